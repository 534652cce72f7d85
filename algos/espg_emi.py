"""ESPG with EMI: exploration with mutual information (Kim et al., ICML 2019) in the place of espg.py's Gaussian process.

1. One model for the team learns embeddings, phi of what all see and psi of what all do, in which a joint action adds a step:

       phi(o') = phi(o) + psi(a) + S(o, a) + e,          loss = mean ||e||^2 + w_S mean ||S||^2 + w_I (L_a + L_o) + w_KL KL.

   S takes up what cannot be written so. L_a is small if (phi(o), phi(o')) tells much about psi(a), L_o if (phi(o), psi(a)) does
   about phi(o'). KL is the divergence of psi(a) from the unit Gaussian, which sets the scale. The reward of all agents becomes
   r' = r + beta EB (Eq. 9) with EB = ||e||^2, the error before the model learns from the episode.
2. For every terminal state the team keeps its best episodes; their gradients are added to that of Eq. 14 (Eqs. 15-16).

Figure 6 of Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed Exploration and Selective Memory Reuse" (SAC 2021).
Loss, weights and bonus are those of the published code for discrete actions (snu-mllab/EMI, examples/trpo_emi_atari.py; the one
for continuous actions rewards diversity instead). What has to be chosen here:
- phi, psi, S and the statistics T have one hidden layer of 64 (there 1 to 3 layers of 32 to 256). Embeddings have 2 dimensions
  per agent, as its place has (there 2 for one agent).
- There, 3 epochs of minibatches of 512 follow every 100 000 steps of play. Here an episode may have 3 steps, of which a
  covariance is singular and no marginal can be had. So minibatches of 64 are drawn from the last 4000 steps, the first when 64
  have been seen: one after each of the first 1000 episodes, which in findtreasure and pushbox last 19 and 27 steps (under sign
  descent), and one after every fifth of the others, of 9 and 5 steps. So every step of play is used 1.4 to 3.4 times.
- These are fewer steps of Adam, so they are 0.003 long (there 0.001): under random play in findtreasure ||e||^2 comes to rest
  after 250 of them instead of 700, at the same value.
- w_S leaves S about 1 % of what phi and psi cannot say, so steps into a wall or a teammate go on to earn a bonus.

    python algos/espg_emi.py --env pushbox --seed 3
"""

import contextlib
import json
import signal
import subprocess
import sys
import time
from copy import copy
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import torch
import tyro
from numba import njit
from torch.nn.functional import softplus
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs

sys.modules.setdefault(Path(__file__).stem, sys.modules[__name__])  # where numba's cache looks after an import by this name

# Table 1 of the paper.
WORLDS = {
    "cleaner": dict(hidden=(256, 128), gamma=0.99, max_steps=200, num_episodes=20_000),
    "findtreasure": dict(hidden=(64,), gamma=0.98, max_steps=200, num_episodes=10_000),
    "gotogether": dict(hidden=(64,), gamma=0.98, max_steps=2000, num_episodes=10_000),
    "movebox": dict(hidden=(256, 128), gamma=0.999, max_steps=200, num_episodes=20_000),
    "pushbox": dict(hidden=(64, 32), gamma=0.95, max_steps=200, num_episodes=20_000),
}
# The tuning rule's choice for each world and optimiser (benchmark/tuning/espg_emi.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("cleaner", "adam"): dict(learning_rate=3e-4, beta=0.1, slots=10),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=10),
    ("gotogether", "sign"): dict(learning_rate=1e-3, beta=0.03, slots=10),
    ("gotogether", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=10),
    ("movebox", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("movebox", "adam"): dict(learning_rate=3e-4, beta=0.1, slots=10),
    ("pushbox", "sign"): dict(learning_rate=1e-4, beta=1.0, slots=10),
    ("pushbox", "adam"): dict(learning_rate=1e-3, beta=3.0, slots=10),
}
# The lowest and highest value of every number that makes sense.
LIMITS = dict(
    **dict(seed=(0, np.inf), num_trials=(1, np.inf), num_episodes=(1, np.inf), max_steps=(1, np.inf), hidden=(1, np.inf)),
    **dict(gamma=(0, 1), learning_rate=(0, np.inf), log_every=(1, np.inf), checkpoint_every=(0, np.inf)),
    **dict(beta=(0, np.inf), embedding_learning_rate=(0, np.inf), embedding_batch=(2, np.inf), recent_steps=(1, np.inf)),
    **dict(error_weight=(0, np.inf), information_weight=(0, np.inf), gaussian_weight=(0, np.inf)),
    **dict(slots=(0, np.inf)),
)


@dataclass
class Args:
    env: str = "pushbox"
    """world: cleaner, findtreasure, gotogether, movebox or pushbox"""
    env_args: tuple[str, ...] = ()
    """options of the world, such as size=6 (envs/<world>.py lists them)"""
    seed: int = 1
    """seed of the first trial; trial k has seed + k"""
    num_trials: int = 1
    """independent trials, trained side by side in this process"""
    num_episodes: int | None = None
    """training episodes of each trial (None: Table 1); with --evaluate, episodes to play (None: 100)"""
    max_steps: int | None = None
    """time limit of an episode in steps (None: Table 1)"""
    hidden: tuple[int, ...] | None = None
    """widths of the hidden layers (None: Table 1)"""
    gamma: float | None = None
    """discount factor (None: Table 1)"""
    optimizer: Literal["sign", "adam"] = "sign"
    """of the policies: sign descent (a fresh Adam in every update, what the paper's figures show) or a persistent Adam"""
    learning_rate: float | None = None
    """step size of the policies (None: tuned for world and optimiser)"""
    log_every: int = 100
    """episodes between two points of the TensorBoard curves, which show the mean since the last point"""
    run_dir: Path | None = None
    """where the run's files go (None: runs/<env>/<method>/seed<first>[-<last>][-<arguments that are not the default>])"""
    checkpoint_every: float = 60.0
    """seconds between two checkpoints (longer where writing one would take over 2 % of the time)"""
    resume: bool = False
    """go on from the checkpoint in the run's directory"""
    overwrite: bool = False
    """start anew even if the run's directory holds results"""
    save_model: bool = False
    """write the trained policies to policy.pt"""
    capture_video: bool = False
    """write one episode of the first trial's trained team to team.gif"""
    evaluate: Path | None = None
    """do not train: play the teams of this policy.pt, print how their episodes end and write a GIF beside it"""
    greedy: bool = False
    """with --evaluate: take the likeliest actions instead of drawing from the policies"""
    beta: float | None = None
    """weight of the exploration bonus, in units of reward (beta of Eq. 9; None: tuned for world and optimiser)"""
    embedding_learning_rate: float = 3e-3
    """step size of the embeddings, which always have a persistent Adam"""
    embedding_batch: int = 64
    """steps in a minibatch from which the embeddings learn; both halves of it have equally many"""
    recent_steps: int = 4000
    """last steps of each trial, from which minibatches are drawn"""
    error_weight: float = 100.0
    """w_S: a small one lets S(o, a) take over all prediction, a large one none of it (the published code's)"""
    information_weight: float = 0.1
    """w_I of both bounds on the mutual information (the published code's)"""
    gaussian_weight: float = 0.5
    """w_KL of the divergence of psi(a) from the unit Gaussian (the published code's)"""
    slots: int | None = None
    """episodes that the memory keeps for each terminal state (None: tuned for world and optimiser); 0 switches it off"""


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
        """x [num_nets, batch, in] -> [num_nets, batch, out]."""
        for layer in range(0, len(self.params), 2):
            if layer > 0:
                x = torch.relu(x)
            x = torch.baddbmm(self.params[layer + 1], x, self.params[layer])
        return x

    def subset(self, nets):
        """A copy of some of the networks."""
        part = copy(self)
        part.params = [param[nets] for param in self.params]
        return part


Policy = StackedMLP  # what agents act with: observations to logits of the actions


@njit(cache=True, error_model="numpy")  # which lets divisions be vectorised
def sign_step(param, grad, active, learning_rate):
    """One step of sign descent, in place; param and grad [num_nets, num_weights], the mask active [num_nets]."""
    real = param.dtype.type  # single precision stays single
    rate, tiny = real(learning_rate), real(1e-8)
    for net in np.flatnonzero(active):
        for j in range(param.shape[1]):
            g = grad[net, j]
            param[net, j] -= rate * g / (abs(g) + tiny)


@njit(cache=True, error_model="numpy")
def adam_step(param, grad, first, second, count, active, learning_rate):
    """One step of Adam, in place; param, grad and both moments [num_nets, num_weights], count and active [num_nets]."""
    real = param.dtype.type
    rate, tiny, weight1, weight2 = real(learning_rate), real(1e-8), real(0.1), real(0.001)
    for net in np.flatnonzero(active):
        correction1, correction2 = real(1 - 0.9 ** count[net]), real(1 - 0.999 ** count[net])
        for j in range(param.shape[1]):
            g = grad[net, j]
            first[net, j] += weight1 * (g - first[net, j])
            second[net, j] += weight2 * (g * g - second[net, j])
            param[net, j] -= rate * (first[net, j] / correction1) / (np.sqrt(second[net, j] / correction2) + tiny)


class StackedOptimizer:
    """Gradient descent for stacked networks, every network on its own.

    "sign": w -= lr g / (|g| + 1e-8), which is exactly the first step of a fresh Adam (the authors create one in every update).
    "adam": Adam (Kingma & Ba, 2015) with betas 0.9 and 0.999; moments and step count belong to the network.
    """

    def __init__(self, params, kind, learning_rate):
        self.params, self.learning_rate = params, learning_rate
        self.count = np.zeros(len(params[0]), np.int64)
        self.moments = [[np.zeros_like(p.detach().numpy()) for _ in range(2 if kind == "adam" else 0)] for p in params]
        self.state = [self.count, *(moment for moments in self.moments for moment in moments)]

    def step(self, grads, active=None):
        """One step against the gradients; networks outside the mask `active` (bool [num_nets], None: all) stay untouched."""
        active = np.ones(len(self.count), bool) if active is None else active.numpy()
        self.count += active
        for param, grad, moments in zip(self.params, grads, self.moments, strict=True):
            arrays = [array.reshape(len(active), -1) for array in (param.detach().numpy(), grad.numpy(), *moments)]
            if moments:
                adam_step(*arrays, self.count, active, self.learning_rate)
            else:
                sign_step(*arrays, active, self.learning_rate)


@njit(cache=True)
def sample_actions(logits, uniforms):
    """Draw from softmax(logits) by inverting the distribution function.

    logits [num_trials, num_agents, num_actions], uniforms in [0, 1) [num_trials, num_agents] -> actions, shaped as uniforms.
    """
    actions = np.empty(uniforms.shape, np.int64)
    for k in range(logits.shape[0]):
        for i in range(logits.shape[1]):
            highest = logits[k, i].max()
            total = 0.0
            for logit in logits[k, i]:
                total += np.exp(np.float64(logit - highest))
            a, remaining = -1, uniforms[k, i] * total
            while remaining >= 0.0 and a < logits.shape[2] - 1:
                a += 1
                remaining -= np.exp(np.float64(logits[k, i, a] - highest))
            actions[k, i] = a
    return actions


class Rollout:
    """One episode of every trial, time first; a row beyond a trial's length counts for nothing.

    Only `obs` has one row more, for what was seen after the last step (critics ask for it where the time limit cuts).
    """

    def __init__(self, env):
        world, shape = env.world, (env.world.max_steps, env.num_envs)
        self.obs = np.zeros((world.max_steps + 1, env.num_envs, world.num_agents, world.obs_dim), np.float32)
        self.actions = np.zeros((*shape, world.num_agents), np.int64)
        self.reward = np.zeros(shape)
        self.lengths = np.zeros(env.num_envs, np.int64)
        self.outcomes = np.zeros(env.num_envs, np.int64)


@torch.no_grad()
def collect(env, policy, uniforms, rollout, frames=None):
    """Play one episode in every world, in lock step until the last has ended, and write it into `rollout`.

    The agents draw their actions with `uniforms` [num_trials, max_steps, num_agents], or take the likeliest ones if it is None.
    Pictures of the first world are appended to `frames` if it is a list.
    """
    num_agents = env.world.num_agents
    rollout.obs[0], _ = env.reset()
    if frames is not None:
        frames.append(env.draw(0, caption="start"))
    rollout.lengths[:] = 0
    running, playing, num_playing, actor = np.ones(env.num_envs, bool), slice(None), env.num_envs, policy
    actions = np.zeros(rollout.actions.shape[1:], np.int64)
    for t in range(env.world.max_steps):
        logits = actor(torch.from_numpy(rollout.obs[t][playing]).view(num_playing * num_agents, 1, -1))
        logits = logits.view(num_playing, num_agents, -1).numpy()
        actions[playing] = logits.argmax(-1) if uniforms is None else sample_actions(logits, uniforms[playing, t])
        rollout.actions[t] = actions
        rollout.lengths += running
        rollout.obs[t + 1], rollout.reward[t], terminated, truncated, info = env.step(actions)
        if frames is not None and running[0]:
            frames.append(env.draw(0, caption=f"step {t + 1}   reward {rollout.reward[t, 0]:+g}"))
        running = ~(terminated | truncated)
        num_running = np.count_nonzero(running)
        if num_running == 0:
            break
        if 2 * num_running <= num_playing:  # acting takes as long as there are networks: let those that wait go
            playing, num_playing = np.flatnonzero(running), num_running
            actor = policy.subset((playing[:, None] * num_agents + np.arange(num_agents)).ravel())
    rollout.outcomes[:] = info["outcome"]


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


@njit(cache=True)
def merge_steps(obs, actions, weights, lengths, num_actions):
    """Add up the weights of equal steps: sum_t w_t log pi(a_t | o_t) needs every distinct observation only once.

    obs [T, num_trials, num_agents, obs_dim], actions and weights [T, num_trials, num_agents], lengths [num_trials]
    -> distinct observations [num_nets, U, obs_dim] and the weights of all actions there [num_nets, U, num_actions], 0 in the
    rows that a network with fewer than U distinct observations leaves over. There is one network per trial and agent.
    """
    _, trials, agents, dim = obs.shape
    distinct = np.zeros((trials * agents, lengths.max(), dim), np.float32)
    weight = np.zeros((trials * agents, lengths.max(), num_actions))
    buckets = 2
    while buckets < 2 * lengths.max():
        buckets *= 2
    bits = obs.view(np.int32)
    most = 0
    for k in range(trials):
        for i in range(agents):
            net, found = k * agents + i, 0
            row_in = np.full(buckets, -1)  # a hash table with open addressing: bucket -> row of `distinct`
            for t in range(lengths[k]):
                bucket = 0
                for j in range(dim):
                    bucket = (bucket ^ bits[t, k, i, j]) * 16777619
                bucket = (bucket ^ (bucket >> 20)) & (buckets - 1)
                while row_in[bucket] >= 0 and not np.array_equal(distinct[net, row_in[bucket]], obs[t, k, i]):
                    bucket = (bucket + 1) & (buckets - 1)
                if row_in[bucket] < 0:
                    row_in[bucket] = found
                    distinct[net, found] = obs[t, k, i]
                    found += 1
                weight[net, row_in[bucket], actions[t, k, i]] += weights[t, k, i]
            most = max(most, found)
    return distinct[:, :most].copy(), weight[:, :most].astype(np.float32)


def information_loss(joint, marginal):
    """mean [softplus(-T) + softplus(T')] of statistics T of steps as they were and T' of mixed ones, [.., batch] each -> [..].

    2 log 2 less its minimum over all T is twice the Jensen-Shannon divergence between the two.
    """
    return (softplus(-joint) + softplus(marginal)).mean(-1)


def gaussian_divergence(samples):
    """KL(N(m, C) || N(0, I)) = 1/2 (tr C + m^T m - d - log det C), m and C of samples [num_trials, batch, d] -> [num_trials].

    C is singular if few actions differ. Its eigenvalues count as at least 1e-6, which only double precision tells from 0.
    """
    samples = samples.double()
    mean = samples.mean(1, keepdim=True)
    centred = samples - mean
    covariance = centred.transpose(1, 2) @ centred / (samples.shape[1] - 1)
    eigenvalues = torch.linalg.eigvalsh(covariance).clamp(min=1e-6)
    return 0.5 * (eigenvalues + mean[:, 0].square() - 1 - eigenvalues.log()).sum(1)


def squared_residual(phi, psi, next_phi, error):
    """||e||^2 with e = phi(o') - phi(o) - psi(a) - S(o, a); all [num_trials, batch, d] -> [num_trials, batch]."""
    return (next_phi - phi - psi - error).square().sum(2)


def learns_after(episode):
    """Whether the model learns after an episode: always while the teams still explore, whose episodes are long."""
    return episode < 1000 or episode % 5 == 0


class EmbeddingNovelty:
    """The exploration bonus of EMI: one model for each trial, of all agents together, and the steps from which it learns."""

    def __init__(self, world, args, init, learn):
        self.args, self.learn, self.widths = args, learn, [world.num_actions, world.obs_dim]  # of an agent's part of a pair
        sight, choice, dim = world.num_agents * world.obs_dim, world.num_agents * world.num_actions, 2 * world.num_agents
        self.phi = StackedMLP(init, 1, [sight, 64, dim])
        self.psi = StackedMLP(init, 1, [choice, 64, dim])
        self.error = StackedMLP(init, 1, [choice + sight, 64, dim])  # S
        self.statistics = StackedMLP(init, 2, [3 * dim, 64, 1])  # T of L_a, then T of L_o, in each trial
        params = [*self.phi.params, *self.psi.params, *self.error.params], self.statistics.params
        self.optimizers = [StackedOptimizer(part, "adam", args.embedding_learning_rate) for part in params]
        self.pairs = np.zeros((args.num_trials, args.recent_steps, choice + sight), np.float32)
        self.next_obs = np.zeros((args.num_trials, args.recent_steps, sight), np.float32)
        self.visits = np.zeros(args.num_trials, np.int64)  # visit number n is in row n mod recent_steps
        self.figures = np.zeros((2, args.num_trials))  # what the last minibatch said of the model
        self.state = [self.pairs, self.next_obs, self.visits, self.figures]
        for optimizer in self.optimizers:
            self.state += [*optimizer.params, *optimizer.state]

    def bonus(self, pairs, lengths, next_obs, learn):
        """EB = ||e||^2 of each step of an episode, [T, num_trials, 1], 0 beyond its end; then learn from a minibatch, or not.

        Also returns mean ||e||^2 / mean ||psi||^2 and 2 log 2 - (L_a + L_o) / 2 of the last minibatch, [num_trials] each.
        pairs [T, num_trials, 1, pair_dim], lengths [num_trials], next_obs [T, num_trials, 1, num_agents * obs_dim]
        """
        pairs, next_obs, during = pairs[:, :, 0], next_obs[:, :, 0], np.arange(len(pairs))[:, None] < lengths
        with torch.no_grad():
            parts = self.embed(*(torch.from_numpy(array).transpose(0, 1) for array in (pairs, next_obs)))
        bonus = np.where(during, squared_residual(*parts).T.numpy(), 0.0)[:, :, None]

        t, k = np.nonzero(during)
        rows = k, (self.visits[k] + t) % self.args.recent_steps
        self.pairs[rows], self.next_obs[rows] = pairs[t, k], next_obs[t, k]
        self.visits += lengths
        if learn:
            self.fit()
        return bonus, *self.figures

    def embed(self, pairs, next_obs):
        """phi(o), psi(a), phi(o') and S(o, a) of steps, [num_trials, batch, d] each; both arguments [num_trials, batch, ..]."""
        actions, obs = pairs.unflatten(2, (-1, sum(self.widths))).split(self.widths, dim=3)
        phi, next_phi = self.phi(torch.cat([obs.flatten(2), next_obs], dim=1)).chunk(2, dim=1)
        return phi, self.psi(actions.flatten(2)), next_phi, self.error(pairs)

    def fit(self):
        """Learn from a minibatch, in each trial that has seen as many steps as are in it."""
        held, size = np.minimum(self.visits, self.args.recent_steps), self.args.embedding_batch
        drawn = [generator.integers(count, size=size) for generator, count in zip(self.learn, held, strict=True)]
        rows = np.arange(len(held))[:, None], np.array(drawn)
        loss, *figures = self.loss(torch.from_numpy(self.pairs[rows]), torch.from_numpy(self.next_obs[rows]))
        embeddings, statistics = self.optimizers
        grads = torch.autograd.grad(loss.sum(), [*embeddings.params, *statistics.params])
        active = torch.from_numpy(self.visits >= size)
        embeddings.step(grads[: len(embeddings.params)], active)
        statistics.step(grads[len(embeddings.params) :], active.repeat_interleave(2))
        self.figures[:] = torch.stack(figures).detach()

    def loss(self, pairs, next_obs):
        """The loss of a minibatch, mean ||e||^2 / mean ||psi||^2 and 2 log 2 - (L_a + L_o) / 2, [num_trials] each.

        pairs [num_trials, batch, pair_dim], next_obs [num_trials, batch, num_agents * obs_dim]
        """
        args = self.args
        phi, psi, next_phi, error = self.embed(pairs, next_obs)
        residual = squared_residual(phi, psi, next_phi, error).mean(1)
        penalty = error.square().sum(2).mean(1)

        # The steps of a minibatch are drawn independently of each other. So a step of its first half that gets psi(a) or
        # phi(o') from the second half in the place of its own is drawn from the product of the marginals.
        half = pairs.shape[1] // 2
        own, other = slice(half), slice(half, 2 * half)
        joint = torch.cat([phi[:, own], psi[:, own], next_phi[:, own]], dim=2)
        other_action = torch.cat([phi[:, own], psi[:, other], next_phi[:, own]], dim=2)
        other_end = torch.cat([phi[:, own], psi[:, own], next_phi[:, other]], dim=2)
        inputs = torch.stack([joint, other_action, joint, other_end], dim=1)  # the first two for L_a, the others for L_o
        scores = self.statistics(inputs.view(2 * len(inputs), 2 * half, -1)).view(-1, 2, 2, half)
        information = information_loss(scores[:, :, 0], scores[:, :, 1]).sum(1)  # L_a + L_o

        loss = residual + args.error_weight * penalty + args.information_weight * information
        loss = loss + args.gaussian_weight * gaussian_divergence(psi)
        return loss, residual / psi.square().sum(2).mean(1), 2 * np.log(2) - information / 2


class SelectiveMemory:
    """The best episodes of each terminal state (Section 3.2), kept jointly for the team, and their gradient."""

    def __init__(self, env, slots):
        world = env.world
        shape = (env.num_envs, len(world.outcome_names) + 1, slots)  # outcome 0, the time limit, is a terminal state too
        self.value = np.full(shape, -np.inf)  # Psi*, the discounted return of the original reward
        self.lengths = np.zeros(shape, np.int64)
        self.obs = np.zeros((*shape, world.max_steps, world.num_agents, world.obs_dim), np.float32)
        self.actions = np.zeros((*shape, world.max_steps, world.num_agents), np.int64)
        self.returns = np.zeros((*shape, world.max_steps))
        self.num_actions = world.num_actions
        self.state = [self.value, self.lengths, self.obs, self.actions, self.returns]
        self.replays = [None] * env.num_envs

    def remember(self, rollout, returns):
        """Keep each trial's episode if it is better than the worst one kept for its terminal state.

        returns [T, num_trials] are those of the original reward; on a tie the older episode stays.
        """
        for k, (outcome, length) in enumerate(zip(rollout.outcomes, rollout.lengths, strict=True)):
            values = self.value[k, outcome]
            if values.size and returns[0, k] > values.min():
                slot = k, outcome, values.argmin()
                self.value[slot], self.lengths[slot] = returns[0, k], length
                self.obs[slot][:length], self.actions[slot][:length] = rollout.obs[:length, k], rollout.actions[:length, k]
                self.returns[slot][:length] = returns[:length, k]
                self.replays[k] = None

    def replay(self):
        """The steps of the second term of Eq. 16, merged as by `merge_steps`: sum_i w_i g_i with w_i = Psi*_i / sum_j Psi*_j.

        g_i = 1/T_i sum_t G*_t grad log pi(a*_t | o*_t) is Eq. 15. Only episodes of positive value are replayed. What is stored
        does not change, so the steps are merged again only when a better episode has come.
        """
        changed = [k for k, replay in enumerate(self.replays) if replay is None]
        for k in changed:
            self.replays[k] = self._merge(k)
        if changed:
            rows = max(obs.shape[1] for obs, _ in self.replays)
            agents, dim = self.obs.shape[-2:]
            nets = len(self.replays) * agents
            self.stacked = [np.zeros((nets, rows, width), np.float32) for width in (dim, self.num_actions)]
            for k, replay in enumerate(self.replays):
                for stacked, part in zip(self.stacked, replay, strict=True):
                    stacked[k * agents : (k + 1) * agents, : part.shape[1]] = part
        return self.stacked

    def _merge(self, k):
        """The steps of trial k's episodes, each weighted by w_i G*_t / T_i."""
        value = np.where(self.value[k] > 0, self.value[k], 0.0)  # [outcomes, slots]
        scale = value / (value.sum() or 1.0) / np.maximum(self.lengths[k], 1)
        steps = np.arange(self.returns.shape[-1]) < (self.lengths[k] * (value > 0))[:, :, None]  # [outcomes, slots, max_steps]
        obs, actions, weights = self.obs[k][steps], self.actions[k][steps], (scale[:, :, None] * self.returns[k])[steps]
        weights = np.repeat(weights[:, None], obs.shape[1], axis=1)
        return merge_steps(obs[:, None], actions[:, None], weights[:, None], np.array([len(obs)]), self.num_actions)


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    torch.set_num_threads(1)
    args, env = resolve(args)
    world, num_agents = env.world, env.world.num_agents
    seeds = [np.random.SeedSequence(args.seed + k).spawn(3) for k in range(args.num_trials)]
    init, act, learn = [[np.random.default_rng(seed) for seed in stream] for stream in zip(*seeds, strict=True)]

    policy = Policy(init, num_agents, [world.obs_dim, *args.hidden, world.num_actions])
    optimizer = StackedOptimizer(policy.params, args.optimizer, args.learning_rate)
    one_hot = np.eye(world.num_actions, dtype=np.float32)
    pair_dim = num_agents * (world.num_actions + world.obs_dim)
    novelty = EmbeddingNovelty(world, args, init, learn)
    memory = SelectiveMemory(env, args.slots)
    rollout = Rollout(env)
    uniforms = np.empty((args.num_trials, world.max_steps, num_agents))
    arrays = [*policy.params, *optimizer.state, *novelty.state, *memory.state]
    run = Run(args, env, arrays, generators=[*act, *learn], figures=("bonus", "unexplained", "information"))

    for episode in run.episodes():
        # Play one episode of every trial.
        for generator, row in zip(act, uniforms, strict=True):
            generator.random(out=row)
        collect(env, policy, uniforms, rollout)
        lengths, longest = rollout.lengths, rollout.lengths.max()
        reward = np.repeat(rollout.reward[:longest, :, None], num_agents, axis=2)  # [T, num_trials, num_agents]

        # Augment the reward with the team's exploration bonus, Eq. 9, the same for all agents, and let the model learn.
        pairs = np.concatenate([one_hot[rollout.actions[:longest]], rollout.obs[:longest]], axis=3)  # each agent's u
        pairs = pairs.reshape(longest, args.num_trials, 1, pair_dim)  # the team's u
        next_obs = rollout.obs[1 : longest + 1].reshape(longest, args.num_trials, 1, -1)
        bonus, unexplained, information = novelty.bonus(pairs, lengths, next_obs, learns_after(episode))
        augmented = reward + args.beta * bonus

        # Update the selective memory, by the original reward.
        memory.remember(rollout, discounted_returns(reward, lengths, args.gamma)[:, :, 0])

        # Climb along 1/T sum_t G_t grad log pi(a_t | o_t), Eq. 14, and the memory's gradient, Eq. 16.
        returns = discounted_returns(augmented, lengths, args.gamma)
        obs, weight = merge_steps(rollout.obs, rollout.actions, returns / lengths[:, None], lengths, world.num_actions)
        obs, weight = (np.concatenate(parts, axis=1) for parts in zip((obs, weight), memory.replay(), strict=True))
        log_probs = torch.log_softmax(policy(torch.from_numpy(obs)), dim=-1)
        loss = -(torch.from_numpy(weight) * log_probs).sum()
        optimizer.step(torch.autograd.grad(loss, policy.params))

        mean_bonus = bonus.sum((0, 2)) / (lengths * bonus.shape[2])
        run.record(episode, rollout, bonus=mean_bonus, unexplained=unexplained, information=information)
    run.finish(policy)
    return SimpleNamespace(policy=policy, novelty=novelty, memory=memory, log=run.log)


# --- run keeping ---
# Arguments, directories, curves, checkpoints and evaluation: the same text in every script, and nothing that a method needs.

METHOD = Path(__file__).stem
HOUSEKEEPING = ("run_dir", "checkpoint_every", "resume", "overwrite", "save_model", "capture_video", "evaluate", "greedy")


def resolve(args):
    """The arguments with every None filled in from WORLDS and TUNED, and the worlds; UsageError for what is impossible."""
    tuned = TUNED.get((args.env, getattr(args, "optimizer", "adam")), {})  # Q-learning has no policies, and Adam always
    defaults = {**WORLDS.get(args.env, {}), **tuned, "run_dir": default_run_dir(args)}
    values = {name: defaults.get(name) if value is None else value for name, value in vars(args).items()}
    options = {"max_steps": values["max_steps"], **envs.parse_options(args.env_args)}
    envs.make_world(args.env, **options)
    values["max_steps"] = options["max_steps"]
    for name in LIMITS:
        check_limits(name, values[name])
    return type(args)(**values), envs.make_vec(args.env, args.num_trials, **options)


def check_limits(name, values):
    """UsageError if an argument, or one of its numbers if it has several, is outside its LIMITS."""
    for value in values if isinstance(values, tuple) else [values]:
        envs.check_number(f"--{name.replace('_', '-')}", value, *LIMITS[name])


def default_run_dir(args):
    """runs/<env>/<method>/seed<first>[-<last>][-<arguments that are not the default>]"""
    words = [f"seed{args.seed}" + f"-{args.seed + args.num_trials - 1}" * (args.num_trials > 1)]
    for field in fields(args):
        value = getattr(args, field.name)
        if value != field.default and field.name not in ("env", "seed", "num_trials", *HOUSEKEEPING):
            words.append(f"{field.name}={','.join(map(str, value)) if isinstance(value, tuple) else value}")
    return Path("runs", args.env, METHOD, "-".join(words).replace("/", "_"))


class Run:
    """The directory of a run: curves, checkpoints, results.

    arrays:     all arrays and tensors that training changes (of fixed shape; a checkpoint keeps them in this order)
    generators: all random generators that training uses
    figures:    names of the method's own curves, for which `record` takes values [num_trials]
    """

    def __init__(self, args, env, arrays, generators, figures=()):
        self.args, self.env, self.generators = args, env, generators
        self.log = envs.EpisodeLog(env.world, args.num_trials, args.num_episodes)
        self.sums = {name: np.zeros(args.num_trials) for name in figures}  # since the last point of the curves
        arrays = [*arrays, self.log.returns, self.log.lengths, self.log.outcomes, *self.sums.values()]
        self.arrays = [torch.from_numpy(a) if isinstance(a, np.ndarray) else a.detach() for a in arrays]
        self.settings = {"method": METHOD, **{k: v for k, v in asdict(args).items() if k not in HOUSEKEEPING}}
        self.checkpoint, self.result = args.run_dir / "checkpoint.pt", args.run_dir / "episodes.npz"
        self.start = 0
        if args.resume:
            self._load_checkpoint()
        self._open_directory()
        trials = [args.run_dir / f"seed{args.seed + k}" for k in range(args.num_trials)]
        self.writers = [SummaryWriter(str(trial), purge_step=self.start + 1, max_queue=1000) for trial in trials]

    def _open_directory(self):
        directory, resume = self.args.run_dir, self.args.resume
        kept = [directory / name for name in ("episodes.npz", "checkpoint.pt", "policy.pt", "team.gif")]
        if not (resume or self.args.overwrite) and any(path.exists() for path in kept):
            held = "a finished run" if self.result.exists() else "an unfinished run or a part of one"
            advice = "go on with --resume or " if self.checkpoint.exists() and not self.result.exists() else ""
            raise envs.UsageError(f"{directory} holds {held}; {advice}start anew with --overwrite.")
        about = {"method": METHOD, "args": asdict(self.args), "python": sys.version.split()[0]}
        about.update({package: version(package) for package in ("torch", "numpy", "numba", "gymnasium")})
        git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40"]
        with contextlib.suppress(OSError):
            about["commit"] = subprocess.run(git, capture_output=True, text=True).stdout.strip()
        try:
            directory.mkdir(parents=True, exist_ok=True)
            for old in [] if resume else [*kept, *directory.glob("seed*/events.*")]:
                old.unlink(missing_ok=True)
            with envs.complete_file(directory / "args.json") as file:
                file.write(json.dumps(about, indent=2, default=str).encode())
        except OSError as error:
            raise envs.UsageError(f"cannot write to {directory}: {error.strerror}.") from error

    def _load_checkpoint(self):
        if not self.checkpoint.exists():
            raise envs.UsageError(f"there is nothing to resume: {self.args.run_dir} holds no checkpoint of an unfinished run.")
        try:
            saved = torch.load(self.checkpoint, weights_only=True)
        except Exception as error:  # whatever can be wrong with a file
            raise envs.UsageError(f"{self.checkpoint} cannot be read; start anew with --overwrite.") from error
        for name, value in self.settings.items():
            if (kept := saved["settings"].get(name)) != value:
                raise envs.UsageError(f"--resume needs the same arguments, but {name} was {kept} and is now {value}.")
        self.start = saved["episode"]
        for array, kept in zip(self.arrays, saved["arrays"], strict=True):
            array.copy_(kept)
        for generator, state in zip(self.generators, saved["generators"], strict=True):
            generator.bit_generator.state = state

    def _save_checkpoint(self, episode):
        for writer in self.writers:
            writer.flush()
        states = [generator.bit_generator.state for generator in self.generators]
        with envs.complete_file(self.checkpoint) as file:
            torch.save({"settings": self.settings, "episode": episode, "arrays": self.arrays, "generators": states}, file)

    def episodes(self):
        """Yield the number of every episode to play; between two of them write checkpoints and listen to Ctrl-C."""
        first, last, stopped = self.start, self.args.num_episodes, []
        handlers = {s: signal.signal(s, lambda number, _: stopped.append(number)) for s in (signal.SIGINT, signal.SIGTERM)}
        self.bar = tqdm(initial=first, total=last, desc=f"{METHOD} {self.args.env}", unit="ep", mininterval=0.5)
        self.clock = saved = time.monotonic()
        pause = self.args.checkpoint_every
        try:
            for episode in range(first, last):
                yield episode
                self.bar.update()
                if stopped or time.monotonic() - saved >= pause:
                    began = time.monotonic()
                    self._save_checkpoint(episode + 1)
                    saved = time.monotonic()
                    pause = max(self.args.checkpoint_every, 50 * (saved - began))
                if stopped:
                    self.bar.write(f"Stopped after {episode + 1} episodes; go on with --resume.", file=sys.stderr)
                    sys.exit(128 + stopped[0])
        finally:
            self.bar.close()
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def record(self, episode, rollout, **figures):
        """Keep one episode of every trial; every `log_every` episodes write the means since the last time to TensorBoard."""
        self.log.add(episode, rollout.reward[: rollout.lengths.max()], rollout.lengths, rollout.outcomes)
        for name, values in figures.items():
            self.sums[name] += values
        done, every = episode + 1, self.args.log_every
        if done % every:
            return
        recent, seconds = slice(done - every, done), time.monotonic() - self.clock
        curves = self.log.means(recent)
        steps = curves["episodic_length"] * every
        curves.update(SPS=steps / seconds, **{name: total / every for name, total in self.sums.items()})
        for name, values in curves.items():
            for writer, value in zip(self.writers, values, strict=True):
                writer.add_scalar(f"charts/{name}", value, done)
        for total in self.sums.values():
            total[:] = 0
        recently = {"reward/step": f"{curves['reward_per_step'].mean():.2f}", "steps/s": f"{steps.sum() / seconds:.0f}"}
        if self.env.world.outcome_names:
            recently["trials at best"] = f"{self.log.share_at_best(recent):.0%}"
        self.bar.set_postfix(recently, refresh=False)
        self.clock = time.monotonic()

    def finish(self, policy):
        """Write what was asked for and, last of all, the file that marks the run as finished."""
        args, directory = self.args, self.args.run_dir
        for writer in self.writers:
            writer.close()
        if args.save_model:
            team = {"method": METHOD, "env": args.env, "env_args": list(args.env_args), "max_steps": self.env.world.max_steps}
            with envs.complete_file(directory / "policy.pt") as file:
                torch.save({**team, "hidden": list(args.hidden), "params": [p.detach() for p in policy.params]}, file)
        if args.capture_video:
            play(self.env, policy, args, 1, directory / "team.gif")
        with envs.complete_file(self.result) as file:
            np.savez(file, returns=self.log.returns, lengths=self.log.lengths, outcomes=self.log.outcomes)
        self.checkpoint.unlink(missing_ok=True)
        print(f"{directory}: {args.num_trials} trial{'s' * (args.num_trials > 1)}, {self.log.summary()}")


def play(env, policy, args, num_episodes, video):
    """Play episodes with every trial's team, write the first team's first one as a GIF, and return their log."""
    rng, rollout, frames = np.random.default_rng(args.seed), Rollout(env), []
    log = envs.EpisodeLog(env.world, env.num_envs, num_episodes)
    for episode in range(num_episodes):
        uniforms = None if args.greedy else rng.random((env.num_envs, env.world.max_steps, env.world.num_agents))
        collect(env, policy, uniforms, rollout, frames if episode == 0 else None)
        log.add(episode, rollout.reward[: rollout.lengths.max()], rollout.lengths, rollout.outcomes)
    try:
        envs.save_gif(video, frames)
    except OSError as error:
        raise envs.UsageError(f"cannot write {video}: {error.strerror}.") from error
    return log


def load_teams(path):
    """The worlds and the policies of a policy.pt that --save-model wrote; UsageError for anything else."""
    if not path.exists():
        raise envs.UsageError(f"there is no file {path}.")
    try:
        saved = torch.load(path, weights_only=True)
        world = envs.make_world(saved["env"], **{"max_steps": saved["max_steps"], **envs.parse_options(saved["env_args"])})
        teams = len(saved["params"][0]) // world.num_agents
        sizes = [world.obs_dim, *saved["hidden"], world.num_actions]
        policy = Policy([np.random.default_rng(0)] * teams, world.num_agents, sizes)
        for param, kept in zip(policy.params, saved["params"], strict=True):
            param.data.copy_(kept)
    except Exception as error:  # whatever can be wrong with a file
        raise envs.UsageError(f"{path} is not a policy.pt that --save-model wrote.") from error
    return envs.GridVectorEnv(world, teams), policy


def evaluate(args):
    """Play the teams of a policy.pt that --save-model wrote, say how their episodes ended, and write a GIF beside it."""
    torch.set_num_threads(1)
    video, num_episodes = args.evaluate.with_suffix(".gif"), 100 if args.num_episodes is None else args.num_episodes
    check_limits("num_episodes", num_episodes)
    check_limits("seed", args.seed)
    env, policy = load_teams(args.evaluate)
    log = play(env, policy, args, num_episodes, video)
    print(f"{args.evaluate}: {num_episodes} episodes of {env.num_envs} teams, {log.summary(share=1.0)}; one of them in {video}")


def main():
    try:
        args = tyro.cli(Args, description=__doc__)
        evaluate(args) if args.evaluate else train(args)
    except envs.UsageError as error:
        print(f"{METHOD}.py: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
