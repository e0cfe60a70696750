"""The record of bench data: what was applied to a cluster and what its converter read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray

UNNAMED = -1  # the cycle of a row in a file that names none
_SOUND = 99.0  # [%] of the rows, at least


@dataclass(frozen=True)
class BenchData:
    """Bench data of one cluster, one row a reading.

    Attributes:
        files: Names of the files.
        file: Which of them each row is from, shape (N,).
        line: The line it stands on there, shape (N,).
        time: Time within its file, shape (N,) [s]; NaN where the file has none.
        cycle: Which cycle of its file a row belongs to, shape (N,); `UNNAMED` where the file
            names none.
        capacitance: Capacitances by input of the converter, shape (N, 4) [pF].
        stress: Known normal stress (positive in compression), shear x and shear y in the
            cluster's frame, shape (N, 3) [Pa].
    """

    files: tuple[str, ...]
    file: IntArray
    line: IntArray
    time: FloatArray
    cycle: IntArray
    capacitance: FloatArray
    stress: FloatArray

    def __len__(self) -> int:
        return len(self.file)

    def __getitem__(self, rows: BoolArray | IntArray) -> BenchData:
        """Some of the rows."""
        return BenchData(
            self.files,
            self.file[rows],
            self.line[rows],
            self.time[rows],
            self.cycle[rows],
            self.capacitance[rows],
            self.stress[rows],
        )

    @property
    def full_scale(self) -> FloatArray:
        """Largest size of each known stress, shape (3,) [Pa]."""
        return np.abs(self.stress).max(axis=0)

    def place(self, row: int) -> str:
        """Where a row stands, in words."""
        return f"{self.files[self.file[row]]} line {self.line[row]}"


def scaled_stress(stress: FloatArray) -> FloatArray:
    """Stresses as parts of the largest ones, from -1 to 1, however wrong one in a hundred is.

    Args:
        stress: Normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Parts, shape (N, 3) [-]; zero for a stress that is hardly ever applied.
    """
    scale = np.percentile(np.abs(stress), _SOUND, axis=0, method="lower")
    return np.clip(stress / np.where(scale > 0.0, scale, np.inf), -1.0, 1.0)


def join_benches(parts: Sequence[BenchData]) -> BenchData:
    """Put the data of several files together, in their order."""
    offsets = np.cumsum([0, *(len(part.files) for part in parts[:-1])])
    return BenchData(
        files=tuple(name for part in parts for name in part.files),
        file=np.concatenate([p.file + o for p, o in zip(parts, offsets, strict=True)]),
        line=np.concatenate([part.line for part in parts]),
        time=np.concatenate([part.time for part in parts]),
        cycle=np.concatenate([part.cycle for part in parts]),
        capacitance=np.concatenate([part.capacitance for part in parts]),
        stress=np.concatenate([part.stress for part in parts]),
    )
