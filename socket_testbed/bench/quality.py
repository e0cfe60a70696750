"""Errors of a calibration against the known stresses, one stress at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.bench.bench_data import BenchData
from socket_testbed.bench.turns import FALLING, RISING

_LEVEL = 0.1  # [-] of the full scale; stresses within one level count as equal


@dataclass(frozen=True)
class StressErrors:
    """Errors of one stress.

    Attributes:
        rmse: Root-mean-square error [Pa].
        mae: Mean absolute error [Pa].
        r2: Part of the known stress's variance that is explained [-].
        percent: The RMSE in percent of the full scale.
    """

    rmse: float
    mae: float
    r2: float
    percent: float


def stress_errors(
    known: FloatArray, predicted: FloatArray, full_scale: FloatArray
) -> tuple[StressErrors, ...]:
    """Errors of the normal stress, shear x and shear y.

    Args:
        known: Known stresses, shape (N, 3) [Pa].
        predicted: What the calibration makes of the capacitances, shape (N, 3) [Pa].
        full_scale: Largest size of each known stress, shape (3,) [Pa].
    """
    columns = zip(known.T, predicted.T, full_scale.tolist(), strict=True)
    return tuple(_errors(*column) for column in columns)


def _errors(known: FloatArray, predicted: FloatArray, full_scale: float) -> StressErrors:
    residual = predicted - known
    rmse = float(np.sqrt(np.mean(residual**2)))
    return StressErrors(
        rmse=rmse,
        mae=float(np.mean(np.abs(residual))),
        r2=1.0 - rmse**2 / float(np.var(known)),
        percent=100.0 * rmse / full_scale,
    )


def hysteresis(bench: BenchData, residual: FloatArray, branches: IntArray) -> FloatArray:
    """Widest gap between rising and falling at equal stress, in percent of the full scale.

    Equal means that all three stresses lie within the same tenth of their full scales. In each
    such cell the mean residuals of the rising and of the falling rows are subtracted; the cells
    of one level of the stress in question are averaged, and the widest level counts.

    Args:
        bench: The bench data.
        residual: Calibrated minus known stress, shape (N, 3) [Pa].
        branches: `find_branches` of the data, shape (N, 3).

    Returns:
        One figure a stress, shape (3,) [%]; NaN for one that did not rise and fall between
        equal stresses.
    """
    levels = _levels(bench)
    _, cells = np.unique(levels, axis=0, return_inverse=True)
    cells = cells.ravel()
    widest = np.full(3, np.nan)
    for axis in range(3):
        up, rising = _means(cells, residual[:, axis], branches[:, axis] == RISING)
        down, falling = _means(cells, residual[:, axis], branches[:, axis] == FALLING)
        both = (rising > 0) & (falling > 0)
        if not both.any():
            continue
        level_of_cell = np.zeros(len(up), dtype=np.int64)
        level_of_cell[cells] = levels[:, axis] - levels[:, axis].min()
        weight = np.minimum(rising, falling)[both]
        total = np.bincount(level_of_cell[both], weight * (up - down)[both])
        weights = np.bincount(level_of_cell[both], weight)
        gaps = np.abs(total[weights > 0] / weights[weights > 0])
        widest[axis] = 100.0 * gaps.max() / bench.full_scale[axis]
    return widest


def repeatability(
    bench: BenchData, residual: FloatArray, branches: IntArray, cycles: IntArray
) -> FloatArray:
    """Spread of the cycles at equal stress on the same branch, in percent of the full scale.

    The standard deviation over the cycles of their mean residuals in a cell (see
    `hysteresis`), pooled over all cells that two cycles or more went through.

    Args:
        bench: The bench data.
        residual: Calibrated minus known stress, shape (N, 3) [Pa].
        branches: `find_branches` of the data, shape (N, 3).
        cycles: `cycle_ids` of the data, shape (N,).

    Returns:
        One figure a stress, shape (3,) [%]; NaN for one that no two cycles repeated.
    """
    levels = _levels(bench)
    spread = np.full(3, np.nan)
    for axis in range(3):
        keys = np.column_stack([levels, branches[:, axis], cycles])
        visits, visit = np.unique(keys, axis=0, return_inverse=True)
        mean, _ = _means(visit.ravel(), residual[:, axis], np.ones(len(bench), dtype=bool))
        _, cell = np.unique(visits[:, :4], axis=0, return_inverse=True)
        centre, count = _means(cell.ravel(), mean, np.ones(len(mean), dtype=bool))
        freedom = (count - 1).sum()
        if freedom > 0:
            variance = ((mean - centre[cell.ravel()]) ** 2).sum() / freedom
            spread[axis] = 100.0 * np.sqrt(variance) / bench.full_scale[axis]
    return spread


def _levels(bench: BenchData) -> IntArray:
    """Level of each stress in each row; the one of no stress is not cut in two, shape (N, 3)."""
    return np.round(bench.stress / (_LEVEL * bench.full_scale)).astype(np.int64)


def _means(cells: IntArray, values: FloatArray, rows: BoolArray) -> tuple[FloatArray, IntArray]:
    """Mean of some rows in each cell, zero where there is none, and their number."""
    count = np.bincount(cells[rows], minlength=int(cells.max()) + 1)
    total = np.bincount(cells[rows], values[rows], minlength=len(count))
    return total / np.maximum(count, 1), count
