"""SPG, EPG, ESPG and DecESPG: PG with the memory, a bonus or both, against the paper's equations, and without them."""

import numpy as np
import pytest

from algos import pg
from tests.helpers import (
    assert_same_direction,
    assert_same_run,
    curves,
    dense_eta,
    each_setting,
    memory_steps,
    pairs,
    plain_returns,
    record_updates,
    script,
    train,
)

CENTRAL, PRIVATE = "one window for the team", "a window for each agent"
BONUS = {"spg": None, "epg": CENTRAL, "espg": CENTRAL, "decespg": PRIVATE}
MEMORY = {"spg": True, "epg": False, "espg": True, "decespg": True}
WORLDS = {  # what to play in short runs, and with how many agents
    "findtreasure": (dict(env="findtreasure"), 2),
    "pushbox": (dict(env="pushbox"), 2),
    "three agents": (dict(env="cleaner", env_args=("num_agents=3", "size=5"), hidden=(8,)), 3),
}


def own_args(name, beta, slots, **kernel):
    """The arguments of those parts that a script has."""
    return {**(dict(beta=beta, **kernel) if BONUS[name] else {}), **(dict(slots=slots) if MEMORY[name] else {})}


@pytest.mark.parametrize("name", BONUS)
@pytest.mark.parametrize("world", WORLDS)
def test_every_update_climbs_along_equations_14_to_16(name, world, tmp_path, monkeypatch):
    """30 updates of the script against Algorithm 1 written with lists, dense solves and one score at a time."""
    updates = record_updates(script(name), monkeypatch)
    trials, gamma, beta, slots, kernel = 2, 0.9, 0.7, 2, dict(window=5, sigma=0.9, noise=0.2)
    args, agents = WORLDS[world]
    args = dict(args, seed=2, num_trials=trials, num_episodes=30, max_steps=10, learning_rate=0.02, log_every=1, gamma=gamma)
    log = train(script(name), tmp_path, **args, **own_args(name, beta, slots, **kernel)).log
    assert len(updates) == 30
    num_actions = log.world.num_actions
    kernel["sigma"] *= log.world.cell
    sharing = {None: [], CENTRAL: [range(agents)], PRIVATE: [[i] for i in range(agents)]}[BONUS[name]]  # agents of each window
    visited = {}
    kept = [{} for _ in range(trials)]
    replaced = 0
    shown = [curves(tmp_path / f"seed{2 + k}") for k in range(trials)]
    for n, (rollout, params, direction) in enumerate(updates):
        steps_of = []
        for k, length in enumerate(rollout.lengths):
            obs, actions, reward = rollout.all_obs[:length, k], rollout.actions[:length, k], rollout.reward[:length, k, 0]
            bonus, etas = np.zeros((agents, length)), []
            for w, members in enumerate(sharing):
                now = np.concatenate([pairs(obs[:, i], actions[:, i], num_actions) for i in members], axis=1)
                past = visited[k, w] = np.concatenate([visited.get((k, w), now[:0]), now])
                etas.append([dense_eta(past, len(past) - length + t, **kernel) for t in range(length)])
                bonus[members] = -np.log(np.clip(etas[-1], 1e-3, 1))
            if sharing:
                etas = np.array(etas)
                for tag, values in dict(bonus=bonus, unvisited=etas < 1e-3, overvisited=etas > 1).items():
                    value = values.mean()
                    assert shown[k][f"charts/{tag}"][n][1] == pytest.approx(value, abs=1e-6)

            episode = obs, actions, np.array(plain_returns(reward, gamma))
            best = kept[k].setdefault(int(rollout.outcomes[k]), [])
            worst = min(range(len(best)), key=lambda slot: best[slot][2][0], default=None)
            if len(best) < slots:
                best.append(episode)
            elif episode[2][0] > best[worst][2][0]:
                best[worst] = episode
                replaced += 1
            stored = [one for episodes in kept[k].values() for one in episodes] if MEMORY[name] else []
            for i in range(agents):
                returns = plain_returns(reward + beta * bonus[i], gamma)
                own = [(obs[t, i], actions[t, i], returns[t] / length) for t in range(length)]
                steps_of.append(own + memory_steps(stored, i))
        assert_same_direction(direction, params, steps_of)
    if world == "pushbox" and MEMORY[name]:
        assert min(len(outcomes) for outcomes in kept) >= 2
        assert replaced >= 3


@pytest.mark.parametrize("name", BONUS)
@each_setting
def test_without_bonus_and_memory_it_is_pg_bit_for_bit(name, env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, seed=5, num_trials=2, num_episodes=150, learning_rate=1e-3)
    plain = train(pg, tmp_path / "pg", **args)
    assert_same_run(plain, train(script(name), tmp_path / name, **args, **own_args(name, beta=0.0, slots=0)))


def bonuses(module, directory, **args):
    """What every call of `VisitNovelty.bonus` in a run returns, [T, num_trials, num_windows]."""
    seen = []

    class WatchedNovelty(module.VisitNovelty):
        def bonus(self, pairs, lengths):
            values, *shares = super().bonus(pairs, lengths)
            seen.append(values)
            return values, *shares

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "VisitNovelty", WatchedNovelty)
        train(module, directory, learning_rate=0.0, **args)
    return seen


@pytest.mark.parametrize("name", [name for name, bonus in BONUS.items() if bonus])
def test_the_bonus_of_a_pair_can_be_asked_for_without_recording_a_visit(name, tmp_path):
    kernel = dict(window=7, sigma=0.9, noise=0.2)
    args = dict(env="findtreasure", num_trials=2, num_episodes=2, max_steps=3)
    team = train(script(name), tmp_path, **args, **own_args(name, beta=0.1, slots=1, **kernel))
    novelty, rng = team.novelty, np.random.default_rng(0)
    before = [array.copy() for array in novelty.state]
    trials, windows, dim, _ = novelty.pairs.shape
    asked = rng.random((trials, windows, 4, dim)).astype(np.float32)
    asked[:, :, 0] = novelty.pairs[:, :, :, 1]
    found = novelty.at(asked)
    assert all(map(np.array_equal, before, novelty.state))
    for k, w in np.ndindex(trials, windows):
        held = novelty.visits[k]
        past = novelty.pairs[k, w].T[:held].astype(np.float32)
        for n in range(4):
            eta = dense_eta(np.concatenate([past, asked[k, w, n : n + 1]]), held, **{**kernel, "sigma": novelty.sigma})
            assert found[k, w, n] == pytest.approx(-np.log(np.clip(eta, 1e-3, 1)), abs=1e-8)
    assert found[:, :, 0].max() < found[:, :, 1:].min()


@pytest.mark.parametrize("name", [name for name, bonus in BONUS.items() if bonus])
@pytest.mark.parametrize("env", ["findtreasure", "pushbox"])
def test_exchanging_agents_exchanges_private_bonuses_and_leaves_the_central_one(name, env, tmp_path, monkeypatch):
    module, args = script(name), dict(env=env, num_trials=2, num_episodes=10, max_steps=30)
    before = bonuses(module, tmp_path / "before", **args)

    class ExchangedRollout(module.Rollout):
        def play(self, *args):
            super().play(*args)
            self.all_obs[:], self.actions[:] = self.all_obs[:, :, ::-1].copy(), self.actions[:, :, ::-1].copy()

    monkeypatch.setattr(module, "Rollout", ExchangedRollout)
    after = bonuses(module, tmp_path / "after", **args)
    for values, exchanged in zip(before, after, strict=True):
        assert values.shape[2] == (2 if BONUS[name] == PRIVATE else 1)
        assert np.allclose(exchanged, values[:, :, ::-1], rtol=0, atol=1e-12)
        if BONUS[name] == PRIVATE:
            assert not np.allclose(values[:, :, 0], values[:, :, 1])
