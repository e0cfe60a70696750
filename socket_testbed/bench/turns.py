"""Where a load turns: its cycles, and where a stress rises or falls."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.bench.bench_data import UNNAMED, BenchData, scaled_stress

_CYCLE = 0.25  # [-] of the load's span; what turns by less is no cycle
_BRANCH = 0.2  # [-] of the full scale; what turns by less is no loading
_ENDS = 0.05  # [-] of a branch at either end, where the stress may dwell

RISING, FALLING, NEITHER = 1, -1, 0


def find_turns(values: FloatArray, least: float) -> IntArray:
    """Indices of the extremes between which a signal moves by a least amount, in turn up and down.

    Args:
        values: The signal, shape (N,).
        least: Smallest move that counts.

    Returns:
        Indices from the first extreme to the last one; a single one if nothing moves so much.
    """
    turns: list[int] = []
    lowest = highest = direction = 0
    for i, value in enumerate(values.tolist()):
        lowest = i if value < values[lowest] else lowest
        highest = i if value > values[highest] else highest
        if direction <= 0 and value - values[lowest] >= least:
            turns.append(lowest)
            direction, highest = 1, i
        elif direction >= 0 and values[highest] - value >= least:
            turns.append(highest)
            direction, lowest = -1, i
    turns.append(highest if direction > 0 else lowest)
    return np.array(turns, dtype=np.int64)


def find_cycles(stress: FloatArray) -> IntArray:
    """Cycles of one file: from one low point of the load to the next.

    The load is the length of the stress in parts of each one's full scale.

    Args:
        stress: Normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Cycle of each row, 0, 1, ..., shape (N,).
    """
    load = median_filter(np.linalg.norm(scaled_stress(stress), axis=1), 3)  # a spike is no cycle
    turns = find_turns(load, _CYCLE * float(np.ptp(load)))
    low = [
        i for k, i in enumerate(turns) if 0 < k < len(turns) - 1 and load[i] < load[turns[k - 1]]
    ]
    return np.searchsorted(low, np.arange(len(load)), side="right").astype(np.int64)


def cycle_ids(bench: BenchData) -> IntArray:
    """Cycle of each row over all files, shape (N,): the file's own, or those that are found.

    One name for all rows of a file names no cycle.
    """
    ids = np.empty(len(bench), dtype=np.int64)
    first = 0
    for file in range(len(bench.files)):
        rows = np.flatnonzero(bench.file == file)
        named = (bench.cycle[rows] != UNNAMED).all() and np.ptp(bench.cycle[rows]) > 0
        cycles = bench.cycle[rows] if named else find_cycles(bench.stress[rows])
        _, ids[rows] = np.unique(cycles, return_inverse=True)
        ids[rows] += first
        first = int(ids[rows].max(initial=first - 1)) + 1
    return ids


def find_branches(bench: BenchData) -> IntArray:
    """Whether each stress is rising, falling or neither in each row, shape (N, 3)."""
    branches = np.full(bench.stress.shape, NEITHER)
    least = _BRANCH * bench.full_scale
    for file in range(len(bench.files)):
        rows = np.flatnonzero(bench.file == file)
        for axis in range(3):
            branches[rows, axis] = _branches_of(bench.stress[rows, axis], float(least[axis]))
    return branches


def _branches_of(values: FloatArray, least: float) -> IntArray:
    branches = np.full(len(values), NEITHER)
    turns = find_turns(values, least)
    for start, end in pairwise(turns):
        travel = values[end] - values[start]
        progress = (values[start:end] - values[start]) / travel
        moving = (progress > _ENDS) & (progress < 1.0 - _ENDS)
        branches[start:end][moving] = RISING if travel > 0.0 else FALLING
    return branches
