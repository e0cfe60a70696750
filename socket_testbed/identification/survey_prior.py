r"""What a survey taught of a limb, as the prior of its next trial.

The next trial puts the limb on once more, so that its forces are :math:`F' = F + G'`, with the
limb's forces F, as the survey's trials tell them, and what its own donning changes, of the
covariance :math:`\epsilon^2 K_g` (see `survey`). Before it measures anything, with the channels z
of all trials of the survey at one load and :math:`S_z` their covariance, the forces have

.. math:: m = C S_z^{-1} z, \qquad K' = K + \epsilon^2 K_g - C S_z^{-1} C^T, \qquad C = cov(F, z)

under each hypothesis with each epsilon, of which the survey tells the probabilities. The trial's
own channels then update forces, amplitude and probabilities as in `force_map`. The forces grow in
proportion to the load; a load unlike any of the survey's has no such prior.

The file of a survey holds z and the probabilities, from which everything else follows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from scipy.special import logsumexp

from socket_testbed import documents
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.socket import SocketGeometry, socket_from_document
from socket_testbed.identification.force_map import axes_of
from socket_testbed.identification.map_posterior import EVIDENCE_POWER, Family, likely_ones
from socket_testbed.identification.map_prior import Hypothesis, Prior
from socket_testbed.identification.survey import (
    MAX_MISMATCH,
    Donned,
    JointMap,
    Limb,
    repeated_difference,
)
from socket_testbed.samples import FORCES, MOMENTS, WRENCH_CHANNELS
from socket_testbed.settings.identification import MIN_SHARE

FORMAT = "socket_testbed survey 1"
UNITS = {
    "wrenches": "[M; F] on the socket in {S} [N m, N]",
    "forces": "on the clusters in their tiles' frames {L} [N]",
    "changes": "epsilon, what a donning changes over what the limb has [-]",
    "sizes": "normal_deviation, force_error and cluster_error [N], moment_error [N m], length and"
    " arm [m], the others [-]",
}
"""Unit and frame of each field of the file."""
MAX_SCALE = 1.5
"""Largest ratio of a load to one of the survey, either way, that counts as like [-]."""
MAX_REPEATED = 0.4
"""Difference between repeats in place from which a survey can make maps worse, over the force [-].

Measured on simulated limbs, see docs/survey.md."""
_WRENCH = len(WRENCH_CHANNELS)
_AGAIN = "survey the trials again"
_GIVE = "give a file that 'survey -o FILE.json' wrote"


@dataclass(frozen=True, eq=False)
class SurveyPrior:
    """What a survey taught of a limb.

    Attributes:
        geometry: The socket with its n tiles.
        trials: Names of the J trials.
        fingerprints: Their fingerprints.
        clusters: Names of each trial's clusters.
        donned: What each trial measured, at S loads that all share.
        changes: The grid of epsilon, shape (E,) [-].
        hypotheses: The M likely hypotheses of the force map.
        weights: Probability of each hypothesis with each epsilon, shape (M, E) [-].
    """

    geometry: SocketGeometry
    trials: tuple[str, ...]
    fingerprints: tuple[str, ...]
    clusters: tuple[tuple[str, ...], ...]
    donned: tuple[Donned, ...]
    changes: FloatArray
    hypotheses: tuple[Hypothesis, ...]
    weights: FloatArray

    @property
    def name(self) -> str:
        """The survey in words, such as `survey of a, b`."""
        return f"survey of {', '.join(self.trials)}"

    @property
    def doubt(self) -> str:
        """Why the survey may make the map of another trial worse; empty if nothing says so."""
        repeated = repeated_difference(self.donned)
        if not repeated >= MAX_REPEATED:  # also without repeats in place
            return ""
        return (
            f"its repeats in place differ by {repeated:.2f} of the force, so that it may make the"
            " map worse"
        )

    def require(self, where: str, geometry: SocketGeometry, fingerprint: str) -> None:
        """Refuse a trial of another socket, and one of the survey's own.

        Args:
            where: The trial, in words.
            geometry: Its socket.
            fingerprint: Its fingerprint.

        Raises:
            ConfigurationError: It is of another socket, or in the survey.
        """
        if not self.geometry.same_tiles(geometry):
            raise ConfigurationError(
                f"{where} is of another socket ({len(geometry)} tiles) than the {self.name}"
                f" ({len(self.geometry)} tiles)",
                "give a survey of this limb in this socket",
            )
        if fingerprint in self.fingerprints:
            own = self.trials[self.fingerprints.index(fingerprint)]
            raise ConfigurationError(
                f"{where} is in the {self.name} ({own}), which would count it twice",
                "give a trial that is not in it, or leave out --prior",
            )

    def expected(self, geometry: SocketGeometry, clusters: tuple[str, ...]) -> Expected:
        """What the survey says of another trial before it measures anything.

        Args:
            geometry: The socket of that trial, with the survey's tiles.
            clusters: Names of its clusters, in the order of the samples.
        """
        return Expected(self, geometry, clusters)

    def document(self) -> dict[str, Any]:
        """The content of the file, for JSON."""
        return {
            "units": UNITS,
            "geometry": self.geometry.to_document(),
            "trials": [
                {
                    "name": name,
                    "fingerprint": fingerprint,
                    "clusters": {
                        cluster: self.geometry.names[tile]
                        for cluster, tile in zip(names, donned.tiles, strict=True)
                    },
                    "wrenches": _or_null(donned.values[:, :_WRENCH]),
                    "forces": _or_null(donned.forces),
                }
                for name, fingerprint, names, donned in zip(
                    self.trials, self.fingerprints, self.clusters, self.donned, strict=True
                )
            ],
            "changes": self.changes.tolist(),
            "hypotheses": [
                {"weights": weights, "sizes": dataclasses.asdict(sizes)}
                for weights, sizes in zip(self.weights.tolist(), self.hypotheses, strict=True)
            ],
        }


def learnt(
    joint: JointMap,
    geometry: SocketGeometry,
    trials: Sequence[tuple[str, str, Sequence[str]]],
    donned: Sequence[Donned],
) -> SurveyPrior:
    """What the map of all trials of a survey teaches.

    Args:
        joint: The map.
        geometry: The socket.
        trials: Name, fingerprint and names of the clusters of each trial.
        donned: What each trial measured.
    """
    likely = np.flatnonzero(joint.weights.any(axis=1))
    names, fingerprints, clusters = zip(*trials, strict=True)
    return SurveyPrior(
        geometry=geometry,
        trials=names,
        fingerprints=fingerprints,
        clusters=tuple(map(tuple, clusters)),
        donned=tuple(donned),
        changes=joint.changes,
        hypotheses=tuple(joint.hypotheses[number] for number in likely),
        weights=joint.weights[likely],
    )


class Expected:
    """What a survey says of the forces and channels of another trial, by hypothesis.

    A hypothesis here is one of the T likely pairs of a hypothesis of the force map and an epsilon.

    Args:
        survey: The survey of J trials.
        geometry: The socket of the other trial, with n tiles.
        clusters: Names of its clusters, in the order of the samples.

    Attributes:
        name: The survey in words.
        doubt: Why it may make the map worse; empty if nothing says so.
        weights: Probabilities of the hypotheses, shape (T,) [-].
        family: What they say at each of the S loads.
    """

    def __init__(
        self, survey: SurveyPrior, geometry: SocketGeometry, clusters: tuple[str, ...]
    ) -> None:
        self.name, self.doubt = survey.name, survey.doubt
        self._survey, self._geometry, self._clusters = survey, geometry, clusters
        own = [geometry.clusters[name] for name in clusters]
        self._tiles = sorted({*own, *(tile for each in survey.donned for tile in each.tiles)})
        present = [np.isfinite(each.values).all(axis=0) for each in survey.donned]
        self._earlier = np.concatenate(
            [self._rows_of(each.tiles)[p] for each, p in zip(survey.donned, present, strict=True)]
        )
        self._own = self._rows_of(own)
        self._who = np.repeat(np.arange(len(present)), [each.sum() for each in present])
        self._z = np.hstack(
            [each.values[:, p] for each, p in zip(survey.donned, present, strict=True)]
        )
        self._groups, numbers = np.nonzero(survey.weights)
        self._changes = survey.changes[numbers]
        self.weights = survey.weights[self._groups, numbers]
        self.weights = self.weights / self.weights.sum()
        self._limbs = [Limb(geometry, self._tiles, sizes) for sizes in survey.hypotheses]
        self.family = self._family()

    def _rows_of(self, tiles: Sequence[int]) -> IntArray:
        """Rows of the wrench and of some tiles' forces among the channels of `Limb`."""
        places = np.searchsorted(self._tiles, tiles)
        of_tiles = _WRENCH + 3 * places[:, None] + np.arange(3)
        return np.concatenate([np.arange(_WRENCH), of_tiles.ravel()]).astype(int)

    def _precision(self, limb: Limb, change: float) -> FloatArray:
        """Inverse covariance of the survey's channels."""
        at = np.ix_(self._earlier, self._earlier)
        total = limb.signal[at] + np.diag(limb.noise[self._earlier])
        total = total + change**2 * limb.changed_signal[at] * (self._who[:, None] == self._who)
        return np.asarray(np.linalg.inv(total))

    def _family(self) -> Family:
        turned, tiles = axes_of(self._geometry), len(self._geometry)
        found: dict[str, list[FloatArray]] = {
            name: [] for name in ("total", "cross", "variances", "forces", "channels", "distances")
        }
        for group, change in zip(self._groups.tolist(), self._changes.tolist(), strict=True):
            limb, own, earlier = self._limbs[group], self._own, self._earlier
            precision = self._precision(limb, change)
            of_forces = limb.with_channels[:, earlier]  # (3n, d)
            of_channels = limb.signal[np.ix_(own, earlier)]
            gain = of_forces @ precision
            blocks = limb.blocks + change**2 * limb.changed_blocks
            known = gain.reshape(tiles, 3, -1) @ np.swapaxes(of_forces.reshape(tiles, 3, -1), 1, 2)
            cross = limb.with_channels + change**2 * limb.changed_with_channels
            cross = cross[:, own] - gain @ of_channels.T
            total = (limb.signal + change**2 * limb.changed_signal)[np.ix_(own, own)]
            total = total + np.diag(limb.noise[own]) - of_channels @ precision @ of_channels.T
            means = (self._z @ gain.T).reshape(-1, tiles, 3, 1)
            found["total"].append(total)
            found["cross"].append(turned @ cross.reshape(tiles, 3, -1))
            found["variances"].append((turned @ (blocks - known) * turned).sum(axis=2))
            found["forces"].append((turned @ means)[..., 0])
            found["channels"].append(self._z @ precision @ of_channels.T)
            found["distances"].append(((self._z @ precision) * self._z).sum(axis=1))
        return Family(
            **{name: np.array(values) for name, values in found.items()}, earlier=self._z.shape[1]
        )

    def covariance(self, number: int) -> FloatArray:
        """Covariance of the forces in the tiles' frames under a hypothesis, (3n, 3n) [N^2].

        It is for an amplitude of 1.

        Args:
            number: Index of the hypothesis, below T.
        """
        group, change = int(self._groups[number]), float(self._changes[number])
        limb = self._limbs[group]
        K = Prior(self._geometry, (), self._survey.hypotheses[group]).covariance()
        of_forces = limb.with_channels[:, self._earlier]
        known = of_forces @ self._precision(limb, change) @ of_forces.T
        return np.asarray(K + change**2 * limb.changed(K) - known)

    @cached_property
    def _loads(self) -> tuple[FloatArray, FloatArray]:
        """The S loads, with moments over the lever arm, shape (S, 6) [N], and their forces [N]."""
        values = np.array([each.values[:, :_WRENCH] for each in self._survey.donned])
        loads = self._scaled(values.mean(axis=0))  # NaN if a trial has no such channel
        return loads, np.linalg.norm(np.nan_to_num(loads[:, FORCES]), axis=1)

    def _scaled(self, wrenches: FloatArray) -> FloatArray:
        arm = self._survey.hypotheses[0].arm
        return np.hstack([wrenches[:, MOMENTS] / arm, wrenches[:, FORCES]])

    def loads(self, values: FloatArray) -> FloatArray:
        """How many times the mean at each load is expected in samples, shape (N, S) [-].

        The nearest load counts, as many times as it fits best; none in a sample without such a
        load, or without a force.

        Args:
            values: Channels of N samples, the wrench [M; F] first, shape (N, 6 + 3c) [N m, N].
        """
        loads, sizes = self._loads
        found = np.zeros((len(values), len(loads)))
        wrenches = self._scaled(values[:, :_WRENCH])
        # Only channels that all trials know count.
        known = np.isfinite(wrenches) & np.isfinite(loads).all(axis=0)
        weights = known.astype(float)
        wrenches, loads = np.where(known, wrenches, 0.0), np.nan_to_num(loads)
        squares = np.maximum(weights @ (loads**2).T, 1e-12)
        times = np.asarray(wrenches @ loads.T / squares)
        usable = (times > 1.0 / MAX_SCALE) & (times < MAX_SCALE)
        usable &= known[:, FORCES].all(axis=1, keepdims=True)
        left = (wrenches**2).sum(axis=1)[:, None] - times**2 * squares
        times = np.where(usable, times, 1.0)
        apart = np.sqrt(np.maximum(left, 0.0)) / (times * sizes)
        usable &= apart <= MAX_MISMATCH
        apart = np.where(usable, np.hypot(apart, np.log(times)), np.inf)
        nearest, rows = apart.argmin(axis=1), np.flatnonzero(np.any(usable, axis=1))
        found[rows, nearest[rows]] = times[rows, nearest[rows]]
        return found

    def weighed(self, evidence: FloatArray) -> FloatArray:
        """Probabilities of the hypotheses given another trial, shape (T,) [-].

        As in a survey of one more trial, the evidence is averaged over the trials to weigh the
        hypotheses of the force map, and counts in full for epsilon.

        Args:
            evidence: Mean log evidence of the trial's samples by hypothesis, shape (T,) [-].
        """
        trials = len(self._survey.donned)
        log_weights = np.log(self.weights)
        joint = log_weights + evidence
        found = np.full(len(joint), -np.inf)
        for group in np.unique(self._groups):
            which = self._groups == group
            before, after = logsumexp(log_weights[which]), logsumexp(joint[which])
            tempered = trials * before + EVIDENCE_POWER * (after - before)
            found[which] = joint[which] - after + tempered / (trials + 1)
        return likely_ones(np.exp(found - found.max()))


def _or_null(values: FloatArray) -> list[Any]:
    """Values as nested lists, None for NaN."""
    found = values.astype(object)
    found[~np.isfinite(values)] = None
    return list(found.tolist())


_Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Value = _Number | None
_Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class _Trial(documents.Document):
    name: documents.Text
    fingerprint: Annotated[str, Meta(min_length=1)]
    clusters: dict[str, str]
    wrenches: list[tuple[_Value, _Value, _Value, _Value, _Value, _Value]]
    forces: list[list[tuple[_Value, _Value, _Value]]]


class _Weighted(documents.Document):
    weights: list[_Share]
    sizes: dict[str, _Number]


class _Learnt(documents.Document):
    units: dict[str, str]
    geometry: dict[str, Any]
    trials: Annotated[list[_Trial], Meta(min_length=2)]
    changes: Annotated[list[Annotated[float, Meta(ge=0.0, le=10.0)]], Meta(min_length=1)]
    hypotheses: Annotated[list[_Weighted], Meta(min_length=1)]


class _File(Struct):  # ignores what the survey judged
    prior: dict[str, Any]


def read_survey(path: Path) -> SurveyPrior:
    """Read what a survey taught from its file.

    Args:
        path: A file that `survey -o FILE.json` wrote.

    Raises:
        ConfigurationError: If the file is no survey of this format, or its parts do not fit.
    """
    data = documents.load_json(path, "a survey", _GIVE)
    if not isinstance(data, dict) or "format" not in data:
        raise ConfigurationError(f"{path}: is not a survey", _GIVE)
    if data["format"] != FORMAT:
        fact = f"{path}: is of the format {documents.shown(data['format'])}"
        raise ConfigurationError(fact, _AGAIN)
    where = f"{path}: prior"
    found = documents.convert(documents.convert(data, _File, str(path)).prior, _Learnt, where)
    if found.units != UNITS:
        raise ConfigurationError(f"{where}: is in other units or frames", _AGAIN)
    geometry = socket_from_document(found.geometry, f"{where}: geometry")
    states = len(found.trials[0].wrenches)
    donned = tuple(_donned(trial, geometry, states, where) for trial in found.trials)
    names = {field.name for field in dataclasses.fields(Hypothesis)}
    for number, each in enumerate(found.hypotheses):
        at = f"{where}: hypotheses: {number}"
        if {*each.sizes} != names or len(each.weights) != len(found.changes):
            raise ConfigurationError(f"{at}: has other sizes or another number of weights", _AGAIN)
        sizes = each.sizes
        if min(sizes["length"], sizes["arm"]) <= 0.0 or sizes["share"] <= MIN_SHARE / 2:
            raise ConfigurationError(f"{at}: a length or the share is not positive", _AGAIN)
    weights = np.array([each.weights for each in found.hypotheses])
    if not weights.any():
        raise ConfigurationError(f"{where}: no hypothesis has a weight", _AGAIN)
    return SurveyPrior(
        geometry=geometry,
        trials=tuple(str(trial.name) for trial in found.trials),
        fingerprints=tuple(trial.fingerprint for trial in found.trials),
        clusters=tuple(tuple(trial.clusters) for trial in found.trials),
        donned=donned,
        changes=np.array(found.changes),
        hypotheses=tuple(Hypothesis(**each.sizes) for each in found.hypotheses),
        weights=weights,
    )


def _donned(trial: _Trial, geometry: SocketGeometry, states: int, where: str) -> Donned:
    """What a trial of the file measured, at as many states as the first one."""
    at = f"{where}: trials: {trial.name}"
    for tile in trial.clusters.values():
        if tile not in geometry.names:
            raise ConfigurationError(f"{at}: clusters: no tile '{tile}'", _AGAIN)
    tiles = tuple(geometry.names.index(tile) for tile in trial.clusters.values())
    counts = {len(each) for each in trial.forces}
    if not states or len(trial.wrenches) != states or len(trial.forces) != states:
        raise ConfigurationError(f"{at}: has another number of loads than the first", _AGAIN)
    if counts != {len(tiles)}:
        raise ConfigurationError(f"{at}: has no force for each of its clusters", _AGAIN)
    wrenches = np.array(trial.wrenches, float)
    if not np.isfinite(wrenches[:, FORCES]).all():
        raise ConfigurationError(f"{at}: a load has no force", _AGAIN)
    forces = np.array(trial.forces, float).reshape(states, -1)
    return Donned(tiles, np.hstack([wrenches, forces]))
