"""MAPPO: ippo.py with critics that see the global state beside their agent's own observation (Yu et al., 2022).

Agent i has a policy pi_i(a | o) and, while the team learns, a critic V_i(s, o). After every few episodes, which one policy has
played,

    A_t = sum_l (gamma lambda)^l delta_{t+l},  delta_t = r_t + gamma V_i(s_{t+1}, o_{t+1}) - V_i(s_t, o_t),    and
    1/N sum_t min(rho_t A_t, clip(rho_t, 1 - eps, 1 + eps) A_t) + c H(pi_i(. | o_t))    is what agent i climbs,

over all N steps, rho_t = pi_i(a_t | o_t) / pi_i,old(a_t | o_t), in a few steps; V_i goes towards V_i + A, clipped likewise.
Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games" (NeurIPS 2022), whose five practices (Section
5) are numbered below. The critics' input is their agent-specific global state. Each agent has its own networks, where theirs
share weights if agents are of one kind. Always one Adam for the whole run, because several steps of sign descent on the same
episodes would not stay near pi_old. The critics' step size is the policies'. Rewards keep their scale, because values are
normalised.

    python algos/mappo.py --env findtreasure --num-trials 20
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

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
# The tuning rule's choice for each world (benchmark/tuning/mappo.csv), guesses where it has no row yet; it is always Adam's.
TUNED = {
    ("cleaner", "adam"): dict(learning_rate=1e-3, entropy_coef=0.01),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, entropy_coef=0.01),
    ("gotogether", "adam"): dict(learning_rate=3e-3, entropy_coef=0.01),
    ("movebox", "adam"): dict(learning_rate=1e-3, entropy_coef=0.01),
    ("pushbox", "adam"): dict(learning_rate=1e-3, entropy_coef=0.03),
    ("climbing", "adam"): dict(learning_rate=1e-3, entropy_coef=0.03),
    ("passage", "adam"): dict(learning_rate=3e-3, entropy_coef=3e-3),
    ("secretroom", "adam"): dict(learning_rate=3e-3, entropy_coef=3e-3),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, entropy_coef=0.01)  # what a world of your own gets
MAX_GRAD_NORM = 10.0  # of the gradient of each network by itself (Yu et al.)
MOMENTS_DECAY = 0.99999  # share of themselves that the running moments of the value targets keep in an update (Yu et al.)


@dataclass
class Args(RunArgs):
    hidden: Annotated[tuple[int, ...] | None, AtLeast(1)] = None
    """widths of the hidden layers (None: Table 1; 64 in other worlds)"""
    gamma: Annotated[float | None, Between(0, 1)] = None
    """discount factor (None: Table 1; 0.99 in other worlds)"""
    learning_rate: Annotated[float | None, AtLeast(0)] = None
    """step size of the agents' networks (None: tuned, see TUNED; 0.001 in other worlds)"""
    entropy_coef: Annotated[float | None, AtLeast(0)] = None
    """weight of the policies' entropy, c beside normalised advantages (None: tuned for the world; 0.01 in other worlds)"""
    gae_lambda: Annotated[float, Between(0, 1)] = 0.95
    """lambda of the advantages: 0 looks one step ahead, 1 to the end of the episode (Schulman et al., 2016)"""
    clip: Annotated[float, AtLeast(0)] = 0.2
    """how far probability ratios, and normalised values, may go in one update (eps of Schulman et al., 2017)"""
    episodes_per_update: Annotated[int, AtLeast(1)] = 8
    """episodes that are played before each update, which learns from all of them at once"""
    num_epochs: Annotated[int, AtLeast(1)] = 5
    """steps of Adam in an update, each one over all its episodes"""


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


class EpisodeBatch:
    """The episodes since the last update, each trial's one after the other; differs from ippo.py in keeping global states too.

    An episode of T steps takes T + 1 rows of its trial; the last one holds only what was seen after the last step.
    """

    def __init__(self, world, num_trials, num_episodes):
        shape = (num_episodes * (world.max_steps + 1), num_trials)
        self.obs = np.zeros((*shape, world.num_agents, world.obs_dim), np.float32)
        self.global_state = np.zeros((*shape, len(world.start)), np.float32)
        self.actions = np.zeros((*shape, world.num_agents), np.int64)
        self.reward = np.zeros(shape)
        self.played = np.zeros(shape, bool)  # whether a row is a step
        self.terminated = np.zeros(shape, bool)  # whether the world itself has ended the episode whose last row this is
        self.count = np.zeros(num_trials, np.int64)  # rows that each trial has
        self.state = [self.obs, self.global_state, self.actions, self.reward, self.played, self.terminated, self.count]

    def add(self, rollout):
        """Keep an episode of every trial."""
        global_state = rollout.global_state
        for k, length in enumerate(rollout.lengths):
            first, last = self.count[k], self.count[k] + length
            self.obs[first : last + 1, k] = rollout.all_obs[: length + 1, k]
            self.global_state[first : last + 1, k] = global_state[: length + 1, k]
            self.actions[first:last, k] = rollout.actions[:length, k]
            self.reward[first:last, k] = rollout.reward[:length, k, 0]
            self.played[first:last, k] = True
            self.terminated[last, k] = rollout.terminated[k]
        self.count += rollout.lengths + 1

    def clear(self):
        """Make room for other episodes."""
        self.played[:], self.count[:] = False, 0


def seen_by_critics(batch):
    """(2) The value function's input: the global state and, what differs from ippo.py, beside it the agent's own observation.

    -> [R, num_trials, num_agents, state_dim + obs_dim]
    """
    obs, global_state = batch.obs[: batch.count.max()], batch.global_state[: batch.count.max(), :, None]
    return np.concatenate([global_state.repeat(obs.shape[2], axis=2), obs], axis=3)


@njit(cache=True)
def gae(reward, values, played, terminated, count, gamma, gae_lambda):
    """A_t = delta_t + gamma lambda A_{t+1} with delta_t = r_t + gamma V_{t+1} - V_t (Schulman et al., 2016), 0 in other rows.

    reward, played and terminated [R, num_trials], values [R, num_trials, num_agents], count [num_trials], as in `EpisodeBatch`
    -> shaped as values. Nothing follows the step that terminates an episode. One that the time limit cuts would have gone on:
    the value of what was seen last stands for the rest of it.
    """
    advantages = np.zeros(values.shape)
    for k in range(values.shape[1]):
        for i in range(values.shape[2]):
            following, tail = 0.0, 0.0
            for row in range(count[k] - 1, -1, -1):
                if played[row, k]:
                    tail = reward[row, k] + gamma * following - values[row, k, i] + gamma * gae_lambda * tail
                    following = values[row, k, i]
                else:
                    following, tail = 0.0 if terminated[row, k] else values[row, k, i], 0.0
                advantages[row, k, i] = tail
    return advantages


def standardised(advantages, share):
    """(A - mean) / std over the steps of each agent; advantages [R, num_trials, num_agents], share as in `learn`."""
    centred = advantages - (share * advantages).sum(0)
    return centred / (np.sqrt((share * centred**2).sum(0)) + 1e-8)


class ValueNormalizer:
    """Running mean and standard deviation of the value targets of every critic, freed of the bias of their start at 0.

    `ValueNorm` in the code of Yu et al.: as PopArt (Hessel et al., 2019), but without its correction of the last layers.
    """

    def __init__(self, num_trials, num_agents):
        self.state = [np.zeros((num_trials, num_agents)) for _ in range(3)]  # sums of targets, of squares, of weights

    def learn(self, targets, share):
        """Take in the targets [R, num_trials, num_agents] of an update; share as in `learn`."""
        for running, new in zip(self.state, ((share * targets).sum(0), (share * targets**2).sum(0), 1.0), strict=True):
            running += (1 - MOMENTS_DECAY) * (new - running)

    def mean_and_std(self):
        """Both [num_trials, num_agents]; 0 and 0.1, which is the smallest standard deviation, before anything was learnt."""
        total, squares, weight = self.state
        mean, square = (running / np.maximum(weight, 1e-8) for running in (total, squares))
        return mean, np.sqrt(np.maximum(square - mean**2, 0.01))

    def normalize(self, values):
        """Values in units of reward -> in standard deviations from the mean; [R, num_trials, num_agents]."""
        mean, std = self.mean_and_std()
        return (values - mean) / std

    def denormalize(self, outputs):
        """The way back."""
        mean, std = self.mean_and_std()
        return mean + std * outputs


def clipped_objective(ratio, advantages, clip):
    """min(rho A, clip(rho, 1 - eps, 1 + eps) A), Eq. 7 of Schulman et al. (2017): no gain from a ratio beyond the clip."""
    return torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)


def clipped_squares(outputs, before, targets, clip):
    """The larger one of two squared errors: of a critic's outputs, and of these kept within eps of what they were before."""
    near = before + (outputs - before).clamp(-clip, clip)
    return torch.maximum((targets - outputs) ** 2, (targets - near) ** 2)


def clipped_step(optimizer, loss):
    """One step down the gradient of a loss summed over all networks, each of which has its own gradient's norm clipped."""
    optimizer.zero_grad()
    loss.backward()
    grads = [param.grad for param in optimizer.param_groups[0]["params"]]
    norms = sum(grad.square().sum((1, 2)) for grad in grads).sqrt()  # [num_nets]
    for grad in grads:
        grad *= (MAX_GRAD_NORM / norms).clamp(max=1)[:, None, None]
    optimizer.step()


def log_probs_and_entropy(logits, rows, actions):
    """log pi(a_t | o_t) of the actions taken and the entropy of pi(. | o_t), tensors [R, num_trials, num_agents].

    logits [num_nets, U, num_actions] of distinct observations, rows and actions [R, num_trials, num_agents]
    """
    log_probs = torch.log_softmax(logits.double(), dim=-1)
    entropy = -(log_probs.exp() * log_probs).sum(2)
    return in_every_step(log_probs.flatten(1), rows * logits.shape[2] + actions), in_every_step(entropy, rows)


def learn(team, optimizer, critic_optimizer, args):
    """An update of all networks from the episodes of the batch; returns its figures, [num_trials] each."""
    batch = team.batch
    obs, rows = distinct_rows(batch.obs, batch.count)  # each observation once, and where it is [R, num_trials, num_agents]
    inputs, input_rows = distinct_rows(seen_by_critics(batch), batch.count)
    kept = (array[: len(rows)] for array in (batch.actions, batch.reward, batch.played, batch.terminated))
    actions, reward, played, terminated = kept
    share = (played / played.sum(0))[:, :, None]  # 1/N in each of a trial's N steps, 0 in other rows

    # What policies and critics say before the update.
    with torch.no_grad():
        log_probs_before, _ = log_probs_and_entropy(team.policy(obs), rows, actions)
        before = in_every_step(team.critic(inputs), input_rows)[..., 0].double()  # [R, num_trials, num_agents]

    values = team.normalizer.denormalize(before.numpy())
    advantages = gae(reward, values, played, terminated, batch.count, args.gamma, args.gae_lambda)
    team.normalizer.learn(values + advantages, share)
    targets = torch.from_numpy(team.normalizer.normalize(values + advantages))  # (1) Value normalisation.
    normalised, weights = torch.from_numpy(standardised(advantages, share)), torch.from_numpy(share)

    for _ in range(args.num_epochs):  # (3) Few epochs and no minibatches: each step is one over the whole batch.
        log_probs, entropy = log_probs_and_entropy(team.policy(obs), rows, actions)
        ratio = (log_probs - log_probs_before).exp()
        objective = clipped_objective(ratio, normalised, args.clip)  # (4) Clipping at no more than 0.2, here and of values.
        loss = -(weights * (objective + args.entropy_coef * entropy)).sum((0, 2))  # [num_trials]
        clipped_step(optimizer, loss.sum())

        outputs = in_every_step(team.critic(inputs), input_rows)[..., 0].double()
        squares = clipped_squares(outputs, before, targets, args.clip)
        clipped_step(critic_optimizer, (weights * squares).sum())

    with torch.no_grad():  # of the last step, means over a trial's steps and agents
        moved = [ratio - 1 - ratio.log(), ((ratio - 1).abs() > args.clip).double()]
        kl, clip_fraction = ((weights * figure).sum(0).mean(1).numpy() for figure in moved)
    value, square = ((share * figure).sum(0).mean(1) for figure in (values, advantages**2))
    return loss.detach().numpy(), value, np.sqrt(square), kl, clip_fraction


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        critic=StackedMLP(init, world.num_agents, [len(world.start) + world.obs_dim, *args.hidden, 1]),
        normalizer=ValueNormalizer(len(init), world.num_agents),
        batch=EpisodeBatch(world, len(init), min(args.episodes_per_update, args.num_episodes)),
        figures=SimpleNamespace(state=[np.zeros((5, len(init)))]),  # of the last update, shown until the next
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, _ = generators_of(args)
    team = build(args, world, init)
    adam = dict(lr=args.learning_rate, eps=1e-5, fused=True)  # eps of Yu et al.
    optimizer, critic_optimizer = torch.optim.Adam(team.policy.params, **adam), torch.optim.Adam(team.critic.params, **adam)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer, critic_optimizer], generators=act)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)
        team.batch.add(rollout)
        if (episode + 1) % args.episodes_per_update == 0:  # (5) A large batch: several episodes in each update.
            team.figures.state[0][:] = learn(team, optimizer, critic_optimizer, args)
            team.batch.clear()

        policy_loss, value, advantage, kl, clip_fraction = team.figures.state[0]
        figures = dict(value=value, advantage=advantage, kl=kl, clip_fraction=clip_fraction)
        run.record(episode, rollout, policy_loss=torch.from_numpy(policy_loss), **figures)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
