"""What several tests share: recorded episodes, agents placed by hand, random play; runs of the scripts and plain gradients."""

import contextlib
import importlib
import io
import itertools
import json
import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import settings
from hypothesis import strategies as st
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import envs
from envs import run
from envs.run import arrays_of

settings.register_profile("compiled", deadline=None)  # the first example of a test may compile a world's rules
settings.load_profile("compiled")
ALGOS = Path(__file__).resolve().parents[1] / "algos"
# The repository's own scripts, not those that a user has put beside them; without git, all that are there.
LISTED = subprocess.run(["git", "-C", str(ALGOS), "ls-files", "*.py"], capture_output=True, text=True).stdout.split()
SCRIPTS = sorted(path.stem for path in ([ALGOS / name for name in LISTED] or ALGOS.glob("*.py")))
each_script = pytest.mark.parametrize("name", SCRIPTS)
each_setting = pytest.mark.parametrize(
    ("env", "optimizer"), list(itertools.product(("findtreasure", "pushbox"), ("sign", "adam")))
)
RACE = Path(__file__).parent / "data" / "race.py"  # a world of the user's own
RECORDED = {
    name: recording
    for file in ("trajectories.json", "rooms.json")
    for name, recording in json.loads((Path(__file__).parent / "data" / file).read_text(encoding="utf-8")).items()
}
# The shortest way to the best outcome, a list of joint actions; of cleaner, which has no outcomes, its constructed plan.
BEST_PLANS = {
    "cleaner": envs.make_world("cleaner").plan().tolist(),
    "findtreasure": [(3, 3), (3, 3), (3, 3), (4, 3), (0, 4), (0, 4), (0, 4), (3, 4)],
    "gotogether": [(0, 0)] * 11 + [(3, 3)] * 11 + [(3, 0)],
    "movebox": [(0, 0)] * 3 + [(3, 2)] * 5 + [(2, 2)] * 4 + [(0, 0)] * 6 + [(3, 3)] * 4 + [(0, 0)] * 3,
    "pushbox": [(0, 0), (1, 2), (0, 0), (0, 0)],
    "climbing": [(0, 0)],
    "passage": [(0, 1)] * 2 + [(1, 2)] * 4 + [(2, 2)] * 4 + [(1, 0)] * 2 + [(0, 0)] * 2 + [(1, 1)] * 2 + [(0, 1)] * 2,
    "secretroom": [(0, 1)] * 2
    + [(0, 2)] * 4
    + [(1, 2)] * 4
    + [(1, 0)]
    + [(0, 0)] * 4
    + [(1, 0)] * 2
    + [(1, 1), (2, 1)]
    + [(0, 1)] * 2,
}


def play(world, state, *actions):
    """Play joint `actions` from the integers `state`; returns the state then, and reward and outcome of the last step."""
    state = np.array(state)
    for joint in actions:
        reward, outcome = world.step(world.rules, state, np.array(joint))
    return state.tolist(), pytest.approx(reward, abs=1e-9), outcome


def look(world, state):
    """What the agents see in `state`, a list for each agent."""
    obs = np.full((world.num_agents, world.obs_dim), np.nan, np.float32)
    world.observe(world.rules, world.cell, np.array(state), obs)
    return obs.tolist()


def whole_state(env, info):
    """The integer states of all copies, [num_envs, state_dim], from the scaled ones that `info` tells."""
    return np.rint(info["state"] / env.world.state_scale).astype(int)


class Step(NamedTuple):
    """One step of a vector environment: the integer states [num_envs, state_dim] before and after it, and what it returned."""

    before: np.ndarray
    after: np.ndarray
    obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict


def walk(env, actions):
    """Reset and play `actions`, each [num_envs, num_agents] or one [num_agents] for all copies; yields every `Step`."""
    _, info = env.reset()
    for joint in actions:
        before = whole_state(env, info)
        *returned, info = env.step(np.array(np.broadcast_to(joint, (env.num_envs, env.world.num_agents))))
        yield Step(before, whole_state(env, info), *returned, info)


def random_play(num_actions, num_envs=1, longest=60, num_agents=2):
    """Hypothesis: a list of up to `longest` joint actions in `num_envs` copies, [num_envs, num_agents] each."""
    joint = st.tuples(*[st.integers(0, num_actions - 1)] * num_agents)
    return st.lists(st.tuples(*[joint] * num_envs), min_size=1, max_size=longest)


def assert_replays(recording, to_state, **options):
    """All recorded episodes of tests/data/*.json under the key `recording` go the same way, step by step.

    to_state: turns the positions of the file into the world's integer state, or the part of it that they tell
    """
    env = envs.make_vec(recording.rstrip("0123456789"), **options)
    episodes = RECORDED[recording]["episodes"]
    assert len(episodes) >= 10
    for episode in episodes:
        steps = list(walk(env, episode["actions"]))
        for step, positions in zip(steps, episode["positions"], strict=True):
            if positions is not None:  # the published movebox, passage and secretroom start anew in their last step
                expected = to_state(positions)
                assert step.after[0, : len(expected)].tolist() == expected
        assert [step.reward[0] for step in steps] == pytest.approx(episode["rewards"], abs=1e-9)
        assert [step.terminated[0] for step in steps] == [False] * (len(steps) - 1) + [episode["done"]]
        assert not any(step.truncated[0] for step in steps)
        if "observations" in episode:
            assert [step.obs[0].tolist() for step in steps] == episode["observations"]


def assert_refused(accepted, make, *args, **options):
    """`make` refuses `options` by a UsageError of one sentence that names what is `accepted`."""
    with pytest.raises(envs.UsageError) as error:
        make(*args, **options)
    assert accepted in str(error.value)
    assert_one_sentence(str(error.value))


def assert_one_sentence(message):
    """The message is one sentence in one line."""
    assert message.endswith(".")
    assert "\n" not in message
    assert ". " not in message


def script(name):
    """The script algos/<name>.py as a module."""
    return importlib.import_module(f"algos.{name}")


def optimizers(name):
    """What --optimizer may be, as arguments of `train`; Q-learning and PPO have no such option."""
    takes_optimizer = "optimizer" in [field.name for field in fields(script(name).Args)]
    return [dict(optimizer=optimizer) for optimizer in ("sign", "adam")] if takes_optimizer else [{}]


each_script_and_setting = pytest.mark.parametrize(
    ("name", "setting"),
    [
        pytest.param(name, dict(env=env, **choice), id="-".join([name, env, *choice.values()]))
        for name in SCRIPTS
        for env in ("findtreasure", "pushbox")
        for choice in optimizers(name)
    ],
)


def train(module, run_dir, **args):
    """What a script's `train` returns; `args` are those that are not the default."""
    return module.train(module.Args(run_dir=run_dir, **args))


def weights(policy):
    """Copies of the weights of a policy, of which nothing in the script knows."""
    return [param.detach().clone() for param in policy.params]


class Update(NamedTuple):
    """One update of the policies: the episode before it, the weights then, and the direction in which they are to climb."""

    rollout: SimpleNamespace
    params: list
    direction: list


ROLLOUT = ("obs", "rows", "all_obs", "actions", "reward", "lengths", "outcomes", "terminated", "played", "entropy")
ROLLOUT += ("states", "global_state", "local_state")


def record_rollouts(module, monkeypatch):
    """A list that gets a copy of every rollout that the script plays from now on, and the `params` that played it."""
    rollouts = []

    class WatchedRollout(module.Rollout):
        def play(self, params, *args):
            super().play(params, *args)
            rollouts.append(SimpleNamespace(params=params, **{name: getattr(self, name).copy() for name in ROLLOUT}))

    monkeypatch.setattr(module, "Rollout", WatchedRollout)
    return rollouts


def record_updates(module, monkeypatch):
    """A list that gets every `Update` of the policies, which are those that play, that the script makes from now on."""
    updates, update = [], module.update
    rollouts = record_rollouts(module, monkeypatch)

    def watched_update(optimizer, kind, loss):
        rollout = rollouts[-1]
        if optimizer.param_groups[0]["params"][0] is rollout.params[0]:
            grads = torch.autograd.grad(loss, rollout.params, retain_graph=True)
            updates.append(Update(rollout, weights(rollout), [-grad for grad in grads]))
        update(optimizer, kind, loss)

    monkeypatch.setattr(module, "update", watched_update)
    return updates


def plain_logits(own, obs):
    """What one network says to one observation, layer by layer; `own` are its weights and biases in double precision."""
    x = torch.as_tensor(np.asarray(obs), dtype=torch.double)
    for layer in range(0, len(own), 2):
        x = (x if layer == 0 else x.clamp(min=0)) @ own[layer] + own[layer + 1][0]
    return x


def plain_gradient(params, net, steps):
    """The gradient of sum_t w_t log pi(a_t | o_t) in one network, step by step in double precision; `steps` are (o, a, w)."""
    own = [param[net].detach().double().requires_grad_() for param in params]
    total = sum(param.sum() * 0 for param in own)
    for obs, action, weight in steps:
        logits = plain_logits(own, obs)
        total = total + float(weight) * (logits[action] - torch.logsumexp(logits, 0))
    return torch.autograd.grad(total, own)


def plain_returns(reward, gamma):
    """The discounted sum of the rewards from every step on."""
    return [sum(gamma**later * r for later, r in enumerate(reward[t:])) for t in range(len(reward))]


def assert_same_direction(direction, params, steps_of):
    """The gradients of all networks are those of the plain loop over steps_of[net]."""
    for net, steps in enumerate(steps_of):
        for found, expected in zip(direction, plain_gradient(params, net, steps), strict=True):
            assert np.allclose(found[net], expected, rtol=1e-4, atol=1e-5 * max(1.0, float(expected.abs().max())))


def pairs(obs, actions, num_actions):
    """The vectors u = (o, one-hot a) of an agent's steps, [T, obs_dim + num_actions]."""
    return np.concatenate([np.asarray(obs), np.eye(num_actions)[actions]], axis=1).astype(np.float32)


def kernel(some, others, sigma):
    """Eq. 5 with C = 1."""
    return np.exp(-((some[:, None].astype(float) - others[None]) ** 2).sum(-1) / (2 * sigma**2))


def dense_eta(visited, t, window, sigma, noise):
    """eta of the pair visited[t] after all pairs before it, by Eqs. 5-7 with targets 1 and a dense solve."""
    past = visited[max(0, t - window) : t]
    covariance = kernel(past, past, sigma) + noise * np.eye(len(past))
    return float(kernel(visited[t : t + 1], past, sigma)[0] @ np.linalg.solve(covariance, np.ones(len(past))))


def memory_steps(episodes, i):
    """Agent i's steps (o*, a*, w_k G*_t / T_k) in the episodes k that Eqs. 15-16 replay, w_k = Psi*_k / sum_j Psi*_j.

    An episode is (observations [T, num_agents, obs_dim], actions [T, num_agents], returns [T]).
    """
    replayed = [episode for episode in episodes if episode[2][0] > 0]
    total = sum(returns[0] for _, _, returns in replayed)
    return [
        (obs[t, i], actions[t, i], returns[0] / total * returns[t] / len(returns))
        for obs, actions, returns in replayed
        for t in range(len(returns))
    ]


def use_double_precision(module, monkeypatch):
    """Let the networks of a script calculate in double precision, in which rounding does not grow into sight."""
    network = module.StackedMLP  # whatever is made of it, such as another Policy, changes with it
    init, call = network.__init__, network.__call__

    def init_in_double(self, *args):
        init(self, *args)
        self.params = [param.detach().double().requires_grad_() for param in self.params]

    monkeypatch.setattr(network, "__init__", init_in_double)
    monkeypatch.setattr(network, "__call__", lambda self, x: call(self, torch.as_tensor(x).double()))


def assert_same_episodes(some, others):
    """Two logs are the same: lengths and outcomes exactly, returns to 1e-6."""
    assert np.array_equal(some.lengths, others.lengths)
    assert np.array_equal(some.outcomes, others.outcomes)
    assert np.allclose(some.returns, others.returns, rtol=0, atol=1e-6)


def assert_trials_are_runs(module, directory, tolerance, **args):
    """Trial k of three is the run with the seed of trial k: the same episodes, and weights within the tolerance."""
    args = dict(num_episodes=200, max_steps=60) | args  # in which teams reach all ends of their worlds
    together = train(module, directory / "together", seed=7, num_trials=3, **args)
    assert len({trial.tobytes() for trial in together.log.returns}) == 3  # no trial is another's copy
    for k in range(3):
        alone = train(module, directory / str(k), seed=7 + k, **args)
        trial = {name: getattr(together.log, name)[k : k + 1] for name in ("returns", "lengths", "outcomes")}
        assert_same_episodes(alone.log, SimpleNamespace(**trial))
        for one, all_trials in zip(weights(alone.policy), weights(together.policy), strict=True):
            assert float((one - all_trials.chunk(3)[k]).abs().max()) <= tolerance


def assert_same_run(one, other, parts=("policy",)):
    """Two runs are the same bit for bit: their episodes, and the parts of their teams."""
    for name in ("returns", "lengths", "outcomes"):
        assert np.array_equal(getattr(one.log, name), getattr(other.log, name))
    for part in parts:
        assert all(map(torch.equal, arrays_of(getattr(one, part)), arrays_of(getattr(other, part))))


def curves(directory):
    """What TensorBoard shows of a directory: {tag: [(step, value), ...]}."""
    events = EventAccumulator(str(directory), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def stop_after(monkeypatch, episode, number):
    """Let this process get the signal when it records the given episode (1, 2, ...)."""
    record = run.Run.record

    def interrupted_record(self, now, *args, **figures):
        record(self, now, *args, **figures)
        if now + 1 == episode:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(run.Run, "record", interrupted_record)


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def command(name, *words):
    """Run a script in this process, as the command line would."""
    out, err, code, argv, module = io.StringIO(), io.StringIO(), 0, sys.argv, script(name)
    sys.argv = [f"algos/{name}.py", *map(str, words)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            run.main(module.Args, module.build, module.train)
    except SystemExit as error:
        code = error.code or 0
    finally:
        sys.argv = argv
    return Ended(code, out.getvalue(), err.getvalue())


def assert_refusal(name, ended, *said):
    """The command ended with code 2 and one sentence."""
    assert (ended.code, ended.out) == (2, ""), ended
    sentence = ended.err.splitlines()[-1]
    assert sentence.startswith(f"{name}.py: ")
    assert_one_sentence(sentence)
    for words in said:
        assert words in sentence


def results(directory):
    """The arrays of episodes.npz."""
    with np.load(directory / "episodes.npz") as file:
        return dict(file)


def assert_same_results(directory, other):
    """Two runs have left the same episodes."""
    found, expected = results(directory), results(other)
    assert found.keys() == expected.keys() == {"returns", "lengths", "outcomes"}
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert np.array_equal(found[name], values)


def contents(directory):
    """Everything that lies in a directory but for what says who owns it: {path: bytes}, None for a directory."""
    found = [path for path in directory.rglob("*") if path.name != ".owner"]
    return {path.relative_to(directory): path.read_bytes() if path.is_file() else None for path in found}


def record_all_updates(module, monkeypatch):
    """As `record_updates`, but of all networks that the script moves, in the order in which it does."""
    updates, update, rollouts = [], module.update, record_rollouts(module, monkeypatch)

    def note(params, loss):
        grads = torch.autograd.grad(loss, params, retain_graph=True)
        updates.append(Update(rollouts[-1], [param.detach().clone() for param in params], [-grad for grad in grads]))

    def watched_update(optimizer, kind, loss):
        note(optimizer.param_groups[0]["params"], loss)
        update(optimizer, kind, loss)

    monkeypatch.setattr(module, "update", watched_update)
    if hasattr(module, "MaskedAdam"):

        class WatchedAdam(module.MaskedAdam):
            def step(self, loss, active):
                note(self.weights, loss)
                super().step(loss, active)

        monkeypatch.setattr(module, "MaskedAdam", WatchedAdam)
    return updates
