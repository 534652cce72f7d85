"""PushBox: the recorded episodes, one rule per test, the observations, invariants under random play, refused options.

A state is [x 0, y 0, facing 0, x 1, y 1, facing 1, y of the left small box, of the right one, of the large one]. In the small
room (n = 4) the small boxes are in columns 0 and 3, the large one in 1 and 2; in the larger one (n = 6) in 0 and 5, 2 and 3.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from tests.helpers import assert_refused, assert_replays, look, play, random_play, walk

FORWARD, TURN_LEFT, TURN_RIGHT, WAIT = range(4)
N, E, S, W = range(4)  # facing
SMALL = envs.make_world("pushbox", boundary_penalty=1.0)
LARGE = envs.make_world("pushbox", size=6, boundary_penalty=1.0)
BOXES_4, BOXES_6 = [2, 2, 2], [3, 3, 3]  # where they start


@pytest.mark.parametrize("size", [4, 6, 8])
def test_recorded_episodes(size):
    room = envs.make_world("pushbox", size=size).rules[0]

    def to_state(positions):
        agent_0, agent_1, left, right, large = positions
        assert [left[0], right[0], large[0]] == [room["left"], room["right"], room["large"] + 0.5]
        return [*agent_0, *agent_1, left[1], right[1], large[1]]

    assert_replays(f"pushbox{size}", to_state, size=size, boundary_penalty=5.0, step_penalty=0.1)


def test_turning_left_and_right():
    assert play(SMALL, [0, 0, N, 3, 0, N, *BOXES_4], (TURN_LEFT, TURN_RIGHT)) == ([0, 0, W, 3, 0, E, *BOXES_4], 0, 0)
    assert play(SMALL, [0, 0, W, 3, 0, S, *BOXES_4], (TURN_LEFT, TURN_RIGHT)) == ([0, 0, S, 3, 0, W, *BOXES_4], 0, 0)


def test_waiting():
    assert play(SMALL, SMALL.start, (WAIT, WAIT)) == (SMALL.start.tolist(), 0, 0)


@pytest.mark.parametrize(("facing", "x", "y"), [(N, 2, 2), (E, 3, 1), (S, 2, 0), (W, 1, 1)])
def test_forward_goes_where_the_agent_faces(facing, x, y):
    assert play(LARGE, [2, 1, facing, 5, 0, N, *BOXES_6], (FORWARD, WAIT)) == ([x, y, facing, 5, 0, N, *BOXES_6], 0, 0)


def test_agents_may_share_a_cell():
    assert play(SMALL, [1, 0, E, 3, 0, W, *BOXES_4], (FORWARD, FORWARD)) == ([2, 0, E, 2, 0, W, *BOXES_4], 0, 0)


def test_the_border_blocks_and_costs():
    assert play(SMALL, [0, 0, S, 3, 0, E, *BOXES_4], (FORWARD, WAIT)) == ([0, 0, S, 3, 0, E, *BOXES_4], -1, 0)
    assert play(SMALL, [0, 0, S, 3, 0, E, *BOXES_4], (FORWARD, FORWARD)) == ([0, 0, S, 3, 0, E, *BOXES_4], -2, 0)


def test_a_small_box_is_pushed_from_below():
    assert play(LARGE, [0, 2, N, 5, 0, N, *BOXES_6], (FORWARD, WAIT)) == ([0, 3, N, 5, 0, N, 4, 3, 3], 0, 0)
    assert play(LARGE, [0, 0, N, 5, 2, N, *BOXES_6], (WAIT, FORWARD)) == ([0, 0, N, 5, 3, N, 3, 4, 3], 0, 0)


@pytest.mark.parametrize(("x", "y", "facing"), [(1, 3, W), (0, 4, S)])
def test_a_small_box_does_not_move_otherwise(x, y, facing):
    assert play(LARGE, [x, y, facing, 5, 0, N, *BOXES_6], (FORWARD, WAIT)) == ([x, y, facing, 5, 0, N, *BOXES_6], -1, 0)


def test_both_agents_may_push_one_small_box_but_not_out_of_the_room():
    # Agent 1 stands in the box's cell, because the box was pushed over it.
    assert play(LARGE, [0, 3, N, 0, 4, N, 4, 3, 3], (FORWARD, FORWARD)) == ([0, 4, N, 0, 5, N, 5, 3, 3], 10, 1)
    large = envs.make_world("pushbox", size=8)
    assert play(large, [1, 3, N, 1, 4, N, 4, 4, 4], (FORWARD, FORWARD)) == ([1, 4, N, 1, 5, N, 6, 4, 4], 0, 0)


def test_the_large_box_needs_both_agents():
    below = [2, 2, N, 3, 2, N, *BOXES_6]
    assert play(LARGE, below, (FORWARD, FORWARD)) == ([2, 3, N, 3, 3, N, 3, 3, 4], 0, 0)
    assert play(LARGE, below, (FORWARD, WAIT)) == (below, -5, 0)
    assert play(LARGE, below, (WAIT, FORWARD)) == (below, -5, 0)


def test_either_agent_may_have_either_half_of_the_large_box():
    assert play(LARGE, [3, 2, N, 2, 2, N, *BOXES_6], (FORWARD, FORWARD)) == ([3, 3, N, 2, 3, N, 3, 3, 4], 0, 0)


@pytest.mark.parametrize(
    "state",
    [
        [2, 2, N, 2, 2, N, *BOXES_6],  # both below the same half
        [1, 3, E, 4, 3, W, *BOXES_6],  # from both sides
        [2, 4, S, 3, 4, S, *BOXES_6],  # from above
        [2, 2, N, 4, 3, W, *BOXES_6],  # one from below, one from the side
    ],
)
def test_every_other_push_at_the_large_box_costs(state):
    assert play(LARGE, state, (FORWARD, FORWARD)) == (state, -10, 0)


def test_the_ends():
    assert play(SMALL, [0, 1, N, 3, 0, N, *BOXES_4], (FORWARD, WAIT)) == ([0, 2, N, 3, 0, N, 3, 2, 2], 10, 1)
    assert play(SMALL, [0, 0, N, 3, 1, N, *BOXES_4], (WAIT, FORWARD)) == ([0, 0, N, 3, 2, N, 2, 3, 2], 10, 2)
    assert play(SMALL, [0, 1, N, 3, 1, N, *BOXES_4], (FORWARD, FORWARD)) == ([0, 2, N, 3, 2, N, 3, 3, 2], 20, 3)
    assert play(SMALL, [1, 1, N, 2, 1, N, *BOXES_4], (FORWARD, FORWARD)) == ([1, 2, N, 2, 2, N, 2, 2, 3], 100, 4)


def test_the_penalties_add_up():
    room = envs.make_world("pushbox", lone_push_penalty=7.0, boundary_penalty=2.0, step_penalty=0.25)
    assert play(room, [1, 1, N, 0, 0, S, *BOXES_4], (FORWARD, FORWARD))[1] == -9.25
    assert play(room, [1, 1, N, 2, 1, N, *BOXES_4], (FORWARD, FORWARD))[1] == 99.75


def test_the_default_room_has_only_the_lone_push_penalty():
    room = envs.make_world("pushbox")
    assert play(room, [1, 1, N, 0, 0, S, *BOXES_4], (FORWARD, FORWARD))[1] == -5


@pytest.mark.parametrize(
    ("agent", "other", "seen"),
    [
        ((0, 2, N), (5, 0, N), "small box"),
        ((4, 3, E), (5, 0, N), "small box"),
        ((3, 2, N), (5, 0, N), "large box"),
        ((1, 3, E), (5, 0, N), "large box"),
        ((1, 0, N), (5, 0, N), "empty"),
        ((1, 0, S), (5, 0, N), "boundary"),
        ((1, 0, E), (2, 0, N), "teammate"),
        ((1, 0, E), (1, 0, E), "empty"),  # a teammate in one's own cell is not in front
        ((0, 2, N), (0, 3, N), "small box, teammate"),  # who stands in a box's cell is seen beside it
    ],
)
def test_agents_see_the_cell_in_front(agent, other, seen):
    one_hot = [float(what in seen) for what in ("small box", "large box", "empty", "boundary", "teammate")]
    assert look(LARGE, [*agent, *other, *BOXES_6])[0] == one_hot
    assert look(LARGE, [*other, *agent, *BOXES_6])[1] == one_hot


def test_a_local_state_is_ones_own_place_and_facing_and_the_boxes():
    state = np.array([0, 3, N, 5, 1, W, 4, 3, 2])
    assert state[LARGE.local_index].tolist() == [[0, 3, N, 4, 3, 2], [5, 1, W, 4, 3, 2]]


@pytest.mark.parametrize("size", [4, 6, 8, 10])
@given(data=st.data())
def test_boxes_stay_in_the_room_and_move_only_when_pushed(size, data):
    """One step from any state, reachable or not, so that rare crowds at a box are seen too."""
    world = envs.make_world("pushbox", size=size)
    cell, box = st.integers(0, size - 1), st.integers(size // 2, size - 2)
    before = data.draw(st.tuples(*[cell, cell, st.integers(0, 3)] * 2, box, box, box))
    after, _, outcome = play(world, before, data.draw(st.tuples(*[st.integers(0, 3)] * 2)))
    north = sum(after[y] - before[y] for y in (1, 4) if after[y] > before[y])
    pushed = [now - then for now, then in zip(after[6:], before[6:], strict=True)]
    assert all(0 <= place < size for place in after)
    assert min(pushed) >= 0
    assert pushed[0] + pushed[1] + 2 * pushed[2] <= north  # each agent that goes north moves a small box or half the large one
    at_goal = [y == size - 1 for y in after[6:]]
    assert outcome == (4 if at_goal[2] else at_goal[0] + 2 * at_goal[1])


@given(random_play(4))
def test_agents_always_see_exactly_one_thing(actions):
    for step in walk(envs.make_vec("pushbox"), actions):
        assert step.obs.sum(2).tolist() == [[1, 1]]
        assert set(np.unique(step.obs)) == {0, 1}


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("4, 6, 8, 10", {"size": 5}),
        ("4, 6, 8, 10", {"size": "4"}),
        ("at least 0", {"lone_push_penalty": -1.0}),
        ("at least 0", {"boundary_penalty": float("nan")}),
        ("at least 0", {"step_penalty": float("inf")}),
        ("at least 0", {"step_penalty": "none"}),
        ("at least 0", {"step_penalty": True}),
        ("at least 1", {"max_steps": 0}),
        ("at least 1", {"max_steps": 10.0}),
        ("size, lone_push_penalty, boundary_penalty, step_penalty, max_steps", {"observation": "own"}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "pushbox", **options)
