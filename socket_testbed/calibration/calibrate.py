"""From bench data to a cluster's calibration, its quality, and its section of the file.

Errors are given on the data of the fit and on held-out groups. Stresses and residuals (calibrated
minus known stress) have shape (N, 3) [Pa]: normal, shear x and shear y. Branches and cycles are
those of the load, see `find_branches` and `cycle_ids`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from scipy.ndimage import median_filter
from scipy.special import stdtrit

from socket_testbed.arrays import UPPER_QUANTILE, BoolArray, FloatArray, IntArray
from socket_testbed.calibration import fit
from socket_testbed.calibration.bench_data import STRESSES, UNNAMED, BenchData, scaled_stress
from socket_testbed.calibration.drift import DRIFT_LIMIT, Drift
from socket_testbed.calibration.model import MIN_GAIN, ClusterCalibration
from socket_testbed.errors import CalibrationError

_MIN_CYCLE = 0.25  # of the load's span
_MIN_BRANCH = 0.2  # of full scale
_END_MARGIN = 0.05  # of a branch at either end, where the stress may dwell
RISING, FALLING, NEITHER = 1, -1, 0
_LEVEL = 0.1  # of full scale; stresses within one level count as equal
_ZERO_TOLERANCE = 0.02  # of full scale; smaller stresses count as zero
_UP_AND_DOWN = pd.MultiIndex.from_product([("mean", "size"), (RISING, FALLING)])


def stress_errors(known: FloatArray, predicted: FloatArray, full_scale: FloatArray) -> pd.DataFrame:
    """Errors by stress: `rmse` and `mae` [Pa], `r2` [-], and the RMSE in `percent` of full scale.

    R^2 is the explained fraction of the known stress's variance. The table has a row per stress:
    `normal`, `shear_x` and `shear_y`.

    Args:
        known: Known stresses: normal, shear x and shear y, shape (N, 3) [Pa].
        predicted: Stresses by a calibration in these rows, shape (N, 3) [Pa].
        full_scale: Full scale of each stress, shape (3,) [Pa], see `BenchData.full_scale`.
    """
    residual = predicted - known
    rmse = np.sqrt(np.mean(residual**2, axis=0))
    errors = {
        "rmse": rmse,
        "mae": np.mean(np.abs(residual), axis=0),
        "r2": 1.0 - rmse**2 / np.var(known, axis=0),
        "percent": 100.0 * rmse / full_scale,
    }
    return pd.DataFrame(errors, index=STRESSES)


def quality_figures(
    bench: BenchData, fitted: FloatArray, unseen: FloatArray, branches: IntArray, cycles: IntArray
) -> pd.DataFrame:
    """Quality figures of each stress [% of full scale], from training and held-out residuals.

    Rows belong to the same cell if all three stresses lie within the same tenth of full scale.

    - `hysteresis`: difference of the mean residuals of rising and falling rows in a cell, averaged
      over the cells at each level of the stress; the largest level counts. NaN if the stress never
      rose and fell through the same cell.
    - `repeatability`: standard deviation between cycles of their mean residuals in a cell, on the
      same branch, pooled over all cells visited by at least two cycles; NaN without such a cell.
    - `cross_talk`: apparent normal stress under pure shear, and apparent shear under pure normal
      stress: the largest mean held-out residual of a cell. A row is pure if its loading stress is
      at least 10 % of full scale and the others are at most 2 %; pure shear may combine x and y.
      NaN without a pure row.

    Args:
        bench: The N readings that are judged.
        fitted: Residuals of the fit, calibrated minus known stress, shape (N, 3) [Pa].
        unseen: Residuals of the fits without a row's own group, shape (N, 3) [Pa].
        branches: `RISING`, `FALLING` or `NEITHER` for each row and stress, shape (N, 3); see
            `find_branches`.
        cycles: Load cycle of each row, shape (N,); see `cycle_ids`.

    Returns:
        A row per stress: `normal`, `shear_x` and `shear_y`; a column per figure.
    """
    levels = np.round(bench.stress / (_LEVEL * bench.full_scale)).astype(np.int64)
    share = np.abs(bench.stress) / bench.full_scale
    small, loaded = share <= _ZERO_TOLERANCE, share >= _LEVEL
    by_normal = loaded[:, 0] & small[:, 1:].all(axis=1)
    by_shear = small[:, 0] & loaded[:, 1:].any(axis=1)
    rows = []
    for axis, pure in enumerate((by_shear, by_normal, by_normal)):
        cells = pd.DataFrame(levels, columns=STRESSES)  # zero lies inside a level
        cells["branch"], cells["cycle"] = branches[:, axis], cycles
        cells["fitted"], cells["unseen"] = fitted[:, axis], unseen[:, axis]
        on_branch = [*STRESSES, "branch"]
        by_branch = cells.groupby(on_branch)["fitted"].agg(["mean", "size"]).unstack("branch")
        both = by_branch.reindex(columns=_UP_AND_DOWN).dropna()
        # A cell counts by its rows on the branch that has fewer.
        weight = both["size"].min(axis=1)
        difference = both["mean", RISING] - both["mean", FALLING]
        level = STRESSES[axis]
        weighted_sum = (difference * weight).groupby(level).sum()
        mean_difference = weighted_sum / weight.groupby(level).sum()
        hysteresis = mean_difference.abs().max()

        means = cells.groupby([*on_branch, "cycle"])["fitted"].mean()
        by_cell = means.groupby(on_branch)
        freedom = (by_cell.size() - 1).sum() or np.nan
        deviation = means - by_cell.transform("mean")
        repeatability = np.sqrt((deviation**2).sum() / freedom)

        apparent = cells[pure].groupby([*STRESSES])["unseen"].mean()
        cross_talk = apparent.abs().max()
        rows.append((hysteresis, repeatability, cross_talk))
    figures = 100.0 * np.array(rows) / bench.full_scale[:, None]
    return pd.DataFrame(figures, STRESSES, ["hysteresis", "repeatability", "cross_talk"])


def find_extremes(values: FloatArray, threshold: float) -> IntArray:
    """Indices of alternating minima and maxima that differ by at least a threshold, ascending.

    A single index if the signal never moves that far.

    Args:
        values: The signal in any unit, shape (N,), without NaN.
        threshold: Smallest difference between an extreme and the next, in the signal's unit.
    """
    extremes: list[int] = []
    lowest = highest = direction = 0
    for i, value in enumerate(values.tolist()):
        lowest = i if value < values[lowest] else lowest
        highest = i if value > values[highest] else highest
        if direction <= 0 and value - values[lowest] >= threshold:
            extremes.append(lowest)
            direction, highest = 1, i
        elif direction >= 0 and values[highest] - value >= threshold:
            extremes.append(highest)
            direction, lowest = -1, i
    extremes.append(highest if direction > 0 else lowest)
    return np.array(extremes, dtype=np.int64)


def _find_cycles(stress: FloatArray) -> IntArray:
    """Load cycles of one file, numbered from 0, from one minimum of the load to the next, (N,).

    The load is the norm of the `scaled_stress` of the file's readings, shape (N, 3) [Pa].
    """
    load = median_filter(np.linalg.norm(scaled_stress(stress), axis=1), 3)  # removes spikes
    extremes = find_extremes(load, _MIN_CYCLE * float(np.ptp(load)))
    inner = extremes[1:-1]
    low = inner[load[inner] < load[extremes[:-2]]]
    return np.searchsorted(low, np.arange(len(load)), side="right").astype(np.int64)


def cycle_ids(bench: BenchData) -> IntArray:
    """Cycle of each row over all files, shape (N,): named in the file, or found from the load.

    Cycles are numbered from 0 through all files. A single name for all rows of a file is ignored.
    """
    cycles = pd.DataFrame({"file": bench.file, "cycle": bench.cycle})
    for file in np.unique(bench.file):
        rows = np.flatnonzero(bench.file == file)
        if (bench.cycle[rows] == UNNAMED).any() or np.ptp(bench.cycle[rows]) == 0:
            cycles.loc[rows, "cycle"] = _find_cycles(bench.stress[rows])
    return cycles.groupby(["file", "cycle"]).ngroup().to_numpy()


def find_branches(bench: BenchData) -> IntArray:
    """Whether each stress is rising, falling or neither in each row, shape (N, 3).

    The values are `RISING`, `FALLING` and `NEITHER`, the last also where the stress turns or
    dwells.
    """
    branches = np.full(bench.stress.shape, NEITHER)
    for file in range(len(bench.files)):
        rows = np.flatnonzero(bench.file == file)
        for axis, threshold in enumerate((_MIN_BRANCH * bench.full_scale).tolist()):
            values = bench.stress[rows, axis]
            for start, end in pairwise(find_extremes(values, threshold)):
                travel = values[end] - values[start]
                progress = (values[start:end] - values[start]) / travel
                moving = (progress > _END_MARGIN) & (progress < 1.0 - _END_MARGIN)
                branches[rows[start:end][moving], axis] = RISING if travel > 0.0 else FALLING
    return branches


_MIN_GROUPS = 3
_BLOCK_COUNT = 10


@dataclass(frozen=True)
class Groups:
    """Readings to hold out together, because neighbours are correlated.

    Attributes:
        unit: Kind of group: `file`, `cycle` or `block`.
        ids: Group of each reading, 0 to G - 1, shape (N,).
    """

    unit: str
    ids: IntArray

    def __len__(self) -> int:
        return int(self.ids.max()) + 1

    @cached_property
    def rows(self) -> list[IntArray]:
        """Indices of the readings in each of the G groups, ascending."""
        order = np.argsort(self.ids, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.ids))[:-1])

    def __str__(self) -> str:
        return f"{len(self)} {self.unit}s"


@dataclass(frozen=True)
class CrossValidation:
    """Leave-one-group-out fits.

    Attributes:
        groups: The G groups of readings that were left out in turn.
        predicted: Stress of each reading by the fit without its group, shape (N, 3) [Pa].
        normal: Coefficients of the normal stress by the fit without each group, shape (G, 2)
            [Pa, Pa/pF]; columns as in `ClusterCalibration.normal`.
        shear: Coefficients of shear x and shear y by the fit without each group, shape (G, 2, 6)
            [Pa, Pa/pF, Pa/pF^2]; last axes as in `ClusterCalibration.shear`.
    """

    groups: Groups
    predicted: FloatArray
    normal: FloatArray
    shear: FloatArray


def choose_groups(bench: BenchData) -> Groups:
    """Choose the largest groups that can each be left out with the fit still determined.

    Three or more files, else three or more cycles (named in the file, or found from the load),
    else ten blocks of successive rows. If a cycle cannot be left out there is no fallback to
    blocks: blocks split cycles, and the held-out errors would be optimistic.
    """
    numbers = np.unique(bench.file, return_inverse=True)[1]  # outliers may be all of a file
    files, others = Groups("file", numbers), Groups("cycle", cycle_ids(bench))
    if len(others) < _MIN_GROUPS:
        others = Groups("block", np.arange(len(bench)) * _BLOCK_COUNT // len(bench))
    terms = fit.excitation_terms(bench.stress)
    products = terms.T @ terms
    for groups in (files, others) if len(files) >= _MIN_GROUPS else (others,):
        for rows in groups.rows:
            remaining = products - terms[rows].T @ terms[rows]
            if lack := fit.find_lack(remaining, len(bench) - len(rows)):
                refusal = CalibrationError(
                    f"without the {groups.unit} that starts at {bench.place(int(rows[0]))},"
                    f" {lack[0]}, so the fit cannot be checked on unseen data",
                    "repeat the loading of this part at least once",
                )
                break
        else:
            return groups
    raise refusal


def cross_validate(capacitance: FloatArray, stress: FloatArray, groups: Groups) -> CrossValidation:
    """Fit without each group in turn, and predict that group.

    Args:
        capacitance: Capacitances by channel, not by input, shape (N, 4) [pF].
        stress: Known normal stress (positive in compression), shear x and shear y, shape (N, 3)
            [Pa].
        groups: The group of each of the N readings.
    """
    normal_design, shear_design = fit.design_matrices(capacitance)
    predicted, fits = np.empty_like(stress), []
    for rows in groups.rows:
        normal, shear = fit.fit_polynomials(
            np.delete(capacitance, rows, axis=0), np.delete(stress, rows, axis=0)
        )
        predicted[rows, 0] = normal_design[rows] @ normal
        predicted[rows, 1:] = shear_design[rows] @ shear.T
        fits.append((normal, shear))
    normals, shears = zip(*fits, strict=True)
    return CrossValidation(groups, predicted, np.array(normals), np.array(shears))


def half_widths(full: FloatArray, without: FloatArray) -> FloatArray:
    """Half widths of 95 % confidence intervals by the jackknife over groups.

    ``t(0.975, G - 1) sqrt((G - 1) / G sum_g (b_g - b)^2)``, the variance CV3 of MacKinnon,
    Nielsen and Webb (2023), "Fast and reliable jackknife and bootstrap methods for
    cluster-robust inference", arXiv:2301.04527. Residuals may be correlated in any way within a
    group; groups are assumed independent. The intervals state how well this bench determines the
    coefficients, not whether the polynomial describes the sensor.

    Args:
        full: Coefficients b of the fit to all data, in any shape and unit.
        without: Coefficients b_g of the fits without each group, shape (G, *full.shape), in the
            unit of b.

    Returns:
        The half widths in the shape and unit of b.
    """
    count = len(without)
    variance = (count - 1) / count * ((without - full) ** 2).sum(axis=0)
    return np.asarray(stdtrit(count - 1, UPPER_QUANTILE) * np.sqrt(variance))


_MAX_DROPPED = 0.05  # [-]; beyond this they are not outliers but a different law


@dataclass(frozen=True)
class BenchCalibration:
    """A cluster's calibration with its quality.

    Attributes:
        cluster: The coefficients.
        bench: The N readings of the fit.
        sound: Which readings of `bench` are no outliers, shape (N,); all if outliers were dropped.
        outliers: Readings far from the rest; their rows count all readings, dropped ones included.
        dropped: Whether the outliers were left out of the fit and of `bench`.
        fitted: Stress of each reading by the calibration: normal, shear x and shear y, shape (N, 3)
            [Pa].
        cross_validation: The fits without each group, and their predictions of the group.
        training: `stress_errors` of `fitted` over all readings of the fit.
        held_out: `stress_errors` of the predictions in `cross_validation`, over all readings.
        normal_half_width: Half widths of the 95 % intervals of `cluster.normal`, shape (2,)
            [Pa, Pa/pF].
        shear_half_width: Half widths of the 95 % intervals of `cluster.shear`, shape (2, 6)
            [Pa, Pa/pF, Pa/pF^2].
        figures: `quality_figures` over the sound readings [% of full scale].
    """

    cluster: ClusterCalibration
    bench: BenchData
    sound: BoolArray
    outliers: tuple[fit.Outlier, ...]
    dropped: bool
    fitted: FloatArray
    cross_validation: CrossValidation
    training: pd.DataFrame
    held_out: pd.DataFrame
    normal_half_width: FloatArray
    shear_half_width: FloatArray
    figures: pd.DataFrame

    @property
    def full_scale(self) -> FloatArray:
        """Largest magnitude of each known stress in the sound rows, shape (3,) [Pa]."""
        return self.bench[self.sound].full_scale

    @property
    def stress_range(self) -> FloatArray:
        """Minimum and maximum of each known stress in the sound rows, shape (3, 2) [Pa]."""
        stress = self.bench.stress[self.sound]
        return np.column_stack([stress.min(axis=0), stress.max(axis=0)])

    def require_gain(self) -> None:
        """Refuse a normal stress that does not grow with the capacitance.

        Raises:
            CalibrationError: If its gain is less than `MIN_GAIN` [Pa/pF]; check the sign of the
                known stress, its unit, and outliers.
        """
        gain = self.cluster.normal[1]
        if gain < MIN_GAIN:
            raise CalibrationError(
                f"the gain of the normal stress comes out as {gain:g} Pa/pF, where compression"
                f" should give at least {MIN_GAIN:g}",
                "give compression as positive normal stress, and check units and outliers",
            )

    def above(self, limit: float) -> tuple[str, ...]:
        """Names of the stresses whose held-out RMSE exceeds a limit [% of full scale]."""
        return tuple(self.held_out.index[self.held_out["percent"] > limit])

    def require_accuracy(self, limit: float) -> None:
        """Refuse a calibration whose held-out RMSE exceeds a limit [% of full scale].

        Raises:
            CalibrationError: If one of the three stresses exceeds it.
        """
        errors = self.held_out.loc[[*self.above(limit)]]
        bad = [f"{e.Index} {e.percent:.1f} % ({e.rmse:.0f} Pa)" for e in errors.itertuples()]
        if bad:
            raise CalibrationError(
                f"the held-out RMSE exceeds {limit:g} % of the full scale: {', '.join(bad)}",
                "see --figure; --drop-outliers may help, and --force writes it anyway",
            )


def calibrate_bench(
    bench: BenchData, wiring: IntArray, wiring_stated: bool, drop_outliers: bool
) -> BenchCalibration:
    """Fit a cluster and assess the fit.

    Args:
        bench: The readings, already corrected for drift if it was measured.
        wiring: Converter input, 0 to 3, of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y), shape
            (4,).
        wiring_stated: Whether the user stated the wiring, so that it is kept even if the data
            contradicts it.
        drop_outliers: Whether to leave outliers out of the fit; otherwise they are only reported.

    Raises:
        CalibrationError: If the readings do not determine the coefficients, contradict a wiring
            that is not stated, or more than 5 % of them would be dropped.
    """
    fit.check_excitation(bench.stress, ", ".join(bench.files))
    if not wiring_stated:
        fit.require_wiring(bench, wiring)
    fit.fit_polynomials(bench.capacitance[:, wiring], bench.stress)  # refuses singular data
    outliers = fit.find_outliers(bench, wiring)
    sound = np.ones(len(bench), dtype=bool)
    sound[[outlier.row for outlier in outliers]] = False
    if drop_outliers:
        if len(outliers) > _MAX_DROPPED * len(bench):
            raise CalibrationError(
                f"{len(outliers)} of {len(bench)} readings would be dropped, more than"
                f" {100 * _MAX_DROPPED:g} %: these are not outliers",
                "inspect them with --figure, and omit --drop-outliers",
            )
        bench, sound = bench[sound], sound[sound]
    cluster = fit.fit_cluster(bench.capacitance, bench.stress, wiring, sound)
    fitted = fit.predict_stress(cluster, bench.capacitance)
    checked = cross_validate(bench.capacitance[:, wiring], bench.stress, choose_groups(bench))
    kept = bench[sound]
    full_scale = kept.full_scale
    residual, unseen = ((s - bench.stress)[sound] for s in (fitted, checked.predicted))
    cycles = cycle_ids(bench)[sound]
    return BenchCalibration(
        cluster=cluster,
        bench=bench,
        sound=sound,
        outliers=outliers,
        dropped=drop_outliers,
        fitted=fitted,
        cross_validation=checked,
        training=stress_errors(bench.stress, fitted, full_scale),
        held_out=stress_errors(bench.stress, checked.predicted, full_scale),
        normal_half_width=half_widths(cluster.normal, checked.normal),
        shear_half_width=half_widths(cluster.shear, checked.shear),
        figures=quality_figures(kept, residual, unseen, find_branches(kept), cycles),
    )


_DIGITS = 4  # significant digits; a bench does not support more


def bench_record(
    calibrated: BenchCalibration, date: str, limit: float, forced: bool, found: Drift | None
) -> dict[str, Any]:
    """The `bench` entry in a cluster's section of `calibration.yaml`.

    Args:
        calibrated: The calibration with its quality.
        date: Date of the fit, such as 2026-01-31.
        limit: Largest accepted held-out RMSE [% of full scale].
        forced: Whether the cluster was accepted above the limit.
        found: Drift of the unloaded cluster over the bench run; None if it was not measured.
    """
    record: dict[str, Any] = {
        "date": date,
        "source": ", ".join(calibrated.bench.files),
        "readings": len(calibrated.bench),
        "units": "errors and stresses in Pa, percent of full_scale, intervals as coefficients",
        "forced": forced,
        "limit_percent": limit,
        "full_scale": _by_stress(calibrated.full_scale),
        "stress_range": _by_stress(calibrated.stress_range),
        "held_out_by": str(calibrated.cross_validation.groups),
        "held_out": calibrated.held_out.to_dict("index"),
        "training": calibrated.training.to_dict("index"),
        **calibrated.figures.add_suffix("_percent").to_dict(),
        "interval_95": {
            "normal": calibrated.normal_half_width,
            "shear_x": calibrated.shear_half_width[0],
            "shear_y": calibrated.shear_half_width[1],
        },
        "outliers": [outlier.place for outlier in calibrated.outliers],
        "outliers_dropped": calibrated.dropped,
    }
    if found is not None:
        record["drift"] = {
            "capacitance": found.capacitance,
            "stress": _by_stress(found.stress),
            "limit": DRIFT_LIMIT,
            "flagged": found.flagged,
        }
    return {**_plain(record), "limit_percent": limit}


def _by_stress(values: Iterable[Any]) -> dict[str, Any]:
    return dict(zip(STRESSES, values, strict=True))


def _plain(value: Any) -> Any:
    """Convert to YAML types: rounded numbers, lists, dictionaries; NaN becomes None."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | np.ndarray):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value
