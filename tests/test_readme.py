"""The commands and examples of README and docs/ do what they say."""

import json
import re
import shlex
import subprocess
import sys
from math import log
from pathlib import Path
from types import SimpleNamespace

import pytest

import envs

ROOT = Path(envs.__file__).parents[1]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = [
    block for text in TEXTS for block in re.findall(r"```(bash|python)\n(.*?)```", text.read_text(encoding="utf-8"), re.DOTALL)
]
COMMANDS = [line for kind, block in BLOCKS if kind == "bash" for line in block.splitlines()]


def example(words):
    """The one Python example with these words."""
    (found,) = [block for kind, block in BLOCKS if kind == "python" and words in block]
    return found


def python(folder, *words):
    """Run the Python of the tests in a folder, with the repository's envs and algos at hand; returns what it says."""
    done = subprocess.run([sys.executable, *map(str, words)], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run(command, folder):
    words = [str(ROOT / word) if word.startswith("algos/") else word for word in shlex.split(command)]
    return python(folder, *words[1:])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A user's folder in which `import envs` and `import algos` work."""
    folder = tmp_path_factory.mktemp("user")
    for name in ("envs", "algos", "benchmark"):
        (folder / name).symlink_to(ROOT / name)
    return folder


def test_ci_runs_exactly_the_test_command():
    install_and_test = [command for command in COMMANDS if command.endswith("-m pytest -n 2")]
    assert len(install_and_test) == 1
    assert install_and_test[0] in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()


def test_the_first_command_installs_and_trains(folder):
    install, _, train = COMMANDS[0].rpartition(" && ")
    assert install == "python3 -m venv .venv && .venv/bin/pip install -r requirements.txt"
    assert "1 trial, usual end" in run(train + " --num-episodes 2", folder)


def test_the_example_commands_run(folder):
    own = ("my_world", "counts.py")  # which readers make
    commands = [command for command in COMMANDS if command.startswith("python algos/") and not any(o in command for o in own)]
    train, evaluate, other, help_text, *reported = commands
    policy = evaluate.split()[-1]
    assert "20 trials" in run(f"{train} --num-episodes 2 --run-dir {policy.rpartition('/')[0]}", folder)
    assert "2 episodes of 20 teams" in run(f"{evaluate} --num-episodes 2", folder)
    assert "1 trial" in run(f"{other} --num-episodes 2", folder)
    assert "--learning-rate" in run(help_text, folder)
    for command in reported:
        assert "usual end" in run(re.sub("--num-episodes [0-9]+", "--num-episodes 2", command), folder)


def test_the_shown_numbers_of_changed_lines_are_those_of_diff():
    rows = re.findall(r"^\| (\w+) \| (\w+) \| (\d+) / (\d+) \|", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) >= 8
    for one, other, gone, new in rows:
        words = ["diff", f"algos/{one}.py", f"algos/{other}.py"]
        lines = subprocess.run(words, cwd=ROOT, capture_output=True, text=True).stdout.splitlines()
        counts = [sum(line.startswith(sign) for line in lines) for sign in "<>"]
        assert counts == [int(gone), int(new)], (one, other)


def test_looking_inside_a_trained_team(folder):
    words = ["--env", "pushbox", "--seed", 3, "--num-episodes", 400, "--save-model", "--run-dir", "runs/pushbox/decespg/seed3"]
    python(folder, ROOT / "algos" / "decespg.py", *words, "--overwrite")
    code = example("envs.run.load(")
    assert len(code.splitlines()) <= 13
    said = python(folder, "-c", code + "\nprint(probs.sum(1).tolist(), bonus.shape, (bonus >= 0).all(), best.shape[1])")
    sums, shape, positive, agents = re.match(r"(\[.*\]) (\(.*\)) (\w+) (\d)", said).groups()
    assert [round(total, 5) for total in eval(sums)] == [1, 1]
    assert (shape, positive, agents) == ("(2, 4)", "True", "2")


# --- docs/own.md ---


def test_the_example_of_a_world_works_wherever_a_name_does(folder):
    world = example("class Corridor")
    assert len(world.splitlines()) <= 45
    (folder / "my_world.py").write_text(world)
    play, optimum, decespg, pg, compare = [command for command in COMMANDS if "my_world.py" in command]
    assert "B bell" in (said := run(play, folder)).replace("b bell", "B bell")
    assert re.search(r"end: (far end|near end|time limit) after \d+ steps", said)
    assert re.search(r"far end +6 +10 ", run(optimum, folder))
    assert "3 trials, usual end: " in run(decespg.replace("500", "20"), folder)
    assert list(folder.glob("runs/my_world/decespg/*/team.gif"))
    assert "1 trial, usual end: " in run(f"{pg} --num-episodes 20", folder)
    words = shlex.split(compare)[1:]
    words = [word.replace("500", "4") if word == "500" else word for word in words]
    said = python(ROOT, "-m", "benchmark.compare", *(str(folder / w) if w == "my_world.py" else w for w in words), "--dry-run")
    assert "my_world/pg/sign-seeds1-3-episodes4" in said
    assert "my_world/decespg/sign-seeds1-3-episodes4" in said


def test_the_example_of_a_world_with_observations_of_its_own_works(folder):
    (folder / "vault.py").write_text(example("class Vault"))
    assert re.search(r"out +8 +10 ", python(folder, "-c", "import envs; print(envs.optimum('vault.py'))"))
    optimum = python(folder, "-c", "import envs; w = envs.make_world('vault.py'); print(envs.optimal_plan(w).T.tolist())")
    assert eval(optimum)[0][:3] == [0, 0, 2]
    words = ["--env", "vault.py", "--num-episodes", 5, "--num-trials", 2]
    for name in ("decespg", "coma", "edti"):
        assert "2 trials, usual end: " in python(folder, ROOT / "algos" / f"{name}.py", *words)


@pytest.mark.parametrize(
    ("script", "policy"),
    [
        ("pg", "SharedPolicy(init, world, args.hidden)"),
        ("decespg", "SharedPolicy(init, world, args.hidden)"),
        ("pg", "GRUPolicy(init, world)"),
        ("epg", "GRUPolicy(init, world)"),
    ],
)
def test_other_networks_train_are_saved_and_play(script, policy, folder, tmp_path):
    name = policy.partition("(")[0]
    changed = (
        (ROOT / "algos" / f"{script}.py")
        .read_text(encoding="utf-8")
        .replace("def build(", example(f"class {name}") + "\n\ndef build(", 1)
    )
    made = "StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions])"
    changes = {made: policy, "rollout.play(team.policy.params, act)": "rollout.play_with(team.policy.player(), act)"}
    if name == "GRUPolicy":
        changes[
            "        log_probs = torch.log_softmax(team.policy(rollout.obs), dim=-1)  # of each distinct observation, once\n"
        ] = ""
        changes["rollout.of_taken(log_probs)"] = "team.policy.log_probs(rollout)"
    for old, new in changes.items():
        assert changed.count(old) == 1
        changed = changed.replace(old, new)
    (tmp_path / "algos").mkdir()
    (tmp_path / "algos" / "mine.py").write_text(changed)
    (tmp_path / "envs").symlink_to(ROOT / "envs")
    words = ["--env", "findtreasure", "--max-steps", 30, "--num-trials", 2, "--num-episodes", 30, "--save-model"]
    said = python(tmp_path, "algos/mine.py", *words, "--run-dir", "run", "--optimizer", "adam")
    assert "2 trials, usual end: " in said
    assert "5 episodes of 2 teams" in python(tmp_path, "algos/mine.py", "--evaluate", "run/policy.pt", "--num-episodes", 5)


def test_the_example_of_a_search_trains_with_what_is_chosen(tmp_path, monkeypatch):
    """A stand-in for Optuna that chooses the lowest values, once."""
    monkeypatch.chdir(tmp_path)
    trial = SimpleNamespace(number=0, suggest_float=lambda name, low, high, log: low)
    study = SimpleNamespace(optimize=lambda objective, n_trials: results.append(objective(trial)))
    results, optuna = [], SimpleNamespace(create_study=lambda direction: study)
    monkeypatch.setitem(sys.modules, "optuna", optuna)
    exec(example("import optuna").replace("num_episodes=5000", "num_episodes=300"), {})
    args = json.loads((tmp_path / "runs" / "optuna" / "0" / "args.json").read_text())["args"]
    assert (args["learning_rate"], args["beta"], args["num_trials"]) == (1e-5, 0.1, 5)
    assert 0.3 < results[0] < 2


def put_in_the_place_of_the_window(bonus, folder):
    """Make folder/algos/counts.py, decespg.py with another bonus."""
    script = (ROOT / "algos" / "decespg.py").read_text(encoding="utf-8")
    changed = re.sub(r"class VisitNovelty:.*?\n\n\n(?=class )", lambda _: bonus + "\n\n", script, flags=re.DOTALL)
    changed = changed.replace("import numpy as np\n", "from zlib import crc32\n\nimport numpy as np\n", 1)
    assert changed.count("class VisitNovelty") == 1
    (folder / "algos").mkdir()
    (folder / "algos" / "counts.py").write_text(changed)
    (folder / "envs").symlink_to(ROOT / "envs")


def test_the_example_of_a_bonus_takes_the_place_of_the_window(tmp_path):
    put_in_the_place_of_the_window(example("1 / sqrt(n) for the n-th visit"), tmp_path)
    train = "import sys; sys.path.insert(0, 'algos'); import counts; run = counts.train(counts.Args(num_episodes=30));"
    said = python(tmp_path, "-c", train + "print(run.novelty.counts.sum(), 2 * run.log.lengths.sum())")
    remembered, steps = map(int, said.splitlines()[-1].split())
    assert remembered == steps > 60


def test_the_window_of_all_visits_counts_them(tmp_path):
    put_in_the_place_of_the_window(example("def visits_before"), tmp_path)
    code = """
import sys; sys.path.insert(0, "algos")
import counts, numpy as np
run = counts.train(counts.Args(env="movebox", num_trials=2, num_episodes=3, beta=100, noise=10))
print(run.novelty.counts.sum(), 2 * run.log.lengths.sum())
pairs = np.zeros((7, 2, 2, 10), np.float32)  # the agents stand beside the box all the time, and choose up but for once
pairs[..., 4:] = np.array([10, 6, 10, 8, 10, 7]) / 15
pairs[..., 0] = 1
pairs[2, ..., :4] = 0, 0, 0, 1
novelty = counts.VisitNovelty(2, 2, 10, 50, 0.5, 10.0)
bonus, _, _ = novelty.bonus(pairs, np.array([5, 7]))
print(*bonus[:, 0, 0], *bonus[:, 1, 1])
"""
    reported, chosen = [command for command in COMMANDS if "counts.py" in command]
    for command, trials in ((reported, "20 trials"), (chosen, " 5 trials")):
        assert trials in python(tmp_path, *command.split()[1:], "--num-episodes", 2)
    counts, bonuses = python(tmp_path, "-c", code).splitlines()[-2:]
    remembered, steps = map(int, counts.split())
    assert remembered == steps > 60
    first = log(1000)
    five = [first, log(1 + 10 / 1), first, log(1 + 10 / 2), log(1 + 10 / 3)]
    assert list(map(float, bonuses.split())) == pytest.approx([*five, 0, 0, *five, log(1 + 10 / 4), log(1 + 10 / 5)])
