"""The comparison's results, kept small in benchmark/results/: all that tables, figures and estimates of time need."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark.cells import METHODS, OPTIMIZERS, ROOT, WORLDS, Cell, path_of, script, settings_of
from envs import run

STORE = ROOT / "benchmark" / "results"
BLOCK = 100  # episodes of which a point of a curve is the mean


@dataclass(frozen=True)
class Result:
    """What is kept of a run of several trials."""

    score: np.ndarray  # [num_trials, num_episodes / BLOCK] reward per step, mean of each block
    at_best: np.ndarray  # shaped as score, share of the episodes that ended in the best outcome
    last: np.ndarray  # [num_trials] reward per step, mean of the last 5 % of the episodes
    usual: np.ndarray  # [num_trials] the outcome in which most of the last 5 % of the episodes ended
    actions: np.ndarray  # [T, num_agents] an episode of the first trial's trained team; T is 0 if the team was not saved
    seconds: float  # that the run took; nan if nobody has timed it
    num_episodes: int
    about: dict  # args.json but for what does not concern the result, such as directories

    @classmethod
    def of_run(cls, run_dir, method=None):
        """Read a finished run's directory; method: its script, unless it is one of algos/."""
        about = json.loads((run_dir / "args.json").read_text())
        about["args"] = {name: value for name, value in about["args"].items() if name not in run.HOUSEKEEPING}
        world = envs.make_world(about["args"]["env"])
        with np.load(run_dir / "episodes.npz") as episodes:
            log = envs.EpisodeLog(world, *episodes["returns"].shape)
            log.returns, log.lengths, log.outcomes = (episodes[name] for name in ("returns", "lengths", "outcomes"))
        trials, num_episodes = log.returns.shape
        blocks, recent = num_episodes // BLOCK, slice(-max(1, num_episodes // 20), None)

        def block_means(values):
            return values[:, : blocks * BLOCK].reshape(trials, blocks, BLOCK).mean(2).astype(np.float32)

        timed = run_dir / "seconds"
        return cls(
            score=block_means(envs.reward_per_step(log.returns, log.lengths)),
            at_best=block_means(log.outcomes == (world.best_outcome if world.outcome_names else -1)),
            last=log.means(recent)["reward_per_step"],
            usual=log.usual_outcomes(recent),
            actions=sample_episode(method or about["method"], run_dir / "policy.pt", world.num_agents),
            seconds=float(timed.read_text()) if timed.exists() else float("nan"),
            num_episodes=num_episodes,
            about=about,
        )

    @classmethod
    def load(cls, path):
        """Read what `save` wrote."""
        with np.load(path) as file:
            values = {name: file[name] for name in cls.__dataclass_fields__}
        about = json.loads(str(values.pop("about")))
        return cls(**{name: value if value.ndim else value.item() for name, value in values.items()}, about=about)

    def save(self, path):
        """Write some kilobytes, at once and complete."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with envs.complete_file(path) as file:
            np.savez_compressed(file, **{**vars(self), "about": json.dumps(self.about)})


def sample_episode(method, policy_file, num_agents):
    """The joint actions [T, num_agents] of an episode that the first team of a policy.pt plays; T is 0 if there is no file."""
    if not policy_file.exists():
        return np.zeros((0, num_agents), np.int8)
    _, world, team = run.load(policy_file, script(method))
    rollout = envs.Rollout(world, 1, head=getattr(team.policy, "head", envs.softmax))
    first = [param[:num_agents] for param in team.policy.params]
    rollout.play(first, [np.random.default_rng(1)], getattr(team.policy, "parameter", 1.0))
    return rollout.actions[:, 0].astype(np.int8)


def load(path):
    """A kept result; None if there is none, or a broken one, which is named."""
    try:
        return Result.load(path) if path.exists() else None
    except Exception as error:  # whatever can be wrong with a file
        print(f"{path} cannot be read ({type(error).__name__}) and is left out.", file=sys.stderr)
        return None


def take_in(runs, scripts=()):
    """Keep the finished cells of the comparison that lie under `runs` and are not shorter than what is kept already.

    scripts: files of methods outside algos/
    """
    methods = {path_of(method).stem: method for method in (*(path.stem for path in (ROOT / "algos").glob("*.py")), *scripts)}
    for file in sorted(runs.rglob("episodes.npz")):
        try:
            found = settings_of(file.parent)
        except Exception as error:  # whatever can be wrong with a file
            print(f"{file.parent} cannot be read ({type(error).__name__}) and is left out.", file=sys.stderr)
            continue
        if (found["seed"], found["num_trials"]) != (1, 20) or found["method"] not in methods:
            continue
        method, optimizer = methods[found["method"]], found.get("optimizer", "adam")
        try:
            cell = Cell(method, found["env"], optimizer, num_episodes=found["num_episodes"])
            own = cell.settings == found  # not somebody's experiment, nor from before a change of the defaults
        except envs.UsageError as error:  # a world that is there no more
            print(f"{file.parent} is left out: {error}", file=sys.stderr)
            continue
        if not own:
            continue
        if broken := cell.what_is_wrong(file.parent):
            print(f"{broken} and is left out.", file=sys.stderr)
            continue
        path = STORE / Path(cell.world).stem / f"{found['method']}-{optimizer}.npz"
        before = load(path)
        if before is None or before.num_episodes <= cell.settings["num_episodes"]:
            Result.of_run(file.parent, method).save(path)


def kept():
    """All results that are kept, {(world, method, optimizer): Result}, in the order of the tables; others come last."""
    found = {}
    for result in filter(None, map(load, sorted(STORE.rglob("*.npz")))):
        args = result.about["args"]
        found[args["env"], result.about["method"], args.get("optimizer", "adam")] = result

    def place(key):
        orders = list(WORLDS), list(METHODS), list(OPTIMIZERS)
        return [order.index(word) if word in order else len(order) for order, word in zip(orders, key, strict=True)]

    return {key: found[key] for key in sorted(found, key=place)}


def named_in(found):
    """The worlds and the methods of results: the paper's, and whatever others there are."""
    return [list(dict.fromkeys((*own, *(key[place] for key in found)))) for place, own in ((0, WORLDS), (1, METHODS))]


def seconds_per_episode(results):
    """{(method, world): seconds that an episode of 20 trials takes}, means of the kept times.

    A method that has no time in a world is taken for as fast there as elsewhere, beside PG; so is PG, beside the methods that
    have one. Where nothing is known, PG takes 0.01 s, and a method as long as PG.
    """
    timed = {}
    for (world, method, _), result in results.items():
        if result.seconds > 0:
            timed.setdefault((method, world), []).append(result.seconds / result.num_episodes)
    known = {key: float(np.mean(values)) for key, values in timed.items()}

    def ratio_to_pg(method):
        both = [world for world in WORLDS if {(method, world), ("pg", world)} <= set(known)]
        return float(np.mean([known[method, world] / known["pg", world] for world in both])) if both else 1.0

    pace = dict(known)
    for world in WORLDS:
        by_others = [known[method, world] / ratio_to_pg(method) for method in METHODS if (method, world) in known]
        pg = known.get(("pg", world), float(np.mean(by_others)) if by_others else 0.01)
        pace.update({(method, world): known.get((method, world), pg * ratio_to_pg(method)) for method in METHODS})
    return pace
