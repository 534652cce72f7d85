"""Does learned novelty lag behind? The exploration bonus of the first, tenth and hundredth visit, and how it follows counts.

    python benchmark/novelty.py                          # some minutes; draws docs/novelty.png

Trains each script as it is, at its own defaults, and notes for every trial and window the bonus (before beta) of each visit to
each pair u. Only pairs that are visited at least `VISITS` times count, so that all visit numbers speak of the same pairs. A
model that has not begun to learn says nothing yet (EX2's waits for 1000 pairs), so pairs that are visited before do not count
either. The last column is of all pairs in the last quarter of the episodes: the correlation of the bonus with -log n at the nth
visit to a pair, mean over trials and windows.
"""

import sys
from collections import Counter, defaultdict
from itertools import count
from pathlib import Path
from unittest.mock import patch

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from matplotlib import pyplot as plt

import envs
from benchmark.cells import METHODS, ROOT, check_words, name_of, script, train_aside
from benchmark.figures import DASHES, check_picture, colour_of
from benchmark.report import markdown
from envs.command import command_line

VISITS = 100


def novelty_class(module):
    """The name of a script's class that gives the exploration bonus; UsageError if there is none."""
    for name, value in vars(module).items():
        if isinstance(value, type) and hasattr(value, "bonus"):
            return name
    raise envs.UsageError(f"{Path(module.__file__).name} has no exploration bonus.")


def bonuses_of_visits(method, args):
    """Train; returns the bonus of the first VISITS visits to each pair that has as many, [pairs, VISITS], and the correlation.

    The bonus of a first visit is nan if the model had learnt nothing then. The correlation is that of the bonus with -log n at
    the n-th visit to a pair, over the last quarter of the episodes, mean over trials and windows. UsageError without pairs.
    """
    module, episode = script(method), count()
    name = novelty_class(module)
    seen, visits, late = defaultdict(list), Counter(), defaultdict(list)

    class Watched(getattr(module, name)):
        def bonus(self, pairs, *rest):
            values, *figures = super().bonus(pairs, *rest)
            (lengths, *_) = rest
            is_late = next(episode) >= 3 * args["num_episodes"] // 4
            for k, length in enumerate(lengths):
                learning = values[:, k].any()
                for w in range(pairs.shape[2]):
                    for pair, value in zip(pairs[:length, k, w], values[:length, k, w], strict=True):
                        key = k, w, pair.tobytes()
                        visits[key] += 1
                        if visits[key] <= VISITS:
                            seen[key].append(value if learning or visits[key] > 1 else np.nan)
                        if is_late:
                            late[k, w].append((value, -np.log(visits[key])))
            return values, *figures

    with patch.object(module, name, Watched):
        train_aside(module, **args)
    bonuses = np.array([values for values in seen.values() if len(values) == VISITS])
    if not len(bonuses):
        raise envs.UsageError(f"no pair is visited {VISITS} times by {method} in {args['env']}; train for more episodes.")
    return bonuses, np.mean([np.corrcoef(*zip(*pairs, strict=True))[0, 1] for pairs in late.values()])


def draw(curves, worlds, path):
    """Mean bonus of the n-th visit beside that of the first, one panel for each world."""
    figure, axes = plt.subplots(1, len(worlds), figsize=(4.6 * len(worlds), 3.2), layout="constrained", squeeze=False)
    for axis, world in zip(axes[0], worlds, strict=True):
        for (method, where), bonuses in curves.items():
            if where == world:
                mean, look = bonuses.mean(0), dict(color=colour_of(method), label=name_of(method))
                axis.plot(np.arange(VISITS) + 1, mean / mean.max(), DASHES.get(method, "-"), **look)
        axis.set_xscale("log")
        axis.set_ylim(-0.03, 1.03)
        axis.set_title(world, fontsize="medium")
        axis.set_xlabel("visit to the same pair")
        axis.set_ylabel("bonus / largest")
    named = {label: line for axis in axes[0] for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(named.values(), named.keys(), loc="outside right center", frameon=False)
    figure.savefig(path, dpi=130)


def main(
    methods: tuple[str, ...] = ("decespg", "espg", "decespg_ex2", "espg_icm", "espg_emi"),
    worlds: tuple[str, ...] = ("findtreasure", "pushbox"),
    num_trials: int = 5,
    num_episodes: int = 1000,
    output: Path = ROOT / "docs" / "novelty.png",
):
    """Train, print a table and draw.

    Args:
        methods: scripts with an exploration bonus
        worlds: worlds to train in
        num_trials: trials of each script
        num_episodes: episodes of each trial
        output: file for the figure
    """
    check_words("script", methods, METHODS)
    check_words("world", worlds, envs.WORLDS)
    for name, number in (("--num-episodes", num_episodes), ("--num-trials", num_trials)):
        envs.check_whole(name, number, minimum=1)
    if not (methods and worlds):
        raise envs.UsageError("--methods and --worlds must name at least one each.")
    check_picture(output)
    for method in methods:
        novelty_class(script(method))
    curves, rows = {}, [["script", "world", "pairs", "1st visit", "10th", "100th", "correlation"]]
    for method in methods:
        for world in worlds:
            args = dict(env=world, num_trials=num_trials, num_episodes=num_episodes)
            bonuses, correlation = bonuses_of_visits(method, args)
            bonuses = bonuses[~np.isnan(bonuses[:, 0])]
            row = [method, world, str(len(bonuses)), *"---"]
            if len(bonuses):
                curves[method, world] = bonuses
                row[3:] = [f"{bonuses[:, n - 1].mean():.2f}" for n in (1, 10, VISITS)]
            rows.append([*row, f"{correlation:+.2f}"])
    draw(curves, worlds, output)
    print(markdown(rows))


if __name__ == "__main__":
    with command_line("novelty.py"):
        tyro.cli(main, description=__doc__)
