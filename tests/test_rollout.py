"""Whole episodes: compiled play against a plain loop over the vector face, what a rollout holds, and other policies."""

import time

import numpy as np
import pytest
import torch

import envs
from algos import pg
from tests.helpers import use_double_precision

TRIALS = 3
LIMIT = {"gotogether": 60}


def world_of(name):
    return envs.make_world(name, max_steps=LIMIT.get(name, 40))


def generators(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def networks(world, seed=0, trials=TRIALS, hidden=(16, 8)):
    """Stacked policies that are far from uniform."""
    policy = pg.StackedMLP(
        generators(*range(seed, seed + trials)), world.num_agents, [world.obs_dim, *hidden, world.num_actions]
    )
    policy.params = [(3 * param).detach().requires_grad_() for param in policy.params]
    return policy


def plain_play(world, policy, uniforms, probabilities):
    """Play one world after the other through the vector face; a list with (obs, actions, reward, outcome, states, local)."""
    episodes = []
    for k in range(len(uniforms)):
        env = envs.GridVectorEnv(world, 1)
        obs, info = env.reset()
        seen, actions, rewards, states, local = [obs[0]], [], [], [env.states[0]], [info["local_state"][0]]
        over = False
        while not over:
            joint = []
            for i in range(world.num_agents):
                x = torch.as_tensor(seen[-1][i]).to(policy.params[0].dtype)
                for layer in range(0, len(policy.params), 2):
                    net = k * world.num_agents + i
                    x = (x if layer == 0 else x.clamp(min=0)) @ policy.params[layer][net] + policy.params[layer + 1][net, 0]
                bounds = np.cumsum(probabilities(x.detach().double().numpy()))
                joint.append(min(int((uniforms[k, len(actions), i] >= bounds).sum()), world.num_actions - 1))
            obs, reward, terminated, truncated, info = env.step(np.array([joint]))
            over = terminated[0] or truncated[0]
            for kept, new in zip((seen, actions, rewards), (obs[0], joint, reward[0]), strict=True):
                kept.append(new)
            states.append(env.states[0])
            local.append(info["local_state"][0])
        episodes.append(
            (np.array(seen), np.array(actions), np.array(rewards), info["outcome"][0], np.array(states), np.array(local))
        )
    return episodes


def uniforms_of(world, seeds):
    return np.array([np.random.default_rng(seed).random((world.max_steps, world.num_agents)) for seed in seeds])


def assert_same_episode(rollout, k, episode):
    """Trial k of a rollout is this episode of `plain_play`."""
    obs, actions, reward, outcome, states, local = episode
    length = rollout.lengths[k]
    assert length == len(actions)
    assert rollout.outcomes[k] == outcome
    assert rollout.terminated[k] == (outcome > 0)
    assert np.array_equal(rollout.actions[:length, k], actions)
    assert np.array_equal(rollout.all_obs[: length + 1, k], obs)
    assert np.array_equal(rollout.reward[:length, k], np.repeat(reward[:, None], rollout.reward.shape[2], axis=1))
    assert np.array_equal(rollout.states[: length + 1, k], states)
    assert np.array_equal(rollout.local_state[: length + 1, k], local)


def softmax(logits):
    weights = np.exp(logits - logits.max())
    return weights / weights.sum()


def epsilon_greedy(values):
    probs = np.full(len(values), 0.3 / len(values))
    probs[values.argmax()] += 0.7
    return probs


@pytest.mark.parametrize("name", envs.WORLDS)
@pytest.mark.parametrize(("head", "parameter", "plain"), [("softmax", 1.0, softmax), ("epsilon_greedy", 0.3, epsilon_greedy)])
def test_compiled_play_is_plain_play_action_for_action(name, head, parameter, plain):
    world = world_of(name)
    policy, rollout, act = networks(world), envs.Rollout(world, TRIALS, head=getattr(envs, head)), generators(5, 6, 7)
    rollout.play(policy.params, act, parameter)
    expected = plain_play(world, policy, uniforms_of(world, (5, 6, 7)), plain)
    for k, episode in enumerate(expected):
        assert_same_episode(rollout, k, episode)
    # The generators have gone on by a whole episode's uniforms, whatever its length.
    assert act[0].random() == np.random.default_rng(5).random(world.max_steps * world.num_agents + 1)[-1]


def test_networks_in_double_precision_play_too(monkeypatch):
    use_double_precision(pg, monkeypatch)
    world = world_of("pushbox")
    policy = pg.StackedMLP(generators(1), 2, [world.obs_dim, 16, world.num_actions])
    assert policy.params[0].dtype == torch.double
    rollout = envs.Rollout(world, 1)
    rollout.play(policy.params, generators(5))
    assert_same_episode(rollout, 0, plain_play(world, policy, uniforms_of(world, [5]), softmax)[0])


def test_the_likeliest_actions_are_played_greedily():
    world = world_of("findtreasure")
    policy, rollout = networks(world, seed=4), envs.Rollout(world, TRIALS, greedy=True)
    rollout.play(policy.params, generators(1, 2, 3))

    def certain(logits):
        return np.eye(len(logits))[logits.argmax()]

    for k, episode in enumerate(plain_play(world, policy, uniforms_of(world, (8, 9, 10)), certain)):
        assert_same_episode(rollout, k, episode)


@pytest.mark.parametrize("name", envs.WORLDS)
def test_a_trial_plays_what_it_plays_alone(name):
    world = world_of(name)
    policy, together, alone = networks(world), envs.Rollout(world, TRIALS), envs.Rollout(world, 1)
    together.play(policy.params, generators(5, 6, 7))
    own = [param[world.num_agents : 2 * world.num_agents] for param in policy.params]
    alone.play(own, generators(6))
    length = alone.lengths[0]
    assert length == together.lengths[1]
    assert np.array_equal(alone.actions[:, 0], together.actions[:length, 1])
    assert alone.entropy[0] == together.entropy[1]


@pytest.fixture
def played():
    """A rollout of pushbox whose trials have different lengths, and its policy."""
    world = world_of("pushbox")
    policy, rollout = networks(world), envs.Rollout(world, TRIALS)
    for seed in range(100):
        rollout.play(policy.params, generators(seed, seed + 1, seed + 2))
        if len(set(rollout.lengths)) == TRIALS and rollout.terminated.any():
            return rollout, policy
    raise AssertionError("no such episode")


def test_every_distinct_observation_is_there_once_and_rows_say_which(played):
    rollout, _ = played
    shown = envs.in_every_step(rollout.obs, rollout.rows)
    for k, length in enumerate(rollout.lengths):
        assert np.array_equal(shown[:length, k], rollout.all_obs[:length, k])
        for i in range(2):
            distinct = {obs.tobytes() for obs in rollout.all_obs[:length, k, i]}
            own = rollout.obs[2 * k + i]
            assert len(distinct) == rollout.rows[:length, k, i].max() + 1
            assert {obs.tobytes() for obs in own[: len(distinct)]} == distinct
            assert not own[len(distinct) :].any()
    assert rollout.obs.shape[1] == rollout.rows.max() + 1


def test_beyond_an_end_nothing_is_played_and_nothing_moves(played):
    rollout, _ = played
    longest = rollout.lengths.max()
    for name, steps in dict(rows=0, actions=0, reward=0, all_obs=1, states=1).items():
        assert len(getattr(rollout, name)) == longest + steps
    for k, length in enumerate(rollout.lengths):
        assert rollout.played[:, k].tolist() == [True] * length + [False] * (longest - length)
        for values in (rollout.rows, rollout.actions, rollout.reward):
            assert not values[length:, k].any()
        for values in (rollout.all_obs, rollout.states):
            assert (values[length:, k] == values[length, k]).all()


def test_the_global_state_is_the_vector_faces(played):
    rollout, _ = played
    env = envs.GridVectorEnv(rollout.world, TRIALS)
    _, info = env.reset()
    for t in range(len(rollout.actions)):
        assert np.array_equal(rollout.global_state[t], info["state"])
        assert np.array_equal(rollout.local_state[t], info["local_state"])
        *_, info = env.step(rollout.actions[t])
    assert np.array_equal(rollout.global_state[-1], info["state"])
    assert rollout.global_state.dtype == np.float32


def test_what_is_said_of_the_actions_taken_and_its_gradient(played):
    rollout, policy = played
    log_probs = torch.log_softmax(policy(rollout.obs), dim=-1)
    log_probs.retain_grad()
    taken = rollout.of_taken(log_probs)
    assert taken.dtype == torch.double
    weights = np.random.default_rng(0).normal(size=taken.shape) * rollout.played[:, :, None]
    (torch.from_numpy(weights) * taken).sum().backward()
    expected = np.zeros(log_probs.shape)
    for t, k, i in np.ndindex(*taken.shape):
        place = 2 * k + i, rollout.rows[t, k, i], rollout.actions[t, k, i]
        assert taken[t, k, i] == log_probs[place]
        expected[place] += weights[t, k, i]
    assert np.allclose(log_probs.grad.numpy(), expected, rtol=1e-6, atol=1e-6)


def test_the_entropy_is_that_of_what_is_drawn_from(played):
    rollout, policy = played
    probs = torch.softmax(policy(rollout.obs), dim=-1).detach().double().numpy()
    entropy = envs.in_every_step(-(probs * np.log(probs)).sum(2), rollout.rows)
    expected = (entropy * rollout.played[:, :, None]).sum((0, 2)) / (2 * rollout.lengths)
    assert rollout.entropy == pytest.approx(expected, abs=1e-6)


def test_merging_equal_vectors_by_the_first_time_they_come():
    rng = np.random.default_rng(0)
    places, lengths = rng.normal(size=(7, 4)).astype(np.float32), np.array([40, 1, 0, 25])
    vectors = places[rng.integers(7, size=(40, 4, 2))]
    for k, length in enumerate(lengths):
        vectors[length:, k] = np.nan  # nothing there may count
    distinct, rows = envs.distinct_rows(vectors, lengths)
    assert rows.shape == (40, 4, 2)
    for k, length in enumerate(lengths):
        for i in range(2):
            first = list(dict.fromkeys(vector.tobytes() for vector in vectors[:length, k, i]))
            assert [vector.tobytes() for vector in distinct[2 * k + i, : len(first)]] == first
            assert not distinct[2 * k + i, len(first) :].any()
            assert np.array_equal(distinct[2 * k + i, rows[:length, k, i]], vectors[:length, k, i])
            assert not rows[length:, k, i].any()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_noticed(value):
    world = world_of("pushbox")
    policy, rollout = networks(world), envs.Rollout(world, TRIALS)
    rollout.play(policy.params, generators(1, 2, 3))
    assert rollout.finite
    policy.params[1].data[2, 0, 0] = value  # a bias in the first layer of one network
    policy.params[2].data[2] = 1.0
    rollout.play(policy.params, generators(1, 2, 3))
    assert not rollout.finite


# --- other policies ---


@pytest.mark.parametrize("name", envs.WORLDS)
def test_any_policy_plays_through_the_vector_face(name):
    """Networks that are asked step by step play the same episode, and leave the same rollout."""
    world = world_of(name)
    policy, compiled, stepped = networks(world), envs.Rollout(world, TRIALS), envs.Rollout(world, TRIALS)

    @torch.no_grad()
    def probabilities(obs):
        logits = policy(obs.reshape(-1, 1, world.obs_dim))
        return torch.softmax(logits.double(), dim=-1).view(TRIALS, world.num_agents, -1)

    for seed in range(3):  # a second and third episode, so that what is left of the one before would show
        compiled.play(policy.params, generators(seed, seed + 1, seed + 2))
        stepped.play_with(probabilities, generators(seed, seed + 1, seed + 2))
        for what in ("obs", "rows", "actions", "reward", "lengths", "outcomes", "all_obs", "states", "finite"):
            assert np.array_equal(getattr(compiled, what), getattr(stepped, what)), what
        assert stepped.entropy == pytest.approx(compiled.entropy, abs=1e-6)


def test_what_a_policy_carries_along_belongs_to_a_trial_whatever_ends_when():
    world = envs.make_world("findtreasure", max_steps=30)
    rollout, steps = envs.Rollout(world, TRIALS), np.zeros(TRIALS, int)

    def probabilities(obs):
        """Trial 1 walks to the meeting in the fewest steps; the others wait, and count."""
        assert obs.shape == (TRIALS, 2, 4)
        way = [(3, 3), (3, 3), (3, 3), (3, 3)]
        joint = [(4, 4), way[steps[1]] if steps[1] < len(way) else (4, 4), (4, 4)]
        steps[:] += 1
        return np.eye(5)[np.array(joint)]

    rollout.play_with(probabilities, generators(1, 2, 3))
    assert steps.tolist() == [30] * TRIALS
    assert rollout.lengths.tolist() == [30, 4, 30]
    assert rollout.outcomes.tolist() == [0, 2, 0]
    assert rollout.entropy.tolist() == [0, 0, 0]


# --- a world of the user's own ---

WORLD = """
import numpy as np

import envs


@envs.rule
def step(rules, state, actions):
    state[1] = min(state[1] + actions[0], 4)
    state[3] = min(state[3] + actions[1], 4)
    return {reward}, int(state[1] == 4 and state[3] == 4)


class Race(envs.PositionWorld):
    action_names = ("stay", "go")
    outcome_names = ("there",)
    best_outcome = 1
    step = staticmethod(step)

    def __init__(self, max_steps: int = 20):
        super().__init__(np.zeros(1), [0, 0, 1, 0], 5, num_agents=2, observation="positions", max_steps=max_steps)
"""


def test_an_edited_world_plays_by_its_new_rules(tmp_path):
    path, totals = tmp_path / "race.py", []
    for reward in (1.0, -2.0):
        path.write_text(WORLD.format(reward=reward))
        world = envs.make_world(str(path))
        rollout = envs.Rollout(world, 1)
        policy = pg.StackedMLP(generators(1), 2, [world.obs_dim, 4, world.num_actions])
        rollout.play(policy.params, generators(2))
        totals.append(rollout.reward[:, 0, 0].sum() / rollout.lengths[0])
        assert envs.optimum(str(path)).fewest["there"].total == 4 * reward
        time.sleep(1.1)  # numba looks at a file's time in whole seconds, and at its size
    assert totals == [1.0, -2.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import envs", "must define one subclass of envs.World, not 0"),
        (WORLD.format(reward=1.0) + "\n\nclass Other(Race):\n    pass\n", "must define one subclass of envs.World, not 2"),
        ("1 / 0", "cannot be imported: ZeroDivisionError: division by zero"),
        ("def", "cannot be imported: SyntaxError"),
        (WORLD.format(reward=1.0).replace("@envs.rule\n", ""), "must be functions compiled by envs.rule"),
    ],
)
def test_a_file_without_a_world_says_what_is_wrong(text, said, tmp_path):
    path = tmp_path / "race.py"
    path.write_text(text)
    with pytest.raises(envs.UsageError, match=said):
        envs.make_vec(str(path)).world.compiled  # noqa: B018
