"""The tuning rule: its grid, which cell it chooses, and the tables that it keeps."""

import zipfile

import numpy as np
import pytest

from benchmark import tune
from tests.helpers import assert_refused


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "ROOT", tmp_path)
    (tmp_path / "benchmark").mkdir()
    return tune.Table("decespg")


def fill(table, world, optimizer, scores):
    for cell, (last, overall) in zip(table.cells(world, optimizer), scores, strict=True):
        table.add(cell, (last, last - 1, overall))


def test_the_grid_has_three_rates_and_three_values(table):
    cells = table.cells("pushbox", "adam")
    assert [(cell.learning_rate, cell.value) for cell in cells] == [(lr, b) for lr in (3e-4, 1e-3, 3e-3) for b in (1, 3, 10)]
    assert len({cell.key for cell in cells}) == 9
    assert [cell.value for cell in tune.Table("pg").cells("findtreasure", "sign")] == [None] * 3


def test_the_best_last_episodes_are_chosen_and_of_equal_ones_the_best_of_all(table):
    fill(table, "findtreasure", "sign", [(1, 9)] * 4 + [(5, 2), (5, 3), (5, 1)] + [(4, 9)] * 2)
    assert table.best("findtreasure", "sign").key == ("findtreasure", "sign", "0.0003", "0.3")


def test_other_worlds_take_the_rate_of_the_nearest_network(table):
    fill(table, "findtreasure", "adam", [(n, 0) for n in (1, 2, 3, 9, 5, 6, 7, 8, 4)])
    cells = table.cells("gotogether", "adam")
    assert [(cell.learning_rate, cell.value) for cell in cells] == [(1e-3, beta) for beta in tune.BETAS["gotogether"]]


def test_a_table_is_read_as_it_was_written(table):
    assert not table.finished("pushbox", "sign")
    fill(table, "pushbox", "sign", [(n / 3, n) for n in range(9)])
    again = tune.Table("decespg")
    assert again.rows == table.rows
    assert again.finished("pushbox", "sign")
    lines = table.path.read_text(encoding="utf-8").splitlines()
    assert len(lines) == 10
    assert [line for line in lines if line.endswith(",yes")] == ["pushbox,sign,0.001,10,2.6667,1.6667,8.0,yes"]


def test_rows_stand_in_the_order_of_the_grid(table):
    cells = table.cells("pushbox", "sign")
    for cell in reversed(cells):
        table.add(cell, (1, 1, 1))
    found = [tuple(line.split(",")[:4]) for line in table.path.read_text(encoding="utf-8").splitlines()[1:]]
    assert found == [cell.key for cell in cells]


def test_what_is_in_the_table_is_not_run_again(table, monkeypatch, capsys):
    monkeypatch.setattr(tune.Cell, "run", lambda self: pytest.fail("this cell is finished"))
    fill(table, "pushbox", "sign", [(n, n) for n in range(9)])
    tune.main(("decespg",), worlds=("pushbox",), optimizers=("sign",))
    assert "pushbox sign ('0.001', '10') 8.0 7.0 8.0" in capsys.readouterr().out


def test_what_is_not_in_the_table_is_run_though_an_old_result_lies_there(table, monkeypatch):
    told = []
    monkeypatch.setattr(tune.subprocess, "run", lambda command, **_: told.append(command))
    cell = table.cells("pushbox", "sign")[0]
    folder = tune.ROOT / "runs" / "tuning" / "decespg" / "pushbox-sign-0.0001-1"
    folder.mkdir(parents=True)
    np.savez(folder / "episodes.npz", returns=np.ones((5, 100)), lengths=np.full((5, 100), 2))
    assert cell.run() == (1, 1, 1)
    (folder / "checkpoint.pt").touch()
    cell.run()
    assert [command[-1] for command in told] == ["--overwrite", "--resume"]


def test_a_failed_run_is_shown_and_leaves_no_row(table, monkeypatch, capsys):
    def fails(self):
        raise tune.subprocess.CalledProcessError(2, "decespg.py", stderr="a bar\nthe reason\n")

    monkeypatch.setattr(tune.Cell, "run", fails)
    with pytest.raises(SystemExit) as end:
        tune.main(("decespg",), worlds=("pushbox",), optimizers=("sign",))
    assert end.value.code == 1
    assert capsys.readouterr().err.count("the reason") == 9
    assert not tune.Table("decespg").rows


@pytest.mark.parametrize("words", [dict(methods=("ppo",)), dict(methods=("pg",), worlds=("pacman",))])
def test_unknown_words_are_refused(words):
    assert_refused("there is no ", tune.main, **words)


def test_a_table_that_is_none_is_refused(table):
    table.path.parent.mkdir()
    for text in ("", "a,b\n"):
        table.path.write_text(text, encoding="utf-8")
        assert not tune.Table("decespg").rows
    for text in ("head\npushbox,sign,0.001,1,x,1,1,\n", "head\nmars,sign,0.001,1,1,1,1,\n", "head\npushbox\n"):
        table.path.write_text(text, encoding="utf-8")
        assert_refused("is no table of this program", tune.Table, "decespg")


def test_a_result_that_cannot_be_read_does_not_stop_the_others(table, monkeypatch, capsys):
    def fails(self):
        raise zipfile.BadZipFile("File is not a zip file")

    monkeypatch.setattr(tune.Cell, "run", fails)
    with pytest.raises(SystemExit) as end:
        tune.main(("decespg",), worlds=("pushbox",), optimizers=("sign",))
    assert end.value.code == 1
    assert capsys.readouterr().err.count("File is not a zip file") == 9
