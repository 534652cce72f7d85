"""Cooperative gridworlds for exploration research, how episodes are played in them, and the statistics of their episodes.

    env = envs.make_vec("pushbox", num_envs=20)          # a gymnasium.vector.VectorEnv
    env = envs.make("pushbox", render_mode="ansi")       # a PettingZoo ParallelEnv
    rollout = envs.Rollout(world, num_trials=20)         # whole episodes, compiled
    print(envs.optimum("findtreasure"))                  # the exact optimum, by search
    envs.optimal_plan(world)                             # how to play it: the joint actions, step by step
    envs.draw(world, world.start)                        # a picture; envs.save_gif makes a film of several
    env = gymnasium.make_vec("CoopGrid/PushBox-v0", num_envs=20)    # as envs.make_vec("pushbox", num_envs=20)

`envs.WORLDS` has the worlds by name; each one's module is its documentation. Wherever a name is asked for, a file with a world
of your own will do: `python -m envs my_world.py` plays it in a terminal, as `python -m envs pushbox` does.
"""

import gymnasium

from envs.base import (
    PositionWorld,
    UsageError,
    World,
    check_choice,
    check_memory,
    check_number,
    check_whole,
    kernel,
    plain,
    rule,
)
from envs.drawing import draw, save_gif
from envs.files import complete_file
from envs.parallel import GridParallelEnv
from envs.rollout import Rollout, distinct_rows, epsilon_greedy, in_every_step, softmax
from envs.search import Optimum, find_optimum, optimal_plan
from envs.statistics import EpisodeLog, last_episodes, reward_per_step
from envs.vector import GridVectorEnv
from envs.worlds import WORLDS, make_world, parse_options

for _world in WORLDS.values():
    _id = f"CoopGrid/{_world.__name__}-v0"
    if _id not in gymnasium.registry:  # which warns of a second time
        gymnasium.register(_id, vector_entry_point="envs:make_vec", kwargs={"name": _world.name})


def make_vec(name: str, num_envs: int = 1, **options) -> GridVectorEnv:
    """`num_envs` copies of the world `name`, as a `gymnasium.vector.VectorEnv`; see `GridVectorEnv`."""
    return GridVectorEnv(make_world(name, **options), num_envs)


def make(name: str, render_mode: str | None = None, **options) -> GridParallelEnv:
    """The world `name` as a PettingZoo `ParallelEnv`; see `GridParallelEnv`."""
    return GridParallelEnv(make_world(name, **options), render_mode)


def optimum(name: str, **options) -> Optimum:
    """The exact optimum of the world `name`, by search over its rules (of cleaner, a constructed one); see `envs.search`."""
    return find_optimum(make_world(name, **options))
