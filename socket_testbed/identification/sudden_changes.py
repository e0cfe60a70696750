"""Single values and steps that no other source feels, poses that jump."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, finite_quantile, gaps
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.samples import GROUPS, LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, channel_unit

_USUAL_DEPARTURE = 0.97  # quantile of a channel's departures that are usual
MIN_SPIKE = 8.0  # [-]; of a single value from both neighbours, over the usual ones and the noise
FELT_SPIKE = 4.0  # [-]; of another source at the same sample, which then felt it as well
SPIKE_SHARE = 0.05  # [-]; of a wrench's spike in the usual size of its group; sound 0.026
POSE_SPIKES = (3e-4, 5e-3)  # [m, rad]; sound 0.05 mm and nothing
LEAST_SPIKES = 2
CLEAR_SPIKE = 2.5  # [-]; of a spike over these limits, if there is only one; sound ratio 15
MIN_STEP_RATIO = 8.0  # [-]; of a step over the usual ones and the noise; sound, if so large, 6.6
STEP_SHARE = 0.1  # [-]; of a wrench's step in the usual size of its group
POSE_STEPS = (1.5e-3, 0.01)  # [m, rad]; sound 0.3 mm
MIN_STEP = 2.0  # [N]; of the force on a cluster
_STEP_ALONE = 0.5  # [-]; of the steps before and after, in that between them
_KINK_NOISE = np.sqrt(5.0)  # [-]; root sum of squares of the weights of `_kinks`
POSE_JUMPS = (0.02, 0.15)  # [m, rad]; from one sample to the next


def find_spikes(samples: Samples, noise: ChannelNoise) -> Iterator[DataFinding]:
    """Single values within the range that leave the course of their channel and come back.

    Args:
        samples: The samples, without outliers and left-out channels, with rotations since the mean
            attitude.
        noise: Noise of the samples.
    """
    for name, sizes, ratios in _changes(samples, noise, _departures, MIN_SPIKE):
        least = _least_change(samples, name, SPIKE_SHARE, POSE_SPIKES, 0.0)
        single = (ratios > MIN_SPIKE) & (sizes > least)
        clear = (ratios > CLEAR_SPIKE * MIN_SPIKE) & (sizes > CLEAR_SPIKE * least)
        rows = np.flatnonzero(single.any(axis=1))
        if len(rows) < LEAST_SPIKES and not clear.any():
            continue
        row, column = np.unravel_index((single * ratios).argmax(), ratios.shape)
        size = _in_words(name, int(column), float(sizes[row, column]))
        number = "a single value jumps and comes back,"
        if len(rows) > 1:
            number = f"{len(rows)} single values jump and come back, such as"
        yield DataFinding(
            name,
            f"{number} {size} at {samples.time[row]:.2f} s, which no other source feels",
            "check cables, connectors and shields, or the markers",
        )


def find_steps(samples: Samples, noise: ChannelNoise) -> Iterator[DataFinding]:
    """Channels that step from one sample to the next and stay there, while no other source moves.

    Poses that jump far are found without a comparison, see `find_jumps`.

    Args:
        samples: The samples, as in `find_spikes`.
        noise: Noise of the samples.
    """
    jumps = any(find_jumps(samples))
    for name, sizes, ratios in _changes(samples, noise, _kinks, MIN_STEP_RATIO):
        least = _least_change(samples, name, STEP_SHARE, POSE_STEPS, MIN_STEP)
        steps = np.where(sizes > least, ratios, 0.0)
        row, column = np.unravel_index(steps.argmax(), steps.shape)
        if steps[row, column] <= MIN_STEP_RATIO or (jumps and name == "the limb pose"):
            continue
        size = _in_words(name, int(column), float(sizes[row, column]))
        yield DataFinding(
            name,
            f"it steps: {size} at {samples.time[row]:.2f} s, which no other source feels",
            "check its cables, mounting and supply, and whether it was tared or moved",
        )


def find_jumps(samples: Samples) -> Iterator[DataFinding]:
    """Poses that jump from one sample to the next and stay there."""
    known = samples.pose[samples.has_pose]
    time = samples.time[samples.has_pose]
    for which, part, limit in zip("qr", (known[:, :3], known[:, 3:]), POSE_JUMPS, strict=True):
        jumped = np.linalg.norm(np.diff(part, axis=0), axis=1)
        if len(jumped) and jumped.max() > limit:
            row = int((jumped > limit).argmax())  # the first one
            size = jumped[row]
            words = f"{1e3 * size:.3g} mm" if which == "q" else f"{np.degrees(size):.3g} deg"
            yield DataFinding(
                "the limb pose",
                f"it jumps by {words} at {time[row + 1]:.2f} s",
                "check whether markers are exchanged or hidden, and whether a body was moved",
            )
            return


def _changes(
    samples: Samples,
    noise: ChannelNoise,
    found_by: Callable[[FloatArray, BoolArray, FloatArray], tuple[FloatArray, FloatArray]],
    limit: float,
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Sudden changes of single sources: what a limb does is felt by several of them.

    Args:
        samples: N samples without outliers and left-out channels.
        noise: Noise of the samples.
        found_by: Returns sizes and ratios of changes, such as `_departures`.
        limit: Ratio above which a change counts [-].

    Yields:
        A source with a ratio above the limit, the sizes of the changes in the units of its k
        channels, and the sizes over the usual ones [-], shape (N, k) each; the latter are 0 where
        another source changes as well.
    """
    sources = {
        "the wrench": (samples.wrench, noise.wrench),
        "the limb pose": (samples.pose, noise.pose),
    }
    forces = samples.trusted_forces
    for column, name in enumerate(samples.clusters):
        sources[name] = forces[:, column], noise.local_forces[column]
    regular = ~gaps(samples.stamps)
    found = {name: found_by(own, regular, of_own) for name, (own, of_own) in sources.items()}
    for name, (sizes, ratios) in found.items():
        if ratios.max() <= limit:
            continue
        sharp = [own.max(axis=1) for other, (_, own) in found.items() if other != name]
        others = np.max(sharp, axis=0)
        yield name, sizes, np.where((others < FELT_SPIKE)[:, None], ratios, 0.0)


def _least_change(
    samples: Samples, source: str, share: float, of_pose: tuple[float, float], force: float
) -> FloatArray:
    """Sizes of the channels of a source from which a change counts, shape (k,) [N m, N, m, rad].

    Args:
        samples: The samples, whose usual moment and force limit the changes of the wrench.
        source: The source.
        share: Of the usual moment and force [-].
        of_pose: Of the limb's position [m] and rotation [rad].
        force: Of the force on a cluster [N].
    """
    if source == "the limb pose":
        return np.repeat(of_pose, 3)
    if source != "the wrench":
        return np.full(3, force)
    moments_and_forces = (samples.wrench[:, group] for group in GROUPS)
    usual = [finite_quantile(np.linalg.norm(own, axis=1), 0.95) for own in moments_and_forces]
    return share * np.repeat(usual, 3)


def _in_words(source: str, column: int, size: float) -> str:
    """A channel of a source with a size in its unit."""
    if source == "the limb pose":
        axis = "xyz"[column % 3]
        turns = f"the rotation about {axis} by {np.degrees(size):.2g} deg"
        return turns if column > 2 else f"{axis} by {1e3 * size:.2g} mm"
    names = WRENCH_CHANNELS if source == "the wrench" else LOCAL_CHANNELS
    return f"{names[column]} by {size:.3g} {channel_unit(names[column])}"


def _departures(
    values: FloatArray, regular: BoolArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far each value lies beyond both its neighbours, on one side of both.

    Args:
        values: Channels of one source, shape (N, k), in their units.
        regular: Which of the steps between samples are of the usual length, shape (N - 1,).
        noise: Noise of the channels, shape (k,), in their units; NaN if it is unknown.

    Returns:
        The distances from the nearer neighbour in the channels' units, 0 between the neighbours or
        where one is missing, and the same relative to the usual ones or the noise [-], (N, k) each.
    """
    steps = np.where(regular[:, None], np.diff(values, axis=0), np.nan)
    into, out = steps[:-1], -steps[1:]
    sizes = np.zeros(values.shape)
    beyond = into * out > 0.0
    sizes[1:-1][beyond] = np.minimum(np.abs(into), np.abs(out))[beyond]
    usual = np.quantile(sizes, _USUAL_DEPARTURE, axis=0)
    scale = np.maximum(usual, np.nan_to_num(noise))
    return sizes, np.divide(sizes, scale, out=np.zeros(sizes.shape), where=scale > 0.0)


def _kinks(
    values: FloatArray, regular: BoolArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far each value steps from the one before, beyond the mean of the steps around it.

    Args:
        values: Channels of one source, shape (N, k), in their units.
        regular: Which of the steps between samples are of the usual length, shape (N - 1,).
        noise: Noise of the channels, shape (k,), in their units; NaN if it is unknown.

    Returns:
        The sizes of the steps in the channels' units, 0 where a value nearby is missing or where
        the next or previous one is as large, and the same relative to the usual ones or the noise
        [-], (N, k) each.
    """
    steps = np.where(regular[:, None], np.diff(values, axis=0), np.nan)
    before, own, after = steps[:-2], steps[1:-1], steps[2:]
    beyond = np.abs(own - 0.5 * (before + after))
    alone = np.maximum(np.abs(before), np.abs(after)) < _STEP_ALONE * np.abs(own)
    sizes = np.zeros(values.shape)
    sizes[2:-1] = np.nan_to_num(beyond)
    usual = np.quantile(sizes, _USUAL_DEPARTURE, axis=0)
    sizes[2:-1][~alone] = 0.0
    scale = np.maximum(usual, _KINK_NOISE * np.nan_to_num(noise))
    return sizes, np.divide(sizes, scale, out=np.zeros(sizes.shape), where=scale > 0.0)
