"""Watch an episode of a world in the terminal, or play it.

    python -m envs pushbox                              random play
    python -m envs findtreasure observation=own --keys  by the keyboard

After every step it prints the map, what each agent observes and what the team earned.
"""

import time
from dataclasses import dataclass
from string import ascii_lowercase, digits

import numpy as np
import tyro

import envs
from envs.command import command_line


@dataclass
class Args:
    world: tyro.conf.Positional[str]
    """cleaner, climbing, findtreasure, gotogether, movebox, passage, pushbox or secretroom, or a file such as my_world.py"""
    options: tyro.conf.Positional[tuple[str, ...]] = ()
    """options of the world, such as size=6 (envs/<world>.py lists them)"""
    keys: bool = False
    """play by the keyboard: a line with one letter for each agent; otherwise actions are drawn at random"""
    seed: int = 0
    """seed of random play"""
    delay: float = 0.2
    """seconds between two steps of random play"""


def play(args: Args):
    """Play one episode and print all of it, until its end or that of the keyboard's input."""
    env = envs.make(args.world, render_mode="ansi", **envs.parse_options(args.options))
    rng = np.random.default_rng(envs.check_whole("--seed", args.seed, minimum=0))
    delay = envs.check_number("--delay", args.delay, lowest=0, highest=3600)
    letters = letters_of(env.world.action_names) if args.keys else {}
    obs, _ = env.reset()
    print(describe(env, obs))
    total, steps = 0.0, 0
    while env.agents:
        if args.keys:
            actions = ask(env, letters)
            if actions is None:
                print(f"\nstopped after {steps} step{'s' * (steps != 1)}, return {total:g}")
                return
        else:
            time.sleep(delay)
            actions = rng.integers(env.world.num_actions, size=env.num_agents)
        obs, rewards, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        reward, outcome = rewards["agent_0"], infos["agent_0"]["outcome"]
        env.world.check_outcomes(outcome)
        total, steps = total + reward, steps + 1
        done = ", ".join(f"agent {i} {env.world.action_names[action]}" for i, action in enumerate(actions))
        print(f"\nstep {steps}: {done}; the team earned {reward:g} ({total:g} so far)\n{describe(env, obs)}")
    end = ("time limit", *env.world.outcome_names)[outcome]
    length = f"{steps} step{'s' * (steps != 1)}"
    print(f"\nend: {end} after {length}, return {total:g}, {envs.reward_per_step(total, steps):.2f} per step")


def describe(env, obs):
    """The map, and a line for each agent on what it observes: the numbers, and in brackets what they mean."""
    lines = [env.render()]
    for i, numbers in enumerate(obs.values()):
        meaning = ""
        if env.world.sights:
            meaning = " and ".join(sight for sight, seen in zip(env.world.sights, numbers, strict=True) if seen)
        elif isinstance(env.world, envs.PositionWorld):
            places = np.rint(numbers / env.world.cell).astype(int).reshape(-1, 2)
            meaning = " ".join(f"({row}, {column})" for row, column in places)
        lines.append(f"agent {i} observes {' '.join(f'{number:.3g}' for number in numbers)}{meaning and f'  [{meaning}]'}")
    return "\n".join(lines)


def letters_of(names):
    """A letter for every action, {letter: action}, if possible of its last word; UsageError if there are too many actions."""
    letters, others = {}, ascii_lowercase + digits
    if len(names) > len(others):
        raise envs.UsageError(f"--keys has letters for at most {len(others)} actions, and this world has {len(names)}.")
    for action, name in enumerate(names):
        wanted = [letter for letter in name.split()[-1].lower() if letter in others]
        letters[next(letter for letter in (*wanted, *others) if letter not in letters)] = action
    return letters


def ask(env, letters):
    """The joint action that a line from the keyboard says, or None if there are no more lines."""
    names = ", ".join(f"{letter} {env.world.action_names[action]}" for letter, action in letters.items())
    while True:
        try:
            line = input(f"{names}; a letter for each agent: ").strip().lower()
        except EOFError:
            return None
        if len(line) == env.num_agents and set(line) <= set(letters):
            return [letters[letter] for letter in line]
        example = ("".join(letters) * env.num_agents)[: env.num_agents]
        print(f"type {env.num_agents} of the letters {''.join(letters)} and Enter, such as {example}")


def main():
    with command_line("python -m envs"):
        play(tyro.cli(Args, prog="python -m envs", description=__doc__))


if __name__ == "__main__":
    main()
