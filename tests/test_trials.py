"""Trials side by side are the runs that their seeds give alone, and the same command gives the same run."""

import pytest

from tests.helpers import (
    assert_same_run,
    assert_trials_are_runs,
    each_script_and_setting,
    script,
    train,
    use_double_precision,
)


@each_script_and_setting
def test_trials_are_runs(name, setting, tmp_path, monkeypatch):
    use_double_precision(script(name), monkeypatch)
    assert_trials_are_runs(script(name), tmp_path, 1e-9, **setting)


ONE_KIND = ("pg", "epg", "spg", "espg", "decespg", "dqn", "hysteretic")


@pytest.mark.parametrize("name", ONE_KIND)
def test_trials_are_runs_in_single_precision(name, tmp_path):
    """Only with one kind of networks: sign descent makes whole steps out of the rounding of what others say near 0."""
    assert_trials_are_runs(script(name), tmp_path, 1e-5, env="pushbox", max_steps=200)


@each_script_and_setting
def test_the_same_command_gives_the_same_run(name, setting, tmp_path):
    args = dict(setting, num_trials=2, num_episodes=100, max_steps=60)
    first, second = (train(script(name), tmp_path / which, **args) for which in ("first", "second"))
    assert_same_run(first, second, parts=vars(first).keys() - {"log"})
