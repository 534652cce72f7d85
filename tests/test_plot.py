"""benchmark/plot.py: one's own runs in one figure and one table."""

import numpy as np
import pytest

import envs
from algos import pg
from benchmark import plot
from benchmark.plot import Group
from tests.helpers import train


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """PG's seeds 1 to 5 in two runs, and three of them with another learning rate and fewer episodes."""
    folder = tmp_path_factory.mktemp("runs")
    short = dict(env="pushbox", max_steps=5)
    logs = [
        train(pg, folder / "a", **short, seed=1, num_trials=2, num_episodes=60).log,
        train(pg, folder / "b", **short, seed=3, num_trials=3, num_episodes=60).log,
        train(pg, folder / "c", **short, seed=1, num_trials=3, num_episodes=40, learning_rate=0.01).log,
    ]
    return folder, logs


def score(log):
    return envs.reward_per_step(log.returns, log.lengths)


def test_runs_that_differ_in_their_seeds_are_one_curve(runs):
    folder, (first, second, other) = runs
    one, two = plot.groups_of(plot.read([folder / "b", folder / "a", folder / "c"]))
    assert one.seeds == (1, 2, 3, 4, 5)
    assert np.array_equal(one.score, np.concatenate([score(first), score(second)]))
    assert np.array_equal(two.score, score(other))
    assert [group.label for group in (one, two)] == [
        "pg num_episodes=60 learning_rate=0.0003",
        "pg num_episodes=40 learning_rate=0.01",
    ]
    assert one.last == pytest.approx(one.score[:, -3:].mean(1))


def test_another_task_is_named_beside_another_method():
    settings = dict(method="pg", env="gotogether", env_args=[], max_steps=200, hidden=[64])
    others = settings | dict(method="mappo", env_args=["size=7", "num_agents=3"], hidden=[32])
    found = {plot.json.dumps(each): {1: np.zeros(10)} for each in (settings, others)}
    assert [group.label for group in plot.groups_of(found)] == ["pg env_args=", "mappo env_args=size=7 num_agents=3"]


def test_small_rewards_have_more_decimals():
    def first(*means):
        groups = [Group(f"run {k}", "my_world", range(5), np.full((5, 20), mean)) for k, mean in enumerate(means)]
        scores, differences = plot.tables(groups)
        return [row[4] for row in scores[1:]] + [row[2] for row in differences[1:]]

    assert first(0.0152, 0.002) == ["0.0152", "0.0020", "-0.0132 [-0.0132, -0.0132]"]
    assert first(0.152, 0.002) == ["0.152", "0.002", "-0.150 [-0.150, -0.150]"]
    assert first(-15.2, 3.126) == ["-15.20", "3.13", "+18.33 [+18.33, +18.33]"]
    assert first(0.0) == ["0.00"]


def test_differences_are_those_of_the_same_seeds():
    noise = np.random.default_rng(0).normal(scale=100, size=(20, 1))
    one, other = (Group("", "pushbox", tuple(range(20)), noise + shift) for shift in (2.0, 0.0))
    difference, better = plot.compare(one, other)
    assert difference == "+2.00 [+2.00, +2.00]"
    assert 0.5 < float(better.split()[0]) < 0.6
    later = Group("", "pushbox", tuple(range(8, 28)), np.concatenate([noise[8:], noise[:8]]))
    assert plot.compare(one, later)[0] == "+2.00 [+2.00, +2.00]"  # seeds 8 to 19
    assert plot.compare(one, Group("", "pushbox", tuple(range(17, 37)), noise))[0] == "-"
    assert plot.compare(*(Group("", "", (seed,), np.array([[3.0]])) for seed in (1, 2))) == ["-", "0.50"]


@pytest.mark.parametrize("name", ["figure.png", "figure.svg"])
def test_the_figure_and_both_tables(name, runs, tmp_path, capsys):
    folder, _ = runs
    plot.main((folder / "a", folder / "b", folder / "c", tmp_path / "none"), output=tmp_path / name)
    said, warned = capsys.readouterr()
    assert (tmp_path / name).stat().st_size > 5000
    assert "| pushbox | pg num_episodes=60 learning_rate=0.0003 | 5 | 60 | " in said
    assert "| pushbox | pg num_episodes=40 learning_rate=0.01 - pg num_episodes=60 learning_rate=0.0003 | " in said
    assert warned == (
        f"{tmp_path}/none is not a finished run and is left out.\n"
        "In pushbox the curves have 40 and 60 episodes: their ends cannot be compared.\n"
    )


@pytest.mark.parametrize(
    ("output", "said"), [("a.png", "there is no finished run among these."), ("a", "--output must end in")]
)
def test_what_cannot_be_drawn(output, said, tmp_path):
    with pytest.raises(envs.UsageError, match=said):
        plot.main((tmp_path,), output=tmp_path / output)
    assert not (tmp_path / output).exists()
