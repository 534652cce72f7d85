"""Passage: episodes recorded from the published code, one rule per test, invariants under random play, refused options.

A state is [row 0, column 0, row 1, column 1, steps for which the door is still open]; the door is (4, 5), the switches are
(8, 2) and (2, 8), and the right room begins in column 6.
"""

import numpy as np
import pytest
from hypothesis import given

import envs
from tests.helpers import RECORDED, assert_refused, assert_replays, look, play, random_play, walk

UP, RIGHT, DOWN, LEFT = range(4)
WORLD = envs.make_world("passage")


@pytest.mark.parametrize("recording", ["passage", "passage30"])
def test_recorded_episodes(recording):
    """Of pass_environment.py in TonghanWang/EITI-EDTI, from its fixed start; its rewards, divided by ten."""
    assert_replays(recording, lambda positions: [*positions[0], *positions[1]], **RECORDED[recording]["options"])


@pytest.mark.parametrize(("action", "target"), [(UP, [4, 3]), (DOWN, [6, 3]), (LEFT, [5, 2]), (RIGHT, [5, 4])])
def test_moves(action, target):
    assert play(WORLD, [5, 3, 0, 0, 0], (action, UP)) == ([*target, 0, 0, 0], 0, 0)
    assert play(WORLD, [0, 0, 5, 3, 0], (UP, action)) == ([0, 0, *target, 0], 0, 0)


@pytest.mark.parametrize(
    ("row", "column", "action"), [(0, 2, UP), (9, 2, DOWN), (5, 0, LEFT), (5, 9, RIGHT), (3, 4, RIGHT), (3, 6, LEFT)]
)
def test_border_and_wall_block_and_cost_nothing(row, column, action):
    assert play(WORLD, [row, column, 0, 0, 0], (action, UP)) == ([row, column, 0, 0, 0], 0, 0)


def test_the_door_is_closed_while_nobody_is_on_a_switch():
    assert play(WORLD, [4, 4, 0, 0, 0], (RIGHT, UP)) == ([4, 4, 0, 0, 0], 0, 0)


@pytest.mark.parametrize(("switch", "back"), [([8, 2], LEFT), ([2, 8], RIGHT)])
def test_either_switch_opens_the_door_for_the_next_step(switch, back):
    aside = [switch[0], switch[1] + (1 if back == RIGHT else -1)]
    onto = LEFT if back == RIGHT else RIGHT
    entered = play(WORLD, [4, 4, *aside, 0], (RIGHT, onto))
    assert entered == ([4, 4, *switch, 1], 0, 0)  # it opens after the moves
    assert play(WORLD, [4, 4, *switch, 1], (RIGHT, back)) == ([4, 5, *aside, 0], 0, 0)  # and closes after them
    assert play(WORLD, [4, 4, *switch, 1], (UP, back), (DOWN, back))[0][:2] == [4, 4]


@pytest.mark.parametrize(("action", "column"), [(LEFT, 4), (RIGHT, 6)])
def test_a_closed_door_lets_go_whoever_stands_in_it(action, column):
    assert play(WORLD, [4, 5, 0, 0, 0], (action, UP)) == ([4, column, 0, 0, 0], 0, 0)


def test_a_door_may_stay_open_for_some_steps():
    world = envs.make_world("passage", door_stays=2)
    aside = ([8, 1, 8, 2, 3], (LEFT, LEFT), (UP, UP), (UP, UP))
    assert [play(world, *aside[: 2 + k])[0][4] for k in range(3)] == [2, 1, 0]
    assert play(world, [8, 0, 8, 2, 1], (LEFT, DOWN))[0][4] == 0
    assert play(world, [9, 0, 9, 2, 1], (LEFT, UP))[0][4] == 3  # held when it would close: open anew


def test_both_have_to_be_in_the_right_room():
    assert play(WORLD, [4, 5, 2, 8, 1], (RIGHT, RIGHT)) == ([4, 6, 2, 9, 0], 100, 1)
    assert play(WORLD, [4, 5, 4, 6, 0], (LEFT, RIGHT)) == ([4, 4, 4, 7, 0], 0, 0)
    assert play(WORLD, [4, 5, 4, 6, 0], (UP, RIGHT)) == ([4, 5, 4, 7, 0], 0, 0)  # the door is in neither room


@pytest.mark.parametrize(("size", "door", "near", "far"), [(15, [6, 7], 3, 12), (30, [13, 14, 15], 6, 24)])
def test_other_sizes_are_the_published_maps(size, door, near, far):
    world = envs.make_world("passage", size=size)
    assert np.argwhere(world.rules[0] == 3).tolist() == [[row, size // 2] for row in door]
    assert sorted(world.switches) == [(near, far), (far, near)]


def test_observations():
    assert look(WORLD, [2, 3, 5, 4, 1]) == [pytest.approx([0.2, 0.3, 0.5, 0.4])] * 2
    own = envs.make_world("passage", observation="own")
    assert look(own, [2, 3, 5, 4, 1]) == [pytest.approx([0.2, 0.3]), pytest.approx([0.5, 0.4])]


@given(random_play(4))
def test_nobody_in_a_wall_and_nobody_through_a_closed_door(actions):
    for step in walk(envs.make_vec("passage"), actions):
        before, after = step.before[0], step.after[0]
        for old, new in zip(before[:4].reshape(2, 2), after[:4].reshape(2, 2), strict=True):
            assert WORLD.rules[0][tuple(new)] != 0
            assert abs(new - old).sum() <= 1
            assert tuple(new) != (4, 5) or tuple(old) == (4, 5) or before[4] > 0
        assert after[4] == any(tuple(agent) in WORLD.switches for agent in after[:4].reshape(2, 2).tolist())


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("at least 10", {"size": 9}),
        ("at least 0", {"door_stays": -1}),
        ("'positions', 'own'", {"observation": "all"}),
        ("size, door_stays, observation, max_steps", {"num_agents": 3}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "passage", **options)
