"""Trials side by side are the runs that their seeds give alone, and the same command gives the same run."""

import pytest

from tests.helpers import (
    SCRIPTS,
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


@pytest.mark.parametrize("name", [name for name in SCRIPTS if "critic_learning_rate" not in script(name).LIMITS])
def test_trials_are_runs_in_single_precision(name, tmp_path):
    """Not with critics: sign descent makes whole steps out of the rounding of their errors where a gradient is near 0."""
    assert_trials_are_runs(script(name), tmp_path, 1e-5, env="pushbox")


@each_script_and_setting
def test_the_same_command_gives_the_same_run(name, setting, tmp_path):
    args = dict(setting, num_trials=2, num_episodes=100)
    assert_same_run(*(train(script(name), tmp_path / which, **args) for which in ("first", "second")))
