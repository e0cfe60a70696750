r"""The prior of the force map: what is assumed of the forces on the tiles before any measurement.

The tiles' forces are a Gaussian process over the socket's surface. In the tiles' frames {L_i} (z is
the inward normal) it has the mean zero and the covariance

.. math:: K = T \bigl(K_{field} + K_{preload} + (U U^T) \circ (1 + \kappa^2 M)\bigr) T^T

- M is the Matern correlation :math:`(1 + \sqrt{3} d/\ell) e^{-\sqrt{3} d/\ell}` over the tiles'
  distance d: neighbouring forces are similar;
- the field has this correlation, with one amplitude for the normal and one for both tangents; the
  preload is a normal force common to all tiles;
- the six columns of U are the forces of a bed of springs under a small motion of the rigid limb,
  with weak tangential springs; the bed's stiffness varies by kappa;
- T adds a tangential force along the socket's axis, the drag of a sinking limb, as a share of the
  normal force.

Every term is positive semidefinite, and the field is definite. These hyperparameters are uncertain:
they follow wide distributions (`ForceMapSettings`), from which a quasi-random sequence draws M
hypotheses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import rigid_motions, wrench_map
from socket_testbed.settings.identification import MIN_SHARE, ForceMapSettings

_NUGGET = 1e-9  # [-]; keeps the correlation definite when tiles almost coincide
_TILE_SHARE_SPREAD = 0.03  # [-]; of the load, about the share of the wall that the tiles cover
_UNCERTAIN = 11  # hyperparameters that `hypotheses` spreads


@dataclass(frozen=True)
class Hypothesis:
    """The hyperparameters of a prior; unlike the settings' values they know no bounds.

    Attributes:
        normal_deviation: Standard deviation of a tile's own normal force, to which the sizes below
            are relative [N]; the data scales all of them.
        length: Correlation length of the forces over the wall [m].
        shear: Standard deviation of a tile's own tangential force along each tangent [-].
        preload: Standard deviation of the normal force common to all tiles [-].
        bed: Root mean square force of the bed of springs as the limb moves sideways [-].
        sinking: Root mean square force of the bed as the limb sinks [-].
        rotation: Root mean square force of the bed as the limb turns, about each axis [-].
        bed_shear: Tangential stiffness of the bed, relative to its normal stiffness [-].
        bed_variation: Variation kappa of the bed's stiffness over the wall, relative to it [-].
        arm: Lever arm at which a rotation displaces a tile as far as a translation does [m].
        drag: Distal force on a tile by friction, relative to its normal force [-].
        share: Share of the load that the tiles bear, within `MIN_SHARE` to 1 [-]; the surface
            between them bears the rest.
        moment_error: Standard deviation of a moment's error [N m].
        force_error: Standard deviation of the error of a force of the load cell [N].
        cluster_error: Standard deviation of the offset of a force on a cluster [N].
        cluster_gain_error: Standard deviation of the gain of a cluster [-].
    """

    normal_deviation: float
    length: float
    shear: float
    preload: float
    bed: float
    sinking: float
    rotation: float
    bed_shear: float
    bed_variation: float
    arm: float
    drag: float
    share: float
    moment_error: float
    force_error: float
    cluster_error: float
    cluster_gain_error: float


def hypotheses(settings: ForceMapSettings, tile_share: float | None) -> Iterator[Hypothesis]:
    """The prior's hyperparameters, spread evenly over their distributions; one has the medians.

    `drag` and `share` are normally distributed, the other uncertain ones log-normally.

    Args:
        settings: Medians and spreads.
        tile_share: Share of the wall that the tiles cover [-], which is then the mean share of the
            load, +- 0.03; None for that of the settings.
    """

    def log_normal(median: float, deviation: float, point: float) -> float:
        return float(median * np.exp(deviation * point))

    mean_share, share_spread = settings.share, settings.share_spread
    if tile_share is not None:
        mean_share, share_spread = tile_share, _TILE_SHARE_SPREAD
    spread = settings.spread
    for point in _normal_points(settings.draws, _UNCERTAIN).tolist():
        shear, preload, bed, sinking, rotation, bed_shear, bed_variation = point[:7]
        length, cluster_error, drag, share = point[7:]
        borne = mean_share + share_spread * share
        yield Hypothesis(
            normal_deviation=settings.normal_deviation,
            length=log_normal(settings.length, settings.length_spread, length),
            shear=log_normal(settings.shear, spread, shear),
            preload=log_normal(settings.preload, spread, preload),
            bed=log_normal(settings.bed, spread, bed),
            sinking=log_normal(settings.sinking, spread, sinking),
            rotation=log_normal(settings.rotation, spread, rotation),
            bed_shear=log_normal(settings.bed_shear, spread, bed_shear),
            bed_variation=log_normal(settings.bed_variation, spread, bed_variation),
            arm=settings.arm,
            drag=settings.drag + settings.drag_spread * drag,
            share=min(max(borne, MIN_SHARE), 1.0),
            moment_error=settings.moment_error,
            force_error=settings.force_error,
            cluster_error=log_normal(
                settings.cluster_error, settings.cluster_error_spread, cluster_error
            ),
            cluster_gain_error=settings.cluster_gain_error,
        )


def _normal_points(count: int, dimensions: int) -> FloatArray:
    """Standard normal points, evenly spread, the first at the medians, (count, dimensions) [-].

    They are the low-discrepancy additive recurrence of the generalised golden ratio
    (Niederreiter, Random Number Generation and Quasi-Monte Carlo Methods, 1992, section 3.2).
    """
    ratio = 1.0
    for _ in range(64):  # to rounding
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1.0))
    steps = ratio ** -np.arange(1.0, dimensions + 1.0)
    return np.asarray(ndtri((0.5 + np.arange(count)[:, None] * steps) % 1.0))


class Prior:
    """The forces in the tiles' frames under one hypothesis: their covariance K and its parts.

    The d channels are the wrench's [M; F] in {S}, then three per cluster in its tile's frame {L}.

    Args:
        geometry: The socket with its n tiles.
        clusters: Names of the c clusters, so that d = 6 + 3c.
        sizes: The hyperparameters.

    Attributes:
        mapping: H from the forces to the channels, shape (d, 3n) [m, -].
        noise: Variances R of the channels' noise, offset and gain, shape (d,) [(N m)^2, N^2].
        with_channels: K H', covariances of forces and channels, shape (n, 3, d) [N^2 m, N^2].
        signal: H K H', covariance of the channels without noise, shape (d, d).
        blocks: The covariances of each tile's force, shape (n, 3, 3) [N^2].
    """

    def __init__(
        self, geometry: SocketGeometry, clusters: tuple[str, ...], sizes: Hypothesis
    ) -> None:
        count = len(geometry)
        self._correlation = wall_correlation(geometry, sizes.length)
        self._field = np.array([sizes.shear, sizes.shear, 1.0])
        self._preload = sizes.preload
        bed = np.array([sizes.bed_shear, sizes.bed_shear, 1.0])[:, None]
        bed = bed * _rigid_motions(geometry, sizes.arm)
        bed /= np.sqrt((bed**2).sum(axis=1).mean(axis=0))
        self._bed = bed * [sizes.bed, sizes.bed, sizes.sinking, *[sizes.rotation] * 3]  # (n, 3, 6)
        self._variation = sizes.bed_variation
        turned = np.tile(np.eye(3), (count, 1, 1))  # T
        turned[:, :2, 2] = sizes.drag * (proximal_direction(geometry) @ geometry.rotations)[:, :2]
        self._turned = sizes.normal_deviation * turned
        in_socket = wrench_map(geometry.anchors).reshape(6, count, 3)
        wrench = np.einsum("fni,nij->fnj", in_socket, geometry.rotations) / sizes.share
        local = np.zeros((len(clusters), 3, count, 3))
        for number, cluster in enumerate(clusters):
            local[number, :, geometry.clusters[cluster]] = np.eye(3)
        self.mapping = np.vstack([wrench.reshape(6, -1), local.reshape(-1, 3 * count)])
        self.blocks = self._blocks()
        self.with_channels = self._with(self.mapping)
        self.signal = self.mapping @ self.with_channels.reshape(3 * count, -1)
        channels = 3 * len(clusters)
        errors = (sizes.moment_error, sizes.force_error, sizes.cluster_error)
        gains = np.repeat([0.0, sizes.cluster_gain_error], (6, channels))
        self.noise = np.repeat(errors, (3, 3, channels)) ** 2 + gains**2 * np.diag(self.signal)

    def covariance(self) -> FloatArray:
        """K in the tiles' frames, x, y, z of one tile after another, (3n, 3n) [N^2].

        The module docstring gives its equation.
        """
        count = len(self._correlation)
        alike = np.kron(self._correlation, np.ones((3, 3)))  # M, for each component of a force
        normal, bed = np.tile([0.0, 0.0, 1.0], count), self._bed.reshape(3 * count, -1)
        K = np.kron(self._correlation, np.diag(self._field**2))
        K += self._preload**2 * np.outer(normal, normal)
        K += (bed @ bed.T) * (1.0 + self._variation**2 * alike)
        turned = self._turned @ K.reshape(count, 3, -1)
        K = self._turned @ turned.reshape(3 * count, -1).T.reshape(count, 3, -1)
        return np.asarray(K.reshape(3 * count, -1))

    def _blocks(self) -> FloatArray:
        """The blocks of K on its diagonal, shape (n, 3, 3) [N^2]."""
        own = np.diag(self._correlation)[:, None, None]  # M of each tile with itself
        blocks = own * np.diag(self._field**2)
        blocks[:, 2, 2] += self._preload**2
        blocks += (self._bed @ np.swapaxes(self._bed, 1, 2)) * (1.0 + self._variation**2 * own)
        return np.asarray(self._turned @ blocks @ np.swapaxes(self._turned, 1, 2))

    def _with(self, mapping: FloatArray) -> FloatArray:
        """K H', shape (n, 3, d) [N^2], for a mapping H of the forces, (d, 3n): without K itself.

        Its terms are those of `covariance`, each multiplied from the right.
        """
        count = len(self._correlation)
        right = np.swapaxes(self._turned, 1, 2) @ mapping.T.reshape(count, 3, -1)
        found = self._field[:, None] ** 2 * self._correlated(right)
        found[:, 2] += self._preload**2 * right[:, 2].sum(axis=0)
        motions = np.swapaxes(self._bed, 1, 2) @ right
        varying = motions.sum(axis=0) + self._variation**2 * self._correlated(motions)
        return np.asarray(self._turned @ (found + self._bed @ varying))

    def _correlated(self, values: FloatArray) -> FloatArray:
        """M times values of each of the n tiles, of shape (n, ...) in any unit."""
        return (self._correlation @ values.reshape(len(values), -1)).reshape(values.shape)

    def draw(self, numbers: FloatArray) -> FloatArray:
        """Draws of the forces in the tiles' frames, x, y, z of each tile in turn, (D, 3n) [N].

        They follow from standard normal numbers, shape (D, 9n + 7) [-].
        """
        count, tiles = len(numbers), len(self._correlation)
        parts = np.split(numbers, [3 * tiles, 9 * tiles, 9 * tiles + 1], axis=1)
        root = np.linalg.cholesky(self._correlation)
        field, varying = (root @ part.reshape(count, tiles, -1) for part in parts[:2])
        field *= self._field
        field[..., 2] += self._preload * parts[2]
        motions = parts[3][:, None] + self._variation * varying
        field += np.einsum("naj,dnj->dna", self._bed, motions)
        return np.einsum("nab,dnb->dna", self._turned, field).reshape(count, -1)


def _rigid_motions(geometry: SocketGeometry, arm: float) -> FloatArray:
    """Displacements of the tiles in their frames under six motions of the limb, (n, 3, 6) [-].

    Translations along two transverse directions and the proximal one, and rotations about these
    axes through the mean anchor, scaled to a displacement of 1 at the distance `arm` [m].
    """
    axes = np.linalg.svd(proximal_direction(geometry)[None])[2][[1, 2, 0]]
    in_socket = rigid_motions((geometry.anchors - geometry.anchors.mean(axis=0)) / arm)
    return np.swapaxes(geometry.rotations, 1, 2) @ in_socket @ np.kron(np.eye(2), axes.T)


def wall_correlation(geometry: SocketGeometry, length: float) -> FloatArray:
    """Definite Matern correlation of forces on the tiles, shape (n, n) [-].

    Args:
        geometry: The socket, whose n tiles have straight distances between their centres.
        length: Correlation length [m].
    """
    apart = np.linalg.norm(geometry.anchors[:, None] - geometry.anchors, axis=2)
    return matern(apart, length) + _NUGGET * np.eye(len(geometry))


def matern(apart: FloatArray, length: float) -> FloatArray:
    """Matern correlation of smoothness 3/2 (Rasmussen & Williams, 2006, section 4.2) [-].

    Args:
        apart: Distances, of any shape [m].
        length: Correlation length [m].

    Returns:
        Correlations from 1 at no distance to 0 far away, of the shape of the distances [-].
    """
    scaled = np.sqrt(3.0) * apart / length
    return np.asarray((1.0 + scaled) * np.exp(-scaled))
