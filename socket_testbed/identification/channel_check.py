"""Each source alone: missing, frozen, clipped, noisy."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import compress

import numpy as np

from socket_testbed.arrays import FloatArray, gaps, usual_period
from socket_testbed.identification.data_finding import LEAST_CHECKED, STILL, DataFinding
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.samples import WRENCH_CHANNELS, Samples, Status, channel_unit

MAX_MISSING = 0.05  # [-]; share of a source's samples; sound 0
MAX_STILL = 2.0  # [s]; time without any change; sound two samples
MAX_CLIPPED = 0.05  # [-]; share of the samples at one end of a channel's range; sound 0.002
MAX_NOISE = {"N": 20.0, "N m": 3.0}  # by unit; sound 0.3 N, with the published errors 11 N
MAX_POSE_NOISE = (2e-3, 0.03)  # [m, rad]; sound 0.04 mm and 0.0008 rad
NOISIER = (8.0, 1.5)  # [-, N]; of a cluster than the others, and at least; sound 2.8, 0.3 N


def check_channels(
    samples: Samples, noise: ChannelNoise, leave_out: tuple[str, ...]
) -> Iterator[DataFinding]:
    """Sources and channels that are missing, frozen, clipped or noisy.

    Args:
        samples: The samples, N of them.
        noise: Noise of the samples without their outliers.
        leave_out: Names of channels that are not checked.
    """
    period, counts = usual_period(samples.time), samples.counted(leave_out)
    measured = np.isfinite(samples.wrench[:, counts[:6]])
    names = compress(WRENCH_CHANNELS, counts)
    lacking = [name for name, column in zip(names, measured.T, strict=False) if not column.any()]
    sources = {
        lacking[0] if len(lacking) == 1 else "the wrench": measured.all(axis=1),
        "the limb pose": samples.has_pose,
    }
    for k, name in enumerate(samples.clusters):
        if counts[6 + 3 * k : 9 + 3 * k].any():
            sources[name] = samples.status[:, k] == Status.OK
    for name, present in sources.items():
        share = float(np.mean(~present))
        if share > MAX_MISSING:
            yield DataFinding(
                name,
                f"{100.0 * share:.0f} % of its samples are missing or out of range",
                "see 'info' for the gaps, and 'doctor' for the wiring",
            )
    steps = np.diff(samples.time)
    lost = float(np.maximum(steps[gaps(samples.time)] - period, 0.0).sum())
    if lost > MAX_MISSING * samples.time[-1]:
        share = 100.0 * lost / samples.time[-1]
        fact = f"{share:.0f} % of the time has no sample"
        yield DataFinding("the trigger", fact, "see 'info' for the gaps, and the trigger's rate")
    # An averaged or extrapolated pose still varies in its last digits.
    poses = samples.pose[samples.has_pose]
    limit = still_limit(period)
    if period * max(map(_longest_run, poses.T)) > limit:
        yield DataFinding(
            "the limb pose", "it stands still", "check the cameras and the bodies' names"
        )
    yield from _noisy_pose(noise)
    yield from _noisy_clusters(samples, noise, leave_out)
    values = samples.trusted_values
    noises = noise.values.tolist()
    for name, column, own_noise in zip(samples.channels, values.T, noises, strict=True):
        known = column[np.isfinite(column)]
        if len(known) < LEAST_CHECKED or name in leave_out:
            continue
        still = period * _longest_run(known)
        at_end, end = max((np.mean(known == end), end) for end in (known.min(), known.max()))
        unit = channel_unit(name)
        if still > limit:
            fact, hint = f"it does {STILL} {still:.1f} s", "check the sensor and its driver"
        elif at_end > MAX_CLIPPED:
            fact = f"{100.0 * at_end:.0f} % of its values are at one end, {end:.3g} {unit}"
            hint = "check the sensor's range: it is clipped"
        elif own_noise > MAX_NOISE[unit]:
            fact = f"its noise is {own_noise:.3g} {unit}"
            hint = "check shields, connectors and the supply"
        else:
            continue
        yield DataFinding(name, fact, hint)


def still_limit(period: float) -> float:
    """Time for which a source may stand still [s], from the usual time between samples [s]."""
    return max(MAX_STILL, 4.0 * period)


def _noisy_pose(noise: ChannelNoise) -> Iterator[DataFinding]:
    """A pose with more noise than markers have."""
    position, rotation = np.nan_to_num(noise.pose).reshape(2, 3).max(axis=1)
    if position > MAX_POSE_NOISE[0] or rotation > MAX_POSE_NOISE[1]:
        yield DataFinding(
            "the limb pose",
            f"its noise is {1e3 * position:.2g} mm and {np.degrees(rotation):.2g} deg",
            "check the markers, the cameras' calibration, and reflections",
        )


def _noisy_clusters(
    samples: Samples, noise: ChannelNoise, leave_out: tuple[str, ...]
) -> Iterator[DataFinding]:
    """Clusters with far more noise than the others."""
    own = noise.local_forces[:, 2]
    for column, name in enumerate(samples.clusters):
        others = np.delete(own, column)
        others = others[np.isfinite(others)]
        if not len(others) or f"{name}.Fz" in leave_out:
            continue
        limit = max(NOISIER[0] * float(np.median(others)), NOISIER[1])
        if limit < own[column] <= MAX_NOISE["N"]:
            yield DataFinding(
                name,
                f"its noise is {own[column]:.2g} N, that of the others {np.median(others):.2g} N",
                "check its shield, its plug and its supply",
            )


def _longest_run(values: FloatArray) -> int:
    """Number of values in the longest run of equal ones, of a series (N,)."""
    ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True))
    return int(np.diff(np.append(-1, ends)).max())
