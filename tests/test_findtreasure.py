"""FindTreasure: the recorded episodes, one rule per test, the observations, invariants under random play, refused options.

A state is [row 0, column 0, row 1, column 1]; the door is (3, 2) to (3, 4), the lever (5, 5), the treasure (1, 5).
"""

import numpy as np
import pytest
from hypothesis import given

import envs
from envs.findtreasure import DOOR, WALL
from tests.helpers import assert_refused, assert_replays, look, play, random_play, walk

UP, DOWN, LEFT, RIGHT, WAIT = range(5)
WORLD = envs.make_world("findtreasure")


def test_recorded_episodes():
    assert_replays("findtreasure", lambda positions: [*positions[0], *positions[1]])


@pytest.mark.parametrize(("action", "target"), [(UP, [1, 3]), (DOWN, [3, 3]), (LEFT, [2, 2]), (RIGHT, [2, 4]), (WAIT, [2, 3])])
def test_moves(action, target):
    assert play(WORLD, [2, 3, 5, 5], (action, WAIT)) == ([*target, 5, 5], 0, 0)
    assert play(WORLD, [5, 5, 2, 3], (WAIT, action)) == ([5, 5, *target], 0, 0)


def test_each_bump_into_the_wall_costs():
    assert play(WORLD, [4, 1, 5, 1], (LEFT, WAIT)) == ([4, 1, 5, 1], -0.1, 0)
    assert play(WORLD, [4, 1, 5, 1], (LEFT, DOWN)) == ([4, 1, 5, 1], -0.2, 0)


def test_a_teammate_blocks():
    assert play(WORLD, [4, 1, 5, 1], (WAIT, UP)) == ([4, 1, 5, 1], -0.1, 0)


def test_agent_0_moves_first():
    assert play(WORLD, [4, 1, 5, 1], (RIGHT, UP)) == ([4, 2, 4, 1], 0, 0)  # the cell is free by then
    assert play(WORLD, [4, 1, 5, 1], (DOWN, RIGHT)) == ([4, 1, 5, 2], -0.1, 0)  # the cell is not free yet


def test_the_door_is_closed():
    assert play(WORLD, [4, 3, 5, 1], (UP, WAIT)) == ([4, 3, 5, 1], -0.1, 0)


def test_the_lever_opens_the_door():
    assert play(WORLD, [4, 3, 5, 5], (UP, WAIT)) == ([3, 3, 5, 5], 0, 0)
    assert play(WORLD, [5, 5, 4, 3], (WAIT, UP)) == ([5, 5, 3, 3], 0, 0)


def test_the_lever_works_from_the_next_step_on():
    assert play(WORLD, [5, 4, 4, 3], (RIGHT, UP)) == ([5, 5, 4, 3], -0.1, 0)
    assert play(WORLD, [5, 4, 4, 3], (RIGHT, UP), (WAIT, UP)) == ([5, 5, 3, 3], 0, 0)


def test_leaving_the_lever_closes_the_door_after_the_step():
    assert play(WORLD, [5, 5, 4, 3], (LEFT, UP)) == ([5, 4, 3, 3], 0, 0)
    assert play(WORLD, [5, 5, 4, 3], (LEFT, WAIT), (WAIT, UP)) == ([5, 4, 4, 3], -0.1, 0)


@pytest.mark.parametrize(("action", "target"), [(UP, [2, 3]), (DOWN, [4, 3])])
def test_a_closed_door_lets_go_whoever_stands_in_it(action, target):
    assert play(WORLD, [3, 3, 5, 1], (action, WAIT)) == ([*target, 5, 1], 0, 0)


def test_from_door_cell_to_door_cell_only_while_it_is_open():
    assert play(WORLD, [3, 3, 5, 5], (LEFT, WAIT)) == ([3, 2, 5, 5], 0, 0)
    assert play(WORLD, [3, 3, 5, 1], (LEFT, WAIT)) == ([3, 3, 5, 1], -0.1, 0)


def test_the_treasure_is_either_agents():
    assert play(WORLD, [1, 4, 5, 5], (RIGHT, WAIT)) == ([1, 5, 5, 5], 100, 1)
    assert play(WORLD, [5, 5, 2, 5], (WAIT, UP)) == ([5, 5, 1, 5], 100, 1)


def test_the_meeting_works_either_way_round():
    assert play(WORLD, [4, 4, 5, 4], (RIGHT, RIGHT)) == ([4, 5, 5, 5], 3, 2)
    assert play(WORLD, [5, 4, 4, 4], (RIGHT, RIGHT)) == ([5, 5, 4, 5], 3, 2)


def test_one_agent_alone_does_not_meet():
    assert play(WORLD, [4, 4, 5, 1], (RIGHT, WAIT)) == ([4, 5, 5, 1], 0, 0)


def test_a_bump_is_taken_off_the_last_reward():
    assert play(WORLD, [5, 5, 4, 4], (RIGHT, RIGHT)) == ([5, 5, 4, 5], 2.9, 2)
    assert play(WORLD, [5, 5, 1, 4], (RIGHT, RIGHT)) == ([5, 5, 1, 5], 99.9, 1)


def test_a_larger_map_has_the_same_places():
    large = envs.make_world("findtreasure", size=9)
    assert large.start.tolist() == [6, 1, 7, 1]
    assert np.argwhere(large.rules == DOOR).tolist() == [[4, 3], [4, 4], [4, 5]]
    assert play(large, [1, 6, 7, 7], (RIGHT, WAIT)) == ([1, 7, 7, 7], 100, 1)
    assert play(large, [6, 6, 7, 6], (RIGHT, RIGHT)) == ([6, 7, 7, 7], 3, 2)


def test_positions_show_both_agents_to_both():
    seen = pytest.approx([2 / 7, 3 / 7, 5 / 7, 4 / 7])
    assert look(WORLD, [2, 3, 5, 4]) == [seen, seen]


def test_own_shows_each_agent_itself():
    assert look(envs.make_world("findtreasure", observation="own"), [2, 3, 5, 4]) == [
        pytest.approx([2 / 7, 3 / 7]),
        pytest.approx([5 / 7, 4 / 7]),
    ]


@given(random_play(5))
def test_nobody_in_a_wall_or_in_the_other(actions):
    for step in walk(envs.make_vec("findtreasure"), actions):
        agents = step.after[0].reshape(2, 2)
        assert all(WORLD.rules[row, column] != WALL for row, column in agents)
        assert agents[0].tolist() != agents[1].tolist()
        assert np.all(np.abs(step.after - step.before).reshape(2, 2).sum(1) <= 1)  # at most one cell each
        assert step.terminated[0] or round(step.reward[0], 9) in (0, -0.1, -0.2)


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("at least 7", {"size": 5}),
        ("at least 7", {"size": 7.0}),
        ("at least 7", {"size": "large"}),
        ("odd", {"size": 8}),
        ("'positions', 'own'", {"observation": "all"}),
        ("at least 1", {"max_steps": 0}),
        ("at least 1", {"max_steps": True}),
        ("size, observation, max_steps", {"sise": 7}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "findtreasure", **options)
