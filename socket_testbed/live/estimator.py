"""Measurements as they come in: put together by stamp, and kept for a fit."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.samples import Samples

_SMALLEST_BUFFER = 256  # samples


class StampSynchroniser:
    """Puts measurements with equal stamps together; nothing is matched by nearest.

    Args:
        kinds: Names of the measurements that make a sample.
        pending: Number of stamps kept while their measurements come in.

    Attributes:
        incomplete: Number of stamps given up before all their measurements were in.
    """

    def __init__(self, kinds: tuple[str, ...], pending: int) -> None:
        self._kinds = frozenset(kinds)
        self._pending = pending
        self._open: OrderedDict[int, dict[str, Any]] = OrderedDict()
        self.incomplete = 0

    def add(self, kind: str, stamp: int, value: Any) -> dict[str, Any] | None:
        """Add a measurement.

        Args:
            kind: Its name.
            stamp: Stamp of its trigger since the epoch [ns].
            value: The measurement.

        Returns:
            All measurements of the stamp by name if this was the last, else None.
        """
        entry = self._open.setdefault(stamp, {})
        entry[kind] = value
        if entry.keys() == self._kinds:
            del self._open[stamp]
            return entry
        while len(self._open) > self._pending:
            self._open.popitem(last=False)
            self.incomplete += 1
        return None

    def clear(self) -> None:
        """Forget what is pending, as after a jump back in time."""
        self._open.clear()


@dataclass(frozen=True)
class Sample:
    """One synchronised sample; see `Samples` for shapes, units and frames."""

    stamp: int
    position: FloatArray
    wrench: FloatArray
    local_forces: FloatArray
    status: StatusArray


class SampleWindow:
    """The newest samples, up to a duration, kept so that handing them out takes no time.

    Args:
        clusters: Names of the clusters, in the order of the samples' local forces.
        duration: Length of the window [s].
    """

    def __init__(self, clusters: tuple[str, ...], duration: float) -> None:
        self._clusters = clusters
        self._duration = round(duration * 1e9)
        width = len(clusters)
        self._buffer = np.empty(
            _SMALLEST_BUFFER,
            dtype=[
                ("stamp", np.int64),
                ("position", np.float64, (3,)),
                ("wrench", np.float64, (6,)),
                ("local_forces", np.float64, (width, 3)),
                ("status", np.uint8, (width,)),
            ],
        )
        self._start = self._end = 0

    def __len__(self) -> int:
        return self._end - self._start

    def add(self, sample: Sample) -> None:
        """Add the newest sample; those older than the window go."""
        if self._end == len(self._buffer):
            self._make_room()
        self._buffer[self._end] = (
            sample.stamp,
            sample.position,
            sample.wrench,
            sample.local_forces,
            sample.status,
        )
        self._end += 1
        while self._buffer["stamp"][self._start] < sample.stamp - self._duration:
            self._start += 1

    def clear(self) -> None:
        """Forget all samples."""
        self._start = self._end = 0

    def samples(self) -> Samples:
        """The samples of the window in the order of their stamps."""
        rows = self._buffer[self._start : self._end]
        rows = rows[np.argsort(rows["stamp"], kind="stable")]
        return Samples(
            stamps=rows["stamp"],
            position=rows["position"],
            wrench=rows["wrench"],
            clusters=self._clusters,
            local_forces=rows["local_forces"],
            status=rows["status"],
        )

    def _make_room(self) -> None:
        """Move the samples to the front, into a larger buffer where they fill half of it."""
        kept = self._buffer[self._start : self._end]
        if 2 * len(kept) > len(self._buffer):
            self._buffer = np.empty(2 * len(self._buffer), dtype=self._buffer.dtype)
        self._buffer[: len(kept)] = kept.copy()
        self._start, self._end = 0, len(kept)
