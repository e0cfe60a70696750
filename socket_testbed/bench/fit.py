"""Least squares for the polynomials that a `ClusterCalibration` applies, and their range."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.calibration import (
    ClusterCalibration,
    Status,
    channel_features,
    shear_terms,
)
from socket_testbed.errors import CalibrationError

_NOTHING = 1e-12  # [pF], [pF^2]


def design_matrices(capacitance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Terms of the normal stress, shape (N, 2), and of each shear stress, shape (N, 6).

    Args:
        capacitance: Capacitances by channel, shape (N, 4) [pF].
    """
    mean, along_x, along_y = channel_features(capacitance)
    return np.stack([np.ones_like(mean), mean], axis=-1), shear_terms(along_x, along_y)


def fit_polynomials(capacitance: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit first degree of the mean to the normal, total degree 2 of the differences to the shear.

    Args:
        capacitance: Capacitances by channel, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Coefficients `normal`, shape (2,), and `shear`, shape (2, 6), of a
        `ClusterCalibration`.

    Raises:
        CalibrationError: If the capacitances do not determine them.
    """
    of_mean, of_differences = design_matrices(capacitance)
    normal = solve_least_squares(of_mean, stress[:, 0])
    return normal, solve_least_squares(of_differences, stress[:, 1:]).T


def solve_least_squares(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares whose columns are brought to one size, because pF^2 are not pF.

    Args:
        design: Design matrix, shape (N, p).
        target: Values to explain, shape (N,) or (N, m).

    Returns:
        Coefficients, shape (p,) or (p, m).

    Raises:
        CalibrationError: If the design matrix is singular.
    """
    scale = np.sqrt((design**2).mean(axis=0))
    scale = np.where(scale > _NOTHING, scale, 1.0)  # rounding must not be blown up to a term
    solution, _, rank, _ = np.linalg.lstsq(design / scale, target, rcond=None)
    if rank < design.shape[1]:
        raise CalibrationError(
            "the four capacitances do not determine the coefficients: some of them always go"
            " together",
            "check that each of c0 to c3 is an input of its own",
        )
    return np.asarray((solution.T / scale).T)


def fit_cluster(
    capacitance: FloatArray, stress: FloatArray, wiring: IntArray, in_range: BoolArray
) -> ClusterCalibration:
    """Fit a cluster's calibration, with the range of capacitances that it is good for.

    The range of the pair differences is the one that both of them went through.

    Args:
        capacitance: Capacitances by input of the converter, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].
        wiring: Input that holds each channel, shape (4,).
        in_range: Rows that may widen the range, which no outlier should, shape (N,).

    Raises:
        CalibrationError: If the coefficients are not determined, or if the two differences
            share no range.
    """
    channels = capacitance[:, wiring]
    normal, shear = fit_polynomials(channels, stress)
    mean, along_x, along_y = channel_features(channels[in_range])
    differences = np.array([max(along_x.min(), along_y.min()), min(along_x.max(), along_y.max())])
    if differences[0] >= differences[1]:
        raise CalibrationError(
            f"the differences along x ({along_x.min():.3g} to {along_x.max():.3g} pF) and y"
            f" ({along_y.min():.3g} to {along_y.max():.3g} pF) share no range",
            "load the cluster along both directions and to both sides",
        )
    mean_range = np.array([mean.min(), mean.max()])
    return ClusterCalibration(normal, shear, mean_range, differences, wiring)


def predict_stress(cluster: ClusterCalibration, capacitance: FloatArray) -> FloatArray:
    """Stress that a calibration gives, inside of its range and outside, shape (N, 3) [Pa].

    Args:
        cluster: The calibration.
        capacitance: Capacitances by input, shape (N, 4) [pF].
    """
    stress, _ = cluster.apply(capacitance, np.full(capacitance.shape, Status.OK, dtype=np.uint8))
    return stress
