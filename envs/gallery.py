"""A picture of all worlds side by side, in the style of the paper's Figure 2: `python -m envs.gallery docs/worlds.png`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

import envs
from envs.command import command_line
from envs.drawing import INK, PAPER

SIDE, GAP, TEXT = 420, 40, 30  # pixels: a map's side (at most), the space between two maps, the names' letters


@dataclass
class Args:
    path: tyro.conf.Positional[Path]
    """where to write the picture, a PNG file"""


def gallery():
    """The picture, uint8 [height, width, 3]: every world at its start, cleaner after some steps of its plan."""
    page = Image.new("RGB", (len(envs.WORLDS) * (SIDE + GAP) - GAP, SIDE + 2 * TEXT), PAPER)
    for k, name in enumerate(envs.WORLDS):
        world = envs.make_world(name)
        state = world.start.copy()
        if name == "cleaner":
            for actions in world.plan()[:16]:
                world.step(world.rules, state, actions)
        picture = Image.fromarray(envs.draw(world, state, cell=SIDE // max(world.sketch(state)[:2])))
        left = k * (SIDE + GAP)
        page.paste(picture, (left + (SIDE - picture.width) // 2, (SIDE - picture.height) // 2))
        place, font = (left + SIDE / 2, SIDE + TEXT), ImageFont.load_default(TEXT)
        ImageDraw.Draw(page).text(place, type(world).__name__, INK, font, anchor="mm")
    return np.asarray(page)


def main():
    with command_line("python -m envs.gallery"):
        args = tyro.cli(Args, prog="python -m envs.gallery", description=__doc__)
        try:
            args.path.parent.mkdir(parents=True, exist_ok=True)
            with envs.complete_file(args.path) as file:
                Image.fromarray(gallery()).save(file, "PNG", optimize=True)
        except OSError as error:
            raise envs.UsageError(f"cannot write {args.path}: {error.strerror}.") from error


if __name__ == "__main__":
    main()
