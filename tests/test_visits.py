"""benchmark/novelty.py: the bonus of each visit to the same pair."""

import numpy as np
import pytest

from benchmark import novelty


def test_the_bonus_of_the_nth_visit_is_that_of_the_nth_visit(monkeypatch):
    monkeypatch.setattr(novelty, "VISITS", 3)
    few = dict(env="findtreasure", num_trials=2, num_episodes=3, max_steps=150, window=1000, sigma=0.01, noise=0.5)
    bonuses = novelty.bonuses_of_visits("decespg", few)
    before = np.arange(3)  # visits to the pair, which are all that a kernel as narrow as this sees
    expected = -np.log(np.clip(before / (before + 0.5), 1e-3, 1))
    assert len(bonuses) > 10
    assert bonuses == pytest.approx(np.tile(expected, (len(bonuses), 1)))


def test_the_script_is_left_as_it_was():
    module = novelty.script("espg")
    before = module.VisitNovelty
    novelty.bonuses_of_visits("espg", dict(env="pushbox", num_trials=1, num_episodes=1))
    assert module.VisitNovelty is before
    assert novelty.novelty_class(module) == "VisitNovelty"
