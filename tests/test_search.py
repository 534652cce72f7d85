"""The exact search: the published optima of the worlds, options, the time limit, and a comparison with plain enumeration."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.search import Episode, best_plan, best_returns
from tests.helpers import RACE, assert_refused


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


# --- how to play the optimum ---


def replayed(world, plan):
    """The outcome, steps and return of a plan by the world's rules; no step may follow the end."""
    state, total, outcome = world.start.copy(), 0.0, 0
    for t, actions in enumerate(plan):
        assert outcome == 0, f"the episode ends before step {t}"
        reward, outcome = world.step(world.rules, state, actions)
        total += reward
    return ("time limit", *world.outcome_names)[outcome], len(plan), pytest.approx(total)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("cleaner", {}),
        ("cleaner", {"size": 9, "num_agents": 3, "max_steps": 30}),
        ("findtreasure", {}),
        ("findtreasure", {"size": 9}),
        ("findtreasure", {"max_steps": 7}),
        ("findtreasure", {"max_steps": 3}),
        ("gotogether", {}),
        ("gotogether", {"size": 6}),
        ("gotogether", {"max_steps": 22}),
        ("movebox", {}),
        ("movebox", {"max_steps": 24}),
        ("pushbox", {}),
        ("pushbox", {"step_penalty": 0.1, "boundary_penalty": 5.0}),
        ("pushbox", {"step_penalty": 60.0, "max_steps": 2}),
        ("pushbox", {"size": 6, "lone_push_penalty": 0.0}),
        (str(RACE), {}),
    ],
)
def test_every_episode_of_an_optimum_can_be_played(name, options):
    world = envs.make_world(name, **options)
    optimum = envs.optimum(name, **options)
    for episode in (optimum.best_per_step, optimum.best_return, *optimum.fewest.values()):
        plan = envs.optimal_plan(world, episode)
        assert plan.shape == (episode.steps, world.num_agents)
        assert replayed(world, plan) == episode[:3]
    assert envs.optimal_plan(world).tolist() == envs.optimal_plan(world, optimum.best_per_step).tolist()


@given(st.data())
def test_best_plans_have_the_best_returns(data):
    """In made-up worlds of three states, two actions and two outcomes, for every length and outcome that is possible or not."""
    following = np.array(data.draw(st.lists(st.tuples(*[st.integers(-2, 2)] * 2), min_size=3, max_size=3)), np.int32)
    reward = np.array(data.draw(st.lists(st.tuples(*[st.integers(-3, 3)] * 2), min_size=3, max_size=3)), float)
    returns = best_returns(following, reward, 2, 8)
    for steps, outcome in [*product(range(1, 9), (1, 2)), (8, 0)]:
        plan = best_plan(following, reward, outcome, steps)
        if plan is None:
            assert returns[steps, outcome] == -np.inf
            continue
        state, total = 0, 0.0
        for action in plan:
            assert state >= 0
            total, state = total + reward[state, action], following[state, action]
        assert (len(plan), max(-state, 0), total) == (steps, outcome, returns[steps, outcome])


def test_a_plan_in_parts_is_the_same_plan(monkeypatch):
    world = envs.make_world("findtreasure")
    whole = envs.optimal_plan(world)
    for kept in (1, 3 * 328):  # one step at a time; three, three and two
        monkeypatch.setattr("envs.search.CHOICES", kept)
        assert envs.optimal_plan(world).tolist() == whole.tolist()


@pytest.mark.parametrize(
    ("outcome", "steps"), [("treasure", 7), ("meeting", 201), ("meeting", 0), ("goal", 8), ("time limit", 8)]
)
def test_an_episode_that_cannot_be_is_refused(outcome, steps):
    episode = Episode(outcome, steps, 0.0, 0.0)
    assert_refused(f"no episode of {steps} steps", envs.optimal_plan, envs.make_world("findtreasure"), episode)


# --- limits ---


def test_more_joint_actions_than_memory_concern_only_worlds_that_are_searched():
    world = envs.make_world("cleaner", num_agents=40, max_steps=3)
    assert replayed(world, envs.optimal_plan(world)) == envs.optimum("cleaner", num_agents=40, max_steps=3).best_return[:3]


def test_worlds_with_too_many_states_are_refused(monkeypatch):
    monkeypatch.setattr("envs.search.MAX_STATES", 328)
    assert envs.optimum("findtreasure").num_states == 328
    monkeypatch.setattr("envs.search.MAX_STATES", 327)
    assert_refused("at most 327 states", envs.optimum, "findtreasure")


def test_too_many_agents_are_refused_before_their_joint_actions_are_made(monkeypatch):
    assert_refused("at most 10000 joint actions", envs.optimum, "gotogether", size=1001, num_agents=999)
    monkeypatch.setattr("envs.search.MAX_STEPS", 7800 * 125)
    assert envs.optimum("findtreasure", num_agents=3).num_states == 7800
    monkeypatch.setattr("envs.search.MAX_STEPS", 7800 * 125 - 1)
    assert_refused("at most 7799 states", envs.optimum, "findtreasure", num_agents=3)


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
