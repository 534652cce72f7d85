"""Trials side by side are the runs that their seeds give alone, and the same command gives the same run."""

from tests.helpers import (
    assert_same_run,
    assert_trials_are_runs,
    each_script,
    each_setting,
    script,
    train,
    use_double_precision,
)


@each_script
@each_setting
def test_trials_are_runs(name, env, optimizer, tmp_path, monkeypatch):
    use_double_precision(script(name), monkeypatch)
    assert_trials_are_runs(script(name), tmp_path, 1e-9, env=env, optimizer=optimizer)


@each_script
def test_trials_are_runs_in_single_precision(name, tmp_path):
    assert_trials_are_runs(script(name), tmp_path, 1e-5, env="pushbox")


@each_script
@each_setting
def test_the_same_command_gives_the_same_run(name, env, optimizer, tmp_path):
    args = dict(env=env, optimizer=optimizer, num_trials=2, num_episodes=100)
    assert_same_run(*(train(script(name), tmp_path / which, **args) for which in ("first", "second")))
