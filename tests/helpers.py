"""What the tests of several worlds share: recorded episodes, agents placed by hand, random play."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import strategies as st

import envs

RECORDED = json.loads((Path(__file__).parent / "data" / "trajectories.json").read_text())
# The shortest way to the best outcome, a list of joint actions.
BEST_PLANS = {
    "findtreasure": [(3, 3), (3, 3), (3, 3), (4, 3), (0, 4), (0, 4), (0, 4), (3, 4)],
    "pushbox": [(0, 0), (1, 2), (0, 0), (0, 0)],
}


def play(world, state, *actions):
    """Play joint `actions` from the integers `state`; returns the state then, and reward and outcome of the last step."""
    state = np.array(state)
    for joint in actions:
        reward, outcome = world.step(world.rules, state, np.array(joint))
    return state.tolist(), pytest.approx(reward, abs=1e-9), outcome


def look(world, state):
    """What the agents see in `state`, a list for each agent."""
    obs = np.full((world.num_agents, world.obs_dim), np.nan, np.float32)
    world.observe(world.rules, world.cell, np.array(state), obs)
    return obs.tolist()


def whole_state(env, info):
    """The integer states of all copies, [num_envs, state_dim], from the scaled ones that `info` tells."""
    return np.rint(info["state"] / env.world.state_scale).astype(int)


class Step(NamedTuple):
    """One step of a vector environment: the integer states [num_envs, state_dim] before and after it, and what it returned."""

    before: np.ndarray
    after: np.ndarray
    obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict


def walk(env, actions):
    """Reset and play `actions`, each [num_envs, num_agents] or one [num_agents] for all copies; yields every `Step`."""
    _, info = env.reset()
    for joint in actions:
        before = whole_state(env, info)
        *returned, info = env.step(np.array(np.broadcast_to(joint, (env.num_envs, env.world.num_agents))))
        yield Step(before, whole_state(env, info), *returned, info)


def random_play(num_actions, num_envs=1, longest=60):
    """Hypothesis: a list of up to `longest` joint actions of two agents in `num_envs` copies, [num_envs, 2] each."""
    joint = st.tuples(*[st.integers(0, num_actions - 1)] * 2)
    return st.lists(st.tuples(*[joint] * num_envs), min_size=1, max_size=longest)


def assert_replays(recording, to_state, **options):
    """All recorded episodes of tests/data/trajectories.json under the key `recording` go the same way, step by step.

    to_state: turns the positions of the file into the world's integer state
    """
    env = envs.make_vec(recording.rstrip("0123456789"), **options)
    episodes = RECORDED[recording]["episodes"]
    assert len(episodes) == 40
    for episode in episodes:
        steps = list(walk(env, episode["actions"]))
        assert [step.after[0].tolist() for step in steps] == [to_state(positions) for positions in episode["positions"]]
        assert [step.reward[0] for step in steps] == pytest.approx(episode["rewards"], abs=1e-9)
        assert [step.terminated[0] for step in steps] == [False] * (len(steps) - 1) + [episode["done"]]
        assert not any(step.truncated[0] for step in steps)
        if "observations" in episode:
            assert [step.obs[0].tolist() for step in steps] == episode["observations"]


def assert_refused(accepted, make, *args, **options):
    """`make` refuses `options` by a UsageError of one sentence that names what is `accepted`."""
    with pytest.raises(envs.UsageError) as error:
        make(*args, **options)
    message = str(error.value)
    assert accepted in message
    assert message.endswith(".")
    assert "\n" not in message
    assert ". " not in message
