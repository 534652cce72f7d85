"""QMIX and VDN: mixing, monotonicity, error and updates beside plain ones, one agent is DQN, the two-step game."""

from copy import deepcopy
from itertools import groupby, product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import dqn, qmix
from tests import test_dqn
from tests.helpers import (
    RACE,
    assert_same_run,
    curves,
    plain_logits,
    train,
    use_double_precision,
    weights,
)
from tests.test_pg import generators

TWO_STEP = RACE.with_name("two_step.py")
UNITS = qmix.MIXING_UNITS

# --- mixing ---


def plain_mix(own, values, state):
    """Q_tot of one trial's mixing network, unit by unit; own: its four parameters, values and state: one step's, as numbers."""
    weights, bias, value_weights, value_bias = (param[0] for param in own)
    made = [bias[0, j] + sum(s * weights[d, j] for d, s in enumerate(state)) for j in range(weights.shape[1])]
    n, total = len(values), value_bias[0, 0]
    for unit in range(UNITS):
        x = made[n * UNITS + unit] + sum(q * abs(made[i * UNITS + unit]) for i, q in enumerate(values))
        elu = x if x > 0 else torch.exp(x) - 1
        total = total + abs(made[(n + 1) * UNITS + unit]) * elu
        total = total + max(made[(n + 2) * UNITS + unit], 0 * bias[0, 0]) * value_weights[unit, 0]
    return total


def mixer_of(trials, agents, state_dim, scale=1.0):
    """A mixing network for each trial, in double precision."""
    mixer = qmix.MonotonicMixer(generators(*range(trials)), agents, state_dim)
    mixer.params = [(scale * param.detach().double()).requires_grad_() for param in mixer.params]
    return mixer


def random_inputs(rng, trials, batch, agents, state_dim):
    return torch.from_numpy(rng.normal(size=(trials, batch, agents))), torch.from_numpy(rng.random((trials, batch, state_dim)))


@pytest.mark.parametrize("agents", [1, 2, 3])
def test_the_mixing_network_is_that_of_plain_loops(agents):
    mixer = mixer_of(2, agents, 4)
    values, state = random_inputs(np.random.default_rng(agents), 2, 5, agents, 4)
    found = mixer(values, state)
    assert found.shape == (2, 5)
    for k, b in np.ndindex(2, 5):
        own = [param[k : k + 1] for param in mixer.params]
        assert found[k, b].item() == pytest.approx(plain_mix(own, values[k, b], state[k, b]).item(), rel=1e-12)


@pytest.mark.parametrize("scale", [0.3, 1, 10])
def test_the_teams_value_rises_with_every_agents_value(scale):
    rng, mixer = np.random.default_rng(0), mixer_of(4, 3, 6, scale)
    values, state = random_inputs(rng, 4, 200, 3, 6)
    values.requires_grad_()
    slopes = torch.autograd.grad(mixer(values, state).sum(), values)[0]
    assert (slopes >= 0).all()
    assert (slopes > 0).double().mean() > 0.99  # so nothing is lost
    with torch.no_grad():
        for i in range(3):
            higher = values.clone()
            higher[..., i] += torch.from_numpy(rng.exponential(size=(4, 200)))
            assert (mixer(higher, state) >= mixer(values, state)).all()


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
def test_what_is_best_for_each_agent_is_best_for_the_team(kind):
    """By brute force over the joint actions of three agents with four actions each."""
    rng, mixer = np.random.default_rng(1), mixer_of(1, 3, 6, 2.0) if kind == "monotonic" else qmix.SumMixer()
    for _ in range(30):
        values, (_, state) = rng.normal(size=(3, 4)), random_inputs(rng, 1, 1, 3, 6)
        joint = list(product(range(4), repeat=3))
        taken = torch.from_numpy(np.array([[values[i, a] for i, a in enumerate(actions)] for actions in joint]))
        with torch.no_grad():
            totals = mixer(taken[None], state.expand(1, len(joint), 6))[0]
        assert joint[totals.argmax()] == tuple(values.argmax(1))


def test_vdn_is_the_sum_and_each_agents_slope_is_1():
    values, state = random_inputs(np.random.default_rng(2), 2, 5, 3, 4)
    values.requires_grad_()
    found = qmix.SumMixer()(values, state)
    for k, b in np.ndindex(2, 5):
        assert found[k, b].item() == pytest.approx(sum(values[k, b].tolist()), rel=1e-14)
    assert torch.equal(torch.autograd.grad(found.sum(), values)[0], torch.ones_like(values))


def test_the_agents_values_stand_by_their_teams():
    values = torch.arange(24).view(6, 4)  # 3 teams of 2 agents, 4 steps
    assert qmix.of_team(values, 3)[1].tolist() == [[8, 12], [9, 13], [10, 14], [11, 15]]


# --- the replay ---


def test_the_replay_keeps_the_states_around_every_step():
    world = envs.make_world("findtreasure", max_steps=5)
    replay, rollout = qmix.ConcurrentReplay(world, 3, 12), envs.Rollout(world, 3)
    policy, kept = qmix.StackedMLP(generators(0, 1, 2), 2, [4, 8, 5]), [[], [], []]
    for _ in range(4):
        rollout.play(policy.params, generators(3, 4, 5))
        replay.add(rollout)
        for k, episode in enumerate(kept):
            for t in range(rollout.lengths[k]):
                states = rollout.states[t : t + 2, k] / 7
                episode.append((rollout.all_obs[t : t + 2, k].copy(), states, rollout.reward[t, k, 0] / 10))
    drawn = replay.draw(generators(6, 7, 8), np.array([1, 1, 1]), 40)[0]
    obs, _, next_obs, state, next_state, reward, terminated = (part.numpy() for part in replay.batch(drawn[[0, 2]]))
    assert state.shape == next_state.shape == (2, 40, 4)
    for row, k in enumerate((0, 2)):
        for b in range(40):
            n = drawn[k, b] - 12 * k  # a place in the ring
            before, states, earned = kept[k][n + (len(kept[k]) - 1 - n) // 12 * 12]
            assert np.array_equal([obs[2 * row : 2 * row + 2, b], next_obs[2 * row : 2 * row + 2, b]], before)
            assert [state[row, b], next_state[row, b]] == pytest.approx(states)
            assert reward[row, b] == pytest.approx(earned)
    assert not terminated.any()


# --- the error ---


def networks(monkeypatch, seeds, kind):
    """Policies of two teams of two agents, and their mixers, in double precision."""
    with monkeypatch.context() as patched:
        use_double_precision(qmix, patched)
        policy = qmix.StackedMLP(generators(*seeds), 2, [3, 8, 4])
    return policy, mixer_of(2, 2, 5) if kind == "monotonic" else qmix.SumMixer()


def random_batch(rng, terminated):
    obs, next_obs = (torch.from_numpy(rng.normal(size=(4, 7, 3))) for _ in range(2))
    actions, (reward, state) = torch.from_numpy(rng.integers(4, size=(4, 7))), random_inputs(rng, 2, 7, 1, 5)
    next_state = torch.from_numpy(rng.random((2, 7, 5)))
    return obs, actions, next_obs, state, next_state, reward[..., 0], torch.full((2, 7), terminated).double()


def own_of(params, first, last):
    """Some of the copies of the weights, as new leaves."""
    return [param[first:last].detach().double().requires_grad_() for param in params]


def q_values(own, obs):
    """Q(o, .) of each agent of a team by plain products; own: the team's weights, obs [num_agents, obs_dim]."""
    return [plain_logits([param[i] for param in own], obs[i]) for i in range(len(obs))]


def plain_error(own, own_mixer, target, target_mixer, step, gamma):
    """(y - Q_tot)^2 of one step of one team, with gradient; the weights of the mixers are () for a sum."""
    obs, actions, next_obs, state, next_state, reward, terminated = step
    best = [values.argmax() for values in q_values(own, next_obs)]
    rest = [values[a].item() for values, a in zip(q_values(target, next_obs), best, strict=True)]
    rest = plain_mix(target_mixer, rest, next_state).item() if target_mixer else sum(rest)
    taken = [values[a] for values, a in zip(q_values(own, obs), actions, strict=True)]
    total = plain_mix(own_mixer, taken, state) if own_mixer else sum(taken)
    return (float(reward) + (0 if terminated else gamma * rest) - total) ** 2


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
@pytest.mark.parametrize("terminated", [0, 1])
def test_error_and_gradient_are_those_of_plain_loops(kind, terminated, monkeypatch):
    (policy, mixer), (target, target_mixer) = (networks(monkeypatch, seeds, kind) for seeds in ((0, 1), (2, 3)))
    target_mixer.params = [0.7 * param.detach() for param in target_mixer.params]
    batch = obs, actions, next_obs, *shared = random_batch(np.random.default_rng(terminated), terminated)
    found = qmix.squared_td_errors(policy, mixer, target, target_mixer, batch, 0.9)
    grads = torch.autograd.grad(found.sum(), [*policy.params, *mixer.params])
    for k in range(2):
        own, own_mixer = own_of(policy.params, 2 * k, 2 * k + 2), own_of(mixer.params, k, k + 1)
        old, old_mixer = own_of(target.params, 2 * k, 2 * k + 2), own_of(target_mixer.params, k, k + 1)
        errors = []
        for b in range(7):
            private = [part[2 * k : 2 * k + 2, b] for part in (obs, actions, next_obs)]
            step = *private, *(part[k, b] for part in shared)
            errors.append(plain_error(own, own_mixer, old, old_mixer, step, 0.9))
            assert found[k, b].item() == pytest.approx(errors[-1].item(), rel=1e-10)
        for grad, expected in zip(grads, torch.autograd.grad(sum(errors), [*own, *own_mixer]), strict=True):
            assert torch.allclose(grad.chunk(2)[k], expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
def test_the_end_of_the_world_has_exactly_its_reward_as_target(kind, monkeypatch):
    (policy, mixer), (other, _) = (networks(monkeypatch, seeds, kind) for seeds in ((0, 1), (2, 3)))
    batch = random_batch(np.random.default_rng(0), terminated=1)
    errors = [qmix.squared_td_errors(policy, mixer, target, mixer, batch, 0.9) for target in (policy, other)]
    assert torch.equal(*errors)
    going_on = random_batch(np.random.default_rng(0), terminated=0)
    assert not torch.equal(errors[0], qmix.squared_td_errors(policy, mixer, policy, mixer, going_on, 0.9))


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
def test_no_gradient_flows_through_the_target(kind, monkeypatch):
    policy, mixer = networks(monkeypatch, (0, 1), kind)
    learning, grads = [*policy.params, *mixer.params], []
    for target in (policy, mixer), (deepcopy(policy), deepcopy(mixer)):
        error = qmix.squared_td_errors(policy, mixer, *target, random_batch(np.random.default_rng(0), terminated=0), 0.9)
        grads.append(torch.autograd.grad(error.sum(), learning))
    assert all(map(torch.equal, *grads))


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
@pytest.mark.parametrize(("ends", "expected"), [(99, 10.0), (5, 1 / (1 - 0.9 * 4 / 5))])
def test_the_time_limit_bootstraps_and_an_end_does_not(kind, ends, expected, tmp_path, monkeypatch):
    """Episodes of 5 steps, gamma 0.9: 1 + 0.9 + .. for ever, if the time limit cuts; else one of 5 steps is the last.

    The state, which counts the steps and so tells the last one, is kept from the mixer.
    """
    world = test_dqn.Loop(np.array([ends]), [0], [[0], [0]], num_agents=2, obs_dim=1, cell=1.0, state_scale=[0.0], max_steps=5)
    monkeypatch.setattr(qmix, "resolve", lambda args, *_: (args, world))
    args = dict(env="loop", hidden=(16,), gamma=0.9, exploration=1.0, learning_rate=1e-3, num_episodes=300, mixer=kind)
    team = train(qmix, tmp_path, **args, train_every=1, target_every=20, batch_size=500, replay_size=500)
    with torch.no_grad():
        values = qmix.of_team(team.policy(torch.ones(2, 1, 1))[..., 0], 1)
        assert 10 * team.mixer(values, torch.zeros(1, 1, 1)).item() == pytest.approx(expected, rel=0.05)


# --- whole runs ---


class PlainTrial(test_dqn.PlainTrial):
    """As in test_dqn.py, but a step is kept with its states."""

    def kept(self, rollout, t, k, terminated):
        seen = rollout.all_obs[t, k], rollout.actions[t, k], rollout.all_obs[t + 1, k]
        states = rollout.global_state[t, k], rollout.global_state[t + 1, k]
        return *seen, *states, rollout.reward[t, k, 0] / 10, terminated


def of_trial(params, k):
    """Trial k's own of 3 trials' weights: its agents' and its mixer's."""
    return [param.chunk(3)[k] for param in params]


def parts(own):
    """The agents' weights (of two layers) and the mixer's, as new leaves."""
    own = own_of(own, None, None)
    return own[:4], own[4:]


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
def test_every_update_descends_the_mean_squared_error_of_its_batch(kind, tmp_path, monkeypatch):
    """All updates of 3 trials against the method by plain loops: which steps, how many updates, along which direction."""
    use_double_precision(qmix, monkeypatch)
    monkeypatch.setattr(qmix, "MIXING_UNITS", 3)
    monkeypatch.setitem(globals(), "UNITS", 3)
    updates = test_dqn.record_updates(monkeypatch, qmix)
    every = dict(batch_size=3, train_every=3, target_every=20)
    args = dict(env="findtreasure", seed=4, num_trials=3, num_episodes=9, max_steps=9, learning_rate=0.05, gamma=0.9)
    args |= dict(hidden=(6,), exploration=0.5, log_every=1, mixer=kind)
    run = train(qmix, tmp_path, **args, **every, replay_size=20)
    finals = [*weights(run.policy), *(param.detach() for param in run.mixer.params)]
    afters = [*(update.params for update in updates[1:]), finals]
    episodes = [list(group) for _, group in groupby(zip(updates, afters, strict=True), key=lambda pair: id(pair[0].rollout))]
    assert len(episodes) == 9
    copies = 0
    for k in range(3):
        trial = PlainTrial(4 + k, of_trial(updates[0].params, k), 20, **every)
        shown = curves(tmp_path / f"seed{4 + k}")
        assert [value for _, value in shown["charts/epsilon"]] == pytest.approx(np.interp(np.arange(9), [0, 4.5], [1, 0.05]))
        for episode, pairs in enumerate(episodes):
            rollout = pairs[0][0].rollout
            batches, copied = trial.play(rollout, k)
            for n, (update, after) in enumerate(pairs):
                before, direction, after = (of_trial(some, k) for some in (update.params, update.direction, after))
                assert all(map(torch.equal, before, after)) == (n >= len(batches))
                if n < len(batches):
                    (own, own_mixer), old = parts(before), parts(trial.target)
                    loss = sum(plain_error(own, own_mixer, *old, step, 0.9) for step in batches[n]) / 3
                    for found, slope in zip(direction, torch.autograd.grad(loss, [*own, *own_mixer]), strict=True):
                        assert torch.allclose(found, -slope, rtol=1e-5, atol=1e-6)
            if copied:
                trial.target, copies = after, copies + 1
            own, own_mixer = parts(after)
            best = [max(values) for values in q_values(own, rollout.all_obs[0, k])]
            start = plain_mix(own_mixer, best, rollout.global_state[0, k]) if own_mixer else sum(best)
            assert shown["charts/value"][episode] == (trial.count, pytest.approx(10 * start.item(), rel=1e-5))
        kept = of_trial([*weights(run.target), *run.target_mixer.params], k)
        assert all(map(torch.equal, kept, trial.target))
        assert trial.count > 40  # the ring has turned twice
    assert copies >= 9


def test_trials_of_vdn_end_at_different_times(tmp_path):
    """Trial k of three is the run with its seed, with the sum too (the monotonic mixer is in test_trials.py)."""
    args = dict(env="pushbox", num_episodes=40, max_steps=40, mixer="sum", exploration=0.3)
    together = train(qmix, tmp_path / "together", seed=7, num_trials=3, **args)
    assert (together.log.lengths[0] != together.log.lengths[1]).any()
    for k in range(3):
        alone = train(qmix, tmp_path / str(k), seed=7 + k, **args)
        assert np.array_equal(alone.log.lengths[0], together.log.lengths[k])
        for one, every in zip(weights(alone.policy), weights(together.policy), strict=True):
            assert float((one - every.chunk(3)[k]).abs().max()) < 1e-5


@envs.rule
def walk(rules, state, actions):
    """One agent in a corridor; its end is worth 10, every other step costs something."""
    state[0] = max(state[0] + 2 * actions[0] - 1, 0)
    return (10.0, 1) if state[0] == rules[0] else (-0.1, 0)


class Walk(envs.World):
    name, action_names, outcome_names, best_outcome = "walk", ("back", "forth"), ("end",), 1
    step, observe = staticmethod(walk), staticmethod(envs.base.observe_positions)


def test_the_sum_of_one_agent_is_dqn_with_double_q(tmp_path, monkeypatch):
    def double_errors(policy, target, batch, gamma):
        """As in dqn.py, but the value in the target is that of the action which `policy` prefers."""
        preferred = SimpleNamespace(amax=lambda _: following)
        following = target(batch[2]).gather(-1, policy(batch[2]).argmax(-1, keepdim=True))[..., 0]
        return plain_errors(policy, lambda _: preferred, batch, gamma)

    plain_errors = dqn.squared_td_errors
    monkeypatch.setattr(dqn, "squared_td_errors", double_errors)
    world = Walk(np.array([4]), [0], [[0]], num_agents=1, obs_dim=1, cell=0.25, state_scale=[0.25], max_steps=30)
    args = dict(env="walk", hidden=(16,), gamma=0.9, exploration=0.5, learning_rate=3e-3, num_episodes=60, num_trials=2)
    every = dict(train_every=4, target_every=50)
    runs = {}
    for module, own in ((qmix, dict(mixer="sum")), (dqn, {})):
        monkeypatch.setattr(module, "resolve", lambda args, *_: (args, world))
        runs[module] = train(module, tmp_path / module.__name__, **args, **own, **every, replay_size=20_000)
    assert_same_run(runs[qmix], runs[dqn], ("policy", "target", "optimizer"))
    assert runs[qmix].log.outcomes[:, -20:].mean() > 0.8  # and it has learnt to walk


# --- what it is for ---


def learned(team, trials):
    """Q_tot of all joint actions, [num_trials, state, first agent's action, second's].

    States: the first step, game 2A, game 2B.
    """
    state = torch.eye(3)
    with torch.no_grad():
        values = team.policy(state.expand(2 * trials, 3, 3))  # both agents see the state
        taken = values.view(trials, 2, 3, 2)
        joint = torch.stack([taken[:, 0, :, :, None].expand(-1, -1, 2, 2), taken[:, 1, :, None].expand(-1, -1, 2, 2)], dim=-1)
        totals = team.mixer(joint.reshape(trials, 12, 2), state.repeat_interleave(4, 0).expand(trials, 12, 3))
    return totals.view(trials, 3, 2, 2).numpy()


def greedy_return(table):
    """What the team earns that takes the best of Q_tot [state, action, action] in both steps."""
    first, _ = np.unravel_index(table[0].argmax(), (2, 2))
    second = np.unravel_index(table[1 + first].argmax(), (2, 2))
    return 7 if first == 0 else [[0, 1], [1, 8]][second[0]][second[1]]


@pytest.mark.parametrize(
    ("kind", "tables", "earned"),
    [
        ("monotonic", [[[6.93, 6.93], [7.92, 7.92]], [[7, 7], [7, 7]], [[0, 1], [1, 8]]], 8),
        ("sum", [[[6.93, 6.93], [6.43, 6.43]], [[7, 7], [7, 7]], [[-1.5, 2.5], [2.5, 6.5]]], 7),
    ],
)
def test_the_two_step_game_goes_as_published(kind, tables, earned, tmp_path, monkeypatch):
    """Rashid et al., Section 5, with the settings of their appendix: QMIX learns all values and earns 8, VDN earns 7.

    VDN learns the sums that are nearest in the mean of squares, of which 2B's best is 6.5; what is learnt here and there
    differs from them by what has been drawn last (6.51 and -1.87 are published for 6.5 and -1.5).
    """
    monkeypatch.setattr(qmix, "FINAL_EPSILON", 1.0)  # full exploration
    monkeypatch.setattr(qmix, "REWARD_SCALE", 1.0)
    args = dict(env=str(TWO_STEP), num_trials=2, num_episodes=5000, mixer=kind, learning_rate=5e-4, gamma=0.99, log_every=5000)
    team = train(qmix, tmp_path, **args, train_every=2, batch_size=64, target_every=200, replay_size=1000)
    found = learned(team, 2)
    assert np.abs(found - tables).max() < (0.05 if kind == "monotonic" else 0.5)
    assert [greedy_return(table) for table in found] == [earned] * 2


@pytest.mark.parametrize("kind", ["monotonic", "sum"])
def test_a_team_learns_to_race(kind, tmp_path, monkeypatch):
    """The world's rewards are small beside what a new mixing network says, so they are not divided by 10."""
    monkeypatch.setattr(qmix, "REWARD_SCALE", 1.0)
    args = dict(env=str(RACE), num_trials=4, num_episodes=300, learning_rate=1e-3, exploration=0.4, mixer=kind)
    log = train(qmix, tmp_path, **args).log
    early, late = (log.means(episodes)["episodic_length"] for episodes in (slice(0, 20), slice(-100, None)))
    assert early.min() > 8  # at first they play at random
    assert late.max() < 5  # of at least 4 steps
    assert (log.outcomes[:, -100:] == 1).all()
