"""GASIL: DecESPG with generative adversarial self-imitation in the place of the selective memory, on the base of decespg.py.

1. Every agent has decespg.py's private exploration bonus (--beta 0: plain GASIL).
2. The team keeps its best episodes. Every agent's discriminator D(o, a) learns to tell their steps (label 0.9) from those of
   the current episode (label 0), and the agent's reward becomes r' = r + beta EB(u) + lambda_im r_im, where
   r_im = clip(-log(1 - clip(D, 0.01, 0.99)) + log 1/2, -1/2, 3/2)
   is positive for what good episodes do over 1.25 times as often as the current one, and else negative.

Hao et al., "Independent Generative Adversarial Self-Imitation Learning in Cooperative Multiagent Systems" (AAMAS 2019). Labels,
r_im, the curve of lambda_im, the number of good episodes, without which nobody imitates, and D's layers, Adam (0.5, 0.9) and
clipped gradients are those of its code, which trains deterministic policies with critics for 140 000 episodes
(github.com/tjuHaoXiaotian/GASIL). Here policies draw their actions and learn from the episode that they have just played,
never from stored actions, as in Guo et al., "Generative Adversarial Self-Imitation Learning" (2018). What else differs:
- Good is a high discounted return, as for decespg.py's memory: the undiscounted one does not prefer a shorter way. Stored
  episodes do not age (in the code their return falls by 0.01 in every episode, which belongs to its scale of reward): these
  worlds are deterministic, so a success is never luck.
- Episodes are kept, and their steps drawn, for the team: all agents' discriminators see the same good steps.
- D has an output for each action, ReLU and no layer normalisation. After each episode it makes one step of Adam, on this
  episode where the code takes its last 32. The code's second task, to tell stored actions from the policy's own in the same
  observations, is left out. All steps weigh the same, as in the code once its weight kappa has reached 1.
As in the code, whole episodes are kept; the paper's sub-curriculum is left out.

    python algos/gasil.py --env pushbox --seed 3
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/gasil.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-3, beta=0.01, lambda_im=0.3, rise=430),
    ("cleaner", "adam"): dict(learning_rate=1e-3, beta=0.01, lambda_im=0.3, rise=430),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, beta=0.3, lambda_im=30.0, rise=215),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, beta=0.3, lambda_im=30.0, rise=215),
    ("gotogether", "sign"): dict(learning_rate=1e-3, beta=0.03, lambda_im=0.3, rise=215),
    ("gotogether", "adam"): dict(learning_rate=3e-3, beta=0.03, lambda_im=0.3, rise=215),
    ("movebox", "sign"): dict(learning_rate=1e-3, beta=0.3, lambda_im=3.0, rise=430),
    ("movebox", "adam"): dict(learning_rate=1e-3, beta=0.03, lambda_im=3.0, rise=430),
    ("pushbox", "sign"): dict(learning_rate=1e-3, beta=1.0, lambda_im=30.0, rise=430),
    ("pushbox", "adam"): dict(learning_rate=3e-3, beta=10.0, lambda_im=30.0, rise=430),
}
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, beta=0.1, lambda_im=1.0, rise=215)  # what a world of your own gets


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
    lambda_im: Annotated[float | None, AtLeast(0)] = None
    """final weight of the imitation reward, in units of reward (None: tuned for world and optimiser; 1 in other worlds)"""
    rise: Annotated[int | None, AtLeast(1)] = None
    """episodes in which lambda_im rises to its final weight (None: 430 where Table 1 has 20 000 episodes, else 215)"""
    good_episodes: Annotated[int, AtLeast(1)] = 32
    """best episodes that the team keeps, and how many it has before anybody imitates (Hao et al.)"""
    good_label: Annotated[float, Between(0, 1)] = 0.9
    """what the discriminators are to say to good steps, less than 1 so that they stay unsure (Hao et al.)"""
    good_batch: Annotated[int, AtLeast(1)] = 128
    """good steps from which the discriminators learn after each episode"""
    discriminator_hidden: Annotated[tuple[int, ...], AtLeast(1)] = (32, 32)
    """widths of the discriminators' hidden layers (Hao et al.)"""
    discriminator_learning_rate: Annotated[float, AtLeast(0)] = 3e-3
    """step size of the discriminators, which always have a persistent Adam (Hao et al.: 1e-3, but many more steps)"""


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


class GoodEpisodes:
    """The team's best episodes, whole and kept jointly."""

    def __init__(self, world, num_trials, size):
        shape = (num_trials, size)
        self.value = np.full(shape, -np.inf)  # the discounted return of the original reward
        self.number = np.zeros(shape, np.int64)  # of the episode
        self.lengths = np.zeros(shape, np.int64)
        self.obs = np.zeros((*shape, world.max_steps, world.num_agents, world.obs_dim), np.float32)
        self.actions = np.zeros((*shape, world.max_steps, world.num_agents), np.int64)
        self.state = [self.value, self.number, self.lengths, self.obs, self.actions]

    def remember(self, episode, rollout, value):
        """Keep each trial's episode, which has this number and value [num_trials], in the place of the worst if it is as good.

        Of equally bad ones the oldest goes, so that what good teams do now is there to imitate.
        """
        worst = np.lexsort((self.number, self.value))[:, 0]
        for k, (slot, length) in enumerate(zip(worst, rollout.lengths, strict=True)):
            if value[k] >= self.value[k, slot]:
                self.value[k, slot], self.number[k, slot], self.lengths[k, slot] = value[k], episode, length
                self.obs[k, slot, :length] = rollout.all_obs[:length, k]
                self.actions[k, slot, :length] = rollout.actions[:length, k]

    def draw(self, generators, num_steps):
        """Steps of the whole team, uniformly from all that are kept and with replacement, each trial's by its own generator.

        Returns obs [num_steps, num_trials, num_agents, obs_dim] and actions [num_steps, num_trials, num_agents].
        """
        ends, trials = self.lengths.cumsum(1), np.arange(len(self.lengths))  # the episodes of a trial, one after the other
        steps, slots = np.empty((2, num_steps, len(trials)), np.int64)
        for k, generator in enumerate(generators):
            steps[:, k] = generator.integers(ends[k, -1], size=num_steps)
            slots[:, k] = np.searchsorted(ends[k], steps[:, k], side="right")
        steps -= (ends - self.lengths)[trials, slots]
        return self.obs[trials, slots, steps], self.actions[trials, slots, steps]


def step_shares(obs, actions, lengths, num_actions):
    """The distinct observations of the first `lengths` steps, and which share of these steps did what in each.

    obs [T, num_trials, num_agents, obs_dim], actions [T, num_trials, num_agents], lengths [num_trials]
    -> [num_nets, U, obs_dim] and [num_nets, U, num_actions]
    """
    distinct, rows = distinct_rows(obs, lengths)
    t, k = np.nonzero(np.arange(len(rows))[:, None] < lengths)
    nets = np.arange(len(distinct)).reshape(rows.shape[1:])
    shares = np.zeros((*distinct.shape[:2], num_actions))
    np.add.at(shares, (nets[k], rows[t, k], actions[t, k]), 1 / lengths[k, None])
    return distinct, shares.astype(np.float32)


def imitation_reward(d):
    """r_im = -log(1 - D) + log 1/2, kept in [-1/2, 3/2]; 0 at D = 1/2, less where steps look alike (D = label / 2)."""
    return (np.log(0.5) - np.log(1 - np.clip(d, 0.01, 0.99))).clip(-0.5, 1.5)


class Discriminators:
    """Every agent's D(o, a): how likely it is that a good episode did a in o, and not the current one."""

    def __init__(self, init, world, hidden, learning_rate, good_label):
        # Observations to log D / (1 - D) of the actions.
        self.net = StackedMLP(init, world.num_agents, [world.obs_dim, *hidden, world.num_actions])
        self.params, self.good_label = self.net.params, good_label
        self.optimizer = torch.optim.Adam(self.params, lr=learning_rate, betas=(0.5, 0.9), fused=True)
        for param in self.params:  # no weight matrix or bias vector of any network gets a gradient of a norm above 1/2
            param.register_hook(lambda grad: grad.renorm(2, 0, 0.5))

    def learn(self, good, own):
        """One step towards telling good steps from own ones, both as `step_shares` gives them.

        Returns the mean D of the good and of the own steps before it, [num_nets] each.
        """
        logits = self.net(torch.from_numpy(np.concatenate([good[0], own[0]], axis=1)))  # [num_nets, U of both, num_actions]
        good_logits, own_logits = logits.split([good[0].shape[1], own[0].shape[1]], dim=1)
        good_share, own_share = torch.from_numpy(good[1]), torch.from_numpy(own[1])
        # For any label, -label log D - (1 - label) log(1 - D) = softplus(logit) - label logit.
        loss = (good_share * (softplus(good_logits) - self.good_label * good_logits)).sum()
        loss += (own_share * softplus(own_logits)).sum()
        update(self.optimizer, "adam", loss)
        return [
            (share * torch.sigmoid(logits.detach())).sum((1, 2)).numpy()
            for share, logits in ((good_share, good_logits), (own_share, own_logits))
        ]

    @torch.no_grad()
    def reward(self, rollout):
        """r_im of every step of an episode, [T, num_trials, num_agents]."""
        return imitation_reward(rollout.of_taken(torch.sigmoid(self.net(rollout.obs))).numpy())


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    pair_dim = world.num_actions + world.obs_dim
    sizes, learning_rate = args.discriminator_hidden, args.discriminator_learning_rate
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        novelty=VisitNovelty(len(init), world.num_agents, pair_dim, args.window, args.sigma * world.cell, args.noise),
        good=GoodEpisodes(world, len(init), args.good_episodes),
        discriminators=Discriminators(init, world, sizes, learning_rate, args.good_label),
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, learn = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    optimizers, generators = [optimizer, team.discriminators.optimizer], [*act, *learn]
    run = Run(args, world, team, optimizers=optimizers, generators=generators)
    one_hot = np.eye(world.num_actions, dtype=np.float32)
    batch = np.full(args.num_trials, args.good_batch)

    for episode in run.episodes():
        rollout.play(team.policy.params, act)

        # Augment each agent's reward with its own exploration bonus, Eq. 9, and remember the visits.
        pairs = np.concatenate([one_hot[rollout.actions], rollout.all_obs[:-1]], axis=3)  # each agent's u
        bonus, unvisited, overvisited = team.novelty.bonus(pairs, rollout.lengths)  # [T, num_trials, num_agents]
        augmented = rollout.reward + args.beta * bonus

        # Keep the good episodes, by the original reward.
        team.good.remember(episode, rollout, discounted_returns(rollout.reward, rollout.lengths, args.gamma)[0, :, 0])
        d_good = d_own = np.full(args.num_trials, 0.5)
        if episode + 1 >= args.good_episodes:  # all their places are taken
            # Learn to tell their steps from those of this episode.
            own_steps = step_shares(rollout.all_obs, rollout.actions, rollout.lengths, world.num_actions)
            good_steps = step_shares(*team.good.draw(learn, args.good_batch), batch, world.num_actions)
            d_good, d_own = team.discriminators.learn(good_steps, own_steps)

            # Augment each agent's reward with that for what looks like good episodes.
            lambda_im = args.lambda_im * np.exp(6 * min(0.0, episode / args.rise - 1))
            augmented += lambda_im * team.discriminators.reward(rollout)

        # Climb along 1/T sum_t G_t grad log pi(a_t | o_t), Eq. 14.
        returns = discounted_returns(augmented, rollout.lengths, args.gamma)
        weights = torch.from_numpy(returns / rollout.lengths[:, None])  # [T, num_trials, num_agents]
        log_probs = torch.log_softmax(team.policy(rollout.obs), dim=-1)  # of each distinct observation, once
        loss = -(weights * rollout.of_taken(log_probs)).sum((0, 2))  # [num_trials]
        update(optimizer, args.optimizer, loss.sum())

        d_good, d_own = (d.reshape(args.num_trials, -1).mean(1) for d in (d_good, d_own))
        mean_bonus = bonus.sum((0, 2)) / (rollout.lengths * bonus.shape[2])
        figures = dict(bonus=mean_bonus, unvisited=unvisited, overvisited=overvisited, d_good=d_good, d_own=d_own)
        run.record(episode, rollout, policy_loss=loss, **figures)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
