"""Where do teams go while they explore? The visits of each cell in the first episodes, drawn on each world.

python benchmark/visits.py                           # some minutes; draws docs/visits.png
python benchmark/visits.py --methods pg spg decespg --worlds movebox --num-episodes 2000 --output movebox.png
"""

import sys
from pathlib import Path
from typing import Literal
from unittest.mock import patch

import numpy as np
import tyro
from matplotlib.colors import LogNorm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from matplotlib import pyplot as plt

import envs
from benchmark.cells import BEYOND, METHODS, ROOT, WORLDS, check_words, name_of, script, takes_optimizer, train_aside
from benchmark.figures import agent_places, check_picture
from envs.command import command_line

CELL = 24  # pixels


def visits(method, world, optimizer, num_episodes, num_trials):
    """Train; returns how often each agent was at each place, in the state's coordinates, [num_agents, size, size]."""
    module = script(method)
    counts = np.zeros((world.num_agents, world.size, world.size), np.int64)

    class Watched(module.Rollout):
        def play(self, *args):
            super().play(*args)
            places = self.local_state[:-1, :, :, :2][self.played]  # [steps of all trials, num_agents, 2]
            for agent, where in enumerate(places.transpose(1, 2, 0)):
                np.add.at(counts[agent], tuple(where), 1)

    args = dict(env=world.name, num_trials=num_trials, num_episodes=num_episodes)
    args |= dict(optimizer=optimizer) if takes_optimizer(method) else {}
    with patch.object(module, "Rollout", Watched):
        train_aside(module, **args)
    return counts


def on_picture(world, counts):
    """The visits of all agents together, [rows, columns] of the world's picture."""
    rows, columns, _ = world.sketch(world.start)
    shown = np.zeros((rows, columns))
    for agent, *place in np.argwhere(counts):
        state = world.start.copy()
        state[world.local_index[agent, :2]] = place
        shown[agent_places(world, state)[agent]] += counts[agent, *place]
    return shown


def draw(found, path):
    """A row for each method, a column for each world; found is {(method, world): visits per trial, on the picture}."""
    methods, worlds = (list(dict.fromkeys(key[place] for key in found)) for place in (0, 1))
    size = (3.1 * len(worlds), 3.2 * len(methods))
    figure, axes = plt.subplots(len(methods), len(worlds), figsize=size, layout="constrained", squeeze=False)
    for column, name in enumerate(worlds):
        world, most = envs.make_world(name), max(found[method, name].max() for method in methods)
        for axis, method in zip(axes[:, column], methods, strict=True):
            shown = found[method, name]
            axis.imshow(envs.draw(world, world.start, cell=CELL))
            heat = np.ma.masked_equal(shown, 0).repeat(CELL, 0).repeat(CELL, 1)
            image = axis.imshow(heat, cmap="plasma", norm=LogNorm(max(most / 1e4, 0.05), most), alpha=0.85)
            axis.set_title(f"{name}, {name_of(method)}", fontsize="medium")
            axis.set_axis_off()
        figure.colorbar(image, ax=axes[:, column], location="bottom", shrink=0.8, label="visits in a trial")
    figure.savefig(path, dpi=110)


def main(
    methods: tuple[str, ...] = ("pg", "decespg"),
    worlds: tuple[str, ...] = WORLDS,
    optimizer: Literal["sign", "adam"] = "sign",
    num_episodes: int = 500,
    num_trials: int = 20,
    output: Path = ROOT / "docs" / "visits.png",
):
    """Train, count and draw.

    Args:
        methods: scripts of algos/ without .py
        worlds: worlds to train in
        optimizer: of the policies
        num_episodes: episodes of each trial
        num_trials: trials of each script
        output: the picture
    """
    check_words("script", methods, METHODS | BEYOND)
    check_words("world", worlds, envs.WORLDS)
    for name, number in (("--num-episodes", num_episodes), ("--num-trials", num_trials)):
        envs.check_whole(name, number, minimum=1)
    if not (methods and worlds):
        raise envs.UsageError("--methods and --worlds must name at least one each.")
    check_picture(output)
    found = {}
    for method in methods:
        for name in worlds:
            world = envs.make_world(name)
            shown = on_picture(world, visits(method, world, optimizer, num_episodes, num_trials))
            found[method, name] = shown / num_trials
            print(f"{name}, {name_of(method)}: {np.count_nonzero(shown)} cells visited, {int(shown.sum())} visits")
    draw(found, output)


if __name__ == "__main__":
    with command_line("visits.py"):
        tyro.cli(main, description=__doc__)
