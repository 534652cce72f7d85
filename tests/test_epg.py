"""EPG's learning; its bonus is tested in test_novelty.py, its updates in test_family.py."""

from algos import epg
from tests.helpers import train


def test_epg_goes_on_exploring_where_pg_ends_in_a_local_optimum(tmp_path):
    """In findtreasure, where PG with the same seeds, networks and step size always meets at the end, see test_pg.py."""
    log = train(epg, tmp_path, env="findtreasure", num_trials=4, num_episodes=1000, beta=0.1).log
    assert (log.outcomes[:, 500:] == 1).mean(1).min() > 0.1
