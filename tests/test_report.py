"""benchmark/report.py: the figures, the page, and the tables in the README."""

import re

import numpy as np
import pytest

from benchmark import figures, report, results
from benchmark.cells import METHODS
from tests.helpers import BEST_PLANS


@pytest.fixture(scope="module")
def kept():
    return results.kept()


def test_tables_are_written_between_their_marks():
    readme = "a\n<!-- scores -->\nold\n<!-- end scores -->\nb\n<!-- other -->\n<!-- end other -->"
    once = report.rewrite(readme, "scores", "new")
    assert once == "a\n<!-- scores -->\nnew\n<!-- end scores -->\nb\n<!-- other -->\n<!-- end other -->"
    assert report.rewrite(once, "scores", "new") == once


def test_the_readmes_tables_are_those_of_the_kept_results(kept):
    assert len(kept) >= 26
    readme = report.README.read_text()
    assert report.markdown(report.score_table(kept)) in readme
    assert report.markdown(report.difference_table(kept)) in readme


def test_every_method_has_its_own_look():
    looks = {(figures.COLOURS[method], figures.DASHES.get(method, "-")) for method in METHODS}
    assert len(looks) == len(METHODS)


def test_curves_show_mean_error_and_optimum(kept):
    result = kept["pushbox", "pg", "sign"]
    drawn = figures.learning_curves({("pushbox", "pg", "sign"): result}, ("pg", "spg"))
    axis = next(axis for axis in drawn.axes if axis.get_title() == "pushbox, sign")
    optimum, mean = axis.lines
    assert np.allclose(mean.get_ydata(), result.score.mean(0))
    assert mean.get_xdata()[[0, -1]].tolist() == [100, result.num_episodes]
    assert optimum.get_ydata() == pytest.approx([100 / 3] * 2)
    band = axis.collections[0].get_paths()[0].vertices[:, 1]
    error = result.score.std(0, ddof=1) / np.sqrt(len(result.score))
    assert band.max() == pytest.approx((result.score.mean(0) + error).max())
    assert [axis.get_visible() for axis in drawn.axes] == [True, False]  # there is nothing under adam


def test_an_agents_way_goes_through_its_cells(kept):
    result = kept["pushbox", "pg", "sign"]
    plan = np.array(BEST_PLANS["pushbox"])
    both = {("pushbox", method, "sign"): type(result)(**{**vars(result), "actions": plan}) for method in ("pg", "decespg")}
    upper, lower = figures.trajectories(both).axes
    for axis in (upper, lower):
        way = axis.lines[0]  # of the first agent: from the lower left corner to below the large box, and up
        columns, rows = (np.asarray(values) // 24 for values in way.get_data())
        assert columns.astype(int).tolist() == [0, 1, 1, 1, 1]
        assert rows.astype(int).tolist() == [3, 3, 3, 2, 1]
    assert "PG, 4 steps" in upper.get_title()


def test_the_page_holds_everything_in_one_file(kept):
    few = {key: result for key, result in kept.items() if key[0] == "pushbox" and key[1] in ("pg", "spg", "decespg")}
    drawn = {"figure4": figures.learning_curves(few, ("pg", "spg", "decespg"))}
    page = report.page(few, drawn)
    assert "width=device-width" in page
    assert not re.search(r"(src|href)=.http", page)
    assert page.count("data:image/svg+xml") == 1
    assert "6 of " in page
    assert page.count("data:image/gif") == sum(len(few["pushbox", m, "sign"].actions) > 0 for m in ("pg", "decespg"))
    mean = few["pushbox", "decespg", "adam"].last.mean()
    assert f"<td>{mean:.2f} ± " in page
    assert "learning_rate 0.0001" in page


def test_without_results_it_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(results, "STORE", tmp_path / "store")
    with pytest.raises(SystemExit) as error:
        report.main(runs=tmp_path, output=tmp_path / "report.html")
    assert error.value.code == 2
    assert capsys.readouterr().err == "report.py: there is no result yet; ./benchmark.sh makes some.\n"
    assert not (tmp_path / "report.html").exists()
