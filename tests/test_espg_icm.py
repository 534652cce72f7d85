"""ESPG with ICM: errors, gradients and bonuses against plain loops and closed forms, every update of a run, and learning."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from algos import espg_icm, pg
from tests.helpers import (
    assert_same_direction,
    assert_same_run,
    curves,
    each_setting,
    memory_steps,
    plain_returns,
    record_all_updates,
    train,
    use_double_precision,
    weights,
)

torch.set_num_threads(1)  # as in `train`: the networks are small
LAYERS = (2, 2, 2)  # of phi, the inverse and the forward model, where each has one hidden layer


def module(trials, agents, obs_dim, num_actions, **sizes):
    """A curiosity module of double precision for a world with these numbers."""
    default = dict(hidden=(7,), features=3, icm_hidden=(6,), forward_weight=0.3, icm_learning_rate=0.01)
    world = SimpleNamespace(num_agents=agents, obs_dim=obs_dim, num_actions=num_actions)
    return espg_icm.IntrinsicCuriosity(
        list(map(np.random.default_rng, range(trials))), world, SimpleNamespace(**default | sizes)
    )


def bonus(icm, obs, actions, lengths, num_actions):
    """What `bonus` gives for observations [T + 1, num_trials, num_agents, obs_dim] and actions [T, num_trials, num_agents]."""
    obs = obs.astype(np.float32)
    pairs = np.concatenate([np.eye(num_actions, dtype=np.float32)[actions], obs[:-1]], axis=3)
    return icm.bonus(pairs.reshape(*actions.shape[:2], 1, -1), np.array(lengths), obs.reshape(*obs.shape[:2], 1, -1))


def answer(own, x):
    """What a network with these weights and biases says to one vector."""
    for layer in range(0, len(own), 2):
        x = (x if layer == 0 else x.clamp(min=0)) @ own[layer] + own[layer + 1][0]
    return x


def plain_module(own, layers, obs, actions, num_actions, forward_weight):
    """Bonuses [T], the loss of Eq. 7, the inverse model's loss and accuracy of one trial's episode, one step after the other.

    own are the weights and biases of all three networks in double precision, obs [T + 1, num_agents, obs_dim] and actions
    [T, num_agents] end with the episode.
    """
    ends = [0, *2 * np.cumsum(layers)]
    phi, inverse, forward = (own[ends[i] : ends[i + 1]] for i in range(3))
    errors, inverse_losses, right = [], [], []
    for now, joint, then in zip(obs[:-1], actions, obs[1:], strict=True):
        now, then = (answer(phi, torch.tensor([float(x) for agent in place for x in agent]).double()) for place in (now, then))
        said = answer(inverse, torch.cat([now, then]))
        for i, a in enumerate(joint):
            logits = said[num_actions * i : num_actions * (i + 1)]
            inverse_losses.append(torch.logsumexp(logits, 0) - logits[a])
            right.append(int(logits.argmax()) == a)
        one_hot = torch.tensor([float(a == other) for a in joint for other in range(num_actions)]).double()
        errors.append(((answer(forward, torch.cat([now, one_hot])) - then) ** 2).sum() / 2)
    inverse_loss = sum(inverse_losses) / len(actions)
    loss = (1 - forward_weight) * inverse_loss + forward_weight * sum(errors) / len(actions)
    return np.array([error.item() for error in errors]), loss, inverse_loss.item(), np.mean(right)


def own_weights(params, k):
    """Trial k's weights in double precision."""
    return [param[k].detach().clone().double().requires_grad_() for param in params]


# --- the module ---


@pytest.mark.parametrize("agents", [1, 2, 3])
def test_errors_and_gradient_of_some_episodes_are_those_of_the_plain_loop(agents, monkeypatch):
    """All with the parameters before the episode, and means over each trial's own steps."""
    use_double_precision(espg_icm, monkeypatch)
    rng, trials, num_actions, steps_made = np.random.default_rng(agents), 3, 4, []
    icm = module(trials, agents, 2, num_actions)
    step = icm.optimizer.step
    monkeypatch.setattr(icm.optimizer, "step", lambda: (steps_made.append([p.grad.clone() for p in icm.params]), step()))
    for n, lengths in enumerate(([8, 1, 5], [1, 1, 1], [2, 8, 8], [8, 8, 8])):
        steps = max(lengths)
        obs = rng.integers(-2, 3, size=(steps + 1, trials, agents, 2)) / 2  # some are equal
        actions = rng.integers(num_actions, size=(steps, trials, agents))
        for k, length in enumerate(lengths):
            obs[length + 1 :, k] = 1e3  # nothing there may count
        before = [own_weights(icm.params, k) for k in range(trials)]
        found, inverse_loss, accuracy = bonus(icm, obs, actions, lengths, num_actions)
        assert found.shape == (steps, trials, 1)
        assert len(steps_made) == n + 1
        for k, length in enumerate(lengths):
            episode = obs[: length + 1, k], actions[:length, k]
            errors, loss, *expected = plain_module(before[k], LAYERS, *episode, num_actions, 0.3)
            assert found[:length, k, 0] == pytest.approx(errors, abs=1e-12)
            assert not found[length:, k].any()
            assert [inverse_loss[k], accuracy[k]] == pytest.approx(expected, abs=1e-12)
            for grad, gradient in zip(steps_made[n], torch.autograd.grad(loss, before[k]), strict=True):
                assert torch.allclose(grad[k], gradient, rtol=0, atol=1e-12)


def test_without_knowledge_the_inverse_loss_is_n_log_a():
    rng, icm = np.random.default_rng(0), module(2, 2, 3, 4)
    with torch.no_grad():
        for param in icm.inverse_model.params[-2:]:
            param.zero_()
    _, loss, _ = bonus(icm, rng.normal(size=(10, 2, 2, 3)), rng.integers(4, size=(9, 2, 2)), [9, 4], 4)
    assert loss == pytest.approx(2 * np.log(4), abs=1e-6)


def test_what_foresees_nothing_gives_half_the_squared_features_summed():
    rng, icm = np.random.default_rng(0), module(2, 2, 3, 4, features=5)
    with torch.no_grad():
        for param in icm.forward_model.params[-2:]:
            param.zero_()
    obs, lengths = rng.normal(size=(10, 2, 2, 3)), [9, 4]
    phi = icm.encoder(torch.from_numpy(obs.astype(np.float32)).flatten(2).transpose(0, 1)).detach().numpy()
    error, *_ = bonus(icm, obs, rng.integers(4, size=(9, 2, 2)), lengths, 4)
    for k, length in enumerate(lengths):
        assert error[:length, k, 0] == pytest.approx(0.5 * (phi[k, 1 : length + 1] ** 2).sum(1), rel=1e-5)


def test_with_known_places_as_features_what_was_trained_is_foreseen_and_what_was_not_is_not():
    """Frozen one-hot phi in a ring of 6 places; a ring walk only ever goes on (action 0), then it turns round (action 1)."""
    places, icm = 6, module(1, 1, 6, 2, hidden=(6,), features=6, icm_hidden=(32,), forward_weight=1.0)
    frozen = [torch.eye(places), torch.zeros(1, places)] * 2
    trained = np.arange(2 * places + 1) % places, np.zeros(2 * places, int)
    held_out = -np.arange(2 * places + 1) % places, np.ones(2 * places, int)

    def mean_bonus(walk):
        with torch.no_grad():
            for param, value in zip(icm.encoder.params, frozen, strict=True):
                param.copy_(value)
        return bonus(icm, np.eye(places)[walk[0]][:, None, None], walk[1][:, None, None], [2 * places], 2)[0].mean()

    before = mean_bonus(trained)
    for _ in range(400):
        after = mean_bonus(trained)
    assert before > 0.3
    assert after < 1e-3
    assert mean_bonus(held_out) > 0.3


def test_the_inverse_model_tells_the_moves_of_both_agents_and_phi_keeps_both():
    """Two agents in an open line of 7 cells each; what it learns from are the moves alone."""
    rng, icm = np.random.default_rng(0), module(2, 2, 1, 3, hidden=(32,), features=8, icm_hidden=(32,), forward_weight=0.2)
    for _ in range(500):
        actions = rng.integers(3, size=(20, 2, 2))
        obs = np.concatenate([rng.integers(7, size=(1, 2, 2)), actions - 1]).cumsum(0)[..., None] / 7
        *_, accuracy = bonus(icm, obs, actions, [20, 20], 3)
    assert accuracy.min() > 0.9  # 1/3 is chance, 2/3 what one agent alone would give
    line = np.arange(7) / 7
    for agent in range(2):
        obs = np.full((7, 2), 0.5)
        obs[:, agent] = line
        phi = icm.encoder(torch.from_numpy(obs).float().expand(2, 7, 2))
        assert float(phi.diff(dim=1).norm(dim=2).min().detach()) > 0.1


# --- whole runs ---


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_of_module_and_policies(env, tmp_path, monkeypatch):
    updates = record_all_updates(espg_icm, monkeypatch)
    trials, gamma, beta, slots, forward_weight = 2, 0.9, 0.7, 2, 0.4
    args = dict(env=env, seed=2, num_trials=trials, num_episodes=20, max_steps=10, learning_rate=0.02, log_every=1, gamma=gamma)
    sizes = dict(hidden=(9, 8), features=5, icm_hidden=(6,))
    own_args = dict(beta=beta, slots=slots, forward_weight=forward_weight, icm_learning_rate=0.01)
    log = train(espg_icm, tmp_path, **args, **sizes, **own_args).log
    assert len(updates) == 40
    num_actions, ends = log.world.num_actions, set()
    kept = [{} for _ in range(trials)]
    shown = [curves(tmp_path / f"seed{2 + k}") for k in range(trials)]
    for n, (learnt, climbed) in enumerate(zip(updates[::2], updates[1::2], strict=True)):
        rollout, steps_of = climbed.rollout, []
        for k, length in enumerate(rollout.lengths):
            ends.add((length < rollout.lengths.max(), rollout.outcomes[k] > 0))
            obs, actions, reward = rollout.all_obs[: length + 1, k], rollout.actions[:length, k], rollout.reward[:length, k, 0]
            own = own_weights(learnt.params, k)
            errors, loss, *figures = plain_module(own, (3, 2, 2), obs, actions, num_actions, forward_weight)
            for found, expected in zip(learnt.direction, torch.autograd.grad(-loss, own), strict=True):
                assert np.allclose(found[k], expected, rtol=1e-4, atol=1e-6)
            for tag, value in zip(("bonus", "inverse_loss", "inverse_accuracy"), (errors.mean(), *figures), strict=True):
                assert shown[k][f"charts/{tag}"][n][1] == pytest.approx(value, rel=1e-4, abs=1e-6)

            episode = obs[:-1], actions, np.array(plain_returns(reward, gamma))
            best = kept[k].setdefault(int(rollout.outcomes[k]), [])
            worst = min(range(len(best)), key=lambda slot: best[slot][2][0], default=None)
            if len(best) < slots:
                best.append(episode)
            elif episode[2][0] > best[worst][2][0]:
                best[worst] = episode
            stored = [one for episodes in kept[k].values() for one in episodes]
            returns = plain_returns(reward + beta * errors, gamma)
            for i in range(2):
                steps = [(obs[t, i], actions[t, i], returns[t] / length) for t in range(length)]
                steps_of.append(steps + memory_steps(stored, i))
        assert_same_direction(climbed.direction, climbed.params, steps_of)
    assert (False, False) in ends
    if env == "pushbox":
        assert (True, True) in ends


@pytest.mark.parametrize("optimizer", ["sign", "adam"])
def test_the_module_has_an_adam_of_its_own_of_which_the_policies_see_nothing(optimizer, tmp_path, monkeypatch):
    updates = record_all_updates(espg_icm, monkeypatch)
    args = dict(env="pushbox", optimizer=optimizer, num_trials=2, num_episodes=10, max_steps=10)
    trained = train(espg_icm, tmp_path, **args, learning_rate=1e-3, icm_learning_rate=1e-2)
    reference = [param.clone() for param in updates[0].params]
    adam = torch.optim.Adam(reference, lr=1e-2)
    after = [*(update.params for update in updates[2::2]), weights(trained.curiosity)]
    for update, following in zip(updates[::2], after, strict=True):
        for param, direction in zip(reference, update.direction, strict=True):
            param.grad = -direction
        adam.step()
        assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))
    assert not {*map(id, trained.curiosity.params)} & {*map(id, trained.policy.params)}
    before, rng = [param.grad.clone() for param in trained.policy.params], np.random.default_rng(0)
    bonus(trained.curiosity, rng.normal(size=(9, 2, 2, 5)), rng.integers(4, size=(8, 2, 2)), [8, 8], 4)
    assert all(torch.equal(param.grad, grad) for param, grad in zip(trained.policy.params, before, strict=True))


@each_setting
def test_without_bonus_and_memory_it_is_pg_bit_for_bit(env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=100, learning_rate=1e-3)
    plain = train(pg, tmp_path / "pg", **args)
    assert_same_run(plain, train(espg_icm, tmp_path / "icm", **args, beta=0.0, slots=0))


def test_the_module_has_weights_drawn_after_the_actors(tmp_path):
    args = dict(env="pushbox", seed=4, num_trials=2, num_episodes=1)
    curiosity = train(espg_icm, tmp_path, **args, icm_learning_rate=0.0).curiosity
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    espg_icm.StackedMLP(fresh, 2, [5, 64, 32, 4])
    sizes = [10, 64, 32, 32], [2 * 32, 64, 2 * 4], [32 + 2 * 4, 64, 32]
    expected = [param for one in sizes for param in espg_icm.StackedMLP(fresh, 1, one).params]
    assert all(torch.equal(a, b) for a, b in zip(curiosity.params, expected, strict=True))


def test_espg_icm_leaves_the_local_optimum_of_findtreasure(tmp_path):
    args = dict(learning_rate=1e-3, beta=0.3, slots=10)
    log = train(espg_icm, tmp_path, env="findtreasure", num_trials=4, num_episodes=1000, **args).log
    assert (log.outcomes[:, -100:] == 1).mean(1).min() > 0.5
    assert log.means(slice(-100, None))["reward_per_step"].min() > 4
    assert log.means(slice(0, 100))["reward_per_step"].max() < 3
