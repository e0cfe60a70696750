"""The tares of a trial: what was subtracted from its wrenches, since when, and how old it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.load_cell.load_cell import in_words, iso_time
from socket_testbed.trials.bag import BagReader
from socket_testbed.wire import cdr
from socket_testbed.wire.messages import Reader
from socket_testbed.wire.topics import LOAD_CELL_RAW, match_topics


@dataclass(frozen=True)
class RecordedTare:
    """A tare that some wrenches of a trial have in common.

    Attributes:
        wrench: What was subtracted, [M; F] in {S}, shape (6,) [N m, N].
        taken: When it was taken, since the epoch [ns]; 0 if the load cell was never tared.
        since: Stamp of the first wrench that it was subtracted from, since the epoch [ns].
    """

    wrench: FloatArray
    taken: int
    since: int


def read_tares(bag: BagReader) -> list[RecordedTare]:
    """The tares of an open bag, in the order of its messages; empty if none is recorded."""
    name = match_topics(bag.types, str(bag.path)).get(LOAD_CELL_RAW, "")
    if bag.types.get(name) != LOAD_CELL_RAW.type:
        return []
    reader, found = Reader(LOAD_CELL_RAW, bag.path), list[RecordedTare]()
    for _, messages in bag.blocks([name]):
        for places, stamps, values in reader.parts(messages):
            wrenches = values[:, 6:]
            new = np.ones(len(wrenches), dtype=bool)
            new[1:] = (wrenches[1:] != wrenches[:-1]).any(axis=1)
            for row in np.flatnonzero(new).tolist():
                message = cdr.decode(messages[places[row]], LOAD_CELL_RAW.type)
                taken = cdr.nanoseconds(message.tared)
                if not found or found[-1].taken != taken:
                    found.append(RecordedTare(wrenches[row], taken, int(stamps[row])))
    return found


def tares_in_words(tares: Sequence[RecordedTare], first: int) -> list[str]:
    """A line for each tare.

    Args:
        tares: The tares of a trial.
        first: Stamp of its first sample since the epoch [ns].
    """
    lines = []
    for number, tare in enumerate(tares):
        since = f"from {1e-9 * (tare.since - first):.2f} s: " if number else ""
        if tare.taken == 0:
            lines.append(f"tare: {since}none, the load cell was never tared")
        else:
            lines.append(f"tare: {since}{in_words(tare.wrench)}, taken at {iso_time(tare.taken)}")
    return lines or ["tare: not recorded"]
