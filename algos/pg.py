"""PG: decentralised REINFORCE (Williams, 1992), the root of the policy-gradient scripts.

Every agent i has a policy pi_i(a | o) of its own and climbs, after each episode of T steps, along

    g_i = 1/T sum_t G_t grad log pi_i(a_t | o_t)          with G_t = r_t + gamma G_{t+1},

Eq. 14 of Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed Exploration and Selective Memory Reuse" (SAC 2021).
The agents share nothing but the team's reward r. There is no baseline, no normalisation and no entropy term, as in the paper.

    python algos/pg.py --env findtreasure --num-trials 20
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

import numpy as np
import torch
from numba import njit

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from envs import Rollout
from envs.run import AtLeast, Between, Run, RunArgs, generators_of, main, resolve

# Table 1 of the paper; climbing, passage and secretroom are beyond it.
WORLDS = {
    "cleaner": dict(hidden=(256, 128), gamma=0.99, max_steps=200, num_episodes=20_000),
    "findtreasure": dict(hidden=(64,), gamma=0.98, max_steps=200, num_episodes=10_000),
    "gotogether": dict(hidden=(64,), gamma=0.98, max_steps=2000, num_episodes=10_000),
    "movebox": dict(hidden=(256, 128), gamma=0.999, max_steps=200, num_episodes=20_000),
    "pushbox": dict(hidden=(64, 32), gamma=0.95, max_steps=200, num_episodes=20_000),
    "climbing": dict(hidden=(64,), gamma=0.99, max_steps=1, num_episodes=5_000),
    "passage": dict(hidden=(64,), gamma=0.99, max_steps=200, num_episodes=10_000),
    "secretroom": dict(hidden=(64,), gamma=0.99, max_steps=200, num_episodes=10_000),
}
# The tuning rule's choice for each world and optimiser (benchmark/tuning/pg.csv), or that of a world of the same size.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-3),
    ("cleaner", "adam"): dict(learning_rate=3e-4),
    ("findtreasure", "sign"): dict(learning_rate=1e-3),
    ("findtreasure", "adam"): dict(learning_rate=1e-3),
    ("gotogether", "sign"): dict(learning_rate=1e-3),
    ("gotogether", "adam"): dict(learning_rate=1e-3),
    ("movebox", "sign"): dict(learning_rate=1e-3),
    ("movebox", "adam"): dict(learning_rate=3e-4),
    ("pushbox", "sign"): dict(learning_rate=3e-4),
    ("pushbox", "adam"): dict(learning_rate=1e-3),
    ("climbing", "sign"): dict(learning_rate=1e-3),
    ("climbing", "adam"): dict(learning_rate=3e-3),
    ("passage", "sign"): dict(learning_rate=1e-3),
    ("passage", "adam"): dict(learning_rate=1e-3),
    ("secretroom", "sign"): dict(learning_rate=1e-3),
    ("secretroom", "adam"): dict(learning_rate=1e-3),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3)  # what a world of your own gets


@dataclass
class Args(RunArgs):
    hidden: Annotated[tuple[int, ...] | None, AtLeast(1)] = None
    """widths of the hidden layers (None: Table 1; 64 in other worlds)"""
    gamma: Annotated[float | None, Between(0, 1)] = None
    """discount factor (None: Table 1; 0.99 in other worlds)"""
    optimizer: Literal["sign", "adam"] = "sign"
    """of the policies: sign descent (a fresh Adam in every update, as in the authors' scripts) or a persistent Adam"""
    learning_rate: Annotated[float | None, AtLeast(0)] = None
    """step size of the agents' networks (None: tuned, see TUNED; 0.001 in other worlds)"""


class StackedMLP:
    """Independent multilayer perceptrons with ReLU side by side, applied with one batched product per layer."""

    def __init__(self, generators, nets_per_trial, sizes):
        """Weights [num_nets, in, out], biases [num_nets, 1, out], all ~ U(-1/sqrt(in), 1/sqrt(in)); one generator a trial."""
        self.params = []
        for width, next_width in pairwise(sizes):
            for rows in (width, 1):
                shape, bound = (nets_per_trial, rows, next_width), width**-0.5
                draws = np.concatenate([generator.uniform(-bound, bound, shape) for generator in generators])
                self.params.append(torch.from_numpy(draws).float().requires_grad_())

    def __call__(self, x):
        """x [num_nets, batch, in], a tensor or an array -> [num_nets, batch, out]."""
        x = torch.as_tensor(x)
        for layer in range(0, len(self.params), 2):
            if layer > 0:
                x = torch.relu(x)
            x = torch.baddbmm(self.params[layer + 1], x, self.params[layer])
        return x


@njit(cache=True)
def discounted_returns(reward, lengths, gamma):
    """G_t = r_t + gamma G_{t+1} of every step; reward [T, num_trials, num_agents], lengths [num_trials] -> shaped as reward."""
    returns = np.zeros(reward.shape)
    for k in range(reward.shape[1]):
        for i in range(reward.shape[2]):
            tail = 0.0
            for t in range(lengths[k] - 1, -1, -1):
                tail = reward[t, k, i] + gamma * tail
                returns[t, k, i] = tail
    return returns


def update(optimizer, kind, loss):
    """One step down the gradient of a loss summed over all trials, whose networks it moves independently of each other.

    "adam": a persistent Adam. "sign": a new Adam in every update, as in the authors' scripts. The first step of an Adam is
    lr g / (|g| + 1e-8), so this is descent along the sign of the gradient.
    """
    if kind == "sign":
        optimizer.state.clear()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def build(args, world, init):
    """All that learns, for all trials; `init` are the generators of the first weights."""
    return SimpleNamespace(policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]))


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, _ = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer], generators=act)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)

        # Climb along 1/T sum_t G_t grad log pi(a_t | o_t), Eq. 14.
        returns = discounted_returns(rollout.reward, rollout.lengths, args.gamma)
        weights = torch.from_numpy(returns / rollout.lengths[:, None])  # [T, num_trials, num_agents]
        log_probs = torch.log_softmax(team.policy(rollout.obs), dim=-1)  # of each distinct observation, once
        loss = -(weights * rollout.of_taken(log_probs)).sum((0, 2))  # [num_trials]
        update(optimizer, args.optimizer, loss.sum())

        run.record(episode, rollout, policy_loss=loss)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
