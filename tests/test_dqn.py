"""DQN: epsilon-greedy play, the replay, the errors that are descended, every update against plain loops, known fixed points."""

from itertools import groupby
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numba import njit

import envs
from algos import dqn
from tests.helpers import curves, plain_logits, record_updates, train, use_double_precision
from tests.test_pg import CLIMB, generators

# --- acting ---


class FixedValues(dqn.Policy):
    """A policy with given action values [num_nets, 1, num_actions] of every observation."""

    def __init__(self, values):
        self.values = torch.as_tensor(np.array(values), dtype=torch.float32)

    def q_values(self, obs):
        return self.values


def play_probabilities(values, epsilon):
    policy = FixedValues(values)
    policy.epsilon = epsilon
    return torch.exp(policy(None)).numpy()


@pytest.mark.parametrize("epsilon", [1.0, 0.4, 0.05])
def test_the_best_action_is_played_but_with_probability_epsilon_any(epsilon):
    values = np.random.default_rng(0).normal(scale=10, size=(6, 1, 5))
    expected = np.full(values.shape, epsilon / 5)
    np.put_along_axis(expected, values.argmax(-1)[..., None], 1 - epsilon * 4 / 5, axis=-1)
    assert np.abs(play_probabilities(values, epsilon) - expected).max() < 1e-6


def test_without_randomness_only_the_best_action_is_played():
    with np.errstate(divide="ignore"):
        assert play_probabilities([[[1, 3, 2]], [[-5, -6, -7]]], 0.0).tolist() == [[[0, 1, 0]], [[1, 0, 0]]]


def test_of_equally_good_actions_one_is_best():
    for values in ([0, 0, 0], [1, 2, 2], [3, 3, -1]):
        probabilities = play_probabilities([[values]], 0.3)[0, 0]
        assert sorted(probabilities) == pytest.approx([0.1, 0.1, 0.8])
        assert values[probabilities.argmax()] == max(values)


def test_drawn_actions_have_these_frequencies_and_the_likeliest_is_the_best():
    values = np.random.default_rng(1).normal(size=(6, 1, 4))
    policy, draws = FixedValues(values), 4000
    log_probs = policy(None).view(3, 2, 4).numpy()
    even = (np.arange(draws) + 0.5) / draws
    actions = np.array([dqn.sample_actions(log_probs, np.full((3, 2), u)) for u in even])
    best = values.reshape(3, 2, 4).argmax(-1)
    assert np.array_equal(log_probs.argmax(-1), best)
    frequencies = np.stack([(actions == a).mean(0) for a in range(4)], -1)
    assert np.abs(frequencies - np.where(np.arange(4) == best[..., None], 0.9625, 0.0125)).max() < 2 / draws


def test_a_part_of_the_policy_plays_as_the_whole():
    policy = dqn.Policy(generators(0, 1, 2), 2, [4, 8, 5])
    obs = torch.rand(6, 1, 4, generator=torch.Generator().manual_seed(0))
    assert float(torch.exp(policy(obs)).min()) == pytest.approx(0.01)  # what a saved team plays with
    policy.epsilon = 0.5
    nets = np.array([4, 5, 0])
    assert torch.equal(policy.subset(nets)(obs[nets]), policy(obs)[nets])


@pytest.mark.parametrize("exploration", [0.2, 1.0])
def test_epsilon_falls_linearly_and_then_stays(exploration, tmp_path, monkeypatch):
    seen, collect = [], dqn.collect

    def watched_collect(env, policy, *args):
        seen.append(policy.epsilon)
        collect(env, policy, *args)
        assert policy.epsilon == seen[-1]

    monkeypatch.setattr(dqn, "collect", watched_collect)
    train(dqn, tmp_path, num_episodes=50, max_steps=3, exploration=exploration, log_every=1)
    expected = np.interp(np.arange(50), [0, 50 * exploration], [1, 0.05])
    assert seen == pytest.approx(expected)
    assert [value for _, value in curves(tmp_path / "seed1")["charts/epsilon"]] == pytest.approx(expected)


def test_agents_play_at_random_first_and_then_what_their_networks_say_is_best(tmp_path, monkeypatch):
    played, collect = [], dqn.collect

    def watched_collect(env, policy, uniforms, rollout):
        collect(env, policy, uniforms, rollout)
        played.append((rollout.obs[:-1, 0].copy(), rollout.actions[:, 0].copy()))

    monkeypatch.setattr(dqn, "collect", watched_collect)
    policy = train(dqn, tmp_path, env="cleaner", num_episodes=20, exploration=0.5, learning_rate=0.0, train_every=100).policy
    obs, actions = (torch.from_numpy(np.array(part)) for part in zip(*played, strict=True))  # [episodes, steps, agents, ..]
    best = policy.q_values(obs.flatten(0, 1).transpose(0, 1)).argmax(-1).T.reshape(actions.shape) == actions
    assert best[0].double().mean() == pytest.approx(0.25, abs=0.1)
    assert best[10:].double().mean() == pytest.approx(0.9625, abs=0.015)


# --- the replay ---

MAX_STEPS = 6


def replay_of(trials, size):
    return dqn.ConcurrentReplay(envs.make_vec("pushbox", trials, max_steps=MAX_STEPS), size)


def marked_rollout(episode, lengths, outcomes):
    """A rollout in whose observations, actions and rewards stand trial, agent, episode and time; nan where nothing was seen."""
    lengths, outcomes = np.array(lengths), np.array(outcomes)
    trials = len(lengths)
    obs = np.full((MAX_STEPS + 1, trials, 2, 5), np.nan, np.float32)
    actions, reward = np.full((MAX_STEPS, trials, 2), -1), np.full((MAX_STEPS, trials), np.nan)
    for k in range(trials):
        for t in range(lengths[k] + 1):
            for i in range(2):
                obs[t, k, i] = k, i, episode, t, 0
                if t < lengths[k]:
                    actions[t, k, i], reward[t, k] = 2 * (10 * episode + t) + i, 10 * episode + t
    return SimpleNamespace(obs=obs, actions=actions, reward=reward, lengths=lengths, outcomes=outcomes)


@pytest.mark.parametrize("size", [3, 20, 200])
def test_all_agents_draw_the_same_of_the_last_steps(size):
    rng = np.random.default_rng(size)
    replay, kept, last = replay_of(3, size), [[], [], []], {}
    for episode in range(15):
        lengths = rng.integers(1, MAX_STEPS + 1, 3)
        outcomes = np.where(lengths == MAX_STEPS, rng.integers(2, size=3), rng.integers(1, 5, 3))
        replay.add(marked_rollout(episode, lengths, outcomes))
        for k in range(3):
            kept[k] = (kept[k] + [(episode, t) for t in range(lengths[k])])[-size:]
            last[k, episode] = lengths[k] - 1, outcomes[k]
        num_batches = np.array([2, 3, 0])
        drawn = replay.draw(generators(1, 2, 3), num_batches, 150)
        assert drawn.shape == (3, 3, 150)
        for batch, trials in zip(drawn, ([0, 1], [0, 1], [1]), strict=True):
            obs, actions, next_obs, reward, terminated = (part.numpy() for part in replay.batch(batch[trials]))
            assert {part.dtype for part in (obs, next_obs, reward, terminated)} == {np.dtype(np.float32)}
            for net in range(2 * len(trials)):
                k, i = trials[net // 2], net % 2
                ids = [(int(episode), int(t)) for episode, t in obs[net, :, 2:4]]
                assert set(ids) <= set(kept[k])
                assert set(ids) == set(kept[k]) or len(kept[k]) > 20  # 150 draws find each of 20 steps
                assert ids == [(int(episode), int(t)) for episode, t in obs[net - i, :, 2:4]]  # as the first agent of the trial
                assert np.array_equal(obs[net][:, :2], [[k, i]] * 150)
                assert np.array_equal(next_obs[net], obs[net] + [0, 0, 0, 1, 0])
                marks = np.array([10 * episode + t for episode, t in ids])
                assert np.array_equal(actions[net], 2 * marks + i)
                assert reward[net] == pytest.approx(marks / 10)
                ended = [t == last[k, episode][0] and last[k, episode][1] > 0 for episode, t in ids]
                assert np.array_equal(terminated[net], np.array(ended, np.float32))
    assert replay.count.tolist() == [sum(last[k, episode][0] + 1 for episode in range(15)) for k in range(3)]


def test_steps_are_drawn_uniformly_and_each_trial_draws_for_itself():
    replay, alone = replay_of(2, 10), replay_of(1, 10)
    replay.add(marked_rollout(0, [4, 6], [1, 0]))
    alone.add(marked_rollout(0, [4], [1]))
    drawn = replay.draw(generators(7, 8), np.array([50, 400]), 25)
    assert np.array_equal(drawn[:50, 0], alone.draw(generators(7), np.array([50]), 25)[:, 0])
    for first, steps, batches in ((0, 4, drawn[:50, 0]), (10, 6, drawn[:, 1])):
        counts = np.bincount(batches.ravel() - first, minlength=10)
        assert not counts[steps:].any()
        assert np.abs(counts[:steps] / batches.size - 1 / steps).max() < 5 * (1 / steps / batches.size) ** 0.5
    assert not np.array_equal(drawn[:50, 0], drawn[50:100, 1] - 10)


# --- the error ---


def random_batch(rng, nets, terminated):
    obs, next_obs = (torch.from_numpy(rng.normal(size=(nets, 7, 3))) for _ in range(2))
    actions, reward = torch.from_numpy(rng.integers(4, size=(nets, 7))), torch.from_numpy(rng.normal(size=(nets, 7)))
    return obs, actions, next_obs, reward, torch.full((nets, 7), terminated).double()


def double_policies(monkeypatch):
    with monkeypatch.context() as patched:
        use_double_precision(dqn, patched)
        return [dqn.Policy(generators(*seeds), 2, [3, 8, 4]) for seeds in ((0, 1), (2, 3))]


def values(params, net, obs):
    """Q(o, .) of one network by plain products."""
    return plain_logits([param[net].detach().double() for param in params], obs).numpy()


@pytest.mark.parametrize("terminated", [0, 1])
def test_the_error_is_that_of_the_bellman_equation(terminated, monkeypatch):
    policy, target = double_policies(monkeypatch)
    obs, actions, next_obs, reward, ended = random_batch(np.random.default_rng(terminated), 4, terminated)
    found = dqn.squared_td_errors(policy, target, (obs, actions, next_obs, reward, ended), 0.9)
    for net, b in np.ndindex(4, 7):
        q = values(policy.params, net, obs[net, b])[actions[net, b]]
        y = reward[net, b].item() + (0 if terminated else 0.9 * values(target.params, net, next_obs[net, b]).max())
        assert found[net, b].item() == pytest.approx((y - q) ** 2, rel=1e-12)


def test_the_end_of_the_world_has_exactly_its_reward_as_target(monkeypatch):
    policy, _ = double_policies(monkeypatch)
    batch = random_batch(np.random.default_rng(0), 4, terminated=1)
    obs, actions, next_obs, reward, _ = batch
    errors = [dqn.squared_td_errors(policy, target, batch, 0.9) for target in double_policies(monkeypatch)]
    errors.append(dqn.squared_td_errors(policy, policy, (obs, actions, 1e6 * next_obs, reward, batch[4]), 0.9))
    q = policy.q_values(obs).gather(-1, actions[..., None])[..., 0]
    assert all(torch.equal(error, (reward - q) ** 2) for error in errors)


def test_no_gradient_flows_through_the_target(monkeypatch):
    policy, _ = double_policies(monkeypatch)
    obs, actions, next_obs, reward, ended = random_batch(np.random.default_rng(0), 4, terminated=0)
    found = torch.autograd.grad(
        dqn.squared_td_errors(policy, policy, (obs, actions, next_obs, reward, ended), 0.9).sum(), policy.params
    )
    y = (reward + 0.9 * policy.q_values(next_obs).amax(-1)).detach()
    error = y - policy.q_values(obs).gather(-1, actions[..., None])[..., 0]
    expected = torch.autograd.grad(error.square().sum(), policy.params)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


# --- fixed points ---


def test_independent_learners_of_the_climb_game_learn_the_means_over_their_teammates_actions():
    """Relative over-generalisation: where 11 and 7 are to be had, they end up with 5."""
    policy = dqn.Policy(generators(0), 2, [1, 16, 3])
    optimizer = dqn.StackedOptimizer(policy.params, "adam", 0.01)
    actions = torch.cartesian_prod(torch.arange(3), torch.arange(3)).T  # all joint actions, [2, 9]
    reward, ones = torch.from_numpy(CLIMB).float().reshape(1, 9).repeat(2, 1), torch.ones(2, 9, 1)
    for _ in range(800):
        loss = dqn.squared_td_errors(policy, policy, (ones, actions, ones, reward / 10, ones[..., 0]), 0.9).mean(1).sum()
        optimizer.step(torch.autograd.grad(loss, policy.params))
    found = 10 * policy.q_values(ones[:, :1]).detach().numpy()[:, 0]
    assert np.abs(found - [CLIMB.mean(1), CLIMB.mean(0)]).max() < 0.01
    assert found.argmax(1).tolist() == [2, 2]


@njit
def stay(rules, state, actions):
    """One state and a reward of 1; the world ends with step `rules[0]`."""
    state[0] += 1
    return 1.0, 1 if state[0] == rules[0] else 0


@njit
def see_nothing(rules, cell, state, obs):
    obs[:] = 1.0


class Loop(envs.World):
    """A world of one state and one action, in which every step earns 1."""

    name, action_names, outcome_names, best_outcome = "loop", ("wait",), ("end",), 1
    step, observe = staticmethod(stay), staticmethod(see_nothing)


@pytest.mark.parametrize(("ends", "expected"), [(99, 10.0), (5, 1 / (1 - 0.9 * 4 / 5))])
def test_the_time_limit_bootstraps_and_an_end_does_not(ends, expected, tmp_path, monkeypatch):
    """Episodes of 5 steps, gamma 0.9: 1 + 0.9 + .. for ever, if the time limit cuts; else one of 5 steps is the last."""
    world = Loop(np.array([ends]), [0], [[0], [0]], num_agents=2, obs_dim=1, cell=1.0, state_scale=[1.0], max_steps=5)
    monkeypatch.setattr(dqn, "resolve", lambda args: (args, envs.GridVectorEnv(world, args.num_trials)))
    args = dict(env="loop", hidden=(16,), gamma=0.9, exploration=1.0, learning_rate=1e-3, num_episodes=300)
    policy = train(dqn, tmp_path, **args, train_every=1, target_every=20, batch_size=2000, buffer_size=500).policy
    assert 10 * policy.q_values(torch.ones(2, 1, 1)).detach().numpy() == pytest.approx(np.full((2, 1, 1), expected), rel=0.05)


# --- whole runs ---


class PlainTrial:
    """What one trial keeps, draws and copies, with lists and its own generator; `target` are the weights of its targets."""

    def __init__(self, seed, target, size, batch_size, train_every, target_every):
        self.learn = np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[2])
        self.target, self.ring, self.count = target, [], 0
        self.size, self.batch_size, self.train_every, self.target_every = size, batch_size, train_every, target_every

    def play(self, rollout, k):
        """Keep trial k's episode; returns the batches that are due then, and whether the target is to be copied after them."""
        before = self.count
        for t in range(rollout.lengths[k]):
            terminated = t + 1 == rollout.lengths[k] and rollout.outcomes[k] > 0
            step = rollout.obs[t, k], rollout.actions[t, k], rollout.reward[t, k], rollout.obs[t + 1, k], terminated
            row = self.count % self.size
            self.ring[row : row + 1] = [step]  # appends until the ring is full
            self.count += 1
        due, copied = (self.count // every - before // every for every in (self.train_every, self.target_every))
        rows = self.learn.integers(len(self.ring), size=(due, self.batch_size))
        return [[self.ring[row] for row in batch] for batch in rows], copied > 0


def plain_descent(params, target, agent, batch, gamma):
    """Minus the gradient of the mean of (y - Q(o, a))^2 over a batch in the network of one agent."""
    own = [param[agent].detach().requires_grad_() for param in params]
    loss = 0
    for obs, actions, reward, next_obs, terminated in batch:
        y = reward / 10 + (0 if terminated else gamma * values(target, agent, next_obs[agent]).max())
        loss = loss + (y - plain_logits(own, obs[agent])[actions[agent]]) ** 2 / len(batch)
    return [-grad for grad in torch.autograd.grad(loss, own)]


def of_trial(params, k):
    return [param[2 * k : 2 * k + 2] for param in params]


def same(some, others):
    return all(map(torch.equal, some, others))


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_descends_the_mean_squared_error_of_its_batch(env, tmp_path, monkeypatch):
    """All updates of 3 trials against the method by plain loops: which steps, how many updates, along which direction."""
    use_double_precision(dqn, monkeypatch)
    updates = record_updates(dqn, monkeypatch)
    every = dict(batch_size=5, train_every=3, target_every=20)
    args = dict(env=env, seed=4, num_trials=3, num_episodes=12, max_steps=11, learning_rate=0.05, gamma=0.9, log_every=1)
    run = train(dqn, tmp_path, **args, **every, buffer_size=30)
    afters = [*(update.params for update in updates[1:]), run.policy.params]
    episodes = [list(group) for _, group in groupby(zip(updates, afters, strict=True), key=lambda pair: id(pair[0].rollout))]
    assert len(episodes) == 12
    copies, counts = 0, []
    for k in range(3):
        trial = PlainTrial(4 + k, of_trial(updates[0].params, k), 30, **every)
        value = curves(tmp_path / f"seed{4 + k}")["charts/value"]
        for episode, pairs in enumerate(episodes):
            rollout = pairs[0][0].rollout
            batches, copied = trial.play(rollout, k)
            for n, (update, after) in enumerate(pairs):
                before, direction, after = (of_trial(some, k) for some in (update.params, update.direction, after))
                assert same(before, after) == (n >= len(batches))
                for agent in range(2 if n < len(batches) else 0):
                    expected = plain_descent(before, trial.target, agent, batches[n], 0.9)
                    for found, part in zip(direction, expected, strict=True):
                        assert torch.allclose(found[agent], part, rtol=1e-5, atol=1e-6)
            if copied:
                trial.target = after
                copies += 1
            start = [values(after, agent, rollout.obs[0, k, agent]).max() for agent in range(2)]
            assert value[episode] == (episode + 1, pytest.approx(10 * np.mean(start), rel=1e-5))
            counts.append((len(batches), len(pairs)))
        assert same(of_trial(run.target.params, k), trial.target)
        assert trial.count > 60  # the ring has turned twice
    assert copies >= 9
    due, made = np.array(counts).reshape(3, 12, 2).transpose(2, 0, 1)
    assert np.array_equal(due.max(0), made[0])
    assert (due < made).any()


def test_dqn_learns_to_push_boxes(tmp_path):
    log = train(dqn, tmp_path, env="pushbox", num_trials=4, num_episodes=500).log
    early, late = (log.means(episodes) for episodes in (slice(0, 20), slice(-100, None)))  # at first they play at random
    assert early["reward_per_step"].max() < 1.0
    assert late["reward_per_step"].mean() > 1.5
    assert early["episodic_length"].min() > 25
    assert late["episodic_length"].max() < 16
