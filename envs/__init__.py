"""Cooperative gridworlds for exploration research, and the statistics of their episodes.

    env = envs.make_vec("pushbox", num_envs=20)          # a gymnasium.vector.VectorEnv
    env = envs.make("pushbox", render_mode="ansi")       # a PettingZoo ParallelEnv
    print(envs.optimum("findtreasure"))                  # the exact optimum, by search
    envs.draw(env.world, env.world.start)                # a picture; envs.save_gif makes a film of several

`envs.WORLDS` has the worlds by name; each one's module is its documentation. `python -m envs pushbox` plays one in a terminal.
"""

import ast
import inspect

from envs.base import UsageError, World, check_number, check_whole
from envs.cleaner import Cleaner
from envs.drawing import draw, save_gif
from envs.files import complete_file
from envs.findtreasure import FindTreasure
from envs.gotogether import GoTogether
from envs.movebox import MoveBox
from envs.parallel import GridParallelEnv
from envs.pushbox import PushBox
from envs.search import Optimum, find_optimum
from envs.statistics import EpisodeLog, reward_per_step
from envs.vector import GridVectorEnv

WORLDS = {world.name: world for world in (Cleaner, FindTreasure, GoTogether, MoveBox, PushBox)}


def make_world(name: str, **options) -> World:
    """The world `name` with its options; UsageError for an unknown world or option, or an impossible value."""
    if name not in WORLDS:
        raise UsageError(f"there is no world {name!r}; the worlds are {', '.join(WORLDS)}.")
    accepted = list(inspect.signature(WORLDS[name]).parameters)
    for option in options:
        if option not in accepted:
            raise UsageError(f"{name} has no option {option!r}; it takes {', '.join(accepted)}.")
    return WORLDS[name](**options)


def make_vec(name: str, num_envs: int = 1, **options) -> GridVectorEnv:
    """`num_envs` copies of the world `name`, as a `gymnasium.vector.VectorEnv`; see `GridVectorEnv`."""
    return GridVectorEnv(make_world(name, **options), num_envs)


def make(name: str, render_mode: str | None = None, **options) -> GridParallelEnv:
    """The world `name` as a PettingZoo `ParallelEnv`; see `GridParallelEnv`."""
    return GridParallelEnv(make_world(name, **options), render_mode)


def optimum(name: str, **options) -> Optimum:
    """The exact optimum of the world `name`, by search over its rules (of cleaner, a constructed one); see `envs.search`."""
    return find_optimum(make_world(name, **options))


def parse_options(words) -> dict:
    """Options from the command line: ["size=9", "observation=own"] -> {"size": 9, "observation": "own"}."""
    options = {}
    for word in words:
        option, equals, value = word.partition("=")
        if not (option and equals and value):
            raise UsageError(f"a world's option is written option=value, not {word!r}.")
        try:
            options[option] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            options[option] = value
    return options
