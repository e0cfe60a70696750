"""Where a frame lies, from landmarks whose coordinates in it are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.rigid import (
    PoseUncertainty,
    fit_rigid,
    misfit,
    pose_uncertainty,
    root_mean_square,
)
from socket_testbed.registration.mix_ups import refuse_mix_ups, unseen_mix_ups

_FEWEST = 3
_SMALLEST = 0.005  # [m]; landmarks closer to each other or to one line hold no rotation


@dataclass(frozen=True)
class LandmarkFit:
    """A frame registered by k landmarks.

    Attributes:
        names: Names of the landmarks.
        pose: Pose of the frame in which they are known, in the frame in which they are measured.
        residual: Distances of the landmarks from where the fit puts them, shape (k,) [m].
        noise: 1-sigma error of a coordinate of a landmark [m].
        degrees: Degrees of freedom of the residual, 3k - 6.
        uncertainty: 1-sigma uncertainty of the pose, in the axes of the known frame.
        blind: What mix-ups of the landmarks no residual would show.
    """

    names: tuple[str, ...]
    pose: Pose
    residual: FloatArray
    noise: float
    degrees: int
    uncertainty: PoseUncertainty
    blind: tuple[str, ...]

    @property
    def rms(self) -> float:
        """Root-mean-square residual [m]."""
        return float(root_mean_square(self.residual))


def register_landmarks(
    known: FloatArray, measured: FloatArray, names: Sequence[str], noise: float | None = None
) -> LandmarkFit:
    """Least-squares pose of a frame from landmarks.

    The uncertainty is the first-order one (`pose_uncertainty`). Without a given noise, sigma
    comes from the residuals, ``sigma^2 = sum(residual^2) / (3k - 6)``; with few landmarks it is
    itself known roughly only (three of them leave 3 degrees of freedom). An error that all
    landmarks share, such as a wrong origin of the known frame, is in no residual.

    Args:
        known: Landmarks in the frame to register, shape (k, 3) [m].
        measured: The same landmarks in another frame, shape (k, 3) [m].
        names: Names of the k landmarks.
        noise: 1-sigma error of a coordinate of a landmark [m], if it is known.

    Raises:
        RegistrationError: If there are fewer than three landmarks, if they lie together or on
            one line, or if they fit much better under other names or mirrored.
    """
    if len(names) < _FEWEST:
        raise RegistrationError(
            f"{len(names)} landmarks ({', '.join(names) or 'none'}) hold no frame",
            f"give {_FEWEST} or more that are not on one line",
        )
    _require_spread(known, names, "are given")
    _require_spread(measured, names, "were measured")
    refuse_mix_ups(known, measured, names)

    batch = fit_rigid(known, measured[None])
    residual = misfit(known, measured[None], batch)[0]
    degrees = 3 * len(names) - 6
    sigma = float(np.sqrt((residual**2).sum() / degrees)) if noise is None else noise
    return LandmarkFit(
        names=tuple(names),
        pose=Pose(batch.rotation[0], batch.translation[0]),
        residual=residual,
        noise=sigma,
        degrees=degrees,
        uncertainty=pose_uncertainty(known, sigma),
        blind=unseen_mix_ups(known, names),
    )


def _require_spread(points: FloatArray, names: Sequence[str], how: str) -> None:
    for a, b in combinations(range(len(names)), 2):
        apart = float(np.linalg.norm(points[a] - points[b]))
        if apart < _SMALLEST:
            raise RegistrationError(
                f"landmarks {names[a]} and {names[b]} {how} {1e3 * apart:.1f} mm apart",
                "give landmarks far from each other",
            )
    stretch = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    off_line = float(np.hypot(stretch[1], stretch[2]) / np.sqrt(len(names)))
    if off_line < _SMALLEST:
        raise RegistrationError(
            f"landmarks {', '.join(names)} {how} on one line (within {1e3 * off_line:.1f} mm)",
            "move one of them away from the line of the others",
        )
