"""The tares of a trial: what was subtracted from its wrenches, since when, and how old it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.load_cell.load_cell import in_words, iso_time
from socket_testbed.trials.synchronise import Measurements


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


def find_tares(measured: Measurements) -> list[RecordedTare]:
    """The tares of a trial in the order of its samples; empty if none is recorded."""
    known = np.flatnonzero(np.isfinite(measured.tares).all(axis=1))
    wrenches, taken, stamps = measured.tares[known], measured.tared[known], measured.stamps[known]
    new = np.ones(len(taken), dtype=bool)
    new[1:] = taken[1:] != taken[:-1]
    columns = wrenches[new], taken[new].tolist(), stamps[new].tolist()
    return [RecordedTare(*tare) for tare in zip(*columns, strict=True)]


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
