"""Does the decentralised bonus scale with the number of agents, and what does a longer window cost?

    python benchmark/scaling.py                          # prints two tables; --num-episodes 100 for a look

Agents: decespg.py and espg.py clean the maze with 2, 4 and 8 agents; 5 trials, sign descent, beta as tuned for two agents.
Windows: microseconds per remembered visit, along random play in findtreasure.
"""

import importlib
import sys
import time
from pathlib import Path
from unittest.mock import patch

import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import envs
from benchmark.cells import train_aside
from benchmark.speed import bonus_speed, print_table
from envs.command import command_line

TRIALS = 5


def clean(method, num_agents, observation, num_episodes):
    """Train on cleaner: [ms per step of a team, ms of it for the bonus, kB that the windows of a team take, share cleaned]."""
    script = importlib.import_module(f"algos.{method}")
    options, spent = (f"num_agents={num_agents}", f"observation={observation}"), []
    bonus = script.VisitNovelty.bonus

    def timed(*args):
        start = time.perf_counter()
        result = bonus(*args)
        spent.append(time.perf_counter() - start)
        return result

    args = dict(env="cleaner", env_args=options, num_trials=TRIALS, seed=1000)
    with patch.object(script.VisitNovelty, "bonus", timed):
        train_aside(script, num_episodes=1, **args)  # compiles
        spent.clear()
        start = time.perf_counter()
        run = train_aside(script, num_episodes=num_episodes, **args)
        seconds = time.perf_counter() - start
    steps = run.log.lengths.sum()
    memory = sum(array.nbytes for array in run.novelty.state) / TRIALS / 1000
    cells = envs.optimum("cleaner").best_return.total
    cleaned = run.log.returns[:, envs.last_episodes(num_episodes)].mean() / cells
    return [f"{seconds / steps * 1e3:.3f}", f"{sum(spent) / steps * 1e3:.4f}", f"{memory:.0f}", f"{cleaned:.0%}"]


def main(num_episodes: int = 1000, windows: tuple[int, ...] = (50, 200, 800)):
    """Measure and print.

    Args:
        num_episodes: training episodes of each trial on cleaner
        windows: lengths m of the window
    """
    envs.check_whole("--num-episodes", num_episodes, minimum=1)
    for m in windows:
        envs.check_memory(f"a window of {envs.check_whole('--windows', m, minimum=1)}", 16 * m * m)
    rows = [
        [method, observation, agents, *clean(method, agents, observation, num_episodes)]
        for observation in ("positions", "own")
        for method in ("espg", "decespg")
        for agents in (2, 4, 8)
    ]
    head = ["script", "observation", "agents", "ms per step", "of it the bonus", "windows, kB", "maze cleaned"]
    print_table(f"Number of agents, cleaner, {num_episodes} episodes:", head, rows)
    rows = [[m, f"{bonus_speed(m, visits=max(2000, 20 * m)):.1f}"] for m in windows]
    print_table("Length of the window:", ["window m", "microseconds per visit"], rows)


if __name__ == "__main__":
    with command_line("scaling.py"):
        tyro.cli(main, description=__doc__)
