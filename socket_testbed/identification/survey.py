r"""One limb surveyed by several trials: the force map judged, and completed, by moved clusters.

In a survey one limb is put on several times, with its clusters on other tiles, and loaded alike.
The forces on the tiles in trial j are those of the limb, F, and what its donning changes,

.. math:: F_j = F + G_j, \qquad cov F = K, \qquad cov G_j = \epsilon^2 K_g

K is the covariance of the force map (`force_map`), under each of its hypotheses. The load is the
same in every trial, so that donning moves forces about without changing their resultant: K_g is K
conditioned on the wrench. The channels of all trials are one Gaussian vector with the covariance

.. math:: cov(y_i, y_j) = H_i (K + \delta_{ij} \epsilon^2 K_g) H_j^T + \delta_{ij} R_i

and everything follows from it as in `force_map`: the evidence of each hypothesis and of each
epsilon on a grid, the forces of each donning, and their standard deviations. Sensors have errors of
their own in each trial. A survey of one trial is the ordinary map.

The limb is none of the hypotheses exactly, so that the evidence of many channels would soon leave
one of them alone. It is therefore averaged over the trials, as it is over the states, to weigh the
hypotheses; for epsilon under each of them it counts in full.

A trial's map is judged by the forces that other trials measured elsewhere. Such a difference holds
more than the map's error: the other sensor's error and, as far as the map follows its own donning,
the change to the other one. It is also of a few tiles, as a rule far from the trial's clusters. The
expected square of each difference, V, and that of the map's error on each tile, E, are known under
the posterior. The error of the map on the whole wall is

.. math:: e^2 = c^2 \, \overline{E}, \qquad c^2 = \frac{\sum (\hat F - y)^2}{\sum V}

a ratio estimate: the measured differences set the scale, and the model only says how much harder a
tile is than another (Cochran, Sampling Techniques, 1977, section 6.3). Its interval follows from
leaving out one tile at a time (jackknife), with Student's t, and from a relative error of the
model's word about the other tiles, `MODEL_ERROR`, measured on simulated limbs (docs/survey.md).

The completed map is judged in the same way by each measured tile in turn, left out of all trials.
With P the inverse covariance of all channels and k those of the tile, its residuals are
:math:`P_{kk}^{-1} (P y)_k` and their covariance is :math:`P_{kk}^{-1}` (Rasmussen & Williams, 2006,
section 5.4.2).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.special import ndtri, stdtrit

from socket_testbed.arrays import UPPER_QUANTILE, BoolArray, FloatArray, IntArray, evenly
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.map_posterior import (
    AMPLITUDE_FREEDOM,
    likely_ones,
    probabilities,
)
from socket_testbed.identification.map_prior import Hypothesis, Prior, hypotheses
from socket_testbed.identification.validation import LEVELS, close_wrench, inverse_distance
from socket_testbed.samples import FORCES, MOMENTS, WRENCH_CHANNELS
from socket_testbed.settings.identification import ForceMapSettings

CHANGES = (0.0, 0.1, 0.2, 0.3, 0.45, 0.7)
"""Grid of epsilon, what a donning changes over what the limb has [-]."""
MAX_MISMATCH = 0.15
"""Largest difference between two like loads, relative to the force [-]."""
MAX_STATES = 12
"""States of the load that a survey uses."""
MODEL_ERROR = 0.15
"""Standard deviation of the logarithm of e for errors of the expected E over V [-]."""
_WRENCH = len(WRENCH_CHANNELS)
_RIDGE = 1e-3  # [-]; variance of the wrench that donning may change, relative to the prior's
_MAX_PLANNED = 12  # likeliest ones, for which places are compared


@dataclass(frozen=True)
class Donned:
    """What one trial of a survey measured, at S states of the load that all trials share.

    Attributes:
        tiles: Index of the tile under each of its c clusters, shape (c,).
        values: The wrench [M; F] on the socket in {S}, then three forces per cluster in its tile's
            frame {L}, shape (S, 6 + 3c) [N m, N]; a channel with a NaN is not used.
    """

    tiles: tuple[int, ...]
    values: FloatArray

    @property
    def forces(self) -> FloatArray:
        """Forces on the clusters in their tiles' frames, shape (S, c, 3) [N]."""
        return self.values[:, _WRENCH:].reshape(len(self.values), -1, 3)


@dataclass(frozen=True)
class Field:
    """Forces on all n tiles at S states, in the tiles' frames {L}.

    Attributes:
        forces: Shape (S, n, 3) [N].
        deviations: Their standard deviations, shape (S, n, 3) [N].
    """

    forces: FloatArray
    deviations: FloatArray


def match_loads(wrenches: Sequence[FloatArray], arm: float) -> tuple[IntArray, FloatArray]:
    """Samples of several trials with like loads.

    At most `MAX_STATES` are spread evenly over the first trial; each other trial contributes the
    sample with the nearest wrench. States whose load is not found in every trial are left out.

    Args:
        wrenches: Wrenches [M; F] of each of J trials, shape (N_j, 6) [N m, N], without NaN.
        arm: Lever arm that turns moments into forces [m].

    Returns:
        The rows of each trial, shape (J, S), and the largest mismatch of each state, relative to
        the force, shape (S,) [-].

    Raises:
        IdentificationError: No load is found in every trial.
    """
    scaled = [np.hstack([each[:, MOMENTS] / arm, each[:, FORCES]]) for each in wrenches]
    chosen = evenly(len(scaled[0]), MAX_STATES)
    targets = scaled[0][chosen]
    sizes = np.linalg.norm(targets[:, 3:], axis=1)
    rows, apart = [], []
    for each in scaled:
        distances = np.linalg.norm(targets[:, None] - each, axis=2)
        rows.append(distances.argmin(axis=1))
        apart.append(distances.min(axis=1) / sizes)
    mismatch = np.max(apart, axis=0)
    like = mismatch <= MAX_MISMATCH
    if not like.any():
        worst = int(np.min(apart, axis=1).argmax())
        raise IdentificationError(
            f"no load of the first trial occurs in trial {worst + 1}: the nearest differs by"
            f" {100.0 * np.min(apart[worst]):.0f} % of the force",
            "load the limb alike in each trial, or choose a part with like loads with --segment",
        )
    return np.array(rows)[:, like], mismatch[like]


@dataclass(frozen=True)
class _Term:
    """One hypothesis with one epsilon, conditioned on the channels of all trials.

    Attributes:
        number: Index of the hypothesis.
        change: Epsilon [-].
        weight: Its probability [-].
        precision: Inverse covariance of the d channels, shape (d, d).
        scale: Posterior mean of the squared amplitude at each state, shape (S,) [-].
    """

    number: int
    change: float
    weight: float
    precision: FloatArray
    scale: FloatArray


class Limb:
    """The prior of a limb's forces under one hypothesis, and of what a donning changes.

    The channels are the wrench and three per tile of some tiles.

    Args:
        geometry: The socket with its n tiles.
        tiles: Indices of t different tiles.
        sizes: The hypothesis.

    Attributes:
        with_channels: Covariances of forces and channels, shape (3n, 6 + 3t) [N^2 m, N^2].
        signal: Covariance of the channels without noise, shape (6 + 3t, 6 + 3t).
        noise: Variances of their noise, shape (6 + 3t,).
        variances: Variances of the forces, shape (3n,) [N^2].
        changed_with_channels: As `with_channels`, for K_g in place of K.
        changed_signal: As `signal`, for K_g.
        changed_variances: As `variances`, for K_g.
        blocks: Covariances of each tile's force, shape (n, 3, 3) [N^2].
        changed_blocks: As `blocks`, for K_g.
    """

    def __init__(self, geometry: SocketGeometry, tiles: Sequence[int], sizes: Hypothesis) -> None:
        names = tuple(map(str, tiles))
        instrumented = replace(geometry, clusters=dict(zip(names, tiles, strict=True)), turned={})
        prior = Prior(instrumented, names, sizes)
        self.signal, self.noise = prior.signal, prior.noise
        self.with_channels = prior.with_channels.reshape(3 * len(geometry), -1)
        self.blocks = prior.blocks
        self.variances = np.diagonal(prior.blocks, axis1=1, axis2=2).ravel()
        onto_wrench = self.with_channels[:, :_WRENCH]
        known = self.signal[:_WRENCH, :_WRENCH]
        known = known + _RIDGE * np.diag(np.diag(known))
        by_channels = np.linalg.solve(known, self.signal[:_WRENCH])
        self._by_forces = by_forces = np.linalg.solve(known, onto_wrench.T)
        self.changed_with_channels = self.with_channels - onto_wrench @ by_channels
        self.changed_signal = self.signal - self.signal[:, :_WRENCH] @ by_channels
        self.changed_variances = self.variances - (onto_wrench.T * by_forces).sum(axis=0)
        by_tile = onto_wrench.reshape(len(geometry), 3, -1)
        told = by_tile @ np.swapaxes(by_forces.T.reshape(by_tile.shape), 1, 2)
        self.changed_blocks = self.blocks - told

    def changed(self, K: FloatArray) -> FloatArray:
        """K_g from the covariance K of the forces, shape (3n, 3n) [N^2]."""
        return np.asarray(K - self.with_channels[:, :_WRENCH] @ self._by_forces)


class JointMap:
    """The forces of each donning, and those of the limb, from all trials of a survey.

    Args:
        geometry: The socket with its n tiles; its own clusters are ignored.
        trials: What each of J trials measured at S states.
        settings: Sizes and spreads of the prior; None for the default settings.
        changes: Grid of epsilon [-]; not used for a single trial.

    Attributes:
        hypotheses: The M hypotheses of the prior.
        changes: The grid of epsilon, shape (E,) [-].
        weights: Posterior probability of each hypothesis with each epsilon, shape (M, E) [-]; 0 for
            unlikely ones.
        probabilities: Posterior probability of each epsilon, shape (E,) [-].
    """

    def __init__(
        self,
        geometry: SocketGeometry,
        trials: Sequence[Donned],
        settings: ForceMapSettings | None = None,
        changes: Sequence[float] = CHANGES,
    ) -> None:
        self._geometry = geometry
        self._count = len(trials)
        self.hypotheses = (*hypotheses(settings or ForceMapSettings(), geometry.tile_share),)
        self._tiles = sorted({tile for trial in trials for tile in trial.tiles})
        self._limbs = [Limb(geometry, self._tiles, sizes) for sizes in self.hypotheses]
        rows, values, who = [], [], []
        for number, trial in enumerate(trials):
            present = np.isfinite(trial.values).all(axis=0)
            rows.append(self._rows_of(trial.tiles)[present])
            values.append(trial.values[:, present])
            who.append(np.full(int(present.sum()), number))
        self._rows, self._who = np.concatenate(rows), np.concatenate(who)
        self._values = np.hstack(values)
        self.changes = np.array(changes if len(trials) > 1 else (0.0,))
        self._terms = self._condition()
        self.weights = np.zeros((len(self.hypotheses), len(self.changes)))
        for term in self._terms:
            self.weights[term.number, self.changes == term.change] = term.weight
        self.probabilities = self.weights.sum(axis=0)

    def changed_square(self, unit: bool = False) -> float:
        """Mean square of what a donning changes, over tiles, axes and states [N^2].

        Args:
            unit: Whether epsilon is 1 instead of the estimated one.
        """
        return sum(
            term.weight
            * float(term.scale.mean())
            * (1.0 if unit else term.change**2)
            * float(self._limbs[term.number].changed_variances.mean())
            for term in self._terms
        )

    @property
    def change(self) -> float:
        """What a donning changes over the limb's forces, both RMS over all tiles [-]."""
        return float(np.sqrt(self.changed_square() / np.mean(self.field().forces ** 2)))

    def _rows_of(self, tiles: Sequence[int]) -> IntArray:
        """Rows of the wrench and of the tiles' forces among the channels of `Limb`."""
        places = np.searchsorted(self._tiles, tiles)
        of_tiles = _WRENCH + 3 * places[:, None] + np.arange(3)
        return np.concatenate([np.arange(_WRENCH), of_tiles.ravel()]).astype(int)

    def _condition(self) -> list[_Term]:
        measured, same = self._values, self._who[:, None] == self._who
        channels, freedom = measured.shape[1], AMPLITUDE_FREEDOM
        at = np.ix_(self._rows, self._rows)
        found, evidence = [], []
        for (number, limb), change in product(enumerate(self._limbs), self.changes):
            total = limb.signal[at] + change**2 * limb.changed_signal[at] * same
            total += np.diag(limb.noise[self._rows])
            precision = np.linalg.inv(total)
            distance = ((measured @ precision) * measured).sum(axis=1)
            misfit = (freedom + channels) * np.log1p(distance / freedom)
            evidence.append(-0.5 * float((np.linalg.slogdet(total)[1] + misfit).mean()))
            scale = (freedom + distance) / max(freedom + channels - 2.0, 1.0)
            found.append(_Term(number, float(change), 1.0, precision, scale))
        weights = _weights(np.reshape(evidence, (-1, len(self.changes))), self._count)
        return [
            replace(term, weight=weight)
            for term, weight in zip(found, weights.ravel().tolist(), strict=True)
            if weight > 0.0
        ]

    def _with_channels(self, term: _Term, trial: int | None) -> FloatArray:
        """Covariances of a donning's forces, or the limb's, with all channels, (3n, d)."""
        limb = self._limbs[term.number]
        found = limb.with_channels[:, self._rows]
        if trial is None:
            return np.asarray(found)
        own = term.change**2 * (self._who == trial)
        return np.asarray(found + own * limb.changed_with_channels[:, self._rows])

    def field(self, trial: int | None = None) -> Field:
        """The forces in one donning, or those of the limb that all donnings share.

        Args:
            trial: Index of the trial; None for the limb.
        """
        states, tiles = len(self._values), len(self._geometry)
        mean, square, variance = np.zeros((3, states, 3 * tiles))
        for term in self._terms:
            limb = self._limbs[term.number]
            own = 0.0 if trial is None else term.change**2
            cross = self._with_channels(term, trial)
            gain = cross @ term.precision
            forces = self._values @ gain.T
            before = limb.variances + own * limb.changed_variances
            left = np.maximum(before - (gain * cross).sum(axis=1), 0.0)
            mean += term.weight * forces
            square += term.weight * forces**2
            variance += term.weight * term.scale[:, None] * left
        total = variance + np.maximum(square - mean**2, 0.0)
        shape = (states, tiles, 3)
        return Field(mean.reshape(shape), np.sqrt(total).reshape(shape))

    def followed(self, trial: int) -> FloatArray:
        """How far a trial's map follows what its donning changes, for an epsilon of 1.

        It is the covariance of the estimate with the change G_j, shape (S, n, 3) [N^2]: 0 far from
        the clusters, the variance of G_j on them.
        """
        found = np.zeros((len(self._values), 3 * len(self._geometry)))
        for term in self._terms:
            changed = self._limbs[term.number].changed_with_channels[:, self._rows]
            gain = self._with_channels(term, trial) @ term.precision
            covariance = (gain * changed * (self._who == trial)).sum(axis=1)
            found += term.weight * term.scale[:, None] * covariance
        return found.reshape(len(self._values), -1, 3)

    def left_out(self) -> FloatArray:
        """How well each measured tile is predicted from all others, in every trial.

        Returns:
            For each of the t tiles of the survey the squared differences between its measured
            forces and the map without them, and their expected squares, both summed over states,
            trials and axes, shape (t, 2) [N^2].
        """
        sums = []
        for tile in self._tiles:
            own = np.flatnonzero(np.isin(self._rows, self._rows_of([tile])[_WRENCH:]))
            if not len(own):
                continue
            mean, square, variance = np.zeros((3, len(self._values), len(own)))
            for term in self._terms:
                covariance = np.linalg.inv(term.precision[np.ix_(own, own)])
                residuals = self._values @ term.precision[:, own] @ covariance
                mean += term.weight * residuals
                square += term.weight * residuals**2
                variance += term.weight * term.scale[:, None] * np.diag(covariance)
            expected = variance + np.maximum(square - mean**2, 0.0)
            sums.append([(mean**2).sum(), expected.sum()])
        return np.array(sums)

    def sensor_variances(self, tile: int) -> FloatArray:
        """Error variances of a cluster on one of the survey's tiles, shape (3,) [N^2]."""
        rows = self._rows_of([tile])[_WRENCH:]
        return np.sum(
            [
                term.weight * term.scale.mean() * self._limbs[term.number].noise[rows]
                for term in self._terms
            ],
            axis=0,
        )

    def place_next(self, count: int, allowed: BoolArray) -> tuple[IntArray, float]:
        """Where the clusters of another trial tell most about the limb.

        Each is placed where it lowers the expected squared error of the limb's forces most, given
        all trials, the wrench of the next one and the clusters placed before it. What the next
        donning changes counts as an error.

        Args:
            count: Number of clusters.
            allowed: Which tiles may take one, shape (n,); at least `count`.

        Returns:
            Indices of the tiles in the order of their choice, shape (count,), and the expected
            error of the limb's forces after that trial over the one before it [-].
        """
        everywhere = range(len(self._geometry))
        # For each term the covariance of the limb's forces, of the channels of the next trial, and
        # of the two; the channels are the wrench and three per tile.
        states = []
        before = 0.0
        likeliest = sorted(self._terms, key=lambda term: -term.weight)[:_MAX_PLANNED]
        for term in likeliest:
            limb = Limb(self._geometry, everywhere, self.hypotheses[term.number])
            known = self._with_channels(term, None)
            of_tiles = (3 * np.array(self._tiles)[:, None] + np.arange(3)).ravel()
            seen = np.concatenate([np.arange(_WRENCH), _WRENCH + of_tiles])[self._rows]
            cross = limb.signal[:, seen]
            gain = known @ term.precision
            onto = limb.with_channels - gain @ cross.T
            channels = limb.signal + term.change**2 * limb.changed_signal + np.diag(limb.noise)
            channels -= cross @ term.precision @ cross.T
            share = term.weight * float(term.scale.mean())
            before += share * float((limb.variances - (gain * known).sum(axis=1)).sum())
            states.append((share, onto, channels))
        gained = 0.0
        chosen: list[int] = []
        rows = np.arange(_WRENCH)
        for step in range(count + 1):
            if step:
                gains = np.sum([share * _gains(*each) for share, *each in states], axis=0)
                free = np.setdiff1d(np.flatnonzero(allowed), chosen)
                chosen.append(int(free[gains[free].argmax()]))
                rows = _WRENCH + 3 * chosen[-1] + np.arange(3)
            after = []
            for share, onto, channels in states:
                told = np.linalg.solve(channels[np.ix_(rows, rows)], onto[:, rows].T)
                gained += share * float((onto[:, rows].T * told).sum())
                by_rows = np.linalg.solve(channels[np.ix_(rows, rows)], channels[rows])
                left = channels - channels[:, rows] @ by_rows
                # What is measured varies no more.
                left[rows, rows] += np.diag(channels)[rows]
                after.append((share, onto - told.T @ channels[rows], left))
            states = after
        return np.array(chosen, dtype=int), float(np.sqrt(max(before - gained, 0.0) / before))


def _weights(evidence: FloatArray, trials: int) -> FloatArray:
    """Probabilities of hypotheses and epsilons, shape (M, E) [-]; 0 for unlikely ones.

    Args:
        evidence: Log evidence of each hypothesis with each epsilon, shape (M, E) [-].
        trials: Number of trials.
    """
    highest = evidence.max(axis=1, keepdims=True)
    of_change = np.exp(evidence - highest)
    total = of_change.sum(axis=1, keepdims=True)
    of_hypothesis = probabilities((highest + np.log(total)).ravel() / trials)
    return likely_ones(of_hypothesis[:, None] * of_change / total)


def _gains(onto: FloatArray, channels: FloatArray) -> FloatArray:
    """Decrease of the summed variances of the forces for a cluster on each tile, shape (n,) [N^2].

    Args:
        onto: Covariances of the forces with the channels, shape (3n, 6 + 3n).
        channels: Covariance of the channels, shape (6 + 3n, 6 + 3n).
    """
    tiles = np.arange(len(onto) // 3)
    by_tile = onto[:, _WRENCH:].reshape(len(onto), -1, 3)
    squares = np.einsum("jia,jib->iab", by_tile, by_tile)
    own = channels[_WRENCH:, _WRENCH:].reshape(len(tiles), 3, len(tiles), 3)[tiles, :, tiles]
    return np.asarray(np.linalg.solve(own, squares).trace(axis1=1, axis2=2))


@dataclass(frozen=True)
class JudgedPoint:
    """What a cluster of another trial measured, and what a trial's map says there.

    Attributes:
        trial: Index of the trial whose map is judged.
        other: Index of the trial that measured.
        cluster: Index of the other trial's cluster.
        tile: Index of the tile.
        distance: Distance to the nearest cluster of the judged trial [m].
        measured: Measured forces in the tile's frame, shape (S, 3) [N].
        estimated: Forces of the map, shape (S, 3) [N].
        deviations: Standard deviations of the difference that map and sensor explain, shape (S, 3)
            [N].
        rival: Forces interpolated by inverse distance with the wrench matched, shape (S, 3) [N].
        expected: Expected square of the difference, summed over states and axes, with what the two
            donnings change [N^2].
        mapped: The part of it that is the map's own error [N^2].
    """

    trial: int
    other: int
    cluster: int
    tile: int
    distance: float
    measured: FloatArray
    estimated: FloatArray
    deviations: FloatArray
    rival: FloatArray
    expected: float
    mapped: float

    @property
    def squared(self) -> float:
        """Square of the difference, summed over states and axes [N^2]."""
        return float(((self.estimated - self.measured) ** 2).sum())


@dataclass(frozen=True)
class Score:
    """How well maps predict what other trials measured.

    Attributes:
        values: Number of measured values, three per cluster and judged map.
        error: RMS of the differences over that of the measured forces [-].
        rival: That of the rival [-].
        bias: Mean estimated minus mean measured compression, over the mean magnitude of the
            measured ones; positive where maps press too hard [-].
        coverage: Share of the measured values within the intervals of each of `LEVELS`, shape (3,)
            [-].
    """

    values: int
    error: float
    rival: float
    bias: float
    coverage: tuple[float, ...]


def score(points: Sequence[JudgedPoint]) -> Score:
    """The score of one or more judged points."""
    measured = np.stack([point.measured for point in points])
    estimated = np.stack([point.estimated for point in points])
    deviations = np.stack([point.deviations for point in points])
    rival = np.stack([point.rival for point in points])
    size = float((measured**2).sum())
    scaled = np.abs((estimated - measured) / deviations)
    pressed = -measured[..., 2]
    return Score(
        values=3 * len(points),
        error=float(np.sqrt(((estimated - measured) ** 2).sum() / size)),
        rival=float(np.sqrt(((rival - measured) ** 2).sum() / size)),
        bias=float((-estimated[..., 2] - pressed).mean() / np.abs(pressed).mean()),
        coverage=tuple(
            float(np.mean(scaled <= limit)) for limit in ndtri(0.5 + 0.5 * np.array(LEVELS))
        ),
    )


@dataclass(frozen=True)
class Interval:
    """A positive value with its 95 % interval, whose ends are NaN if unknown.

    Attributes:
        value: The value.
        low: Lower end.
        high: Upper end.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Judgements:
    """The maps of single trials, judged by what the other trials measured elsewhere.

    Attributes:
        points: The judged points, map by map.
        error: Error of a trial's map on the tiles without one of its clusters, over the RMS of the
            forces there [-].
        completed: Error of a trial's completed map on the tiles that no trial measured, over the
            RMS of the forces there [-]; judged by left-out tiles.
        explained: Share of the judged square that donning and sensors explain: the square of
            `repeated` over that of the judged error, or what the joint map expects [-].
        repeated: RMS difference between two donnings of what clusters left in place measure, over
            the RMS of the forces [-]; NaN if none was left in place.
        repeats: Number of pairs of measurements behind `repeated`.
    """

    points: tuple[JudgedPoint, ...]
    error: Interval
    completed: Interval
    explained: Interval
    repeated: float
    repeats: int


def judge(
    geometry: SocketGeometry,
    trials: Sequence[Donned],
    joint: JointMap,
    singles: Sequence[JointMap],
) -> Judgements:
    """Judge the map of each trial by the forces that the other trials measured elsewhere.

    Args:
        geometry: The socket with its n tiles.
        trials: What each of J trials measured at S states.
        joint: The map of all trials.
        singles: The map of each trial alone.

    Raises:
        IdentificationError: No trial measured where another one did not.
    """
    fields = [each.field(0) for each in singles]
    completed = [joint.field(number) for number in range(len(trials))]
    points = tuple(_points(geometry, trials, joint, singles, fields))
    if not points:
        raise IdentificationError(
            "all trials have their clusters on the same tiles: nothing judges the maps between"
            " them",
            "move the clusters between trials, and state each trial's places with --geometry",
        )
    by_tile = _sums(points)
    ratio = _ratio(by_tile[:, 0], by_tile[:, 1])
    own, of_own = np.zeros(2), np.zeros(2)
    measured_anywhere = {tile for trial in trials for tile in trial.tiles}
    for trial, field, full in zip(trials, fields, completed, strict=True):
        bare = _bare(geometry, trial.tiles)
        own += (field.deviations[:, bare] ** 2).sum(), (full.forces[:, bare] ** 2).sum()
        bare = _bare(geometry, measured_anywhere)
        of_own += (full.deviations[:, bare] ** 2).sum(), (full.forces[:, bare] ** 2).sum()
    return Judgements(
        points=points,
        error=_root(ratio, own[0] / own[1]),
        completed=_root(
            _ratio(*joint.left_out().T), of_own[0] / of_own[1] if of_own[1] else np.nan
        ),
        explained=_explained(trials, points, by_tile),
        repeated=repeated_difference(trials),
        repeats=repeats_by_tile(trials)[1],
    )


def _bare(geometry: SocketGeometry, tiles: Iterable[int]) -> IntArray:
    return np.setdiff1d(np.arange(len(geometry)), [*tiles])


def _points(
    geometry: SocketGeometry,
    trials: Sequence[Donned],
    joint: JointMap,
    singles: Sequence[JointMap],
    fields: Sequence[Field],
) -> Iterable[JudgedPoint]:
    changed = joint.changed_square()
    followed = [
        2.0 * changed / each.changed_square(unit=True) * each.followed(0) for each in singles
    ]
    rivals = [_rival(geometry, trial) for trial in trials]
    for mine, others in permutations(range(len(trials)), 2):
        field, other = fields[mine], trials[others]
        for cluster, tile in enumerate(other.tiles):
            measured = other.forces[:, cluster]
            if tile in trials[mine].tiles or not np.isfinite(measured).all():
                continue
            apart = geometry.anchors[[*trials[mine].tiles]] - geometry.anchors[tile]
            sensor = joint.sensor_variances(tile)
            error = field.deviations[:, tile] ** 2
            yield JudgedPoint(
                trial=mine,
                other=others,
                cluster=cluster,
                tile=tile,
                distance=float(np.linalg.norm(apart, axis=1).min()),
                measured=measured,
                estimated=field.forces[:, tile],
                deviations=np.sqrt(error + sensor),
                rival=rivals[mine][:, tile],
                expected=float((error + sensor + followed[mine][:, tile]).sum()),
                mapped=float(error.sum()),
            )


def _rival(geometry: SocketGeometry, trial: Donned) -> FloatArray:
    """Inverse distance with the wrench matched, in the tiles' frames, shape (S, n, 3) [N]."""
    names = tuple(map(str, range(len(trial.tiles))))
    placed = replace(geometry, clusters=dict(zip(names, trial.tiles, strict=True)), turned={})
    forces = inverse_distance(placed, names, trial.forces)
    closed = close_wrench(placed, forces, trial.values[:, :_WRENCH], trial.tiles)
    return np.einsum("nij,kni->knj", geometry.rotations, closed)


def _sums(points: Sequence[JudgedPoint]) -> FloatArray:
    """Squared differences, expected ones, and squared forces, by tile, shape (t, 3) [N^2]."""
    tiles = sorted({point.tile for point in points})
    sums = np.zeros((len(tiles), 3))
    for point in points:
        row = tiles.index(point.tile)
        sums[row] += point.squared, point.expected, float((point.measured**2).sum())
    return sums


def _ratio(tops: FloatArray, bottoms: FloatArray) -> tuple[float, float, int]:
    """A ratio of sums, the jackknife's standard error of its logarithm, and degrees of freedom.

    Args:
        tops: Parts of the numerator, one per tile, shape (t,).
        bottoms: Parts of the denominator, shape (t,).
    """
    count, found = len(tops), float(tops.sum() / bottoms.sum())
    if count < 2 or found <= 0.0:
        return found, float("nan"), 0
    without = np.log(tops.sum() - tops) - np.log(bottoms.sum() - bottoms)
    error = np.sqrt((count - 1.0) * without.var())
    return found, float(error), count - 1


def _interval(value: float, error: float, freedom: int) -> Interval:
    """A value whose logarithm has a standard error and Student's t distribution."""
    if freedom < 1:
        return Interval(value, float("nan"), float("nan"))
    reach = float(np.exp(min(error * stdtrit(freedom, UPPER_QUANTILE), 50.0)))
    return Interval(value, value / reach, value * reach)


def _root(ratio: tuple[float, float, int], square: float) -> Interval:
    """Root of a ratio times a square that the model knows: half the error of the logarithm."""
    found, error, freedom = ratio
    total = float(np.hypot(0.5 * error, MODEL_ERROR))
    return _interval(float(np.sqrt(found * square)), total, freedom)


def repeats_by_tile(trials: Sequence[Donned]) -> tuple[FloatArray, int]:
    """Differences between donnings of what clusters left in place measure.

    Args:
        trials: What each of J trials measured at S states.

    Returns:
        Squared differences, and the mean squares of the two forces, summed over states and pairs,
        by tile on which two trials measured, shape (t, 2) [N^2]; and the number of pairs.
    """
    squares: dict[int, list[tuple[float, float]]] = {}
    for one, two in combinations(trials, 2):
        for tile in sorted({*one.tiles} & {*two.tiles}):
            a, b = (trial.forces[:, trial.tiles.index(tile)] for trial in (one, two))
            if np.isfinite(a - b).all():
                pair = float(((a - b) ** 2).sum()), float(0.5 * (a**2 + b**2).sum())
                squares.setdefault(tile, []).append(pair)
    sums = [np.sum(each, axis=0) for each in squares.values()]
    return np.reshape(sums, (-1, 2)), sum(map(len, squares.values()))


def repeated_difference(trials: Sequence[Donned]) -> float:
    """RMS difference between two donnings of clusters left in place, over the RMS of the forces.

    NaN if no cluster was left in place [-].

    Args:
        trials: What each of J trials measured at S states.
    """
    by_tile, count = repeats_by_tile(trials)
    different, forces = by_tile.sum(axis=0)
    return float(np.sqrt(different / forces)) if count else float("nan")


def _explained(
    trials: Sequence[Donned], points: Sequence[JudgedPoint], by_tile: FloatArray
) -> Interval:
    """Share of the judged square that repeats explain; without repeats, that of the joint map."""
    repeats, count = repeats_by_tile(trials)
    if not count:
        expected = np.array([[point.expected, point.mapped] for point in points]).sum(axis=0)
        share = float(1.0 - expected[1] / expected[0])
        return Interval(share, float("nan"), float("nan"))
    repeated, repeated_error, freedom = _ratio(repeats[:, 0], repeats[:, 1])
    judged, judged_error, others = _ratio(by_tile[:, 0], by_tile[:, 2])
    found = _interval(
        repeated / judged, float(np.hypot(repeated_error, judged_error)), min(freedom, others)
    )
    return Interval(*(min(each, 1.0) for each in (found.value, found.low, found.high)))
