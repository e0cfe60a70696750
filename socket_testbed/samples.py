"""Synchronised samples: the data that all analyses of a trial use."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray, StatusArray
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.rotations import compose, quaternions_to_vectors, vectors_to_quaternions

if TYPE_CHECKING:
    import pandas as pd

WRENCH_CHANNELS = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
LOCAL_CHANNELS = ("Fx", "Fy", "Fz")
GROUPS = MOMENTS, FORCES = slice(0, 3), slice(3, 6)  # of a wrench
GRAVITY = 9.81  # [m/s^2]


class Status(IntEnum):
    """Status of a cluster's stress; a single channel takes one of the first three.

    Attributes:
        OK: The value is within the calibrated range.
        SATURATED: A capacitance is at an end of the chip's range: the value is NaN.
        MISSING: There is no measurement: the value is NaN.
        OUT_OF_RANGE: The value lies outside the calibrated range and is extrapolated.
    """

    OK = 0
    SATURATED = 1
    MISSING = 2
    OUT_OF_RANGE = 3


WITHOUT_VALUE = (Status.SATURATED, Status.MISSING)


def local_channels(cluster: str) -> list[str]:
    """Names of the three channels of a cluster, such as `distal.Fx`, in its frame {L}."""
    return [f"{cluster}.{channel}" for channel in LOCAL_CHANNELS]


def channel_names(clusters: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the 6 + 3c channels: the wrench's [M; F], then three for each of c clusters."""
    return (*WRENCH_CHANNELS, *chain.from_iterable(map(local_channels, clusters)))


def named_channels(names: object, clusters: Collection[str]) -> tuple[str, ...]:
    """The channels that a user names; a cluster's name means its three channels.

    Args:
        names: Names of channels or clusters, such as `Mz`, `distal.Fx` or `distal`, or a single one
            as a text.
        clusters: Names of the known clusters.

    Returns:
        The channels in the order of their names, each once. Unknown names are kept.

    Raises:
        ConfigurationError: If the names are not texts.
    """
    several = isinstance(names, Iterable) and not isinstance(names, str)
    listed: list[Any] = [*names] if several else [names]  # type: ignore[misc]
    if wrong := [name for name in listed if not isinstance(name, str)]:
        raise ConfigurationError(
            f"leave_out holds {wrong[0]!r}", "give names of channels, such as ['distal.Fx', 'Mz']"
        )
    found = (local_channels(name) if name in clusters else [name] for name in listed)
    return tuple(dict.fromkeys(chain.from_iterable(found)))


def refuse_unknown_channels(leave_out: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Check that every name is a channel.

    Args:
        leave_out: Names to check, such as `Mz` or `distal.Fx`.
        names: Names of all channels.

    Raises:
        ConfigurationError: If a name is not one of them.
    """
    for name in leave_out:
        if name not in names:
            own = [channel for channel in names if channel.startswith(f"{name}.")]
            hint = f"give {' '.join(own)}" if own else closest(name, names)
            raise ConfigurationError(f"leave_out: no channel '{name}'", hint)


def channel_unit(name: str) -> str:
    """Unit of a channel from its name, such as `Mx` or `distal.Fz`: `N m` or `N`."""
    return "N m" if name.rpartition(".")[2].startswith("M") else "N"


def force_magnitude(wrench: FloatArray) -> FloatArray:
    """Magnitudes (N,) [N] of the forces of wrenches [M; F], (N, 6); NaN where one is missing.

    A channel that never has a value does not count.
    """
    force = wrench[:, 3:]
    dead = np.isnan(force).all(axis=0)
    return np.asarray(np.linalg.norm(force[:, ~dead] if not dead.all() else force, axis=1))


def moments_about(wrench: FloatArray, point: Sequence[float] | None) -> FloatArray:
    """Wrenches [M; F] about another point: M - p x F and F, shape (N, 6) [N m, N].

    Args:
        wrench: Wrenches [M; F] about the origin of their frame, shape (N, 6) [N m, N].
        point: The point p in their frame, shape (3,) [m]; None for the origin.
    """
    if point is None:
        return wrench
    return np.hstack([wrench[:, :3] - np.cross(point, wrench[:, 3:]), wrench[:, 3:]])


def mean_and_sigma(vectors: FloatArray) -> tuple[float, float]:
    """Magnitude of the mean of vectors, and standard deviation of their magnitudes.

    The vectors have shape (N, 3) in one unit, which both results have. Rows that hold a NaN do not
    count; without any other row both results are NaN.
    """
    vectors = vectors[np.isfinite(vectors).all(axis=1)]
    if not len(vectors):
        return float("nan"), float("nan")
    magnitude = float(np.linalg.norm(vectors.mean(axis=0)))
    return magnitude, float(np.linalg.norm(vectors, axis=1).std())


def turned(rotation: FloatArray, by: FloatArray) -> FloatArray:
    """Rotation vectors of the product exp(rotation) exp(by), shape (N, 3) [rad].

    Args:
        rotation: Rotation vectors, shape (N, 3) [rad]; a row with NaN gives a row of NaN.
        by: Rotation vector that is applied first, shape (3,) [rad].
    """
    product = compose(vectors_to_quaternions(rotation), vectors_to_quaternions(by))
    return quaternions_to_vectors(product)


def relative_pose(pose: FloatArray, reference: FloatArray) -> FloatArray:
    """Displacement and rotation vector since a reference pose, both in {S}.

    Args:
        pose: Positions q and rotation vectors of the limb in {S}, shape (N, 6) [m, rad].
        reference: Reference position c and rotation vector in {S}, shape (6,) [m, rad].

    Returns:
        ``[q - c, phi]`` with ``R = exp(phi) R_ref``, shape (N, 6) [m, rad]; NaN in rows where any
        component of the pose is NaN.
    """
    relative = np.hstack([pose[:, :3] - reference[:3], turned(pose[:, 3:], -reference[3:])])
    relative[~np.isfinite(relative).all(axis=1)] = np.nan
    return relative


@dataclass(frozen=True)
class Samples:
    """Synchronised measurements, one row per trigger.

    Missing values are NaN, never an older value.

    Attributes:
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        position: Limb position q in {S}, shape (N, 3) [m].
        rotation: Rotation vector of the limb frame in {S}, shape (N, 3) [rad].
        wrench: Measured wrench [M; F] in {S}, shape (N, 6) [N m, N].
        clusters: Names of the c clusters.
        local_forces: Measured force on each cluster in the frame {L} of its tile, also where
            the cluster is turned on it, shape (N, c, 3) [N]; pressed along -z.
        status: Status of each cluster (`Status`), shape (N, c).
    """

    stamps: IntArray
    position: FloatArray
    rotation: FloatArray
    wrench: FloatArray
    clusters: tuple[str, ...]
    local_forces: FloatArray
    status: StatusArray

    def __len__(self) -> int:
        return len(self.stamps)

    def __repr__(self) -> str:
        duration = self.time[-1] if len(self) else 0.0
        return (
            f"Samples({len(self)} samples in {duration:.2f} s, {self.complete.sum()} complete;"
            f" clusters {', '.join(self.clusters)})"
        )

    def __getitem__(self, rows: slice | BoolArray | IntArray) -> Samples:
        """The samples in the given rows."""
        parts = {name: values[rows] for name, values in vars(self).items() if name != "clusters"}
        return replace(self, **parts)

    @property
    def time(self) -> FloatArray:
        """Time since the first sample, shape (N,) [s]."""
        return (self.stamps - self.stamps[:1]).astype(np.float64) * 1e-9

    @property
    def pose(self) -> FloatArray:
        """Pose of the limb in {S}: position, then rotation vector, shape (N, 6) [m, rad]."""
        return np.hstack([self.position, self.rotation])

    @property
    def has_pose(self) -> BoolArray:
        """Rows with a limb pose, shape (N,)."""
        return np.asarray(np.isfinite(self.pose).all(axis=1))

    @property
    def attitude(self) -> FloatArray:
        """Rotation vector of the limb's mean attitude in {S}, shape (3,) [rad]; 0 if unknown."""
        from scipy.spatial.transform import Rotation  # 15 MB, which not every node needs

        known = self.rotation[self.has_pose]
        return Rotation.from_rotvec(known).mean().as_rotvec() if len(known) else np.zeros(3)

    def centred(self) -> Samples:
        """The samples with rotations since the mean attitude.

        These are small rotations about x, y and z of {S}, however the limb's frame is turned. Only
        they may be averaged, subtracted or used in a regression.
        """
        return replace(self, rotation=turned(self.rotation, -self.attitude))

    @property
    def has_wrench(self) -> BoolArray:
        """Rows with a wrench, shape (N,); channels that never have a value are not required."""
        measured = np.isfinite(self.wrench)
        complete = (measured | ~measured.any(axis=0)).all(axis=1)
        return np.asarray(complete & measured.any(axis=1))

    @property
    def has_pose_and_wrench(self) -> BoolArray:
        """Rows with both a wrench and a limb pose, as a fit requires, shape (N,)."""
        return self.has_pose & self.has_wrench

    def under_load(self, least_force: float) -> BoolArray:
        """Rows with a pose, a wrench, and a force of at least so many newtons, shape (N,)."""
        return self.has_pose_and_wrench & (force_magnitude(self.wrench) >= least_force)

    @property
    def states(self) -> dict[str, StatusArray]:
        """`Status` of each sample, shape (N,), of `wrench`, `limb position` and each cluster."""
        complete = np.isfinite(self.wrench).all(axis=1)
        present = {"wrench": complete, "limb position": self.has_pose}
        found = {name: np.where(rows, Status.OK, Status.MISSING) for name, rows in present.items()}
        return found | dict(zip(self.clusters, self.status.T, strict=True))

    @property
    def complete(self) -> BoolArray:
        """Rows in which the wrench, the pose and every cluster have a value, shape (N,)."""
        return np.all([~np.isin(state, WITHOUT_VALUE) for state in self.states.values()], axis=0)

    @property
    def trusted_forces(self) -> FloatArray:
        """Forces on the clusters in their frames, shape (N, c, 3) [N]; NaN if not `Status.OK`.

        Forces outside the calibrated range are extrapolated, so fits and evaluations ignore them.
        """
        return np.where((self.status == Status.OK)[:, :, None], self.local_forces, np.nan)

    @property
    def trusted_values(self) -> FloatArray:
        """The wrench and the `trusted_forces`, by `channels`, shape (N, 6 + 3c) [N m, N]."""
        forces = self.trusted_forces.reshape(len(self), 3 * len(self.clusters))
        return np.hstack([self.wrench, forces])

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the 6 + 3c channels: the wrench's [M; F], then Fx, Fy, Fz of each cluster."""
        return channel_names(self.clusters)

    @property
    def titles(self) -> list[str]:
        """Names of all channels with their units, such as `Mx [N m]`."""
        return [f"{name} [{channel_unit(name)}]" for name in self.channels]

    def counted(self, leave_out: Sequence[str]) -> BoolArray:
        """Which of the `channels` are not among some names, shape (6 + 3c,)."""
        return np.isin(self.channels, leave_out, invert=True)

    def without(self, leave_out: Sequence[str]) -> Samples:
        """The samples with the values of some channels, given by name, replaced by NaN."""
        return self.blanked(~self.counted(leave_out))

    def blanked(self, missing: BoolArray) -> Samples:
        """The samples with NaN where a flag, shape (N, 6 + 3c) by `channels`, is set."""
        values = np.where(missing, np.nan, self.values)
        forces = values[:, 6:].reshape(self.local_forces.shape)
        return replace(self, wrench=values[:, :6], local_forces=forces)

    @property
    def values(self) -> FloatArray:
        """All channels in the order of `channels`, shape (N, 6 + 3c) [N m, N]."""
        forces = self.local_forces.reshape(len(self), 3 * len(self.clusters))
        return np.hstack([self.wrench, forces])

    def to_dataframe(self) -> pd.DataFrame:
        """The samples as a pandas table, with units in the column names.

        Returns:
            A row per sample, indexed by `time [s]`. Columns: the wrench in {S}, such as `Mx [N m]`
            and `Fz [N]`; the limb position and rotation vector in {S}, such as `q_x [m]` and
            `phi_x [rad]`; for each cluster its force in its tile's frame, such as `distal.Fx [N]`,
            and its status, such as `distal.status [-]` (see `Status`). Missing values are NaN.
        """
        import pandas as pd

        titles = self.titles
        values = dict(zip(titles, self.values.T, strict=True))
        columns: dict[str, FloatArray | StatusArray] = {name: values[name] for name in titles[:6]}
        columns |= {f"q_{axis} [m]": self.position[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"phi_{axis} [rad]": self.rotation[:, i] for i, axis in enumerate("xyz")}
        for i, cluster in enumerate(self.clusters):
            columns |= {name: values[name] for name in titles[6 + 3 * i : 9 + 3 * i]}
            columns[f"{cluster}.status [-]"] = self.status[:, i]
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time [s]"))
