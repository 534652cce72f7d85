"""EDTI: its counts against plain dictionaries and closed forms, every update against plain loops, and learning."""

from collections import Counter
from itertools import product

import numpy as np
import pytest
import torch

import envs
from algos import edti, pg
from tests.helpers import (
    BEST_PLANS,
    assert_same_direction,
    assert_same_run,
    curves,
    each_setting,
    plain_logits,
    record_all_updates,
    train,
    walk,
)
from tests.test_ac import critic_descent, plain_errors


class PlainCounts:
    """One trial's counts in a dictionary that keeps at most `size` of them, as edti.py's table does."""

    def __init__(self, size=10**9):
        self.counts, self.limit, self.joint_limit = Counter(), size * 7 // 8, size * 3 // 4

    def count(self, key, limit):
        if key not in self.counts and len(self.counts) >= limit:
            return 0
        self.counts[key] += 1
        return self.counts[key]

    def p(self, now, actions, after, j, without=None):
        """p(x_j' | x, a), or without what an agent is and does; None if it is unknown."""
        context = tuple((i, *now[i], actions[i]) for i in range(len(now)) if i != without)
        total, part = self.counts[context], self.counts[context, j, tuple(after[j])]
        return part / total if part and total else None

    def add(self, now, actions, after):
        """1 / sqrt(N(x_i') + 1) of every agent and the influence c_ij of one step, which is counted."""
        agents = range(len(now))
        seen = [self.count((i, tuple(after[i])), self.limit) for i in agents]
        for without in [*agents, None]:
            limit = self.joint_limit if without is None else self.limit
            context = tuple((i, *now[i], actions[i]) for i in agents if i != without)
            if self.count(context, limit):
                for j in agents:
                    if j != without:
                        self.count((context, j, tuple(after[j])), limit)
        influence = np.zeros((len(now), len(now)))
        for i, j in product(agents, agents):
            alone, together = self.p(now, actions, after, j, without=i), self.p(now, actions, after, j)
            if i != j and alone and together:
                influence[i, j] = 1 - alone / together
        return [max(n, 1) ** -0.5 for n in seen], influence


class Episode:
    """local_state [T + 1, num_trials, num_agents, d], actions [T, num_trials, num_agents] and lengths [num_trials]."""

    def __init__(self, local_state, actions, lengths):
        self.local_state, self.actions, self.lengths = np.array(local_state), np.array(actions), np.array(lengths)


def one_step_episodes(steps):
    """An episode of one step for each (x, a, x') with x and x' a whole number for every agent, in one trial."""
    for now, actions, after in steps:
        yield Episode(np.array([now, after])[:, None, :, None], [[actions]], [1])


def influences(counts, steps):
    """c of each of the steps [N, num_agents, num_agents], one after the other."""
    return np.array([counts.add(episode)[1][0, 0] for episode in one_step_episodes(steps)])


def probability(counts, now, actions, after, j, without=None):
    """p(x_j' | x, a) that the table of trial 0 holds, or without what an agent is and does."""
    agents = len(now)
    key = edti.extend_key(0, agents if without is None else without)
    for i in range(agents):
        if i != without:
            key = edti.extend_key(edti.extend_key(key, now[i]), actions[i])
    places = [edti.find_place(counts.keys[0], counts.counts[0], k) for k in (key, successor(key, j, after[j]))]
    total, part = counts.counts[0, places]
    return part / total if total else 0.0


def successor(context, j, after):
    return edti.extend_key(edti.extend_key(context, j), after)


# --- the counts ---


@pytest.mark.parametrize("size", [2**14, 101, 8])
@pytest.mark.parametrize("agents", [1, 2, 3])
def test_novelty_and_influence_are_those_of_plain_dictionaries(agents, size):
    rng = np.random.default_rng(agents)
    counts, plain = edti.TransitionCounts(2, size), [PlainCounts(size), PlainCounts(size)]
    positive = 0
    for lengths in ([30, 30], [1, 17], [30, 2], [8, 30]):
        local_state = rng.integers(-1, 2, size=(41, 2, agents, 2))  # rows beyond an episode's end count for nothing
        local_state[:, 1] *= 3  # the trials see different things
        actions = rng.integers(2, size=(40, 2, agents))
        rollout = Episode(local_state, actions[: max(lengths)], lengths)
        novelty, influence = counts.add(rollout)
        assert influence.shape == (*novelty.shape, agents) == (30 if max(lengths) == 30 else 17, 2, agents, agents)
        for k, length in enumerate(lengths):
            for t in range(length):
                new, expected = plain[k].add(local_state[t, k], actions[t, k], local_state[t + 1, k])
                assert novelty[t, k] == pytest.approx(new, abs=1e-14)
                assert influence[t, k] == pytest.approx(expected, abs=1e-14)
                positive += np.sum(expected > 0)
            assert not novelty[length:, k].any()
            assert not influence[length:, k].any()
    assert counts.filled.tolist() == [len(one.counts) for one in plain] == (counts.counts > 0).sum(1).tolist()
    assert counts.counts.sum(1).tolist() == [sum(one.counts.values()) for one in plain]
    assert (positive > 10) == (agents > 1) or size < 2**14


def test_a_full_table_keeps_counting_what_it_knows_and_takes_the_rest_for_new():
    counts = edti.TransitionCounts(1, 16)  # 14 places for all, 12 for joint contexts; one new step of two agents takes 9
    known, other = ((0, 0), (0, 0), (1, 1)), ((5, 5), (1, 1), (6, 6))
    first = [counts.add(episode) for episode in one_step_episodes([known, other, known, other, known])]
    assert counts.filled.tolist() == [14]
    novelty = [one[0, 0].tolist() for one, _ in first]
    assert novelty[::2] == [[1, 1], pytest.approx([2**-0.5] * 2), pytest.approx([3**-0.5] * 2)]
    assert novelty[1::2] == [[1, 1], pytest.approx([2**-0.5] * 2)]  # local states found room
    third = next(one_step_episodes([((7, 7), (1, 1), (8, 8))]))
    for _ in range(3):
        novelty, influence = counts.add(third)
        assert novelty[0, 0].tolist() == [1, 1]
        assert not influence.any()
    assert counts.filled.tolist() == [14]


def test_no_two_of_a_million_sequences_have_the_same_key():
    keys = np.zeros(1, np.int64)
    extend = np.vectorize(edti.extend_key)
    seen = [keys]
    for _ in range(5):
        keys = extend(keys[:, None], np.arange(-1, 15)[None]).ravel()
        seen.append(keys)
    seen = np.concatenate(seen)
    assert len(np.unique(seen)) == len(seen) > 1_000_000
    places = np.bincount(seen % 1024, minlength=1024)
    assert places.max() < 1.3 * places.mean()


def test_independent_deterministic_agents_have_no_influence_from_the_first_step_on():
    rng = np.random.default_rng(0)
    x, a = rng.integers(5, size=(300, 2)), rng.integers(3, size=(300, 2))
    assert not influences(edti.TransitionCounts(1, 2**12), zip(x, a, (x * 3 + a) % 5, strict=True)).any()


def test_the_influence_of_independent_stochastic_agents_vanishes_on_average():
    rng = np.random.default_rng(0)
    x, a, after = rng.integers(2, size=(3, 4000, 2))
    found = influences(edti.TransitionCounts(1, 2**12), zip(x, a, after, strict=True))[:, 0, 1]
    assert found[:100].mean() > 0.05  # a first visit looks like influence
    assert abs(found[2000:].mean()) < 0.01


def test_the_influence_of_who_pushes_a_box():
    """Agent 0 pushes the left small box three times and then waits once, which is to be seen in agent 1's local state."""
    world = envs.make_world("pushbox", size=6)
    before, counts = np.array([0, 2, 0, 5, 0, 0, 3, 3, 3]), edti.TransitionCounts(1, 256)
    for joint, expected in [((0, 3), 0)] * 3 + [((3, 3), 1 - 1 / 4), ((0, 3), 1 - 4 / 5)]:
        after = before.copy()
        world.step(world.rules, after, np.array(joint))
        assert (after[6] == 4) == (joint[0] == 0)
        local_state = np.array([before, after])[:, None, world.local_index]
        assert counts.add(Episode(local_state, [[joint]], [1]))[1][0, 0].tolist() == [[0, pytest.approx(expected)], [0, 0]]


def test_the_influence_of_who_opens_a_door():
    """Agent 1 crosses (0 -> 1) only if agent 0 stands on the lever (1); three times it does, once it does not."""
    opened, closed = ((1, 0), (0, 0), (1, 1)), ((0, 0), (0, 0), (0, 0))
    for order, expected in [([closed, *[opened] * 3], 1 - 3 / 4), ([*[opened] * 3, closed], 1 - 1 / 4)]:
        last = influences(edti.TransitionCounts(1, 64), order)[-1]
        assert last.tolist() == [[0, expected], [0, 0]]


def stochastic_team(steps):
    """Steps of two agents with 3 local states and 2 actions; agent 0's choice decides where agent 1 goes."""
    rng = np.random.default_rng(1)
    law = rng.dirichlet(np.full(3, 0.3), size=(3, 2, 3, 2))
    x, a = rng.integers(3, size=(steps, 2)), rng.integers(2, size=(steps, 2))
    after = [(rng.integers(3), rng.choice(3, p=law[x[t, 0], a[t, 0], x[t, 1], a[t, 1]])) for t in range(steps)]
    return list(zip(x.tolist(), a.tolist(), after, strict=True))


def test_the_mean_influence_is_the_mass_off_the_support():
    steps, counts = stochastic_team(200), edti.TransitionCounts(1, 2**11)
    influences(counts, steps)
    off_support = 0
    for (now, actions), (i, j) in product({(tuple(x), tuple(a)) for x, a, _ in steps}, [(0, 1), (1, 0)]):
        mean, mass = 0.0, 0.0
        for place in range(3):
            full = probability(counts, now, actions, [place, place], j)
            alone = probability(counts, now, actions, [place, place], j, without=i)
            mean += full * (1 - alone / full) if full else 0.0
            mass += alone if full else 0.0
        assert mean == pytest.approx(1 - mass, abs=1e-12)
        off_support += mass < 0.999
    assert off_support > 10


def test_the_mean_log_ratio_is_the_conditional_mutual_information():
    steps, counts = stochastic_team(500), edti.TransitionCounts(1, 2**11)
    influences(counts, steps)
    mean = np.mean([np.log(probability(counts, *s, 1) / probability(counts, *s, 1, without=0)) for s in steps])

    def entropy(keys):
        frequency = np.array(list(Counter(keys).values())) / len(steps)
        return -(frequency * np.log(frequency)).sum()

    own, everything = [(x[1], a[1]) for x, a, _ in steps], [(*x, *a) for x, a, _ in steps]
    after = [x[1] for *_, x in steps]
    information = entropy(zip(own, after, strict=True)) - entropy(own)
    information -= entropy(zip(everything, after, strict=True)) - entropy(everything)
    assert mean == pytest.approx(information, abs=1e-12)
    assert information > 0.3


# --- the rewards ---


def test_influence_rewards_are_those_of_the_plain_loop():
    rng = np.random.default_rng(0)
    lengths, terminated = np.array([1, 1, 9, 9, 12, 12]), np.array([False, True] * 3)
    shared, influence, worth = rng.normal(size=(12, 6, 3)), rng.normal(size=(12, 6, 3, 3)), rng.normal(size=(13, 6, 3))
    shared *= (np.arange(12)[:, None] < lengths)[:, :, None]
    influence *= (np.arange(12)[:, None] < lengths)[:, :, None, None] * ~np.eye(3, dtype=bool)
    found = edti.influence_rewards(shared, influence, worth, lengths, terminated, 0.9)
    for t, k, i in np.ndindex(12, 6, 3):
        follows = t < lengths[k] - 1 or (t == lengths[k] - 1 and not terminated[k])
        others = [shared[t, k, j] + 0.9 * influence[t, k, i, j] * worth[t + 1, k, j] * follows for j in range(3) if j != i]
        assert found[t, k, i] == pytest.approx(sum(others), abs=1e-14)
    alone = edti.influence_rewards(shared, 0 * influence, worth, lengths, terminated, 0.9)
    assert shared + alone == pytest.approx(shared.sum(2, keepdims=True).repeat(3, axis=2))  # without influence all share alike


@pytest.mark.parametrize("env", list(envs.WORLDS))
def test_eta_is_relative_to_the_largest_reward(env):
    world = envs.make_vec(env)
    rewards = [step.reward[0] for step in walk(world, BEST_PLANS[env])]
    agents = world.world.num_agents if env == "cleaner" else 1  # there every agent may earn its 1
    assert max(rewards) == pytest.approx(agents * world.world.largest_reward, abs=0.5)  # gotogether's goal: less the distance


# --- whole runs ---


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_of_actors_and_critics(env, tmp_path, monkeypatch):
    updates = record_all_updates(edti, monkeypatch)
    args = dict(env=env, seed=1, num_trials=3, num_episodes=12, max_steps=15, learning_rate=0.05, gamma=0.9)
    own = dict(gae_lambda=0.8, eta=50.0, share_ext=0.4, share_int=0.6, beta_ext=3.0, beta_int=7.0)
    transitions = train(edti, tmp_path, **args, **own, critic_learning_rate=0.1, log_every=1, table_size=4096).transitions
    assert len(updates) == 24
    shown = [curves(tmp_path / f"seed{1 + k}") for k in range(3)]
    plain, ends, largest = [PlainCounts() for _ in range(3)], set(), 0.0
    for n, (actors, critics) in enumerate(zip(updates[::2], updates[1::2], strict=True)):
        rollout, steps_of = actors.rollout, []
        for k, length in enumerate(rollout.lengths):
            end = rollout.outcomes[k] > 0
            ends.add((length < rollout.lengths.max(), end))
            own = [[[p[6 * k + 2 * kind + i].double() for p in critics.params] for i in range(2)] for kind in range(3)]
            seen = [rollout.all_obs[: length + 1, k, i] for i in range(2)]
            values = [[[float(plain_logits(net, o)[0]) for o in seen[i]] for i, net in enumerate(kind)] for kind in own]
            values = np.array(values)  # [3, 2, T + 1]: V, V^ext and V^int of both agents
            steps = [(rollout.local_state[t, k], rollout.actions[t, k], rollout.local_state[t + 1, k]) for t in range(length)]
            new, influence = map(np.array, zip(*[plain[k].add(*step) for step in steps], strict=True))
            bonus = 50 * 100 / 1000 * new  # [T, 2], in units of reward
            delta, advantages = np.zeros((2, 2, length))
            for i, j in [(0, 1), (1, 0)]:
                total = 1.4 * rollout.reward[:length, k, 0] / 10 + bonus[:, i] / 10 + 0.6 * bonus[:, j] / 10
                for t in range(length):
                    worth = 3 * values[1, j, t + 1] + 7 * values[2, j, t + 1]
                    gain = 0.9 * influence[t, i, j] * worth * (t < length - 1 or not end)
                    total[t] += gain
                    largest = max(largest, abs(gain))
                rewards = [total, rollout.reward[:length, k, 0] / 10, bonus[:, i] / 10]
                for kind, reward in enumerate(rewards):
                    errors = np.array(plain_errors(reward, values[kind, i], end, 0.9))
                    summed = np.array([sum((0.9 * 0.8) ** n * e for n, e in enumerate(errors[t:])) for t in range(length)])
                    net = 6 * k + 2 * kind + i
                    expected = critic_descent(
                        critics.params, net, rollout.all_obs[:length, k, i], summed + values[kind, i, :-1]
                    )
                    for found, direction in zip(critics.direction, expected, strict=True):
                        scale = max(1.0, float(direction.abs().max()))
                        assert np.allclose(found[net], direction, rtol=1e-4, atol=1e-5 * scale)
                    if kind == 0:
                        delta[i], advantages[i] = errors, summed
                obs, actions = rollout.all_obs[:length, k, i], rollout.actions[:length, k, i]
                steps_of.append(list(zip(obs, actions, advantages[i] / length, strict=True)))
            figures = dict(value=10 * values[0, :, :-1].mean(), td_error=10 * np.sqrt((delta**2).mean()))
            figures.update(
                novelty=bonus.mean(), influence=influence.sum() / (2 * length), table_fill=len(plain[k].counts) / 4096
            )
            for tag, value in figures.items():
                assert shown[k][f"charts/{tag}"][n][1] == pytest.approx(value, rel=1e-4, abs=1e-5)
        assert_same_direction(actors.direction, actors.params, steps_of)
    assert transitions.filled.tolist() == [len(one.counts) for one in plain]
    assert largest > 0.05
    assert (False, False) in ends
    if env == "pushbox":
        assert (True, True) in ends


@pytest.mark.parametrize("optimizer", ["sign", "adam"])
def test_the_critics_have_an_adam_of_their_own(optimizer, tmp_path, monkeypatch):
    updates = record_all_updates(edti, monkeypatch)
    args = dict(env="pushbox", optimizer=optimizer, num_trials=2, num_episodes=10, max_steps=10)
    trained = train(edti, tmp_path, **args, learning_rate=1e-3, critic_learning_rate=1e-2)
    reference = [param.clone() for param in updates[1].params]
    adam = torch.optim.Adam(reference, lr=1e-2)
    after = [*(update.params for update in updates[3::2]), trained.critic.params]
    for update, following in zip(updates[1::2], after, strict=True):
        for param, direction in zip(reference, update.direction, strict=True):
            param.grad = -direction
        adam.step()
        assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))


def test_six_critics_of_one_agents_observation_have_weights_drawn_after_the_actors(tmp_path):
    critic = train(edti, tmp_path, env="pushbox", seed=4, num_trials=2, num_episodes=1, critic_learning_rate=0.0).critic
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    edti.StackedMLP(fresh, 2, [5, 64, 32, 4])
    expected = edti.StackedMLP(fresh, 6, [5, 64, 32, 1])
    assert all(map(torch.equal, critic.params, expected.params))


@each_setting
def test_without_values_and_novelty_it_is_pg_of_the_shared_reward_alone_bit_for_bit(env, optimizer, tmp_path, monkeypatch):
    class Nothing(edti.StackedMLP):
        def __init__(self, *args):
            super().__init__(*args)
            if self.params[-1].shape[2] == 1:  # the critics
                self.params = [torch.zeros_like(param).requires_grad_() for param in self.params]

    monkeypatch.setattr(edti, "StackedMLP", Nothing)
    monkeypatch.setattr(edti, "REWARD_SCALE", 2.0)  # half of the reward, and once more its half for the other agent
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=60, learning_rate=1e-3)
    plain = train(pg, tmp_path / "pg", **args, gamma=0.0)
    own = dict(eta=0.0, share_ext=1.0, critic_learning_rate=0.0, gae_lambda=0.0)
    assert_same_run(plain, train(edti, tmp_path / "edti", **args, **own))


def test_edti_leaves_the_local_optimum_of_findtreasure(tmp_path):
    args = dict(learning_rate=1e-3, critic_learning_rate=1e-2, eta=3.0)  # with 10 some walk until the time limit
    log = train(edti, tmp_path, env="findtreasure", num_trials=4, num_episodes=1500, **args).log
    share = (log.outcomes[:, -75:] == 1).mean(1)  # where PG has none at all
    assert share.min() > 0.5
    assert share.mean() > 0.8
    assert log.means(slice(-75, None))["reward_per_step"].mean() > 3
