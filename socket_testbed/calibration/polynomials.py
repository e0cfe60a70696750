"""Least squares for the polynomials of a cluster, and whether the stresses determine them."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.calibration.bench_data import STRESSES, scaled_stress
from socket_testbed.calibration.model import ClusterCalibration, channel_features, shear_terms
from socket_testbed.errors import CalibrationError
from socket_testbed.samples import Status

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
    """Fit a cluster's calibration, with the range of capacitances that it covers.

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


_LEAST_ROWS = 30  # five per coefficient of a shear stress
_LEAST_SPANS = (1000.0, 200.0, 200.0)  # [Pa]; less is noise, or in another unit
_LEAST_INDEPENDENCE = 0.01  # [-] RMS of a term that the others do not explain
_ROUNDING = 1e-12  # [-]

# The second-degree terms of the shear: what their lack means and what fixes it.
_SECOND_DEGREE = (
    ("shear_x takes too few values for its square", "apply shear_x at three sizes or more"),
    (
        "shear_x and shear_y are never applied together",
        "apply them together, along and against each other, too",
    ),
    ("shear_y takes too few values for its square", "apply shear_y at three sizes or more"),
)


def check_excitation(stress: FloatArray, where: str) -> None:
    """Refuse bench data that does not determine the coefficients.

    Args:
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].
        where: The data, for the error.

    Raises:
        CalibrationError: If there are too few rows or a stress is missing, naming it.
    """
    if len(stress) < _LEAST_ROWS:
        raise CalibrationError(
            f"{where}: {len(stress)} readings are too few for 14 coefficients",
            f"give {_LEAST_ROWS} or more; several bench files may be given",
        )
    for name, values, least in zip(STRESSES, stress.T, _LEAST_SPANS, strict=True):
        if np.ptp(values) < least:
            raise CalibrationError(
                f"{where}: {name} spans only {np.ptp(values):.3g} Pa, less than {least:g} Pa",
                f"apply {name}, or name its true unit with --units {name}=UNIT",
            )
    terms = excitation_terms(stress)
    lack = find_lack(terms.T @ terms, len(terms))
    if lack is not None:
        raise CalibrationError(f"{where}: {lack[0]}", lack[1])


def excitation_terms(stress: FloatArray) -> FloatArray:
    """Terms that the stresses must distinguish, of scaled stresses, shape (N, 7) [-].

    They are 1, the three stresses n, x, y, and the second degree of the shear, x^2, xy, y^2.
    """
    n, x, y = scaled_stress(stress).T
    return np.column_stack([np.ones_like(n), n, x, y, x**2, x * y, y**2])


def find_lack(products: FloatArray, rows: int) -> tuple[str, str] | None:
    """What keeps some stresses from determining the polynomials, and the hint.

    A term is determined if the others do not explain it: the linear ones of all three
    stresses, since a stress that always comes with another cannot be separated from it, and the
    second-degree ones of the shear.

    Args:
        products: Products of the `excitation_terms`, summed over the rows, shape (7, 7) [-].
        rows: Number of the rows.

    Returns:
        The fact and the hint; None if nothing is lacking.
    """
    moments = products / max(rows, 1)
    alone = _independent_parts(moments[:4, :4])
    for axis, name in enumerate(STRESSES, start=1):
        if alone[axis] >= _LEAST_INDEPENDENCE:
            continue
        if moments[axis, axis] - moments[0, axis] ** 2 < _LEAST_INDEPENDENCE**2:
            return f"{name} hardly changes", f"apply {name} in more of the readings"
        others = " and ".join(other for other in STRESSES if other != name)
        return (
            f"{name} always goes with {others}",
            f"apply {name} while the others stay as they are, too",
        )
    alone = _independent_parts(np.delete(np.delete(moments, 1, axis=0), 1, axis=1))
    lacking = np.flatnonzero(alone[3:] < _LEAST_INDEPENDENCE)
    return _SECOND_DEGREE[lacking[0]] if len(lacking) else None


def _independent_parts(moments: FloatArray) -> FloatArray:
    """RMS of what the other terms leave of each: a Schur complement per term."""
    regular = moments + _ROUNDING * np.eye(len(moments))
    return np.asarray(1.0 / np.sqrt(np.diag(np.linalg.inv(regular))))
