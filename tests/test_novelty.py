"""The exploration bonus of epg, espg and decespg, the same text in all, against dense solves."""

import numpy as np
import pytest

from algos import decespg
from tests.helpers import dense_eta, kernel, pairs


def novelty(trials=1, windows=1, dim=1, window=50, sigma=0.5, noise=0.01):
    return decespg.VisitNovelty(trials, windows, dim, window, sigma, noise)


def visit(bonus, visited, lengths=None):
    """eta of the pairs of an episode, [T, num_trials, num_windows]; visited [T, num_trials, num_windows, pair_dim]."""
    lengths = np.full(visited.shape[1], len(visited)) if lengths is None else np.asarray(lengths)
    return decespg.visit_counts(visited, lengths, *bonus.state, bonus.sigma, bonus.noise)


def visit_alone(bonus, places):
    """eta of visits to places on a line, in a single window."""
    return visit(bonus, np.array(places, np.float32)[:, None, None, None])[:, 0, 0]


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
    trials, windows, dim, sigma, noise = 2, 3, 11, 0.2, 0.05
    bonus = novelty(trials, windows, dim, window, sigma, noise)
    visited = {(k, w): np.zeros((0, dim), np.float32) for k in range(trials) for w in range(windows)}
    compared = []
    for _ in range(12):
        lengths = rng.integers(1, 21, trials)
        episode = np.full((20, trials, windows, dim), np.nan, np.float32)  # nothing beyond an episode's length may be read
        for k, length in enumerate(lengths):
            for w in range(windows):
                episode[:length, k, w] = pairs(walk(rng, length, 3), rng.integers(5, size=length), 5)
        eta = visit(bonus, episode, lengths)
        assert eta.shape == (20, trials, windows)
        for (k, w), past in visited.items():
            length = lengths[k]
            visited[k, w] = now = np.concatenate([past, episode[:length, k, w]])
            expected = [dense_eta(now, t, window, sigma, noise) for t in range(len(past), len(now))]
            assert np.abs(eta[:length, k, w] - expected).max() < 1e-9
            assert np.all(eta[length:, k, w] == 1)
            compared += expected
    assert bonus.visits.tolist() == [len(visited[k, 0]) for k in range(trials)]
    assert min(bonus.visits) > 3 * window
    assert min(compared) < 0.01
    assert max(compared) > 0.9


def test_the_incremental_inverse_is_the_inverse():
    rng = np.random.default_rng(0)
    bonus = novelty(dim=9, sigma=0.5 / 7)
    visited = pairs(walk(rng, 150, 2), rng.integers(5, size=150), 5)
    for t in range(150):
        visit(bonus, visited[t, None, None, None])
        recent = np.array([visited[n] for n in range(max(0, t - 49), t + 1)])
        slots = np.arange(max(0, t - 49), t + 1) % 50
        found = bonus.inverse[0, 0]
        expected = np.zeros((50, 50))
        expected[np.ix_(slots, slots)] = np.linalg.inv(kernel(recent, recent, 0.5 / 7) + 0.01 * np.eye(len(recent)))
        assert np.abs(found - expected).max() < 1e-8


@pytest.mark.parametrize("world", ["one-hot", "positions", "one pair for ever"])
def test_eta_does_not_drift_in_100_000_visits(world):
    rng = np.random.default_rng(0)
    sigma = 0.5 / 7 if world == "positions" else 0.5
    bonus = novelty(dim=9, sigma=sigma)
    for _ in range(100):
        seen, actions = rng.integers(5, size=1000), rng.integers(4, size=1000)
        if world == "one pair for ever":
            seen[:], actions[:] = 0, 0
        obs = walk(rng, 1000, 2) if world == "positions" else np.eye(5)[seen]
        visited = pairs(obs, actions, 9 - obs.shape[1])
        eta = visit(bonus, visited[:, None, None])
    assert bonus.visits.tolist() == [100_000]
    assert np.abs([eta[t, 0, 0] - dense_eta(visited, t, 50, sigma, 0.01) for t in range(500, 1000)]).max() < 1e-8


@pytest.mark.parametrize("noise", [0.01, 0.1, 2.0])
def test_n_visits_to_an_isolated_pair(noise):
    bonus = novelty(window=20, noise=noise)
    visits = np.minimum(np.arange(40), 20)
    assert visit_alone(bonus, [3.0] * 40) == pytest.approx(visits / (visits + noise), abs=1e-10)


def test_the_bonus_comes_before_the_visit_is_remembered():
    values, unvisited, overvisited = novelty().bonus(np.zeros((2, 1, 1, 1), np.float32), np.array([2]))
    assert values[:, 0, 0] == pytest.approx([np.log(1000), np.log(1.01)], abs=1e-12)
    assert (unvisited.tolist(), overvisited.tolist()) == ([0.5], [0])


def test_the_window_forgets_after_m_visits():
    for others, expected in ((3, 1 / 1.01), (4, 0.0)):
        places = [0, *range(10, 10 + others), 0]
        assert visit_alone(novelty(window=4), places)[-1] == pytest.approx(expected, abs=1e-12)


def test_the_shares_of_clamped_visits():
    bonus = novelty(trials=2, windows=2, sigma=1.0)
    visited = np.zeros((7, 2, 2, 1), np.float32)
    visited[:, 0, 0, 0] = [0, 1, 2, 3, 4, 0.5, 100]  # the sixth has eta > 1, the first and the last have 0
    visited[:, 1, 0, 0] = [0, 50, 0, 0, 0, 0, 0]
    values, unvisited, overvisited = bonus.bonus(visited, np.array([7, 3]))
    eta = [dense_eta(visited[:, 0, 0], t, 50, 1.0, 0.01) for t in range(7)]
    assert (eta[5] > 1, eta[0], eta[6] < 1e-3) == (True, 0, True)
    assert values[:, 0, 0] == pytest.approx(-np.log(np.clip(eta, 1e-3, 1)), abs=1e-9)
    assert unvisited == pytest.approx([3 / 14, 3 / 6])
    assert overvisited == pytest.approx([1 / 14 * (1 + np.sum(np.array(eta[:5]) > 1)), 0])
    assert not values[3:, 1].any()


def test_windows_and_trials_are_private():
    rng = np.random.default_rng(3)
    bonus, swapped = (novelty(2, 2, 4, window=5, sigma=0.1) for _ in range(2))
    for _ in range(5):
        visited, lengths = rng.random((9, 2, 2, 4), np.float32).round(), np.array([9, 6])
        values, *shares = bonus.bonus(visited, lengths)
        other = swapped.bonus(visited[:, :, ::-1].copy(), lengths)
        assert np.array_equal(values[:, :, ::-1], other[0])
        assert np.array_equal(shares, other[1:])
        assert not np.allclose(values[:, :, 0], values[:, :, 1])
    for mine, others in zip((bonus.pairs, bonus.inverse), (swapped.pairs, swapped.inverse), strict=True):
        assert np.array_equal(mine[:, ::-1], others)
