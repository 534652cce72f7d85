"""ACER: Retrace, the policy gradient and the trust region against closed forms, the replay against a list, every update."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import acer
from tests.helpers import assert_same_direction, curves, each_setting, plain_logits, record_all_updates, train, weights


def random_policy(rng, num_actions=4):
    probs = np.exp(rng.normal(scale=1.5, size=num_actions))
    return probs / probs.sum()


# --- Retrace ---


def random_steps(rng, length=12):
    """reward, rho, Q of the actions taken and V of an episode's steps, and V of what comes after them."""
    reward, q_taken, value = rng.normal(size=(3, length))
    return reward, rng.exponential(size=length), q_taken, value, rng.normal()


def forward_retrace(reward, ratio, q_taken, value, tail, gamma):
    """Q plus the discounted TD errors to come, each times all the cut ratios on the way to it (Munos et al., 2016, Eq. 3)."""
    after = np.append(value[1:], tail)
    error = reward + gamma * after - q_taken
    return [
        q_taken[t]
        + sum(gamma ** (s - t) * np.minimum(1, ratio[t + 1 : s + 1]).prod() * error[s] for s in range(t, len(reward)))
        for t in range(len(reward))
    ]


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
def test_retrace_is_the_sum_of_td_errors_with_cut_traces(gamma):
    steps = random_steps(np.random.default_rng(0))
    assert 3 < (steps[1] > 1).sum() < 9
    assert acer.retrace(*steps, gamma) == pytest.approx(forward_retrace(*steps, gamma), abs=1e-12)


def test_on_policy_retrace_is_the_return_and_what_the_values_miss():
    reward, _, q_taken, value, tail = random_steps(np.random.default_rng(1))
    length, gamma = len(reward), 0.9
    returns = [
        sum(gamma ** (s - t) * reward[s] for s in range(t, length)) + gamma ** (length - t) * tail for t in range(length)
    ]
    missed = [sum(gamma ** (s - t) * (value[s] - q_taken[s]) for s in range(t + 1, length)) for t in range(length)]
    assert acer.retrace(reward, np.ones(length), q_taken, value, tail, gamma) == pytest.approx(np.add(returns, missed))
    assert acer.retrace(reward, np.ones(length), value, value, tail, gamma) == pytest.approx(returns)


def test_without_traces_retrace_is_the_one_step_target():
    reward, _, q_taken, value, tail = random_steps(np.random.default_rng(2))
    target = acer.retrace(reward, np.zeros(len(reward)), q_taken, value, tail, 0.9)
    assert target == pytest.approx(reward + 0.9 * np.append(value[1:], tail))


def test_retrace_of_the_true_values_is_the_true_values():
    """In a deterministic world, on every path, whoever played it."""
    rng = np.random.default_rng(3)
    reward, following, gamma = rng.normal(size=(5, 3)), rng.integers(5, size=(5, 3)), 0.8
    pi, mu = (np.array([random_policy(rng, 3) for _ in range(5)]) for _ in range(2))
    ends = np.arange(5)[:, None] * np.ones(3, int) == 4  # every action ends the episode in the last state
    q = np.zeros((5, 3))
    for _ in range(300):
        q = reward + gamma * ~ends * (pi * q).sum(1)[following]
    value, ended = (pi * q).sum(1), []
    for _ in range(50):
        states, actions = [0], []
        for _ in range(12):
            actions.append(rng.choice(3, p=mu[states[-1]]))
            states.append(following[states[-1], actions[-1]])
            if ends[states[-2], actions[-1]]:
                break
        path, ended = (np.array(states[:-1]), np.array(actions)), [*ended, states[-2] == 4]
        tail = 0.0 if ended[-1] else value[states[-1]]
        target = acer.retrace(reward[path], (pi / mu)[path], q[path], value[path[0]], tail, gamma)
        assert np.abs(target - q[path]).max() < 1e-12
    assert 0 < sum(ended) < 50


# --- the policy gradient and the trust region ---


@pytest.mark.parametrize("truncation", [1.0, 2.0, 10.0, 1e9])
def test_the_truncated_gradient_and_its_correction_add_up_to_that_of_all_actions(truncation):
    """In expectation over the actions of mu, if Qret = Q: sum_a pi(a) (Q(a) - V) grad log pi(a), whatever mu and c are."""
    rng, most = np.random.default_rng(4), 0
    for _ in range(20):
        pi, mu, q = random_policy(rng), random_policy(rng), rng.normal(size=4)
        value, most = pi @ q, max(most, (pi / mu).max())
        g = sum(mu[a] * acer.policy_gradient(pi, mu, q, value, a, q[a], truncation) for a in range(4))
        assert g == pytest.approx(q - value, abs=1e-12)
    assert most > 10


def test_the_policy_gradient_of_known_numbers():
    pi, mu, q = np.array([0.8, 0.15, 0.05]), np.array([0.1, 0.4, 0.5]), np.array([1.0, 2.0, 4.0])
    g = acer.policy_gradient(pi, mu, q, 1.3, 0, 3.3, 2.0)  # the ratios are 8, 3/8 and 1/10
    assert g == pytest.approx([2 * 2 / 0.8 + (1 - 2 / 8) * -0.3, 0, 0])
    g = acer.policy_gradient(pi, mu, q, 1.3, 1, 3.3, 2.0)
    assert g == pytest.approx([(1 - 2 / 8) * -0.3, 3 / 8 * 2 / 0.15, 0])


def test_on_policy_only_the_action_taken_counts():
    rng = np.random.default_rng(5)
    for truncation in (1.0, 10.0):
        pi, q = random_policy(rng), rng.normal(size=4)
        g = acer.policy_gradient(pi, pi, q, pi @ q, 2, 5.0, truncation)
        assert g == pytest.approx([0, 0, (5 - pi @ q) / pi[2], 0])


def divergence_gradient(pi, average):
    """The gradient of KL(average || pi) by pi."""
    variable = torch.tensor(pi, requires_grad=True)
    (torch.tensor(average) * (torch.tensor(average).log() - variable.log())).sum().backward()
    return variable.grad.numpy()


def test_the_projection_is_the_nearest_point_of_the_trust_region():
    rng, too_far = np.random.default_rng(6), 0
    for _ in range(200):
        pi, average, g = random_policy(rng), random_policy(rng), rng.normal(scale=2, size=4)
        k, z = divergence_gradient(pi, average), g.copy()
        bound = acer.project_to_trust_region(z, pi, average, 0.5)
        assert bound == (k @ g > 0.5)
        too_far += bound
        if bound:  # on the border, and straight from g towards it
            assert k @ z == pytest.approx(0.5, abs=1e-9)
            multiplier = (g - z) @ k / (k @ k)
            assert multiplier > 0
            assert g - z == pytest.approx(multiplier * k, abs=1e-12)
        else:
            assert np.array_equal(z, g)
    assert 50 < too_far < 150


# --- what an episode says to the networks ---


def random_episode(rng, trials=3, agents=2, num_actions=4, kinds=6):
    """What `output_directions` takes before the numbers of the method; nothing beyond an episode's length may count."""
    lengths = np.array([9, 1, 5])[:trials]
    rows = rng.integers(kinds, size=(10, trials, agents))
    reward, actions = rng.normal(size=(9, trials)), rng.integers(num_actions, size=(9, trials, agents))
    pi, average = (
        np.array([[random_policy(rng, num_actions) for _ in range(kinds)] for _ in range(trials * agents)]) for _ in range(2)
    )
    mu = np.array([[[random_policy(rng, num_actions)] * agents for _ in range(trials)] for _ in range(9)], np.float32)
    q = rng.normal(size=pi.shape)
    for k, length in enumerate(lengths):
        reward[length:, k], actions[length:, k], mu[length:, k] = np.nan, -9, np.nan
        rows[length + 1 :, k] = -99
    return reward, actions, mu, lengths, np.array([True, False, True])[:trials], rows, pi, average, q


def test_the_directions_of_an_episode_are_the_means_of_its_steps():
    reward, actions, mu, lengths, cut, rows, pi, average, q = episode = random_episode(np.random.default_rng(7))
    gamma, truncation, delta, entropy = 0.9, 1.5, 0.3, 0.2
    found = acer.output_directions(*episode, gamma, truncation, delta, entropy)
    policy, critic, value, bound = np.zeros(pi.shape), np.zeros(pi.shape), np.zeros(3), np.zeros(3)
    for k, length in enumerate(lengths):
        for i in range(2):
            net = 2 * k + i
            at, chosen = rows[: length + 1, k, i], actions[:length, k, i]
            v = (pi[net, at] * q[net, at]).sum(-1)
            taken = net, at[:-1], chosen
            ratio = pi[taken] / mu[np.arange(length), k, i, chosen]
            target = forward_retrace(reward[:length, k], ratio, q[taken], v[:-1], v[-1] if cut[k] else 0.0, gamma)
            for t in range(length):
                p, old, mean = pi[net, at[t]], mu[t, k, i], average[net, at[t]]
                g = np.maximum(0, 1 - truncation / (p / old)) * (q[net, at[t]] - v[t])
                g += np.eye(4)[chosen[t]] * min(truncation, ratio[t]) * (target[t] - v[t]) / p
                g -= entropy * (np.log(p) + 1)
                far = -mean / p @ g - delta
                g -= max(0, far / (mean / p @ (mean / p))) * -mean / p
                policy[net, at[t]] += p * (g - p @ g) / length
                critic[net, at[t], chosen[t]] += (target[t] - q[net, at[t], chosen[t]]) / length
                bound[k] += (far > 0) / (2 * length)
                value[k] += q[net, at[t], chosen[t]] / (2 * length)
    for one, expected in zip(found, (policy, critic, value, bound), strict=True):
        assert np.abs(one - expected).max() < 1e-12
    assert 0.1 < bound.mean() < 0.9


def test_the_trust_region_changes_nothing_around_the_average_policy():
    """There k = -1 for all actions, and the same for all probabilities is nothing for the logits."""
    *episode, average, q = random_episode(np.random.default_rng(8))
    pi = episode[-1]
    (free, *_, never), (held, *_, often) = (
        acer.output_directions(*episode, pi, q, 0.9, 10.0, delta, 0.01) for delta in (1e9, 0.1)
    )
    assert (never.max(), often.min() > 0.2) == (0, True)
    assert np.abs(free).max() > 0.1
    assert np.abs(held - free).max() < 1e-12
    elsewhere = acer.output_directions(*episode, average, q, 0.9, 10.0, 0.1, 0.01)[0]
    assert np.abs(elsewhere - free).max() > 0.01


def test_where_nothing_is_to_be_gained_the_entropy_grows():
    reward, actions, mu, lengths, cut, rows, pi, average, q = random_episode(np.random.default_rng(9), trials=1)
    direction, *_ = acer.output_directions(0 * reward, actions, mu, lengths, cut, rows, pi, average, 0 * q, 0.9, 10.0, 1e9, 0.3)
    logits = torch.tensor(pi).log().requires_grad_()
    probs = torch.softmax(logits, -1)
    entropy = -(probs * probs.log()).sum(-1)  # [num_nets, U]
    mean = sum(entropy[i, row] for i in range(2) for row in rows[:9, 0, i]) / 9
    assert direction == pytest.approx(0.3 * torch.autograd.grad(mean, logits)[0].numpy(), abs=1e-12)


def test_the_networks_see_every_observation_once():
    rng = np.random.default_rng(10)
    lengths = np.array([7, 0, 30])
    obs = np.eye(5, dtype=np.float32)[rng.integers(5, size=(31, 3, 2))]
    obs[:, 2] = rng.normal(size=(31, 2, 5))
    obs[30, 2] = obs[4, 2]  # what comes after the last step has been seen before
    for k, length in enumerate(lengths):
        obs[length + 1 :, k] = np.nan
    distinct, rows = acer.distinct_rows(obs, lengths + 1)
    assert distinct.shape == (6, 30, 5)
    for k, length in enumerate(lengths):
        for i in range(2):
            seen, own, net = obs[: length + 1, k, i], rows[: length + 1, k, i], 2 * k + i
            assert np.array_equal(distinct[net, own], seen)
            assert own.max() + 1 == len({place.tobytes() for place in seen})
            assert not distinct[net, own.max() + 1 :].any()


def test_probabilities_are_never_nought():
    logits = torch.tensor([[0.0, 1.0, 2.0], [0.0, -300.0, 300.0]], requires_grad=True)
    pi = acer.probabilities(logits)
    assert pi.dtype == np.float64
    assert pi[0] == pytest.approx(np.exp([0, 1, 2]) / np.exp([0, 1, 2]).sum(), abs=1e-7)
    assert pi[1] == pytest.approx([1e-8, 1e-8, 1], abs=1e-12)


# --- the replay ---

MAX_STEPS = 12


def random_rollout(rng, lengths):
    """A random episode of every trial as a rollout, and the probabilities of its actions."""
    longest, trials = max(lengths), len(lengths)
    rollout = SimpleNamespace(
        all_obs=rng.normal(size=(longest + 1, trials, 2, 5)).astype(np.float32),
        actions=rng.integers(4, size=(longest, trials, 2)),
        reward=rng.normal(size=(longest, trials, 1)).repeat(2, axis=2),
        lengths=np.array(lengths),
        outcomes=rng.integers(3, size=trials),
        played=np.arange(longest)[:, None] < lengths,
    )
    return rollout, rng.random((longest, trials, 2, 4)).astype(np.float32)


def empty_replay(trials, num_episodes, size):
    return acer.EpisodeReplay(envs.make_world("pushbox", max_steps=MAX_STEPS), trials, num_episodes, size)


def kept_of(lengths, size):
    """Numbers of the episodes in a ring: from the newest on backwards as long as T + 1 rows of each fit."""
    kept, rows = [], 0
    for episode in range(len(lengths) - 1, -1, -1):
        rows += lengths[episode] + 1
        if rows > size:
            break
        kept.append(episode)
    return kept[::-1]


@pytest.mark.parametrize("size", [1, 40, 1000])
def test_the_replay_keeps_the_last_whole_episodes(size):
    rng, trials, num_episodes = np.random.default_rng(size), 3, 60
    replay, episodes, forgotten = empty_replay(trials, num_episodes, size), [], 0
    for episode in range(num_episodes):
        episodes.append(random_rollout(rng, rng.integers(1, MAX_STEPS + 1, trials)))
        replay.add(episode, *episodes[-1])
        kept = [kept_of([one.lengths[k] for one, _ in episodes], max(size, MAX_STEPS + 1)) for k in range(trials)]
        drawn = [replay.draw(episode, [np.random.default_rng([seed, k]) for k in range(trials)]) for seed in range(20)]
        for k in range(trials):
            fresh = [np.random.default_rng([seed, k]).integers(kept[k][0], episode + 1) for seed in range(20)]
            assert [draw[k] for draw in drawn] == fresh
            forgotten += episode + 1 - len(kept[k])
        for chosen in ([one[0] for one in kept], [one[-1] for one in kept], [rng.choice(one) for one in kept]):
            found = replay.read(np.array(chosen))
            for k, number in enumerate(chosen):
                (rollout, mu), length = episodes[number], episodes[number][0].lengths[k]
                assert (found.lengths[k], found.outcomes[k]) == (length, rollout.outcomes[k])
                assert np.array_equal(found.obs[: length + 1, k], rollout.all_obs[: length + 1, k])
                steps = rollout.actions, mu, rollout.reward[:, :, 0]
                for name, expected in zip(("actions", "mu", "reward"), steps, strict=True):
                    assert np.array_equal(getattr(found, name)[:length, k], expected[:length, k])
    assert (forgotten > 1000) == (size < 1000)


def test_every_kept_episode_is_drawn_equally_often():
    replay, rng = empty_replay(1, 9, 30), np.random.default_rng(0)
    for episode, length in enumerate([12, 12, 3, 1, 12, 5]):
        replay.add(episode, *random_rollout(rng, [length]))
    draws = np.array([replay.draw(5, [rng])[0] for _ in range(8000)])
    assert np.bincount(draws, minlength=6)[2:] == pytest.approx(4 * [2000], rel=0.1)
    assert draws.min() == 2  # 4 + 2 + 13 + 6 rows are 25, and the second episode would take 13 more


# --- whole runs ---


def plain_update(steps, cut, params, q_params, average, net, numbers):
    """What one agent learns from an episode, step by step in double precision.

    steps: obs [T + 1, obs_dim], actions [T], mu [T, num_actions], reward [T]
    -> (o, a, weight) of the policy's steps, the direction of the critic, Q of the actions taken, where the trust region binds
    """
    obs, actions, mu, reward = steps
    gamma, truncation, delta, entropy = numbers
    own, own_average = ([param[net].double() for param in network] for network in (params, average))
    own_q = [param[net].double().requires_grad_() for param in q_params]
    pi, mean = (torch.stack([torch.softmax(plain_logits(one, o), 0) for o in obs]).numpy() for one in (own, own_average))
    q_all = torch.stack([plain_logits(own_q, o) for o in obs])
    q, length = q_all.detach().numpy(), len(actions)
    value, taken = (pi * q).sum(1), (np.arange(length), actions)
    ratio = pi[taken] / mu[taken]
    target = forward_retrace(reward / 10, ratio, q[taken], value[:-1], value[-1] if cut else 0.0, gamma)
    policy_steps, binds = [], []
    for t in range(length):
        g = np.maximum(0, 1 - truncation * mu[t] / pi[t]) * (q[t] - value[t]) - entropy * (np.log(pi[t]) + 1)
        g[actions[t]] += min(truncation, ratio[t]) * (target[t] - value[t]) / pi[t, actions[t]]
        k = -mean[t] / pi[t]
        binds.append(k @ g > delta)
        z = g - max(0, (k @ g - delta) / (k @ k)) * k
        policy_steps += [(obs[t], a, pi[t, a] * z[a] / length) for a in range(len(z))]
    loss = sum((target[t] - q_all[t, actions[t]]) ** 2 for t in range(length)) / (2 * length)
    return policy_steps, [-grad for grad in torch.autograd.grad(loss, own_q)], q[taken], binds, ratio


@each_setting
def test_every_update_is_that_of_the_equations(env, optimizer, tmp_path, monkeypatch):
    """12 episodes of the script, two updates after each, against equations 5 and 9-12 written out for one step at a time."""
    updates = record_all_updates(acer, monkeypatch)
    seed, trials, num_episodes, size, decay, rates = 6, 2, 12, 40, 0.7, (0.02, 0.01)
    numbers = gamma, truncation, delta, entropy = 0.9, 1.1, 0.3, 0.03
    result = train(
        *(acer, tmp_path),
        **dict(env=env, optimizer=optimizer, seed=seed, num_trials=trials, num_episodes=num_episodes, max_steps=10),
        **dict(log_every=1, learning_rate=rates[0], critic_learning_rate=rates[1], gamma=gamma, truncation=truncation),
        **dict(trust_region=delta, entropy=entropy, average_decay=decay, buffer_size=size),
    )
    assert len(updates) == 4 * num_episodes
    learn = [np.random.default_rng(np.random.SeedSequence(seed + k).spawn(3)[2]) for k in range(trials)]
    shown = [curves(tmp_path / f"seed{seed + k}") for k in range(trials)]
    average, played, ages, ratios, cuts = [param.double() for param in updates[0].params], [], [], [], []
    for episode in range(num_episodes):
        rollout = updates[4 * episode].rollout
        acting = [param.double() for param in updates[4 * episode].params]
        played.append([])
        for k, length in enumerate(rollout.lengths):
            obs, actions = rollout.all_obs[: length + 1, k], rollout.actions[:length, k]
            mu = [
                torch.stack([torch.softmax(plain_logits([p[2 * k + i] for p in acting], o), 0) for o in obs[:-1, i]]).numpy()
                for i in range(2)
            ]
            played[-1].append((obs, actions, mu, rollout.reward[:length, k, 0], rollout.outcomes[k] == 0))
            cuts.append(rollout.outcomes[k] == 0)
        kept = [kept_of([len(one[k][3]) for one in played], size) for k in range(trials)]
        old = [generator.integers(kept[k][0], episode + 1) for k, generator in enumerate(learn)]
        ages += [episode - number for number in old]
        binding = np.zeros(trials)
        for which, chosen in enumerate(([episode] * trials, old)):
            update, critic_update = updates[4 * episode + 2 * which : 4 * episode + 2 * which + 2]
            steps_of, value = [], np.zeros(trials)
            for k in range(trials):
                obs, actions, mu, reward, cut = played[chosen[k]][k]
                for i in range(2):
                    net = 2 * k + i
                    steps = obs[:, i], actions[:, i], mu[i], reward
                    policy_steps, direction, q_taken, binds, ratio = plain_update(
                        steps, cut, update.params, critic_update.params, average, net, numbers
                    )
                    steps_of.append(policy_steps)
                    for found, expected in zip(critic_update.direction, direction, strict=True):
                        assert np.allclose(found[net], expected, rtol=1e-4, atol=1e-6 + 1e-5 * float(expected.abs().max()))
                    value[k] += 10 * np.mean(q_taken) / 2
                    binding[k] += np.mean(binds) / 4
                    ratios.append(ratio)
            assert_same_direction(update.direction, update.params, steps_of)
            if which == 0:
                assert [shown[k]["charts/value"][episode][1] for k in range(trials)] == pytest.approx(value, abs=1e-4)
            following = 4 * episode + 2 * which + 2
            after = updates[following].params if following < len(updates) else weights(result.policy)
            average = [decay * slow + (1 - decay) * fast.double() for slow, fast in zip(average, after, strict=True)]
        assert [shown[k]["charts/trust_region"][episode][1] for k in range(trials)] == pytest.approx(binding, abs=1e-6)
    assert all(np.allclose(a, b, atol=1e-5) for a, b in zip(average, weights(result.average), strict=True))

    # What these tests would not see if it did not happen.
    assert max(ages) > 1
    assert kept[0][0] > 5
    assert any(cuts)
    assert env == "findtreasure" or not all(cuts)
    ratios = np.concatenate(ratios)
    assert (ratios > truncation).sum() > 50
    assert (ratios < 0.9).sum() > 50
    assert 0.02 < np.mean([value for k in range(trials) for _, value in shown[k]["charts/trust_region"]]) < 0.98

    # The steps of both optimisers: the critic's is always a persistent Adam.
    for first, kind, rate, last in (0, optimizer, rates[0], result.policy), (1, "adam", rates[1], result.critic):
        own = updates[first::2]
        ordinary = [param.clone() for param in own[0].params]
        adam = torch.optim.Adam(ordinary, lr=rate)
        for update, after in zip(own, [*(one.params for one in own[1:]), weights(last)], strict=True):
            for param, direction in zip(ordinary, update.direction, strict=True):
                param.grad = -direction
            (torch.optim.Adam(ordinary, lr=rate) if kind == "sign" else adam).step()
            assert all(np.allclose(a, b, atol=2e-5) for a, b in zip(ordinary, after, strict=True))


def test_acer_finds_the_treasure(tmp_path):
    log = train(acer, tmp_path, env="findtreasure", optimizer="adam", num_trials=4, num_episodes=700).log
    assert (log.outcomes[:, :40] == 1).mean() < 0.8  # it was not easy
    assert (log.outcomes[:, -60:] == 1).mean(1).min() > 0.9
    assert log.means(slice(-60, None))["reward_per_step"].min() > 4
