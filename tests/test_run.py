"""What a run keeps, which is the same for all scripts: its files, curves, checkpoints and refusals, and `--evaluate`."""

import contextlib
import io
import itertools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import envs
from algos import decespg, pg
from envs import run, worlds
from tests.helpers import (
    ALGOS,
    RACE,
    assert_one_sentence,
    assert_refusal,
    assert_same_results,
    command,
    contents,
    curves,
    results,
    stop_after,
    train,
)

SHORT = ["--env", "findtreasure", "--env-args", "size=9", "--max-steps", 40, "--hidden", 16, "--num-trials", 2, "--seed", 5]
INTERRUPTED = [*SHORT, "--num-episodes", 60, "--log-every", 10]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The directory of a finished run of pg.py and how its command ended."""
    directory = tmp_path_factory.mktemp("finished") / "run"
    words = [*SHORT, "--num-episodes", 250, "--save-model", "--capture-video", "--run-dir", directory]
    return directory, command("pg", *words)


# --- arguments ---


def test_the_default_directory_says_what_is_not_default():
    def directory(**args):
        return str(run.default_run_dir(pg.Args(env="findtreasure", **args)))

    assert directory() == "runs/findtreasure/pg/seed1"
    assert directory(seed=3, num_trials=4) == "runs/findtreasure/pg/seed3-6"
    assert (
        directory(learning_rate=0.5, hidden=(8, 4), env_args=("size=9",), max_steps=7)
        == "runs/findtreasure/pg/seed1-env_args=size=9-max_steps=7-hidden=8,4-learning_rate=0.5"
    )
    assert directory(save_model=True, overwrite=True, checkpoint_every=1.0) == directory()


def test_the_actors_weights_are_the_first_draws_and_each_trial_has_its_own_streams():
    init, act, learn = run.generators_of(pg.Args(seed=7, num_trials=3))
    alone = run.generators_of(pg.Args(seed=8))
    for stream, own in zip((init, act, learn), alone, strict=True):
        draws = [generator.random() for generator in stream]
        assert len(set(draws)) == 3
        assert draws[1] == own[0].random()


def test_a_time_limit_among_the_options_of_the_world_counts(tmp_path):
    words = ["--env-args", "max_steps=7", "--max-steps", "9", "--num-episodes", "2", "--run-dir", tmp_path]
    assert command("pg", *words).code == 0
    assert json.loads((tmp_path / "args.json").read_text(encoding="utf-8"))["args"]["max_steps"] == 7
    assert results(tmp_path)["lengths"].max() <= 7


def test_compiled_functions_are_found_whatever_name_a_script_was_imported_by(tmp_path):
    call = "print(m.discounted_returns(np.ones((2, 1, 1)), np.array([2]), 0.5)[:, 0, 0])"
    for module, folder in (("pg", ALGOS), ("algos.pg", ALGOS.parent)):
        code = f"import numpy as np, {module} as m; {call}"
        environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(tmp_path)}
        ended = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert (ended.returncode, ended.stdout) == (0, "[1.5 1. ]\n"), ended.stderr


# --- what a finished run leaves ---


def test_a_run_leaves_its_files_and_says_how_it_ended(finished):
    directory, ended = finished
    assert ended.code == 0
    assert sorted(path.name for path in directory.iterdir()) == [
        *("args.json", "episodes.npz", "policy.pt", "seed5", "seed6", "team.gif")
    ]
    usual = [np.bincount(trial).argmax() for trial in results(directory)["outcomes"][:, -12:]]
    ends = [f"{usual.count(k)} {what}" for k, what in enumerate(("time limit", "treasure", "meeting")) if k in usual]
    (line,) = ended.out.splitlines()
    assert line.startswith(f"{directory}: 2 trials, usual end: {', '.join(ends)}; reward per step ")
    assert "compiling, if it is the first time" in ended.err
    for words in ("pg findtreasure: 100%", "250/250", "reward/step=", "steps/s=", "trials at best="):
        assert words in ended.err


def test_args_json_holds_all_resolved_arguments_and_versions(finished):
    about = json.loads((finished[0] / "args.json").read_text(encoding="utf-8"))
    assert about["method"] == "pg"
    assert about["args"].keys() == {*vars(pg.Args())}
    given = dict(env="findtreasure", env_args=["size=9"], seed=5, num_trials=2, num_episodes=250, max_steps=40, hidden=[16])
    assert about["args"].items() >= dict(given, gamma=0.98, optimizer="sign", learning_rate=1e-3).items()
    assert [name for name, value in about["args"].items() if value is None] == ["evaluate"]
    assert about["torch"] == version("torch")
    assert {"python", "numpy", "numba", "gymnasium", "commit", "source"} <= about.keys()


def test_the_episodes_agree_with_each_other(finished):
    episodes = results(finished[0])
    returns, lengths, outcomes = episodes["returns"], episodes["lengths"], episodes["outcomes"]
    assert {name: (values.shape, values.dtype) for name, values in episodes.items()} == {
        "returns": ((2, 250), np.float64),
        "lengths": ((2, 250), np.int32),
        "outcomes": ((2, 250), np.int8),
    }
    assert lengths.min() >= 6  # the way to the meeting cells of the larger map
    assert np.all(lengths[outcomes == 0] == 40)
    bumps = (returns - np.array([0.0, 100.0, 3.0])[outcomes]) / -0.1
    assert bumps == pytest.approx(bumps.round(), abs=1e-6)
    assert np.all((bumps > -0.5) & (bumps < 2 * lengths + 0.5))
    assert not np.array_equal(returns[0], returns[1])


def test_tensorboard_shows_the_means_between_its_points_over_environment_steps(finished):
    directory, _ = finished
    episodes = results(directory)
    for k in range(2):
        shown = curves(directory / f"seed{5 + k}")
        returns, lengths = (episodes[which][k, :200].reshape(2, 100) for which in ("returns", "lengths"))
        steps = lengths.sum(1).cumsum().tolist()
        assert all([step for step, _ in points] == steps for points in shown.values())
        expected = {
            "episodic_return": returns.mean(1),
            "episodic_length": lengths.mean(1),
            "reward_per_step": (returns / (lengths - 1)).mean(1),
            "episode": [100, 200],
        }
        for tag, values in expected.items():
            assert [value for _, value in shown[f"charts/{tag}"]] == pytest.approx(values, rel=1e-5)
        assert min(value for _, value in shown["charts/SPS"]) > 0
        assert all(0 < value <= np.log(5) + 1e-6 for _, value in shown["losses/entropy"])
        assert np.std([value for _, value in shown["losses/policy_loss"]]) > 0


def test_tensorboard_shows_the_arguments_as_text(finished):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(finished[0] / "seed5"), size_guidance={"tensors": 0})
    events.Reload()
    (point,) = events.Tensors("arguments")
    assert "learning_rate = 0.001" in point.tensor_proto.string_val[0].decode()


def test_the_curves_of_many_trials_need_few_open_files(tmp_path):
    lowest, highest = resource.getrlimit(resource.RLIMIT_NOFILE)
    now_open = len(os.listdir("/proc/self/fd"))
    resource.setrlimit(resource.RLIMIT_NOFILE, (now_open + 10, highest))
    try:
        train(pg, tmp_path, num_trials=60, num_episodes=2, max_steps=4, log_every=1)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, highest))
    assert len(list(tmp_path.glob("seed*/events*"))) == 60


def test_the_captured_video_is_an_episode(finished):
    with Image.open(finished[0] / "team.gif") as gif:
        assert 7 <= gif.n_frames <= 41  # the start and every step
        assert gif.width == 9 * 48


def test_a_finished_run_is_overwritten_only_on_request(finished, tmp_path):
    directory = tmp_path / "run"
    shutil.copytree(finished[0], directory)
    before = contents(directory)
    words = [*SHORT, "--num-episodes", "30", "--log-every", "10", "--run-dir", directory]
    assert_refusal("pg", command("pg", *words), "holds a finished run", "--overwrite")
    assert contents(directory) == before
    ended = command("pg", *words, "--resume")
    assert (ended.code, contents(directory)) == (2, before)
    assert command("pg", *words, "--overwrite").code == 0
    assert results(directory)["returns"].shape == (2, 30)
    assert sorted(path.name for path in directory.iterdir()) == ["args.json", "episodes.npz", "seed5", "seed6"]
    assert [value for _, value in curves(directory / "seed5")["charts/episode"]] == [10, 20, 30]


# --- playing a saved team ---


@pytest.fixture
def policy_file(finished, tmp_path):
    return shutil.copy(finished[0] / "policy.pt", tmp_path / "policy.pt")


def greedy_episodes(params):
    """Reward per step of both teams' episode when they take the likeliest actions, without the scripts' help."""
    env, scores = envs.make_vec("findtreasure", size=9, max_steps=40), []
    for k in range(2):
        obs, _ = env.reset()
        total, steps, over = 0.0, 0, False
        while not over:
            actions = []
            for i in range(2):
                hidden, bias, out, out_bias = (param[2 * k + i] for param in params)
                logits = torch.relu(torch.from_numpy(obs[0, i]) @ hidden + bias) @ out + out_bias
                actions.append(int(logits.argmax()))
            obs, reward, terminated, truncated, _ = env.step(np.array([actions]))
            total, steps, over = total + reward[0], steps + 1, terminated[0] or truncated[0]
        scores.append(total / (steps - 1))
    return scores


def test_a_saved_team_plays_greedily(policy_file):
    ended = command("pg", "--evaluate", policy_file, "--greedy", "--num-episodes", 3)
    assert (ended.code, ended.err) == (0, "")
    scores = greedy_episodes(torch.load(policy_file, weights_only=True)["parts"]["policy"])
    assert ended.out.startswith(f"{policy_file}: 3 episodes of 2 teams, usual end: ")
    score = f"reward per step {np.mean(scores):.2f} (worst trial {min(scores):.2f}, best {max(scores):.2f})"
    assert f"; {score}; one of them in {Path(policy_file).with_suffix('.gif')}\n" in ended.out


def test_a_saved_team_plays_by_drawing(policy_file):
    def play(seed):
        ended = command("pg", "--evaluate", policy_file, "--num-episodes", 20, "--seed", seed, "--overwrite")
        return ended, Path(policy_file).with_suffix(".gif").read_bytes()

    first, second, again = map(play, (1, 2, 1))
    assert first[0].code == 0
    assert first == again
    assert first[1] != second[1]  # the lines may be the same, as they are rounded
    assert sorted(path.name for path in Path(policy_file).parent.iterdir()) == ["policy.gif", "policy.pt"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--num-episodes", 0], "--num-episodes"),
        (["--seed", -1], "--seed"),
        (["--env", "findtreasure"], "--env does not go with --evaluate"),
        (["--learning-rate", 0.1], "--learning-rate does not go with --evaluate"),
        (["--save-model"], "--save-model does not go with --evaluate"),
    ],
)
def test_evaluate_refuses_what_it_does_not_heed(policy_file, words, said):
    before = contents(Path(policy_file).parent)
    assert_refusal("pg", command("pg", "--evaluate", policy_file, *words), said)
    assert contents(Path(policy_file).parent) == before


def test_a_team_whose_numbers_are_not_finite_is_not_evaluated(policy_file, tmp_path):
    saved = torch.load(policy_file, weights_only=True)
    saved["parts"]["policy"][-1][:] = np.nan  # the last biases
    torch.save(saved, tmp_path / "policy.pt")
    assert_refusal("pg", command("pg", "--evaluate", tmp_path / "policy.pt"), "numbers are not finite")
    assert not (tmp_path / "policy.gif").exists()


def test_evaluate_overwrites_nothing_unasked(policy_file):
    film = Path(policy_file).with_suffix(".gif")
    film.write_text("mine")
    assert_refusal("pg", command("pg", "--evaluate", policy_file, "--num-episodes", 1), "is there already")
    assert film.read_text(encoding="utf-8") == "mine"
    shutil.copy(policy_file, film)  # a model that is named like a film
    before = film.read_bytes()
    for words in ([], ["--overwrite"]):
        assert_refusal("pg", command("pg", "--evaluate", film, "--num-episodes", 1, *words), "is there already")
        assert film.read_bytes() == before


def test_a_team_of_another_method_is_named(policy_file):
    assert_refusal("spg", command("spg", "--evaluate", policy_file), "is of pg.py, not of spg.py")


def test_a_file_with_other_parts_says_why_it_does_not_fit(policy_file):
    saved = torch.load(policy_file, weights_only=True)
    saved["parts"]["policy"][0] = saved["parts"]["policy"][0][:, :, :3]
    torch.save(saved, policy_file)
    assert_refusal("pg", command("pg", "--evaluate", policy_file), "does not fit to this pg.py", "(4, 4, 3)")


def test_a_saved_team_comes_back_with_everything_that_it_has_learnt(tmp_path):
    trained = train(decespg, tmp_path, env="pushbox", num_trials=2, num_episodes=60, max_steps=30, save_model=True)
    args, world, team = run.load(tmp_path / "policy.pt", decespg)
    assert (args.num_trials, args.max_steps, world.name) == (2, 30, "pushbox")
    for name, part in vars(team).items():
        for one, other in zip(run.arrays_of(part), run.arrays_of(getattr(trained, name)), strict=True):
            assert torch.equal(one, other)
    assert team.novelty.visits.min() > 60


# --- interrupted runs ---


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A run that Ctrl-C ended after 43 of its 60 episodes, how it ended, and one that went through."""
    directory = tmp_path_factory.mktemp("interrupted")
    assert command("decespg", *INTERRUPTED, "--run-dir", directory / "whole").code == 0
    with pytest.MonkeyPatch.context() as monkeypatch:
        stop_after(monkeypatch, 43, signal.SIGINT)
        ended = command("decespg", *INTERRUPTED, "--run-dir", directory / "stopped")
    return directory / "stopped", ended, directory / "whole"


def resume(directory, *words):
    """Go on with a run; not within the second in which it began (no process starts so fast), by which TensorBoard sorts."""
    time.sleep(1)
    return command("decespg", *INTERRUPTED, "--run-dir", directory, "--resume", *words)


def assert_same_curves(directory, other):
    """Both runs show the same points, each once."""
    for trial in ("seed5", "seed6"):
        found, expected = curves(directory / trial), curves(other / trial)
        assert found.keys() == expected.keys()
        for tag in expected.keys() - {"charts/SPS"}:
            assert found[tag] == expected[tag]
        assert [step for step, _ in found["charts/SPS"]] == [step for step, _ in expected["charts/SPS"]]


def test_the_first_speed_after_resuming_is_of_what_was_played_since(tmp_path, monkeypatch):
    """Episodes of 4 steps, and a clock that goes on by a second or more in each: nobody plays more than 4 steps a second."""
    ticks = itertools.count()
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))
    words = ["--env", "gotogether", "--max-steps", 4, "--num-episodes", 60, "--log-every", 10, "--run-dir", tmp_path / "run"]
    with monkeypatch.context() as patch:
        stop_after(patch, 43, signal.SIGINT)
        assert command("pg", *words).code == 130
    time.sleep(1)  # as in `resume`
    assert command("pg", *words, "--resume").code == 0
    speeds = [speed for _, speed in curves(tmp_path / "run" / "seed1")["charts/SPS"]]
    assert len(speeds) == 6
    assert 2 < min(speeds) <= max(speeds) <= 4


def test_a_run_that_another_process_has_finished_meanwhile_is_not_lost(tmp_path, monkeypatch):
    """Between the question whether something is there and the lock."""
    own = run.Run._own_directory

    def late(self):
        self.result.write_text("finished")
        own(self)

    monkeypatch.setattr(run.Run, "_own_directory", late)
    ended = command("pg", "--env", "findtreasure", "--num-episodes", 2, "--run-dir", tmp_path / "run")
    assert_refusal("pg", ended, "holds a finished run")
    assert (tmp_path / "run" / "episodes.npz").read_text() == "finished"


def test_ctrl_c_leaves_a_checkpoint_from_which_the_run_goes_on(interrupted, tmp_path):
    stopped, ended, whole = interrupted
    assert ended.code == 130
    assert "Stopped after 43 episodes; go on with --resume." in ended.err
    left = [path.name for path in stopped.iterdir() if path.name != ".owner"]
    assert sorted(left) == ["args.json", "checkpoint.pt", "seed5", "seed6"]
    directory = tmp_path / "run"
    shutil.copytree(stopped, directory)
    assert resume(directory).code == 0
    assert_same_results(directory, whole)
    assert_same_curves(directory, whole)
    assert not (directory / "checkpoint.pt").exists()


def test_a_run_may_be_stopped_twice(interrupted, tmp_path):
    *_, whole = interrupted
    with pytest.MonkeyPatch.context() as patched:
        stop_after(patched, 13, signal.SIGTERM)
        assert command("decespg", *INTERRUPTED, "--run-dir", tmp_path).code == 143
    with pytest.MonkeyPatch.context() as patched:
        stop_after(patched, 33, signal.SIGTERM)
        assert resume(tmp_path).code == 143
    assert resume(tmp_path).code == 0
    assert_same_results(tmp_path, whole)
    assert_same_curves(tmp_path, whole)


@pytest.mark.parametrize(
    ("name", "optimizer", "number", "code"),
    [
        ("pg", "sign", signal.SIGKILL, -9),
        ("decespg", "sign", signal.SIGTERM, 143),
        ("decespg", "adam", signal.SIGKILL, -9),
    ],
)
def test_a_killed_run_goes_on_as_if_nothing_had_happened(name, optimizer, number, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--env", "pushbox", "--max-steps", "50", "--num-trials", "2", "--seed", "5", "--optimizer", optimizer]
    words += ["--num-episodes", "600", "--log-every", "1", "--checkpoint-every", "0", "--run-dir", "run"]
    process = subprocess.Popen([sys.executable, ALGOS / f"{name}.py", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    while not Path("run/checkpoint.pt").exists():
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(0.3 * random.random())  # a moment that nobody has chosen
    process.send_signal(number)
    out, _ = process.communicate()
    assert (process.returncode, out) == (code, b"")
    assert not Path("run/episodes.npz").exists()
    done = torch.load("run/checkpoint.pt", weights_only=True)["episode"]
    assert 0 < done < 600
    assert command(name, *words, "--resume").code == 0
    assert command(name, *words[:-1], "whole").code == 0
    assert_same_results(Path("run"), Path("whole"))
    assert_same_curves(Path("run"), Path("whole"))
    left = {path.name for path in Path("run").iterdir() if not path.name.startswith(".")}
    assert left == {"args.json", "episodes.npz", "seed5", "seed6"}


def test_checkpoints_are_so_seldom_that_they_cost_under_2_percent_of_the_time(tmp_path, monkeypatch):
    seconds, written, record = [0.0], [], run.Run.record
    monkeypatch.setattr(time, "monotonic", lambda: seconds[0])

    def record_for_a_second(*args, **figures):
        record(*args, **figures)
        seconds[0] += 1.0

    def save_for_three_seconds(self, episode):
        written.append(seconds[0])
        seconds[0] += 3.0

    monkeypatch.setattr(run.Run, "record", record_for_a_second)
    monkeypatch.setattr(run.Run, "_save_checkpoint", save_for_three_seconds)
    train(pg, tmp_path, num_episodes=500, max_steps=3, checkpoint_every=60.0)
    assert written == [60.0, 213.0, 366.0]  # the first after a minute, then 150 seconds after the end of the last one


def test_a_script_may_train_in_a_thread(tmp_path):
    """In which Python allows no handlers of signals."""
    thread = threading.Thread(target=train, args=(pg, tmp_path), kwargs=dict(num_episodes=3, max_steps=3))
    thread.start()
    thread.join()
    assert results(tmp_path)["returns"].shape == (1, 3)


def test_an_unfinished_run_is_not_overwritten(interrupted):
    stopped, *_ = interrupted
    before = contents(stopped)
    ended = command("decespg", *INTERRUPTED, "--run-dir", stopped)
    assert_refusal("decespg", ended, "holds an unfinished run", "--resume", "--overwrite")
    assert contents(stopped) == before


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        (["--seed", "6"], "seed"),
        (["--gamma", "0.9"], "gamma"),
        (["--hidden", "8"], "hidden"),
        (["--env", "pushbox", "--env-args", "size=4"], "env"),
        (["--num-episodes", "70"], "num_episodes"),
        (["--slots", "1"], "slots"),
    ],
)
def test_resume_refuses_changed_arguments_by_name(interrupted, changed, what):
    stopped, *_ = interrupted
    before = contents(stopped)
    ended = command("decespg", *INTERRUPTED, "--run-dir", stopped, "--resume", *changed)
    assert_refusal("decespg", ended, f"but {what} was ")
    assert contents(stopped) == before


def test_a_checkpoint_of_another_script_is_refused(interrupted):
    stopped, *_ = interrupted
    ended = command("espg", *INTERRUPTED, "--run-dir", stopped, "--resume")
    assert_refusal("espg", ended, "method was decespg and is now espg")


def test_a_broken_checkpoint_is_refused_and_kept(interrupted, tmp_path):
    stopped, *_ = interrupted
    shutil.copytree(stopped, tmp_path / "run")
    broken = tmp_path / "run" / "checkpoint.pt"
    broken.write_bytes(broken.read_bytes()[:1000])
    ended = command("decespg", *INTERRUPTED, "--run-dir", tmp_path / "run", "--resume")
    assert_refusal("decespg", ended, "checkpoint.pt cannot be read")
    assert len(broken.read_bytes()) == 1000


@pytest.mark.parametrize("change", ["other shapes", "other parts", "nothing else"])
def test_a_checkpoint_of_an_older_script_is_named_as_such(interrupted, tmp_path, change):
    stopped, *_ = interrupted
    shutil.copytree(stopped, tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.pt"
    saved = torch.load(path, weights_only=True)
    if change == "other shapes":
        saved["contents"]["memory"] = saved["contents"]["memory"][:-1]
    elif change == "other parts":
        del saved["contents"]["memory"]
    else:
        saved = {"settings": saved["settings"]}
    torch.save(saved, path)
    ended = command("decespg", *INTERRUPTED, "--run-dir", tmp_path / "run", "--resume")
    assert_refusal("decespg", ended, "is not a checkpoint of this version of decespg.py", "--overwrite")


# --- directories ---


def test_a_directory_has_one_owner_at_a_time(tmp_path):
    args, world = run.resolve(pg.Args(run_dir=tmp_path / "run"), pg.WORLDS, pg.TUNED, pg.OTHER)
    first = run.Run(args, world, pg.build(args, world, run.generators_of(args)[0]))
    code = "import sys; from envs import run; from algos import pg; run.main(pg.Args, pg.build, pg.train)"
    words = [sys.executable, "-c", code, "--run-dir", str(tmp_path / "run"), "--num-episodes", "2"]
    ended = subprocess.run(words, capture_output=True, text=True, cwd=ALGOS.parent)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "another process works in" in ended.stderr
    first.lock.close()
    assert command("pg", "--run-dir", tmp_path / "run", "--num-episodes", 2).code == 0


@pytest.mark.parametrize("name", ["notes.txt", "data"])
def test_a_directory_with_other_files_is_refused(name, tmp_path):
    (tmp_path / name).mkdir() if name == "data" else (tmp_path / name).write_text("mine")
    before = contents(tmp_path)
    for words in ([], ["--overwrite"]):
        assert_refusal("pg", command("pg", "--num-episodes", 2, "--run-dir", tmp_path, *words), f"holds other files ({name})")
    assert contents(tmp_path) == before


def test_a_policy_without_its_run_is_not_cleared_away(tmp_path):
    (tmp_path / "policy.pt").write_bytes(b"somebody's")
    ended = command("pg", *INTERRUPTED, "--run-dir", tmp_path)
    assert_refusal("pg", ended, "holds an unfinished run or a part of one", "--overwrite")
    assert contents(tmp_path) == {Path("policy.pt"): b"somebody's"}


# --- what goes wrong on the way ---


def test_numbers_that_are_no_longer_finite_end_the_run_with_the_episode(tmp_path):
    words = ["--learning-rate", "1e38", "--num-episodes", 50, "--run-dir", tmp_path]
    ended = command("pg", *words)
    assert (ended.code, ended.out) == (2, "")
    sentence = ended.err.splitlines()[-1]
    assert sentence.startswith("pg.py: in episode ")
    assert "the policies' numbers are no longer finite; a step size" in sentence
    assert not (tmp_path / "episodes.npz").exists()


def test_an_observation_that_is_not_finite_is_not_blamed_on_the_step_size(tmp_path, monkeypatch):
    monkeypatch.setattr(worlds, "try_out", lambda world: None)  # as where random play does not come to it
    world = tmp_path / "race.py"
    see = "@envs.rule\ndef observe(rules, cell, state, obs):\n    obs[:] = np.inf\n\n\nclass Race"
    text = RACE.read_text(encoding="utf-8").replace("class Race", see)
    call = next(line for line in text.splitlines() if "super().__init__" in line)
    world.write_text(text.replace(call, f"{call}\n        self.observe = observe"))
    ended = command("pg", "--env", world, "--num-episodes", 50, "--run-dir", tmp_path / "run")
    assert ended.code == 2
    assert "pg.py: in episode 1 an observation or a reward of the world is not finite." in ended.err


def test_a_part_that_could_not_be_saved_is_refused_before_anything_is_done(tmp_path, monkeypatch):
    monkeypatch.setattr(decespg, "SelectiveMemory", lambda *_, **__: SimpleNamespace(state=[[1.0]]))
    ended = command("decespg", "--num-episodes", 5, "--run-dir", tmp_path / "run")
    assert_refusal("decespg", ended, "the team's memory, a SimpleNamespace, must list its arrays and tensors")
    assert not (tmp_path / "run").exists()


def test_a_world_without_a_picture_is_refused_a_film_at_once_and_evaluated_without(tmp_path):
    world = tmp_path / "race.py"
    text = RACE.read_text(encoding="utf-8").replace("PositionWorld", "World").replace("def sketch", "def outline")
    see = "@envs.rule\ndef observe(rules, cell, state, obs):\n    obs[:] = cell\n\n\nclass Race"
    numbers = "start=[0, 0, 1, 0], local_index=[[0], [2]], num_agents=2, obs_dim=3, cell=1, state_scale=[1] * 4, max_steps=9"
    call = next(line for line in text.splitlines() if "super().__init__" in line)
    text = text.replace("class Race", see).replace(call, f"        super().__init__(rules, {numbers})")
    world.write_text(text.replace("    step = static", "    observe = staticmethod(observe)\n    step = static"))
    words = ["--env", world, "--num-episodes", 5, "--save-model", "--run-dir", tmp_path / "run"]
    assert_refusal("pg", command("pg", *words, "--capture-video"), "race cannot be drawn")
    assert not (tmp_path / "run").exists()
    assert command("pg", *words).code == 0
    ended = command("pg", "--evaluate", tmp_path / "run" / "policy.pt", "--num-episodes", 4)
    assert (ended.code, "4 episodes of 1 team" in ended.out, ".gif" in ended.out) == (0, True, False)


def test_a_learnt_model_that_is_no_longer_finite_ends_the_run(tmp_path):
    words = ["--embedding-learning-rate", "1e38", "--embedding-batch", 2, "--num-episodes", 50, "--max-steps", 5]
    ended = command("espg_emi", *words, "--run-dir", tmp_path / "run")
    assert_refusal("espg_emi", ended, "a learnt model's numbers are no longer finite")


def test_a_full_standard_output_gives_one_sentence_and_keeps_the_results(tmp_path):
    words = [sys.executable, ALGOS / "pg.py", "--num-episodes", "2", "--run-dir", tmp_path / "run"]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 2
    sentence = ended.stderr.splitlines()[-1]
    assert sentence == "pg.py: cannot write to standard output: No space left on device."
    assert "Traceback" not in ended.stderr
    assert results(tmp_path / "run")["returns"].shape == (1, 2)


def test_a_full_disk_gives_one_sentence_and_keeps_the_last_checkpoint(interrupted, tmp_path, monkeypatch):
    stopped, *_ = interrupted
    directory = tmp_path / "run"
    shutil.copytree(stopped, directory)
    before = (directory / "checkpoint.pt").read_bytes()

    def fill_disk(contents, file):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", fill_disk)
    ended = resume(directory, "--checkpoint-every", 0)
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.splitlines()[-1] == f"decespg.py: cannot write to {directory}: No space left on device."
    assert (directory / "checkpoint.pt").read_bytes() == before
    assert not [path for path in directory.iterdir() if path.name.startswith(".checkpoint")]


@pytest.mark.parametrize("after", [0, 3000])
def test_a_disk_that_is_full_within_a_file_gives_one_sentence(after, tmp_path, monkeypatch):
    """Of which torch says something else."""

    class Full(io.BytesIO):
        def write(self, data):
            if self.tell() + len(data) > after:
                raise OSError(28, "No space left on device")
            return super().write(data)

    @contextlib.contextmanager
    def on_a_full_disk(path):
        with Full() if path.suffix == ".pt" else complete_file(path) as file:
            yield file

    complete_file = envs.complete_file
    monkeypatch.setattr(envs, "complete_file", on_a_full_disk)
    ended = command("pg", "--num-episodes", 2, "--max-steps", 5, "--save-model", "--run-dir", tmp_path / "run")
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.splitlines()[-1] == f"pg.py: cannot write to {tmp_path / 'run'}: No space left on device."


# --- bad input ---

BAD_INPUT = {
    "--env pacman": "there is no world 'pacman'; the worlds are ",
    "--env missing.py": "there is no file missing.py",
    "--env findtreasure --env-args size=8": "odd",
    "--env findtreasure --env-args speed=8": "'speed'",
    "--env-args size": "option=value",
    "--num-trials 0": "--num-trials must be a number of at least 1, not 0",
    "--num-episodes -1": "--num-episodes must be a number of at least 1, not -1",
    "--num-episodes 0": "--num-episodes must be a number of at least 1, not 0",
    "--max-steps 0": "must be a whole number of at least 1, not 0",
    "--hidden 0": "--hidden must be a number of at least 1, not 0",
    "--hidden 64 -3": "--hidden must be a number of at least 1, not -3",
    "--gamma 1.5": "--gamma must be a number between 0 and 1, not 1.5",
    "--gamma nan": "--gamma must be a number between 0 and 1, not nan",
    "--learning-rate nan": "--learning-rate must be a number of at least 0, not nan",
    "--learning-rate inf": "--learning-rate must be a number of at least 0, not inf",
    "--seed -1": "--seed must be a number of at least 0, not -1",
    "--log-every 0": "--log-every must be a number of at least 1, not 0",
    "--checkpoint-every -1": "--checkpoint-every must be a number of at least 0, not -1",
    "--checkpoint-every nan": "--checkpoint-every must be a number of at least 0, not nan",
    # beyond 64 bits
    "--seed 100000000000000000000": "--seed must be a number between 0 and 9223372036854775807, not 100000000000000000000",
    "--hidden 64 100000000000000000000": "--hidden must be a number between 1 and 9223372036854775807",
    "--max-steps 1000000000000000000000": "max_steps must be a whole number between 1 and 2147483647",
    "--env-args lone_push_penalty=100000000000000000000": "lone_push_penalty must be a number between 0 and 922337203685477",
    "--env cleaner --env-args maze_seed=100000000000000000000": "maze_seed must be a whole number between 0 and",
    # beyond the memory of this machine, whether that is said before it is tried or after
    "--num-episodes 1000000000000": "a log of 1 x 1000000000000 episodes would need 13,000 GB of memory, and this machine has",
    "--num-trials 1000000000000": "a log of 1000000000000 x 20000 episodes would need",
    "--max-steps 2000000000": "1 x 2000000000 steps of an episode would need",
    "--hidden 10000000000": "2 networks with hidden layers of 10000000000 would need",
    "--resume": "there is nothing to resume",
    "--greedy": "--greedy goes with --evaluate only",
    "--run-dir file": "cannot write to file",
    "--run-dir file/below": "cannot write to file/below",
    f"--run-dir {'x' * 300}": "File name too long",
    f"--evaluate {'x' * 300}": "there is no file",
    f"--env {'x' * 300}.py": "there is no file",
    "--run-dir .": "--run-dir must name a directory of its own",
    "--evaluate file": "file is not a policy.pt",
    "--evaluate missing.pt": "missing.pt",
    "--evaluate other.pt": "other.pt is not a policy.pt",
    "--evaluate folder": "folder is not a policy.pt",
    "--evaluate /": "/ is not a policy.pt",
}


@pytest.fixture
def files(tmp_path, monkeypatch):
    """The working directory: a folder, a text file and a file that torch can read but that no script wrote."""
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    Path("file").write_text("mine")
    torch.save({"weights": torch.zeros(3)}, "other.pt")
    return tmp_path


@pytest.mark.parametrize(("words", "said"), BAD_INPUT.items())
def test_bad_input_is_refused_in_one_sentence(words, said, files):
    before = contents(files)
    assert_refusal("pg", command("pg", *words.split()), said)
    assert contents(files) == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("decespg", "--window 10000000000"),
        ("decespg", "--window 9223372036854775807"),
        ("spg", "--slots 10000000000"),
        ("espg_icm", "--features 9000000000000000000"),
    ],
)
def test_what_does_not_fit_into_memory_is_refused(name, words, files):
    before = contents(files)
    assert_refusal(name, command(name, *words.split(), "--num-episodes", 2), "this is too large for the machine (")
    assert contents(files) == before


def test_numbers_of_numpy_are_numbers(tmp_path):
    args = dict(num_episodes=np.int64(2), num_trials=np.int8(1), seed=np.uint8(3), gamma=np.float32(0.5), max_steps=np.int16(3))
    train(pg, tmp_path, **args)
    about = json.loads((tmp_path / "args.json").read_text(encoding="utf-8"))["args"]
    assert [about[name] for name in args] == [2, 1, 3, 0.5, 3]


def test_a_default_directory_has_no_longer_name_than_a_file_system_takes():
    args = [pg.Args(env_args=("x" * 300, last)) for last in "ab"]
    names = [run.default_run_dir(each).name for each in args]
    assert names[0] != names[1]
    assert all(len(os.fsencode(name)) <= 200 and name.startswith("seed1-env_args=xxx") for name in names)


def test_an_empty_directory_name_is_refused(files):
    assert_refusal("pg", command("pg", "--run-dir", ""), "--run-dir must name a directory of its own")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--optimizer foo", "--optimizer"),
        ("--num-trials two", "--num-trials"),
        ("--num-trials 1.5", "--num-trials"),
        ("--gamma", "--gamma"),
        ("--nonsense 3", "--nonsense"),
    ],
)
def test_what_the_command_line_cannot_mean_is_refused_by_its_reader(words, said, files):
    before = contents(files)
    ended = command("pg", *words.split())
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err
    assert "Traceback" not in ended.err
    assert contents(files) == before


def test_importing_the_worlds_does_not_import_torch():
    code = "import sys, envs; envs.Rollout(envs.make_world('pushbox'), 1); print('torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ALGOS.parent)
    assert ended.stdout == "False\n", ended.stderr


def test_where_no_cache_can_be_written_code_is_compiled_anew_and_this_is_said_once(tmp_path):
    code = """
import numba.core.caching as caching
caching.CacheImpl._locator_classes = [caching.UserProvidedCacheLocator]
import envs
env = envs.make_vec("pushbox")
env.reset()
print(env.step([[0, 0]])[1][0])
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ALGOS.parent)
    assert ended.stdout == "0.0\n", ended.stderr
    assert ended.stderr.count("Compiled code cannot be kept here") == 1
    assert_one_sentence(ended.stderr.strip())
