"""FindTreasure: hold the lever so that your teammate gets through the secret door.

    #######     Two rooms, 7x7 cells (row, column), origin top left.
    #    T#     T: treasure, T = (1, 5)
    #     #
    ##DDD##     D: secret door, open while an agent stands on the lever
    #0   c#     0, 1: where the agents start, (4, 1) and (5, 1)
    #1   L#     L: lever, (5, 5);  c: with L the two meeting cells
    #######

Actions       0 up, 1 down, 2 left, 3 right, 4 wait. Agents move in order and never share a cell. The door opens and
              closes after the moves of a step, so the lever opens the way for the next step; whoever stands in the door
              may always leave it.
Observation   "positions" (default): row and column of all agents divided by the map's size [2 * num_agents]; "own":
              only one's own [2].
Rewards       treasure reached by any agent +100; agents on both meeting cells, whoever they are, +3; bumping into a
              wall, the closed door or a teammate -0.1 for each bump.
Outcomes      1 treasure, 2 meeting (the local optimum; the paper's "alternative terminal state"). Both end the episode.
Optimum       treasure in 8 steps, return 100 (14.29 per step); meeting in 4 steps, return 3 (1.00 per step).
Options       size (7; odd, 7 to 1001: the same map drawn larger), num_agents (2; 2 to 2 * size - 6: they start in columns
              of two from the left), observation, max_steps (200).
Source        the map, the rules for two agents and the bump's cost are the authors' published env_FindTreasure; rewards
              also in Section 4.1. More agents are this repository's.
"""

import numpy as np

from envs.base import LARGEST_MAP, PositionWorld, UsageError, check_whole, rule

UP, DOWN, LEFT, RIGHT, WAIT = range(5)
FREE, WALL, DOOR, LEVER, MEETING, TREASURE = range(6)
TREASURE_REWARD, MEETING_REWARD, BUMP_REWARD = 100.0, 3.0, -0.1


@rule
def step(grid, state, actions):
    """Rules of one step; state = [row 0, column 0, row 1, ...], grid [size, size] holds what is in each cell."""
    num_agents = len(actions)
    door_open = False
    for i in range(num_agents):
        door_open |= grid[state[2 * i], state[2 * i + 1]] == LEVER

    reward = 0.0
    for i in range(num_agents):
        if actions[i] == WAIT:
            continue
        row = state[2 * i] + (actions[i] == DOWN) - (actions[i] == UP)
        column = state[2 * i + 1] + (actions[i] == RIGHT) - (actions[i] == LEFT)
        blocked = grid[row, column] == WALL or (grid[row, column] == DOOR and not door_open)
        for j in range(num_agents):
            blocked |= j != i and row == state[2 * j] and column == state[2 * j + 1]
        if blocked:
            reward += BUMP_REWARD
        else:
            state[2 * i], state[2 * i + 1] = row, column

    treasure = lever = meeting = False
    for i in range(num_agents):
        here = grid[state[2 * i], state[2 * i + 1]]
        treasure |= here == TREASURE
        lever |= here == LEVER
        meeting |= here == MEETING
    if treasure:
        return reward + TREASURE_REWARD, 1
    if lever and meeting:
        return reward + MEETING_REWARD, 2
    return reward, 0


class FindTreasure(PositionWorld):
    """FindTreasure; see the module's docstring."""

    name = "findtreasure"
    action_names = ("up", "down", "left", "right", "wait")
    outcome_names = ("treasure", "meeting")
    best_outcome = 1
    largest_reward = TREASURE_REWARD
    step = staticmethod(step)

    def __init__(self, size: int = 7, num_agents: int = 2, observation: str = "positions", max_steps: int = 200):
        size = check_whole("size", size, minimum=7, maximum=LARGEST_MAP)
        if size % 2 == 0:
            raise UsageError(f"findtreasure's size must be odd (the wall has a middle cell), not {size}.")
        num_agents = check_whole("num_agents", num_agents, minimum=2, maximum=2 * size - 6)  # not on the meeting cells
        middle, last = size // 2, size - 2
        grid = np.full((size, size), WALL, np.int8)
        grid[1:middle, 1:-1] = FREE
        grid[middle + 1 : -1, 1:-1] = FREE
        grid[middle, middle - 1 : middle + 2] = DOOR
        grid[last, last], grid[last - 1, last], grid[1, last] = LEVER, MEETING, TREASURE
        start = [(last - 1 + i % 2, 1 + i // 2) for i in range(num_agents)]
        super().__init__(grid, np.ravel(start), size, num_agents, observation, max_steps)

    def sketch(self, state):
        grid = self.rules
        door_open = LEVER in grid[state[::2], state[1::2]]
        kinds = (None, "wall", "open door" if door_open else "door", "lever", "meeting", "treasure")  # as numbered above
        shapes = [("cell", kinds[grid[r, c]], r, c) for r, c in np.argwhere(grid != FREE)]
        return self.size, self.size, shapes + self.sketch_agents(state)
