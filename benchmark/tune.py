"""The tuning rule, the same for every method: 3 learning rates x 3 values of one number of its own, for each optimiser.

Each cell of the grid trains 5 teams (seeds 1000-1004, which no reported result uses) for a quarter of Table 1's episodes. The
best cell has the highest mean reward per step over the last 5 % of the episodes; of equal ones, the higher mean over all. The
paper's figures play no part. Finished cells are not run again, interrupted ones go on.

    python benchmark/tune.py pg decespg --jobs 2         # writes benchmark/tuning/pg.md and decespg.md
"""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import envs

# A quarter of Table 1.
EPISODES = {"findtreasure": 2500, "pushbox": 5000, "gotogether": 2500, "cleaner": 5000, "movebox": 5000}
# These worlds take the best learning rate of the world whose networks are of the same or nearest size.
NEAREST = {"gotogether": "findtreasure", "cleaner": "pushbox", "movebox": "pushbox"}
LEARNING_RATES = {"sign": (1e-4, 3e-4, 1e-3), "adam": (3e-4, 1e-3, 3e-3)}
# The number of a method's own that is tuned, and its values in each world; pg has none, and so nothing to tune elsewhere.
OWN = {
    "pg": {"findtreasure": ("", (None,)), "pushbox": ("", (None,))},
    "decespg": {
        "findtreasure": ("beta", (0.03, 0.1, 0.3)),
        "pushbox": ("beta", (1.0, 3.0, 10.0)),
        "gotogether": ("beta", (0.03, 0.1, 0.3)),
        "cleaner": ("beta", (0.01, 0.03, 0.1)),
        "movebox": ("beta", (0.3, 1.0, 3.0)),
    },
}


@dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    method: str
    env: str
    optimizer: str
    learning_rate: float
    own: str
    value: float | None

    @property
    def run_dir(self):
        own = f"-{self.own}={self.value}" if self.own else ""
        return ROOT / "runs" / "tuning" / self.method / self.env / f"{self.optimizer}-learning_rate={self.learning_rate}{own}"

    @property
    def result(self):
        return self.run_dir / "episodes.npz"

    def run(self):
        """Train; returns the last line of what the script says if it fails, None if it does not."""
        if self.result.exists():
            return None
        command = [sys.executable, ROOT / "algos" / f"{self.method}.py", "--env", self.env, "--seed", 1000, "--num-trials", 5]
        command += ["--num-episodes", EPISODES[self.env], "--optimizer", self.optimizer, "--learning-rate", self.learning_rate]
        command += ["--run-dir", self.run_dir, *([f"--{self.own}", self.value] if self.own else [])]
        command += ["--resume"] if (self.run_dir / "checkpoint.pt").exists() else []
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
        return None if done.returncode == 0 else done.stderr.strip().splitlines()[-1]

    def scores(self):
        """Mean reward per step over the last 5 % of the episodes and over all, and the mean of each trial over the last 5 %."""
        episodes = np.load(self.result)
        score = envs.reward_per_step(episodes["returns"], episodes["lengths"])
        trials = score[:, -score.shape[1] // 20 :].mean(1)
        return trials.mean(), score.mean(), trials


def cells_of(method, env, optimizer):
    """The cells of one world and optimiser."""
    own, values = OWN[method][env]
    rates = [best(method, NEAREST[env], optimizer).learning_rate] if env in NEAREST else LEARNING_RATES[optimizer]
    return [Cell(method, env, optimizer, rate, own, value) for rate, value in product(rates, values)]


def best(method, env, optimizer):
    """The cell that the rule chooses, out of finished ones."""
    return max(cells_of(method, env, optimizer), key=lambda cell: cell.scores()[:2])


def table(method):
    """The whole grid as a Markdown page; the best cell of each world and optimiser in bold."""
    own = next(iter(OWN[method].values()))[0]
    head = ["world", "optimiser", "learning rate", own or "-", "last 5 %", "worst trial", "all episodes"]
    lines = [f"# {method}: the tuning grid", "", f"Made by `python benchmark/tune.py {method}`, which says how.", ""]
    lines += [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for env, optimizer in product(OWN[method], LEARNING_RATES):
        cells = cells_of(method, env, optimizer)
        if not all(cell.result.exists() for cell in cells):
            continue
        for cell in cells:
            last, overall, trials = cell.scores()
            value = "-" if cell.value is None else f"{cell.value:g}"
            row = [env, optimizer, f"{cell.learning_rate:g}", value, f"{last:.2f}", f"{trials.min():.2f}", f"{overall:.2f}"]
            chosen = cell == best(method, env, optimizer)
            lines.append("| " + " | ".join(f"**{word}**" if chosen else word for word in row) + " |")
    return "\n".join(lines) + "\n"


def run_all(cells, jobs):
    """Run cells side by side; exits with 1 after the last if one has failed."""
    with ThreadPoolExecutor(jobs) as pool:
        errors = list(tqdm(pool.map(Cell.run, cells), total=len(cells), unit="run"))
    failed = [f"{cell.run_dir}: {error}" for cell, error in zip(cells, errors, strict=True) if error]
    if failed:
        print("\n".join(failed), file=sys.stderr)
        sys.exit(1)


def main(
    methods: Annotated[tuple[str, ...], tyro.conf.Positional],
    worlds: tuple[str, ...] = tuple(EPISODES),
    optimizers: tuple[Literal["sign", "adam"], ...] = tuple(LEARNING_RATES),
    jobs: int = 2,
):
    """Run the tuning grid of some methods and write the tables of what is finished.

    Args:
        methods: scripts of algos/ without .py
        worlds: worlds to tune for
        optimizers: optimisers of the policies to tune for
        jobs: runs at the same time, one core each
    """
    for what, words, known in (("grid for the method", methods, OWN), ("world", worlds, EPISODES)):
        for word in set(words) - set(known):
            print(f"tune.py: there is no {what} {word!r}; there is {', '.join(known)}.", file=sys.stderr)
            sys.exit(2)
    for stage in (set(worlds) - set(NEAREST), set(worlds) & set(NEAREST)):  # the second needs what the first finds
        wanted = [(m, env, o) for m in methods for env in OWN[m] for o in optimizers if env in stage]
        run_all([cell for group in wanted for cell in cells_of(*group)], jobs)
    for method in methods:
        path = ROOT / "benchmark" / "tuning" / f"{method}.md"
        path.parent.mkdir(exist_ok=True)
        path.write_text(table(method))
        print(f"wrote {path}\n\n{table(method)}")


if __name__ == "__main__":
    tyro.cli(main)
