"""Run the comparison, cell by cell; `./benchmark.sh` calls it.

A cell is a script on a world with one optimiser and a block of seeds (20 trials by default), one process on one core. Cells
whose result is there are skipped, interrupted ones go on from their checkpoint: kill this at any moment and call it again.
"""

import contextlib
import dataclasses
import fcntl
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark import results
from benchmark.cells import BEYOND, METHODS, OPTIMIZERS, ROOT, RUNS, WORLDS, path_of, seconds_of, seeds_of, select
from envs.command import Forgiving, command_line
from envs.run import HOUSEKEEPING

TOLD = ("env", "env_args", "seed", "num_trials", "num_episodes", "optimizer")  # by options of ./benchmark.sh
ROOM = 100_000  # bytes without which a cell cannot even say what is wrong


@dataclass
class Args:
    algos: tuple[str, ...] = tuple(METHODS)
    """scripts of algos/ without .py, or files such as my_method.py"""
    envs: tuple[str, ...] = WORLDS
    """worlds, or files such as my_world.py"""
    optimizers: tuple[Literal["sign", "adam"], ...] = OPTIMIZERS
    """optimisers of the policies"""
    seeds: str = "1-20"
    """first and last seed; all trials of a cell run side by side in one process"""
    episodes: int | None = None
    """training episodes of each trial (None: Table 1); a smoke run: --episodes 50"""
    env_args: tuple[str, ...] = ()
    """options of the world, in all cells, such as size=6"""
    args: tuple[str, ...] = ()
    """arguments of the scripts, with one value or several to try: beta=0.1,0.3 learning_rate=1e-3,1e-4 are four cells each"""
    jobs: int | None = None
    """cells that run at the same time, one core each (None: the variable JOBS, or else one for each core)"""
    checkpoint_every: float = 60.0
    """seconds between two checkpoints of a cell"""
    runs: Path = RUNS
    """directory under which the cells work"""
    overwrite: bool = False
    """run the selected cells anew, also those that are finished or stopped"""
    dry_run: bool = False
    """only list the cells, their numbers and states"""
    status: bool = False
    """only show where the cells are"""
    slurm: bool = False
    """submit the cells that are not finished to Slurm, as one job array (benchmark/cell.sbatch)"""
    cell: int | None = None
    """run exactly the cell of this number in the selection's list: the contract for every scheduler"""


@cache
def pace():
    """Seconds per episode of 20 trials, {(method, world): seconds}, as the kept results took."""
    return results.seconds_per_episode(results.kept())


def remaining_seconds(cell, done=0):
    """A guess of how long a cell still takes after `done` episodes; nearly in proportion to the trials."""
    return pace().get((cell.method, cell.world), 0.05) * (cell.settings["num_episodes"] - done) * cell.num_trials / 20


def progress(cell):
    """Episodes that the last progress bar in a cell's output counts; 0 if there is none."""
    try:
        with cell.log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 2000))
            counts = re.findall(rb"(\d+)/\d+ \[", file.read())
    except OSError:
        return 0
    return int(counts[-1]) if counts else 0


def last_line(cell):
    """The last line of a cell's output."""
    lines = cell.log.read_text(encoding="utf-8", errors="replace").replace("\r", "\n").split("\n") if cell.log.exists() else []
    full = "no output, for the disk is full"
    silent = full if cell.run_dir.exists() and shutil.disk_usage(cell.run_dir).free < ROOM else "no output"
    return next((line.strip() for line in reversed(lines) if line.strip()), silent)


@contextlib.contextmanager
def owned(cell, wait=True):
    """Own a cell's directory: yields an open file whose lock lasts as long as any process holds it, None if another does."""
    cell.run_dir.mkdir(parents=True, exist_ok=True)
    with (cell.run_dir / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield None
            return
        yield file


def state(cell):
    """finished, broken, running, stopped (it has a checkpoint), failed or new."""
    if cell.finished:
        return "finished"
    if not cell.run_dir.exists():
        return "new"
    with owned(cell, wait=False) as lock:
        if lock is None:
            return "running"
    if cell.broken:
        return "broken"
    if (cell.run_dir / "exit_code").exists():
        return "failed"
    return "stopped" if (cell.run_dir / "checkpoint.pt").exists() else "new"


class Job:
    """A cell that is being run: its process, and how it ended."""

    def __init__(self, cell, checkpoint_every):
        self.cell, self.checkpoint_every = cell, checkpoint_every
        self.process, self.code, self.seconds, self.stopped = None, None, 0.0, False
        self.trouble = ""  # what kept this runner, not the script, from its work

    def run(self):
        """Run the cell from where it stands, unless it is finished; waits for another process that runs it already."""
        try:
            self._run()
        except OSError as error:  # a full disk, a directory without permission; what the script has done counts all the same
            self.trouble = f"cannot use {error.filename or self.cell.run_dir}: {error.strerror}"
            self.code = 2 if self.code is None else self.code

    def _run(self):
        cell, start = self.cell, time.monotonic()
        with owned(cell) as lock:
            if cell.finished or self.stopped:
                self.code = 0 if cell.finished else -signal.SIGTERM
                return
            (cell.run_dir / "exit_code").unlink(missing_ok=True)
            resume = (cell.run_dir / "checkpoint.pt").exists() and not cell.broken
            command = [*cell.command, "--checkpoint-every", str(self.checkpoint_every)]
            command.append("--resume" if resume else "--overwrite")
            told = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
            # A script may stand anywhere, and finds envs/ all the same.
            told["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
            with cell.log.open("ab" if resume else "wb") as log:
                # The script inherits the lock: should this runner die, nobody else starts the cell while the script goes on.
                kinds = dict(stdout=log, stderr=log, cwd=ROOT, env={**os.environ, **told}, pass_fds=[lock.fileno()])
                self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, **kinds)
            if self.stopped:  # while the process was being made, when there was nobody to tell
                self.process.send_signal(signal.SIGTERM)
            self.code = self.process.wait()
            self.seconds = time.monotonic() - start
            before = seconds_of(cell.run_dir) if resume else 0.0
            (cell.run_dir / "seconds").write_text(f"{before + self.seconds:.1f}\n")
            if self.code != 0 and not self.stopped:
                (cell.run_dir / "exit_code").write_text(f"{self.code}\n")

    def stop(self):
        """Ask for a checkpoint and the end."""
        self.stopped = True
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)


class Runner:
    """Runs cells, `jobs` at a time, the longest first, and shows how far they are."""

    def __init__(self, cells, jobs, checkpoint_every):
        cells = sorted(cells, key=lambda cell: -remaining_seconds(cell, progress(cell)))
        self.waiting = [Job(cell, checkpoint_every) for cell in cells]
        self.jobs, self.running, self.ended = jobs, {}, []
        self.stopping = 0  # the number of the signal that asked for it
        self.lines, self.began = 0, time.monotonic()

    def run(self):
        """Run all; returns the jobs in the order of their ends."""
        handlers = {s: signal.signal(s, self._stop) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            while self.running or (self.waiting and not self.stopping):
                while self.waiting and len(self.running) < self.jobs and not self.stopping:
                    job = self.waiting.pop(0)
                    self.running[job] = threading.Thread(target=job.run, daemon=True)
                    self.running[job].start()
                time.sleep(0.2)
                for job in [job for job, thread in self.running.items() if not thread.is_alive()]:
                    del self.running[job]
                    self.ended.append(job)
                    how = "finished" if job.code == 0 else "stopped" if job.stopped else f"FAILED with code {job.code}"
                    self._say(f"{job.cell.name}: {how} after {clock(job.seconds)}")
                self._show()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        return self.ended

    def _stop(self, number, _):
        self.stopping = number
        for job in self.running:
            job.stop()

    def _say(self, line):
        self._clear()
        print(line, flush=True)

    def _clear(self):
        if self.lines:
            print(f"\x1b[{self.lines}A\x1b[J", end="")
            self.lines = 0

    def _show(self):
        """A line for every running cell and one for all, rewritten in place; nothing where nobody looks."""
        if not sys.stdout.isatty():
            return
        self._clear()
        lines, left = [], sum(remaining_seconds(job.cell) for job in self.waiting)
        for job in self.running:
            done, total = progress(job.cell), job.cell.settings["num_episodes"]
            left += remaining_seconds(job.cell, done)
            lines.append(f"  {job.cell.name:<60} {done:>6}/{total} {done / total:4.0%}")
        ended, total = len(self.ended), len(self.ended) + len(self.running) + len(self.waiting)
        lines.append(f"{ended} of {total} cells, {clock(time.monotonic() - self.began)}, about {clock(left / self.jobs)} left")
        print("\n".join(lines), flush=True)
        self.lines = len(lines)


def clock(seconds):
    """h:mm:ss"""
    return f"{int(seconds) // 3600}:{int(seconds) // 60 % 60:02d}:{int(seconds) % 60:02d}"


def jobs_of(args):
    """How many cells run at the same time."""
    if args.jobs is not None:
        return envs.check_whole("--jobs", args.jobs, minimum=1)
    text = os.environ.get("JOBS") or str(os.cpu_count() or 1)
    if not re.fullmatch(r"[0-9]{1,9}", text) or int(text) < 1:
        raise envs.UsageError(f"the variable JOBS must be a whole number of at least 1, not {text!r}.")
    return int(text)


def selection(args):
    """The cells that the arguments select."""
    for word in args.algos:
        if not path_of(word).is_file():
            others = ", ".join(METHODS | BEYOND)
            raise envs.UsageError(f"there is no script {word!r}; there is {others}, or a file such as my_method.py.")
    for word in args.envs:
        if word not in envs.WORLDS and not (word.endswith(".py") and Path(word).is_file()):
            others = ", ".join(envs.WORLDS)
            raise envs.UsageError(f"there is no world {word!r}; there is {others}, or a file such as my_world.py.")
    seeds = seeds_of(args.seeds)
    if args.episodes is not None:
        envs.check_whole("--episodes", args.episodes, minimum=1)
    envs.check_number("--checkpoint-every", args.checkpoint_every, lowest=0)
    if args.runs.exists() and not args.runs.is_dir():
        raise envs.UsageError(f"--runs must be a directory, which {args.runs} is not.")
    block = dict(first_seed=seeds[0], num_trials=seeds[1] - seeds[0] + 1, num_episodes=args.episodes, runs=args.runs.absolute())
    cells = select(args.algos, args.envs, args.optimizers, env_args=args.env_args, **block)
    cells = [dataclasses.replace(cell, own=own) for cell in cells for own in combinations(args.args)]
    if not cells:
        raise envs.UsageError("nothing is selected; methods without --optimizer, Q-learning and PPO, are run under adam only.")
    for cell in cells:
        cell.settings  # noqa: B018 - what is impossible is said before anything runs
    return cells


def combinations(words):
    """All ways to choose a value for each argument: beta=0.1,0.3 gives (("beta", "0.1"),) and (("beta", "0.3"),)."""
    choices = []
    for word in words:
        name, equals, values = word.partition("=")
        if not equals or not re.fullmatch(r"[a-z_]+", name) or not all(values.split(",")):
            raise envs.UsageError(f"--args must be written argument=value or argument=value,value, not {word!r}.")
        if name in (*TOLD, *HOUSEKEEPING):
            raise envs.UsageError(f"--args must be arguments of the method, which {name!r} is not.")
        choices.append([(name, value) for value in values.split(",")])
    return list(product(*choices))


def show_table(cells):
    """What the finished cells have reached, as benchmark/plot.py says it."""
    from benchmark import plot  # matplotlib takes a second, which no scheduler needs to wait

    if finished := [cell.run_dir for cell in cells if cell.finished]:
        scores, differences = plot.tables(plot.groups_of(plot.read(finished)))
        print("", plot.markdown(scores), *([plot.markdown(differences)] if len(differences) > 1 else []), sep="\n\n")


def show_states(cells):
    """A line for every cell: number, name, state."""
    for number, cell in enumerate(cells):
        word = state(cell)
        detail = cell.broken if word == "broken" else last_line(cell) if word == "failed" else ""
        if word in ("running", "stopped"):
            detail = f"{progress(cell)} of {cell.settings['num_episodes']} episodes"
        print(f"{number:>4}  {cell.name:<60} {word:<9} {detail}".rstrip())


def remove(cells):
    """Remove what the cells have left, as --overwrite asks; UsageError if one of them is running."""
    there = [cell for cell in cells if cell.run_dir.exists()]
    with contextlib.ExitStack() as stack:
        for cell in there:  # all, before the first is lost
            if stack.enter_context(owned(cell, wait=False)) is None:
                raise envs.UsageError(f"{cell.name} is running; stop it before --overwrite, or wait for its end.")
        for cell in there:
            shutil.rmtree(cell.run_dir)


def submit(args, cells):
    """Submit one job array over the unfinished cells; a task runs `./benchmark.sh <the same selection> --cell <its number>`."""
    numbers = [number for number, cell in enumerate(cells) if state(cell) not in ("finished", "running")]
    if not numbers:
        return print("All cells are finished or running.")
    own = [word for word in sys.argv[1:] if word not in ("--slurm", "--overwrite")]
    files = {str(word): str(path_of(word)) for word in (*args.algos, *args.envs) if word.endswith(".py")}
    selected = [*(files.get(word, word) for word in own), "--runs", str(args.runs.absolute())]  # the caller's, wherever it runs
    (ROOT / "runs" / "slurm").mkdir(parents=True, exist_ok=True)
    command = ["sbatch", f"--array={','.join(map(str, numbers))}", "benchmark/cell.sbatch", *selected]
    try:
        subprocess.run(command, cwd=ROOT, check=True)
    except FileNotFoundError as error:
        raise envs.UsageError("there is no sbatch on this machine; --slurm needs the commands of Slurm.") from error
    except subprocess.CalledProcessError as error:
        reason = f"sbatch refused with code {error.returncode}"
        raise envs.UsageError(f"{reason}; the three lines to adapt stand in benchmark/cell.sbatch.") from error


def report(skipped, jobs, waiting, signal_number):
    """What became of the cells; returns the exit code, after a signal what shells say of it."""
    failed = [job for job in jobs if job.code != 0 and not job.stopped]
    finished = [job for job in jobs if job.code == 0]
    rest = len(waiting) + len(jobs) - len(failed) - len(finished)
    print(f"\n{len(finished)} finished, {len(failed)} failed, {len(skipped)} skipped (finished before), {rest} not finished")
    for job in failed:
        print(f"  {job.cell.name}: code {job.code}: {job.trouble or last_line(job.cell)}")
        print(f"    again: {shlex.join([*job.cell.command, '--overwrite'])}")
    return 1 if failed else 128 + signal_number if rest else 0


def main():
    """The command line."""
    with command_line("benchmark.sh"):
        run(tyro.cli(Args, prog="benchmark.sh", description=__doc__))


def run(args):
    """Run, list or show the cells of a selection; UsageError for what is impossible."""
    cells, jobs = selection(args), jobs_of(args)
    if args.dry_run or args.status:
        return show_states(cells)
    if args.cell is not None and not args.slurm:
        if not 0 <= args.cell < len(cells):
            raise envs.UsageError(f"--cell must be a number between 0 and {len(cells) - 1}, not {args.cell}.")
        cells = [cells[args.cell]]
    if args.overwrite:
        remove(cells)
    with contextlib.redirect_stdout(Forgiving(sys.stdout)):  # no cell is left out because nobody listens
        for cell in cells:
            if cell.broken:
                print(f"{cell.broken}; it is run again.")
            elif cell.edited:
                did = "has finished" if cell.finished else "has begun"
                print(f"{cell.name} {did} before its script or its world was edited; --overwrite runs it anew.")
        if args.slurm:
            return submit(args, cells)
        skipped = [cell for cell in cells if cell.finished]
        runner = Runner([cell for cell in cells if cell not in skipped], jobs, args.checkpoint_every)
        ended = runner.run()
        code = report(skipped, ended, runner.waiting, runner.stopping)
        if args.cell is None:
            show_table(cells)
            print(f"\nThe cells are under {args.runs}.")
        sys.exit(code)


if __name__ == "__main__":
    main()
