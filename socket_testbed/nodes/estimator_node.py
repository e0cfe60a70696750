"""Estimator node: force maps from measurements, predicted wrench and local forces from samples.

Subscribes: trigger, clusters/stress, load_cell/wrench, mocap/socket/pose, mocap/pylon/pose.
Publishes: estimate/force_map, estimate/wrench, estimate/local_forces, estimate/parameters
(latched), estimate/pressure_map, estimate/regions, /diagnostics. Service: estimator/fit.

It maps the forces on all tiles as soon as the clusters and the wrench of a trigger have arrived, if
anybody subscribes to a map. It predicts every synchronised sample with the newest model. It fits a
model on its window once enough steady data has arrived, or on request, in a separate process.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger as TriggerService
from visualization_msgs.msg import Marker

from socket_testbed.files import SOCKET_FILE, file_or_packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.fit import check_names
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import greyness
from socket_testbed.live.estimator import MEASURED, OnlineEstimator
from socket_testbed.live.fit_worker import FitWorker
from socket_testbed.nodes.base import NEWEST_STAMP, TestbedNode
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.wire import messages, topics
from socket_testbed.wire.cdr import blank, elements
from socket_testbed.wire.messages import named

_PICTURE_PERIOD = 100_000_000  # [ns]; RViz needs no more
_REGIONS_PERIOD = 500_000_000  # [ns]; joint draws take 15 ms
_ARROW_SCALE = 0.002  # [m/N]
_MAX_PRESSURE = 30e3  # [Pa]; end of the colour scale, normal pressure
_MIN_OPACITY = 0.1  # [-]
_LIFETIME = 3  # [s]; then the picture of a stopped estimator disappears

# Corners of a tile's two triangles, in half side lengths along its x and y. They face outwards,
# towards the viewer.
_CORNERS = ((-1, -1), (-1, 1), (1, 1), (-1, -1), (1, 1), (1, -1))


class EstimatorNode(TestbedNode[EstimatorSettings]):
    """Passes measurements to the online estimator and publishes its results.

    Subscribes: trigger; clusters/stress, normal stress and shears along the cluster's own axes
    [Pa]; load_cell/wrench in {S} [N, N m]; mocap/socket/pose and mocap/pylon/pose of the marker
    bodies in the world [m].

    Publishes, with the stamp of the trigger and in the frame load_cell, {S}, the maps only while
    anybody subscribes:

    - estimate/force_map: forces of the limb on all tiles and their standard deviations [N], normal
      pressure and shear [Pa];
    - estimate/wrench: the predicted wrench of the limb on the socket [N, N m];
    - estimate/local_forces: the predicted forces of the limb on all tiles [N];
    - estimate/regions, twice a second: mean and peak pressure, shear [Pa] and share of load [-];
    - estimate/pressure_map, ten times a second: markers for RViz.

    Publishes each new model on estimate/parameters, latched, with the stamp of its newest sample:
    stiffnesses [N/m] and rest positions [m] in {S}. Service: estimator/fit.
    """

    _geometry: SocketGeometry | None = None

    def __init__(self) -> None:
        super().__init__("estimator_node", EstimatorSettings)
        assert self._geometry is not None  # read with the settings
        self._worker = FitWorker()
        self._estimator = OnlineEstimator(
            self._geometry,
            lambda: self.settings,
            self._worker,
            self.sender(topics.PARAMETERS, messages.model_message),
            self._map_wanted,
        )
        self._picture = PressureMap(self._geometry)
        self._last_picture = 0  # [ns]
        names = self._geometry.names
        self._send_wrench = self.sender(topics.ESTIMATED_WRENCH, messages.wrench_packer())
        self._send_forces = self.sender(topics.LOCAL_FORCES, messages.local_forces_packer(names))
        self._force_map = self.advertise(topics.FORCE_MAP)
        self._pack_map = messages.force_map_packer(names)
        self._pressure_map = self.advertise(topics.PRESSURE_MAP)
        self._regions = self.advertise(topics.REGIONS)
        self._pack_regions = messages.regions_packer(
            [place.name for place in self._estimator.map.places]
        )
        self._last_regions = 0  # [ns]
        for topic in MEASURED:
            self.follow(topic, partial(self._on_measured, topic))
        self.follow(topics.TRIGGER, lambda stamp, sequence: self._estimator.trigger(stamp))
        self.serve(TriggerService, topics.Service.FIT, self._on_fit, slow=True)
        if self.settings.model:
            self._estimator.load(Path(self.settings.model))

    def _read_settings(self, changes: dict[str, Any]) -> EstimatorSettings:
        settings = super()._read_settings(changes)
        if self._geometry is None:
            self._geometry = read_socket(file_or_packaged(settings.geometry, SOCKET_FILE))
        check_names(settings.identification, tuple(self._geometry.clusters))
        return settings

    def close(self) -> None:
        """End the fit process and the service that waits for it."""
        self._worker.close()
        super().close()

    def figures(self) -> dict[str, object]:
        """The estimator's counts [1], and the newest stamp of a complete sample [ns]."""
        return {**self._estimator.figures(), NEWEST_STAMP: self._estimator.newest}

    def check(self) -> None:
        """Report the estimator's state."""
        self.report(*self._estimator.state)

    def ready(self) -> bool:
        """Whether the fit process runs."""
        return self._worker.ready

    def _on_measured(self, topic: topics.Topic, stamp: int, value: Any) -> None:
        """Publish what a measurement completes; its units are those of `OnlineEstimator.add`."""
        force_map, wrench, forces = self._estimator.add(topic, stamp, value)
        if force_map is not None:
            self._publish_map(stamp, force_map)
        if wrench is not None and forces is not None:
            self._send_wrench(stamp, wrench)
            self._send_forces(stamp, forces)

    def _map_wanted(self) -> bool:
        """Whether anybody subscribes to the maps; they take a fifth of the node's time."""
        maps = (self._force_map, self._pressure_map, self._regions)
        return any(publisher.get_subscription_count() > 0 for publisher in maps)

    def _publish_map(self, stamp: int, estimate: MapEstimate) -> None:
        """Publish a map with N = 1 at a stamp [ns], and, when due, its picture and its regions."""
        if self._force_map.get_subscription_count() > 0:
            self._force_map.publish(self._pack_map(stamp, estimate))
        due = abs(stamp - self._last_picture) >= _PICTURE_PERIOD
        if due and self._pressure_map.get_subscription_count() > 0:
            self._last_picture = stamp
            self._pressure_map.publish(self._picture.serialised(stamp, estimate))
        due = abs(stamp - self._last_regions) >= _REGIONS_PERIOD
        if due and self._regions.get_subscription_count() > 0:
            self._last_regions = stamp
            outputs = self._estimator.map.outputs()
            if outputs is not None:
                self._regions.publish(self._pack_regions(stamp, outputs.regions))

    def _on_fit(self) -> str:
        """Fit on the complete window; returns when it is done."""
        fit = self._estimator.fit()
        return f"fitted {fit.samples} samples; {fit.status}"


class PressureMap:
    """The markers of a force map in the frame load_cell, {S}: a square and an arrow per tile.

    The squares, of two triangles, have the areas of the tiles. An arrow of 2 mm per newton shows
    the force of the limb.
    """

    def __init__(self, geometry: SocketGeometry) -> None:
        self._anchors = geometry.anchors
        quaternions = Rotation.from_matrix(geometry.square_frames()).as_quat()
        shared = {"header": {"frame_id": messages.LOAD_CELL_FRAME}, "lifetime": {"sec": _LIFETIME}}
        markers: list[dict[str, Any]] = []
        for i, (anchor, quaternion) in enumerate(zip(self._anchors, quaternions, strict=True)):
            half = 0.5 * math.sqrt(geometry.areas[i])
            tile = {
                "ns": "tiles", "id": i, "type": Marker.TRIANGLE_LIST, "action": Marker.ADD,
                "pose": {"position": named(anchor), "orientation": named(quaternion)},
                "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
                "points": [{"x": half * x, "y": half * y} for x, y in _CORNERS],
            }  # fmt: skip
            arrow = {
                "ns": "forces", "id": i, "type": Marker.ARROW, "action": Marker.ADD,
                "scale": {"x": 0.002, "y": 0.004},
                "pose": {"orientation": {"w": 1.0}}, "points": [named(anchor)] * 2,
            }  # fmt: skip
            markers += [shared | tile, shared | arrow]
        self._content, numbers = blank(topics.PRESSURE_MAP.type, markers=markers)
        records = elements(numbers, "markers")
        self._stamps = [record["header"]["stamp"] for record in records]
        self._colours = [record["color"] for record in records]
        self._tips = [arrow["points"][1] for arrow in records[1::2]]

    def serialised(self, stamp: int, estimate: MapEstimate) -> bytes:
        """The serialised MarkerArray of a map: a tile and an arrow for each force.

        Colour shows the normal pressure, from pale to dark red at 30 kPa. Uncertain tiles fade
        where they turn grey on pages.

        Args:
            stamp: Stamp of the map since the epoch [ns].
            estimate: The map of one sample, N = 1: forces [N] and normal pressures [Pa].
        """
        tips = self._anchors + _ARROW_SCALE * estimate.forces[0]
        pressure = estimate.normal_pressure[0]
        shares = np.clip(pressure / _MAX_PRESSURE, 0.0, 1.0)
        opacities = 1.0 - (1.0 - _MIN_OPACITY) * greyness(pressure, estimate.pressure_reach[0])
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
