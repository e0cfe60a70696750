"""Errors of a calibration: against the known stresses, and held out in groups.

Throughout, stresses have the shape (N, 3) [Pa]: normal, shear x and shear y. A residual is the
calibrated less the known stress, likewise; branches and cycles are those of `drift`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.bench_data import STRESSES, BenchData
from socket_testbed.calibration.drift import FALLING, RISING, cycle_ids
from socket_testbed.calibration.fit import (
    design_matrices,
    excitation_terms,
    find_lack,
    fit_polynomials,
)
from socket_testbed.errors import CalibrationError

_LEVEL = 0.1  # [-] of the full scale; stresses within one level count as equal
_PURE = 0.02  # [-] of the full scale; a smaller stress counts as none


@dataclass(frozen=True)
class StressErrors:
    """Errors of one stress."""

    rmse: float  # Root-mean-square error [Pa]
    mae: float  # mean absolute error [Pa]
    r2: float  # part of the known stress's variance that is explained [-]
    percent: float  # the RMSE in percent of the full scale


def stress_errors(
    known: FloatArray, predicted: FloatArray, full_scale: FloatArray
) -> tuple[StressErrors, ...]:
    """Errors of the normal stress, shear x and shear y."""
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

    Returns:
        One figure per stress, shape (3,) [%]; NaN for one that did not rise and fall between
        equal stresses.
    """
    cells = _levels(bench)
    widest = np.full(3, np.nan)
    for axis, stress in enumerate(STRESSES):
        cells["residual"] = residual[:, axis]
        up, down = (
            cells[branches[:, axis] == branch]
            .groupby([*STRESSES])["residual"]
            .agg(["mean", "size"])
            .add_suffix(suffix)
            for branch, suffix in ((RISING, "_up"), (FALLING, "_down"))
        )
        both = up.join(down, how="inner")
        weight = both[["size_up", "size_down"]].min(axis=1)
        gap = (both["mean_up"] - both["mean_down"]) * weight
        gaps = gap.groupby(stress).sum() / weight.groupby(stress).sum()
        widest[axis] = 100.0 * gaps.abs().max() / bench.full_scale[axis]
    return widest


def repeatability(
    bench: BenchData, residual: FloatArray, branches: IntArray, cycles: IntArray
) -> FloatArray:
    """Spread of the cycles at equal stress on the same branch, in percent of the full scale.

    The standard deviation over the cycles of their mean residuals in a cell (see
    `hysteresis`), pooled over all cells that two cycles or more went through.

    Returns:
        One figure per stress, shape (3,) [%]; NaN for one that no two cycles repeated.
    """
    cells = _levels(bench).assign(cycle=cycles)
    spread = np.full(3, np.nan)
    for axis in range(3):
        cells["branch"], cells["residual"] = branches[:, axis], residual[:, axis]
        means = cells.groupby([*STRESSES, "branch", "cycle"])["residual"].mean()
        of_cell = means.groupby([*STRESSES, "branch"])
        freedom = (of_cell.size() - 1).sum()
        if freedom > 0:
            variance = ((means - of_cell.transform("mean")) ** 2).sum() / freedom
            spread[axis] = 100.0 * np.sqrt(variance) / bench.full_scale[axis]
    return spread


def cross_talk(bench: BenchData, residual: FloatArray) -> FloatArray:
    """Apparent normal stress under pure shear, and apparent shear under pure normal stress.

    A row is pure if the stress that loads it is at least a tenth of its full scale and the others
    are at most 2 % of theirs; of pure shear, x and y may come together. The mean residuals of the
    cells (see `hysteresis`) are compared, and the largest size counts.

    Returns:
        The apparent normal stress, shear x and shear y, shape (3,) [% of the full scale]; NaN
        without a pure row.
    """
    share, cells = np.abs(bench.stress) / bench.full_scale, _levels(bench)
    small, loaded = share <= _PURE, share >= _LEVEL
    by_normal = loaded[:, 0] & small[:, 1:].all(axis=1)
    by_shear = small[:, 0] & loaded[:, 1:].any(axis=1)
    found = np.empty(3)
    for axis, pure in enumerate((by_shear, by_normal, by_normal)):
        means = cells[pure].assign(residual=residual[pure, axis]).groupby([*STRESSES]).mean()
        found[axis] = 100.0 * means["residual"].abs().max() / bench.full_scale[axis]
    return found


def _levels(bench: BenchData) -> pd.DataFrame:
    """Level of each stress in each row; the one of no stress is not cut in two."""
    levels = np.round(bench.stress / (_LEVEL * bench.full_scale)).astype(np.int64)
    return pd.DataFrame(levels, columns=STRESSES)


_LEAST_GROUPS = 3
_BLOCKS = 10


@dataclass(frozen=True)
class Groups:
    """Readings that are held out together, because neighbours are correlated."""

    unit: str  # what a group is: file, cycle or block
    ids: IntArray  # group of each row, 0 to G - 1; (N,)

    def __len__(self) -> int:
        return int(self.ids.max()) + 1

    @cached_property
    def rows(self) -> list[IntArray]:
        """Rows of each group, in their order."""
        order = np.argsort(self.ids, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.ids))[:-1])

    def __str__(self) -> str:
        return f"{len(self)} {self.unit}s"


@dataclass(frozen=True)
class CrossValidation:
    """The fits without each group."""

    groups: Groups
    predicted: FloatArray  # stress of each row by the fit without its group; (N, 3) [Pa]
    normal: FloatArray  # coefficients `normal` of each fit; (G, 2) [Pa, Pa/pF]
    shear: FloatArray  # coefficients `shear` of each fit; (G, 2, 6) [Pa, Pa/pF, Pa/pF^2]


def choose_groups(bench: BenchData) -> Groups:
    """The largest groups without each of which the rest still determines the fit.

    Three files or more, else three cycles or more (the file's own, or found from the load), else
    ten blocks of successive rows. Cycles that cannot be left out are no reason to fall back to
    blocks: these would share their cycles and flatter the fit.
    """
    choice = None
    for groups in _candidates(bench):
        choice = _lack_of_rest(bench, groups)
        if choice is None:
            return groups
    assert choice is not None
    raise choice


def _candidates(bench: BenchData) -> Iterator[Groups]:
    files = Groups("file", bench.file)
    if len(files) >= _LEAST_GROUPS:
        yield files
    cycles = Groups("cycle", cycle_ids(bench))
    if len(cycles) >= _LEAST_GROUPS:
        yield cycles
    else:
        yield Groups("block", np.arange(len(bench)) * _BLOCKS // len(bench))


def _lack_of_rest(bench: BenchData, groups: Groups) -> CalibrationError | None:
    terms = excitation_terms(bench.stress)
    products = terms.T @ terms
    for rows in groups.rows:
        lack = find_lack(products - terms[rows].T @ terms[rows], len(bench) - len(rows))
        if lack is not None:
            return CalibrationError(
                f"without the {groups.unit} that starts at {bench.place(int(rows[0]))}, {lack[0]},"
                " so the fit cannot be checked on data it has not seen",
                "repeat the loading of this part at least once",
            )
    return None


def cross_validate(capacitance: FloatArray, stress: FloatArray, groups: Groups) -> CrossValidation:
    """Fit without each group in turn, and predict it."""
    of_mean, of_differences = design_matrices(capacitance)
    predicted, fits = np.empty_like(stress), []
    for rows in groups.rows:
        normal, shear = fit_polynomials(
            np.delete(capacitance, rows, axis=0), np.delete(stress, rows, axis=0)
        )
        predicted[rows, 0] = of_mean[rows] @ normal
        predicted[rows, 1:] = of_differences[rows] @ shear.T
        fits.append((normal, shear))
    normals, shears = zip(*fits, strict=True)
    return CrossValidation(groups, predicted, np.array(normals), np.array(shears))


def half_widths(full: FloatArray, without: FloatArray) -> FloatArray:
    """Half widths of 95 % confidence intervals by the jackknife over groups.

    ``t(0.975, G - 1) sqrt((G - 1) / G sum_g (b_g - b)^2)``, the variance CV3 of MacKinnon,
    Nielsen and Webb (2023), "Fast and reliable jackknife and bootstrap methods for
    cluster-robust inference", arXiv:2301.04527. The residuals within a group may be correlated
    in any way; those of different groups are taken as independent. It states how well this bench
    determines the coefficients, not whether the polynomial is the law of the sensor.

    Args:
        full: Coefficients of the fit to all data, any shape.
        without: Coefficients of the fits without each group, shape (G, ...).
    """
    count = len(without)
    variance = (count - 1) / count * ((without - full) ** 2).sum(axis=0)
    return np.asarray(stdtrit(count - 1, 0.975) * np.sqrt(variance))
