"""benchmark.sh --slurm on a real Slurm with two nodes: a requeued task and a lost node change nothing in the results."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from benchmark import compare
from benchmark.cells import ROOT, select

MISSING = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
pytestmark = pytest.mark.skipif(bool(MISSING), reason="Slurm is not installed (Debian: slurm-wlm and munge)")
SELECTION = "--algos pg decespg --envs findtreasure --optimizers sign --seeds 5 --episodes 6000 --checkpoint-every 0"


@pytest.fixture
def slurm():
    """A running Slurm; yields a function that runs one of its commands."""
    folder = Path(tempfile.mkdtemp(prefix="slurm"))  # the path of munge's socket has to be short
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf"), "PYTHON": sys.executable}

    def run(*words, check=True):
        done = subprocess.run([str(word) for word in words], env=environment, cwd=ROOT, capture_output=True, text=True)
        assert not check or done.returncode == 0, done.stderr
        return done.stdout.strip()

    run(ROOT / "tests" / "slurm_up.sh", folder)
    yield run
    if jobs := run("squeue", "-h", "-o", "%A").split():
        run("scancel", *jobs)
        wait_until(lambda: not run("squeue", "-h"), 30)
    for number in reversed((folder / "pids").read_text(encoding="utf-8").split()):
        os.kill(int(number), signal.SIGTERM)
    shutil.rmtree(folder, ignore_errors=True)


def wait_until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def cells(runs):
    block = dict(first_seed=5, num_trials=1, num_episodes=6000)
    return select(["pg", "decespg"], ["findtreasure"], ["sign"], **block, runs=runs)


def test_a_requeued_task_and_a_lost_node_change_nothing(slurm, tmp_path):
    slurm("./benchmark.sh", *SELECTION.split(), "--runs", tmp_path / "here", "--jobs", 2)
    job = slurm("./benchmark.sh", *SELECTION.split(), "--runs", tmp_path / "there", "--slurm").split()[-1]
    pg, decespg = cells(tmp_path / "there")
    task = f"{job}_1"  # decespg is the second cell of the selection

    def says(what):
        return slurm("squeue", "-h", "-r", "-j", task, "-o", what)

    def comes_back(node):
        """Ask for it while the node is down; that fails if it comes back by itself in this moment (ReturnToService)."""
        down = "down" in slurm("sinfo", "-h", "-n", node, "-o", "%T")
        if down:
            slurm("scontrol", "update", f"NodeName={node}", "State=RESUME", check=False)
        return not down

    def interrupt(*command):
        """Interrupt the task after 100 more episodes; Slurm starts it again after some seconds."""
        last = compare.progress(decespg)
        wait_until(lambda: compare.progress(decespg) >= last + 100, 90)
        slurm("scontrol", *command)
        wait_until(lambda: says("%T") == "PENDING", 30)

    interrupt("requeue", task)
    wait_until(lambda: says("%T") == "RUNNING", 30)
    node = says("%N")
    interrupt("update", f"NodeName={node}", "State=DOWN", "Reason=test")
    wait_until(lambda: comes_back(node), 30)
    wait_until(lambda: pg.finished and decespg.finished, 120)

    assert decespg.log.read_text(encoding="utf-8").count(" 0/6000 [00:00<?, ?ep/s, compiling") == 1  # it never began anew
    assert "Restarts=2" in slurm("scontrol", "-o", "show", "job", task)
    for here, there in zip(cells(tmp_path / "here"), (pg, decespg), strict=True):
        with np.load(here.run_dir / "episodes.npz") as expected, np.load(there.run_dir / "episodes.npz") as found:
            assert all(np.array_equal(expected[name], found[name]) for name in ("returns", "lengths", "outcomes"))
    said = slurm("./benchmark.sh", *SELECTION.split(), "--runs", tmp_path / "there", "--slurm")
    assert said == "All cells are finished or running."
