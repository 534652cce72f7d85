"""All scripts: their help, their shared text, what a run leaves, kill and resume, evaluation, bad input."""

import ast
import contextlib
import io
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image

import envs
from tests.helpers import ALGOS, SCRIPTS, assert_one_sentence, curves, each_script, optimizers, script

SOURCES = {f"{name}.py": (ALGOS / f"{name}.py").read_text() for name in SCRIPTS}


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def command(name, *words):
    """Run a script's `main` in this process, as the command line would."""
    out, err, code, argv = io.StringIO(), io.StringIO(), 0, sys.argv
    sys.argv = [f"algos/{name}.py", *map(str, words)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            script(name).main()
    except SystemExit as error:
        code = error.code or 0
    finally:
        sys.argv = argv
    return Ended(code, out.getvalue(), err.getvalue())


def results(directory):
    """The arrays of episodes.npz."""
    with np.load(directory / "episodes.npz") as file:
        return dict(file)


def assert_same_results(directory, other):
    found, expected = results(directory), results(other)
    assert found.keys() == expected.keys() == {"returns", "lengths", "outcomes"}
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert np.array_equal(found[name], values)


def contents(directory):
    """Everything that lies in a directory: {path: bytes}, None for a directory."""
    return {path.relative_to(directory): path.read_bytes() if path.is_file() else None for path in directory.rglob("*")}


# --- the copies ---


class Part(NamedTuple):
    """A piece of a script that other scripts repeat: where it stands, its text, and the docstring that may excuse a change."""

    place: str
    text: str
    docstring: str


def parts_of(name, source):
    """The parts of a script that have to be the same in all, {what it is: Part}."""
    lines, parts = source.splitlines(), {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name not in ("train", "Args"):
            first = min(part.lineno for part in [node, *node.decorator_list])
            text = "\n".join(lines[first - 1 : node.end_lineno])
            parts[node.name] = Part(f"{name}:{first}", text, ast.get_docstring(node) or "")
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets) == "WORLDS":
            parts["WORLDS"] = Part(f"{name}:{node.lineno}", ast.unparse(node), "")
        elif isinstance(node, ast.ClassDef) and node.name == "Args":
            for field, docstring in zip(node.body[::2], node.body[1::2], strict=True):
                text = f"{ast.unparse(field)}\n{ast.literal_eval(docstring.value)}"
                parts[f"Args.{field.target.id}"] = Part(f"{name}:{field.lineno}", text, "")
    marker = lines.index("# --- run keeping ---")
    parts["run keeping"] = Part(f"{name}:{marker + 1}", "\n".join(lines[marker:]), "")
    return parts


def differing_copies(sources):
    """A sentence for every two places that ought to be the same text.

    A function or class may differ if its docstring names the script from which it differs.
    """
    of_script = {name: parts_of(name, source) for name, source in sources.items()}
    sentences = []
    for one, other in combinations(of_script, 2):
        for what in of_script[one].keys() & of_script[other].keys():
            mine, theirs = of_script[one][what], of_script[other][what]
            excused = any(
                name in part.docstring and what in parts and parts[what].text != part.text
                for part in (mine, theirs)
                for name, parts in of_script.items()
            )
            if mine.text != theirs.text and not excused:
                sentences.append(f"{what} differs between {mine.place} and {theirs.place}")
    return sorted(sentences)


def test_copies_are_the_same_text():
    assert differing_copies(SOURCES) == []


def test_shared_limits_are_the_same():
    for one, other in combinations(map(script, SCRIPTS), 2):
        for name in one.LIMITS.keys() & other.LIMITS.keys():
            assert one.LIMITS[name] == other.LIMITS[name]


@pytest.mark.parametrize(
    ("old", "new", "what", "starts"),
    [
        ("rollout.obs[0], _ = env.reset()", "rollout.obs[0] = env.reset()[0]", "collect", "@torch.no_grad()\ndef collect"),
        ("@njit(cache=True)\ndef merge_steps", "@njit\ndef merge_steps", "merge_steps", "@njit\ndef merge_steps"),
        ("        x = torch.baddbmm", "        # a comment\n        x = torch.baddbmm", "StackedMLP", "class StackedMLP"),
        ("    seed: int = 1\n", "    seed: int = 2\n", "Args.seed", "    seed: int"),
        ("    seed: int = 1\n", "    seed: float = 1\n", "Args.seed", "    seed: float"),
        ('"""seed of the first trial;', '"""the first seed;', "Args.seed", "    seed: int"),
        ("WORLDS = {\n", "WORLDS = {\n    'nowhere': dict(gamma=1.0),\n", "WORLDS", "WORLDS ="),
        ("# Arguments, directories, curves,", "# Arguments, curves,", "run keeping", "# --- run keeping ---"),
        ("METHOD = Path(__file__).stem", "METHOD = 'pg'", "run keeping", "# --- run keeping ---"),
    ],
)
def test_a_changed_copy_is_found_with_both_places(old, new, what, starts):
    original = SOURCES["pg.py"]
    assert original.count(old) == 1
    changed = original.replace(old, new)
    assert differing_copies({"pg.py": original, "other.py": original}) == []
    place = changed[: changed.index(starts)].count("\n") + 1  # the same in both, as no change is above it
    expected = f"{what} differs between pg.py:{place} and other.py:{place}"
    assert differing_copies({"pg.py": original, "other.py": changed}) == [expected]


def test_a_change_that_names_the_other_script_is_excused():
    original = SOURCES["pg.py"]
    changed = original.replace("    rollout.obs[0], _ = env.reset()", "    rollout.obs[0] = env.reset()[0]")
    told = changed.replace(
        '"""Play one episode in every world,', '"""Differs from pg.py by one line. Play one episode in every world,'
    )
    assert told != changed
    assert differing_copies({"pg.py": original, "other.py": told, "third.py": original}) == []
    of_itself = changed.replace('"""Play one episode in', '"""Differs from other.py: play one episode in')
    assert len(differing_copies({"pg.py": original, "other.py": of_itself})) == 1


def test_train_may_differ_and_so_may_what_only_one_script_has():
    original = SOURCES["pg.py"]
    changed = original.replace("    # Climb along", "    # Step along").replace(
        "def play(", "def extra():\n    pass\n\n\ndef play("
    )
    assert [found.split()[0] for found in differing_copies({"pg.py": original, "other.py": changed})] == ["run"]


# --- help and arguments ---


def squeezed(text):
    return re.sub(r"[\s│]", "", text)


@each_script
def test_help_explains_every_argument(name):
    ended = command(name, "--help")
    assert (ended.code, ended.err) == (0, "")
    for field in fields(script(name).Args):
        text = parts_of(name, SOURCES[f"{name}.py"])[f"Args.{field.name}"].text
        assert f"--{field.name.replace('_', '-')}" in ended.out
        assert squeezed(text.split("\n")[1]) in squeezed(ended.out)
    assert "%%" not in ended.out


@each_script
def test_the_default_directory_says_what_is_not_default(name):
    module = script(name)

    def directory(**args):
        return str(module.default_run_dir(module.Args(env="findtreasure", **args)))

    assert directory() == f"runs/findtreasure/{name}/seed1"
    assert directory(seed=3, num_trials=4) == f"runs/findtreasure/{name}/seed3-6"
    assert (
        directory(learning_rate=0.5, hidden=(8, 4), env_args=("size=9",), max_steps=7)
        == f"runs/findtreasure/{name}/seed1-env_args=size=9-max_steps=7-hidden=8,4-learning_rate=0.5"
    )
    assert directory(save_model=True, overwrite=True, checkpoint_every=1.0) == directory()


@each_script
def test_every_world_and_optimiser_has_its_defaults(name):
    module = script(name)
    for world in envs.WORLDS:
        for choice in optimizers(name):
            resolved, env = module.resolve(module.Args(env=world, num_trials=2, **choice))
            assert env.world.name == world
            assert env.num_envs == 2
            assert all(getattr(resolved, argument) is not None for argument in module.LIMITS)
            assert resolved.hidden == module.WORLDS[world]["hidden"]
            assert resolved.learning_rate == module.TUNED[world, choice.get("optimizer", "adam")]["learning_rate"]


@each_script
def test_a_script_runs_from_anywhere(name, tmp_path):
    words = [sys.executable, ALGOS / f"{name}.py", "--env", "pushbox", "--num-episodes", "3", "--max-steps", "5"]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout.count("\n")) == (0, 1)
    assert results(tmp_path / "runs/pushbox" / name / "seed1-num_episodes=3-max_steps=5")["returns"].shape == (1, 3)


@each_script
def test_compiled_functions_are_found_whatever_name_a_script_was_imported_by(name, tmp_path):
    call = "print(m.sample_actions(np.log(np.array([[[1.0, 2.0, 1.0]]])), np.array([[0.7]])))"
    for module, folder in ((name, ALGOS), (f"algos.{name}", ALGOS.parent)):
        code = f"import numpy as np, {module} as m; {call}"
        environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(tmp_path)}
        ended = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert (ended.returncode, ended.stdout) == (0, "[[1]]\n"), ended.stderr


# --- a finished run ---

SHORT = [
    "--env",
    "findtreasure",
    "--env-args",
    "size=9",
    "--max-steps",
    "40",
    "--hidden",
    "16",
    "--num-trials",
    "2",
    "--seed",
    "5",
]


class Finished(NamedTuple):
    """A finished run: which script, where its files are, how the command ended."""

    name: str
    directory: Path
    ended: Ended


@pytest.fixture(scope="module", params=SCRIPTS)
def finished(request, tmp_path_factory):
    directory = tmp_path_factory.mktemp(request.param) / "run"
    words = [*SHORT, "--num-episodes", "250", "--save-model", "--capture-video", "--run-dir", directory]
    return Finished(request.param, directory, command(request.param, *words))


def test_a_run_leaves_its_files_and_says_how_it_ended(finished):
    directory, ended = finished.directory, finished.ended
    assert ended.code == 0
    assert sorted(path.name for path in directory.iterdir()) == [
        *("args.json", "episodes.npz", "policy.pt", "seed5", "seed6", "team.gif")
    ]
    usual = [np.bincount(trial).argmax() for trial in results(directory)["outcomes"][:, -12:]]
    ends = [f"{usual.count(k)} {what}" for k, what in enumerate(("time limit", "treasure", "meeting")) if k in usual]
    (line,) = ended.out.splitlines()
    assert line.startswith(f"{directory}: 2 trials, usual end: {', '.join(ends)}; reward per step ")
    assert f"{finished.name} findtreasure: 100%" in ended.err
    assert "250/250" in ended.err
    assert re.search(r"reward/step=-?\d+\.\d\d, steps/s=\d+, trials at best=\d+%", ended.err)


def test_args_json_holds_all_resolved_arguments_and_versions(finished):
    about = json.loads((finished.directory / "args.json").read_text())
    module = script(finished.name)
    assert about["method"] == finished.name
    assert about["args"].keys() == {field.name for field in fields(module.Args)}
    given = dict(env="findtreasure", env_args=["size=9"], seed=5, num_trials=2, num_episodes=250, max_steps=40, hidden=[16])
    default = optimizers(finished.name)[0]
    tuned = module.TUNED["findtreasure", default.get("optimizer", "adam")]
    assert about["args"].items() >= dict(given, gamma=0.98, run_dir=str(finished.directory), **default, **tuned).items()
    assert [name for name, value in about["args"].items() if value is None] == ["evaluate"]
    assert about["torch"] == version("torch")
    assert {"python", "numpy", "numba", "gymnasium", "commit"} <= about.keys()


@each_script
def test_a_time_limit_among_the_options_of_the_world_counts(name, tmp_path):
    words = ["--env-args", "max_steps=7", "--max-steps", "9", "--num-episodes", "2", "--run-dir", tmp_path]
    assert command(name, *words).code == 0
    assert json.loads((tmp_path / "args.json").read_text())["args"]["max_steps"] == 7
    assert results(tmp_path)["lengths"].max() <= 7


def test_the_episodes_agree_with_each_other(finished):
    episodes = results(finished.directory)
    returns, lengths, outcomes = episodes["returns"], episodes["lengths"], episodes["outcomes"]
    assert {name: (values.shape, values.dtype) for name, values in episodes.items()} == {
        "returns": ((2, 250), np.float64),
        "lengths": ((2, 250), np.int32),
        "outcomes": ((2, 250), np.int8),
    }
    assert lengths.min() >= 6  # the way to the meeting cells of the larger map
    assert lengths.max() == 40
    assert np.all(lengths[outcomes == 0] == 40)
    bumps = (returns - np.array([0.0, 100.0, 3.0])[outcomes]) / -0.1
    assert bumps == pytest.approx(bumps.round(), abs=1e-6)
    assert np.all((bumps > -0.5) & (bumps < 2 * lengths + 0.5))
    assert np.unique(outcomes).size >= 2
    assert not np.array_equal(returns[0], returns[1])


def test_tensorboard_shows_the_means_between_its_points(finished):
    episodes = results(finished.directory)
    bonus, critic = ["bonus", "unvisited", "overvisited"], ["value", "td_error"]
    own = {"pg": [], "spg": [], "epg": bonus, "espg": bonus, "decespg": bonus, "ac": critic, "coma": critic}
    own |= {
        "edti": [*critic, "novelty", "influence", "table_fill"],
        "espg_icm": ["bonus", "inverse_loss", "inverse_accuracy"],
        "espg_emi": ["bonus", "unexplained", "information"],
        "acer": ["value", "trust_region"],
        "dqn": ["epsilon", "value"],
        "gasil": [*bonus, "d_good", "d_own"],
        "decespg_ex2": ["bonus", "cross_entropy", "overvisited"],
    }
    usual = ["episodic_return", "episodic_length", "reward_per_step", "SPS"]
    for k in range(2):
        shown = curves(finished.directory / f"seed{5 + k}")
        assert shown.keys() == {f"charts/{tag}" for tag in usual + own[finished.name]}
        assert all([step for step, _ in points] == [100, 200] for points in shown.values())
        returns, lengths = (episodes[which][k, :200].reshape(2, 100) for which in ("returns", "lengths"))
        expected = {
            "episodic_return": returns.mean(1),
            "episodic_length": lengths.mean(1),
            "reward_per_step": (returns / (lengths - 1)).mean(1),
        }
        for tag, values in expected.items():
            assert [value for _, value in shown[f"charts/{tag}"]] == pytest.approx(values, rel=1e-5)
        assert min(value for _, value in shown["charts/SPS"]) > 0
        if "charts/unvisited" in shown:
            assert all(0 < value < np.log(1000) for _, value in shown["charts/bonus"])
            assert all(0 < value < 1 for _, value in shown["charts/unvisited"])


def test_the_captured_video_is_an_episode(finished):
    with Image.open(finished.directory / "team.gif") as gif:
        assert 7 <= gif.n_frames <= 41  # the start and every step
        assert gif.is_animated
        assert gif.width == 9 * 48


def test_a_finished_run_is_overwritten_only_on_request(finished, tmp_path):
    directory = tmp_path / "run"
    shutil.copytree(finished.directory, directory)
    before = contents(directory)
    words = [*SHORT, "--num-episodes", "30", "--log-every", "10", "--run-dir", directory]
    ended = command(finished.name, *words)
    assert (ended.code, ended.out) == (2, "")
    assert "holds a finished run" in ended.err
    assert "--overwrite" in ended.err
    assert_refusal(finished.name, ended)
    assert contents(directory) == before
    ended = command(finished.name, *words, "--resume")
    assert (ended.code, contents(directory)) == (2, before)
    assert command(finished.name, *words, "--overwrite").code == 0
    assert results(directory)["returns"].shape == (2, 30)
    assert sorted(path.name for path in directory.iterdir()) == ["args.json", "episodes.npz", "seed5", "seed6"]
    assert [step for step, _ in curves(directory / "seed5")["charts/episodic_return"]] == [10, 20, 30]


# --- playing a saved team ---


@pytest.fixture
def policy_file(finished, tmp_path):
    return shutil.copy(finished.directory / "policy.pt", tmp_path / "policy.pt")


def greedy_episodes(saved):
    """Reward per step of both teams' episode when they take the likeliest actions, without the scripts' help."""
    env, scores = envs.make_vec("findtreasure", size=9, max_steps=40), []
    for k in range(2):
        obs, _ = env.reset()
        total, steps, over = 0.0, 0, False
        while not over:
            actions = []
            for i in range(2):
                hidden, bias, out, out_bias = (param[2 * k + i] for param in saved["params"])
                logits = torch.relu(torch.from_numpy(obs[0, i]) @ hidden + bias) @ out + out_bias
                actions.append(int(logits.argmax()))
            obs, reward, terminated, truncated, _ = env.step(np.array([actions]))
            total, steps, over = total + reward[0], steps + 1, terminated[0] or truncated[0]
        scores.append(total / (steps - 1))
    return scores


def test_a_saved_team_plays_greedily(finished, policy_file):
    lines = set()
    for seed in (1, 2):
        ended = command(finished.name, "--evaluate", policy_file, "--greedy", "--num-episodes", 3, "--seed", seed)
        assert (ended.code, ended.err) == (0, "")
        lines.add(ended.out)
    (line,) = lines
    scores = greedy_episodes(torch.load(policy_file, weights_only=True))
    assert line.startswith(f"{policy_file}: 3 episodes of 2 teams, usual end: ")
    score = f"reward per step {np.mean(scores):.2f} (worst trial {min(scores):.2f}, best {max(scores):.2f})"
    assert f"; {score}; one of them in {Path(policy_file).with_suffix('.gif')}\n" in line
    with Image.open(Path(policy_file).with_suffix(".gif")) as gif:
        assert gif.is_animated


def test_a_saved_team_plays_by_drawing(finished, policy_file):
    def play(seed):
        ended = command(finished.name, "--evaluate", policy_file, "--num-episodes", 20, "--seed", seed)
        return ended, Path(policy_file).with_suffix(".gif").read_bytes()

    first, second, again = map(play, (1, 2, 1))
    assert first[0].code == 0
    assert first == again
    assert first[1] != second[1]  # the lines may be the same, as they are rounded
    assert sorted(path.name for path in Path(policy_file).parent.iterdir()) == ["policy.gif", "policy.pt"]


# --- interrupted runs ---

INTERRUPTED = [*SHORT, "--num-episodes", "60", "--log-every", "10"]


def stop_after(module, monkeypatch, episode, number):
    """Let this process get the signal while the script plays the given episode (1, 2, ...)."""
    collect, played = module.collect, []

    def interrupted_collect(*args):
        collect(*args)
        played.append(None)
        if len(played) == episode:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(module, "collect", interrupted_collect)


@pytest.fixture(scope="module", params=SCRIPTS)
def interrupted(request, tmp_path_factory):
    """A run that Ctrl-C ended after 40 of its 60 episodes, and one that went through."""
    name, directory = request.param, tmp_path_factory.mktemp(request.param)
    whole = Finished(name, directory / "whole", command(name, *INTERRUPTED, "--run-dir", directory / "whole"))
    with pytest.MonkeyPatch.context() as monkeypatch:
        stop_after(script(name), monkeypatch, 40, signal.SIGINT)
        ended = command(name, *INTERRUPTED, "--run-dir", directory / "stopped")
    return Finished(name, directory / "stopped", ended), whole


def resume(name, directory):
    """Go on with a run; not within the second in which it began (no process starts so fast), by which TensorBoard sorts."""
    time.sleep(1)
    return command(name, *INTERRUPTED, "--run-dir", directory, "--resume")


def assert_same_curves(directory, other):
    """Both runs show the same points, each once."""
    for trial in ("seed5", "seed6"):
        found, expected = curves(directory / trial), curves(other / trial)
        assert found.keys() == expected.keys()
        for tag in expected.keys() - {"charts/SPS"}:
            assert found[tag] == expected[tag]
        assert [step for step, _ in found["charts/SPS"]] == [step for step, _ in expected["charts/SPS"]]


def test_ctrl_c_leaves_a_checkpoint_from_which_the_run_goes_on(interrupted, tmp_path):
    stopped, whole = interrupted
    assert stopped.ended.code == 130
    assert "Stopped after 40 episodes; go on with --resume." in stopped.ended.err
    assert sorted(path.name for path in stopped.directory.iterdir()) == ["args.json", "checkpoint.pt", "seed5", "seed6"]
    directory = tmp_path / "run"
    shutil.copytree(stopped.directory, directory)
    assert resume(stopped.name, directory).code == 0
    assert_same_results(directory, whole.directory)
    assert_same_curves(directory, whole.directory)
    assert not (directory / "checkpoint.pt").exists()


@each_script
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_run_may_be_stopped_twice(name, number, code, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        stop_after(script(name), patched, 13, number)
        assert command(name, *INTERRUPTED, "--run-dir", tmp_path / "run").code == code
    with monkeypatch.context() as patched:
        stop_after(script(name), patched, 20, number)
        assert resume(name, tmp_path / "run").code == code
    assert resume(name, tmp_path / "run").code == 0
    assert command(name, *INTERRUPTED, "--run-dir", tmp_path / "whole").code == 0
    assert_same_results(tmp_path / "run", tmp_path / "whole")
    assert_same_curves(tmp_path / "run", tmp_path / "whole")


def test_an_unfinished_run_is_not_overwritten(interrupted):
    stopped, _ = interrupted
    before = contents(stopped.directory)
    ended = command(stopped.name, *INTERRUPTED, "--run-dir", stopped.directory)
    assert_refusal(stopped.name, ended, "holds an unfinished run")
    assert "--resume" in ended.err
    assert "--overwrite" in ended.err
    assert contents(stopped.directory) == before


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        (["--seed", "6"], "seed"),
        (["--gamma", "0.9"], "gamma"),
        (["--hidden", "8"], "hidden"),
        (["--env", "pushbox", "--env-args", "size=4"], "env"),
        (["--num-episodes", "70"], "num_episodes"),
        (["--learning-rate", "0.5"], "learning_rate"),
        (["--log-every", "20"], "log_every"),
    ],
)
def test_resume_refuses_changed_arguments_by_name(interrupted, changed, what):
    stopped, _ = interrupted
    before = contents(stopped.directory)
    ended = command(stopped.name, *INTERRUPTED, "--run-dir", stopped.directory, "--resume", *changed)
    assert_refusal(stopped.name, ended, f"but {what} was ")
    assert contents(stopped.directory) == before


def test_a_checkpoint_of_another_script_is_refused(interrupted):
    stopped, _ = interrupted
    other = next(name for name in SCRIPTS if name != stopped.name)
    ended = command(other, *INTERRUPTED, "--run-dir", stopped.directory, "--resume")
    assert_refusal(other, ended, f"method was {stopped.name} and is now {other}")


def test_a_broken_checkpoint_is_refused_and_kept(interrupted, tmp_path):
    stopped, _ = interrupted
    shutil.copytree(stopped.directory, tmp_path / "run")
    broken = tmp_path / "run" / "checkpoint.pt"
    broken.write_bytes(broken.read_bytes()[:1000])
    ended = command(stopped.name, *INTERRUPTED, "--run-dir", tmp_path / "run", "--resume")
    assert_refusal(stopped.name, ended, "checkpoint.pt cannot be read")
    assert len(broken.read_bytes()) == 1000


@each_script
def test_a_policy_without_its_run_is_not_cleared_away(name, tmp_path):
    (tmp_path / "policy.pt").write_bytes(b"somebody's")
    ended = command(name, *INTERRUPTED, "--run-dir", tmp_path)
    assert_refusal(name, ended, "holds an unfinished run or a part of one", "--overwrite")
    assert contents(tmp_path) == {Path("policy.pt"): b"somebody's"}


@pytest.mark.parametrize(("name", "optimizer"), [("pg", "sign"), ("decespg", "sign"), ("decespg", "adam")])
def test_a_killed_run_goes_on_as_if_nothing_had_happened(name, optimizer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--env", "pushbox", "--max-steps", "50", "--num-trials", "2", "--seed", "5", "--optimizer", optimizer]
    words += ["--num-episodes", "600", "--log-every", "1", "--checkpoint-every", "0", "--run-dir", "run"]
    process = subprocess.Popen([sys.executable, ALGOS / f"{name}.py", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    while not Path("run/checkpoint.pt").exists():
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(0.3 * random.random())  # a moment that nobody has chosen
    process.kill()
    out, _ = process.communicate()
    assert (process.returncode, out) == (-signal.SIGKILL, b"")
    assert not Path("run/episodes.npz").exists()
    done = torch.load("run/checkpoint.pt", weights_only=True)["episode"]
    assert 0 < done < 600
    assert command(name, *words, "--resume").code == 0
    assert command(name, *words[:-1], "whole").code == 0
    assert_same_results(Path("run"), Path("whole"))
    assert_same_curves(Path("run"), Path("whole"))
    left = {path.name for path in Path("run").iterdir() if not path.name.startswith(".")}
    assert left == {"args.json", "episodes.npz", "seed5", "seed6"}


# --- bad input ---


def assert_refusal(name, ended, *said):
    """The command ended with code 2 and one sentence."""
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.startswith(f"{name}.py: ")
    assert_one_sentence(ended.err.removesuffix("\n"))
    for words in said:
        assert words in ended.err


BAD_INPUT = {
    "--env pacman": "there is no world 'pacman'; the worlds are ",
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
    "--resume": "there is nothing to resume",
    "--run-dir file": "cannot write to file",
    "--run-dir file/below": "cannot write to file/below",
    "--evaluate file": "file is not a policy.pt",
    "--evaluate missing.pt": "missing.pt",
    "--evaluate other.pt": "other.pt is not a policy.pt",
    "--evaluate folder": "folder is not a policy.pt",
}
BAD_BONUS = {
    "--beta -1": "--beta must be a number of at least 0, not -1",
    "--window 0": "--window must be a number of at least 1, not 0",
    "--sigma 0": "--sigma must be a number of at least 0.001, not 0",
    "--noise 0": "--noise must be a number of at least 1e-06, not 0",
}
BAD_CRITIC = {"--critic-learning-rate -1": "--critic-learning-rate must be a number of at least 0, not -1"}
BAD_MEMORY = {"--slots -1": "--slots must be a number of at least 0, not -1"}
BAD_INPUT_OF = {
    "spg": BAD_MEMORY,
    "epg": BAD_BONUS,
    "espg": BAD_BONUS | BAD_MEMORY,
    "decespg": BAD_BONUS | BAD_MEMORY,
    "espg_icm": {
        **BAD_MEMORY,
        "--beta -1": "--beta must be a number of at least 0, not -1",
        "--icm-learning-rate -1": "--icm-learning-rate must be a number of at least 0, not -1",
        "--forward-weight 1.1": "--forward-weight must be a number between 0 and 1, not 1.1",
        "--features 0": "--features must be a number of at least 1, not 0",
        "--icm-hidden 64 0": "--icm-hidden must be a number of at least 1, not 0",
    },
    "ac": BAD_CRITIC,
    "coma": {
        **BAD_CRITIC,
        "--critic-learning-rate nan": "--critic-learning-rate must be a number of at least 0, not nan",
        "--td-lambda 1.1": "--td-lambda must be a number between 0 and 1, not 1.1",
        "--td-lambda nan": "--td-lambda must be a number between 0 and 1, not nan",
        "--target-critic-every 0": "--target-critic-every must be a number of at least 1, not 0",
    },
    "acer": {
        **BAD_CRITIC,
        "--truncation 0.5": "--truncation must be a number of at least 1, not 0.5",
        "--trust-region -1": "--trust-region must be a number of at least 0, not -1",
        "--average-decay 1.1": "--average-decay must be a number between 0 and 1, not 1.1",
        "--entropy -1": "--entropy must be a number of at least 0, not -1",
        "--buffer-size 0": "--buffer-size must be a number of at least 1, not 0",
    },
    "dqn": {
        "--exploration 0": "--exploration must be a number between 0.001 and 1, not 0",
        "--exploration 2": "--exploration must be a number between 0.001 and 1, not 2",
        "--buffer-size 0": "--buffer-size must be a number of at least 1, not 0",
        "--batch-size 0": "--batch-size must be a number of at least 1, not 0",
        "--train-every 0": "--train-every must be a number of at least 1, not 0",
        "--target-every 0": "--target-every must be a number of at least 1, not 0",
    },
    "decespg_ex2": {
        **BAD_MEMORY,
        "--beta -1": "--beta must be a number of at least 0, not -1",
        "--exemplar-learning-rate -1": "--exemplar-learning-rate must be a number of at least 0, not -1",
        "--kl-weight -1": "--kl-weight must be a number of at least 0, not -1",
        "--exemplars 0": "--exemplars must be a number of at least 1, not 0",
        "--buffer-size 0": "--buffer-size must be a number of at least 1, not 0",
        "--min-replay 0": "--min-replay must be a number of at least 1, not 0",
    },
    "espg_emi": {
        **BAD_MEMORY,
        "--beta -1": "--beta must be a number of at least 0, not -1",
        "--embedding-learning-rate -1": "--embedding-learning-rate must be a number of at least 0, not -1",
        "--embedding-batch 1": "--embedding-batch must be a number of at least 2, not 1",
        "--recent-steps 0": "--recent-steps must be a number of at least 1, not 0",
        "--error-weight -1": "--error-weight must be a number of at least 0, not -1",
        "--information-weight nan": "--information-weight must be a number of at least 0, not nan",
        "--gaussian-weight -1": "--gaussian-weight must be a number of at least 0, not -1",
    },
    "edti": {
        **BAD_CRITIC,
        "--eta -1": "--eta must be a number of at least 0, not -1",
        "--beta-ext -1": "--beta-ext must be a number of at least 0, not -1",
        "--beta-int -1": "--beta-int must be a number of at least 0, not -1",
        "--table-size 7": "--table-size must be a number of at least 8, not 7",
    },
    "gasil": {
        **BAD_BONUS,
        "--lambda-im -1": "--lambda-im must be a number of at least 0, not -1",
        "--rise 0": "--rise must be a number between 0.001 and 1, not 0",
        "--rise 2": "--rise must be a number between 0.001 and 1, not 2",
        "--good-episodes 0": "--good-episodes must be a number of at least 1, not 0",
        "--good-label 1.1": "--good-label must be a number between 0 and 1, not 1.1",
        "--good-batch 0": "--good-batch must be a number of at least 1, not 0",
        "--discriminator-hidden 32 0": "--discriminator-hidden must be a number of at least 1, not 0",
        "--discriminator-learning-rate -1": "--discriminator-learning-rate must be a number of at least 0, not -1",
    },
}


@pytest.fixture
def files(tmp_path, monkeypatch):
    """The working directory: a folder, a text file and a file that torch can read but that no script wrote."""
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    Path("file").write_text("mine")
    torch.save({"weights": torch.zeros(3)}, "other.pt")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "words", "said"),
    [(name, *case) for name in SCRIPTS for case in {**BAD_INPUT, **BAD_INPUT_OF.get(name, {})}.items()],
)
def test_bad_input_is_refused_in_one_sentence(name, words, said, files):
    before = contents(files)
    ended = command(name, *words.split())
    assert_refusal(name, ended, said)
    assert contents(files) == before


@each_script
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
def test_what_the_command_line_cannot_mean_is_refused_by_its_reader(name, words, said, files):
    before = contents(files)
    ended = command(name, *words.split())
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err
    assert "Traceback" not in ended.err
    assert contents(files) == before


@pytest.mark.parametrize("words", ["--num-episodes 0", "--num-episodes -1", "--seed -1"])
def test_a_saved_team_is_not_played_with_impossible_numbers(finished, policy_file, words):
    before = contents(Path(policy_file).parent)
    ended = command(finished.name, "--evaluate", policy_file, *words.split())
    assert_refusal(finished.name, ended, words.split()[0])
    assert contents(Path(policy_file).parent) == before
