"""Pictures of the worlds in the style of a paper's figure, GIFs of episodes, and maps in letters for the terminal.

A world says what it looks like by `world.sketch(state) -> (rows, columns, shapes)`; row 0 is the top. The shapes are
    ("cell", kind, row, column)            a cell in the colour of `kind`, of CELLS or any other word
    ("box", kind, row, column, width)      a box from `column` on, `width` cells wide; `kind` as in BOXES or any other word
    ("agent", index, row, column, facing)  agent number `index`; facing 0 north, 1 east, 2 south, 3 west, or None
drawn in this order: cells, the grid's lines, boxes, agents. Agents that share a cell stand smaller in a ring.
"""

import math
from collections import Counter

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs.base import check_memory, check_number, check_whole
from envs.files import complete_file

PAPER, GRID, INK = "#ffffff", "#d4d4d4", "#222222"
CELLS = {
    "wall": INK,
    "door": "#8f7057",
    "open door": "#eee3d9",  # hatched
    "lever": "#f2c500",
    "meeting": "#fdf0bd",
    "treasure": "#2c9f4b",
    "goal": "#b5e0bf",
    "near goal": "#fdf0bd",
    "far goal": "#b5e0bf",
    "dirt": "#a8d9b0",
    **{"11": "#2c9f4b", "10": "#2c9f4b", "7": "#74bd86", "6": "#8fcb9b", "5": "#b5e0bf", "2": "#b5e0bf"},  # payoffs
    **{"0": "#ececec", "penalty": "#e0705f"},
}
BOXES = {"small box": "#e6c79b", "large box": "#c08f5a", "box": "#c08f5a"}
OTHERS = ("#c9b6e4", "#9fd8df", "#f2b8a0", "#c5d86d", "#e3a6c4")  # for kinds in a world of the user's own
LETTERS = {
    **{"wall": "#", "door": "D", "open door": "o", "lever": "L", "meeting": "m", "treasure": "T", "goal": "g"},
    **{"near goal": "n", "far goal": "f", "dirt": ".", "small box": "s", "large box": "B", "box": "B"},
}
# Red and blue first; the shades differ in lightness too, so that they can be told apart without red or green.
AGENTS = ("#d62f2f", "#1f5fa8", "#f59a3c", "#7a3fa0", "#35b6cf", "#e58bc4", "#7d7d7d", "#5e3413")
FINE = 4  # everything is drawn this many times larger and averaged, which smooths the edges and keeps even areas even


def colour_of(kind, colours):
    """The colour of a kind of cell or box; one that is not listed has the same of OTHERS wherever it is drawn."""
    return colours.get(kind) or OTHERS[sum(kind.encode()) % len(OTHERS)]


def draw(world, state, cell=48, caption=""):
    """The picture of `state` [state_dim] of `world`, uint8 [rows * cell, columns * cell, 3]; UsageError if cell < 6 pixels.

    A caption adds a line of text (about 36 letters) below the map; its height depends on the map's width only.
    """
    cell = check_whole("cell", cell, minimum=6)
    rows, columns, shapes = world.sketch(state)
    width, height = columns * cell, rows * cell
    check_memory(f"a picture of {rows} rows and {columns} columns", 3 * width * height * FINE**2)
    large = Image.new("RGB", (width * FINE, height * FINE), PAPER)
    pen, unit = ImageDraw.Draw(large), cell * FINE
    line = max(1, round(cell / 48)) * FINE  # whole pixels of the finished picture: sharp
    shapes_of = {what: [shape[1:] for shape in shapes if shape[0] == what] for what in ("cell", "box", "agent")}

    for kind, row, column in shapes_of["cell"]:
        _draw_cell(large, kind, row * unit, column * unit, unit)
    walls = {(row, column) for kind, row, column in shapes_of["cell"] if kind == "wall"}
    for row in range(rows):
        for column in range(columns):
            top, left = row * unit, column * unit
            if (row, column) not in walls and (row - 1, column) not in walls:
                pen.rectangle((left, top, left + unit - 1, top + line - 1), GRID)
            if (row, column) not in walls and (row, column - 1) not in walls:
                pen.rectangle((left, top, left + line - 1, top + unit - 1), GRID)
    pen.rectangle((0, 0, large.width - 1, large.height - 1), outline=INK, width=line)
    for kind, row, column, cells in shapes_of["box"]:
        _draw_box(pen, colour_of(kind, BOXES), row * unit, column * unit, cells, unit)
    for row, column in dict.fromkeys(shape[1:3] for shape in shapes_of["agent"]):
        here = [(index, facing) for index, r, c, facing in shapes_of["agent"] if (r, c) == (row, column)]
        if len(here) == 1:
            away, radius = 0.0, 0.41 * unit
        else:  # a ring of equal circles that touch each other and the border of the cell
            slope = math.sin(math.pi / len(here))
            away = 0.5 * unit / (1 + slope)
            radius = away * slope
        for k, (index, facing) in enumerate(here):
            angle = math.pi * (1.25 + 2 * k / len(here))
            x = (column + 0.5) * unit + away * math.cos(angle)
            y = (row + 0.5) * unit + away * math.sin(angle)
            _draw_agent(pen, AGENTS[index % len(AGENTS)], x, y, radius, facing)

    picture = large.reduce(FINE)
    if caption:
        size = min(max(8, width // 18), 18)
        page = Image.new("RGB", (width, height + 2 * size), PAPER)
        page.paste(picture)
        place = (width / 2, height + size)
        ImageDraw.Draw(page).text(place, caption, INK, ImageFont.load_default(size), anchor="mm")
        picture = page
    return np.asarray(picture)


def _draw_cell(large, kind, top, left, unit):
    """One cell in its colour; an open door is hatched."""
    tile = Image.new("RGB", (unit, unit), colour_of(kind, CELLS))
    if kind == "open door":
        pen = ImageDraw.Draw(tile)
        for x in range(-unit, unit, unit // 4):
            pen.line((x, unit, x + unit, 0), CELLS["door"], unit // 24)
    large.paste(tile, (left, top))


def _draw_box(pen, colour, top, left, cells, unit):
    """A rounded, outlined rectangle slightly inside its cells; gap and outline are whole pixels of the finished picture."""
    gap, outline = (max(1, round(unit / FINE / part)) * FINE for part in (9, 32))
    corners = (left + gap, top + gap, left + cells * unit - gap - 1, top + unit - gap - 1)
    pen.rounded_rectangle(corners, unit // 8, colour, INK, outline)


def _draw_agent(pen, colour, x, y, radius, facing):
    """A disc around (x, y); if the agent faces somewhere, a smaller one with a nose that points there."""
    disc = (0.88 if facing is None else 0.75) * radius
    pen.circle((x, y), disc, colour)
    if facing is not None:
        dx, dy = ((0, -1), (1, 0), (0, 1), (-1, 0))[facing]
        tip, side = 1.5 * disc, 0.71 * disc  # the sides of the nose touch the disc
        base = [(x + side * (dx - turn * dy), y + side * (dy + turn * dx)) for turn in (-1, 1)]
        pen.polygon([(x + tip * dx, y + tip * dy), *base], colour)


def save_gif(path, frames, fps=4):
    """Write the film of `frames` (pictures of one size, as `draw` makes them) to `path`; it loops and rests on its last frame.

    fps: frames per second, 0.01 to 50, which is what a GIF can say. The file appears at once and complete, or not at all.
    ValueError if there are no frames, or not all are pictures [height, width, 3] (uint8) of one size.
    """
    frames, fps = [np.asarray(frame) for frame in frames], check_number("fps", fps, lowest=0.01, highest=50)
    if not frames:
        raise ValueError("a film needs at least one frame.")
    for frame in frames:
        picture = frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3 and frame.size
        if not picture or frame.shape != frames[0].shape:
            what = f"{frame.dtype} {frame.shape}"
            raise ValueError(f"frames must be pictures [height, width, 3] (uint8) of one size, not {what}.")
    images = [Image.fromarray(frame) for frame in frames]
    colours = Counter()
    for image in images:
        colours.update({colour: count for count, colour in image.getcolors(image.width * image.height)})
    palette = Image.new("P", (1, 1))  # the same for all frames, so that nothing flickers
    palette.putpalette([channel for colour, _ in colours.most_common(128) for channel in colour])
    first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = [round(1000 / fps)] * len(rest) + [2000]
    with complete_file(path) as file:
        first.save(file, "GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=True)


def text_map(world, state):
    """The map of `state` of `world` in letters, with a last line that says what they mean.

    A cell shows the numbers of its agents (and an arrow where they look), then the letter of its box or of the cell itself.
    Cells are as wide as the fullest one, at least two letters.
    """
    rows, columns, shapes = world.sketch(state)
    letters, agents, kinds = {}, {}, {}
    for what, *shape in sorted(shapes, key=lambda shape: ("cell", "box", "agent").index(shape[0])):
        if what == "agent":
            index, row, column, facing = shape
            agents[row, column] = f"{agents.get((row, column), '')}{index}{'' if facing is None else '^>v<'[facing]}"
        else:
            kind, row, column, cells = (*shape, 1)[:4]
            kinds[kind] = LETTERS.get(kind, kind[0])
            letters.update({(row, column + k): kinds[kind] for k in range(cells)})
    width = max(2, *map(len, agents.values()))
    lines = [
        "".join((agents.get((r, c), "") + letters.get((r, c), " ") * width)[:width] for c in range(columns))
        for r in range(rows)
    ]
    if "wall" not in kinds:
        edge = f"+{'-' * columns * width}+"
        lines = [edge, *(f"|{line}|" for line in lines), edge]
    legend = [" ".join(map(str, range(world.num_agents))) + " agents", *(f"{letter} {kind}" for kind, letter in kinds.items())]
    return "\n".join([*lines, ", ".join(legend)])
