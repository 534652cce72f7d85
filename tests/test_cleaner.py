"""Cleaner: the recorded episodes, one rule per test, mazes, the constructed plan, invariants, refused options.

A state is the rows and columns of all agents, then 1 for each dirty and 0 for each clean cell, in the order of the map's rows.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs.cleaner import MAZE, WALL
from tests.helpers import RECORDED, assert_refused, assert_replays, look, random_play, walk

UP, DOWN, LEFT, RIGHT = range(4)
WORLD = envs.make_world("cleaner")


def play(world, positions, *actions, clean=()):
    """Play joint `actions` from `positions`, where only the cells in `clean` are clean.

    Returns the positions then, the cells that the actions cleaned, and reward and outcome of the last step.
    """
    state = world.start.copy()
    state[: len(positions)] = positions
    for cell in clean:
        state[world.rules[cell]] = 0
    before = state.copy()
    for joint in actions:
        reward, outcome = world.step(world.rules, state, np.array(joint))
    cells = {(int(r), int(c)) for r, c in np.argwhere(world.rules != WALL)}
    cleaned = {cell for cell in cells if state[world.rules[cell]] != before[world.rules[cell]]}
    return state[: len(positions)].tolist(), cleaned, reward, outcome


def test_the_maze_is_the_recorded_one():
    assert list(MAZE) == RECORDED["cleaner"]["maze"]
    assert WORLD.start[:4].reshape(2, 2).tolist() == RECORDED["cleaner"]["start"]


def test_recorded_episodes():
    assert_replays("cleaner", lambda positions: [*positions[0], *positions[1]], max_steps=201)


@pytest.mark.parametrize(("action", "target"), [(UP, (8, 5)), (DOWN, (10, 5)), (LEFT, (9, 4)), (RIGHT, (9, 6))])
def test_moves_walls_and_cleaning(action, target):
    stays = MAZE[target[0]][target[1]] == "#"
    after = (9, 5) if stays else target
    assert play(WORLD, [9, 5, 1, 1], (action, UP), clean=[(1, 1)]) == ([*after, 1, 1], {after}, 1, 0)
    assert play(WORLD, [1, 1, 9, 5], (UP, action), clean=[(1, 1)]) == ([1, 1, *after], {after}, 1, 0)


def test_a_clean_cell_earns_nothing():
    assert play(WORLD, [1, 1, 5, 5], (RIGHT, UP), clean=[(1, 2), (5, 5)]) == ([1, 2, 5, 5], set(), 0, 0)


def test_the_cell_that_an_agent_leaves_stays_dirty():
    assert play(WORLD, [1, 1, 1, 1], (RIGHT, DOWN)) == ([1, 2, 2, 1], {(1, 2), (2, 1)}, 2, 0)


def test_the_start_is_cleaned_by_whoever_stands_on_it_after_a_move():
    assert play(WORLD, [1, 1, 1, 1], (UP, LEFT)) == ([1, 1, 1, 1], {(1, 1)}, 1, 0)
    assert play(WORLD, [1, 1, 1, 1], (RIGHT, RIGHT), (LEFT, RIGHT)) == ([1, 1, 1, 3], {(1, 1), (1, 2), (1, 3)}, 2, 0)


def test_two_agents_on_one_dirty_cell_earn_once():
    assert play(WORLD, [1, 1, 1, 1], (RIGHT, RIGHT)) == ([1, 2, 1, 2], {(1, 2)}, 1, 0)


def test_it_never_ends_before_the_time_limit():
    clean = [(int(r), int(c)) for r, c in np.argwhere(WORLD.rules != WALL)]
    assert play(WORLD, [1, 1, 1, 1], (RIGHT, RIGHT), clean=clean) == ([1, 2, 1, 2], set(), 0, 0)
    *_, last = walk(envs.make_vec("cleaner"), WORLD.plan())
    assert (last.terminated.tolist(), last.truncated.tolist(), last.info["outcome"].tolist()) == ([False], [True], [0])
    assert last.info["state"][0, 4:].sum() == 0


def test_any_number_of_agents():
    for num_agents in (1, 3):
        world = envs.make_world("cleaner", num_agents=num_agents)
        assert world.start.tolist() == [1, 1] * num_agents + [1] * 71
        assert look(world, world.start) == [pytest.approx([1 / 13] * 2 * num_agents)] * num_agents
        after = play(world, [1, 1] * num_agents, [RIGHT] * num_agents)
        assert after == ([1, 2] * num_agents, {(1, 2)}, 1, 0)


def is_tree(world):
    """Whether the free cells hang together without a loop, by growing the set of cells that can be reached."""
    free = {(int(r), int(c)) for r, c in np.argwhere(world.rules != WALL)}
    links = sum((r + 1, c) in free for r, c in free) + sum((r, c + 1) in free for r, c in free)
    reached, grown = set(), {(1, 1)}
    while grown != reached:
        reached = grown
        grown = reached | {
            cell for r, c in reached for cell in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)) if cell in free
        }
    return reached == free and links == len(free) - 1


@given(st.integers(2, 10), st.integers(0, 1000))
def test_a_drawn_maze_joins_all_rooms_without_a_loop(half, seed):
    size = 2 * half + 1
    world = envs.make_world("cleaner", size=size, maze_seed=seed)
    assert np.all(world.rules[1::2, 1::2] != WALL)
    assert (world.rules != WALL).sum() == 2 * half**2 - 1
    assert np.all(world.rules[[0, -1]] == WALL)
    assert np.all(world.rules[:, [0, -1]] == WALL)
    assert is_tree(world)


@pytest.mark.parametrize("size", [127, 255, 257, 301])
def test_the_rules_hold_in_mazes_of_any_size(size):
    """The last room's number in the state is beyond 16 bits from size 257 on."""
    world = envs.make_world("cleaner", size=size)
    free = world.rules != WALL
    assert np.array_equal(world.rules[free], 4 + np.arange(free.sum()))
    last = size - 2
    _, _, reward, _ = play(world, [last, last, 1, 1], (DOWN, UP))
    assert reward == 2


def test_sizes_are_numbers_of_any_type():
    world = envs.make_world("cleaner", size=np.int8(13), num_agents=np.int8(100))
    assert len(world.start) == 200 + 71


def test_mazes_come_from_their_seed():
    def maze(**options):
        return (envs.make_world("cleaner", **options).rules != WALL).tolist()

    assert is_tree(WORLD)
    assert maze(maze_seed=3) == maze(maze_seed=3)
    assert maze(maze_seed=3) != maze(maze_seed=4)
    assert maze(maze_seed=0) != maze()  # the published one is none of the drawn ones
    assert maze(size=9) == maze(size=9, maze_seed=0)


@pytest.mark.parametrize(("num_agents", "steps"), [(1, 127), (2, 61), (3, 77)])
def test_the_plan_cleans_the_published_maze(num_agents, steps):
    env = envs.make_vec("cleaner", num_agents=num_agents)
    rewards = [step.reward[0] for step in walk(env, env.world.plan())]
    assert (len(rewards), sum(rewards)) == (200, 71)
    assert np.flatnonzero(rewards)[-1] + 1 == steps


def test_the_optimum_is_what_the_plan_earns():
    found = envs.optimum("cleaner")
    assert found.best_return == found.best_per_step == ("time limit", 200, 71, pytest.approx(71 / 199))
    assert (found.fewest, found.num_states) == ({}, None)
    assert str(found).splitlines()[-1] == "constructed and played, not searched"
    assert envs.optimum("cleaner", max_steps=10).best_return == ("time limit", 10, 11, pytest.approx(11 / 9))


def test_no_outcome_is_best():
    log = envs.EpisodeLog(WORLD, num_trials=2, num_episodes=3)
    log.add(0, np.full((200, 2), 0.25), [200, 200], [0, 0])
    assert np.isnan(log.share_at_best(slice(None)))
    assert "usual end: 2 time limit;" in log.summary(slice(None))


def test_positions_show_all_agents_to_all():
    seen = pytest.approx([1 / 13, 3 / 13, 5 / 13, 4 / 13])
    assert look(WORLD, [1, 3, 5, 4, *WORLD.start[4:]]) == [seen, seen]


def test_own_shows_each_agent_itself():
    world = envs.make_world("cleaner", observation="own")
    assert look(world, [1, 3, 5, 4, *world.start[4:]]) == [pytest.approx([1 / 13, 3 / 13]), pytest.approx([5 / 13, 4 / 13])]


@given(random_play(4))
def test_nobody_in_a_wall_and_the_reward_is_the_dirt_that_is_gone(actions):
    for step in walk(envs.make_vec("cleaner"), actions):
        agents = step.after[0, :4].reshape(2, 2)
        places = [WORLD.rules[row, column] for row, column in agents]
        assert WALL not in places
        assert np.all(np.abs(step.after - step.before)[0, :4].reshape(2, 2).sum(1) <= 1)  # at most one cell each
        gone = np.flatnonzero(step.before[0, 4:] - step.after[0, 4:]) + 4
        assert set(gone) <= set(places)
        assert step.reward[0] == len(gone)
        assert not step.after[0, places].any()


@pytest.mark.parametrize(
    ("accepted", "options"),
    [
        ("at least 5", {"size": 3}),
        ("between 5 and 1001", {"size": 1003}),
        ("between 1 and 1000", {"num_agents": 10**9}),
        ("between 0 and 9223372036854775807", {"maze_seed": 10**30}),
        ("between 1 and 2147483647", {"max_steps": 10**30}),
        ("odd", {"size": 8}),
        ("at least 1", {"num_agents": 0}),
        ("at least 1", {"num_agents": 2.0}),
        ("'positions', 'own'", {"observation": "dirt"}),
        ("at least 0", {"maze_seed": -1}),
        ("at least 0", {"maze_seed": "published"}),
        ("at least 1", {"max_steps": 0}),
        ("size, num_agents, observation, maze_seed, max_steps", {"maze": 1}),
    ],
)
def test_refused_options(accepted, options):
    assert_refused(accepted, envs.make_world, "cleaner", **options)
