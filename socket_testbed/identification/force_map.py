r"""The force on every tile of the socket from one sample's clusters and wrench, with uncertainty.

The tiles' forces have a Gaussian prior, see `map_prior`, and are conditioned on the channels of one
sample; nothing is fitted beforehand. H maps the forces F to the channels y: the wrench [M; F],
partly carried by the surface between the tiles, and each cluster's force in its frame. With the
prior's covariance K and the noise R of the channels

.. math:: F = K H^T (H K H^T + R)^{-1} y

(Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section 2.2). The prior's
hyperparameters are uncertain: M hypotheses of them are weighted by their mean evidence over the
trial, or live over recent samples, see `map_posterior`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy.special import chdtri, expit, i0e, i1e, logsumexp

from socket_testbed.arrays import NORMAL_QUANTILE, BoolArray, FloatArray, IntArray, evenly
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.map_posterior import (
    AMPLITUDE_FREEDOM,
    Conditioned,
    Family,
    JointDraws,
    probabilities,
)
from socket_testbed.identification.map_prior import Prior, hypotheses
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, local_channels
from socket_testbed.settings.identification import ForceMapSettings

if TYPE_CHECKING:
    import pandas as pd

_EVIDENCE_MEMORY = 1000  # live samples over which the evidence is averaged
_MAX_SAMPLES = 500  # samples of a trial, evenly spread
_BLOCK = 1024  # samples of a mean
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

    def _condition(self, pattern: bytes, surveyed: bool = False) -> Conditioned:
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
