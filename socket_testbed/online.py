"""Measurements as they come in: put together by stamp, and kept for a fit."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.samples import Samples


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
    """The newest samples, up to a duration.

    Args:
        clusters: Names of the clusters, in the order of the samples' local forces.
        duration: Length of the window [s].
    """

    def __init__(self, clusters: tuple[str, ...], duration: float) -> None:
        self._clusters = clusters
        self._duration = round(duration * 1e9)
        self._samples: deque[Sample] = deque()

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, sample: Sample) -> None:
        """Add the newest sample; those older than the window go."""
        self._samples.append(sample)
        while self._samples[0].stamp < sample.stamp - self._duration:
            self._samples.popleft()

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()

    def samples(self) -> Samples:
        """The samples of the window in the order of their stamps."""
        ordered = sorted(self._samples, key=lambda sample: sample.stamp)
        count = len(ordered)
        width = len(self._clusters)
        return Samples(
            stamps=np.array([s.stamp for s in ordered], dtype=np.int64),
            position=np.array([s.position for s in ordered]).reshape(count, 3),
            wrench=np.array([s.wrench for s in ordered]).reshape(count, 6),
            clusters=self._clusters,
            local_forces=np.array([s.local_forces for s in ordered]).reshape(count, width, 3),
            status=np.array([s.status for s in ordered], dtype=np.uint8).reshape(count, width),
        )
