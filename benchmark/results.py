"""The README's results table and learning curves, from the runs that are there.

    python benchmark/results.py                          # prints the table, writes docs/curves.png

It reads runs/<world>/<method>/seed1-20/ and seed1-20-optimizer=adam/, that is what
`python algos/<method>.py --env <world> --num-trials 20 [--optimizer adam]` leaves, and says which are missing.
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np
import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import envs

matplotlib.use("Agg")
from matplotlib import pyplot as plt

METHODS = {"pg": "PG", "decespg": "DecESPG"}
OPTIMIZERS = ("sign", "adam")
# What the paper says (Section 4.3); where it only says that a method reaches the global optimum, the optimum that it quotes.
PAPER = {
    ("findtreasure", "pg"): "1.0",
    ("findtreasure", "decespg"): "14.25",
    ("pushbox", "pg"): "0.94 to 1.88",
    ("pushbox", "decespg"): "near 33.3",
}
COLOURS = {"pg": "#777777", "decespg": "#0072b2"}  # readable for the colour-blind
LINES = {"sign": "-", "adam": "--"}


def load(runs, world, method, optimizer):
    """The log of all episodes of a run of 20 trials, or None if it is not there."""
    name = "seed1-20" if optimizer == "sign" else f"seed1-20-optimizer={optimizer}"
    path = runs / world / method / name / "episodes.npz"
    if not path.exists():
        print(f"missing: {path}", file=sys.stderr)
        return None
    episodes = np.load(path)
    log = envs.EpisodeLog(envs.make_world(world), *episodes["returns"].shape)
    log.returns, log.lengths, log.outcomes = (episodes[name] for name in ("returns", "lengths", "outcomes"))
    return log


def row(world, method, optimizer, log, optimum):
    """One line of the table: reward per step over the last 5 % of the episodes, over trials."""
    recent = slice(-log.returns.shape[1] // 20, None)
    score = log.means(recent)["reward_per_step"]
    error = score.std(ddof=1) / np.sqrt(len(score))
    best = np.sum(log.usual_outcomes(recent) == log.world.best_outcome)
    words = [world, METHODS[method], optimizer, f"{score.mean():.2f} ± {error:.2f}", f"{score.min():.2f}"]
    return [*words, f"{best} of {len(score)}", f"{optimum.best_per_step.per_step:.2f}", PAPER[world, method]]


def draw_curves(axis, logs, optimum, window=100):
    """Mean and standard error over trials of the reward per step, averaged over `window` episodes; the optimum as a line."""
    for (method, optimizer), log in logs.items():
        score = envs.reward_per_step(log.returns, log.lengths)
        score = score[:, : score.shape[1] // window * window].reshape(len(score), -1, window).mean(2)
        mean, error = score.mean(0), score.std(0, ddof=1) / np.sqrt(len(score))
        episodes = (np.arange(score.shape[1]) + 1) * window
        label = f"{METHODS[method]}, {optimizer}"
        axis.plot(episodes, mean, LINES[optimizer], color=COLOURS[method], label=label, linewidth=1.5)
        axis.fill_between(episodes, mean - error, mean + error, color=COLOURS[method], alpha=0.2, linewidth=0)
    axis.axhline(optimum.best_per_step.per_step, color="black", linewidth=0.8, linestyle=":", label="exact optimum")
    axis.set_xlabel("episode")


def main(runs: Path = ROOT / "runs", figure: Path = ROOT / "docs" / "curves.png"):
    """Print the results table and draw the learning curves.

    Args:
        runs: where the scripts have left their runs
        figure: the picture to write
    """
    head = ["world", "method", "optimiser", "reward per step", "worst trial", "at best end", "exact optimum", "paper"]
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    worlds = list(dict.fromkeys(world for world, _ in PAPER))
    plots, axes = plt.subplots(1, len(worlds), figsize=(5 * len(worlds), 3.4), layout="constrained")
    for axis, world in zip(axes, worlds, strict=True):
        optimum = envs.find_optimum(envs.make_world(world))
        keys = [(method, optimizer) for method in METHODS for optimizer in OPTIMIZERS]
        logs = {key: log for key in keys if (log := load(runs, world, *key)) is not None}
        for (method, optimizer), log in logs.items():
            print(f"| {' | '.join(row(world, method, optimizer, log, optimum))} |")
        draw_curves(axis, logs, optimum)
        axis.set_title(world)
    axes[0].set_ylabel("reward per step (mean of 100 episodes)")
    axes[-1].legend(fontsize="small")
    plots.savefig(figure, dpi=150)


if __name__ == "__main__":
    tyro.cli(main)
