"""The kept results: what is taken in, and what is said of them."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

import envs
from algos import pg
from benchmark import measures, results
from benchmark.cells import Cell
from benchmark.results import Result
from tests.helpers import script, train


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "STORE", tmp_path / "store")
    return tmp_path / "store"


def write_run(cell, runs, returns, lengths, outcomes, **changed):
    """What a script leaves after these episodes."""
    folder = runs / "a" / "b"
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "episodes.npz", returns=returns, lengths=lengths, outcomes=outcomes)
    (folder / "seconds").write_text("12.5\n")
    args = {**dataclasses.asdict(script(cell.method).Args()), **cell.settings, **changed}
    (folder / "args.json").write_text(json.dumps({"method": args.pop("method"), "args": args}, default=str))
    return folder


def some_run(runs, num_episodes=250, **changed):
    cell, rng = Cell("pg", "pushbox", "adam", num_episodes=num_episodes), np.random.default_rng(0)
    lengths, outcomes = rng.integers(1, 50, (20, num_episodes)), rng.integers(0, 5, (20, num_episodes))
    returns = rng.normal(size=lengths.shape)
    return write_run(cell, runs, returns, lengths, outcomes, **changed), returns, lengths, outcomes


def test_a_result_is_the_block_means_of_its_episodes(tmp_path):
    folder, returns, lengths, outcomes = some_run(tmp_path)
    result = Result.of_runs([folder])
    score = returns / np.maximum(lengths - 1, 1)
    best = envs.make_world("pushbox").best_outcome
    assert result.score.shape == result.at_best.shape == (20, 20)  # blocks of 12
    assert result.score[3, 1] == pytest.approx(score[3, 12:24].mean(), abs=1e-6)
    assert result.at_best[4, 0] == pytest.approx((outcomes[4, :12] == best).mean(), abs=1e-6)
    assert result.last == pytest.approx(score[:, -13:].mean(1))
    assert result.usual[5] == np.bincount(outcomes[5, -12:]).argmax()
    assert (result.num_episodes, result.seconds) == (250, 12.5)
    assert result.about["args"]["learning_rate"] == Cell("pg", "pushbox", "adam").settings["learning_rate"]
    assert "run_dir" not in result.about["args"]
    assert result.steps[7, [0, 19]].tolist() == [lengths[7, :12].sum(), lengths[7, :240].sum()]
    assert [results.block_of(n) for n in (1, 50, 2000, 20_000)] == [1, 2, 100, 100]


def test_a_result_is_loaded_as_it_was_saved(tmp_path):
    result = Result.of_runs([some_run(tmp_path)[0]])
    result.save(tmp_path / "kept" / "pg-adam.npz")
    again = Result.load(tmp_path / "kept" / "pg-adam.npz")
    for name, value in vars(result).items():
        assert np.array_equal(value, getattr(again, name))


def test_only_the_comparisons_own_runs_are_found(tmp_path):
    some_run(tmp_path / "gamma", gamma=0.5)
    some_run(tmp_path / "seed", seed=2)
    some_run(tmp_path / "longer", num_episodes=300)
    assert results.finished(tmp_path, num_episodes=250) == {}
    some_run(tmp_path / "own")
    found = results.finished(tmp_path, num_episodes=250)
    assert {key: result.num_episodes for key, result in found.items()} == {("pushbox", "pg", "adam"): 250}
    assert results.finished(tmp_path) == {}  # Table 1's number of episodes
    assert results.finished(tmp_path, seeds=(1, 3), num_episodes=250) == {}


def test_a_result_is_put_together_from_blocks_of_seeds(tmp_path):
    whole, returns, lengths, outcomes = some_run(tmp_path / "whole")
    expected, parts = Result.of_runs([whole]), tmp_path / "parts"
    for first, end in ((1, 6), (6, 15), (15, 21)):
        assert results.finished(parts, num_episodes=250) == {}
        cell, block = Cell("pg", "pushbox", "adam", first, end - first, num_episodes=250), slice(first - 1, end - 1)
        folder = write_run(cell, parts / str(first), returns[block], lengths[block], outcomes[block])
        about = json.loads((folder / "args.json").read_text(encoding="utf-8"))
        (folder / "args.json").write_text(json.dumps({**about, "commit": "b" if first == 6 else "a"}))
    ((_, result),) = results.finished(parts, num_episodes=250).items()
    for name in ("score", "at_best", "steps", "last", "usual"):
        assert np.array_equal(getattr(result, name), getattr(expected, name))
    assert (result.seconds, result.about["commit"], result.about["args"]["num_trials"]) == (37.5, "a and b", 20)


def test_blocks_that_overlap_or_leave_a_gap_are_none():
    def cover(*blocks):
        return results.cover({block: str(block) for block in blocks}, 1, 21)

    assert cover((1, 11), (11, 21)) == ["(1, 11)", "(11, 21)"]
    assert cover((1, 21), (1, 11), (11, 21), (5, 8)) == ["(1, 21)"]
    assert cover((1, 11), (12, 21)) == cover((1, 11), (10, 21)) == cover((1, 22)) == cover((2, 21)) == []
    assert cover((1, 11), (1, 16), (11, 21)) == ["(1, 11)", "(11, 21)"]


def test_what_is_broken_is_named_and_left_out(tmp_path, store, capsys):
    whole = some_run(tmp_path / "whole")[0]
    half = tmp_path / "half"
    shutil.copytree(whole, half)
    (half / "episodes.npz").write_bytes(b"half")
    assert results.finished(half, num_episodes=250) == {}
    assert "half/episodes.npz cannot be read" in capsys.readouterr().err
    (half / "args.json").write_text("{")
    assert results.finished(half, num_episodes=250) == {}
    assert "half cannot be read" in capsys.readouterr().err
    results.keep(results.finished(whole, num_episodes=250))
    assert list(results.kept()) == [("pushbox", "pg", "adam")]
    kept = store / "pushbox" / "pg-adam.npz"
    kept.write_bytes(kept.read_bytes()[:-40])
    assert results.kept() == {}
    assert f"{kept} cannot be read" in capsys.readouterr().err


def test_one_broken_or_foreign_run_leaves_the_others(tmp_path, capsys):
    some_run(tmp_path / "own")
    (some_run(tmp_path / "time")[0] / "seconds").write_text("", encoding="utf-8")
    assert np.isnan(Result.of_runs([tmp_path / "time" / "a" / "b"]).seconds)
    shutil.rmtree(tmp_path / "time")
    for name, about in {"list": [], "no-args": {"method": "pg"}, "odd": {"method": ["pg"], "args": 3}}.items():
        folder = some_run(tmp_path / name)[0]
        (folder / "args.json").write_text(json.dumps(about), encoding="utf-8")
    some_run(tmp_path / "types", seed="one")
    some_run(tmp_path / "world", env="missing.py")
    (tmp_path / "loop").symlink_to(tmp_path)
    assert list(results.finished(tmp_path, num_episodes=250)) == [("pushbox", "pg", "adam")]
    assert len(capsys.readouterr().err.splitlines()) == 5
    (tmp_path / "own" / "a" / "b" / "policy.pt").write_bytes(b"none")
    assert results.finished(tmp_path / "own", num_episodes=250) == {}
    assert "policy.pt is not a policy.pt" in capsys.readouterr().err


def test_an_episode_of_the_first_team_is_kept(tmp_path):
    args = dict(env="findtreasure", seed=1, num_trials=2, num_episodes=400, learning_rate=3e-3, save_model=True)
    log = train(pg, tmp_path, **args).log
    world, actions = log.world, Result.of_runs([tmp_path]).actions
    assert Result.of_runs([tmp_path]).actions.tolist() == actions.tolist()
    state, outcome = world.start.copy(), 0
    for step, joint in enumerate(actions.astype(np.int64)):
        assert outcome == 0, step
        _, outcome = world.step(world.rules, state, joint)
    assert outcome == log.usual_outcomes(slice(-20, None))[0] > 0
    (tmp_path / "policy.pt").unlink()
    assert Result.of_runs([tmp_path]).actions.shape == (0, 2)


def some_result(last, **values):
    empty = dict.fromkeys(Result.__dataclass_fields__)
    return Result(**{**empty, "last": np.asarray(last), "seconds": float("nan"), "num_episodes": 100, "about": {}, **values})


def test_a_difference_is_that_of_the_same_seeds():
    noise = np.random.default_rng(0).normal(size=20)
    assert measures.difference(some_result(noise * 100 + 2), some_result(noise * 100)) == pytest.approx((2, 2, 2))
    mean, low, high = measures.difference(some_result(noise), some_result(np.zeros(20)))
    assert mean == noise.mean()
    error = noise.std(ddof=1) / np.sqrt(20)
    assert (low, high) == pytest.approx((mean - 1.96 * error, mean + 1.96 * error), abs=0.15)


def test_when_most_trials_are_good_is_the_end_of_the_first_such_block():
    good = np.zeros((20, 4), bool)
    good[:18, 1], good[:19, 2], good[:, 3] = True, True, True
    result = some_result(np.zeros(20), num_episodes=20_000, steps=np.arange(80).reshape(20, 4))
    assert measures.reached(result, good) == (300, result.steps[:, 2].mean())
    assert measures.reached(result, good[:, :2]) is None
    score = np.array([[0.949, 0.951], [0.96, 0.94]]) * 100 / 3
    assert measures.near_optimum(some_result([0], score=score), "pushbox").tolist() == [[False, True], [True, False]]


def test_scores_are_shares_of_the_optimum_where_a_method_has_all_worlds():
    found = {("findtreasure", "pg", "sign"): some_result([1, 2]), ("pushbox", "pg", "sign"): some_result([100 / 3, 50 / 3])}
    found["pushbox", "spg", "sign"] = some_result([1, 1])
    shares = measures.scores_over_worlds(found, "sign", ("findtreasure", "pushbox"))
    assert list(shares) == ["pg"]
    assert shares["pg"] == pytest.approx(np.array([[7 / 100, 1], [14 / 100, 0.5]]))


def test_interquartile_means_leave_the_outer_quarters_out():
    scores = np.arange(40.0).reshape(20, 2)
    scores[-1] = 1e6
    assert measures.interquartile_means({"pg": scores})["pg"][0] == pytest.approx(np.arange(10, 30).mean())


def test_intervals_are_seeded_and_leave_the_global_generator_alone():
    scores = {"pg": np.random.default_rng(1).normal(size=(20, 2)), "decespg": np.random.default_rng(2).normal(size=(20, 2))}
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    first = measures.interquartile_means(scores, reps=50), measures.improvements(scores, reps=50)
    assert (measures.interquartile_means(scores, reps=50), measures.improvements(scores, reps=50)) == first
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002
    for value, low, high in (*first[0].values(), *first[1].values()):
        assert low < value < high


def test_improvement_counts_the_pairs_that_are_better():
    scores = {"decespg": np.array([[1.0], [3.0]]), "pg": np.array([[0.0], [2.0]]), "spg": np.array([[1.0], [1.0]])}
    better = measures.improvements(scores, reps=50)
    assert {method: value for method, (value, _, _) in better.items()} == {"pg": 0.75, "spg": 0.75}


def test_a_profile_is_the_share_of_all_runs_above():
    scores = {"pg": np.array([[0.0, 0.5], [0.2, 1.0]])}
    value, low, high = measures.profiles(scores, np.array([0.1, 0.4, 0.9]), reps=50)["pg"]
    assert value.tolist() == [0.75, 0.5, 0.25]
    assert np.all(low <= value)
    assert np.all(value <= high)


def test_the_pace_of_what_nobody_has_timed_is_guessed_from_pg():
    found = {
        ("pushbox", "pg", "sign"): some_result([], seconds=100.0, num_episodes=1000),
        ("pushbox", "pg", "adam"): some_result([], seconds=300.0, num_episodes=1000),
        ("pushbox", "spg", "adam"): some_result([], seconds=600.0, num_episodes=1000),
        ("movebox", "pg", "sign"): some_result([], seconds=5000.0, num_episodes=1000),
        ("movebox", "epg", "sign"): some_result([]),
        ("cleaner", "spg", "sign"): some_result([], seconds=9000.0, num_episodes=1000),
    }
    pace = results.seconds_per_episode(found)
    assert pace["pg", "pushbox"] == pytest.approx(0.2)
    assert pace["spg", "movebox"] == pytest.approx(15)
    assert pace["epg", "movebox"] == pytest.approx(5)
    assert pace["pg", "cleaner"] == pytest.approx(3)
    assert pace["spg", "cleaner"] == pytest.approx(9)
    assert pace["epg", "gotogether"] == 0.01
