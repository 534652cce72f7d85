"""MoveBox: the recorded episodes, one rule per test, the observations, invariants under random play, refused options.

A state is [row 0, column 0, row 1, column 1, row of the box, column of the box]; the box starts on (10, 7).
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.movebox import MAP, WALL
from tests.helpers import RECORDED, assert_refused, assert_replays, look, play, random_play, walk

UP, DOWN, LEFT, RIGHT = range(4)
WORLD = envs.make_world("movebox")
BOX = [10, 7]  # where it starts


def test_the_map_is_the_recorded_one():
    assert [row.replace("f", ".").replace("n", ".") for row in MAP] == RECORDED["movebox"]["map"]
    assert WORLD.start.reshape(3, 2).tolist() == RECORDED["movebox"]["start"]


def test_recorded_episodes():
    assert_replays("movebox", lambda positions: [*positions[0], *positions[1], *positions[2]])


@pytest.mark.parametrize(("action", "target"), [(UP, [7, 3]), (DOWN, [9, 3]), (LEFT, [8, 2]), (RIGHT, [8, 4])])
def test_moves(action, target):
    assert play(WORLD, [8, 3, 13, 13, *BOX], (action, DOWN)) == ([*target, 13, 13, *BOX], 0, 0)
    assert play(WORLD, [13, 13, 8, 3, *BOX], (DOWN, action)) == ([13, 13, *target, *BOX], 0, 0)


@pytest.mark.parametrize(("row", "column", "action"), [(2, 5, UP), (13, 1, DOWN), (8, 1, LEFT), (6, 4, RIGHT), (7, 5, UP)])
def test_walls_block(row, column, action):
    assert play(WORLD, [row, column, 13, 13, *BOX], (action, DOWN)) == ([row, column, 13, 13, *BOX], 0, 0)


def test_the_teammate_blocks_and_agent_0_moves_first():
    assert play(WORLD, [8, 3, 8, 4, *BOX], (RIGHT, RIGHT))[0] == [8, 3, 8, 5, *BOX]  # not free yet
    assert play(WORLD, [8, 4, 8, 3, *BOX], (RIGHT, RIGHT))[0] == [8, 5, 8, 4, *BOX]  # free by then


def test_the_box_blocks():
    above_and_below = [7, 3, 9, 3, 8, 3]
    assert play(WORLD, above_and_below, (DOWN, UP)) == (above_and_below, 0, 0)


@pytest.mark.parametrize("action", range(4))
@pytest.mark.parametrize("column", [6, 8])
def test_who_stands_beside_the_box_no_longer_moves_alone(action, column):
    assert play(WORLD, [10, column, 13, 13, *BOX], (action, DOWN)) == ([10, column, 13, 13, *BOX], 0, 0)
    assert play(WORLD, [13, 13, 10, column, *BOX], (DOWN, action)) == ([13, 13, 10, column, *BOX], 0, 0)


def test_above_or_below_the_box_nobody_holds_it():
    assert play(WORLD, [9, 7, 13, 13, *BOX], (UP, DOWN)) == ([8, 7, 13, 13, *BOX], 0, 0)


@pytest.mark.parametrize(("action", "rows", "columns"), [(UP, -1, 0), (DOWN, 1, 0), (LEFT, 0, -1), (RIGHT, 0, 1)])
@pytest.mark.parametrize("columns_of_agents", [(6, 8), (8, 6)])
def test_both_carry_the_box_where_both_want(action, rows, columns, columns_of_agents):
    first, second = columns_of_agents
    before = np.array([8, first, 8, second, 8, 7])
    assert play(WORLD, before, (action, action)) == ((before + [rows, columns] * 3).tolist(), 0, 0)


def test_both_stand_still_if_they_want_different_things():
    before = [8, 6, 8, 8, 8, 7]
    for actions in ((UP, DOWN), (LEFT, RIGHT), (RIGHT, LEFT), (UP, LEFT)):
        assert play(WORLD, before, actions) == (before, 0, 0)


def test_the_box_is_held_from_the_step_after_the_arrival_on():
    # Both arrive in the first step, in which each still moves alone; only the second one lifts the box.
    arrived = [10, 6, 10, 8, *BOX]
    assert play(WORLD, [10, 5, 10, 9, *BOX], (RIGHT, LEFT)) == (arrived, 0, 0)
    assert play(WORLD, [10, 6, 9, 8, *BOX], (DOWN, DOWN)) == (arrived, 0, 0)
    assert play(WORLD, [10, 5, 10, 9, *BOX], (RIGHT, LEFT), (UP, UP)) == ([9, 6, 9, 8, 9, 7], 0, 0)


@pytest.mark.parametrize(
    ("row", "column", "action"),
    [
        (10, 7, DOWN),  # the wall is below all three
        (10, 5, DOWN),  # below the right agent only
        (10, 9, DOWN),  # below the left agent only
        (7, 5, UP),  # above the right agent and the box
        (8, 2, LEFT),  # beside the left agent
        (8, 12, RIGHT),  # beside the right agent
    ],
)
def test_a_wall_in_the_way_of_any_of_the_three_stops_all(row, column, action):
    before = [row, column - 1, row, column + 1, row, column]
    assert play(WORLD, before, (action, action)) == (before, 0, 0)


def test_the_ends():
    assert play(WORLD, [2, 6, 2, 8, 2, 7], (UP, UP)) == ([1, 6, 1, 8, 1, 7], 100, 1)
    assert play(WORLD, [7, 8, 7, 6, 7, 7], (UP, UP)) == ([6, 8, 6, 6, 6, 7], 10, 2)


def test_agents_in_a_goal_without_the_box_end_nothing():
    assert play(WORLD, [2, 7, 7, 7, *BOX], (UP, UP)) == ([1, 7, 6, 7, *BOX], 0, 0)


def test_positions_show_everything_to_both():
    seen = pytest.approx([2 / 15, 3 / 15, 5 / 15, 4 / 15, 10 / 15, 7 / 15])
    assert look(WORLD, [2, 3, 5, 4, *BOX]) == [seen, seen]


def test_own_shows_each_agent_itself():
    assert look(envs.make_world("movebox", observation="own"), [2, 3, 5, 4, *BOX]) == [
        pytest.approx([2 / 15, 3 / 15]),
        pytest.approx([5 / 15, 4 / 15]),
    ]


def assert_sound(before, after):
    """Nobody in a wall or in each other, no leaps; the box moves only between two agents that move along."""
    cells = after.reshape(3, 2)
    assert all(WORLD.rules[row, column] != WALL for row, column in cells)
    assert len({tuple(cell) for cell in cells}) == 3
    moves = (after - before).reshape(3, 2)
    assert np.all(np.abs(moves).sum(1) <= 1)
    beside = [row == before[4] and abs(column - before[5]) == 1 for row, column in before[:4].reshape(2, 2)]
    if any(moves[2]):
        assert all(beside)
        assert moves[0].tolist() == moves[1].tolist() == moves[2].tolist()
    else:
        assert not any(np.any(moves[i]) for i in range(2) if beside[i])


@given(random_play(4))
def test_random_play_from_the_start(actions):
    for step in walk(envs.make_vec("movebox"), actions):
        assert_sound(step.before[0], step.after[0])


@given(st.data())
def test_one_step_from_any_state(data):
    """Random play hardly ever carries the box, so states are drawn too: often with one or both agents beside it."""
    free = [(int(row), int(column)) for row, column in np.argwhere(WORLD.rules != WALL)]
    box = data.draw(st.sampled_from(free))
    beside = [cell for cell in ((box[0], box[1] - 1), (box[0], box[1] + 1)) if cell in free]
    cell = st.sampled_from(free + beside * 50)
    agents = data.draw(st.tuples(cell, cell).filter(lambda cells: len({*cells, box}) == 3))
    before = np.array([*agents[0], *agents[1], *box])
    after, reward, outcome = play(WORLD, before, data.draw(st.tuples(*[st.integers(0, 3)] * 2)))
    assert_sound(before, np.array(after))
    kind = MAP[after[4]][after[5]]
    assert (outcome, reward) == {"f": (1, 100), "n": (2, 10)}.get(kind, (0, 0))


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("'positions', 'own'", {"observation": "box"}),
        ("at least 1", {"max_steps": 0}),
        ("observation, max_steps", {"size": 15}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "movebox", **options)
