"""Gaussian hypotheses, conditioned on measured channels and averaged by their evidence.

The amplitude that all forces of a hypothesis share has an inverse-gamma prior and is integrated
out, so that the channels have a multivariate t distribution. The hypotheses are weighted by their
mean evidence to the power 0.6.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from socket_testbed.arrays import FloatArray, IntArray

AMPLITUDE_FREEDOM = 2.0  # [1]; degrees of freedom of the prior of the amplitude
EVIDENCE_POWER = 0.6  # [-]; the prior's laws are no limb's: trust the evidence less than fully
_MIN_WEIGHT = 2e-3  # of a hypothesis, relative to the likeliest
_CHUNK = 256  # samples of products
_MANY = 64  # samples, from which quadratic forms of the variances are worth making


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

    def conditioned(self, present: IntArray) -> Conditioned:
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
        return Conditioned(
            present=present,
            gain=gain,
            precision=precision,
            log_determinant=log_determinant,
            variances=variances,
            distances=self.distances,
            earlier=self.earlier,
        )


@dataclass(frozen=True)
class Conditioned:
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

    def __getitem__(self, kept: IntArray) -> Conditioned:
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


def _mirrored(means: FloatArray, errors: FloatArray, axis: int) -> FloatArray:
    """Means with errors added, followed along an axis by those with errors subtracted."""
    shape = [*means.shape]
    shape[axis] *= 2
    drawn = np.empty(shape)
    above, below = np.split(drawn, 2, axis)
    np.add(means, errors, out=above)
    np.subtract(means, errors, out=below)
    return drawn


def probabilities(log_evidence: FloatArray) -> FloatArray:
    """Probabilities of the hypotheses from their evidence, shape (M,) [-]; 0 for unlikely ones."""
    return likely_ones(np.exp(EVIDENCE_POWER * (log_evidence - log_evidence.max())))


def likely_ones(weights: FloatArray) -> FloatArray:
    """Probabilities in proportion to weights of any shape [-]; 0 for unlikely hypotheses."""
    found = np.where(weights < _MIN_WEIGHT * weights.max(), 0.0, weights)
    return np.asarray(found / found.sum())
