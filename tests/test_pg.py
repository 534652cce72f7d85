"""PG: its gradient against closed forms and plain loops, the stacked networks, the optimiser, and learning."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.nn import Linear, ReLU, Sequential

import envs
from algos import pg
from tests.helpers import SCRIPTS, assert_same_direction, plain_returns, record_updates, script, train, weights

CLIMB = np.array([[11.0, -30.0, 0.0], [-30.0, 7.0, 6.0], [0.0, 0.0, 5.0]])  # the team's reward for both actions


def generators(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def random_policy(nets, sizes, trials=1):
    return pg.StackedMLP(generators(*range(trials)), nets // trials, sizes)


# --- the gradient ---


@pytest.mark.parametrize("seed", range(5))
def test_the_expected_gradient_of_the_climb_game_is_its_closed_form(seed):
    policy = pg.StackedMLP(generators(seed), 2, [1, 8, 3])
    policy.params = [(2 * param).detach().double().requires_grad_() for param in policy.params]  # policies far from uniform
    logits = policy(torch.ones(2, 1, 1, dtype=torch.double))
    logits.retain_grad()
    pi = torch.softmax(logits, -1).detach().numpy()[:, 0]
    rollout = envs.Rollout(envs.make_world("pushbox", max_steps=9), num_trials=1)  # one "episode" of the 9 joint actions
    rollout.rows = np.zeros((9, 1, 2), np.int64)
    rollout.actions = np.array([(a, b) for a in range(3) for b in range(3)])[:, None]
    weight = np.array([pi[0, a] * pi[1, b] * CLIMB[a, b] for a, b in rollout.actions[:, 0]])
    (torch.from_numpy(weight)[:, None, None] * rollout.of_taken(torch.log_softmax(logits, dim=-1))).sum().backward()
    value = pi[0] @ CLIMB @ pi[1]
    closed_form = np.array([pi[0] * (CLIMB @ pi[1] - value), pi[1] * (CLIMB.T @ pi[0] - value)])
    assert np.abs(closed_form).max() > 0.05
    assert np.abs(logits.grad.numpy()[:, 0] - closed_form).max() < 1e-6


def test_known_returns():
    reward = np.array([1.0, 2.0, 4.0, 8.0])[:, None, None] * [[1.0, -1.0]]
    returns = pg.discounted_returns(np.repeat(reward, 2, 1), np.array([4, 2]), 0.5)
    assert returns[:, 0, 0].tolist() == [4, 6, 8, 8]
    assert returns[:, 1, 0].tolist() == [2, 2, 0, 0]  # nothing after its end counts
    assert np.array_equal(returns[:, :, 1], -returns[:, :, 0])


@pytest.mark.parametrize("gamma", [0.0, 0.95, 1.0])
def test_returns_are_discounted_sums(gamma):
    rng = np.random.default_rng(0)
    lengths = np.array([1, 17, 30])
    reward = rng.normal(size=(30, 3, 2))
    returns = pg.discounted_returns(reward, lengths, gamma)
    for k, length in enumerate(lengths):
        for i in range(2):
            assert returns[:length, k, i] == pytest.approx(plain_returns(reward[:length, k, i], gamma), abs=1e-12)
        assert not returns[length:, k].any()


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_climbs_along_the_mean_of_returns_times_scores(env, tmp_path, monkeypatch):
    updates = record_updates(pg, monkeypatch)
    train(pg, tmp_path, env=env, num_trials=2, num_episodes=6, max_steps=12, learning_rate=0.05, gamma=0.9)
    assert len(updates) == 6
    for rollout, params, direction in updates:
        steps_of = []
        for k, length in enumerate(rollout.lengths):
            returns = np.array(plain_returns(rollout.reward[:length, k, 0], 0.9))
            for i in range(2):
                own = rollout.all_obs[:length, k, i], rollout.actions[:length, k, i], returns / length
                steps_of.append(list(zip(*own, strict=True)))
        assert_same_direction(direction, params, steps_of)


# --- stacked networks and their optimiser ---


def test_stacked_networks_are_ordinary_networks_side_by_side():
    sizes = [4, 7, 6, 3]
    policy = random_policy(6, sizes, trials=3)
    assert [tuple(param.shape) for param in policy.params] == [(6, 4, 7), (6, 1, 7), (6, 7, 6), (6, 1, 6), (6, 6, 3), (6, 1, 3)]
    x = torch.randn(6, 11, 4, generator=torch.Generator().manual_seed(0))
    out = policy(x)
    for net in range(6):
        layers = []
        for width, next_width in pairwise(sizes):
            layers += [Linear(width, next_width), ReLU()]
        ordinary = Sequential(*layers[:-1])
        ordinary.load_state_dict(
            {
                name: (policy.params[j][net].T if "weight" in name else policy.params[j][net, 0]).detach()
                for j, name in enumerate(ordinary.state_dict())
            }
        )
        assert torch.allclose(out[net], ordinary(x[net]), atol=1e-6)


def test_initial_weights_are_uniform_and_come_from_the_trials_own_generator():
    together = pg.StackedMLP(generators(5, 6), 2, [4, 300, 3])
    for trial, seed in enumerate((5, 6)):
        alone = pg.StackedMLP(generators(seed), 2, [4, 300, 3])
        assert all(torch.equal(a[2 * trial : 2 * trial + 2], b) for a, b in zip(together.params, alone.params, strict=True))
    for param, width in zip(together.params, (4, 4, 300, 300), strict=True):
        assert param.abs().max() <= width**-0.5
        if param.numel() > 1000:
            assert float(param.detach().std()) == pytest.approx((3 * width) ** -0.5, rel=0.05)
            assert len(param.unique()) > 0.99 * param.numel()


@pytest.mark.parametrize("name", SCRIPTS)
@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_all_scripts_start_from_the_same_actors_and_play_the_same_first_episodes(name, env, tmp_path):
    args = dict(env=env, seed=3, num_trials=2, num_episodes=3, learning_rate=0.0)
    found = train(script(name), tmp_path / "found", **args)
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (3, 4)]
    sizes = [found.log.world.obs_dim, *pg.WORLDS[env]["hidden"], found.log.world.num_actions]
    assert all(map(torch.equal, weights(found.policy), weights(pg.StackedMLP(fresh, 2, sizes))))
    if not hasattr(found.policy, "head"):  # not where the networks' outputs are values, which play otherwise
        expected = train(pg, tmp_path / "expected", **args)
        assert np.array_equal(found.log.returns, expected.log.returns)
        assert np.array_equal(found.log.lengths, expected.log.lengths)


def random_losses(policy, rng):
    """A loss whose gradients are of all magnitudes, some of them 0."""
    grads = [rng.normal(size=p.shape) * 10.0 ** rng.integers(-6, 4, p.shape) * (rng.random(p.shape) < 0.9) for p in policy]
    return lambda params: sum((torch.from_numpy(g).float() * p).sum() for g, p in zip(grads, params, strict=True))


@pytest.mark.parametrize("kind", ["sign", "adam"])
def test_stacked_networks_step_as_each_does_alone(kind):
    """For "sign" a network's own Adam is made anew in every update, for "adam" it is kept."""
    rng, policy = np.random.default_rng(0), random_policy(4, [3, 5, 2]).params
    alone = [[param[net].detach().clone().requires_grad_() for param in policy] for net in range(4)]
    stacked, adams = torch.optim.Adam(policy, lr=0.01, fused=True), [torch.optim.Adam(own, lr=0.01) for own in alone]
    for _ in range(20):
        loss = random_losses(policy, rng)
        pg.update(stacked, kind, loss(policy))
        grads = [param.grad.clone() for param in policy]
        for net in range(4):
            if kind == "sign":
                adams[net] = torch.optim.Adam(alone[net], lr=0.01)
            for param, grad in zip(alone[net], grads, strict=True):
                param.grad = grad[net].clone()
            adams[net].step()
            for one, other in zip(policy, alone[net], strict=True):
                assert torch.allclose(one[net], other, rtol=0, atol=1e-6)


def test_sign_is_descent_along_the_sign_of_the_gradient():
    rng, policy = np.random.default_rng(1), random_policy(2, [3, 5, 2]).params
    optimizer = torch.optim.Adam(policy, lr=0.01, fused=True)
    for _ in range(3):
        before = [param.detach().clone() for param in policy]
        pg.update(optimizer, "sign", random_losses(policy, rng)(policy))
        for old, new in zip(before, policy, strict=True):
            step = 0.01 * new.grad / (new.grad.abs() + 1e-8)
            assert torch.allclose(old - step, new.detach(), rtol=0, atol=1e-6)


# --- whole runs ---


def test_pg_ends_in_the_local_optimum_of_findtreasure(tmp_path):
    log = train(pg, tmp_path, env="findtreasure", num_trials=4, num_episodes=1500).log
    assert (log.outcomes[:, -75:] == 2).mean(1).min() > 0.9
    assert log.means(slice(-75, None))["reward_per_step"] == pytest.approx(np.ones(4), abs=0.05)
    assert (log.outcomes == 1).any(1).all()  # though every team had found the treasure
