"""Each source alone: missing, frozen, clipped, noisy.

Every rule is a function: of all sources (`_RULES`), or of single channels (`_RULES_OF_A_CHANNEL`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, compress

import numpy as np

from socket_testbed.arrays import FloatArray, gaps, usual_period
from socket_testbed.identification.data_finding import LEAST_CHECKED, DataFinding
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.samples import WRENCH_CHANNELS, Samples, Status, channel_unit

MAX_MISSING = 0.05  # [-]; share of a source's samples; sound 0
MAX_STILL = 2.0  # [s]; time without any change; sound two samples
MAX_CLIPPED = 0.05  # [-]; share of the samples at one end of a channel's range; sound 0.002
MAX_NOISE = {"N": 20.0, "N m": 3.0}  # by unit; sound 0.3 N, with the published errors 11 N
MAX_POSE_NOISE = (2e-3, 0.03)  # [m, rad]; sound 0.04 mm and 0.0008 rad
NOISIER = (8.0, 1.5)  # [-, N]; of a cluster than the others, and at least; sound 2.8, 0.3 N


@dataclass(frozen=True)
class _Sources:
    """The sources of N samples, in which rules find defects.

    Attributes:
        samples: The samples.
        noise: Noise of the samples without their outliers.
        leave_out: Names of channels that are not checked.
    """

    samples: Samples
    noise: ChannelNoise
    leave_out: tuple[str, ...]

    @cached_property
    def period(self) -> float:
        """Usual time between samples [s]."""
        return usual_period(self.samples.time)

    @property
    def channels(self) -> Iterator[_Channel]:
        """The channels that are checked, of those with enough values."""
        values, noises = self.samples.trusted_values.T, self.noise.values.tolist()
        for name, column, noise in zip(self.samples.channels, values, noises, strict=True):
            known = column[np.isfinite(column)]
            if len(known) >= LEAST_CHECKED and name not in self.leave_out:
                yield _Channel(name, known, noise, self.period)


@dataclass(frozen=True)
class _Channel:
    """One channel, in which rules find defects.

    Attributes:
        name: Its name, such as `Mx` or `distal.Fz`.
        known: Its K values that are not missing, shape (K,) [N m or N].
        noise: Its noise [N m or N]; NaN if it is unknown.
        period: Usual time between samples [s].
    """

    name: str
    known: FloatArray
    noise: float
    period: float

    @property
    def unit(self) -> str:
        """Its unit: `N m` or `N`."""
        return channel_unit(self.name)


def _missing_sources(sources: _Sources) -> Iterator[DataFinding]:
    """Sources without a value, or out of range, in more than `MAX_MISSING` of the samples.

    A wrench of which a single channel never has a value goes by that channel's name.
    """
    samples, counts = sources.samples, sources.samples.counted(sources.leave_out)
    measured = np.isfinite(samples.wrench[:, counts[:6]])
    names = compress(WRENCH_CHANNELS, counts)
    lacking = [name for name, column in zip(names, measured.T, strict=False) if not column.any()]
    present = {
        lacking[0] if len(lacking) == 1 else "the wrench": measured.all(axis=1),
        "the limb pose": samples.has_pose,
    }
    for k, name in enumerate(samples.clusters):
        if counts[6 + 3 * k : 9 + 3 * k].any():
            present[name] = samples.status[:, k] == Status.OK
    for name, rows in present.items():
        share = float(np.mean(~rows))
        if share > MAX_MISSING:
            yield DataFinding(
                name,
                f"{100.0 * share:.0f} % of its samples are missing or out of range",
                "see 'info' for the gaps, and 'doctor' for the wiring",
            )


def _missing_time(sources: _Sources) -> Iterator[DataFinding]:
    """Gaps between the samples that take more than `MAX_MISSING` of the trial's time."""
    time = sources.samples.time
    lost = float(np.maximum(np.diff(time)[gaps(time)] - sources.period, 0.0).sum())
    if lost > MAX_MISSING * time[-1]:
        share = 100.0 * lost / time[-1]
        fact = f"{share:.0f} % of the time has no sample"
        yield DataFinding("the trigger", fact, "see 'info' for the gaps, and the trigger's rate")


def _still_pose(sources: _Sources) -> Iterator[DataFinding]:
    """A pose of which a component stands still for longer than the `still_limit`.

    An averaged or extrapolated pose still varies in its last digits.
    """
    poses = sources.samples.pose[sources.samples.has_pose]
    if sources.period * max(map(_longest_run, poses.T)) > still_limit(sources.period):
        yield DataFinding(
            "the limb pose", "it stands still", "check the cameras and the bodies' names"
        )


def _noisy_pose(sources: _Sources) -> Iterator[DataFinding]:
    """A pose with more noise than markers have: above `MAX_POSE_NOISE`."""
    position, rotation = np.nan_to_num(sources.noise.pose).reshape(2, 3).max(axis=1)
    if position > MAX_POSE_NOISE[0] or rotation > MAX_POSE_NOISE[1]:
        yield DataFinding(
            "the limb pose",
            f"its noise is {1e3 * position:.2g} mm and {np.degrees(rotation):.2g} deg",
            "check the markers, the cameras' calibration, and reflections",
        )


def _noisier_clusters(sources: _Sources) -> Iterator[DataFinding]:
    """Clusters with far more noise in their normal force than the others' median: `NOISIER`.

    Noise above `MAX_NOISE` is found channel by channel.
    """
    own = sources.noise.local_forces[:, 2]
    for column, name in enumerate(sources.samples.clusters):
        others = np.delete(own, column)
        others = others[np.isfinite(others)]
        if not len(others) or f"{name}.Fz" in sources.leave_out:
            continue
        limit = max(NOISIER[0] * float(np.median(others)), NOISIER[1])
        if limit < own[column] <= MAX_NOISE["N"]:
            yield DataFinding(
                name,
                f"its noise is {own[column]:.2g} N, that of the others {np.median(others):.2g} N",
                "check its shield, its plug and its supply",
            )


def _still_channel(channel: _Channel) -> DataFinding | None:
    """A channel that keeps one value for longer than the `still_limit`."""
    still = channel.period * _longest_run(channel.known)
    if still <= still_limit(channel.period):
        return None
    fact = f"it does not change for {still:.1f} s"
    return DataFinding(channel.name, fact, "check the sensor and its driver", "still")


def _clipped_channel(channel: _Channel) -> DataFinding | None:
    """A channel with more than `MAX_CLIPPED` of its values at its largest or smallest one."""
    known = channel.known
    at_end, end = max((np.mean(known == end), end) for end in (known.min(), known.max()))
    if at_end <= MAX_CLIPPED:
        return None
    fact = f"{100.0 * at_end:.0f} % of its values are at one end, {end:.3g} {channel.unit}"
    return DataFinding(channel.name, fact, "check the sensor's range: it is clipped")


def _noisy_channel(channel: _Channel) -> DataFinding | None:
    """A channel with more noise than `MAX_NOISE` of its unit."""
    if not channel.noise > MAX_NOISE[channel.unit]:  # it may be unknown
        return None
    fact = f"its noise is {channel.noise:.3g} {channel.unit}"
    return DataFinding(channel.name, fact, "check shields, connectors and the supply")


_RULES = (_missing_sources, _missing_time, _still_pose, _noisy_pose, _noisier_clusters)
# What the first of them finds in a channel explains what the others would find.
_RULES_OF_A_CHANNEL = (_still_channel, _clipped_channel, _noisy_channel)


def check_channels(
    samples: Samples, noise: ChannelNoise, leave_out: tuple[str, ...]
) -> Iterator[DataFinding]:
    """Sources and channels that are missing, frozen, clipped or noisy.

    Args:
        samples: The samples, N of them.
        noise: Noise of the samples without their outliers.
        leave_out: Names of channels that are not checked.
    """
    sources = _Sources(samples, noise, leave_out)
    yield from chain.from_iterable(rule(sources) for rule in _RULES)
    for channel in sources.channels:
        for rule in _RULES_OF_A_CHANNEL:
            if finding := rule(channel):
                yield finding
                break


def still_limit(period: float) -> float:
    """Time for which a source may stand still [s], from the usual time between samples [s]."""
    return max(MAX_STILL, 4.0 * period)


def _longest_run(values: FloatArray) -> int:
    """Number of values in the longest run of equal ones, of a series (N,)."""
    ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True))
    return int(np.diff(np.append(-1, ends)).max())
