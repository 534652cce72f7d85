"""Your own runs in one figure and one table: any scripts, worlds, settings and seeds.

    python benchmark/plot.py runs/pushbox/pg/* runs/pushbox/mine/* --output figure.png

Runs that differ in nothing but their seeds are one curve: the mean over their trials and a 95 % bootstrap interval. Prints the
reward per step over the last 5 % of the episodes and, in each world, what every curve has more than the first: the difference
over the trials of the same seeds, and the probability that a trial of it ends better than one of the first. Fewer than five
trials have no interval.
"""

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from matplotlib import pyplot as plt

import envs
from benchmark import measures
from benchmark.cells import settings_of
from benchmark.report import markdown
from envs.command import command_line

POINTS = 100  # of the longest curve in a panel
RESAMPLES = 2000  # of the bootstrap
FEWEST = 5  # trials that have an interval
TASK = ("env_args", "max_steps")  # settings that make another task of a world, for all methods


@dataclass(frozen=True)
class Group:
    """The trials of runs that differ in their seeds only."""

    label: str
    world: str
    seeds: tuple[int, ...]
    score: np.ndarray  # [num_trials, num_episodes] reward per step

    @property
    def last(self):
        """Reward per step over the last 5 % of the episodes, [num_trials]."""
        return self.score[:, envs.last_episodes(self.score.shape[1])].mean(1)


def read(directories):
    """{settings without seeds, as text: {seed: reward per step [num_episodes]}} of finished runs; the others are named."""
    found = {}
    for directory in directories:
        try:
            settings = settings_of(directory)
            with np.load(directory / "episodes.npz") as episodes:
                scores = envs.reward_per_step(episodes["returns"], episodes["lengths"])
        except Exception as error:  # whatever can be wrong with somebody's directory
            why = "is not a finished run" if isinstance(error, OSError) else f"cannot be read ({type(error).__name__})"
            print(f"{directory} {why} and is left out.", file=sys.stderr)
            continue
        first = settings.pop("seed")
        settings.pop("num_trials")
        trials = found.setdefault(json.dumps(settings), {})
        if again := sorted(set(trials) & {first + k for k in range(len(scores))}):
            print(f"{directory} holds seed {again[0]} once more; its trials replace the earlier ones.", file=sys.stderr)
        trials.update({first + k: score for k, score in enumerate(scores)})
    return found


def groups_of(found):
    """Name the curves after their method and whatever else distinguishes them."""
    settings = [json.loads(text) for text in found]
    groups = []
    for own, trials in zip(settings, found.values(), strict=True):
        there = [other for other in settings if other["env"] == own["env"]]
        alike = [other for other in there if other["method"] == own["method"]]
        names = [name for name in own if any(other.get(name) != own[name] for other in (there if name in TASK else alike))]
        values = [" ".join(map(str, own[name])) if isinstance(own[name], list) else own[name] for name in names]
        words = [f"{name}={value}" for name, value in zip(names, values, strict=True)]
        seeds = tuple(sorted(trials))
        score = np.stack([trials[seed] for seed in seeds])
        groups.append(Group(" ".join([own["method"], *words]), Path(own["env"]).stem, seeds, score))
    return groups


def interval(values):
    """The 95 % bootstrap interval of the mean of trials [num_trials, ..]: (low, high)."""
    draws = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    return np.quantile(values[draws].mean(1), (0.025, 0.975), axis=0)


def decimals_of(groups, world):
    """With how many decimals a world's rewards are told: 2, or so many that the largest mean has three figures."""
    largest = max(abs(group.last.mean()) for group in groups if group.world == world)
    return max(2, 2 - math.floor(math.log10(largest))) if largest > 0 else 2


def compare(one, other, decimals=2):
    """What `one` has more than `other`, in words: over the trials of the same seeds, and the probability of improvement."""
    seeds = sorted(set(one.seeds) & set(other.seeds))
    same = [SimpleNamespace(last=group.last[np.isin(group.seeds, seeds)]) for group in (one, other)]
    scores = {"one": one.last[:, None], "other": other.last[:, None]}
    better, *shares = measures.improvements(scores, over="one")["other"]
    difference = [f"{value:+.{decimals}f}" for value in measures.difference(*same)] if len(seeds) >= FEWEST else []
    words = "{} [{}, {}]".format(*difference) if difference else "-"
    enough = min(map(len, (one.seeds, other.seeds))) >= FEWEST
    return [words, f"{better:.2f}" + (" [{:.2f}, {:.2f}]".format(*shares) if enough else "")]


def draw(groups, path):
    """A panel for each world."""
    worlds = list(dict.fromkeys(group.world for group in groups))
    labels = list(dict.fromkeys(group.label for group in groups))
    size = (4.6 * len(worlds) + 2, 3.2 + 0.22 * len(labels))  # the panels and, below them, a line for each curve
    figure, axes = plt.subplots(1, len(worlds), figsize=size, layout="constrained", squeeze=False)
    for axis, world in zip(axes[0], worlds, strict=True):
        there = [group for group in groups if group.world == world]
        block = max(1, max(group.score.shape[1] for group in there) // POINTS)
        for group in there:
            blocks = group.score[:, : group.score.shape[1] // block * block].reshape(len(group.score), -1, block).mean(2)
            episodes = (np.arange(blocks.shape[1]) + 1) * block
            (curve,) = axis.plot(episodes, blocks.mean(0), color=f"C{labels.index(group.label) % 10}", label=group.label)
            axis.fill_between(episodes, *interval(blocks), color=curve.get_color(), alpha=0.2, linewidth=0)
        axis.set_title(world, fontsize="medium")
        axis.set_xlabel("episode")
    axes[0, 0].set_ylabel("reward per step")
    curves = {label: curve for axis in axes[0] for curve, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(curves.values(), curves, loc="outside lower center", frameon=False)
    with envs.complete_file(path) as file:
        figure.savefig(file, dpi=130, format=path.suffix[1:] or "png")
    plt.close(figure)


def tables(groups):
    """The scores of all, and in each world the differences to the first."""
    scores, differences = [["world", "curve", "trials", "episodes", "reward per step", "95 % interval", "worst trial"]], []
    decimals = {group.world: decimals_of(groups, group.world) for group in groups}
    for group in groups:
        numbers = (group.last.mean(), *interval(group.last), group.last.min())
        mean, low, high, worst = (f"{number:.{decimals[group.world]}f}" for number in numbers)
        bounds = f"[{low}, {high}]" if len(group.seeds) >= FEWEST else "-"
        scores.append([group.world, group.label, str(len(group.seeds)), str(group.score.shape[1]), mean, bounds, worst])
    firsts = {group.world: group for group in reversed(groups)}
    for group in (group for group in groups if group is not firsts[group.world]):
        first = firsts[group.world]
        words = compare(group, first, decimals[group.world])
        differences.append([group.world, f"{group.label} - {first.label}", *words])
    return scores, [["world", "curves", "difference", "probability of improvement"], *differences]


def main(runs: Annotated[tuple[Path, ...], tyro.conf.Positional], output: Path = Path("plot.png")):
    """Read, draw, print.

    Args:
        runs: directories of finished runs
        output: the picture (.png, .svg or .pdf)
    """
    if output.suffix not in (".png", ".svg", ".pdf"):
        raise envs.UsageError(f"--output must end in .png, .svg or .pdf, not {output}.")
    groups = groups_of(read(runs))
    if not groups:
        raise envs.UsageError("there is no finished run among these.")
    for world in dict.fromkeys(group.world for group in groups):
        episodes = sorted({group.score.shape[1] for group in groups if group.world == world})
        if len(episodes) > 1:
            print(
                f"In {world} the curves have {' and '.join(map(str, episodes))} episodes: their ends cannot be compared.",
                file=sys.stderr,
            )
    draw(groups, output)
    scores, differences = tables(groups)
    print(markdown(scores), *([markdown(differences)] if len(differences) > 1 else []), f"See {output}.", sep="\n\n")


if __name__ == "__main__":
    with command_line("plot.py"):
        tyro.cli(main, description=__doc__)
