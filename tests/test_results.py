"""The kept results: what is taken in, what they say, and the tables in the README."""

import dataclasses
import json

import numpy as np
import pytest

import envs
from benchmark import results
from benchmark.cells import Cell
from benchmark.results import Result
from tests.helpers import script


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "STORE", tmp_path / "store")
    return tmp_path / "store"


def write_run(cell, runs, returns, lengths, outcomes, **changed):
    """What a script leaves after these episodes."""
    folder = runs / "a" / "b"
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "episodes.npz", returns=returns, lengths=lengths, outcomes=outcomes)
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
    result = Result.of_run(folder)
    score = returns / np.maximum(lengths - 1, 1)
    best = envs.make_world("pushbox").best_outcome
    assert result.score.shape == result.at_best.shape == (20, 2)
    assert result.score[3, 1] == pytest.approx(score[3, 100:200].mean(), abs=1e-6)
    assert result.at_best[4, 0] == pytest.approx((outcomes[4, :100] == best).mean(), abs=1e-6)
    assert result.last == pytest.approx(score[:, -12:].mean(1))
    assert result.usual[5] == np.bincount(outcomes[5, -12:]).argmax()
    assert result.num_episodes == 250


def test_a_result_is_loaded_as_it_was_saved(tmp_path):
    result = Result.of_run(some_run(tmp_path)[0])
    result.save(tmp_path / "kept" / "pg-adam.npz")
    again = Result.load(tmp_path / "kept" / "pg-adam.npz")
    for name, value in vars(result).items():
        assert np.array_equal(value, getattr(again, name))


def test_only_the_comparisons_own_runs_are_taken_in(tmp_path, store):
    some_run(tmp_path / "gamma", gamma=0.5)
    some_run(tmp_path / "seed", seed=2)
    results.take_in(tmp_path)
    assert not store.exists()
    some_run(tmp_path / "own")
    results.take_in(tmp_path)
    assert [path.relative_to(store).as_posix() for path in store.rglob("*.npz")] == ["pushbox/pg-adam.npz"]


def test_the_longer_run_counts(tmp_path, store):
    for runs, kept in (("some", 250), ("more", 300), ("fewer", 300)):
        some_run(tmp_path / runs, num_episodes={"some": 250, "more": 300, "fewer": 200}[runs])
        results.take_in(tmp_path / runs)
        assert Result.load(store / "pushbox" / "pg-adam.npz").num_episodes == kept


def test_a_difference_is_that_of_the_same_seeds():
    def result(last):
        return Result(None, None, np.asarray(last), None, 0, {})

    noise = np.random.default_rng(0).normal(size=20)
    assert results.difference(result(noise * 100 + 2), result(noise * 100)) == "+2.00 [+2.00, +2.00]"
    wide = results.difference(result(noise), result(np.zeros(20)))
    mean, error = noise.mean(), noise.std(ddof=1) / np.sqrt(20)
    low, high = (float(word.strip("[],")) for word in wide.split()[1:])
    assert float(wide.split()[0]) == pytest.approx(mean, abs=0.01)
    assert low == pytest.approx(mean - 1.96 * error, abs=0.15)
    assert high == pytest.approx(mean + 1.96 * error, abs=0.15)


def test_tables_are_written_between_their_marks():
    readme = "a\n<!-- scores -->\nold\n<!-- end scores -->\nb\n<!-- other -->\n<!-- end other -->"
    once = results.rewrite(readme, "scores", "new")
    assert once == "a\n<!-- scores -->\nnew\n<!-- end scores -->\nb\n<!-- other -->\n<!-- end other -->"
    assert results.rewrite(once, "scores", "new") == once


def test_the_readmes_tables_are_those_of_the_kept_results():
    kept = results.kept()
    assert len(kept) >= 8
    readme = results.README.read_text()
    assert results.score_table(kept) in readme
    assert results.difference_table(kept) in readme
