"""The tuning rule, the same for every method: 3 learning rates x 3 values of one number of its own, for each optimiser.

Each cell of the grid trains 5 teams (seeds 1000-1004, which no reported result uses) for a quarter of Table 1's episodes. The
best cell has the highest mean reward per step over the last 5 % of the episodes; of equal ones, the higher mean over all. The
paper's figures play no part.

In the worlds with large networks, cleaner and movebox, memories keep 3 episodes for each end instead of 10, which takes a third
of the time for replay: DecESPG with 3 is not worse than with 10 by more than a standard error of that (5 trials of the grid's
length, at rates chosen before: cleaner 0.267 and 0.268 +- 0.007, movebox 0.95 and 0.46 +- 0.12 under sign, 1.35 and 1.73 +-
0.62 under adam). So it is for SPG, whose own number that is (movebox, sign: 1.09 and 1.36 +- 0.47).

    python benchmark/tune.py pg decespg --jobs 2         # adds what is missing in benchmark/tuning/pg.csv and decespg.csv

The tables hold what was measured and are all that the rule reads: a cell with a row there is not run again; one without is (so
after a change of a method delete its rows), from its checkpoint under runs/tuning/ if it was interrupted.
"""

import csv
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark.cells import ROOT, check_words, takes_optimizer
from envs.command import command_line, one_line

# A quarter of Table 1, and of what the worlds beyond it have.
EPISODES = {"findtreasure": 2500, "pushbox": 5000, "gotogether": 2500, "cleaner": 5000, "movebox": 5000}
EPISODES |= {"climbing": 1250, "passage": 2500, "secretroom": 2500}
# These worlds take the best learning rate of the world whose networks are of the same size. Climbing has networks of
# findtreasure's size, but episodes of one step, so it is tuned by itself.
SAME_SIZE = {"gotogether": "findtreasure", "cleaner": "movebox", "passage": "findtreasure", "secretroom": "findtreasure"}
LEARNING_RATES = {"sign": (1e-4, 3e-4, 1e-3), "adam": (3e-4, 1e-3, 3e-3)}
BETAS = {
    "findtreasure": (0.03, 0.1, 0.3),
    "pushbox": (1.0, 3.0, 10.0),
    "gotogether": (0.03, 0.1, 0.3),
    "cleaner": (0.01, 0.03, 0.1),
    "movebox": (0.03, 0.1, 0.3),
    "climbing": (0.1, 0.3, 1.0),
    "passage": (0.03, 0.1, 0.3),
    "secretroom": (0.03, 0.1, 0.3),
}
# The bonuses of learnt models have other scales.
EXEMPLAR_BETAS = {
    "findtreasure": (0.003, 0.01, 0.03),
    "pushbox": (0.1, 0.3, 1.0),
    "gotogether": (0.003, 0.01, 0.03),
    "cleaner": (0.001, 0.003, 0.01),
    "movebox": (0.003, 0.01, 0.03),
}
CURIOSITY_BETAS = {
    "findtreasure": (0.1, 0.3, 1.0),
    "pushbox": (1.0, 3.0, 10.0),
    "gotogether": (0.1, 0.3, 1.0),
    "cleaner": (0.03, 0.1, 0.3),
    "movebox": (0.1, 0.3, 1.0),
}
EMBEDDING_BETAS = {
    "findtreasure": (0.03, 0.1, 0.3),
    "pushbox": (0.3, 1.0, 3.0),
    "gotogether": (0.01, 0.03, 0.1),
    "cleaner": (0.03, 0.1, 0.3),
    "movebox": (0.03, 0.1, 0.3),
}
# The number of a method's own that is tuned, and its values in each world; pg has none, and so nothing to tune in SAME_SIZE.
OWN = {
    "pg": ("", {world: (None,) for world in EPISODES if world not in SAME_SIZE}),
    "epg": ("beta", BETAS),
    "spg": ("slots", dict.fromkeys(EPISODES, (1, 3, 10)) | dict.fromkeys(("cleaner", "movebox"), (1, 3))),
    "espg": ("beta", BETAS),
    "decespg": ("beta", BETAS),
    "ac": ("critic_learning_rate", dict.fromkeys(EPISODES, (1e-3, 3e-3, 1e-2))),
    "coma": ("critic_learning_rate", dict.fromkeys(EPISODES, (1e-3, 3e-3, 1e-2))),
    "acer": ("critic_learning_rate", dict.fromkeys(EPISODES, (3e-4, 1e-3, 3e-3))),
    "dqn": ("exploration", dict.fromkeys(EPISODES, (0.1, 0.2, 0.5))),
    "hysteretic": ("hysteresis", dict.fromkeys(EPISODES, (0.1, 0.2, 0.4))),
    "qmix": ("exploration", dict.fromkeys(EPISODES, (0.1, 0.2, 0.5))),
    "edti": ("eta", dict.fromkeys(EPISODES, (3.0, 10.0, 30.0)) | {"movebox": (0.1, 0.3, 1.0)}),
    "decespg_ex2": ("beta", EXEMPLAR_BETAS),
    "espg_icm": ("beta", CURIOSITY_BETAS),
    "espg_emi": ("beta", EMBEDDING_BETAS),
    "ippo": ("entropy_coef", dict.fromkeys(EPISODES, (0.003, 0.01, 0.03))),
    "mappo": ("entropy_coef", dict.fromkeys(EPISODES, (0.003, 0.01, 0.03))),
    "gasil": (
        "lambda_im",
        dict.fromkeys(EPISODES, (3.0, 10.0, 30.0)) | {"gotogether": (0.3, 1.0, 3.0), "cleaner": (0.1, 0.3, 1.0)},
    ),
}
COLUMNS = ("world", "optimizer", "learning_rate", "own", "last 5 %", "worst trial", "all episodes", "chosen")


@dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    method: str
    world: str
    optimizer: str
    learning_rate: float
    value: float | None

    @property
    def key(self):
        """What the first columns of the table say."""
        return self.world, self.optimizer, f"{self.learning_rate:g}", "" if self.value is None else f"{self.value:g}"

    def run(self):
        """Train; returns mean reward per step over the last 5 % of the episodes, that of the worst trial, and over all."""
        own, _ = OWN[self.method]
        run_dir = ROOT / "runs" / "tuning" / self.method / "-".join(word for word in self.key if word)
        command = [sys.executable, ROOT / "algos" / f"{self.method}.py", "--env", self.world, "--seed", 1000, "--num-trials", 5]
        command += ["--num-episodes", EPISODES[self.world], "--run-dir", run_dir]
        command += ["--optimizer", self.optimizer] if takes_optimizer(self.method) else []
        command += ["--learning-rate", self.learning_rate, *([f"--{own.replace('_', '-')}", self.value] if own else [])]
        command.append("--resume" if (run_dir / "checkpoint.pt").exists() else "--overwrite")  # a row that is missing is run
        subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True)
        episodes = np.load(run_dir / "episodes.npz")
        score = envs.reward_per_step(episodes["returns"], episodes["lengths"])
        trials = score[:, envs.last_episodes(score.shape[1])].mean(1)
        return trials.mean(), trials.min(), score.mean()


class Table:
    """benchmark/tuning/<method>.csv: {key of a cell: (last 5 %, worst trial, all episodes)}."""

    def __init__(self, method):
        self.method, self.path, self.rows = method, ROOT / "benchmark" / "tuning" / f"{method}.csv", {}
        self.lock = threading.Lock()
        if self.path.exists():
            with self.path.open(newline="", encoding="utf-8") as file:
                rows = list(csv.reader(file))
            try:
                self.rows = {tuple(row[:4]): tuple(map(float, row[4:7])) for row in rows[1:]}
                sorted(self.rows.items(), key=order)
            except ValueError as error:
                raise envs.UsageError(f"{self.path} is no table of this program ({one_line(error)}).") from error

    def cells(self, world, optimizer):
        """The grid of one world and optimiser."""
        values, rates = OWN[self.method][1].get(world, ()), LEARNING_RATES[optimizer]
        if optimizer == "sign" and not takes_optimizer(self.method):
            return []
        if values and world in SAME_SIZE:
            rates = [self.best(SAME_SIZE[world], optimizer).learning_rate]
        return [Cell(self.method, world, optimizer, *cell) for cell in product(rates, values)]

    def finished(self, world, optimizer):
        """Whether all cells of a world and optimiser, of which there are some, have a row."""
        if world in SAME_SIZE and not self.finished(SAME_SIZE[world], optimizer):
            return False
        cells = self.cells(world, optimizer)
        return bool(cells) and all(cell.key in self.rows for cell in cells)

    def best(self, world, optimizer):
        """The cell that the rule chooses, out of finished ones."""
        return max(self.cells(world, optimizer), key=lambda cell: (self.rows[cell.key][0], self.rows[cell.key][2]))

    def add(self, cell, scores):
        """Write the table anew with one more row."""
        with self.lock:
            self.rows[cell.key] = tuple(float(f"{score:.4f}") for score in scores)
            chosen = [self.best(*pair).key for pair in product(EPISODES, LEARNING_RATES) if self.finished(*pair)]
            self.path.parent.mkdir(exist_ok=True)
            with envs.complete_file(self.path) as file:
                lines = [COLUMNS, *((*key, *row, "yes" * (key in chosen)) for key, row in sorted(self.rows.items(), key=order))]
                file.write("".join(",".join(map(str, line)) + "\n" for line in lines).encode())


def order(item):
    """Rows stand in the order of the grid."""
    (world, optimizer, learning_rate, own), _ = item
    return list(EPISODES).index(world), list(LEARNING_RATES).index(optimizer), float(learning_rate), float(own or 0)


def run_cells(tables, cells, jobs):
    """Run cells side by side, each into its table as it ends; exits with 1 after the last if one has failed."""
    failed, bar = [], tqdm(total=len(cells), unit="run")

    def run(cell):
        try:
            tables[cell.method].add(cell, cell.run())
        except subprocess.CalledProcessError as error:
            failed.append(f"{cell}: {(error.stderr.strip().splitlines() or ['no output'])[-1]}")
        except Exception as error:  # whatever can be wrong with a file
            failed.append(f"{cell}: {one_line(error)}")
        bar.update()

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(run, cells))
    bar.close()
    if failed:
        print("\n".join(failed), file=sys.stderr)
        sys.exit(1)


def main(
    methods: Annotated[tuple[str, ...], tyro.conf.Positional],
    worlds: tuple[str, ...] = tuple(EPISODES),
    optimizers: tuple[Literal["sign", "adam"], ...] = tuple(LEARNING_RATES),
    jobs: int = 2,
):
    """Run what is missing in the tuning grid of some methods.

    Args:
        methods: scripts of algos/ without .py
        worlds: worlds to tune for
        optimizers: optimisers of the policies to tune for
        jobs: runs at the same time, one core each
    """
    check_words("grid for the method", methods, OWN)
    check_words("world", worlds, EPISODES)
    envs.check_whole("--jobs", jobs, minimum=1)
    tables = {method: Table(method) for method in methods}
    needed = [SAME_SIZE.get(world, world) for world in worlds]
    for stage in ([w for w in EPISODES if w in needed], [w for w in SAME_SIZE if w in worlds]):  # the second needs the first
        cells = [cell for group in product(methods, stage, optimizers) for cell in tables[group[0]].cells(*group[1:])]
        run_cells(tables, [cell for cell in cells if cell.key not in tables[cell.method].rows], jobs)
    for method in methods:
        print(tables[method].path.relative_to(ROOT))
        for pair in filter(lambda pair: tables[method].finished(*pair), product(worlds, optimizers)):
            print("  ", *pair, tables[method].best(*pair).key[2:], *tables[method].rows[tables[method].best(*pair).key])


if __name__ == "__main__":
    with command_line("tune.py"):
        tyro.cli(main)
