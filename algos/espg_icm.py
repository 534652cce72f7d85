"""ESPG with ICM: espg.py whose Gaussian process gives way to an intrinsic curiosity module (Pathak et al., ICML 2017).

1. A central model of each step (o, a, o'), all joint, has features phi(o), an inverse model that says all agents' actions from
   phi(o) and phi(o'), and a forward model that foresees phi(o') from phi(o) and a. What it does not foresee is the bonus,
   b = 1/2 ||phihat(o') - phi(o')||^2, and the reward of all agents becomes r' = r + beta b (their eta is in beta).
2. For every terminal state the team keeps its best episodes; their gradients are added to that of Eq. 14 (Eqs. 15-16).

From the published code (pathak22/noreward-rl): b sums over the features, the forward loss weighs 0.2, its gradient flows also
through phi(o'), and the bonus comes before learning. Adam's 1e-3 is the paper's. There the module learns from every 20 steps,
here once from every episode. The rest is sized to worlds whose joint state is a handful of small numbers, not a picture: phi
has the policies' hidden layers (Table 1) and 32 features instead of 288, both models have 64 hidden units instead of 256. The
clipping of large gradients and the tenfold loss are left out, as Adam undoes most of both.

Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed Exploration and Selective Memory Reuse" (SAC 2021).

    python algos/espg_icm.py --env pushbox --seed 3
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/espg_icm.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-3, beta=0.03, slots=3),
    ("cleaner", "adam"): dict(learning_rate=1e-3, beta=0.3, slots=3),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, beta=1.0, slots=10),
    ("gotogether", "sign"): dict(learning_rate=1e-3, beta=1.0, slots=10),
    ("gotogether", "adam"): dict(learning_rate=3e-3, beta=1.0, slots=10),
    ("movebox", "sign"): dict(learning_rate=1e-3, beta=0.3, slots=3),
    ("movebox", "adam"): dict(learning_rate=1e-3, beta=0.1, slots=3),
    ("pushbox", "sign"): dict(learning_rate=1e-4, beta=1.0, slots=10),
    ("pushbox", "adam"): dict(learning_rate=3e-4, beta=1.0, slots=10),
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
    icm_learning_rate: Annotated[float, AtLeast(0)] = 1e-3
    """step size of the curiosity module, which always has a persistent Adam"""
    forward_weight: Annotated[float, Between(0, 1)] = 0.2
    """weight of the forward model's loss beside the inverse model's (beta in Eq. 7 of Pathak et al.), between 0 and 1"""
    features: Annotated[int, AtLeast(1)] = 32
    """features of a joint observation (the length of phi)"""
    icm_hidden: Annotated[tuple[int, ...], AtLeast(1)] = (64,)
    """widths of the hidden layers of the inverse and the forward model (those of phi: --hidden)"""
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


class IntrinsicCuriosity:
    """The bonus of Pathak et al. (2017; their Eqs. 2-7): what a central forward model fails to foresee of learnt features."""

    def __init__(self, generators, world, args):
        self.forward_weight, features = args.forward_weight, args.features
        self.actions_shape = (world.num_agents, world.num_actions)
        actions_dim = world.num_agents * world.num_actions
        self.encoder = StackedMLP(generators, 1, [world.num_agents * world.obs_dim, *args.hidden, features])
        self.inverse_model = StackedMLP(generators, 1, [2 * features, *args.icm_hidden, actions_dim])
        self.forward_model = StackedMLP(generators, 1, [features + actions_dim, *args.icm_hidden, features])
        self.params = [*self.encoder.params, *self.inverse_model.params, *self.forward_model.params]
        self.optimizer = torch.optim.Adam(self.params, lr=args.icm_learning_rate, fused=True)

    def bonus(self, pairs, lengths, seen):
        """1/2 ||phihat(o') - phi(o')||^2 of each step of an episode (Eq. 6), [T, num_trials, 1]; then learn from the episode.

        pairs [T, num_trials, 1, pair_dim] are the team's u = (a_1, o_1, .., a_n, o_n), of which a is needed, and seen [T + 1,
        num_trials, 1, num_agents * obs_dim] its observations, the one after the last step too. The second and third result
        [num_trials] are the inverse model's loss (n log A if it knows nothing) and its share of right guesses.
        """
        num_agents, num_actions = self.actions_shape
        pairs = torch.from_numpy(pairs).transpose(0, 1).reshape(len(lengths), -1, num_agents, pairs.shape[3] // num_agents)
        actions = pairs[..., :num_actions]  # one-hot a, [num_trials, T, num_agents, num_actions]
        joint_action = actions.flatten(2)
        distinct, rows = distinct_rows(seen, lengths + 1)
        phi = in_every_step(self.encoder(distinct), rows)[:, :, 0].transpose(0, 1)  # [num_trials, T + 1, features]
        phi, next_phi = phi[:, :-1], phi[:, 1:]

        # Eqs. 2-3: the inverse model, log p(a_i | phi(o), phi(o')) of each agent.
        logits = self.inverse_model(torch.cat([phi, next_phi], dim=2)).view(actions.shape)
        log_probs = torch.log_softmax(logits, dim=3)
        taken = (actions * log_probs).sum(3)  # [num_trials, T, num_agents]
        inverse_error = -taken.sum(2)
        # Eqs. 4-5: the forward model.
        foreseen = self.forward_model(torch.cat([phi, joint_action], dim=2))
        forward_error = 0.5 * ((foreseen - next_phi) ** 2).sum(2)

        # Eq. 7 but for the policies' part: descend the mean of both errors over the episode.
        played = (torch.arange(actions.shape[1]) < torch.from_numpy(lengths)[:, None]).double()  # [num_trials, T]
        share = played / torch.from_numpy(lengths)[:, None]
        loss = (share * ((1 - self.forward_weight) * inverse_error + self.forward_weight * forward_error)).sum()
        update(self.optimizer, "adam", loss)

        bonus = (played * forward_error.detach()).T[:, :, None].numpy()
        right = (taken == log_probs.amax(3)).double().mean(2)
        return bonus, (share * inverse_error.detach()).sum(1).numpy(), (share * right).sum(1).numpy()


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


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        curiosity=IntrinsicCuriosity(init, world, args),
        memory=SelectiveMemory(world, len(init), args.slots),
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, _ = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer, team.curiosity.optimizer], generators=act)
    one_hot = np.eye(world.num_actions, dtype=np.float32)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)

        # Augment the reward with the team's exploration bonus, Eq. 9, the same for all agents, and learn from the steps.
        pairs = np.concatenate([one_hot[rollout.actions], rollout.all_obs[:-1]], axis=3)
        pairs = pairs.reshape(*pairs.shape[:2], 1, -1)  # the team's u
        seen = rollout.all_obs.reshape(*rollout.all_obs.shape[:2], 1, -1)  # what the team saw
        bonus, inverse_loss, inverse_accuracy = team.curiosity.bonus(pairs, rollout.lengths, seen)  # bonus [T, num_trials, 1]
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
        figures = dict(bonus=mean_bonus, inverse_loss=inverse_loss, inverse_accuracy=inverse_accuracy)
        run.record(episode, rollout, policy_loss=loss, **figures)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
