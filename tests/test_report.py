"""benchmark/report.py: the figures, the page, and the tables in the README."""

import dataclasses
import re

import numpy as np
import pytest

import envs
from benchmark import figures, report, results
from benchmark.cells import BEYOND, METHODS, Cell
from tests.helpers import BEST_PLANS, assert_refused, script, train


@pytest.fixture(scope="module")
def kept():
    return results.kept()


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    figures.plt.close("all")


def test_tables_are_written_between_their_marks():
    readme = "a\n<!-- scores -->\nold\n<!-- end scores -->\nb\n<!-- other -->\n<!-- end other -->"
    once = report.rewrite(readme, "scores", "new")
    assert once == "a\n<!-- scores -->\nnew\n<!-- end scores -->\nb\n<!-- other -->\n<!-- end other -->"
    assert report.rewrite(once, "scores", "new") == once


def test_the_published_tables_are_those_of_the_kept_results(kept):
    assert len(kept) >= 54
    for (world, method, _), result in kept.items():
        assert result.num_episodes == script(method).WORLDS[world]["num_episodes"]
    assert all(len(result.about["commit"]) == 40 for result in kept.values())
    for page, tables in report.published_tables(kept).items():
        text = page.read_text(encoding="utf-8")
        for mark, table in tables.items():
            assert report.rewrite(text, mark, report.markdown(table)) == text, (page.name, mark)


def test_tables_are_published_and_one_without_a_place_is_refused_before_anything_is_written(kept, tmp_path, monkeypatch):
    pages = [report.README, report.DOCS / "results.md", report.DOCS / "beyond.md"]
    monkeypatch.setattr(report, "README", tmp_path / "README.md")
    monkeypatch.setattr(report, "DOCS", tmp_path)
    for page in pages:
        text = page.read_text(encoding="utf-8").replace("| PG |", "| old |").replace("| sign |", "| old |")
        (tmp_path / page.name).write_text(text, encoding="utf-8")
    report.publish(report.published_texts(kept), {})
    assert [(tmp_path / page.name).read_bytes() for page in pages] == [page.read_bytes() for page in pages]
    (tmp_path / "beyond.md").write_text("<!-- leaderboard -->\nno end", encoding="utf-8")
    before = [path.read_bytes() for path in sorted(tmp_path.iterdir())]
    with pytest.raises(envs.UsageError, match="must be marked by one <!-- leaderboard --> and one <!-- end leaderboard -->"):
        report.published_texts({key: kept[key] for key in [("pushbox", "pg", "sign")]})
    assert [path.read_bytes() for path in sorted(tmp_path.iterdir())] == before


def test_what_is_published_is_of_the_repositorys_methods_and_worlds(kept):
    pg = kept["pushbox", "pg", "sign"]
    own = {("/my/world.py", "qmix", "adam"): pg, ("pushbox", "my_method", "sign"): pg, ("/my/pushbox.py", "pg", "sign"): pg}
    assert results.shipped({**kept, **own}) == kept


def ended(kept, usual, met, num_episodes=20_000):
    """20 trials in pushbox that usually end as `usual` says; the last of them have `met` the large box so often."""
    at_best = np.zeros((20, 200))
    at_best[20 - len(met) :, 0] = np.array(met) / results.block_of(num_episodes)
    parts = dict(last=np.full(20, 2.0), usual=np.array(usual), at_best=at_best, num_episodes=num_episodes)
    return dataclasses.replace(kept["pushbox", "spg", "sign"], **parts)


def test_a_worlds_table_tells_where_trials_end(kept):
    result = ended(kept, [4] * 17 + [0, 1, 1], met=[0, 0, 8])
    head, row, optimum = report.score_table({("pushbox", "spg", "sign"): result}, "pushbox")
    assert head[1:5] == [f"sign: {word}" for word in ("reward per step", "worst trial", "at best end", "the others")]
    assert row[:5] == ["SPG", "2.00 ± 0.00", "2.00", "17 of 20", "time limit: 1, small left: 2; 1 met it, up to 8 times"]
    assert (row[5:], optimum[:2]) == ([""] * 4, ["*exact optimum*", "*33.33*"])
    head, row, _ = report.score_table({("cleaner", "pg", "sign"): kept["cleaner", "pg", "sign"]}, "cleaner")
    assert (len(head), len(row)) == (5, 5)  # there is nothing to end in
    assert re.fullmatch(r"0\.\d{3} ± 0\.\d{3}", row[1])


@pytest.mark.parametrize(
    ("usual", "met", "episodes", "said"),
    [
        ([4] * 20, [], 20_000, ""),
        ([4] * 18 + [2, 2], [0, 0], 20_000, "small right: 2; none met it"),
        ([4] * 18 + [2, 2], [5, 3], 20_000, "small right: 2; all met it, up to 5 times"),
        ([4] * 19 + [3], [7], 20_000, "both small: 1; all met it, up to 7 times"),
        ([4] * 18 + [1, 0], [1, 0], 20_000, "time limit: 1, small left: 1; 1 met it, once"),
        ([4] * 19 + [5], [0], 20_000, "outcome 5: 1; none met it"),  # of a world that has changed since
        ([4] * 19 + [3], [2], 100, "both small: 1; all met it, up to 2 times"),  # blocks of 5 episodes
    ],
)
def test_the_others_are_those_not_at_the_best_outcome(usual, met, episodes, said, kept):
    assert report.the_others("pushbox", ended(kept, usual, met, episodes)) == said


def test_of_one_trial_there_is_no_error_and_no_interval(kept, recwarn):
    one = {}
    for method in ("spg", "decespg"):
        result = kept["pushbox", method, "sign"]
        parts = {name: getattr(result, name)[:1] for name in ("score", "at_best", "steps", "last", "usual")}
        one["pushbox", method, "sign"] = dataclasses.replace(result, **parts)
    assert re.fullmatch(r"\d+\.\d\d", report.score_table(one, "pushbox")[1][1])
    assert re.fullmatch(r"[+-]\d\.\d\d", report.difference_table(one)[1][1])
    assert not recwarn


def test_what_is_beyond_the_paper_stands_by_itself(kept):
    some = {key: kept[key] for key in [("pushbox", "pg", "sign"), ("pushbox", "coma", "adam"), ("findtreasure", "pg", "sign")]}
    result = some["pushbox", "pg", "sign"]
    more = {("pushbox", "mappo", "adam"): result, ("passage", "pg", "sign"): result, ("pushbox", "mine", "sign"): result}
    found = results.in_order({**more, **some})
    assert results.of_the_paper(found).keys() == {*some, ("pushbox", "mine", "sign")}
    beyond = results.beyond_the_paper(found)
    assert list(beyond) == [
        ("pushbox", "pg", "sign"),
        ("pushbox", "coma", "adam"),
        ("pushbox", "mappo", "adam"),
        ("passage", "pg", "sign"),
    ]
    drawn = report.all_figures(found)
    assert {axis.get_title() for axis in drawn["beyond"].axes if axis.get_visible()} == {
        "pushbox, sign",
        "pushbox, adam",
        "passage, sign",
    }
    assert "passage, sign" not in {axis.get_title() for axis in drawn["figure3"].axes}


def test_the_leaderboard_counts_until_95_percent_are_there(kept):
    key = "pushbox", "decespg", "sign"
    head, row = report.leaderboard({key: kept[key]})
    block = np.flatnonzero((kept[key].at_best > 0.5).sum(0) >= 19)[0]
    assert row[:4] == ["pushbox", "DecESPG", "sign", str(100 * (block + 1))]
    assert row[4] == f"{kept[key].steps[:, block].mean():,.0f}"
    assert len(head) == len(row)


def test_the_best_of_each_world_is_named_and_who_is_level_with_it(kept):
    few = {key: kept[key] for key in [("pushbox", m, "sign") for m in ("pg", "spg", "decespg")]}
    few["pushbox", "spg", "sign"] = dataclasses.replace(few["pushbox", "spg", "sign"], last=np.full(20, 33.0))
    _, row = report.best_table(few)
    assert row[:5] == ["pushbox", "33.33", "sign", "SPG 33.00 ± 0.00 (20 of 20)", "-"]
    assert row[5].endswith("(20 of 20)")
    few["pushbox", "decespg", "sign"] = dataclasses.replace(few["pushbox", "spg", "sign"], last=np.linspace(32, 33.9, 20))
    assert report.best_table(few)[1][4] == "DecESPG"


def test_every_method_has_its_own_look():
    looks = {(figures.COLOURS[method], figures.DASHES.get(method, "-")) for method in METHODS | BEYOND}
    assert len(looks) == len(METHODS | BEYOND)
    assert len({figures.COLOURS[method] for method in METHODS}) == len(METHODS)  # dots with intervals have no dashes


def test_panels_of_a_world_have_one_scale_and_a_legend_names_all_profiles(kept):
    drawn = figures.learning_curves({key: kept[key] for key in kept if key[0] == "cleaner" and key[1] == "pg"}, ("pg",))
    assert drawn.axes[0].get_ylim() == drawn.axes[1].get_ylim()
    shares = np.linspace(0, 1, 3)
    profiles = {"sign": {"pg": 3 * (shares,)}, "adam": {"dqn": 3 * (shares,), "pg": 3 * (shares,)}}
    (legend,) = figures.performance_profiles(profiles, shares).legends
    assert [text.get_text() for text in legend.get_texts()] == ["PG", "DQN"]


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


def test_a_smoke_run_has_a_report_of_its_own(tmp_path, monkeypatch, capsys):
    """Where nothing is published: neither what is kept nor README and docs/ change, and nothing longer stands beside it."""
    paths = [report.README, *(path for path in report.DOCS.iterdir() if path.is_file())]
    before = [path.read_bytes() for path in paths]
    monkeypatch.setattr(results, "STORE", tmp_path / "store")
    for method in ("pg", "spg", "decespg"):
        cell = Cell(method, "pushbox", "sign", num_trials=2, num_episodes=100, runs=tmp_path / "runs")
        train(script(method), cell.run_dir, **cell.arguments)
    capsys.readouterr()
    report.main(report.Args(runs=tmp_path / "runs", episodes=100, seeds="1-2"))
    said = capsys.readouterr().out
    assert said.startswith("pushbox\n\n| method | sign: reward per step |")
    assert [said.count(f"\n| {name} | ") for name in ("PG", "SPG", "DecESPG", "*exact optimum*", "pushbox")] == [1] * 5
    assert (tmp_path / "report" / "report.html").stat().st_size > 10_000
    assert (tmp_path / "report" / "figure4.png").exists()
    assert [path.read_bytes() for path in paths] == before
    assert not (tmp_path / "store").exists()


def test_how_long_all_cells_take_is_not_guessed_from_short_runs(kept):
    assert re.search(r"take about \d+\.\d hours on 2 cores", report.time_needed(kept))
    assert report.time_needed({key: dataclasses.replace(result, num_episodes=50) for key, result in kept.items()}) == ""


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (dict(), "there is no finished cell under "),
        (dict(publish=True, episodes=50), "only results of seeds 1-20 and all of Table 1's episodes are published."),
        (dict(publish=True, seeds="1-3"), "only results of seeds 1-20 and all of Table 1's episodes are published."),
        (dict(episodes=0), "--episodes must be a whole number of at least 1, not 0."),
        (dict(seeds="3-1"), "--seeds must be two numbers such as 1-20, not '3-1'."),
    ],
)
def test_what_cannot_be_reported(args, said, tmp_path, monkeypatch):
    monkeypatch.setattr(results, "STORE", tmp_path / "store")
    assert_refused(said, report.main, report.Args(runs=tmp_path, output_dir=tmp_path / "report", **args))
    assert not (tmp_path / "report").exists()
