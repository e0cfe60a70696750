"""The align node without a graph: the numbers that it publishes, its tare, what it refuses."""

import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from support import HANGS
from support.foreign import header, pose_fields, wrench_fields
from support.graph import Probe
from support.nodes import Maker, running_ros
from support.wording import refused

from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.nodes.align_node import AlignNode
from socket_testbed.nodes.foreign_topics import ForeignTopic, matching_qos, type_class
from socket_testbed.nodes.trigger_node import TriggerNode
from socket_testbed.trials.bag import RawMessage
from socket_testbed.wire import cdr
from socket_testbed.wire.cdr import stamp_of
from socket_testbed.wire.topics import Topic

START, STEP = 1_700_000_000_000_000_000, 10_000_000  # [ns]
WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
OK, WARN, ERROR = 0, 1, 2


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with running_ros():
        yield


def until(condition: Callable[[], bool]) -> None:
    """Wait for the thread of a node."""
    deadline = time.monotonic() + HANGS
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def message(kind: str, stamp: int, **fields: Any) -> RawMessage:
    content = cdr.make_message(kind, header=header(stamp, "rig"), **fields)
    return RawMessage("/x", kind, stamp, cdr.encode(content, kind))


def wrenches(value: np.ndarray, start: int = START, count: int = 101) -> list[RawMessage]:
    times = [start + row * STEP for row in range(count)]
    return [message(WRENCH, stamp, wrench=wrench_fields(value)) for stamp in times]


def value_at(node: AlignNode, make: Maker, topic: str, stamp: int = START + 50 * STEP) -> Any:
    """What the node sends on a topic for a trigger."""
    node._on_trigger(stamp, 1)
    until(lambda: bool(make.sent[topic]))
    sent = make.sent[topic][-1]
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec) == divmod(stamp, 10**9)
    return sent


def test_a_wrench_goes_out_in_the_load_cell_s_frame(make: Maker) -> None:
    """Turned by 90 deg about z and 0.1 m above {S}: F (-20, 10, -150), M + p x F."""
    parameters = {
        "wrench.topic": "/ft",
        "wrench.rotation": "[0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]",
        "wrench.translation": "[0.0, 0.0, 0.1]",
    }
    node = make(AlignNode, **parameters)
    node._sources["wrench"].receive(wrenches(np.array([1.0, 2.0, 3.0, 10.0, 20.0, -150.0])))
    sent = value_at(node, make, "load_cell/wrench")
    assert sent.header.frame_id == "load_cell"
    force, moment = sent.wrench.force, sent.wrench.torque
    assert (force.x, force.y, force.z) == pytest.approx((-20.0, 10.0, -150.0))
    assert (moment.x, moment.y, moment.z) == pytest.approx((-3.0, -1.0, 3.0))


def test_a_tare_is_subtracted_and_recorded(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    node = make(AlignNode, **{"wrench.topic": "/ft"})
    now = START + 100 * STEP
    monkeypatch.setattr(node._trigger_time, "stamp", lambda moment: now)
    load = np.array([0.1, 0.2, 0.3, 1.0, 2.0, -30.0])
    node._sources["wrench"].receive(wrenches(load))
    text = node._taring.tare()
    assert text == "tared: removed Mx 0.1 N m, My 0.2 N m, Mz 0.3 N m, Fx 1 N, Fy 2 N, Fz -30 N"
    assert make.sent["event"][-1].label == f"tare {text.removeprefix('tared: ')}"
    later = now + STEP
    node._sources["wrench"].receive(wrenches(load + 5.0, later, 20))
    now += 2_000_000_000
    sent = value_at(node, make, "load_cell/wrench", later + 10 * STEP)
    assert sent.wrench.force.z == pytest.approx(5.0)
    until(lambda: bool(make.sent["load_cell/raw"]))
    raw = make.sent["load_cell/raw"][-1]
    assert raw.tare.force.z == pytest.approx(-30.0) and np.isnan(raw.ratios).all()
    assert (raw.tared.sec, raw.tared.nanosec) == divmod(START + 100 * STEP, 10**9)


def test_a_moving_load_refuses_the_tare(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    node = make(AlignNode, **{"wrench.topic": "/ft"})
    monkeypatch.setattr(node._trigger_time, "stamp", lambda moment: START + 100 * STEP)
    rows = [wrenches(np.full(6, float(row)), START + row * STEP, 1)[0] for row in range(101)]
    node._sources["wrench"].receive(rows)
    with refused(DeviceError, "cannot tare: Mx moves by 28.9 N m", "hold the cell still"):
        node._taring.tare()


def test_poses_go_out_in_the_world(make: Maker) -> None:
    names = {"socket_pose.topic": "/rig/socket", "pylon_pose.topic": "/rig/limb"}
    node = make(AlignNode, **names)
    kind = "geometry_msgs/msg/PoseStamped"
    place = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8])
    times = [START + row * STEP for row in range(101)]
    sent = [message(kind, stamp, pose=pose_fields(place)) for stamp in times]
    node._sources["pylon_pose"].receive(sent)
    pylon = value_at(node, make, "mocap/pylon/pose")
    assert pylon.header.frame_id == "world" and pylon.pose.position.y == pytest.approx(0.2)
    assert pylon.pose.orientation.w == pytest.approx(0.8)
    until(lambda: bool(make.sent["mocap/socket/pose"]))
    socket = make.sent["mocap/socket/pose"][-1]
    assert np.isnan(socket.pose.position.x), "no reading of it"


def test_stresses_go_out_as_capacitances(make: Maker) -> None:
    """They give 12 kPa back; the cluster without a reading is missing."""
    names = "['brim_lateral', 'distal']"
    node = make(AlignNode, **{"clusters.topic": "/uc", "clusters.names": names})
    kind = "socket_testbed_msgs/msg/ClusterStressArray"
    stress = {"name": "distal", "normal": 12e3, "shear_x": 1e3, "shear_y": -2e3}
    sent = [message(kind, START + row * STEP, clusters=[stress]) for row in range(101)]
    node._sources["clusters"].receive(sent)
    first, second = value_at(node, make, "clusters/capacitance").clusters
    assert (first.name, [*first.status]) == ("brim_lateral", [2, 2, 2, 2])
    assert (second.name, [*second.status]) == ("distal", [0, 0, 0, 0])
    values = np.array([[[np.nan] * 4, second.capacitance]])
    status = np.array([[[2] * 4, [0] * 4]], np.uint8)
    back, _ = node._calibration.stacked(("brim_lateral", "distal")).apply(values, status)
    np.testing.assert_allclose(back[0, 1], [12e3, 1e3, -2e3], rtol=1e-6)


AHEAD = "socket pose: the stamps of /rig are 250 ms ahead of their arrival: synchronise the clocks"
NOTHING = (
    "pylon pose: nothing arrives on /limb: start its driver, or check the topic's name and the"
    " ROS_DOMAIN_ID"
)
TYPE = "wrench: /ft is a std_msgs/msg/String: name a topic of type geometry_msgs/msg/Wrench"
# How far the pose's stamps are ahead [s], other topics, what is wrong with /ft; level and text.
STATES: dict[str, tuple[float, dict[str, str], str, tuple[int, str]]] = {
    "all sound": (0.0, {}, "", (OK, "wrench at 100 Hz; socket pose at 100 Hz")),
    "one early": (0.25, {}, "", (WARN, AHEAD)),
    "early and silent": (
        0.25, {"pylon_pose.topic": "/limb"}, "", (ERROR, f"{AHEAD}; {NOTHING}"),
    ),
    "of another type": (0.0, {}, TYPE, (ERROR, TYPE)),
    "early and of another type": (0.25, {}, TYPE, (ERROR, f"{TYPE}; {AHEAD}")),
}  # fmt: skip


@pytest.mark.parametrize("case", STATES)
def test_the_node_tells_all_that_is_wrong(
    case: str, make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    early, more, wrong, expected = STATES[case]
    names = {"wrench.topic": "/ft", "socket_pose.topic": "/rig", **more}
    names |= {"pylon_pose.topic": "none"} if not more else {}
    node = make(AlignNode, **names)
    node._stopping.set()  # so that its thread does not look for publishers
    node._aligning.join()
    node._sources["wrench"].receive(wrenches(np.zeros(6)))
    place = pose_fields(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]))
    sent = [
        message(POSE, START + row * STEP, pose=place)._replace(
            time=START + row * STEP - round(1e9 * early)
        )
        for row in range(101)
    ]
    node._sources["socket_pose"].receive(sent)
    told: list[tuple[int, str]] = []
    monkeypatch.setattr(node, "report", lambda level, text: told.append((level, text)))
    monkeypatch.setattr(node, "_now", lambda: START + 100 * STEP)
    monkeypatch.setattr(node._aligning, "is_alive", lambda: True)
    node._wrong = {"wrench": wrong.removeprefix("wrench: ")}
    node.check()
    assert told == [expected]


def test_a_node_that_stopped_aligning_says_so(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    node = make(AlignNode, **{"wrench.topic": "/ft"})
    node._stopping.set()
    node._aligning.join()
    told: list[tuple[int, str]] = []
    monkeypatch.setattr(node, "report", lambda level, text: told.append((level, text)))
    node.check()
    assert told == [(ERROR, "it stopped aligning: see what it printed, and start it again")]


def test_the_figures_name_their_sources(make: Maker) -> None:
    """The period of a single trigger is not known, and so its window has one reading."""
    node = make(AlignNode, **{"wrench.topic": "/ft", "pylon_pose.topic": "none"})
    node._sources["wrench"].receive(wrenches(np.zeros(6)))
    value_at(node, make, "load_cell/wrench")
    found = node.figures()
    assert (found["samples"], found["wrench_rate"], found["wrench_missing"]) == (1, 100.0, 0)
    assert (found["wrench_late"], found["wrench_readings"]) == (0.0, 1)


def test_a_wrench_that_there_is_not_is_missing(make: Maker) -> None:
    node = make(AlignNode, **{"wrench.topic": "none"})
    sent = value_at(node, make, "load_cell/wrench")
    assert np.isnan(sent.wrench.force.x) and "load_cell/raw" not in make.sent


@pytest.mark.parametrize("topic", ["load_cell/wrench", "/clusters/stress"])
def test_a_topic_of_the_testbed_is_no_source(topic: str, make: Maker) -> None:
    words = f"align_node: wrench.topic is {topic}, which the testbed publishes itself: give"
    with refused(ConfigurationError, words):
        make(AlignNode, **{"wrench.topic": topic})


def test_the_testbed_s_trigger_is_no_other_program_s(make: Maker) -> None:
    words = "trigger_node: topic is /trigger, which the testbed publishes itself: give"
    with refused(ConfigurationError, words):
        make(TriggerNode, source="topic", topic="/trigger")


def test_a_source_of_triggers_needs_its_topic(make: Maker) -> None:
    with refused(ConfigurationError, "trigger_node: source is topic and topic is '': give"):
        make(TriggerNode, source="topic")


@pytest.mark.graph
def test_each_message_of_another_program_is_a_trigger(make: Maker) -> None:
    node = make(TriggerNode, source="topic", topic="/sync")
    with Probe() as probe:
        publisher = probe.publisher(Topic("/sync", WRENCH))
        now = time.time_ns()
        stamps = [now + row * STEP for row in range(3)]
        for stamp in stamps:
            content = message(WRENCH, stamp, wrench=wrench_fields(np.zeros(6)))
            publisher.publish(content.data)
        until(lambda: len(make.sent["trigger"]) == 3)
    sent = [(stamp_of(own), own.sequence) for own in make.sent["trigger"]]
    assert sent == [*zip(stamps, (1, 2, 3), strict=True)]
    assert node.figures()["triggers"] == 3


# --- topics of other programs


def publisher(kind: str = WRENCH, reliable: bool = True, kept: bool = False) -> Any:
    qos = QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
    )
    return SimpleNamespace(topic_type=kind, qos_profile=qos)


@pytest.mark.parametrize(
    ("given", "reliable"),
    [((True,), True), ((False,), False), ((True, False), False)],
    ids=["reliable", "best effort", "both"],
)
def test_the_quality_of_service_is_the_publishers(given: tuple[bool, ...], reliable: bool) -> None:
    found = matching_qos([publisher(reliable=own, kept=own) for own in given])
    assert (found.reliability == ReliabilityPolicy.RELIABLE) is reliable
    assert found.durability == DurabilityPolicy.VOLATILE


class Graph:
    """A node that sees some publishers, and counts its subscriptions."""

    def __init__(self, *publishers: Any) -> None:
        self.publishers = [*publishers]
        self.subscribed: list[tuple[str, Any]] = []
        self.destroyed = 0

    def get_publishers_info_by_topic(self, name: str) -> list[Any]:
        return self.publishers

    def create_subscription(self, kind: Any, name: str, callback: Any, qos: Any, raw: bool) -> Any:
        assert raw
        self.subscribed.append((kind.__name__, qos.reliability))
        return object()

    def destroy_subscription(self, subscription: Any) -> None:
        self.destroyed += 1


WRONG = {
    "type": (
        [publisher("sensor_msgs/msg/Imu")],
        f"/x is a sensor_msgs/msg/Imu: name a topic of type {WRENCH}",
    ),
    "two types": (
        [publisher(), publisher("sensor_msgs/msg/Imu")],
        f"/x has publishers of {WRENCH} and sensor_msgs/msg/Imu: rename one of the topics",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_topic_is_named(case: str) -> None:
    publishers, expected = WRONG[case]
    node: Any = Graph(*publishers)
    assert ForeignTopic(node, "/x", (WRENCH,)).look() == expected
    assert not node.subscribed


def test_a_publisher_s_new_quality_is_followed() -> None:
    node: Any = Graph()
    topic = ForeignTopic(node, "/x", (WRENCH,))
    assert topic.look() == "" and not node.subscribed and topic.take(lambda: 0) == []
    for reliable in (True, True, False):
        node.publishers = [publisher(reliable=reliable)]
        assert topic.look() == ""
    levels = [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]
    assert node.subscribed == [("WrenchStamped", level) for level in levels]
    assert node.destroyed == 1 and topic.type == WRENCH


def test_a_type_that_is_not_installed_is_named() -> None:
    words = "/x is a lab_msgs/msg/Force, whose package cannot be imported: source the workspace"
    with refused(ConfigurationError, words, "lab_msgs"):
        type_class("lab_msgs/msg/Force", "/x")
