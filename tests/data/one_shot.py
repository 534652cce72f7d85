"""Two one-shot games for two agents that see nothing, of Claus & Boutilier (1998), for the tests: climbing and penalty."""

import numpy as np

import envs

GAMES = {
    "climbing": [[11, -30, 0], [-30, 7, 6], [0, 0, 5]],
    "penalty": [[0, 0, 10], [0, 2, 0], [10, 0, 0]],  # k = 0
}


@envs.rule
def step(rules, state, actions):
    """The only step; rules: the team's reward for both actions [3, 3], state: whether it was taken [1]."""
    state[0] = 1
    return rules[actions[0], actions[1]], 1


@envs.rule
def observe(rules, cell, state, obs):
    obs[:] = 1.0


class OneShot(envs.World):
    action_names = ("first", "second", "third")
    outcome_names = ("played",)
    best_outcome = 1
    step, observe = staticmethod(step), staticmethod(observe)

    def __init__(self, game: str = "climbing"):
        rules = np.array(GAMES[envs.check_choice("game", game, tuple(GAMES))], float)
        numbers = dict(num_agents=2, obs_dim=1, cell=1, state_scale=[1], max_steps=1)
        super().__init__(rules, start=[0], local_index=[[0], [0]], **numbers)
