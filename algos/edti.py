"""EDTI: exploration via decision-theoretic influence with counts (Wang et al., ICLR 2020), on the base of ac.py.

Agent i's reward grows by what is new to itself, and by what its presence is worth to the others where they go next:

    rhat_i = r + u_i + sum_{j != i} gamma c_ij (beta_ext V_j^ext(o_j,t+1) + beta_int V_j^int(o_j,t+1)),
    u_i = eta / sqrt(N(x_i') + 1) and c_ij = 1 - p(x_j' | x_-i, a_-i) / p(x_j' | x, a).

x_i is agent i's local state (its place, facing and the box), N and p are counts, -i means all agents but i. Every agent learns
like ac.py's, but from three values of its own observation: V_i of rhat_i, which its actor needs, V_i^ext of r, V_i^int of u_i.
ac.py's critic of the joint observation becomes these, because what c_ij weighs is the value of o_j to agent j, and because the
paper says of EDTI only that its agents are local (Jiang & Amato, SAC 2021); it does not say on which learner EDTI ran.

u, c and the three values per agent are those of the published code (TonghanWang/EITI-EDTI, Curiosity.py and ppo2/runner.py: the
option --tv with count-based probabilities), its eta 10, beta_ext 0.1 and beta_int 1 those of its task Pass, where the reward is
1000. u adds to r, so eta is scaled by the world's largest reward / 1000. The betas are not: c has no unit, and V^ext and V^int
have that of r and u. Unlike there, nothing follows the step that terminates an episode, and PPO gives way to ac.py's update.

    python algos/edti.py --env pushbox --num-trials 20
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/edti.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=3e-4, critic_learning_rate=3e-3, eta=10.0),
    ("cleaner", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0),
    ("findtreasure", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0),
    ("gotogether", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0),
    ("gotogether", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0),
    ("movebox", "sign"): dict(learning_rate=3e-4, critic_learning_rate=3e-3, eta=10.0),
    ("movebox", "adam"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0),
    ("pushbox", "sign"): dict(learning_rate=1e-4, critic_learning_rate=3e-3, eta=30.0),
    ("pushbox", "adam"): dict(learning_rate=3e-4, critic_learning_rate=3e-3, eta=30.0),
}
# The lowest and highest value of every number that makes sense.
LIMITS = dict(
    **dict(seed=(0, np.inf), num_trials=(1, np.inf), num_episodes=(1, np.inf), max_steps=(1, np.inf), hidden=(1, np.inf)),
    **dict(gamma=(0, 1), learning_rate=(0, np.inf), log_every=(1, np.inf), checkpoint_every=(0, np.inf)),
    **dict(critic_learning_rate=(0, np.inf)),
    **dict(eta=(0, np.inf), beta_ext=(0, np.inf), beta_int=(0, np.inf), table_size=(8, np.inf)),
)
REWARD_SCALE = 10.0  # the critics learn from rewards divided by this, so from 0.3 to 10; their curves are in units of reward
LARGEST_REWARD = dict(cleaner=1.0, findtreasure=100.0, gotogether=10.0, movebox=100.0, pushbox=100.0)  # eta is relative to it


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
    critic_learning_rate: float | None = None
    """step size of the critic, which always has a persistent Adam (None: tuned for world and optimiser)"""
    eta: float | None = None
    """weight of the novelty u, in thousandths of the world's largest reward (None: tuned for world and optimiser)"""
    beta_ext: float = 0.1
    """weight of the influence on the others' values of the reward, V^ext (the published code's)"""
    beta_int: float = 1.0
    """weight of the influence on the others' values of their novelty, V^int (the published code's)"""
    table_size: int = 2**19
    """places for counts in each trial's hash table, of 12 bytes each; what finds none counts as never seen"""


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

    Only `obs` and, unlike in pg.py, `local_state` have one row more, for what was there after the last step.
    """

    def __init__(self, env):
        world, shape = env.world, (env.world.max_steps, env.num_envs)
        self.obs = np.zeros((world.max_steps + 1, env.num_envs, world.num_agents, world.obs_dim), np.float32)
        self.local_state = np.zeros((world.max_steps + 1, env.num_envs, *world.local_index.shape), np.int64)
        self.actions = np.zeros((*shape, world.num_agents), np.int64)
        self.reward = np.zeros(shape)
        self.lengths = np.zeros(env.num_envs, np.int64)
        self.outcomes = np.zeros(env.num_envs, np.int64)


@torch.no_grad()
def collect(env, policy, uniforms, rollout, frames=None):
    """Play one episode in every world, in lock step until the last has ended, and write it into `rollout`.

    Unlike pg.py's, it keeps the local states too.

    The agents draw their actions with `uniforms` [num_trials, max_steps, num_agents], or take the likeliest ones if it is None.
    Pictures of the first world are appended to `frames` if it is a list.
    """
    num_agents = env.world.num_agents
    rollout.obs[0], info = env.reset()
    rollout.local_state[0] = info["local_state"]
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
        rollout.local_state[t + 1] = info["local_state"]
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


def td_errors(reward, values, lengths, terminated, gamma):
    """delta_t = r_t + gamma V(s_{t+1}) - V(s_t) of every step, 0 beyond an episode's end.

    reward [T, num_trials], values [T + 1, num_trials], lengths and terminated [num_trials] -> shaped as reward. Nothing follows
    the step that terminates an episode. One that the time limit cuts would have gone on: V(s_T) stands for the rest of it.
    """
    steps = np.arange(len(reward))[:, None]
    goes_on = (steps < lengths - 1) | ~terminated
    delta = reward + gamma * goes_on * values[1:] - values[:-1]
    return np.where(steps < lengths, delta, 0.0)


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


@njit(cache=True)
def distinct_observations(obs, lengths):
    """What the networks have to see of an episode: every distinct observation, the one after the last step too, but only once.

    obs [T + 1, num_trials, num_agents, obs_dim], lengths [num_trials] -> distinct observations [num_nets, U, obs_dim], 0 in the
    rows that a network with fewer than U leaves over, and each step's row among them [T + 1, num_trials, num_agents].
    """
    _, trials, agents, dim = obs.shape
    distinct = np.zeros((trials * agents, lengths.max() + 1, dim), np.float32)
    rows = np.zeros((lengths.max() + 1, trials, agents), np.int64)
    buckets = 2
    while buckets < 2 * lengths.max() + 2:
        buckets *= 2
    bits = obs.view(np.int32)
    most = 0
    for k in range(trials):
        for i in range(agents):
            net, found = k * agents + i, 0
            row_in = np.full(buckets, -1)  # a hash table with open addressing: bucket -> row of `distinct`
            for t in range(lengths[k] + 1):
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
                rows[t, k, i] = row_in[bucket]
            most = max(most, found)
    return distinct[:, :most].copy(), rows


@njit(cache=True)
def extend_key(key, number):
    """The key of a sequence of whole numbers whose last is `number`; `key` is that of the sequence before it.

    Keys have 64 bits. That two of the million sequences of a long run get the same one has a chance of about 1e-7.
    """
    key = (key ^ number) * -7046029254386353131 + 1442695040888963407  # the sum keeps 0, 0, ... from staying 0
    return key ^ (key >> 32 & 0xFFFFFFFF)  # mix the upper half, without its sign, into the lower one


@njit(cache=True)
def find_place(keys, counts, key):
    """Where the hash table of one trial keeps `key`, or the free place (of count 0) that it would take."""
    place = key % len(keys)
    while counts[place] > 0 and keys[place] != key:
        place = (place + 1) % len(keys)
    return place


@njit(cache=True)
def count_key(keys, counts, filled, k, key, limit):
    """How often trial k has seen `key`, this time included; 0 if the key is new and `limit` places are taken already."""
    place = find_place(keys[k], counts[k], key)
    if counts[k, place] == 0:
        if filled[k] >= limit:
            return 0
        keys[k, place] = key
        filled[k] += 1
    counts[k, place] += 1
    return counts[k, place]


@njit(cache=True)
def count_transitions(local_state, actions, lengths, keys, counts, filled):
    """Count an episode step by step; 1 / sqrt(N(x_i') + 1) and the influence c_ij of every step, 0 beyond the episode's end.

    local_state [T + 1, num_trials, num_agents, d], actions [T, num_trials, num_agents], lengths [num_trials]
    -> novelty [T, num_trials, num_agents], influence of i on j [T, num_trials, num_agents, num_agents] (of i on itself 0).
    As in the published code, N is the count before a step, while the probabilities already know of it.
    """
    steps, trials, agents = actions.shape
    novelty, influence = np.zeros((steps, trials, agents)), np.zeros((steps, trials, agents, agents))
    p = np.zeros((agents + 1, agents))  # p[i, j] = p(x_j' | x_-i, a_-i), and p[agents, j] = p(x_j' | x, a); 0: unknown
    limit, joint_limit = len(keys[0]) * 7 // 8, len(keys[0]) * 3 // 4  # joint contexts, the most by far, leave room for others
    for k in range(trials):
        for t in range(lengths[k]):
            now, after = local_state[t, k], local_state[t + 1, k]
            for i in range(agents):
                key = extend_key(agents + 1, i)
                for number in after[i]:
                    key = extend_key(key, number)
                seen = count_key(keys, counts, filled, k, key, limit)  # N + 1
                novelty[t, k, i] = 1.0 / np.sqrt(max(seen, 1))

            for i in range(agents + 1):  # whom the context leaves out; `agents`: nobody
                most = joint_limit if i == agents else limit
                context = extend_key(0, i)
                for j in range(agents):
                    if j != i:
                        for number in now[j]:
                            context = extend_key(context, number)
                        context = extend_key(context, actions[t, k, j])
                total = count_key(keys, counts, filled, k, context, most)
                for j in range(agents):
                    if j != i:
                        key = extend_key(context, j)
                        for number in after[j]:
                            key = extend_key(key, number)
                        p[i, j] = count_key(keys, counts, filled, k, key, most) / total if total > 0 else 0.0

            for i in range(agents):
                for j in range(agents):
                    if j != i and p[i, j] > 0.0 and p[agents, j] > 0.0:
                        influence[t, k, i, j] = 1.0 - p[i, j] / p[agents, j]
    return novelty, influence


class TransitionCounts:
    """How often each trial has seen local states x_i', contexts (x, a) and (x_-i, a_-i), and contexts with an x_j' after them.

    A hash table with open addressing per trial. Once it is full, what is new is no longer kept: a local state that it does not
    know stays new, and what follows a context that it does not know is influenced by nobody.
    """

    def __init__(self, num_trials, size):
        self.keys = np.zeros((num_trials, size), np.int64)
        self.counts = np.zeros((num_trials, size), np.int32)
        self.filled = np.zeros(num_trials, np.int64)
        self.state = [self.keys, self.counts, self.filled]

    def add(self, rollout):
        """Count an episode; see `count_transitions` for what comes back."""
        steps = rollout.lengths.max()
        return count_transitions(rollout.local_state, rollout.actions[:steps], rollout.lengths, *self.state)


def influence_rewards(influence, worth, lengths, terminated, gamma):
    """sum_{j != i} gamma c_ij w_j(o_j,t+1) of every step and agent i, [T, num_trials, num_agents].

    influence [T, num_trials, num_agents, num_agents], worth w [T + 1, num_trials, num_agents], lengths and terminated
    [num_trials]. As in `td_errors`, nothing is worth anything after the step that terminates an episode.
    """
    steps = np.arange(len(influence))[:, None]
    goes_on = (steps < lengths - 1) | ~terminated
    return gamma * (influence * (goes_on[:, :, None] * worth[1:])[:, :, None]).sum(3)


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the critics, the counts and the log of all episodes."""
    torch.set_num_threads(1)
    args, env = resolve(args)
    world, num_agents = env.world, env.world.num_agents
    seeds = [np.random.SeedSequence(args.seed + k).spawn(3) for k in range(args.num_trials)]
    init, act, _ = [[np.random.default_rng(seed) for seed in stream] for stream in zip(*seeds, strict=True)]

    policy = Policy(init, num_agents, [world.obs_dim, *args.hidden, world.num_actions])
    optimizer = StackedOptimizer(policy.params, args.optimizer, args.learning_rate)
    critic = StackedMLP(init, 3 * num_agents, [world.obs_dim, *args.hidden, 1])  # all agents' V, then their V^ext, then V^int
    critic_optimizer = StackedOptimizer(critic.params, "adam", args.critic_learning_rate)
    transitions = TransitionCounts(args.num_trials, args.table_size)
    eta = args.eta * LARGEST_REWARD[args.env] / 1000  # in units of reward
    rollout = Rollout(env)
    uniforms = np.empty((args.num_trials, world.max_steps, num_agents))
    arrays = [*policy.params, *optimizer.state, *critic.params, *critic_optimizer.state, *transitions.state]
    run = Run(args, env, arrays, generators=act, figures=("value", "td_error", "novelty", "influence", "table_fill"))

    for episode in run.episodes():
        # Play one episode of every trial.
        for generator, row in zip(act, uniforms, strict=True):
            generator.random(out=row)
        collect(env, policy, uniforms, rollout)
        lengths, longest = rollout.lengths, rollout.lengths.max()
        reward = np.repeat(rollout.reward[:longest, :, None], num_agents, axis=2) / REWARD_SCALE  # [T, num_trials, num_agents]

        # What is new to each agent, and whose next states it had influence on.
        novelty, influence = transitions.add(rollout)
        bonus = eta * novelty / REWARD_SCALE

        # The critics' values, before they learn from this episode.
        distinct, rows = map(torch.from_numpy, distinct_observations(rollout.obs[: longest + 1], lengths))
        distinct, rows = distinct.view(args.num_trials, num_agents, *distinct.shape[1:]), rows.permute(1, 2, 0)
        inputs, rows = (part[:, None].expand(-1, 3, *part.shape[1:]).flatten(0, 2) for part in (distinct, rows))
        values = critic(inputs)[:, :, 0].gather(1, rows).T  # [T + 1, num_critics]
        detached = values.detach().double().numpy()

        # The agents' augmented rewards, and the errors of all three values.
        shape = (-1, args.num_trials, 3, num_agents)
        worth = (detached.reshape(shape) * np.array([[0.0], [args.beta_ext], [args.beta_int]])).sum(2)
        terminated = rollout.outcomes > 0
        augmented = reward + bonus + influence_rewards(influence, worth, lengths, terminated, args.gamma)
        rewards = np.stack([augmented, reward, bonus], axis=2).reshape(longest, -1)  # [T, num_critics]
        of_critic = np.repeat(np.arange(args.num_trials), 3 * num_agents)  # each critic's trial
        delta = td_errors(rewards, detached, lengths[of_critic], terminated[of_critic], args.gamma)

        # Actors: climb along 1/T sum_t delta_i,t grad log pi_i(a_t | o_t), with the errors of V_i.
        advantage = delta.reshape(shape)[:, :, 0]  # [T, num_trials, num_agents]
        obs, weight = merge_steps(rollout.obs, rollout.actions, advantage / lengths[:, None], lengths, world.num_actions)
        log_probs = torch.log_softmax(policy(torch.from_numpy(obs)), dim=-1)
        loss = -(torch.from_numpy(weight) * log_probs).sum()
        optimizer.step(torch.autograd.grad(loss, policy.params))

        # Critics: descend 1/T sum_t (y_t - V(o_t))^2; beyond an episode's end y_t = V(o_t).
        targets = detached[:-1] + delta
        critic_loss = ((torch.from_numpy(targets) - values[:-1]) ** 2 / torch.from_numpy(lengths[of_critic])).sum()
        critic_optimizer.step(torch.autograd.grad(critic_loss, critic.params))

        played = np.arange(longest)[:, None, None] < lengths[:, None]
        mean_value = REWARD_SCALE * (detached.reshape(shape)[:-1, :, 0] * played).sum((0, 2)) / (num_agents * lengths)
        pairs = max(num_agents * (num_agents - 1), 1)
        run.record(
            episode,
            rollout,
            value=mean_value,
            td_error=REWARD_SCALE * np.sqrt((advantage**2).sum((0, 2)) / (num_agents * lengths)),
            novelty=eta * novelty.sum((0, 2)) / (num_agents * lengths),
            influence=influence.sum((0, 2, 3)) / (pairs * lengths),
            table_fill=transitions.filled / args.table_size,
        )
    run.finish(policy)
    return SimpleNamespace(policy=policy, critic=critic, transitions=transitions, log=run.log)


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
