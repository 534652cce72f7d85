"""Cleaner: clean a maze together; whoever comes to a cell that is clean already earns nothing there.

    #############     13x13 cells (row, column), origin top left: a maze whose 36 rooms at odd rows and columns are
    #S  #       #     joined by 35 passages without a loop, 71 free cells in all.
    # # ### ### #
    # # #   #   #     S: where all agents start, (1, 1)
    ### ### # ###
    #       #   #
    # # # #######
    # # # # #   #
    # ##### # ###
    #           #
    ### ### ### #
    #   #     # #
    #############

Actions       0 up, 1 down, 2 left, 3 right. Walls block; agents may share a cell and move in order.
Observation   "positions" (default): row and column of all agents divided by the map's size [2 * num_agents]; "own":
              only one's own [2]. Nobody sees the dirt; only the global state tells which cells are dirty.
Rewards       +1 for every cell that an agent stands on after its move for the first time. The start cell is dirty too
              until somebody stands on it after a move (into a wall, or later in passing).
Outcomes      none: an episode goes on until the time limit, clean or not.
Optimum       71 = all cells (0.357 per step): there are too many states for a search, but the plan that `plan`
              constructs cleans them all, played by these rules, in far less than 200 steps.
Options       size (13; odd, 5 to 1001), num_agents (2; 1 to 1000), observation, maze_seed (None: the published maze for
              size 13, seed 0 for another size; a number: a maze drawn from this seed), max_steps (200).
Source        the published env_Cleaner, whose maze is drawn at random; the one above is one of its mazes. Rewards also
              in Section 4.1. That code's agents see the dirt, those of Section 4.1 the agents' positions.
"""

import numpy as np

from envs.base import LARGEST_MAP, PositionWorld, UsageError, check_whole, rule

MAZE = (
    *("#############", "#...#.......#", "#.#.###.###.#", "#.#.#...#...#", "###.###.#.###", "#.......#...#", "#.#.#.#######"),
    *("#.#.#.#.#...#", "#.#####.#.###", "#...........#", "###.###.###.#", "#...#.....#.#", "#############"),
)
WALL = -1
MOST_AGENTS = 1000
UP, DOWN, LEFT, RIGHT = range(4)
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # rows and columns that these lead on


@rule
def step(places, state, actions):
    """Rules of one step; state = [row 0, column 0, row 1, ..., then 1 for every dirty and 0 for every clean cell].

    places [size, size]: which entry of the state says whether the cell is dirty; WALL for a wall.
    """
    reward = 0.0
    for i in range(len(actions)):
        row = state[2 * i] + (actions[i] == DOWN) - (actions[i] == UP)
        column = state[2 * i + 1] + (actions[i] == RIGHT) - (actions[i] == LEFT)
        if places[row, column] != WALL:
            state[2 * i], state[2 * i + 1] = row, column
        here = places[state[2 * i], state[2 * i + 1]]
        reward += state[here]
        state[here] = 0
    return reward, 0


class Cleaner(PositionWorld):
    """Cleaner; see the module's docstring."""

    name = "cleaner"
    action_names = ("up", "down", "left", "right")
    outcome_names = ()
    best_outcome = 0
    largest_reward = 1.0
    searchable = False
    step = staticmethod(step)

    def __init__(
        self,
        size: int = 13,
        num_agents: int = 2,
        observation: str = "positions",
        maze_seed: int | None = None,
        max_steps: int = 200,
    ):
        size = check_whole("size", size, minimum=5, maximum=LARGEST_MAP)
        if size % 2 == 0:
            raise UsageError(f"cleaner's size must be odd (the maze's rooms lie at odd rows and columns), not {size}.")
        num_agents = check_whole("num_agents", num_agents, minimum=1, maximum=MOST_AGENTS)
        if maze_seed is None and size == len(MAZE):
            free = np.array([[cell == "." for cell in row] for row in MAZE])
        else:
            free = random_maze(size, 0 if maze_seed is None else check_whole("maze_seed", maze_seed, minimum=0))
        num_cells = int(free.sum())
        places = np.full((size, size), WALL, np.int32)  # room for the largest map's half a million cells
        places[free] = 2 * num_agents + np.arange(num_cells)
        super().__init__(places, [1, 1] * num_agents + [1] * num_cells, size, num_agents, observation, max_steps)

    def plan(self):
        """Joint actions [max_steps, num_agents] of a good team: all go to the nearest dirty cell that nobody else takes.

        In a maze without loops this is a walk in depth, in which the agents part wherever the way does.
        """
        state, plan = self.start.copy(), np.full((self.max_steps, self.num_agents), UP)
        for t in range(self.max_steps):
            if not state[2 * self.num_agents :].any():
                break  # all is clean
            taken, joint = set(), []
            for i in range(self.num_agents):
                action, cell = self.nearest_dirt(state, tuple(state[2 * i : 2 * i + 2]), taken)
                taken.add(cell)
                joint.append(action)
            plan[t] = joint
            self.step(self.rules, state, plan[t])
        return plan

    def nearest_dirt(self, state, start, taken):
        """The first action on the way from the cell `start` to the nearest dirty cell that is not in `taken`, and this cell.

        If there is none, or if it is `start` itself: up.
        """
        first = {start: None}  # the cells found so far, nearest first, and the first action on the way to each
        for cell in (queue := [start]):
            if state[self.rules[cell]] and cell not in taken:
                return first[cell] or 0, cell
            for action, (rows, columns) in enumerate(MOVES):
                target = cell[0] + rows, cell[1] + columns
                if self.rules[target] != WALL and target not in first:
                    first[target] = action if cell == start else first[cell]
                    queue.append(target)
        return 0, None

    def sketch(self, state):
        shapes = [("cell", "wall", r, c) for r, c in np.argwhere(self.rules == WALL)]
        shapes += [("cell", "dirt", r, c) for r, c in np.argwhere(self.rules != WALL) if state[self.rules[r, c]]]
        return self.size, self.size, shapes + self.sketch_agents(state)


def random_maze(size, seed):
    """Which cells are free, bool [size, size]: a random walk in depth joins all rooms (odd rows and columns) without a loop."""
    rng = np.random.default_rng(seed)
    free = np.zeros((size, size), bool)
    path = [(1, 1)]
    free[1, 1] = True
    while path:
        row, column = path[-1]
        rooms = [(row + 2 * rows, column + 2 * columns) for rows, columns in MOVES]
        walled = [(r, c) for r, c in rooms if 0 < r < size and 0 < c < size and not free[r, c]]
        if walled:
            r, c = walled[rng.integers(len(walled))]
            free[r, c] = free[(row + r) // 2, (column + c) // 2] = True
            path.append((r, c))
        else:
            path.pop()
    return free
