"""DQN: epsilon-greedy play, the replay, the errors that are descended, every update against plain loops, known fixed points."""

from itertools import groupby
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import dqn
from envs.rollout import draw_action
from envs.run import load, play_teams
from tests.helpers import Update, curves, plain_logits, record_rollouts, train, use_double_precision, weights
from tests.test_pg import CLIMB, generators

# --- acting ---


def play_probabilities(values, epsilon):
    """Of one agent's actions, for what its network says."""
    probs = np.full(len(values), np.nan)
    envs.epsilon_greedy(np.array(values, np.float32), probs, epsilon)
    return probs


@pytest.mark.parametrize("epsilon", [1.0, 0.4, 0.05])
def test_the_best_action_is_played_but_with_probability_epsilon_any(epsilon):
    for values in np.random.default_rng(0).normal(scale=10, size=(6, 5)):
        expected = np.full(5, epsilon / 5)
        expected[values.argmax()] = 1 - epsilon * 4 / 5
        assert np.abs(play_probabilities(values, epsilon) - expected).max() < 1e-12


def test_without_randomness_only_the_best_action_is_played():
    assert play_probabilities([1, 3, 2], 0.0).tolist() == [0, 1, 0]
    assert play_probabilities([-5, -6, -7], 0.0).tolist() == [1, 0, 0]


def test_of_equally_good_actions_the_first_is_best():
    for values, best in ([0, 0, 0], 0), ([1, 2, 2], 1), ([3, 3, -1], 0):
        expected = np.full(3, 0.1)
        expected[best] = 0.8
        assert play_probabilities(values, 0.3) == pytest.approx(expected)


def test_drawn_actions_have_these_frequencies_and_the_likeliest_is_the_best():
    even = (np.arange(4000) + 0.5) / 4000
    for values in np.random.default_rng(1).normal(size=(6, 4)):
        probs, best = play_probabilities(values, 0.05), values.argmax()
        frequencies = np.bincount([draw_action(probs, u, False) for u in even], minlength=4) / len(even)
        assert np.abs(frequencies - np.where(np.arange(4) == best, 0.9625, 0.0125)).max() < 2 / len(even)
        assert draw_action(probs, 0.5, True) == best


def test_some_of_the_networks_say_what_they_say_among_all():
    policy = dqn.StackedMLP(generators(0, 1, 2), 2, [4, 8, 5])
    obs = torch.rand(6, 1, 4, generator=torch.Generator().manual_seed(0))
    nets = np.array([1, 0, 0, 0, 1, 1], bool)
    assert torch.equal(dqn.some_of(policy, nets)(obs[nets]), policy(obs)[nets])
    assert torch.equal(dqn.some_of(policy, slice(None))(obs), policy(obs))
    assert len(policy.params[0]) == 6


@pytest.mark.parametrize("exploration", [0.2, 1.0])
def test_epsilon_falls_linearly_and_then_stays(exploration, tmp_path, monkeypatch):
    seen = []

    class WatchedRollout(dqn.Rollout):
        def play(self, params, generators, epsilon):
            assert self.head is envs.epsilon_greedy
            seen.append(epsilon)
            super().play(params, generators, epsilon)

    monkeypatch.setattr(dqn, "Rollout", WatchedRollout)
    train(dqn, tmp_path, num_episodes=50, max_steps=3, exploration=exploration, log_every=1)
    expected = np.interp(np.arange(50), [0, 50 * exploration], [1, 0.05])
    assert seen == pytest.approx(expected)
    assert [value for _, value in curves(tmp_path / "seed1")["charts/epsilon"]] == pytest.approx(expected)


def shares_of_best(policy, rollouts):
    """How often the agents of the first trial have played what their networks say is best, in every rollout."""
    obs, actions = (np.array(part) for part in zip(*((r.all_obs[:-1, 0], r.actions[:, 0]) for r in rollouts), strict=True))
    best = policy(obs.reshape(-1, *obs.shape[2:]).swapaxes(0, 1)).argmax(-1).numpy().T.reshape(actions.shape)
    return (best == actions).mean((1, 2))  # obs [episodes, steps, agents, obs_dim], actions [episodes, steps, agents]


def test_agents_play_at_random_first_and_then_what_their_networks_say_is_best(tmp_path, monkeypatch):
    rollouts = record_rollouts(dqn, monkeypatch)
    policy = train(dqn, tmp_path, env="cleaner", num_episodes=20, exploration=0.5, learning_rate=0.0, train_every=100).policy
    best = shares_of_best(policy, rollouts)
    assert best[0] == pytest.approx(0.25, abs=0.1)
    assert best[10:].mean() == pytest.approx(0.9625, abs=0.015)


@pytest.mark.parametrize(("greedy", "share"), [(False, 0.9625), (True, 1)])
def test_a_saved_team_plays_with_the_last_epsilon_or_greedily(greedy, share, tmp_path, monkeypatch):
    train(dqn, tmp_path, env="cleaner", num_episodes=1, train_every=1000, save_model=True)
    args, world, team = load(tmp_path / "policy.pt", dqn)
    args.greedy, rollouts = greedy, record_rollouts(envs, monkeypatch)
    play_teams(args, world, team, 10, tmp_path / "team.gif")
    assert shares_of_best(team.policy, rollouts).mean() == pytest.approx(share, abs=0 if greedy else 0.015)


# --- the replay ---

MAX_STEPS = 6


def replay_of(trials, size):
    return dqn.ConcurrentReplay(envs.make_world("pushbox", max_steps=MAX_STEPS), trials, size)


def marked_rollout(episode, lengths, outcomes):
    """A rollout in whose observations, actions and rewards stand trial, agent, episode and time; nan where nothing was seen."""
    lengths, outcomes = np.array(lengths), np.array(outcomes)
    longest, trials = lengths.max(), len(lengths)
    all_obs = np.full((longest + 1, trials, 2, 5), np.nan, np.float32)
    actions, reward = np.full((longest, trials, 2), -1), np.full((longest, trials, 2), np.nan)
    for k in range(trials):
        for t in range(lengths[k] + 1):
            for i in range(2):
                all_obs[t, k, i] = k, i, episode, t, 0
                if t < lengths[k]:
                    actions[t, k, i], reward[t, k, i] = 2 * (10 * episode + t) + i, 10 * episode + t
    ends = dict(terminated=outcomes > 0, played=np.arange(longest)[:, None] < lengths)
    return SimpleNamespace(all_obs=all_obs, actions=actions, reward=reward, lengths=lengths, outcomes=outcomes, **ends)


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


def double_networks(monkeypatch):
    with monkeypatch.context() as patched:
        use_double_precision(dqn, patched)
        return [dqn.StackedMLP(generators(*seeds), 2, [3, 8, 4]) for seeds in ((0, 1), (2, 3))]


def values(params, net, obs):
    """Q(o, .) of one network by plain products."""
    return plain_logits([param[net].detach().double() for param in params], obs).numpy()


@pytest.mark.parametrize("terminated", [0, 1])
def test_the_error_is_that_of_the_bellman_equation(terminated, monkeypatch):
    policy, target = double_networks(monkeypatch)
    obs, actions, next_obs, reward, ended = random_batch(np.random.default_rng(terminated), 4, terminated)
    found = dqn.squared_td_errors(policy, target, (obs, actions, next_obs, reward, ended), 0.9)
    for net, b in np.ndindex(4, 7):
        q = values(policy.params, net, obs[net, b])[actions[net, b]]
        y = reward[net, b].item() + (0 if terminated else 0.9 * values(target.params, net, next_obs[net, b]).max())
        assert found[net, b].item() == pytest.approx((y - q) ** 2, rel=1e-12)


def test_the_end_of_the_world_has_exactly_its_reward_as_target(monkeypatch):
    policy, _ = double_networks(monkeypatch)
    batch = random_batch(np.random.default_rng(0), 4, terminated=1)
    obs, actions, next_obs, reward, _ = batch
    errors = [dqn.squared_td_errors(policy, target, batch, 0.9) for target in double_networks(monkeypatch)]
    errors.append(dqn.squared_td_errors(policy, policy, (obs, actions, 1e6 * next_obs, reward, batch[4]), 0.9))
    q = policy(obs).gather(-1, actions[..., None])[..., 0]
    assert all(torch.equal(error, (reward - q) ** 2) for error in errors)


def test_no_gradient_flows_through_the_target(monkeypatch):
    policy, _ = double_networks(monkeypatch)
    obs, actions, next_obs, reward, ended = random_batch(np.random.default_rng(0), 4, terminated=0)
    found = torch.autograd.grad(
        dqn.squared_td_errors(policy, policy, (obs, actions, next_obs, reward, ended), 0.9).sum(), policy.params
    )
    y = (reward + 0.9 * policy(next_obs).amax(-1)).detach()
    error = y - policy(obs).gather(-1, actions[..., None])[..., 0]
    expected = torch.autograd.grad(error.square().sum(), policy.params)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


# --- fixed points ---


def test_independent_learners_of_the_climb_game_learn_the_means_over_their_teammates_actions():
    """Relative over-generalisation: where 11 and 7 are to be had, they end up with 5."""
    policy = dqn.StackedMLP(generators(0), 2, [1, 16, 3])
    optimizer = dqn.MaskedAdam(policy.params, 1, 0.01)
    actions = torch.cartesian_prod(torch.arange(3), torch.arange(3)).T  # all joint actions, [2, 9]
    reward, ones = torch.from_numpy(CLIMB).float().reshape(1, 9).repeat(2, 1), torch.ones(2, 9, 1)
    for _ in range(800):
        loss = dqn.squared_td_errors(policy, policy, (ones, actions, ones, reward / 10, ones[..., 0]), 0.9).mean(1).sum()
        optimizer.step(loss, np.array([True]))
    found = 10 * policy(ones[:, :1]).detach().numpy()[:, 0]
    assert np.abs(found - [CLIMB.mean(1), CLIMB.mean(0)]).max() < 0.01
    assert found.argmax(1).tolist() == [2, 2]


@envs.rule
def stay(rules, state, actions):
    """One state and a reward of 1; the world ends with step `rules[0]`."""
    state[0] += 1
    return 1.0, 1 if state[0] == rules[0] else 0


@envs.rule
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
    monkeypatch.setattr(dqn, "resolve", lambda args, *_: (args, world))
    args = dict(env="loop", hidden=(16,), gamma=0.9, exploration=1.0, learning_rate=1e-3, num_episodes=300)
    policy = train(dqn, tmp_path, **args, train_every=1, target_every=20, batch_size=2000, replay_size=500).policy
    assert 10 * policy(torch.ones(2, 1, 1)).detach().numpy() == pytest.approx(np.full((2, 1, 1), expected), rel=0.05)


# --- the steps ---


def test_the_optimiser_is_torchs_adam_for_each_trial_by_its_own_count():
    rng, policy = np.random.default_rng(1), dqn.StackedMLP(generators(0, 1, 2, 3), 2, [3, 5, 2])
    optimizer = dqn.MaskedAdam(policy.params, 4, 0.01)
    single = [[param[2 * k : 2 * k + 2].detach().clone() for param in policy.params] for k in range(4)]
    adams = [torch.optim.Adam(own, lr=0.01) for own in single]
    for step in range(60):
        grads = [
            torch.from_numpy(rng.normal(size=p.shape) * 10.0 ** rng.integers(-6, 4, p.shape)).float() for p in policy.params
        ]
        active = rng.random(4) < ([1, 1, 1, 1] if step % 5 == 0 else [0, 0.5, 0.9, 0.5])
        before, kept = weights(policy), [array.copy() for array in optimizer.state]
        optimizer.step(sum((grad * param).sum() for grad, param in zip(grads, policy.params, strict=True)), active)
        for old, new in zip([*kept, *before], [*optimizer.state, *weights(policy)], strict=True):
            still = ~active.repeat(len(new) // 4)
            assert np.array_equal(new[still], old[still])
        for k in np.flatnonzero(active):
            for param, grad in zip(single[k], grads, strict=True):
                param.grad = grad[2 * k : 2 * k + 2]
            adams[k].step()
        for k in range(4):
            for stacked, own in zip(policy.params, single[k], strict=True):
                assert torch.allclose(stacked[2 * k : 2 * k + 2], own, rtol=0, atol=1e-5)
    counts = [int(adam.state[own[0]]["step"]) for adam, own in zip(adams, single, strict=True)]
    assert optimizer.count.tolist() == counts
    assert len(set(counts)) > 1


# --- whole runs ---


def record_updates(monkeypatch, module=dqn):
    """A list that gets every `Update` that the script makes from now on."""
    updates, rollouts = [], record_rollouts(module, monkeypatch)

    class WatchedAdam(module.MaskedAdam):
        def step(self, loss, active):
            grads = torch.autograd.grad(loss, self.weights, retain_graph=True)
            params = [param.detach().clone() for param in self.weights]
            updates.append(Update(rollouts[-1], params, [-grad for grad in grads]))
            super().step(loss, active)

    monkeypatch.setattr(module, "MaskedAdam", WatchedAdam)
    return updates


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
            row = self.count % self.size
            self.ring[row : row + 1] = [self.kept(rollout, t, k, terminated)]  # appends until the ring is full
            self.count += 1
        due, copied = (self.count // every - before // every for every in (self.train_every, self.target_every))
        rows = self.learn.integers(len(self.ring), size=(due, self.batch_size))
        return [[self.ring[row] for row in batch] for batch in rows], copied > 0

    def kept(self, rollout, t, k, terminated):
        """What it keeps of a step."""
        return rollout.all_obs[t, k], rollout.actions[t, k], rollout.reward[t, k, 0], rollout.all_obs[t + 1, k], terminated


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
    updates = record_updates(monkeypatch)
    every = dict(batch_size=5, train_every=3, target_every=20)
    args = dict(env=env, seed=4, num_trials=3, num_episodes=12, max_steps=11, learning_rate=0.05, gamma=0.9, log_every=1)
    run = train(dqn, tmp_path, **args, **every, replay_size=30)
    afters = [*(update.params for update in updates[1:]), weights(run.policy)]
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
            start = [values(after, agent, rollout.all_obs[0, k, agent]).max() for agent in range(2)]
            assert value[episode] == (trial.count, pytest.approx(10 * np.mean(start), rel=1e-5))
            counts.append((len(batches), len(pairs)))
        assert same(of_trial(weights(run.target), k), trial.target)
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
