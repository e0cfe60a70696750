"""Means of markers over a static take, and whether it is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.rigid import root_mean_square

NOTED_DRIFT = 0.0002  # [m]
NOTED_SPREAD = 0.0004  # [m]; well above the noise of a marker
MOST_MOTION = 0.001  # [m]; for either
_JUMP = 0.005  # [m]; a frame with a marker this far off shows another label or a reflection
_MOST_JUMPS = 0.1  # of the frames; more of them is a body that moved
_FEWEST_FRAMES = 20
_BLOCKS = 10


@dataclass(frozen=True)
class StillMarkers:
    """Markers of a static take, averaged over the frames that show all of them.

    Attributes:
        names: Names of the k markers.
        mean: Mean positions, shape (k, 3) [m].
        spread: Root-mean-square distances from the means, shape (k,) [m].
        drift: Distances between the means of the first and the last third, shape (k,) [m].
        noise: 1-sigma error of a coordinate of a mean, pooled over the markers [m]; from the
            means of blocks of frames, so that slow motion and correlated noise count.
        used: Which frames are averaged, shape (N,).
        occluded: Number of frames in which each marker is occluded, shape (k,).
        mislabelled: Number of frames left out whose triad fits in no order of its labels.
        jumped: Number of frames left out in which a marker is far from its usual place.
    """

    names: tuple[str, ...]
    mean: FloatArray
    spread: FloatArray
    drift: FloatArray
    noise: float
    used: BoolArray
    occluded: IntArray
    mislabelled: int
    jumped: int

    @property
    def notes(self) -> tuple[str, ...]:
        """Markers that moved more than noise does, yet little enough to be used."""
        return tuple(
            f"{name} {what} by {1e3 * moved:.2f} mm over the take"
            for what, motion, limit in self.motions()
            for name, moved in zip(self.names, motion, strict=True)
            if moved > limit
        )

    def motions(self) -> tuple[tuple[str, FloatArray, float], ...]:
        """What the markers did, how far, shape (k,) [m], and from where on it is noted [m]."""
        return (
            ("drifted", self.drift, NOTED_DRIFT),
            ("moved about", self.spread, NOTED_SPREAD),
        )


def average_still(
    names: Sequence[str], positions: FloatArray, fits: BoolArray, where: str
) -> StillMarkers:
    """Average markers over a take in which they stand still.

    Args:
        names: Names of the k markers.
        positions: Their positions over N frames, shape (N, k, 3) [m]; NaN where occluded.
        fits: Frames whose triad fits in some order of its labels, shape (N,).
        where: What names the body in an error.

    Raises:
        RegistrationError: If too few frames show all markers, or if one of them moved.
    """
    occluded = np.isnan(positions).any(axis=2).sum(axis=0)
    seen = np.isfinite(positions).all(axis=(1, 2))
    candidates = seen & fits
    mislabelled = int((seen & ~fits).sum())
    _require_frames(names, candidates, occluded, mislabelled, where)
    usual = np.median(positions[candidates], axis=0)
    far = np.linalg.norm(positions - usual, axis=2) > _JUMP  # False where occluded
    used = candidates & ~far.any(axis=1)
    _require_few_jumps(names, far[candidates], where)
    jumped = int((candidates & ~used).sum())
    still = _average(names, positions[used], used, occluded, mislabelled, jumped)
    _require_still(still, where)
    return still


def _average(
    names: Sequence[str],
    positions: FloatArray,
    used: BoolArray,
    occluded: IntArray,
    mislabelled: int,
    jumped: int,
) -> StillMarkers:
    mean = positions.mean(axis=0)
    third = len(positions) // 3
    drift = positions[-third:].mean(axis=0) - positions[:third].mean(axis=0)
    blocks = np.array([block.mean(axis=0) for block in np.array_split(positions, _BLOCKS)])
    return StillMarkers(
        names=tuple(names),
        mean=mean,
        spread=root_mean_square(np.linalg.norm(positions - mean, axis=2), axis=0),
        drift=np.linalg.norm(drift, axis=1),
        noise=float(np.sqrt(blocks.var(axis=0, ddof=1).mean() / _BLOCKS)),
        used=used,
        occluded=occluded,
        mislabelled=mislabelled,
        jumped=jumped,
    )


def _require_frames(
    names: Sequence[str], candidates: BoolArray, occluded: IntArray, mislabelled: int, where: str
) -> None:
    if candidates.sum() < _FEWEST_FRAMES:
        worst = int(occluded.argmax())
        raise RegistrationError(
            f"{where}: {int(candidates.sum())} of {len(candidates)} frames show all of"
            f" {', '.join(names)} ({names[worst]} is occluded in {int(occluded[worst])}, the"
            f" triad's edges are not its usual ones in {mislabelled})",
            f"record {_FEWEST_FRAMES} frames or more in which the cameras see them all",
        )


def _require_few_jumps(names: Sequence[str], far: BoolArray, where: str) -> None:
    jumps = int(far.any(axis=1).sum())
    if jumps > _MOST_JUMPS * len(far):
        worst = names[int(far.sum(axis=0).argmax())]
        raise RegistrationError(
            f"{where}: in {jumps} of {len(far)} frames a marker, mostly {worst}, is more than"
            f" {1e3 * _JUMP:g} mm from its usual place",
            "record a take in which nothing moves, and check its labels",
        )


def _require_still(still: StillMarkers, where: str) -> None:
    for what, motion, _ in still.motions():
        worst = int(motion.argmax())
        if motion[worst] > MOST_MOTION:
            raise RegistrationError(
                f"{where}: {still.names[worst]} {what} by {1e3 * motion[worst]:.2f} mm over the"
                f" take (at most {1e3 * MOST_MOTION:g} mm)",
                "record a take in which nothing moves, or export its still part",
            )
