"""From bench data to a cluster's calibration and all that is to be known of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.bench.bench_data import BenchData
from socket_testbed.bench.columns import STRESSES
from socket_testbed.bench.excitation import check_excitation
from socket_testbed.bench.fit import fit_cluster, fit_polynomials, predict_stress
from socket_testbed.bench.held_out import (
    CrossValidation,
    choose_groups,
    cross_validate,
    half_widths,
)
from socket_testbed.bench.outliers import Outlier, check_droppable, find_outliers, rows_without
from socket_testbed.bench.quality import (
    StressErrors,
    hysteresis,
    repeatability,
    stress_errors,
)
from socket_testbed.bench.turns import NEITHER, cycle_ids, find_branches
from socket_testbed.bench.wiring import require_wiring
from socket_testbed.calibration import SMALLEST_GAIN, ClusterCalibration
from socket_testbed.errors import CalibrationError


@dataclass(frozen=True)
class BenchCalibration:
    """A cluster's calibration with its quality.

    Attributes:
        cluster: The calibration.
        bench: The data that it was fitted to.
        sound: Rows of it that are no outliers, shape (N,).
        outliers: Readings far from the rest.
        dropped: Whether they were left out of the fit and of `bench`.
        fitted: Stress by the calibration, shape (N, 3) [Pa].
        cross_validation: The fits without each group.
        training: Errors on the data of the fit, one a stress.
        held_out: Errors on data that the fit had not seen, one a stress.
        normal_half_width: Half widths of the 95 % intervals of `normal`, shape (2,).
        shear_half_width: The same of `shear`, shape (2, 6).
        branches: `find_branches` of the sound rows; no branch of the others, shape (N, 3).
        hysteresis: Gap between rising and falling, shape (3,) [% of the full scale].
        repeatability: Spread of the cycles, shape (3,) [% of the full scale].
    """

    cluster: ClusterCalibration
    bench: BenchData
    sound: BoolArray
    outliers: tuple[Outlier, ...]
    dropped: bool
    fitted: FloatArray
    cross_validation: CrossValidation
    training: tuple[StressErrors, ...]
    held_out: tuple[StressErrors, ...]
    normal_half_width: FloatArray
    shear_half_width: FloatArray
    branches: IntArray
    hysteresis: FloatArray
    repeatability: FloatArray

    @property
    def full_scale(self) -> FloatArray:
        """Largest size of each known stress in the sound rows, shape (3,) [Pa]."""
        return self.bench[self.sound].full_scale

    @property
    def stress_range(self) -> FloatArray:
        """Least and largest known stress in the sound rows, shape (3, 2) [Pa]."""
        stress = self.bench.stress[self.sound]
        return np.column_stack([stress.min(axis=0), stress.max(axis=0)])

    def require_gain(self) -> None:
        """Refuse a normal stress that does not grow with the capacitance.

        Raises:
            CalibrationError: If the gain is none that a calibration file may hold.
        """
        gain = self.cluster.normal[1]
        if gain < SMALLEST_GAIN:
            raise CalibrationError(
                f"the gain of the normal stress comes out as {gain:g} Pa/pF, where compression"
                f" should give at least {SMALLEST_GAIN:g}",
                "give compression as positive normal stress, and check units and outliers",
            )

    def above(self, limit: float) -> tuple[str, ...]:
        """Stresses whose held-out RMSE is above a limit [% of the full scale]."""
        pairs = zip(STRESSES, self.held_out, strict=True)
        return tuple(name for name, errors in pairs if errors.percent > limit)

    def require_accuracy(self, limit: float) -> None:
        """Refuse a calibration that predicts unseen data badly.

        Args:
            limit: Largest held-out RMSE [% of the full scale].

        Raises:
            CalibrationError: Naming the stresses with their errors.
        """
        errors = dict(zip(STRESSES, self.held_out, strict=True))
        bad = [
            f"{name} {errors[name].percent:.1f} % ({errors[name].rmse:.0f} Pa)"
            for name in self.above(limit)
        ]
        if bad:
            raise CalibrationError(
                f"the held-out RMSE exceeds {limit:g} % of the full scale: {', '.join(bad)}",
                "see --figure; --drop-outliers may help, and --force writes it all the same",
            )


def calibrate_bench(
    bench: BenchData, wiring: IntArray, wiring_stated: bool, drop_outliers: bool
) -> BenchCalibration:
    """Fit a cluster and judge the fit.

    Args:
        bench: The bench data.
        wiring: Input that holds each channel, shape (4,).
        wiring_stated: Whether somebody stated it for this bench, so that it stands even if the
            data contradicts it.
        drop_outliers: Whether outliers are left out.

    Raises:
        CalibrationError: If the data does not determine the fit or its check, contradicts the
            wiring, or would lose too many readings as outliers.
    """
    check_excitation(bench.stress, ", ".join(bench.files))
    if not wiring_stated:
        require_wiring(bench, wiring)
    fit_polynomials(bench.capacitance[:, wiring], bench.stress)  # refuses what is singular
    outliers = find_outliers(bench, wiring)
    sound = rows_without(bench, outliers)
    if drop_outliers:
        check_droppable(bench, outliers)
        bench, sound = bench[sound], sound[sound]
    return _judge(bench, wiring, outliers, drop_outliers, sound)


def _judge(
    bench: BenchData,
    wiring: IntArray,
    outliers: tuple[Outlier, ...],
    dropped: bool,
    sound: BoolArray,
) -> BenchCalibration:
    cluster = fit_cluster(bench.capacitance, bench.stress, wiring, sound)
    fitted = predict_stress(cluster, bench.capacitance)
    groups = choose_groups(bench)
    checked = cross_validate(bench.capacitance[:, wiring], bench.stress, groups)
    full_scale = bench[sound].full_scale
    residual = (fitted - bench.stress)[sound]
    branches = np.full(bench.stress.shape, NEITHER)
    branches[sound] = find_branches(bench[sound])
    return BenchCalibration(
        cluster=cluster,
        bench=bench,
        sound=sound,
        outliers=outliers,
        dropped=dropped,
        fitted=fitted,
        cross_validation=checked,
        training=stress_errors(bench.stress, fitted, full_scale),
        held_out=stress_errors(bench.stress, checked.predicted, full_scale),
        normal_half_width=half_widths(cluster.normal, checked.normal),
        shear_half_width=half_widths(cluster.shear, checked.shear),
        branches=branches,
        hysteresis=hysteresis(bench[sound], residual, branches[sound]),
        repeatability=repeatability(
            bench[sound], residual, branches[sound], cycle_ids(bench)[sound]
        ),
    )
