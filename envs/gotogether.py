"""GoTogether: walk to the goal side by side, neither too close to each other nor too far apart.

    ###############     An empty room, 15x15 cells (row, column), origin top left.
    #            G#     G: goal, (1, 13)
    #             #
          ...           (nine more rows)
    #0            #     0, 1: where the agents start, (12, 1) and (13, 2)
    # 1           #
    ###############

Actions       0 up, 1 down, 2 left, 3 right. The wall blocks; agents may share a cell.
Observation   "positions" (default): row and column of both agents divided by the map's size [4]; "own": only one's own
              [2].
Rewards       both agents at the goal +10; after every step, the last one too, -0.5 if the agents are too close (squared
              distance 0 or 1) or too far apart (squared distance above 9).
Outcomes      1 goal: both agents at the goal, which ends the episode. They are too close there, so it pays 9.5.
Optimum       goal in 23 steps, return 9.5 (0.43 per step).
Options       size (15; 5 to 1001: agents start at (size - 3, 1) and (size - 2, 2), the goal is (1, size - 2)),
              observation, max_steps (2000).
Source        the map and the rules are the authors' published env_GoTogether; rewards also in Section 4.1, the time
              limit in Table 1.
"""

import numpy as np

from envs.base import LARGEST_MAP, PositionWorld, check_whole, rule

FREE, WALL, GOAL = range(3)
UP, DOWN, LEFT, RIGHT = range(4)
GOAL_REWARD, DISTANCE_REWARD = 10.0, -0.5
TOO_CLOSE, FARTHEST = 1, 9  # squared distances


@rule
def step(grid, state, actions):
    """Rules of one step; state = [row 0, column 0, row 1, column 1], grid [size, size] holds what is in each cell."""
    for i in range(2):
        row = state[2 * i] + (actions[i] == DOWN) - (actions[i] == UP)
        column = state[2 * i + 1] + (actions[i] == RIGHT) - (actions[i] == LEFT)
        if grid[row, column] != WALL:
            state[2 * i], state[2 * i + 1] = row, column

    distance = (state[0] - state[2]) ** 2 + (state[1] - state[3]) ** 2
    reward = 0.0 if TOO_CLOSE < distance <= FARTHEST else DISTANCE_REWARD
    if grid[state[0], state[1]] == GOAL and grid[state[2], state[3]] == GOAL:
        return reward + GOAL_REWARD, 1
    return reward, 0


class GoTogether(PositionWorld):
    """GoTogether; see the module's docstring."""

    name = "gotogether"
    action_names = ("up", "down", "left", "right")
    outcome_names = ("goal",)
    best_outcome = 1
    largest_reward = GOAL_REWARD
    step = staticmethod(step)

    def __init__(self, size: int = 15, observation: str = "positions", max_steps: int = 2000):
        size = check_whole("size", size, minimum=5, maximum=LARGEST_MAP)
        grid = np.full((size, size), WALL, np.int8)
        grid[1:-1, 1:-1] = FREE
        grid[1, size - 2] = GOAL
        super().__init__(grid, [size - 3, 1, size - 2, 2], size, num_agents=2, observation=observation, max_steps=max_steps)

    def sketch(self, state):
        kinds = (None, "wall", "goal")  # as numbered above
        shapes = [("cell", kinds[self.rules[r, c]], r, c) for r, c in np.argwhere(self.rules != FREE)]
        return self.size, self.size, shapes + self.sketch_agents(state)
