"""How an episode is played: one of every trial, each to its own end, in one compiled loop.

    rollout = envs.Rollout(world, num_trials=20)
    rollout.play(params, generators)         # stacked networks, one for each trial and agent
    rollout.play_with(policy, generators)    # any other policy, in Python, step by step

A policy does not change during an episode. So a network is evaluated once for every observation that its agent meets, and the
rollout keeps these distinct observations and, for each step, which of them it was.
"""

import numpy as np
from numba import float64, typeof

from envs.base import UsageError, World, by_address, check_memory, check_whole, kernel
from envs.vector import GridVectorEnv


@kernel
def softmax(outputs, probs, temperature):
    """Write softmax(outputs / temperature) into probs; both [num_actions]."""
    highest = outputs[0]
    for a in range(1, len(outputs)):
        highest = max(highest, outputs[a])
    total = 0.0
    for a in range(len(outputs)):
        probs[a] = np.exp(np.float64(outputs[a] - highest) / temperature)
        total += probs[a]
    for a in range(len(outputs)):
        probs[a] /= total


@kernel
def epsilon_greedy(outputs, probs, epsilon):
    """Any action with probability epsilon, else the one of the highest value (the first of equals); both [num_actions]."""
    best = 0
    for a in range(len(outputs)):
        probs[a] = epsilon / len(outputs)
        if outputs[a] > outputs[best]:
            best = a
    probs[best] += 1.0 - epsilon


@kernel
def draw_action(probs, uniform, greedy):
    """Invert the distribution function of `probs` [num_actions] at `uniform` in [0, 1), or take the likeliest action."""
    if greedy:
        best = 0
        for a in range(1, len(probs)):
            if probs[a] > probs[best]:
                best = a
        return best
    a, remaining = -1, uniform
    while remaining >= 0.0 and a < len(probs) - 1:
        a += 1
        remaining -= probs[a]
    return a


@kernel
def apply_network(params, net, obs, hidden, outputs):
    """Write what one multilayer perceptron says to one observation into `outputs`.

    params: weights [num_nets, in, out] and biases [num_nets, 1, out] of its layers in turn; hidden [2, widest]: room to work
    """
    for j in range(len(obs)):
        hidden[1, j] = obs[j]
    for layer in range(0, len(params), 2):
        weights, bias = params[layer][net], params[layer + 1][net, 0]
        now, then = hidden[(layer // 2 + 1) % 2], hidden[layer // 2 % 2]
        for j in range(weights.shape[1]):
            then[j] = bias[j]
        for i in range(weights.shape[0]):
            x = now[i]  # a local scalar, without which the inner loop is not vectorised
            if layer > 0 and x <= 0:
                continue  # ReLU; a NaN goes on
            if x != 0:
                for j in range(weights.shape[1]):
                    then[j] += x * weights[i, j]
    last = hidden[(len(params) // 2 + 1) % 2]
    for j in range(len(outputs)):
        outputs[j] = last[j]


@kernel
def find_row(bits, kept, found, table):
    """Which of the first `found` rows of kept [.., dim] equals bits [dim]; `found`, now entered in the table, if none does.

    table: a hash table with open addressing, bucket -> row or -1; its size is a power of 2
    """
    bucket = 0
    for j in range(len(bits)):
        bucket = (bucket ^ bits[j]) * 16777619
    bucket = (bucket ^ (bucket >> 20)) & (len(table) - 1)
    while table[bucket] >= 0:
        row, same = table[bucket], True
        for j in range(len(bits)):
            same = same and kept[row, j] == bits[j]
        if same:
            return row
        bucket = (bucket + 1) & (len(table) - 1)
    table[bucket] = found
    return found


@kernel
def _play(
    step, observe, head, rules, cell, start, max_steps, params, parameter, greedy,
    uniforms, obs, obs_bits, states, distinct, distinct_bits, rows, actions, reward, lengths, outcomes, entropy,
    hidden, outputs, probs, row_entropy, found, tables,
):  # fmt: skip
    """Fill in the arrays of a `Rollout`; returns the largest number of distinct observations that an agent has met.

    It is negative if a network says something that is not finite. step, observe and head: as from `by_address`
    """
    trials, agents = rows.shape[1], rows.shape[2]
    most, longest, finite = 0, 0, True
    for k in range(trials):
        for i in range(agents):
            found[k * agents + i] = 0
            for bucket in range(tables.shape[1]):
                tables[i, bucket] = -1
        for j in range(len(start)):
            states[0, k, j] = start[j]
        observe(rules, cell, states[0, k], obs[0, k])
        t, outcome, entropy[k] = 0, 0, 0.0
        while outcome == 0 and t < max_steps:
            for i in range(agents):
                net = k * agents + i
                row = find_row(obs_bits[t, k, i], distinct_bits[net], found[net], tables[i])
                if row == found[net]:
                    found[net] += 1
                    for j in range(obs.shape[3]):
                        distinct[net, row, j] = obs[t, k, i, j]
                    apply_network(params, net, obs[t, k, i], hidden, outputs)
                    for a in range(len(outputs)):  # before `head`, which may turn anything into probabilities
                        finite = finite and np.isfinite(outputs[a])
                    head(outputs, probs[i, row], parameter)
                    row_entropy[i, row] = 0.0
                    for a in range(len(outputs)):
                        p = probs[i, row, a]
                        row_entropy[i, row] -= p * np.log(p) if p > 0.0 else 0.0
                rows[t, k, i] = row
                actions[t, k, i] = draw_action(probs[i, row], uniforms[k, t, i], greedy)
                entropy[k] += row_entropy[i, row]
            for j in range(len(start)):
                states[t + 1, k, j] = states[t, k, j]
            value, outcome = step(rules, states[t + 1, k], actions[t, k])
            for i in range(agents):
                reward[t, k, i] = value
            t += 1
            observe(rules, cell, states[t, k], obs[t, k])
        lengths[k], outcomes[k] = t, outcome
        entropy[k] /= t * agents
        longest = max(longest, t)

    for net in range(len(found)):
        most = max(most, found[net])
    for net in range(len(found)):
        for row in range(found[net], most):
            for j in range(obs.shape[3]):
                distinct[net, row, j] = 0.0
    for k in range(trials):  # what lies beyond a trial's end
        for t in range(lengths[k], longest):
            for i in range(agents):
                rows[t, k, i], actions[t, k, i], reward[t, k, i] = 0, 0, 0.0
            for j in range(len(start)):
                states[t + 1, k, j] = states[t, k, j]
            for i in range(agents):
                for j in range(obs.shape[3]):
                    obs[t + 1, k, i, j] = obs[t, k, i, j]
    return most if finite else -most


class Rollout:
    """One episode of every trial. All arrays are overwritten by the next; T is the length of the longest episode.

    obs           float32 [num_nets, U, obs_dim], every observation on which a network acted, once; there is a network for each
                  trial and agent, and one that met fewer than U has zeros in the rest
    rows          [T, num_trials, num_agents], where in `obs` a step's observation is
    actions       [T, num_trials, num_agents]
    reward        [T, num_trials, num_agents], the team's, so the same for all agents of a trial
    lengths       [num_trials], the number of steps; rows, actions and rewards beyond are 0
    outcomes      [num_trials], 0: cut by the time limit, k: ended as world.outcome_names[k - 1]
    all_obs       float32 [T + 1, num_trials, num_agents, obs_dim], step by step, with what was seen after the last step
    states        [T + 1, num_trials, state_dim], the world's state in whole numbers; as all_obs, it stays after the end
    entropy       [num_trials], of what the actions were drawn from, mean over steps and agents
    finite        whether all networks said finite numbers
    """

    def __init__(self, world: World, num_trials: int, head=softmax, greedy: bool = False):
        """Arguments:
        head:   head(outputs, probs, parameter), compiled by `kernel`, writes the probabilities for what a network says
        greedy: take the likeliest actions instead of drawing them
        """
        self.world, self.head, self.greedy = world, head, greedy
        agents, steps, dim = world.num_agents, world.max_steps, world.obs_dim
        num_trials = check_whole("num_trials", num_trials, minimum=1)
        numbers = len(world.start) + agents * (dim + 4)  # of a step, in all the arrays below
        check_memory(f"{num_trials} x {steps} steps of an episode", 8 * num_trials * steps * numbers)
        shape = (steps, num_trials, agents)
        self.lengths, self.outcomes = np.zeros((2, num_trials), np.int64)
        self.entropy, self.finite = np.zeros(num_trials), True
        self._uniforms = np.empty((num_trials, steps, agents))
        self._all_obs = np.zeros((steps + 1, num_trials, agents, dim), np.float32)
        self._states = np.zeros((steps + 1, num_trials, len(world.start)), np.int64)
        self._obs = np.zeros((num_trials * agents, steps, dim), np.float32)
        self._rows, self._actions = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        self._reward = np.zeros(shape)
        buckets = 1 << (2 * steps - 1).bit_length()  # at most half full
        self._room = (
            np.zeros((agents, steps, world.num_actions)),  # what each distinct observation's actions are drawn from
            np.zeros((agents, steps)),  # and its entropy
            np.zeros(num_trials * agents, np.int64),  # how many distinct observations each network has met
        )
        self._tables = np.empty((agents, buckets), np.int64)
        self._compiled = self._kinds = None
        self._nets = np.arange(num_trials * agents).reshape(num_trials, agents)

    def play(self, params, generators, parameter=1.0):
        """Play with stacked networks: weights [num_nets, in, out], biases [num_nets, 1, out] in turn, tensors or arrays.

        Each trial draws its action uniforms from its own generator, [max_steps, num_agents] at once. parameter: of the head,
        softmax's temperature or the epsilon of `epsilon_greedy`
        """
        for generator, row in zip(generators, self._uniforms, strict=True):
            generator.random(out=row)
        arrays = tuple(param if isinstance(param, np.ndarray) else param.detach().numpy() for param in params)
        kinds = [(array.dtype, array.shape, array.flags.c_contiguous, array.flags.writeable) for array in arrays]
        if kinds != self._kinds:  # what is compiled asks no more
            self._compile(arrays)
            self._kinds = kinds
        most = self._compiled(*self._rules, arrays, float(parameter), self.greedy, *self._arrays)
        self.finite = most > 0
        self._show(self._obs[:, : abs(most)])

    def _compile(self, params):
        """Make ready `_play`, to be called without numba asking in every episode of what types the arguments are (0.2 ms)."""
        world, real = self.world, params[0].dtype
        self._check(params)
        hidden, outputs = np.empty((2, max(max(p.shape[1:]) for p in params)), real), np.empty(world.num_actions, real)
        head = by_address(self.head, typeof(outputs), float64[::1], float64)
        self._rules = *world.compiled, head, world.rules, world.cell, world.start, world.max_steps
        self._arrays = (
            *(self._uniforms, self._all_obs, self._all_obs.view(np.int32), self._states, self._obs, self._obs.view(np.int32)),
            *(self._rows, self._actions, self._reward, self.lengths, self.outcomes, self.entropy),
            *(hidden, outputs, *self._room, self._tables),
        )
        types = tuple(typeof(argument) for argument in (*self._rules, params, 1.0, self.greedy, *self._arrays))
        _play.compile(types)
        self._compiled = _play.overloads[types].entry_point

    def _check(self, params):
        """ValueError if these are not the weights and biases of networks for this world."""
        shapes, nets, width = [param.shape for param in params], self._nets.size, self.world.obs_dim
        for weights, bias in zip(shapes[::2], shapes[1::2], strict=True):
            if len(weights) != 3 or weights[:2] != (nets, width) or bias != (nets, 1, weights[2]):
                raise ValueError(
                    f"a layer of the shapes {weights} and {bias} does not fit to {nets} networks of {width} numbers."
                )
            width = weights[2]
        if width != self.world.num_actions or len({param.dtype for param in params}) != 1 or params[0].dtype.kind != "f":
            raise ValueError(f"params must end in {self.world.num_actions} outputs and be floats of one type.")

    def play_with(self, policy, generators):
        """Play with any policy: policy(obs) says the probabilities of all actions, [num_trials, num_agents, num_actions].

        It is asked once for each time step and gets obs float32 [num_trials, num_agents, obs_dim] of all trials, ended ones
        too, so what it carries along from step to step belongs to a trial by its index. Draws as `play` does. UsageError for
        what are no probabilities.
        """
        world, env = self.world, GridVectorEnv(self.world, len(self.lengths))
        for generator, row in zip(generators, self._uniforms, strict=True):
            generator.random(out=row)
        self._all_obs[0], _ = env.reset()
        running, self.finite = np.ones(len(self.lengths), bool), True
        self.lengths[:], self.entropy[:], self._states[0] = 0, 0.0, world.start
        for t in range(world.max_steps):
            probs = np.asarray(policy(self._all_obs[t].copy())).astype(np.float64)
            self._check_probabilities(probs)
            self.finite = self.finite and bool(np.isfinite(probs).all())
            self._actions[t] = 0
            for k, i in np.ndindex(probs.shape[:2]):
                if running[k]:
                    self._actions[t, k, i] = draw_action(probs[k, i], self._uniforms[k, t, i], self.greedy)
            entropy = -(probs * np.log(np.where(probs > 0, probs, 1.0))).sum(2).mean(1)
            self.entropy += np.where(running, entropy, 0.0)
            self.lengths += running
            self._all_obs[t + 1], reward, terminated, truncated, info = env.step(self._actions[t])
            self._reward[t] = reward[:, None]
            self._states[t + 1] = env.states
            running = ~(terminated | truncated)
            if not running.any():
                break
        self.outcomes[:] = info["outcome"]
        self.entropy /= self.lengths
        obs, rows = distinct_rows(self._all_obs[:-1], self.lengths)
        self._rows[: len(rows)] = rows
        self._show(obs)

    def _check_probabilities(self, probs):
        """UsageError for something else than what the actions of every trial and agent may be drawn from."""
        shape = (len(self.lengths), self.world.num_agents, self.world.num_actions)
        if probs.shape != shape:
            raise UsageError(f"a policy must say probabilities of all actions, {list(shape)}, not {list(probs.shape)} numbers.")
        if np.isfinite(probs).all() and not (probs.min() >= 0 and np.abs(probs.sum(2) - 1).max() < 1e-3):
            raise UsageError("a policy must say probabilities, at least 0 and adding up to 1 over the actions, not logits.")

    def _show(self, obs):
        longest = self.lengths.max()
        self.obs, self.all_obs, self.states = obs, self._all_obs[: longest + 1], self._states[: longest + 1]
        self.rows, self.actions, self.reward = self._rows[:longest], self._actions[:longest], self._reward[:longest]

    @property
    def terminated(self):
        """Whether the world itself has ended a trial's episode, bool [num_trials]; otherwise the time limit has cut it."""
        return self.outcomes > 0

    @property
    def played(self):
        """1 for the steps of an episode and 0 beyond its end, bool [T, num_trials]."""
        return np.arange(len(self.rows))[:, None] < self.lengths

    @property
    def global_state(self):
        """Everything there is to know, scaled to about [0, 1], float32 [T + 1, num_trials, state_dim]; for critics."""
        return (self.states * self.world.state_scale).astype(np.float32)

    @property
    def local_state(self):
        """Each agent's own entries of the state (World's local_index), [T + 1, num_trials, num_agents, d]."""
        return self.states[:, :, self.world.local_index]

    def of_taken(self, outputs):
        """What networks say of the actions taken, step by step; tensor [num_nets, U, num_actions] of values for `obs`
        -> tensor [T, num_trials, num_agents], in double precision, so that no digit of a long sum is lost.
        """
        return outputs.double()[self._nets, self.rows, self.actions]


def in_every_step(outputs, rows):
    """What networks say, step by step; outputs [num_nets, U, ..], rows [T, num_trials, num_agents] -> [T, .., num_agents, ..].

    `rows` says where in the outputs a step is, as `Rollout.rows` or from `distinct_rows`; works for tensors and arrays.
    """
    return outputs[np.arange(len(outputs)).reshape(rows.shape[1:]), rows]


@kernel
def _merge(bits, lengths, distinct, rows, table):
    """The loop of `distinct_rows`; returns the largest number of distinct vectors."""
    most = 0
    for k in range(rows.shape[1]):
        for i in range(rows.shape[2]):
            net, found = k * rows.shape[2] + i, 0
            for bucket in range(len(table)):
                table[bucket] = -1
            for t in range(lengths[k]):
                row = find_row(bits[t, k, i], distinct[net], found, table)
                if row == found:
                    found += 1
                    for j in range(bits.shape[3]):
                        distinct[net, row, j] = bits[t, k, i, j]
                rows[t, k, i] = row
            most = max(most, found)
    return most


def distinct_rows(vectors, lengths):
    """Every distinct vector once, of each network by itself, in the order in which they come.

    vectors float32 [T, num_trials, n, dim], of which trial k has the first lengths[k] -> distinct vectors [num_trials * n, U,
    dim], zeros in the rows that a network with fewer than U leaves over, and where each is [T, num_trials, n], 0 beyond.
    """
    vectors = np.ascontiguousarray(vectors[: lengths.max()], np.float32)
    longest, trials, n, dim = vectors.shape
    distinct = np.zeros((trials * n, longest, dim), np.float32)
    rows = np.zeros(vectors.shape[:3], np.int64)
    table = np.empty(1 << (2 * longest - 1).bit_length(), np.int64)
    most = _merge(vectors.view(np.int32), lengths, distinct.view(np.int32), rows, table)
    return distinct[:, :most].copy(), rows
