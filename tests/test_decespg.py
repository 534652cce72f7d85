"""DecESPG: the bonus against dense solves, the memory against plain lists, every update against the paper's equations."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import decespg, pg
from tests.helpers import (
    assert_same_direction,
    assert_same_run,
    curves,
    each_setting,
    plain_returns,
    record_updates,
    train,
)

# --- the exploration bonus ---


def novelty(trials=1, agents=1, dim=1, window=50, sigma=0.5, noise=0.01):
    return decespg.VisitNovelty(trials, agents, dim, window, sigma, noise)


def visit(bonus, obs, actions, lengths=None):
    """eta of the steps of an episode, [T, num_trials, num_agents]; obs [T, num_trials, num_agents, obs_dim]."""
    lengths = np.full(obs.shape[1], len(obs)) if lengths is None else np.asarray(lengths)
    return decespg.visit_counts(obs, actions, lengths, *bonus.state, bonus.sigma, bonus.noise)


def visit_alone(bonus, places, actions=0):
    """eta of the visits of a single agent to places on a line."""
    places = np.array(places, np.float32)[:, None, None, None]
    return visit(bonus, places, np.broadcast_to(np.asarray(actions), len(places)).astype(np.int64)[:, None, None])[:, 0, 0]


def pairs(obs, actions, num_actions=5):
    """The vectors u = (o, one-hot a) of an agent's steps, [T, obs_dim + num_actions]."""
    return np.concatenate([np.asarray(obs, float), np.eye(num_actions)[actions]], axis=1)


def kernel(some, others, sigma):
    """Eq. 5 with C = 1."""
    return np.exp(-((some[:, None] - others[None]) ** 2).sum(-1) / (2 * sigma**2))


def dense_eta(visited, t, window, sigma, noise):
    """eta of the pair visited[t] after all pairs before it, by Eqs. 5-7 with targets 1 and a dense solve."""
    past = visited[max(0, t - window) : t]
    covariance = kernel(past, past, sigma) + noise * np.eye(len(past))
    return float(kernel(visited[t : t + 1], past, sigma)[0] @ np.linalg.solve(covariance, np.ones(len(past))))


def walk(rng, steps, agents, size=7):
    """A random walk in a room: positions of all agents in map widths [steps, 2 agents], as findtreasure tells them."""
    position, path = np.full(2 * agents, size // 2), []
    for _ in range(steps):
        position = np.clip(position + rng.integers(-1, 2, 2 * agents), 0, size - 1)
        path.append(position)
    return (np.array(path) / size).astype(np.float32)


@pytest.mark.parametrize("window", [1, 7, 30])
def test_eta_is_that_of_a_dense_solve_before_at_and_past_the_full_window(window):
    rng = np.random.default_rng(window)
    trials, agents, sigma, noise = 2, 3, 0.2, 0.05
    bonus = novelty(trials, agents, 6, window, sigma, noise)
    visited = {(k, i): np.zeros((0, 11)) for k in range(trials) for i in range(agents)}
    compared = []
    for _ in range(12):
        lengths = rng.integers(1, 21, trials)
        obs = np.full((20, trials, agents, 6), np.nan, np.float32)  # nothing beyond an episode's length may be read
        actions = np.full((20, trials, agents), -1)
        for k, length in enumerate(lengths):
            for i in range(agents):
                obs[:length, k, i], actions[:length, k, i] = walk(rng, length, 3), rng.integers(5, size=length)
        eta = visit(bonus, obs, actions, lengths)
        for (k, i), past in visited.items():
            length = lengths[k]
            visited[k, i] = now = np.concatenate([past, pairs(obs[:length, k, i], actions[:length, k, i])])
            expected = [dense_eta(now, t, window, sigma, noise) for t in range(len(past), len(now))]
            assert np.abs(eta[:length, k, i] - expected).max() < 1e-9
            compared += expected
    assert bonus.visits.tolist() == [len(visited[k, 0]) for k in range(trials)]
    assert min(bonus.visits) > 3 * window
    assert min(compared) < 0.01
    assert max(compared) > 0.9


def test_the_incremental_inverse_is_the_inverse():
    rng = np.random.default_rng(0)
    bonus = novelty(dim=4, sigma=0.5 / 7)
    obs, actions = walk(rng, 150, 2), rng.integers(5, size=150)
    visited = pairs(obs, actions)
    for t in range(150):
        visit(bonus, obs[t, None, None, None], actions[t, None, None, None])
        recent = np.array([visited[n] for n in range(max(0, t - 49), t + 1)])
        slots = np.arange(max(0, t - 49), t + 1) % 50
        found = bonus.inverse[0, 0]
        expected = np.zeros((50, 50))
        expected[np.ix_(slots, slots)] = np.linalg.inv(kernel(recent, recent, 0.5 / 7) + 0.01 * np.eye(len(recent)))
        assert np.abs(found - expected).max() < 1e-8


@pytest.mark.parametrize("world", ["one-hot", "positions", "one pair for ever"])
def test_eta_does_not_drift_in_100_000_visits(world):
    rng = np.random.default_rng(0)
    dim, sigma = (4, 0.5 / 7) if world == "positions" else (5, 0.5)
    bonus = novelty(dim=dim, sigma=sigma)
    for _ in range(100):
        seen, actions = rng.integers(5, size=1000), rng.integers(4, size=1000)
        if world == "one pair for ever":
            seen[:], actions[:] = 0, 0
        obs = walk(rng, 1000, 2) if world == "positions" else np.eye(5, dtype=np.float32)[seen]
        eta = visit(bonus, obs[:, None, None], actions[:, None, None])
    visited = pairs(obs, actions)
    assert bonus.visits.tolist() == [100_000]
    assert np.abs([eta[t, 0, 0] - dense_eta(visited, t, 50, sigma, 0.01) for t in range(500, 1000)]).max() < 1e-8


@pytest.mark.parametrize("noise", [0.01, 0.1, 2.0])
def test_n_visits_to_an_isolated_pair(noise):
    bonus = novelty(window=20, noise=noise)
    visits = np.minimum(np.arange(40), 20)
    assert visit_alone(bonus, [3.0] * 40) == pytest.approx(visits / (visits + noise), abs=1e-10)


def test_the_bonus_comes_before_the_visit_is_remembered():
    eta, unvisited, overvisited = novelty().bonus(np.zeros((2, 1, 1, 1), np.float32), np.zeros((2, 1, 1), int), np.array([2]))
    assert eta[:, 0, 0] == pytest.approx([np.log(1000), np.log(1.01)], abs=1e-12)
    assert (unvisited.tolist(), overvisited.tolist()) == ([0.5], [0])


def test_another_action_is_another_pair():
    eta = visit_alone(novelty(sigma=1.0), [0, 0, 0], [0, 1, 1])
    assert eta[1] == pytest.approx(np.exp(-1) / 1.01)  # a squared distance of 2
    assert eta[2] > 0.99


def test_the_window_forgets_after_m_visits():
    for others, expected in ((3, 1 / 1.01), (4, 0.0)):
        places = [0, *range(10, 10 + others), 0]
        assert visit_alone(novelty(window=4), places)[-1] == pytest.approx(expected, abs=1e-12)


def test_the_shares_of_clamped_steps():
    bonus = novelty(trials=2, agents=2, sigma=1.0)
    obs = np.zeros((7, 2, 2, 1), np.float32)
    obs[:, 0, 0, 0] = [0, 1, 2, 3, 4, 0.5, 100]  # the sixth has eta > 1, the first and the last have 0
    obs[:, 1, 0, 0] = [0, 50, 0, 0, 0, 0, 0]
    actions, lengths = np.zeros((7, 2, 2), int), np.array([7, 3])
    values, unvisited, overvisited = bonus.bonus(obs, actions, lengths)
    visited = pairs(obs[:, 0, 0], actions[:, 0, 0])
    eta = [dense_eta(visited, t, 50, 1.0, 0.01) for t in range(7)]
    assert (eta[5] > 1, eta[0], eta[6] < 1e-3) == (True, 0, True)
    assert values[:, 0, 0] == pytest.approx(-np.log(np.clip(eta, 1e-3, 1)), abs=1e-9)
    assert unvisited == pytest.approx([3 / 14, 3 / 6])
    assert overvisited == pytest.approx([1 / 14 * (1 + np.sum(np.array(eta[:5]) > 1)), 0])
    assert not values[3:, 1].any()


def test_agents_and_trials_are_private():
    rng = np.random.default_rng(3)
    bonus, swapped = (novelty(2, 2, 4, window=5, sigma=0.1) for _ in range(2))
    for _ in range(5):
        obs, actions, lengths = rng.random((9, 2, 2, 4), np.float32).round(1), rng.integers(4, size=(9, 2, 2)), np.array([9, 6])
        values, *shares = bonus.bonus(obs, actions, lengths)
        other = swapped.bonus(obs[:, :, ::-1].copy(), actions[:, :, ::-1].copy(), lengths)
        assert np.array_equal(values[:, :, ::-1], other[0])
        assert np.array_equal(shares, other[1:])
        assert not np.allclose(values[:, :, 0], values[:, :, 1])
    for mine, others in zip(bonus.state[:3], swapped.state[:3], strict=True):
        assert np.array_equal(mine[:, ::-1], others)


# --- the selective memory ---

NUM_ACTIONS, MAX_STEPS = 4, 6


def memory(trials=1, slots=2):
    return decespg.SelectiveMemory(envs.make_vec("pushbox", trials, max_steps=MAX_STEPS), slots)


def played(rng, *episodes):
    """One random episode of each trial as a rollout, from (outcome, length)."""
    outcomes, lengths = np.array(episodes).T
    obs = np.eye(5, dtype=np.float32)[rng.integers(5, size=(MAX_STEPS, len(episodes), 2))]
    actions = rng.integers(NUM_ACTIONS, size=(MAX_STEPS, len(episodes), 2))
    return SimpleNamespace(obs=obs, actions=actions, lengths=lengths, outcomes=outcomes)


def remember(kept, rng, value, outcome=1, length=3):
    """Let a memory of one trial see a random episode of this value; returns (observations, actions, returns) of its steps."""
    rollout = played(rng, (outcome, length))
    returns = np.zeros((MAX_STEPS, 1))
    returns[:length, 0] = value * 0.5 ** np.arange(length)
    kept.remember(rollout, returns)
    return rollout.obs[:length, 0].copy(), rollout.actions[:length, 0].copy(), returns[:length, 0]


def assert_replays(kept, *episodes, trial=0):
    """What the memory adds to the gradient is the second term of Eq. 16 over these episodes."""
    obs, weight = kept.replay()
    policy = decespg.StackedMLP([np.random.default_rng(0)] * len(kept.value), 2, [5, 8, NUM_ACTIONS])
    log_probs = torch.log_softmax(policy(torch.from_numpy(obs)), dim=-1)
    direction = torch.autograd.grad((torch.from_numpy(weight) * log_probs).sum(), policy.params)
    nets = slice(2 * trial, 2 * trial + 2)
    own = [[tensor[nets] for tensor in tensors] for tensors in (direction, policy.params)]
    assert_same_direction(*own, [memory_steps(episodes, i) for i in range(2)])


def memory_steps(episodes, i):
    """Agent i's steps (o*, a*, w_k G*_t / T_k) in the episodes k that Eqs. 15-16 replay, w_k = Psi*_k / sum_j Psi*_j."""
    replayed = [episode for episode in episodes if episode[2][0] > 0]
    total = sum(returns[0] for _, _, returns in replayed)
    return [
        (obs[t, i], actions[t, i], returns[0] / total * returns[t] / len(returns))
        for obs, actions, returns in replayed
        for t in range(len(returns))
    ]


def test_an_empty_memory_adds_nothing():
    obs, weight = memory(trials=3).replay()
    assert (obs.shape, weight.shape) == ((6, 0, 5), (6, 0, NUM_ACTIONS))


def test_a_memory_without_slots_stays_empty():
    kept, rng = memory(slots=0), np.random.default_rng(0)
    remember(kept, rng, 10.0)
    assert kept.replay()[0].shape == (2, 0, 5)


def test_the_best_episodes_of_every_terminal_state_are_kept_and_replayed():
    kept, rng = memory(slots=2), np.random.default_rng(1)
    first = remember(kept, rng, 5.0, length=6)
    assert_replays(kept, first)
    second = remember(kept, rng, 7.0, length=2)
    assert_replays(kept, first, second)
    remember(kept, rng, 4.0)  # worse than both
    assert_replays(kept, first, second)
    third = remember(kept, rng, 6.0, length=1)  # replaces the first, and nothing of its six steps remains
    assert_replays(kept, second, third)
    cut, large = remember(kept, rng, 0.5, outcome=0, length=6), remember(kept, rng, 90.0, outcome=4, length=4)
    assert_replays(kept, second, third, cut, large)
    assert np.sort(kept.value[0]).tolist() == [[-np.inf, 0.5], [6, 7], [-np.inf] * 2, [-np.inf] * 2, [-np.inf, 90]]
    better = remember(kept, rng, 8.0)
    assert_replays(kept, second, better, cut, large)


def test_on_a_tie_the_older_episode_stays():
    kept, rng = memory(slots=1), np.random.default_rng(2)
    older = remember(kept, rng, 5.0)
    younger = remember(kept, rng, 5.0)
    assert not np.array_equal(older[1], younger[1])
    assert_replays(kept, older)


def test_episodes_without_positive_value_are_kept_but_not_replayed():
    kept, rng = memory(slots=2), np.random.default_rng(3)
    for value in (-3.0, 0.0):
        remember(kept, rng, value)
        assert kept.replay()[0].shape == (2, 0, 5)
    assert sorted(kept.value[0, 1]) == [-3, 0]
    good, other = remember(kept, rng, 1.0), remember(kept, rng, -0.5, outcome=2)
    assert sorted(kept.value[0, 1]) == [0, 1]
    assert_replays(kept, good, other)


def test_trials_remember_for_themselves():
    rng = np.random.default_rng(4)
    kept, steps = memory(trials=2), []
    for outcomes in ((1, 0), (1, 4), (3, 1)):
        rollout = played(rng, (outcomes[0], 4), (outcomes[1], 2))
        returns = rng.random((MAX_STEPS, 2))
        kept.remember(rollout, returns)
        steps.append([(rollout.obs[:n, k], rollout.actions[:n, k], returns[:n, k]) for k, n in enumerate((4, 2))])
        for k in range(2):
            assert_replays(kept, *[both[k] for both in steps], trial=k)


# --- whole runs ---


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_climbs_along_equations_14_to_16(env, tmp_path, monkeypatch):
    """30 updates of the script against Algorithm 1 written with lists, dense solves and one score at a time."""
    updates = record_updates(decespg, monkeypatch)
    trials, window, slots, beta, sigma, noise, gamma = 2, 5, 2, 0.7, 0.9, 0.2, 0.9
    train(
        decespg,
        tmp_path,
        **dict(env=env, seed=2, num_trials=trials, num_episodes=30, max_steps=10, learning_rate=0.02, log_every=1),
        **dict(window=window, slots=slots, beta=beta, sigma=sigma, noise=noise, gamma=gamma),
    )
    assert len(updates) == 30
    world = envs.make_world(env)
    width = sigma * world.cell
    visited = [np.zeros((0, world.obs_dim + world.num_actions))] * (2 * trials)
    kept = [{} for _ in range(trials)]
    replaced = 0
    shown = [curves(tmp_path / f"seed{2 + k}") for k in range(trials)]
    for n, (rollout, params, direction) in enumerate(updates):
        steps_of = []
        for k, length in enumerate(rollout.lengths):
            obs, actions, reward = rollout.obs[:length, k], rollout.actions[:length, k], rollout.reward[:length, k]
            etas = []
            for i in range(2):
                before = len(visited[2 * k + i])
                past = visited[2 * k + i] = np.concatenate(
                    [visited[2 * k + i], pairs(obs[:, i], actions[:, i], world.num_actions)]
                )
                etas.append([dense_eta(past, before + t, window, width, noise) for t in range(length)])
            bonus = -np.log(np.clip(etas, 1e-3, 1))
            for tag, expected in {
                "bonus": bonus.mean(),
                "unvisited": np.mean(np.array(etas) < 1e-3),
                "overvisited": np.mean(np.array(etas) > 1),
            }.items():
                step, value = shown[k][f"charts/{tag}"][n]
                assert (step, value) == (n + 1, pytest.approx(expected, abs=1e-6))

            episode = obs, actions, np.array(plain_returns(reward, gamma))
            best = kept[k].setdefault(int(rollout.outcomes[k]), [])
            worst = min(range(len(best)), key=lambda slot: best[slot][2][0], default=None)
            if len(best) < slots:
                best.append(episode)
            elif episode[2][0] > best[worst][2][0]:
                best[worst] = episode
                replaced += 1
            stored = [one for episodes in kept[k].values() for one in episodes]
            for i in range(2):
                returns = plain_returns(reward + beta * bonus[i], gamma)
                own = [(obs[t, i], actions[t, i], returns[t] / length) for t in range(length)]
                steps_of.append(own + memory_steps(stored, i))
        assert_same_direction(direction, params, steps_of)
    if env == "pushbox":
        assert min(len(outcomes) for outcomes in kept) >= 3
        assert replaced >= 5


@each_setting
def test_without_bonus_and_memory_it_is_pg_bit_for_bit(env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=150, learning_rate=1e-3)
    plain, bare = train(pg, tmp_path / "pg", **args), train(decespg, tmp_path / "decespg", **args, beta=0.0, slots=0)
    assert_same_run(plain, bare)


def test_decespg_pushes_the_large_box_together(tmp_path):
    log = train(decespg, tmp_path, env="pushbox", num_trials=4, num_episodes=3000).log
    assert log.means(slice(-150, None))["reward_per_step"].min() > 15
    assert log.means(slice(0, 500))["reward_per_step"].max() < 5  # it was not easy
