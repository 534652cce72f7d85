"""COMA: decentralised actors whose critics ask what each agent's own action has added (Foerster et al., 2018), as ac.py else.

While the team learns, agent i has a critic Q_i that sees x_i,t = (the global state, the actions of the other agents) and says
what each of agent i's own actions is worth. After each episode of T steps, with the critics before their step,

    A_i,t = Q_i(x_i,t, a_i,t) - sum_a pi_i(a | o_i,t) Q_i(x_i,t, a)      (Eq. 4) is what the agent's action has added,
    g_i = 1/T sum_t A_i,t grad log pi_i(a_i,t | o_i,t)                   is the direction along which actor i climbs, and
    1/T sum_t (y_i,t - Q_i(x_i,t, a_i,t))^2                              is what its critic descends, in one step, where
    y_i,t = r_t + gamma [(1 - lambda) Q'_i(x_i,t+1, a_i,t+1) + lambda y_i,t+1]    is the TD(lambda) target; Q' is an old Q.

Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed Exploration and Selective Memory Reuse" (SAC 2021), compare
with COMA but give no settings. lambda is that of Foerster et al.; a critic for each agent and the 200 critic steps between two
copies of Q to Q' are those of EPyMARL's coma_ns. The hidden layers of Table 1, one critic step per episode, and policies that
explore by themselves (no floor under their probabilities) are chosen here. So is that the critics see no observations beside
the state, which tells them: with the state alone 18 of 20 trials in pushbox end at the large box (adam, 5000 episodes, learning
rates 3e-4 and 1e-3), with both 2, with the observations alone none.

    python algos/coma.py --env findtreasure --num-trials 20
"""

import sys
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

import numpy as np
import torch
from numba import njit

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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/coma.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-4, critic_learning_rate=1e-2),
    ("cleaner", "adam"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
    ("findtreasure", "sign"): dict(learning_rate=3e-4, critic_learning_rate=1e-2),
    ("findtreasure", "adam"): dict(learning_rate=1e-3, critic_learning_rate=1e-2),
    ("gotogether", "sign"): dict(learning_rate=3e-4, critic_learning_rate=1e-2),
    ("gotogether", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("movebox", "sign"): dict(learning_rate=1e-4, critic_learning_rate=1e-3),
    ("movebox", "adam"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
    ("pushbox", "sign"): dict(learning_rate=3e-4, critic_learning_rate=3e-3),
    ("pushbox", "adam"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
    ("climbing", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("climbing", "adam"): dict(learning_rate=3e-3, critic_learning_rate=3e-3),
    ("passage", "sign"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
    ("passage", "adam"): dict(learning_rate=1e-3, critic_learning_rate=1e-3),
    ("secretroom", "sign"): dict(learning_rate=3e-4, critic_learning_rate=1e-3),
    ("secretroom", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, critic_learning_rate=3e-3)  # what a world of your own gets
REWARD_SCALE = 10.0  # the critics learn from rewards divided by this, so from 0.3 to 10; their curves are in units of reward


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
    td_lambda: Annotated[float, Between(0, 1)] = 0.8
    """lambda of the critics' targets: 0 looks one step ahead, 1 to the end of the episode (Foerster et al.)"""
    target_critic_every: Annotated[int, AtLeast(1)] = 200
    """episodes, each a step of the critics, between two copies of the critics to the target critics (EPyMARL)"""


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


def next_actions(policy, rollout, generators):
    """Actions that the teams draw after the last step and do not play, [num_trials, num_agents]; one generator a trial."""
    last = rollout.all_obs[rollout.lengths, np.arange(len(rollout.lengths))]  # [num_trials, num_agents, obs_dim]
    uniforms = np.array([generator.random(last.shape[1]) for generator in generators])
    with torch.no_grad():
        probs = torch.softmax(policy(last.reshape(-1, 1, last.shape[2])).double(), dim=-1)
    bounds = probs.numpy().cumsum(2).reshape(*uniforms.shape, -1)  # the distribution function, which is inverted
    return (uniforms[:, :, None] >= bounds[:, :, :-1]).sum(2)


def critic_inputs(global_state, actions, num_actions):
    """x_i of every step: the global state, and the one-hot actions of all but agent i, i + 1 first.

    global_state [T + 1, num_trials, state_dim], actions [T + 1, num_trials, num_agents]
    -> [T + 1, num_trials, num_agents, state_dim + (num_agents - 1) * num_actions]
    """
    agents = actions.shape[2]
    others = (np.arange(agents)[:, None] + np.arange(1, agents)) % agents
    others_actions = np.eye(num_actions, dtype=np.float32)[actions[:, :, others]].reshape(*actions.shape, -1)
    return np.concatenate([global_state[:, :, None].repeat(agents, axis=2), others_actions], axis=3)


def counterfactual_advantages(values, probs, actions):
    """A = Q(a) - sum_a' pi(a') Q(a'), Eq. 4; values and probs [T, num_trials, num_agents, num_actions], shaped as actions."""
    taken = np.take_along_axis(values, actions[..., None], axis=3)[..., 0]
    return taken - (probs * values).sum(3)


@njit(cache=True)
def lambda_targets(reward, values, lengths, terminated, gamma, td_lambda):
    """y_t = r_t + gamma [(1 - lambda) Q'(x_{t+1}, a_{t+1}) + lambda y_{t+1}] of every step, 0 beyond an episode's end.

    reward [T, num_trials], values Q'(x, a) [T + 1, num_trials, num_agents], lengths and terminated [num_trials]
    -> [T, num_trials, num_agents]. Nothing follows the step that terminates an episode. One that the time limit cuts would have
    gone on: Q'(x_T, a_T) stands for the rest of it.
    """
    targets = np.zeros((len(reward), *values.shape[1:]))
    for k in range(targets.shape[1]):
        for i in range(targets.shape[2]):
            following = 0.0 if terminated[k] else values[lengths[k], k, i]
            for t in range(lengths[k] - 1, -1, -1):
                targets[t, k, i] = reward[t, k] + gamma * following
                following = (1 - td_lambda) * values[t, k, i] + td_lambda * targets[t, k, i]
    return targets


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    critic_dim = len(world.start) + (world.num_agents - 1) * world.num_actions
    policy = StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions])
    critic = StackedMLP(init, world.num_agents, [critic_dim, *args.hidden, world.num_actions])
    return SimpleNamespace(policy=policy, critic=critic, target_critic=deepcopy(critic))


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, learn = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    critic_optimizer = torch.optim.Adam(team.critic.params, lr=args.critic_learning_rate, fused=True)
    rollout, trials = Rollout(world, args.num_trials), np.arange(args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer, critic_optimizer], generators=[*act, *learn])

    for episode in run.episodes():
        rollout.play(team.policy.params, act)
        reward = rollout.reward[:, :, 0] / REWARD_SCALE  # [T, num_trials]
        share = torch.from_numpy(rollout.played / rollout.lengths)[:, :, None]  # 1/T in an episode, 0 beyond its end

        # The critics' values, before they learn from this episode, and their targets.
        actions = np.concatenate([rollout.actions, rollout.actions[:1]])  # [T + 1, num_trials, num_agents]
        actions[rollout.lengths, trials] = next_actions(team.policy, rollout, learn)
        inputs, rows = distinct_rows(critic_inputs(rollout.global_state, actions, world.num_actions), rollout.lengths + 1)
        values = in_every_step(team.critic(inputs), rows)[:-1]  # [T, num_trials, num_agents, num_actions]
        with torch.no_grad():
            target_values = in_every_step(team.target_critic(inputs), rows).double().numpy()
        target_values = np.take_along_axis(target_values, actions[..., None], axis=3)[..., 0]  # [T + 1, num_trials, num_agents]
        targets = lambda_targets(reward, target_values, rollout.lengths, rollout.terminated, args.gamma, args.td_lambda)

        # Actors: climb along 1/T sum_t A_t grad log pi(a_t | o_t).
        logits = team.policy(rollout.obs)
        probs = in_every_step(torch.softmax(logits.detach().double(), dim=-1).numpy(), rollout.rows)
        advantage = counterfactual_advantages(values.detach().double().numpy(), probs, rollout.actions)
        loss = -(share * torch.from_numpy(advantage) * rollout.of_taken(torch.log_softmax(logits, dim=-1))).sum((0, 2))
        update(optimizer, args.optimizer, loss.sum())

        # Critics: descend 1/T sum_t (y_t - Q(x_t, a_t))^2.
        taken = values.gather(3, torch.from_numpy(rollout.actions)[..., None])[..., 0]  # [T, num_trials, num_agents]
        squares = share * (torch.from_numpy(targets) - taken) ** 2
        update(critic_optimizer, "adam", squares.sum())
        if (episode + 1) % args.target_critic_every == 0:
            for kept, param in zip(team.target_critic.params, team.critic.params, strict=True):
                kept.data.copy_(param.detach())

        mean_value = REWARD_SCALE * (share * taken.detach()).sum(0).mean(1).numpy()
        td_error = REWARD_SCALE * np.sqrt(squares.detach().sum(0).mean(1).numpy())
        run.record(episode, rollout, policy_loss=loss, value=mean_value, td_error=td_error)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
