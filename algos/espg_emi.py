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
  have been seen: one after each of the first 1000 episodes and one after every fifth of the others. A step of play is used
  about twice in findtreasure and pushbox and less where episodes are long, 0.2, 0.08 and 0.02 times in movebox, cleaner and
  gotogether. Minibatches by the step, so that each is used three times, changed little (see the method's page).
- These are fewer steps of Adam, so they are 0.003 long (there 0.001): under random play in findtreasure ||e||^2 comes to rest
  after 250 of them instead of 700, at the same value.
- w_S leaves S about 1 % of what phi and psi cannot say, so steps into a wall or a teammate go on to earn a bonus.

    python algos/espg_emi.py --env pushbox --seed 3
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/espg_emi.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=3e-4, beta=0.03, slots=3),
    ("cleaner", "adam"): dict(learning_rate=3e-4, beta=0.03, slots=3),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, beta=0.03, slots=10),
    ("gotogether", "sign"): dict(learning_rate=1e-3, beta=0.1, slots=10),
    ("gotogether", "adam"): dict(learning_rate=3e-3, beta=0.01, slots=10),
    ("movebox", "sign"): dict(learning_rate=3e-4, beta=0.3, slots=3),
    ("movebox", "adam"): dict(learning_rate=3e-4, beta=0.3, slots=3),
    ("pushbox", "sign"): dict(learning_rate=1e-4, beta=1.0, slots=10),
    ("pushbox", "adam"): dict(learning_rate=1e-3, beta=3.0, slots=10),
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
    embedding_learning_rate: Annotated[float, AtLeast(0)] = 3e-3
    """step size of the embeddings, which always have a persistent Adam"""
    embedding_batch: Annotated[int, AtLeast(2)] = 64
    """steps in a minibatch from which the embeddings learn; both halves of it have equally many"""
    recent_steps: Annotated[int, AtLeast(1)] = 4000
    """last steps of each trial, from which minibatches are drawn"""
    error_weight: Annotated[float, AtLeast(0)] = 100.0
    """w_S: a small one lets S(o, a) take over all prediction, a large one none of it (the published code's)"""
    information_weight: Annotated[float, AtLeast(0)] = 0.1
    """w_I of both bounds on the mutual information (the published code's)"""
    gaussian_weight: Annotated[float, AtLeast(0)] = 0.5
    """w_KL of the divergence of psi(a) from the unit Gaussian (the published code's)"""
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
    """Whether the model learns after an episode: always at first, while teams explore."""
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
        params = [param for net in (self.phi, self.psi, self.error, self.statistics) for param in net.params]
        self.optimizer = MaskedAdam(params, args.num_trials, args.embedding_learning_rate)
        self.pairs = np.zeros((args.num_trials, args.recent_steps, choice + sight), np.float32)
        self.next_obs = np.zeros((args.num_trials, args.recent_steps, sight), np.float32)
        self.visits = np.zeros(args.num_trials, np.int64)  # visit number n is in row n mod recent_steps
        self.figures = np.zeros((2, args.num_trials))  # what the last minibatch said of the model
        self.state = [*params, *self.optimizer.state, self.pairs, self.next_obs, self.visits, self.figures]

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
        self.optimizer.step(loss.sum(), self.visits >= size)
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
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        novelty=EmbeddingNovelty(world, args, init, learn),
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

        # Augment the reward with the team's exploration bonus, Eq. 9, the same for all agents, and let the model learn.
        pairs = np.concatenate([one_hot[rollout.actions], rollout.all_obs[:-1]], axis=3)
        pairs = pairs.reshape(*pairs.shape[:2], 1, -1)  # the team's u
        next_obs = rollout.all_obs[1:].reshape(*pairs.shape[:3], -1)
        bonus, unexplained, information = team.novelty.bonus(pairs, rollout.lengths, next_obs, learns_after(episode))
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
        run.record(episode, rollout, policy_loss=loss, bonus=mean_bonus, unexplained=unexplained, information=information)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
