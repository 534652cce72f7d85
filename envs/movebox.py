"""MoveBox: take the box together to the goal far away instead of the one nearby.

    ###############     15x15 cells (row, column), origin top left.
    ######fff######     f: far goal, reached when the box is on (1, 7)
    #             #
    #             #
    #             #
    #    ##########
    #    #nnn######     n: near goal, reached when the box is on (6, 7)
    #             #
    #             #
    #             #
    #      B      #     B: where the box stands, (10, 7)
    #     ###     #
    #     ###     #
    #0    ###    1#     0, 1: where the agents start, (13, 1) and (13, 13)
    ###############

Actions       0 up, 1 down, 2 left, 3 right. Agent 0 moves first; walls, the teammate and the box block. An agent that
              stands left or right of the box after a step holds it for the rest of the episode and no longer moves
              alone. From the next step on, when both agents hold it and choose the same action, all three move
              together, if no wall is in their way.
Observation   "positions" (default): row and column of both agents and of the box divided by the map's size [6]; "own":
              only one's own row and column [2], as in the other worlds.
Rewards       box on the far goal +100, on the near goal +10.
Outcomes      1 far goal, 2 near goal (the local optimum). Both end the episode.
Optimum       far goal in 25 steps, return 100 (4.17 per step); near goal in 12 steps, return 10 (0.91 per step).
Options       observation, max_steps (200).
Source        the map and the rules are the authors' published env_MoveBox; rewards also in Section 4.1. The paper does
              not say what its agents observe; "positions" is that code's global state.
"""

import numpy as np

from envs.base import PositionWorld, rule

MAP = (
    *("###############", "######fff######"),
    *("#.............#", "#.............#", "#.............#"),
    *("#....##########", "#....#nnn######"),
    *("#.............#", "#.............#", "#.............#", "#.............#"),
    *("#.....###.....#", "#.....###.....#", "#.....###.....#"),
    "###############",
)
FREE, WALL, FAR, NEAR = range(4)  # ".#fn"
UP, DOWN, LEFT, RIGHT = range(4)
FAR_REWARD, NEAR_REWARD = 100.0, 10.0
BOX_ROW, BOX_COLUMN = 4, 5  # state = [row 0, column 0, row 1, column 1, row of the box, column of the box]


@rule
def direction(action):
    """How many rows and columns an action leads on."""
    return (action == DOWN) - (action == UP), (action == RIGHT) - (action == LEFT)


@rule
def holds_box(state, i):
    """Whether agent i stands left or right of the box: then it holds it, and keeps standing there."""
    return state[2 * i] == state[BOX_ROW] and abs(state[2 * i + 1] - state[BOX_COLUMN]) == 1


@rule
def step(grid, state, actions):
    """Rules of one step; grid [15, 15] holds what is in each cell."""
    if holds_box(state, 0) and holds_box(state, 1):
        if actions[0] == actions[1]:
            rows, columns = direction(actions[0])
            row, column = state[BOX_ROW] + rows, state[BOX_COLUMN] + columns
            if grid[row, column - 1] != WALL and grid[row, column] != WALL and grid[row, column + 1] != WALL:
                for j in range(0, 6, 2):
                    state[j] += rows
                    state[j + 1] += columns
    else:
        for i in range(2):
            if holds_box(state, i):
                continue
            rows, columns = direction(actions[i])
            row, column, other = state[2 * i] + rows, state[2 * i + 1] + columns, 2 * (1 - i)
            teammate = row == state[other] and column == state[other + 1]
            box = row == state[BOX_ROW] and column == state[BOX_COLUMN]
            if not (grid[row, column] == WALL or teammate or box):
                state[2 * i], state[2 * i + 1] = row, column

    # The goals are three cells wide, so a box between two agents can only be on their middle one.
    here = grid[state[BOX_ROW], state[BOX_COLUMN]]
    if here == FAR:
        return FAR_REWARD, 1
    if here == NEAR:
        return NEAR_REWARD, 2
    return 0.0, 0


class MoveBox(PositionWorld):
    """MoveBox; see the module's docstring."""

    name = "movebox"
    action_names = ("up", "down", "left", "right")
    outcome_names = ("far goal", "near goal")
    best_outcome = 1
    largest_reward = FAR_REWARD
    step = staticmethod(step)

    def __init__(self, observation: str = "positions", max_steps: int = 200):
        grid = np.array([[".#fn".index(cell) for cell in row] for row in MAP], np.int8)
        start, box = [13, 1, 13, 13, 10, 7], (BOX_ROW, BOX_COLUMN)
        super().__init__(grid, start, len(MAP), num_agents=2, observation=observation, max_steps=max_steps, objects=box)

    def sketch(self, state):
        kinds = (None, "wall", "far goal", "near goal")  # as numbered above
        shapes = [("cell", kinds[self.rules[r, c]], r, c) for r, c in np.argwhere(self.rules != FREE)]
        shapes.append(("box", "box", state[BOX_ROW], state[BOX_COLUMN], 1))
        return self.size, self.size, shapes + self.sketch_agents(state)
