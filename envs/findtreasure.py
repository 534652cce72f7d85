"""FindTreasure: hold the lever so that your teammate gets through the secret door.

    #######     Two rooms, 7x7 cells (row, column), origin top left.
    #    T#     T: treasure, T = (1, 5)
    #     #
    ##DDD##     D: secret door, open while an agent stands on the lever
    #0   c#     0, 1: where the agents start, (4, 1) and (5, 1)
    #1   L#     L: lever, (5, 5);  c: with L the two meeting cells
    #######

Actions       0 up, 1 down, 2 left, 3 right, 4 wait. Agent 0 moves first; agents never share a cell. The door opens and
              closes after the moves of a step, so the lever opens the way for the next step; whoever stands in the door
              may always leave it.
Observation   "positions" (default): row and column of both agents divided by the map's size [4]; "own": only one's own
              [2].
Rewards       treasure reached by any agent +100; both agents on the meeting cells, either way round, +3; bumping into a
              wall, the closed door or the teammate -0.1 for each bump.
Outcomes      1 treasure, 2 meeting (the local optimum; the paper's "alternative terminal state"). Both end the episode.
Optimum       treasure in 8 steps, return 100 (14.29 per step); meeting in 4 steps, return 3 (1.00 per step).
Options       size (7; odd, 7 to 1001: the same map drawn larger), observation, max_steps (200).
Source        the map, the rules and the bump's cost are the authors' published env_FindTreasure; rewards also in
              Section 4.1.
"""

import numpy as np

from envs.base import LARGEST_MAP, PositionWorld, UsageError, check_whole, rule

UP, DOWN, LEFT, RIGHT, WAIT = range(5)
FREE, WALL, DOOR, LEVER, MEETING, TREASURE = range(6)
TREASURE_REWARD, MEETING_REWARD, BUMP_REWARD = 100.0, 3.0, -0.1


@rule
def step(grid, state, actions):
    """Rules of one step; state = [row 0, column 0, row 1, column 1], grid [size, size] holds what is in each cell."""
    door_open = grid[state[0], state[1]] == LEVER or grid[state[2], state[3]] == LEVER
    reward = 0.0
    for i in range(2):
        if actions[i] == WAIT:
            continue
        row = state[2 * i] + (actions[i] == DOWN) - (actions[i] == UP)
        column = state[2 * i + 1] + (actions[i] == RIGHT) - (actions[i] == LEFT)
        other = 2 * (1 - i)
        teammate = row == state[other] and column == state[other + 1]
        closed = grid[row, column] == DOOR and not door_open
        if grid[row, column] == WALL or closed or teammate:
            reward += BUMP_REWARD
        else:
            state[2 * i], state[2 * i + 1] = row, column

    here, there = grid[state[0], state[1]], grid[state[2], state[3]]
    if here == TREASURE or there == TREASURE:
        return reward + TREASURE_REWARD, 1
    if (here == LEVER and there == MEETING) or (here == MEETING and there == LEVER):
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

    def __init__(self, size: int = 7, observation: str = "positions", max_steps: int = 200):
        size = check_whole("size", size, minimum=7, maximum=LARGEST_MAP)
        if size % 2 == 0:
            raise UsageError(f"findtreasure's size must be odd (the wall has a middle cell), not {size}.")
        middle, last = size // 2, size - 2
        grid = np.full((size, size), WALL, np.int8)
        grid[1:middle, 1:-1] = FREE
        grid[middle + 1 : -1, 1:-1] = FREE
        grid[middle, middle - 1 : middle + 2] = DOOR
        grid[last, last], grid[last - 1, last], grid[1, last] = LEVER, MEETING, TREASURE
        super().__init__(grid, [last - 1, 1, last, 1], size, num_agents=2, observation=observation, max_steps=max_steps)

    def sketch(self, state):
        grid = self.rules
        door_open = LEVER in (grid[state[0], state[1]], grid[state[2], state[3]])
        kinds = (None, "wall", "open door" if door_open else "door", "lever", "meeting", "treasure")  # as numbered above
        shapes = [("cell", kinds[grid[r, c]], r, c) for r, c in np.argwhere(grid != FREE)]
        return self.size, self.size, shapes + self.sketch_agents(state)
