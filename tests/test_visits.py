"""benchmark/novelty.py: the bonus of each visit to the same pair."""

from collections import Counter
from itertools import count, product

import numpy as np
import pytest

from benchmark import novelty


def test_the_bonus_of_the_nth_visit_is_that_of_the_nth_visit(monkeypatch):
    monkeypatch.setattr(novelty, "VISITS", 3)
    few = dict(env="findtreasure", num_trials=2, num_episodes=3, max_steps=150, window=1000, sigma=0.01, noise=0.5)
    bonuses, _ = novelty.bonuses_of_visits("decespg", few)
    before = np.arange(3)  # visits to the pair, which are all that a kernel as narrow as this sees
    expected = -np.log(np.clip(before / (before + 0.5), 1e-3, 1))
    assert len(bonuses) > 10
    assert bonuses == pytest.approx(np.tile(expected, (len(bonuses), 1)))


def test_visits_to_a_model_that_has_learnt_nothing_and_the_correlation_of_the_last_quarter(monkeypatch):
    """No bonus in the first of eight episodes, noise in the next five, in the last two -log n at the n-th visit."""
    rng, visits, episode = np.random.default_rng(0), Counter(), count()
    first_met = set()

    def bonus(self, pairs, lengths):
        values, now = np.zeros(pairs.shape[:3]), next(episode)
        for k, length in enumerate(lengths):
            for t, w in product(range(length), range(pairs.shape[2])):
                key = k, w, pairs[t, k, w].tobytes()
                visits[key] += 1
                if now == 0:
                    first_met.add(key)
                values[t, k, w] = 0.0 if now == 0 else rng.random() if now < 6 else 20 - np.log(visits[key])
        return values, np.zeros(len(lengths)), np.zeros(len(lengths))

    monkeypatch.setattr(novelty, "VISITS", 4)
    monkeypatch.setattr(novelty.script("decespg").VisitNovelty, "bonus", bonus)
    few = dict(env="findtreasure", num_trials=2, num_episodes=8, max_steps=100)
    bonuses, correlation = novelty.bonuses_of_visits("decespg", few)
    often = [key for key, number in visits.items() if number >= 4]
    assert len(bonuses) == len(often)
    assert np.isnan(bonuses[:, 0]).sum() == len(first_met.intersection(often)) > 10
    assert not np.isnan(bonuses[:, 1:]).any()
    assert correlation == pytest.approx(1)


def test_the_script_is_left_as_it_was(monkeypatch):
    monkeypatch.setattr(novelty, "VISITS", 2)
    module = novelty.script("espg")
    before = module.VisitNovelty
    novelty.bonuses_of_visits("espg", dict(env="pushbox", num_trials=1, num_episodes=4))
    assert module.VisitNovelty is before
    assert novelty.novelty_class(module) == "VisitNovelty"
