"""The estimator node without a graph: what it publishes of the scene, and how often."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scene
from support.nodes import Catcher, Maker, running_ros

from socket_testbed.geometry.socket import write_socket
from socket_testbed.nodes import estimator_node
from socket_testbed.wire import topics

PERIOD = 50_000_000  # [ns]; 20 Hz


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with running_ros():
        yield


class NoFits:
    """Stands for the worker process: nothing is fitted here."""

    ready = True

    def run(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        return Future()

    def close(self) -> None: ...


@pytest.fixture
def make(make: Maker, monkeypatch: pytest.MonkeyPatch) -> Maker:
    scene.stand_in(monkeypatch)
    monkeypatch.setattr(estimator_node, "FitWorker", NoFits)
    return make


@pytest.fixture
def node(make: Maker, tmp_path: Path) -> estimator_node.EstimatorNode:
    write_socket(scene.geometry(), tmp_path / "socket.yaml")
    model = scene.model(tmp_path / "model.json", "hold")
    return make(estimator_node.EstimatorNode, geometry=tmp_path / "socket.yaml", model=model)


def measure(node: estimator_node.EstimatorNode, stamp: int, poses: bool = False) -> None:
    """Clusters under 10 kPa and the wrench of the peak; with the poses of bodies that rest."""
    stress = dict.fromkeys(scene.CLUSTERS, ((1e4, 0.0, 0.0), 0))
    node._on_measured(topics.STRESS, stamp, stress)
    node._on_measured(topics.WRENCH, stamp, scene.wrench()[scene.PEAK_ROW])
    for topic in topics.POSES.values() if poses else ():
        node._on_measured(topic, stamp, np.eye(7)[6])


def test_a_sample_gives_the_known_predictions(
    node: estimator_node.EstimatorNode, make: Maker
) -> None:
    """The model of the scene predicts its offsets: [M; F] (0.55, 1.1, 0.5, 14, 3, -100)."""
    measure(node, scene.START, poses=True)
    (message,) = make.sent["estimate/wrench"]
    torque, force = message.wrench.torque, message.wrench.force
    assert (torque.x, torque.y, torque.z) == pytest.approx((0.55, 1.1, 0.5))
    assert (force.x, force.y, force.z) == pytest.approx((14.0, 3.0, -100.0))
    (forces,) = make.sent["estimate/local_forces"]
    assert tuple(forces.names) == scene.TILES and forces.forces[0].z == 0.0
    assert node.figures()["newest_stamp"] == scene.START and node.figures()["maps"] == 1


def test_the_stored_model_is_published(node: estimator_node.EstimatorNode, make: Maker) -> None:
    (message,) = make.sent["estimate/parameters"]
    assert message.variant == "stiffness_bias" and message.samples == 96
    assert list(message.bias_names) == ["mid_anterior"]
    assert (message.force_bias[0].x, message.force_bias[0].z) == (-2.7, -36.0)
    rmse = message.wrench_rmse
    assert (rmse.torque.x, rmse.torque.z, rmse.force.x, rmse.force.z) == (0.1, 0.3, 1.0, 3.0)
    node.check()
    assert make.state() == (0, "predicting with the model of hold")
    assert node.ready() and node.get_name() == "estimator_node"


def test_pictures_and_regions_are_sent_less_often(
    node: estimator_node.EstimatorNode, make: Maker
) -> None:
    """At 20 Hz: every map, of the pictures 10 a second, of the regions 2 a second."""
    for number in range(21):
        measure(node, scene.START + number * PERIOD)
    assert len(make.sent["estimate/force_map"]) == 21
    assert len(make.sent["estimate/pressure_map"]) == 11
    assert len(make.sent["estimate/regions"]) == 3
    assert make.sent["estimate/wrench"] == []
    stamps = [m.header.stamp.nanosec for m in make.sent["estimate/regions"]]
    assert stamps == [0, 500_000_000, 0]


def test_maps_are_made_for_subscribers_alone(
    node: estimator_node.EstimatorNode, make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Catcher, "get_subscription_count", lambda self: 0)
    measure(node, scene.START, poses=True)
    assert make.sent["estimate/force_map"] == [] and node.figures()["maps"] == 0
    assert len(make.sent["estimate/wrench"]) == 1
    of_pictures = {"estimate/pressure_map"}
    monkeypatch.setattr(
        Catcher, "get_subscription_count", lambda self: self.topic_name in of_pictures
    )
    measure(node, scene.START + PERIOD)
    assert len(make.sent["estimate/pressure_map"]) == node.figures()["maps"] == 1
    assert make.sent["estimate/force_map"] == make.sent["estimate/regions"] == []


def test_a_picture_s_markers_vanish_after_three_seconds(
    node: estimator_node.EstimatorNode, make: Maker
) -> None:
    measure(node, scene.START)
    markers = make.sent["estimate/pressure_map"][0].markers
    assert len(markers) == 24 and {m.lifetime.sec for m in markers} == {3}
    assert {m.action for m in markers} == {0} and {m.ns for m in markers} == {"tiles", "forces"}
    arrow = next(m for m in markers if m.ns == "forces")
    assert (arrow.scale.x, arrow.scale.y, arrow.pose.orientation.w) == (0.002, 0.004, 1.0)


def test_a_jump_back_gives_pictures_again(node: estimator_node.EstimatorNode, make: Maker) -> None:
    measure(node, scene.START + 10**9)
    measure(node, scene.START)
    assert len(make.sent["estimate/pressure_map"]) == len(make.sent["estimate/regions"]) == 2


def test_a_fit_on_request_answers_in_words(
    node: estimator_node.EstimatorNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Fitted:
        samples, status = 80, "solved"

    monkeypatch.setattr(node._estimator, "fit", lambda: Fitted)
    assert node._on_fit() == "fitted 80 samples; solved"
