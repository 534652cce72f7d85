"""What all worlds share: the `World` description, the checks of their options and the compiled batch loop.

A world is a small state (a row of integers), a compiled function `step` that changes it by one joint action, and a compiled
function `observe` that says what each agent sees of it. Everything else (vector face, search, drawing) is built on these two.
"""

import atexit
import os
import re
import shutil
import sys
import tempfile
from functools import cache, cached_property

import numba
import numpy as np
from numba import float32, float64, int64, njit, typeof
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numba.core.types import BaseTuple, Boolean, CompileResultWAP, Float, Integer


def find_cache():
    """Let numba do without its cache on disk, and say so once, where none can be written: a read-only disk and no home."""
    try:
        njit(cache=True)(find_cache)  # compiles nothing yet, but looks for a place
    except RuntimeError:
        numba.config.CACHE_DIR = tempfile.mkdtemp(prefix="envs-")
        atexit.register(shutil.rmtree, numba.config.CACHE_DIR, ignore_errors=True)
        print("Compiled code cannot be kept here, so each start compiles anew; NUMBA_CACHE_DIR names a place.", file=sys.stderr)


find_cache()

# How the functions of a world are compiled: as by `njit(cache=True)`, but without numba's counting of references to arrays,
# which would take a third to half of the time of a step. So they cannot make arrays, only read and write those they are given.
rule = njit(cache=True, _nrt=False)
# The same for the loops around them, in which a division by zero gives what it gives in numpy.
kernel = njit(cache=True, _nrt=False, error_model="numpy")


@cache
def by_address(function, *types):
    """A compiled function, for arguments of these numba types, as an argument of another one.

    The other one knows its address only, so it can be cached on disk, one for all worlds. If it called the rules by name, numba
    would cache them with it, and an edited world would silently keep its old rules.
    """
    function.compile(types)
    return CompileResultWAP(function.overloads[types])


def reason_of(error):
    """What numba says is wrong with a function, in one line: what it cannot do, and where."""
    lines = [line.strip() for line in re.sub(r"\x1b\[[0-9;]*m", "", str(error)).splitlines()]
    what = next((line for line in lines if line and not line.startswith("Failed in")), type(error).__name__)
    if "NRT" in what or "Resolution failure" in what:
        what = "they may only read and write the arrays that they are given, not make arrays or use Python's lists"
    where = next((line.rstrip(":") for line in lines if line.startswith("File ")), "")
    return f"{what.rstrip('.:')}{f' ({where})' if where else ''}"


class UsageError(ValueError):
    """Something that was asked for is impossible; the message is one sentence that says what would be accepted."""


class World:
    """A gridworld: its rules and the numbers that describe it. One subclass per world, one instance per choice of options.

    `step(rules, state, actions) -> (reward, outcome)` changes `state` [state_dim] (int64) by the joint action [num_agents]
    and returns the team's reward and the outcome (0: still running, k: ended as `outcome_names[k - 1]`).
    `observe(rules, cell, state, obs)` writes what the agents see into `obs` [num_agents, obs_dim] (float32).
    Both are compiled by `rule` and take `rules` as the world built it: an array or a record of the world's numbers.
    """

    name: str  # the class's in small letters unless it says another
    action_names: tuple[str, ...]
    outcome_names: tuple[str, ...] = ()  # the names of outcomes 1, 2, ...
    sights: tuple[str, ...] = ()  # what the entries of a one-hot observation stand for; none where positions are observed
    best_outcome: int = 0  # the outcome a good team ends in; 0 if the world has none
    largest_reward: float = 1.0  # of one step; methods whose numbers are relative to the scale of rewards ask for it (EDTI)
    searchable = True  # small enough for `envs.optimum` to visit every state; otherwise the world has a `plan`
    step = observe = None  # compiled functions, set by the subclass as staticmethod

    def __init_subclass__(cls):
        cls.name = cls.__dict__.get("name", cls.__name__.lower())

    def __init__(self, rules, start, local_index, num_agents, obs_dim, cell, state_scale, max_steps):
        """Arguments:
        rules:       what `step` and `observe` take as their first argument
        start:       initial state, integers [state_dim]
        local_index: which entries of the state belong to each agent (its position and facing, the boxes), [num_agents, d]
        num_agents:  number of agents
        obs_dim:     length of one agent's observation
        cell:        width of one cell in units of the observation (1 / size for scaled positions, 1 for one-hot)
        state_scale: factors that bring the entries of the state into about [0, 1], [state_dim]
        max_steps:   an episode is cut (truncated) after this many steps
        """
        self.max_steps = check_whole("max_steps", max_steps, minimum=1, maximum=LONGEST)
        if max(len(self.action_names), len(self.outcome_names)) > MOST_NAMES:
            raise UsageError(f"{self.name} must have at most {MOST_NAMES} actions and as many outcomes.")
        if not 0 <= self.best_outcome <= len(self.outcome_names):
            raise UsageError(f"{self.name}'s best_outcome must be one of its {len(self.outcome_names)} outcomes, or 0.")
        if not all(isinstance(function, Dispatcher) for function in (self.step, self.observe)):
            raise UsageError(f"{self.name}'s step and observe must be functions compiled by envs.rule, in a staticmethod.")
        self.rules, self.cell = rules, float(cell)
        self.num_agents = check_whole(f"{self.name}'s num_agents", num_agents, minimum=1)
        self.obs_dim = check_whole(f"{self.name}'s obs_dim", obs_dim, minimum=1)
        self.start = check_array(f"{self.name}'s start", start, np.int64, shape=(None,))
        self.state_scale = check_array(f"{self.name}'s state_scale", state_scale, np.float32, shape=self.start.shape)
        self.local_index = check_array(f"{self.name}'s local_index", local_index, np.int64, shape=(self.num_agents, None))
        if not ((self.local_index >= 0) & (self.local_index < len(self.start))).all():
            raise UsageError(f"{self.name}'s local_index must name entries of the state, 0 to {len(self.start) - 1}.")

    @property
    def num_actions(self) -> int:
        return len(self.action_names)

    @cached_property
    def compiled(self):
        """`step` and `observe` as compiled loops take them, see `by_address`."""
        state = int64[::1]
        try:
            rules = typeof(self.rules)
            step = by_address(self.step, rules, state, state)
            observe = by_address(self.observe, rules, float64, state, float32[:, ::1])
        except (NumbaError, TypeError, ValueError) as error:
            raise UsageError(f"{self.name}'s rules cannot be compiled: {reason_of(error)}.") from error
        returned = self.step.overloads[rules, state, state].signature.return_type
        kinds = ((Float, Integer, Boolean), (Integer, Boolean))  # of a reward and an outcome
        if not (isinstance(returned, BaseTuple) and len(returned) == 2 and all(map(isinstance, returned, kinds))):
            raise UsageError(f"{self.name}'s step must return a reward and a whole number as outcome, not {returned}.")
        return step, observe

    @property
    def drawable(self):
        """Whether the world says what it looks like."""
        return type(self).sketch is not World.sketch

    def check_outcomes(self, outcomes):
        """UsageError if one of these, [..], is none of the world's outcomes."""
        lowest, highest, named = np.min(outcomes), np.max(outcomes), len(self.outcome_names)
        if lowest < 0 or highest > named:
            what = f"an outcome from 0 to {named}, the number of its outcome_names"
            raise UsageError(f"{self.name}'s step must return {what}, not {lowest if lowest < 0 else highest}.")

    def plan(self):
        """Joint actions [max_steps, num_agents] of a good team, in a world that is not searchable and never ends early."""
        raise NotImplementedError

    def sketch(self, state):
        """The picture of `state` as `(rows, columns, shapes)`, see `envs.drawing`."""
        raise UsageError(f"{self.name} cannot be drawn, because its class has no method `sketch`.")


LARGEST = 2**63 - 1  # whole numbers beyond 64 bits are none of numpy's
LONGEST = 2**31 - 1  # steps of an episode, whose lengths are kept in 32 bits
MOST_NAMES = 127  # actions and outcomes are kept in 8 bits
LARGEST_MAP = 1001  # cells a side, of worlds whose size is free


def plain(value):
    """Python's own value in the place of one of numpy's."""
    return value.item() if isinstance(value, np.generic) else value


def check_whole(option, value, minimum, maximum=LARGEST):
    """`value` as an int if it is a whole number between `minimum` and `maximum`; UsageError otherwise."""
    value = plain(value)
    if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= maximum:
        raise UsageError(f"{option} must be a whole number {limits(minimum, maximum, value)}, not {value!r}.")
    return value


def check_number(option, value, lowest, highest=np.inf):
    """`value` as a float if it is a finite number between `lowest` and `highest`; UsageError otherwise."""
    value = plain(value)
    largest = LARGEST if isinstance(value, int) else np.inf
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and max(lowest, -largest) <= value <= min(highest, largest) and np.isfinite(value)):
        said = f"between {lowest} and {highest}" if highest < np.inf else limits(lowest, largest, value)
        raise UsageError(f"{option} must be a number {said}, not {value!r}.")
    return float(value)


def limits(lowest, highest, value):
    """What numbers are accepted where `value` is not; a highest one that is only technical is named to whom it concerns."""
    beyond = isinstance(value, int) and value > highest
    return f"between {lowest} and {highest}" if beyond else f"of at least {lowest}"


def check_choice(option, value, choices):
    """`value` if it is one of `choices`; UsageError otherwise."""
    value = plain(value)
    if type(value) is not type(choices[0]) or value not in choices:
        raise UsageError(f"{option} must be one of {', '.join(map(repr, choices))}, not {value!r}.")
    return value


def check_array(what, value, dtype, shape):
    """`value` as an array of this type and shape, in which None is any length; UsageError otherwise."""
    try:
        array = np.array(value, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{what} must be numbers, not {value!r}.") from error
    if array.ndim != len(shape) or not all(n in (None, has) for n, has in zip(shape, array.shape, strict=True)):
        wanted, found = (", ".join("any" if n is None else str(n) for n in lengths) for lengths in (shape, array.shape))
        raise UsageError(f"{what} must be numbers [{wanted}], and they are [{found}].")
    return array


def check_seed(seed):
    """`seed` as an int or None, as `reset` takes it; UsageError otherwise."""
    return None if seed is None else check_whole("seed", seed, minimum=0)


def check_memory(what, num_bytes):
    """UsageError if `what` would need more memory than this machine has: said before it is tried, which may take long."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if num_bytes > there:
        needed, has = (f"{number // 10**9:,} GB" for number in (num_bytes, there))
        raise UsageError(f"{what} would need {needed} of memory, and this machine has {has}.")


@rule
def observe_positions(rules, cell, state, obs):
    """Every agent sees the first obs_dim entries of the state: the positions of all agents (and the box), in map widths."""
    for i in range(obs.shape[0]):
        for j in range(obs.shape[1]):
            obs[i, j] = state[j] * cell


@rule
def observe_own(rules, cell, state, obs):
    """Every agent sees only its own row and column, in map widths."""
    for i in range(obs.shape[0]):
        obs[i, 0] = state[2 * i] * cell
        obs[i, 1] = state[2 * i + 1] * cell


class PositionWorld(World):
    """A world whose state begins with each agent's row and column, which is what agents observe: those of all or one's own."""

    def __init__(self, rules, start, size, num_agents, observation, max_steps, objects=()):
        """As World, but for
        size:        of the map; positions are divided by it
        observation: "positions" or "own"
        objects:     entries of the state, next to the agents' positions, that are rows and columns of things they may observe
        """
        check_choice("observation", observation, ("positions", "own"))
        everything = observation == "positions"
        self.observe = observe_positions if everything else observe_own
        self.size, positions = size, 2 * num_agents + len(objects)
        super().__init__(
            rules=rules,
            start=start,
            local_index=[[2 * i, 2 * i + 1, *objects] for i in range(num_agents)],
            num_agents=num_agents,
            obs_dim=positions if everything else 2,
            cell=1 / size,
            state_scale=[1 / size] * positions + [1] * (len(start) - positions),
            max_steps=max_steps,
        )

    def sketch(self, state):
        """The agents in an empty room; worlds with more to show add it."""
        return self.size, self.size, self.sketch_agents(state)

    def sketch_agents(self, state):
        """The shapes of the agents, see `envs.drawing`."""
        return [("agent", i, state[2 * i], state[2 * i + 1], None) for i in range(self.num_agents)]


@cache
def compile_batch(step, observe):
    """The compiled functions `advance` and `look` for a whole batch of worlds with these rules.

    They enclose `step` and `observe` and are compiled anew in every process (about half a second): numba's cache on disk would
    save them together with the rules that they were first compiled for, and an edited world would silently keep its old rules.
    They take the worlds' `memory` [num_envs, 2 + state_dim]: each one's outcome, number of steps and state. One call with few
    arguments does everything, because for a small batch most of the time goes into calling and making arrays. They count no
    references either, see `rule`.
    """

    @njit(_nrt=False)
    def look(rules, cell, local_index, state_scale, memory, obs, global_state, local_state):
        """Write what is to be seen of the worlds: observations, global states, and the agents' own entries."""
        for e in range(len(memory)):
            state = memory[e, 2:]
            observe(rules, cell, state, obs[e])
            for j in range(len(state)):
                global_state[e, j] = state[j] * state_scale[j]
            for i in range(local_index.shape[0]):
                for j in range(local_index.shape[1]):
                    local_state[e, i, j] = state[local_index[i, j]]

    @njit(_nrt=False)
    def advance(
        rules, cell, local_index, state_scale, memory, num_actions, max_steps, actions,
        reward, terminated, truncated, outcome, obs, global_state, local_state,
    ):  # fmt: skip
        """One time step of every world that still runs, and a look. An ended one stays still at reward 0 and keeps its flags.

        Returns False, and does nothing, if an action is none of the world's.
        """
        for e in range(len(memory)):
            for i in range(actions.shape[1]):
                if not 0 <= actions[e, i] < num_actions:
                    return False
        for e in range(len(memory)):
            reward[e] = 0.0
            if memory[e, 0] == 0 and memory[e, 1] < max_steps:
                reward[e], memory[e, 0] = step(rules, memory[e, 2:], actions[e])
                memory[e, 1] += 1
            outcome[e] = memory[e, 0]
            terminated[e] = outcome[e] > 0  # the world itself has ended
            truncated[e] = outcome[e] == 0 and memory[e, 1] >= max_steps  # cut by the time limit
        look(rules, cell, local_index, state_scale, memory, obs, global_state, local_state)
        return True

    return look, advance
