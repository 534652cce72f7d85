"""The vector environment: gymnasium's api, ends, resets, arrays that never change, refused actions, no stale rules."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.base import compile_batch
from tests.helpers import BEST_PLANS, assert_refused, random_play, walk, whole_state

each_world = pytest.mark.parametrize("name", envs.WORLDS)


@each_world
def test_spaces_shapes_and_types(name):
    env = envs.make_vec(name, num_envs=3)
    world = env.world
    assert isinstance(env, gymnasium.vector.VectorEnv)
    assert env.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    assert env.single_observation_space.shape == (world.num_agents, world.obs_dim)
    assert env.single_action_space.nvec.tolist() == [world.num_actions] * world.num_agents
    obs, info = env.reset(seed=0)
    assert obs in env.observation_space
    env.action_space.seed(0)
    for _ in range(20):
        actions = env.action_space.sample()
        assert actions.shape == (3, world.num_agents)
        obs, reward, terminated, truncated, info = env.step(actions)
        assert obs in env.observation_space
        assert all(one in env.single_observation_space for one in obs)
        seen = {"obs": obs, "reward": reward, "terminated": terminated, "truncated": truncated, **info}
        assert {key: (value.dtype, value.shape) for key, value in seen.items()} == {
            "obs": (np.float32, (3, world.num_agents, world.obs_dim)),
            "reward": (np.float64, (3,)),
            "terminated": (np.bool_, (3,)),
            "truncated": (np.bool_, (3,)),
            "outcome": (np.int64, (3,)),
            "state": (np.float32, (3, len(world.start))),
            "local_state": (np.int64, (3, *world.local_index.shape)),
        }


@each_world
def test_state_and_local_state_are_the_worlds_state(name):
    env = envs.make_vec(name)
    _, info = env.reset()
    assert whole_state(env, info)[0].tolist() == env.world.start.tolist()
    assert info["local_state"][0].tolist() == env.world.start[env.world.local_index].tolist()
    assert info["state"].min() >= 0
    assert info["state"].max() <= 1


@given(after=random_play(5, longest=10))
def test_an_ended_copy_stays_still(after):
    steps = list(walk(envs.make_vec("findtreasure", max_steps=12), BEST_PLANS["findtreasure"] + after))
    assert [step.reward[0] for step in steps] == [0.0] * 7 + [100.0] + [0.0] * len(after)
    assert [step.terminated[0] for step in steps] == [False] * 7 + [True] * (1 + len(after))
    assert not any(step.truncated[0] for step in steps)
    assert [step.info["outcome"][0] for step in steps] == [0] * 7 + [1] * (1 + len(after))
    assert all(step.after.tolist() == [[1, 5, 5, 5]] for step in steps[7:])


@each_world
@given(data=st.data())
def test_the_time_limit_cuts_what_has_not_ended(name, data):
    env = envs.make_vec(name, num_envs=2, max_steps=6)
    actions = data.draw(random_play(env.world.num_actions, num_envs=2, longest=9))
    for t, step in enumerate(walk(env, actions), start=1):
        assert not np.any(step.terminated & step.truncated)
        assert step.terminated.tolist() == (step.info["outcome"] > 0).tolist()
        assert step.truncated.tolist() == (~step.terminated & (t >= 6)).tolist()
        if t > 6:
            assert step.reward.tolist() == [0, 0]
            assert step.after.tolist() == step.before.tolist()


def test_an_end_in_the_last_possible_step_is_no_cut():
    steps = list(walk(envs.make_vec("findtreasure", max_steps=8), BEST_PLANS["findtreasure"]))
    assert steps[-1].terminated.tolist() == [True]
    assert steps[-1].truncated.tolist() == [False]


@each_world
@given(data=st.data())
def test_copies_do_not_see_each_other(name, data):
    actions = data.draw(random_play(len(envs.WORLDS[name].action_names), num_envs=3, longest=20))
    together = list(walk(envs.make_vec(name, num_envs=3), actions))
    for e in range(3):
        alone = list(walk(envs.make_vec(name), [joint[e : e + 1] for joint in actions]))
        assert [step.after[e].tolist() for step in together] == [step.after[0].tolist() for step in alone]
        assert [step.reward[e] for step in together] == [step.reward[0] for step in alone]
        assert [step.obs[e].tolist() for step in together] == [step.obs[0].tolist() for step in alone]


def test_reset_mask_resets_only_what_it_says():
    env = envs.make_vec("pushbox", num_envs=3, max_steps=5)
    *_, last = walk(env, BEST_PLANS["pushbox"])
    assert last.terminated.tolist() == [True] * 3
    _, info = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert info["outcome"].tolist() == [4, 0, 4]
    assert whole_state(env, info).tolist() == [last.after[0].tolist(), env.world.start.tolist(), last.after[2].tolist()]
    for t in range(1, 6):  # the clock of the copy that was reset starts anew as well
        _, _, terminated, truncated, _ = env.step(np.full((3, 2), 3))
        assert terminated.tolist() == [True, False, True]
        assert truncated.tolist() == [False, t == 5, False]
    _, info = env.reset()
    assert info["outcome"].tolist() == [0, 0, 0]


@each_world
def test_returned_arrays_never_change(name):
    env = envs.make_vec(name, num_envs=2)
    obs, info = env.reset()
    kept = [(array, array.copy()) for array in (obs, *info.values())]
    for _ in range(2):  # to the end, and again after a reset
        for step in walk(env, BEST_PLANS[name]):
            returned = (step.obs, step.reward, step.terminated, step.truncated, *step.info.values())
            kept += [(array, array.copy()) for array in returned]
    assert all(np.array_equal(now, then) for now, then in kept)


@each_world
@pytest.mark.parametrize("place", [(0, 0), (1, 1)])
def test_impossible_actions_are_refused(name, place):
    env = envs.make_vec(name, num_envs=2)
    env.reset()
    for wrong in (-1, env.world.num_actions):
        actions = np.zeros((2, 2), np.int64)
        actions[place] = wrong
        with pytest.raises(ValueError, match="action"):
            env.step(actions)


def unaligned(actions):
    """The same numbers at an odd address."""
    return np.frombuffer(b"\0" + actions.astype(np.int64).tobytes(), np.uint8)[1:].view(np.int64).reshape(actions.shape)


@pytest.mark.parametrize(
    "kind",
    [
        lambda actions: actions.tolist(),
        lambda actions: actions.astype(np.int8),
        lambda actions: actions.astype(np.uint64),
        lambda actions: actions.astype(">i8"),
        np.asfortranarray,
        lambda actions: np.repeat(actions, 2, axis=1)[:, ::2],
        lambda actions: np.broadcast_to(actions, actions.shape),  # read-only
        unaligned,
    ],
)
def test_actions_of_any_type_and_layout_need_no_new_compilation(kind):
    env, plain = (envs.make_vec("pushbox", num_envs=2) for _ in range(2))
    _, advance = compile_batch(env.world.step, env.world.observe)
    env.reset(), plain.reset()
    for joint in BEST_PLANS["pushbox"]:
        actions = np.array([joint, joint[::-1]])
        expected = plain.step(actions)
        compiled = len(advance.signatures)
        assert np.array_equal(env.step(kind(actions))[1], expected[1])
        assert len(advance.signatures) == compiled


@pytest.mark.parametrize(
    "wrong", [[[True, False]] * 2, np.zeros((2, 2)), [["0", "1"]] * 2, [[0, 0]], 0, None, [[0, 2**70]] * 2]
)
def test_what_is_no_joint_action_is_refused(wrong):
    env = envs.make_vec("pushbox", num_envs=2)
    env.reset()
    with pytest.raises(ValueError, match="actions must be whole numbers of shape"):
        env.step(wrong)
    with pytest.raises(ValueError, match="between 0 and 3"):
        env.step(np.full((2, 2), 2**64 - 1, np.uint64))


def test_nothing_is_played_before_the_first_reset():
    env = envs.make_vec("pushbox")
    with pytest.raises(ValueError, match="no episode is under way"):
        env.step([[0, 0]])


@pytest.mark.parametrize("seed", ["a", True, 1.5, -1, [1, 2]])
def test_a_seed_is_a_whole_number(seed):
    for env in (envs.make_vec("pushbox"), envs.make("pushbox")):
        assert_refused("seed must be a whole number of at least 0", env.reset, seed=seed)
        env.reset(seed=np.int64(3))


def test_an_unknown_option_of_reset_is_refused():
    with pytest.raises(ValueError, match="reset has no option 'reset_masks'"):
        envs.make_vec("pushbox").reset(options={"reset_masks": np.array([True])})
    with pytest.raises(ValueError, match="reset_mask must be booleans"):
        envs.make_vec("pushbox", num_envs=2).reset(options={"reset_mask": [1, 0]})


def test_impossible_environments_are_refused():
    assert_refused("such as 'pushbox'", envs.make_vec, ["pushbox"])
    assert_refused("between 1 and 9223372036854775807", envs.make_vec, "pushbox", num_envs=10**30)
    assert_refused("GB of memory, and this machine has", envs.make_vec, "pushbox", num_envs=10**9)
    assert_refused("there is no file", envs.make_vec, "long" * 100 + ".py")
    assert envs.make_vec("pushbox", num_envs=np.int8(2), size=np.int64(6)).num_envs == 2
    assert_refused("cleaner, findtreasure, gotogether, movebox, pushbox", envs.make_vec, "treasure")
    assert_refused("at least 1", envs.make_vec, "pushbox", num_envs=0)
    assert_refused("option=value", envs.parse_options, ["size"])


def test_options_of_the_command_line():
    words = ["size=9", "observation=own", "step_penalty=0.1"]
    assert envs.parse_options(words) == {"size": 9, "observation": "own", "step_penalty": 0.1}


def test_an_edited_world_shows_at_once(tmp_path):
    """numba's caches of the first run must not bring the old rules back."""
    source = Path(envs.__file__).parent
    shutil.copytree(source, tmp_path / "envs", ignore=shutil.ignore_patterns("__pycache__"))
    script = f"""
import numpy, envs
env = envs.make_vec("findtreasure")
env.reset()
print([float(env.step(numpy.array([joint]))[1][0]) for joint in {BEST_PLANS["findtreasure"]}][-1])
print(envs.optimum("findtreasure").best_return.total)
rollout = envs.Rollout(env.world, 20)
generators = [numpy.random.default_rng(seed) for seed in range(20)]
rollout.play([numpy.zeros(shape, numpy.float32) for shape in ((40, 4, 5), (40, 1, 5))], generators)
print(float(rollout.reward.max()))
"""

    def run():
        environ = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
        command = [sys.executable, "-c", script]
        return subprocess.run(command, cwd=tmp_path, env=environ, check=True, capture_output=True, text=True).stdout.split()

    assert run() == ["100.0"] * 3
    world = tmp_path / "envs" / "findtreasure.py"
    text = world.read_text(encoding="utf-8")
    assert text.count("TREASURE_REWARD, MEETING_REWARD, BUMP_REWARD = 100.0,") == 1
    world.write_text(text.replace("BUMP_REWARD = 100.0,", "BUMP_REWARD = 70.0,"))
    assert run() == ["70.0"] * 3
