"""The exact optimum of a world, found in its compiled rules: every state it can reach, then dynamic programming over time.

Nothing here knows a world's numbers; what is found is what `world.step` says. The value of a state at time t is the largest
return with which it can be reached in exactly t steps; the steps that end the episode give the best by outcome and length. How
to play such an episode is found backwards: the value of a state is then the largest return that can still be had from it.
"""

import sys
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit
from tqdm import tqdm

from envs.base import UsageError, World, check_memory
from envs.statistics import reward_per_step

MAX_STATES, MAX_JOINT = 3_000_000, 10_000  # of states and of joint actions in each
MAX_STEPS = 100_000_000  # of states times joint actions: 1.2 GB
AT_ONCE = 10**8  # states times actions times steps between two looks of the bar and of Ctrl-C: under a second
PATIENCE = 2  # seconds without a bar
CHOICES = 25_000_000  # actions of states that a backward pass keeps at a time: 100 MB
ROUNDING = 1e-9  # returns that differ by less are the same sum, added up in another order


class Episode(NamedTuple):
    """What matters of one episode."""

    outcome: str  # how it ended: one of the world's outcome names, or "time limit"
    steps: int  # T, its number of steps
    total: float  # its undiscounted return
    per_step: float  # its reward per step: total / max(T - 1, 1)


@dataclass(frozen=True)
class Optimum:
    """The best that any team can do in a world.

    fewest:        for every outcome that max_steps leave time for, by name, the best of its shortest episodes
    best_return:   the episode with the largest undiscounted return, the shortest if there are several
    best_per_step: the episode with the largest reward per step, the shortest if there are several
    num_states:    number of states that play can reach (states in which the episode has ended not counted); None for a world
                   that is too large to search: its episode was constructed and played, and there may be better ones
    """

    fewest: dict[str, Episode]
    best_return: Episode
    best_per_step: Episode
    num_states: int | None

    def __str__(self):
        episodes = [("fewest steps", episode) for episode in self.fewest.values()]
        episodes += [("best return", self.best_return), ("best per step", self.best_per_step)]
        lines = [f"{'':15}{'outcome':15}{'steps':>5}{'return':>10}{'reward per step':>18}"]
        lines += [f"{what:15}{e.outcome:15}{e.steps:5}{e.total:10.4g}{e.per_step:18.4f}" for what, e in episodes]
        return "\n".join([*lines, f"{self.num_states} states" if self.num_states else "constructed and played, not searched"])


def find_optimum(world: World) -> Optimum:
    """The optimum of `world` within its max_steps; UsageError if it has too many states or actions or needs too much memory.

    Time and memory are about 10 s and 0.5 GB for a million states with 16 joint actions. Where a long time limit takes more
    than some seconds, a bar on stderr says how far it is. A world that says that it is not searchable gives the episode of its
    own `plan` instead.
    """
    table = 8 * (world.max_steps + 1) * max(len(world.outcome_names) + 1, world.num_agents)
    check_memory(f"a table of {world.max_steps} steps", 3 * table)
    if not world.searchable:
        return played_plan(world)
    _, following, reward = explored(world)
    returns = best_returns(following, reward, len(world.outcome_names), world.max_steps)
    per_step = reward_per_step(returns, np.arange(world.max_steps + 1)[:, None])
    names = ("time limit", *world.outcome_names)

    def episode(t, k):
        return Episode(names[k], int(t), float(returns[t, k]), float(per_step[t, k]))

    def largest(table):
        return episode(*np.argwhere(table >= table.max() - ROUNDING)[0])  # rows are lengths: the first is the shortest

    possible = returns > -np.inf
    fewest = {names[k]: episode(possible[:, k].argmax(), k) for k in range(1, len(names)) if possible[:, k].any()}
    return Optimum(fewest, largest(returns), largest(per_step), len(following))


def played_plan(world: World) -> Optimum:
    """The episode of `world.plan()`, played by the world's rules; it lasts until the time limit."""
    state, plan = world.start.copy(), world.plan()
    total = sum(world.step(world.rules, state, actions)[0] for actions in progress(plan, unit="step"))
    episode = Episode("time limit", len(plan), total, float(reward_per_step(total, len(plan))))
    return Optimum({}, episode, episode, None)


def optimal_plan(world: World, episode: Episode | None = None):
    """How to play an episode of `world`'s optimum: the joint actions, whole numbers [steps, num_agents].

    episode: one of `Optimum`'s, by default `best_per_step`. Any outcome and number of steps will do: the plan has the largest
    return of all such episodes; UsageError if there is none. A world that is not searchable gives its own `plan`.
    """
    if not world.searchable:
        return world.plan()
    episode = episode or find_optimum(world).best_per_step
    joint, following, reward = explored(world)
    names = ("time limit", *world.outcome_names)
    plan = best_plan(following, reward, names.index(episode.outcome), episode.steps) if fits(world, episode) else None
    if plan is None:
        raise UsageError(f"{world.name} has no episode of {episode.steps} steps that ends by {episode.outcome!r}.")
    return joint[plan]


def fits(world, episode):
    """Whether an episode may end so after so many steps, as far as names and the time limit say."""
    if episode.outcome == "time limit":
        return episode.steps == world.max_steps
    return episode.outcome in world.outcome_names and 1 <= episode.steps <= world.max_steps


def explored(world):
    """All joint actions [J, num_agents], and what `explore` finds with them; UsageError if there is too much to search."""
    num_joint = world.num_actions**world.num_agents
    if num_joint > MAX_JOINT:
        raise UsageError(f"only worlds of at most {MAX_JOINT} joint actions can be searched, and this {world.name} has more.")
    joint = np.array(list(product(range(world.num_actions), repeat=world.num_agents)))
    limit = min(MAX_STATES, MAX_STEPS // num_joint)
    following, reward = compile_explore(world.step)(world.rules, world.start, joint, limit)
    if len(following) > limit:
        said = f"{limit} states, with {num_joint} joint actions in each,"
        raise UsageError(f"only worlds of at most {said} can be searched, and this {world.name} has more.")
    world.check_outcomes(max(0, -following.min()))
    return joint, following, reward


@njit(cache=True)
def slot_of(table, states, state):
    """The slot of the hash table `table` (open addressing) that holds the number of `state`, or -1 and is where it belongs."""
    code = np.uint64(14695981039346656037)
    for entry in state:
        code = (code ^ np.uint64(entry)) * np.uint64(1099511628211)  # FNV-1a
    mask = np.uint64(len(table) - 1)
    slot = (code ^ (code >> np.uint64(32))) & mask
    while table[slot] >= 0 and np.any(states[table[slot]] != state):
        slot = (slot + np.uint64(1)) & mask
    return slot


@cache
def compile_explore(step):
    """The compiled enumeration of the states; it encloses `step` and is not cached, for the reason given in `compile_batch`."""

    @njit
    def explore(rules, start, joint, limit):
        """All states that the joint actions `joint` [J, num_agents] can reach from `start` [state_dim], breadth first.

        Returns following [S, J], the number of the next state or -k where the episode ends with outcome k, and reward [S, J].
        The start is state 0. More than `limit` states: it gives up, and S > limit.
        """
        room = limit + len(joint)  # the system hands out only the memory that is written to
        states = np.empty((room, len(start)), np.int64)
        following = np.empty((room, len(joint)), np.int32)
        reward = np.empty((room, len(joint)))
        table = np.full(1 << 23, -1, np.int32)  # at most 3 / 8 full
        state = start.copy()
        states[0] = state
        table[slot_of(table, states, state)] = 0
        count, s = 1, 0
        while s < count <= limit:
            for j in range(len(joint)):
                state[:] = states[s]
                reward[s, j], outcome = step(rules, state, joint[j])
                if outcome > 0:
                    following[s, j] = -outcome
                    continue
                slot = slot_of(table, states, state)
                if table[slot] < 0:
                    states[count] = state
                    table[slot] = count
                    count += 1
                following[s, j] = table[slot]
            s += 1
        return following[:count], reward[:count]

    return explore


def progress(steps=None, **options):
    """A bar on stderr that appears after some seconds and goes when all is done."""
    return tqdm(steps, desc="optimum", delay=PATIENCE, leave=False, disable=sys.stderr is None, **options)


def best_returns(following, reward, num_outcomes, max_steps):
    """The largest return of an episode by its length t and outcome k, [max_steps + 1, num_outcomes + 1]; -inf if there is none.

    following, reward: what `explore` returns. Outcome 0 is the episode cut by the time limit, so only t = max_steps has it.
    """
    returns = np.full((max_steps + 1, num_outcomes + 1), -np.inf)
    value = np.full(len(following), -np.inf)  # largest return with which a state is reached in exactly t steps
    value[0] = 0.0
    at_once = 1 + AT_ONCE // following.size
    with progress(total=max_steps, unit="step") as bar:
        settled = False
        for first in range(1, max_steps + 1, at_once):
            last = min(first + at_once - 1, max_steps)
            settled = settled or _further_steps(following, reward, value, returns, first, last)
            bar.update(last - first + 1)
    returns[max_steps, 0] = value.max()
    return returns


@njit(cache=True)
def _further_steps(following, reward, value, returns, first, last):
    """The steps from `first` to `last` of `best_returns`; True if it now knows all that would follow, and has written it."""
    max_steps = len(returns) - 1
    for t in range(first, last + 1):
        later = np.full(len(following), -np.inf)
        for s in range(len(following)):
            if value[s] == -np.inf:
                continue
            for j in range(following.shape[1]):
                total, target = value[s] + reward[s, j], following[s, j]
                if target >= 0:
                    later[target] = max(later[target], total)
                else:
                    returns[t, -target] = max(returns[t, -target], total)
        gain = later[0] - value[0]
        predicted = value + gain
        value[:] = later
        if np.isfinite(gain) and np.all((later == predicted) | (np.abs(later - predicted) < 1e-9)):
            # This step added the same gain to every state's value, so every later step will: the rest is known.
            for rest in range(t + 1, max_steps + 1):
                returns[rest] = returns[rest - 1] + gain
            value += gain * (max_steps - t)
            return True
    return False


def best_plan(following, reward, outcome, steps):
    """The joint actions, by their numbers [steps], of the episode with this outcome and length that has the largest return.

    None if there is no such episode. Of equally good actions it takes the first. A long episode is planned in parts, each by a
    backward pass from the end, so that the actions of all states at all times need never be kept together.
    """
    plan, s = [], 0
    part = max(1, CHOICES // len(following))
    while len(plan) < steps:
        for choice in _best_choices(following, reward, outcome, steps - len(plan), part):
            if choice[s] < 0:
                return None
            plan.append(choice[s])
            s = following[s, choice[s]]
    return np.array(plan)


@njit(cache=True)
def _best_choices(following, reward, outcome, steps, part):
    """The best joint action in every state, [part, S], at the first `part` of `steps` steps; -1 if none leads to `outcome`."""
    num_states, num_joint = following.shape
    choices = np.full((min(part, steps), num_states), -1, np.int32)
    value = np.full(num_states, 0.0 if outcome == 0 else -np.inf)  # largest return of the steps from t + 1 on
    for t in range(steps - 1, -1, -1):
        earlier = np.full(num_states, -np.inf)
        for s in range(num_states):
            for j in range(num_joint):
                target = following[s, j]
                if target >= 0:
                    total = reward[s, j] + value[target]
                elif t == steps - 1 and target == -outcome:
                    total = reward[s, j]
                else:
                    continue
                if total > earlier[s]:
                    earlier[s] = total
                    if t < part:
                        choices[t, s] = j
        value = earlier
    return choices
