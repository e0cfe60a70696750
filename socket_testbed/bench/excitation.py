"""Whether the stresses that were applied on the bench determine the polynomials."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.bench.bench_data import scaled_stress
from socket_testbed.bench.columns import STRESSES
from socket_testbed.errors import CalibrationError

_LEAST_ROWS = 30  # five a coefficient of a shear stress
_LEAST_SPANS = (1000.0, 200.0, 200.0)  # [Pa]; less is noise, or in another unit
_LEAST_INDEPENDENCE = 0.01  # [-] RMS of a term that the others do not explain
_ROUNDING = 1e-12  # [-]

# The second-degree terms of the shear: what their lack means and what mends it.
_SECOND_DEGREE = (
    ("shear_x takes too few values for its square", "apply shear_x at three sizes or more"),
    (
        "shear_x and shear_y are never applied together",
        "apply them together, along and against each other, too",
    ),
    ("shear_y takes too few values for its square", "apply shear_y at three sizes or more"),
)


def check_excitation(stress: FloatArray, where: str) -> None:
    """Refuse bench data that says too little.

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
    """Terms that the stresses must tell apart, of scaled stresses, shape (N, 7) [-].

    They are 1, the three stresses n, x, y, and the second degree of the shear, x^2, xy, y^2.
    """
    n, x, y = scaled_stress(stress).T
    return np.column_stack([np.ones_like(n), n, x, y, x**2, x * y, y**2])


def find_lack(products: FloatArray, rows: int) -> tuple[str, str] | None:
    """What keeps some stresses from determining the polynomials, and its mend.

    A term is determined if the others do not explain it: the linear ones of all three
    stresses, since a stress that always comes with another cannot be told from it, and the
    second-degree ones of the shear.

    Args:
        products: Products of the `excitation_terms`, summed over the rows, shape (7, 7) [-].
        rows: Number of the rows.

    Returns:
        The fact and the mend; None if nothing is lacking.
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
    """RMS of what the other terms leave of each: a Schur complement a term."""
    regular = moments + _ROUNDING * np.eye(len(moments))
    return np.asarray(1.0 / np.sqrt(np.diag(np.linalg.inv(regular))))
