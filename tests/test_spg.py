"""SPG's learning; its memory is tested in test_memory.py, its updates in test_family.py."""

from algos import spg
from tests.helpers import train


def test_spg_leaves_the_local_optimum_of_findtreasure(tmp_path):
    """In which PG ends with the same seeds, networks and step size, see test_pg.py."""
    log = train(spg, tmp_path, env="findtreasure", num_trials=4, num_episodes=1500).log
    assert (log.outcomes[:, -75:] == 1).mean(1).min() > 0.5
    assert log.means(slice(-75, None))["reward_per_step"].min() > 5
