"""Arguments that nobody would think of: every script, benchmark.sh and the API take them or refuse them, and do no harm.

A command line ends with code 0, or with 2 and one sentence (or the box of the reader of command lines) on stderr, never with a
traceback, and touches nothing but its run's directory. The API answers or raises a ValueError or TypeError. The variable
FUZZ_EXAMPLES says how many examples each test draws; FUZZ_EXAMPLES=1000 is for a night.
"""

import contextlib
import io
import os
import sys
import tempfile
from dataclasses import fields
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import envs
from benchmark import compare
from tests.helpers import RACE, Ended, assert_one_sentence, command, contents, each_script, script

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "20"))
bounded = settings(max_examples=EXAMPLES, deadline=None, database=None, suppress_health_check=list(HealthCheck))
quick = settings(bounded, max_examples=12 * EXAMPLES)

# Values of the command line; none asks for work that is possible and long.
LONG = "x" * 300
WHOLE = st.sampled_from(
    ["1", "2", "3", "0", "-1", "1.5", "nan", "two", "", "10000000000000", "100000000000000000000", "1" * 5000]
)
REAL = st.sampled_from(["0", "0.5", "1", "-1", "nan", "inf", "1e38", "1e308", "5e-324", "1" * 30, "one", ""])
PLACE = st.sampled_from(["run", "run/below", "file", "file/below", "folder", "missing", "é", ".", "", LONG, "/proc/none"])
OPTIONS = ["size=6", "size=9", "size=10000000000000000000", "size", "=", "size=", "size=[4", "observation=own", "num_agents=3"]
OPTIONS += ["maze_seed=3", "step_penalty=nan", "step_penalty=1e308", "max_steps=3", "max_steps=0", "max_steps=1e3", "é=1"]
VALUES = {
    "env": st.sampled_from(["pushbox", "findtreasure", "pacman", "", "é", "missing.py", "file.py", f"{LONG}.py", str(RACE)]),
    "env_args": st.lists(st.sampled_from(OPTIONS), max_size=2),
    "num_episodes": st.sampled_from(["1", "2", "0", "-1", "1e3", "10000000000000", "100000000000000000000"]),
    "max_steps": st.sampled_from(["1", "5", "0", "-1", "2000000000", "10000000000", "100000000000000000000"]),
    "run_dir": PLACE,
    "evaluate": PLACE,
    "optimizer": st.sampled_from(["sign", "adam", "sgd"]),
    "hidden": st.lists(st.sampled_from(["1", "4", "0", "-1", "10000000000", "100000000000000000000"]), max_size=2),
}


def drawn_words(data, args_class, always=()):
    """Up to four options of a script with drawn values, after those that are always there."""
    names = data.draw(st.lists(st.sampled_from([field.name for field in fields(args_class)]), max_size=4, unique=True))
    words = list(always)
    for field in fields(args_class):
        if field.name in names:
            number = WHOLE if "int" in str(field.type) else REAL
            value = [] if field.type is bool else data.draw(VALUES.get(field.name, number))
            words += [f"--{field.name.replace('_', '-')}", *([value] if isinstance(value, str) else value)]
    return words


@contextlib.contextmanager
def somewhere():
    """A working directory with a file, a folder and a file that is no world."""
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        Path("file").write_text("mine", encoding="utf-8")
        Path("file.py").write_text("1 / 0", encoding="utf-8")
        Path("folder").mkdir()
        Path("folder", "notes").write_text("mine", encoding="utf-8")
        yield Path(name)


def assert_ended_well(name, ended):
    """With code 0, or with 2 and one sentence, or what tyro says."""
    assert ended.code in (0, 2), ended
    assert "Traceback" not in ended.err
    if ended.code == 2 and "--help" not in ended.err:
        sentence = ended.err.splitlines()[-1]
        assert sentence.startswith(f"{name}: ")
        assert_one_sentence(sentence)


@each_script
@bounded
@given(data=st.data())
def test_scripts(name, data):
    tiny = ["--num-episodes", "2", "--max-steps", "5", "--hidden", "4"]
    words = drawn_words(data, script(name).Args, always=tiny)
    with somewhere() as folder:
        before = contents(folder)
        ended = command(name, *words)
        assert_ended_well(f"{name}.py", ended)
        own = ("run", "runs", "missing", "é")
        after = {path: data for path, data in contents(folder).items() if path.parts[0] not in own}
        assert after == before


def benchmark(*words, **variables):
    """Run benchmark.sh's program in this process."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    streams = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    with streams[0], streams[1], patch.object(sys, "argv", ["benchmark.sh", *words]), patch.dict(os.environ, variables):
        try:
            compare.main()
        except SystemExit as end:
            code = end.code or 0
    return Ended(code, out.getvalue(), err.getvalue())


BENCHMARK = {
    "--algos": st.lists(
        st.sampled_from(["pg", "dqn", "ppo", "", "file.py", "missing.py", f"{LONG}.py", str(RACE)]), max_size=2
    ),
    "--envs": st.lists(VALUES["env"], max_size=2),
    "--optimizers": st.lists(VALUES["optimizer"], max_size=2),
    "--seeds": st.sampled_from(
        ["1", "1-3", "3-1", "1-", "-1", "", "x", "1-999999999", "1-99999999999999999999", "\uff11-\uff12"]
    ),
    "--episodes": VALUES["num_episodes"],
    "--jobs": WHOLE,
    "--checkpoint-every": REAL,
    "--runs": PLACE,
    "--cell": WHOLE,
}


@quick
@given(
    words=st.dictionaries(st.sampled_from(list(BENCHMARK)), st.none(), max_size=4),
    look=st.sampled_from(["--dry-run", "--status"]),
    jobs=st.sampled_from(["", "1", "all", "0", "-1", "1" * 5000]),
    data=st.data(),
)
def test_benchmark(words, look, jobs, data):
    drawn = [look]
    for option in words:
        value = data.draw(BENCHMARK[option])
        drawn += [option, *([value] if isinstance(value, str) else value)]
    with somewhere() as folder:
        before = contents(folder)
        assert_ended_well("benchmark.sh", benchmark(*drawn, JOBS=jobs))
        assert contents(folder) == before


# Values of the API.
NUMBER = st.integers(-3, 12) | st.integers() | st.floats() | st.sampled_from([np.int8(9), np.uint64(2**63), np.float32(0.5)])
ANYTHING = (
    NUMBER | st.none() | st.booleans() | st.text(max_size=5) | st.lists(st.integers(), max_size=2) | st.binary(max_size=2)
)
OPTION = st.sampled_from(["size", "observation", "num_agents", "maze_seed", "max_steps", "step_penalty", "speed"])


def refused(function, *args, **options):
    """Call; True if it is refused as the API refuses."""
    try:
        function(*args, **options)
    except (ValueError, TypeError):
        return True
    return False


@quick
@given(
    st.sampled_from([*envs.WORLDS, "mars", ""]) | ANYTHING, st.dictionaries(OPTION, ANYTHING, max_size=2), ANYTHING, st.data()
)
def test_worlds(name, options, num_envs, data):
    refused(envs.make_vec, name, num_envs, **options)
    refused(envs.make, name, **options)
    if not refused(envs.make_world, name, **options):
        world = envs.make_world(name, **options)
        refused(envs.draw, world, world.start, cell=data.draw(ANYTHING))
        refused(envs.Rollout, world, data.draw(ANYTHING))
        refused(envs.EpisodeLog, world, data.draw(ANYTHING), data.draw(ANYTHING))


@quick
@given(st.data())
def test_the_vector_and_the_parallel_face(data):
    env = envs.make_vec("pushbox", num_envs=2, max_steps=5)
    kind = data.draw(st.sampled_from(["i1", "u1", ">i8", "u8", "f4", "?", "O", "U3"]))
    shape = data.draw(st.sampled_from([(2, 2), (2,), (), (2, 2, 1), (0, 2)]))
    actions = np.full(shape, data.draw(st.integers(-1, 4) if kind != "u1" and kind != "u8" else st.integers(0, 255)), kind)
    assert refused(env.step, actions)
    refused(env.reset, seed=data.draw(ANYTHING), options=data.draw(ANYTHING | st.just({"reset_mask": actions})))
    env.reset()
    fits = actions.shape == (2, 2) and actions.dtype.kind in "iu" and actions.min() >= 0 and actions.max() <= 3
    assert refused(env.step, actions) == (not fits)
    one = envs.make("pushbox")
    one.reset()
    refused(one.step, data.draw(st.dictionaries(st.sampled_from(["agent_0", "agent_1", "x"]), ANYTHING) | ANYTHING))


@quick
@given(st.lists(st.sampled_from([(5, 5, 3), (4, 5, 3), (5, 5), (0, 5, 3), (5, 5, 4)]), max_size=3), ANYTHING)
def test_films(shapes, fps):
    with somewhere() as folder:
        before = contents(folder)
        if refused(envs.save_gif, "film.gif", [np.zeros(shape, np.uint8) for shape in shapes], fps):
            assert contents(folder) == before


@quick
@given(
    st.lists(st.text(max_size=12) | st.sampled_from(["size=((((", "a={[]:1}", "a=" + "9" * 5000, "a=" + "(" * 300]), max_size=3)
)
def test_options_of_the_command_line(words):
    refused(envs.parse_options, words)


@pytest.mark.parametrize("name", ["findtreasure", "gotogether"])
@bounded
@given(st.integers(-2, 40) | st.integers(min_value=10**10))
def test_the_search(name, max_steps):
    assert refused(envs.optimum, name, max_steps=max_steps) or max_steps > 0
