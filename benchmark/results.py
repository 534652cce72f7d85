"""The comparison's results, kept small in benchmark/results/: all that tables, figures and estimates of time need."""

import json
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark.cells import (
    BESIDE,
    BEYOND,
    BEYOND_WORLDS,
    METHODS,
    OPTIMIZERS,
    ROOT,
    WORLDS,
    Cell,
    path_of,
    script,
    seconds_of,
    settings_of,
)
from envs import run
from envs.command import one_line

STORE = ROOT / "benchmark" / "results"
BLOCK = 100  # episodes of which a point of a curve is the mean, at most


def block_of(num_episodes):
    """Episodes of which a point of a curve is the mean: fewer than BLOCK in short runs, which have 20 points."""
    return min(BLOCK, max(1, num_episodes // 20))


@dataclass(frozen=True)
class Result:
    """What is kept of the trials of a method in a world."""

    score: np.ndarray  # [num_trials, blocks] reward per step, mean of each block (`block_of`)
    at_best: np.ndarray  # shaped as score, share of the episodes that ended in the best outcome
    steps: np.ndarray  # shaped as score, environment steps from the first episode to the end of each block
    last: np.ndarray  # [num_trials] reward per step, mean of the last 5 % of the episodes
    usual: np.ndarray  # [num_trials] the outcome in which more of the last 5 % of the episodes ended than in any other
    actions: np.ndarray  # [T, num_agents] an episode of the first trial's trained team; T is 0 if the team was not saved
    seconds: float  # that the run took; nan if nobody has timed it
    num_episodes: int
    about: dict  # args.json but for what does not concern the result, such as directories

    @classmethod
    def of_runs(cls, run_dirs, method=None):
        """Put the directories of finished runs, blocks of seeds in their order, together.

        method: their script, unless it is one of algos/
        """
        abouts = [json.loads((run_dir / "args.json").read_text(encoding="utf-8")) for run_dir in run_dirs]
        args = {name: value for name, value in abouts[0]["args"].items() if name not in run.HOUSEKEEPING}
        world = envs.make_world(args["env"])
        returns, lengths, outcomes = map(np.concatenate, zip(*map(episodes_of, run_dirs), strict=True))
        log = envs.EpisodeLog(world, *returns.shape)
        log.returns, log.lengths, log.outcomes = returns, lengths, outcomes
        trials, num_episodes = returns.shape
        block = block_of(num_episodes)
        blocks, recent = num_episodes // block, envs.last_episodes(num_episodes)

        def in_blocks(values):
            return values[:, : blocks * block].reshape(trials, blocks, block)

        commits = sorted({about.get("commit", "") for about in abouts})
        return cls(
            score=in_blocks(envs.reward_per_step(returns, lengths)).mean(2).astype(np.float32),
            at_best=in_blocks(outcomes == (world.best_outcome if world.outcome_names else -1)).mean(2).astype(np.float32),
            steps=in_blocks(lengths).sum(2).cumsum(1),
            last=log.means(recent)["reward_per_step"],
            usual=log.usual_outcomes(recent),
            actions=sample_episode(method or abouts[0]["method"], run_dirs[0] / "policy.pt", world.num_agents),
            seconds=sum(map(seconds_of, run_dirs)),
            num_episodes=num_episodes,
            about={**abouts[0], "commit": " and ".join(commits), "args": {**args, "num_trials": trials}},
        )

    @classmethod
    def load(cls, path):
        """Read what `save` wrote."""
        with np.load(path) as file:
            values = {name: file[name] for name in cls.__dataclass_fields__}
        about = json.loads(str(values.pop("about")))
        about["method"], about["args"]["env"]  # without which nobody knows what it is
        return cls(**{name: value if value.ndim else value.item() for name, value in values.items()}, about=about)

    def save(self, path):
        """Write some kilobytes, at once and complete."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with envs.complete_file(path) as file:
            np.savez_compressed(file, **{**vars(self), "about": json.dumps(self.about)})


def episodes_of(run_dir):
    """The returns, lengths and outcomes [num_trials, num_episodes] of a finished run."""
    with np.load(run_dir / "episodes.npz") as file:
        return file["returns"], file["lengths"], file["outcomes"]


def sample_episode(method, policy_file, num_agents):
    """The joint actions [T, num_agents] of an episode that the first team of a policy.pt plays; T is 0 if there is no file."""
    if not policy_file.exists():
        return np.zeros((0, num_agents), np.int8)
    args, world, team = run.load(policy_file, script(method))
    rollout = envs.Rollout(world, args.num_trials, head=getattr(team.policy, "head", envs.softmax))
    run.play_episode(rollout, team.policy, [np.random.default_rng(seed) for seed in range(1, args.num_trials + 1)])
    return rollout.actions[: rollout.lengths[0], 0].astype(np.int8)


def load(path):
    """A kept result; None if there is none, or a broken one, which is named."""
    try:
        return Result.load(path) if path.exists() else None
    except Exception as error:  # whatever can be wrong with a file
        print(f"{path} cannot be read ({type(error).__name__}) and is left out.", file=sys.stderr)
        return None


def finished(runs, seeds=(1, 20), num_episodes=None, scripts=()):
    """{(world, method, optimizer): Result} of the comparison's finished cells under `runs`, in the order of the tables.

    seeds: the first and the last; a cell may have been run in blocks of them
    num_episodes: of each trial (None: Table 1)
    scripts: files of methods outside algos/
    """
    methods = {path_of(method).stem: method for method in (*(path.stem for path in (ROOT / "algos").glob("*.py")), *scripts)}
    blocks, unknown = defaultdict(dict), set()
    for file in sorted(runs.rglob("episodes.npz")):
        try:
            found = settings_of(file.parent)
            if found["method"] not in methods:
                unknown.add(found["method"])
                continue
            method, optimizer = methods[found["method"]], found.get("optimizer", "adam")
            cell = Cell(method, found["env"], optimizer, found["seed"], found["num_trials"], num_episodes)
            own = cell.settings == found  # not somebody's experiment, nor from before a change of the defaults
        except envs.UsageError as error:  # a world that is there no more
            print(f"{file.parent} is left out: {error}", file=sys.stderr)
            continue
        except Exception as error:  # whatever can be wrong with a file
            print(f"{file.parent} cannot be read ({type(error).__name__}) and is left out.", file=sys.stderr)
            continue
        if own and (broken := cell.what_is_wrong(file.parent)):
            print(f"{broken} and is left out.", file=sys.stderr)
        elif own:
            blocks[found["env"], found["method"], optimizer][found["seed"], found["seed"] + found["num_trials"]] = file.parent
    for name in sorted(unknown):
        print(f"The cells of {name}.py are left out: it is not in algos/, and --scripts does not name it.", file=sys.stderr)
    wholes = {key: cover(parts, seeds[0], seeds[1] + 1) for key, parts in blocks.items()}
    found = {}
    for key, parts in wholes.items():
        if not parts:
            continue
        try:
            found[key] = Result.of_runs(parts, methods[key[1]])
        except Exception as error:  # whatever can be wrong with a file, such as policy.pt
            print(f"{parts[0]} cannot be taken in ({one_line(error)}) and is left out.", file=sys.stderr)
    return in_order(found)


def cover(parts, first, end):
    """Those of {(first seed, the seed after the last): directory} that follow each other from `first` to `end`, or nothing."""
    for block in sorted(parts, reverse=True):  # the longest first
        if block[0] == first and block[1] <= end:
            rest = cover(parts, block[1], end)
            if rest or block[1] == end:
                return [parts[block], *rest]
    return []


def shipped(found):
    """Results of the repository's own methods and worlds, without anybody's others."""
    worlds, methods = (*WORLDS, *BEYOND_WORLDS), {**METHODS, **BEYOND}
    return {key: result for key, result in found.items() if key[0] in worlds and key[1] in methods}


def keep(found):
    """Write results into benchmark/results/."""
    for (world, method, optimizer), result in found.items():
        result.save(STORE / world / f"{method}-{optimizer}.npz")


def kept():
    """All results that are kept, {(world, method, optimizer): Result}, in the order of the tables; others come last."""
    found = {}
    for result in filter(None, map(load, sorted(STORE.rglob("*.npz")))):
        args = result.about["args"]
        found[args["env"], result.about["method"], args.get("optimizer", "adam")] = result
    return in_order(found)


def in_order(found):
    """Results in the order of the tables, those of other worlds and methods last."""

    def place(key):
        orders = [*WORLDS, *BEYOND_WORLDS], [*METHODS, *BEYOND], list(OPTIMIZERS)
        return [order.index(word) if word in order else len(order) for order, word in zip(orders, key, strict=True)]

    return {key: found[key] for key in sorted(found, key=place)}


def named_in(found):
    """The worlds and the methods of results: the paper's, and whatever others there are."""
    return [list(dict.fromkeys((*own, *(key[place] for key in found)))) for place, own in ((0, WORLDS), (1, METHODS))]


def of_the_paper(found):
    """Results without those of the worlds and methods beyond the paper; anybody's own are there."""
    return {key: result for key, result in found.items() if not (key[0] in BEYOND_WORLDS or key[1] in BEYOND)}


def beyond_the_paper(found):
    """The results beyond the paper, and those of its methods that stand beside them in the same worlds."""
    worlds = {world for world, method, _ in found if world in BEYOND_WORLDS or method in BEYOND}
    return {key: result for key, result in found.items() if key[0] in worlds and key[1] in (*BESIDE, *BEYOND)}


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
