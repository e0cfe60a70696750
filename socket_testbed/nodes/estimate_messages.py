"""The messages of the estimator: models, forces and maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from scipy.spatial.transform import Rotation
from socket_testbed_msgs.msg import ContactModel as ContactModelMessage
from socket_testbed_msgs.msg import ForceMap, LocalForceArray
from visualization_msgs.msg import Marker, MarkerArray

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.nodes.conversions import (
    LOAD_CELL_FRAME,
    MessageTemplate,
    VectorPacker,
    elements,
    header_to_ros,
    layout_of,
    point_to_ros,
    quaternion_to_ros,
    vector_to_ros,
    vectors_from_ros,
    wrench_to_ros,
)

_MAP_FIELDS = (
    "forces",
    "standard_deviations",
    "normal_pressure",
    "normal_pressure_standard_deviation",
    "shear",
    "shear_standard_deviation",
)


def local_forces_packer(names: Sequence[str]) -> VectorPacker:
    """Packs a LocalForceArray from its stamp [ns] and forces in {S}, shape (n, 3) [N]."""
    template = MessageTemplate(
        LocalForceArray(
            header=header_to_ros(0), names=list(names), forces=[Vector3() for _ in names]
        )
    )
    forces = template.numbers["forces"]

    def pack(stamp: int, values: FloatArray) -> bytes:
        forces[...] = values
        return template.serialised(stamp)

    return pack


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


class ForceMapPacker:
    """Packs the force maps of a socket: a message per source, of which a sample fills the numbers.

    Args:
        names: Names of the n tiles.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = list(names)
        self._template = cache(self._template_of)  # few: by the channels that are there

    def packed(self, stamp: int, estimate: MapEstimate) -> bytes:
        """The message of a sample.

        Args:
            stamp: Stamp since the epoch [ns].
            estimate: The map of this sample, with N = 1.
        """
        template = self._template(estimate.source)
        for field in _MAP_FIELDS:
            template.numbers[field][...] = getattr(estimate, field)[0]
        return template.serialised(stamp)

    def _template_of(self, source: str) -> MessageTemplate:
        count = len(self._names)
        return MessageTemplate(
            ForceMap(
                header=header_to_ros(0),
                names=self._names,
                forces=[Vector3() for _ in self._names],
                standard_deviations=[Vector3() for _ in self._names],
                normal_pressure=[0.0] * count,
                normal_pressure_standard_deviation=[0.0] * count,
                shear=[0.0] * count,
                shear_standard_deviation=[0.0] * count,
                source=source,
            )
        )


def map_from_ros(message: ForceMap) -> MapEstimate:
    """The force map of a message, with N = 1."""

    def row(values: Any) -> FloatArray:
        return np.array(values, dtype=np.float64)[None]

    return MapEstimate(
        vectors_from_ros(message.forces)[None],
        vectors_from_ros(message.standard_deviations)[None],
        row(message.normal_pressure),
        row(message.normal_pressure_standard_deviation),
        row(message.shear),
        row(message.shear_standard_deviation),
        message.source,
    )


_ARROW_SCALE = 0.002  # [m/N]
_FULL_COLOUR = 30e3  # [Pa]; normal pressure
_FAINT = 10e3  # [Pa]; standard deviation of the normal pressure
_FAINTEST = 0.1  # [-]; opacity of a tile with this deviation or more
_LIFETIME = 3  # [s]; a stopped estimator leaves no picture


# Corners of the two triangles of a tile, in halves of its side along its x and y. They face
# outwards, where one looks from.
_CORNERS = ((-1, -1), (-1, 1), (1, 1), (-1, -1), (1, 1), (1, -1))


class PressureMap:
    """The markers of a force map, a serialised message that is filled for each sample.

    A tile is a mesh of two triangles in its own frame, its force an arrow.

    Args:
        geometry: Geometry of the socket.
    """

    def __init__(self, geometry: SocketGeometry) -> None:
        self._anchors = geometry.anchors
        markers = []
        quaternions = Rotation.from_matrix(geometry.square_frames()).as_quat()
        for i, (anchor, quaternion) in enumerate(zip(self._anchors, quaternions, strict=True)):
            tile = Marker(ns="tiles", id=i, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
            tile.pose.position = point_to_ros(anchor)
            tile.pose.orientation = quaternion_to_ros(quaternion)
            tile.scale = Vector3(x=1.0, y=1.0, z=1.0)
            half = 0.5 * math.sqrt(geometry.areas[i])
            tile.points = [Point(x=half * x, y=half * y) for x, y in _CORNERS]
            arrow = Marker(ns="forces", id=i, type=Marker.ARROW, action=Marker.ADD)
            arrow.scale.x, arrow.scale.y = 0.002, 0.004
            arrow.points = [tile.pose.position, tile.pose.position]
            for marker in (tile, arrow):
                marker.header = header_to_ros(0, LOAD_CELL_FRAME)
                marker.lifetime.sec = _LIFETIME
                markers.append(marker)
        self._content, numbers = layout_of(MarkerArray(markers=markers)).blank()
        records = elements(numbers, "markers")
        self._stamps = [record["header"]["stamp"] for record in records]
        self._colours = [record["color"] for record in records]
        self._tips = [arrow["points"][1] for arrow in records[1::2]]

    def serialised(self, stamp: int, estimate: MapEstimate) -> bytes:
        """The message of a sample, a MarkerArray with a tile and an arrow for each force.

        The colour is the normal pressure, from pale to dark red at 30 kPa; what is uncertain is
        faint, from opaque to a tenth where the pressure's standard deviation is 10 kPa.

        Args:
            stamp: Stamp since the epoch [ns].
            estimate: The map of this sample, with N = 1.
        """
        tips = self._anchors + _ARROW_SCALE * estimate.forces[0]
        shares = np.clip(estimate.normal_pressure[0] / _FULL_COLOUR, 0.0, 1.0)
        deviations = estimate.normal_pressure_standard_deviation[0]
        opacities = np.clip(1.0 - (1.0 - _FAINTEST) * deviations / _FAINT, _FAINTEST, 1.0)
        other = 0.9 * (1.0 - shares)
        colours = np.column_stack([1.0 - 0.4 * shares, other, other, opacities])
        time = divmod(stamp, 1_000_000_000)
        for own in self._stamps:
            own[()] = time
        for own, colour in zip(self._colours, colours.repeat(2, axis=0), strict=True):
            own[:] = colour
        for own, tip in zip(self._tips, tips, strict=True):
            own[:] = tip
        return bytes(self._content)
