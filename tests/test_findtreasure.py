"""FindTreasure: the recorded episodes, one rule per test, the observations, invariants under random play, refused options.

A state is [row 0, column 0, row 1, column 1]; the door is (3, 2) to (3, 4), the lever (5, 5), the treasure (1, 5).
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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


# --- more than two agents ---


@pytest.mark.parametrize("holder", range(3))
def test_any_of_three_may_hold_the_lever(holder):
    world, walker = envs.make_world("findtreasure", num_agents=3), (holder + 1) % 3
    before, joint = np.full((3, 2), [5, 1]), np.full(3, WAIT)
    before[holder], before[walker], joint[walker] = [5, 5], [4, 3], UP
    after = before.copy()
    after[walker] = [3, 3]
    assert play(world, before.ravel(), joint) == (after.ravel().tolist(), 0, 0)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_any_two_of_three_meet_and_any_takes_the_treasure(order):
    world = envs.make_world("findtreasure", num_agents=3)
    order = list(order)

    def end_of(places, actions):
        state, joint = np.zeros((3, 2), int), np.zeros(3, int)
        state[order], joint[order] = places, actions
        return play(world, state.ravel(), joint)[1:]

    assert end_of([[5, 5], [4, 4], [1, 1]], [WAIT, RIGHT, WAIT]) == (3, 2)
    assert end_of([[5, 5], [1, 4], [4, 1]], [WAIT, RIGHT, WAIT]) == (100, 1)
    assert end_of([[5, 5], [4, 4], [1, 4]], [WAIT, RIGHT, RIGHT]) == (100, 1)  # at once: the treasure, and it alone


def test_each_of_three_may_block_and_bump():
    world = envs.make_world("findtreasure", num_agents=3)
    assert play(world, [4, 1, 5, 1, 4, 2], (RIGHT, UP, LEFT)) == ([4, 1, 5, 1, 4, 2], -0.3, 0)
    assert play(world, [4, 2, 5, 1, 4, 1], (RIGHT, RIGHT, RIGHT)) == ([4, 3, 5, 2, 4, 2], 0, 0)  # in order


def test_more_agents_start_in_columns_of_two():
    world = envs.make_world("findtreasure", num_agents=5)
    assert world.start.reshape(-1, 2).tolist() == [[4, 1], [5, 1], [4, 2], [5, 2], [4, 3]]
    assert look(world, world.start)[4] == pytest.approx(np.divide([4, 1, 5, 1, 4, 2, 5, 2, 4, 3], 7))


def test_the_optimum_of_three():
    """The agent that starts nearest to the lever needs 4 steps to it, from where the nearest to the door needs 4 more."""
    optimum = envs.optimum("findtreasure", num_agents=3)
    assert optimum.best_return[:3] == ("treasure", 8, 100)
    assert optimum.fewest["meeting"][1:3] == (4, 3)


@given(st.integers(2, 4).flatmap(lambda num_agents: random_play(5, num_agents=num_agents)))
def test_nobody_in_a_wall_or_in_another(actions):
    num_agents = len(actions[0][0])
    for step in walk(envs.make_vec("findtreasure", num_agents=num_agents), actions):
        agents = step.after[0].reshape(-1, 2)
        assert all(WORLD.rules[row, column] != WALL for row, column in agents)
        assert len({tuple(agent) for agent in agents.tolist()}) == num_agents
        assert np.all(np.abs(step.after - step.before).reshape(-1, 2).sum(1) <= 1)  # at most one cell each
        assert step.terminated[0] or round(step.reward[0], 9) in [-k / 10 for k in range(num_agents + 1)]


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
        ("at least 2", {"num_agents": 1}),
        ("between 2 and 8", {"num_agents": 9}),
        ("size, num_agents, observation, max_steps", {"sise": 7}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "findtreasure", **options)
