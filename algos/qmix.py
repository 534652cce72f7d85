"""QMIX: the team learns one value, a monotonic mix of what every agent says of its own action; on the base of dqn.py.

Every agent i has action values Q_i(o, a) of its own and acts epsilon-greedily on them, as in dqn.py. They need not be right by
themselves: a mixing network, which the global state s governs and which is there in training only, makes the team's value

    Q_tot = |w2(s)| . elu(q |W1(s)| + b1(s)) + V(s)      of q = (Q_1(o_1, a_1), .., Q_n(o_n, a_n)),

W1, b1, w2 linear in s and V a small network. No weight is negative, so Q_tot never falls as a Q_i rises, and the agents' own
best actions are the team's best. Along batches of old steps all networks descend

    (y - Q_tot)^2,      y = r + gamma Q'_tot(s', best a'), or y = r where the world has ended,       with Q'_tot an older copy

(Rashid et al., "QMIX: Monotonic Value Function Factorisation for Deep Multi-Agent Reinforcement Learning", ICML 2018: Eqs. 5
and 6, Section 4). `--mixer sum` is VDN: Q_tot = sum_i Q_i (Sunehag et al., "Value-Decomposition Networks For Cooperative
Multi-Agent Learning Based On Team Reward", AAMAS 2018). The time limit bootstraps, the end of the world does not.

Which a' is best, the learning networks say and not the older copies: double Q-learning (van Hasselt et al., AAAI 2016), as in
the authors' pymarl and unlike dqn.py. Values are too high at first even so, but with the copies' own largest value, which is
Eq. 6 to the letter, they are more so: in findtreasure, where an episode is worth 100, up to 570 instead of 310.

All scores are of play with epsilon, 0.05 in the end; that of greedy play is what `--evaluate policy.pt --greedy` says.

    python algos/qmix.py --env findtreasure --num-trials 20
"""

import sys
from copy import copy, deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

import numpy as np
import torch
from numba import njit

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from envs import Rollout, epsilon_greedy
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
# The tuning rule's choice for each world (benchmark/tuning/qmix.csv), guesses where it has no row yet; it is always Adam's.
TUNED = {
    ("cleaner", "adam"): dict(learning_rate=3e-4, exploration=0.2),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, exploration=0.2),
    ("gotogether", "adam"): dict(learning_rate=3e-3, exploration=0.2),
    ("movebox", "adam"): dict(learning_rate=3e-4, exploration=0.2),
    ("pushbox", "adam"): dict(learning_rate=1e-3, exploration=0.2),
    ("climbing", "adam"): dict(learning_rate=1e-3, exploration=0.2, replay_size=500, train_every=1),
    ("passage", "adam"): dict(learning_rate=3e-3, exploration=0.1),
}
# What a world of your own gets, and any world whose tables above lack it.
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, exploration=0.2, replay_size=20_000, train_every=4)
REWARD_SCALE = 10.0  # the networks learn from rewards divided by this, so from 0.3 to 10
MIXING_UNITS = 32  # hidden units of the mixing network, and of V (Rashid et al.)
FINAL_EPSILON = 0.05  # where the schedule of epsilon ends, and of saved teams


@dataclass
class Args(RunArgs):
    hidden: Annotated[tuple[int, ...] | None, AtLeast(1)] = None
    """widths of the hidden layers (None: Table 1; 64 in other worlds)"""
    gamma: Annotated[float | None, Between(0, 1)] = None
    """discount factor (None: Table 1; 0.99 in other worlds)"""
    learning_rate: Annotated[float | None, AtLeast(0)] = None
    """step size of the agents' networks (None: tuned, see TUNED; 0.001 in other worlds)"""
    exploration: Annotated[float | None, Between(1e-3, 1)] = None
    """share of the episodes over which epsilon falls linearly from 1 to 0.05 (None: tuned for the world; 0.2 in others)"""
    mixer: Literal["monotonic", "sum"] = "monotonic"
    """what makes the team's value of the agents': a monotonic network that the state governs (QMIX), or their sum (VDN)"""
    replay_size: Annotated[int | None, AtLeast(1)] = None
    """steps that are kept for replay (None: 500 in climbing, else 20000)"""
    batch_size: Annotated[int, AtLeast(1)] = 32
    """steps in the batch of an update (as in Mnih et al.)"""
    train_every: Annotated[int | None, AtLeast(1)] = None
    """steps for each update, made up for at the end of an episode (as in Mnih et al.; None: 1 in climbing, else 4)"""
    target_every: Annotated[int, AtLeast(1)] = 1000
    """steps between two copies of the networks into the target networks, made at the end of an episode"""


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


@njit(cache=True, error_model="numpy")  # which lets divisions be vectorised
def adam_step(param, grad, first, second, count, active, learning_rate):
    """One step of Adam, in place; param, grad and both moments [num_trials, num_weights], count and active [num_trials]."""
    real = param.dtype.type  # single precision stays single
    rate, tiny, weight1, weight2 = real(learning_rate), real(1e-8), real(0.1), real(0.001)
    for k in np.flatnonzero(active):
        correction1, correction2 = real(1 - 0.9 ** count[k]), real(1 - 0.999 ** count[k])
        for j in range(param.shape[1]):
            g = grad[k, j]
            first[k, j] += weight1 * (g - first[k, j])
            second[k, j] += weight2 * (g * g - second[k, j])
            param[k, j] -= rate * (first[k, j] / correction1) / (np.sqrt(second[k, j] / correction2) + tiny)


class MaskedAdam:
    """Adam (Kingma & Ba, 2015) where not all trials take every step: moments and the count of steps are each trial's own."""

    def __init__(self, params, num_trials, learning_rate):
        self.weights, self.learning_rate = params, learning_rate
        self.count = np.zeros(num_trials, np.int64)
        self.moments = [[np.zeros_like(param.detach().numpy()) for _ in range(2)] for param in params]
        self.state = [self.count, *(moment for moments in self.moments for moment in moments)]

    def step(self, loss, active):
        """One step down the gradient of a loss summed over trials, in the trials of the mask `active`, bool [num_trials]."""
        grads = torch.autograd.grad(loss, self.weights)
        self.count += active
        for param, grad, moments in zip(self.weights, grads, self.moments, strict=True):
            arrays = [array.reshape(len(active), -1) for array in (param.detach().numpy(), grad.numpy(), *moments)]
            adam_step(*arrays, self.count, active, self.learning_rate)


class MonotonicMixer:
    """The mixing network of every trial, whose weights are what hypernetworks make of the global state (Section 4)."""

    def __init__(self, generators, num_agents, state_dim):
        """The hypernetworks of W1, b1, w2 and of V's hidden layer stand side by side in one layer; then V's output."""
        sizes = [state_dim, (num_agents + 3) * MIXING_UNITS], [MIXING_UNITS, 1]
        self.params = [param for size in sizes for param in StackedMLP(generators, 1, size).params]

    def __call__(self, values, state):
        """Q_tot [num_trials, batch] of the agents' values [.., num_agents] and the global state [.., state_dim]."""
        weights, bias, value_weights, value_bias = self.params
        agents = values.shape[-1]
        made = torch.baddbmm(bias, state.to(bias.dtype), weights)
        first, shift, last, hidden = made.split([agents * MIXING_UNITS, *3 * [MIXING_UNITS]], dim=-1)
        mixed = (values[..., None] * first.abs().unflatten(-1, (agents, -1))).sum(-2)
        value = torch.baddbmm(value_bias, torch.relu(hidden), value_weights)[..., 0]  # V(s)
        return (torch.nn.functional.elu(mixed + shift) * last.abs()).sum(-1) + value


class SumMixer:
    """VDN: the team's value is the sum of the agents', and there is nothing to learn."""

    params = ()

    def __call__(self, values, state):
        """Q_tot [num_trials, batch] of the agents' values [.., num_agents]."""
        return values.sum(-1)


class ConcurrentReplay:
    """As in dqn.py, but a step is kept with the global state before and after it, and its reward is the team's."""

    def __init__(self, world, num_trials, size):
        sight, numbers = (np.float32, (world.num_agents, world.obs_dim)), (np.int64, (world.num_agents,))
        whole = (np.float32, (len(world.start),))
        fields = [("obs", *sight), ("actions", *numbers), ("next_obs", *sight), ("state", *whole), ("next_state", *whole)]
        fields += [("reward", "f4"), ("terminated", "f4")]
        self.steps = np.zeros((num_trials, size), np.dtype(fields, align=True))  # one record a step: a draw reads one place
        self.count = np.zeros(num_trials, np.int64)  # steps that each trial has taken
        self.state = [self.steps.view(np.uint8), self.count]

    def add(self, rollout):
        """Keep an episode of every trial, in the place of the oldest steps."""
        t, k = np.nonzero(rollout.played)
        steps = np.zeros(len(t), self.steps.dtype)
        steps["obs"], steps["next_obs"] = rollout.all_obs[t, k], rollout.all_obs[t + 1, k]
        global_state = rollout.global_state
        steps["state"], steps["next_state"] = global_state[t, k], global_state[t + 1, k]
        steps["actions"], steps["reward"] = rollout.actions[t, k], rollout.reward[t, k, 0] / REWARD_SCALE
        steps["terminated"] = (t == rollout.lengths[k] - 1) & rollout.terminated[k]  # not where the time limit cuts
        self.steps[k, (self.count[k] + t) % self.steps.shape[1]] = steps
        self.count += rollout.lengths

    def draw(self, generators, num_batches, batch_size):
        """Which steps are in the batches, uniformly, for num_batches [num_trials] in each trial and from its own generator.

        -> numbers of steps among those of all trials, [most batches, num_trials, batch_size]
        """
        trials, size = self.steps.shape
        drawn = np.zeros((num_batches.max(), trials, batch_size), np.int64)
        for k, generator in enumerate(generators):
            drawn[: num_batches[k], k] = generator.integers(min(self.count[k], size), size=(num_batches[k], batch_size))
        return drawn + size * np.arange(trials)[:, None]

    def batch(self, drawn):
        """The drawn steps [num_trials, batch_size] of some trials: observations, actions and next observations for each of
        their networks, [num_nets, batch_size, ..], and states, next states, rewards and ends as drawn.
        """
        steps = self.steps.take(drawn)
        private = [torch.from_numpy(steps[name]).transpose(1, 2).flatten(0, 1) for name in ("obs", "actions", "next_obs")]
        return *private, *(torch.from_numpy(steps[name]) for name in ("state", "next_state", "reward", "terminated"))


def some_of(network, nets):
    """Some of the networks that stand side by side, as a network; `nets` is a mask."""
    part = copy(network)
    part.params = [param[nets] for param in network.params]
    return part


def of_team(values, num_trials):
    """What the agents say, [num_nets, batch], for each team: [num_trials, batch, num_agents]."""
    return values.unflatten(0, (num_trials, -1)).transpose(1, 2)


def squared_td_errors(policy, mixer, target, target_mixer, batch, gamma):
    """As in dqn.py, but of Q_tot, with y = r + gamma Q'_tot(s', a') for the a' that are best by Q_i (Eq. 6, with double Q)."""
    obs, actions, next_obs, state, next_state, reward, terminated = batch
    with torch.no_grad():
        best = policy(next_obs).argmax(-1, keepdim=True)
        following = of_team(target(next_obs).gather(-1, best)[..., 0], len(state))
        y = reward + gamma * (1 - terminated) * target_mixer(following, next_state)
    taken = of_team(policy(obs).gather(-1, actions[..., None])[..., 0], len(state))
    return (y - mixer(taken, state)).square()


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    policy = StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions])  # observations to Q(o, .)
    policy.head, policy.parameter = epsilon_greedy, FINAL_EPSILON  # how a saved team plays
    mixer = SumMixer() if args.mixer == "sum" else MonotonicMixer(init, world.num_agents, len(world.start))
    optimizer = MaskedAdam([*policy.params, *mixer.params], len(init), args.learning_rate)
    replay = ConcurrentReplay(world, len(init), args.replay_size)
    targets = dict(target=deepcopy(policy), target_mixer=deepcopy(mixer))
    return SimpleNamespace(policy=policy, mixer=mixer, **targets, optimizer=optimizer, replay=replay)


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, learn = generators_of(args)
    team = build(args, world, init)
    rollout = Rollout(world, args.num_trials, head=epsilon_greedy)
    run = Run(args, world, team, generators=[*act, *learn])

    for episode in run.episodes():
        epsilon = 1 - (1 - FINAL_EPSILON) * min(episode / (args.exploration * args.num_episodes), 1)
        rollout.play(team.policy.params, act, epsilon)

        # Keep its steps, and draw the batches that are due, which depend on nothing but a trial's own steps.
        before = team.replay.count.copy()
        team.replay.add(rollout)
        due = team.replay.count // args.train_every - before // args.train_every  # [num_trials]
        batches = team.replay.draw(learn, due, args.batch_size)

        # Descend the mean of (y - Q_tot)^2 over each batch, in the trials that have updates left.
        for update, drawn in enumerate(batches):
            active = due > update
            trials, nets = [slice(None)] * 2 if active.all() else (active, active.repeat(world.num_agents))
            policy, target = some_of(team.policy, nets), some_of(team.target, nets)
            mixer, target_mixer = some_of(team.mixer, trials), some_of(team.target_mixer, trials)
            batch = team.replay.batch(drawn[active])
            loss = squared_td_errors(policy, mixer, target, target_mixer, batch, args.gamma).mean(1).sum()
            team.optimizer.step(loss, active)

        # Bring the target networks up to date in the trials where it is time.
        stale = team.replay.count // args.target_every > before // args.target_every
        for old, new in zip([*team.target.params, *team.target_mixer.params], team.optimizer.weights, strict=True):
            nets = stale.repeat(len(new) // args.num_trials)
            old.data[nets] = new.detach()[nets]

        with torch.no_grad():  # what the team expects of an episode, in units of reward
            start = team.policy(rollout.all_obs[0].reshape(args.num_trials * world.num_agents, 1, -1)).amax(-1)
            value = team.mixer(of_team(start, args.num_trials), torch.from_numpy(rollout.global_state[0])[:, None])
        value = REWARD_SCALE * value[:, 0].numpy()
        run.record(episode, rollout, epsilon=np.full(args.num_trials, epsilon), value=value)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
