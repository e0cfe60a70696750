r"""The force on every tile of the socket from one sample's clusters and wrench, with uncertainty.

The tiles' forces are a Gaussian process over the socket's surface, conditioned on the channels of
one sample. Nothing is fitted beforehand. In the tiles' frames {L_i} (z is the inward normal) the
prior has the mean zero and the covariance

.. math:: K = T \bigl(K_{field} + K_{preload} + (U U^T) \circ (1 + \kappa^2 M)\bigr) T^T

- M is the Matern correlation :math:`(1 + \sqrt{3} d/\ell) e^{-\sqrt{3} d/\ell}` over the tiles'
  distance d: neighbouring forces are similar;
- the field has this correlation, with one amplitude for the normal and one for both tangents; the
  preload is a normal force common to all tiles;
- the six columns of U are the forces of a bed of springs under a small motion of the rigid limb,
  with weak tangential springs; the bed's stiffness varies by kappa;
- T adds a tangential force along the socket's axis, the drag of a sinking limb, as a share of the
  normal force.

Every term is positive semidefinite, and the field is definite. H maps the forces F to the channels
y: the wrench [M; F], partly carried by the surface between the tiles, and each cluster's force in
its frame. With the noise R of the channels

.. math:: F = K H^T (H K H^T + R)^{-1} y

(Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section 2.2). These
hyperparameters are uncertain. The common amplitude has an inverse-gamma prior and is integrated
out. The others follow wide distributions (`ForceMapSettings`), from which a quasi-random sequence
draws M hypotheses, weighted by their mean evidence to the power 0.6: over the trial, or live over
recent samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy.special import chdtri, expit, gammaln, i0e, i1e, logsumexp, ndtri

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, evenly
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import rigid_motions, wrench_map
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, local_channels
from socket_testbed.settings.identification import MIN_SHARE, ForceMapSettings

if TYPE_CHECKING:
    import pandas as pd

NORMAL_QUANTILE = 1.96  # [-]; standard deviations to each end of a 95 % interval
_NUGGET = 1e-9  # [-]; keeps the correlation definite when tiles almost coincide
AMPLITUDE_FREEDOM = 2.0  # [1]; degrees of freedom of the prior of the amplitude
_EVIDENCE_MEMORY = 1000  # live samples over which the evidence is averaged
EVIDENCE_POWER = 0.6  # [-]; the prior's laws are no limb's: trust the evidence less than fully
_TILE_SHARE_SPREAD = 0.03  # [-]; of the load, about the share of the wall that the tiles cover
_MIN_WEIGHT = 2e-3  # of a hypothesis, relative to the likeliest
_MAX_SAMPLES = 500  # samples of a trial, evenly spread
_CHUNK = 256  # samples of products
_BLOCK = 1024  # samples of a mean
_MANY = 64  # samples, from which quadratic forms of the variances are worth making
_DRAW_BATCH = 2048  # samples per batch of joint draws
_TINY = 1e-12  # [N]
_MAX_PATTERNS = 16  # cached patterns of present channels; each takes about 1 MB


@dataclass(frozen=True)
class MapEstimate:
    """Forces of the limb on all n tiles with their standard deviations, for N samples.

    Attributes:
        forces: Forces of the limb on the socket's tiles in {S}, shape (N, n, 3) [N].
        standard_deviations: Standard deviations of the forces, by axis of {S}, shape
            (N, n, 3) [N].
        normal_pressure: Normal pressures on the tiles, positive in compression, shape (N, n) [Pa].
        normal_pressure_standard_deviation: Standard deviations of the normal pressures, shape
            (N, n) [Pa].
        shear: Magnitudes of the tangential forces over the areas, shape (N, n) [Pa].
        shear_standard_deviation: Root mean square differences of the Rice-distributed magnitudes
            from `shear`, shape (N, n) [Pa].
        source: What the estimate was conditioned on, in words.
    """

    forces: FloatArray
    standard_deviations: FloatArray
    normal_pressure: FloatArray
    normal_pressure_standard_deviation: FloatArray
    shear: FloatArray
    shear_standard_deviation: FloatArray
    source: str

    @property
    def pressure_reach(self) -> FloatArray:
        """Half-widths of the 95 % intervals of the normal pressures, shape (N, n) [Pa]."""
        return NORMAL_QUANTILE * self.normal_pressure_standard_deviation

    @property
    def _stresses(self) -> dict[str, FloatArray]:
        """Pressure and shear with their standard deviations, by name, shape (N, n) each [Pa]."""
        return {
            "pressure": self.normal_pressure,
            "pressure sd": self.normal_pressure_standard_deviation,
            "shear": self.shear,
            "shear sd": self.shear_standard_deviation,
        }

    def columns(self, names: tuple[str, ...], prefix: str = "") -> dict[str, FloatArray]:
        """Columns of a table with one row per sample, shape (N,) each, by titles with units.

        For each tile the force in {S} and its standard deviation, such as `tile_012.Fz [N]` and
        `tile_012.Fz.sd [N]`, then normal pressure and shear with theirs, such as
        `tile_012.pressure [Pa]` and `tile_012.pressure.sd [Pa]`.

        Args:
            names: Names of the n tiles, in the order of the geometry.
            prefix: What each title begins with.
        """
        found = {}
        for tile, name in enumerate(names):
            for axis, force in enumerate(LOCAL_CHANNELS):
                found[f"{prefix}{name}.{force} [N]"] = self.forces[:, tile, axis]
                found[f"{prefix}{name}.{force}.sd [N]"] = self.standard_deviations[:, tile, axis]
            for stress, values in self._stresses.items():
                found[f"{prefix}{name}.{stress.replace(' ', '.')} [Pa]"] = values[:, tile]
        return found

    def by_tile(self, geometry: SocketGeometry) -> pd.DataFrame:
        """Pressure and shear of the first sample with their standard deviations [kPa].

        The table has a row per tile of the geometry, indexed by its name, with the cluster on it.
        """
        import pandas as pd

        columns = {f"{name} [kPa]": 1e-3 * values[0] for name, values in self._stresses.items()}
        tiles = pd.Index(geometry.names, name="tile")
        return pd.DataFrame({"cluster": geometry.cluster_names, **columns}, index=tiles)


@dataclass(frozen=True)
class Family:
    """M hypotheses: what they say of forces and channels before a sample is measured.

    A tile's force has four components here: along x, y, z of {S} and along the tile's normal.
    Variances are for an amplitude of 1. Where earlier channels tell of the forces, these have a
    mean at each of s loads.

    Attributes:
        total: Covariances of the 6 + 3c channels with their noise, shape (M, 6 + 3c, 6 + 3c).
        cross: Covariances of the forces with the channels, shape (M, n, 4, 6 + 3c).
        variances: Variances of the forces, shape (M, n, 4) [N^2].
        forces: Means of the forces at each load, shape (M, s, n, 4) [N].
        channels: Means of the channels, shape (M, s, 6 + 3c) [N m, N].
        distances: Squared distances of the earlier channels from zero, shape (M, s) [-].
        earlier: Number of earlier channels; 0 for a mean of zero, with s = 0.
    """

    total: FloatArray
    cross: FloatArray
    variances: FloatArray
    forces: FloatArray
    channels: FloatArray
    distances: FloatArray
    earlier: int = 0

    def conditioned(self, present: IntArray) -> _Conditioned:
        """The hypotheses, conditioned on the channels of these indices, shape (d,)."""
        cross = self.cross[..., present]
        total = self.total[:, present[:, None], present]
        precision = np.asarray(np.linalg.inv(total), np.float64)
        gain = cross @ precision[:, None]
        log_determinant = -np.linalg.slogdet(precision)[1]
        variances = self.variances - (gain * cross).sum(axis=3)
        if self.earlier:
            # A mean c m at a load s is the column m of further channels, of which s has the value
            # c and the others 0.
            expected = self.channels[..., present]  # (M, s, d)
            offset = self.forces - np.einsum("mnad,msd->msna", gain, expected)
            gain = np.concatenate([gain, np.moveaxis(offset, 1, 3)], axis=3)
            known = expected @ precision
            own = known @ np.swapaxes(expected, 1, 2)
            own += self.distances[:, :, None] * np.eye(self.distances.shape[1])
            precision = np.block([[precision, -np.swapaxes(known, 1, 2)], [-known, own]])
        return _Conditioned(
            present=present,
            gain=gain,
            precision=precision,
            log_determinant=log_determinant,
            variances=variances,
            distances=self.distances,
            earlier=self.earlier,
        )


@dataclass(frozen=True)
class _Conditioned:
    """M hypotheses, conditioned on the present channels, see `Family`.

    S is the covariance of the present channels: H K H' + R for a mean of zero. The values of d
    channels are followed by those of the s loads: how many times its mean is expected.

    Attributes:
        present: Indices of the d present channels among all 6 + 3c, shape (d,).
        gain: K H' S^-1 of the hypotheses, from the values to the forces, shape (M, n, 4, d + s)
            [1/m, -].
        precision: S^-1 of the hypotheses, shape (M, d + s, d + s) [1/N^2, or per N m instead of N].
        log_determinant: Logarithm of the determinant of S, shape (M,).
        variances: Variances of the forces for an amplitude of 1, shape (M, n, 4) [N^2].
        distances: As in `Family`.
        earlier: As in `Family`.
    """

    present: IntArray
    gain: FloatArray
    precision: FloatArray
    log_determinant: FloatArray
    variances: FloatArray
    distances: FloatArray
    earlier: int

    def __getitem__(self, kept: IntArray) -> _Conditioned:
        shared = ("present", "earlier")
        parts = {name: values[kept] for name, values in vars(self).items() if name not in shared}
        return replace(self, **parts)

    @property
    def count(self) -> int:
        """Number of channels behind the forces, present and earlier ones."""
        return len(self.present) + self.earlier

    def average(self, measured: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variances of the forces over the hypotheses, shape (N, n, 4) each [N, N^2].

        Under each hypothesis the squared amplitude has the posterior mean
        (f + y' S^-1 y) / (f + d - 2), d with the earlier channels.

        Args:
            measured: Values of the present channels and loads, shape (N, d + s) [N m, N].
            weights: Probabilities of the hypotheses, shape (M,) [-].
        """
        if len(measured) >= _MANY:
            return self._average_many(measured, weights)
        count, channels = measured.shape
        hypotheses, tiles = self.variances.shape[:2]
        forces = measured @ self.gain.reshape(hypotheses * tiles * 4, channels).T
        forces = forces.reshape(count, hypotheses, tiles * 4)
        scales = (AMPLITUDE_FREEDOM + self.distance(measured)) * self._shares(weights)
        mean = weights @ forces
        between = weights @ forces**2 - mean**2
        variances = scales @ self.variances.reshape(hypotheses, -1) + np.maximum(between, 0.0)
        return mean.reshape(count, -1, 4), variances.reshape(count, -1, 4)

    def _average_many(
        self, measured: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `average`: each variance is a constant and a quadratic form in the values.

        The forms are made once, whatever the number of samples.
        """
        hypotheses, channels = len(weights), measured.shape[1]
        gains = self.gain.reshape(hypotheses, -1, channels)
        within = self._shares(weights)[:, None] * self.variances.reshape(hypotheses, -1)  # (M, 4n)
        gain = np.tensordot(weights, gains, axes=1)
        apart = np.swapaxes(np.sqrt(weights)[:, None, None] * (gains - gain), 0, 1)  # (4n, M, d)
        forms = np.swapaxes(apart, 1, 2) @ apart  # between the hypotheses
        forms += np.tensordot(within, self.precision, axes=(0, 0))
        # A form is the sum over pairs of channels, each pair once.
        one, other = np.triu_indices(channels)
        pairs = forms[:, one, other] + np.where(one == other, 0.0, forms[:, other, one])
        mean, variances = np.empty((2, len(measured), len(gain)))
        for start in range(0, len(measured), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            values = measured[chunk]
            np.matmul(values, gain.T, out=mean[chunk])
            np.matmul(values[:, one] * values[:, other], pairs.T, out=variances[chunk])
        variances += AMPLITUDE_FREEDOM * within.sum(axis=0)
        return mean.reshape(len(measured), -1, 4), variances.reshape(len(measured), -1, 4)

    def _shares(self, weights: FloatArray) -> FloatArray:
        """Factors of f + y' S^-1 y in the forces' variances, shape (M,) [-]."""
        return weights / max(AMPLITUDE_FREEDOM + self.count - 2.0, 1.0)

    def distance(self, measured: FloatArray) -> FloatArray:
        """Squared distances y' S^-1 y of the values (N, d + s) by hypothesis, shape (N, M) [-]."""
        hypotheses, channels = self.precision.shape[:2]
        # One large product is several times faster than a batch of small ones.
        whitened = measured @ self.precision.reshape(hypotheses * channels, channels).T
        whitened = whitened.reshape(len(measured), hypotheses, channels)
        return np.einsum("nmd,nd->nm", whitened, measured)

    def log_evidence(self, measured: FloatArray) -> FloatArray:
        """Of the hypotheses for the values (N, d + s), shape (N, M) [-].

        Given the amplitude's prior, the channels have a multivariate t distribution; after earlier
        channels it is the ratio of two. Constants that depend on d alone, or on the number of
        earlier channels alone, are left out.
        """
        freedom = AMPLITUDE_FREEDOM
        exponent, before = freedom + self.count, freedom + self.earlier
        distance = np.log1p(self.distance(measured) / freedom)
        found = gammaln(0.5 * exponent) - 0.5 * (self.log_determinant + exponent * distance)
        if self.earlier:
            known = measured[:, len(self.present) :] ** 2 @ self.distances.T
            found += 0.5 * before * np.log1p(known / freedom)
        return np.asarray(found)


def _mirrored(means: FloatArray, errors: FloatArray, axis: int) -> FloatArray:
    """Means with errors added, followed along an axis by those with errors subtracted."""
    shape = [*means.shape]
    shape[axis] *= 2
    drawn = np.empty(shape)
    above, below = np.split(drawn, 2, axis)
    np.add(means, errors, out=above)
    np.subtract(means, errors, out=below)
    return drawn


@dataclass(frozen=True)
class JointDraws:
    """D joint draws of the forces on all n tiles at k samples, in factored form.

    A draw of the forces in the tiles' frames is :math:`G_m y + b_m E_d` with its hypothesis m. The
    second half of the draws has the errors of the first with opposite sign.

    Attributes:
        rows: Indices of the k samples among those given to `ForceMap.sample`, shape (k,).
        channels: Their d present channels y, shape (k, d) [N m, N].
        gain: G of the M hypotheses, from the channels to the forces in the tiles' frames, flattened
            to x, y, z of one tile after another, shape (M, 3n, d) [1/m, -].
        weights: Probabilities of the hypotheses, shape (M,) [-].
        sizes: Scales b of the errors under each hypothesis, shape (k, M) [-].
        hypotheses: Index of the hypothesis of each of the first D/2 draws, shape (D/2,).
        errors: Errors E of the first D/2 draws, in the tiles' frames, shape (D/2, 3n) [N].
    """

    rows: IntArray
    channels: FloatArray
    gain: FloatArray
    weights: FloatArray
    sizes: FloatArray
    hypotheses: IntArray
    errors: FloatArray

    def __getitem__(self, part: slice) -> JointDraws:
        channels, sizes = self.channels[part], self.sizes[part]
        return replace(self, rows=self.rows[part], channels=channels, sizes=sizes)

    def values(self) -> FloatArray:
        """The draws of the forces on the socket in the tiles' frames, shape (k, D, 3n) [N].

        The last axis is x, y, z of one tile after another.
        """
        errors = self.sizes[:, self.hypotheses, None] * self.errors
        hypotheses, forces, channels = self.gain.shape
        means = self.channels @ self.gain.reshape(-1, channels).T
        means = means.reshape(-1, hypotheses, forces)[:, self.hypotheses]
        return _mirrored(means, errors, axis=1)

    def ordered(self, batch: int) -> Iterator[tuple[slice, FloatArray]]:
        """The draws of every force in ascending order, shape (k, 3n, D) [N], in batches of samples.

        Args:
            batch: Number of samples of a batch; of a few, all draws stay in the cache.

        Yields:
            A slice of the samples, and their draws.
        """
        count, half = len(self.rows), len(self.hypotheses)
        gain = np.swapaxes(self.gain[self.hypotheses], 0, 1)  # (3n, D/2, d)
        forces, _, channels = gain.shape
        onto = gain.reshape(-1, channels).T
        errors, sizes = np.ascontiguousarray(self.errors.T), self.sizes[:, None, self.hypotheses]
        for start in range(0, count, batch):
            some = slice(start, min(start + batch, count))
            means = (self.channels[some] @ onto).reshape(-1, forces, half)
            draws = _mirrored(means, sizes[some] * errors, axis=2)
            draws.sort(axis=-1)
            yield some, draws

    def mean(self) -> FloatArray:
        """The estimate in the tiles' frames: the mean over the hypotheses, shape (k, 3n) [N]."""
        gain = np.tensordot(self.weights, self.gain, axes=1)
        return np.asarray(self.channels @ gain.T)

    def mapped(self, mapping: FloatArray) -> JointDraws:
        """Draws of r linear functions of the forces, with r in place of 3n in every shape.

        The mapping from the forces in the tiles' frames has the shape (3n, r), in any unit.
        """
        gain = np.einsum("mfd,fr->mrd", self.gain, mapping, optimize=True)
        return replace(self, gain=np.ascontiguousarray(gain), errors=self.errors @ mapping)


class Surveyed(Protocol):
    """What a survey of the limb says of a trial, see `survey_prior.Expected`.

    Attributes:
        name: The survey in words.
        doubt: Why it may make the map worse; empty if nothing says so.
        weights: Probabilities of its hypotheses, shape (T,) [-].
        family: What they say at each of s loads.
    """

    name: str
    doubt: str
    weights: FloatArray
    family: Family

    def loads(self, values: FloatArray) -> FloatArray:
        """How many times the mean at each load is expected in samples, shape (N, s) [-].

        Args:
            values: Channels of N samples, the wrench [M; F] first, shape (N, 6 + 3c) [N m, N].
        """

    def weighed(self, evidence: FloatArray) -> FloatArray:
        """Probabilities of the hypotheses given their log evidence, shape (T,) each [-].

        Args:
            evidence: Mean log evidence of the trial's samples [-].
        """

    def covariance(self, number: int) -> FloatArray:
        """Covariance of the forces in the tiles' frames under a hypothesis, (3n, 3n) [N^2].

        Args:
            number: Index of the hypothesis, below T.
        """


@dataclass(frozen=True)
class _Belief:
    """Probabilities of the hypotheses.

    Attributes:
        ordinary: Of those of the ordinary prior, with a sum of 1, shape (M,) [-]; 0 for unlikely
            ones.
        surveyed: Of those of a survey, with a sum of 1, shape (T,) [-]; empty without one.
        share: Probability of the survey's prior against the ordinary one [-].
    """

    ordinary: FloatArray
    surveyed: FloatArray
    share: float = 0.0


class ForceMap:
    """Maps one sample's clusters and wrench to the forces on all tiles, with uncertainty.

    The evidence of a trial's samples weighs the hypotheses. Without a trial, `estimate`, `mean`
    and `sample` use the evidence of their own samples, and `update` that of recent samples.

    A survey of the limb gives another prior, beside the ordinary one: what its trials say of the
    forces at a like load, see `survey_prior`. The evidence of the samples with such a load weighs
    one prior against the other, even at first; other samples have the ordinary prior alone.

    Args:
        geometry: The socket with its n tiles.
        clusters: Names of the c clusters, in the order of the samples.
        settings: Sizes and spreads of the ordinary prior; None for the default settings.
        trial: Samples whose evidence weighs the hypotheses; None for no trial.
        surveyed: What a survey of the limb says of this socket and these clusters; None for the
            ordinary prior alone. `update` ignores it.
    """

    def __init__(
        self,
        geometry: SocketGeometry,
        clusters: tuple[str, ...],
        settings: ForceMapSettings | None = None,
        trial: Samples | None = None,
        surveyed: Surveyed | None = None,
    ) -> None:
        self._geometry = geometry
        self._clusters = clusters
        self._areas = geometry.areas
        self._normals = geometry.rotations[:, :, 2]
        guesses = hypotheses(settings or ForceMapSettings(), geometry.tile_share)
        self._priors = [Prior(geometry, clusters, sizes) for sizes in guesses]
        turned = axes_of(geometry)
        count, channels = len(self._priors), len(WRENCH_CHANNELS) + 3 * len(clusters)
        self._family = Family(
            total=np.array([prior.signal + np.diag(prior.noise) for prior in self._priors]),
            cross=np.array([turned @ prior.with_channels for prior in self._priors]),
            variances=np.array(
                [(turned @ prior.blocks * turned).sum(axis=2) for prior in self._priors]
            ),
            forces=np.zeros((count, 0, len(geometry), 4)),
            channels=np.zeros((count, 0, channels)),
            distances=np.zeros((count, 0)),
        )
        self._survey = surveyed
        self._make_caches()
        self._evidence_count = 0  # samples
        self._evidence = np.zeros(len(self._priors))
        self._belief: _Belief | None = None
        if trial is not None:
            self._evidence = self._mean_evidence(trial)
            self._evidence_count = len(trial)
            self._belief = self._judged(trial, self._evidence)

    def _make_caches(self) -> None:
        # Keyed by the bytes of a pattern, and of the chosen hypotheses: both rarely change.
        self._conditioned = lru_cache(_MAX_PATTERNS)(self._condition)
        self._prior_draws = lru_cache(1)(self._draw)
        self._surveyed_draws = lru_cache(1)(self._draw_surveyed)

    def __getstate__(self) -> dict[str, Any]:
        # Caches cannot be pickled; a copy makes its own.
        caches = ("_conditioned", "_prior_draws", "_surveyed_draws")
        return {name: value for name, value in vars(self).items() if name not in caches}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_caches()

    def estimate(self, samples: Samples) -> MapEstimate:
        """The map at each of N samples; the prior's if a sample has no channel at all."""
        values, present = _channels(samples)
        return self._estimate(values, present, self._weights(samples))

    def update(self, sample: Samples) -> MapEstimate:
        """The map at one live sample, with N = 1, whose evidence updates the hypotheses' weights.

        Ignores channels without a value and clusters whose status is not OK.
        """
        values, present = self._weigh(sample)
        belief = _Belief(probabilities(self._evidence), np.zeros(0))
        return self._estimate(values, present, belief)

    def learn(self, sample: Samples) -> None:
        """Let one live sample update the hypotheses' weights as `update` does, without its map."""
        self._weigh(sample)

    def _weigh(self, sample: Samples) -> tuple[FloatArray, BoolArray]:
        """Update the hypotheses' weights by one live sample; returns its `_channels`."""
        values, present = _channels(sample)
        if present.any():
            conditioned = self._conditioned(present[0].tobytes())
            found = conditioned.log_evidence(values[:, conditioned.present])[0]
            self._evidence_count = min(self._evidence_count + 1, _EVIDENCE_MEMORY)
            self._evidence += (found - self._evidence) / self._evidence_count
        return values, present

    def _mean_evidence(self, samples: Samples) -> FloatArray:
        """Log evidence of the hypotheses, averaged over the samples, shape (M,) [-]."""
        values, present = _channels(samples)
        rows = np.flatnonzero(present.any(axis=1))
        rows = rows[evenly(len(rows), _MAX_SAMPLES)]
        total = np.zeros(len(self._priors))
        for pattern, some in _by_pattern(present[rows]):
            conditioned = self._conditioned(pattern)
            measured = values[rows[some]][:, conditioned.present]
            total += conditioned.log_evidence(measured).sum(axis=0)
        return total / max(len(rows), 1)

    def _weights(self, samples: Samples) -> _Belief:
        """Probabilities of the hypotheses for some samples."""
        if self._belief is not None:
            return self._belief
        known = self._evidence_count
        return self._judged(samples, self._evidence if known else self._mean_evidence(samples))

    def _judged(self, samples: Samples, evidence: FloatArray) -> _Belief:
        """Probabilities by the evidence of samples, that of the ordinary hypotheses given, (M,)."""
        ordinary = probabilities(evidence)
        if self._survey is None:
            return _Belief(ordinary, np.zeros(0))
        values, present = _channels(samples)
        loads = self._survey.loads(values)
        rows = np.flatnonzero(loads.any(axis=1))
        rows = rows[evenly(len(rows), _MAX_SAMPLES)]
        if not len(rows):
            return _Belief(ordinary, self._survey.weights)
        # Log evidence of all channels, and of the wrench alone.
        ordinary_evidence = np.zeros((2, len(self._priors)))
        surveyed_evidence = np.zeros((2, len(self._survey.weights)))
        for pattern, some in _by_pattern(present[rows]):
            for number, kept in enumerate((pattern, _wrench_of(pattern))):
                conditioned = self._conditioned(kept)
                measured = values[rows[some]][:, conditioned.present]
                ordinary_evidence[number] += conditioned.log_evidence(measured).sum(axis=0)
                measured = np.hstack([measured, loads[rows[some]]])
                conditioned = self._conditioned(kept, True)
                surveyed_evidence[number] += conditioned.log_evidence(measured).sum(axis=0)
        ordinary_evidence, surveyed_evidence = (
            evidence / len(rows) for evidence in (ordinary_evidence, surveyed_evidence)
        )
        # The load is like the survey's by choice: only the clusters tell whether the limb is.
        own, of_load = logsumexp(ordinary_evidence, axis=1)
        surveyed, of_like_load = logsumexp(np.log(self._survey.weights) + surveyed_evidence, axis=1)
        odds = (surveyed - of_like_load) - (own - of_load)
        weights = self._survey.weighed(surveyed_evidence[0])
        return _Belief(ordinary, weights, float(expit(odds)))

    def _estimate(self, values: FloatArray, present: BoolArray, belief: _Belief) -> MapEstimate:
        """The map from channels (N, 6 + 3c) [N m, N] and the hypotheses' probabilities.

        `present` marks the channels with a value, shape (N, 6 + 3c).
        """
        forces, variances = np.empty((2, len(values), len(self._areas), 4))
        loads = self._loads(values, belief)
        for pattern, rows in _by_pattern(present):
            likely = np.flatnonzero(belief.ordinary)
            conditioned, weights = self._conditioned(pattern)[likely], belief.ordinary[likely]
            measured = values[rows][:, conditioned.present]
            forces[rows], variances[rows] = conditioned.average(measured, weights)
            like = rows[loads[rows].any(axis=1)]
            if not len(like):
                continue
            likely = np.flatnonzero(belief.surveyed)
            conditioned, weights = self._conditioned(pattern, True)[likely], belief.surveyed[likely]
            measured = np.hstack([values[like][:, conditioned.present], loads[like]])
            surveyed = conditioned.average(measured, weights)
            ordinary = forces[like], variances[like]
            forces[like], variances[like] = _mixed(ordinary, surveyed, belief.share)
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
            source=self._source(values, present, belief),
        )

    def mean(self, samples: Samples) -> MapEstimate:
        """The mean of the map over the samples, with N = 1, in bounded memory.

        Nearly the same directions are unobserved in every sample, so the mean is as uncertain as a
        typical sample: its standard deviations are root mean squares. There must be a sample.
        """
        values, present = _channels(samples)
        weights = self._weights(samples)
        count, tiles = len(samples), len(self._areas)
        # Sums over the samples: of means, and of the squares of standard deviations.
        forces, force_squares = np.zeros((2, 1, tiles, 3))
        pressure, pressure_squares, shear, shear_squares = np.zeros((4, 1, tiles))
        for start in range(0, count, _BLOCK):
            block = slice(start, start + _BLOCK)
            found = self._estimate(values[block], present[block], weights)
            forces += found.forces.sum(axis=0)
            force_squares += (found.standard_deviations**2).sum(axis=0)
            pressure += found.normal_pressure.sum(axis=0)
            pressure_squares += (found.normal_pressure_standard_deviation**2).sum(axis=0)
            shear += found.shear.sum(axis=0)
            shear_squares += (found.shear_standard_deviation**2).sum(axis=0)
        return MapEstimate(
            forces=forces / count,
            standard_deviations=np.sqrt(force_squares / count),
            normal_pressure=pressure / count,
            normal_pressure_standard_deviation=np.sqrt(pressure_squares / count),
            shear=shear / count,
            shear_standard_deviation=np.sqrt(shear_squares / count),
            source=self._source(values, present, weights),
        )

    def survey_probability(self, samples: Samples) -> float:
        """Probability of the survey's prior for some samples [-]; 0 without a like load."""
        return self._weights(samples).share

    def source(self, samples: Samples) -> str:
        """The prior, and the channels that the map of samples is conditioned on, in words."""
        values, present = _channels(samples)
        return self._source(values, present, self._weights(samples))

    def sample(self, samples: Samples, count: int = 200) -> Iterator[JointDraws]:
        r"""Joint draws of the forces on all tiles, given the channels of each sample.

        A hypothesis is drawn by its evidence, and the amplitude s from its posterior, an
        inverse-gamma distribution. With F' and e drawn from the prior of the forces and from the
        noise of the channels, the forces

        .. math:: F = G y + s \, (F' - G (H F' + e))

        have the posterior distribution (Matheron's rule: Journel & Huijbregts, Mining
        Geostatistics, 1978, section VII.A). All samples share the random numbers: the unobserved
        directions stay the same over a trial, so averaging over time does not reduce uncertainty.
        They are seeded, and come in pairs of opposite errors.

        Args:
            samples: N samples with the clusters of the map.
            count: Number D of draws at each sample, even.

        Yields:
            The draws of a batch of samples; each sample occurs once, in any order.
        """
        belief = self._weights(samples)
        values, present = _channels(samples)
        loads = self._loads(values, belief)
        for pattern, rows in _by_pattern(present):
            like = loads[rows].any(axis=1)
            for some, surveyed in ((rows[~like], False), (rows[like], True)):
                if len(some):
                    yield from self._batches(pattern, some, values, loads, belief, surveyed, count)

    def _batches(
        self,
        pattern: bytes,
        rows: IntArray,
        values: FloatArray,
        loads: FloatArray,
        belief: _Belief,
        surveyed: bool,
        count: int,
    ) -> Iterator[JointDraws]:
        """Batches of joint draws at the samples of some rows, whose channels have one pattern."""
        middles = (np.arange(count // 2) + 0.5) / (count // 2)  # of equally probable parts
        levels = np.random.default_rng(0).permuted(np.tile(middles, (2, 1)), axis=1)
        tiles = len(self._areas)
        weights = belief.ordinary
        if surveyed:
            weights = np.concatenate(
                [(1.0 - belief.share) * weights, belief.share * belief.surveyed]
            )
        kept = np.flatnonzero(weights)
        weights = weights[kept]
        chosen = np.searchsorted(weights.cumsum()[:-1], levels[0])
        own, others = kept[kept < len(self._priors)], kept[kept >= len(self._priors)]
        ordinary = self._conditioned(pattern)[own]
        gain = self._in_tiles(ordinary.gain)
        drawn = chosen < len(own)
        priors, errors = self._prior_draws(own[chosen[drawn]].tobytes())
        known = gain[chosen[drawn]] @ errors[:, ordinary.present, None]
        left = np.empty((len(chosen), 3 * tiles))
        left[drawn] = priors - known[..., 0]
        counts = np.full(len(chosen), ordinary.count)
        if surveyed:
            others = others - len(self._priors)
            after = self._conditioned(pattern, True)[others]
            left[~drawn] = self._surveyed_draws(
                pattern, others[chosen[~drawn] - len(own)].tobytes()
            )
            counts[~drawn] = after.count
            # The ordinary hypotheses have no mean.
            gain = np.pad(gain, ((0, 0), (0, 0), (0, loads.shape[1])))
            gain = np.concatenate([gain, self._in_tiles(after.gain)])
        left /= np.sqrt(chdtri(AMPLITUDE_FREEDOM + counts, levels[1]))[:, None]
        for start in range(0, len(rows), _DRAW_BATCH):
            some = rows[start : start + _DRAW_BATCH]
            measured = values[some][:, ordinary.present]
            distance = ordinary.distance(measured)
            if surveyed:
                measured = np.hstack([measured, loads[some]])
                distance = np.hstack([distance, after.distance(measured)])
            yield JointDraws(
                rows=some,
                channels=measured,
                gain=gain,
                weights=weights,
                sizes=np.sqrt(AMPLITUDE_FREEDOM + distance),
                hypotheses=chosen,
                errors=left,
            )

    def _in_tiles(self, gain: FloatArray) -> FloatArray:
        """Gains to the forces in the tiles' frames, shape (M, 3n, d), from those in {S}."""
        found = np.einsum("nij,mnid->mnjd", self._geometry.rotations, gain[:, :, :3])
        return found.reshape(len(gain), 3 * len(self._areas), gain.shape[-1])

    def _draw_surveyed(self, pattern: bytes, chosen: bytes) -> FloatArray:
        """Draws of the forces' errors under hypotheses of the survey, (D, 3n) [N].

        They are in the tiles' frames, for an amplitude of 1, and what the channels of the pattern
        leave; `chosen` holds the bytes of the index of each draw's hypothesis, shape (D,).
        """
        assert self._survey is not None
        numbers = np.frombuffer(chosen, np.int64)
        drawn = np.random.default_rng(1).standard_normal((len(numbers), 3 * len(self._areas)))
        conditioned = self._conditioned(pattern, True)
        for number in np.unique(numbers):
            which, present = numbers == number, conditioned.present
            gain = self._in_tiles(conditioned[np.array([number])].gain)[0][:, : len(present)]
            cross = self._in_tiles(self._survey.family.cross[[number]])[0][:, present]
            left = self._survey.covariance(int(number)) - gain @ cross.T
            sizes, directions = np.linalg.eigh(left)
            drawn[which] = drawn[which] * np.sqrt(np.maximum(sizes, 0.0)) @ directions.T
        return drawn

    def _draw(self, hypotheses: bytes) -> tuple[FloatArray, FloatArray]:
        """Draws of the prior: forces, (D, 3n) [N], and channels with noise, shape (D, c).

        Forces are in the tiles' frames, channels in N m and N; `hypotheses` holds the bytes of the
        index of each draw's hypothesis, shape (D,).
        """
        chosen = np.frombuffer(hypotheses, np.int64)
        tiles, rng = len(self._geometry), np.random.default_rng(0)
        numbers = rng.standard_normal((len(chosen), 9 * tiles + 7))
        noise = rng.standard_normal((len(chosen), self._family.total.shape[1]))
        forces = np.empty((len(chosen), 3 * tiles))
        for number in np.unique(chosen):
            prior, which = self._priors[number], chosen == number
            forces[which] = prior.draw(numbers[which])
            noise[which] *= np.sqrt(prior.noise)
            noise[which] += forces[which] @ prior.mapping.T
        return forces, noise

    def _condition(self, pattern: bytes, surveyed: bool = False) -> _Conditioned:
        """Hypotheses, conditioned on the channels that the bytes of flags (6 + 3c,) mark.

        Those of the survey if `surveyed`, otherwise the ordinary ones.
        """
        family = self._survey.family if surveyed and self._survey else self._family
        return family.conditioned(np.flatnonzero(np.frombuffer(pattern, bool)))

    def _loads(self, values: FloatArray, belief: _Belief) -> FloatArray:
        """How many times the mean at each load of the survey is expected, (N, s) [-].

        Zero in samples without a like load, and without a survey, with s = 0.
        """
        if self._survey is None or not belief.share:
            return np.zeros((len(values), 0))
        return self._survey.loads(values)

    def _source(self, values: FloatArray, present: BoolArray, belief: _Belief) -> str:
        """Prior and measured sources in words, from channels and which are present, (N, 6 + 3c)."""
        wrench = len(WRENCH_CHANNELS)
        names = np.repeat(["wrench", *self._clusters], [wrench] + [3] * len(self._clusters))
        parts = dict.fromkeys(names[present.any(axis=0)])
        prior = "mean zero"
        if self._survey is not None:
            like = int(self._survey.loads(values).any(axis=1).sum())
            prior = f"{self._survey.name}, with {100.0 * belief.share:.0f} % probability"
            if like < len(values):
                prior += f" in {like} of {len(values)} samples, whose loads are like the survey's"
            prior += "; otherwise mean zero"
            if self._survey.doubt:
                prior += f"; {self._survey.doubt}"
        return f"prior: {prior}; measured: {', '.join(parts) or 'nothing'}"


def left_out_pressures(
    samples: Samples, geometry: SocketGeometry, force_map: ForceMap | None = None
) -> Iterator[tuple[str, FloatArray, FloatArray, FloatArray]]:
    """Measured and expected pressure of each cluster.

    Expected is what the force map of the other clusters and the wrench says.

    Args:
        samples: N samples.
        geometry: The socket, which has the clusters of the samples.
        force_map: The map of these clusters; None for one with the default prior.

    Yields:
        Name of a cluster, its measured normal pressure (NaN unless trusted), the expected one and
        its standard deviation, shape (N,) each [Pa]; pressures are positive in compression.
    """
    force_map = force_map or ForceMap(geometry, samples.clusters)
    for column, name in enumerate(samples.clusters):
        tile = geometry.clusters[name]
        measured = geometry.cluster_stress(name, samples.trusted_forces[:, column])[:, 0]
        others = force_map.estimate(samples.without(local_channels(name)))
        deviation = others.normal_pressure_standard_deviation[:, tile]
        yield name, measured, others.normal_pressure[:, tile], deviation


def _wrench_of(pattern: bytes) -> bytes:
    """A pattern of present channels, without those of clusters."""
    return pattern[: len(WRENCH_CHANNELS)] + bytes(len(pattern) - len(WRENCH_CHANNELS))


def _mixed(
    one: tuple[FloatArray, FloatArray], two: tuple[FloatArray, FloatArray], share: float
) -> tuple[FloatArray, FloatArray]:
    """Mean and variances of a mixture of two distributions, of any common shape.

    Args:
        one: Mean and variances of the first.
        two: Mean and variances of the second.
        share: Probability of the second [-].
    """
    mean = (1.0 - share) * one[0] + share * two[0]
    variances = (1.0 - share) * one[1] + share * two[1]
    return mean, variances + share * (1.0 - share) * (one[0] - two[0]) ** 2


def axes_of(geometry: SocketGeometry) -> FloatArray:
    """Components of a force in its tile's frame along x, y, z of {S} and the normal, (n, 4, 3)."""
    along_normal = np.broadcast_to([[0.0, 0.0, 1.0]], (len(geometry), 1, 3))
    return np.concatenate([geometry.rotations, along_normal], axis=1)


def _channels(samples: Samples) -> tuple[FloatArray, BoolArray]:
    """Values of all channels, shape (N, 6 + 3c) [N m, N], and which of them are present."""
    values = samples.trusted_values
    return values, np.isfinite(values)


def _by_pattern(present: BoolArray) -> Iterator[tuple[bytes, IntArray]]:
    """Each pattern of present channels with the indices of its samples."""
    changes = np.flatnonzero((present[1:] != present[:-1]).any(axis=1)) + 1
    edges = [0, *changes.tolist(), len(present)] if len(present) else []
    runs: dict[bytes, list[IntArray]] = {}
    for start, stop in pairwise(edges):
        runs.setdefault(present[start].tobytes(), []).append(np.arange(start, stop))
    return ((pattern, np.concatenate(some)) for pattern, some in runs.items())


def _rice_deviation(size: FloatArray, sigma: FloatArray) -> FloatArray:
    """Root mean square difference of a Rice-distributed magnitude from `size`, of its shape [N].

    Take a vector of two components, of standard deviation sigma each, with a mean of magnitude
    `size`. Its magnitude has the mean sigma sqrt(pi/2) L_1/2(-x), x = size^2 / (2 sigma^2), and
    the mean square size^2 + 2 sigma^2 (Rice, Bell System Technical Journal 24, 1945).
    """
    sigma = np.maximum(sigma, _TINY)
    half = 0.25 * (size / sigma) ** 2  # x / 2
    laguerre = (1.0 + 2.0 * half) * i0e(half) + 2.0 * half * i1e(half)
    mean = sigma * np.sqrt(0.5 * np.pi) * laguerre
    square = 2.0 * (size**2 + sigma**2 - size * mean)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


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


def _rigid_motions(geometry: SocketGeometry, arm: float) -> FloatArray:
    """Displacements of the tiles in their frames under six motions of the limb, (n, 3, 6) [-].

    Translations along two transverse directions and the proximal one, and rotations about these
    axes through the mean anchor, scaled to a displacement of 1 at the distance `arm` [m].
    """
    axes = np.linalg.svd(proximal_direction(geometry)[None])[2][[1, 2, 0]]
    in_socket = rigid_motions((geometry.anchors - geometry.anchors.mean(axis=0)) / arm)
    return np.swapaxes(geometry.rotations, 1, 2) @ in_socket @ np.kron(np.eye(2), axes.T)


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


_UNCERTAIN = 11  # hyperparameters that `hypotheses` spreads


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


def probabilities(log_evidence: FloatArray) -> FloatArray:
    """Probabilities of the hypotheses from their evidence, shape (M,) [-]; 0 for unlikely ones."""
    return likely_ones(np.exp(EVIDENCE_POWER * (log_evidence - log_evidence.max())))


def likely_ones(weights: FloatArray) -> FloatArray:
    """Probabilities in proportion to weights of any shape [-]; 0 for unlikely hypotheses."""
    found = np.where(weights < _MIN_WEIGHT * weights.max(), 0.0, weights)
    return np.asarray(found / found.sum())


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
