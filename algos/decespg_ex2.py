"""DecESPG with the exemplar models EX2 in the place of the Gaussian process (Figure 6 of the paper), on the base of decespg.py.

1. Every agent keeps its pairs u = (o, a). A discriminator D(u*, u) learns to tell an exemplar u* of the episode from earlier
   pairs; at its optimum D(u, u) = 1 / (1 + p(u)), where p is the share of u among these, and the agent's reward becomes
   r' = r + beta EB(u) with EB(u) = -log p(u) = log D(u, u) / (1 - D(u, u)).
2. For every terminal state the team keeps its best episodes; their gradients are added to that of Eq. 14 (Eqs. 15-16).

Jiang & Amato, "Multi-Agent Reinforcement Learning with Directed Exploration and Selective Memory Reuse" (SAC 2021), which
gives no setting of EX2. The loss is that of Fu, Co-Reyes & Levine, "EX2: Exploration with Exemplar Models for Deep
Reinforcement Learning" (NIPS 2017), amortised over exemplars, and of the published code (jcoreyes/ex2): pairs with actions and
-log p as in its pointmass.py, kl_weight as in doom.py, min_replay as in atari.py. The first two fit 1000 times to 128
exemplars after every 4000 steps, at a step size of 1e-4, which would take most of the time here. So the networks are smaller,
and there is one fit to 32 exemplars for every 20 steps, at 1e-2. With so little fitting two encoders, as published, tell pairs
apart less well than one that reads both, and best if the classifier also sees the absolute difference of the codes' numbers.
The bonus lies in [0, 11.5], as D is clamped to [1/2, 1 - 1e-5]: below 1/2 it would be negative. Unlike there its median is not
subtracted.

    python algos/decespg_ex2.py --env pushbox --seed 3
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
from torch.nn.functional import softplus

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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/decespg_ex2.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=3e-4, beta=1e-3, slots=3),
    ("cleaner", "adam"): dict(learning_rate=3e-4, beta=1e-3, slots=3),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, beta=0.01, slots=10),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, beta=0.01, slots=10),
    ("gotogether", "sign"): dict(learning_rate=1e-3, beta=0.03, slots=10),
    ("gotogether", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=10),
    ("movebox", "sign"): dict(learning_rate=3e-4, beta=0.03, slots=3),
    ("movebox", "adam"): dict(learning_rate=3e-4, beta=3e-3, slots=3),
    ("pushbox", "sign"): dict(learning_rate=3e-4, beta=1.0, slots=10),
    ("pushbox", "adam"): dict(learning_rate=3e-4, beta=1.0, slots=10),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, beta=0.1, slots=10)  # what a world of your own gets
# Widths of the discriminators' hidden layers and of a code (published: 32 and 16 in doom.py, 16 and 8 in pointmass.py).
HIDDEN, CODE = 32, 8


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
    exemplar_learning_rate: Annotated[float, AtLeast(0)] = 1e-2
    """step size of the discriminators, which always have a persistent Adam (1e-4 in the published code, which fits more)"""
    kl_weight: Annotated[float, AtLeast(0)] = 0.001
    """weight of the codes' divergence from a standard normal in the discriminators' loss (as in the published doom.py)"""
    exemplars: Annotated[int, AtLeast(1)] = 32
    """exemplars in the batch of a fit; there are as many earlier pairs"""
    buffer_size: Annotated[int, AtLeast(1)] = 20_000
    """steps that are kept for replay"""
    steps_per_fit: Annotated[int, AtLeast(1)] = 20
    """steps of play for one fit of the discriminators (4 in the published pointmass.py)"""
    min_replay: Annotated[int, AtLeast(1)] = 1000
    """earlier steps without which the discriminators are not fitted and give no bonus (as in the published atari.py)"""
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


class ExemplarDiscriminator:
    """D(u*, u), the probability that u is the exemplar u* itself and not an earlier pair; side by side for all windows.

    One encoder gives the mean and the log variance of a normal code of each. A classifier reads both codes and the absolute
    difference of each of their numbers.
    """

    def __init__(self, generators, nets_per_trial, pair_dim):
        self.encoder = StackedMLP(generators, nets_per_trial, [pair_dim, HIDDEN, 2 * CODE])
        self.classifier = StackedMLP(generators, nets_per_trial, [3 * CODE, HIDDEN, 1])
        self.params = [*self.encoder.params, *self.classifier.params]
        for param in self.params:
            param.data *= 3**0.5  # from U(-1/sqrt(in), 1/sqrt(in)) to a variance of 1/in, so that codes differ from the start
        self.encoder.params[-1].data[..., CODE:] = -4.0  # the log variances: at first the noise does not hide the codes

    def compare(self, exemplar, other):
        """log D / (1 - D) of codes [num_nets, batch, CODE] each -> [num_nets, batch]."""
        return self.classifier(torch.cat([exemplar, other, (exemplar - other).abs()], dim=2))[..., 0]

    def losses(self, exemplars, earlier, noise):
        """Mean cross entropy of a batch, and mean divergence KL(N(mean, variance) || N(0, 1)) of both codes, [num_nets] each.

        Every exemplar is paired with itself and with an earlier pair; exemplars and earlier [num_nets, batch, pair_dim].
        noise [num_nets, 3 * batch, CODE], standard normal, is for the codes of the exemplars as u*, as u, and of the earlier.
        """
        first, other = self.encoder(torch.cat([exemplars, earlier], dim=1)).chunk(2, dim=1)
        mean, log_variance = torch.cat([first, first, other], dim=1).chunk(2, dim=2)
        deviation = (log_variance / 2).exp()
        exemplar, same, other = (mean + deviation * noise).chunk(3, dim=1)
        of_same, of_other = self.compare(exemplar, same), self.compare(exemplar, other)
        cross_entropy = (softplus(-of_same) + softplus(of_other)).mean(1) / 2  # -log D and -log(1 - D)
        divergence = 0.5 * (mean**2 + deviation**2 - 1 - log_variance).sum(2)
        exemplar, same, other = divergence.chunk(3, dim=1)
        return cross_entropy, (exemplar + (same + other) / 2).mean(1)

    @torch.no_grad()
    def surprise(self, pairs):
        """-log p(u) = log D(u, u) / (1 - D(u, u)) of pairs [num_nets, batch, pair_dim], from the means of the codes."""
        mean, _ = self.encoder(pairs).chunk(2, dim=2)
        return self.compare(mean, mean)


class ExemplarNovelty:
    """The exploration bonus of EX2: buffers of earlier pairs u = (o, a), and a discriminator for each."""

    def __init__(self, args, init, learn, num_windows, pair_dim):
        """init and learn are the generators of all trials: of the first weights, and of batches and noise."""
        self.args, self.learn = args, learn
        self.discriminator = ExemplarDiscriminator(init, num_windows, pair_dim)
        self.optimizer = MaskedAdam(self.discriminator.params, len(init), args.exemplar_learning_rate)
        self.buffer = np.zeros((len(init), num_windows, args.buffer_size, pair_dim), np.float32)  # visit n in row n mod size
        self.visits = np.zeros(len(init), np.int64)
        self.cross_entropy = np.full(len(init), np.log(2))  # mean of the last fits; before the first, that of D = 1/2
        self.state = [*self.discriminator.params, *self.optimizer.state, self.buffer, self.visits, self.cross_entropy]

    def bonus(self, pairs, lengths):
        """EB = -log p(u) of each pair u of an episode, [T, num_trials, num_windows]; first fit, then remember, then judge.

        It is 0 until the discriminators have been fitted, which takes `min_replay` earlier pairs. Also returns the mean cross
        entropy of the last fits and the share of pairs with D < 1/2, both [num_trials].
        """
        due = (self.visits + lengths) // self.args.steps_per_fit - self.visits // self.args.steps_per_fit
        self.fit(pairs, lengths, np.where(self.visits >= self.args.min_replay, due, 0))
        self.remember(pairs, lengths)
        steps, trials, windows, dim = pairs.shape
        nets_first = torch.from_numpy(pairs).permute(1, 2, 0, 3).reshape(trials * windows, steps, dim)
        surprise = self.discriminator.surprise(nets_first).double().numpy().reshape(trials, windows, steps).transpose(2, 0, 1)
        judged = ((np.arange(steps)[:, None] < lengths) & (self.optimizer.count > 0))[:, :, None]
        bonus = np.where(judged, surprise.clip(0, np.log(1e5 - 1)), 0.0)
        return bonus, self.cross_entropy, (judged & (surprise < 0)).sum((0, 2)) / (lengths * windows)

    def at(self, pairs):
        """EB of any pairs [num_trials, num_windows, n, pair_dim], which are not remembered -> [num_trials, num_windows, n]."""
        surprise = self.discriminator.surprise(torch.as_tensor(pairs, dtype=torch.float32).flatten(0, 1)).double().numpy()
        fitted = (self.optimizer.count > 0)[:, None, None]
        return np.where(fitted, surprise.clip(0, np.log(1e5 - 1)).reshape(pairs.shape[:3]), 0.0)

    def fit(self, pairs, lengths, fits):
        """Steps of Adam for the discriminators, in each trial as many as `fits` [num_trials] says."""
        total = np.zeros(len(fits))
        for number, (exemplars, earlier, noise) in enumerate(zip(*self.draw(pairs, lengths, fits), strict=True)):
            cross_entropy, divergence = self.discriminator.losses(exemplars, earlier, noise)
            loss = (cross_entropy + self.args.kl_weight * divergence).sum()
            self.optimizer.step(loss, number < fits)
            total += (number < fits) * cross_entropy.detach().numpy().reshape(len(fits), -1).mean(1)
        fitted = fits > 0
        self.cross_entropy[fitted] = total[fitted] / fits[fitted]

    def draw(self, pairs, lengths, fits):
        """The batches of all fits, drawn with each trial's own generator; 0 for a trial that has no more fits.

        -> exemplars of the episode and earlier pairs, both [most fits, num_nets, exemplars, pair_dim], and the noise of
        the codes [most fits, num_nets, 3 * exemplars, CODE]
        """
        trials, windows, size, dim = self.buffer.shape
        exemplars, earlier = np.zeros((2, fits.max(), trials, windows, self.args.exemplars, dim), np.float32)
        noise = np.zeros((fits.max(), trials, windows, 3 * self.args.exemplars, CODE), np.float32)
        each = np.arange(windows)[:, None]
        for k in np.flatnonzero(fits):
            drawn, own = (fits[k], windows, self.args.exemplars), np.s_[: fits[k], k]
            exemplars[own] = pairs[self.learn[k].integers(lengths[k], size=drawn), k, each]
            earlier[own] = self.buffer[k, each, self.learn[k].integers(min(self.visits[k], size), size=drawn)]
            noise[own] = self.learn[k].standard_normal(noise[own].shape, dtype=np.float32)
        return [torch.from_numpy(array).flatten(1, 2) for array in (exemplars, earlier, noise)]

    def remember(self, pairs, lengths):
        """Keep the pairs of an episode, in the place of the oldest."""
        for k, length in enumerate(lengths):
            rows = (self.visits[k] + np.arange(length)) % self.buffer.shape[2]
            self.buffer[k][:, rows] = pairs[:length, k].swapaxes(0, 1)
        self.visits += lengths


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


def build(args, world, init, learn=None):
    """All that learns or remembers, for all trials; init and learn are the generators of first weights and of batches."""
    pair_dim = world.num_actions + world.obs_dim
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        novelty=ExemplarNovelty(args, init, learn, world.num_agents, pair_dim),
        memory=SelectiveMemory(world, len(init), args.slots),
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, learn = generators_of(args)
    team = build(args, world, init, learn)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer], generators=[*act, *learn])
    one_hot = np.eye(world.num_actions, dtype=np.float32)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)

        # Augment each agent's reward with its own exploration bonus, Eq. 9, after fitting the models; remember the visits.
        pairs = np.concatenate([one_hot[rollout.actions], rollout.all_obs[:-1]], axis=3)  # each agent's u
        bonus, cross_entropy, overvisited = team.novelty.bonus(pairs, rollout.lengths)
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
        run.record(episode, rollout, policy_loss=loss, bonus=mean_bonus, cross_entropy=cross_entropy, overvisited=overvisited)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
