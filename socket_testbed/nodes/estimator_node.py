"""Estimator node: measurements to a force map, samples to predicted wrench and local forces.

Subscribes: trigger, clusters/stress, load_cell/wrench, mocap/socket/pose, mocap/pylon/pose.
Publishes: estimate/force_map, estimate/wrench, estimate/local_forces, estimate/parameters
(latched), estimate/pressure_map, /diagnostics. Service: estimator/fit.

It maps the forces on all tiles as soon as the clusters and the wrench of a trigger are in.
It predicts every synchronised sample with the newest model. It fits on its window by itself
when enough steady data is in, or on request; a fit runs in a process of its own.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import WrenchStamped
from std_srvs.srv import Trigger as TriggerService

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.live.estimator import Estimate, OnlineEstimator
from socket_testbed.live.fit_worker import FitWorker
from socket_testbed.live.online_map import OnlineMap
from socket_testbed.nodes.base import NEWEST_STAMP, TestbedNode
from socket_testbed.nodes.conversions import (
    LOAD_CELL_FRAME,
    header_to_ros,
    pose_from_ros,
    stamp_from_ros,
    stress_from_ros,
    wrench_from_ros,
    wrench_to_ros,
)
from socket_testbed.nodes.estimate_messages import (
    ForceMapMessage,
    PressureMap,
    fit_to_ros,
    local_forces_to_ros,
    stored_model_to_ros,
)
from socket_testbed.settings.identification import check_solver
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import (
    ESTIMATED_WRENCH,
    FORCE_MAP,
    LOCAL_FORCES,
    PARAMETERS,
    PRESSURE_MAP,
    PYLON_POSE,
    SOCKET_POSE,
    STRESS,
    TRIGGER,
    WRENCH,
    Topic,
)

_PICTURE_PERIOD = 100_000_000  # [ns]; RViz needs no more
_FROM_ROS = {
    STRESS: stress_from_ros,
    WRENCH: lambda message: wrench_from_ros(message.wrench),
    SOCKET_POSE: lambda message: pose_from_ros(message.pose),
    PYLON_POSE: lambda message: pose_from_ros(message.pose),
}


class EstimatorNode(TestbedNode[EstimatorSettings]):
    """Hands measurements to the online estimator and publishes what it returns."""

    def __init__(self) -> None:
        super().__init__("estimator_node", EstimatorSettings)
        path = self.settings.geometry
        self._geometry = read_socket(Path(path) if path else packaged("config", "socket.yaml"))
        self._worker = FitWorker()
        self._estimator = OnlineEstimator(
            self._geometry, lambda: self.settings, self._worker, self._on_model
        )
        self._online_map = OnlineMap(self._geometry, lambda: self.settings)
        self._force_map_message = ForceMapMessage(self._geometry.names)
        self._picture = PressureMap(self._geometry)
        self._drawn = 0  # [ns]; stamp of the last picture
        self._wrench = self.advertise(ESTIMATED_WRENCH)
        self._forces = self.advertise(LOCAL_FORCES)
        self._model = self.advertise(PARAMETERS)
        self._force_map = self.advertise(FORCE_MAP)
        self._pressure_map = self.advertise(PRESSURE_MAP)
        for topic in _FROM_ROS:
            self.listen(topic, partial(self._on_measured, topic))
        self.listen(TRIGGER, self._on_trigger)
        self.serve(TriggerService, "estimator/fit", self._on_fit, slow=True)
        if self.settings.model:
            self._estimator.load(Path(self.settings.model))

    def _read_settings(self, changes: dict[str, Any]) -> EstimatorSettings:
        settings = super()._read_settings(changes)
        check_solver(settings.identification.solver)
        return settings

    def close(self) -> None:
        """End the process of the fits and the service that waits for them."""
        self._worker.close()
        super().close()

    def figures(self) -> dict[str, object]:
        """The estimator's counts, and the newest stamp."""
        maps = self._online_map.count
        return {**self._estimator.figures(), "maps": maps, NEWEST_STAMP: self._estimator.newest}

    def look(self) -> None:
        """Report the estimator's state."""
        self.report(*self._estimator.state)

    def ready(self) -> bool:
        """Whether the process of the fits runs."""
        return self._worker.ready

    def _on_trigger(self, message: Any) -> None:
        if self._estimator.trigger(stamp_from_ros(message.header.stamp)):
            self._online_map.clear()

    def _on_measured(self, topic: Topic, message: Any) -> None:
        stamp = stamp_from_ros(message.header.stamp)
        value = _FROM_ROS[topic](message)
        found = self._online_map.add(topic, stamp, value)
        if found is not None:
            self._publish_map(stamp, found)
        estimate = self._estimator.add(topic, stamp, value)
        if estimate is not None:
            self._publish_estimate(estimate)

    def _publish_map(self, stamp: int, estimate: MapEstimate) -> None:
        self._force_map.publish(self._force_map_message.filled(stamp, estimate))
        due = abs(stamp - self._drawn) >= _PICTURE_PERIOD
        if due and self._pressure_map.get_subscription_count() > 0:
            self._drawn = stamp
            self._pressure_map.publish(self._picture.markers(stamp, estimate))

    def _publish_estimate(self, estimate: Estimate) -> None:
        stamp, model = estimate.stamp, estimate.model
        header = header_to_ros(stamp, LOAD_CELL_FRAME)
        self._wrench.publish(WrenchStamped(header=header, wrench=wrench_to_ros(estimate.wrench)))
        self._forces.publish(local_forces_to_ros(stamp, model.names, estimate.forces))

    def _on_model(self, model: Fit | StoredModel) -> None:
        message = fit_to_ros(model) if isinstance(model, Fit) else stored_model_to_ros(model)
        self._model.publish(message)

    def _on_fit(self) -> str:
        """Fit on the complete window, and answer when it is done."""
        fit = self._estimator.fit()
        return f"fitted {fit.samples} samples; {fit.status}"
