"""The tools of benchmark/ beside benchmark.sh: impossible words and numbers, before anything is trained."""

import importlib
import subprocess
import sys

import pytest
import tyro

import envs
from benchmark.cells import ROOT
from envs.command import command_line
from tests.helpers import assert_one_sentence


@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("tune", "ppo", "there is no grid for the method 'ppo'"),
        ("tune", "pg --worlds mars", "there is no world 'mars'"),
        ("tune", "pg --jobs 0", "--jobs must be a whole number of at least 1, not 0"),
        ("tune", "pg --jobs 100000000000000000000", "between 1 and 9223372036854775807"),
        ("novelty", "--methods ppo", "there is no script 'ppo'"),
        ("novelty", "--methods pg", "pg.py has no exploration bonus"),
        ("novelty", "--worlds mars", "there is no world 'mars'"),
        ("novelty", "--worlds", "must name at least one"),
        ("novelty", "--output novelty.txt", "--output must be a picture"),
        ("novelty", "--num-trials 0", "--num-trials must be a whole number of at least 1, not 0"),
        ("novelty", "--num-episodes 1000000000000", "a log of 5 x 1000000000000 episodes would need"),
        ("novelty", "--num-episodes 1 --num-trials 1", "no pair is visited 100 times by decespg in findtreasure"),
        ("scaling", "--num-episodes 0", "--num-episodes must be a whole number of at least 1, not 0"),
        ("scaling", "--windows 0", "--windows must be a whole number of at least 1, not 0"),
        ("scaling", "--windows 10000000000", "a window of 10000000000 would need"),
        ("speed", "pg ppo", "the methods must be scripts of algos/"),
        ("speed", "spg", "pg and decespg among them"),
        ("visits", "--methods ppo", "there is no script 'ppo'"),
        ("visits", "--worlds mars", "there is no world 'mars'"),
        ("visits", "--methods", "must name at least one"),
        ("visits", "--num-episodes 0", "--num-episodes must be a whole number of at least 1, not 0"),
        ("visits", "--num-trials 100000000000000000000", "between 1 and 9223372036854775807"),
        ("visits", "--output nowhere/visits.png", "--output must be a picture"),
        ("visits", "--output visits.txt", "--output must be a picture"),
        ("peers", "--episodes 0", "--episodes must be a whole number of at least 1, not 0"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(name, words, said, monkeypatch, capsys):
    tool = importlib.import_module(f"benchmark.{name}")
    monkeypatch.setattr(sys, "argv", [f"benchmark/{name}.py", *words.split()])
    with pytest.raises(SystemExit) as end, command_line(f"{name}.py"):
        tyro.cli(tool.main)
    out, err = capsys.readouterr()
    sentence = err.splitlines()[-1]
    assert (end.value.code, out, sentence.startswith(f"{name}.py: ")) == (2, "", True), err
    assert said in sentence
    assert_one_sentence(sentence)


@pytest.mark.parametrize("name", ["report", "tune", "claims"])
def test_a_tool_ends_its_own_command_line_so(name):
    """As a process: a full stdout."""
    line = f"{sys.executable} {ROOT / 'benchmark' / name}.py --help > /dev/full"
    ended = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert (ended.returncode, "Traceback" in ended.stderr) == (2, False)
    assert ended.stderr.startswith(f"{name}.py: cannot use standard output")


def test_a_list_of_words_is_checked():
    from benchmark.cells import check_words

    check_words("world", ("pushbox",), envs.WORLDS)
    with pytest.raises(envs.UsageError, match="there is no world 'mars'; there is cleaner, "):
        check_words("world", ("pushbox", "mars"), envs.WORLDS)
