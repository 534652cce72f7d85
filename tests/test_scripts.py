"""What holds for every script: its imports, its size, the text it shares, its help, a run that resumes, its own bad input."""

import ast
import json
import random
import re
import signal
import subprocess
import sys
from dataclasses import fields
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pytest

import envs
from benchmark import cells
from envs import run
from tests.helpers import (
    ALGOS,
    RACE,
    SCRIPTS,
    assert_refusal,
    assert_same_results,
    command,
    contents,
    curves,
    each_script,
    optimizers,
    results,
    script,
    stop_after,
)

SOURCES = {f"{name}.py": (ALGOS / f"{name}.py").read_text(encoding="utf-8") for name in SCRIPTS}


# --- imports and sizes ---


@each_script
def test_a_script_imports_libraries_and_envs_only(name):
    imported = set()
    for node in ast.walk(ast.parse(SOURCES[f"{name}.py"])):
        if isinstance(node, ast.Import):
            imported |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module.partition(".")[0])
    assert imported <= sys.stdlib_module_names | {"numpy", "torch", "numba", "envs"}


def test_scripts_are_short():
    lines = {name: source.count("\n") for name, source in SOURCES.items()}
    assert lines["pg.py"] <= 180
    assert lines["decespg.py"] <= 380
    assert max(lines.values()) <= 480
    assert sum(lines[f"{name}.py"] for name in PAPER) <= 5000


PAPER = (
    "pg",
    "epg",
    "spg",
    "espg",
    "decespg",
    "ac",
    "coma",
    "acer",
    "dqn",
    "edti",
    "decespg_ex2",
    "espg_icm",
    "espg_emi",
    "gasil",
)

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
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name not in ("train", "build", "Args"):
            first = min(part.lineno for part in [node, *node.decorator_list])
            text = "\n".join(lines[first - 1 : node.end_lineno])
            parts[node.name] = Part(f"{name}:{first}", text, ast.get_docstring(node) or "")
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets) == "WORLDS":
            parts["WORLDS"] = Part(f"{name}:{node.lineno}", ast.unparse(node), "")
        elif isinstance(node, ast.ClassDef) and node.name == "Args":
            for field, docstring in zip(node.body[::2], node.body[1::2], strict=True):
                text = f"{ast.unparse(field)}\n{ast.literal_eval(docstring.value)}"
                parts[f"Args.{field.target.id}"] = Part(f"{name}:{field.lineno}", text, "")
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


@pytest.mark.parametrize(
    ("old", "new", "what", "starts"),
    [
        ("optimizer.state.clear()", "optimizer.state = {}", "update", "def update"),
        ("@njit(cache=True)\ndef disc", "@njit\ndef disc", "discounted_returns", "@njit\ndef disc"),
        ("        x = torch.as_tensor", "        # a comment\n        x = torch.as_tensor", "StackedMLP", "class StackedMLP"),
        ("Between(0, 1)] = None", "Between(0, 2)] = None", "Args.gamma", "    gamma: Ann"),
        ('"""discount factor', '"""factor', "Args.gamma", "    gamma: Ann"),
        ("WORLDS = {\n", "WORLDS = {\n    'nowhere': dict(gamma=1.0),\n", "WORLDS", "WORLDS ="),
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
    changed = original.replace("tail = reward[t, k, i] + gamma * tail", "tail = gamma * tail")
    told = changed.replace('"""G_t = r_t + gamma G_{t+1} of', '"""Differs from pg.py by one line. G_t = r_t + gamma G_{t+1} of')
    assert told != changed
    assert differing_copies({"pg.py": original, "other.py": told, "third.py": original}) == []
    of_itself = changed.replace('"""G_t = r_t + gamma', '"""Differs from other.py: G_t = r_t + gamma')
    assert len(differing_copies({"pg.py": original, "other.py": of_itself})) == 1


def test_train_and_build_may_differ_and_so_may_what_only_one_script_has():
    original = SOURCES["pg.py"]
    changed = original.replace("    # Climb along", "    # Step along").replace(
        "def update(", "def extra():\n    pass\n\n\ndef update("
    )
    changed = changed.replace("    return SimpleNamespace(policy=", "    return SimpleNamespace(team=")
    assert differing_copies({"pg.py": original, "other.py": changed}) == []


# --- help, defaults, places ---


def squeezed(text):
    return re.sub(r"[\s│]", "", text)


@each_script
def test_help_explains_every_argument(name):
    ended = command(name, "--help")
    assert (ended.code, ended.err) == (0, "")
    run_source = (ALGOS.parent / "envs" / "run.py").read_text(encoding="utf-8")
    own = parts_of(name, SOURCES[f"{name}.py"])
    for field in fields(script(name).Args):
        part = own.get(f"Args.{field.name}")
        text = part.text.split("\n")[1] if part else re.search(rf'    {field.name}: .*\n    """(.*)"""', run_source)[1]
        assert f"--{field.name.replace('_', '-')}" in ended.out
        assert squeezed(text) in squeezed(ended.out)


@each_script
def test_every_world_and_optimiser_has_its_defaults(name):
    module = script(name)
    for world in envs.WORLDS:
        for choice in optimizers(name):
            args, made = run.resolve(module.Args(env=world, **choice), module.WORLDS, module.TUNED, module.OTHER)
            assert made.name == world
            assert None not in [value for field, value in vars(args).items() if field != "evaluate"]
            assert args.hidden == module.WORLDS[world]["hidden"]
            pair = world, choice.get("optimizer", "adam")
            tuned = module.TUNED[pair] if world in cells.WORLDS else module.TUNED.get(pair, module.OTHER)
            assert args.learning_rate == tuned["learning_rate"]


RUN_ALL = """
import runpy, sys
path = sys.path[:]
for script in sys.argv[1:]:
    for name in [name for name in sys.modules if name.partition(".")[0] == "envs"]:
        del sys.modules[name]  # so that every script has to find it
    sys.path[:], sys.argv = path, [script, "--env", "pushbox", "--num-episodes", "3", "--max-steps", "5"]
    runpy.run_path(script, run_name="__main__")
"""


def test_scripts_run_from_anywhere(tmp_path):
    """As `python algos/<name>.py` does, but one after the other in one process, which has to load the libraries only once."""
    words = [sys.executable, "-c", RUN_ALL, *(str(ALGOS / f"{name}.py") for name in SCRIPTS)]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    directories = [f"runs/pushbox/{name}/seed1-num_episodes=3-max_steps=5" for name in SCRIPTS]
    assert [line.partition(": 1 trial, ")[0] for line in ended.stdout.splitlines()] == directories
    for directory in directories:
        assert results(tmp_path / directory)["returns"].shape == (1, 3)


@each_script
def test_a_world_of_ones_own_gets_the_values_that_the_help_names(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = command(name, "--env", RACE, "--env-args", "size=3", "--num-episodes", 4, "--save-model", "--capture-video")
    assert ended.code == 0, ended.err
    directory = tmp_path / "runs" / "race" / name / "seed1-env_args=size=3-num_episodes=4"
    args = json.loads((directory / "args.json").read_text(encoding="utf-8"))["args"]
    assert (args["max_steps"], results(directory)["lengths"].shape) == (20, (1, 4))
    text_of = {what: part.text for what, part in parts_of(name, SOURCES[f"{name}.py"]).items()}
    for field, value in script(name).OTHER.items():
        assert args[field] == (list(value) if isinstance(value, tuple) else value)
        (number,) = value if isinstance(value, tuple) else (value,)
        assert re.search(rf"; {number:g} in other|, else {number:g}\)", text_of[f"Args.{field}"])
    assert command(name, "--evaluate", directory / "policy.pt", "--num-episodes", 2).code == 0


@each_script
def test_a_world_that_a_help_text_names_gets_what_it_says(name):
    for what, part in parts_of(name, SOURCES[f"{name}.py"]).items():
        for number, world in re.findall(r"None: ([\d.]+) in (\w+), else", part.text):
            rows = [row for (env, _), row in script(name).TUNED.items() if env == world]
            assert rows
            assert all(row[what.removeprefix("Args.")] == float(number) for row in rows)


# --- a run: its curves, its end by an exception, its team ---

WORDS = ["--env", "findtreasure", "--max-steps", 40, "--hidden", 16, "--num-trials", 2, "--seed", 5, "--num-episodes", 40]
BONUS, CRITIC, LOSS = ["bonus", "unvisited", "overvisited"], ["value", "td_error"], ["losses/policy_loss", "losses/entropy"]
PPO = ["value", "advantage", "kl", "clip_fraction"]
FIGURES = {
    **{"pg": [], "spg": [], "epg": BONUS, "espg": BONUS, "decespg": BONUS, "ac": CRITIC, "coma": CRITIC},
    "edti": [*CRITIC, "novelty", "influence", "table_fill"],
    "espg_icm": ["bonus", "inverse_loss", "inverse_accuracy"],
    "espg_emi": ["bonus", "unexplained", "information"],
    "acer": ["value", "trust_region"],
    "dqn": ["epsilon", "value"],
    "hysteretic": ["epsilon", "value"],
    "qmix": ["epsilon", "value"],
    "ippo": PPO,
    "mappo": PPO,
    "gasil": [*BONUS, "d_good", "d_own"],
    "decespg_ex2": ["bonus", "cross_entropy", "overvisited"],
}


@pytest.fixture(scope="module", params=SCRIPTS)
def interrupted(request, tmp_path_factory):
    """A run that went through, and one that was stopped when every model had begun to learn, and that went on."""
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    words = [*WORDS, "--log-every", 10, "--save-model"]
    assert command(name, *words, "--run-dir", folder / "whole").code == 0
    with pytest.MonkeyPatch.context() as monkeypatch:
        stop_after(monkeypatch, random.Random(name).randrange(31, 40), signal.SIGTERM)
        assert command(name, *words, "--run-dir", folder / "stopped").code == 143
    assert not (folder / "stopped" / "episodes.npz").exists()
    ended = command(name, *words, "--run-dir", folder / "stopped", "--resume")
    assert ended.code == 0, ended.err
    return name, folder


def test_a_resumed_run_ends_as_if_nothing_had_happened(interrupted):
    name, folder = interrupted
    assert_same_results(folder / "stopped", folder / "whole")
    teams = [run.load(folder / which / "policy.pt", script(name))[2] for which in ("stopped", "whole")]
    for part in vars(teams[0]):
        for one, other in zip(*(run.arrays_of(getattr(team, part)) for team in teams), strict=True):
            assert one.equal(other), part
    shown = [curves(folder / which / "seed5") for which in ("stopped", "whole")]
    for tag, points in shown[1].items():
        if tag != "charts/SPS":
            assert shown[0][tag][-1] == points[-1], tag


def test_the_curves_are_those_of_the_method(interrupted):
    name, folder = interrupted
    usual = ["episodic_return", "episodic_length", "reward_per_step", "SPS", "episode"]
    losses = LOSS[1:] if "epsilon" in FIGURES[name] else LOSS  # Q-learning has no policies, and no loss of theirs
    shown = curves(folder / "whole" / "seed5")
    assert shown.keys() == {f"charts/{tag}" for tag in usual + FIGURES.get(name, [])} | set(losses)
    assert all(np.isfinite(value) for points in shown.values() for _, value in points)
    lengths = results(folder / "whole")["lengths"][0]
    assert [step for step, _ in shown["charts/episode"]] == lengths.cumsum()[9::10].tolist()


def test_a_saved_team_plays(interrupted, monkeypatch):
    monkeypatch.setattr(envs, "draw", lambda *_, **__: np.zeros((1, 1, 3), np.uint8))  # pictures take long
    name, folder = interrupted
    ended = command(name, "--evaluate", folder / "whole" / "policy.pt", "--num-episodes", 3, "--overwrite")
    assert ended.code == 0, ended.err
    assert "3 episodes of 2 teams, usual end: " in ended.out
    words = ["--evaluate", folder / "whole" / "policy.pt", "--num-episodes", 2, "--greedy", "--overwrite", "--seed"]
    greedy = [command(name, *words, seed).out for seed in (1, 2)]
    assert greedy[0] == greedy[1]  # nothing is drawn


# --- bad input of the method's own ---


BAD_BONUS = {
    "--beta -1": "--beta must be a number of at least 0, not -1",
    "--window 0": "--window must be a number of at least 1, not 0",
    "--sigma 0": "--sigma must be a number of at least 0.001, not 0",
    "--noise 0": "--noise must be a number of at least 1e-06, not 0",
}
BAD_CRITIC = {"--critic-learning-rate -1": "--critic-learning-rate must be a number of at least 0, not -1"}
BAD_MEMORY = {"--slots -1": "--slots must be a number of at least 0, not -1"}
BAD_REPLAY = {
    "--exploration 0": "--exploration must be a number between 0.001 and 1, not 0",
    "--exploration 2": "--exploration must be a number between 0.001 and 1, not 2",
    "--replay-size 0": "--replay-size must be a number of at least 1, not 0",
    "--batch-size 0": "--batch-size must be a number of at least 1, not 0",
    "--train-every 0": "--train-every must be a number of at least 1, not 0",
    "--target-every 0": "--target-every must be a number of at least 1, not 0",
}
BAD_PPO = {
    "--entropy-coef -1": "--entropy-coef must be a number of at least 0, not -1",
    "--gae-lambda 1.1": "--gae-lambda must be a number between 0 and 1, not 1.1",
    "--clip -1": "--clip must be a number of at least 0, not -1",
    "--episodes-per-update 0": "--episodes-per-update must be a number of at least 1, not 0",
    "--num-epochs 0": "--num-epochs must be a number of at least 1, not 0",
}
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
    "dqn": BAD_REPLAY,
    "hysteretic": {
        **BAD_REPLAY,
        "--hysteresis -0.1": "--hysteresis must be a number between 0 and 1, not -0.1",
        "--hysteresis 1.1": "--hysteresis must be a number between 0 and 1, not 1.1",
    },
    "qmix": BAD_REPLAY,
    "ippo": BAD_PPO,
    "mappo": BAD_PPO,
    "decespg_ex2": {
        **BAD_MEMORY,
        "--beta -1": "--beta must be a number of at least 0, not -1",
        "--exemplar-learning-rate -1": "--exemplar-learning-rate must be a number of at least 0, not -1",
        "--kl-weight -1": "--kl-weight must be a number of at least 0, not -1",
        "--exemplars 0": "--exemplars must be a number of at least 1, not 0",
        "--buffer-size 0": "--buffer-size must be a number of at least 1, not 0",
        "--steps-per-fit 0": "--steps-per-fit must be a number of at least 1, not 0",
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
        "--gae-lambda 1.1": "--gae-lambda must be a number between 0 and 1, not 1.1",
        "--eta -1": "--eta must be a number of at least 0, not -1",
        "--beta-ext -1": "--beta-ext must be a number of at least 0, not -1",
        "--beta-int -1": "--beta-int must be a number of at least 0, not -1",
        "--table-size 7": "--table-size must be a number of at least 8, not 7",
    },
    "gasil": {
        **BAD_BONUS,
        "--lambda-im -1": "--lambda-im must be a number of at least 0, not -1",
        "--rise 0": "--rise must be a number of at least 1, not 0",
        "--good-episodes 0": "--good-episodes must be a number of at least 1, not 0",
        "--good-label 1.1": "--good-label must be a number between 0 and 1, not 1.1",
        "--good-batch 0": "--good-batch must be a number of at least 1, not 0",
        "--discriminator-hidden 32 0": "--discriminator-hidden must be a number of at least 1, not 0",
        "--discriminator-learning-rate -1": "--discriminator-learning-rate must be a number of at least 0, not -1",
    },
}


@pytest.mark.parametrize(
    ("name", "words", "said"), [(name, *case) for name in SCRIPTS for case in BAD_INPUT_OF.get(name, {}).items()]
)
def test_bad_input_is_refused_in_one_sentence(name, words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refusal(name, command(name, *words.split()), said)
    assert contents(tmp_path) == {}
