"""What every node says of itself: diagnostics, parameters with their ranges, services, inputs."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger
from support.clocks import FakeClock
from support.nodes import Maker, running_ros

from socket_testbed.errors import TestbedError
from socket_testbed.nodes import base
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.testbed import ReplaySettings, WindowSettings
from socket_testbed.wire import cdr, messages, topics

OK, WARN, ERROR = 0, 1, 2


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with running_ros():
        yield


class Plain(base.TestbedNode[ReplaySettings]):
    """A node that only reports."""

    def __init__(self) -> None:
        super().__init__("plain_node", ReplaySettings)
        self.works = True

    def ready(self) -> bool:
        return self.works

    def figures(self) -> dict[str, object]:
        return {"samples": 7}


@pytest.fixture
def node(make: Maker) -> Plain:
    return make(Plain)


# --- diagnostics


def test_a_change_of_level_is_sent_at_once(node: Plain, make: Maker) -> None:
    sent = make.sent["/diagnostics"]
    for level, text in ((OK, "a"), (WARN, "b"), (WARN, "c"), (ERROR, "d"), (OK, "e"), (OK, "e")):
        node.report(level, text)
    found = [(m.status[0].level[0], m.status[0].message) for m in sent]
    assert found == [(WARN, "b"), (ERROR, "d"), (OK, "e")]


def test_diagnostics_name_the_node_its_device_and_figures(node: Plain, make: Maker) -> None:
    node.device = "i2c-1"
    node.report(WARN, "look: there")
    (message,) = make.sent["/diagnostics"]
    status = message.status[0]
    assert status.name == "/plain_node" and status.hardware_id.endswith(" i2c-1")
    values = {entry.key: entry.value for entry in status.values}
    assert values == {
        "waiting_for": "(not checked yet)",
        "links": "",
        "hears": "",
        "samples": "7",
    }
    assert message.header.stamp.sec > 1_700_000_000 and message.header.frame_id == ""


def test_links_and_needs_are_listed(node: Plain, make: Maker) -> None:
    """The stand-in of a publisher has one subscriber; the trigger has no publisher."""
    node.advertise(topics.WRENCH, needed=True)
    node.advertise(topics.STRESS, name="/lab/stress")
    node.listen(topics.TRIGGER, lambda message: None)
    node.listen(topics.EVENT, lambda message: None, needed=False)
    node._check()
    values = {entry.key: entry.value for entry in make.sent["/diagnostics"][-1].status[0].values}
    assert values["links"] == "load_cell/wrench=1 /lab/stress=1"
    assert values["hears"] == "/trigger" and values["waiting_for"] == "/trigger"
    assert node.links() == {"load_cell/wrench": (1, 1), "/lab/stress": (1, 0)}


def test_an_unready_node_waits_for_itself(node: Plain, make: Maker) -> None:
    node.works = False
    node._check()
    values = {entry.key: entry.value for entry in make.sent["/diagnostics"][-1].status[0].values}
    assert values["waiting_for"] == "itself"


def test_diagnostics_are_sent_every_second(node: Plain, make: Maker) -> None:
    """It is checked ten times a second; the first check changes what it waits for."""
    for _ in range(31):
        node._check()
    assert len(make.sent["/diagnostics"]) == 4


def test_a_replay_s_nodes_report_at_every_check(
    node: Plain, make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node, "count_publishers", lambda name: int(name == "/clock"))
    for _ in range(5):
        node._check()
    assert len(make.sent["/diagnostics"]) == 5


def test_a_restarted_node_begins_with_a_warning(
    make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(Plain)
    assert make.state() == (OK, "started")
    monkeypatch.setenv(base.RESTARTED, "1")
    make(Plain)
    assert make.state() == (WARN, "started again")


def test_only_news_is_logged(node: Plain, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change in numbers alone is none; the first OK after a fault is a recovery."""
    logged: list[tuple[str, str]] = []
    kinds = ("error", "warning", "info")
    logger = {k: lambda text, k=k: logged.append((k, text)) for k in kinds}
    monkeypatch.setattr(node, "get_logger", lambda: SimpleNamespace(name="plain", **logger))
    node.report(OK, "works at 4 Hz")
    for number in (1, 2.5):
        node.report(WARN, f"{number} triggers are late")
    node.report(WARN, "1 wrench is late")
    node.report(ERROR, "broken")
    node.report(OK, "works at 4 Hz")
    node.report(OK, "works at 5 Hz")
    assert logged == [
        ("info", "works at 4 Hz"),
        ("warning", "1 triggers are late"),
        ("warning", "1 wrench is late"),
        ("error", "broken"),
        ("info", "recovered: works at 4 Hz"),
    ]


def test_a_fault_is_recent_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeClock().install(monkeypatch)
    fault = base.RecentFault()
    fault.note("no answer")
    clock.sleep(0.79)
    assert fault.text() == "no answer"
    clock.sleep(0.02)
    assert (fault.text(), fault.text(1.5)) == ("", "no answer")
    clock.sleep(1.0)
    assert fault.text(1.5) == ""


# --- topics


def test_publishers_are_reliable_and_keep_a_hundred() -> None:
    usual, latched = base.publisher_qos(topics.WRENCH), base.publisher_qos(topics.PARAMETERS)
    assert usual.reliability == latched.reliability == ReliabilityPolicy.RELIABLE
    assert (usual.depth, usual.durability) == (100, DurabilityPolicy.VOLATILE)
    assert (latched.depth, latched.durability) == (1, DurabilityPolicy.TRANSIENT_LOCAL)
    assert base.subscriber_qos(topics.PARAMETERS).durability == DurabilityPolicy.TRANSIENT_LOCAL


NAMES = {  # the contract's names and types
    "trigger": "socket_testbed_msgs/msg/Trigger",
    "clusters/capacitance": "socket_testbed_msgs/msg/ClusterCapacitanceArray",
    "load_cell/wrench": "geometry_msgs/msg/WrenchStamped",
    "load_cell/raw": "socket_testbed_msgs/msg/LoadCellRaw",
    "mocap/socket/pose": "geometry_msgs/msg/PoseStamped",
    "mocap/pylon/pose": "geometry_msgs/msg/PoseStamped",
    "mocap/markers": "socket_testbed_msgs/msg/RigidBodyMarkersArray",
    "event": "socket_testbed_msgs/msg/Event",
    "clusters/stress": "socket_testbed_msgs/msg/ClusterStressArray",
    "estimate/wrench": "geometry_msgs/msg/WrenchStamped",
    "estimate/local_forces": "socket_testbed_msgs/msg/LocalForceArray",
    "estimate/force_map": "socket_testbed_msgs/msg/ForceMap",
    "estimate/regions": "socket_testbed_msgs/msg/RegionPressures",
    "estimate/parameters": "socket_testbed_msgs/msg/ContactModel",
    "estimate/pressure_map": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


def test_topics_have_the_contract_s_names_and_types() -> None:
    assert {topic.name: topic.type for topic in topics.TOPICS} == NAMES
    required = ("trigger", "clusters/capacitance", "load_cell/wrench")
    poses = ("mocap/socket/pose", "mocap/pylon/pose")
    assert {topic.name for topic in topics.REQUIRED} == {*required, *poses}
    assert [t.name for t in topics.TOPICS if t.latched] == ["estimate/parameters"]
    maps = ["estimate/force_map", "estimate/regions", "estimate/pressure_map"]
    assert sorted(t.name for t in topics.TOPICS if t.unrecorded) == sorted(maps)
    computed = {t.name for t in topics.TOPICS if t.computed}
    assert computed == {"clusters/stress", "/diagnostics", *(n for n in NAMES if "estimate/" in n)}
    transforms = topics.TF, topics.TF_STATIC
    assert [(t.name, t.type, t.latched) for t in transforms] == [
        ("tf", "tf2_msgs/msg/TFMessage", False),
        ("tf_static", "tf2_msgs/msg/TFMessage", True),
    ]
    assert topics.RECORDED_TRIAL.name == "recorder/trial" and topics.RECORDED_TRIAL.latched


def test_services_have_the_contract_s_names() -> None:
    assert {str(name) for name in topics.Service} == {
        *("load_cell/tare", "load_cell/force_tare", "estimator/fit", "trigger/enable"),
        *("recorder/record", "replay/pause"),
    }


def unequal_model() -> bytes:
    """A model of two tiles with one stiffness."""
    kind, vector = topics.PARAMETERS.type, [None]
    message = cdr.make_message(kind, names=["a", "b"], stiffness=vector, rest_positions=vector * 2)
    return cdr.encode(message, kind)


def test_a_followed_message_arrives_decoded(node: Plain, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that cannot be decoded is dropped."""
    given: dict[str, Any] = {}

    def subscribe(kind: Any, name: str, callback: Any, qos: Any, raw: bool) -> Any:
        given.update(callback=callback, raw=raw, depth=qos.depth)
        return SimpleNamespace(topic_name=name, get_publisher_count=lambda: 1)

    monkeypatch.setattr(node, "create_subscription", subscribe)
    found: list[tuple[int, float]] = []
    node.follow(topics.TRIGGER, lambda stamp, number: found.append((stamp, number)))
    given["callback"](b"another program's")
    given["callback"](messages.trigger_packer()(5_000_000_009, 12))
    assert found == [(5_000_000_009, 12)] and given["raw"]


@pytest.mark.parametrize(
    ("topic", "data"),
    [
        (topics.DIAGNOSTICS, b"another program's"),
        (topics.RECORDED_TRIAL, b"\0\1\0\0\xff\xff\xff\xff"),
        (topics.PARAMETERS, unequal_model()),
    ],
    ids=["diagnostics", "name", "lengths"],
)
def test_a_foreign_message_is_dropped(
    topic: topics.Topic, data: bytes, node: Plain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A typed subscription would end the node."""
    given: dict[str, Any] = {}

    def subscribe(kind: Any, name: str, callback: Any, qos: Any, raw: bool) -> Any:
        given.update(callback=callback, raw=raw)
        return SimpleNamespace(topic_name=name, get_publisher_count=lambda: 1)

    monkeypatch.setattr(node, "create_subscription", subscribe)
    found: list[Any] = []
    node.listen(topic, found.append)
    given["callback"](data)
    assert given["raw"] and not found


# --- parameters


def test_a_parameter_has_its_description_and_range(node: Plain) -> None:
    rate = node.describe_parameter("rate")
    assert rate.description == "speed of the replay relative to the recording [-]"
    span = rate.floating_point_range[0]
    assert (span.from_value, span.to_value) == (0.001, 10_000.0) and rate.read_only
    assert not node.describe_parameter("trial").floating_point_range


def test_descriptors_have_steps_and_choices() -> None:
    own = base._descriptor("pending", WindowSettings.flat()["pending"])
    span = own.integer_range[0]
    assert (span.from_value, span.to_value, span.step) == (2, 100_000, 1)
    source = base._descriptor("source", TriggerSettings.flat()["source"])
    assert source.description.endswith("program [-]; one of gpio, timer, topic")


class Free(base.TestbedNode[WindowSettings]):
    """A node with parameters that may change."""

    def __init__(self) -> None:
        super().__init__("free_node", WindowSettings)


def test_only_a_valid_parameter_change_counts(make: Maker) -> None:
    node = make(Free)
    (answer,) = node.set_parameters([Parameter("refit_after", value=7)])
    assert answer.successful and node.settings.refit_after == 7
    (answer,) = node.set_parameters([Parameter("refit_after", value="seven")])
    assert not answer.successful and "free_node: refit_after is 'seven'" in answer.reason
    assert node.settings.refit_after == 7
    answer = node._check_settings([Parameter("refit_after")])
    assert not answer.successful
    assert answer.reason == "refit_after cannot be deleted: set it to another value"


# --- services


@pytest.mark.parametrize("slow", [False, True], ids=["at once", "from a thread"])
def test_a_service_answers_in_words(
    slow: bool, node: Plain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal is an answer without success."""
    offered: dict[str, Any] = {}

    def offer(kind: Any, name: str, respond: Any) -> Any:
        offered[name] = respond
        return SimpleNamespace(send_response=lambda response, header: None)

    def keep(own: Any, kind: Any, name: str, respond: Any) -> Any:
        offered[name] = respond
        return SimpleNamespace(thread=SimpleNamespace(shutdown=lambda: None))

    monkeypatch.setattr(node, "create_service", offer)
    monkeypatch.setattr(base, "SlowService", keep)

    def refuse() -> str:
        raise TestbedError("the load cell is loaded", "take the limb out")

    node.serve(SetBool, "a", lambda wanted: f"given {wanted}", slow)
    node.serve(Trigger, "b", lambda: "done", slow)
    node.serve(Trigger, "c", refuse, slow)
    answers = [
        offered["a"](SetBool.Request(data=True), SetBool.Response()),
        offered["b"](Trigger.Request(), Trigger.Response()),
        offered["c"](Trigger.Request(), Trigger.Response()),
    ]
    assert [(own.success, own.message) for own in answers] == [
        (True, "given True"),
        (True, "done"),
        (False, "the load cell is loaded: take the limb out"),
    ]
    assert len(node._slow_services) == (3 if slow else 0)


def test_a_slow_service_answers_from_its_own_thread(node: Plain) -> None:
    answered: list[Any] = []
    service = SimpleNamespace(send_response=lambda *given: answered.append(given))
    offering = SimpleNamespace(
        create_service=lambda kind, name, respond: service, until_ros_ends=node.until_ros_ends
    )
    slow = base.SlowService(offering, Trigger, "b", lambda request, response: (request, response))
    service.send_response((1, 2), "to whom")
    slow.thread.shutdown(wait=True)
    assert answered == [((1, 2), "to whom")]
