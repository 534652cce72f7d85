"""What a run leaves: arguments, directories, curves, checkpoints and results; how it resumes; what `--evaluate` does.

Every script uses it in the same few places, and nothing that a method is stands here:

    class Args(RunArgs): ...                                         # with the method's own arguments
    args, world = resolve(args, WORLDS, TUNED, OTHER)                # every None filled in
    init, act, learn = generators_of(args)                           # one numpy Generator for each trial in each of them
    run = Run(args, world, team, optimizers=[..], generators=act)    # the directory
    for episode in run.episodes(): .. run.record(episode, rollout, figure=values)
    return run.finish()
    main(Args, build, train)                                         # the command line

It is the only file of envs/ that imports torch.
"""

import contextlib
import fcntl
import hashlib
import inspect
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, get_type_hints

import numpy as np
import torch
import tyro
from tqdm import tqdm

import envs
from envs.command import command_line, one_line, silence
from envs.curves import Curves

# Every method of torch's optimisers is wrapped so that torch.compile leaves it alone, and the wrapper, when first called,
# imports the compiler: 2.6 of 5.6 seconds of start-up, and nothing here is compiled by torch. So what the wrapper would find
# out is said in advance, and Adam's step goes without it.
for method in vars(torch.optim.Optimizer).values():
    if (plain := getattr(method, "__wrapped__", None)) is not None:
        plain.__dynamo_disable = plain
torch.optim.Adam.step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))

# Where the run's files go and what is done beside training: nothing on which the result depends.
HOUSEKEEPING = ("run_dir", "checkpoint_every", "resume", "overwrite", "save_model", "capture_video", "evaluate", "greedy")
OUTPUT = ("args.json", "checkpoint.pt", "episodes.npz", "policy.pt", "team.gif")  # what a run may write, beside seed*/


@dataclass(frozen=True)
class Between:
    """The lowest and highest value of a number that makes sense, or of each if there are several; written beside its type."""

    lowest: float
    highest: float = np.inf


AtLeast = Between


@dataclass
class RunArgs:
    """The arguments that every script has. `None` means the value of the script's WORLDS or TUNED."""

    env: str = "pushbox"
    """world: cleaner, climbing, findtreasure, gotogether, movebox, passage, pushbox or secretroom, or a file: my_world.py"""
    env_args: tuple[str, ...] = ()
    """options of the world, such as size=6 (envs/<world>.py lists them)"""
    seed: Annotated[int, AtLeast(0)] = 1
    """seed of the first trial; trial k has seed + k"""
    num_trials: Annotated[int, AtLeast(1)] = 1
    """independent trials, trained side by side in this process"""
    num_episodes: Annotated[int | None, AtLeast(1)] = None
    """training episodes of each trial (None: Table 1; 10000 in other worlds); with --evaluate, episodes to play (None: 100)"""
    max_steps: Annotated[int | None, AtLeast(1)] = None
    """time limit of an episode in steps (None: Table 1; in other worlds what they say themselves)"""
    log_every: Annotated[int, AtLeast(1)] = 100
    """episodes between two points of the TensorBoard curves, which show the mean since the last point"""
    run_dir: Path | None = None
    """where the run's files go (None: runs/<env>/<method>/seed<first>[-<last>][-<arguments that are not the default>])"""
    checkpoint_every: Annotated[float, AtLeast(0)] = 60.0
    """seconds between two checkpoints (longer where writing one would take over 2 % of the time)"""
    resume: bool = False
    """go on from the checkpoint in the run's directory"""
    overwrite: bool = False
    """start anew even if the run's directory holds results; with --evaluate, replace a GIF that is there"""
    save_model: bool = False
    """write the trained policies, and what else the method has learnt, to policy.pt"""
    capture_video: bool = False
    """write one episode of the first trial's trained team to team.gif"""
    evaluate: Path | None = None
    """do not train: play the teams of this policy.pt, print how their episodes end and write a GIF beside it"""
    greedy: bool = False
    """with --evaluate: take the likeliest actions instead of drawing from the policies"""

    def __init_subclass__(cls):
        # numba's cache on disk looks for a script's functions under the name by which the script was once imported.
        module = sys.modules[cls.__module__]
        sys.modules.setdefault(Path(module.__file__).stem, module)


def script_of(args):
    """The path of the script whose Args these are."""
    return Path(inspect.getfile(type(args)))


def resolve(args, worlds, tuned, other):
    """The arguments with every None filled in, and the world; UsageError for what is impossible.

    worlds: {world: {argument: value}}, what Table 1 fixes. tuned: {(world, optimizer): {argument: value}}, what the tuning rule
    has chosen. other: {argument: value} of worlds that these tables do not know.
    """
    args = type(args)(**{name: envs.plain(value) for name, value in vars(args).items()})
    optimizer = getattr(args, "optimizer", "adam")  # Q-learning and PPO always use Adam
    known = {**worlds.get(args.env, {}), **tuned.get((args.env, optimizer), {})}
    defaults = {"num_episodes": 10_000, **other, **known, "run_dir": default_run_dir(args)}
    values = {name: defaults.get(name) if value is None else value for name, value in vars(args).items()}
    limit = {} if values["max_steps"] is None else {"max_steps": values["max_steps"]}
    world = envs.make_world(args.env, **{**limit, **envs.parse_options(args.env_args)})
    resolved = type(args)(**{**values, "max_steps": world.max_steps})
    check_limits(resolved)
    check_room(resolved, world)
    torch.set_num_threads(1)  # a process is one core; ./benchmark.sh starts one for each
    return resolved, world


def check_limits(args, names=None):
    """UsageError if an argument, or one of its numbers if it has several, is not `Between` the limits beside its type."""
    for name, hint in get_type_hints(type(args), include_extras=True).items():
        for limit in getattr(hint, "__metadata__", ()):
            if isinstance(limit, Between) and (names is None or name in names):
                value = getattr(args, name)
                for number in value if isinstance(value, tuple) else [value]:
                    envs.check_number(option(name), number, limit.lowest, limit.highest)


def check_room(args, world):
    """UsageError if what a run holds from its beginning to its end would not fit into this machine's memory."""
    trials, networks = args.num_trials, args.num_trials * world.num_agents
    log, others = 13 * args.num_episodes, 10_000  # bytes of a trial: its episodes, and its generators and whatever else
    envs.check_memory(f"a log of {trials} x {args.num_episodes} episodes", trials * (log + others))
    widths = (world.obs_dim, *getattr(args, "hidden", ()), world.num_actions)
    weights = sum(width * next_width for width, next_width in pairwise(widths))
    what = f"{networks} networks with hidden layers of {' and '.join(map(str, widths[1:-1]))}"
    envs.check_memory(what, 16 * networks * weights)  # a weight, its gradient and Adam's two moments


def default_run_dir(args):
    """runs/<env>/<method>/seed<first>[-<last>][-<arguments that are not the default>]"""
    words = [f"seed{args.seed}" + f"-{args.seed + args.num_trials - 1}" * (args.num_trials > 1)]
    for field in fields(args):
        value = getattr(args, field.name)
        if value != field.default and field.name not in ("env", "seed", "num_trials", *HOUSEKEEPING):
            words.append(f"{field.name}={','.join(map(str, value)) if isinstance(value, tuple) else value}")
    name = "-".join(words).replace("/", "_")
    if len(os.fsencode(name)) > 200:  # no file system takes names of more than 255 bytes
        name = f"{os.fsdecode(os.fsencode(name)[:180])}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"
    return Path("runs", Path(args.env).stem, script_of(args).stem, name)


def generators_of(args):
    """numpy Generators (init, act, learn), each a list with one for each trial.

    The actors' weights are the first draws of init, and nothing but action uniforms draws from act: so all methods start from
    the same actors at the same seed.
    """
    seeds = [np.random.SeedSequence(args.seed + k).spawn(3) for k in range(args.num_trials)]
    return [[np.random.default_rng(seed) for seed in stream] for stream in zip(*seeds, strict=True)]


def check_parts(team):
    """UsageError for a part of a team that could not be saved."""
    for name, part in vars(team).items():
        arrays = getattr(part, "params", getattr(part, "state", None))
        if not isinstance(arrays, list | tuple) or not all(isinstance(array, np.ndarray | torch.Tensor) for array in arrays):
            raise envs.UsageError(
                f"the team's {name}, a {type(part).__name__}, must list its arrays and tensors as `params` or `state`, which is"
                " what a checkpoint keeps."
            )


def arrays_of(part):
    """The arrays and tensors that a part of a team consists of: a network's `params`, the `state` of everything else."""
    arrays = part.params if hasattr(part, "params") else part.state
    return [torch.from_numpy(array) if isinstance(array, np.ndarray) else array.detach() for array in arrays]


def restore(arrays, kept):
    """Copy what was kept into arrays of the same shapes; ValueError if they are others."""
    shapes, found = [tuple(array.shape) for array in arrays], [tuple(array.shape) for array in kept]
    if shapes != found:
        raise ValueError(f"it holds arrays of the shapes {found} where {shapes} are expected")
    for array, values in zip(arrays, kept, strict=True):
        array.copy_(values)


class Run:
    """The directory of a run: curves, checkpoints, results."""

    def __init__(self, args, world, team, optimizers=(), generators=()):
        """Arguments:
        args, world: as from `resolve`
        team:       a namespace of all that learns or remembers, policy first; see `arrays_of`
        optimizers: torch's, and others with state_dict and load_state_dict
        generators: all random generators that training uses
        """
        self.args, self.world, self.team = args, world, team
        self.optimizers, self.generators = optimizers, generators
        self.log = envs.EpisodeLog(world, args.num_trials, args.num_episodes)
        self.sums = {}  # of the figures since the last point of the curves, {name: [num_trials]}
        self.method = script_of(args).stem
        self.settings = {"method": self.method, **{k: v for k, v in asdict(args).items() if k not in HOUSEKEEPING}}
        self.directory = args.run_dir
        self.checkpoint, self.result = self.directory / "checkpoint.pt", self.directory / "episodes.npz"
        self.start = 0
        check_parts(team)  # what cannot be saved or drawn is said now, not after hours
        if args.capture_video:
            envs.draw(world, world.start)
        with writing_to(self.directory):
            self._open_directory()
            trials = [self.directory / f"seed{args.seed + k}" for k in range(args.num_trials)]
            text = "\n".join(f"    {name} = {value}" for name, value in self.settings.items())
            self.curves = Curves(trials, text, purge=self.log.lengths.sum(1) if args.resume else None)

    def _open_directory(self):
        """Make the directory, own it, and load what is to be resumed; UsageError if somebody's files would be lost."""
        directory, args = self.directory, self.args
        if not directory.name:
            raise envs.UsageError(f"--run-dir must name a directory of its own, not {str(directory)!r}.")
        self._refuse_to_overwrite()
        foreign = sorted(path.name for path in directory.glob("*") if not is_ours(path.name)) if directory.is_dir() else []
        if foreign:
            raise envs.UsageError(f"{directory} holds other files ({foreign[0]}); a run needs a directory of its own.")
        if args.resume and not self.checkpoint.exists():
            raise envs.UsageError(
                f"there is nothing to resume: {directory} holds no checkpoint of an unfinished run with these arguments."
            )
        directory.mkdir(parents=True, exist_ok=True)
        self._own_directory()
        self._refuse_to_overwrite()  # what another process may have finished meanwhile
        if args.resume:
            self._load_checkpoint()
        for old in [] if args.resume else [*self._kept(), *directory.glob("seed*/events.*")]:
            old.unlink(missing_ok=True)
        about = {"method": self.method, "args": asdict(args), "python": sys.version.split()[0]}
        about.update({package: version(package) for package in ("torch", "numpy", "numba", "gymnasium")})
        about["commit"] = commit_of(script_of(args).parent)
        about["source"] = source_of(script_of(args), self.world)
        with envs.complete_file(directory / "args.json") as file:
            file.write(json.dumps(about, indent=2, default=str).encode())

    def _kept(self):
        """The files of a run, there or not, that nobody may lose unasked."""
        return [self.directory / name for name in OUTPUT if name != "args.json"]

    def _refuse_to_overwrite(self):
        """UsageError if the directory holds a run that neither --resume nor --overwrite speaks of."""
        if self.args.resume or self.args.overwrite or not any(path.exists() for path in self._kept()):
            return
        held = "a finished run" if self.result.exists() else "an unfinished run or a part of one"
        advice = "go on with --resume or " if self.checkpoint.exists() and not self.result.exists() else ""
        raise envs.UsageError(f"{self.directory} holds {held}; {advice}start anew with --overwrite.")

    def _own_directory(self):
        """Lock the directory for as long as this process lives; UsageError if another one works in it."""
        self.lock = (self.directory / ".owner").open("w")
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise envs.UsageError(f"another process works in {self.directory}; wait for its end or choose --run-dir.") from None

    def _contents(self):
        """What a checkpoint holds beside arrays: {name: list of arrays and tensors}."""
        log = self.log
        return {"log": [torch.from_numpy(array) for array in (log.returns, log.lengths, log.outcomes)]} | {
            name: arrays_of(part) for name, part in vars(self.team).items()
        }

    def _load_checkpoint(self):
        try:
            saved = torch.load(self.checkpoint, weights_only=True)
        except Exception as error:  # whatever can be wrong with a file
            raise envs.UsageError(f"{self.checkpoint} cannot be read; start anew with --overwrite.") from error
        try:
            for name, value in self.settings.items():
                if (kept := saved["settings"].get(name)) != value:
                    raise envs.UsageError(f"--resume needs the same arguments, but {name} was {kept} and is now {value}.")
            if (own := self._contents()).keys() != saved["contents"].keys():
                raise ValueError(f"it holds {', '.join(saved['contents'])}")
            for name, arrays in own.items():
                restore(arrays, saved["contents"][name])
            for optimizer, state in zip(self.optimizers, saved["optimizers"], strict=True):
                optimizer.load_state_dict(state)
            for generator, state in zip(self.generators, saved["generators"], strict=True):
                generator.bit_generator.state = state
            self.start = saved["episode"]
            self.sums = {name: np.array(values) for name, values in saved["sums"].items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            reason = f"{self.checkpoint} is not a checkpoint of this version of {self.method}.py"
            raise envs.UsageError(f"{reason} ({one_line(error)}); start anew with --overwrite.") from error

    def _save_checkpoint(self, episode):
        self.curves.flush()
        saved = {
            "settings": self.settings,
            "episode": episode,
            "contents": self._contents(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "generators": [generator.bit_generator.state for generator in self.generators],
            "sums": {name: values.tolist() for name, values in self.sums.items()},
        }
        with writing_to(self.directory), envs.complete_file(self.checkpoint) as file:
            torch.save(saved, file)

    def episodes(self):
        """Yield the number of every episode to play; between two of them write checkpoints and listen to Ctrl-C."""
        first, last, stopped = self.start, self.args.num_episodes, []
        signals = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
        handlers = {s: signal.signal(s, lambda number, _: stopped.append(number)) for s in signals}
        self.bar = tqdm(initial=first, total=last, desc=f"{self.method} {self.args.env}", unit="ep", mininterval=0.5)
        self.bar.set_postfix_str("compiling, if it is the first time")
        self._set_clock()
        saved = self.clock
        pause = self.args.checkpoint_every
        try:
            for episode in range(first, last):
                yield episode
                if episode == first:
                    self.bar.set_postfix_str("")
                self.bar.update()
                if stopped or time.monotonic() - saved >= pause:
                    began = time.monotonic()
                    self._save_checkpoint(episode + 1)
                    saved = time.monotonic()
                    pause = max(self.args.checkpoint_every, 50 * (saved - began))
                if stopped:
                    self.bar.write(f"Stopped after {episode + 1} episodes; go on with --resume.", file=sys.stderr)
                    sys.exit(128 + stopped[0])
        finally:
            self.bar.close()
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def record(self, episode, rollout, policy_loss=None, **figures):
        """Keep one episode of every trial; every `log_every` episodes write the means since the last time to TensorBoard.

        policy_loss and the method's own figures are [num_trials]. UsageError if the policies' numbers are no longer finite.
        """
        if not rollout.finite:
            kept = ", and the last checkpoint is kept" * self.checkpoint.exists()
            if not (np.isfinite(rollout.all_obs).all() and np.isfinite(self.log.returns).all()):
                raise envs.UsageError(f"in episode {episode + 1} an observation or a reward of the world is not finite{kept}.")
            raise envs.UsageError(
                f"in episode {episode + 1} the policies' numbers are no longer finite; a step size, the bonus's weight or a"
                f" penalty of the world is too large{kept}."
            )
        self.log.add(episode, rollout.reward[:, :, 0], rollout.lengths, rollout.outcomes)
        figures = {f"charts/{name}": values for name, values in figures.items()} | {"losses/entropy": rollout.entropy}
        if policy_loss is not None:
            figures["losses/policy_loss"] = policy_loss.detach().numpy()
        for name, values in figures.items():
            self.sums[name] = self.sums.get(name, np.zeros(self.args.num_trials)) + values
        done, every = episode + 1, self.args.log_every
        if done % every:
            return
        recent, seconds = slice(done - every, done), time.monotonic() - self.clock
        means = self.log.means(recent)
        speed = (self.log.lengths.sum(1) - self.clocked) / seconds  # [num_trials]
        points = {f"charts/{name}": values for name, values in means.items()}
        points |= {name: total / every for name, total in self.sums.items()}
        points |= {"charts/episode": np.full(len(speed), float(done)), "charts/SPS": speed}
        with writing_to(self.directory):
            self.curves.add(points, self.log.lengths.sum(1))
        self.sums.clear()
        recently = {"reward/step": f"{means['reward_per_step'].mean():.2f}", "steps/s": f"{speed.sum():.0f}"}
        if self.world.outcome_names:
            recently["trials at best"] = f"{self.log.share_at_best(recent):.0%}"
        self.bar.set_postfix(recently, refresh=False)
        self._set_clock()

    def _set_clock(self):
        """Speed is what each trial plays from now on."""
        self.clock, self.clocked = time.monotonic(), self.log.lengths.sum(1)

    def finish(self):
        """Write what was asked for and, last of all, the file that marks the run as finished; returns the team and the log."""
        args, directory = self.args, self.directory
        with writing_to(directory):
            self.curves.flush()
            if args.save_model:
                parts = {name: arrays_of(part) for name, part in vars(self.team).items()}
                plain = {k: list(v) if isinstance(v, tuple) else v for k, v in self.settings.items() if k != "method"}
                with envs.complete_file(directory / "policy.pt") as file:
                    torch.save({"method": self.method, "args": plain, "parts": parts}, file)
            if args.capture_video:
                play_teams(args, self.world, self.team, 1, directory / "team.gif")
            with envs.complete_file(self.result) as file:
                np.savez(file, returns=self.log.returns, lengths=self.log.lengths, outcomes=self.log.outcomes)
            self.checkpoint.unlink(missing_ok=True)
        (directory / ".owner").unlink(missing_ok=True)
        self.lock.close()
        ends = self.log.summary(envs.last_episodes(args.num_episodes))
        say(f"{directory}: {args.num_trials} trial{'s' * (args.num_trials > 1)}, {ends}")
        return SimpleNamespace(**vars(self.team), log=self.log)


def is_ours(name):
    """Whether a run, or ./benchmark.sh beside it, may have written a file of this name."""
    return name.startswith((".", "seed")) or name in (*OUTPUT, "output.txt", "exit_code", "seconds")


@contextlib.contextmanager
def writing_to(place):
    """UsageError instead of an OSError: a full disk, a directory without permission, a name that is too long."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        # torch.save, when it cannot write, complains of its own archive, and what came first stands behind that.
        reason = error if isinstance(error, OSError) else error.__context__
        if not isinstance(reason, OSError):
            raise
        raise envs.UsageError(f"cannot write to {place}: {reason.strerror or reason}.") from error


def commit_of(directory):
    """The commit of the repository that holds a directory, with "-dirty" if files differ; empty if there is none."""
    git = ["git", "-C", str(directory), "describe", "--always", "--dirty", "--abbrev=40"]
    with contextlib.suppress(OSError):
        return subprocess.run(git, capture_output=True, text=True).stdout.strip()
    return ""


def source_of(script, world):
    """A checksum of a script's file and of a world's, by which one sees that either has been edited."""
    files = (script, Path(inspect.getfile(type(world))))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def say(line):
    """Print a line at once; UsageError if nobody can take it, such as a full disk."""
    try:
        print(line, flush=True)
    except OSError as error:
        silence(sys.stdout)
        raise envs.UsageError(f"cannot write to standard output: {error.strerror}.") from error


def play_episode(rollout, policy, generators):
    """Play an episode of every trial with stacked networks, or with the `player` of a policy that is something else."""
    if hasattr(policy, "player"):
        rollout.play_with(policy.player(), generators)
    else:
        rollout.play(policy.params, generators, getattr(policy, "parameter", 1.0))


def play_teams(args, world, team, num_episodes, video):
    """Play episodes with every trial's team, write the first team's first one as a GIF, and return their log.

    A world that cannot be drawn gives no GIF.
    """
    policy, teams = team.policy, args.num_trials
    rollout = envs.Rollout(world, teams, head=getattr(policy, "head", envs.softmax), greedy=args.greedy)
    generators = [np.random.default_rng(seed) for seed in np.random.SeedSequence(args.seed).spawn(teams)]
    log, frames = envs.EpisodeLog(world, teams, num_episodes), []
    for episode in range(num_episodes):
        play_episode(rollout, policy, generators)
        if not rollout.finite:
            raise envs.UsageError("the policies' numbers are not finite, so they say nothing of what to do.")
        log.add(episode, rollout.reward[:, :, 0], rollout.lengths, rollout.outcomes)
        if episode == 0 and world.drawable:
            rewards = ["start", *(f"step {t + 1}   reward {rollout.reward[t, 0, 0]:+g}" for t in range(rollout.lengths[0]))]
            frames = [envs.draw(world, rollout.states[t, 0], caption=caption) for t, caption in enumerate(rewards)]
    if frames:
        with writing_to(video):
            envs.save_gif(video, frames)
    return log


def load(path, script):
    """The arguments, the world and the team of a policy.pt that --save-model wrote; script is the module of its method.

    The team is what the script's `build` makes, with everything that had been learnt. UsageError if it cannot be loaded.
    """
    path, method = Path(path), Path(script.__file__).stem
    if not os.path.exists(path):  # unlike path.exists(), of a name that is too long as well
        raise envs.UsageError(f"there is no file {path}.")
    try:
        saved = torch.load(path, weights_only=True)
        found = saved["method"]
    except Exception as error:  # whatever can be wrong with a file
        raise envs.UsageError(f"{path} is not a policy.pt that --save-model wrote.") from error
    if found != method:
        raise envs.UsageError(f"{path} is of {found}.py, not of {method}.py.")
    try:
        values = {name: tuple(value) if isinstance(value, list) else value for name, value in saved["args"].items()}
        args, world = resolve(script.Args(**values), script.WORLDS, script.TUNED, script.OTHER)
        team = script.build(args, world, generators_of(args)[0])
        for name, arrays in saved["parts"].items():
            restore(arrays_of(getattr(team, name)), arrays)
    except envs.UsageError:
        raise
    except Exception as error:  # the script may be any, and another one than it was
        raise envs.UsageError(f"{path} does not fit to this {method}.py ({one_line(error)}).") from error
    return args, world, team


def evaluate(given, script):
    """Play the teams of a policy.pt that --save-model wrote, say how their episodes ended, and write a GIF beside it."""
    heeded = ("evaluate", "num_episodes", "seed", "greedy", "overwrite")
    for field in fields(given):
        if getattr(given, field.name) != field.default and field.name not in heeded:
            raise envs.UsageError(f"{option(field.name)} does not go with --evaluate, which takes what policy.pt says.")
    num_episodes = given.num_episodes
    check_limits(given, ("seed", *(["num_episodes"] if num_episodes is not None else [])))
    num_episodes = 100 if num_episodes is None else num_episodes
    args, world, team = load(given.evaluate, script)
    video = given.evaluate.with_suffix(".gif")
    if video == given.evaluate or (video.exists() and not given.overwrite):
        raise envs.UsageError(f"{video} is there already; --overwrite replaces the film, not the policies.")
    args.seed, args.greedy = given.seed, given.greedy
    log = play_teams(args, world, team, num_episodes, video)
    played = f"{num_episodes} episode{'s' * (num_episodes > 1)} of {args.num_trials} team{'s' * (args.num_trials > 1)}"
    film = f"; one of them in {video}" if world.drawable else ""
    say(f"{given.evaluate}: {played}, {log.summary(slice(None))}{film}")


def option(name):
    """The option of the command line for an argument."""
    return f"--{name.replace('_', '-')}"


def main(args_class, build, train):
    """The command line of a script: train, or with --evaluate play. Ends with code 2 and one sentence for bad input."""
    script = sys.modules[args_class.__module__]
    with command_line(Path(script.__file__).name):
        args = tyro.cli(args_class, description=script.__doc__)
        if args.greedy and not args.evaluate:
            raise envs.UsageError("--greedy goes with --evaluate only; while they learn, agents draw their actions.")
        try:
            evaluate(args, script) if args.evaluate else train(args)
        except torch.linalg.LinAlgError as error:  # a matrix that is no longer one, as that of EMI's embeddings
            reason = "a learnt model's numbers are no longer finite; a step size or a weight is too large"
            raise envs.UsageError(f"{reason} ({one_line(error)}).") from error
