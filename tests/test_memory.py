"""The selective memory of spg, espg and decespg, the same text in all, against plain lists."""

from types import SimpleNamespace

import numpy as np
import torch

import envs
from algos import decespg
from tests.helpers import assert_same_direction, memory_steps

NUM_ACTIONS, MAX_STEPS = 4, 6


def memory(trials=1, slots=2):
    return decespg.SelectiveMemory(envs.make_world("pushbox", max_steps=MAX_STEPS), trials, slots)


def played(rng, *episodes):
    """One random episode of each trial as a rollout, from (outcome, length)."""
    outcomes, lengths = np.array(episodes).T
    obs = np.eye(5, dtype=np.float32)[rng.integers(5, size=(MAX_STEPS, len(episodes), 2))]
    actions = rng.integers(NUM_ACTIONS, size=(MAX_STEPS, len(episodes), 2))
    return SimpleNamespace(all_obs=obs, actions=actions, lengths=lengths, outcomes=outcomes)


def remember(kept, rng, value, outcome=1, length=3):
    """Let a memory of one trial see a random episode of this value; returns (observations, actions, returns) of its steps."""
    rollout = played(rng, (outcome, length))
    returns = np.zeros((MAX_STEPS, 1))
    returns[:length, 0] = value * 0.5 ** np.arange(length)
    kept.remember(rollout, returns)
    return rollout.all_obs[:length, 0].copy(), rollout.actions[:length, 0].copy(), returns[:length, 0]


def assert_replays(kept, *episodes, trial=0):
    """What the memory adds to the gradient is the second term of Eq. 16 over these episodes."""
    obs, weight = kept.replay()
    policy = decespg.StackedMLP([np.random.default_rng(0)] * len(kept.value), 2, [5, 8, NUM_ACTIONS])
    log_probs = torch.log_softmax(policy(torch.from_numpy(obs)), dim=-1)
    direction = torch.autograd.grad((torch.from_numpy(weight) * log_probs).sum(), policy.params)
    nets = slice(2 * trial, 2 * trial + 2)
    own = [[tensor[nets] for tensor in tensors] for tensors in (direction, policy.params)]
    assert_same_direction(*own, [memory_steps(episodes, i) for i in range(2)])


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
        steps.append([(rollout.all_obs[:n, k], rollout.actions[:n, k], returns[:n, k]) for k, n in enumerate((4, 2))])
        for k in range(2):
            assert_replays(kept, *[both[k] for both in steps], trial=k)
