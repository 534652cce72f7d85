"""IPPO, and MAPPO where it is the same: advantages, clipping and normalisation against closed forms, every step of every update
against plain loops, and learning."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from algos import ac, ippo, mappo, pg
from tests.helpers import (
    assert_same_direction,
    assert_same_run,
    curves,
    plain_logits,
    plain_returns,
    record_rollouts,
    train,
    weights,
)

each_module = pytest.mark.parametrize("module", [ippo, mappo], ids=["ippo", "mappo"])


# --- advantages ---


def random_batch():
    """Rows of three trials with 3, 1 and 2 episodes, as in `EpisodeBatch`; nothing that must not count is a number.

    Returns reward, values, played, terminated and count, and (trial, first row, number of steps, whether terminated) of each.
    """
    rng, episodes, first = np.random.default_rng(0), [], 0
    reward, values = np.full((60, 3), np.nan), np.full((60, 3, 2), np.nan)
    played, terminated, count = np.zeros((60, 3), bool), np.zeros((60, 3), bool), np.zeros(3, int)
    for k, ends in enumerate([[(1, True), (17, False), (30, True)], [(1, False)], [(30, False), (2, True)]]):
        for steps, end in ends:
            first = count[k]
            episodes.append((k, first, steps, end))
            reward[first : first + steps, k] = rng.normal(size=steps)
            values[first : first + steps + (not end), k] = rng.normal(size=(steps + (not end), 2))
            played[first : first + steps, k], terminated[first + steps, k] = True, end
            count[k] += steps + 1
    return (reward, values, played, terminated, count), episodes


def plain_gae(reward, values, end, gamma, gae_lambda):
    """sum_l (gamma lambda)^l delta_{t+l} of one agent's episode: reward of T steps, values of T + 1 observations."""
    following = [*values[1:-1], 0.0 if end else values[-1]]
    delta = [r + gamma * after - now for r, now, after in zip(reward, values[:-1], following, strict=True)]
    return plain_returns(delta, gamma * gae_lambda)


@pytest.mark.parametrize("gamma", [0.0, 0.95, 1.0])
@pytest.mark.parametrize("gae_lambda", [0.0, 0.5, 0.95, 1.0])
def test_advantages_are_the_double_sum(gamma, gae_lambda):
    batch, episodes = random_batch()
    advantages = ippo.gae(*batch, gamma, gae_lambda)
    for k, first, steps, end in episodes:
        for i in range(2):
            reward, values = batch[0][first : first + steps, k], batch[1][first : first + steps + 1, k, i]
            expected = plain_gae(reward, values, end, gamma, gae_lambda)
            assert advantages[first : first + steps, k, i] == pytest.approx(expected, abs=1e-12)
    assert not advantages[~batch[2]].any()


def test_known_advantages():
    reward, values = np.array([[1.0, 1.0], [2.0, 2.0], [0.0, 0.0]]), np.array([[10.0], [20.0], [40.0]]).repeat(2, 1)[..., None]
    played, terminated = np.array([[True, True], [True, True], [False, False]]), np.array([[False] * 2] * 2 + [[False, True]])
    advantages = ippo.gae(reward, values, played, terminated, np.array([3, 3]), 0.5, 0.5)
    assert advantages[:, :, 0].T.tolist() == [[1.5, 2, 0], [-3.5, -18, 0]]  # cut, terminated


@pytest.mark.parametrize("gae_lambda", [0.0, 1.0])
def test_advantages_at_the_limits_of_lambda(gae_lambda):
    """0: the errors of ac.py. 1: what the episode returns, with the last value where it is cut, minus the value."""
    batch, episodes = random_batch()
    advantages = ippo.gae(*batch, 0.9, gae_lambda)
    for k, first, steps, end in episodes:
        reward, values = batch[0][first : first + steps, k], batch[1][first : first + steps + 1, k, :1]
        if gae_lambda == 0:
            lengths, terminated = np.array([steps]), np.array([end])
            expected = ac.td_errors(reward[:, None], np.nan_to_num(values), lengths, terminated, 0.9)[:, 0]
        else:
            tail = 0.0 if end else values[-1, 0]
            expected = np.array(plain_returns([*reward, tail], 0.9))[:-1] - values[:-1, 0]
        assert advantages[first : first + steps, k, 0] == pytest.approx(expected, abs=1e-12)


def test_standardised_advantages_have_mean_0_and_standard_deviation_1_in_every_trial():
    (_, _, played, _, count), _ = random_batch()
    advantages = np.random.default_rng(1).normal(3, 7, size=(60, 3, 2)) * [1, 100]
    advantages[:, 1] = 5.0  # all alike: there is nothing to tell apart
    standardised = ippo.standardised(advantages, (played / played.sum(0))[:, :, None])
    for k in (0, 2):
        own = standardised[played[:, k], k]
        assert len(own) == played[:, k].sum() < count[k]
        assert own.mean(0) == pytest.approx([0, 0], abs=1e-12)
        assert own.std(0) == pytest.approx([1, 1], abs=1e-6)
        assert (own.mean(), own.std()) == pytest.approx((0, 1), abs=1e-6)
    assert np.abs(standardised[played[:, 1], 1]).max() < 1e-6


# --- clipping ---


def test_the_objective_has_no_slope_where_the_ratio_has_gone_far_enough():
    ratio = torch.tensor([0.5, 0.79, 0.81, 1.0, 1.19, 1.21, 3.0], dtype=torch.double)
    for advantage, alive in ((2.0, ratio < 1.2), (-2.0, ratio > 0.8)):
        moved = ratio.clone().requires_grad_()
        ippo.clipped_objective(moved, torch.tensor(advantage), 0.2).sum().backward()
        assert moved.grad.tolist() == [advantage * float(each) for each in alive]
    clipped = ippo.clipped_objective(ratio, torch.tensor([2.0, 2, 2, -2, -2, -2, -2]), 0.2)
    assert clipped.tolist() == pytest.approx([1, 1.58, 1.62, -2, -2.38, -2.42, -6])


def test_a_value_has_no_slope_where_it_has_gone_far_enough_towards_its_target():
    before, outputs = torch.zeros(6, dtype=torch.double), torch.tensor([-0.3, -0.1, 0.1, 0.3, 0.3, 0.7], dtype=torch.double)
    targets = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 0.4], dtype=torch.double)
    moved = outputs.clone().requires_grad_()
    squares = ippo.clipped_squares(moved, before, targets, 0.2)
    squares.sum().backward()
    # away from the target or not yet far enough: alive; 0.3 > 0.2 towards 1: dead; too far from 0, or beyond 0.4: alive
    assert moved.grad.tolist() == pytest.approx([-2.6, -2.2, -1.8, 0, 0.6, 0.6])
    assert squares.tolist() == pytest.approx([1.69, 1.21, 0.81, 0.64, 0.09, 0.09])


@each_module
def test_a_step_clips_the_gradient_of_every_network_by_itself(module):
    """Beside torch's own clipping, which takes all that it is given as one network."""
    networks = module.StackedMLP([np.random.default_rng(seed) for seed in range(2)], 2, [3, 8, 2])
    x, scale = torch.randn(4, 5, 3, generator=torch.manual_seed(0)), torch.tensor([1e-2, 1.0, 1e3, 1e5])[:, None, None]
    optimizer = torch.optim.Adam(networks.params, lr=0.1)
    alone = [[param[net : net + 1].detach().clone().requires_grad_() for param in networks.params] for net in range(4)]
    adams, norms = [torch.optim.Adam(params, lr=0.1) for params in alone], []
    for _ in range(3):
        module.clipped_step(optimizer, (scale * networks(x)).square().mean((1, 2)).sum())
        for net, (params, adam) in enumerate(zip(alone, adams, strict=True)):
            network = module.StackedMLP([], 0, [])
            network.params = params
            adam.zero_grad()
            (scale[net] * network(x[net : net + 1])).square().mean().backward()
            norms.append(float(torch.nn.utils.clip_grad_norm_(params, module.MAX_GRAD_NORM)))
            adam.step()
            for one, all_networks in zip(params, networks.params, strict=True):
                assert torch.allclose(one[0], all_networks[net], atol=1e-5)
    assert min(norms) < module.MAX_GRAD_NORM < max(norms)


# --- value normalisation ---


def test_the_running_moments_are_the_weighted_mean_of_all_targets():
    rng, normalizer = np.random.default_rng(2), ippo.ValueNormalizer(3, 2)
    assert [array.tolist() for array in normalizer.mean_and_std()] == [[[0, 0]] * 3, [[0.1, 0.1]] * 3]
    seen = []
    for update in range(5):
        targets, share = rng.normal(40 * update, 5, size=(30, 3, 2)), rng.dirichlet(np.ones(30), size=3).T[:, :, None]
        normalizer.learn(targets, share)
        seen.append(((share * targets).sum(0), (share * targets**2).sum(0)))
        decay = ippo.MOMENTS_DECAY ** np.arange(update, -1, -1)
        mean, square = (np.tensordot(decay / decay.sum(), moments, 1) for moments in zip(*seen, strict=True))
        found, std = normalizer.mean_and_std()
        assert np.allclose(found, mean, rtol=1e-9)
        assert np.allclose(std, np.sqrt(square - mean**2), rtol=1e-6)
    values = rng.normal(size=(30, 3, 2))
    assert np.allclose(normalizer.normalize(values), (values - mean) / std)
    assert np.allclose(normalizer.denormalize(normalizer.normalize(values)), values)


def test_targets_that_are_all_alike_have_the_smallest_standard_deviation():
    normalizer = ippo.ValueNormalizer(1, 1)
    normalizer.learn(np.full((4, 1, 1), 7.0), np.full((4, 1, 1), 0.25))
    mean, std = normalizer.mean_and_std()
    assert (mean.item(), std.item()) == pytest.approx((7, 0.1), abs=1e-9)


# --- whole runs ---


def record_steps(module, monkeypatch):
    """The rollouts of a run, and lists of the steps of policies and of critics: the networks before each, and its direction."""
    rollouts, steps, clipped_step = record_rollouts(module, monkeypatch), ([], []), module.clipped_step

    def watched_step(optimizer, loss):
        params = optimizer.param_groups[0]["params"]
        grads = torch.autograd.grad(loss, params, retain_graph=True)
        of_critics = params[0] is not rollouts[-1].params[0]
        copies = weights(SimpleNamespace(params=params))
        steps[of_critics].append(SimpleNamespace(params=copies, direction=[-grad for grad in grads], number=len(rollouts)))
        clipped_step(optimizer, loss)

    monkeypatch.setattr(module, "clipped_step", watched_step)
    return rollouts, *steps


def seen_by_critic(module, world, rollout, t, k, i):
    """What agent i's critic sees at step t of trial k, T for the end."""
    state = [] if module is ippo else rollout.states[t, k] * world.state_scale
    return np.concatenate([state, rollout.all_obs[t, k, i]]).astype(np.float32)


def outputs_of(params, net, inputs):
    """What network `net` says to several inputs, in double precision, [number, out], and its weights."""
    own = [param[net].double().requires_grad_() for param in params]
    return torch.stack([plain_logits(own, x) for x in inputs]), own


class PlainBatch:
    """The episodes of one agent between two updates, and what follows from them by plain loops."""

    def __init__(self, module, world, rollouts, critic, net, moments, gamma, gae_lambda):
        k, i = divmod(net, world.num_agents)
        self.obs, self.actions, self.seen, values, self.advantages = [], [], [], [], []
        mean, std = moments
        for rollout in rollouts:
            length = rollout.lengths[k]
            seen = [seen_by_critic(module, world, rollout, t, k, i) for t in range(length + 1)]
            value = mean + std * outputs_of(critic, net, seen)[0][:, 0].detach().numpy()
            gains = plain_gae(rollout.reward[:length, k, i], value, rollout.outcomes[k] > 0, gamma, gae_lambda)
            self.obs += list(rollout.all_obs[:length, k, i])
            self.actions += list(rollout.actions[:length, k, i])
            self.seen, self.advantages = self.seen + seen[:-1], self.advantages + gains
            values += list(value[:-1])
        self.values = np.array(values)
        self.targets = self.values + self.advantages
        self.standardised = (self.advantages - np.mean(self.advantages)) / np.std(self.advantages)


def assert_gradient(direction, net, loss, own):
    """The direction of one network is down the gradient of the loss."""
    for found, expected in zip(direction, torch.autograd.grad(loss, own), strict=True):
        assert np.allclose(found[net], -expected, rtol=1e-4, atol=1e-5 * max(1.0, float(expected.abs().max())))


@each_module
@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_every_step_of_every_update(module, env, tmp_path, monkeypatch):
    """Two updates of three epochs, with steps so long that ratios and values reach the clip."""
    rollouts, policies, critics = record_steps(module, monkeypatch)
    args = dict(env=env, seed=1, num_trials=2, num_episodes=7, max_steps=15, gamma=0.9, gae_lambda=0.8, log_every=1)
    args |= dict(learning_rate=0.03, entropy_coef=0.5, clip=0.1, episodes_per_update=3, num_epochs=3)
    trained = train(module, tmp_path, **args)
    world = trained.log.world
    assert [step.number for step in policies] == [step.number for step in critics] == [3, 3, 3, 6, 6, 6]
    shown, ends, clipped, far = [curves(tmp_path / f"seed{1 + k}") for k in range(2)], set(), [], []
    history = [[] for _ in range(4)]  # the moments of each network's targets
    for update in range(2):
        played, steps = rollouts[3 * update : 3 * update + 3], slice(3 * update, 3 * update + 3)
        ends |= {bool(outcome) for rollout in played for outcome in rollout.outcomes}
        figures = np.zeros((4, 5))
        for net in range(4):
            moments = (0.0, 0.1) if update == 0 else moments_of(history[net])
            batch = PlainBatch(module, world, played, critics[steps][0].params, net, moments, 0.9, 0.8)
            history[net].append((batch.targets.mean(), (batch.targets**2).mean()))
            mean, std = moments_of(history[net])
            targets, gains = (torch.from_numpy(x) for x in ((batch.targets - mean) / std, batch.standardised))
            taken = torch.tensor(np.array(batch.actions))[:, None]
            before = outputs_of(critics[steps][0].params, net, batch.seen)[0][:, 0].detach()
            log_probs_before = torch.log_softmax(outputs_of(policies[steps][0].params, net, batch.obs)[0], 1).gather(1, taken)
            for policy, critic in zip(policies[steps], critics[steps], strict=True):
                logits, own = outputs_of(policy.params, net, batch.obs)
                log_probs = torch.log_softmax(logits, 1)
                ratio = (log_probs.gather(1, taken) - log_probs_before.detach()).exp()[:, 0]
                surrogate = torch.minimum(ratio * gains, ratio.clip(0.9, 1.1) * gains)
                loss = -(surrogate + 0.5 * -(log_probs.exp() * log_probs).sum(1)).mean()
                assert_gradient(policy.direction, net, loss, own)
                outputs, own = outputs_of(critic.params, net, batch.seen)
                near = before + (outputs[:, 0] - before).clip(-0.1, 0.1)
                squares = torch.maximum((outputs[:, 0] - targets) ** 2, (near - targets) ** 2)
                assert_gradient(critic.direction, net, squares.mean(), own)
            clipped.append(float(((ratio - 1).abs() > 0.1).double().mean().detach()))
            far.append(float(((outputs[:, 0] - before).abs() > 0.1).double().mean().detach()))
            kl = float((ratio - 1 - ratio.log()).mean().detach())
            figures[net] = float(loss.detach()), batch.values.mean(), np.mean(np.square(batch.advantages)), kl, clipped[-1]
        for k in range(2):
            loss, value, square, kl, fraction = figures[2 * k : 2 * k + 2].mean(0)
            expected = dict(value=value, advantage=np.sqrt(square), kl=kl, clip_fraction=fraction)
            expected = {f"charts/{name}": number for name, number in expected.items()} | {"losses/policy_loss": 2 * loss}
            for tag, number in expected.items():
                for episode in range(3 * update + 2, min(3 * update + 5, 7)):  # shown until the next update
                    assert shown[k][tag][episode][1] == pytest.approx(number, rel=1e-4, abs=1e-5), tag
    assert 0 < np.mean(clipped) < 1
    assert 0 < np.mean(far) < 1
    assert ends == ({True, False} if env == "pushbox" else {False})


def moments_of(history):
    """Mean and standard deviation that an agent's critic has after updates whose targets had these means and mean squares."""
    decay = ippo.MOMENTS_DECAY ** np.arange(len(history) - 1, -1, -1)
    mean, square = np.average(history, axis=0, weights=decay)
    return mean, np.sqrt(max(square - mean**2, 0.01))


@each_module
def test_the_first_step_is_along_the_policy_gradient(module, tmp_path, monkeypatch):
    """At ratio 1 and without entropy: 1/N sum_t A_t grad log pi(a_t | o_t), A standardised, however narrow the clip is."""
    rollouts, policies, critics = record_steps(module, monkeypatch)
    args = dict(env="pushbox", seed=3, num_trials=2, num_episodes=4, max_steps=20, gamma=0.9, gae_lambda=0.5)
    world = train(module, tmp_path, **args, entropy_coef=0.0, clip=0.01, episodes_per_update=4, num_epochs=1).log.world
    (policy,), (critic,) = policies, critics
    steps_of = []
    for net in range(4):
        batch = PlainBatch(module, world, rollouts, critic.params, net, (0.0, 0.1), 0.9, 0.5)
        weight = batch.standardised / len(batch.obs)
        steps_of.append(list(zip(batch.obs, batch.actions, weight, strict=True)))
    assert_same_direction(policy.direction, policy.params, steps_of)


@each_module
def test_policies_and_critics_have_one_adam_each_for_the_whole_run(module, tmp_path, monkeypatch):
    _, *both = record_steps(module, monkeypatch)
    args = dict(env="pushbox", num_trials=2, num_episodes=12, max_steps=10, episodes_per_update=4, num_epochs=3)
    trained = train(module, tmp_path, **args, learning_rate=1e-2)
    for steps, last in zip(both, (trained.policy, trained.critic), strict=True):
        reference = [param.clone() for param in steps[0].params]
        adam = torch.optim.Adam(reference, lr=1e-2, eps=1e-5)
        for step, following in zip(steps, [*(step.params for step in steps[1:]), last.params], strict=True):
            for param, direction in zip(reference, step.direction, strict=True):
                param.grad = -direction  # whose norm is far below the clip
            adam.step()
            assert all(torch.allclose(a, b, rtol=0, atol=1e-5) for a, b in zip(reference, following, strict=True))
        assert len(steps) == 9


@each_module
def test_policies_are_the_first_draws_and_wait_for_a_whole_batch(module, tmp_path):
    args = dict(env="pushbox", seed=4, num_trials=2, num_episodes=7)
    waiting = train(module, tmp_path / "waiting", **args, episodes_per_update=8)
    plain = train(pg, tmp_path / "pg", **args, learning_rate=0.0)
    assert all(map(torch.equal, waiting.policy.params, plain.policy.params))
    assert np.array_equal(waiting.log.returns, plain.log.returns)
    fresh = [np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]) for seed in (4, 5)]
    module.StackedMLP(fresh, 2, [5, 64, 32, 4])
    expected = module.StackedMLP(fresh, 2, [5 if module is ippo else 14, 64, 32, 1])
    assert all(map(torch.equal, waiting.critic.params, expected.params))
    assert waiting.batch.count.tolist() == (waiting.log.lengths.sum(1) + 7).tolist()


@each_module
def test_a_run_that_stops_between_two_updates_goes_on_with_the_episodes_that_it_had_kept(module, tmp_path, monkeypatch):
    args = dict(env="pushbox", num_trials=2, num_episodes=16, max_steps=20, learning_rate=0.03, checkpoint_every=0, log_every=4)
    whole = train(module, tmp_path / "whole", **args)
    with monkeypatch.context() as patch:
        patch.setattr(module.EpisodeBatch, "add", stop_in_episode(5, module.EpisodeBatch.add))
        with pytest.raises(KeyboardInterrupt):
            train(module, tmp_path / "stopped", **args)
    resumed = train(module, tmp_path / "stopped", **args, resume=True)
    assert_same_run(whole, resumed, parts=vars(whole).keys() - {"log"})
    assert resumed.figures.state[0].any()


def stop_in_episode(number, add):
    """`add` of a batch, but the call with this number, counted from 1, ends as Ctrl-C would."""
    calls = []

    def failing_add(*args):
        calls.append(args)
        if len(calls) == number:
            raise KeyboardInterrupt
        add(*args)

    return failing_add


def test_the_critics_of_a_loop_learn_that_the_time_limit_ends_nothing(tmp_path, monkeypatch):
    """Episodes of 5 steps in one place and reward 1, which are cut in the first trial and end in the second."""

    class Loop(ippo.Rollout):
        def play(self, params, generators):
            self._all_obs[:], self._obs[:, 0] = 0.5, 0.5
            self._states[:], self._rows[:], self._actions[:], self._reward[:] = 1, 0, 0, 1.0
            self.lengths[:], self.outcomes[:] = 5, [False, True]
            self._show(self._obs[:, :1])

    monkeypatch.setattr(ippo, "Rollout", Loop)
    args = dict(num_trials=2, num_episodes=800, max_steps=5, gamma=0.9, gae_lambda=0.0, learning_rate=1e-2)
    train(ippo, tmp_path, **args, episodes_per_update=2)
    # V = 1 + 0.9 V where the time limit cuts; V = 1 + 0.9 V in four of five steps, 1 in the fifth, where the world ends
    for k, value in enumerate([10, 1 / (1 - 0.9 * 4 / 5)]):
        assert curves(tmp_path / f"seed{1 + k}")["charts/value"][-1] == (4000, pytest.approx(value, abs=0.05))


# --- learning ---


@each_module
@pytest.mark.parametrize(
    ("options", "published", "worst"), [(("game=penalty", "penalty=0"), 10, 9.8), (("game=climbing",), 7, 5.8)]
)
def test_one_shot_games_end_where_they_did_in_print(module, options, published, worst, tmp_path):
    """10 and 7 for each step, of IPPO and of MAPPO (Papoudakis et al., 2021); here some teams even climb to 11."""
    args = dict(env="climbing", env_args=options, num_trials=6, num_episodes=2400, learning_rate=2e-3, entropy_coef=0.01)
    mean = train(module, tmp_path, **args).log.returns[:, -200:].mean(1)
    assert mean.mean() > published - 0.05
    assert mean.min() > worst


@each_module
def test_teams_find_the_treasure(module, tmp_path):
    log = train(module, tmp_path, env="findtreasure", num_trials=4, num_episodes=1000, learning_rate=3e-3).log
    assert ((log.outcomes[:, -50:] == 1).mean(1) > 0.9).all()
    assert log.means(slice(-50, None))["reward_per_step"].min() > 5
