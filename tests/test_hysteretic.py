"""Hysteretic DQN: its limits h = 1, which is dqn.py, and h = 0, gradient and whole runs beside plain ones, the climb game."""

import numpy as np
import pytest
import torch

from algos import dqn, hysteretic
from tests.helpers import assert_same_run, train, use_double_precision, weights
from tests.test_dqn import double_networks, random_batch, values
from tests.test_pg import CLIMB, generators

PARTS = ("policy", "target", "optimizer", "replay")

# --- the error ---


def plain_gradient(policy, target, batch, gamma, h):
    """The gradient of every network, step by step: that of Q(o, a) times -2 delta, and times h where delta is negative."""
    grads, deltas = [torch.zeros_like(param) for param in policy.params], []
    obs, actions, next_obs, reward, terminated = batch
    for net, b in np.ndindex(*actions.shape):
        y = reward[net, b].item() + (1 - terminated[net, b].item()) * gamma * values(target.params, net, next_obs[net, b]).max()
        q = policy(obs[:, b : b + 1])[net, 0, actions[net, b]]
        deltas.append(y - q.item())
        step = deltas[-1] if deltas[-1] >= 0 else h * deltas[-1]
        for grad, own in zip(grads, torch.autograd.grad(q, policy.params), strict=True):
            grad -= 2 * step * own
    return grads, np.array(deltas)


@pytest.mark.parametrize("h", [0.0, 0.3, 1.0])
def test_the_step_down_is_h_times_as_far_as_the_step_up(h, monkeypatch):
    policy, target = double_networks(monkeypatch)
    monkeypatch.setattr(policy, "params", [param.double().detach().requires_grad_() for param in policy.params])
    batch = random_batch(np.random.default_rng(3), 4, terminated=0)
    found = torch.autograd.grad(hysteretic.squared_td_errors(policy, target, batch, 0.9, h).sum(), policy.params)
    expected, deltas = plain_gradient(policy, target, batch, 0.9, h)
    assert 5 < (deltas < 0).sum() < 23  # of 28
    assert all(torch.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in zip(found, expected, strict=True))


def test_with_h_of_0_nothing_is_ever_learnt_downwards():
    policy, target = (dqn.StackedMLP(generators(*seeds), 2, [3, 8, 4]) for seeds in ((0, 1), (2, 3)))
    obs, actions, next_obs, reward, _ = (part.float() for part in random_batch(np.random.default_rng(0), 4, terminated=1))
    actions, ended = actions.long(), torch.ones(4, 7)
    too_low, too_high = reward - 100, reward + 100  # than what the networks say
    for targets, still in ((too_low, True), (too_high, False)):
        batch = obs, actions, next_obs, targets, ended
        before = policy(obs).gather(-1, actions[..., None])[..., 0].detach()
        optimizer = hysteretic.MaskedAdam(policy.params, 2, 0.001)
        optimizer.step(hysteretic.squared_td_errors(policy, target, batch, 0.9, 0.0).mean(1).sum(), np.array([True, True]))
        moved = policy(obs).gather(-1, actions[..., None])[..., 0].detach() - before
        assert torch.equal(moved, torch.zeros_like(moved)) if still else (moved > 0).all()


# --- whole runs ---

RUN = dict(num_trials=3, seed=5, num_episodes=60, max_steps=40, exploration=0.5, learning_rate=0.003)


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_with_h_of_1_it_is_dqn_bit_for_bit(env, tmp_path):
    one = train(hysteretic, tmp_path / "hysteretic", env=env, hysteresis=1.0, **RUN)
    other = train(dqn, tmp_path / "dqn", env=env, **RUN)
    assert_same_run(one, other, PARTS)
    less = train(hysteretic, tmp_path / "less", env=env, hysteresis=0.9, **RUN)
    assert not torch.equal(less.policy.params[0], other.policy.params[0])


def test_a_run_is_that_of_dqn_with_smaller_steps_down(tmp_path, monkeypatch):
    def weighed_errors(policy, target, batch, gamma):
        delta = batch[3] + gamma * (1 - batch[4]) * target(batch[2]).amax(-1).detach()
        delta = delta - policy(batch[0]).gather(-1, batch[1][..., None])[..., 0]
        return delta.square() * (1 - 0.75 * (delta < 0).double())

    for module in (dqn, hysteretic):
        use_double_precision(module, monkeypatch)
    one = train(hysteretic, tmp_path / "hysteretic", env="findtreasure", hysteresis=0.25, **RUN)
    monkeypatch.setattr(dqn, "squared_td_errors", weighed_errors)
    other = train(dqn, tmp_path / "dqn", env="findtreasure", **RUN)
    assert np.array_equal(one.log.returns, other.log.returns)
    assert all(torch.allclose(a, b, rtol=0, atol=1e-9) for a, b in zip(weights(one.policy), weights(other.policy), strict=True))


# --- what it is for ---


def expectile(numbers, h):
    """Where steps up and steps down, those times h, cancel: the zero of a falling function, by bisection."""
    low, high = min(numbers), max(numbers)
    for _ in range(60):
        middle = (low + high) / 2
        pull = sum(max(h * (number - middle), number - middle) for number in numbers)
        low, high = (middle, high) if pull > 0 else (low, middle)
    return low


@pytest.mark.parametrize(("h", "best"), [(1.0, 2), (0.1, 0)])
def test_disappointments_that_count_little_lead_to_the_top_of_the_climb_game(h, best):
    """Where DQN takes the mean over the teammate's actions and ends at 5; h = 0.1 is that of Matignon et al."""
    policy = hysteretic.StackedMLP(generators(0), 2, [1, 16, 3])
    optimizer = hysteretic.MaskedAdam(policy.params, 1, 0.01)
    actions = torch.cartesian_prod(torch.arange(3), torch.arange(3)).T  # all joint actions, [2, 9]
    reward, ones = torch.from_numpy(CLIMB).float().reshape(1, 9).repeat(2, 1), torch.ones(2, 9, 1)
    for _ in range(1500):
        batch = ones, actions, ones, reward / 10, ones[..., 0]
        optimizer.step(hysteretic.squared_td_errors(policy, policy, batch, 0.9, h).mean(1).sum(), np.array([True]))
    found = 10 * policy(ones[:, :1]).detach().numpy()[:, 0]
    expected = [[expectile(numbers, h) for numbers in table] for table in (CLIMB, CLIMB.T)]
    assert np.abs(found - expected).max() < 0.02
    assert found.argmax(1).tolist() == [best, best]


def test_hysteretic_dqn_learns_to_push_boxes(tmp_path):
    log = train(hysteretic, tmp_path, env="pushbox", num_trials=4, num_episodes=500, hysteresis=0.4).log
    early, late = (log.means(episodes) for episodes in (slice(0, 20), slice(-100, None)))  # at first they play at random
    assert early["reward_per_step"].mean() < 1.0
    assert late["reward_per_step"].mean() > 1.5
    assert early["episodic_length"].min() > 20
    assert late["episodic_length"].max() < 16
