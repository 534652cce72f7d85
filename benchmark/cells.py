"""The comparison's unit of work: a cell is a script on a world with one optimiser and a block of seeds, run in one process."""

import contextlib
import hashlib
import importlib
import importlib.util
import io
import json
import os
import re
import sys
import tempfile
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import envs
from envs import run
from envs.command import one_line

RUNS = ROOT / "runs" / "comparison"
WORLDS = ("cleaner", "findtreasure", "gotogether", "movebox", "pushbox")  # the paper's
BEYOND_WORLDS = ("climbing", "passage", "secretroom")
OPTIMIZERS = ("sign", "adam")
# The paper's, in the order of every table. Any other script, of algos/ or named by its path, is called as its file is.
METHODS = {
    "pg": "PG",
    "epg": "EPG",
    "spg": "SPG",
    "espg": "ESPG",
    "decespg": "DecESPG",
    "ac": "AC",
    "coma": "COMA",
    "acer": "ACER",
    "dqn": "DQN",
    "edti": "EDTI",
    "decespg_ex2": "DecESPG+EX2",
    "espg_icm": "ESPG+ICM",
    "espg_emi": "ESPG+EMI",
    "gasil": "GASIL",
}
# Beyond the paper, under a heading of their own, and those of the paper that stand beside them there.
BEYOND = {"hysteretic": "Hysteretic DQN", "ippo": "IPPO", "mappo": "MAPPO", "qmix": "QMIX"}
BESIDE = ("pg", "spg", "decespg", "coma", "dqn", "edti")


def name_of(method):
    """What tables and figures call a method."""
    return (METHODS | BEYOND).get(method, Path(method).stem)


def path_of(method):
    """The file of a method: algos/<method>.py, or `method` itself if it ends in .py."""
    return Path(method).resolve() if str(method).endswith(".py") else ROOT / "algos" / f"{method}.py"


@cache
def script(method):
    """A script as a module; UsageError if it cannot be imported or is none."""
    path, shipped = path_of(method), ROOT / "algos"
    if path.parent != shipped and (shipped / path.name).exists():
        raise envs.UsageError(f"{path} needs another name than algos/{path.name}, so that their results can be told apart.")
    try:
        if path.parent == shipped:
            module = importlib.import_module(f"algos.{path.stem}")
        else:
            spec = importlib.util.spec_from_file_location(path.stem, path)
            module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # the file may be anybody's
        raise envs.UsageError(f"{path} cannot be imported: {type(error).__name__}: {one_line(error)}.") from error
    for name in ("Args", "WORLDS", "TUNED", "OTHER", "train"):
        if not hasattr(module, name):
            raise envs.UsageError(f"{path} is no script for the comparison, because it has no {name}.")
    return module


def train_aside(module, **args):
    """Train in a directory that goes afterwards, without a word on stdout; returns what the script's `train` returns."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        return module.train(module.Args(run_dir=Path(folder) / "run", **args))


def takes_optimizer(method):
    """Whether a method lets its policies' optimiser be chosen; Q-learning, which has no policies, and PPO always use Adam."""
    return any(field.name == "optimizer" for field in fields(script(method).Args))


@dataclass(frozen=True)
class Cell:
    """One run of the comparison, everything that is not named here at its default."""

    method: str
    world: str
    optimizer: str
    first_seed: int = 1
    num_trials: int = 20
    num_episodes: int | None = None  # None: Table 1
    runs: Path = RUNS  # under which the cells work
    env_args: tuple[str, ...] = ()  # options of the world, such as "size=6"
    own: tuple[tuple[str, str], ...] = ()  # arguments of the script that are not at their defaults, and their values

    @property
    def arguments(self):
        """What the script is told besides `env_args` and `own`, {argument: value}."""
        world = self.world if self.world in envs.WORLDS else str(Path(self.world).resolve())
        told = dict(env=world, seed=self.first_seed, num_trials=self.num_trials)
        if takes_optimizer(self.method):
            told["optimizer"] = self.optimizer
        return told if self.num_episodes is None else {**told, "num_episodes": self.num_episodes}

    @property
    def words(self):
        """All that the script is told, as words of its command line."""
        told = {name: [str(value)] for name, value in self.arguments.items()}
        told |= {"env_args": self.env_args} if self.env_args else {}
        told |= {name: value.split() for name, value in self.own}
        return [word for name, values in told.items() for word in (run.option(name), *values)]

    def parsed(self):
        """The script's Args; UsageError for an argument that it does not take."""
        module = script(self.method)
        if not (self.env_args or self.own):
            return module.Args(**self.arguments)
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                return tyro.cli(module.Args, args=self.words)
        except SystemExit as error:
            own = " ".join(f"{name}={value}" for name, value in self.own)
            raise envs.UsageError(
                f"{path_of(self.method).name} does not take {own or self.env_args}; see its --help."
            ) from error

    @cached_property
    def settings(self):
        """Everything that the result depends on: the arguments with their defaults filled in, as args.json holds them."""
        args, _ = self.resolved
        values = {name: value for name, value in vars(args).items() if name not in run.HOUSEKEEPING}
        return json.loads(json.dumps({"method": path_of(self.method).stem, **values}))

    @property
    def resolved(self):
        """The script's arguments with their defaults filled in, and the world."""
        module = script(self.method)
        return run.resolve(self.parsed(), module.WORLDS, module.TUNED, module.OTHER)

    @property
    def name(self):
        """Short, unique among cells of the same settings."""
        seeds = f"{self.first_seed}-{self.first_seed + self.num_trials - 1}"
        where = f"{Path(self.world).stem}/{path_of(self.method).stem}"
        own = "".join(f"-{word}" for word in (*self.env_args, *(f"{name}={value}" for name, value in self.own)))
        return f"{where}/{self.optimizer}-seeds{seeds}-episodes{self.settings['num_episodes']}{own.replace('/', '_')}"

    @property
    def run_dir(self):
        """Where the script works: other settings are another directory."""
        digest = hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode()).hexdigest()
        return self.runs / f"{self.name}-{digest[:8]}"

    @property
    def log(self):
        """What the script says while it runs."""
        return self.run_dir / "output.txt"

    @property
    def command(self):
        """The command that runs the cell from its beginning."""
        script_file = os.path.relpath(path_of(self.method), ROOT)  # cells are run there
        return [sys.executable, script_file, *self.words, "--run-dir", str(self.run_dir), "--save-model"]

    @property
    def finished(self):
        """Whether the result is there, complete and from these settings."""
        return (self.run_dir / "episodes.npz").exists() and not self.broken

    @property
    def edited(self):
        """Whether the script or the world's file is not what it was when the run that is there began."""
        with contextlib.suppress(OSError, ValueError):
            about = json.loads((self.run_dir / "args.json").read_text(encoding="utf-8"))
            now = run.source_of(path_of(self.method), self.resolved[1])
            return about.get("source", now) != now
        return False

    @property
    def broken(self):
        """What is wrong with the result that is there; empty if nothing is."""
        return self.what_is_wrong(self.run_dir) if (self.run_dir / "episodes.npz").exists() else ""

    def what_is_wrong(self, run_dir):
        """What is wrong with the result in a directory as one of this cell; empty if nothing is."""
        path = run_dir / "episodes.npz"
        try:
            with np.load(path) as episodes:
                shapes = {episodes[name].shape for name in ("returns", "lengths", "outcomes")}
            found = settings_of(run_dir)
        except Exception as error:  # whatever can be wrong with a file
            return f"{path} cannot be read ({type(error).__name__})"
        if shapes != {(self.num_trials, self.settings["num_episodes"])}:
            return f"{path} holds arrays of another shape"
        return "" if found == self.settings else f"{run_dir}/args.json is from other settings"


def check_words(what, words, known):
    """UsageError if one of the words is none of those that are known."""
    for word in words:
        if word not in known:
            raise envs.UsageError(f"there is no {what} {word!r}; there is {', '.join(known)}.")


def seconds_of(run_dir):
    """The seconds that a run took, as ./benchmark.sh has noted them; nan if it has not, or not to the end."""
    try:
        return float((run_dir / "seconds").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return float("nan")


def seeds_of(text):
    """(first, last) of "1-20", or of "1"; UsageError if the text is something else."""
    found = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", text)
    seeds = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if seeds[0] > seeds[1]:
        raise envs.UsageError(f"--seeds must be two numbers such as 1-20, not {text!r}.")
    return seeds


def settings_of(run_dir):
    """The settings of a run that is there, in the form of `Cell.settings`."""
    about = json.loads((run_dir / "args.json").read_text(encoding="utf-8"))
    return {"method": about["method"], **{k: v for k, v in about["args"].items() if k not in run.HOUSEKEEPING}}


def select(methods, worlds, optimizers, **block):
    """The cells of a selection, in the order of the tables; one that takes no optimiser has one cell, under "adam".

    block: the other fields of all cells
    """
    return [
        Cell(method, world, optimizer, **block)
        for world in worlds
        for method in methods
        for optimizer in optimizers
        if takes_optimizer(method) or optimizer == "adam"
    ]
