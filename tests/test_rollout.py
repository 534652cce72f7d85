"""Whole episodes: compiled play against a plain loop over the vector face, what a rollout holds, and other policies."""

import numpy as np
import pytest
import torch

import envs
from algos import pg
from envs.rollout import draw_action
from envs.tryout import try_out
from tests.helpers import RACE, assert_one_sentence, assert_refused

TRIALS = 3
LIMIT = {"gotogether": 60}


def world_of(name):
    return envs.make_world(name, max_steps=LIMIT.get(name, 40))


def generators(*seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def networks(world, seed=0, trials=TRIALS, hidden=(16, 8), dtype=torch.float):
    """Stacked policies that are far from uniform."""
    policy = pg.StackedMLP(
        generators(*range(seed, seed + trials)), world.num_agents, [world.obs_dim, *hidden, world.num_actions]
    )
    policy.params = [(3 * param).detach().to(dtype).requires_grad_() for param in policy.params]
    return policy


# --- what is drawn ---


def draw(logits, uniforms, temperature=1.0):
    """The actions that the uniform numbers draw from the softmax of these logits."""
    probs = np.full(len(logits), np.nan)
    envs.softmax(np.asarray(logits, np.float32), probs, temperature)
    return np.array([draw_action(probs, u, False) for u in uniforms])


@pytest.mark.parametrize("temperature", [1.0, 0.4])
def test_actions_have_the_frequencies_of_the_softmax(temperature):
    draws = 20_000
    even = (np.arange(draws) + 0.5) / draws
    for logits in np.random.default_rng(0).normal(scale=2, size=(6, 5)):
        frequencies = np.bincount(draw(logits, even, temperature), minlength=5) / draws
        expected = torch.softmax(torch.from_numpy(logits) / temperature, -1).numpy()
        assert np.abs(frequencies - expected).max() < 2 / draws


def test_a_uniform_number_is_inverted_exactly():
    logits = np.log(np.array([1, 2, 3, 2]) / 8)
    for below, above, bound in ((0, 1, 1 / 8), (1, 2, 3 / 8), (2, 3, 6 / 8)):
        assert draw(logits, [bound - 1e-6, bound + 1e-6]).tolist() == [below, above]


@pytest.mark.parametrize(
    ("logits", "possible"),
    [
        ([0, 0, 0], {0, 1, 2}),
        ([1e4, -1e4, -1e4], {0}),
        ([-1e4, 1e4, -1e4], {1}),
        ([-1e4, -1e4, 1e4], {2}),
        ([-1e4, 0, 0], {1, 2}),
        ([0.1, 0.3, 1e4], {2}),
        ([-1e4, -1e4, -1e4], {0, 1, 2}),
        ([1e4, 1e4, 1e4], {0, 1, 2}),
    ],
)
def test_extreme_logits_give_possible_actions(logits, possible):
    assert set(draw(logits, [0.0, 5e-324, 0.5, 1 - 2**-53])) <= possible


def test_no_action_is_ever_out_of_range():
    rng = np.random.default_rng(1)
    logits = rng.normal(size=(20_000, 4)) * 10.0 ** rng.integers(-3, 5, (20_000, 1))
    actions = np.array([draw(row, [0.0, 1 - 2**-53]) for row in logits])
    assert (actions.min(), actions.max()) == (0, 3)


@pytest.mark.parametrize("epsilon", [0.0, 0.2, 1.0])
def test_the_first_of_the_highest_values_is_played_but_with_probability_epsilon_any(epsilon):
    probs = np.full(4, np.nan)
    envs.epsilon_greedy(np.array([1.0, 5.0, -2.0, 5.0], np.float32), probs, epsilon)
    assert probs == pytest.approx([epsilon / 4, 1 - epsilon + epsilon / 4, epsilon / 4, epsilon / 4], abs=1e-12)


# --- compiled play and plain play ---


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


HOW = {  # the head, its parameter, whether greedily, the type of the weights, and the same in plain numpy
    "softmax": (envs.softmax, 1.0, False, torch.float, softmax),
    "a low temperature": (envs.softmax, 0.5, False, torch.float, lambda logits: softmax(logits / 0.5)),
    "epsilon-greedy": (envs.epsilon_greedy, 0.3, False, torch.float, epsilon_greedy),
    "greedy": (envs.softmax, 1.0, True, torch.float, lambda logits: np.eye(len(logits))[logits.argmax()]),
    "double precision": (envs.softmax, 1.0, False, torch.double, softmax),
}


@pytest.mark.parametrize("name", envs.WORLDS)
@pytest.mark.parametrize("how", HOW)
def test_compiled_play_is_plain_play_action_for_action(name, how):
    head, parameter, greedy, dtype, plain = HOW[how]
    world = world_of(name)
    policy, act = networks(world, seed=4, dtype=dtype), generators(5, 6, 7)
    rollout = envs.Rollout(world, TRIALS, head=head, greedy=greedy)
    rollout.play(policy.params, act, parameter)
    expected = plain_play(world, policy, uniforms_of(world, (5, 6, 7)), plain)
    for k, episode in enumerate(expected):
        assert_same_episode(rollout, k, episode)
    # The generators have gone on by a whole episode's uniforms, whatever its length.
    assert act[0].random() == np.random.default_rng(5).random(world.max_steps * world.num_agents + 1)[-1]


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


def test_the_next_episode_overwrites_the_arrays(played):
    rollout, policy = played
    names = ("obs", "rows", "actions", "reward", "lengths", "outcomes", "all_obs", "states", "entropy")
    before = {name: getattr(rollout, name) for name in names}
    copies = {name: array.copy() for name, array in before.items()}
    rollout.play(policy.params, generators(200, 201, 202))
    for name, array in before.items():
        assert np.shares_memory(array, getattr(rollout, name)), name
        assert name == "rows" or not np.array_equal(array, copies[name]), name


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("head", "parameter"), [(envs.softmax, 1.0), (envs.epsilon_greedy, 0.05)])
def test_numbers_that_are_not_finite_are_noticed(value, head, parameter):
    world = world_of("pushbox")
    policy, rollout = networks(world), envs.Rollout(world, TRIALS, head=head)
    rollout.play(policy.params, generators(1, 2, 3), parameter)
    assert rollout.finite
    policy.params[1].data[2, 0, 0] = value  # a bias in the first layer of one network
    policy.params[2].data[2] = 1.0
    rollout.play(policy.params, generators(1, 2, 3), parameter)
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


def test_an_edited_world_plays_by_its_new_rules(tmp_path):
    path, text = tmp_path / "race.py", RACE.read_text(encoding="utf-8")
    assert text.count("REWARD = 10.0\n") == 1
    for reward in (10.0, -2.0):
        path.write_text(text.replace("REWARD = 10.0\n", f"REWARD = {reward}\n"))
        world = envs.make_world(str(path), size=4)
        rollout = envs.Rollout(world, 1)
        rollout.play(networks(world, trials=1).params, generators(2))
        assert rollout.terminated.all()
        assert rollout.reward[:, 0, 0].tolist() == [-0.1] * (rollout.lengths[0] - 1) + [reward]
        assert envs.optimum(str(path), size=4).fewest["there"].total == pytest.approx(reward - 0.2)


@pytest.mark.parametrize("name", envs.WORLDS)
def test_the_worlds_themselves_pass_what_ones_own_must(name):
    try_out(envs.make_world(name))


def edited_race(old, new):
    """The text of the test's world with a mistake."""
    text = RACE.read_text(encoding="utf-8")
    assert old in text
    return text.replace(old, new)


def race_that_sees(lines):
    """The text of the test's world with another `observe`."""
    text = edited_race("class Race", f"@envs.rule\ndef observe(rules, cell, state, obs):\n    {lines}\n\n\nclass Race")
    call = next(line for line in text.splitlines() if "super().__init__" in line)
    return text.replace(call, f"{call}\n        self.observe = observe")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import envs", "must define one subclass of envs.World, not 0"),
        (
            RACE.read_text(encoding="utf-8") + "\n\nclass Other(Race):\n    pass\n",
            "must define one subclass of envs.World, not 2",
        ),
        ("1 / 0", "cannot be imported: ZeroDivisionError: division by zero"),
        ("def", "cannot be imported: SyntaxError"),
        (RACE.read_text(encoding="utf-8").replace("@envs.rule\n", ""), "must be functions compiled by envs.rule"),
        (
            RACE.read_text(encoding="utf-8").replace("return -0.1, 0", "return reword, 0"),
            "race's rules cannot be compiled: NameError: name 'reword' is not defined",
        ),
        (
            RACE.read_text(encoding="utf-8").replace("range(2)", "state.agents"),
            r"race's rules cannot be compiled: Unknown attribute 'agents' of type array.* \(File .*race.py.*, line 13\)",
        ),
        (
            RACE.read_text(encoding="utf-8").replace("REWARD, 1", "REWARD").replace("-0.1, 0", "-0.1"),
            "race's step must return a reward and a whole number as outcome, not float64",
        ),
        (
            RACE.read_text(encoding="utf-8").replace("best_outcome = 1", "best_outcome = 2"),
            "must be one of its 1 outcomes, or 0",
        ),
        (edited_race("-0.1, 0", "0, -0.1"), "must return a reward and a whole number as outcome, not"),
        (edited_race("REWARD, 1", "REWARD, 2"), "must return an outcome from 0 to 1, the number of its outcome_names, not 2"),
        (edited_race("REWARD, 1", "REWARD, -1"), "must return an outcome from 0 to 1, the number of its outcome_names, not -1"),
        (edited_race("REWARD = 10.0", "REWARD = np.nan"), "must return a finite number as its reward, not nan"),
        (
            edited_race("last = rules", "old = state.copy()\n    last = rules"),
            "cannot be compiled: they may only read and write",
        ),
        (edited_race("(rules, state, actions)", "(state, actions)"), "cannot be compiled: Signature mismatch"),
        (edited_race("np.array([[size]], np.int8)", '{"size": size}'), "cannot be compiled: Cannot determine Numba type of"),
        (edited_race("step = staticmethod(step)", "step = step"), "compiled by envs.rule, in a staticmethod"),
        (
            edited_race("action_names", "actions"),
            "cannot be made: AttributeError: 'Race' object has no attribute 'action_names'",
        ),
        (edited_race("super().__init__(rules, [0, 0, 1, 0], size,", "dict("), r"must call super\(\).__init__"),
        (edited_race("num_agents=2", "num_agents=2.0"), "cannot be made: TypeError"),
        (edited_race("range(2)", "range(3)"), "write beyond the end of the state"),
        (edited_race("state[3] == last", "state[4] > 0"), "must be deterministic, .* or read beyond the end of an array"),
        (edited_race("state[2 * i + 1] += 1", "state[2 * i + 1 + 2 * (i == 1)] += 1"), "write beyond the end of the state"),
        (edited_race("-0.1, 0", "np.random.random(), 0"), "must be deterministic, .*: they draw random numbers"),
        (race_that_sees("obs[:] = 1\n    obs[1, 4] = 1"), "write beyond the end of the observations"),
        (
            race_that_sees("if state[1] > 1:\n        obs[:] = 1"),
            "write a finite number into all 4 entries .* entry 0 of agent 0's",
        ),
        (race_that_sees("obs[:] = np.inf"), "write a finite number into all 4 entries .* entry 0 of agent 0's"),
    ],
)
def test_a_file_without_a_world_says_what_is_wrong(text, said, tmp_path):
    path = tmp_path / "race.py"
    path.write_text(text)
    with pytest.raises(envs.UsageError, match=said) as error:
        envs.make_vec(str(path)).world.compiled  # noqa: B018
    assert_one_sentence(str(error.value))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (dict(state_scale=[1, 1, 1]), r"race's state_scale must be numbers \[4\], and they are \[3\]"),
        (dict(state_scale=[1, 1, 1, "wide"]), "race's state_scale must be numbers, not"),
        (dict(local_index=[[0], [1], [2]]), r"race's local_index must be numbers \[2, any\], and they are \[3, 1\]"),
        (dict(local_index=[[0], [4]]), "race's local_index must name entries of the state, 0 to 3"),
        (dict(start=[[0, 0, 1, 0]]), r"race's start must be numbers \[any\], and they are \[1, 4\]"),
        (dict(num_agents=2.0), "race's num_agents must be a whole number of at least 1, not 2.0"),
        (dict(obs_dim=0), "race's obs_dim must be a whole number of at least 1, not 0"),
    ],
)
def test_numbers_that_do_not_describe_a_world(changed, said):
    kind = type(envs.make_world(str(RACE)))
    numbers = dict(
        start=[0, 0, 1, 0], local_index=[[0], [1]], num_agents=2, obs_dim=4, cell=1, state_scale=[1] * 4, max_steps=9
    )

    class Race(envs.World):
        action_names, step, observe = kind.action_names, staticmethod(kind.step), staticmethod(envs.base.observe_own)

        def __init__(self, changed):
            super().__init__(np.array([[4]], np.int8), **{**numbers, **changed})

    assert Race({}).obs_dim == 4
    with pytest.raises(envs.UsageError, match=said) as error:
        Race(changed)
    assert_one_sentence(str(error.value))


def test_an_outcome_without_a_name_is_refused_whenever_it_comes():
    log = envs.EpisodeLog(envs.make_world("pushbox"), 2, 1)
    names = len(log.world.outcome_names)
    log.add(0, np.zeros((1, 2)), np.ones(2), np.array([0, names]))
    for outcome in (-1, names + 1):
        said = f"must return an outcome from 0 to {names}, the number of its outcome_names, not {outcome}"
        assert_refused(said, log.add, 0, np.zeros((1, 2)), np.ones(2), np.array([0, outcome]))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        (np.full((2, 2, 4), -np.log(4)), "not logits"),
        (np.array([0.5, 0.5, 0.5, 0.5]) * np.ones((2, 2, 4)), "adding up to 1"),
        (np.full((2, 2, 3), 1 / 3), "probabilities of all actions, [2, 2, 4], not [2, 2, 3] numbers"),
        (np.full((4, 4), 1 / 4), "probabilities of all actions, [2, 2, 4], not [4, 4] numbers"),
    ],
)
def test_a_policy_must_say_probabilities(told, said):
    rollout = envs.Rollout(envs.make_world("pushbox", max_steps=3), 2)
    assert_refused(said, rollout.play_with, lambda obs: told, generators(1, 2))
    rollout.play_with(lambda obs: np.full((2, 2, 4), 0.25, np.float32), generators(1, 2))


def test_the_options_of_a_world_of_ones_own():
    assert envs.make_world(str(RACE), size=3, max_steps=7).max_steps == 7
    assert_refused("it takes size, max_steps", envs.make_world, str(RACE), speed=3)
    assert_refused("at least 2", envs.make_world, str(RACE), size=1)


def network(dtype=np.float32, inputs=5, outputs=4):
    """Weights and biases of the networks of one pushbox team, without a hidden layer."""
    return [np.zeros((2, inputs, outputs), dtype), np.zeros((2, 1, outputs), dtype)]


@pytest.mark.parametrize(
    "params",
    [
        network(inputs=4),
        network(outputs=3),
        network(int),
        network()[:1],
        [network()[0], network(np.float64)[1]],
        [network()[0], network(outputs=2)[1]],
        [array[0] for array in network()],
    ],
)
def test_networks_that_do_not_fit_are_refused(params):
    rollout = envs.Rollout(envs.make_world("pushbox", max_steps=3), num_trials=1)
    generators = [np.random.default_rng(0)]
    rollout.play(network(), generators)  # what is compiled for it would read beyond the others' ends
    with pytest.raises(ValueError, match=r"fit|params|zip"):
        rollout.play(params, generators)


def test_networks_of_another_type_or_layout_play_the_same():
    played = []
    rollout = envs.Rollout(envs.make_world("pushbox", max_steps=9), num_trials=1)
    rng = np.random.default_rng(1)
    params = [rng.normal(size=array.shape).astype(np.float32) for array in network()]
    for kind in (np.float32, np.float64, np.asfortranarray, np.ascontiguousarray):
        changed = [param.astype(kind) if isinstance(kind, type) else kind(param) for param in params]
        rollout.play(changed, [np.random.default_rng(0)])
        played.append(rollout.actions.tolist())
    assert played == [played[0]] * 4
