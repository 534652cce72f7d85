"""Climbing: one joint action, one payoff. Whoever goes for the best pays dearly while the teammate does not go along.

    agent 1 plays    a    b    c            a    b    c     Rows are what agent 0 plays.
                a   11  -30    0           10    0  -30     Left: the climbing game (default).
                b  -30    7    6            0    2    0     Right: the penalty game. -30 is minus `penalty`.
                c    0    0    5          -30    0   10

Actions       0 a, 1 b, 2 c.
Observation   the number 1 [1]: there is nothing to see.
Rewards       the payoff.
Outcomes      the payoffs, best first: 1 11, 2 7, 3 6, 4 5, 5 0, 6 penalty; in the penalty game 1 10, 2 2, 3 0, 4 penalty.
              Every episode ends with its first step.
Optimum       climbing 11, penalty game 10, in 1 step (11 and 10 per step, as the index of the last step counts as 1).
Options       game ("climbing" or "penalty"), penalty (30; at least 0), max_steps (1).
Source        Claus & Boutilier, "The Dynamics of Reinforcement Learning in Cooperative Multiagent Systems" (AAAI 1998),
              Section 4, who leave the penalty game's k = -penalty open.
"""

import numpy as np

from envs.base import World, check_choice, check_number, rule

# The outcome of each joint action, and what each outcome pays; the last one is the penalty.
GAMES = {
    "climbing": (((1, 6, 5), (6, 2, 3), (5, 5, 4)), (11.0, 7.0, 6.0, 5.0, 0.0)),
    "penalty": (((1, 3, 4), (3, 2, 3), (4, 3, 1)), (10.0, 2.0, 0.0)),
}


@rule
def step(rules, state, actions):
    """Rules of the one step; state = [1 + action 0, 1 + action 1], 0 before it; rules = [payoffs, outcomes], each [3, 3]."""
    state[0], state[1] = 1 + actions[0], 1 + actions[1]
    return rules[0, actions[0], actions[1]], int(rules[1, actions[0], actions[1]])


@rule
def observe(rules, cell, state, obs):
    """Nothing is to be seen."""
    obs[:] = 1.0


class Climbing(World):
    """Climbing; see the module's docstring."""

    name = "climbing"
    action_names = ("a", "b", "c")
    sights = ("the game",)
    outcome_names = ("11", "7", "6", "5", "0", "penalty")
    best_outcome = 1
    largest_reward = 11.0
    step, observe = staticmethod(step), staticmethod(observe)

    def __init__(self, game: str = "climbing", penalty: float = 30.0, max_steps: int = 1):
        outcomes, payoffs = GAMES[check_choice("game", game, tuple(GAMES))]
        payoffs = np.array([*payoffs, -check_number("penalty", penalty, lowest=0)])
        self.outcome_names = (*(f"{payoff:g}" for payoff in payoffs[:-1]), "penalty")
        self.largest_reward = payoffs[0]
        super().__init__(
            rules=np.array([payoffs[np.array(outcomes) - 1], outcomes]),
            start=[0, 0],
            local_index=[[0], [1]],
            num_agents=2,
            obs_dim=1,
            cell=1.0,
            state_scale=[1 / 3, 1 / 3],
            max_steps=max_steps,
        )

    def sketch(self, state):
        """The payoffs by their kinds; agent 0 stands beside the row that it plays, agent 1 above its column."""
        _, outcomes = self.rules
        shapes = [("cell", self.outcome_names[int(outcomes[r, c]) - 1], r + 1, c + 1) for r, c in np.ndindex(3, 3)]
        return 4, 4, [*shapes, ("agent", 0, state[0], 0, None), ("agent", 1, 0, state[1], None)]
