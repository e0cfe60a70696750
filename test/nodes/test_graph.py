"""The real graph: nodes in processes of their own, DDS between them, a subscriber outside."""

import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.srv import DescribeParameters
from std_srvs.srv import Trigger as TriggerService
from support import HANGS
from support.bags import copying
from support.graph import Probe
from support.problems import ring_socket
from support.verbs import COMMAND, Running, program

from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import write_socket
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.model_file import read_model
from socket_testbed.live.bringup import record_estimates
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.nodes.base import ELAPSED, FREE, TestbedNode
from socket_testbed.nodes.view_node import LiveSource
from socket_testbed.settings import testbed
from socket_testbed.settings.fields import Settings
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics
from socket_testbed.wire.cdr import decode
from socket_testbed.wire.messages import Reader, capacitance_packer, force_map_packer

pytestmark = pytest.mark.graph

NO_FIT = testbed.EstimatorSettings(auto_fit=False)


# --- what a replay estimates


@dataclass
class Replayed:
    """A trial with another geometry and tare, and what the nodes published of it."""

    trial: Trial
    bag: Path

    def read(self, topic: topics.Topic) -> list[Any]:
        """Values of a topic by the trial's stamps; there are no others."""
        reader, stamps = Reader(topic), self.trial.samples().stamps.tolist()
        with BagReader(self.bag) as bag:
            found = dict(reader.read(raw.data) for raw in bag.messages([f"/{topic.name}"]))
        assert set(found) == set(stamps)
        return [found[stamp] for stamp in stamps]


@pytest.fixture(scope="module")
def replayed(hold: Path, hold_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Replayed:
    """The first 20 s of the hold."""
    folder = tmp_path_factory.mktemp("replayed")
    short = folder / "short"
    with copying(hold, short) as (old, new):
        for raw in list(old.messages())[: 7 * 80]:
            new.write(raw.topic, raw.time, raw.data)
    own = Trial(short).geometry
    turned = dataclasses.replace(own, socket_markers=own.socket_markers[:, [1, 2, 0]])
    write_socket(turned, folder / "turned.yaml")
    trial, path = Trial(short, folder / "turned.yaml", tare="0:5"), folder / "replayed"
    settings = dataclasses.replace(NO_FIT, model=str(hold_model))
    record_estimates(trial, testbed.ReplaySettings(trial=str(short), rate=50.0), settings, path)
    return Replayed(trial, path)


def test_a_replay_publishes_its_model_once(replayed: Replayed) -> None:
    with BagReader(replayed.bag) as bag:
        assert bag.counts[f"/{topics.PARAMETERS.name}"] == 1


def test_a_replay_draws_two_markers_a_tile(replayed: Replayed) -> None:
    with BagReader(replayed.bag) as bag:
        (*_, picture) = bag.messages([f"/{topics.PRESSURE_MAP.name}"])
    drawn = decode(picture.data, picture.type).markers
    assert len(drawn) == 2 * len(replayed.trial.geometry)


@pytest.fixture(scope="module")
def regions(replayed: Replayed) -> tuple[tuple[str, ...], Any]:
    """Names and outputs of the regions, as published last."""
    reader = Reader(topics.REGIONS)
    with BagReader(replayed.bag) as bag:
        found = [reader.read(raw.data) for raw in bag.messages([f"/{topics.REGIONS.name}"])]
    return found[-1][1]


def test_a_replay_publishes_plausible_regions(replayed: Replayed, regions: Any) -> None:
    names, outputs = regions
    assert names == tuple(place.name for place in all_regions(replayed.trial.geometry))
    assert outputs.share.value[-1] == pytest.approx(1.0) and 1e3 < outputs.peak.value[-1] < 1e5


@pytest.mark.parametrize("output", ["mean", "peak", "shear", "share"])
def test_a_replay_s_intervals_hold_their_values(output: str, regions: Any) -> None:
    found = getattr(regions[1], output)
    assert (found.low <= found.value).all() and (found.value <= found.high).all()


def test_a_replay_recomputes_wrenches(replayed: Replayed) -> None:
    """By the tare that was given."""
    expected = replayed.trial.measurements().wrench
    np.testing.assert_array_equal(replayed.read(topics.WRENCH), expected)


def test_a_replay_recomputes_poses(replayed: Replayed) -> None:
    """By the geometry that was given."""
    expected = replayed.trial.measurements().socket
    np.testing.assert_array_equal(replayed.read(topics.SOCKET_POSE), expected)


def test_a_replay_predicts_as_offline(replayed: Replayed, hold_model: Path) -> None:
    model, pose = read_model(hold_model).model, replayed.trial.samples().pose
    wrench, forces = map(replayed.read, (topics.ESTIMATED_WRENCH, topics.LOCAL_FORCES))
    np.testing.assert_allclose(wrench, model.wrench(pose), atol=1e-9)
    np.testing.assert_allclose(forces, model.forces(pose), atol=1e-9)


@pytest.fixture(scope="module")
def running(replayed: Replayed) -> list[MapEstimate]:
    """The force map of a running mean of the evidence, by sample."""
    samples = replayed.trial.samples()
    force_map = ForceMap(replayed.trial.geometry, samples.clusters)
    return [force_map.update(samples[row : row + 1]) for row in range(len(samples))]


@pytest.mark.parametrize("name", ["forces", "standard_deviations", "normal_pressure"])
def test_a_replay_maps_as_offline(
    name: str, replayed: Replayed, running: list[MapEstimate]
) -> None:
    """The map asks for no marker."""
    maps = replayed.read(topics.FORCE_MAP)
    for (_, fields), expected in zip(maps, running, strict=True):
        np.testing.assert_allclose(fields[name], getattr(expected, name), atol=1e-9)


# --- how a replay goes


def test_a_replay_waits_for_its_follower(hold: Path) -> None:
    """It keeps no more ahead than writers send again: one that stands still misses nothing."""
    stamps = Trial(hold).samples().stamps.tolist()
    replay = testbed.ReplaySettings(trial=str(hold), rate=1000.0, wait_for=("follower",))
    with Probe() as probe, Graph() as graph:
        triggers = {topic: probe.listen(topic) for topic in topics.REQUIRED}[topics.TRIGGER]
        publisher = probe.node.create_publisher(DiagnosticArray, "/diagnostics", 10)

        def has_come(count: int, newest: int) -> bool:
            """Report the newest stamp as a follower does."""
            values = {"waiting_for": "", "newest_stamp": str(newest)}
            entries = [KeyValue(key=key, value=value) for key, value in values.items()]
            status = DiagnosticStatus(name="/follower", values=entries)
            publisher.publish(DiagnosticArray(status=[status]))
            return len(triggers) >= count

        graph.start("replay_node", replay)

        def assert_ahead(worked_off: int) -> None:
            ahead = worked_off + topics.PUBLISHER_DEPTH // 2 + 1
            newest = stamps[worked_off - 1] if worked_off else 0
            probe.wait(partial(has_come, ahead, newest), "what may be ahead")
            assert len(triggers) == ahead

        assert_ahead(0)
        assert_ahead(1)
        assert_ahead(60)
        probe.wait(partial(has_come, len(stamps), stamps[-1]), "the rest")
        graph.wait("replay_node")


def test_an_incomplete_last_sample_keeps_nobody_waiting(hold: Path, tmp_path: Path) -> None:
    """As 'ros2 bag record' leaves it."""
    with copying(hold, tmp_path / "cut") as (old, new):
        raws = list(old.messages())[: 7 * 12]
        while raws[-1].topic != f"/{topics.TRIGGER.name}":
            raws.pop()
        for raw in raws:
            new.write(raw.topic, raw.time, raw.data)
    code, _, err = program(*COMMAND, "replay", tmp_path / "cut", "--rate", 20, "--estimate")
    assert code == 0 and "not processed" not in err


def test_a_node_that_cannot_start_states_why() -> None:
    """A program with a node's name runs that node, as `ros2 run socket_testbed NODE` does."""
    words = ["/bin/calibration_node", "--ros-args", "-p", "calibration:=nowhere.yaml"]
    script = f"import sys; sys.argv = {words}; from socket_testbed.nodes.__main__ import main"
    code, _, error = program(sys.executable, "-c", f"{script}; main()")
    assert code == 1 and error.count("error: ") == 1 and "nowhere.yaml" in error, error


@pytest.mark.slow
def test_a_killed_command_leaves_no_node(hold: Path) -> None:
    command = [*COMMAND, "replay", str(hold), "--estimate"]
    with Running(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as replay:
        with Probe() as probe:
            probe.wait(lambda: bool(probe.said("estimator_node")), "the estimator")
        replay.kill()
        # The pipe closes when the last process that holds it has ended.
        replay.communicate(timeout=HANGS)


@pytest.fixture
def source() -> Iterator[tuple[Probe, LiveSource]]:
    """The source of a live page of the ring socket, which listens while a browser asks."""
    rclpy.init()
    with Probe() as probe:
        node = TestbedNode("page", Settings)
        source = LiveSource(node, ring_socket(), None)
        source.now(None)
        yield probe, source
        node.destroy_node()
    rclpy.shutdown()


def test_a_map_of_another_socket_is_named(source: tuple[Probe, LiveSource]) -> None:
    """And not drawn, even if it has as many tiles."""
    probe, page = source
    own = ring_socket()
    other = dataclasses.replace(own, names=tuple(reversed(own.names)))
    vectors, numbers = np.ones((1, len(own), 3)), np.full((1, len(own)), 5e3)
    estimate = MapEstimate(vectors, vectors, *[numbers] * 4, "measured: wrench")
    publisher = probe.publisher(topics.FORCE_MAP)

    def shows(geometry, drawn: bool) -> bool:
        publisher.publish(force_map_packer(geometry.names)(1, estimate))
        found = page.now(None)
        another = "another socket" in found["cards"][-1]["words"]
        return ("pressure" in found["moment"], another) == (drawn, not drawn)

    probe.wait(lambda: shows(own, True), "the map")
    probe.wait(lambda: shows(other, False), "that it is of another socket")


def test_a_minute_is_not_sixty_seconds(source: tuple[Probe, LiveSource]) -> None:
    _, page = source
    values = [KeyValue(key=ELAPSED, value="59.6"), KeyValue(key=FREE, value="1e9")]
    page._sensors["/recorder_node"] = DiagnosticStatus(values=values), page._asked_at
    page._trial = "walk", 0.0
    assert "0:60" not in page._recording()["words"]


def test_a_page_that_nobody_asks_listens_no_more(source: tuple[Probe, LiveSource]) -> None:
    _, page = source
    page._asked_at -= 60.0
    page.unsubscribe_if_idle()
    assert page._inbox is None


# --- one graph for what follows: its nodes would answer beside those above


@pytest.fixture(scope="module")
def estimating() -> Iterator[tuple[Graph, Probe]]:
    """A calibration and an estimator node in the time of a replay, and what another hears."""
    with Graph() as graph, Probe() as probe:
        calibration = testbed.CalibrationNodeSettings()
        for node, settings in (("calibration_node", calibration), ("estimator_node", NO_FIT)):
            graph.start_nodes([GraphNode(node, settings, use_sim_time=True)])
        yield graph, probe


def test_the_calibration_node_names_an_unknown_cluster(estimating) -> None:
    _, probe = estimating
    stresses = probe.listen(topics.STRESS)
    publisher = probe.publisher(topics.CAPACITANCE)
    pack = capacitance_packer(("brim_lateral", "unknown"))
    data = pack(7 * 10**9, np.full((2, 4), 5.2), np.zeros((2, 4), np.uint8))

    def send_until_heard() -> bool:
        publisher.publish(data[:-9])  # of another layout: reported and dropped
        publisher.publish(data)
        return bool(stresses and probe.said("calibration_node", "no calibration for unknown"))

    probe.wait(send_until_heard, "stresses and a diagnostics message")
    assert probe.said("calibration_node")[-1].level == DiagnosticStatus.ERROR
    probe.node.destroy_publisher(publisher)  # no replay would begin beside it
    assert stresses[0].header.stamp.sec == 7
    known, unknown = stresses[0].clusters
    assert known.status == 0 and np.isfinite([known.normal, known.shear_x, known.shear_y]).all()
    assert unknown.status == 2 and np.isnan(unknown.normal)


def test_parameters_are_described(estimating) -> None:
    _, probe = estimating
    request = DescribeParameters.Request(names=["identification.theta"])
    service = "estimator_node/describe_parameters"
    (described,) = probe.call(DescribeParameters, service, request).descriptors
    (bounds,) = described.floating_point_range
    assert "wrench" in described.description and (bounds.from_value, bounds.to_value) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("theta", 1.5, ""),  # the middleware's own words
        ("theta", -0.5, ""),
        ("solver", "osqqp", "did you mean 'osqp'?"),
        ("leave_out", ["distal.Fq"], "no channel 'distal.Fq'"),
        ("leave_out", None, "cannot be deleted: set it to another value"),
    ],
    ids=["too high", "too low", "misspelt", "unknown channel", "deleted"],
)
def test_a_wrong_parameter_is_refused(estimating, name: str, value: Any, reason: str) -> None:
    _, probe = estimating
    (refusal,) = probe.refusals("estimator_node", **{f"identification__{name}": value})
    assert refusal and reason in refusal


@pytest.mark.parametrize("theta", [0.25, 1, 0.5])
def test_a_parameter_changes_at_run_time(estimating, theta: float) -> None:
    """A whole number is a number."""
    _, probe = estimating
    assert not probe.refusals("estimator_node", identification__theta=theta)


def test_a_fit_that_was_asked_for_predicts(hold: Path, estimating) -> None:
    """The map needs no model."""
    graph, probe = estimating
    outputs = (topics.FORCE_MAP, topics.PARAMETERS, topics.ESTIMATED_WRENCH)
    maps, models, wrenches = map(probe.listen, outputs)
    answer = probe.call(TriggerService, "estimator/fit", TriggerService.Request())
    assert not answer.success and "no complete sample" in answer.message
    # Each round starts the window anew: one lasts long enough for 60 samples and the fit.
    ready = ("calibration_node", "estimator_node")
    replay = testbed.ReplaySettings(trial=str(hold), rate=4.0, wait_for=ready, loop=True)
    graph.start("replay_node", replay)
    probe.wait(lambda: probe.figure("estimator_node", "window") > 60, "samples")
    probe.wait(lambda: bool(maps), "a map")
    assert not models and not wrenches
    answer = probe.call(TriggerService, "estimator/fit", TriggerService.Request())
    assert answer.success, answer.message
    probe.wait(lambda: len(models) == 1 and len(wrenches) > 50, "predictions")
    assert models[0].samples > 50 and "KKT" in models[0].solver_status
    probe.listen(topics.PARAMETERS)
    probe.wait(lambda: len(models) == 2, "the model for a late subscriber")
    assert models[1] == models[0]
