"""ACER: off-policy actor-critics, an independent one for each agent, that replay the team's episodes; on the base of pg.py.

Every agent has a policy pi(a | o) and action values Q(o, a) of its own. It learns from each episode as soon as it is over and
once more from an old one. With mu, the policy that played it, rho = pi / mu and V = sum_a pi(a) Q(a),

    Qret_t = r_t + gamma (V_{t+1} + min(1, rho_{t+1}) (Qret_{t+1} - Q_{t+1}))         is what Q(o_t, a_t) goes towards, and
    g_t(a) = [a = a_t] min(c, rho_t) (Qret_t - V_t) / pi(a) + max(0, 1 - c / rho_t(a)) (Q(o_t, a) - V_t)

is where pi(. | o_t) goes, though no faster away from a running average of the policy than the trust region allows. Under sign
descent, whose steps do not follow the gradient's length, the trust region turns a step and does not bound it.

Wang et al., "Sample Efficient Actor-Critic with Experience Replay" (ICLR 2017): Eqs. 5 and 9-12, and Section 4 for c, delta,
alpha, the weight of the entropy and one replay an episode. The traces are cut at 1, as in its published implementations. A
segment is a whole episode. The replay is concurrent: all agents of a team learn from the same old episode, each with the ratio
of its own actions (Omidshafiei et al., ICML 2017). Section 4.2 of Jiang & Amato (SAC 2021) asks for that and gives no numbers.

    python algos/acer.py --env findtreasure --num-trials 20
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/acer.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("cleaner", "adam"): dict(learning_rate=1e-3, critic_learning_rate=1e-3),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, critic_learning_rate=3e-3),
    ("gotogether", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-4),
    ("gotogether", "adam"): dict(learning_rate=3e-3, critic_learning_rate=3e-4),
    ("movebox", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-4),
    ("movebox", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-4),
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
    truncation: Annotated[float, AtLeast(1)] = 10.0
    """largest importance ratio of an action taken; a term for all actions makes up for the rest (c of Eq. 9)"""
    trust_region: Annotated[float, AtLeast(0)] = 1.0
    """how fast a step may lead away from the average policy, in divergence (delta of Eq. 11); a huge number: no bound"""
    average_decay: Annotated[float, Between(0, 1)] = 0.99
    """share of its weights that the average policy keeps in an update (alpha of Section 3.3)"""
    entropy: Annotated[float, AtLeast(0)] = 0.001
    """weight of the policies' entropy, whose gradient is added to that of Eq. 9"""
    buffer_size: Annotated[int, AtLeast(1)] = 20_000
    """steps that are kept for replay"""


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


class EpisodeReplay:
    """The last episodes of every trial, whole and kept jointly, so what is drawn is the same episode for all agents.

    An episode of T steps takes T + 1 rows of its trial's ring; the last one holds only what was seen after the last step.
    """

    def __init__(self, world, num_trials, num_episodes, size):
        self.size = max(size, world.max_steps + 1)  # there is always room for an episode
        shape = (num_trials, self.size, world.num_agents)
        self.obs = np.zeros((*shape, world.obs_dim), np.float32)
        self.actions = np.zeros(shape, np.int64)
        self.mu = np.zeros((*shape, world.num_actions), np.float32)
        self.reward = np.zeros(shape[:2])
        self.begin = np.zeros((num_trials, num_episodes + 1), np.int64)  # rows that were written before each episode
        self.outcomes = np.zeros((num_trials, num_episodes), np.int64)
        self.state = [self.obs, self.actions, self.mu, self.reward, self.begin, self.outcomes]

    def add(self, episode, rollout, mu):
        """Keep the episode with this number (0, 1, ...) of every trial, in the place of the oldest steps.

        mu [T, num_trials, num_agents, num_actions]: the probabilities with which it was played
        """
        trials, begin = np.arange(len(rollout.lengths)), self.begin[:, episode]
        t, k = np.nonzero(rollout.played)
        rows = (begin[k] + t) % self.size
        self.obs[k, rows], self.actions[k, rows] = rollout.all_obs[t, k], rollout.actions[t, k]
        self.mu[k, rows], self.reward[k, rows] = mu[t, k], rollout.reward[t, k, 0]
        self.obs[trials, (begin + rollout.lengths) % self.size] = rollout.all_obs[rollout.lengths, trials]
        self.begin[:, episode + 1] = begin + rollout.lengths + 1
        self.outcomes[:, episode] = rollout.outcomes

    def draw(self, episode, generators):
        """Numbers of episodes [num_trials], uniformly from those up to `episode` of which no step has been overwritten."""
        oldest = [np.searchsorted(begin[: episode + 1], begin[episode + 1] - self.size) for begin in self.begin]
        return np.array([one.integers(first, episode + 1) for one, first in zip(generators, oldest, strict=True)])

    def read(self, episodes):
        """The episodes with these numbers [num_trials], as a namespace of arrays, time first; obs [T + 1, ..]."""
        trials = np.arange(len(episodes))
        begin = self.begin[trials, episodes]
        lengths = self.begin[trials, episodes + 1] - begin - 1
        rows = (begin + np.arange(lengths.max() + 1)[:, None]) % self.size  # [T + 1, num_trials]
        steps = {name: getattr(self, name)[trials, rows] for name in ("obs", "actions", "mu", "reward")}
        return SimpleNamespace(**steps, lengths=lengths, outcomes=self.outcomes[trials, episodes])


def probabilities(logits):
    """softmax(logits) in double precision; at least 1e-8, because the equations divide by it."""
    return torch.softmax(logits.detach(), dim=-1).clamp(min=1e-8).double().numpy()


@njit(cache=True)
def retrace(reward, ratio, q_taken, value, tail, gamma):
    """Qret_t = r_t + gamma (V_{t+1} + min(1, rho_{t+1}) (Qret_{t+1} - Q_{t+1})) of every step of an episode (Eq. 5).

    reward, rho and Q of the actions taken, and V are [T]; `tail` is what stands for the bracket after the last step.
    """
    target = np.empty(len(reward))
    for t in range(len(reward) - 1, -1, -1):
        target[t] = reward[t] + gamma * tail
        tail = value[t] + min(1.0, ratio[t]) * (target[t] - q_taken[t])
    return target


@njit(cache=True)
def policy_gradient(pi, mu, q, value, action, target, truncation):
    """g of Eq. 9, the direction for the probabilities pi(. | o_t); pi, mu, q and g are [num_actions]."""
    g = np.empty(len(pi))
    for a in range(len(pi)):
        g[a] = max(0.0, 1.0 - truncation * mu[a] / pi[a]) * (q[a] - value)
    g[action] += min(truncation, pi[action] / mu[action]) * (target - value) / pi[action]
    return g


@njit(cache=True)
def project_to_trust_region(g, pi, average, delta):
    """Change g into the nearest z with k . z <= delta, where k = -average / pi is the gradient of KL(average || pi) by pi.

    That is z = g - max(0, (k . g - delta) / |k|^2) k (Eqs. 11-12); all are [num_actions]. Returns whether g went too far.
    """
    excess, square = -delta, 0.0
    for a in range(len(pi)):
        k = -average[a] / pi[a]
        excess += k * g[a]
        square += k * k
    if excess <= 0.0:
        return False
    for a in range(len(pi)):
        g[a] += excess / square * average[a] / pi[a]
    return True


@njit(cache=True)
def output_directions(reward, actions, mu, lengths, cut, rows, pi, average, q, gamma, truncation, trust_region, entropy):
    """Where an episode of every trial wants the networks' outputs, logits and Q, to go.

    The episode is reward [T, num_trials], actions [T, num_trials, num_agents], mu [.., num_actions], lengths and cut
    [num_trials]; where the time limit has cut it, V(o_T) stands for what would have come. pi, average and q [num_nets, U,
    num_actions] are what the networks say, and rows [T + 1, num_trials, num_agents] where in that the steps are.
    -> 1/T sum_t of pi (z_t - sum_a pi z_t), which is z_t brought from pi to the logits, and of Qret_t - Q_t, shaped as pi; Q_t
    and how often the trust region binds, means over steps and agents [num_trials].
    """
    _, trials, agents = actions.shape
    policy_direction, critic_direction = np.zeros(pi.shape), np.zeros(pi.shape)
    mean_value, bound = np.zeros(trials), np.zeros(trials)
    v = (pi * q).sum(2)  # V = sum_a pi(a) Q(a)
    for k in range(trials):
        length = lengths[k]
        ratio, q_taken, value = np.empty(length), np.empty(length), np.empty(length)
        for i in range(agents):
            net, row, action = k * agents + i, rows[:, k, i], actions[:, k, i]
            for t in range(length):
                ratio[t] = pi[net, row[t], action[t]] / mu[t, k, i, action[t]]
                q_taken[t], value[t] = q[net, row[t], action[t]], v[net, row[t]]
            tail = v[net, row[length]] if cut[k] else 0.0
            target = retrace(reward[:length, k], ratio, q_taken, value, tail, gamma)
            for t in range(length):
                probs = pi[net, row[t]]
                z = policy_gradient(probs, mu[t, k, i], q[net, row[t]], value[t], action[t], target[t], truncation)
                for a in range(len(z)):
                    z[a] -= entropy * (np.log(probs[a]) + 1.0)
                bound[k] += project_to_trust_region(z, probs, average[net, row[t]], trust_region) / (length * agents)
                mean_z = (probs * z).sum()
                for a in range(len(z)):
                    policy_direction[net, row[t], a] += probs[a] * (z[a] - mean_z) / length
                critic_direction[net, row[t], action[t]] += (target[t] - q_taken[t]) / length
                mean_value[k] += q_taken[t] / (length * agents)
    return policy_direction, critic_direction, mean_value, bound


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    sizes = [world.obs_dim, *args.hidden, world.num_actions]
    policy, critic = (StackedMLP(init, world.num_agents, sizes) for _ in range(2))  # observations to logits, and to Q
    replay = EpisodeReplay(world, len(init), args.num_episodes, args.buffer_size)
    return SimpleNamespace(policy=policy, critic=critic, average=deepcopy(policy), replay=replay)


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, learn = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    critic_optimizer = torch.optim.Adam(team.critic.params, lr=args.critic_learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer, critic_optimizer], generators=[*act, *learn])

    for episode in run.episodes():
        # Play, and keep the episode with the probabilities of all actions.
        rollout.play(team.policy.params, act)
        mu = in_every_step(probabilities(team.policy(rollout.obs)), rollout.rows)
        team.replay.add(episode, rollout, mu)

        # Learn from it, and from one that is drawn.
        losses, values, bounds = [], [], []
        for numbers in (np.full(args.num_trials, episode), team.replay.draw(episode, learn)):
            steps = team.replay.read(numbers)
            obs, rows = distinct_rows(steps.obs, steps.lengths + 1)
            logits, q = team.policy(obs), team.critic(obs)  # [num_nets, U, num_actions]
            policy_direction, critic_direction, value, bound = output_directions(
                *(steps.reward / REWARD_SCALE, steps.actions, steps.mu, steps.lengths, steps.outcomes == 0, rows),
                *(probabilities(logits), probabilities(team.average(obs)), q.detach().double().numpy()),
                *(args.gamma, args.truncation, args.trust_region, args.entropy),
            )
            loss = -(torch.from_numpy(policy_direction) * logits).view(args.num_trials, -1).sum(1)
            update(optimizer, args.optimizer, loss.sum())
            critic_loss = -(torch.from_numpy(critic_direction) * q).sum()  # descends 1/T sum_t (Qret_t - Q_t)^2 / 2
            update(critic_optimizer, "adam", critic_loss)
            for slow, fast in zip(team.average.params, team.policy.params, strict=True):
                slow.data.lerp_(fast.detach(), 1 - args.average_decay)
            losses.append(loss)
            values.append(value)
            bounds.append(bound)
        figures = dict(value=REWARD_SCALE * values[0], trust_region=np.mean(bounds, axis=0))
        run.record(episode, rollout, policy_loss=losses[0], **figures)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
