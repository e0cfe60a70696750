"""What a source measured, at its own times: wrenches, poses, capacitances or stresses."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class WrenchSeries:
    """Wrenches of a load cell.

    Attributes:
        times: When each was measured, by the source's clock, shape (N,) [ns]; ascending.
        values: Wrenches [M; F] that the limb applies to the socket, shape (N, 6) [N m, N]; NaN
            where a value is missing.
        frame: Name of the frame whose axes and origin they have, such as `load_cell`.
    """

    times: IntArray
    values: FloatArray
    frame: str = "load_cell"


@dataclass(frozen=True)
class PoseSeries:
    """Poses of one rigid body.

    Attributes:
        times: When each was measured, by the source's clock, shape (N,) [ns]; ascending.
        positions: Positions of the body's origin in `frame`, shape (N, 3) [m]; NaN where missing.
        quaternions: Orientations x, y, z, w that map the body's axes to `frame`, shape (N, 4) [-].
        frame: Name of the frame that does not move, such as `world`.
    """

    times: IntArray
    positions: FloatArray
    quaternions: FloatArray
    frame: str = "world"


@dataclass(frozen=True)
class ClusterSeries:
    """Capacitances or stresses of clusters.

    Attributes:
        times: When each row was measured, by the source's clock, shape (N,) [ns]; ascending.
        clusters: Names of the C clusters.
        values: Capacitances by converter input, as the `wiring` of the calibration counts them,
            shape (N, C, 4) [pF], or stresses `normal` (positive in compression), `shear_x`,
            `shear_y` along the cluster's axes, shape (N, C, 3) [Pa]; NaN where a value is missing.
    """

    times: IntArray
    clusters: tuple[str, ...]
    values: FloatArray

    @property
    def are_stresses(self) -> bool:
        """Whether the values are stresses [Pa], not capacitances [pF]."""
        return self.values.shape[2] == 3
