"""GoTogether: walk to the goal side by side, neither too close to each other nor too far apart.

    ###############     An empty room, 15x15 cells (row, column), origin top left.
    #            G#     G: goal, (1, 13)
    #             #
          ...           (nine more rows)
    #0            #     0, 1: where the agents start, (12, 1) and (13, 2)
    # 1           #
    ###############

Actions       0 up, 1 down, 2 left, 3 right. The wall blocks; agents may share a cell.
Observation   "positions" (default): row and column of all agents divided by the map's size [2 * num_agents]; "own":
              only one's own [2].
Rewards       all agents at the goal +10; after every step, the last one too, -0.5 if any agent is too close to its
              nearest teammate (squared distance 0 or 1) or too far from it (squared distance above 9).
Outcomes      1 goal: all agents at the goal, which ends the episode. They are too close there, so it pays 9.5.
Optimum       goal in 23 steps, return 9.5 (0.43 per step).
Options       size (15; 5 to 1001: the goal is (1, size - 2)), num_agents (2; 2 to size - 2: they start from left to right
              in rows size - 3 and size - 2 by turns), observation, max_steps (2000).
Source        the map and the rules for two agents are the authors' published env_GoTogether; rewards also in Section 4.1,
              the time limit in Table 1. More agents are this repository's.
"""

import numpy as np

from envs.base import LARGEST_MAP, PositionWorld, check_whole, rule

FREE, WALL, GOAL = range(3)
UP, DOWN, LEFT, RIGHT = range(4)
GOAL_REWARD, DISTANCE_REWARD = 10.0, -0.5
TOO_CLOSE, FARTHEST, ANYWHERE = 1, 9, 2 * LARGEST_MAP**2  # squared distances


@rule
def step(grid, state, actions):
    """Rules of one step; state = [row 0, column 0, row 1, ...], grid [size, size] holds what is in each cell."""
    num_agents = len(actions)
    all_at_goal = True
    for i in range(num_agents):
        row = state[2 * i] + (actions[i] == DOWN) - (actions[i] == UP)
        column = state[2 * i + 1] + (actions[i] == RIGHT) - (actions[i] == LEFT)
        if grid[row, column] != WALL:
            state[2 * i], state[2 * i + 1] = row, column
        all_at_goal &= grid[state[2 * i], state[2 * i + 1]] == GOAL

    reward = 0.0
    for i in range(num_agents):
        nearest = ANYWHERE
        for j in range(num_agents):
            if j != i:
                distance = (state[2 * i] - state[2 * j]) ** 2 + (state[2 * i + 1] - state[2 * j + 1]) ** 2
                nearest = min(nearest, distance)
        if not TOO_CLOSE < nearest <= FARTHEST:
            reward = DISTANCE_REWARD
    return (reward + GOAL_REWARD, 1) if all_at_goal else (reward, 0)


class GoTogether(PositionWorld):
    """GoTogether; see the module's docstring."""

    name = "gotogether"
    action_names = ("up", "down", "left", "right")
    outcome_names = ("goal",)
    best_outcome = 1
    largest_reward = GOAL_REWARD
    step = staticmethod(step)

    def __init__(self, size: int = 15, num_agents: int = 2, observation: str = "positions", max_steps: int = 2000):
        size = check_whole("size", size, minimum=5, maximum=LARGEST_MAP)
        num_agents = check_whole("num_agents", num_agents, minimum=2, maximum=size - 2)
        grid = np.full((size, size), WALL, np.int8)
        grid[1:-1, 1:-1] = FREE
        grid[1, size - 2] = GOAL
        start = [(size - 3 + i % 2, 1 + i) for i in range(num_agents)]
        super().__init__(grid, np.ravel(start), size, num_agents, observation, max_steps)

    def sketch(self, state):
        kinds = (None, "wall", "goal")  # as numbered above
        shapes = [("cell", kinds[self.rules[r, c]], r, c) for r, c in np.argwhere(self.rules != FREE)]
        return self.size, self.size, shapes + self.sketch_agents(state)
