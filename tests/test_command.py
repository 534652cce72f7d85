"""How command lines end whatever the outside world does to them: closed, broken and full streams, odd locales, long names."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

import envs
from envs.command import command_line, one_line
from tests.helpers import ALGOS, RACE, assert_one_sentence, results

ROOT = ALGOS.parent
PLAY = f"{sys.executable} -m envs pushbox max_steps=3 --delay 0"
TRAIN = f"{sys.executable} algos/pg.py --num-episodes 2 --max-steps 5 --run-dir"


def shell(line, **variables):
    """Run a line of bash in the repository; a pipe ends as its first part does."""
    line += "; exit ${PIPESTATUS[0]}"
    environment = {**os.environ, **variables}
    return subprocess.run(["bash", "-c", line], cwd=ROOT, env=environment, capture_output=True, text=True, encoding="utf-8")


@pytest.mark.parametrize(
    ("redirections", "code", "said"),
    [
        ("| head -1", (0, 141), ""),  # it may have written all before the pipe breaks
        ("> /dev/full", (2,), "python -m envs: cannot use standard output: No space left on device.\n"),
        ("> /dev/full 2>&1", (2,), ""),
        ("2>&-", (0,), ""),
        (">&- 2>&- <&-", (0,), ""),
        ("--help > /dev/full", (2,), "python -m envs: cannot use standard output: No space left on device.\n"),
    ],
)
def test_streams_that_take_nothing(redirections, code, said):
    ended = shell(f"{PLAY} {redirections}")
    assert (ended.returncode in code, ended.stderr) == (True, said)


def test_a_refusal_into_a_closed_stderr_is_not_written_elsewhere():
    ended = shell(f"{PLAY} size=5 2>&-")
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", "")


@pytest.mark.parametrize("redirections", ["2>&-", "2> /dev/full", "2>&1 | head -c 5"])
def test_no_training_ends_because_nobody_takes_its_progress_bar(redirections, tmp_path):
    ended = shell(f"{TRAIN} {tmp_path / 'run'} {redirections}")
    assert ended.returncode in (0, 2)  # 2: the last line could not be written
    assert ended.stderr == ""
    assert results(tmp_path / "run")["returns"].shape == (1, 2)


def test_a_locale_without_the_letters(tmp_path):
    ascii_only = dict(PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", LC_ALL="C")
    (tmp_path / "rénn-1.py").write_bytes(RACE.read_bytes())
    ended = shell(f"{TRAIN} {tmp_path / 'é'} --env {tmp_path / 'rénn-1.py'}", **ascii_only)
    assert ended.returncode == 0, ended.stderr
    assert results(tmp_path / "é")["returns"].shape == (1, 2)
    ended = shell(f"{TRAIN} {tmp_path / 'ü'} --env ä", **ascii_only)
    assert (ended.returncode, "Traceback" in ended.stderr) == (2, False)


def end_of(action, monkeypatch, capsys):
    """The exit code and stderr of a command line that does this."""
    with pytest.raises(SystemExit) as end, command_line("it.py"):
        action()
    return end.value.code, capsys.readouterr().err


def fail(error):
    raise error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (envs.UsageError("no."), 2, "it.py: no.\n"),
        (OSError(36, "File name too long", "x" * 300), 2, f"it.py: cannot use {'x' * 300}: File name too long.\n"),
        (OSError(28, "No space left on device"), 2, "it.py: cannot use standard output: No space left on device.\n"),
        (MemoryError("Unable to allocate 373. GiB. Sorry."), 2, None),
        (ValueError("Maximum allowed dimension exceeded"), 2, None),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_what_is_no_fault_of_the_program_ends_in_a_sentence(error, code, said, monkeypatch, capsys):
    found, err = end_of(lambda: fail(error), monkeypatch, capsys)
    assert found == code
    if said is None:
        assert err.startswith("it.py: this is too large for the machine (")
        assert_one_sentence(err.removesuffix("\n"))
    else:
        assert err == said


def test_what_is_a_fault_of_the_program_is_not_hidden():
    with pytest.raises(ZeroDivisionError), command_line("it.py"):
        fail(ZeroDivisionError())


def test_the_streams_are_left_as_they_were():
    before = sys.stdin, sys.stdout, sys.stderr
    with command_line("it.py"):
        print("to nowhere", file=sys.stderr)
    assert before == (sys.stdin, sys.stdout, sys.stderr)


def test_a_stream_that_fails_later_is_given_up(monkeypatch):
    class Failing(io.StringIO):
        def write(self, text):
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(sys, "stderr", Failing())
    with command_line("it.py"):
        assert sys.stderr.write("three") == 5
        sys.stderr.flush()


def test_an_exception_is_one_line():
    assert one_line(MemoryError("Unable to allocate 373. GiB for\n it. Really.")) == "Unable to allocate 373 GiB for it; Really"
    assert one_line(MemoryError()) == "MemoryError"


def test_text_keeps_its_line_ends_in_every_clone():
    """A shell refuses benchmark.sh with the line ends of Windows."""
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files"], capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this is no clone")
    assert (ROOT / ".gitattributes").read_text(encoding="utf-8").splitlines()[-1] == "* text=auto eol=lf"
    scripts = [name for name in listed.stdout.split() if Path(name).suffix in (".sh", ".py", ".sbatch")]
    assert not [name for name in scripts if b"\r" in (ROOT / name).read_bytes()]
