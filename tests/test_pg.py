"""PG: its gradient against closed forms and plain loops, sampling, the stacked networks, their optimiser, and learning."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.nn import Linear, ReLU, Sequential

from algos import pg
from tests.helpers import (
    SCRIPTS,
    assert_same_direction,
    plain_returns,
    record_updates,
    script,
    train,
    weights,
)

CLIMB = np.array([[11.0, -30.0, 0.0], [-30.0, 7.0, 6.0], [0.0, 0.0, 5.0]])  # the team's reward for both actions


def generators(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def random_policy(nets, sizes, trials=1):
    return pg.StackedMLP(generators(*range(trials)), nets // trials, sizes)


def random_gradients(policy, rng):
    """Of all magnitudes, some of them 0."""
    return [
        torch.from_numpy(rng.normal(size=p.shape) * 10.0 ** rng.integers(-6, 4, p.shape) * (rng.random(p.shape) < 0.9)).float()
        for p in policy.params
    ]


# --- the gradient ---


@pytest.mark.parametrize("seed", range(5))
def test_the_expected_gradient_of_the_climb_game_is_its_closed_form(seed):
    policy = pg.StackedMLP(generators(seed), 2, [1, 8, 3])
    policy.params = [(2 * param).detach().double().requires_grad_() for param in policy.params]  # policies far from uniform
    logits = policy(torch.ones(2, 1, 1, dtype=torch.double))
    logits.retain_grad()
    pi = torch.softmax(logits, -1).detach().numpy()[:, 0]
    actions = np.array([(a, b) for a in range(3) for b in range(3)])[:, None]  # one "episode" of the 9 joint actions
    weight = np.array([pi[0, a] * pi[1, b] * CLIMB[a, b] for a, b in actions[:, 0]])
    obs, weight = pg.merge_steps(
        np.ones((9, 1, 2, 1), np.float32), actions, np.repeat(weight[:, None, None], 2, 2), np.array([9]), 3
    )
    assert (obs.shape, weight.shape) == ((2, 1, 1), (2, 1, 3))
    (torch.from_numpy(weight) * torch.log_softmax(logits, dim=-1)).sum().backward()
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


@pytest.mark.parametrize(("dim", "kinds"), [(5, 3), (4, 200), (1, 2)])
def test_merged_steps_have_the_gradient_of_the_plain_loop(dim, kinds):
    rng = np.random.default_rng(dim)
    trials, agents, num_actions, lengths = 3, 2, 4, np.array([40, 1, 25])
    places = rng.normal(size=(kinds, dim)).astype(np.float32)
    obs = places[rng.integers(kinds, size=(40, trials, agents))]
    actions = rng.integers(num_actions, size=obs.shape[:3])
    weight = rng.normal(size=obs.shape[:3])
    for k, length in enumerate(lengths):
        obs[length:, k], actions[length:, k], weight[length:, k] = np.nan, -7, np.nan  # nothing there may count
    merged, merged_weight = pg.merge_steps(obs, actions, weight, lengths, num_actions)

    policy = random_policy(trials * agents, [dim, 8, num_actions])
    log_probs = torch.log_softmax(policy(torch.from_numpy(merged)), dim=-1)
    direction = torch.autograd.grad((torch.from_numpy(merged_weight) * log_probs).sum(), policy.params)
    steps_of, most = [], 0
    for k, length in enumerate(lengths):
        for i in range(agents):
            steps_of.append(list(zip(obs[:length, k, i], actions[:length, k, i], weight[:length, k, i], strict=True)))
            distinct = len({place.tobytes() for place in obs[:length, k, i]})
            most = max(most, distinct)
            assert not merged_weight[k * agents + i, distinct:].any()
    assert merged.shape == (trials * agents, most, dim)
    assert_same_direction(direction, policy.params, steps_of)


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_climbs_along_the_mean_of_returns_times_scores(env, tmp_path, monkeypatch):
    updates = record_updates(pg, monkeypatch)
    train(pg, tmp_path, env=env, num_trials=2, num_episodes=6, max_steps=12, learning_rate=0.05, gamma=0.9)
    assert len(updates) == 6
    for rollout, params, direction in updates:
        steps_of = []
        for k, length in enumerate(rollout.lengths):
            returns = np.array(plain_returns(rollout.reward[:length, k], 0.9))
            for i in range(2):
                steps_of.append(
                    list(zip(rollout.obs[:length, k, i], rollout.actions[:length, k, i], returns / length, strict=True))
                )
        assert_same_direction(direction, params, steps_of)


# --- sampling ---


def test_actions_have_the_frequencies_of_the_softmax():
    logits = np.random.default_rng(0).normal(scale=2, size=(3, 2, 5)).astype(np.float32)
    draws = 20_000
    even = (np.arange(draws) + 0.5) / draws
    actions = np.array([pg.sample_actions(logits, np.full((3, 2), u)) for u in even])
    frequencies = np.stack([(actions == a).mean(0) for a in range(5)], -1)
    assert np.abs(frequencies - torch.softmax(torch.from_numpy(logits), -1).numpy()).max() < 2 / draws


def test_a_uniform_number_is_inverted_exactly():
    logits = np.log(np.array([1, 2, 3, 2], np.float32) / 8)[None, None]
    for below, above, bound in ((0, 1, 1 / 8), (1, 2, 3 / 8), (2, 3, 6 / 8)):
        assert pg.sample_actions(logits, np.array([[bound - 1e-6]]))[0, 0] == below
        assert pg.sample_actions(logits, np.array([[bound + 1e-6]]))[0, 0] == above


@pytest.mark.parametrize("u", [0.0, 5e-324, 0.5, 1 - 2**-53])
@pytest.mark.parametrize(
    ("logits", "possible"),
    [
        ([0, 0, 0], {0, 1, 2}),
        ([1e4, -1e4, -1e4], {0}),
        ([-1e4, 1e4, -1e4], {1}),
        ([-1e4, -1e4, 1e4], {2}),
        ([-1e4, 0, 0], {1, 2}),
        ([0.1, 0.3, 1e4], {2}),
        ([-1e4, -1e4, -1e4], {0, 1, 2}),
        ([1e4, 1e4, 1e4], {0, 1, 2}),
    ],
)
def test_extreme_logits_give_possible_actions(logits, possible, u):
    assert pg.sample_actions(np.array([[logits]], np.float32), np.array([[u]]))[0, 0] in possible


def test_no_action_is_ever_out_of_range():
    rng = np.random.default_rng(1)
    logits = (rng.normal(size=(50_000, 2, 4)) * 10.0 ** rng.integers(-3, 5, (50_000, 1, 1))).astype(np.float32)
    for u in (0.0, 1 - 2**-53):
        actions = pg.sample_actions(logits, np.full((50_000, 2), u))
        assert (actions.min(), actions.max()) == (0, 3)


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
    if script(name).Policy is script(name).StackedMLP:  # not where the networks' outputs are values, which play otherwise
        expected = train(pg, tmp_path / "expected", **args)
        assert np.array_equal(found.log.returns, expected.log.returns)
        assert np.array_equal(found.log.lengths, expected.log.lengths)


def test_sign_descent_is_the_first_step_of_a_fresh_adam():
    rng = np.random.default_rng(0)
    policy = random_policy(4, [3, 5, 2])
    optimizer = pg.StackedOptimizer(policy.params, "sign", 0.01)
    ordinary = weights(policy)
    for _ in range(5):
        grads = random_gradients(policy, rng)
        optimizer.step(grads)
        for param, grad in zip(ordinary, grads, strict=True):
            param.grad = grad
        torch.optim.Adam(ordinary, lr=0.01).step()
        assert all(torch.allclose(a, b, rtol=0, atol=2e-6) for a, b in zip(policy.params, ordinary, strict=True))


def test_adam_is_torchs_adam_for_each_network_by_its_own_count():
    rng = np.random.default_rng(1)
    policy = random_policy(4, [3, 5, 2])
    optimizer = pg.StackedOptimizer(policy.params, "adam", 0.01)
    single = [[param[net].detach().clone() for param in policy.params] for net in range(4)]
    adams = [torch.optim.Adam(own, lr=0.01) for own in single]
    for step in range(60):
        grads = random_gradients(policy, rng)
        active = None if step % 5 == 0 else torch.from_numpy(rng.random(4) < [0.2, 0.5, 0.9, 0.5])
        optimizer.step(grads, active)
        for net in range(4):
            if active is None or active[net]:
                for param, grad in zip(single[net], grads, strict=True):
                    param.grad = grad[net]
                adams[net].step()
            for stacked, own in zip(policy.params, single[net], strict=True):
                assert torch.allclose(stacked[net], own, rtol=0, atol=1e-5)
    counts = [int(adam.state[own[0]]["step"]) for adam, own in zip(adams, single, strict=True)]
    assert optimizer.count.tolist() == counts
    assert len(set(counts)) > 1


@pytest.mark.parametrize("kind", ["sign", "adam"])
def test_gradients_may_lie_otherwise_in_memory(kind):
    policy, other = (random_policy(2, [3, 5, 2]) for _ in range(2))
    grads = random_gradients(policy, np.random.default_rng(0))
    pg.StackedOptimizer(policy.params, kind, 0.01).step(grads)
    pg.StackedOptimizer(other.params, kind, 0.01).step([grad.mT.contiguous().mT for grad in grads])
    assert all(map(torch.equal, weights(policy), weights(other)))


@pytest.mark.parametrize("kind", ["sign", "adam"])
def test_networks_outside_the_mask_stay_untouched(kind):
    rng = np.random.default_rng(2)
    policy, alone = (random_policy(4, [3, 5, 2]) for _ in range(2))
    optimizer, reference = (pg.StackedOptimizer(one.params, kind, 0.01) for one in (policy, alone))
    for mask in ([1, 1, 1, 1], [1, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0], [1, 1, 1, 0]):
        active = torch.tensor(mask, dtype=torch.bool)
        grads = random_gradients(policy, rng)
        before = [*weights(policy), *(array.copy() for array in optimizer.state)]
        optimizer.step(grads, active)
        for old, new in zip(before, (*weights(policy), *optimizer.state), strict=True):
            assert np.array_equal(old[~active.numpy()], new[~active.numpy()])
        if mask[0]:  # network 0 goes its way as if the others were not there
            reference.step([grad * torch.tensor([1.0, 0, 0, 0]).view(4, 1, 1) for grad in grads])
        assert all(torch.equal(a[0], b[0]) for a, b in zip(policy.params, alone.params, strict=True))
    assert optimizer.count.tolist() == [3, 2, 3, 2]


# --- whole runs ---


def test_pg_ends_in_the_local_optimum_of_findtreasure(tmp_path):
    log = train(pg, tmp_path, env="findtreasure", num_trials=4, num_episodes=1500).log
    assert (log.outcomes[:, -75:] == 2).mean(1).min() > 0.9
    assert log.means(slice(-75, None))["reward_per_step"] == pytest.approx(np.ones(4), abs=0.05)
    assert (log.outcomes == 1).any(1).all()  # though every team had found the treasure
