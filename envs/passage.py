"""Passage: get both through a door that is open only while somebody stands on a switch, in one room or the other.

    0....#....     Two rooms, 10x10 cells (row, column), origin top left.
    .....#....     0: where both agents start, (0, 0)
    .....#..S.     S: switches, (2, 8) and (8, 2)
    .....#....
    .....D....     D: door, (4, 5)
    .....#....
    .....#....
    .....#....
    ..S..#....
    .....#....

Actions       0 up, 1 right, 2 down, 3 left. Walls and the map's border block; agents may share a cell. The door opens
              and closes after the moves of a step, so a switch opens the way for the next step; whoever stands in the
              door may always leave it.
Observation   "positions" (default): row and column of both agents divided by the map's size [4]; "own": only one's own
              [2].
Rewards       both agents in the right room +100.
Outcomes      1 passed: both are in the right room, which ends the episode.
Optimum       passed in 18 steps, return 100 (5.88 per step).
Options       size (10; 10 to 1001), door_stays (0; steps for which the door stays open after the next one), observation,
              max_steps (200).
Source        Pass of Wang et al., "Influence-Based Multi-Agent Exploration" (ICLR 2020), where the door is open while a
              switch is occupied; rules from TonghanWang/EITI-EDTI, pass_environment.py. There the map has 30x30 cells
              and an episode 300 steps, the door stays open for 8 more steps (size=30 max_steps=300 door_stays=8 here),
              the reward is 1000, and positions are observed one-hot. In 10 000 episodes of random play it is passed
              once on 10x10 cells and never on 15x15.
"""

import numpy as np

from envs.base import LARGEST_MAP, PositionWorld, check_whole, rule

UP, RIGHT, DOWN, LEFT = range(4)
WALL, FREE, TARGET, DOOR = range(4)  # door number d is DOOR + d
REWARD = 100.0
DOORS = 4  # where the doors begin in the state


@rule
def step(rules, state, actions):
    """Rules of one step; state = [row 0, column 0, row 1, column 1, then for each door how many steps it is still open].

    rules [1 + doors, size, size]: what is in each cell, and for each door how long an agent in a cell opens it.
    """
    size = rules.shape[1]
    for i in range(2):
        row = state[2 * i] + (actions[i] == DOWN) - (actions[i] == UP)
        column = state[2 * i + 1] + (actions[i] == RIGHT) - (actions[i] == LEFT)
        if 0 <= row < size and 0 <= column < size:
            kind = rules[0, row, column]
            closed = kind >= DOOR and state[DOORS + kind - DOOR] == 0
            if not (kind == WALL or closed):
                state[2 * i], state[2 * i + 1] = row, column

    for door in range(len(rules) - 1):
        left = max(state[DOORS + door] - 1, 0)
        if left == 0:
            left = max(rules[1 + door, state[0], state[1]], rules[1 + door, state[2], state[3]])
        state[DOORS + door] = left

    if rules[0, state[0], state[1]] == TARGET and rules[0, state[2], state[3]] == TARGET:
        return REWARD, 1
    return 0.0, 0


class Rooms(PositionWorld):
    """A map of rooms with doors and switches, and a target room in which both agents have to be."""

    action_names = ("up", "right", "down", "left")
    outcome_names = ("passed",)
    best_outcome = 1
    largest_reward = REWARD
    step = staticmethod(step)

    def __init__(self, cells, switches, door_stays, observation, max_steps):
        """As PositionWorld, but for
        cells:      what is in each cell, [size, size]
        switches:   {(row, column): doors that it opens}
        door_stays: steps for which a door stays open, beside the next one, after somebody has opened it
        """
        num_doors = cells.max() + 1 - DOOR
        opens = np.zeros((num_doors, *cells.shape), cells.dtype)
        for (row, column), doors in switches.items():
            opens[doors, row, column] = door_stays + 1
        self.switches = switches
        rules, start = np.concatenate([cells[None], opens]), [0] * (4 + num_doors)
        super().__init__(rules, start, len(cells), num_agents=2, observation=observation, max_steps=max_steps)

    def sketch(self, state):
        kinds = {WALL: "wall", TARGET: "goal"}
        kinds |= {DOOR + door: "open door" if left else "door" for door, left in enumerate(state[DOORS:])}
        shapes = [("cell", kinds[self.rules[0, r, c]], r, c) for r, c in np.argwhere(self.rules[0] != FREE)]
        shapes += [("cell", "lever", row, column) for row, column in self.switches]
        return self.size, self.size, shapes + self.sketch_agents(state)


class Passage(Rooms):
    """Passage; see the module's docstring."""

    name = "passage"

    def __init__(self, size: int = 10, door_stays: int = 0, observation: str = "positions", max_steps: int = 200):
        size = check_whole("size", size, minimum=10, maximum=LARGEST_MAP)
        door_stays = check_whole("door_stays", door_stays, minimum=0, maximum=1000)
        near, far, middle = size // 5, 4 * size // 5, size // 2
        cells = np.full((size, size), FREE, np.int16)
        cells[:, middle], cells[:, middle + 1 :] = WALL, TARGET
        cells[45 * size // 100 : 55 * size // 100, middle] = DOOR
        super().__init__(cells, {(far, near): [0], (near, far): [0]}, door_stays, observation, max_steps)
