"""ESPG with EMI: its loss against closed forms, a known world and plain formulas; every update; learning."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal, kl_divergence
from torch.nn.functional import softplus

import envs
from algos import espg_emi, pg
from tests.helpers import (
    assert_same_direction,
    assert_same_run,
    curves,
    each_setting,
    memory_steps,
    plain_logits,
    plain_returns,
    record_all_updates,
    train,
    use_double_precision,
)

# --- the terms of the loss ---


def test_statistics_that_know_nothing_lose_2_log_2():
    loss = espg_emi.information_loss(torch.zeros(3, 2, 8), torch.zeros(3, 2, 8))
    assert loss.shape == (3, 2)
    assert np.allclose(loss, 2 * np.log(2), atol=1e-6)


@pytest.mark.parametrize(("symbols", "equal"), [(2, True), (4, True), (7, True), (4, False)])
def test_the_least_loss_of_a_free_table(symbols, equal):
    """Two symbols that are always equal have the minimum log(1 + 1/K) + log(1 + K)/K, two independent ones 2 log 2."""
    a, b = np.divmod(np.arange(symbols**2), symbols)  # all pairs, as often as the product of the marginals has them
    pairs = (a, a) if equal else (a, b)
    table = torch.zeros(symbols, symbols, dtype=torch.double)
    if equal:
        table = torch.full_like(table, -40.0).fill_diagonal_(np.log(symbols))  # log p / q
    table.requires_grad_()
    loss = espg_emi.information_loss(table[pairs], table[a, b])
    expected = np.log(1 + 1 / symbols) + np.log(1 + symbols) / symbols if equal else 2 * np.log(2)
    assert loss.item() == pytest.approx(expected, abs=1e-12)
    assert float(torch.autograd.grad(loss, table)[0].abs().max()) < 1e-12  # the loss is convex: no table does better
    if (symbols, equal) == (4, True):
        assert loss.item() == pytest.approx(0.6255, abs=1e-4)


def test_samples_of_the_unit_gaussian_do_not_diverge_from_it():
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]) * (3 / 4) ** 0.5  # mean 0, covariance 1
    divergence = espg_emi.gaussian_divergence(torch.stack([signs, 2 * signs, signs + 1]))
    assert divergence.tolist() == pytest.approx([0, 3 - 2 * np.log(2), 1], abs=1e-6)


def test_the_divergence_is_that_of_two_gaussians():
    samples = torch.from_numpy(np.random.default_rng(0).normal(1, 3, size=(3, 20, 4)))
    unit = MultivariateNormal(torch.zeros(4).double(), torch.eye(4).double())
    for one, found in zip(samples, espg_emi.gaussian_divergence(samples), strict=True):
        assert float(found) == pytest.approx(float(kl_divergence(MultivariateNormal(one.mean(0), one.T.cov()), unit)), abs=1e-9)


def test_a_singular_covariance_has_a_finite_divergence_and_gradient():
    """In single precision its eigenvalues would be anything up to 1e-5; those below 1e-6 count as 1e-6 and pull at nothing."""
    few = torch.from_numpy(np.random.default_rng(1).normal(0, 10, size=(2, 4))).float()  # two actions in four dimensions
    samples = few[[0, 1] * 8][None].requires_grad_()
    centred = (few.double()[0] - few.double()[1]) / 2
    spread, mean = float(centred.square().sum() * 16 / 15), few.double().mean(0)
    expected = 0.5 * (spread + 3e-6 + float(mean.square().sum()) - 4 - np.log(spread) - 3 * np.log(1e-6))
    divergence = espg_emi.gaussian_divergence(samples)
    assert divergence.item() == pytest.approx(expected, abs=1e-6)
    grad = torch.autograd.grad(divergence.sum(), samples)[0]
    along = mean / 16 + centred / 15 * (1 - 1 / spread)
    assert np.allclose(grad[0, 0].double(), along.detach(), rtol=1e-5)


# --- whole models ---


def set_linear(network, matrix):
    """Let the networks [in, 64, d] multiply inputs of at least 0 by `matrix` [in, d]."""
    for param in network.params:
        param.data.zero_()
    width, dim = matrix.shape
    network.params[0].data[:, :, :width] = torch.eye(width)
    network.params[2].data[:, :width, :dim] = torch.as_tensor(matrix)


def test_where_places_and_moves_are_the_embeddings_only_hindered_steps_earn_a_bonus():
    """||e||^2 is 0 where everybody got where it wanted, and the squared length of the moves that were hindered."""
    env, rng = envs.make_vec("findtreasure", num_envs=3), np.random.default_rng(1)
    world, lengths = env.world, np.array([60, 60, 17])
    actions = rng.integers(world.num_actions, size=(60, 3, 2))
    obs = [env.reset()[0].copy()]
    for joint in actions:
        after, _, terminated, _, _ = env.step(joint)
        obs.append(after.copy())
    assert not terminated.any()
    obs = np.array(obs)  # [T + 1, num_trials, num_agents, 4]: each agent sees the places of both
    place = np.rint(obs[:, :, 0].astype(float) / world.cell).reshape(61, 3, 2, 2)
    moves = np.array([(-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)])
    expected = ((place[1:] - place[:-1] - moves[actions]) ** 2).sum((2, 3))
    expected[17:, 2] = 0

    streams = [[np.random.default_rng(k) for k in range(3)] for _ in range(2)]
    model = espg_emi.EmbeddingNovelty(world, espg_emi.Args(num_trials=3), *streams)
    set_linear(model.phi, np.concatenate([np.eye(4) / world.cell, np.zeros((4, 4))]))
    set_linear(model.psi, np.kron(np.eye(2), moves))
    set_linear(model.error, np.zeros((18, 4)))
    pairs = np.concatenate([np.eye(5, dtype=np.float32)[actions], obs[:60]], axis=3).reshape(60, 3, 1, 18)
    bonus, _, _ = model.bonus(pairs, lengths, obs[1:].reshape(60, 3, 1, 8), True)
    assert bonus.shape == (60, 3, 1)
    assert np.allclose(bonus[:, :, 0], expected, atol=1e-4)
    assert not bonus[17:, 2].any()
    assert {0.0, 1.0, 2.0} <= set(expected[:17].ravel())


def joint_inputs(obs, actions, num_actions):
    """What a plain model is asked: the observations of all, the one-hot actions of all, and the pairs of all in turn."""
    one_hot = np.eye(num_actions)[actions]
    return [x.reshape(len(obs), -1) for x in (obs, one_hot, np.concatenate([one_hot, obs], axis=2))]


def plain_parts(own, steps, num_actions):
    """phi(o), psi(a), phi(o') and S(o, a) of steps (obs, actions, next_obs) by one trial's weights, in double precision."""
    obs, actions, next_obs = (np.array(part) for part in zip(*steps, strict=True))
    sight, choice, pair = joint_inputs(obs, actions, num_actions)
    ends = next_obs.reshape(len(obs), -1)
    return [plain_logits(own[net], x) for net, x in (("phi", sight), ("psi", choice), ("phi", ends), ("S", pair))]


def plain_loss(own, steps, num_actions, args):
    """The loss of a minibatch, term by term."""
    phi, psi, next_phi, error = plain_parts(own, steps, num_actions)
    size, half, dim = len(steps), len(steps) // 2, phi.shape[1]
    residual = sum((next_phi[b] - phi[b] - psi[b] - error[b]).square().sum() for b in range(size)) / size
    penalty = sum(error[b].square().sum() for b in range(size)) / size
    information = []
    for net in ("T_a", "T_o"):
        total = 0
        for b in range(half):
            c = half + b
            mixed = (phi[b], psi[c], next_phi[b]) if net == "T_a" else (phi[b], psi[b], next_phi[c])
            total += softplus(-plain_logits_of(own[net], (phi[b], psi[b], next_phi[b])))
            total += softplus(plain_logits_of(own[net], mixed))
        information.append(total / half)
    mean = psi.sum(0) / size
    covariance = sum(torch.outer(psi[b] - mean, psi[b] - mean) for b in range(size)) / (size - 1)
    eigenvalues = torch.linalg.eigvalsh(covariance)
    if float(eigenvalues.detach().min()) > 1e-6:
        gaussian = (covariance.trace() + mean @ mean - dim - torch.logdet(covariance)) / 2
    else:  # too few different actions
        eigenvalues = eigenvalues.clamp(min=1e-6)
        gaussian = (eigenvalues.sum() + mean @ mean - dim - eigenvalues.log().sum()) / 2
    loss = residual + args["error_weight"] * penalty + args["information_weight"] * sum(information)
    figures = residual / (psi.square().sum() / size), 2 * np.log(2) - sum(information) / 2
    return loss + args["gaussian_weight"] * gaussian, [float(figure.detach()) for figure in figures]


def plain_logits_of(own, parts):
    x = torch.cat(parts)
    return ((x @ own[0] + own[1][0]).clamp(min=0) @ own[2] + own[3][0])[0]


def own_model(params, k):
    """Trial k's part of the model's weights, or of their gradients: those of all five networks."""
    parts = [param[k].double() for param in params[:12]]
    both = [[param[2 * k + which].double() for param in params[12:]] for which in range(2)]
    return dict(phi=parts[:4], psi=parts[4:8], S=parts[8:], T_a=both[0], T_o=both[1])


WORLDS = {
    "findtreasure": (dict(env="findtreasure"), 2),
    "pushbox": (dict(env="pushbox"), 2),
    "three agents": (dict(env="cleaner", env_args=("num_agents=3", "size=5"), hidden=(8,)), 3),
}


@pytest.mark.parametrize("world", WORLDS)
def test_every_update_of_the_model_and_the_actors(world, tmp_path, monkeypatch):
    """10 episodes: the bonus with the model before them, what the model learns from, and what the actors climb."""
    use_double_precision(espg_emi, monkeypatch)
    updates = record_all_updates(espg_emi, monkeypatch)
    args, agents = WORLDS[world]
    args = dict(args, seed=3, num_trials=3, num_episodes=10, max_steps=36, learning_rate=0.02, gamma=0.9, log_every=1)
    model_args = dict(embedding_batch=25, recent_steps=31, error_weight=0.5, information_weight=0.7, gaussian_weight=0.3)
    log = train(espg_emi, tmp_path, **args, **model_args, embedding_learning_rate=0.05, beta=1.7, slots=2).log
    assert len(updates) == 20
    num_actions = log.world.num_actions
    learn = [np.random.default_rng(np.random.SeedSequence(3 + k).spawn(3)[2]) for k in range(3)]
    shown = [curves(tmp_path / f"seed{3 + k}") for k in range(3)]
    visits, held, kept = [0] * 3, [{} for _ in range(3)], [{} for _ in range(3)]
    waited, overflowed = 0, 0
    episodes = list(zip(updates[::2], updates[1::2], strict=True))
    for n, (model, actors) in enumerate(episodes):
        rollout, steps_of = actors.rollout, []
        for k, length in enumerate(rollout.lengths):
            obs, actions, reward = rollout.all_obs[: length + 1, k], rollout.actions[:length, k], rollout.reward[:length, k, 0]
            steps = [(obs[t], actions[t], obs[t + 1]) for t in range(length)]
            own = own_model(model.params, k)

            # The bonus.
            phi, psi, next_phi, error = (part.detach().numpy() for part in plain_parts(own, steps, num_actions))
            bonus = ((next_phi - phi - psi - error) ** 2).sum(1)

            # What the model learns from.
            for step in steps:
                held[k][visits[k] % 31] = step
                visits[k] += 1
            batch = [held[k][row] for row in learn[k].integers(min(visits[k], 31), size=25)]
            overflowed += length > 31
            if visits[k] >= 25:
                params = [param.requires_grad_() for part in own.values() for param in part]
                loss, figures = plain_loss(own, batch, num_actions, model_args)
                found = [direction for part in own_model(model.direction, k).values() for direction in part]
                for direction, grad in zip(found, torch.autograd.grad(loss, params), strict=True):
                    assert np.allclose(-direction, grad, rtol=1e-7, atol=1e-9 * max(1.0, float(grad.abs().max())))
                for tag, value in zip(("unexplained", "information"), figures, strict=True):
                    assert shown[k][f"charts/{tag}"][n][1] == pytest.approx(value, rel=1e-5, abs=1e-6)
            if n < 9:  # who has not seen enough waits
                following = own_model(episodes[n + 1][0].params, k)
                same = [torch.equal(p, q) for net in own for p, q in zip(own[net], following[net], strict=True)]
                assert all(same) if visits[k] < 25 else not any(same)
                waited += visits[k] < 25
            assert shown[k]["charts/bonus"][n][1] == pytest.approx(bonus.mean(), rel=1e-5)

            # What the actors climb.
            best = kept[k].setdefault(int(rollout.outcomes[k]), [])
            episode = obs[:-1], actions, np.array(plain_returns(reward, 0.9))
            worst = min(range(len(best)), key=lambda slot: best[slot][2][0], default=None)
            if len(best) < 2:
                best.append(episode)
            elif episode[2][0] > best[worst][2][0]:
                best[worst] = episode
            stored = [one for episodes_of in kept[k].values() for one in episodes_of]
            returns = plain_returns(reward + 1.7 * bonus, 0.9)
            for i in range(agents):
                now = [(obs[t, i], actions[t, i], returns[t] / length) for t in range(length)]
                steps_of.append(now + memory_steps(stored, i))
        assert_same_direction(actors.direction, actors.params, steps_of)
    assert visits == log.lengths.sum(1).tolist()
    assert overflowed if world != "pushbox" else waited


def test_later_the_model_learns_after_every_fifth_episode_only(tmp_path, monkeypatch):
    assert [espg_emi.learns_after(episode) for episode in range(2000)] == [True] * 1000 + [True, *[False] * 4] * 200
    monkeypatch.setattr(espg_emi, "learns_after", lambda episode: episode < 3 or episode == 6)
    updates = record_all_updates(espg_emi, monkeypatch)
    args = dict(env="pushbox", num_trials=1, num_episodes=9, max_steps=20, log_every=1)
    model = train(espg_emi, tmp_path, **args, embedding_batch=2).novelty
    assert len(updates) == 4 * 2 + 5  # the model and the actors, or the actors alone
    assert model.optimizer.count.tolist() == [4]
    shown = curves(tmp_path / "seed1")
    for tag in ("unexplained", "information"):
        values = [value for _, value in shown[f"charts/{tag}"]]
        assert [after == before for before, after in pairwise(values)] == [False, False, True, True, True, False, True, True]
    assert len({value for _, value in shown["charts/bonus"]}) == 9


@pytest.mark.parametrize("optimizer", ["sign", "adam"])
def test_the_model_has_an_adam_of_its_own(optimizer, tmp_path, monkeypatch):
    updates = record_all_updates(espg_emi, monkeypatch)
    args = dict(env="pushbox", optimizer=optimizer, num_trials=2, num_episodes=10, max_steps=20)
    model = train(espg_emi, tmp_path, **args, embedding_batch=2, embedding_learning_rate=1e-2).novelty
    reference = [param.clone() for param in updates[0].params]
    adam = torch.optim.Adam(reference, lr=1e-2)
    after = [*(update.params for update in updates[2::2]), model.optimizer.weights]
    for update, following in zip(updates[::2], after, strict=True):
        for param, direction in zip(reference, update.direction, strict=True):
            param.grad = -direction
        adam.step()
        assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))


def test_the_models_weights_are_drawn_after_the_actors(tmp_path):
    args = dict(env="pushbox", seed=4, num_trials=2, num_episodes=1, learning_rate=0.0)
    trained = train(espg_emi, tmp_path, **args, embedding_learning_rate=0.0)
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    model = trained.novelty
    for found, nets, sizes in (
        (trained.policy, 2, [5, 64, 32, 4]),
        (model.phi, 1, [10, 64, 4]),
        (model.psi, 1, [8, 64, 4]),
        (model.error, 1, [18, 64, 4]),
        (model.statistics, 2, [12, 64, 1]),
    ):
        assert all(map(torch.equal, found.params, espg_emi.StackedMLP(fresh, nets, sizes).params))


@each_setting
def test_without_bonus_and_memory_it_is_pg_bit_for_bit(env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=30, learning_rate=1e-3)
    plain = train(pg, tmp_path / "pg", **args)
    assert_same_run(plain, train(espg_emi, tmp_path / "emi", **args, beta=0.0, slots=0))


def test_the_defaults_are_those_of_the_docstring():
    args = espg_emi.Args()
    assert (args.error_weight, args.information_weight, args.gaussian_weight) == (100, 0.1, 0.5)
    assert (args.embedding_batch, args.recent_steps, args.embedding_learning_rate) == (64, 4000, 0.003)


# --- learning ---


def test_the_model_learns_where_moves_lead_and_stays_surprised_at_walls(tmp_path, monkeypatch):
    """Under random play in findtreasure the steps in which both stand still and want to move keep the larger bonus."""
    seen, bonus_of = [], espg_emi.EmbeddingNovelty.bonus

    def watched_bonus(self, pairs, lengths, next_obs, learn):
        found = bonus_of(self, pairs, lengths, next_obs, learn)
        moved = (pairs[:, :, 0, 5:9] != next_obs[:, :, 0, :4]).any(2)
        acting = (pairs[:, :, 0, 4] == 0) & (pairs[:, :, 0, 13] == 0)
        during = np.arange(len(pairs))[:, None] < lengths
        seen.append([found[0][:, :, 0][which & during].mean() for which in (moved, ~moved & acting)])
        return found

    monkeypatch.setattr(espg_emi.EmbeddingNovelty, "bonus", watched_bonus)
    train(espg_emi, tmp_path, env="findtreasure", num_trials=4, num_episodes=400, max_steps=30, learning_rate=0.0)
    free, hindered = np.array(seen)[-50:].mean(0)
    assert hindered > 2 * free
    for k in range(4):
        shown = curves(tmp_path / f"seed{1 + k}")
        unexplained, information = ([value for _, value in shown[f"charts/{tag}"]] for tag in ("unexplained", "information"))
        assert unexplained[-1] < 0.55 < 0.65 < unexplained[0]
        assert information[-1] > 0.5 > 0.3 > information[0] > 0


def test_espg_with_emi_finds_the_treasure(tmp_path):
    log = train(espg_emi, tmp_path, env="findtreasure", num_trials=4, num_episodes=800, learning_rate=1e-3).log
    assert (log.outcomes[:, -100:] == 1).mean(1).min() > 0.5
