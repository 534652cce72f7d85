"""The commands of README and docs/ and the worked example do what they say."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import envs

ROOT = Path(envs.__file__).parents[1]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = [block for text in TEXTS for block in re.findall(r"```(bash|python)\n(.*?)```", text.read_text(), re.DOTALL)]
COMMANDS = [line for kind, block in BLOCKS if kind == "bash" for line in block.splitlines()]


def run(command, folder):
    words = [str(ROOT / word) if word.startswith("algos/") else word for word in shlex.split(command)]
    done = subprocess.run([sys.executable, *words[1:]], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("user")


def test_ci_runs_exactly_the_test_command():
    install_and_test = [command for command in COMMANDS if command.endswith("-m pytest -n 2")]
    assert len(install_and_test) == 1
    assert install_and_test[0] in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_first_command_installs_and_trains(folder):
    install, _, train = COMMANDS[0].rpartition(" && ")
    assert install == "python3 -m venv .venv && .venv/bin/pip install -r requirements.txt"
    assert "1 trial, usual end" in run(train + " --num-episodes 2", folder)


def test_the_example_commands_run(folder):
    train, evaluate, other, help_text, *reported = [command for command in COMMANDS if command.startswith("python algos/")]
    policy = evaluate.split()[-1]
    assert "20 trials" in run(f"{train} --num-episodes 2 --run-dir {policy.rpartition('/')[0]}", folder)
    assert "2 episodes of 20 teams" in run(f"{evaluate} --num-episodes 2", folder)
    assert "1 trial" in run(f"{other} --num-episodes 2", folder)
    assert "--learning-rate" in run(help_text, folder)
    for command in reported:
        assert "usual end" in run(re.sub("--num-episodes [0-9]+", "--num-episodes 2", command), folder)


def test_the_worked_example_replaces_the_bonus(folder):
    example = next(block for kind, block in BLOCKS if kind == "python" and "class VisitNovelty" in block)
    script = (ROOT / "algos" / "decespg.py").read_text()
    changed = re.sub(r"class VisitNovelty:.*?\n\n\n(?=class )", lambda _: example + "\n\n", script, flags=re.DOTALL)
    changed = changed.replace("import numpy as np\n", "from collections import defaultdict\n\nimport numpy as np\n", 1)
    assert changed.count("class VisitNovelty") == 1
    assert "visit_counts(pairs" not in changed.replace("def visit_counts(pairs", "")
    (folder / "algos").mkdir()
    (folder / "algos" / "counts.py").write_text(changed)
    (folder / "envs").symlink_to(ROOT / "envs")
    train = "import sys; sys.path.insert(0, 'algos'); import counts; run = counts.train(counts.Args(num_episodes=30));"
    said = subprocess.run(
        [sys.executable, "-c", train + "print(sum(run.novelty.counts.values()), 2 * run.log.lengths.sum())"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert said.returncode == 0, said.stderr
    remembered, steps = map(int, said.stdout.splitlines()[-1].split())
    assert remembered == steps > 60
