"""Pictures of all worlds: side by side in the style of the paper's Figure 2, and a film of each one's optimal play.

python -m envs.gallery docs/worlds.png

python -m envs.gallery --plays docs         optimal-<world>.gif for every world
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

import envs
from envs.command import command_line
from envs.drawing import INK, PAPER

SIDE, GAP, TEXT = 420, 40, 30  # pixels: a map's side (at most), the space between two maps, the names' letters
IN_A_ROW = 4
FILM, SECONDS = 300, 8  # pixels: the side of a film's map (at most); how long a film is (at most)


@dataclass
class Args:
    path: tyro.conf.Positional[Path | None] = None
    """where to write the picture of all worlds, a PNG file"""
    plays: Path | None = None
    """the folder in which to write the films of optimal play, optimal-<world>.gif"""


def gallery():
    """The picture, uint8 [height, width, 3]: every world at its start, cleaner after some steps of its plan."""
    rows = -(-len(envs.WORLDS) // IN_A_ROW)
    page = Image.new("RGB", (IN_A_ROW * (SIDE + GAP) - GAP, rows * (SIDE + 2 * TEXT)), PAPER)
    for k, name in enumerate(envs.WORLDS):
        world = envs.make_world(name)
        state = world.start.copy()
        if name == "cleaner":
            for actions in world.plan()[:16]:
                world.step(world.rules, state, actions)
        picture = Image.fromarray(envs.draw(world, state, cell=SIDE // max(world.sketch(state)[:2])))
        left, top = k % IN_A_ROW * (SIDE + GAP), k // IN_A_ROW * (SIDE + 2 * TEXT)
        page.paste(picture, (left + (SIDE - picture.width) // 2, top + (SIDE - picture.height) // 2))
        place, font = (left + SIDE / 2, top + SIDE + TEXT), ImageFont.load_default(TEXT)
        ImageDraw.Draw(page).text(place, type(world).__name__, INK, font, anchor="mm")
    return np.asarray(page)


def optimal_play(world):
    """The pictures of the episode with the best reward per step, with step, reward and return beneath.

    It stops after the last reward: what follows in cleaner, whose episodes last until the time limit, is only waiting.
    """
    state, total = world.start.copy(), 0.0
    cell = FILM // max(world.sketch(state)[:2])
    frames = [envs.draw(world, state, cell, "start")]
    last = 0
    for t, actions in enumerate(envs.optimal_plan(world), start=1):
        reward, _ = world.step(world.rules, state, actions)
        total += reward
        last = t if reward else last
        frames.append(envs.draw(world, state, cell, f"step {t}   reward {reward:g}   return {total:g}"))
    return frames[: last + 1]


def write_picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    with envs.complete_file(path) as file:
        Image.fromarray(gallery()).save(file, "PNG", optimize=True)


def write_films(folder):
    folder.mkdir(parents=True, exist_ok=True)
    for name in envs.WORLDS:
        frames = optimal_play(envs.make_world(name))
        envs.save_gif(folder / f"optimal-{name}.gif", frames, fps=max(2, len(frames) / SECONDS))


def main():
    with command_line("python -m envs.gallery"):
        args = tyro.cli(Args, prog="python -m envs.gallery", description=__doc__)
        if not (args.path or args.plays):
            raise envs.UsageError("name a PNG file for the picture of all worlds, or a folder after --plays.")
        try:
            if args.path:
                write_picture(args.path)
            if args.plays:
                write_films(args.plays)
        except OSError as error:
            raise envs.UsageError(f"cannot write {error.filename or args.plays or args.path}: {error.strerror}.") from error


if __name__ == "__main__":
    main()
