r"""The force on every tile of the socket from one sample's clusters and wrench, with uncertainty.

The tiles' forces are a Gaussian process over the socket's surface, conditioned on the channels of
one sample. Nothing is fitted beforehand. In the tiles' frames {L_i} (z is the inward normal) the
prior has the mean zero and the covariance

.. math:: K = T \bigl(K_{field} + K_{preload} + (U U^T) \circ (1 + \kappa^2 M)\bigr) T^T

- M is the Matern covariance of the graph of neighbouring tiles,
  :math:`(2\nu/\ell^2 + L)^{-(\nu+1)}` scaled to a unit diagonal, with L the graph's Laplacian
  weighted by 1/d^2, d the distance of the tiles: forces are alike along the surface, not through
  the air (Borovitskiy et al., Matern Gaussian processes on graphs, AISTATS 2021);
- the field has this correlation, with one amplitude for the normal and one for both tangents; the
  preload is a normal force that all tiles have in common;
- the six columns of U are the forces of a bed of springs under a small motion of the rigid limb,
  with weak tangential springs; the bed's stiffness varies by kappa;
- T adds a tangential force along the socket's axis, by which a sinking limb drags the socket: it is
  a share of the normal force.

Every term is positive semidefinite, and the field is definite. H maps the forces F to the channels
y: the wrench [M; F], which the surface between the tiles bears as well, and each cluster's force
in its frame. With the noise R of the channels

.. math:: F = K H^T (H K H^T + R)^{-1} y

(Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section 2.2). The sizes of
the parts are uncertain. The common amplitude has an inverse-gamma prior and is integrated out; the
sizes relative to it and the clusters' offsets are drawn from stated log-normal priors, and every
draw counts by its evidence in the sample.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import chdtri, i0e, i1e, ndtri

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, StatusArray
from socket_testbed.geometry.axis import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact_law import wrench_map
from socket_testbed.identification.plausibility import (
    Outliers,
    find_outliers,
    without_outliers,
)
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, Status
from socket_testbed.settings.identification import ForceMapSettings

_SMOOTHNESS = 1.5  # [-]; nu of the Matern covariance
_AMPLITUDE_FREEDOM = 6.0  # [1]; degrees of freedom of the prior of the amplitude
_OFFSETS = 4  # sizes of the clusters' offsets per draw
_CHUNK = 256  # samples
_DRAWN = 2048  # samples whose joint draws come at a time
_TINY = 1e-12  # [N]
_MOST_PATTERNS = 64  # of present channels that are kept


@dataclass(frozen=True)
class MapEstimate:
    """Forces of the limb on all n tiles with their standard deviations, for N samples."""

    forces: FloatArray  # forces on the socket in {S}, shape (N, n, 3) [N]
    standard_deviations: FloatArray  # theirs, by axis of {S}, shape (N, n, 3) [N]
    normal_pressure: FloatArray  # positive in compression, shape (N, n) [Pa]
    normal_pressure_standard_deviation: FloatArray  # shape (N, n) [Pa]
    shear: FloatArray  # magnitude of the tangential force over the area, shape (N, n) [Pa]
    # root mean square difference of the magnitude, which has a Rice distribution, to `shear`, shape
    # (N, n) [Pa]
    shear_standard_deviation: FloatArray
    source: str  # what the estimate was conditioned on, in words

    def columns(self, names: tuple[str, ...], prefix: str = "") -> dict[str, FloatArray]:
        """Columns of a table, a row per sample, by titles with the units.

        Of each tile the force in {S} with its standard deviations, such as `tile_012.Fz [N]` and
        `tile_012.Fz.sd [N]`, then `pressure` and `shear` [Pa] with theirs.
        """
        found = {}
        for tile, name in enumerate(names):
            start = prefix + name
            for axis, force in enumerate(LOCAL_CHANNELS):
                found[f"{start}.{force} [N]"] = self.forces[:, tile, axis]
                found[f"{start}.{force}.sd [N]"] = self.standard_deviations[:, tile, axis]
            found[f"{start}.pressure [Pa]"] = self.normal_pressure[:, tile]
            found[f"{start}.pressure.sd [Pa]"] = self.normal_pressure_standard_deviation[:, tile]
            found[f"{start}.shear [Pa]"] = self.shear[:, tile]
            found[f"{start}.shear.sd [Pa]"] = self.shear_standard_deviation[:, tile]
        return found

    def mean(self) -> MapEstimate:
        """The map averaged over the samples, with N = 1: see `ForceMap.mean`."""
        return _averaged([self], self.source)


def _averaged(parts: Iterable[MapEstimate], source: str) -> MapEstimate:
    """The mean over the samples of all parts; of standard deviations the root mean square."""
    count, sums = 0, {field.name: np.zeros(1) for field in fields(MapEstimate)}
    del sums["source"]
    for part in parts:
        count += len(part.forces)
        for name, total in sums.items():
            values = getattr(part, name) ** (2 if "deviation" in name else 1)
            sums[name] = total + values.sum(axis=0, keepdims=True)
    means = {name: total / count for name, total in sums.items()}
    means |= {name: np.sqrt(mean) for name, mean in means.items() if "deviation" in name}
    return MapEstimate(**means, source=source)


@dataclass(frozen=True)
class _Conditioned:
    """The draws of the prior, conditioned on the channels that are present.

    A tile's force has four components here: along x, y, z of {S} and along the tile's normal.
    """

    present: IntArray  # indices of the d channels that are present
    # K H' S^-1 of the M draws, from the channels to the forces, shape (M, n, 4, d)
    gain: FloatArray
    precision: FloatArray  # S^-1, shape (M, d, d)
    log_determinant: FloatArray  # of S, shape (M,)
    variances: FloatArray  # of the forces, shape (M, n, 4) [N^2]

    def average(self, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variances of the forces over the draws, weighted by their evidence.

        With the amplitude's prior, the channels have a multivariate t distribution under each
        draw, and the square of the amplitude the posterior mean (f + y' S^-1 y) / (f + d - 2).

        Args:
            measured: The channels that are present, shape (N, d).

        Returns:
            Forces, shape (N, n, 4) [N], and their variances, shape (N, n, 4) [N^2].
        """
        count, channels = measured.shape
        draws, tiles = self.variances.shape[:2]
        forces = measured @ self.gain.reshape(draws * tiles * 4, channels).T
        forces = forces.reshape(count, draws, tiles * 4)
        distance, freedom = self.distance(measured), _AMPLITUDE_FREEDOM
        weights = self.weights(distance)
        scales = weights * (freedom + distance) / max(freedom + channels - 2.0, 1.0)
        mean = (weights[:, None] @ forces)[:, 0]
        between = (weights[:, None] @ forces**2)[:, 0] - mean**2
        variances = scales @ self.variances.reshape(draws, -1) + np.maximum(between, 0.0)
        return mean.reshape(count, -1, 4), variances.reshape(count, -1, 4)

    def distance(self, measured: FloatArray) -> FloatArray:
        """Squared sizes y' S^-1 y of the channels (N, d) under the draws, shape (N, M) [-]."""
        draws, channels = self.precision.shape[:2]
        # One product over all draws: a batch of small ones takes several times as long.
        whitened = measured @ self.precision.reshape(draws * channels, channels).T
        whitened = whitened.reshape(len(measured), draws, channels)
        return np.asarray((whitened * measured[:, None]).sum(axis=2))

    def weights(self, distance: FloatArray) -> FloatArray:
        """Probabilities of the draws by their evidence, shape (N, M) [-]; see `distance`."""
        freedom = _AMPLITUDE_FREEDOM
        exponent = freedom + len(self.present)
        evidence = self.log_determinant + exponent * np.log1p(distance / freedom)
        weights = np.exp(0.5 * (evidence.min(axis=1, keepdims=True) - evidence))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class JointDraws:
    """D joint draws of the forces on all n tiles at k samples, as the factors that vary.

    Each of the M draws of the prior's sizes is a hypothesis. A draw of the forces in the tiles'
    frames is :math:`G_m y + b_m E_{md}` with its hypothesis m at the sample; of the first D/2
    draws, the others have the opposite errors.
    """

    rows: IntArray  # indices of the samples, shape (k,)
    channels: FloatArray  # their channels y, shape (k, d) [N m, N]
    gain: FloatArray  # G of the hypotheses, shape (M, 3n, d)
    weights: FloatArray  # probabilities of the hypotheses, shape (k, M) [-]
    sizes: FloatArray  # sizes b of the errors under each hypothesis, shape (k, M) [-]
    hypotheses: IntArray  # those of the draws, shape (k, D/2)
    errors: FloatArray  # E, shape (M, D/2, 3n) [N]

    def __getitem__(self, part: slice) -> JointDraws:
        """The draws of some of the samples."""
        return replace(
            self,
            rows=self.rows[part],
            channels=self.channels[part],
            weights=self.weights[part],
            sizes=self.sizes[part],
            hypotheses=self.hypotheses[part],
        )

    def values(self) -> FloatArray:
        """The forces in the tiles' frames, in a row, shape (k, D, 3n) [N]."""
        count, half = self.hypotheses.shape
        each = np.arange(count)[:, None]
        errors = self.errors[self.hypotheses, np.arange(half)]
        errors *= self.sizes[each, self.hypotheses][..., None]
        hypotheses, forces, channels = self.gain.shape
        means = self.channels @ self.gain.reshape(-1, channels).T
        means = means.reshape(count, hypotheses, forces)[each, self.hypotheses]
        return np.concatenate([means + errors, means - errors], axis=1)

    def mean(self) -> FloatArray:
        """The estimate: mean of the values over the hypotheses, shape (k, 3n) [N]."""
        weighted = self.weights[:, :, None] * self.channels[:, None]  # (k, M, d)
        flat = np.swapaxes(self.gain, 1, 2).reshape(-1, self.gain.shape[1])
        return np.asarray(weighted.reshape(-1, len(flat)) @ flat)

    def mapped(self, mapping: FloatArray) -> JointDraws:
        """The same draws of r linear functions of the forces, by their matrix, shape (3n, r)."""
        gain = np.ascontiguousarray(np.swapaxes(np.swapaxes(self.gain, 1, 2) @ mapping, 1, 2))
        return replace(self, gain=gain, errors=self.errors @ mapping)


class ForceMap:
    """Maps one sample's clusters and wrench to the forces on all tiles, with uncertainty."""

    def __init__(
        self,
        geometry: SocketGeometry,
        clusters: tuple[str, ...],
        settings: ForceMapSettings | None = None,
    ) -> None:
        self._geometry = geometry
        self._settings = settings or ForceMapSettings()
        self._clusters = clusters
        self._areas = geometry.areas
        self._normals = geometry.rotations[:, :, 2]
        self._moments = _prior_moments(geometry, clusters, self._settings)
        self._patterns: dict[bytes, _Conditioned] = {}
        self._drawn: dict[int, tuple[FloatArray, ...]] = {}  # by their number

    def estimate(self, samples: Samples) -> MapEstimate:
        """The map at every sample; that of the prior where a sample has no channel at all."""
        return self._estimate(samples.wrench, samples.local_forces, samples.status)

    def update(
        self, wrench: FloatArray, local_forces: FloatArray, status: StatusArray
    ) -> MapEstimate:
        """The map at one live sample, with N = 1, as `estimate` has it.

        Args:
            wrench: Wrench [M; F] in {S}, shape (6,) [N m, N]; NaN where missing.
            local_forces: Forces on the clusters in their frames, shape (c, 3) [N].
            status: Status of each cluster (`Status`), shape (c,); a cluster counts if it is OK.
        """
        return self._estimate(wrench[None], local_forces[None], status[None])

    def _estimate(
        self, wrench: FloatArray, local_forces: FloatArray, status: StatusArray
    ) -> MapEstimate:
        values, present = _channels(wrench, local_forces, status)
        forces, variances = np.empty((2, len(values), len(self._areas), 4))
        for pattern, rows in _by_pattern(present):
            conditioned = self._conditioned(pattern)
            for start in range(0, len(rows), _CHUNK):
                chunk = rows[start : start + _CHUNK]
                measured = values[chunk][:, conditioned.present]
                forces[chunk], variances[chunk] = conditioned.average(measured)
        return self._describe(forces, variances, present)

    def mean(self, samples: Samples) -> MapEstimate:
        """The mean of the map over N samples, with N = 1, in bounded memory.

        The channels leave nearly the same open in every sample, so the mean is as uncertain as a
        usual sample: its standard deviations are root mean squares.
        """
        starts = range(0, len(samples), _CHUNK)
        parts = (self.estimate(samples[start : start + _CHUNK]) for start in starts)
        return _averaged(parts, self.source(samples))

    def source(self, samples: Samples) -> str:
        """What the map at some samples is conditioned on, in words."""
        _, present = _channels(samples.wrench, samples.local_forces, samples.status)
        return self._source(present)

    def sample(self, samples: Samples, count: int = 200) -> Iterator[JointDraws]:
        r"""Joint draws of the forces on all tiles, given the channels of each sample.

        A draw of the prior's sizes is chosen by its evidence, and the amplitude s from its
        posterior, an inverse-gamma distribution. Then with F' and e drawn from the prior of the
        forces and from the noise of the channels, the forces

        .. math:: F = G y + s \, (F' - G (H F' + e))

        have the posterior distribution (Matheron's rule: Journel & Huijbregts, Mining
        Geostatistics, 1978, section VII.A). The random numbers are the same in all samples: what
        the channels leave open stays the same over a trial, so a mean over time is no more certain
        than its samples. They are seeded, and come in pairs of opposite errors.

        Args:
            samples: N samples.
            count: Number D of draws, even.

        Yields:
            The draws of some of the samples, until every sample has come once, in whatever order.
        """
        settings = _draw(self._settings)
        if count not in self._drawn:  # the same in all samples, and long to draw
            rng = np.random.default_rng(0)
            drawn = self._prior_draws(settings, count // 2, rng)
            levels = rng.permuted(np.tile(_levels(count // 2), (2, 1)), axis=1)
            self._drawn = {count: (*drawn, *levels)}
        priors, errors, chosen, amplitude = self._drawn[count]
        values, present = _channels(samples.wrench, samples.local_forces, samples.status)
        tiles = len(self._areas)
        for pattern, rows in _by_pattern(present):
            conditioned = self._conditioned(pattern)
            gain = np.einsum(
                "nij,mnid->mnjd", self._geometry.rotations, conditioned.gain[:, :, :3]
            ).reshape(len(settings), 3 * tiles, -1)
            left = priors - errors[..., conditioned.present] @ np.swapaxes(gain, 1, 2)
            freedom = _AMPLITUDE_FREEDOM + len(conditioned.present)
            left /= np.sqrt(chdtri(freedom, amplitude))[:, None]
            for start in range(0, len(rows), _DRAWN):
                some = rows[start : start + _DRAWN]
                measured = values[some][:, conditioned.present]
                distance = conditioned.distance(measured)
                weights = conditioned.weights(distance)
                below = weights.cumsum(axis=1)[:, :-1, None]
                yield JointDraws(
                    rows=some,
                    channels=measured,
                    gain=gain,
                    weights=weights,
                    sizes=np.sqrt(_AMPLITUDE_FREEDOM + distance),
                    hypotheses=(chosen > below).sum(axis=1),
                    errors=left,
                )

    def _prior_draws(
        self, settings: list[ForceMapSettings], count: int, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draws of the prior: forces, (M, count, 3n) [N], and channels with noise, (M, count, c).

        Forces are in the tiles' frames. All draws of the prior's sizes share the random numbers.
        """
        geometry = self._geometry
        correlation = surface_correlation(geometry, self._settings.length)
        motions = _rigid_motions(geometry, self._settings.arm)
        of_forces = rng.standard_normal((count, 3 * len(geometry)))
        of_noise = rng.standard_normal((count, len(WRENCH_CHANNELS) + 3 * len(self._clusters)))
        forces, channels = [], []
        for drawn in settings:
            mapping = _mapping(geometry, self._clusters, drawn.share)
            prior = _prior(geometry, correlation, motions, drawn)
            noise = _noise(mapping @ prior @ mapping.T, drawn)
            forces.append(of_forces @ np.linalg.cholesky(prior).T)
            channels.append(forces[-1] @ mapping.T + of_noise * np.sqrt(np.diag(noise)))
        return np.array(forces), np.array(channels)

    def _conditioned(self, pattern: BoolArray) -> _Conditioned:
        """The draws conditioned on a pattern of channels; a pattern is computed once."""
        key = pattern.tobytes()
        if key not in self._patterns:
            if len(self._patterns) >= _MOST_PATTERNS:
                self._patterns.clear()
            total, cross, before = self._moments
            present = np.flatnonzero(pattern)
            cross = cross[..., present]
            precision = np.asarray(np.linalg.inv(total[:, present[:, None], present]), np.float64)
            gain = cross @ precision[:, None]
            self._patterns[key] = _Conditioned(
                present=present,
                gain=gain,
                precision=precision,
                log_determinant=-np.linalg.slogdet(precision)[1],
                variances=before - (gain * cross).sum(axis=3),
            )
        return self._patterns[key]

    def _describe(
        self, forces: FloatArray, variances: FloatArray, present: BoolArray
    ) -> MapEstimate:
        """The estimate from forces and variances, (N, n, 4), and the present channels."""
        areas, deviations = self._areas, np.sqrt(variances)
        vectors, normal = forces[..., :3], forces[..., 3]
        across = vectors - normal[..., None] * self._normals
        shear = np.sqrt((across**2).sum(axis=-1))
        tangential = np.maximum(variances[..., :3].sum(axis=-1) - variances[..., 3], 0.0)
        return MapEstimate(
            forces=vectors,
            standard_deviations=deviations[..., :3],
            normal_pressure=-normal / areas,
            normal_pressure_standard_deviation=deviations[..., 3] / areas,
            shear=shear / areas,
            shear_standard_deviation=_rice_deviation(shear, np.sqrt(0.5 * tangential)) / areas,
            source=self._source(present),
        )

    def _source(self, present: BoolArray) -> str:
        """The prior's mean and the measured channels."""
        wrench = len(WRENCH_CHANNELS)
        parts = ["wrench"] if present[:, :wrench].any() else []
        for number, cluster in enumerate(self._clusters):
            if present[:, wrench + 3 * number : wrench + 3 * (number + 1)].any():
                parts.append(cluster)
        return f"prior: mean zero; measured: {', '.join(parts) or 'nothing'}"


def _channels(
    wrench: FloatArray, local_forces: FloatArray, status: StatusArray
) -> tuple[FloatArray, BoolArray]:
    """Values of all channels, shape (N, 6 + 3c), and which of them count."""
    values = np.concatenate([wrench, local_forces.reshape(len(wrench), -1)], axis=1)
    present = np.isfinite(values)
    present[:, wrench.shape[1] :] &= np.repeat(status == Status.OK, 3, axis=1)
    return values, present


def _by_pattern(present: BoolArray) -> Iterator[tuple[BoolArray, IntArray]]:
    """Each pattern of present channels with the samples that have it."""
    patterns, which = np.unique(present, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        yield pattern, np.flatnonzero(which.reshape(-1) == number)


def _rice_deviation(size: FloatArray, sigma: FloatArray) -> FloatArray:
    """Root mean square difference of a Rice-distributed magnitude to `size`.

    The magnitude of a vector of two components, of standard deviation sigma each, whose mean has
    the magnitude `size`, has the mean sigma sqrt(pi/2) L_1/2(-x), x = size^2 / (2 sigma^2), and
    the mean square size^2 + 2 sigma^2 (Rice, Bell System Technical Journal 24, 1945).
    """
    half = 0.25 * (size / np.maximum(sigma, _TINY)) ** 2  # x / 2
    laguerre = (1.0 + 2.0 * half) * i0e(half) + 2.0 * half * i1e(half)
    mean = sigma * np.sqrt(0.5 * np.pi) * laguerre
    square = 2.0 * (size**2 + sigma**2 - size * mean)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def map_samples(
    samples: Samples,
    geometry: SocketGeometry,
    settings: ForceMapSettings,
    leave_out: tuple[str, ...] = (),
) -> MapEstimate:
    """The map at every sample, without single outliers and without channels that are left out."""
    trusted = without_untrusted(samples, geometry, leave_out)
    return ForceMap(geometry, samples.clusters, settings).estimate(trusted)


def without_untrusted(
    samples: Samples, geometry: SocketGeometry, leave_out: tuple[str, ...] = ()
) -> Samples:
    """The samples without single outliers and without channels that are left out."""
    ignored = find_outliers(samples, geometry, leave_out).values
    ignored[:, [name in leave_out for name in samples.channels]] = True
    return without_outliers(samples, Outliers(np.zeros(len(samples), bool), ignored))


def surface_correlation(geometry: SocketGeometry, length: float) -> FloatArray:
    """Matern correlation of the tiles along the surface, definite, shape (n, n) [-].

    Forces are alike over the length l [m].
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

    Translations along two directions across the socket and the proximal one, and rotations about
    them and the mean anchor, whose displacement at the distance `arm` [m] is 1.
    """
    axes = np.linalg.svd(proximal_direction(geometry)[None])[2][[1, 2, 0]]
    arms = (geometry.anchors - geometry.anchors.mean(axis=0)) / arm
    in_socket = np.empty((len(geometry), 3, 6))
    in_socket[:, :, :3] = axes.T
    in_socket[:, :, 3:] = np.swapaxes(np.cross(axes, arms[:, None]), 1, 2)
    return np.swapaxes(geometry.rotations, 1, 2) @ in_socket


_RELATIVE = ("shear", "preload", "bed", "sinking", "rotation", "bed_shear", "bed_variation")


def _draw(settings: ForceMapSettings) -> list[ForceMapSettings]:
    """The prior's uncertain sizes, drawn evenly (a Latin hypercube; one draw has the medians).

    Each draw comes with several sizes of the clusters' offsets: what matters most.
    """
    levels = np.tile(ndtri(_levels(settings.draws)), (len(_RELATIVE) + 1, 1))
    points = np.random.default_rng(0).permuted(levels, axis=1).T
    offsets = np.exp(settings.cluster_error_spread * ndtri(_levels(_OFFSETS)))
    found: list[ForceMapSettings] = []
    for *relative, of_share in points.tolist():
        factors = zip(_RELATIVE, np.exp(settings.spread * np.array(relative)), strict=True)
        sizes = {name: getattr(settings, name) * factor for name, factor in factors}
        share = min(max(settings.share + settings.share_spread * of_share, 0.2), 1.0)
        drawn = replace(settings, **sizes, share=share)
        errors = (settings.cluster_error * offsets).tolist()
        found += [replace(drawn, cluster_error=error) for error in errors]
    return found


def _levels(count: int) -> FloatArray:
    """Middles of equally probable parts, shape (count,) [-]."""
    return np.asarray((np.arange(count) + 0.5) / count)


def _prior_moments(
    geometry: SocketGeometry, clusters: tuple[str, ...], settings: ForceMapSettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariances under the M draws of the prior, from which any channels can condition the forces.

    Returns:
        That of the channels, shape (M, c, c), of the forces with the channels, shape (M, n, 4, c),
        and the variances of the forces, shape (M, n, 4).
    """
    count = len(geometry)
    # From a tile's frame to x, y, z of {S} and the normal.
    along_normal = np.broadcast_to([[0.0, 0.0, 1.0]], (count, 1, 3))
    turned = np.concatenate([geometry.rotations, along_normal], axis=1)
    tile = np.arange(3 * count).reshape(count, 3)
    correlation = surface_correlation(geometry, settings.length)
    motions = _rigid_motions(geometry, settings.arm)
    total, cross, variances = [], [], []
    for drawn in _draw(settings):
        prior = _prior(geometry, correlation, motions, drawn)
        mapping = _mapping(geometry, clusters, drawn.share)
        mapped = prior @ mapping.T
        signal = mapping @ mapped
        total.append(signal + _noise(signal, drawn))
        cross.append(turned @ mapped.reshape(count, 3, -1))
        before = turned @ prior[tile[:, :, None], tile[:, None]]
        variances.append((before * turned).sum(axis=2))
    return np.array(total), np.array(cross), np.array(variances)


def _prior(
    geometry: SocketGeometry,
    correlation: FloatArray,
    motions: FloatArray,
    settings: ForceMapSettings,
) -> FloatArray:
    """Covariance K of all forces in the tiles' frames, shape (3n, 3n) [N^2]: see this module."""
    count = len(geometry)
    bed = motions * np.array([settings.bed_shear, settings.bed_shear, 1.0])[:, None]
    bed = bed / np.sqrt((bed**2).sum(axis=1).mean(axis=0))
    sizes = [settings.bed, settings.bed, settings.sinking, *[settings.rotation] * 3]
    bed = (bed * sizes).reshape(3 * count, 6)
    varying = 1.0 + settings.bed_variation**2 * correlation
    prior = (bed @ bed.T) * np.kron(varying, np.ones((3, 3)))
    for axis, size in enumerate((settings.shear, settings.shear, 1.0)):
        prior[axis::3, axis::3] += size**2 * correlation
    prior[2::3, 2::3] += settings.preload**2

    drag = np.tile(np.eye(3), (count, 1, 1))
    drag[:, :2, 2] = settings.drag * (proximal_direction(geometry) @ geometry.rotations)[:, :2]
    prior = drag @ prior.reshape(count, 3, 3 * count)
    prior = drag @ np.moveaxis(prior.reshape(3 * count, count, 3), 0, 2)
    return settings.normal_deviation**2 * prior.reshape(3 * count, 3 * count)


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
    """Covariance R of noise, offset and gain of the channels, diagonal, by the prior's H K H'."""
    clusters = len(signal) - len(WRENCH_CHANNELS)
    errors = (settings.moment_error, settings.force_error, settings.cluster_error)
    offset = np.repeat(errors, (3, 3, clusters))
    gain = np.repeat([0.0, settings.cluster_gain_error], (len(WRENCH_CHANNELS), clusters))
    return np.diag(offset**2 + gain**2 * np.diag(signal))
