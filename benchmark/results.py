"""The comparison's results: kept small in benchmark/results/, drawn as the paper's figures, tabled in the README.

    python benchmark/results.py                          # takes in the runs that are there, redraws docs/, rewrites the tables

It takes in finished cells of `./benchmark.sh` with 20 trials; of two that differ in length only, the longer counts. Figures
and tables need nothing but benchmark/results/.
"""

import json
import sys
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import matplotlib
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark.cells import METHODS, OPTIMIZERS, ROOT, RUNS, WORLDS, Cell, settings_of

matplotlib.use("Agg")
from matplotlib import pyplot as plt

STORE = ROOT / "benchmark" / "results"
README = ROOT / "README.md"
BLOCK = 100  # episodes of which a point of a curve is the mean
# The colours of Okabe and Ito, which the colour-blind can tell apart; the same in all figures.
COLOURS = {
    **{"pg": "#777777", "epg": "#009e73", "spg": "#e69f00", "espg": "#56b4e9", "decespg": "#0072b2"},
    **{"ac": "#d55e00", "coma": "#cc79a7", "acer": "#f0e442", "dqn": "#000000", "edti": "#882255"},
}
FIGURES = {
    "figure3": ("pg", "ac", "coma", "acer", "dqn", "edti", "decespg"),
    "figure4": ("pg", "epg", "spg", "espg", "decespg"),
}


@dataclass(frozen=True)
class Result:
    """What is kept of a run of several trials."""

    score: np.ndarray  # [num_trials, num_episodes / BLOCK] reward per step, mean of each block
    at_best: np.ndarray  # shaped as score, share of the episodes that ended in the best outcome
    last: np.ndarray  # [num_trials] reward per step, mean of the last 5 % of the episodes
    usual: np.ndarray  # [num_trials] the outcome in which most of the last 5 % of the episodes ended
    num_episodes: int
    about: dict  # args.json

    @classmethod
    def of_run(cls, run_dir):
        """Read a finished run's directory."""
        about = json.loads((run_dir / "args.json").read_text())
        world = envs.make_world(about["args"]["env"])
        with np.load(run_dir / "episodes.npz") as episodes:
            log = envs.EpisodeLog(world, *episodes["returns"].shape)
            log.returns, log.lengths, log.outcomes = (episodes[name] for name in ("returns", "lengths", "outcomes"))
        trials, num_episodes = log.returns.shape
        blocks, recent = num_episodes // BLOCK, slice(-max(1, num_episodes // 20), None)

        def block_means(values):
            return values[:, : blocks * BLOCK].reshape(trials, blocks, BLOCK).mean(2).astype(np.float32)

        score = block_means(envs.reward_per_step(log.returns, log.lengths))
        at_best = block_means(log.outcomes == (world.best_outcome if world.outcome_names else -1))
        last = log.means(recent)["reward_per_step"]
        return cls(score, at_best, last, log.usual_outcomes(recent), num_episodes, about)

    @classmethod
    def load(cls, path):
        """Read what `save` wrote."""
        with np.load(path) as file:
            arrays = {name: file[name] for name in ("score", "at_best", "last", "usual")}
            return cls(**arrays, num_episodes=int(file["num_episodes"]), about=json.loads(str(file["about"])))

    def save(self, path):
        """Write some kilobytes, at once and complete."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with envs.complete_file(path) as file:
            np.savez_compressed(file, **{**vars(self), "about": json.dumps(self.about)})


def take_in(runs):
    """Keep the finished cells of the comparison that lie under `runs` and are not shorter than what is kept already."""
    for file in sorted(runs.rglob("episodes.npz")):
        found = settings_of(file.parent)
        if (found["seed"], found["num_trials"]) != (1, 20) or found["method"] not in METHODS:
            continue
        cell = Cell(found["method"], found["env"], found.get("optimizer", "adam"), num_episodes=found["num_episodes"])
        if cell.settings != found:  # somebody's own experiment, or from before a change of the defaults
            continue
        result, path = Result.of_run(file.parent), STORE / cell.world / f"{cell.method}-{cell.optimizer}.npz"
        if not path.exists() or Result.load(path).num_episodes <= result.num_episodes:
            result.save(path)


def kept():
    """All results that are kept, {(world, method, optimizer): Result}."""
    keys = product(WORLDS, METHODS, OPTIMIZERS)
    paths = {(world, method, optimizer): STORE / world / f"{method}-{optimizer}.npz" for world, method, optimizer in keys}
    return {key: Result.load(path) for key, path in paths.items() if path.exists()}


@cache
def optimum(world):
    """The best reward per step of a world."""
    return envs.optimum(world).best_per_step.per_step


def mean_and_error(values):
    """Mean over trials (the first axis) and its standard error."""
    return values.mean(0), values.std(0, ddof=1) / np.sqrt(len(values))


def difference(some, others, resamples=10_000):
    """Mean difference of two methods' last 5 % and its 95 % bootstrap interval.

    Trials of the same seed start from the same networks and action draws, so the pairs are resampled.
    """
    differences = some.last - others.last
    draws = np.random.default_rng(0).integers(0, len(differences), (resamples, len(differences)))
    low, high = np.quantile(differences[draws].mean(1), (0.025, 0.975))
    return f"{differences.mean():+.2f} [{low:+.2f}, {high:+.2f}]"


def draw_figure(name, methods, results):
    """One of the paper's figures, a panel for each world and optimiser: mean and standard error over trials."""
    worlds = [world for world in WORLDS if any((world, m, o) in results for m in methods for o in OPTIMIZERS)]
    rows, columns = len(OPTIMIZERS), len(worlds)
    plots, axes = plt.subplots(rows, columns, figsize=(3.4 * columns, 2.6 * rows), layout="constrained", squeeze=False)
    for row, optimizer in enumerate(OPTIMIZERS):
        for column, world in enumerate(worlds):
            axis = axes[row, column]
            axis.set_visible(any((world, method, optimizer) in results for method in methods))
            for method in methods:
                if (result := results.get((world, method, optimizer))) is not None:
                    mean, error = mean_and_error(result.score)
                    episodes, colour = (np.arange(len(mean)) + 1) * BLOCK, COLOURS[method]
                    axis.plot(episodes, mean, color=colour, label=METHODS[method], linewidth=1.3)
                    axis.fill_between(episodes, mean - error, mean + error, color=colour, alpha=0.2, linewidth=0)
            axis.axhline(optimum(world), color="black", linewidth=0.8, linestyle=":", label="exact optimum")
            axis.set_title(f"{world}, {optimizer}", fontsize="medium")
            axis.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
    plots.supylabel(f"reward per step (mean of {BLOCK} episodes)", fontsize="medium")
    plots.supxlabel("episode", fontsize="medium")
    labels = {label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    names = [name for name in (*(METHODS[m] for m in methods), "exact optimum") if name in labels]
    plots.legend([labels[name] for name in names], names, loc="outside right center", frameon=False)
    plots.savefig(ROOT / "docs" / f"{name}.png", dpi=130)
    plt.close(plots)


def score_table(results):
    """Reward per step over the last 5 % of the episodes of everything that is kept, a Markdown table."""
    head = ["world", "method", "episodes"]
    for optimizer in OPTIMIZERS:
        head += [f"{optimizer}: reward per step", "worst trial", "at best end"]
    lines = [head, ["---"] * len(head)]
    for world in WORLDS:
        for method in METHODS:
            found = [results.get((world, method, optimizer)) for optimizer in OPTIMIZERS]
            if any(found):
                lengths = {str(result.num_episodes) for result in found if result}
                words = [world, METHODS[method], ", ".join(sorted(lengths))]
                lines.append(words + [word for result in found for word in scores(world, result)])
        if lines[-1][0] == world:
            lines.append([world, "*exact optimum*", "", f"*{optimum(world):.2f}*", "", "", f"*{optimum(world):.2f}*", "", ""])
    return markdown(lines)


def scores(world, result):
    """The three columns of one result."""
    if result is None:
        return ["", "", ""]
    mean, error = mean_and_error(result.last)
    best = envs.make_world(world)
    count = f"{np.sum(result.usual == best.best_outcome)} of {len(result.usual)}" if best.outcome_names else "-"
    return [f"{mean:.2f} ± {error:.2f}", f"{result.last.min():.2f}", count]


def difference_table(results, one="decespg", other="spg"):
    """What one method adds to another, with intervals."""
    head = ["world", *OPTIMIZERS]
    lines = [head, ["---"] * len(head)]
    for world in WORLDS:
        pairs = [[results.get((world, method, optimizer)) for method in (one, other)] for optimizer in OPTIMIZERS]
        if any(all(pair) for pair in pairs):
            lines.append([world, *(difference(*pair) if all(pair) else "" for pair in pairs)])
    return markdown(lines) if len(lines) > 2 else ""


def markdown(lines):
    """Rows of words as a table."""
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def rewrite(readme, name, text):
    """Put a table between the marks <!-- name --> and <!-- end name --> of the README."""
    marks = f"<!-- {name} -->", f"<!-- end {name} -->"
    before, _, rest = readme.partition(marks[0])
    _, _, after = rest.partition(marks[1])
    return f"{before}{marks[0]}\n{text}\n{marks[1]}{after}"


def main(runs: Path = RUNS):
    """Take in new runs, redraw the figures and rewrite the README's tables.

    Args:
        runs: where the cells have worked
    """
    take_in(runs)
    results = kept()
    for name, methods in FIGURES.items():
        if not any(method in methods[1:-1] for _, method, _ in results):
            continue  # only what every figure shows
        draw_figure(name, methods, results)
    readme = rewrite(README.read_text(), "scores", score_table(results))
    README.write_text(rewrite(readme, "differences", difference_table(results)))
    print(score_table(results))
    print(difference_table(results))


if __name__ == "__main__":
    tyro.cli(main)
