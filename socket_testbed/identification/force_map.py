r"""The force on every tile of the socket from one sample's clusters and wrench, with uncertainty.

The tiles' forces are a Gaussian process over the socket's surface, conditioned on the channels of
one sample. Nothing is fitted beforehand. In the tiles' frames {L_i} (z is the inward normal) the
prior has the mean zero and the covariance

.. math:: K = T \bigl(K_{field} + K_{preload} + (U U^T) \circ (1 + \kappa^2 M)\bigr) T^T

- M is the Matern covariance of the graph of neighbouring tiles,
  :math:`(2\nu/\ell^2 + L)^{-(\nu+1)}` scaled to a unit diagonal, with L the graph's Laplacian
  weighted by 1/d^2, d the distance of the tiles: the distance counts along the surface
  (Borovitskiy et al., Matern Gaussian processes on graphs, AISTATS 2021);
- the field has its own amplitude for the normal and for the two tangents, the preload is common
  to all tiles;
- the six columns of U are the forces of a bed of springs under a small motion of the rigid limb,
  with tangential springs that are weaker; the stiffness of the bed varies by kappa;
- T adds to the force along x (proximal) the share of the normal force by which a sinking limb
  drags the socket.

Every term is positive semidefinite, and the field is definite. H maps the forces F to the channels
y: the wrench [M; F], which the surface between the tiles bears as well, and each cluster's force
in its frame. With the noise R of the channels

.. math:: F = m + K H^T (H K H^T + R)^{-1} (y - H m)

(Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section 2.2). The amplitude
and the ratios of the parts are uncertain. The amplitude has an inverse-gamma prior, and is
integrated out; the ratios are drawn from stated log-normal priors, and every draw counts by its
evidence in the sample.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import i0e, i1e
from scipy.stats import norm, qmc

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, StatusArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import wrench_map
from socket_testbed.samples import WRENCH_CHANNELS, Samples, Status
from socket_testbed.settings.identification import ForceMapSettings

_SMOOTHNESS = 1.5  # [-]; nu of the Matern covariance
_AMPLITUDE_FREEDOM = 2.0  # [1]; degrees of freedom of the prior of the amplitude
_CHUNK = 256  # samples
_MOST_PATTERNS = 64  # of present channels that are kept


@dataclass(frozen=True)
class MapEstimate:
    """Forces of the limb on all n tiles with their standard deviations, for N samples.

    Attributes:
        forces: Forces on the socket in {S}, shape (N, n, 3) [N].
        standard_deviations: Theirs, by axis of {S}, shape (N, n, 3) [N].
        normal_pressure: Positive in compression, shape (N, n) [Pa].
        normal_pressure_standard_deviation: Shape (N, n) [Pa].
        shear: Magnitude of the tangential force over the area, shape (N, n) [Pa].
        shear_standard_deviation: Root mean square difference of the magnitude, which has a Rice
            distribution, to `shear`, shape (N, n) [Pa].
        source: What the estimate was conditioned on, in words.
    """

    forces: FloatArray
    standard_deviations: FloatArray
    normal_pressure: FloatArray
    normal_pressure_standard_deviation: FloatArray
    shear: FloatArray
    shear_standard_deviation: FloatArray
    source: str


@dataclass(frozen=True)
class _Ratios:
    """One draw of what the evidence chooses among; M of them as arrays of shape (M,)."""

    shear: FloatArray
    preload: FloatArray
    bed: FloatArray
    bed_variation: FloatArray
    share: FloatArray


@dataclass(frozen=True)
class _Conditioned:
    """The draws conditioned on the channels that are present.

    Attributes:
        present: Indices of the d channels that are present.
        gain: K H' S^-1 in the tiles' frames, shape (M, 3n, d).
        precision: S^-1, shape (M, d, d).
        log_determinant: Of S, shape (M,).
        covariance: Of each tile's force in its frame, shape (M, n, 3, 3) [N^2].
    """

    present: list[int]
    gain: FloatArray
    precision: FloatArray
    log_determinant: FloatArray
    covariance: FloatArray

    def without(self, channel: int) -> _Conditioned:
        """The same without one channel: a downdate of rank one.

        With j the place of the channel in y, and P the precision: P - P_j P_j' / P_jj without
        row and column j is the precision of the other channels (block inversion).

        Args:
            channel: Index of the channel.
        """
        j = self.present.index(channel)
        kept = [place for place in range(len(self.present)) if place != j]
        row, pivot = self.precision[:, j], self.precision[:, j, j]
        lost = self.gain[:, :, j] / pivot[:, None]
        precision = self.precision - row[:, :, None] * (row / pivot[:, None])[:, None]
        gain = self.gain - lost[:, :, None] * row[:, None]
        per_tile = lost.reshape(len(lost), -1, 3)
        return _Conditioned(
            present=[self.present[place] for place in kept],
            gain=np.ascontiguousarray(gain[:, :, kept]),
            precision=np.ascontiguousarray(precision[:, kept][:, :, kept]),
            log_determinant=self.log_determinant + np.log(pivot),
            covariance=self.covariance
            + pivot[:, None, None, None] * per_tile[..., :, None] * per_tile[..., None, :],
        )


class ForceMap:
    """Maps one sample's clusters and wrench to the forces on all tiles, with uncertainty.

    Args:
        geometry: Geometry of the socket.
        clusters: Names of the c clusters, in the order of the samples' local forces.
        settings: The prior.
    """

    def __init__(
        self,
        geometry: SocketGeometry,
        clusters: tuple[str, ...],
        settings: ForceMapSettings | None = None,
    ) -> None:
        self._geometry = geometry
        self._clusters = clusters
        self._areas = geometry.areas
        settings = settings or ForceMapSettings()
        complete = _condition(geometry, clusters, settings)
        self._patterns: dict[bytes, _Conditioned] = {}
        self._complete = complete

    def estimate(self, samples: Samples) -> MapEstimate:
        """The map at every sample.

        Args:
            samples: N samples; their poses are not used.

        Returns:
            The estimate; where a sample has no channel at all, that of the prior.
        """
        values, present = _channels(samples.wrench, samples.local_forces, samples.status)
        parts = np.empty((len(samples), len(self._geometry), 3))
        covariance = np.empty((len(samples), len(self._geometry), 3, 3))
        for pattern, rows in _by_pattern(present):
            conditioned = self._conditioned(pattern)
            for start in range(0, len(rows), _CHUNK):
                chunk = rows[start : start + _CHUNK]
                measured = values[chunk][:, conditioned.present]
                parts[chunk], covariance[chunk] = _average(conditioned, measured)
        return self._describe(parts, covariance, self._words(present))

    def update(
        self, wrench: FloatArray, local_forces: FloatArray, status: StatusArray
    ) -> MapEstimate:
        """The map at one live sample, as `estimate` has it.

        Args:
            wrench: Wrench [M; F] in {S}, shape (6,) [N m, N]; NaN where missing.
            local_forces: Forces on the clusters in their frames, shape (c, 3) [N].
            status: Status of each cluster (`Status`), shape (c,); a cluster counts if it is OK.

        Returns:
            The estimate, with N = 1.
        """
        values, present = _channels(wrench[None], local_forces[None], status[None])
        conditioned = self._conditioned(present[0])
        forces, covariance = _average(conditioned, values[:, conditioned.present])
        return self._describe(forces, covariance, self._words(present))

    def _conditioned(self, present: BoolArray) -> _Conditioned:
        """The draws conditioned on a pattern of channels; a pattern is computed once."""
        key = present.tobytes()
        if key not in self._patterns:
            if len(self._patterns) >= _MOST_PATTERNS:
                self._patterns.clear()
            conditioned = self._complete
            for channel in np.flatnonzero(~present).tolist():
                conditioned = conditioned.without(channel)
            self._patterns[key] = conditioned
        return self._patterns[key]

    def _describe(self, local: FloatArray, covariance: FloatArray, source: str) -> MapEstimate:
        """The estimate from forces (N, n, 3) and covariances (N, n, 3, 3) in the tiles' frames."""
        rotations, areas = self._geometry.rotations, self._areas
        forces = (rotations @ local[..., None])[..., 0]
        variances = ((rotations @ covariance) * rotations).sum(axis=-1)
        tangential = 0.5 * (covariance[..., 0, 0] + covariance[..., 1, 1])
        shear = np.hypot(local[..., 0], local[..., 1])
        return MapEstimate(
            forces=forces,
            standard_deviations=np.sqrt(variances),
            normal_pressure=-local[..., 2] / areas,
            normal_pressure_standard_deviation=np.sqrt(covariance[..., 2, 2]) / areas,
            shear=shear / areas,
            shear_standard_deviation=_rice_deviation(shear, np.sqrt(tangential)) / areas,
            source=source,
        )

    def _words(self, present: BoolArray) -> str:
        """What the estimate was conditioned on."""
        wrench = present[:, : len(WRENCH_CHANNELS)].any()
        of_clusters = present[:, len(WRENCH_CHANNELS) :].reshape(len(present), -1, 3)
        parts = ["wrench"] if wrench else []
        parts += [c for k, c in enumerate(self._clusters) if of_clusters[:, k].any()]
        return "prior: mean zero; measured: " + (", ".join(parts) or "nothing")


def _channels(
    wrench: FloatArray, local_forces: FloatArray, status: StatusArray
) -> tuple[FloatArray, BoolArray]:
    """Values of all channels, shape (N, 6 + 3c), and which of them count."""
    trusted = np.where((status == Status.OK)[:, :, None], local_forces, np.nan)
    values = np.hstack([wrench, trusted.reshape(len(wrench), -1)])
    return values, np.isfinite(values)


def _by_pattern(present: BoolArray) -> Iterator[tuple[BoolArray, IntArray]]:
    """Each pattern of present channels with the samples that have it."""
    patterns, which = np.unique(present, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        yield pattern, np.flatnonzero(which.reshape(-1) == number)


def _average(conditioned: _Conditioned, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the tiles' forces over the draws, weighted by their evidence.

    With the amplitude's prior, the channels have a multivariate t distribution under each draw,
    and the amplitude's square the posterior mean (f + y' S^-1 y) / (f + d - 2).

    Args:
        conditioned: The M draws.
        measured: The d channels that are present, shape (N, d).

    Returns:
        Forces in the tiles' frames, shape (N, n, 3) [N], and covariances, (N, n, 3, 3) [N^2].
    """
    count, freedom = measured.shape[1], _AMPLITUDE_FREEDOM
    whitened = measured @ conditioned.precision
    distance = np.einsum("mkd,kd->km", whitened, measured)
    evidence = -0.5 * (
        conditioned.log_determinant + (freedom + count) * np.log1p(distance / freedom)
    )
    weights = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    scales = weights * (freedom + distance) / max(freedom + count - 2.0, 1.0)

    draws, tiles = conditioned.covariance.shape[:2]
    # (N, M, n, 3)
    forces = np.einsum("mfd,kd->kmf", conditioned.gain, measured, optimize=True)
    mean = np.einsum("km,kmf->kf", weights, forces).reshape(-1, tiles, 3)
    spread = forces.reshape(-1, draws, tiles, 3) - mean[:, None]
    covariance = np.tensordot(scales, conditioned.covariance, axes=1)
    covariance += np.einsum("km,kmni,kmnj->knij", weights, spread, spread, optimize=True)
    return mean, covariance


def _rice_deviation(size: FloatArray, sigma: FloatArray) -> FloatArray:
    """Root mean square difference of a Rice-distributed magnitude to `size`.

    The magnitude of a vector of two components, of standard deviation sigma each, whose mean has
    the magnitude `size`, has the mean sigma sqrt(pi/2) L_1/2(-x), x = size^2 / (2 sigma^2), and
    the mean square size^2 + 2 sigma^2 (Rice, Bell System Technical Journal 24, 1945).
    """
    sigma = np.maximum(sigma, np.finfo(float).tiny)
    half = 0.25 * (size / sigma) ** 2  # x / 2
    laguerre = (1.0 + 2.0 * half) * i0e(half) + 2.0 * half * i1e(half)
    mean = sigma * np.sqrt(0.5 * np.pi) * laguerre
    square = 2.0 * (size**2 + sigma**2 - size * mean)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def surface_correlation(geometry: SocketGeometry, length: float) -> FloatArray:
    """Matern correlation of the tiles along the surface, positive definite, shape (n, n) [-].

    Args:
        geometry: Geometry of the socket.
        length: Length l over which forces are alike [m].
    """
    a, b = geometry.neighbours.T
    distance = np.linalg.norm(geometry.anchors[a] - geometry.anchors[b], axis=1)
    laplacian = np.zeros((len(geometry), len(geometry)))
    np.add.at(laplacian, (a, b), -1.0 / distance**2)
    laplacian += laplacian.T
    np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
    eigenvalues, vectors = np.linalg.eigh(laplacian)
    damped = 2.0 * _SMOOTHNESS / length**2 + np.maximum(eigenvalues, 0.0)
    covariance = (vectors * damped ** -(_SMOOTHNESS + 1.0)) @ vectors.T
    scale = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / (scale * scale[:, None]))


def _rigid_motions(geometry: SocketGeometry, arm: float) -> FloatArray:
    """Displacements of the tiles in their frames under six motions of the limb, (n, 3, 6) [-].

    Three translations, and three rotations about the mean anchor whose displacement at the
    distance `arm` [m] is 1.
    """
    arms = (geometry.anchors - geometry.anchors.mean(axis=0)) / arm
    in_socket = np.zeros((len(geometry), 3, 6))
    in_socket[:, :, :3] = np.eye(3)
    for axis, unit in enumerate(np.eye(3)):
        in_socket[:, :, 3 + axis] = np.cross(unit, arms)
    return np.swapaxes(geometry.rotations, 1, 2) @ in_socket


def _draw(settings: ForceMapSettings) -> _Ratios:
    """Ratios drawn evenly from their log-normal priors (a Sobol sequence)."""
    medians = (
        settings.shear, settings.preload, settings.bed, settings.bed_variation,
    )  # fmt: skip
    draws = settings.draws
    points = qmc.Sobol(len(medians) + 1, rng=0).random(draws)
    logs = settings.spread * norm.ppf(points)
    drawn = np.array(medians) * np.exp(logs[:, : len(medians)])
    share = settings.share + settings.share_spread * norm.ppf(points[:, -1])
    shear, preload, bed, bed_variation = drawn.T
    return _Ratios(shear, preload, bed, bed_variation, share)


def _condition(
    geometry: SocketGeometry, clusters: tuple[str, ...], settings: ForceMapSettings
) -> _Conditioned:
    """The draws of the prior, conditioned on all channels."""
    count, channels = len(geometry), len(WRENCH_CHANNELS) + 3 * len(clusters)
    ratios = _draw(settings)
    draws = len(ratios.shear)
    gain = np.empty((draws, 3 * count, channels))
    precision = np.empty((draws, channels, channels))
    log_determinant = np.empty(draws)
    covariance = np.empty((draws, count, 3, 3))

    correlation = surface_correlation(geometry, settings.length)
    motions = _rigid_motions(geometry, settings.arm)
    blocks = np.arange(3 * count).reshape(count, 3)
    for m in range(draws):
        prior = _prior(correlation, motions, settings, ratios, m)
        mapping = _mapping(geometry, clusters, ratios.share[m])
        mapped = prior @ mapping.T
        noise = _noise(mapping @ mapped, settings)
        precision[m] = np.linalg.inv(mapping @ mapped + noise)
        gain[m] = mapped @ precision[m]
        log_determinant[m] = -np.linalg.slogdet(precision[m])[1]
        covariance[m] = prior[blocks[:, :, None], blocks[:, None, :]]
        covariance[m] -= gain[m][blocks] @ np.swapaxes(mapped[blocks], 1, 2)
    return _Conditioned(list(range(channels)), gain, precision, log_determinant, covariance)


def _prior(
    correlation: FloatArray,
    motions: FloatArray,
    settings: ForceMapSettings,
    ratios: _Ratios,
    m: int,
) -> FloatArray:
    """Covariance K of all forces in the tiles' frames, shape (3n, 3n) [N^2]."""
    count = len(correlation)
    tangential = np.array([settings.bed_shear, settings.bed_shear, 1.0])
    bed = motions * tangential[:, None]
    bed = bed / np.sqrt((bed**2).sum(axis=1).mean(axis=0))
    bed = (ratios.bed[m] * bed).reshape(3 * count, 6)
    varying = 1.0 + ratios.bed_variation[m] ** 2 * correlation
    prior = (bed @ bed.T) * np.kron(varying, np.ones((3, 3)))
    for axis, size in enumerate((ratios.shear[m], ratios.shear[m], 1.0)):
        prior[axis::3, axis::3] += size**2 * correlation
    prior[2::3, 2::3] += ratios.preload[m] ** 2
    drag = np.eye(3)
    drag[0, 2] = settings.drag
    dragged = np.einsum("ai,nimj,bj->namb", drag, prior.reshape(count, 3, count, 3), drag)
    return settings.normal_deviation**2 * dragged.reshape(3 * count, 3 * count)


def _mapping(geometry: SocketGeometry, clusters: tuple[str, ...], share: float) -> FloatArray:
    """H from the forces in the tiles' frames to the channels, shape (6 + 3c, 3n)."""
    count = len(geometry)
    in_socket = wrench_map(geometry.anchors).reshape(6, count, 3)
    wrench = np.einsum("fni,nij->fnj", in_socket, geometry.rotations) / share
    local = np.zeros((len(clusters), 3, count, 3))
    for number, cluster in enumerate(clusters):
        local[number, :, geometry.clusters[cluster]] = np.eye(3)
    return np.vstack([wrench.reshape(6, -1), local.reshape(-1, 3 * count)])


def _noise(signal: FloatArray, settings: ForceMapSettings) -> FloatArray:
    """Covariance R of noise, offset and gain of the channels, diagonal.

    Args:
        signal: Prior covariance H K H' of the channels.
        settings: Sizes of the errors.
    """
    clusters = len(signal) - 6
    offset = np.concatenate(
        [
            np.full(3, settings.moment_error),
            np.full(3, settings.force_error),
            np.full(clusters, settings.cluster_error),
        ]
    )
    gain = np.concatenate([np.zeros(6), np.full(clusters, settings.cluster_gain_error)])
    return np.diag(offset**2 + gain**2 * np.diag(signal))
