"""Outputs are complete or not there, even if several processes write them."""

import os
from pathlib import Path

import pytest
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import TemporaryFolder, atomic_output, check_outputs


def test_two_writers_of_one_output_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with atomic_output(path) as first:
        first.write_text("first")
        with atomic_output(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("first")
    with refused(ConfigurationError, "No space left"), atomic_output(path) as staging:
        staging.write_text("half of")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_the_first_writer_of_a_folder_keeps_it(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    with refused(ConfigurationError, "another run wrote it"), atomic_output(path) as second:
        (second / "deep").mkdir(parents=True)
        with atomic_output(path) as first:
            first.mkdir()
            (first / "data").write_text("first")
    assert (path / "data").read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_a_folder_is_replaced_in_one_step(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    path.mkdir()
    (path / "data").write_text("first")
    with atomic_output(path, replace=True) as staging:
        staging.mkdir()
        (staging / "newer").write_text("second")
    assert [p.name for p in path.iterdir()] == ["newer"] and list(tmp_path.iterdir()) == [path]


def test_only_a_killed_process_s_folders_are_removed(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    left, trials = tmp_path / "socket_testbed_left", tmp_path / "socket_testbed_trials"
    for file in (left / ".temporary", trials / "s01.mcap"):
        file.parent.mkdir()
        file.touch()
        for path in (file, file.parent):
            os.utime(path, (0.0, 0.0))
    with TemporaryFolder():
        assert trials.exists() and not left.exists()


def test_a_file_that_came_meanwhile_stays(tmp_path: Path) -> None:
    """What replaces a file, and what does not: commands/test_commands.py."""
    check_outputs(tmp_path / "new.json", None, replace=False)
    (tmp_path / "new.json").write_text("another's")
    with refused(ConfigurationError, "meanwhile"), atomic_output(tmp_path / "new.json") as own:
        own.write_text("ours")
    assert (tmp_path / "new.json").read_text() == "another's"
    assert [path.name for path in tmp_path.iterdir()] == ["new.json"]


@pytest.mark.parametrize(
    ("name", "fact"),
    [
        pytest.param(".", "as a folder", id="folder"),
        pytest.param("modles/m.json", "no such folder", id="no-folder"),
    ],
)
def test_an_output_is_refused_where_it_cannot_be(name: str, fact: str, tmp_path: Path) -> None:
    with refused(ConfigurationError, fact):
        check_outputs(tmp_path / name, replace=True)
    assert not [*tmp_path.iterdir()]


def test_an_output_without_permission_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with refused(ConfigurationError, "no permission"), atomic_output(tmp_path / "other.json"):
        pass
    assert not [*tmp_path.iterdir()]
