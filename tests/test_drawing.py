"""Pictures and films: what is where in which colour, that agents in one cell are all seen, that files appear whole."""

import re

import numpy as np
import pytest
from PIL import Image, ImageColor

import envs
from envs.drawing import AGENTS, BOXES, CELLS
from tests.helpers import RACE, assert_refused

TREASURE, PUSHBOX = envs.make_world("findtreasure"), envs.make_world("pushbox")
FLOOR = "#ffffff"


def middle(picture, row, column, cell=48):
    """The colour in the middle of a cell, as "#rrggbb"."""
    return "#" + bytes(picture[int((row + 0.5) * cell), int((column + 0.5) * cell)]).hex()


def pixels(picture, colour):
    """How many pixels have exactly this colour."""
    return int(np.all(picture == ImageColor.getrgb(colour), axis=2).sum())


@pytest.mark.parametrize("cell", [6, 12, 48, 96])
def test_the_map_of_findtreasure(cell):
    picture = envs.draw(TREASURE, TREASURE.start, cell)
    assert picture.dtype == np.uint8
    assert picture.shape == (7 * cell, 7 * cell, 3)
    for (row, column), colour in {
        (0, 0): CELLS["wall"],
        (3, 1): CELLS["wall"],
        (3, 3): CELLS["door"],
        (1, 5): CELLS["treasure"],
        (4, 5): CELLS["meeting"],
        (5, 5): CELLS["lever"],
        (2, 2): FLOOR,
        (4, 1): AGENTS[0],
        (5, 1): AGENTS[1],
    }.items():
        assert middle(picture, row, column, cell) == colour


def test_an_open_door_looks_open():
    closed, opened = (envs.draw(TREASURE, state) for state in ([4, 4, 5, 1], [4, 4, 5, 5]))
    assert (pixels(closed, CELLS["open door"]), pixels(opened, CELLS["open door"]) > 1000) == (0, True)


def test_a_world_of_ones_own_has_colours_and_letters_of_its_own():
    world = envs.make_world(str(RACE))
    picture = envs.draw(world, world.start)
    assert (middle(picture, 0, 0), middle(picture, 1, 0), middle(picture, 2, 2)) == (*AGENTS[:2], FLOOR)
    colours = {middle(picture, row, 4) for row in range(5)}
    assert len(colours) == 1
    assert not colours & {FLOOR, *CELLS.values(), *BOXES.values()}
    env = envs.make(str(RACE), render_mode="ansi", size=3)
    env.reset()
    frame = "+------+"
    assert env.render().splitlines() == [frame, "|0   ff|", "|1   ff|", "|    ff|", frame, "0 1 agents, f finish"]


@pytest.mark.parametrize("cell", [12, 48, 96])
def test_the_room_of_pushbox(cell):
    picture = envs.draw(PUSHBOX, [0, 0, 1, 3, 0, 3, 3, 2, 2], cell)
    assert picture.shape == (4 * cell, 4 * cell, 3)
    for (row, column), colour in {
        (0, 0): BOXES["small box"],
        (0, 1): CELLS["goal"],
        (1, 0): FLOOR,
        (1, 1): BOXES["large box"],
        (1, 2): BOXES["large box"],
        (1, 3): BOXES["small box"],
        (3, 0): AGENTS[0],
        (3, 3): AGENTS[1],
    }.items():
        assert middle(picture, row, column, cell) == colour
    assert tuple(picture[int(1.5 * cell), 2 * cell]) == ImageColor.getrgb(BOXES["large box"])  # one box, no gap


@pytest.mark.parametrize(("facing", "dx", "dy"), [(0, 0, -1), (1, 1, 0), (2, 0, 1), (3, -1, 0)])
def test_the_nose_points_where_the_agent_looks(facing, dx, dy):
    picture = envs.draw(PUSHBOX, [1, 1, facing, 3, 0, 0, 2, 2, 2], cell=96)
    rows, columns = np.nonzero(np.all(picture == ImageColor.getrgb(AGENTS[0]), axis=2))
    assert (np.sign(round(columns.mean() - 144)), np.sign(round(rows.mean() - 240))) == (dx, dy)


@pytest.mark.parametrize("num_agents", range(1, 9))
def test_agents_in_one_cell_are_all_seen(num_agents):
    class Crowd:
        @staticmethod
        def sketch(state):
            return 1, 2, [("agent", index, 0, 1, None) for index in range(num_agents)]

    picture = envs.draw(Crowd, None)
    seen = [pixels(picture, colour) for colour in AGENTS]
    assert min(seen[:num_agents]) >= 40
    assert seen[num_agents:] == [0] * (8 - num_agents)
    assert max(seen[:num_agents]) <= 1.2 * min(seen[:num_agents])  # no disc covers another
    assert np.all(picture[1:-1, 1:48] == 255)  # and none leaves the cell


def test_a_caption_stands_beneath_the_map():
    bare, written = envs.draw(TREASURE, TREASURE.start), envs.draw(TREASURE, TREASURE.start, caption="step 1   reward -0.1")
    assert np.array_equal(written[:336], bare)
    assert 8 <= len(written) - 336 <= 48
    assert np.any(written[336:] < 100)
    assert envs.draw(TREASURE, TREASURE.start, caption="short").shape == written.shape


def test_too_small_cells_are_refused():
    assert_refused("at least 6", envs.draw, PUSHBOX, PUSHBOX.start, cell=5)


def film():
    """Agent 0 of findtreasure walks to the right: four different frames."""
    return [envs.draw(TREASURE, [4, column, 5, 1]) for column in (1, 2, 3, 4)]


def test_a_film(tmp_path):
    frames = film()
    envs.save_gif(tmp_path / "walk.gif", frames, fps=5)
    assert [path.name for path in tmp_path.iterdir()] == ["walk.gif"]
    assert (tmp_path / "walk.gif").stat().st_size < 10_000
    with Image.open(tmp_path / "walk.gif") as gif:
        assert gif.n_frames == 4
        assert gif.info["loop"] == 0
        durations = []
        for k, frame in enumerate(frames):
            gif.seek(k)
            durations.append(gif.info["duration"])
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - frame).max() <= 16
    assert durations == [200, 200, 200, 2000]


@pytest.mark.parametrize(
    ("said", "frames", "fps"),
    [
        ("at least one frame", [], 4),
        ("of one size, not uint8 (4, 5, 3)", [np.zeros((5, 5, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], 4),
        ("not float64 (5, 5, 3)", [np.zeros((5, 5, 3))], 4),
        ("not uint8 (5, 5)", [np.zeros((5, 5), np.uint8)], 4),
        ("fps must be a number between 0.01 and 50, not 0", [np.zeros((5, 5, 3), np.uint8)], 0),
        ("fps must be a number between 0.01 and 50, not 1000", [np.zeros((5, 5, 3), np.uint8)], 1000),
    ],
)
def test_what_is_no_film_is_refused(said, frames, fps, tmp_path):
    with pytest.raises(ValueError, match=re.escape(said)):
        envs.save_gif(tmp_path / "walk.gif", frames, fps)
    assert not list(tmp_path.iterdir())


def test_a_film_that_fails_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "walk.gif"
    path.write_bytes(b"old")

    def full_disk(self, file, *args, **options):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(Image.Image, "save", full_disk)
    with pytest.raises(OSError, match="no space"):
        envs.save_gif(path, film())
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
