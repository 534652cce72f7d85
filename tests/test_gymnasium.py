"""gymnasium's own names for the worlds, and its wrappers around them."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import envs
from tests.helpers import ALGOS, BEST_PLANS, assert_refused

IDS = {name: f"CoopGrid/{world.__name__}-v0" for name, world in envs.WORLDS.items()}


@pytest.mark.parametrize("name", envs.WORLDS)
def test_a_world_by_gymnasiums_name_is_the_same(name):
    env, own = gymnasium.make_vec(IDS[name], num_envs=2, max_steps=30), envs.make_vec(name, num_envs=2, max_steps=30)
    assert type(env) is type(own)
    assert (env.spec.id, env.num_envs, env.world.max_steps) == (IDS[name], 2, 30)
    assert np.array_equal(env.reset()[0], own.reset()[0])
    for joint in BEST_PLANS[name][:30]:
        one, other = (each.step([joint, joint]) for each in (env, own))
        assert all(np.array_equal(*pair) for pair in zip(one[:4], other[:4], strict=True))


def test_impossible_options_are_refused():
    assert_refused("4, 6, 8, 10", gymnasium.make_vec, IDS["pushbox"], size=5)
    with pytest.raises(gymnasium.error.Error):
        gymnasium.make(IDS["pushbox"])  # there is no single environment with one reward for several agents


def test_one_import_is_enough_and_says_nothing():
    made = f"gymnasium.make_vec({IDS['movebox']!r}, num_envs=3)"
    code = f"import sys, gymnasium, envs; print({made}.num_envs, 'torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ALGOS.parent)
    assert (ended.stdout, ended.stderr) == ("3 False\n", "")


def test_tensors():
    torch = pytest.importorskip("torch")
    pytest.importorskip("array_api_compat", reason="gymnasium's NumpyToTorch needs array-api-compat")
    env = gymnasium.wrappers.vector.NumpyToTorch(gymnasium.make_vec(IDS["pushbox"], num_envs=3))
    obs, info = env.reset()
    assert (obs.dtype, info["state"].dtype) == (torch.float32, torch.float32)
    for joint in BEST_PLANS["pushbox"]:
        _, reward, terminated, *_ = env.step(torch.tensor([joint] * 3))
    assert (reward.tolist(), terminated.tolist()) == ([100.0] * 3, [True] * 3)


def test_a_recorded_video(tmp_path):
    pytest.importorskip("moviepy", reason="gymnasium's RecordVideo needs moviepy")
    made = gymnasium.make_vec(IDS["pushbox"], num_envs=2, max_steps=3)
    env = gymnasium.wrappers.vector.RecordVideo(made, str(tmp_path), episode_trigger=lambda episode: True)
    env.reset()
    for _ in range(3):
        env.step(np.full((2, 2), 3))
    env.reset()
    env.close()
    assert list(tmp_path.glob("*.mp4"))


def test_statistics():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(gymnasium.make_vec(IDS["pushbox"], num_envs=2))
    env.reset()
    for joint in BEST_PLANS["pushbox"]:
        *_, info = env.step([joint] * 2)
    assert (info["episode"]["r"].tolist(), info["episode"]["l"].tolist()) == ([100.0] * 2, [4] * 2)
