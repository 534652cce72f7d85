"""AC: its errors against closed forms, every update of actors and critic against plain loops, and learning."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import ac, pg
from tests.helpers import (
    Update,
    assert_same_direction,
    assert_same_run,
    curves,
    each_setting,
    look,
    plain_logits,
    record_updates,
    train,
    weights,
)

CLIMB = np.array([[11.0, -30.0, 0.0], [-30.0, 7.0, 6.0], [0.0, 0.0, 5.0]])  # the team's reward for both actions


def plain_errors(reward, values, terminated, gamma):
    """The one-step errors of one episode: reward of T steps, values of T + 1 joint observations."""
    errors = []
    for t in range(len(reward)):
        target = reward[t] if terminated and t == len(reward) - 1 else reward[t] + gamma * values[t + 1]
        errors.append(target - values[t])
    return errors


def plain_input(world, state):
    """What the critic sees in one step: the integers `state` [state_dim], scaled."""
    return (np.asarray(state) * world.state_scale).astype(np.float32)


def record_both(monkeypatch):
    """Lists that get every `Update` of the actors, and every one of the critic, which follows it."""
    actors, critics = record_updates(ac, monkeypatch), []
    watched = ac.update

    def update(optimizer, kind, loss):
        params, before = optimizer.param_groups[0]["params"], len(actors)
        known = weights(SimpleNamespace(params=params))
        grads = torch.autograd.grad(loss, params, retain_graph=True)
        watched(optimizer, kind, loss)
        if len(actors) == before:
            critics.append(Update(actors[-1].rollout, known, [-grad for grad in grads]))

    monkeypatch.setattr(ac, "update", update)
    return actors, critics


# --- what the critic sees ---


def test_the_critic_tells_states_apart_that_look_the_same_to_all_agents():
    """In pushbox both agents face an empty cell wherever the first one stands."""
    world = envs.make_world("pushbox")
    states = np.array([[0, 0, 1, 3, 0, 3, 2, 2, 2], [0, 1, 1, 3, 0, 3, 2, 2, 2]])
    obs = np.array([look(world, state) for state in states], np.float32)
    assert np.array_equal(*obs)
    critic = ac.build(ac.Args(hidden=(64, 32)), world, [np.random.default_rng(0)]).critic
    assert critic.params[0].shape == (1, 9, 64)
    first, second = critic(np.array([[plain_input(world, state) for state in states]])).flatten().tolist()
    assert abs(first - second) > 1e-3


# --- the errors ---


def test_known_errors():
    reward = np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 0.0]])
    values = np.array([[10.0, 10.0, 10.0], [20.0, 20.0, 20.0], [40.0, 40.0, 40.0]])
    errors = ac.td_errors(reward, values, np.array([2, 2, 1]), np.array([False, True, True]), 0.5)
    assert errors.T.tolist() == [[1, 2], [1, -18], [-9, 0]]  # cut, terminated, terminated at once


@pytest.mark.parametrize("gamma", [0.0, 0.95, 1.0])
def test_errors_are_those_of_the_plain_loop(gamma):
    rng = np.random.default_rng(0)
    lengths, terminated = np.array([1, 1, 17, 17, 30, 30]), np.array([False, True] * 3)
    reward, values = rng.normal(size=(30, 6)), rng.normal(size=(31, 6))
    for k, length in enumerate(lengths):
        reward[length:, k], values[length + 1 :, k] = np.nan, np.nan  # nothing there may count
    errors = ac.td_errors(reward, values, lengths, terminated, gamma)
    for k, length in enumerate(lengths):
        expected = plain_errors(reward[:length, k], values[: length + 1, k], terminated[k], gamma)
        assert errors[:length, k] == pytest.approx(expected, abs=1e-14)
        assert not errors[length:, k].any()


def test_with_the_true_values_the_error_is_the_advantage():
    """5 states, 3 actions, some of which end the episode: sum_a pi(a) delta(a) = 0 and delta(a) = Q(a) - V in every state."""
    rng = np.random.default_rng(1)
    gamma, reward, following = 0.9, rng.normal(size=(5, 3)), rng.integers(5, size=(5, 3))
    ends, pi = rng.random((5, 3)) < 0.3, rng.dirichlet(np.ones(3), size=5)
    moves = np.zeros((5, 5))
    for s, a in np.ndindex(5, 3):
        moves[s, following[s, a]] += pi[s, a] * (not ends[s, a])
    value = np.linalg.solve(np.eye(5) - gamma * moves, (pi * reward).sum(1))
    quality = reward + gamma * ~ends * value[following]
    steps = list(np.ndindex(5, 3))  # each one an episode of one step, which terminates or is cut
    values = np.array([[value[s] for s, _ in steps], [value[following[step]] for step in steps]])
    errors = ac.td_errors(reward.reshape(1, 15), values, np.ones(15, int), ends.ravel(), gamma).reshape(5, 3)
    assert 0 < ends.sum() < 15
    assert np.abs((pi * errors).sum(1)).max() < 1e-12
    assert np.abs(errors - (quality - value[:, None])).max() < 1e-12
    assert np.abs(errors).max() > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_the_expected_gradient_of_the_climb_game_is_its_closed_form_for_any_values(seed):
    rng = np.random.default_rng(seed)
    logits = torch.from_numpy(rng.normal(size=(2, 3))).requires_grad_()
    pi = torch.softmax(logits, -1).detach().numpy()
    actions = np.array([(a, b) for a in range(3) for b in range(3)])  # the 9 joint actions, each an episode of one step
    values = np.repeat(rng.normal(scale=20, size=(2, 1)), 9, axis=1)  # the episode ends: what is thought of s_1 does not count
    errors = ac.td_errors(CLIMB.reshape(1, 9), values, np.ones(9, int), np.ones(9, bool), 0.9)[0]
    weight = torch.from_numpy(pi[0, actions[:, 0]] * pi[1, actions[:, 1]] * errors)
    log_probs = torch.log_softmax(logits, -1)
    (weight[:, None] * torch.stack([log_probs[i, actions[:, i]] for i in range(2)], 1)).sum().backward()
    mean = pi[0] @ CLIMB @ pi[1]
    closed_form = np.array([pi[0] * (CLIMB @ pi[1] - mean), pi[1] * (CLIMB.T @ pi[0] - mean)])
    assert np.abs(closed_form).max() > 0.05
    assert np.abs(logits.grad.numpy() - closed_form).max() < 1e-12


def play_a_loop(monkeypatch, *, terminated):
    """Episodes of 5 steps in one state and reward 1, which then are cut or, in trials that are `terminated`, end."""

    class Loop(ac.Rollout):
        def play(self, params, generators):
            self._all_obs[:], self._obs[:, 0] = 0.5, 0.5
            self._states[:], self._rows[:], self._actions[:], self._reward[:] = 1, 0, 0, 1.0
            self.lengths[:], self.outcomes[:] = 5, terminated
            self._show(self._obs[:, :1])

    monkeypatch.setattr(ac, "Rollout", Loop)


def test_the_critic_of_a_loop_learns_that_the_time_limit_ends_nothing(tmp_path, monkeypatch):
    play_a_loop(monkeypatch, terminated=[False, True])
    args = dict(num_trials=2, num_episodes=500, max_steps=5, gamma=0.9, critic_learning_rate=1e-2, log_every=100)
    trained = train(ac, tmp_path, **args)
    seen = plain_input(trained.log.world, np.ones(9))
    values = 10 * trained.critic(np.tile(seen, (2, 1, 1))).detach().flatten().numpy()
    # V = 1 + 0.9 V where the time limit cuts; V = 1 + 0.9 V in four of five steps, 1 in the fifth, where the world ends
    assert values == pytest.approx([10, 1 / (1 - 0.9 * 4 / 5)], abs=0.01)
    for k, (value, error) in enumerate([(10, 0), (1 / 0.28, 0.4 * 0.9 / 0.28)]):
        shown = curves(tmp_path / f"seed{1 + k}")
        assert shown["charts/value"][-1] == (2500, pytest.approx(value, abs=0.02))
        assert shown["charts/td_error"][-1] == (2500, pytest.approx(error, abs=0.02))


@pytest.mark.parametrize(("terminated", "expected"), [(True, 4.0951), (False, 10.0)])
def test_values_of_a_loop_that_see_the_time(terminated, expected):
    values, lengths = np.zeros((6, 1)), np.array([5])
    for _ in range(500):
        values[:5] += ac.td_errors(np.ones((5, 1)), values, lengths, np.array([terminated]), 0.9)
        values[5] = values[4]  # nothing can be learnt of s_5 itself
    assert values[0, 0] == pytest.approx(expected, abs=1e-6)


# --- whole runs ---


def critic_descent(params, k, states, targets):
    """Minus the gradient of 1/T sum_t (y_t - V(s_t))^2 in the critic of trial k, step by step in double precision."""
    own = [param[k].detach().double().requires_grad_() for param in params]
    loss = sum((y - plain_logits(own, s)[0]) ** 2 for s, y in zip(states, targets, strict=True)) / len(targets)
    return [-grad for grad in torch.autograd.grad(loss, own)]


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_of_actors_and_critic(env, tmp_path, monkeypatch):
    actors, critics = record_both(monkeypatch)
    args = dict(env=env, seed=1, num_trials=3, num_episodes=12, max_steps=15, learning_rate=0.05, gamma=0.9)
    log = train(ac, tmp_path, **args, critic_learning_rate=0.1, log_every=1).log
    assert len(actors) == len(critics) == 12
    shown = [curves(tmp_path / f"seed{1 + k}") for k in range(3)]
    ends = set()
    for n, (actor, critic) in enumerate(zip(actors, critics, strict=True)):
        rollout, steps_of = actor.rollout, []
        for k, length in enumerate(rollout.lengths):
            ends.add((length < rollout.lengths.max(), rollout.outcomes[k] > 0))
            obs, actions = rollout.all_obs[: length + 1, k], rollout.actions[:length, k]
            seen = [plain_input(log.world, state) for state in rollout.states[: length + 1, k]]
            own = [param[k].double() for param in critic.params]
            values = [float(plain_logits(own, x)[0]) for x in seen]
            errors = np.array(plain_errors(rollout.reward[:length, k, 0] / 10, values, rollout.outcomes[k] > 0, 0.9))
            steps_of += [list(zip(obs[:length, i], actions[:, i], errors / length, strict=True)) for i in range(2)]
            expected = critic_descent(critic.params, k, seen[:-1], errors + values[:-1])
            for found, plain in zip(critic.direction, expected, strict=True):
                assert np.allclose(found[k], plain, rtol=1e-4, atol=1e-5 * max(1.0, float(plain.abs().max())))
            steps = log.lengths[k, : n + 1].sum()
            for tag, value in {"value": np.mean(values[:-1]), "td_error": np.sqrt(np.mean(errors**2))}.items():
                assert shown[k][f"charts/{tag}"][n] == (steps, pytest.approx(10 * value, rel=1e-4, abs=1e-5))
        assert_same_direction(actor.direction, actor.params, steps_of)
    assert (False, False) in ends
    if env == "pushbox":
        assert (True, True) in ends


@pytest.mark.parametrize("optimizer", ["sign", "adam"])
def test_the_critic_has_an_adam_of_its_own(optimizer, tmp_path, monkeypatch):
    _, critics = record_both(monkeypatch)
    args = dict(env="pushbox", optimizer=optimizer, num_trials=2, num_episodes=10, max_steps=10)
    trained = train(ac, tmp_path, **args, learning_rate=1e-3, critic_learning_rate=1e-2)
    reference = [param.clone() for param in critics[0].params]
    adam = torch.optim.Adam(reference, lr=1e-2)
    after = [*(update.params for update in critics[1:]), trained.critic.params]
    for update, following in zip(critics, after, strict=True):
        for param, direction in zip(reference, update.direction, strict=True):
            param.grad = -direction
        adam.step()
        assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))


def test_a_critic_has_the_hidden_layers_of_table_1_and_weights_drawn_after_the_actors(tmp_path):
    critic = train(ac, tmp_path, env="pushbox", seed=4, num_trials=2, num_episodes=1, critic_learning_rate=0.0).critic
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    ac.StackedMLP(fresh, 2, [5, 64, 32, 4])
    expected = ac.StackedMLP(fresh, 1, [9, 64, 32, 1])
    assert all(map(torch.equal, critic.params, expected.params))


@each_setting
def test_without_values_it_is_pg_of_the_reward_alone_bit_for_bit(env, optimizer, tmp_path, monkeypatch):
    build = ac.build

    def build_without_values(*args):
        team = build(*args)
        for param in team.critic.params:
            param.data.zero_()
        return team

    monkeypatch.setattr(ac, "build", build_without_values)
    monkeypatch.setattr(ac, "REWARD_SCALE", 1.0)
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=60, learning_rate=1e-3)
    plain = train(pg, tmp_path / "pg", **args, gamma=0.0)
    assert_same_run(plain, train(ac, tmp_path / "ac", **args, critic_learning_rate=0.0))


def test_ac_leaves_the_local_optimum_of_findtreasure(tmp_path):
    args = dict(learning_rate=1e-3, critic_learning_rate=1e-2)
    log = train(ac, tmp_path, env="findtreasure", num_trials=4, num_episodes=1500, **args).log
    found = (log.outcomes[:, -75:] == 1).mean(1) > 0.5  # none of PG's; one of these walks until the time limit
    assert found.sum() >= 3
    assert log.means(slice(-75, None))["reward_per_step"][found].min() > 3
