r"""Moments of the gated displacements: all that Stage 2 needs of the data.

With S the N x 3n matrix of the gated displacements and Y the measured targets, Stage 2 needs
their means and the centred products :math:`S_c^T S_c` and :math:`S_c^T Y_c`. Nothing of size
6N x 3n is ever built: the wrench's quadratic term is :math:`(C^T W C) \circ (S^T S)`.
Centring before the product keeps the digits that a hold would lose afterwards.

There are two ways to the products, and `GatedMoments` takes the cheaper one. The direct way
multiplies S out for each set of rest positions. The other way uses that every column of S is
a function of one coordinate of q alone: with T the Chebyshev polynomials of the panels that
`GateSeries` divides each coordinate into, and B the coefficients of the gate, :math:`S = T B`. A
sample is in one panel of each coordinate, so that T has few entries in a row, however wide the
motion. The products :math:`T^T T` and :math:`T^T Y` are computed once; they hold for any rest
positions, and each further set costs nothing in the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.identification.contact import gated_displacement, gated_slope
from socket_testbed.identification.gate_series import GateSeries

Method = Literal["auto", "direct", "series"]

_BLOCK = 512  # rows; keeps the products within the cache at any N
LEAST_KEPT = 0.1  # [-]; of the products in any direction, where the noise is subtracted
_RIDGE = 1e-10  # [-]; of the mean product, which makes directions without data defined

# Times on one thread, by which `series_is_cheaper` compares the two ways.
_ELEMENT = 20.0  # [ns]; an element of S, or of the Chebyshev polynomials
_PRODUCT = 0.1  # [ns]; a multiplication in a product over the samples
_SMALL_PRODUCT = 0.2  # [ns]; a multiplication in a product of small matrices
_CELL, _CELL_PRODUCT = 2e4, 3.0  # [ns]; what a cell takes, and each product of its polynomials
_DIRECT_CALL, _SERIES_CALL = 5e4, 1.5e5  # [ns]; what a call takes at any size


@dataclass(frozen=True)
class Moments:
    """Moments of N rows of gated displacements S (N, p) and targets Y (N, m).

    Stacked moments of k sets have a first axis of length k in every array, the count included.

    Attributes:
        count: Number of rows N, shape () or (k,).
        mean: Means of S, shape (p,) [m].
        gram: Centred products of S with itself, shape (p, p) [m^2].
        target_mean: Means of Y, shape (m,).
        cross: Centred products of S with Y, shape (p, m).
        target_power: Centred sums of squares of Y, shape (m,).
        noise: What the noise of the pose adds to `gram`, shape (p, p) [m^2]: see `noise_products`.
            None where it is not to be subtracted.
    """

    count: int | IntArray
    mean: FloatArray
    gram: FloatArray
    target_mean: FloatArray
    cross: FloatArray
    target_power: FloatArray
    noise: FloatArray | None = None

    @property
    def corrected_gram(self) -> FloatArray:
        """`gram` without what the noise of the pose adds, shape (p, p) [m^2]."""
        if self.noise is None:
            return self.gram
        if self.gram.ndim == 2:
            return subtract_noise(self.gram, self.noise)
        pairs = zip(self.gram, self.noise, strict=True)
        return np.array([subtract_noise(gram, noise) for gram, noise in pairs])

    def about_zero(self) -> Moments:
        """The same moments without centring, as a model without offsets needs them."""
        count = np.asarray(self.count)[..., None]
        sums = count[..., None] * self.mean[..., None]
        return Moments(
            self.count,
            np.zeros_like(self.mean),
            self.gram + sums * self.mean[..., None, :],
            np.zeros_like(self.target_mean),
            self.cross + sums * self.target_mean[..., None, :],
            self.target_power + count * self.target_mean**2,
            self.noise,
        )

    def select(self, columns: slice, targets: slice) -> Moments:
        """The moments of some columns of S and some targets."""
        return Moments(
            self.count,
            self.mean[columns],
            self.gram[columns, columns],
            self.target_mean[targets],
            self.cross[columns, targets],
            self.target_power[targets],
            None if self.noise is None else self.noise[columns, columns],
        )

    def mean_square_residuals(self, rows: FloatArray, with_offset: bool) -> FloatArray:
        """Mean squares of the residuals ``Y - S rows^T``, of each target.

        They are differences of larger sums: a residual is known to 1e-8 of the spread of its
        target.

        Args:
            rows: What each target is predicted by, shape (m, p) [unit of the target over m].
            with_offset: Whether each target has the constant offset that suits it best.

        Returns:
            Array of shape (m,), in squares of the targets' units.
        """
        explained = ((rows @ self.gram) * rows).sum(axis=-1)
        common = (rows * self.cross.swapaxes(-1, -2)).sum(axis=-1)
        squares = (self.target_power - 2.0 * common + explained) / np.asarray(self.count)[..., None]
        squares = np.maximum(squares, 0.0)
        if not with_offset:
            squares += (self.target_mean - (rows @ self.mean[..., None])[..., 0]) ** 2
        return squares


def stack(sets: Sequence[Moments]) -> Moments:
    """Sets of moments, of a point's three columns and one target each, as one: see `Moments`."""

    def stacked(name: str, *shape: int) -> FloatArray:
        return np.array([getattr(of, name) for of in sets]).reshape(len(sets), *shape)

    noisy = any(of.noise is not None for of in sets)
    return Moments(
        np.array([of.count for of in sets], dtype=np.int64),
        stacked("mean", 3),
        stacked("gram", 3, 3),
        stacked("target_mean", 1),
        stacked("cross", 3, 1),
        stacked("target_power", 1),
        stacked("noise", 3, 3) if noisy else None,
    )


def noise_products(
    position: FloatArray, rest_positions: FloatArray, sharpness: float, covariance: FloatArray
) -> FloatArray:
    r"""What the noise of the limb position adds to the products of the gated displacements.

    To first order in the noise e, :math:`s(q + e) = s(q) + D e` with the slopes D = ds/dq, so that
    the expected products grow by :math:`\sum_k D_k \Sigma D_k^T` over the samples (Fuller,
    Measurement Error Models, 1987, 1.2).

    Args:
        position: Limb positions q, shape (N, 3) [m].
        rest_positions: Rest positions q_r, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        covariance: Covariance of the noise of one position, shape (3, 3) [m^2].

    Returns:
        Array of shape (3n, 3n) [m^2], ordered point by point.
    """
    points = len(rest_positions)
    products = np.zeros((3 * points, 3 * points))
    for start in range(0, len(position), _BLOCK):
        block = gated_slope(position[start : start + _BLOCK], rest_positions, sharpness)
        slopes = block.reshape(len(block), -1)
        products += slopes.T @ slopes
    return products * np.tile(covariance, (points, points))


def subtract_noise(gram: FloatArray, noise: FloatArray) -> FloatArray:
    r"""Products G without the share E of the noise: positive definite, so that a fit stays convex.

    In the directions u with :math:`E u = \mu G u`, the noise makes up the share mu of the products.
    At most 1 - `LEAST_KEPT` of them is subtracted: a share above that is not known well enough
    (noise is estimated to some percent), and more than all would make the program non-convex.

    Args:
        gram: Products G, positive semidefinite, shape (p, p).
        noise: What noise adds to them, E, positive semidefinite, shape (p, p).
    """
    regular = gram + _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    shares, directions = scipy.linalg.eigh(noise, regular)
    scaled = regular @ directions
    return np.asarray(gram - (scaled * np.clip(shares, 0.0, 1.0 - LEAST_KEPT)) @ scaled.T)


@dataclass(frozen=True)
class Group:
    """Targets that were measured in the same samples.

    Attributes:
        rows: Those samples, shape (N,).
        targets: The measured values in those samples, shape (rows, m).
        points: Indices of the points of interest whose displacements explain them, k of them.
    """

    rows: BoolArray
    targets: FloatArray
    points: Sequence[int]


class GatedMoments:
    """Moments of samples for any rest positions.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        groups: The targets, grouped by the samples in which they were measured.
        sets: How many sets of rest positions are expected.
        method: `direct` multiplies the displacements out, `series` goes through the Chebyshev
            series, `auto` takes for each group what `series_is_cheaper` names.
        noise: Covariance of the noise of a limb position, shape (3, 3) [m^2], for
            `Moments.noise`; None for none.
    """

    def __init__(
        self,
        position: FloatArray,
        sharpness: float,
        groups: Sequence[Group],
        sets: int = 1,
        method: Method = "auto",
        noise: FloatArray | None = None,
    ) -> None:
        self._position, self._sharpness, self._noise = position, sharpness, noise
        self._rows = [group.rows for group in groups]
        self._groups: list[tuple[list[int], Callable[[FloatArray], Moments]]] = []
        for group in groups:
            rows, points = position[group.rows], list(group.points)
            series = method == "series" or (
                method == "auto" and series_is_cheaper(rows, sharpness, len(points), sets)
            )
            kind = _Series if series else _Direct
            self._groups.append((points, kind(rows, sharpness, group.targets).moments))

    def at(self, rest_positions: FloatArray) -> tuple[Moments, ...]:
        """Moments of each group, with p = 3k columns ordered point by point.

        Args:
            rest_positions: Rest positions q_r of all points of interest, shape (n, 3) [m].
        """
        found = (moments(rest_positions[points]) for points, moments in self._groups)
        if (noise := self._noise) is None:
            return tuple(found)
        products = (
            noise_products(self._position[rows], rest_positions[points], self._sharpness, noise)
            for rows, (points, _) in zip(self._rows, self._groups, strict=True)
        )
        return tuple(replace(of, noise=e) for of, e in zip(found, products, strict=True))


def series_is_cheaper(position: FloatArray, sharpness: float, points: int, sets: int = 1) -> bool:
    """Whether the series costs less time than the direct products.

    The times are counted in elements and multiplications. Measured on one thread for 40 to
    5000 samples, 8 to 160 points, series of 10 to 250 terms and 1, 10 and 101 sets, the way
    that this rule takes is at most 22 % slower than the other one, and 1 % in the mean.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        points: Number n of points of interest.
        sets: How many sets of rest positions are expected.
    """
    rows, width = len(position), 3 * points
    series = GateSeries(position, sharpness)
    length, terms, cells = 3 * series.length, series.terms, min(series.cells, rows)
    direct = _DIRECT_CALL + rows * width * (_ELEMENT + _PRODUCT * width)
    once = _SERIES_CALL + rows * length * (_ELEMENT + _PRODUCT * length)
    once += cells * (_CELL + _CELL_PRODUCT * length**2) + _SMALL_PRODUCT * terms**2 * length
    each = _SERIES_CALL + _SMALL_PRODUCT * 2 * points * terms * (terms / 3 + points)
    return once + sets * each < sets * direct


class _Direct:
    """The displacements multiplied out for each set of rest positions: see `GatedMoments`."""

    def __init__(self, position: FloatArray, sharpness: float, targets: FloatArray) -> None:
        self._position, self._sharpness = position, sharpness
        self._target_mean = targets.mean(axis=0)
        self._targets = targets - self._target_mean

    def moments(self, rest_positions: FloatArray) -> Moments:
        def displacements(position: FloatArray) -> FloatArray:
            gated = gated_displacement(position, rest_positions, self._sharpness)
            return gated.reshape(len(position), -1)

        mean, gram, cross = _centred_products(self._position, displacements, self._targets)
        power = (self._targets**2).sum(axis=0)
        return Moments(len(self._position), mean, gram, self._target_mean, cross, power)


class _Series:
    """The Chebyshev polynomials multiplied out once for all sets: see `GatedMoments`."""

    def __init__(self, position: FloatArray, sharpness: float, targets: FloatArray) -> None:
        self._sharpness, self._count = sharpness, len(position)
        self._centre = position.mean(axis=0)
        self._target_mean = targets.mean(axis=0)
        centred = targets - self._target_mean
        self._target_power = (centred**2).sum(axis=0)
        series = GateSeries(position, sharpness)
        self._nodes = [series.nodes(axis).ravel() for axis in range(3)]
        self._multiply(series, position, centred)

    def _multiply(self, series: GateSeries, position: FloatArray, targets: FloatArray) -> None:
        """Products of the functions that are 1 at one node and 0 at the others of its panel."""
        length, panels = series.length, series.panels.tolist()
        pairs = [(a, b) for a in range(3) for b in range(a, 3)]
        gram = {(a, b): np.zeros((panels[a], length, panels[b], length)) for a, b in pairs}
        cross = [np.zeros((count, length, targets.shape[1])) for count in panels]
        of = [slice(a * length, (a + 1) * length) for a in range(3)]
        for cell, _, values in series.by_cell(position, targets):
            products = values @ values.T
            for a, b in pairs:
                gram[a, b][cell[a], :, cell[b]] += products[of[a], of[b]]
            for a in range(3):
                cross[a][cell[a]] += products[of[a], 3 * length :]
        transform = series.transform
        self._sum = [
            (np.einsum("kjkm->kjm", gram[a, a])[:, 0] @ transform).ravel() for a in range(3)
        ]
        self._cross = [(transform.T @ of).reshape(-1, targets.shape[1]) for of in cross]
        self._gram = {
            (a, b): (
                (transform.T @ of.reshape(panels[a], length, -1)).reshape(-1, length) @ transform
            ).reshape(panels[a] * length, -1)
            for (a, b), of in gram.items()
        }

    def moments(self, rest_positions: FloatArray) -> Moments:
        points, count = len(rest_positions), self._count
        at_centre = gated_displacement(self._centre[None], rest_positions, self._sharpness)[0]
        mean = np.empty((points, 3))
        gram = np.empty((points, 3, points, 3))
        cross = np.empty((points, 3, len(self._target_mean)))
        # About the values at the mean position, which are close to the means: no digits are lost.
        values = [
            gated_displacement(nodes[:, None], rest_positions[:, a, None], self._sharpness)[..., 0]
            - at_centre[:, a]
            for a, nodes in enumerate(self._nodes)
        ]
        total = [sums @ of for sums, of in zip(self._sum, values, strict=True)]
        for a in range(3):
            mean[:, a] = at_centre[:, a] + total[a] / count
            cross[:, a] = values[a].T @ self._cross[a]
            for b in range(a, 3):
                block = values[a].T @ self._gram[a, b] @ values[b]
                block -= np.outer(total[a], total[b]) / count
                gram[:, b, :, a], gram[:, a, :, b] = block.T, block
        return Moments(
            count=count,
            mean=mean.reshape(-1),
            gram=gram.reshape(3 * points, 3 * points),
            target_mean=self._target_mean,
            cross=cross.reshape(3 * points, -1),
            target_power=self._target_power,
        )


def _centred_products(
    position: FloatArray, columns: Callable[[FloatArray], FloatArray], targets: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means and centred products of columns, which are functions of q, and centred targets.

    The products are taken about the columns at the mean position, which are close to their
    means, and then moved to the means: so they lose no digits.

    Args:
        position: Limb positions q, shape (N, 3) [m].
        columns: Gives the p columns at some positions, shape (rows, p).
        targets: Centred targets, shape (N, m).

    Returns:
        The means, shape (p,), the products of the columns with themselves, shape (p, p), and
        with the targets, shape (p, m).
    """
    pivot = columns(position.mean(axis=0, keepdims=True))[0]
    total, gram = np.zeros(len(pivot)), np.zeros((len(pivot), len(pivot)))
    cross = np.zeros((len(pivot), targets.shape[1]))
    for start in range(0, len(position), _BLOCK):
        rows = slice(start, start + _BLOCK)
        block = columns(position[rows]) - pivot
        total += block.sum(axis=0)
        gram += block.T @ block
        cross += block.T @ targets[rows]
    gram -= np.outer(total, total) / len(position)
    return pivot + total / len(position), gram, cross
