"""Hysteretic DQN: as dqn.py, but agents learn less from disappointments, which may be a teammate's fault.

Every agent i learns action values Q_i(o, a) of its own, acts epsilon-greedily on them, and moves Q_i(o, a) along batches of old
steps (o, a, r, o') towards

    y = r + gamma max_a' Q'_i(o', a'), or y = r where the world has ended,          with Q'_i an older copy of Q_i

(Mnih et al., "Human-level control through deep reinforcement learning", Nature 2015). All agents of a team draw the same steps,
so that each learns beside what its teammates did then. With delta = y - Q_i(o, a), the step of Q_i(o, a) is not delta but

    max(h delta, delta), so h times as far where delta < 0,          with h in [0, 1]; h = 1 is dqn.py

(Matignon et al., "Hysteretic Q-Learning", IROS 2007, whose beta is h alpha; with networks and such a replay Omidshafiei et al.,
"Deep Decentralized Multi-task Multi-Agent Reinforcement Learning under Partial Observability", ICML 2017).
The time limit bootstraps, the end of the world does not. The copies Q' are timed by steps, because episodes become ten times as
short: with one every 200 episodes, teams in findtreasure often fell back into walking in circles.

All scores are of play with epsilon, 0.05 in the end; that of greedy play is what `--evaluate policy.pt --greedy` says.

    python algos/hysteretic.py --env findtreasure --num-trials 20
"""

import sys
from copy import copy, deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

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
# The tuning rule's choice (benchmark/tuning/hysteretic.csv), guesses where it has no row yet; exploration is that of dqn.py.
TUNED = {
    ("cleaner", "adam"): dict(learning_rate=3e-4, hysteresis=0.2, exploration=0.2),
    ("findtreasure", "adam"): dict(learning_rate=1e-3, hysteresis=0.4, exploration=0.1),
    ("gotogether", "adam"): dict(learning_rate=1e-3, hysteresis=0.2, exploration=0.5),
    ("movebox", "adam"): dict(learning_rate=3e-4, hysteresis=0.2, exploration=0.2),
    ("pushbox", "adam"): dict(learning_rate=3e-4, hysteresis=0.1, exploration=0.5),
    ("climbing", "adam"): dict(learning_rate=3e-3, hysteresis=0.1, exploration=0.2, replay_size=500, train_every=1),
    ("passage", "adam"): dict(learning_rate=1e-3, hysteresis=0.1, exploration=0.2),
    ("secretroom", "adam"): dict(learning_rate=1e-3, hysteresis=0.4, exploration=0.2),
}
# What a world of your own gets, and any world whose tables above lack it.
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, hysteresis=0.2, exploration=0.2, replay_size=20_000, train_every=4)
REWARD_SCALE = 10.0  # the networks learn from rewards divided by this, so from 0.3 to 10
FINAL_EPSILON = 0.05  # where the schedule of epsilon ends, and of saved teams


@dataclass
class Args(RunArgs):
    hidden: Annotated[tuple[int, ...] | None, AtLeast(1)] = None
    """widths of the hidden layers (None: Table 1; 64 in other worlds)"""
    gamma: Annotated[float | None, Between(0, 1)] = None
    """discount factor (None: Table 1; 0.99 in other worlds)"""
    learning_rate: Annotated[float | None, AtLeast(0)] = None
    """step size of the agents' networks (None: tuned, see TUNED; 0.001 in other worlds)"""
    hysteresis: Annotated[float | None, Between(0, 1)] = None
    """h, what is left of a step where the error is negative: 1 all, 0 nothing (None: tuned for the world; 0.2 in others)"""
    exploration: Annotated[float | None, Between(1e-3, 1)] = None
    """share of the episodes over which epsilon falls linearly from 1 to 0.05 (None: tuned for the world; 0.2 in others)"""
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


class ConcurrentReplay:
    """The last steps of every trial in a ring. A step is kept jointly, so what is drawn is the same step for all agents."""

    def __init__(self, world, num_trials, size):
        sight, numbers = (np.float32, (world.num_agents, world.obs_dim)), (np.int64, (world.num_agents,))
        fields = [("obs", *sight), ("actions", *numbers), ("reward", "f4"), ("next_obs", *sight), ("terminated", "f4")]
        self.steps = np.zeros((num_trials, size), np.dtype(fields, align=True))  # one record a step: a draw reads one place
        self.count = np.zeros(num_trials, np.int64)  # steps that each trial has taken
        self.state = [self.steps.view(np.uint8), self.count]

    def add(self, rollout):
        """Keep an episode of every trial, in the place of the oldest steps."""
        t, k = np.nonzero(rollout.played)
        steps = np.zeros(len(t), self.steps.dtype)
        steps["obs"], steps["next_obs"] = rollout.all_obs[t, k], rollout.all_obs[t + 1, k]
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
        """The drawn steps [num_trials, batch_size] of some trials for each of their networks, [num_nets, batch_size, ..]."""
        steps = self.steps.take(drawn)
        private = [torch.from_numpy(steps[name]).transpose(1, 2).flatten(0, 1) for name in ("obs", "actions", "next_obs")]
        agents = steps["actions"].shape[2]
        return *private, *(torch.from_numpy(steps[name].repeat(agents, axis=0)) for name in ("reward", "terminated"))


def some_of(network, nets):
    """Some of the networks that stand side by side, as a network; `nets` is a mask."""
    part = copy(network)
    part.params = [param[nets] for param in network.params]
    return part


def squared_td_errors(policy, target, batch, gamma, hysteresis):
    """As in dqn.py, but times h where delta = y - Q(o, a) is negative: half the slope in delta is max(h delta, delta)."""
    obs, actions, next_obs, reward, terminated = batch
    with torch.no_grad():
        y = reward + gamma * (1 - terminated) * target(next_obs).amax(-1)
    delta = y - policy(obs).gather(-1, actions[..., None])[..., 0]
    return torch.maximum(hysteresis * delta, delta) * delta


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    policy = StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions])  # observations to Q(o, .)
    policy.head, policy.parameter = epsilon_greedy, FINAL_EPSILON  # how a saved team plays
    optimizer = MaskedAdam(policy.params, len(init), args.learning_rate)
    replay = ConcurrentReplay(world, len(init), args.replay_size)
    return SimpleNamespace(policy=policy, target=deepcopy(policy), optimizer=optimizer, replay=replay)


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

        # Descend the mean of max(h delta, delta) delta over each batch, in the trials that have updates left.
        for update, drawn in enumerate(batches):
            active = due > update
            nets = active.repeat(world.num_agents) if not active.all() else slice(None)
            policy, target = some_of(team.policy, nets), some_of(team.target, nets)
            batch = team.replay.batch(drawn[active])
            loss = squared_td_errors(policy, target, batch, args.gamma, args.hysteresis).mean(1).sum()
            team.optimizer.step(loss, active)

        # Bring the target networks up to date in the trials where it is time.
        nets = (team.replay.count // args.target_every > before // args.target_every).repeat(world.num_agents)
        for old, new in zip(team.target.params, team.policy.params, strict=True):
            old.data[nets] = new.detach()[nets]

        with torch.no_grad():  # what the agents expect of an episode, in units of reward
            start = team.policy(rollout.all_obs[0].reshape(args.num_trials * world.num_agents, 1, -1))
        value = REWARD_SCALE * start.amax(-1).view(args.num_trials, -1).mean(1).numpy()
        run.record(episode, rollout, epsilon=np.full(args.num_trials, epsilon), value=value)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
