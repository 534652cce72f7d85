"""GoTogether: the recorded episodes, one rule per test, the observations, invariants under random play, refused options.

A state is [row 0, column 0, row 1, column 1]; the goal is (1, 13).
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.gotogether import WALL
from tests.helpers import assert_refused, assert_replays, look, play, random_play, walk

UP, DOWN, LEFT, RIGHT = range(4)
WORLD = envs.make_world("gotogether")


def test_recorded_episodes():
    assert_replays("gotogether", lambda positions: [*positions[0], *positions[1]])


@pytest.mark.parametrize(("action", "target"), [(UP, [4, 5]), (DOWN, [6, 5]), (LEFT, [5, 4]), (RIGHT, [5, 6])])
def test_moves(action, target):
    assert play(WORLD, [5, 5, 6, 1], (action, LEFT))[0] == [*target, 6, 1]
    assert play(WORLD, [6, 1, 5, 5], (LEFT, action))[0] == [6, 1, *target]


@pytest.mark.parametrize(("row", "column", "action"), [(1, 5, UP), (13, 5, DOWN), (5, 1, LEFT), (5, 13, RIGHT)])
def test_the_wall_blocks_and_costs_nothing(row, column, action):
    together = [row, column] * 2
    assert play(WORLD, together, (action, action)) == (together, -0.5, 0)  # for the distance only


def test_agents_may_share_a_cell_and_pass_through_each_other():
    assert play(WORLD, [5, 5, 5, 7], (RIGHT, LEFT))[0] == [5, 6, 5, 6]
    assert play(WORLD, [5, 5, 5, 6], (RIGHT, LEFT))[0] == [5, 6, 5, 5]


@pytest.mark.parametrize(
    ("rows", "columns", "reward"),
    [
        *((0, 0, -0.5), (0, 1, -0.5), (1, 0, -0.5)),  # squared distances 0 and 1: too close
        *((1, 1, 0), (0, 2, 0), (2, 2, 0), (0, 3, 0), (3, 0, 0)),  # 2 to 9
        *((1, 3, -0.5), (3, 1, -0.5), (0, 4, -0.5), (12, 3, -0.5)),  # 10 and more: too far apart
    ],
)
def test_the_distance_after_the_moves_counts(rows, columns, reward):
    before = [1, 5, 1 + rows, 5 + columns]
    after = [1, 4, 1 + rows, 4 + columns]
    assert play(WORLD, before, (LEFT, LEFT)) == (after, reward, 0)


def test_both_at_the_goal_end_the_episode_too_close():
    assert play(WORLD, [1, 12, 2, 13], (RIGHT, UP)) == ([1, 13, 1, 13], 9.5, 1)
    assert play(WORLD, [2, 13, 1, 13], (UP, UP)) == ([1, 13, 1, 13], 9.5, 1)


def test_one_alone_at_the_goal_does_not_end_it():
    assert play(WORLD, [1, 12, 1, 10], (RIGHT, RIGHT)) == ([1, 13, 1, 11], 0, 0)


@pytest.mark.parametrize("size", [5, 6, 21])
def test_other_sizes_have_the_same_corners(size):
    world = envs.make_world("gotogether", size=size)
    assert world.start.tolist() == [size - 3, 1, size - 2, 2]
    goal = [1, size - 2]
    assert play(world, [1, size - 3, 2, size - 2], (RIGHT, UP)) == ([*goal, *goal], 9.5, 1)
    assert (world.rules == WALL).sum() == 4 * (size - 1)


def test_positions_show_both_agents_to_both():
    seen = pytest.approx([2 / 15, 3 / 15, 5 / 15, 4 / 15])
    assert look(WORLD, [2, 3, 5, 4]) == [seen, seen]


def test_own_shows_each_agent_itself():
    assert look(envs.make_world("gotogether", observation="own"), [2, 3, 5, 4]) == [
        pytest.approx([2 / 15, 3 / 15]),
        pytest.approx([5 / 15, 4 / 15]),
    ]


# --- more than two agents ---


@pytest.mark.parametrize(
    ("agents", "reward"),
    [
        ([[5, 5], [5, 8], [5, 11]], 0),  # a chain: the outer ones are far from each other, but near the middle one
        ([[5, 5], [5, 8], [5, 12]], -0.5),  # the last one has nobody in reach
        ([[5, 5], [5, 8], [5, 9]], -0.5),  # two are too close
        ([[5, 5], [5, 6], [5, 12]], -0.5),  # both at once cost no more
        ([[2, 2], [2, 4], [9, 9], [9, 11]], 0),  # two pairs
    ],
)
def test_the_nearest_teammate_counts(agents, reward):
    world = envs.make_world("gotogether", num_agents=len(agents))
    before = [[row, column + 1] for row, column in agents]
    after = np.ravel(agents).tolist()
    assert play(world, np.ravel(before), (LEFT,) * len(agents)) == (after, reward, 0)


def test_all_have_to_be_at_the_goal():
    world = envs.make_world("gotogether", num_agents=3)
    assert play(world, [1, 12, 2, 13, 2, 13], (RIGHT, UP, UP)) == ([1, 13] * 3, 9.5, 1)
    assert play(world, [1, 12, 2, 13, 3, 13], (RIGHT, UP, UP)) == ([1, 13, 1, 13, 2, 13], -0.5, 0)


def test_more_agents_start_in_two_rows_by_turns():
    world = envs.make_world("gotogether", size=6, num_agents=4)
    assert world.start.reshape(-1, 2).tolist() == [[3, 1], [4, 2], [3, 3], [4, 4]]
    assert look(world, world.start)[3] == pytest.approx(np.divide([3, 1, 4, 2, 3, 3, 4, 4], 6))


@pytest.mark.parametrize(("size", "steps"), [(5, 3), (7, 7), (9, 11)])
def test_the_optimum_of_three(size, steps):
    """Agent 0 has farthest to go. One step before the end all are within a step of the corner, so two are too close there."""
    best = envs.optimum("gotogether", size=size, num_agents=3).best_return
    assert best[:3] == ("goal", steps, 9.0)


@given(st.integers(2, 4).flatmap(lambda num_agents: random_play(4, num_agents=num_agents)))
def test_nobody_in_a_wall_and_the_reward_is_the_distances(actions):
    num_agents = len(actions[0][0])
    for step in walk(envs.make_vec("gotogether", size=6, num_agents=num_agents), actions):
        agents = step.after[0].reshape(-1, 2)
        assert np.all((agents >= 1) & (agents <= 4))
        assert np.all(np.abs(step.after - step.before).reshape(-1, 2).sum(1) <= 1)  # at most one cell each
        if not np.array_equal(step.before, step.after):  # still running
            distances = ((agents[:, None] - agents) ** 2).sum(2)
            nearest = np.where(np.eye(num_agents), np.inf, distances).min(1)
            at_goal = agents.tolist() == [[1, 4]] * num_agents
            assert step.terminated[0] == at_goal
            assert step.reward[0] == -0.5 * bool(((nearest < 2) | (nearest > 9)).any()) + 10 * at_goal


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("at least 5", {"size": 4}),
        ("at least 5", {"size": "large"}),
        ("'positions', 'own'", {"observation": "all"}),
        ("at least 1", {"max_steps": 0}),
        ("at least 2", {"num_agents": 1}),
        ("between 2 and 3", {"size": 5, "num_agents": 4}),
        ("size, num_agents, observation, max_steps", {"agents": 3}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "gotogether", **options)
