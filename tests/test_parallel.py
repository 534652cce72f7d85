"""The PettingZoo environments: its own tests, the same episodes as the vector environment, determinism, refused actions."""

import pickle

import cloudpickle
import matplotlib
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test, parallel_seed_test, render_test
from pettingzoo.utils.conversions import parallel_to_aec

import envs
from tests.helpers import BEST_PLANS, RACE, assert_refused, walk

each_world = pytest.mark.parametrize("name", envs.WORLDS)


@pytest.mark.parametrize("name", [*envs.WORLDS, str(RACE)])
@pytest.mark.filterwarnings("error")
def test_pettingzoos_api_test(name):
    parallel_api_test(envs.make(name, max_steps=150), num_cycles=400)


@each_world
def test_pettingzoos_seed_test(name):
    parallel_seed_test(lambda: envs.make(name, max_steps=150))


@each_world
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_pettingzoos_render_test(name):
    matplotlib.use("agg")
    render_test(lambda render_mode: parallel_to_aec(envs.make(name, render_mode=render_mode)))


@each_world
def test_50_steps_go_the_same_way_twice(name):
    def record(seed):
        env, steps = envs.make(name), []
        steps.append(env.reset(seed=seed))
        for agent in env.possible_agents:
            env.action_space(agent).seed(7)
        for _ in range(50):
            if not env.agents:
                steps.append(env.reset())
            steps.append(env.step({agent: env.action_space(agent).sample() for agent in env.agents}))
            steps.append(env.state())
        return pickle.dumps(steps)

    assert record(seed=1) == record(seed=1) == record(seed=2)


@each_world
def test_it_is_the_same_world_as_the_vector_environments(name):
    env, vec = envs.make(name), envs.make_vec(name)
    assert isinstance(env, ParallelEnv)
    obs, infos = env.reset()
    first, info = vec.reset()
    assert np.array_equal(np.stack(list(obs.values())), first[0])
    assert np.array_equal(env.state(), info["state"][0])
    assert infos == {agent: {"outcome": 0} for agent in env.possible_agents}
    for joint, step in zip(BEST_PLANS[name], walk(vec, BEST_PLANS[name]), strict=True):
        agents = env.agents
        obs, rewards, terminations, truncations, infos = env.step(dict(zip(agents, joint, strict=True)))
        assert np.array_equal(np.stack([obs[agent] for agent in agents]), step.obs[0])
        assert np.array_equal(env.state(), step.info["state"][0])
        assert rewards == dict.fromkeys(agents, step.reward[0])
        assert terminations == dict.fromkeys(agents, step.terminated[0])
        assert truncations == dict.fromkeys(agents, step.truncated[0])
        assert infos == {agent: {"outcome": step.info["outcome"][0]} for agent in agents}
    assert env.agents == []


@each_world
def test_spaces(name):
    env = envs.make(name)
    obs, _ = env.reset()
    assert env.possible_agents == ["agent_0", "agent_1"]
    for agent in env.agents:
        assert obs[agent] in env.observation_space(agent)
        assert env.action_space(agent).n == env.world.num_actions
    assert env.state() in env.state_space


def test_the_number_of_agents_is_the_worlds():
    env = envs.make("cleaner", num_agents=3)
    env.reset()
    assert env.agents == ["agent_0", "agent_1", "agent_2"]
    _, rewards, *_ = env.step({"agent_2": 3, "agent_0": 3, "agent_1": 1})
    assert rewards == dict.fromkeys(env.agents, 2.0)
    assert (env.state()[:6] * 13).round().tolist() == [1, 2, 2, 1, 1, 2]


def test_returned_arrays_never_change():
    env = envs.make("findtreasure")
    obs, _ = env.reset()
    state, kept = env.state(), obs["agent_0"].copy()
    before = state.copy()
    env.step({"agent_0": 3, "agent_1": 3})
    assert np.array_equal(obs["agent_0"], kept)
    assert np.array_equal(state, before)


def test_pictures_and_maps():
    env = envs.make("pushbox", render_mode="rgb_array")
    env.reset()
    assert np.array_equal(env.render(), envs.draw(env.world, env.world.start))
    env = envs.make("pushbox", render_mode="ansi")
    env.reset()
    assert env.render() == "\n".join(
        [
            "+--------+",
            "|gggggggg|",
            "|ssBBBBss|",
            "|        |",
            "|0>    1<|",
            "+--------+",
            "0 1 agents, g goal, s small box, B large box",
        ]
    )


def test_a_copy_that_went_through_pickle_plays_on():
    env = envs.make("cleaner")
    env.reset()
    env.step({"agent_0": 3, "agent_1": 1})
    copy = cloudpickle.loads(cloudpickle.dumps(env))
    for one in (env, copy):
        one.step({"agent_0": 3, "agent_1": 1})
    assert np.array_equal(env.state(), copy.state())


@pytest.mark.parametrize("action", [-1, 4, 1.0, "up", None, True, np.True_])
def test_impossible_actions_are_refused(action):
    env = envs.make("cleaner")
    env.reset()
    with pytest.raises(ValueError, match="agent_1's action must be a whole number from 0 to 3, not"):
        env.step({"agent_0": 0, "agent_1": action})


def test_missing_and_surplus_actions_are_refused():
    env = envs.make("cleaner")
    with pytest.raises(ValueError, match="no episode is under way"):
        env.step({"agent_0": 0, "agent_1": 0})
    env.reset()
    with pytest.raises(ValueError, match="must be of agent_0, agent_1, not of agent_0"):
        env.step({"agent_0": 0})
    with pytest.raises(ValueError, match="not of nobody"):
        env.step({})
    with pytest.raises(ValueError, match="not of agent_0, agent_1, agent_2"):
        env.step({"agent_0": 0, "agent_1": 0, "agent_2": 0})


def test_impossible_environments_are_refused():
    assert_refused("'rgb_array', 'ansi', 'human'", envs.make, "pushbox", render_mode="film")
    assert_refused("cleaner, findtreasure", envs.make, "treasure")
    assert_refused("4, 6, 8, 10", envs.make, "pushbox", size=5)
