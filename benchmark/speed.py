"""Speed on one core: the worlds, the scripts at 1 and 20 trials, the exploration bonus, and start-up.

    python benchmark/speed.py                            # some minutes; --quick for a tenth of the episodes
    python benchmark/speed.py pg decespg ac coma         # other scripts beside these two

Prints tables of figures and of their ratios, all from this one run. Seconds are those of the processor (of the clock for the
start-up only), so that other programs disturb little; run it on an otherwise idle machine all the same.
"""

import importlib
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Annotated
from unittest.mock import patch

import numpy as np
import torch
import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import envs
from benchmark.cells import train_aside
from envs.command import command_line

EPISODES = {"findtreasure": 10_000, "pushbox": 20_000}  # Table 1
EARLY = {"findtreasure": 200, "pushbox": 200, "gotogether": 20, "movebox": 60}  # in which teams still explore
NOVELTIES = ("decespg_ex2", "espg_icm", "espg_emi")  # DecESPG or ESPG with another exploration bonus


def print_table(title, head, rows):
    """A Markdown table."""
    print(f"\n{title}\n\n| {' | '.join(map(str, head))} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |", flush=True)


def world_speed(name, num_envs, seconds=1.0):
    """Environment steps per second of the vector face under random play, resets included."""
    env = envs.make_vec(name, num_envs)
    rng = np.random.default_rng(0)
    actions = rng.integers(0, env.world.num_actions, (env.world.max_steps, num_envs, env.world.num_agents))
    env.reset()
    env.step(actions[0])
    steps, start = 0, time.process_time()
    while time.process_time() - start < seconds:
        env.reset()
        for joint in actions:
            env.step(joint)
        steps += len(actions) * num_envs
    return steps / (time.process_time() - start)


def script_speed(method, env, num_trials, num_episodes, **changed):
    """Seconds of a training run and its useful steps (of trials whose episode still runs) per second; `changed` arguments."""
    script = importlib.import_module(f"algos.{method}")
    args = dict(env=env, num_trials=num_trials, **changed)
    train_aside(script, num_episodes=2, **args)  # compiles
    start = time.process_time()
    steps = train_aside(script, num_episodes=num_episodes, **args).log.lengths.sum()
    seconds = time.process_time() - start
    return seconds, steps / seconds


def novelty_speed(method, env, num_episodes):
    """Seconds of DecESPG and of a script with another exploration bonus, 20 trials, for the same episodes.

    Both play the same if the bonus, which is computed all the same, does not count in the reward, and the rest is DecESPG's.
    """
    silent = {**importlib.import_module("algos.decespg").TUNED[env, "sign"], "beta": 0.0}
    seconds, rate = script_speed("decespg", env, 20, num_episodes, **silent)
    own_seconds, own_rate = script_speed(method, env, 20, num_episodes, **silent)
    assert round(seconds * rate) == round(own_seconds * own_rate), "the episodes differ"
    return seconds, own_seconds


def bonus_speed(window, visits=20_000):
    """Microseconds per remembered visit of DecESPG's Gaussian process, along random play in findtreasure."""
    script, env = importlib.import_module("algos.decespg"), envs.make_vec("findtreasure")
    world, rng = env.world, np.random.default_rng(0)
    obs = np.zeros((visits, 1, world.num_agents, world.obs_dim), np.float32)
    actions = rng.integers(0, world.num_actions, (visits, 1, world.num_agents))
    for t in range(visits):
        if t % world.max_steps == 0:
            obs[t], _ = env.reset()
        if t + 1 < visits:
            obs[t + 1] = env.step(actions[t])[0]
    pairs = np.concatenate([np.eye(world.num_actions, dtype=np.float32)[actions], obs], axis=3)
    novelty = script.VisitNovelty(1, world.num_agents, pairs.shape[3], window, 0.5 * world.cell, 0.01)
    novelty.bonus(pairs[:window], np.array([window]))
    start = time.process_time()
    novelty.bonus(pairs, np.array([visits]))
    return (time.process_time() - start) / (visits * world.num_agents) * 1e6


def update_profile(method, env, num_episodes=200):
    """Shares of a run's time that play, the networks' forward and backward pass and the optimiser take."""
    script = importlib.import_module(f"algos.{method}")
    script_speed(method, env, 20, 2)  # so that loading what is compiled does not count
    seconds = dict.fromkeys(("play", "forward", "backward", "optimiser"), 0.0)

    def timed(what, function):
        def call(*args, **options):
            start = time.process_time()
            result = function(*args, **options)
            seconds[what] += time.process_time() - start
            return result

        return call

    with (
        patch.object(envs.Rollout, "play", timed("play", envs.Rollout.play)),
        patch.object(script.StackedMLP, "__call__", timed("forward", script.StackedMLP.__call__)),
        patch.object(torch.Tensor, "backward", timed("backward", torch.Tensor.backward)),
        patch.object(torch.optim.Adam, "step", timed("optimiser", torch.optim.Adam.step)),
    ):
        total, _ = script_speed(method, env, 20, num_episodes)
    return [f"{part / total:.0%}" for part in seconds.values()]


def startup_seconds(method):
    """Seconds of a whole run of two episodes with warm caches: what a user waits before training begins."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, ROOT / "algos" / f"{method}.py", "--num-episodes", "2", "--run-dir"]
        start = time.perf_counter()
        subprocess.run([*command, folder], check=True, capture_output=True)
        return time.perf_counter() - start


def main(methods: Annotated[tuple[str, ...], tyro.conf.Positional] = ("pg", "decespg"), quick: bool = False):
    """Measure and print.

    Args:
        methods: scripts of algos/ without .py, pg and decespg among them
        quick: train for a tenth of Table 1's episodes
    """
    if not {"pg", "decespg"} <= set(methods) <= {path.stem for path in (ROOT / "algos").glob("*.py")}:
        raise envs.UsageError("the methods must be scripts of algos/ without .py, pg and decespg among them.")
    copies = (1, 20, 200)
    rows = [[name, *(f"{world_speed(name, n) / 1e6:.2f}" for n in copies)] for name in envs.WORLDS]
    print_table("Million environment steps per second:", ["copies of", *copies], rows)

    rows = [[env, n, f"{script_speed('pg', env, 20, n)[1]:.0f}"] for env, n in EARLY.items()]
    print_table(
        "PG, useful environment steps per second of 20 trials in the first episodes:", ["world", "episodes", "steps/s"], rows
    )

    rows, rates = [], {}
    for method in methods:
        for env, episodes in EPISODES.items():
            episodes //= 10 if quick else 1
            one, one_rate = script_speed(method, env, 1, episodes)
            many, many_rate = script_speed(method, env, 20, episodes)
            rates[method, env] = many_rate
            rows.append([method, env, episodes, f"{one:.1f}", f"{one_rate:.0f}", f"{many:.1f}", f"{many_rate:.0f}"])
            rows[-1] += [f"{many_rate / one_rate:.1f}", f"{rates['pg', env] / many_rate:.2f}"]
    head = [
        "script",
        "world",
        "episodes",
        "1 trial: s",
        "steps/s",
        "20 trials: s",
        "steps/s",
        "20 : 1 trials",
        "time per step : pg",
    ]
    print_table("Training, useful environment steps per second:", head, rows)

    rows = []
    for method, env in product([each for each in methods if each in NOVELTIES], EPISODES):
        base, own = novelty_speed(method, env, EPISODES[env] // (10 if quick else 1))
        rows.append([method, env, f"{base:.1f}", f"{own:.1f}", f"{own / base:.2f}"])
    head = ["script", "world", "decespg: s", "script: s", "script : decespg"]
    print_table("Other bonuses, for the same episodes (beta 0), 20 trials:", head, rows)

    visit = {m: bonus_speed(m) for m in (50, 100, 200)}
    print_table("The exploration bonus:", ["window m", "microseconds per visit"], [[m, f"{visit[m]:.1f}"] for m in visit])
    shares = [[env, f"{rates['decespg', env] * 2 * visit[50] / 1e6:.0%}"] for env in EPISODES]  # two agents remember each step
    print_table("Its share of DecESPG's time at 20 trials:", ["world", "share"], shares)
    rows = [[method, env, *update_profile(method, env)] for method in ("pg", "decespg") for env in ("cleaner", "movebox")]
    head = ["script", "world", "play", "forward", "backward", "optimiser"]
    print_table("Where the time of the 256-128 networks goes, 20 trials:", head, rows)
    rows = [[method, f"{startup_seconds(method):.1f}"] for method in methods]
    print_table("Start-up, with two episodes:", ["script", "seconds"], rows)


if __name__ == "__main__":
    with command_line("speed.py"):
        tyro.cli(main, description=__doc__)
