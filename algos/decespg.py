"""DecESPG: REINFORCE with private exploration bonuses and a selective memory (Algorithm 1 of the paper), on the base of pg.py.

1. Every agent remembers its last m pairs u = (o, a). A Gaussian process says how much a new pair has been visited, eta(u) in
   (0, 1] (Eqs. 5-7), and the agent's reward becomes r' = r + beta EB(u) with EB(u) = -log eta(u) (Eqs. 8-9).
2. For every terminal state the team keeps its best episodes; their gradients are added to that of Eq. 14 (Eqs. 15-16).

Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed Exploration and Selective Memory Reuse" (SAC 2021).

    python algos/decespg.py --env pushbox --seed 3
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
from envs import Rollout, distinct_rows
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/decespg.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=3e-4, beta=0.01, slots=3),
    ("cleaner", "adam"): dict(learning_rate=3e-3, beta=0.01, slots=3),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, beta=0.3, slots=10),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, beta=0.3, slots=10),
    ("gotogether", "sign"): dict(learning_rate=1e-3, beta=0.03, slots=10),
    ("gotogether", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=10),
    ("movebox", "sign"): dict(learning_rate=3e-4, beta=0.3, slots=3),
    ("movebox", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=3),
    ("pushbox", "sign"): dict(learning_rate=1e-4, beta=1.0, slots=10),
    ("pushbox", "adam"): dict(learning_rate=3e-4, beta=10.0, slots=10),
    ("climbing", "sign"): dict(learning_rate=1e-3, beta=0.3, slots=10),
    ("climbing", "adam"): dict(learning_rate=3e-3, beta=0.3, slots=10),
    ("passage", "sign"): dict(learning_rate=1e-3, beta=0.03, slots=10),
    ("passage", "adam"): dict(learning_rate=3e-3, beta=0.3, slots=10),
    ("secretroom", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("secretroom", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=10),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, beta=0.1, slots=10)  # what a world of your own gets


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
    beta: Annotated[float | None, AtLeast(0)] = None
    """weight of the exploration bonus, in units of reward (Eq. 9; None: see TUNED; 0.1 in other worlds)"""
    window: Annotated[int, AtLeast(1)] = 50
    """visits that are remembered (m of Section 3.1.4)"""
    sigma: Annotated[float, AtLeast(1e-3)] = 0.5
    """width of the kernel (sigma of Eq. 5), in cells where agents observe positions, else in units of the observation"""
    noise: Annotated[float, AtLeast(1e-6)] = 0.01
    """variance of the noise (sigma_epsilon^2 of Eq. 7); n visits to an isolated pair give eta = n / (n + noise)"""
    slots: Annotated[int | None, AtLeast(0)] = None
    """episodes kept for each terminal state, 0: none (None: tuned in spg.py, in others 3 in cleaner and movebox, else 10)"""


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


@njit(cache=True)
def slide_inverse(inverse, product, kernel, slot, full, diagonal):
    """Bring inverse = (K + noise I)^-1 [m, m] up to date, in place, when a new visit takes row `slot` of the ring.

    kernel [m] holds the new visit's kernel values (0 where nothing is remembered), product = inverse @ kernel, and diagonal is
    1 + noise; kernel and product are used up. Rows that nothing has taken yet are 0. Eqs. 12-13 number the rows from the oldest
    to the newest; in a ring the newest takes the row of the oldest.
    """
    m = len(kernel)
    # B = H - f f^T / e (Eq. 13) is the inverse without the visit that stood in `slot`: its row is [.., e, ..] with f around e.
    # Before the ring is full nothing stood there: its row is 0, B is the old inverse, and what follows is Eq. 11, whose
    # vector e is B h here and whose scalar g is s.
    row, per_e = inverse[slot].copy(), 1.0 / inverse[slot, slot] if full else 0.0
    for c in range(m):
        product[c] -= kernel[slot] * row[c]
    kernel[slot] = 0.0  # kernel is h now
    projection = product[slot] * per_e
    s = diagonal
    for c in range(m):
        product[c] -= projection * row[c]  # product becomes B h
        s -= kernel[c] * product[c]
    s = 1.0 / s
    # B + s (B h)(B h)^T, bordered by -s B h and s.
    for r in range(m):
        added, removed = s * product[r], per_e * row[r]
        if added != 0.0 or removed != 0.0:
            for c in range(m):
                inverse[r, c] += added * product[c] - removed * row[c]
    for c in range(m):
        inverse[slot, c] = inverse[c, slot] = -s * product[c]
    inverse[slot, slot] = s


@njit(cache=True)
def visit_counts(pairs, lengths, rings, inverses, visits, sigma, noise):
    """The bounded visit count eta of each pair u of an episode, which is then remembered; every window by itself.

    pairs [T, num_trials, num_windows, pair_dim], lengths [num_trials] -> eta [T, num_trials, num_windows], 1 beyond the
    episode's end. What is remembered stands in rings [num_trials, num_windows, pair_dim, m], visit number n in column n mod m,
    and in inverses [num_trials, num_windows, m, m]; visits [num_trials] counts them.
    """
    _, trials, windows, dim = pairs.shape
    m = rings.shape[3]
    eta = np.ones((len(pairs), trials, windows))
    kernel, product = np.empty(m), np.empty(m)
    for k in range(trials):
        for w in range(windows):
            ring, inverse = rings[k, w], inverses[k, w]
            for t in range(lengths[k]):
                visit = visits[k] + t
                # Eq. 5 with C = 1.
                kernel[:] = 0.0
                for d in range(dim):
                    value = np.float64(pairs[t, k, w, d])
                    for r in range(m):
                        kernel[r] += (value - ring[d, r]) ** 2
                for r in range(m):
                    near = r < visit and kernel[r] < 80.0 * sigma * sigma  # exp(-40) is nothing beside 1
                    kernel[r] = np.exp(-kernel[r] / (2.0 * sigma * sigma)) if near else 0.0

                # Eq. 7 with targets 1, because every remembered pair was visited: eta = kernel^T inverse 1.
                product[:] = 0.0
                for r in range(m):
                    if kernel[r] > 0.0:
                        for c in range(m):
                            product[c] += kernel[r] * inverse[r, c]
                eta[t, k, w] = product.sum()

                slot = visit % m
                slide_inverse(inverse, product, kernel, slot, visit >= m, 1.0 + noise)
                ring[:, slot] = pairs[t, k, w]
    for k in range(trials):
        visits[k] += lengths[k]
    return eta


class VisitNovelty:
    """The exploration bonus of Section 3.1: windows of the last m pairs u = (o, a), and a Gaussian process over each."""

    def __init__(self, num_trials, num_windows, pair_dim, window, sigma, noise):
        self.pairs = np.zeros((num_trials, num_windows, pair_dim, window))
        self.inverse = np.zeros((num_trials, num_windows, window, window))
        self.visits = np.zeros(num_trials, np.int64)
        self.sigma, self.noise = sigma, noise
        self.state = [self.pairs, self.inverse, self.visits]

    def bonus(self, pairs, lengths):
        """EB = -log eta of each pair u of an episode (Eq. 8), [T, num_trials, num_windows], and the shares of clamped ones.

        In the paper eta lies in (0, 1]; here it is clamped to [1e-3, 1], because a pair unlike all that is remembered has
        eta = 0 and a pair between several remembered ones may have eta > 1.
        """
        eta = visit_counts(pairs, lengths, *self.state, self.sigma, self.noise)
        visits = lengths * eta.shape[2]
        return -np.log(eta.clip(1e-3, 1)), (eta < 1e-3).sum((0, 2)) / visits, (eta > 1).sum((0, 2)) / visits

    def at(self, pairs):
        """EB of any pairs [num_trials, num_windows, n, pair_dim], which are not remembered -> [num_trials, num_windows, n]."""
        distance = ((pairs[:, :, :, :, None] - self.pairs[:, :, None]) ** 2).sum(3)  # [num_trials, num_windows, n, m]
        held = np.arange(distance.shape[3]) < self.visits[:, None, None, None]
        eta = (np.where(held, np.exp(-distance / (2 * self.sigma**2)), 0.0) @ self.inverse).sum(3)
        return -np.log(eta.clip(1e-3, 1))


class SelectiveMemory:
    """The best episodes of each terminal state (Section 3.2), kept jointly for the team, and their gradient."""

    def __init__(self, world, num_trials, slots):
        shape = (num_trials, len(world.outcome_names) + 1, slots)  # outcome 0, the time limit, is a terminal state too
        self.value = np.full(shape, -np.inf)  # Psi*, the discounted return of the original reward
        self.lengths = np.zeros(shape, np.int64)
        self.obs = np.zeros((*shape, world.max_steps, world.num_agents, world.obs_dim), np.float32)
        self.actions = np.zeros((*shape, world.max_steps, world.num_agents), np.int64)
        self.returns = np.zeros((*shape, world.max_steps))
        self.num_actions = world.num_actions
        self.state = [self.value, self.lengths, self.obs, self.actions, self.returns]
        self.replays = [None] * num_trials

    def remember(self, rollout, returns):
        """Keep each trial's episode if it is better than the worst one kept for its terminal state.

        returns [T, num_trials] are those of the original reward. An episode that is only as good as the worst does not replace
        it; of several that are equally bad, the one in the first slot goes.
        """
        for k, (outcome, length) in enumerate(zip(rollout.outcomes, rollout.lengths, strict=True)):
            values = self.value[k, outcome]
            if values.size and returns[0, k] > values.min():
                slot = k, outcome, values.argmin()
                self.value[slot], self.lengths[slot] = returns[0, k], length
                self.obs[slot][:length] = rollout.all_obs[:length, k]
                self.actions[slot][:length] = rollout.actions[:length, k]
                self.returns[slot][:length] = returns[:length, k]
                self.replays[k] = None

    def replay(self):
        """The second term of Eq. 16, sum_i w_i g_i with w_i = Psi*_i / sum_j Psi*_j, as weights of log pi(a | o).

        g_i = 1/T_i sum_t G*_t grad log pi(a*_t | o*_t) is Eq. 15. Only episodes of positive value are replayed, which Eq. 16
        does not say; but a sum that is 0 or negative defines no shares. Every distinct observation is there once:
        obs [num_nets, M, obs_dim], and the weights of all actions there [num_nets, M, num_actions].
        What is stored does not change, so the steps are merged again only when a better episode has come.
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
        """Trial k's part of `replay`: every step has the weight w_i G*_t / T_i."""
        value = np.where(self.value[k] > 0, self.value[k], 0.0)  # [outcomes, slots]
        scale = value / (value.sum() or 1.0) / np.maximum(self.lengths[k], 1)
        steps = np.arange(self.returns.shape[-1]) < (self.lengths[k] * (value > 0))[:, :, None]  # [outcomes, slots, max_steps]
        actions, weights = self.actions[k][steps], (scale[:, :, None] * self.returns[k])[steps]  # [N, num_agents], [N]
        obs, rows = distinct_rows(self.obs[k][steps][:, None], np.array([len(weights)]))  # rows [N, 1, num_agents]
        summed = np.zeros((*obs.shape[:2], self.num_actions))  # [num_agents, M, num_actions]
        np.add.at(summed, (np.arange(len(obs)), rows[:, 0], actions), weights[:, None])
        return obs, summed


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
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    pair_dim = world.num_actions + world.obs_dim
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        novelty=VisitNovelty(len(init), world.num_agents, pair_dim, args.window, args.sigma * world.cell, args.noise),
        memory=SelectiveMemory(world, len(init), args.slots),
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, _ = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer], generators=act)
    one_hot = np.eye(world.num_actions, dtype=np.float32)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)

        # Augment each agent's reward with its own exploration bonus, Eq. 9, and remember the visits.
        pairs = np.concatenate([one_hot[rollout.actions], rollout.all_obs[:-1]], axis=3)  # each agent's u
        bonus, unvisited, overvisited = team.novelty.bonus(pairs, rollout.lengths)  # [T, num_trials, num_agents]
        augmented = rollout.reward + args.beta * bonus

        # Update the selective memory, by the original reward.
        team.memory.remember(rollout, discounted_returns(rollout.reward, rollout.lengths, args.gamma)[:, :, 0])

        # Climb along 1/T sum_t G_t grad log pi(a_t | o_t), Eq. 14, and the memory's gradient, Eq. 16.
        returns = discounted_returns(augmented, rollout.lengths, args.gamma)
        weights = torch.from_numpy(returns / rollout.lengths[:, None])  # [T, num_trials, num_agents]
        memory_obs, memory_weights = team.memory.replay()
        log_probs = torch.log_softmax(team.policy(np.concatenate([rollout.obs, memory_obs], axis=1)), dim=-1)
        own, remembered = log_probs.split([rollout.obs.shape[1], memory_obs.shape[1]], dim=1)
        loss = -(weights * rollout.of_taken(own)).sum((0, 2))  # [num_trials]
        loss = loss - (torch.from_numpy(memory_weights) * remembered).view(args.num_trials, -1).sum(1)
        update(optimizer, args.optimizer, loss.sum())

        mean_bonus = bonus.sum((0, 2)) / (rollout.lengths * bonus.shape[2])
        run.record(episode, rollout, policy_loss=loss, bonus=mean_bonus, unvisited=unvisited, overvisited=overvisited)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
