"""benchmark.sh: its cells, what it skips, runs again and goes on with, what it says of failures, and real kills."""

import dataclasses
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmark import compare, figures, report, results
from benchmark.cells import ROOT, Cell, seconds_of, select
from tests.helpers import RACE, assert_one_sentence, assert_refused, script

BLOCK = dict(first_seed=5, num_trials=2, num_episodes=6000)


def start(runs, *words):
    """Start ./benchmark.sh on two small cells, with a checkpoint after every episode; words may be more options."""
    selected = (
        "--algos pg decespg --envs findtreasure --optimizers sign --seeds 5-6 --episodes 6000 --jobs 2 --checkpoint-every 0"
    )
    command = [ROOT / "benchmark.sh", *selected.split(), "--runs", runs, *words]
    environment = {**os.environ, "PYTHON": sys.executable}
    kinds = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True)
    return subprocess.Popen([str(word) for word in command], **kinds)


def cells(runs):
    """The cells of `start`."""
    return select(["pg", "decespg"], ["findtreasure"], ["sign"], **BLOCK, runs=Path(runs))


def wait_for_episode(cell, episode, seconds=300):
    """Wait until a cell's progress bar has passed an episode."""
    deadline = time.monotonic() + seconds
    while compare.progress(cell) < episode:
        assert time.monotonic() < deadline, cell.log.read_text(encoding="utf-8") if cell.log.exists() else "nothing was started"
        time.sleep(0.02)


def process_of(cell):
    """The process number of a running cell's script."""
    found = subprocess.run(["pgrep", "-f", f"algos/{cell.method}.py.*{cell.run_dir}"], capture_output=True, text=True)
    return int(found.stdout.split()[0])


def episodes(cell):
    with np.load(cell.run_dir / "episodes.npz") as file:
        return dict(file)


def test_killed_scripts_and_runners_lose_nothing(tmp_path):
    expected = {}
    whole = start(tmp_path / "whole")
    assert whole.wait(300) == 0, whole.communicate()
    for cell in cells(tmp_path / "whole"):
        assert cell.finished
        expected[cell.method] = episodes(cell)

    # One script is killed: the other cell is finished, and the failure can't be overlooked.
    runs = tmp_path / "killed"
    pg, decespg = cells(runs)
    first = start(runs)
    wait_for_episode(decespg, 20)
    os.kill(process_of(decespg), signal.SIGKILL)
    said, _ = first.communicate(timeout=300)
    assert first.returncode == 1
    assert "1 finished, 1 failed, 0 skipped" in said
    assert f"{decespg.name}: code -9" in said
    assert "python algos/decespg.py --env findtreasure --seed 5 --num-trials 2" in said.replace(sys.executable, "python")
    assert (pg.finished, decespg.finished) == (True, False)
    assert compare.state(decespg) == "failed"

    # Runner and script are killed while the cell goes on from its checkpoint.
    finished_at, reached = (pg.run_dir / "episodes.npz").stat().st_mtime_ns, compare.progress(decespg)
    second = start(runs)
    wait_for_episode(decespg, reached + 20)
    os.killpg(second.pid, signal.SIGKILL)
    second.wait(60)
    assert not decespg.finished

    # The runner alone is killed: its script goes on, and the next runner waits for it instead of starting another.
    reached = compare.progress(decespg)
    third = start(runs)
    wait_for_episode(decespg, reached + 20)
    os.kill(third.pid, signal.SIGKILL)
    third.wait(60)
    assert compare.state(decespg) == "running"
    last = start(runs)
    said, _ = last.communicate(timeout=300)
    assert (last.returncode, "0 failed" in said, "0 not finished" in said) == (0, True, True), said
    assert decespg.log.read_text(encoding="utf-8").count("usual end") == 1
    assert (pg.run_dir / "episodes.npz").stat().st_mtime_ns == finished_at
    for cell in (pg, decespg):
        for name, values in expected[cell.method].items():
            assert np.array_equal(episodes(cell)[name], values)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_polite_stop_leaves_checkpoints(number, code, tmp_path):
    _, decespg = cells(tmp_path)
    runner = start(tmp_path)
    wait_for_episode(decespg, 5)
    runner.send_signal(number)
    said, _ = runner.communicate(timeout=300)
    assert runner.returncode == code
    assert "0 failed" in said
    assert compare.state(decespg) == "stopped"
    assert re.search(
        r"findtreasure/decespg/\S+ +stopped +\d+ of 6000 episodes", start(tmp_path, "--status").communicate(timeout=300)[0]
    )


# --- what counts as done ---


def finish(cell):
    """Let a cell look finished."""
    cell.run_dir.mkdir(parents=True, exist_ok=True)
    shape = cell.num_trials, cell.settings["num_episodes"]
    np.savez(cell.run_dir / "episodes.npz", returns=np.zeros(shape), lengths=np.ones(shape), outcomes=np.zeros(shape))
    args = {**dataclasses.asdict(script(cell.method).Args()), **cell.settings}
    about = {"method": args.pop("method"), "args": args}
    (cell.run_dir / "args.json").write_text(json.dumps(about, default=str))


@pytest.fixture
def cell(tmp_path):
    return Cell("pg", "pushbox", "sign", **BLOCK, runs=tmp_path)


def test_a_complete_result_of_the_same_settings_is_finished(cell):
    assert (cell.finished, cell.broken, compare.state(cell)) == (False, "", "new")
    finish(cell)
    assert (cell.finished, cell.broken, compare.state(cell)) == (True, "", "finished")


def test_a_broken_result_is_named_and_not_finished(cell):
    finish(cell)
    path = cell.run_dir / "episodes.npz"
    path.write_bytes(path.read_bytes()[:100])
    assert not cell.finished
    assert str(path) in cell.broken
    assert compare.state(cell) == "broken"


@pytest.mark.parametrize("wrong", [dict(num_episodes=299), dict(num_trials=3)])
def test_a_result_of_another_shape_is_broken(cell, wrong):
    finish(cell)
    other = dataclasses.replace(cell, **wrong)
    other.run_dir.mkdir(parents=True)
    for path in cell.run_dir.glob("*.*"):
        (other.run_dir / path.name).write_bytes(path.read_bytes())
    assert not other.finished
    assert "another shape" in other.broken


def test_a_result_of_other_settings_is_broken(cell):
    finish(cell)
    about = json.loads((cell.run_dir / "args.json").read_text(encoding="utf-8"))
    about["args"]["gamma"] = 0.5
    (cell.run_dir / "args.json").write_text(json.dumps(about))
    assert not cell.finished
    assert "other settings" in cell.broken


def test_other_settings_are_another_directory(cell, monkeypatch):
    others = [dict(num_episodes=200), dict(first_seed=6), dict(num_trials=3), dict(optimizer="adam"), dict(method="decespg")]
    places = {dataclasses.replace(cell, **other).run_dir for other in others}
    assert len({*places, cell.run_dir}) == 6
    monkeypatch.setitem(script("pg").TUNED, ("pushbox", "sign"), dict(learning_rate=0.5))  # a change of the defaults
    assert dataclasses.replace(cell).run_dir != cell.run_dir
    assert dataclasses.replace(cell).name == cell.name


def test_a_script_and_a_world_of_ones_own_need_no_list(tmp_path, monkeypatch, capsys):
    text = (ROOT / "algos" / "pg.py").read_text(encoding="utf-8")
    (tmp_path / "mine.py").write_text(text)
    world = ROOT / "tests" / "data" / "race.py"
    words = ["--algos", tmp_path / "mine.py", "--envs", world, "--optimizers", "sign"]
    code, said, _ = command(monkeypatch, capsys, *words, "--episodes", 100, "--runs", tmp_path / "runs")
    assert (code, "1 finished, 0 failed" in said) == (0, True), said
    found = results.finished(tmp_path / "runs", num_episodes=100, scripts=[str(tmp_path / "mine.py")])
    assert list(found) == [(str(world), "mine", "sign")]
    capsys.readouterr()
    assert not results.finished(tmp_path / "runs", num_episodes=100)
    assert "mine.py are left out: it is not in algos/, and --scripts does not name it" in capsys.readouterr().err
    assert found[str(world), "mine", "sign"].actions.any()
    assert report.score_tables(found)[str(world)][1][0] == "mine"
    drawn = figures.learning_curves(found, results.named_in(found)[1])
    assert [axis.get_title() for axis in drawn.axes] == ["race, sign", "race, adam"]


def test_a_script_of_ones_own_needs_a_name_of_its_own(tmp_path):
    shutil.copy(ROOT / "algos" / "pg.py", tmp_path / "pg.py")
    assert_refused("needs another name than algos/pg.py", lambda: Cell(str(tmp_path / "pg.py"), "climbing", "adam").settings)


def test_a_stop_while_a_cell_starts_reaches_its_script(cell, monkeypatch):
    job, told = compare.Job(cell, 60.0), []

    def start(*_, **__):
        job.stop()  # a signal comes before the runner holds the process
        return SimpleNamespace(wait=lambda: -15, send_signal=told.append, poll=lambda: None)

    monkeypatch.setattr(compare.subprocess, "Popen", start)
    job.run()
    assert (told, job.code, job.trouble) == ([signal.SIGTERM], -15, "")


def test_a_selection_is_a_numbered_list():
    found = select(["pg", "decespg"], ["pushbox", "cleaner"], ["sign", "adam"])
    assert [(cell.world, cell.method, cell.optimizer) for cell in found] == [
        (world, method, optimizer)
        for world in ("pushbox", "cleaner")
        for method in ("pg", "decespg")
        for optimizer in ("sign", "adam")
    ]
    assert {(cell.first_seed, cell.num_trials) for cell in found} == {(1, 20)}
    assert found[0].settings["num_episodes"] == 20_000


def test_a_sweep_is_a_cell_for_every_combination_and_ends_with_its_table(tmp_path, monkeypatch, capsys):
    words = [
        "--algos",
        "decespg",
        "--envs",
        "pushbox",
        "--optimizers",
        "sign",
        "--seeds",
        "1-2",
        "--episodes",
        "40",
        "--runs",
        tmp_path,
    ]
    sweep = [*words, "--env-args", "size=6", "--args", "beta=0.5,1", "window=5"]
    code, said, _ = command(monkeypatch, capsys, *sweep)
    assert (code, "2 finished, 0 failed" in said) == (0, True), said
    assert "| pushbox | decespg beta=0.5 | 2 | 40 | " in said
    assert "| pushbox | decespg beta=1.0 - decespg beta=0.5 | " in said
    settings = [json.loads(path.read_text())["args"] for path in tmp_path.rglob("args.json")]
    assert sorted((args["beta"], args["window"], args["env_args"]) for args in settings) == [
        (b, 5, ["size=6"]) for b in (0.5, 1)
    ]
    _, said, _ = command(monkeypatch, capsys, *sweep, "--dry-run")
    assert said.count("finished") == 2
    _, said, _ = command(monkeypatch, capsys, *words, "--dry-run")
    assert said.split()[-1] == "new"
    assert results.finished(tmp_path, (1, 2), 40) == {}  # these are not the comparison's


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--args", "beta"], "--args must be written argument=value or argument=value,value, not 'beta'."),
        (["--args", "beta=1,,2"], "--args must be written argument=value or argument=value,value, not 'beta=1,,2'."),
        (["--args", "seed=3"], "--args must be arguments of the method, which 'seed' is not."),
        (["--args", "betas=3"], "pg.py does not take betas=3; see its --help."),
        (["--args", "gamma=x"], "pg.py does not take gamma=x; see its --help."),
        (["--args", "gamma=7"], "--gamma must be a number between 0 and 1, not 7.0."),
        (["--env-args", "size=5"], "pushbox's size must be one of 4, 6, 8, 10, not 5."),
    ],
)
def test_impossible_sweeps(words, said, monkeypatch, capsys):
    code, _, error = command(monkeypatch, capsys, "--algos", "pg", "--envs", "pushbox", *words, "--dry-run")
    assert (code, error) == (2, f"benchmark.sh: {said}\n")


# --- the runner ---


def command(monkeypatch, capsys, *words):
    """Run benchmark/compare.py in this process: code, stdout, stderr."""
    monkeypatch.setattr(sys, "argv", ["benchmark/compare.py", *map(str, words)])
    try:
        compare.main()
        code = 0
    except SystemExit as error:
        code = error.code
    return code, *capsys.readouterr()


SMALL = ["--algos", "pg", "decespg", "--envs", "pushbox", "--optimizers", "sign", "--seeds", "1", "--episodes", "2"]


def test_one_cell_is_the_contract_for_schedulers(tmp_path, monkeypatch, capsys):
    code, said, _ = command(monkeypatch, capsys, *SMALL, "--cell", 1, "--runs", tmp_path)
    assert (code, "1 finished, 0 failed, 0 skipped" in said) == (0, True)
    _, said, _ = command(monkeypatch, capsys, *SMALL, "--dry-run", "--runs", tmp_path)
    lines = [line.split() for line in said.splitlines()]
    assert [(number, name.split("/")[1], state) for number, name, state in lines] == [
        ("0", "pg", "new"),
        ("1", "decespg", "finished"),
    ]
    code, said, _ = command(monkeypatch, capsys, *SMALL, "--cell", 1, "--runs", tmp_path)
    assert (code, "0 finished, 0 failed, 1 skipped" in said) == (0, True)


def test_a_failure_is_shown_with_its_last_line_and_its_command(tmp_path, monkeypatch, capsys):
    failing = property(lambda self: [sys.executable, "-c", "import sys; print('the reason'); sys.exit(3)"])
    monkeypatch.setattr(Cell, "command", failing)
    code, said, _ = command(monkeypatch, capsys, *SMALL, "--runs", tmp_path)
    assert code == 1
    assert "0 finished, 2 failed, 0 skipped" in said
    assert said.count("code 3: the reason") == 2
    assert said.count("again: ") == 2
    _, said, _ = command(monkeypatch, capsys, *SMALL, "--status", "--runs", tmp_path)
    assert said.count("failed    the reason") == 2


def test_a_cell_of_an_edited_script_is_said_and_run_again_only_if_asked(tmp_path, monkeypatch, capsys):
    mine, world = tmp_path / "mine.py", tmp_path / "race.py"
    mine.write_text((ROOT / "algos" / "pg.py").read_text(encoding="utf-8"))
    world.write_text(RACE.read_text(encoding="utf-8"))
    selected = [
        "--algos",
        mine,
        "--envs",
        world,
        "--optimizers",
        "sign",
        "--seeds",
        1,
        "--episodes",
        2,
        "--runs",
        tmp_path / "runs",
    ]
    said = "mine/sign-seeds1-1-episodes2 has finished before its script or its world was edited; --overwrite runs it anew."
    for edited in (None, mine, world):
        if edited is not None:
            edited.write_text(edited.read_text(encoding="utf-8") + "# edited\n")
            _, out, _ = command(monkeypatch, capsys, *selected)
            assert said in out
            assert "0 finished, 0 failed, 1 skipped" in out
        _, out, _ = command(monkeypatch, capsys, *selected, "--overwrite")
        assert said not in out
        assert "1 finished, 0 failed, 0 skipped" in out
        _, out, _ = command(monkeypatch, capsys, *selected)
        assert said not in out
        assert "0 finished, 0 failed, 1 skipped" in out


def test_nothing_is_overwritten_while_one_of_the_cells_is_running(tmp_path, monkeypatch, capsys):
    cells = [Cell(method, "pushbox", "sign", num_trials=1, num_episodes=2, runs=tmp_path) for method in ("pg", "decespg")]
    for cell in cells:
        finish(cell)
    with compare.owned(cells[1]):
        code, _, error = command(monkeypatch, capsys, *SMALL, "--overwrite", "--runs", tmp_path)
    assert (code, "is running; stop it before --overwrite" in error) == (2, True)
    assert all(cell.finished for cell in cells)


def test_a_broken_result_is_said_and_run_again(tmp_path, monkeypatch, capsys):
    cell = Cell("pg", "pushbox", "sign", num_trials=1, num_episodes=2, runs=tmp_path)
    finish(cell)
    (cell.run_dir / "episodes.npz").write_bytes(b"half")
    code, said, _ = command(monkeypatch, capsys, *SMALL, "--cell", 0, "--runs", tmp_path)
    assert code == 0
    assert f"{cell.run_dir / 'episodes.npz'} cannot be read" in said
    assert "1 finished" in said
    assert cell.finished


def test_without_slurm_nothing_is_submitted(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    code, _, err = command(monkeypatch, capsys, *SMALL, "--slurm", "--runs", tmp_path)
    assert (code, err) == (2, "benchmark.sh: there is no sbatch on this machine; --slurm needs the commands of Slurm.\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--algos ppo", "'ppo'"),
        ("--envs pacman", "'pacman'"),
        ("--seeds 5-2", "'5-2'"),
        ("--seeds x", "'x'"),
        ("--seeds 1-100000000000000000000", "'1-100000000000000000000'"),
        ("--seeds 1-999999999 --dry-run", "a log of 999999999 x 20000 episodes would need"),
        ("--episodes 0", "not 0"),
        ("--episodes 1000000000000 --dry-run", "would need 260,000 GB of memory"),
        ("--episodes 1000000000000000000000", "between 1 and 9223372036854775807"),
        ("--jobs 0", "not 0"),
        ("--jobs 1000000000000000000000", "between 1 and 9223372036854775807"),
        ("--checkpoint-every nan", "at least 0, not nan"),
        ("--checkpoint-every -1", "at least 0, not -1"),
        (f"--runs {__file__}", "--runs must be a directory"),
        (f"--algos {Path(__file__).parent / 'data' / 'race.py'}", "is no script for the comparison, because it has no Args"),
        (f"--envs {ROOT / 'algos' / 'pg.py'}", "must define one subclass of envs.World, not 0"),
        ("--cell -1", "not -1"),
        ("--cell 100000", "not 100000"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(words, said, monkeypatch, capsys):
    monkeypatch.setattr(compare.Runner, "run", lambda self: pytest.fail("nothing must be run"))
    code, out, err = command(monkeypatch, capsys, *words.split())
    assert (code, out) == (2, "")
    assert err.startswith("benchmark.sh: ")
    assert said in err
    assert_one_sentence(err.removesuffix("\n"))


@pytest.mark.parametrize("jobs", ["all", "0", "-1", "1.5", "100000000000000000000"])
def test_the_variable_jobs_is_a_number(jobs, monkeypatch, capsys):
    monkeypatch.setenv("JOBS", jobs)
    code, out, err = command(monkeypatch, capsys, *SMALL, "--dry-run")
    assert (code, out) == (2, "")
    assert err == f"benchmark.sh: the variable JOBS must be a whole number of at least 1, not {jobs!r}.\n"
    assert command(monkeypatch, capsys, *SMALL, "--dry-run", "--jobs", 1)[0] == 0


def test_it_is_called_from_anywhere_and_through_a_link(tmp_path):
    """Files and directories that it is told are the caller's."""
    (tmp_path / "bench").symlink_to(ROOT / "benchmark.sh")
    (tmp_path / "my_world.py").write_bytes((ROOT / "tests" / "data" / "race.py").read_bytes())
    words = ["./bench", *SMALL, "--envs", "my_world.py", "--cell", "0", "--runs", "mine"]
    environment = {**os.environ, "PYTHON": sys.executable}
    ended = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert len(list((tmp_path / "mine" / "my_world" / "pg").glob("*/episodes.npz"))) == 1


def test_an_array_of_jobs_is_told_the_callers_files(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_world.py").write_bytes((ROOT / "tests" / "data" / "race.py").read_bytes())
    (tmp_path / "sbatch").write_text('#!/bin/sh\necho "$@" > told\n'.replace("told", str(tmp_path / "told")), encoding="utf-8")
    (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    code, _, _ = command(monkeypatch, capsys, *SMALL, "--envs", "my_world.py", "--runs", "mine", "--slurm")
    told = (tmp_path / "told").read_text(encoding="utf-8").split()
    assert (code, told[:2]) == (0, ["--array=0,1", "benchmark/cell.sbatch"])
    monkeypatch.chdir(ROOT)
    _, said, _ = command(monkeypatch, capsys, *told[2:], "--dry-run")
    assert [line.split()[1].split("/")[:2] for line in said.splitlines()] == [["my_world", "pg"], ["my_world", "decespg"]]
    assert str(tmp_path / "mine") in told


def test_a_time_that_was_not_written_to_its_end_is_none(cell):
    finish(cell)
    timed = cell.run_dir / "seconds"
    for text in ("", "12.", "abc", "12.5\n"):
        timed.write_text(text, encoding="utf-8")
        assert seconds_of(cell.run_dir) == pytest.approx(float(text) if text.strip("abc") else np.nan, nan_ok=True)
    timed.unlink()
    assert np.isnan(seconds_of(cell.run_dir))


def test_a_cell_goes_on_though_its_time_is_lost(tmp_path, monkeypatch, capsys):
    cell = Cell("pg", "pushbox", "sign", num_trials=1, num_episodes=2, runs=tmp_path)
    cell.run_dir.mkdir(parents=True)
    (cell.run_dir / "seconds").write_text("", encoding="utf-8")
    (cell.run_dir / "checkpoint.pt").write_bytes(b"none")  # so that it is resumed, and refused
    code, said, _ = command(monkeypatch, capsys, *SMALL, "--cell", 0, "--runs", tmp_path)
    assert (code, "checkpoint.pt cannot be read" in said) == (1, True)
    assert (cell.run_dir / "seconds").read_text(encoding="utf-8") == "nan\n"


def test_a_full_disk_is_said_to_be_full(tmp_path, monkeypatch, capsys):
    failing = property(lambda self: [sys.executable, "-c", "import sys; sys.exit(2)"])
    monkeypatch.setattr(Cell, "command", failing)
    monkeypatch.setattr(compare.shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
    code, said, _ = command(monkeypatch, capsys, *SMALL, "--runs", tmp_path)
    assert (code, said.count("code 2: no output, for the disk is full")) == (1, 2)


def test_a_directory_that_cannot_be_made_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "pushbox").write_text("mine", encoding="utf-8")
    code, said, err = command(monkeypatch, capsys, *SMALL, "--runs", tmp_path)
    assert (code, err) == (1, "")
    assert "2 failed" in said
    assert f"code 2: cannot use {tmp_path / 'pushbox'}" in said
    assert (tmp_path / "pushbox").read_text(encoding="utf-8") == "mine"


def test_cells_are_run_though_nobody_listens(tmp_path, monkeypatch, capsys):
    class Deaf(io.StringIO):
        def write(self, text):
            raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(sys, "stdout", Deaf())
    assert command(monkeypatch, capsys, *SMALL, "--cell", 0, "--runs", tmp_path)[0] == 0
    assert len(list(tmp_path.rglob("episodes.npz"))) == 1
