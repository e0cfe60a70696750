"""From bench data to a cluster's polynomials: excitation, wiring, outliers and least squares.

Capacitances have shape (N, 4) [pF], by channel or by converter input; stresses have shape
(N, 3) [Pa]: normal (positive in compression), shear x and shear y. A wiring, shape (4,), gives the
converter input of each channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, robust_deviation
from socket_testbed.calibration.bench_data import STRESSES, BenchData, scaled_stress
from socket_testbed.calibration.model import (
    SHEAR_SIGNS,
    ClusterCalibration,
    channel_features,
    shear_terms,
)
from socket_testbed.errors import CalibrationError
from socket_testbed.samples import Status

_ZERO = 1e-12  # [pF], [pF^2]


def design_matrices(capacitance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Terms of the normal stress, shape (N, 2), and of each shear stress, shape (N, 6).

    Those of the normal stress are 1 and the mean [pF] of the capacitances by channel, shape (N, 4)
    [pF]; those of a shear stress are its `SHEAR_TERMS` [pF^0..pF^2].
    """
    mean, along_x, along_y = channel_features(capacitance)
    return np.stack([np.ones_like(mean), mean], axis=-1), shear_terms(along_x, along_y)


def fit_polynomials(capacitance: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients `normal` and `shear` of a `ClusterCalibration` by least squares.

    Args:
        capacitance: Capacitances by channel, not by input, shape (N, 4) [pF].
        stress: Known normal stress (positive in compression), shear x and shear y, shape (N, 3)
            [Pa].

    Returns:
        Offset and gain of the normal stress, shape (2,) [Pa, Pa/pF], and the coefficients of
        `SHEAR_TERMS` for shear x and shear y, shape (2, 6) [Pa, Pa/pF, Pa/pF^2].

    Raises:
        CalibrationError: If the capacitances do not determine them.
    """
    normal_design, shear_design = design_matrices(capacitance)
    normal = _solve(normal_design, stress[:, :1])[:, 0]
    return normal, _solve(shear_design, stress[:, 1:]).T


def _solve(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares, (p, m); columns are scaled, since their units differ (pF, pF^2)."""
    scale = np.sqrt((design**2).mean(axis=0))
    scale = np.where(scale > _ZERO, scale, 1.0)  # do not amplify rounding errors
    solution, _, rank, _ = np.linalg.lstsq(design / scale, target, rcond=None)
    if rank < design.shape[1]:
        raise CalibrationError(
            "the four capacitances do not determine the coefficients: some of them always go"
            " together",
            "check that each of c0 to c3 is an input of its own",
        )
    return np.asarray(solution / scale[:, None])


def fit_cluster(
    capacitance: FloatArray, stress: FloatArray, wiring: IntArray, in_range: BoolArray
) -> ClusterCalibration:
    """Fit a cluster's calibration, with the range of capacitances that it covers.

    The range of the pair differences is the intersection of those along x and along y.

    Args:
        capacitance: Capacitances by input of the converter, shape (N, 4) [pF].
        stress: Known normal stress (positive in compression), shear x and shear y, shape (N, 3)
            [Pa].
        wiring: Converter input of each channel, shape (4,).
        in_range: Rows that count for the range, shape (N,); all rows count for the coefficients.

    Raises:
        CalibrationError: If the capacitances do not determine the coefficients, or the differences
            along x and y have no range in common.
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
    """Calibrated stress, including extrapolation out of range, shape (N, 3) [Pa].

    Its columns are normal (positive in compression), shear x and shear y.

    Args:
        cluster: The cluster's calibration.
        capacitance: Capacitances by input of the converter, shape (N, 4) [pF]; a row with NaN gives
            NaN.
    """
    return cluster.apply(capacitance, np.full(capacitance.shape, Status.OK, dtype=np.uint8))[0]


_MIN_ROWS = 30  # five per coefficient of a shear stress
_MIN_SPANS = (1000.0, 200.0, 200.0)  # [Pa]; less is noise, or has another unit
_MIN_INDEPENDENCE = 0.01  # RMS of a term not explained by the others [-]
_ROUNDING = 1e-12  # [-]

# Fact and hint if a second-degree shear term cannot be determined.
_SECOND_DEGREE = (
    ("shear_x takes too few values for its square", "apply at least three levels of shear_x"),
    (
        "shear_x and shear_y are never applied together",
        "also apply them together, with equal and with opposite signs",
    ),
    ("shear_y takes too few values for its square", "apply at least three levels of shear_y"),
)


def check_excitation(stress: FloatArray, where: str) -> None:
    """Refuse bench data that does not determine the coefficients.

    Args:
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].
        where: Start of every error, such as the files.

    Raises:
        CalibrationError: If there are fewer than 30 readings, a stress spans too little, or
            stresses are never applied independently; the hint says what to apply.
    """
    if len(stress) < _MIN_ROWS:
        raise CalibrationError(
            f"{where}: {len(stress)} readings are too few for 14 coefficients",
            f"give {_MIN_ROWS} or more; several bench files may be given",
        )
    for name, values, least in zip(STRESSES, stress.T, _MIN_SPANS, strict=True):
        if np.ptp(values) < least:
            raise CalibrationError(
                f"{where}: {name} spans only {np.ptp(values):.3g} Pa, less than {least:g} Pa",
                f"apply {name}, or give its true unit with --units {name}=UNIT",
            )
    terms = excitation_terms(stress)
    lack = find_lack(terms.T @ terms, len(terms))
    if lack is not None:
        raise CalibrationError(f"{where}: {lack[0]}", lack[1])


def excitation_terms(stress: FloatArray) -> FloatArray:
    """Terms of scaled stresses that the bench data must separate, shape (N, 7) [-].

    They are 1, n, x, y (the three stresses, each scaled by `scaled_stress`) and x^2, xy, y^2. The
    stresses are normal, shear x and shear y, shape (N, 3) [Pa].
    """
    n, x, y = scaled_stress(stress).T
    return np.column_stack([np.ones_like(n), n, x, y, x**2, x * y, y**2])


def find_lack(products: FloatArray, rows: int) -> tuple[str, str] | None:
    """Fact and hint if stresses do not determine the polynomials; None if they do.

    A term is determined unless the others explain it. This covers the linear terms of all three
    stresses, since stresses that always come together cannot be separated, and the second-degree
    terms of the shear.

    Args:
        products: Products of every two `excitation_terms`, summed over the rows, shape (7, 7) [-].
        rows: Number of rows summed.
    """
    moments = products / max(rows, 1)
    independent = _independent_parts(moments[:4, :4])
    for axis, name in enumerate(STRESSES, start=1):
        if independent[axis] >= _MIN_INDEPENDENCE:
            continue
        if moments[axis, axis] - moments[0, axis] ** 2 < _MIN_INDEPENDENCE**2:
            return f"{name} hardly changes", f"apply {name} in more of the readings"
        others = " and ".join(other for other in STRESSES if other != name)
        return (
            f"{name} always goes with {others}",
            f"also apply {name} while the others stay as they are",
        )
    independent = _independent_parts(np.delete(np.delete(moments, 1, axis=0), 1, axis=1))
    lacking = np.flatnonzero(independent[3:] < _MIN_INDEPENDENCE)
    return _SECOND_DEGREE[lacking[0]] if len(lacking) else None


def _independent_parts(moments: FloatArray) -> FloatArray:
    """RMS of each term after projecting out the others: a Schur complement per term."""
    regular = moments + _ROUNDING * np.eye(len(moments))
    return np.asarray(1.0 / np.sqrt(np.diag(np.linalg.inv(regular))))


_MIN_RESPONSE = 0.1  # of the inputs' variance; less is noise


def find_wiring(capacitance: FloatArray, stress: FloatArray) -> IntArray:
    """Find the wiring with which a shear stress raises the channels on its own side.

    Args:
        capacitance: Capacitances by input of the converter, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Converter input, 0 to 3, of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y), shape (4,).
    """
    from scipy.optimize import linear_sum_assignment  # 5 MB, which nodes need not hold

    slopes = np.linalg.lstsq(*_response(capacitance, stress), rcond=None)[0][2:]
    slopes = slopes - slopes.mean(axis=1, keepdims=True)
    slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12)
    return linear_sum_assignment(SHEAR_SIGNS.T @ slopes, maximize=True)[1].astype(np.int64)


def _response(capacitance: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Design matrix of the scaled stresses, (N, 4), and the inputs without glitches, (N, 4).

    A polynomial of total degree 2 in the stresses is fitted to each input by least trimmed squares.
    A reading is a glitch if it is farther from it than an outlier may be, and takes its value.
    """
    n, x, y = scaled_stress(stress).T
    design = np.column_stack([np.ones_like(n), n, x, y])
    basis = np.column_stack([design, n**2, x**2, y**2, n * x, n * y, x * y])
    expected = basis @ np.column_stack([_fit_least_trimmed(basis, c) for c in capacitance.T])
    off = np.abs(capacitance - expected)
    limits = np.maximum(
        _OUTLIER_LIMIT * robust_deviation(off), _MIN_RESIDUAL * np.ptp(expected, axis=0)
    )
    return design, np.where(off > limits, expected, capacitance)


def require_wiring(bench: BenchData, wiring: IntArray) -> None:
    """Refuse a default wiring that the bench data contradicts.

    Args:
        bench: The readings.
        wiring: Converter input of each channel, shape (4,).

    Raises:
        CalibrationError: If `find_wiring` finds another one (the hint states it), or no input
            responds to a shear stress.
    """
    files = ", ".join(bench.files)
    design, inputs = _response(bench.capacitance, bench.stress)
    differences = inputs - inputs.mean(axis=1, keepdims=True)

    def unexplained(columns: FloatArray) -> float:
        fitted = columns @ np.linalg.lstsq(columns, differences, rcond=None)[0]
        return float(((differences - fitted) ** 2).sum())

    for axis, name in enumerate(STRESSES[1:], start=1):
        without = unexplained(np.delete(design, 1 + axis, axis=1))
        if 1.0 - unexplained(design) / max(without, 1e-300) < _MIN_RESPONSE:  # a partial R^2
            raise CalibrationError(
                f"{files}: no input responds to {name}, at most {bench.full_scale[axis]:.0f} Pa,"
                " above the noise",
                f"apply {name} on the bench; the wiring and its coefficients need it",
            )
    found = find_wiring(bench.capacitance, bench.stress)
    if not np.array_equal(found, wiring):
        asked, better = (" ".join(map(str, inputs.tolist())) for inputs in (wiring, found))
        raise CalibrationError(
            f"{files}: the shear stresses do not raise the channels on their own"
            f" side with the wiring {asked}, but do with {better}",
            f"give --wiring {better}, or --wiring {asked} to keep it",
        )


_OUTLIER_LIMIT = 5.0  # [-]; in robust standard deviations
_MIN_RESIDUAL = 0.05  # of full scale; smaller residuals are harmless
_MIN_LOAD = 0.1  # of full scale; with many unloaded rows any load would be an outlier
_KEPT_FRACTION = 0.9  # of the rows, used by the robust fit
_STARTS, _START_ROWS, _STEPS, _MAX_ROWS = 30, 24, 22, 3000


@dataclass(frozen=True)
class Outlier:
    """A reading far from the robust fit.

    Attributes:
        row: Index of the reading in the bench data that was searched.
        place: File and line of the reading, in words.
        axis: Stress whose residual exceeds its limit most: 0 normal, 1 shear x, 2 shear y.
        known: Known value of this stress [Pa].
        fitted: Value of this stress by the robust fit [Pa].
    """

    row: int
    place: str
    axis: int
    known: float
    fitted: float


def find_outliers(bench: BenchData, wiring: IntArray) -> tuple[Outlier, ...]:
    """Find readings whose residual exceeds five scaled median absolute deviations.

    A polynomial of total degree 2 in the mean and the differences is fitted by least trimmed
    squares over 90 % of the rows (Rousseeuw and Van Driessen 2006,
    doi:10.1007/s10618-005-0024-4), so neither wrong stresses nor wrong capacitances pull the fit.
    The deviation is computed over the loaded rows; residuals below 5 % of full scale never count.

    Args:
        bench: The readings.
        wiring: Converter input of each channel, shape (4,).

    Returns:
        The outliers in the order of their rows, one per reading.
    """
    basis = _rich_basis(bench.capacitance[:, wiring])
    fitted = basis @ np.column_stack([_fit_least_trimmed(basis, y) for y in bench.stress.T])
    residual = np.abs(fitted - bench.stress)
    excess = residual / _limits(residual, bench.stress)
    worst = excess.argmax(axis=1)
    return tuple(
        Outlier(row, bench.place(row), axis, float(bench.stress[row, axis]), fitted[row, axis])
        for row in np.flatnonzero((excess > 1.0).any(axis=1)).tolist()
        for axis in (int(worst[row]),)
    )


def _rich_basis(capacitance: FloatArray) -> FloatArray:
    """Orthonormal basis of all terms up to total degree 2 of mean and differences, (N, 10).

    It is richer than the calibration's polynomials: effects that those omit, such as normal stress
    changing a difference, must not make a reading an outlier.
    """
    mean, along_x, along_y = channel_features(capacitance)
    shear = shear_terms(along_x, along_y)
    terms = np.column_stack([shear, mean[:, None] * shear[:, :3], mean**2])
    return np.linalg.qr(terms / np.abs(terms).max(axis=0))[0]


def _fit_least_trimmed(basis: FloatArray, target: FloatArray) -> FloatArray:
    """Coefficients, (p,), minimising the sum of the smallest 90 % of the squared residuals."""
    rng = np.random.default_rng(0)
    if len(target) > _MAX_ROWS:
        some = rng.choice(len(target), _MAX_ROWS, replace=False)
        basis, target = basis[some], target[some]
    size, kept = min(_START_ROWS, len(target)), int(np.ceil(_KEPT_FRACTION * len(target)))
    starts = [rng.choice(len(target), size, replace=False) for _ in range(_STARTS)]
    least, best = np.inf, np.zeros(basis.shape[1])
    for rows in (np.arange(len(target)), *starts):
        for _ in range(_STEPS):  # fit, keep the rows with the smallest residuals, repeat
            part = basis[rows]
            solution = np.linalg.lstsq(part.T @ part, part.T @ target[rows], rcond=None)[0]
            squares = (basis @ solution - target) ** 2
            rows = np.argpartition(squares, kept - 1)[:kept]  # noqa: PLW2901
        if squares[rows].sum() < least:
            least, best = float(squares[rows].sum()), solution
    return best


def _limits(residual: FloatArray, stress: FloatArray) -> FloatArray:
    """Residual limits for sound readings, shape (3,) [Pa]."""
    loaded = (np.abs(scaled_stress(stress)) > _MIN_LOAD).any(axis=1)
    limits = _OUTLIER_LIMIT * robust_deviation(residual[loaded])
    # Repeat without the outliers, because a wrong stress distorts the full scale.
    for _ in range(2):
        harmless = _MIN_RESIDUAL * np.abs(stress).max(axis=0)
        sound = (residual <= np.maximum(limits, harmless)).all(axis=1)
        stress, residual = stress[sound], residual[sound]
    return np.maximum(limits, _MIN_RESIDUAL * np.abs(stress).max(axis=0))
