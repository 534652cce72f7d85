"""The figures of the comparison, each a function of the kept results that returns a matplotlib figure."""

from pathlib import Path

import matplotlib
import numpy as np

import envs
from benchmark import measures
from benchmark.cells import BESIDE, BEYOND, METHODS, OPTIMIZERS, WORLDS, name_of
from benchmark.results import block_of, named_in
from envs.drawing import AGENTS

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.backend_bases import FigureCanvasBase

# The colours of Okabe and Ito, and of Paul Tol, which the colour-blind can tell apart, with dashes; always the same.
COLOURS = {
    **{"pg": "#777777", "epg": "#009e73", "spg": "#e69f00", "espg": "#56b4e9", "decespg": "#0072b2"},
    **{"ac": "#d55e00", "coma": "#cc79a7", "acer": "#b3a100", "dqn": "#000000", "edti": "#882255"},
    **{"decespg_ex2": "#332288", "espg_icm": "#aa4499", "espg_emi": "#44aa99", "gasil": "#117733"},
    # These never stand beside the four before them.
    **{"hysteretic": "#332288", "ippo": "#44aa99", "mappo": "#117733", "qmix": "#aa4499"},
}
OTHERS = ("#8c564b", "#e6194b", "#911eb4", "#7fbf3f")  # of your own scripts
DASHES = {
    "ac": "--",
    "coma": "--",
    "acer": "-.",
    "dqn": "-.",
    "edti": ":",
    "decespg_ex2": "--",
    "espg_icm": "-.",
    "espg_emi": ":",
    "gasil": "-.",
    "hysteretic": "-.",
    "qmix": "--",
    "ippo": "-.",
    "mappo": "--",
}
FIGURES = {
    "figure3": ("pg", "ac", "coma", "acer", "dqn", "edti", "espg", "decespg"),
    "figure4": ("pg", "epg", "spg", "espg", "decespg"),
    "figure6": ("decespg_ex2", "espg_icm", "espg_emi", "gasil", "espg", "decespg"),
    "beyond": (*BESIDE, *BEYOND),
}


def check_picture(path):
    """UsageError unless a figure can be written to the path, which after hours is too late to learn."""
    if path.suffix[1:] not in FigureCanvasBase.filetypes or not path.absolute().parent.is_dir():
        raise envs.UsageError(f"--output must be a picture such as visits.png in a directory that is there, not {path}.")


def colour_of(method):
    """A method's colour; a script of your own has the same of OTHERS in every figure."""
    return COLOURS.get(method) or OTHERS[sum(method.encode()) % len(OTHERS)]


def panels(results, methods, ylabel, draw, worlds=None, xlabel="episode"):
    """A panel for each world and optimiser; draw(axis, world, method, result) draws one method there."""
    there = {world for world, method, _ in results if method in methods}
    worlds = [world for world in worlds or named_in(results)[0] if world in there]
    rows, columns = len(OPTIMIZERS), len(worlds)
    size = (3.4 * columns, 2.6 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, sharey="col")
    for row, optimizer in enumerate(OPTIMIZERS):
        for axis, world in zip(axes[row], worlds, strict=True):
            found = {method: results[world, method, optimizer] for method in methods if (world, method, optimizer) in results}
            axis.set_visible(bool(found))
            for method, result in found.items():
                draw(axis, world, method, result)
            axis.set_title(f"{Path(world).stem}, {optimizer}", fontsize="medium")
            if axis.get_xscale() == "linear":
                axis.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
    figure.supylabel(ylabel, fontsize="medium")
    figure.supxlabel(xlabel, fontsize="medium")
    return with_legend(figure, methods)


def with_legend(figure, methods):
    """Name all curves once, beside the panels."""
    labels = {label: line for axis in figure.axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    names = [name for name in (*(name_of(method) for method in methods), "exact optimum") if name in labels]
    figure.legend([labels[name] for name in names], names, loc="outside right center", frameon=False)
    return figure


def line(axis, method, xs, values, error=None):
    """A curve, with a band of its error."""
    colour = colour_of(method)
    axis.plot(xs, values, DASHES.get(method, "-"), color=colour, label=name_of(method), linewidth=1.3)
    if error is not None:
        axis.fill_between(xs, values - error, values + error, color=colour, alpha=0.2, linewidth=0)


def episodes_of(result):
    """The number of the last episode of each block."""
    return (np.arange(result.score.shape[1]) + 1) * block_of(result.num_episodes)


def optimum_line(axis, world):
    """The exact optimum, under the first curve of a panel."""
    if not axis.lines:
        axis.axhline(measures.optimum(world), color="black", linewidth=0.8, linestyle=":", label="exact optimum")


def learning_curves(results, methods):
    """The paper's Figures 3, 4 and 6: mean and standard error over trials, the exact optimum as a line."""

    def draw(axis, world, method, result):
        optimum_line(axis, world)
        line(axis, method, episodes_of(result), *measures.mean_and_error(result.score))

    return panels(results, methods, "reward per step (mean of a block of episodes)", draw)


def curves_over_steps(results, methods):
    """The same over environment steps; a trial whose episodes are over keeps its last value, so that all count everywhere."""

    def draw(axis, world, method, result):
        optimum_line(axis, world)
        steps = np.geomspace(result.steps[:, 0].max(), result.steps[:, -1].max(), 200)
        scores = [np.interp(steps, *trial) for trial in zip(result.steps, result.score, strict=True)]
        axis.set_xscale("log")
        line(axis, method, steps, *measures.mean_and_error(np.array(scores)))

    return panels(results, methods, "reward per step", draw, xlabel="environment steps of a trial")


def share_at_best(results, methods):
    """The share of the trials that end most episodes of a block in the best outcome."""

    def draw(axis, world, method, result):
        line(axis, method, episodes_of(result), measures.at_best_outcome(result).mean(0))
        axis.set_ylim(-0.03, 1.03)

    worlds = [world for world in named_in(results)[0] if envs.make_world(world).outcome_names]
    return panels(results, methods, "share of trials at the best outcome", draw, worlds)


def performance_profiles(profiles, shares):
    """The share of all trials, over worlds, that reach a share of the optimum; {optimiser: {method: (share, low, high)}}."""
    figure, axes = plt.subplots(1, len(profiles), figsize=(4.6 * len(profiles), 3.4), layout="constrained", squeeze=False)
    for axis, (optimizer, found) in zip(axes[0], profiles.items(), strict=True):
        for method, (value, low, high) in found.items():
            line(axis, method, shares, value)
            axis.fill_between(shares, low, high, color=colour_of(method), alpha=0.12, linewidth=0)
        axis.set_title(optimizer, fontsize="medium")
        axis.grid(alpha=0.3)
    figure.supxlabel("reward per step / optimum, at least", fontsize="medium")
    figure.supylabel("share of trials", fontsize="medium")
    return with_legend(figure, METHODS)


def intervals(estimates, xlabel):
    """Points with 95 % intervals; estimates are {optimiser: {method: (value, low, high)}}."""
    rows = max(map(len, estimates.values()))
    size = (4.2 * len(estimates), 0.9 + 0.28 * rows)
    figure, axes = plt.subplots(1, len(estimates), figsize=size, layout="constrained", squeeze=False, sharex=True)
    for axis, (optimizer, found) in zip(axes[0], estimates.items(), strict=True):
        for row, (method, (value, low, high)) in enumerate(found.items()):
            axis.plot([low, high], [row, row], color=colour_of(method), linewidth=6, alpha=0.4, solid_capstyle="butt")
            axis.plot([value], [row], "|", color=colour_of(method), markersize=11, markeredgewidth=2.5)
        axis.set_yticks(range(len(found)), [name_of(method) for method in found])
        axis.invert_yaxis()
        axis.grid(axis="x", alpha=0.3)
        axis.set_title(optimizer, fontsize="medium")
    figure.supxlabel(xlabel, fontsize="medium")
    return figure


def episode_states(world, actions):
    """The states [T + 1, state_dim] of an episode of joint actions [T, num_agents]."""
    states = [world.start.copy()]
    for joint in actions:
        states.append(states[-1].copy())
        world.step(world.rules, states[-1], np.asarray(joint, np.int64))
    return states


def trajectories(results, methods=("pg", "decespg"), optimizer="sign"):
    """The paper's Figure 5: the ways of two methods' trained teams, on the picture of the world as it is at the end."""
    worlds = [world for world in WORLDS if all((r := results.get((world, m, optimizer))) and len(r.actions) for m in methods)]
    figure, axes = plt.subplots(len(methods), len(worlds), figsize=(2.6 * len(worlds), 6), layout="constrained", squeeze=False)
    for column, name in enumerate(worlds):
        world = envs.make_world(name)
        for axis, method in zip(axes[:, column], methods, strict=True):
            states = episode_states(world, results[name, method, optimizer].actions)
            axis.imshow(envs.draw(world, states[-1], cell=24))
            for i in range(world.num_agents):
                draw_way(axis, [agent_places(world, state)[i] for state in states], AGENTS[i], i / world.num_agents)
            axis.set_title(f"{name}\n{name_of(method)}, {len(states) - 1} steps", fontsize="medium")
            axis.set_axis_off()
    return figure


def agent_places(world, state):
    """(row, column) of every agent."""
    _, _, shapes = world.sketch(state)
    return {shape[1]: shape[2:4] for shape in shapes if shape[0] == "agent"}


def draw_way(axis, places, colour, shift, cell=24):
    """One agent's way from a ring at its start; ways are drawn beside each other, `shift` in cells from the middle."""
    rows, columns = (np.array(axis_places) for axis_places in zip(*places, strict=True))
    x, y = ((values + 0.35 + 0.5 * shift) * cell for values in (columns, rows))
    axis.plot(x, y, color=colour, linewidth=1.6, alpha=0.8)
    axis.plot(x[:1], y[:1], "o", color=colour, markersize=7, markerfacecolor="white", markeredgewidth=1.6)
