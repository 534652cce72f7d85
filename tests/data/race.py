"""A user's own world, for the tests: two agents run to the right wall of an empty room, which ends the episode."""

import numpy as np

import envs

REWARD = 10.0


@envs.rule
def step(rules, state, actions):
    last = rules[0, 0] - 1
    for i in range(2):
        if actions[i] == 1 and state[2 * i + 1] < last:
            state[2 * i + 1] += 1
    if state[1] == last and state[3] == last:
        return REWARD, 1
    return -0.1, 0


class Race(envs.PositionWorld):
    action_names = ("stay", "go")
    outcome_names = ("there",)
    best_outcome = 1
    step = staticmethod(step)

    def __init__(self, size: int = 5, max_steps: int = 20):
        envs.check_whole("size", size, minimum=2)
        rules = np.array([[size]], np.int8)
        super().__init__(rules, [0, 0, 1, 0], size, num_agents=2, observation="positions", max_steps=max_steps)

    def sketch(self, state):
        finish = [("cell", "finish", row, self.size - 1) for row in range(self.size)]
        return self.size, self.size, finish + self.sketch_agents(state)
