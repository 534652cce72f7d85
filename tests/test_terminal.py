"""`python -m envs` and `python -m envs.gallery`: what they print and write, and how they refuse."""

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import envs
from envs import __main__ as terminal
from envs import gallery
from tests.helpers import RACE, assert_refused


def run(module, monkeypatch, *words, typed=""):
    """Call the program with these command-line words, and lines that are typed; returns its exit status."""
    monkeypatch.setattr(sys, "argv", ["envs", *words])
    monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
    try:
        module.main()
    except SystemExit as exit:
        return exit.code
    return 0


def test_an_episode_by_the_keyboard(monkeypatch, capsys):
    """The large box of pushbox, and a typing error on the way."""
    assert run(terminal, monkeypatch, "pushbox", "--keys", typed="ff\nlr\nf\nFF \nff\nff\n") == 0
    printed = capsys.readouterr().out
    assert "f forward, l left, r right, w wait; a letter for each agent" in printed.replace("turn ", "")
    assert "type 2 of the letters flrw and Enter, such as fl" in printed
    assert "step 2: agent 0 turn left, agent 1 turn right; the team earned 0 (0 so far)" in printed
    assert "|  0^1^  |\n+--------+\n0 1 agents, g goal, s small box, B large box\n" in printed
    assert "agent 0 observes 0 0 1 0 0  [empty]\n" in printed
    assert "agent 1 observes 0 1 0 0 0  [large box]\n" in printed
    assert printed.endswith("end: large after 4 steps, return 100, 33.33 per step\n")


def test_every_action_has_a_letter_of_its_own():
    names = ("stay", "north", "south", "turn west", "Ö")
    assert terminal.letters_of(names) == {"s": 0, "n": 1, "o": 2, "w": 3, "a": 4}
    assert_refused("at most 36 actions", terminal.letters_of, ("go",) * 37)


def test_numbers_that_are_no_positions_are_told_as_they_are():
    env = envs.make("movebox")
    world = SimpleNamespace(num_agents=1, sights=(), cell=1.0)
    said = terminal.describe(SimpleNamespace(render=lambda: "map", world=world), {"agent_0": np.array([0.5, 1, 0])})
    assert said == "map\nagent 0 observes 0.5 1 0"
    assert "[(13, 1)" in terminal.describe(SimpleNamespace(render=lambda: "map", world=env.world), env.reset()[0])


def test_the_end_of_the_input_ends_the_episode(monkeypatch, capsys):
    assert run(terminal, monkeypatch, "findtreasure", "--keys", typed="ud\n") == 0
    assert capsys.readouterr().out.endswith("stopped after 1 step, return -0.2\n")


def test_a_world_of_ones_own(monkeypatch, capsys):
    assert run(terminal, monkeypatch, str(RACE), "size=3", "--keys", typed="gg\nsg\ngg\n") == 0
    printed = capsys.readouterr().out
    assert "s stay, g go; a letter for each agent" in printed
    assert "agent 1 observes 0 0.667 0.333 0.667  [(0, 2) (1, 2)]" in printed
    assert printed.endswith("end: there after 3 steps, return 9.8, 4.90 per step\n")


@pytest.mark.parametrize("name", envs.WORLDS)
def test_random_play(name, monkeypatch, capsys):
    steps, end = (1, "0 after 1 step,") if name == "climbing" else (5, "time limit after 5 steps,")
    words = (name, "max_steps=5", "--delay", "0")
    assert run(terminal, monkeypatch, *words) == 0
    printed = capsys.readouterr().out
    assert printed.count("; the team earned ") == steps
    assert printed.count("agent 1 observes ") == steps + 1
    assert f"end: {end}" in printed
    assert run(terminal, monkeypatch, *words, "--seed", "0") == 0
    assert capsys.readouterr().out == printed
    assert run(terminal, monkeypatch, *words, "--seed", "1") == 0
    assert capsys.readouterr().out != printed


def test_positions_are_told_in_cells(monkeypatch, capsys):
    run(terminal, monkeypatch, "movebox", "--keys")
    assert "agent 0 observes 0.867 0.0667 0.867 0.867 0.667 0.467  [(13, 1) (13, 13) (10, 7)]" in capsys.readouterr().out
    run(terminal, monkeypatch, "movebox", "observation=own", "--keys")
    assert "agent 1 observes 0.867 0.867  [(13, 13)]" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("accepted", "words"),
    [
        ("cleaner, findtreasure, gotogether, movebox, pushbox", ["treasure"]),
        ("4, 6, 8, 10", ["pushbox", "size=5"]),
        ("option=value", ["pushbox", "size"]),
        ("between 0 and 3600", ["pushbox", "--delay", "-1"]),
        ("between 0 and 3600", ["pushbox", "--delay", "1e300"]),
        ("at least 0", ["pushbox", "--seed", "-1"]),
    ],
)
def test_refused_words(accepted, words, monkeypatch, capsys):
    assert run(terminal, monkeypatch, *words) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("python -m envs: ")
    assert accepted in error
    assert error.count("\n") == 1


def test_the_picture_of_all_worlds(monkeypatch, tmp_path):
    assert run(gallery, monkeypatch, str(tmp_path / "docs" / "worlds.png")) == 0
    with Image.open(tmp_path / "docs" / "worlds.png") as picture:
        page = np.asarray(picture)
    assert page.shape == (960, 1800, 3)
    for k, name in enumerate(envs.WORLDS):
        middle, row = k % 4 * 460 + 210, page[k // 4 * 480 :][:480]
        assert len(np.unique(row[:420, middle - 210 : middle + 210].reshape(-1, 3), axis=0)) > 4, name  # a map
        assert np.any(row[430:, middle - 40 : middle + 40] < 100), name  # its name
    assert np.all(page[:, 425:455] == 255)  # space between two maps


def test_the_films_of_optimal_play(monkeypatch, tmp_path):
    """As many pictures as the optimum has steps and one of the start (in cleaner until all is clean), and those in docs/."""
    assert run(gallery, monkeypatch, "--plays", str(tmp_path / "films")) == 0
    steps = {"cleaner": 61, "findtreasure": 8, "gotogether": 23, "movebox": 25, "pushbox": 4}
    steps |= {"climbing": 1, "passage": 18, "secretroom": 21}
    assert {path.name for path in (tmp_path / "films").iterdir()} == {f"optimal-{name}.gif" for name in steps}
    for name, number in steps.items():
        path = tmp_path / "films" / f"optimal-{name}.gif"
        assert path.stat().st_size < 100_000
        with Image.open(path) as film, Image.open(Path(envs.__file__).parents[1] / "docs" / path.name) as published:
            assert film.n_frames == published.n_frames == number + 1
            for k in (0, number // 2, number):
                film.seek(k)
                published.seek(k)
                assert np.array_equal(np.asarray(film.convert("RGB")), np.asarray(published.convert("RGB"))), (name, k)


@pytest.mark.parametrize("words", [["worlds.png"], ["--plays", "films"]])
def test_a_picture_that_cannot_be_written(words, monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run(gallery, monkeypatch, *words[:-1], str(tmp_path / "file" / words[-1])) == 2
    assert "cannot write" in capsys.readouterr().err


def test_a_gallery_of_nothing_is_refused(monkeypatch, capsys):
    assert run(gallery, monkeypatch) == 2
    assert "a folder after --plays" in capsys.readouterr().err
