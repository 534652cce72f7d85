"""ESPG's learning; its parts are tested in test_novelty.py and test_memory.py, its updates in test_family.py."""

from algos import espg
from tests.helpers import train


def test_espg_pushes_the_large_box_together(tmp_path):
    log = train(espg, tmp_path, env="pushbox", num_trials=4, num_episodes=3000).log
    assert log.means(slice(-150, None))["reward_per_step"].min() > 4.5  # without the large box 4.0 is the most
    assert log.means(slice(0, 500))["reward_per_step"].max() < 5  # it was not easy
