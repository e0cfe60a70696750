"""Estimator node: synchronised samples to predicted wrench and local forces.

Subscribes: trigger, clusters/stress, load_cell/wrench, mocap/socket/pose, mocap/pylon/pose.
Publishes: estimate/wrench, estimate/local_forces, estimate/parameters (latched),
estimate/pressure_map, /diagnostics. Service: estimator/fit.

It predicts every synchronised sample with the newest model. It fits on its window by itself
when enough steady data is in, or when it is asked to; a fit runs in a process of its own.
"""

from __future__ import annotations

from concurrent.futures import CancelledError
from concurrent.futures import Future as WorkerFuture
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger as TriggerService

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.model_file import read_model
from socket_testbed.live.estimator import Sample, SampleWindow, StampSynchroniser
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
from socket_testbed.nodes.diagnostics import ERROR, NEWEST_STAMP, OK, WARN, Diagnostics
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
_MEASURED = {
    STRESS: stress_from_ros,
    WRENCH: lambda message: wrench_from_ros(message.wrench),
    SOCKET_POSE: lambda message: pose_from_ros(message.pose),
    PYLON_POSE: lambda message: pose_from_ros(message.pose),
}


class EstimatorNode(Node):
    """Predicts every synchronised sample with the newest model."""

    def __init__(self) -> None:
        super().__init__("estimator_node")
        self.finished = Future()
        self._adjustable = Parameters(self, EstimatorSettings)
        settings = self._adjustable.settings
        path = settings.geometry
        self._geometry = read_socket(Path(path) if path else packaged("config", "socket.yaml"))
        self._clusters = tuple(self._geometry.clusters)
        kinds = tuple(topic.name for topic in _MEASURED)
        self._synchroniser = StampSynchroniser(kinds, settings.window.pending)
        self._window = SampleWindow(self._clusters, settings.window.duration)
        self._model: ContactModel | None = None
        self._running: WorkerFuture[Fit | None] | None = None
        self._since_attempt = 0
        self._newest = 0
        self._last_trigger = 0
        self._map_stamp = 0
        self._drawn: tuple[ContactModel, PressureMap] | None = None
        self._counts = {"triggers": 0, "samples": 0, "predictions": 0, "fits": 0}
        self._worker = FitWorker()

        self._wrench = self._publisher(ESTIMATED_WRENCH)
        self._forces = self._publisher(LOCAL_FORCES)
        self._model_publisher = self._publisher(PARAMETERS)
        self._map = self._publisher(PRESSURE_MAP)
        inputs = [self._subscribe(topic, partial(self._on_measured, topic)) for topic in _MEASURED]
        inputs.append(self._subscribe(TRIGGER, self._on_trigger))
        self._service = BlockingService(self, TriggerService, "estimator/fit", self._on_fit)
        self._diagnostics = Diagnostics(
            self,
            self._values,
            inputs=tuple(inputs),
            offered=(self._wrench, self._forces, self._model_publisher, self._map),
            ready=lambda: self._worker.ready,
        )
        self._diagnostics.report(WARN, "no model yet: waiting for steady data or estimator/fit")
        if settings.model:
            self._load(Path(settings.model))

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

    def _values(self) -> dict[str, object]:
        return {
            **self._counts,
            "incomplete": self._synchroniser.incomplete,
            "window": len(self._window),
            NEWEST_STAMP: self._newest,
        }

    def _load(self, path: Path) -> None:
        stored = read_model(path)
        if not stored.geometry.same_tiles(self._geometry):
            raise ConfigurationError(
                f"{path}: was fitted on another socket than this geometry",
                "give the socket.yaml of its trial, or a model of this socket",
            )
        self._model = stored.model
        self._model_publisher.publish(stored_model_to_ros(stored))
        self._diagnostics.report(OK, f"predicting with the model of {stored.trial}")

    def _on_trigger(self, message: Any) -> None:
        stamp = stamp_from_ros(message.header.stamp)
        if stamp < self._last_trigger:
            self._start_over()
        self._last_trigger = stamp
        self._counts["triggers"] += 1

    def _start_over(self) -> None:
        """A jump back in time: what was measured after it says nothing about now."""
        self._synchroniser.clear()
        self._window.clear()
        self._newest = 0

    def _on_measured(self, topic: Topic, message: Any) -> None:
        stamp = stamp_from_ros(message.header.stamp)
        complete = self._synchroniser.add(topic.name, stamp, _MEASURED[topic](message))
        if complete is not None:
            self._on_sample(stamp, complete)

    def _on_sample(self, stamp: int, measured: dict[str, Any]) -> None:
        sample = self._to_sample(stamp, measured)
        self._counts["samples"] += 1
        if self._model is not None:
            self._predict(self._model, sample)
        self._newest = max(self._newest, stamp)
        self._window.add(sample)
        self._fit_by_itself()

    def _to_sample(self, stamp: int, measured: dict[str, Any]) -> Sample:
        poses = [measured[topic.name][None] for topic in (SOCKET_POSE, PYLON_POSE)]
        socket, pylon = (Pose.from_quaternion(pose[:, :3], pose[:, 3:]) for pose in poses)
        missing = (np.full(3, np.nan), 2)
        stresses = [measured[STRESS.name].get(name, missing) for name in self._clusters]
        return Sample(
            stamp=stamp,
            position=self._geometry.limb_position(socket, pylon)[0],
            wrench=measured[WRENCH.name],
            local_forces=np.array(
                [
                    self._geometry.cluster_force(name, stress)
                    for name, (stress, _) in zip(self._clusters, stresses, strict=True)
                ]
            ),
            status=np.array([status for _, status in stresses], dtype=np.uint8),
        )

    def _predict(self, model: ContactModel, sample: Sample) -> None:
        wrench, forces = model.predict(sample.position[None])
        header = header_to_ros(sample.stamp, LOAD_CELL_FRAME)
        self._wrench.publish(WrenchStamped(header=header, wrench=wrench_to_ros(wrench[0])))
        self._forces.publish(local_forces_to_ros(sample.stamp, model.names, forces[0]))
        self._counts["predictions"] += 1
        due = abs(sample.stamp - self._map_stamp) >= _MAP_PERIOD
        if due and self._map.get_subscription_count() > 0:
            self._map_stamp = sample.stamp
            if self._drawn is None or self._drawn[0] is not model:
                self._drawn = (model, PressureMap(model, self._geometry.areas))
            self._map.publish(self._drawn[1].markers(sample.stamp, forces[0]))

    def _fit_by_itself(self) -> None:
        settings = self._adjustable.settings
        self._since_attempt += 1
        due = settings.window.refit_after if self._model is not None else 10
        if (
            settings.auto_fit
            and self._running is None
            and due > 0
            and self._since_attempt >= due
            and len(self._window) >= settings.window.least_samples
        ):
            self._start_fit(on_plateau=True)

    def _start_fit(self, on_plateau: bool) -> WorkerFuture[Fit | None]:
        settings = self._adjustable.settings
        self._since_attempt = 0
        self._running = self._worker.submit(
            self._window.samples(),
            self._geometry,
            settings.identification,
            settings.plateau if on_plateau else None,
            settings.window.least_samples,
        )
        self._running.add_done_callback(self._on_fitted)
        return self._running

    def _on_fitted(self, future: WorkerFuture[Fit | None]) -> None:
        """Take a model over; called in a thread of the worker's."""
        self._running = None
        if future.cancelled():
            return
        try:
            fit = future.result()
        except (TestbedError, BrokenProcessPool) as error:
            self._diagnostics.report(ERROR, f"no fit: {error}")
            return
        if fit is None:
            return
        self._model = fit.model
        self._counts["fits"] += 1
        self._model_publisher.publish(fit_to_ros(fit))
        self._diagnostics.report(
            OK,
            f"model {fit.model.variant} from {fit.samples} samples, "
            f"{fit.determined:.0f} of {fit.model.stiffness.size} directions determined",
        )

    def _on_fit(
        self, request: TriggerService.Request, response: TriggerService.Response
    ) -> TriggerService.Response:
        """Fit on the whole window, and answer when it is done, in the service's thread."""
        del request
        if self._running is not None:
            response.message = "a fit is running already: ask again when it is done"
            return response
        try:
            fit = self._start_fit(on_plateau=False).result()
        except (TestbedError, CancelledError, BrokenProcessPool) as error:
            response.message = str(error) or "the node ends"
            return response
        response.success = fit is not None
        response.message = f"fitted {fit.samples} samples; {fit.status}" if fit else "no fit"
        return response


def main() -> None:
    """Run the node."""
    run_node(EstimatorNode)


if __name__ == "__main__":
    main()
