"""Files that appear whole or not at all."""

import os

import pytest

from envs import complete_file


def test_a_file_appears_when_it_is_complete(tmp_path):
    path = tmp_path / "result.txt"
    with complete_file(path) as file:
        file.write(b"new")
        assert not path.exists()
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_the_old_file_stays_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "result.txt"
    path.write_bytes(b"old")
    with complete_file(str(path)) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"


@pytest.mark.parametrize("trouble", [OSError, KeyboardInterrupt, SystemExit])
def test_trouble_leaves_the_old_file_and_nothing_else(tmp_path, trouble):
    path = tmp_path / "result.txt"
    path.write_bytes(b"old")

    def write_half():
        with complete_file(path) as file:
            file.write(b"half")
            raise trouble

    with pytest.raises(trouble):
        write_half()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_two_processes_do_not_write_into_the_same_temporary_file(tmp_path, monkeypatch):
    path = tmp_path / "result.txt"
    with complete_file(path) as mine:
        mine.write(b"mine")
        with monkeypatch.context() as elsewhere:
            elsewhere.setattr(os, "getpid", lambda: -1)
            with complete_file(path) as other:
                other.write(b"the other's")
        assert path.read_bytes() == b"the other's"
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_an_os_error(tmp_path):
    (tmp_path / "file").touch()
    for place in (tmp_path / "file" / "below", tmp_path / "missing" / "below"):
        with pytest.raises(OSError, match=r"Not a directory|No such file"), complete_file(place):
            pytest.fail("the block must not run")
