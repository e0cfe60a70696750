"""Outputs are complete or not there, even if several processes write them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output


def test_two_writers_of_one_output_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with atomic_output(path) as first:
        first.write_text("first")
        with atomic_output(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_is_removed_and_a_live_one_s_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    program = (
        "import os, pathlib, sys; from socket_testbed.files import atomic_output\n"
        "with atomic_output(pathlib.Path(sys.argv[1])) as staging:\n"
        "    staging.write_text('half of')\n"
        "    os._exit(1)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    (leftover,) = tmp_path.iterdir()
    own = tmp_path / leftover.name.replace(leftover.name.split("-")[-1], f"{os.getpid()}.x.partial")
    other = tmp_path / ".other.txt.elsewhere-1.x.partial"
    own.mkdir()
    other.mkdir()
    with atomic_output(path) as staging:
        assert not leftover.exists()
        staging.write_text("complete")
    assert sorted(tmp_path.iterdir()) == sorted([path, own, other])


def test_an_error_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("older")
    with pytest.raises(ConfigurationError, match="No space left"), atomic_output(path) as staging:
        staging.write_text("half of")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "older" and list(tmp_path.iterdir()) == [path]
