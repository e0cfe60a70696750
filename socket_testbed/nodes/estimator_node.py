"""Estimator node: measurements to a force map, samples to predicted wrench and local forces.

Subscribes: trigger, clusters/stress, load_cell/wrench, mocap/socket/pose, mocap/pylon/pose.
Publishes: estimate/force_map, estimate/wrench, estimate/local_forces, estimate/parameters
(latched), estimate/pressure_map, /diagnostics. Service: estimator/fit.

It maps the forces on all tiles as soon as the clusters and the wrench of a trigger are in.
It predicts every synchronised sample with the newest model. It fits on its window by itself
when enough steady data is in, or on request; a fit runs in a process of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger as TriggerService

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.live.estimator import Estimate, OnlineEstimator, OnlineMap
from socket_testbed.live.fit_worker import FitWorker
from socket_testbed.nodes.base import NEWEST_STAMP, TestbedNode
from socket_testbed.nodes.conversions import (
    MessageReader,
    pose_reader,
    stress_reader,
    trigger_reader,
    wrench_packer,
    wrench_reader,
)
from socket_testbed.nodes.estimate_messages import (
    ForceMapPacker,
    PressureMap,
    fit_to_ros,
    local_forces_packer,
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
_READERS: dict[Topic, Callable[[], MessageReader[Any]]] = {
    STRESS: stress_reader,
    WRENCH: wrench_reader,
    SOCKET_POSE: pose_reader,
    PYLON_POSE: pose_reader,
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
        self._pack_map = ForceMapPacker(self._geometry.names).packed
        self._pack_wrench = wrench_packer()
        self._pack_forces = cache(local_forces_packer)  # by the names of the points
        self._picture = PressureMap(self._geometry)
        self._drawn = 0  # [ns]; stamp of the last picture
        self._wrench = self.advertise(ESTIMATED_WRENCH)
        self._forces = self.advertise(LOCAL_FORCES)
        self._model = self.advertise(PARAMETERS)
        self._force_map = self.advertise(FORCE_MAP)
        self._pressure_map = self.advertise(PRESSURE_MAP)
        for topic, reader in _READERS.items():
            self.listen(topic, partial(self._on_measured, topic, reader()), raw=True)
        self._triggers = trigger_reader()
        self.listen(TRIGGER, self._on_trigger, raw=True)
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

    def _on_trigger(self, data: bytes) -> None:
        if self._estimator.trigger(self._triggers.read(data)[0]):
            self._online_map.clear()

    def _on_measured(self, topic: Topic, reader: MessageReader[Any], data: bytes) -> None:
        stamp, value = reader.read(data)
        found = self._online_map.add(topic, stamp, value)
        if found is not None:
            self._publish_map(stamp, found)
        estimate = self._estimator.add(topic, stamp, value)
        if estimate is not None:
            self._publish_estimate(estimate)

    def _publish_map(self, stamp: int, estimate: MapEstimate) -> None:
        self._force_map.publish(self._pack_map(stamp, estimate))
        due = abs(stamp - self._drawn) >= _PICTURE_PERIOD
        if due and self._pressure_map.get_subscription_count() > 0:
            self._drawn = stamp
            self._pressure_map.publish(self._picture.serialised(stamp, estimate))

    def _publish_estimate(self, estimate: Estimate) -> None:
        stamp, model = estimate.stamp, estimate.model
        self._wrench.publish(self._pack_wrench(stamp, estimate.wrench))
        self._forces.publish(self._pack_forces(model.names)(stamp, estimate.forces))

    def _on_model(self, model: Fit | StoredModel) -> None:
        message = fit_to_ros(model) if isinstance(model, Fit) else stored_model_to_ros(model)
        self._model.publish(message)

    def _on_fit(self) -> str:
        """Fit on the complete window, and answer when it is done."""
        fit = self._estimator.fit()
        return f"fitted {fit.samples} samples; {fit.status}"
