"""The worlds by name, and a user's own world from a file."""

import ast
import importlib.util
import inspect
import os
import re
import sys
from pathlib import Path

from envs.base import UsageError, World
from envs.cleaner import Cleaner
from envs.climbing import Climbing
from envs.command import one_line
from envs.findtreasure import FindTreasure
from envs.gotogether import GoTogether
from envs.movebox import MoveBox
from envs.passage import Passage
from envs.pushbox import PushBox
from envs.secretroom import SecretRoom
from envs.tryout import try_out

# The paper's, and those on which others judge exploration and coordination.
WORLDS = {world.name: world for world in (Cleaner, FindTreasure, GoTogether, MoveBox, PushBox, Climbing, Passage, SecretRoom)}

TRIED = set()  # files and options of worlds that need not be tried out again, as for each cell of a sweep


def make_world(name: str, **options) -> World:
    """The world `name`, or the one in the file `name` (such as "my_world.py"), with its options.

    UsageError for an unknown world or option, an impossible value, or a file that holds no world.
    """
    if not isinstance(name, str | Path):
        raise UsageError(f"a world is named by a word such as 'pushbox' or by its file, not by {name!r}.")
    name = str(name)
    if name in WORLDS:
        world = WORLDS[name]
    elif name.endswith(".py"):
        world = world_in_file(Path(name))
    else:
        raise UsageError(f"there is no world {name!r}; the worlds are {', '.join(WORLDS)}, or a file such as my_world.py.")
    accepted = list(inspect.signature(world).parameters)
    for option in options:
        if option not in accepted:
            takes = f"takes {', '.join(accepted)}" if accepted else "has none"
            raise UsageError(f"{name} has no option {option!r}; it {takes}.")
    return world(**options) if name in WORLDS else own_world(world, name, options)


def own_world(world, name, options):
    """A world of a class that somebody has written, tried out; UsageError for whatever is wrong with it."""
    try:
        made = world(**options)
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(f"the world in {name} cannot be made: {type(error).__name__}: {one_line(error)}.") from error
    if not hasattr(made, "max_steps"):
        raise UsageError(f"the world in {name} must call super().__init__ in its own.")
    if (known := (Path(name).read_bytes(), repr(options))) not in TRIED:
        try_out(made)
        TRIED.add(known)
    return made


def world_in_file(path):
    """The one subclass of World that a Python file defines."""
    if not os.path.isfile(path):  # unlike path.is_file(), of a name that is too long as well
        raise UsageError(f"there is no file {path}.")
    name = "world_" + re.sub(r"\W", "_", path.stem)  # numba takes no letters that the locale cannot read
    spec = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # numba looks for a module of this name
    try:
        spec.loader.exec_module(module)
    except UsageError:
        raise
    except (Exception, SystemExit) as error:
        raise UsageError(f"{path} cannot be imported: {type(error).__name__}: {one_line(error)}.") from error
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, World) and value.__module__ == name
    ]
    if len(found) != 1:
        raise UsageError(f"{path} must define one subclass of envs.World, not {len(found)}.")
    return found[0]


def parse_options(words) -> dict:
    """Options from the command line: ["size=9", "observation=own"] -> {"size": 9, "observation": "own"}."""
    options = {}
    for word in words:
        option, equals, value = word.partition("=")
        if not (option and equals and value):
            raise UsageError(f"a world's option is written option=value, not {word!r}.")
        try:
            options[option] = ast.literal_eval(value)
        except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):  # all that Python may say of such a text
            options[option] = value
    return options
