"""The two-step game of Rashid et al. (QMIX, ICML 2018, Section 5), as a user's own world.

Agent 0's first action chooses which matrix game the team plays in the second step; both agents see where they are.

    2A   7  7        2B   0  1
         7  7             1  8
"""

import numpy as np

import envs

PAYOFFS = [[[7, 7], [7, 7]], [[0, 1], [1, 8]]]


@envs.rule
def step(payoffs, state, actions):
    """state = [is it the first step, is it game 2A, is it game 2B], of which one is 1."""
    if state[0] == 1:
        state[0], state[1 + actions[0]] = 0, 1
        return 0.0, 0
    reward = payoffs[state[2], actions[0], actions[1]]
    return reward, 1 if reward == 7 else 2 if reward == 8 else 3


@envs.rule
def observe(payoffs, cell, state, obs):
    for i in range(obs.shape[0]):
        for j in range(obs.shape[1]):
            obs[i, j] = state[j]


class TwoStep(envs.World):
    action_names = ("A", "B")
    outcome_names = ("seven", "eight", "less")
    best_outcome = 2
    step, observe = staticmethod(step), staticmethod(observe)

    def __init__(self, max_steps: int = 2):
        local_index, scale = [[0, 1, 2]] * 2, [1, 1, 1]
        super().__init__(np.array(PAYOFFS, float), [1, 0, 0], local_index, 2, 3, 1.0, scale, max_steps)
