"""Conversions between the core's records and ROS messages, in pairs where both are needed."""

from __future__ import annotations

import math

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3, Wrench
from scipy.spatial.transform import Rotation
from socket_testbed_msgs.msg import (
    ClusterCapacitance,
    ClusterCapacitanceArray,
    ClusterStress,
    ClusterStressArray,
    ForceMap,
    LocalForceArray,
    RigidBodyMarkers,
    RigidBodyMarkersArray,
)
from socket_testbed_msgs.msg import ContactModel as ContactModelMessage
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.model_file import StoredModel

LOAD_CELL_FRAME = "load_cell"


def stamp_from_ros(stamp: Time) -> int:
    """Nanoseconds since the epoch."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_to_ros(stamp: int) -> Time:
    """Stamp from nanoseconds since the epoch."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_to_ros(stamp: int, frame: str = "") -> Header:
    """Header from nanoseconds since the epoch and a frame."""
    return Header(stamp=stamp_to_ros(stamp), frame_id=frame)


def wrench_from_ros(wrench: Wrench) -> FloatArray:
    """[M; F], shape (6,) [N m, N]."""
    t, f = wrench.torque, wrench.force
    return np.array([t.x, t.y, t.z, f.x, f.y, f.z])


def wrench_to_ros(wrench: FloatArray) -> Wrench:
    """Wrench from [M; F], shape (6,) [N m, N]."""
    return Wrench(torque=vector_to_ros(wrench[:3]), force=vector_to_ros(wrench[3:]))


def vector_to_ros(vector: FloatArray) -> Vector3:
    """Vector3 from an array of shape (3,)."""
    x, y, z = vector.tolist()
    return Vector3(x=x, y=y, z=z)


def vectors_from_ros(vectors: list[Vector3]) -> FloatArray:
    """Array of shape (n, 3) from n Vector3."""
    return np.array([(v.x, v.y, v.z) for v in vectors]).reshape(-1, 3)


def pose_from_ros(pose: Pose) -> FloatArray:
    """Position [m] and quaternion (x, y, z, w), shape (7,)."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def pose_to_ros(position: FloatArray, quaternion: FloatArray) -> Pose:
    """Pose from a position, shape (3,) [m], and a quaternion (x, y, z, w), shape (4,)."""
    x, y, z, w = quaternion.tolist()
    return Pose(position=point_to_ros(position), orientation=Quaternion(x=x, y=y, z=z, w=w))


def point_to_ros(position: FloatArray) -> Point:
    """Point from a position, shape (3,) [m]."""
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


def markers_to_ros(
    stamp: int, frame: str, bodies: tuple[str, ...], markers: FloatArray
) -> RigidBodyMarkersArray:
    """Message from the markers of b bodies, shape (b, m, 3) [m]; NaN where occluded."""
    triads = [
        RigidBodyMarkers(name=name, markers=[point_to_ros(marker) for marker in triad])
        for name, triad in zip(bodies, markers, strict=True)
    ]
    return RigidBodyMarkersArray(header=header_to_ros(stamp, frame), bodies=triads)


def capacitance_to_ros(
    stamp: int, names: tuple[str, ...], capacitance: FloatArray, status: StatusArray
) -> ClusterCapacitanceArray:
    """Message from capacitances, shape (c, 4) [pF], and statuses, shape (c, 4)."""
    clusters = [
        ClusterCapacitance(name=name, capacitance=capacitance[i], status=status[i])
        for i, name in enumerate(names)
    ]
    return ClusterCapacitanceArray(header=header_to_ros(stamp), clusters=clusters)


def stress_from_ros(message: ClusterStressArray) -> dict[str, tuple[FloatArray, int]]:
    """Normal stress, shear x, shear y [Pa] and status by cluster."""
    return {
        c.name: (np.array([c.normal, c.shear_x, c.shear_y]), int(c.status))
        for c in message.clusters
    }


def stress_to_ros(
    stamp: int, names: list[str], stress: FloatArray, status: StatusArray
) -> ClusterStressArray:
    """Message from stresses, shape (c, 3) [Pa], and statuses, shape (c,)."""
    clusters = [
        ClusterStress(
            name=name,
            normal=float(values[0]),
            shear_x=float(values[1]),
            shear_y=float(values[2]),
            status=int(state),
        )
        for name, values, state in zip(names, stress, status, strict=True)
    ]
    return ClusterStressArray(header=header_to_ros(stamp), clusters=clusters)


def local_forces_to_ros(stamp: int, names: tuple[str, ...], forces: FloatArray) -> LocalForceArray:
    """Message from forces in {S}, shape (n, 3) [N]."""
    return LocalForceArray(
        header=header_to_ros(stamp, LOAD_CELL_FRAME),
        names=list(names),
        forces=[Vector3(x=x, y=y, z=z) for x, y, z in forces.tolist()],
    )


def fit_to_ros(fit: Fit) -> ContactModelMessage:
    """Message from a fit."""
    rmse = np.array([error.rmse for error in fit.errors[:6]])
    return _model_to_ros(fit.model, fit.last_stamp, rmse, fit.samples, fit.status)


def stored_model_to_ros(stored: StoredModel) -> ContactModelMessage:
    """Message from a model read from its file."""
    return _model_to_ros(
        stored.model, stored.last_stamp, stored.wrench_rmse, stored.samples, stored.status
    )


def _model_to_ros(
    model: ContactModel, stamp: int, wrench_rmse: FloatArray, samples: int, status: str
) -> ContactModelMessage:
    return ContactModelMessage(
        header=header_to_ros(stamp, LOAD_CELL_FRAME),
        variant=model.variant,
        names=list(model.names),
        stiffness=[vector_to_ros(row) for row in model.stiffness],
        rest_positions=[vector_to_ros(row) for row in model.rest_positions],
        wrench_bias=wrench_to_ros(model.wrench_bias),
        bias_names=list(model.force_bias),
        force_bias=[vector_to_ros(row) for row in model.force_bias.values()],
        wrench_rmse=wrench_to_ros(wrench_rmse),
        samples=samples,
        solver_status=status,
    )


class ForceMapMessage:
    """The message of a socket's force map, made once: a sample changes only the values in it.

    To set the 200 vectors of 100 tiles takes a third of the time of making them.

    Args:
        names: Names of the n tiles.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._message = ForceMap(
            names=list(names),
            forces=[Vector3() for _ in names],
            standard_deviations=[Vector3() for _ in names],
        )

    def filled(self, stamp: int, estimate: MapEstimate) -> ForceMap:
        """The message of a sample, which holds until the next one.

        Args:
            stamp: Stamp since the epoch [ns].
            estimate: The map of this sample, with N = 1.
        """
        message = self._message
        message.header = header_to_ros(stamp, LOAD_CELL_FRAME)
        _fill(message.forces, estimate.forces[0])
        _fill(message.standard_deviations, estimate.standard_deviations[0])
        message.normal_pressure = estimate.normal_pressure[0].tolist()
        message.normal_pressure_standard_deviation = estimate.normal_pressure_standard_deviation[
            0
        ].tolist()
        message.shear = estimate.shear[0].tolist()
        message.shear_standard_deviation = estimate.shear_standard_deviation[0].tolist()
        message.source = estimate.source
        return message


def _fill(vectors: list[Vector3], values: FloatArray) -> None:
    for vector, (x, y, z) in zip(vectors, values.tolist(), strict=True):
        vector.x, vector.y, vector.z = x, y, z


_ARROW_SCALE = 0.002  # [m/N]
_FULL_COLOUR = 30e3  # [Pa]; normal pressure
_FAINT = 10e3  # [Pa]; standard deviation of the normal pressure
_FAINTEST = 0.1  # [-]; opacity of a tile with this deviation or more
_LIFETIME = 3  # [s]; a stopped estimator leaves no picture


class PressureMap:
    """The markers of a force map, of which only what a sample changes is made anew.

    Args:
        geometry: Geometry of the socket.
    """

    def __init__(self, geometry: SocketGeometry) -> None:
        self._anchors = geometry.anchors
        self._tiles = []
        self._arrows = []
        quaternions = Rotation.from_matrix(geometry.rotations).as_quat().tolist()
        for i, (anchor, (x, y, z, w)) in enumerate(zip(self._anchors, quaternions, strict=True)):
            tile = Marker(ns="tiles", id=i, type=Marker.CUBE, action=Marker.ADD)
            tile.pose.position = point_to_ros(anchor)
            tile.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
            tile.scale.x = tile.scale.y = math.sqrt(geometry.areas[i])
            tile.scale.z = 0.001
            arrow = Marker(ns="forces", id=i, type=Marker.ARROW, action=Marker.ADD)
            arrow.scale.x, arrow.scale.y = 0.002, 0.004
            for marker in (tile, arrow):
                marker.lifetime.sec = _LIFETIME
            self._tiles.append(tile)
            self._arrows.append(arrow)

    def markers(self, stamp: int, estimate: MapEstimate) -> MarkerArray:
        """The message of a sample.

        The colour is the normal pressure, from pale to dark red at 30 kPa; what is uncertain is
        faint, from opaque to a tenth where the pressure's standard deviation is 10 kPa.

        Args:
            stamp: Stamp since the epoch [ns].
            estimate: The map of this sample, with N = 1.
        """
        header = header_to_ros(stamp, LOAD_CELL_FRAME)
        tips = self._anchors + _ARROW_SCALE * estimate.forces[0]
        shares = np.clip(estimate.normal_pressure[0] / _FULL_COLOUR, 0.0, 1.0)
        deviations = estimate.normal_pressure_standard_deviation[0]
        opacities = np.clip(1.0 - (1.0 - _FAINTEST) * deviations / _FAINT, _FAINTEST, 1.0)
        colours = np.column_stack([1.0 - 0.4 * shares, 0.9 * (1.0 - shares), opacities]).tolist()
        markers = []
        for tile, arrow, tip, (red, other, opacity) in zip(
            self._tiles, self._arrows, tips, colours, strict=True
        ):
            arrow.points = [tile.pose.position, point_to_ros(tip)]
            for marker in (tile, arrow):
                marker.header = header
                colour = marker.color
                colour.r, colour.g, colour.b, colour.a = red, other, other, opacity
                markers.append(marker)
        return MarkerArray(markers=markers)
