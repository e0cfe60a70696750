"""Cross-validation in groups of readings that belong together, and what it says of the fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.bench.bench_data import BenchData
from socket_testbed.bench.excitation import excitation_terms, find_lack
from socket_testbed.bench.fit import design_matrices
from socket_testbed.bench.turns import cycle_ids
from socket_testbed.errors import CalibrationError

_LEAST_GROUPS = 3
_BLOCKS = 10


@dataclass(frozen=True)
class Groups:
    """Readings that are held out together, because neighbours know of each other.

    Attributes:
        unit: What a group is: file, cycle or block.
        ids: Group of each row, 0 to G - 1, shape (N,).
    """

    unit: str
    ids: IntArray

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
    """What the fits without each group say.

    Attributes:
        groups: The groups.
        predicted: Stress of each row by the fit without its group, shape (N, 3) [Pa].
        normal: Coefficients `normal` of each fit, shape (G, 2) [Pa, Pa/pF].
        shear: Coefficients `shear` of each fit, shape (G, 2, 6) [Pa, Pa/pF, Pa/pF^2].
    """

    groups: Groups
    predicted: FloatArray
    normal: FloatArray
    shear: FloatArray


def choose_groups(bench: BenchData) -> Groups:
    """The largest groups without each of which the rest still determines the fit.

    Three files or more, else three cycles or more (the file's own, or found where the load
    turns), else ten blocks of successive rows. Cycles that cannot be left out are no reason to
    fall back to blocks: these would share their cycles and flatter the fit.

    Raises:
        CalibrationError: If the rest does not determine the fit, naming the group.
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
    """Fit without each group in turn, and predict it.

    Args:
        capacitance: Capacitances by channel, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].
        groups: The groups.
    """
    of_mean, of_differences = design_matrices(capacitance)
    normal = fit_without(of_mean, stress[:, :1], groups)[:, :, 0]
    shear = np.swapaxes(fit_without(of_differences, stress[:, 1:], groups), 1, 2)
    predicted = np.empty_like(stress)
    for group, rows in enumerate(groups.rows):
        predicted[rows, 0] = of_mean[rows] @ normal[group]
        predicted[rows, 1:] = of_differences[rows] @ shear[group].T
    return CrossValidation(groups, predicted, normal, shear)


def fit_without(design: FloatArray, target: FloatArray, groups: Groups) -> FloatArray:
    """Least squares without each group in turn, for the work of about one fit.

    With X = QR, the fit without the rows g solves ``(I - Qg'Qg) R b = Q'y - Qg'yg``, which is
    as well conditioned as the group lets it be.

    Args:
        design: Design matrix X, shape (N, p).
        target: Values to explain y, shape (N, m).
        groups: The groups.

    Returns:
        Coefficients without each group, shape (G, p, m).
    """
    scale = np.sqrt((design**2).mean(axis=0))
    q, r = np.linalg.qr(design / scale)
    seen = q.T @ target
    rotated = [
        np.linalg.lstsq(
            np.eye(len(r)) - q[rows].T @ q[rows], seen - q[rows].T @ target[rows], rcond=None
        )[0]
        for rows in groups.rows
    ]
    return np.asarray(np.linalg.solve(r, np.array(rotated)) / scale[:, None])


def half_widths(full: FloatArray, without: FloatArray) -> FloatArray:
    """Half widths of 95 % confidence intervals by the jackknife over groups.

    ``t(0.975, G - 1) sqrt((G - 1) / G sum_g (b_g - b)^2)``, the variance CV3 of MacKinnon,
    Nielsen and Webb (2023), "Fast and reliable jackknife and bootstrap methods for
    cluster-robust inference", arXiv:2301.04527. The residuals within a group may hang together
    in any way; those of different groups are taken as independent. It says how well this bench
    determines the coefficients, not whether the polynomial is the law of the sensor.

    Args:
        full: Coefficients of the fit to all data, any shape.
        without: Coefficients of the fits without each group, shape (G, ...).
    """
    count = len(without)
    variance = (count - 1) / count * ((without - full) ** 2).sum(axis=0)
    return np.asarray(stdtrit(count - 1, 0.975) * np.sqrt(variance))
