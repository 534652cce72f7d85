"""The exact search: the published optima of the worlds, options, the time limit, and a comparison with plain enumeration."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.search import best_returns
from tests.helpers import assert_refused


def summary(optimum):
    """Fewest steps and return by outcome."""
    return {outcome: (episode.steps, pytest.approx(episode.total)) for outcome, episode in optimum.fewest.items()}


@pytest.mark.parametrize(
    ("name", "options", "fewest", "best", "per_step"),
    [
        ("findtreasure", {}, {"treasure": (8, 100), "meeting": (4, 3)}, ("treasure", 8, 100), 100 / 7),
        ("findtreasure", {"size": 9}, {"treasure": (12, 100), "meeting": (6, 3)}, ("treasure", 12, 100), 100 / 11),
        ("findtreasure", {"max_steps": 7}, {"meeting": (4, 3)}, ("meeting", 4, 3), 1),
        ("findtreasure", {"max_steps": 3}, {}, ("time limit", 3, 0), 0),
        ("gotogether", {}, {"goal": (23, 9.5)}, ("goal", 23, 9.5), 9.5 / 22),
        ("gotogether", {"size": 5}, {"goal": (3, 9.5)}, ("goal", 3, 9.5), 9.5 / 2),
        ("gotogether", {"max_steps": 22}, {}, ("time limit", 22, 0), 0),
        ("movebox", {}, {"far goal": (25, 100), "near goal": (12, 10)}, ("far goal", 25, 100), 100 / 24),
        ("movebox", {"max_steps": 24}, {"near goal": (12, 10)}, ("near goal", 12, 10), 10 / 11),
        (
            "pushbox",
            {},
            {"small left": (3, 10), "small right": (3, 10), "both small": (3, 20), "large": (4, 100)},
            ("large", 4, 100),
            100 / 3,
        ),
        (
            "pushbox",
            {"step_penalty": 0.1, "boundary_penalty": 5.0},
            {"small left": (3, 9.7), "small right": (3, 9.7), "both small": (3, 19.7), "large": (4, 99.6)},
            ("large", 4, 99.6),
            99.6 / 3,
        ),
        (
            "pushbox",
            {"size": 6},
            {"small left": (4, 10), "small right": (4, 10), "both small": (4, 20), "large": (6, 100)},
            ("large", 6, 100),
            20,
        ),
        (
            "pushbox",
            {"step_penalty": 60.0, "max_steps": 2},
            {},
            ("time limit", 2, -120),
            -120,
        ),
    ],
)
def test_optima(name, options, fewest, best, per_step):
    found = envs.optimum(name, **options)
    assert summary(found) == fewest
    assert found.best_return[:3] == (best[0], best[1], pytest.approx(best[2]))
    assert found.best_return.per_step == pytest.approx(best[2] / max(best[1] - 1, 1))
    assert found.best_per_step.per_step == pytest.approx(per_step)


@pytest.mark.parametrize("name", ["findtreasure", "pushbox"])
def test_number_of_states(name):
    world = envs.make_world(name)
    joint = np.array(list(product(range(world.num_actions), repeat=2)))
    seen = {tuple(world.start)}
    waiting = list(seen)
    while waiting:
        before = waiting.pop()
        for actions in joint:
            state = np.array(before)
            _, outcome = world.step(world.rules, state, actions)
            if outcome == 0 and tuple(state) not in seen:
                seen.add(tuple(state))
                waiting.append(tuple(state))
    assert envs.optimum(name).num_states == len(seen)


@given(st.data())
def test_best_returns_are_those_of_all_plans(data):
    """A made-up world of three states, two actions and two outcomes, against every sequence of eight actions."""
    following = np.array(data.draw(st.lists(st.tuples(*[st.integers(-2, 2)] * 2), min_size=3, max_size=3)), np.int32)
    reward = np.array(data.draw(st.lists(st.tuples(*[st.integers(-3, 3)] * 2), min_size=3, max_size=3)), float)
    expected = np.full((9, 3), -np.inf)
    for plan in product(range(2), repeat=8):
        state, total, t = 0, 0.0, 0
        while state >= 0 and t < 8:
            total, state, t = total + reward[state, plan[t]], following[state, plan[t]], t + 1
        outcome = max(-state, 0)
        expected[t, outcome] = max(expected[t, outcome], total)
    assert best_returns(following, reward, 2, 8).tolist() == expected.tolist()


def test_the_best_return_and_the_best_return_per_step_may_be_of_different_episodes():
    returns = best_returns(np.array([[-1, 0]], np.int32), np.array([[2.0, 1.5]]), 1, 4)
    assert returns.tolist() == [[-np.inf, -np.inf], [-np.inf, 2], [-np.inf, 3.5], [-np.inf, 5], [6, 6.5]]


def test_worlds_with_too_many_states_are_refused(monkeypatch):
    monkeypatch.setattr("envs.search.MAX_STATES", 328)
    assert envs.optimum("findtreasure").num_states == 328
    monkeypatch.setattr("envs.search.MAX_STATES", 327)
    assert_refused("at most 327 states", envs.optimum, "findtreasure")


def test_a_time_limit_beyond_memory_is_refused():
    for name in ("findtreasure", "cleaner"):
        assert_refused("a table of 2000000000 steps would need", envs.optimum, name, max_steps=2_000_000_000)


def test_a_long_search_says_how_far_it_is(monkeypatch, capsys):
    monkeypatch.setattr("envs.search.AT_ONCE", 1)
    monkeypatch.setattr("envs.search.PATIENCE", 0)
    assert envs.optimum("findtreasure", max_steps=50).best_return.steps == 8
    assert "/50 [" in capsys.readouterr().err


def test_the_table():
    lines = str(envs.optimum("findtreasure")).splitlines()
    assert [line.split() for line in lines] == [
        ["outcome", "steps", "return", "reward", "per", "step"],
        ["fewest", "steps", "treasure", "8", "100", "14.2857"],
        ["fewest", "steps", "meeting", "4", "3", "1.0000"],
        ["best", "return", "treasure", "8", "100", "14.2857"],
        ["best", "per", "step", "treasure", "8", "100", "14.2857"],
        ["328", "states"],
    ]
