"""Estimator node: synchronised samples to predicted wrench and local forces.

Subscribes: trigger, clusters/stress, load_cell/wrench, mocap/socket/pose, mocap/pylon/pose.
Publishes: estimate/wrench, estimate/local_forces, estimate/parameters (latched),
estimate/pressure_map, /diagnostics. Service: estimator/fit.

It predicts every synchronised sample with the newest model. It fits on its window by itself
when enough steady data is in, or on request; a fit runs in a process of its own.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger as TriggerService

from socket_testbed.errors import TestbedError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.live.estimator import Estimate, OnlineEstimator
from socket_testbed.live.fit_worker import FitWorker
from socket_testbed.nodes.conversions import (
    LOAD_CELL_FRAME,
    PressureMap,
    fit_to_ros,
    header_to_ros,
    local_forces_to_ros,
    pose_from_ros,
    stamp_from_ros,
    stored_model_to_ros,
    stress_from_ros,
    wrench_from_ros,
    wrench_to_ros,
)
from socket_testbed.nodes.diagnostics import LEVELS, NEWEST_STAMP, Diagnostics
from socket_testbed.nodes.parameters import Parameters
from socket_testbed.nodes.runtime import (
    BlockingService,
    message_type,
    publisher_qos,
    run_node,
    subscriber_qos,
)
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import (
    ESTIMATED_WRENCH,
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

_MAP_PERIOD = 100_000_000  # [ns]; RViz needs no more
_FROM_ROS = {
    STRESS: stress_from_ros,
    WRENCH: lambda message: wrench_from_ros(message.wrench),
    SOCKET_POSE: lambda message: pose_from_ros(message.pose),
    PYLON_POSE: lambda message: pose_from_ros(message.pose),
}


class EstimatorNode(Node):
    """Hands measurements to the online estimator and publishes what it returns."""

    def __init__(self) -> None:
        super().__init__("estimator_node")
        self.finished = Future()
        self._adjustable = Parameters(self, EstimatorSettings)
        settings = self._adjustable.settings
        self._geometry = read_socket(
            Path(settings.geometry) if settings.geometry else packaged("config", "socket.yaml")
        )
        self._map_stamp = 0
        self._drawn: tuple[ContactModel, PressureMap] | None = None
        self._worker = FitWorker()

        self._wrench = self._publisher(ESTIMATED_WRENCH)
        self._forces = self._publisher(LOCAL_FORCES)
        self._model_publisher = self._publisher(PARAMETERS)
        self._map = self._publisher(PRESSURE_MAP)
        self._estimator = OnlineEstimator(
            self._geometry, lambda: self._adjustable.settings, self._worker, self._on_model
        )
        inputs = [self._subscribe(topic, partial(self._on_measured, topic)) for topic in _FROM_ROS]
        inputs.append(self._subscribe(TRIGGER, self._on_trigger))
        self._service = BlockingService(self, TriggerService, "estimator/fit", self._on_fit)
        self._diagnostics = Diagnostics(
            self,
            lambda: {**self._estimator.figures(), NEWEST_STAMP: self._estimator.newest},
            inputs=tuple(inputs),
            offered=(self._wrench, self._forces, self._model_publisher, self._map),
            ready=lambda: self._worker.ready,
            look=self._look,
        )
        if settings.model:
            self._estimator.load(Path(settings.model))

    def close(self) -> None:
        """End the process of the fits and the service that waits for them."""
        self._worker.close()
        self._service.close()

    def _publisher(self, topic: Topic) -> Any:
        return self.create_publisher(message_type(topic), topic.name, publisher_qos(topic))

    def _subscribe(self, topic: Topic, callback: Any) -> Any:
        return self.create_subscription(
            message_type(topic), topic.name, callback, subscriber_qos(topic)
        )

    def _look(self) -> None:
        level, message = self._estimator.state
        self._diagnostics.report(LEVELS[level], message)

    def _on_trigger(self, message: Any) -> None:
        self._estimator.trigger(stamp_from_ros(message.header.stamp))

    def _on_measured(self, topic: Topic, message: Any) -> None:
        stamp = stamp_from_ros(message.header.stamp)
        estimate = self._estimator.add(topic, stamp, _FROM_ROS[topic](message))
        if estimate is not None:
            self._publish(estimate)

    def _publish(self, estimate: Estimate) -> None:
        stamp, model = estimate.stamp, estimate.model
        header = header_to_ros(stamp, LOAD_CELL_FRAME)
        self._wrench.publish(WrenchStamped(header=header, wrench=wrench_to_ros(estimate.wrench)))
        self._forces.publish(local_forces_to_ros(stamp, model.names, estimate.forces))
        due = abs(stamp - self._map_stamp) >= _MAP_PERIOD
        if due and self._map.get_subscription_count() > 0:
            self._map_stamp = stamp
            if self._drawn is None or self._drawn[0] is not model:
                self._drawn = (model, PressureMap(model, self._geometry.areas))
            self._map.publish(self._drawn[1].markers(stamp, estimate.forces))

    def _on_model(self, model: Fit | StoredModel) -> None:
        message = fit_to_ros(model) if isinstance(model, Fit) else stored_model_to_ros(model)
        self._model_publisher.publish(message)

    def _on_fit(
        self, request: TriggerService.Request, response: TriggerService.Response
    ) -> TriggerService.Response:
        """Fit on the complete window, and answer when it is done, in the service's thread."""
        del request
        try:
            fit = self._estimator.fit()
        except TestbedError as error:
            response.message = str(error)
            return response
        response.success = True
        response.message = f"fitted {fit.samples} samples; {fit.status}"
        return response


def main() -> None:
    """Run the node."""
    run_node(EstimatorNode)


if __name__ == "__main__":
    main()
