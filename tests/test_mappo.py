"""MAPPO: what its critics see, which is all that it has beside IPPO; tests/test_ippo.py tests both."""

import numpy as np
import pytest

import envs
from algos import ippo, mappo
from tests.helpers import assert_same_episodes, look, record_rollouts, train, use_double_precision, weights


def test_critics_tell_states_apart_that_look_the_same_to_an_agent():
    """In pushbox both agents face an empty cell wherever the first one stands."""
    world = envs.make_world("pushbox")
    states = np.array([[0, 0, 1, 3, 0, 3, 2, 2, 2], [0, 1, 1, 3, 0, 3, 2, 2, 2]])
    obs = np.array([look(world, state) for state in states], np.float32)
    assert np.array_equal(*obs)
    for module, apart in ((mappo, True), (ippo, False)):
        team = module.build(module.Args(hidden=(64, 32), num_episodes=1), world, [np.random.default_rng(0)])
        team.batch.obs[:2, 0], team.batch.count[:] = obs, 2
        if module is mappo:
            team.batch.global_state[:2, 0] = states * world.state_scale
        values = team.critic(module.seen_by_critics(team.batch)[:2, 0].transpose(1, 0, 2)).detach()  # [num_agents, 2, 1]
        assert ((values[:, 0] - values[:, 1]).abs() > 1e-4).all() == apart


def test_critics_see_the_state_and_then_their_own_agents_observation(tmp_path, monkeypatch):
    rollouts = record_rollouts(mappo, monkeypatch)
    trained = train(mappo, tmp_path, env="pushbox", num_trials=3, num_episodes=4, max_steps=12, episodes_per_update=5)
    seen, scale = mappo.seen_by_critics(trained.batch), trained.log.world.state_scale
    for k in range(3):
        for i in range(2):
            expected = [
                np.concatenate([rollout.states[t, k] * scale, rollout.all_obs[t, k, i]])
                for rollout in rollouts
                for t in range(rollout.lengths[k] + 1)
            ]
            assert np.array_equal(seen[: len(expected), k, i], np.array(expected, np.float32))
            assert trained.batch.count[k] == len(expected)


@pytest.mark.parametrize("game", ["climbing", "penalty"])
def test_where_there_is_nothing_but_the_observation_it_is_ippo(game, tmp_path, monkeypatch):
    """The state of a one-shot game is 0 before its only step, so its weights neither say nor learn anything."""
    for module in (ippo, mappo):
        use_double_precision(module, monkeypatch)
    build = mappo.build

    def build_with_ippos_critics(*args):
        team, fresh = build(*args), [np.random.default_rng(np.random.SeedSequence(5 + k).spawn(3)[0]) for k in range(2)]
        first, *others = ippo.build(*args[:2], fresh).critic.params
        team.critic.params[0].data[:, 2:] = first.data
        for param, other in zip(team.critic.params[1:], others, strict=True):
            param.data.copy_(other.data)
        return team

    monkeypatch.setattr(mappo, "build", build_with_ippos_critics)
    args = dict(env="climbing", env_args=(f"game={game}",), seed=5, num_trials=2, num_episodes=200)
    one, other = train(ippo, tmp_path / "ippo", **args), train(mappo, tmp_path / "mappo", **args)
    assert_same_episodes(one.log, other.log)
    for mine, theirs in zip(weights(one.policy), weights(other.policy), strict=True):
        assert np.allclose(mine, theirs, rtol=0, atol=1e-9)
    assert np.allclose(other.critic.params[0][:, 2:].detach(), one.critic.params[0].detach(), rtol=0, atol=1e-9)
    assert np.ptp(one.log.returns[:, -50:]) > 0  # they still try this and that
