"""SecretRoom: episodes recorded from the published code, and what it has beside passage: three doors and their switches.

A state is [row 0, column 0, row 1, column 1, then for the doors A, B and C the steps for which they are still open].
"""

import numpy as np
import pytest
from hypothesis import given

import envs
from tests.helpers import RECORDED, assert_refused, assert_replays, play, random_play, walk

UP, RIGHT, DOWN, LEFT = range(4)
WORLD = envs.make_world("secretroom")


@pytest.mark.parametrize("recording", ["secretroom", "secretroom30"])
def test_recorded_episodes(recording):
    """Of three_pass_environment.py in TonghanWang/EITI-EDTI, from its fixed start; its rewards, divided by ten."""
    assert_replays(recording, lambda positions: [*positions[0], *positions[1]], **RECORDED[recording]["options"])


@pytest.mark.parametrize(
    ("switch", "opened"), [([8, 2], [1, 1, 1]), ([1, 8], [1, 0, 0]), ([5, 8], [0, 1, 0]), ([8, 8], [0, 0, 1])]
)
def test_the_left_switch_opens_all_doors_and_each_other_one_its_own(switch, opened):
    aside = [switch[0], switch[1] - 1]
    assert play(WORLD, [0, 0, *aside, 0, 0, 0], (UP, RIGHT)) == ([0, 0, *switch, *opened], 0, 0)


@pytest.mark.parametrize(("row", "door"), [(0, 0), (1, 0), (4, 1), (5, 1), (7, 2), (8, 2)])
def test_each_door_opens_by_itself(row, door):
    for number in range(3):
        opened = [int(number == d) for d in range(3)]
        entered = play(WORLD, [row, 4, 0, 0, *opened], (RIGHT, UP))[0][:2]
        assert entered == [row, 5 if number == door else 4]


@pytest.mark.parametrize(("row", "passed"), [(0, True), (2, True), (4, False), (7, False)])
def test_only_the_uppermost_room_counts(row, passed):
    reward, outcome = play(WORLD, [row, 6, row, 7, 0, 0, 0], (RIGHT, RIGHT))[1:]
    assert (reward, outcome) == ((100, 1) if passed else (0, 0))


def test_one_alone_there_does_not_end_it():
    assert play(WORLD, [0, 6, 4, 6, 0, 0, 0], (RIGHT, RIGHT))[1:] == (0, 0)


@pytest.mark.parametrize(("size", "doors", "walls"), [(15, [2, 7, 12], [5, 10]), (30, [5, 15, 25], [10, 20])])
def test_other_sizes_are_the_published_maps(size, doors, walls):
    world = envs.make_world("secretroom", size=size)
    for number, row in enumerate(doors):
        assert np.argwhere(world.rules[0] == 3 + number).tolist() == [[row - 1, size // 2], [row, size // 2]]
        assert world.switches[row, 4 * size // 5] == [number]
    assert np.flatnonzero(world.rules[0][:, -1] == 0).tolist() == walls


@given(random_play(4))
def test_nobody_in_a_wall_and_nobody_through_a_closed_door(actions):
    for step in walk(envs.make_vec("secretroom"), actions):
        before, after = step.before[0], step.after[0]
        for old, new in zip(before[:4].reshape(2, 2), after[:4].reshape(2, 2), strict=True):
            kind = WORLD.rules[0][tuple(new)]
            assert kind != 0
            assert kind < 3 or tuple(new) == tuple(old) or before[4 + kind - 3] > 0
        held = [WORLD.switches.get(tuple(agent), []) for agent in after[:4].reshape(2, 2).tolist()]
        assert after[4:].tolist() == [int(any(door in doors for doors in held)) for door in range(3)]


def test_refused_options():
    assert_refused("at least 10", envs.make_world, "secretroom", size=5)
    assert_refused("at least 0", envs.make_world, "secretroom", door_stays=-1)
