"""COMA: its baseline and targets against closed forms, every update against plain loops, its target critics, and learning."""

import itertools
import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import envs
from algos import coma, pg
from tests.helpers import (
    Update,
    assert_same_direction,
    assert_same_run,
    curves,
    look,
    plain_logits,
    record_updates,
    train,
    weights,
)

CLIMB = np.array([[11.0, -30.0, 0.0], [-30.0, 7.0, 6.0], [0.0, 0.0, 5.0]])  # the team's reward for both actions


# --- the counterfactual baseline ---


def test_known_advantages():
    values = np.array([[[[10.0, 20.0], [0.0, 4.0]]]])
    probs = np.array([[[[0.5, 0.5], [0.75, 0.25]]]])
    assert coma.counterfactual_advantages(values, probs, np.array([[[1, 0]]])).tolist() == [[[5, -1]]]


def test_the_expected_advantage_of_an_agents_own_action_is_0():
    rng = np.random.default_rng(0)
    values, probs = rng.normal(size=(7, 3, 2, 5)), rng.dirichlet(np.ones(5), size=(7, 3, 2))
    every = [coma.counterfactual_advantages(values, probs, np.full((7, 3, 2), a)) for a in range(5)]
    assert np.abs(np.einsum("atki,tkia->tki", every, probs)).max() < 1e-14
    assert np.abs(every).min() > 1e-4


def test_where_values_add_up_the_advantage_knows_only_the_own_action():
    """Q(s, u) = f(s) + sum_j q_j(u_j): A_i = q_i(u_i) - sum_a pi_i(a) q_i(a), whatever f and the others' actions are."""
    rng = np.random.default_rng(1)
    joint = np.array(list(itertools.product(range(4), repeat=3)))  # 64 joint actions of 3 agents, each a step of one trial
    own, pi = rng.normal(size=(3, 4)), rng.dirichlet(np.ones(4), size=3)
    state = rng.normal(scale=10, size=64)
    total = state + sum(own[j, joint[:, j]] for j in range(3))
    values = np.array([total[:, None] - own[i, joint[:, i]][:, None] + own[i] for i in range(3)]).transpose(1, 0, 2)[:, None]
    advantage = coma.counterfactual_advantages(values, np.broadcast_to(pi, values.shape), joint[:, None])[:, 0]
    expected = own - (pi * own).sum(1, keepdims=True)
    for i in range(3):
        assert np.abs(advantage[:, i] - expected[i, joint[:, i]]).max() < 1e-13


@pytest.mark.parametrize("seed", range(3))
def test_the_expected_gradient_of_the_climb_game_is_its_closed_form(seed):
    logits = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, 3))).requires_grad_()
    pi = torch.softmax(logits, -1).detach().numpy()
    actions = np.array([(a, b) for a in range(3) for b in range(3)])  # the 9 joint actions, each an episode of one step
    values = np.array([[CLIMB[:, b], CLIMB[a]] for a, b in actions])[None]  # the exact critics
    advantage = coma.counterfactual_advantages(values, np.broadcast_to(pi, values.shape), actions[None])[0]
    weight = torch.from_numpy((pi[0, actions[:, 0]] * pi[1, actions[:, 1]])[:, None] * advantage)
    log_probs = torch.log_softmax(logits, -1)
    (weight * torch.stack([log_probs[i, actions[:, i]] for i in range(2)], 1)).sum().backward()
    mean = pi[0] @ CLIMB @ pi[1]
    closed_form = np.array([pi[0] * (CLIMB @ pi[1] - mean), pi[1] * (CLIMB.T @ pi[0] - mean)])
    assert np.abs(closed_form).max() > 0.05
    assert np.abs(logits.grad.numpy() - closed_form).max() < 1e-12


# --- what the critics see ---


def plain_input(scale, state, actions, i, num_actions):
    """What agent i's critic is asked in one step: state [state_dim], actions [num_agents]."""
    agents = len(actions)
    others = [(i + step) % agents for step in range(1, agents)]
    one_hot = (np.eye(num_actions)[actions[j]] for j in others)
    return np.concatenate([state * scale, *one_hot]).astype(np.float32)


@pytest.mark.parametrize("agents", [1, 2, 3, 4])
def test_a_critic_is_asked_with_the_state_and_the_others_actions(agents):
    rng = np.random.default_rng(2)
    states, actions = rng.random((6, 3, 7), np.float32), rng.integers(4, size=(6, 3, agents))
    inputs = coma.critic_inputs(states, actions, 4)
    assert (inputs.shape, inputs.dtype) == ((6, 3, agents, 7 + (agents - 1) * 4), np.float32)
    for t, k, i in np.ndindex(6, 3, agents):
        assert np.array_equal(inputs[t, k, i], plain_input(1, states[t, k], actions[t, k], i, 4))
    for i in range(agents):
        changed = actions.copy()
        changed[:, :, i] = (actions[:, :, i] + 1) % 4
        same = (coma.critic_inputs(states, changed, 4) == inputs).all(3)
        assert same[:, :, i].all()
        assert not np.delete(same, i, axis=2).any()


def test_the_critics_tell_states_apart_that_look_the_same_to_all_agents():
    """In pushbox both agents face an empty cell wherever the first one stands."""
    world = envs.make_world("pushbox")
    states = np.array([[0, 0, 1, 3, 0, 3, 2, 2, 2], [0, 1, 1, 3, 0, 3, 2, 2, 2]])
    obs = np.array([look(world, state) for state in states], np.float32)
    assert np.array_equal(*obs)
    scaled = (states * world.state_scale).astype(np.float32)[:, None]
    inputs = coma.critic_inputs(scaled, np.zeros((2, 1, 2), int), 4)
    critic = coma.build(coma.Args(hidden=(64, 32)), world, [np.random.default_rng(0)]).critic
    first, second = critic(inputs[:, 0].transpose(1, 0, 2)).detach().unbind(1)  # [num_agents, num_actions]
    assert float((first - second).abs().min()) > 1e-4


def test_networks_see_every_input_once_and_answer_in_every_step():
    kinds, rng = np.random.default_rng(4).normal(size=(4, 3)).astype(np.float32), np.random.default_rng(5)
    inputs, lengths = kinds[rng.integers(4, size=(21, 3, 2))], np.array([20, 1, 9])
    distinct, rows = envs.distinct_rows(inputs, lengths + 1)
    assert distinct.shape == (6, 4, 3)
    answers = envs.in_every_step(torch.from_numpy(distinct), rows).numpy()
    for k, length in enumerate(lengths):
        assert np.array_equal(answers[: length + 1, k], inputs[: length + 1, k])


# --- the targets ---


def random_episodes():
    """reward [30, 6], values [31, 6, 2], lengths and ends of six episodes; nothing that must not count is a number."""
    rng = np.random.default_rng(3)
    lengths, terminated = np.array([1, 1, 17, 17, 30, 30]), np.array([False, True] * 3)
    reward, values = rng.normal(size=(30, 6)), rng.normal(size=(31, 6, 2))
    for k, length in enumerate(lengths):
        reward[length:, k], values[length + (not terminated[k]) :, k] = np.nan, np.nan
    return reward, values, lengths, terminated


def test_known_targets():
    reward = np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 0.0]])
    values = np.repeat([[[10.0], [20.0], [40.0]]], 3, axis=0).transpose(1, 0, 2)
    targets = coma.lambda_targets(reward, values, np.array([2, 2, 1]), np.array([False, True, True]), 0.5, 0.75)
    # cut: y_1 = 2 + 40/2, y_0 = 1 + (20/4 + 3/4 22)/2; terminated: y_1 = 2, y_0 = 1 + (20/4 + 3/4 2)/2; terminated at once
    assert targets[:, :, 0].T.tolist() == [[11.75, 22], [4.25, 2], [1, 0]]


@pytest.mark.parametrize("gamma", [0.0, 0.95, 1.0])
@pytest.mark.parametrize("td_lambda", [0.0, 0.3, 0.8, 1.0])
def test_targets_are_the_mixture_of_all_looks_ahead(gamma, td_lambda):
    """y_t = (1 - lambda) sum_n lambda^(n-1) G^(n) + lambda^(N-1) G^(N), G^(n) looks n steps ahead and N = T - t to the end."""
    reward, values, lengths, terminated = random_episodes()
    targets = coma.lambda_targets(reward, values, lengths, terminated, gamma, td_lambda)
    for k, length in enumerate(lengths):
        for i, t in itertools.product(range(2), range(length)):
            ahead = []
            for n in range(1, length - t + 1):
                beyond = 0.0 if terminated[k] and t + n == length else gamma**n * values[t + n, k, i]
                ahead.append(sum(gamma**m * reward[t + m, k] for m in range(n)) + beyond)
            expected = sum((1 - td_lambda) * td_lambda**n * one for n, one in enumerate(ahead[:-1]))
            expected += td_lambda ** (len(ahead) - 1) * ahead[-1]
            assert targets[t, k, i] == pytest.approx(expected, abs=1e-12)
        assert not targets[length:, k].any()


def test_the_extremes_of_lambda_are_the_return_and_one_step():
    reward, values, lengths, terminated = random_episodes()
    returns, one_step = (coma.lambda_targets(reward, values, lengths, terminated, 0.9, extreme) for extreme in (1.0, 0.0))
    for k, length in enumerate(lengths):
        if terminated[k]:
            expected = pg.discounted_returns(np.repeat(reward[:, :, None], 2, axis=2), lengths, 0.9)[:length, k]
            assert np.abs(returns[:length, k] - expected).max() < 1e-13
        following = values[1 : length + 1, k].copy()
        if terminated[k]:
            following[-1] = 0
        assert np.abs(one_step[:length, k] - reward[:length, k, None] - 0.9 * following).max() < 1e-13


@pytest.mark.parametrize("td_lambda", [0.0, 0.8, 1.0])
@pytest.mark.parametrize(("terminated", "expected"), [(True, 4.0951), (False, 10.0)])
def test_values_of_a_loop_that_see_the_time(terminated, expected, td_lambda):
    values = np.zeros((6, 1, 1))
    for _ in range(500):
        values[:5] = coma.lambda_targets(np.ones((5, 1)), values, np.array([5]), np.array([terminated]), 0.9, td_lambda)
        values[5] = values[4]  # nothing can be learnt of what follows the last step
    assert values[0, 0, 0] == pytest.approx(expected, abs=1e-6)


def test_the_critics_of_a_loop_learn_that_the_time_limit_ends_nothing(tmp_path, monkeypatch):
    """Episodes of 5 steps with one observation, any actions and reward 1: the first trial's are cut, the second's end."""

    class Loop(coma.Rollout):
        def play(self, params, generators):
            self._all_obs[:], self._obs[:, 0] = 0.5, 0.5
            self._states[:], self._rows[:], self._reward[:] = 1, 0, 1.0
            for k, generator in enumerate(generators):
                self._actions[:, k] = generator.integers(4, size=(5, 2))
            self.lengths[:], self.outcomes[:] = 5, [0, 1]
            self._show(self._obs[:, :1])

    monkeypatch.setattr(coma, "Rollout", Loop)
    args = dict(num_trials=2, num_episodes=1000, max_steps=5, hidden=(16,), gamma=0.9, learning_rate=0.0)
    trained = train(coma, tmp_path, **args, critic_learning_rate=1e-2, target_critic_every=5)
    state = np.ones(9)
    seen = [plain_input(trained.log.world.state_scale, state, (other, other), 0, 4) for other in range(4)]
    values = 10 * trained.critic(np.tile(seen, (4, 1, 1))).detach().view(2, -1).numpy()
    fixed = 0.0
    for _ in range(500):  # of q = the mean of all targets in an episode that ends
        targets = [1.0]
        for _ in range(4):
            targets.append(1 + 0.9 * (0.2 * fixed + 0.8 * targets[-1]))
        fixed = np.mean(targets)
    assert 2 < fixed < 4
    assert values[0] == pytest.approx(np.full(32, 10), abs=0.3)
    assert values[1].mean() == pytest.approx(fixed, abs=0.3)  # a single value depends on the steps in which it was visited last


# --- whole runs ---

WORLDS = {
    "findtreasure": (dict(env="findtreasure"), 2),
    "pushbox": (dict(env="pushbox"), 2),
    "three agents": (dict(env="cleaner", env_args=("num_agents=3", "size=5"), hidden=(8,)), 3),
}


def plain_draw(own, obs, uniform):
    """The action that a policy draws with this uniform: the first whose share of the distribution, added up, exceeds it."""
    below = np.cumsum(torch.softmax(plain_logits(own, obs), 0).numpy())
    return int(np.searchsorted(below, uniform, side="right"))


def critic_descent(own, inputs, actions, targets):
    """Minus the gradient of 1/T sum_t (y_t - Q(x_t, a_t))^2 in one critic, step by step in double precision."""
    own = [param.clone().requires_grad_() for param in own]
    loss = sum((y - plain_logits(own, x)[a]) ** 2 for x, a, y in zip(inputs, actions, targets, strict=True)) / len(targets)
    return [-grad for grad in torch.autograd.grad(loss, own)]


def record_both(monkeypatch):
    """Lists that get every `Update` of the actors, and every one of the critics, which follows it."""
    actors, critics = record_updates(coma, monkeypatch), []
    watched = coma.update

    def update(optimizer, kind, loss):
        params, before = optimizer.param_groups[0]["params"], len(actors)
        known = weights(SimpleNamespace(params=params))
        grads = torch.autograd.grad(loss, params, retain_graph=True)
        watched(optimizer, kind, loss)
        if len(actors) == before:
            critics.append(Update(actors[-1].rollout, known, [-grad for grad in grads]))

    monkeypatch.setattr(coma, "update", update)
    return actors, critics


@pytest.mark.parametrize("world", WORLDS)
def test_every_update_of_actors_and_critics(world, tmp_path, monkeypatch):
    """12 updates against Eq. 4 and the recursion, one step at a time; the target critics are copied after 5 and 10."""
    all_actors, all_critics = record_both(monkeypatch)
    args, agents = WORLDS[world]
    args = dict(args, seed=1, num_trials=3, num_episodes=12, max_steps=15, learning_rate=0.05, gamma=0.9, log_every=1)
    log = train(coma, tmp_path, **args, critic_learning_rate=0.1, td_lambda=0.7, target_critic_every=5).log
    assert len(all_actors) == len(all_critics) == 12
    num_actions, scale = log.world.num_actions, log.world.state_scale
    learn = [np.random.default_rng(np.random.SeedSequence(1 + k).spawn(3)[2]) for k in range(3)]
    shown = [curves(tmp_path / f"seed{1 + k}") for k in range(3)]
    ends = set()
    for n, (actors, critics) in enumerate(zip(all_actors, all_critics, strict=True)):
        rollout, steps_of = actors.rollout, []
        old = all_critics[n - n % 5].params
        for k, length in enumerate(rollout.lengths):
            terminated = rollout.outcomes[k] > 0
            ends.add((length < rollout.lengths.max(), terminated))
            nets = range(agents * k, agents * (k + 1))
            parts = (actors.params, critics.params, old)
            policies, own, target = ([[param[net].double() for param in part] for net in nets] for part in parts)
            states, obs, uniforms = rollout.states[: length + 1, k], rollout.all_obs[: length + 1, k], learn[k].random(agents)
            drawn = [plain_draw(policies[i], obs[length, i], uniforms[i]) for i in range(agents)]
            actions = np.array([*rollout.actions[:length, k], drawn])
            figures = []
            for i in range(agents):
                inputs = [plain_input(scale, *step, i, num_actions) for step in zip(states, actions, strict=True)]
                target_values = [float(plain_logits(target[i], x)[a]) for x, a in zip(inputs, actions[:, i], strict=True)]
                following, targets = 0.0 if terminated else target_values[length], np.zeros(length)
                for t in reversed(range(length)):
                    targets[t] = rollout.reward[t, k, 0] / 10 + 0.9 * following
                    following = 0.3 * target_values[t] + 0.7 * targets[t]
                values = np.array([plain_logits(own[i], x).numpy() for x in inputs[:length]])
                probs = [torch.softmax(plain_logits(policies[i], o), 0).numpy() for o in obs[:length, i]]
                taken = values[np.arange(length), actions[:length, i]]
                advantage = taken - (probs * values).sum(1)
                steps_of.append(list(zip(obs[:length, i], actions[:length, i], advantage / length, strict=True)))
                expected = critic_descent(own[i], inputs[:length], actions[:length, i], targets)
                for found, plain in zip(critics.direction, expected, strict=True):
                    assert np.allclose(found[nets[i]], plain, rtol=1e-4, atol=1e-5 * max(1.0, float(plain.abs().max())))
                figures.append((taken.mean(), np.mean((targets - taken) ** 2)))
            value, square = np.mean(figures, axis=0)
            steps = log.lengths[k, : n + 1].sum()
            for tag, expected in {"value": value, "td_error": np.sqrt(square)}.items():
                assert shown[k][f"charts/{tag}"][n] == (steps, pytest.approx(10 * expected, rel=1e-4, abs=1e-5))
        assert_same_direction(actors.direction, actors.params, steps_of)
    assert (False, False) in ends
    if world == "pushbox":
        assert (True, True) in ends


@pytest.mark.parametrize("optimizer", ["sign", "adam"])
def test_the_critics_have_an_adam_of_their_own(optimizer, tmp_path, monkeypatch):
    _, critics = record_both(monkeypatch)
    args = dict(env="pushbox", optimizer=optimizer, num_trials=2, num_episodes=10, max_steps=10)
    trained = train(coma, tmp_path, **args, learning_rate=1e-3, critic_learning_rate=1e-2)
    reference = [param.clone() for param in critics[0].params]
    adam = torch.optim.Adam(reference, lr=1e-2)
    after = [*(update.params for update in critics[1:]), trained.critic.params]
    for update, following in zip(critics, after, strict=True):
        for param, direction in zip(reference, update.direction, strict=True):
            param.grad = -direction
        adam.step()
        assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))


def test_critics_have_the_hidden_layers_of_table_1_and_weights_drawn_after_the_actors(tmp_path):
    args = dict(env="pushbox", seed=4, num_trials=2, num_episodes=1, learning_rate=0.0, critic_learning_rate=0.0)
    trained = train(coma, tmp_path, **args)
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    for found, sizes in ((trained.policy, [5, 64, 32, 4]), (trained.critic, [9 + 4, 64, 32, 4])):
        assert all(map(torch.equal, found.params, coma.StackedMLP(fresh, 2, sizes).params))


def test_actors_that_do_not_learn_play_as_those_of_pg(tmp_path):
    args = dict(env="pushbox", seed=5, num_trials=3, num_episodes=20, learning_rate=0.0)
    assert_same_run(train(pg, tmp_path / "pg", **args), train(coma, tmp_path / "coma", **args))


def test_the_defaults_are_lambda_0_8_and_200_critic_steps():
    assert (coma.Args().td_lambda, coma.Args().target_critic_every) == (0.8, 200)
    assert coma.REWARD_SCALE == 10


def test_a_run_that_was_stopped_goes_on_with_its_target_critics_and_draws(tmp_path, monkeypatch):
    args = dict(env="findtreasure", num_trials=2, num_episodes=30, max_steps=20, learning_rate=1e-2, critic_learning_rate=1e-2)
    args |= dict(target_critic_every=7)
    whole = train(coma, tmp_path / "whole", **args)
    played = []

    class Interrupted(coma.Rollout):
        def play(self, *args):
            super().play(*args)
            played.append(None)
            if len(played) == 18:
                os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(coma, "Rollout", Interrupted)
        with pytest.raises(SystemExit):
            train(coma, tmp_path / "stopped", **args)
    resumed = train(coma, tmp_path / "stopped", **args, resume=True)
    assert_same_run(whole, resumed, parts=("policy", "critic", "target_critic"))


def test_coma_learns_to_push_boxes(tmp_path):
    log = train(coma, tmp_path, env="pushbox", optimizer="adam", num_trials=4, num_episodes=1500, max_steps=50).log
    first, last = (log.means(part)["reward_per_step"] for part in (slice(100), slice(-100, None)))
    assert last.min() > 1.2 > first.max()
