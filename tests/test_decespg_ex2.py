"""DecESPG with EX2: its discriminators against plain loops, closed forms and known densities, every update, and learning."""

import copy
from itertools import product
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch

from algos import decespg_ex2, pg
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
)

HIGHEST = np.log((1 - 1e-5) / 1e-5)  # the bonus where D is clamped from above
CODE = decespg_ex2.CODE


def generators(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def novelty(trials=1, windows=1, dim=4, **args):
    torch.set_num_threads(1)  # as in `train`: on a busy machine threads wait for each other in every small product
    default = dict(exemplar_learning_rate=1e-2, kl_weight=1e-3, exemplars=32, buffer_size=20_000, min_replay=1, steps_per_fit=1)
    init, learn = generators(*range(trials)), generators(*range(50, 50 + trials))
    return decespg_ex2.ExemplarNovelty(SimpleNamespace(**default | args), init, learn, windows, dim)


def plain_layers(own, x):
    """What a network of two layers says to x; `own` are its weights and biases."""
    return (x @ own[0] + own[1][0]).clamp(min=0) @ own[2] + own[3][0]


def plain_discriminator(own, exemplar, other, noise=None):
    """log D / (1 - D) of an exemplar and another pair, and the divergence of both codes; without `noise`, of the means.

    `own` are the weights of the encoder and of the classifier, noise [2, CODE].
    """
    exemplar, other = (torch.as_tensor(pair, dtype=torch.double) for pair in (exemplar, other))
    outputs = torch.stack([plain_layers(own[:4], pair) for pair in (exemplar, other)])
    mean, deviation = outputs[:, :CODE], outputs[:, CODE:].exp().sqrt()
    codes = mean if noise is None else mean + deviation * torch.as_tensor(noise, dtype=torch.double)
    standard = torch.distributions.Normal(torch.zeros_like(mean), 1.0)
    divergence = torch.distributions.kl_divergence(torch.distributions.Normal(mean, deviation), standard).sum()
    return plain_layers(own[4:], torch.cat([*codes, (codes[0] - codes[1]).abs()]))[0], divergence


def own_weights(params, net):
    return [param[net].detach().double().requires_grad_() for param in params]


# --- one fit ---


class Fit(NamedTuple):
    """One step of Adam on the discriminators: the weights before it, the gradients, which networks take it."""

    params: list
    grads: list
    active: torch.Tensor


class Episode(NamedTuple):
    """One call of `bonus`: what it was given and returned, its generators before, its fits, and the weights that judged."""

    pairs: np.ndarray
    lengths: np.ndarray
    bonus: np.ndarray
    cross_entropy: np.ndarray
    overvisited: np.ndarray
    learn: list
    fits: list
    params: list


def watch(monkeypatch):
    """A list that gets every `Episode` from now on."""
    episodes, fits = [], []
    novelty = decespg_ex2.ExemplarNovelty

    class WatchedNovelty(novelty):
        def __init__(self, *args):
            super().__init__(*args)
            step = self.optimizer.step

            def watched_step(loss, active):
                before = [param.detach().clone() for param in self.discriminator.params]
                grads = torch.autograd.grad(loss, self.discriminator.params, retain_graph=True)
                nets = torch.from_numpy(active.repeat(len(before[0]) // len(active)))
                fits.append(Fit(before, grads, nets))
                step(loss, active)

            self.optimizer.step = watched_step

        def bonus(self, pairs, lengths):
            learn = copy.deepcopy(self.learn)
            fits.clear()
            found = super().bonus(pairs, lengths)
            params = [param.detach().clone() for param in self.discriminator.params]
            episodes.append(Episode(pairs.copy(), lengths.copy(), *map(np.copy, found), learn, [*fits], params))
            return found

    monkeypatch.setattr(decespg_ex2, "ExemplarNovelty", WatchedNovelty)
    return episodes


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_fit_and_bonus_is_that_of_a_plain_loop(env, tmp_path, monkeypatch):
    """First the fits, against earlier pairs only; then the pairs are remembered; then they are judged."""
    use_double_precision(decespg_ex2, monkeypatch)
    episodes = watch(monkeypatch)
    trials, size, exemplars, kl_weight, enough, every = 2, 25, 3, 0.3, 18, 5
    train(
        decespg_ex2,
        tmp_path,
        **dict(env=env, seed=2, num_trials=trials, num_episodes=14, max_steps=13, beta=0.5, log_every=1),
        **dict(exemplar_learning_rate=0.05, kl_weight=kl_weight, exemplars=exemplars, buffer_size=size, min_replay=enough),
        steps_per_fit=every,
    )
    agents, past, checked, clamped, dues = 2, {}, 0, [], set()
    entropy_of, shown = [np.log(2)] * trials, [curves(tmp_path / f"seed{2 + k}") for k in range(trials)]
    fitted = [False] * trials
    for number, episode in enumerate(episodes):
        most = 0
        for k, length in enumerate(episode.lengths):
            earlier = {i: past.get((k, i), np.zeros((0, episode.pairs.shape[-1]))) for i in range(agents)}
            due, entropies = 0, []
            if len(earlier[0]) >= enough:
                due = sum(step % every == 0 for step in range(len(earlier[0]) + 1, len(earlier[0]) + length + 1))
            most, dues = max(most, due), dues | {due}
            if due:
                drawn = (due, agents, exemplars)
                first = episode.learn[k].integers(length, size=drawn)
                second = episode.learn[k].integers(min(len(earlier[0]), size), size=drawn)
                noise = episode.learn[k].standard_normal((due, agents, 3, exemplars, CODE), dtype=np.float32)
                fitted[k] = True
            for n, i in product(range(due), range(agents)):
                net, fit = k * agents + i, episode.fits[n]
                ring = np.zeros((size, episode.pairs.shape[-1]))
                for visit, pair in enumerate(earlier[i]):
                    ring[visit % size] = pair
                own = own_weights(fit.params, net)
                cross_entropy, loss = 0.0, 0.0
                for same, row in product((True, False), range(exemplars)):
                    exemplar = episode.pairs[first[n, i, row], k, i]
                    other = exemplar if same else ring[second[n, i, row]]
                    of_both = noise[n, i, [0, 1 if same else 2], row]
                    logit, divergence = plain_discriminator(own, exemplar, other, of_both)
                    d = torch.sigmoid(logit)
                    cross_entropy -= torch.log(d if same else 1 - d) / (2 * exemplars)
                    loss += kl_weight * divergence / (2 * exemplars)
                expected = torch.autograd.grad(loss + cross_entropy, own)
                for grad, plain in zip(fit.grads, expected, strict=True):
                    assert np.allclose(grad[net], plain, rtol=1e-7, atol=1e-9)
                entropies.append(cross_entropy.item())
                checked += 1
            assert all((fit.active[k * agents :][:agents] == (n < due)).all() for n, fit in enumerate(episode.fits))
            for i in range(agents):
                own = own_weights(episode.params, k * agents + i)
                logits = [plain_discriminator(own, u, u)[0].item() for u in episode.pairs[:length, k, i]]
                bonus = np.clip(logits, 0, HIGHEST) if fitted[k] else np.zeros(length)
                assert episode.bonus[:length, k, i] == pytest.approx(bonus, abs=1e-8)
                assert not episode.bonus[length:, k, i].any()
                clamped.append((np.array(logits) < 0) & fitted[k])
                past[k, i] = np.concatenate([earlier[i], episode.pairs[:length, k, i]])
            entropy_of[k] = np.mean(entropies) if due else entropy_of[k]
            assert episode.overvisited[k] == pytest.approx(np.mean(clamped[-agents:]))
            assert episode.cross_entropy[k] == pytest.approx(entropy_of[k], abs=1e-6)
            figures = dict(cross_entropy=episode.cross_entropy[k], overvisited=episode.overvisited[k])
            for tag, value in dict(figures, bonus=episode.bonus[:length, k].mean()).items():
                assert shown[k][f"charts/{tag}"][number][1] == pytest.approx(value, abs=1e-6)
        assert len(episode.fits) == most
    assert checked > 30
    assert len(dues) > 2
    assert max(map(len, past.values())) > 2 * size
    assert 0 < np.concatenate(clamped).mean() < 1


def test_the_discriminators_have_a_persistent_adam(tmp_path, monkeypatch):
    episodes = watch(monkeypatch)
    args = dict(env="findtreasure", max_steps=12, min_replay=20, steps_per_fit=5, exemplar_learning_rate=0.01, seed=1)
    train(decespg_ex2, tmp_path, num_trials=2, num_episodes=20, **args)
    fits = [fit for episode in episodes for fit in episode.fits]
    references = [[param[2 * k : 2 * k + 2].clone() for param in fits[0].params] for k in range(2)]  # of two agents each
    adams = [torch.optim.Adam(reference, lr=0.01) for reference in references]
    for fit, following in zip(fits, [*(fit.params for fit in fits[1:]), episodes[-1].params], strict=True):
        for k, (reference, adam) in enumerate(zip(references, adams, strict=True)):
            if fit.active[2 * k]:
                for param, grad in zip(reference, fit.grads, strict=True):
                    param.grad = grad[2 * k : 2 * k + 2]
                adam.step()
            for mine, found in zip(reference, following, strict=True):
                assert torch.allclose(mine, found[2 * k : 2 * k + 2], rtol=0, atol=1e-5)
    assert len(fits) > 10
    assert not all(fit.active.all() for fit in fits)


def test_the_codes_begin_apart_and_with_little_noise():
    mean, log_variance = novelty(dim=4).discriminator.encoder(torch.eye(4)[None]).detach().chunk(2, dim=2)  # [1, 4, CODE]
    assert mean.std(1).mean() > 0.3
    assert float(log_variance.mean()) == pytest.approx(-4, abs=0.5)


def test_the_divergence_is_that_of_closed_forms():
    """mean 0, variance 1: 0; mean m: m^2 / 2 for every number of a code; log variance v: (exp(v) - 1 - v) / 2."""
    bonus = novelty(dim=3)
    weights, biases = bonus.discriminator.encoder.params[2:]
    with torch.no_grad():
        for param in bonus.discriminator.params:
            param.zero_()
        batch = torch.zeros(1, 5, 3), torch.ones(1, 5, 3), torch.zeros(1, 15, CODE)
        assert bonus.discriminator.losses(*batch)[1].tolist() == [0]
        biases[0, 0, :CODE] = 2.0
        biases[0, 0, CODE:] = -3.0
        cross_entropy, divergence = bonus.discriminator.losses(*batch)
        assert divergence.item() == pytest.approx(2 * CODE * (2 + (np.exp(-3) + 2) / 2), rel=1e-6)
        assert cross_entropy.item() == pytest.approx(np.log(2), rel=1e-6)
        # Of the second codes half are the exemplars' and half the earlier pairs', whose means alone move here.
        bonus.discriminator.encoder.params[0][0, :, 0], weights[0, 0, :CODE] = 1.0, 1.0
        _, divergence = bonus.discriminator.losses(*batch)
    of_exemplar, of_earlier = (CODE * (mean**2 / 2 + (np.exp(-3) + 2) / 2) for mean in (2.0, 5.0))
    assert divergence.item() == pytest.approx(of_exemplar + (of_exemplar + of_earlier) / 2, rel=1e-6)


# --- densities ---


class Table(torch.nn.Module):
    """A free logit for every two of K cells; the means of the codes are the cells themselves, one-hot, and without noise."""

    def __init__(self, cells):
        super().__init__()
        self.params = [torch.zeros(1, cells, cells, requires_grad=True)]
        self.encoder = lambda u: torch.cat([u, torch.full_like(u, -200.0)], dim=-1)

    def classifier(self, codes):
        exemplar, other, _ = codes.chunk(3, dim=-1)
        return ((exemplar @ self.params[0]) * other).sum(-1, keepdim=True)

    compare, losses, surprise = (getattr(decespg_ex2.ExemplarDiscriminator, name) for name in ("compare", "losses", "surprise"))


def table_novelty(cells, **args):
    bonus = novelty(dim=cells, kl_weight=0.0, **args)
    bonus.discriminator = Table(cells)
    bonus.optimizer = decespg_ex2.MaskedAdam(bonus.discriminator.params, 1, 0.05)
    return bonus


def test_a_free_table_finds_the_density_and_its_logarithm():
    """Five cells, the last one never visited; every exemplar meets every earlier pair, so that batches are expectations."""
    p = np.array([0.5, 0.3, 0.15, 0.05, 0.0])
    bonus = table_novelty(5)
    exemplars = np.repeat(np.eye(5, dtype=np.float32), 20, axis=0)
    earlier = np.tile(np.repeat(np.eye(5, dtype=np.float32), (20 * p).round().astype(int), axis=0), (5, 1))
    batch = [torch.from_numpy(each) for each in (exemplars, earlier, np.zeros((300, 5), np.float32))]
    bonus.draw = lambda pairs, lengths, fits: [each.expand(500, 1, -1, -1) for each in batch]
    bonus.fit(None, None, np.array([500]))
    values, _, overvisited = bonus.bonus(np.eye(5, dtype=np.float32)[:, None, None], np.array([5]))
    with torch.no_grad():
        d = torch.sigmoid(bonus.discriminator.params[0][0].diagonal()).numpy()
    assert d[:4] == pytest.approx(1 / (1 + p[:4]), abs=1e-4)
    assert d[:4] == pytest.approx([0.667, 0.769, 0.870, 0.952], abs=6e-4)
    assert (1 - d[:4]) / d[:4] == pytest.approx(p[:4], abs=1e-3)
    assert values[:4, 0, 0] == pytest.approx(-np.log(p[:4]), abs=1e-3)
    assert values[4, 0, 0] > values[3, 0, 0] + 2
    assert overvisited == [0]


def test_the_bonus_of_what_was_never_visited_rises_to_11_5():
    bonus, cells = table_novelty(CODE), np.eye(CODE, dtype=np.float32)
    bonus.optimizer.learning_rate = 5.0  # the nearer D comes to 1, the less do the gradients move it
    bonus.remember(cells[[1] * 40][:, None, None], np.array([40]))
    bonus.remember = lambda pairs, lengths: None
    values, cross_entropy, _ = bonus.bonus(cells[[0] * 250][:, None, None], np.array([250]))
    assert values == pytest.approx(HIGHEST, abs=1e-5)
    assert cross_entropy < 0.05


def test_the_bonus_lies_between_0_and_11_5(monkeypatch):
    monkeypatch.setattr(decespg_ex2, "CODE", 3)
    bonus = table_novelty(3)
    bonus.optimizer.learning_rate = 0.0
    with torch.no_grad():
        bonus.discriminator.params[0][0] += torch.diag(torch.tensor([-3.0, 2.0, 40.0]))
    bonus.visits[:] = 1
    values, _, overvisited = bonus.bonus(np.eye(3, dtype=np.float32)[:, None, None], np.array([3]))
    assert values[:, 0, 0] == pytest.approx([0, 2, 11.512915], abs=1e-5)
    assert overvisited == pytest.approx([1 / 3])


def test_the_rarer_a_pair_is_the_higher_is_its_bonus():
    """The networks themselves: cells of four frequencies, then episodes with a fifth that is always new (nothing is kept)."""
    rng, p, bonus = np.random.default_rng(0), [0.5, 0.3, 0.15, 0.05], novelty(dim=5, min_replay=100, steps_per_fit=8)

    def judge(cells):
        values = bonus.bonus(np.eye(5, dtype=np.float32)[cells][:, None, None], np.array([800]))[0][:, 0, 0]
        return np.array([values[cells == cell].mean() for cell in np.unique(cells)])

    for _ in range(13):
        found = judge(rng.choice(4, p=p, size=800))
    assert found == pytest.approx(-np.log(p), abs=1.0)
    assert found.argsort().tolist() == [0, 1, 2, 3]
    bonus.remember = lambda pairs, lengths: None
    for _ in range(3):
        found = judge(np.where(np.arange(800) % 10, rng.choice(4, p=p, size=800), 4))
    assert found.argsort().tolist() == [0, 1, 2, 3, 4]
    assert found[4] > found[3] + 0.3


# --- the buffer, privacy, the start ---


@pytest.mark.parametrize("lengths", [[3, 3, 3, 3], [7, 1], [1, 23, 2], [10, 5]])
def test_the_buffer_keeps_the_last_pairs_in_a_ring(lengths):
    bonus = novelty(trials=2, windows=2, dim=1, buffer_size=5)
    seen = np.zeros(5)
    visit = 0
    for length in lengths:
        now = np.arange(visit, visit + length, dtype=np.float32)
        both = np.full((length + 2, 2, 2, 1), np.nan, np.float32)
        both[:length, 0, 0, 0], both[:length, 0, 1, 0], both[: length + 1, 1] = now, 100 + now, 7.0
        bonus.remember(both, np.array([length, length + 1]))
        for value in now:
            seen[int(value) % 5] = value
        visit += length
    assert bonus.buffer[0, 0, :, 0].tolist() == seen.tolist()
    kept = min(visit, 5)
    assert bonus.buffer[0, 1, :kept, 0].tolist() == (100 + seen[:kept]).tolist()
    assert bonus.visits.tolist() == [visit, visit + len(lengths)]
    assert set(bonus.buffer[1].ravel()) <= {0.0, 7.0}


def test_there_is_no_bonus_before_min_replay_earlier_pairs():
    bonus = novelty(trials=3, windows=2, min_replay=20, steps_per_fit=5)
    rng = np.random.default_rng(0)
    weights = [param.detach().clone() for param in bonus.discriminator.params]
    played = [((10, 9, 1), (0, 0, 0)), ((10, 10, 2), (0, 0, 0)), ((10, 2, 30), (2, 0, 0)), ((4, 5, 7), (0, 1, 2))]
    for lengths, fits in played:
        before = bonus.optimizer.count.copy()
        values, cross_entropy, _ = bonus.bonus(rng.random((30, 3, 2, 4), np.float32), np.array(lengths))
        assert (bonus.optimizer.count - before).tolist() == [*fits]
        for k in range(3):
            fitted = bonus.optimizer.count[k] > 0
            assert values[:, k].any() <= fitted
            assert (cross_entropy[k] == np.log(2)) == (not fitted)
            if not fitted:
                nets = slice(2 * k, 2 * k + 2)
                for old, new in zip(weights, bonus.discriminator.params, strict=True):
                    assert torch.equal(old[nets], new[nets])


def test_between_fits_the_discriminators_rest_and_go_on_to_judge():
    bonus, rng = novelty(trials=2, windows=2, min_replay=5, steps_per_fit=8), np.random.default_rng(0)
    episode, lengths = rng.random((9, 2, 2, 4), np.float32), np.array([9, 7])
    for _ in range(3):
        expected, cross_entropy, _ = map(np.copy, bonus.bonus(episode, lengths))
    assert bonus.optimizer.count.tolist() == [2, 2]  # after 16 and 24 steps; 8 steps came before min_replay
    states = [generator.bit_generator.state for generator in bonus.learn]
    found, entropy_then, _ = bonus.bonus(episode, np.array([4, 2]))  # 31 and 23 steps in all
    assert np.array_equal(found[:4, 0], expected[:4, 0])
    assert np.array_equal(found[:2, 1], expected[:2, 1])
    assert np.array_equal(entropy_then, cross_entropy)
    assert states == [generator.bit_generator.state for generator in bonus.learn]
    assert bonus.optimizer.count.tolist() == [2, 2]
    assert bonus.visits.tolist() == [31, 23]


def test_the_bonus_of_a_pair_can_be_asked_for_without_recording_a_visit():
    bonus, rng = novelty(trials=2, windows=2, min_replay=5), np.random.default_rng(0)
    for lengths in ([6, 2], [9, 7]):  # the second trial has too few earlier pairs
        episode = rng.random((9, 2, 2, 4), np.float32)
        expected, *_ = bonus.bonus(episode, np.array(lengths))
    before = [torch.as_tensor(array).detach().clone() for array in bonus.state]
    found = bonus.at(episode.transpose(1, 2, 0, 3)).transpose(2, 0, 1)
    assert all(map(torch.equal, before, map(torch.as_tensor, bonus.state)))
    assert found == pytest.approx(expected, abs=1e-6)
    assert found[:, 0].any()
    assert not found[:, 1].any()


@pytest.mark.parametrize("changed", [0, 1, 2, 3])
def test_windows_and_trials_are_private(changed):
    rng = np.random.default_rng(1)
    one, other = (novelty(trials=2, windows=2, min_replay=5) for _ in range(2))
    k, i = divmod(changed, 2)
    for _ in range(4):
        episode, lengths = rng.random((12, 2, 2, 4), np.float32), np.array([12, 9])
        elsewhere = episode.copy()
        elsewhere[:, k, i] = rng.random((12, 4))
        found, expected = other.bonus(elsewhere, lengths)[0], one.bonus(episode, lengths)[0]
        same = np.ones((2, 2), bool)
        same[k, i] = False
        assert np.array_equal(found[:, same], expected[:, same])
    for mine, others in zip(one.discriminator.params, other.discriminator.params, strict=True):
        assert [torch.equal(*nets) for nets in zip(mine, others, strict=True)] == [net != changed for net in range(4)]


def test_the_discriminators_weights_are_drawn_after_the_actors(tmp_path):
    trained = train(decespg_ex2, tmp_path, env="pushbox", seed=4, num_trials=2, num_episodes=1)
    fresh = generators(*(np.random.SeedSequence(seed).spawn(3)[0] for seed in (4, 5)))
    decespg_ex2.StackedMLP(fresh, 2, [5, 64, 32, 4])
    expected = decespg_ex2.ExemplarDiscriminator(fresh, 2, 9).params
    assert all(map(torch.equal, trained.novelty.discriminator.params, expected))
    shapes = [tuple(param.shape) for param in expected]
    assert shapes[:4] == [(4, 9, 32), (4, 1, 32), (4, 32, 16), (4, 1, 16)]
    assert shapes[4:] == [(4, 24, 32), (4, 1, 32), (4, 32, 1), (4, 1, 1)]


# --- the policies ---


@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_update_climbs_along_the_reward_with_the_bonus_and_the_memory(env, tmp_path, monkeypatch):
    episodes, updates = watch(monkeypatch), record_all_updates(decespg_ex2, monkeypatch)
    args = dict(env=env, seed=2, num_trials=2, num_episodes=30, max_steps=10, min_replay=40, steps_per_fit=5)
    train(decespg_ex2, tmp_path, **args, learning_rate=0.02, gamma=0.9, beta=0.5, slots=1000)
    policy_shapes = [param.shape for param in updates[0].params]
    updates = [update for update in updates if [param.shape for param in update.params] == policy_shapes]
    assert len(updates) == len(episodes) == 30
    kept = [[], []]
    for update, episode in zip(updates, episodes, strict=True):
        rollout, steps_of = update.rollout, []
        for k, length in enumerate(rollout.lengths):
            obs, actions, reward = rollout.all_obs[:length, k], rollout.actions[:length, k], rollout.reward[:length, k, 0]
            kept[k].append((obs, actions, np.array(plain_returns(reward, 0.9))))
            for i in range(2):
                own = np.concatenate([np.eye(episode.pairs.shape[-1] - obs.shape[-1])[actions[:, i]], obs[:, i]], axis=1)
                assert np.array_equal(episode.pairs[:length, k, i], own.astype(np.float32))
                returns = plain_returns(reward + 0.5 * episode.bonus[:length, k, i], 0.9)
                steps = [(obs[t, i], actions[t, i], returns[t] / length) for t in range(length)]
                steps_of.append(steps + memory_steps(kept[k], i))
        assert_same_direction(update.direction, update.params, steps_of)
    assert episodes[-1].bonus.max() > 0.1


@each_setting
def test_without_bonus_and_memory_it_is_pg_bit_for_bit(env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=50, max_steps=40, learning_rate=1e-3)
    plain = train(pg, tmp_path / "pg", **args)
    assert_same_run(plain, train(decespg_ex2, tmp_path / "ex2", **args, beta=0.0, slots=0, min_replay=200))
