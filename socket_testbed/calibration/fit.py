"""From bench data to a cluster's polynomials: excitation, wiring, outliers and least squares.

Throughout, capacitances have the shape (N, 4) [pF], by channel or by input of the converter,
stresses (N, 3) [Pa]: normal (positive in compression), shear x and shear y. A wiring, shape (4,),
names the input that holds each channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.calibration.bench_data import STRESSES, BenchData, scaled_stress
from socket_testbed.calibration.model import ClusterCalibration, channel_features, shear_terms
from socket_testbed.errors import CalibrationError
from socket_testbed.samples import Status

_NOTHING = 1e-12  # [pF], [pF^2]


def design_matrices(capacitance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Terms of the normal stress, shape (N, 2), and of each shear stress, shape (N, 6)."""
    mean, along_x, along_y = channel_features(capacitance)
    return np.stack([np.ones_like(mean), mean], axis=-1), shear_terms(along_x, along_y)


def fit_polynomials(capacitance: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients `normal`, shape (2,), and `shear`, shape (2, 6), of a `ClusterCalibration`."""
    of_mean, of_differences = design_matrices(capacitance)
    normal = _solve(of_mean, stress[:, :1])[:, 0]
    return normal, _solve(of_differences, stress[:, 1:]).T


def _solve(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares, (p, m); the columns are brought to one size, because pF^2 are not pF."""
    scale = np.sqrt((design**2).mean(axis=0))
    scale = np.where(scale > _NOTHING, scale, 1.0)  # rounding must not be blown up to a term
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

    The range of the pair differences is the one that both of them went through.
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
    """Stress that a calibration gives, inside of its range and outside, shape (N, 3) [Pa]."""
    return cluster.apply(capacitance, np.full(capacitance.shape, Status.OK, dtype=np.uint8))[0]


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
    """Refuse bench data that does not determine the coefficients."""
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
    """The reason why some stresses do not determine the polynomials, and the hint; None if they do.

    A term is determined if the others do not explain it: the linear ones of all three
    stresses, since a stress that always comes with another cannot be separated from it, and the
    second-degree ones of the shear. The products of the `excitation_terms`, shape (7, 7) [-], are
    summed over the rows.
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


_CORNERS = np.sign(np.column_stack(channel_features(np.eye(4))[1:]))  # (4, 2), sides of channels
_LEAST_RESPONSE = 0.1  # [-] of the inputs' variance; less is noise
_BULK = (1.0, 99.0)  # [%]; a spike beyond them must not decide


def find_wiring(capacitance: FloatArray, stress: FloatArray) -> IntArray:
    """Find the wiring for which a shear stress raises the channels on its own side."""
    slopes = np.linalg.lstsq(*_response(capacitance, stress), rcond=None)[0][2:]
    slopes = slopes - slopes.mean(axis=1, keepdims=True)
    slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12)
    return linear_sum_assignment(_CORNERS @ slopes, maximize=True)[1].astype(np.int64)


def _response(capacitance: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The design matrix of the scaled stresses, (N, 4), and the inputs without spikes, (N, 4)."""
    design = np.column_stack([np.ones(len(stress)), scaled_stress(stress)])
    return design, np.clip(capacitance, *np.percentile(capacitance, _BULK, axis=0))


def require_wiring(bench: BenchData, wiring: IntArray) -> None:
    """Refuse a default wiring that the bench data contradicts."""
    files = ", ".join(bench.files)
    design, inputs = _response(bench.capacitance, bench.stress)
    differences = inputs - inputs.mean(axis=1, keepdims=True)

    def unexplained(columns: FloatArray) -> float:
        fitted = columns @ np.linalg.lstsq(columns, differences, rcond=None)[0]
        return float(((differences - fitted) ** 2).sum())

    for axis, name in enumerate(STRESSES[1:], start=1):
        without = unexplained(np.delete(design, 1 + axis, axis=1))
        if 1.0 - unexplained(design) / max(without, 1e-300) < _LEAST_RESPONSE:  # a partial R^2
            raise CalibrationError(
                f"{files}: no input follows {name}, of {bench.full_scale[axis]:.0f} Pa at most:"
                " it is no more than noise",
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


_SCALES = 5.0  # residuals beyond as many scaled median absolute deviations
_MAD = 1.4826  # [-] makes the median absolute deviation of normal noise its standard deviation
_LEAST = 0.05  # [-] of the full scale; a smaller residual does no harm
_LOADED = 0.1  # [-] of the full scale; many rows at rest would make any load an outlier
_KEPT = 0.9  # [-] of the rows that the robust fit looks at
_STARTS, _START_ROWS, _STEPS, _MOST_ROWS = 30, 24, 22, 3000


@dataclass(frozen=True)
class Outlier:
    """A reading far from the robust fit."""

    row: int  # of the bench data
    place: str  # file and line
    axis: int  # the stress that is farthest off, in scaled deviations: 0, 1 or 2
    known: float  # [Pa]
    fitted: float  # [Pa]; by the robust fit


def find_outliers(bench: BenchData, wiring: IntArray) -> tuple[Outlier, ...]:
    """Find readings whose residual exceeds five scaled median absolute deviations.

    The residuals are those of a polynomial of total degree 2 in the mean and the differences,
    by least trimmed squares over 90 % of the rows (Rousseeuw and Van Driessen 2006,
    doi:10.1007/s10618-005-0024-4), which neither a wrong stress nor a wrong capacitance can
    pull to itself. The deviation is taken over the loaded rows, and residuals below 5 % of the
    full scale never count.
    """
    basis = _rich_basis(bench.capacitance[:, wiring])
    fitted = basis @ np.column_stack([_fit_least_trimmed(basis, y) for y in bench.stress.T])
    residual = np.abs(fitted - bench.stress)
    excess = residual / _limits(residual, bench.stress)
    farthest = excess.argmax(axis=1)
    return tuple(
        Outlier(row, bench.place(row), axis, float(bench.stress[row, axis]), fitted[row, axis])
        for row in np.flatnonzero((excess > 1.0).any(axis=1)).tolist()
        for axis in (int(farthest[row]),)
    )


def _rich_basis(capacitance: FloatArray) -> FloatArray:
    """Orthonormal basis of all terms up to total degree 2 of mean and differences, (N, 10).

    What a calibration's polynomials miss, such as a normal stress that makes a difference, is no
    reason to call a reading an outlier.
    """
    mean, along_x, along_y = channel_features(capacitance)
    of_differences = shear_terms(along_x, along_y)
    terms = np.column_stack([of_differences, mean[:, None] * of_differences[:, :3], mean**2])
    return np.linalg.qr(terms / np.abs(terms).max(axis=0))[0]


def _fit_least_trimmed(basis: FloatArray, target: FloatArray) -> FloatArray:
    """Coefficients, (p,), with the least sum of the smallest 90 % of the squared residuals."""
    rng = np.random.default_rng(0)
    if len(target) > _MOST_ROWS:
        some = rng.choice(len(target), _MOST_ROWS, replace=False)
        basis, target = basis[some], target[some]
    size, kept = min(_START_ROWS, len(target)), int(np.ceil(_KEPT * len(target)))
    starts = [rng.choice(len(target), size, replace=False) for _ in range(_STARTS)]
    least, best = np.inf, np.zeros(basis.shape[1])
    for rows in (np.arange(len(target)), *starts):
        for _ in range(_STEPS):  # fit some rows, take those that are fitted best, and again
            part = basis[rows]
            solution = np.linalg.lstsq(part.T @ part, part.T @ target[rows], rcond=None)[0]
            squares = (basis @ solution - target) ** 2
            rows = np.argpartition(squares, kept - 1)[:kept]  # noqa: PLW2901
        if squares[rows].sum() < least:
            least, best = float(squares[rows].sum()), solution
    return best


def _limits(residual: FloatArray, stress: FloatArray) -> FloatArray:
    """Largest residual of a sound reading, shape (3,) [Pa]."""
    loaded = (np.abs(scaled_stress(stress)) > _LOADED).any(axis=1)
    limits = _SCALES * _MAD * np.median(residual[loaded], axis=0)
    # Again without those found, because a wrong stress makes a wrong full scale.
    for _ in range(2):
        sound = (residual <= np.maximum(limits, _LEAST * np.abs(stress).max(axis=0))).all(axis=1)
        stress, residual = stress[sound], residual[sound]
    return np.maximum(limits, _LEAST * np.abs(stress).max(axis=0))
