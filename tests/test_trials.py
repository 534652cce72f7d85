"""Trials side by side are the runs that their seeds give alone, and the same command gives the same run."""

from tests.helpers import (
    assert_same_run,
    assert_trials_are_runs,
    each_script,
    each_script_and_setting,
    script,
    train,
    use_double_precision,
)


@each_script_and_setting
def test_trials_are_runs(name, setting, tmp_path, monkeypatch):
    use_double_precision(script(name), monkeypatch)
    assert_trials_are_runs(script(name), tmp_path, 1e-9, **setting)


@each_script
def test_trials_are_runs_in_single_precision(name, tmp_path):
    # The errors of a critic are rounded, and sign descent makes parts of a step (3e-4) out of that where a gradient is near 0.
    tolerance = 1e-3 if "critic_learning_rate" in script(name).LIMITS else 1e-5
    assert_trials_are_runs(script(name), tmp_path, tolerance, env="pushbox")


@each_script_and_setting
def test_the_same_command_gives_the_same_run(name, setting, tmp_path):
    args = dict(setting, num_trials=2, num_episodes=100)
    assert_same_run(*(train(script(name), tmp_path / which, **args) for which in ("first", "second")))
