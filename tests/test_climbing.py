"""Climbing: both games' payoffs, cell by cell, and refused options."""

import numpy as np
import pytest

import envs
from tests.helpers import assert_refused, look, play

CLIMBING = [[11, -30, 0], [-30, 7, 6], [0, 0, 5]]  # Claus & Boutilier (1998)
PENALTY = [[10, 0, -30], [0, 2, 0], [-30, 0, 10]]


@pytest.mark.parametrize(("game", "payoffs"), [("climbing", CLIMBING), ("penalty", PENALTY)])
def test_payoffs_and_outcomes(game, payoffs):
    world = envs.make_world("climbing", game=game)
    for joint in np.ndindex(3, 3):
        payoff = payoffs[joint[0]][joint[1]]
        after, reward, outcome = play(world, [0, 0], joint)
        assert (after, reward) == ([1 + joint[0], 1 + joint[1]], payoff)
        assert world.outcome_names[outcome - 1] == ("penalty" if payoff < 0 else f"{payoff}")
    assert world.outcome_names[world.best_outcome - 1] == f"{world.largest_reward:g}"


def test_the_penalty_is_an_option():
    world = envs.make_world("climbing", penalty=2.5)
    assert [play(world, [0, 0], joint)[1] for joint in ((0, 1), (1, 0), (0, 2))] == [-2.5, -2.5, 0]
    free = envs.make_world("climbing", game="penalty", penalty=0)
    assert play(free, [0, 0], (0, 2))[1:] == (0, 4)  # it pays nothing, and is still told apart


def test_nothing_is_seen_and_the_first_step_is_the_last():
    world = envs.make_world("climbing")
    assert look(world, [0, 0]) == look(world, [2, 1]) == [[1.0], [1.0]]
    env = envs.make_vec("climbing", num_envs=1)
    env.reset()
    _, reward, terminated, truncated, info = env.step(np.array([[1, 2]]))
    assert (reward[0], terminated[0], truncated[0], info["outcome"][0]) == (6, True, False, 3)


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("'climbing', 'penalty'", {"game": "chicken"}),
        ("at least 0", {"penalty": -1}),
        ("game, penalty, max_steps", {"size": 3}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "climbing", **options)
