"""Bags that were compressed by file, message or chunk are read as the plain ones."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from backports import zstd
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support.bags import copy_configuration, written_by_rosbags

from socket_testbed.errors import TrialError
from socket_testbed.trials import bag
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.trial import Trial

KINDS = [
    (StoragePlugin.MCAP, CompressionMode.FILE),
    (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
    (StoragePlugin.SQLITE3, CompressionMode.NONE),
    (StoragePlugin.SQLITE3, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
]


def written(source: Path, path: Path, storage: StoragePlugin, mode: CompressionMode) -> Path:
    """A copy of a trial by another program, compressed."""
    with BagReader(source) as plain:
        written_by_rosbags(plain.messages(), path, storage, mode)
    return copy_configuration(source, path)


def test_a_compressed_trial_gives_the_samples_of_the_plain_one(hold: Path, tmp_path: Path) -> None:
    expected = Trial(hold).samples().values
    for storage, mode in KINDS:
        path = written(hold, tmp_path / f"{storage.name}_{mode.name}", storage, mode)
        np.testing.assert_array_equal(Trial(path).samples().values, expected)
        (path / "metadata.yaml").unlink()
        np.testing.assert_array_equal(Trial(path).samples().values, expected)


def test_a_compressed_file_that_was_cut_or_is_too_large_names_itself(
    hold: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(hold, tmp_path / "packed", StoragePlugin.MCAP, CompressionMode.FILE)
    file = path / "packed.mcap.zstd"
    whole = file.read_bytes()
    for share in (0.0, 0.3, 0.9):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(TrialError, match=r"packed/packed\.mcap\.zstd: is truncated"):
            Trial(path).samples()
    file.write_bytes(zstd.compress(bytes(2**25)))
    monkeypatch.setattr(bag, "_LARGEST", 2**20)
    with pytest.raises(TrialError, match=r"packed\.mcap\.zstd: .*too large once unpacked"):
        Trial(path).samples()


def test_another_compression_is_refused_for_what_it_is(hold: Path, tmp_path: Path) -> None:
    path = tmp_path / "hold"
    shutil.copytree(hold, path)
    content = yaml.safe_load((path / "metadata.yaml").read_text())
    information = content["rosbag2_bagfile_information"]
    information |= {"compression_format": "lz4", "compression_mode": "file"}
    (path / "metadata.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(TrialError, match=r"is compressed with 'lz4'.*ros2 bag convert"):
        Trial(path).samples()


def test_a_journal_beside_an_sqlite_file_is_noted(hold: Path, tmp_path: Path) -> None:
    path = written(hold, tmp_path / "b", StoragePlugin.SQLITE3, CompressionMode.NONE)
    (path / "b.db3-wal").write_bytes(b"some messages")
    with BagReader(path) as reader:
        assert any("b.db3-wal, which may hold" in note for note in reader.notes)
