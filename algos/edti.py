"""EDTI: exploration via decision-theoretic influence with counts (Wang et al., ICLR 2020), on the base of ac.py.

Agent i's reward grows by what is new to itself, by what the others gain now, and by what its presence is worth to them where
they go next:

    rhat_i = r + u_i + sum_{j != i} [share_ext r + share_int u_j + gamma c_ij (beta_ext V_j^ext(o_j') + beta_int V_j^int(o_j'))]
    with u_i = eta / sqrt(N(x_i') + 1) and c_ij = 1 - p(x_j' | x_-i, a_-i) / p(x_j' | x, a).

x_i is agent i's local state (its place and facing, and the boxes), N and p are counts, a prime marks what follows a step, and
-i means all agents but i. Every agent learns like ac.py's, but from generalised advantages, and from three values of its own
observation: V_i of rhat_i, which its actor needs, V_i^ext of r, V_i^int of u_i. ac.py's critic of the global state becomes
these, because what c_ij weighs is the value of o_j to agent j, and because the paper says of EDTI only that its agents are
local (Jiang & Amato, SAC 2021); it does not say on which learner EDTI ran.

rhat is that of the published code (TonghanWang/EITI-EDTI, Curiosity.py and ppo2/runner.py: count-based probabilities and the
option --r_tv, which README.md says is EDTI). The weights are those of README.txt's command for the task Pass; those of the
paper's Table 2 were not to be had. It names the shares, too, though it runs --tv, which leaves them out. Without shares, with
these and with share_int 1 five teams of an earlier version, with one-step errors, ended in findtreasure at 5.4, 6.5 and 7.0
(sign) or 6.9, 4.5 and 7.3 (adam), each +- 1 to 2. share_ext only makes r count more, because r is the team's. The reward of
Pass is 1000 and u adds to r, so eta is scaled by the world's largest reward / 1000. The other weights are not: they and c have
no unit, and V^ext and V^int have that of r and u. Unlike there, nothing follows the step that terminates an episode, and PPO
gives way to ac.py's update.

    python algos/edti.py --env pushbox --num-trials 20
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
# The tuning rule's choice for each world and optimiser (benchmark/tuning/edti.csv); guesses where it has no row yet.
TUNED = {
    ("cleaner", "sign"): dict(learning_rate=1e-4, critic_learning_rate=3e-3, eta=10.0),
    ("cleaner", "adam"): dict(learning_rate=3e-4, critic_learning_rate=3e-3, eta=10.0),
    ("findtreasure", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=30.0),
    ("findtreasure", "adam"): dict(learning_rate=3e-3, critic_learning_rate=3e-3, eta=10.0),
    ("gotogether", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=3.0),
    ("gotogether", "adam"): dict(learning_rate=3e-3, critic_learning_rate=3e-3, eta=10.0),
    ("movebox", "sign"): dict(learning_rate=1e-4, critic_learning_rate=3e-3, eta=0.1, beta_ext=0.001, beta_int=0.01),
    ("movebox", "adam"): dict(learning_rate=3e-4, critic_learning_rate=3e-3, eta=0.3, beta_ext=0.001, beta_int=0.01),
    ("pushbox", "sign"): dict(learning_rate=1e-3, critic_learning_rate=3e-3, eta=30.0),
    ("pushbox", "adam"): dict(learning_rate=3e-3, critic_learning_rate=3e-3, eta=10.0),
    ("climbing", "sign"): dict(learning_rate=1e-3, eta=3.0),
    ("climbing", "adam"): dict(learning_rate=3e-3, eta=3.0),
    ("passage", "sign"): dict(learning_rate=1e-3, eta=30.0),
    ("passage", "adam"): dict(learning_rate=3e-3, eta=3.0),
    ("secretroom", "sign"): dict(learning_rate=1e-3, eta=10.0),
    ("secretroom", "adam"): dict(learning_rate=3e-3, eta=30.0),
}
# What a world of your own gets, and any world whose tables above lack it.
OTHER = dict(hidden=(64,), gamma=0.99, learning_rate=1e-3, critic_learning_rate=3e-3, eta=10.0, beta_ext=0.1, beta_int=1.0)
REWARD_SCALE = 10.0  # the critics learn from rewards divided by this, so from 0.3 to 10; their curves are in units of reward


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
    gae_lambda: Annotated[float, Between(0, 1)] = 0.95
    """lambda of the advantages: 0 looks one step ahead, 1 to the end of the episode (Schulman et al., 2016)"""
    eta: Annotated[float | None, AtLeast(0)] = None
    """weight of the novelty u, in thousandths of the world's largest reward (None: tuned for world and optimiser, else 10)"""
    share_ext: Annotated[float, AtLeast(0)] = 0.1
    """weight of the others' rewards (the published code's)"""
    share_int: Annotated[float, AtLeast(0)] = 0.1
    """weight of the others' novelty (the published code's)"""
    beta_ext: Annotated[float | None, AtLeast(0)] = None
    """weight of the influence on the others' values V^ext of reward (published code's; None: 0.001 in movebox, else 0.1)"""
    beta_int: Annotated[float | None, AtLeast(0)] = None
    """weight of the influence on the others' values V^int of novelty (published code's; None: 0.01 in movebox, else 1)"""
    table_size: Annotated[int, AtLeast(8)] = 2**19
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
def discounted_errors(delta, decay):
    """A_t = delta_t + decay A_{t+1}; with decay = gamma lambda these are generalised advantages (Schulman et al., 2016).

    delta [T, num_critics], 0 beyond an episode's end -> shaped as delta.
    """
    advantages = delta.copy()
    for t in range(len(delta) - 2, -1, -1):
        advantages[t] += decay * advantages[t + 1]
    return advantages


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
        return count_transitions(rollout.local_state, rollout.actions, rollout.lengths, *self.state)


def influence_rewards(shared, influence, worth, lengths, terminated, gamma):
    """sum_{j != i} (s_j + gamma c_ij w_j(o_j')) of every step and agent i, [T, num_trials, num_agents].

    shared s [T, num_trials, num_agents], influence c [T, num_trials, num_agents, num_agents], worth w [T + 1, num_trials,
    num_agents], lengths and terminated [num_trials]. As in `td_errors`, nothing is worth anything after the step that
    terminates an episode.
    """
    steps, others = np.arange(len(influence))[:, None], 1 - np.eye(influence.shape[2])
    goes_on = (steps < lengths - 1) | ~terminated
    return shared @ others + gamma * (influence * (goes_on[:, :, None] * worth[1:])[:, :, None]).sum(3)


def build(args, world, init):
    """All that learns or remembers, for all trials; `init` are the generators of the first weights."""
    return SimpleNamespace(
        policy=StackedMLP(init, world.num_agents, [world.obs_dim, *args.hidden, world.num_actions]),
        critic=StackedMLP(init, 3 * world.num_agents, [world.obs_dim, *args.hidden, 1]),  # all V_i, then V_i^ext, then V_i^int
        transitions=TransitionCounts(len(init), args.table_size),
    )


def train(args: Args):
    """Train `num_trials` teams side by side; returns the policies, the method's parts and the log of all episodes."""
    args, world = resolve(args, WORLDS, TUNED, OTHER)
    init, act, _ = generators_of(args)
    team = build(args, world, init)
    optimizer = torch.optim.Adam(team.policy.params, lr=args.learning_rate, fused=True)
    critic_optimizer = torch.optim.Adam(team.critic.params, lr=args.critic_learning_rate, fused=True)
    rollout = Rollout(world, args.num_trials)
    run = Run(args, world, team, optimizers=[optimizer, critic_optimizer], generators=act)
    trials, agents = args.num_trials, world.num_agents
    eta = args.eta * world.largest_reward / 1000  # in units of reward
    of_critic = np.repeat(np.arange(trials), 3 * agents)  # each critic's trial

    for episode in run.episodes():
        rollout.play(team.policy.params, act)
        lengths, terminated = rollout.lengths, rollout.terminated

        # What is new to each agent, and whose next states it had influence on.
        novelty, influence = team.transitions.add(rollout)
        reward, bonus = rollout.reward / REWARD_SCALE, eta * novelty / REWARD_SCALE  # [T, num_trials, num_agents]

        # The critics' values, before they learn from this episode.
        distinct, rows = distinct_rows(rollout.all_obs, lengths + 1)
        inputs = np.tile(distinct.reshape(trials, agents, *distinct.shape[1:]), (1, 3, 1, 1)).reshape(-1, *distinct.shape[1:])
        values = in_every_step(team.critic(inputs), np.tile(rows, 3))[..., 0].flatten(1)  # [T + 1, num_critics]
        detached = values.detach().double().numpy()

        # The agents' augmented rewards, and the generalised advantages of all three values.
        of_kind = detached.reshape(-1, trials, 3, agents)
        worth = (of_kind * np.array([[0.0], [args.beta_ext], [args.beta_int]])).sum(2)
        shared = args.share_ext * reward + args.share_int * bonus
        augmented = reward + bonus + influence_rewards(shared, influence, worth, lengths, terminated, args.gamma)
        rewards = np.stack([augmented, reward, bonus], axis=2).reshape(len(reward), -1)  # [T, num_critics]
        delta = td_errors(rewards, detached, lengths[of_critic], terminated[of_critic], args.gamma)
        advantages = discounted_errors(delta, args.gamma * args.gae_lambda)

        # Actors: climb along 1/T sum_t A_i,t grad log pi_i(a_t | o_t), with the advantages of V_i.
        advantage = advantages.reshape(-1, trials, 3, agents)[:, :, 0]  # [T, num_trials, num_agents]
        error = delta.reshape(-1, trials, 3, agents)[:, :, 0]
        weights = torch.from_numpy(advantage / lengths[:, None])
        log_probs = torch.log_softmax(team.policy(rollout.obs), dim=-1)  # of each distinct observation, once
        loss = -(weights * rollout.of_taken(log_probs)).sum((0, 2))  # [num_trials]
        update(optimizer, args.optimizer, loss.sum())

        # Critics: descend 1/T sum_t (y_t - V(o_t))^2; beyond an episode's end y_t = V(o_t).
        targets = torch.from_numpy(detached[:-1] + advantages)
        critic_loss = ((targets - values[:-1]) ** 2 / torch.from_numpy(lengths[of_critic])).sum()
        update(critic_optimizer, "adam", critic_loss)

        steps = agents * lengths
        figures = dict(
            value=REWARD_SCALE * (of_kind[:-1, :, 0] * rollout.played[:, :, None]).sum((0, 2)) / steps,
            td_error=REWARD_SCALE * np.sqrt((error**2).sum((0, 2)) / steps),
            novelty=eta * novelty.sum((0, 2)) / steps,
            influence=influence.sum((0, 2, 3)) / (max(agents - 1, 1) * steps),
            table_fill=team.transitions.filled / args.table_size,
        )
        run.record(episode, rollout, policy_loss=loss, **figures)
    return run.finish()


if __name__ == "__main__":
    main(Args, build, train)
