"""What is said about results: means and errors, differences, interquartile means and probabilities of improvement."""

from contextlib import contextmanager
from functools import cache

import numpy as np
from rliable import library, metrics

import envs
from benchmark.cells import METHODS
from benchmark.results import block_of


@cache
def optimum(world):
    """The best reward per step of a world; nan if it is too large to search and has no plan."""
    try:
        return envs.optimum(world).best_per_step.per_step
    except (envs.UsageError, NotImplementedError):
        return float("nan")


def in_words(world, value, sign=""):
    """A reward per step as 1.23, or 0.123 where even the optimum is below 1, as in cleaner; sign "+" shows its sign."""
    return f"{value:{sign}.{3 if abs(optimum(world)) < 1 else 2}f}"


def interval_in_words(world, mean, low, high):
    """A difference and its interval as +1.23 [+0.45, +2.01]; of one trial there is no interval."""
    words = in_words(world, mean, "+")
    return words if np.isnan(low) else f"{words} [{in_words(world, low, '+')}, {in_words(world, high, '+')}]"


def mean_and_error(values):
    """Mean over trials (the first axis) and its standard error, nan of one trial."""
    mean = values.mean(0)
    return mean, values.std(0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.full_like(mean, np.nan)


def difference(some, others, resamples=10_000):
    """Mean difference of two methods' last 5 % and its 95 % bootstrap interval: mean, low, high.

    Trials of the same seed start from the same networks and action draws, so the pairs are resampled. One pair has no
    interval, which is nan then.
    """
    differences = some.last - others.last
    if len(differences) == 1:
        return differences[0], np.nan, np.nan
    draws = np.random.default_rng(0).integers(0, len(differences), (resamples, len(differences)))
    return differences.mean(), *np.quantile(differences[draws].mean(1), (0.025, 0.975))


def reached(result, good, share=0.95):
    """When `share` of the trials were good: (episodes, environment steps of a trial, mean) up to the end of that block.

    good: whether a trial was, in each block of episodes, [num_trials, blocks]. None if that never was so.
    """
    blocks = np.flatnonzero(good.mean(0) >= share)
    return (
        ((int(blocks[0]) + 1) * block_of(result.num_episodes), float(result.steps[:, blocks[0]].mean()))
        if len(blocks)
        else None
    )


def near_optimum(result, world, margin=0.05):
    """Whether each trial's reward per step was within `margin` of the exact optimum, block by block."""
    return result.score >= (1 - margin) * optimum(world)


def at_best_outcome(result):
    """Whether each trial ended most episodes of a block in the best outcome."""
    return result.at_best > 0.5


def scores_over_worlds(results, optimizer, worlds):
    """{method: last 5 % as a share of the optimum [num_trials, worlds]} of the methods that have a result in all `worlds`."""
    found = {}
    for method in METHODS:
        runs = [results.get((world, method, optimizer)) for world in worlds]
        if all(runs):
            found[method] = np.stack([run.last / optimum(world) for run, world in zip(runs, worlds, strict=True)], axis=1)
    return found


@contextmanager
def seeded(seed=0):
    """rliable draws from numpy's global generator, whatever random_state it is given: seed that, and put it back afterwards."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002


def interquartile_means(scores, reps=1000):
    """{method: (interquartile mean, low, high)}, 95 % by stratified bootstrap (Agarwal et al., NeurIPS 2021)."""
    with seeded():
        means, bounds = library.get_interval_estimates(scores, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=reps)
    return {method: (means[method][0], *bounds[method][:, 0]) for method in scores}


def improvements(scores, over="decespg", reps=1000):
    """{method: (probability that a trial of `over` is better than one of the method, low, high)}, ties counting half."""
    pairs = {method: (scores[over], others) for method, others in scores.items() if method != over}
    with seeded():
        means, bounds = library.get_interval_estimates(
            pairs, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]), reps=reps
        )
    return {method: (means[method][0], *bounds[method][:, 0]) for method in pairs}


def profiles(scores, shares, reps=500):
    """{method: (share of all runs with at least each score, low, high)}, [len(shares)] each (Agarwal et al., 2021)."""
    with seeded():
        means, bounds = library.create_performance_profile(scores, shares, reps=reps)
    return {method: (means[method], *bounds[method]) for method in scores}
