"""PushBox: push the large box together instead of the small ones alone, seeing only the cell in front of you.

    . . . .     goal row, y = 3        A 4x4 room (default). (x, y): x grows to the east, y to the north up to the goal row.
    s L L s     s: small box, x = 0 and 3;  L: the large box, two cells wide, x = 1 and 2
    . . . .
    > . . <     the agents start at (0, 0) facing east and at (3, 0) facing west

Actions       0 forward, 1 turn left, 2 turn right, 3 wait. Agents act in order and may share a cell. Boxes move only
              north: a small box when an agent below it, facing north, goes forward; the large one when both agents
              stand below its two cells, face north and go forward in the same step. The pushing agents move along.
Observation   one-hot [5] of the cell in front: small box, large box, empty, boundary, teammate.
Rewards       large box in the goal row +100; each small box in the goal row +10; `lone_push_penalty` (5) for each other
              forward move into the large box, also from the side; `boundary_penalty` (0) for a forward move into the
              border, or into a small box while not facing north; `step_penalty` (0) for every step.
Outcomes      1 small left, 2 small right, 3 both small, 4 large. The episode ends as soon as any box is in the goal
              row.
Optimum       large box in 4 steps, return 100 (33.33 per step); small boxes in 3 steps, return 10 or 20 (5.00 or 10.00
              per step). Among deterministic memoryless policies, which see too little: large 33.33, both small 4.00,
              one small 2.00.
Options       size (4, 6, 8 or 10), the three penalties, max_steps (200). For n = 6 the agents start at (0, 1) and (5,
              1), for n >= 8 at (1, 1) and (n - 2, 1); the small boxes stand above them, the large one in the middle,
              all at y = n / 2.
Source        yuchen-x/MacDeepMARL, box_pushing (the paper's [36]), whose penalties are 5, 5 and 0.1; the defaults here
              are 5, 0, 0, because Section 4.1 names only the first and the optimum it quotes, 33.3 = 100 / 3, has no
              other cost. One difference: for n >= 6 both agents can push one small box in the same step; there it could
              jump over the goal row and out of the room without ending the episode, here it stops in the goal row.
"""

import numpy as np

from envs.base import World, check_choice, check_number, rule

NORTH, EAST, SOUTH, WEST = range(4)
FORWARD, TURN_LEFT, TURN_RIGHT, WAIT = range(4)
SMALL_BOX, LARGE_BOX, EMPTY, BOUNDARY, TEAMMATE = range(5)
SMALL_REWARD, LARGE_REWARD = 10.0, 100.0

# The numbers of one room: its size, the columns of the boxes (the large one also covers the next column) and the penalties.
RULES = np.dtype(
    [("size", "i8"), ("left", "i8"), ("right", "i8"), ("large", "i8")]
    + [("lone_push_penalty", "f8"), ("boundary_penalty", "f8"), ("step_penalty", "f8")]
)
# state = [x 0, y 0, facing 0, x 1, y 1, facing 1, y of the left small box, y of the right small box, y of the large box]
LEFT_Y, RIGHT_Y, LARGE_Y = 6, 7, 8


@rule
def in_front(state, i):
    """The cell (x, y) that agent i faces."""
    x, y, facing = state[3 * i], state[3 * i + 1], state[3 * i + 2]
    return x + (facing == EAST) - (facing == WEST), y + (facing == NORTH) - (facing == SOUTH)


@rule
def content(room, state, x, y):
    """What is in cell (x, y), teammates aside."""
    if not (0 <= x < room.size and 0 <= y < room.size):
        return BOUNDARY
    if (x == room.left and y == state[LEFT_Y]) or (x == room.right and y == state[RIGHT_Y]):
        return SMALL_BOX
    if room.large <= x <= room.large + 1 and y == state[LARGE_Y]:
        return LARGE_BOX
    return EMPTY


@rule
def below_large(room, state, i):
    """Whether agent i stands below the large box and faces it."""
    x, y = in_front(state, i)
    return state[3 * i + 2] == NORTH and content(room, state, x, y) == LARGE_BOX


@rule
def step(rules, state, actions):
    """Rules of one step."""
    room = rules[0]
    reward = -room.step_penalty
    together = (
        actions[0] == FORWARD
        and actions[1] == FORWARD
        and below_large(room, state, 0)
        and below_large(room, state, 1)
        and state[0] != state[3]
    )
    if together:
        state[LARGE_Y] += 1
        state[1] += 1
        state[4] += 1
    for i in range(2):
        if actions[i] == TURN_LEFT:
            state[3 * i + 2] = (state[3 * i + 2] - 1) % 4
        elif actions[i] == TURN_RIGHT:
            state[3 * i + 2] = (state[3 * i + 2] + 1) % 4
        elif actions[i] == FORWARD and not together:
            x, y = in_front(state, i)
            ahead = content(room, state, x, y)
            if ahead == LARGE_BOX:
                reward -= room.lone_push_penalty
            elif ahead == BOUNDARY or (ahead == SMALL_BOX and state[3 * i + 2] != NORTH):
                reward -= room.boundary_penalty
            else:
                if ahead == SMALL_BOX:
                    box = LEFT_Y if x == room.left else RIGHT_Y
                    state[box] = min(state[box] + 1, room.size - 1)  # both agents may push it, one after the other
                state[3 * i], state[3 * i + 1] = x, y

    goal = room.size - 1
    if state[LARGE_Y] == goal:
        return reward + LARGE_REWARD, 4
    left, right = state[LEFT_Y] == goal, state[RIGHT_Y] == goal
    return reward + SMALL_REWARD * (left + right), left + 2 * right


@rule
def observe(rules, cell, state, obs):
    """What each agent faces, one-hot; a teammate in a box's cell (possible for n >= 6) is seen beside the box."""
    obs[:] = 0.0
    for i in range(2):
        x, y = in_front(state, i)
        ahead = content(rules[0], state, x, y)
        teammate = x == state[3 * (1 - i)] and y == state[3 * (1 - i) + 1]
        if teammate:
            obs[i, TEAMMATE] = 1.0
        if not (teammate and ahead == EMPTY):
            obs[i, ahead] = 1.0


class PushBox(World):
    """PushBox; see the module's docstring."""

    name = "pushbox"
    action_names = ("forward", "turn left", "turn right", "wait")
    sights = ("small box", "large box", "empty", "boundary", "teammate")  # as numbered above
    outcome_names = ("small left", "small right", "both small", "large")
    best_outcome = 4
    largest_reward = LARGE_REWARD
    step, observe = staticmethod(step), staticmethod(observe)

    def __init__(
        self,
        size: int = 4,
        lone_push_penalty: float = 5.0,
        boundary_penalty: float = 0.0,
        step_penalty: float = 0.0,
        max_steps: int = 200,
    ):
        self.size = size = check_choice("pushbox's size", size, (4, 6, 8, 10))
        margin, y = {4: (0, 0), 6: (0, 1)}.get(size, (1, 1))  # columns between wall and agent; the agents' row
        left, right, large = margin, size - 1 - margin, size // 2 - 1
        penalties = (
            check_number("lone_push_penalty", lone_push_penalty, lowest=0),
            check_number("boundary_penalty", boundary_penalty, lowest=0),
            check_number("step_penalty", step_penalty, lowest=0),
        )
        super().__init__(
            rules=np.array([(size, left, right, large, *penalties)], RULES),
            start=[left, y, EAST, right, y, WEST, size // 2, size // 2, size // 2],
            # An agent's own x, y and facing, and the boxes, which for n = 4 move in an episode's last step only.
            local_index=[[0, 1, 2, LEFT_Y, RIGHT_Y, LARGE_Y], [3, 4, 5, LEFT_Y, RIGHT_Y, LARGE_Y]],
            num_agents=2,
            obs_dim=5,
            cell=1.0,
            state_scale=[1 / size, 1 / size, 1 / 4] * 2 + [1 / size] * 3,
            max_steps=max_steps,
        )

    def sketch(self, state):
        room, north = self.rules[0], self.size - 1  # row 0 of a picture is its top, y = size - 1
        shapes = [("cell", "goal", 0, x) for x in range(self.size)]
        for kind, y, x, width in (("small", LEFT_Y, "left", 1), ("small", RIGHT_Y, "right", 1), ("large", LARGE_Y, "large", 2)):
            shapes.append(("box", f"{kind} box", north - state[y], room[x], width))
        shapes += [("agent", i, north - state[3 * i + 1], state[3 * i], state[3 * i + 2]) for i in range(2)]
        return self.size, self.size, shapes
