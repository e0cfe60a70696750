"""What a running graph has measured so far, counted from serialised messages.

At 100 Hz a decoder would take a tenth of a core. The few bytes that matter stand at known places of
the serialised form, CDR (OMG DDSI-RTPS 2.5, section 10): a header of four bytes that gives the byte
order, then the fields in their order, each aligned to its size, counted from after that header.
"""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from typing import Any

from socket_testbed.samples import Status
from socket_testbed.trials.topics import (
    CAPACITANCE,
    ESTIMATED_WRENCH,
    PARAMETERS,
    PYLON_POSE,
    RECORDED_TRIAL,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
    Topic,
)

MEASURED = (CAPACITANCE, WRENCH, SOCKET_POSE, PYLON_POSE)
WATCHED = (TRIGGER, *MEASURED, ESTIMATED_WRENCH, PARAMETERS, RECORDED_TRIAL)

Wrench = tuple[float, ...]  # fx, fy, fz [N], mx, my, mz [N m]

_PENDING = 1000  # stamps kept while their measurements come in
_JUDGED = 10.0  # [s]; over which predictions are compared with measurements
_HEADER = 4  # [B]; before the first field
_CHANNELS = 4


class GraphStatus:
    """Counts the samples of a graph, and compares what is predicted with what is measured.

    Attributes:
        triggers: Number of triggers.
        complete: Number of triggers of which every measurement has come and none is missing.
        wrench: The newest wrench: forces [N], then moments [N m]; None before any.
        variant: Variant of the model that predicts; empty before any.
        trial: Name of the trial that is being recorded; empty if none is.
        heard: When the newest trigger arrived, on this machine's monotonic clock [s]; None before
            any.
    """

    def __init__(self) -> None:
        self.triggers = 0
        self.complete = 0
        self.wrench: Wrench | None = None
        self.variant = ""
        self.trial = ""
        self.heard: float | None = None
        self._first = self._last = 0  # stamps of triggers [ns]
        self._pending: dict[int, set[Topic]] = {}
        self._measured: dict[int, Wrench] = {}
        self._errors: deque[tuple[int, float, float]] = deque()

    @property
    def elapsed(self) -> float:
        """Time from the first trigger to the newest [s]; since the last jump back, if any."""
        return 1e-9 * (self._last - self._first)

    def errors(self) -> tuple[float, float] | None:
        """RMSE of the predicted forces [N] and moments [N m] over the last seconds; None: unknown.

        Each sample is predicted before it is fitted to: the model has not seen it.
        """
        errors = list(self._errors)  # another thread adds
        if not errors:
            return None
        force, moment = (
            math.sqrt(sum(error[k] for error in errors) / (3 * len(errors))) for k in (1, 2)
        )
        return force, moment

    def add(self, topic: Topic, data: bytes) -> None:
        """Take a serialised message of one of the topics `WATCHED`."""
        if topic is TRIGGER:
            self._add_trigger(_stamp(data))
        elif topic is PARAMETERS:
            self.variant = _text(data, _after_header(data))[0]
        elif topic is RECORDED_TRIAL:
            self.trial = _text(data, _HEADER)[0]
        elif topic is ESTIMATED_WRENCH:
            self._judge(_stamp(data), _last_doubles(data, 6))
        else:
            self._add_measurement(topic, _stamp(data), data)

    def _add_trigger(self, stamp: int) -> None:
        if not self.triggers or stamp < self._last:  # a replay that starts over
            self._first = stamp
            self._pending.clear()
            self._measured.clear()
            self._errors.clear()
        self._last = stamp
        self.triggers += 1
        self.heard = time.monotonic()

    def _add_measurement(self, topic: Topic, stamp: int, data: bytes) -> None:
        if topic is CAPACITANCE:
            present = Status.MISSING not in _statuses(data)
        else:
            values = _last_doubles(data, 6 if topic is WRENCH else 7)
            present = all(map(math.isfinite, values))
            if topic is WRENCH:
                self.wrench = values
                self._measured[stamp] = values
                _keep_newest(self._measured)
        if not present:
            return
        found = self._pending.setdefault(stamp, set())
        found.add(topic)
        if len(found) == len(MEASURED):
            del self._pending[stamp]
            self.complete += 1
        _keep_newest(self._pending)

    def _judge(self, stamp: int, predicted: Wrench) -> None:
        measured = self._measured.get(stamp)
        if measured is None:
            return
        squares = [(p - m) ** 2 for p, m in zip(predicted, measured, strict=True)]
        if math.isfinite(sum(squares)):
            self._errors.append((stamp, sum(squares[:3]), sum(squares[3:])))
            while self._errors[0][0] < stamp - _JUDGED * 1e9:
                self._errors.popleft()


def _keep_newest(entries: dict[int, Any]) -> None:
    while len(entries) > _PENDING:
        del entries[next(iter(entries))]


def _order(data: bytes) -> str:
    """Byte order of a message, as `struct` writes it."""
    return "<" if data[1] & 1 else ">"


def _stamp(data: bytes) -> int:
    """Stamp of a message that begins with a header [ns]."""
    seconds, nanoseconds = struct.unpack_from(f"{_order(data)}iI", data, _HEADER)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A text, and where it ends [B]."""
    at = _aligned(at, 4)
    (length,) = struct.unpack_from(f"{_order(data)}I", data, at)
    end = at + 4 + length
    return bytes(data[at + 4 : end - 1]).decode("utf-8", "replace"), end


def _after_header(data: bytes) -> int:
    """Where the fields after a message's header (stamp, frame_id) begin [B]."""
    return _text(data, _HEADER + 8)[1]


def _last_doubles(data: bytes, count: int) -> tuple[float, ...]:
    """The numbers at the end of a message."""
    return struct.unpack_from(f"{_order(data)}{count}d", data, len(data) - 8 * count)


def _statuses(data: bytes) -> bytes:
    """Status of every channel in a ClusterCapacitanceArray."""
    at = _aligned(_after_header(data), 4)
    (clusters,) = struct.unpack_from(f"{_order(data)}I", data, at)
    at += 4
    found = b""
    for _ in range(clusters):
        _, at = _text(data, at)
        at = _aligned(at, 8) + 8 * _CHANNELS
        found += bytes(data[at : at + _CHANNELS])
        at += _CHANNELS
    return found


def _aligned(at: int, size: int) -> int:
    return at + (_HEADER - at) % size
