"""Outputs are complete or not there, even if several processes write them."""

import os
from pathlib import Path

import pytest
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import TemporaryFolder, atomic_output, check_new_folder, check_outputs


def test_two_writers_of_one_output_do_not_meet_and_an_error_leaves_the_older_file(tmp_path) -> None:
    path = tmp_path / "out.txt"
    with atomic_output(path) as first:
        first.write_text("first")
        with atomic_output(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    with refused(ConfigurationError, "No space left"), atomic_output(path) as staging:
        staging.write_text("half of")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_the_first_writer_of_a_folder_keeps_it_until_it_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    with refused(ConfigurationError, "another run wrote it"), atomic_output(path) as second:
        (second / "deep").mkdir(parents=True)
        with atomic_output(path) as first:
            first.mkdir()
            (first / "data").write_text("first")
    assert (path / "data").read_text() == "first" and list(tmp_path.iterdir()) == [path]
    with atomic_output(path, replace=True) as staging:  # in one step
        staging.mkdir()
        (staging / "newer").write_text("second")
    assert [p.name for p in path.iterdir()] == ["newer"] and list(tmp_path.iterdir()) == [path]


def test_a_temporary_folder_removes_only_what_a_killed_process_left(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    left, trials = tmp_path / "socket_testbed_left", tmp_path / "socket_testbed_trials"
    for file in (left / ".temporary", trials / "s01.mcap"):
        file.parent.mkdir()
        file.touch()
        for path in (file, file.parent):
            os.utime(path, (0.0, 0.0))
    with TemporaryFolder():
        assert trials.exists() and not left.exists()


def test_outputs_replace_nothing_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = tmp_path / "bench.csv"
    taken.write_text("data")
    check_outputs(tmp_path / "new.json", None, replace=False)
    check_outputs(taken, replace=True)
    (tmp_path / "new.json").write_text("another's")
    with refused(ConfigurationError, "meanwhile"), atomic_output(tmp_path / "new.json") as own:
        own.write_text("ours")
    assert (tmp_path / "new.json").read_text() == "another's"
    check_outputs(tmp_path / "new.json", replace=True)  # now on request
    with atomic_output(tmp_path / "new.json") as own:
        own.write_text("ours")
    assert (tmp_path / "new.json").read_text() == "ours"
    (tmp_path / "new.json").unlink()
    check_new_folder(tmp_path / "trials" / "s01")
    for name, replace, fact in (
        ("bench.csv", False, "--replace"),
        (".", True, "as a folder"),
        ("modles/m.json", True, "no such folder"),
    ):
        with refused(ConfigurationError, fact):
            check_outputs(None, tmp_path / name, replace=replace)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with refused(ConfigurationError, "no permission"), atomic_output(tmp_path / "other.json"):
        pass
    assert list(tmp_path.iterdir()) == [taken]
