"""GASIL: its good episodes against plain lists, its discriminators against closed forms, every update against plain loops."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import decespg, gasil, pg
from tests.helpers import (
    assert_same_direction,
    assert_same_run,
    curves,
    dense_eta,
    each_setting,
    pairs,
    plain_logits,
    plain_returns,
    record_all_updates,
    train,
)

MAX_STEPS = 6


class PlainGood:
    """The best episodes of one trial in a list that keeps the places of those it does not replace."""

    def __init__(self, size):
        self.size, self.kept = size, []

    def offer(self, value, number, episode):
        if len(self.kept) < self.size:
            self.kept.append((value, number, episode))
            return
        place = min(range(self.size), key=lambda slot: self.kept[slot][:2])
        if value >= self.kept[place][0]:
            self.kept[place] = value, number, episode

    def steps(self):
        """(observations, actions) of the whole team, of all steps that are kept."""
        return [step for *_, (obs, actions) in self.kept for step in zip(obs, actions, strict=True)]


def played(rng, lengths):
    """One random episode of each trial as a rollout; no two steps of the team are alike."""
    obs = rng.random((MAX_STEPS + 1, len(lengths), 2, 5), np.float32)
    actions = rng.integers(4, size=(MAX_STEPS, len(lengths), 2))
    return SimpleNamespace(all_obs=obs, actions=actions, lengths=np.array(lengths))


def good_episodes(trials=1, size=3):
    return gasil.GoodEpisodes(envs.make_world("pushbox", max_steps=MAX_STEPS), trials, size)


# --- the good episodes ---


def test_of_returns_1_to_100_the_32_highest_stay():
    rng = np.random.default_rng(0)
    good = good_episodes(size=32)
    for number, value in enumerate(rng.permutation(np.arange(1, 101))):
        good.remember(number, played(rng, [2]), np.array([float(value)]))
    assert sorted(good.value[0]) == list(range(69, 101))


def test_the_best_episodes_stay_whole_and_of_equals_the_newest():
    rng = np.random.default_rng(1)
    good, plain = good_episodes(trials=2), [PlainGood(3), PlainGood(3)]
    for number in range(40):
        rollout, value = played(rng, rng.integers(1, MAX_STEPS + 1, 2)), rng.integers(-2, 3, 2).astype(float)
        good.remember(number, rollout, value)
        for k, length in enumerate(rollout.lengths):
            plain[k].offer(value[k], number, (rollout.all_obs[:length, k].copy(), rollout.actions[:length, k].copy()))
            for slot, (kept, born, (obs, actions)) in enumerate(plain[k].kept):
                assert (good.value[k, slot], good.number[k, slot], good.lengths[k, slot]) == (kept, born, len(actions))
                assert np.array_equal(good.obs[k, slot, : len(actions)], obs)
                assert np.array_equal(good.actions[k, slot, : len(actions)], actions)
    assert good.value.min() == 2  # the best value came often enough, the last three times in the end
    assert good.number.min() > 10


def test_a_checkpoint_of_the_good_episodes_holds_all_that_matters():
    rng = np.random.default_rng(7)
    good, resumed = good_episodes(), good_episodes()
    for number in range(40):
        if number == 20:
            for array, kept in zip(resumed.state, good.state, strict=True):
                array[:] = kept
        rollout, value = played(rng, rng.integers(1, MAX_STEPS + 1, 1)), rng.integers(3, size=1).astype(float)
        for one in (good, resumed) if number >= 20 else (good,):
            one.remember(number, rollout, value)
    assert all(map(np.array_equal, good.state, resumed.state))
    assert np.array_equal(good.number, resumed.number)


def test_steps_are_drawn_uniformly_and_for_the_whole_team():
    rng = np.random.default_rng(2)
    good, plain = good_episodes(trials=2), [PlainGood(3), PlainGood(3)]
    for number, lengths in enumerate([(6, 1), (2, 5)]):  # a place stays empty
        rollout = played(rng, lengths)
        good.remember(number, rollout, np.zeros(2))
        for k, length in enumerate(lengths):
            plain[k].offer(0, number, (rollout.all_obs[:length, k], rollout.actions[:length, k]))
    generators = [np.random.default_rng(seed) for seed in (3, 4)]
    obs, actions = good.draw(generators, 24_000)
    assert (obs.shape, actions.shape) == ((24_000, 2, 2, 5), (24_000, 2, 2))
    for k, one in enumerate(plain):
        steps, found = one.steps(), np.zeros(24_000, int)
        assert len(steps) == (8, 6)[k]
        for step_obs, step_actions in steps:
            same = (obs[:, k] == step_obs).all((1, 2)) & (actions[:, k] == step_actions).all(1)
            assert same.mean() == pytest.approx(1 / len(steps), rel=0.1)
            found += same
        assert np.all(found == 1)
    alone = good.draw([np.random.default_rng(5), np.random.default_rng(4)], 24_000)  # whatever the other trial draws
    assert np.array_equal(alone[0][:, 1], obs[:, 1])
    assert not np.array_equal(generators[0].random(3), np.random.default_rng(3).random(3))


# --- discriminators ---


def tabular(label, learning_rate=0.002):
    """Discriminators without hidden layers of two agents that observe one of three one-hot states and have two actions."""
    world = SimpleNamespace(num_agents=2, obs_dim=3, num_actions=2)
    return gasil.Discriminators([np.random.default_rng(0)], world, (), learning_rate, label)


def exactly(*distributions):
    """What `step_shares` would give of steps with these distributions [3, 2], one for each agent."""
    obs = np.tile(np.eye(3, dtype=np.float32), (len(distributions), 1, 1))
    return obs, np.array(distributions, np.float32)


def steps_of_a_team(states, actions):
    """A rollout of one trial whose two agents both see these states [T, 3] and do these actions [T]."""
    rollout = envs.Rollout(envs.make_world("pushbox"), 1)
    rollout.obs, rollout.rows = envs.distinct_rows(states[:, None, None].repeat(2, 2), np.array([len(states)]))
    rollout.actions = np.array(actions)[:, None, None].repeat(2, 2)
    return rollout


def learnt(discriminators, good, own, steps=1500):
    """D of all states and actions after learning, [num_agents, 3, 2]."""
    for _ in range(steps):
        discriminators.learn(good, own)
    return torch.sigmoid(discriminators.net(torch.eye(3).repeat(2, 1, 1))).detach().numpy()


@pytest.mark.parametrize("label", [0.9, 1.0])
def test_tabular_discriminators_find_the_optimum(label):
    rng = np.random.default_rng(5)
    rho_good, rho_own = rng.dirichlet(np.full(6, 3.0), size=(2, 2)).reshape(2, 2, 3, 2)
    d = learnt(tabular(label), exactly(*rho_good), exactly(*rho_own))
    expected = label * rho_good / (rho_good + rho_own)
    assert np.abs(d - expected).max() < 1e-3
    assert np.ptp(expected) > 0.3
    assert np.abs(expected[0] - expected[1]).max() > 0.2


@pytest.mark.parametrize(("label", "reward"), [(1.0, 0.0), (0.9, np.log(0.5 / 0.55))])
def test_who_does_as_good_episodes_do_gets_no_reward_or_a_little_less(label, reward):
    discriminators, rho = tabular(label), np.full((3, 2), 1 / 6)
    learnt(discriminators, exactly(rho, rho), exactly(rho, rho))
    found = discriminators.reward(steps_of_a_team(np.eye(3, dtype=np.float32)[[0, 1, 2, 0]], [0, 1, 0, 1]))
    assert found.shape == (4, 1, 2)
    assert found == pytest.approx(reward, abs=1e-3)
    assert reward == pytest.approx(0 if label == 1 else -0.0953, abs=1e-4)


def test_what_only_one_side_does_is_told_apart_within_the_clips():
    discriminators = tabular(1.0, learning_rate=0.05)
    good, own = (np.array([[0.5, 0], [0, 0.5], [0, 0]]), np.array([[0, 0.5], [0, 0], [0.5, 0]]))
    d = learnt(discriminators, exactly(good, own), exactly(own, good), 3000)
    assert np.all(d[0][good > 0] > 0.99)
    assert np.all(d[0][own > 0] < 0.01)
    found = discriminators.reward(steps_of_a_team(np.eye(3, dtype=np.float32)[[0, 1, 0, 2]], [0, 1, 1, 0]))
    assert found[:, 0].tolist() == [[1.5, -0.5], [1.5, -0.5], [-0.5, 1.5], [-0.5, 1.5]]


def test_gradients_are_clipped_for_each_network_and_each_of_its_arrays(monkeypatch):
    discriminators, rho = tabular(1.0), np.full((3, 2), 1 / 6)
    good, own = exactly(50 * rho, rho), exactly(0 * rho, 0 * rho)  # what agent 0 learns from counts fifty times
    monkeypatch.setattr(gasil, "update", lambda optimizer, kind, loss: loss.backward())
    discriminators.learn(good, own)
    plain = [param.detach().clone().requires_grad_() for param in discriminators.params]
    logits = torch.baddbmm(plain[1], torch.eye(3).repeat(2, 1, 1), plain[0])
    expected = torch.autograd.grad(-(torch.from_numpy(good[1]) * torch.nn.functional.logsigmoid(logits)).sum(), plain)
    for param, grad in zip(discriminators.params, expected, strict=True):
        norms = grad.flatten(1).norm(dim=1)
        assert norms[0] > 5
        assert norms[1] < 0.5
        assert torch.allclose(param.grad[0], grad[0] * 0.5 / norms[0], atol=1e-6)
        assert torch.allclose(param.grad[1], grad[1], atol=1e-6)


def test_the_imitation_reward():
    d = np.array([0.0, 0.01, 0.17, 0.18, 0.45, 0.5, 0.7, 0.888, 0.89, 0.99, 1.0])
    with np.errstate(all="raise"):
        found = gasil.imitation_reward(d)
    between = np.log(0.5 / np.array([0.82, 0.55, 0.5, 0.3, 0.112]))
    expected = [-0.5, -0.5, -0.5, *between, 1.5, 1.5, 1.5]
    assert found == pytest.approx(expected, abs=1e-12)


def test_shares_are_those_of_the_steps():
    rng = np.random.default_rng(6)
    obs, actions, lengths = rng.integers(2, size=(9, 3, 2, 1)).astype(np.float32), rng.integers(2, size=(9, 3, 2)), [9, 1, 4]
    distinct, shares = gasil.step_shares(obs, actions, np.array(lengths), 2)
    assert shares.sum((1, 2)) == pytest.approx(1)
    for k, i, seen, a in np.ndindex(3, 2, 2, 2):
        steps = [t for t in range(lengths[k]) if (obs[t, k, i, 0], actions[t, k, i]) == (seen, a)]
        rows = np.flatnonzero((distinct[2 * k + i, :, 0] == seen) & shares[2 * k + i].any(1))
        assert shares[2 * k + i, rows, a].sum() == pytest.approx(len(steps) / lengths[k])


# --- whole runs ---


def log_d(own, obs, action):
    """log D(o, a) and log(1 - D(o, a)) of the network with these weights."""
    logit = plain_logits(own, obs)[action]
    return torch.nn.functional.logsigmoid(logit), torch.nn.functional.logsigmoid(-logit)


def discriminator_ascent(params, net, good, own, label):
    """The gradient of the mean of label log D + (1 - label) log(1 - D) over good steps and of log(1 - D) over own ones, and D.

    Steps are (o, a). Every array of the gradient is scaled down to a norm of at most 1/2; also returns their norms before, and
    the mean of D over the steps of either kind.
    """
    own_params = [param[net].detach().double().requires_grad_() for param in params]
    total, means = 0, []
    for steps, target in ((good, label), (own, 0.0)):
        both = [log_d(own_params, *step) for step in steps]
        total = total + sum(target * yes + (1 - target) * no for yes, no in both) / len(steps)
        means.append(np.mean([yes.exp().item() for yes, _ in both]))
    grads = torch.autograd.grad(total, own_params)
    norms = [float(grad.norm()) for grad in grads]
    return [grad * 0.5 / max(norm, 0.5) for grad, norm in zip(grads, norms, strict=True)], norms, means


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_of_discriminators_and_policies(env, tmp_path, monkeypatch):
    updates = record_all_updates(gasil, monkeypatch)
    trials, episodes, gamma, beta, lambda_im, kernel = 2, 20, 0.9, 0.7, 3.0, dict(window=5, sigma=0.9, noise=0.2)
    args = dict(env=env, seed=2, num_trials=trials, num_episodes=episodes, max_steps=10, learning_rate=0.02, log_every=1)
    args.update(gamma=gamma, beta=beta, lambda_im=lambda_im, rise=10, good_episodes=3, good_batch=20, good_label=0.8)
    trained = train(gasil, tmp_path, **args, **kernel, discriminator_hidden=(6,), discriminator_learning_rate=0.3)
    assert len(updates) == 2 + 2 * 18  # the policies', and from the third episode on the discriminators' before each of them
    of_policies, of_discriminators = updates[:2] + updates[3::2], [None, None, *updates[2::2]]
    after = [None, None, *(update.params for update in of_discriminators[3:]), trained.discriminators.net.params]
    num_actions, kernel["sigma"] = trained.log.world.num_actions, kernel["sigma"] * trained.log.world.cell
    plain, visited = [PlainGood(3) for _ in range(trials)], {}
    learn = [np.random.default_rng(np.random.SeedSequence(2 + k).spawn(3)[2]) for k in range(trials)]
    shown = [curves(tmp_path / f"seed{2 + k}") for k in range(trials)]
    rewards, ends, all_norms = [], set(), []
    for n, (discriminators, (rollout, params, direction)) in enumerate(zip(of_discriminators, of_policies, strict=True)):
        weight = lambda_im * min(1, np.exp(-6 * (1 - n / 10)))
        own_steps = {}
        for k, length in enumerate(rollout.lengths):
            obs, actions, reward = rollout.all_obs[:length, k], rollout.actions[:length, k], rollout.reward[:length, k, 0]
            ends.add(length < rollout.lengths.max())
            plain[k].offer(plain_returns(reward, gamma)[0], n, (obs, actions))
            for i in range(2):
                own_steps[k, i] = list(zip(obs[:, i], actions[:, i], strict=True))
        for k in range(trials):
            if n < 2:
                assert [shown[k][f"charts/{tag}"][n][1] for tag in ("d_good", "d_own")] == [0.5, 0.5]
                continue
            steps, means = plain[k].steps(), []
            drawn = [steps[draw] for draw in learn[k].integers(len(steps), size=20)]
            for i in range(2):
                good = [(obs[i], actions[i]) for obs, actions in drawn]
                expected, norms, d = discriminator_ascent(discriminators.params, 2 * k + i, good, own_steps[k, i], 0.8)
                all_norms += norms
                means.append(d)
                for found, one in zip(discriminators.direction, expected, strict=True):
                    assert np.allclose(found[2 * k + i], one, rtol=1e-4, atol=1e-6)
            for tag, value in zip(("d_good", "d_own"), np.mean(means, axis=0), strict=True):
                assert shown[k][f"charts/{tag}"][n][1] == pytest.approx(value, abs=1e-5)
        steps_of = []
        for (k, i), steps in own_steps.items():
            length = rollout.lengths[k]
            now = pairs(rollout.all_obs[:length, k, i], rollout.actions[:length, k, i], num_actions)
            past = visited[k, i] = np.concatenate([visited.get((k, i), now[:0]), now])
            etas = [dense_eta(past, len(past) - length + t, **kernel) for t in range(length)]
            r_im = np.zeros(length)
            if n >= 2:
                own = [param[2 * k + i].detach().double() for param in after[n]]
                d = np.array([log_d(own, *step)[0].exp().item() for step in steps])
                r_im = np.clip(-np.log(1 - np.clip(d, 0.01, 0.99)) + np.log(0.5), -0.5, 1.5)
            rewards += list(r_im)
            augmented = rollout.reward[:length, k, 0] - beta * np.log(np.clip(etas, 1e-3, 1)) + weight * r_im
            returns = np.array(plain_returns(augmented, gamma))
            steps_of.append([(*step, g / length) for step, g in zip(steps, returns, strict=True)])
        assert_same_direction(direction, params, steps_of)
    assert min(rewards) < -0.4
    assert max(rewards) > 0.1
    assert max(all_norms) > 0.5  # some were clipped
    assert (True in ends) == (env == "pushbox")  # nobody reaches an end of findtreasure so soon
    assert max(number for _, number, _ in plain[0].kept) > 3  # episodes were replaced


@each_setting
def test_without_imitation_it_is_decespg_without_memory_bit_for_bit(env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=100, learning_rate=1e-3, beta=0.5)
    without_memory = train(decespg, tmp_path / "decespg", **args, slots=0)
    assert_same_run(without_memory, train(gasil, tmp_path / "gasil", **args, lambda_im=0.0))


@each_setting
def test_without_imitation_and_bonus_it_is_pg_bit_for_bit(env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=100, learning_rate=1e-3)
    assert_same_run(train(pg, tmp_path / "pg", **args), train(gasil, tmp_path / "gasil", **args, beta=0.0, lambda_im=0.0))


@pytest.mark.parametrize("optimizer", ["sign", "adam"])
def test_the_discriminators_have_an_adam_of_their_own(optimizer, tmp_path, monkeypatch):
    updates = record_all_updates(gasil, monkeypatch)
    args = dict(env="pushbox", optimizer=optimizer, num_trials=2, num_episodes=10, max_steps=10, good_episodes=1)
    trained = train(gasil, tmp_path, **args, discriminator_learning_rate=1e-2)
    steps = updates[::2]
    reference = [param.clone() for param in steps[0].params]
    adam = torch.optim.Adam(reference, lr=1e-2, betas=(0.5, 0.9))
    after = [*(update.params for update in steps[1:]), trained.discriminators.net.params]
    for update, following in zip(steps, after, strict=True):
        for param, direction in zip(reference, update.direction, strict=True):
            param.grad = -direction
        adam.step()
        assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))


def test_discriminators_of_one_agents_observation_have_weights_drawn_after_the_actors(tmp_path, monkeypatch):
    updates = record_all_updates(gasil, monkeypatch)
    train(gasil, tmp_path, env="pushbox", seed=4, num_trials=2, num_episodes=1, good_episodes=1)
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    gasil.StackedMLP(fresh, 2, [5, 64, 32, 4])
    expected = gasil.StackedMLP(fresh, 2, [5, 32, 32, 4])
    assert all(map(torch.equal, updates[0].params, expected.params))


def test_gasil_keeps_the_treasure_that_its_base_gives_up(tmp_path):
    args = dict(env="findtreasure", num_trials=4, num_episodes=900, learning_rate=1e-3, beta=0.0)
    found = {}
    for lambda_im in (0.0, 10.0):
        log = train(gasil, tmp_path / str(lambda_im), **args, lambda_im=lambda_im).log
        assert (log.outcomes[:, :100] == 1).any(1).all()  # every trial has met it early
        found[lambda_im] = (log.outcomes[:, -60:] == 1).mean(1)
    assert found[0.0].max() < 0.1
    assert found[10.0].min() > 0.4


def test_its_bonus_has_the_weight_that_the_rule_chose_for_decespg():
    chosen = {pair: values["beta"] for pair, values in decespg.TUNED.items()}
    assert {pair: values["beta"] for pair, values in gasil.TUNED.items()} == {pair: chosen[pair] for pair in gasil.TUNED}
