"""PG beside other ways of writing it: the same REINFORCE (Eq. 14, Adam), world and networks, one core.

    pip install -r requirements.txt -r benchmark/peers-requirements.txt
    python benchmark/peers.py                            # some minutes; --episodes 100 for a look

pg          algos/pg.py: compiled play, all trials side by side
loop        what one writes in the manner of CleanRL: one trial after the other, a forward pass for every step
jax         one jitted program for all trials, with the rules in jax.numpy (checked here against those of envs/); play stops
            with the longest episode, and the update takes the next power of two of its steps
torchrl     TorchRL's rollouts on the PettingZoo face, its networks and modules; one trial after the other

Prints processor seconds for an environment step and their ratios. They are those of whole training runs from the first episode
on, without imports and compilation. Where trials follow each other, 20 of them cost what one does, step for step; three run.
"""

import importlib.util
import os
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import envs
from algos import pg
from benchmark.cells import train_aside
from benchmark.speed import print_table
from envs.command import command_line

SETTINGS = {world: {**pg.WORLDS[world], **pg.TUNED[world, "adam"]} for world in ("findtreasure", "pushbox")}
ALONE = 3  # trials of those that run one after the other


def run_pg(name, num_trials, num_episodes):
    """(returns [num_trials, num_episodes], number of steps, processor seconds) of algos/pg.py."""
    args = dict(env=name, num_trials=num_trials, optimizer="adam")
    train_aside(pg, num_episodes=2, **args)  # compiles
    start = time.process_time()
    log = train_aside(pg, num_episodes=num_episodes, **args).log
    return log.returns, log.lengths.sum(), time.process_time() - start


def to_go(rewards, gamma):
    """The discounted sum of the rewards from every step on."""
    returns = np.zeros(len(rewards) + 1)
    for t in range(len(rewards) - 1, -1, -1):
        returns[t] = rewards[t] + gamma * returns[t + 1]
    return torch.as_tensor(returns[:-1], dtype=torch.float32)


def run_loop(name, num_trials, num_episodes):
    """As run_pg; a plain loop in torch."""
    setting, env = SETTINGS[name], envs.make_vec(name, 1)
    widths, agents = [env.world.obs_dim, *setting["hidden"]], range(env.world.num_agents)
    env.reset()
    env.step(np.zeros((1, len(agents)), int))
    returns, steps, start = np.zeros((num_trials, num_episodes)), 0, time.process_time()
    for trial in range(num_trials):
        torch.manual_seed(trial)
        policies = []
        for _ in agents:
            layers = [layer for n, m in pairwise(widths) for layer in (torch.nn.Linear(n, m), torch.nn.ReLU())]
            policies.append(torch.nn.Sequential(*layers, torch.nn.Linear(widths[-1], env.world.num_actions)))
        params = [param for policy in policies for param in policy.parameters()]
        optimizer = torch.optim.Adam(params, lr=setting["learning_rate"])
        for episode in range(num_episodes):
            obs, _ = env.reset()
            log_probs, rewards, done = [], [], False
            while not done:
                choices = [torch.distributions.Categorical(logits=policies[i](torch.as_tensor(obs[0, i]))) for i in agents]
                actions = [choice.sample() for choice in choices]
                log_probs.append(sum(choice.log_prob(action) for choice, action in zip(choices, actions, strict=True)))
                obs, reward, terminated, truncated, _ = env.step(np.array([[action.item() for action in actions]]))
                rewards.append(reward[0])
                done = terminated[0] or truncated[0]
            loss = -(to_go(rewards, setting["gamma"]) * torch.stack(log_probs)).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            returns[trial, episode], steps = sum(rewards), steps + len(rewards)
    return returns, steps, time.process_time() - start


def jax_findtreasure(world):
    """The world's rules for one copy: step(state, actions) -> (state, reward, outcome), and observe(state)."""
    from jax import numpy as jnp

    from envs import findtreasure as own

    grid = jnp.array(world.rules)

    def step(state, actions):
        where = list(state)
        door_open = (grid[where[0], where[1]] == own.LEVER) | (grid[where[2], where[3]] == own.LEVER)
        reward = 0.0
        for i in range(2):
            row = where[2 * i] + (actions[i] == own.DOWN) - (actions[i] == own.UP)
            column = where[2 * i + 1] + (actions[i] == own.RIGHT) - (actions[i] == own.LEFT)
            teammate = (row == where[2 - 2 * i]) & (column == where[3 - 2 * i])
            there = grid[row, column]
            blocked = (there == own.WALL) | ((there == own.DOOR) & ~door_open) | teammate
            moves = actions[i] != own.WAIT
            reward += jnp.where(moves & blocked, own.BUMP_REWARD, 0.0)
            for j, place in ((2 * i, row), (2 * i + 1, column)):
                where[j] = jnp.where(moves & ~blocked, place, where[j])
        here, there = grid[where[0], where[1]], grid[where[2], where[3]]
        treasure = (here == own.TREASURE) | (there == own.TREASURE)
        meeting = ((here == own.LEVER) & (there == own.MEETING)) | ((here == own.MEETING) & (there == own.LEVER))
        outcome = jnp.where(treasure, 1, jnp.where(meeting, 2, 0))
        reward += jnp.where(treasure, own.TREASURE_REWARD, jnp.where(meeting, own.MEETING_REWARD, 0.0))
        return jnp.stack(where), reward, outcome

    return step, lambda state: jnp.tile(state.astype(jnp.float32) * world.cell, (2, 1))


def jax_pushbox(world):
    """As jax_findtreasure."""
    from jax import numpy as jnp

    from envs import pushbox as own

    room = {name: world.rules[0][name].item() for name in own.RULES.names}
    size, goal = room["size"], room["size"] - 1

    def ahead(state, i):
        x, y, facing = state[3 * i], state[3 * i + 1], state[3 * i + 2]
        return (
            x + jnp.where(facing == own.EAST, 1, 0) - jnp.where(facing == own.WEST, 1, 0),
            y + jnp.where(facing == own.NORTH, 1, 0) - jnp.where(facing == own.SOUTH, 1, 0),
        )

    def content(state, x, y):
        outside = (x < 0) | (x >= size) | (y < 0) | (y >= size)
        small = ((x == room["left"]) & (y == state[own.LEFT_Y])) | ((x == room["right"]) & (y == state[own.RIGHT_Y]))
        large = (room["large"] <= x) & (x <= room["large"] + 1) & (y == state[own.LARGE_Y])
        boxes = jnp.where(small, own.SMALL_BOX, jnp.where(large, own.LARGE_BOX, own.EMPTY))
        return jnp.where(outside, own.BOUNDARY, boxes)

    def below_large(state, i):
        return (state[3 * i + 2] == own.NORTH) & (content(state, *ahead(state, i)) == own.LARGE_BOX)

    def step(state, actions):
        forward = actions == own.FORWARD
        both_below = below_large(state, 0) & below_large(state, 1) & (state[0] != state[3])
        together = forward[0] & forward[1] & both_below
        state = state + jnp.where(together, 1, 0) * jnp.array([0, 1, 0, 0, 1, 0, 0, 0, 1])
        reward = -room["step_penalty"]
        for i in range(2):
            x, y = ahead(state, i)
            there, north = content(state, x, y), state[3 * i + 2] == own.NORTH
            alone = forward[i] & ~together
            lone_push = alone & (there == own.LARGE_BOX)
            bump = alone & ((there == own.BOUNDARY) | ((there == own.SMALL_BOX) & ~north))
            reward -= jnp.where(lone_push, room["lone_push_penalty"], 0.0) + jnp.where(bump, room["boundary_penalty"], 0.0)
            moves = alone & ~lone_push & ~bump
            for box, column in ((own.LEFT_Y, room["left"]), (own.RIGHT_Y, room["right"])):
                pushed = moves & (there == own.SMALL_BOX) & (x == column)
                state = state.at[box].set(jnp.where(pushed, jnp.minimum(state[box] + 1, goal), state[box]))
            turn = jnp.where(actions[i] == own.TURN_RIGHT, 1, 0) - jnp.where(actions[i] == own.TURN_LEFT, 1, 0)
            state = state.at[3 * i].set(jnp.where(moves, x, state[3 * i]))
            state = state.at[3 * i + 1].set(jnp.where(moves, y, state[3 * i + 1]))
            state = state.at[3 * i + 2].set((state[3 * i + 2] + turn) % 4)
        large, left, right = (state[box] == goal for box in (own.LARGE_Y, own.LEFT_Y, own.RIGHT_Y))
        small = jnp.where(left, 1, 0) + jnp.where(right, 1, 0)
        reward += jnp.where(large, own.LARGE_REWARD, own.SMALL_REWARD * small)
        return state, reward, jnp.where(large, 4, jnp.where(left, 1, 0) + 2 * jnp.where(right, 1, 0))

    def observe(state):
        seen = []
        for i in range(2):
            x, y = ahead(state, i)
            there, other = content(state, x, y), 3 * (1 - i)
            teammate = (x == state[other]) & (y == state[other + 1])
            kinds = jnp.arange(5)
            box_or_cell = (kinds == there) & ~(teammate & (there == own.EMPTY))
            seen.append((box_or_cell | ((kinds == own.TEAMMATE) & teammate)).astype(jnp.float32))
        return jnp.stack(seen)

    return step, observe


JAX_WORLDS = {"findtreasure": jax_findtreasure, "pushbox": jax_pushbox}


def check_rules(name, num_steps=3000):
    """The rules in jax.numpy are those of envs/, step by step under random play; AssertionError otherwise."""
    import jax

    world = envs.make_world(name)
    step, observe = map(jax.jit, JAX_WORLDS[name](world))
    state, rng, obs = world.start.copy(), np.random.default_rng(0), np.zeros((world.num_agents, world.obs_dim), np.float32)
    for _ in range(num_steps):
        actions = rng.integers(0, world.num_actions, world.num_agents)
        found, found_reward, found_outcome = step(state, actions)
        reward, outcome = world.step(world.rules, state, actions)
        world.observe(world.rules, world.cell, state, obs)
        assert np.array_equal(found, state)
        assert np.allclose(observe(state), obs)
        assert abs(found_reward - reward) < 1e-4
        assert found_outcome == outcome
        if outcome:
            state = world.start.copy()


def run_jax(name, num_trials, num_episodes, at_once=50):
    """As run_pg; `at_once` episodes are one call of a compiled function."""
    import jax
    from jax import numpy as jnp

    check_rules(name)
    setting, world = SETTINGS[name], envs.make_world(name)
    step, observe = (jax.vmap(function) for function in JAX_WORLDS[name](world))
    start, limit, agents = jnp.array(world.start), world.max_steps, world.num_agents
    sizes = [2**k for k in range(3, (limit - 1).bit_length())] + [limit]
    widths, nets = [world.obs_dim, *setting["hidden"], world.num_actions], (num_trials, agents)

    def logits(params, obs):  # obs [.., num_trials, num_agents, obs_dim]
        for k, (weights, bias) in enumerate(params):
            obs = jnp.einsum("...kai,kaij->...kaj", jax.nn.relu(obs) if k else obs, weights) + bias
        return obs

    def play(params, key):
        def advance(carry):
            t, key, state, running, (obs, actions, reward, played) = carry
            key, draw = jax.random.split(key)
            seen = observe(state)
            chosen = jax.random.categorical(draw, logits(params, seen))
            after, gain, outcome = step(state, chosen)
            kept = (seen, chosen, jnp.where(running, gain, 0.0), running)
            memory = [old.at[t].set(new) for old, new in zip((obs, actions, reward, played), kept, strict=True)]
            return t + 1, key, jnp.where(running[:, None], after, state), running & (outcome == 0), memory

        memory = [jnp.zeros((limit, *nets, world.obs_dim)), jnp.zeros((limit, *nets), int)]
        memory += [jnp.zeros((limit, num_trials)), jnp.zeros((limit, num_trials), bool)]
        first = (0, key, jnp.tile(start, (num_trials, 1)), jnp.ones(num_trials, bool), memory)
        longest, *_, memory = jax.lax.while_loop(lambda carry: (carry[0] < limit) & carry[3].any(), advance, first)
        return longest, memory

    def gradient(size, params, memory):
        obs, actions, reward, played = (part[:size] for part in memory)
        _, returns = jax.lax.scan(lambda g, r: (r + setting["gamma"] * g,) * 2, jnp.zeros(num_trials), reward, reverse=True)
        weights = (returns * played / played.sum(0))[:, :, None]

        def loss(params):
            log_probs = jax.nn.log_softmax(logits(params, obs))
            return -(weights * jnp.take_along_axis(log_probs, actions[..., None], -1)[..., 0]).sum()

        return jax.grad(loss)(params)

    def episode(carry, _):
        params, first, second, count, key = carry
        key, draw = jax.random.split(key)
        longest, memory = play(params, draw)
        branches = [lambda p, m, size=size: gradient(size, p, m) for size in sizes]
        grads = jax.lax.switch(jnp.searchsorted(jnp.array(sizes), longest), branches, params, memory)
        count += 1
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, grads)
        second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, second, grads)
        rate, root = setting["learning_rate"] / (1 - 0.9**count), jnp.sqrt(1 - 0.999**count)
        params = jax.tree.map(lambda p, m, v: p - rate * m / (jnp.sqrt(v) / root + 1e-8), params, first, second)
        return (params, first, second, count, key), (memory[2].sum(0), memory[3].sum())

    episodes = jax.jit(lambda carry: jax.lax.scan(episode, carry, None, length=at_once))
    rng, params = np.random.default_rng(1), []
    for n, m in pairwise(widths):
        shapes = (*nets, n, m), (*nets, m)
        params.append([jnp.array(rng.uniform(-(n**-0.5), n**-0.5, shape), jnp.float32) for shape in shapes])
    zeros = jax.tree.map(jnp.zeros_like, params)
    carry = (params, zeros, zeros, 0.0, jax.random.key(1))
    jax.block_until_ready(episodes(carry))  # compiles
    returns, steps, began = [], 0, time.process_time()
    for _ in range(-(-num_episodes // at_once)):
        carry, (earned, played) = episodes(carry)
        returns, steps = [*returns, np.asarray(earned)], steps + int(played.sum())
    return np.concatenate(returns).T, steps, time.process_time() - began


def run_torchrl(name, num_trials, num_episodes):
    """As run_pg; TorchRL on the PettingZoo face."""
    from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
    from torchrl.envs import PettingZooWrapper
    from torchrl.envs.utils import MarlGroupMapType
    from torchrl.modules import MultiAgentMLP, ProbabilisticActor

    setting, world = SETTINGS[name], envs.make_world(name)
    env = PettingZooWrapper(envs.make(name), group_map=MarlGroupMapType.ALL_IN_ONE_GROUP, use_mask=False)
    (group,) = env.group_map
    returns, steps, start = np.zeros((num_trials, num_episodes)), 0, time.process_time()
    for trial in range(num_trials):
        torch.manual_seed(trial)
        sizes = dict(n_agent_inputs=world.obs_dim, n_agent_outputs=world.num_actions, n_agents=world.num_agents)
        kind = dict(centralized=False, share_params=False, activation_class=torch.nn.ReLU, num_cells=list(setting["hidden"]))
        network = TensorDictModule(MultiAgentMLP(**sizes, **kind), [(group, "observation")], [(group, "logits")])
        actor = ProbabilisticActor(
            TensorDictSequential(network),
            in_keys=[(group, "logits")],
            out_keys=[(group, "action")],
            distribution_class=torch.distributions.Categorical,
            default_interaction_type=InteractionType.RANDOM,  # draw, where its default is the mode
        )
        optimizer = torch.optim.Adam(actor.parameters(), lr=setting["learning_rate"])
        for episode in range(num_episodes):
            with torch.no_grad():
                data = env.rollout(world.max_steps, actor)
            rewards = data["next", group, "reward"][:, 0, 0].numpy()
            log_probs = actor.get_dist(data).log_prob(data[group, "action"]).sum(-1)
            loss = -(to_go(rewards, setting["gamma"]) * log_probs).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            returns[trial, episode], steps = rewards.sum(), steps + len(rewards)
    return returns, steps, time.process_time() - start


def main(episodes: int = 500):
    """Measure and print.

    Args:
        episodes: training episodes of each trial
    """
    envs.check_whole("--episodes", episodes, minimum=1)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # all threads of all libraries share one core
    torch.set_num_threads(1)
    head = ["what", "return at the end", "1 trial: us per step", ": pg", "20 trials: us per step", ": pg"]
    for world in SETTINGS:
        rows, base = [], {}
        for peer, package, run in (
            ("pg", "torch", run_pg),
            ("loop", "torch", run_loop),
            ("jax", "jax", run_jax),
            ("torchrl", "torchrl", run_torchrl),
        ):
            if importlib.util.find_spec(package) is None:
                print(f"{peer} is left out, because {package} is not installed (benchmark/peers-requirements.txt).")
                continue
            together = run in (run_pg, run_jax)
            measured = {n: run(world, n, episodes) for n in ((1, 20) if together else (ALONE,))}
            cost = {n: seconds / steps for n, (_, steps, seconds) in measured.items()}
            cost = cost if together else dict.fromkeys((1, 20), cost[ALONE])
            base = base or cost
            returns = next(reversed(measured.values()))[0]
            rows.append([peer, f"{returns[:, -max(1, episodes // 10) :].mean():.2f}"])
            rows[-1] += [word for n in (1, 20) for word in (f"{cost[n] * 1e6:.1f}", f"{cost[n] / base[n]:.2f}")]
        print_table(f"REINFORCE in {world}, {episodes} episodes, processor time on one core:", head, rows)


if __name__ == "__main__":
    with command_line("peers.py"):
        tyro.cli(main)
