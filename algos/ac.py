"""AC: decentralised actors with one centralised critic (Williams, 1992; Sutton & Barto, Section 13.5), on the base of pg.py.

While the team learns, a critic V sees the global state s_t. After each episode of T steps

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t)                    is the critic's one-step error, the same for all agents,
    g_i = 1/T sum_t delta_t grad log pi_i(a_t | o_t)             is the direction along which every actor i climbs, and
    1/T sum_t (y_t - V(s_t))^2 with y_t = V(s_t) + delta_t       is what the critic descends, in one step with fixed y_t.

Both learn from the delta_t of the critic before its step. Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed
Exploration and Selective Memory Reuse" (SAC 2021), say of their AC only that it is "vanilla" and its critic "centralized"
(Section 4.2). What the critic sees, one-step errors, its hidden layers, those of Table 1, and its single step per episode are
chosen here.

    python algos/ac.py --env findtreasure --num-trials 20
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from envs import Rollout, distinct_rows, in_every_step
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/ac.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-4, critic_learning_rate=1e-3),
    ("cleaner", "adam"): dict(learning_rate=3e-4, critic_learning_rate=3e-3),
    ("findtreasure", "sign"): dict(learning_rate=3e-4, critic_learning_rate=1e-2),
    ("findtreasure", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("gotogether", "sign"): dict(learning_rate=3e-4, critic_learning_rate=1e-2),
    ("gotogether", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("movebox", "sign"): dict(learning_rate=1e-4, critic_learning_rate=1e-3),
    ("movebox", "adam"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
    ("pushbox", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("pushbox", "adam"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, critic_learning_rate=3e-3)  # what a world of your own gets
REWARD_SCALE = 10.0  # the critic learns from rewards divided by this, so from 0.3 to 10; its curves are in units of reward


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
    critic_learning_rate: Annotated[float | None, AtLeast(0)] = None
    """step size of critics, which always have a persistent Adam (None: see TUNED; 0.003 in other worlds)"""


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


def td_errors(reward, values, lengths, terminated, gamma):
    """delta_t = r_t + gamma V(s_{t+1}) - V(s_t) of every step, 0 beyond an episode's end.

    reward [T, num_trials], values [T + 1, num_trials], lengths and terminated [num_trials] -> shaped as reward. Nothing follows
    the step that terminates an episode. One that the time limit cuts would have gone on: V(s_T) stands for the rest of it.
    """
    steps = np.arange(len(reward))[:, None]
    goes_on = (steps < lengths - 1) | ~terminated
    delta = reward + gamma * goes_on * values[1:] - values[:-1]
    return np.where(steps < lengths, delta, 0.0)


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        critic=StackedMLP(init, 1, [len(world.start), *args.hidden, 1]),
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, _ = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    critic_optimizer = torch.optim.Adam(team.critic.params, lr=args.critic_learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer, critic_optimizer], generators=act)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)

        # The critic's values and errors, before it learns from this episode.
        states, rows = distinct_rows(rollout.global_state[:, :, None], rollout.lengths + 1)
        values = in_every_step(team.critic(states), rows)[:, :, 0, 0]  # [T + 1, num_trials]
        detached = values.detach().double().numpy()
        delta = td_errors(rollout.reward[:, :, 0] / REWARD_SCALE, detached, rollout.lengths, rollout.terminated, args.gamma)

        # Actors: climb along 1/T sum_t delta_t grad log pi(a_t | o_t).
        weights = torch.from_numpy(delta / rollout.lengths)[:, :, None]  # the same for all agents
        log_probs = torch.log_softmax(team.policy(rollout.obs), dim=-1)  # of each distinct observation, once
        loss = -(weights * rollout.of_taken(log_probs)).sum((0, 2))  # [num_trials]
        update(optimizer, args.optimizer, loss.sum())

        # Critic: descend 1/T sum_t (y_t - V(s_t))^2; beyond an episode's end y_t = V(s_t).
        targets = torch.from_numpy(detached[:-1] + delta)
        critic_loss = ((targets - values[:-1]) ** 2 / torch.from_numpy(rollout.lengths)).sum()
        update(critic_optimizer, "adam", critic_loss)

        mean_value = REWARD_SCALE * (detached[:-1] * rollout.played).sum(0) / rollout.lengths
        td_error = REWARD_SCALE * np.sqrt((delta**2).sum(0) / rollout.lengths)
        run.record(episode, rollout, policy_loss=loss, value=mean_value, td_error=td_error)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
