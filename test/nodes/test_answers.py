"""Buttons and events without a graph: which service is called with what, and what is answered."""

import sys
import time
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.serialization import serialize_message
from socket_testbed_msgs.msg import ContactModel
from std_msgs.msg import String
from support.wording import refused

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.nodes import __main__ as program
from socket_testbed.nodes import controls as module
from socket_testbed.nodes.calibration_node import CalibrationNode
from socket_testbed.nodes.controls import EventMarker, Marked, ServiceControls, StatusListener
from socket_testbed.trials.events import stamp_by_triggers
from socket_testbed.wire import topics

# --- services


class Client:
    """Stands for the client of a service; answers at once, or never."""

    def __init__(self, kind: Any, name: str) -> None:
        self.kind, self.name = kind, name
        self.ready, self.requests = True, list[Any]()
        self.answer: Any = SimpleNamespace(success=True, message=f"{name} is done")

    def service_is_ready(self) -> bool:
        return self.ready

    def call_async(self, request: Any) -> Any:
        assert isinstance(request, self.kind.Request)
        self.requests.append(request)
        answer = self.answer
        return SimpleNamespace(done=lambda: answer is not None, result=lambda: answer)

    def remove_pending_request(self, future: Any) -> None: ...


class Lab:
    """Stands for a node that only makes clients."""

    def __init__(self) -> None:
        self.clients: dict[str, Client] = {}

    def create_client(self, kind: Any, name: str) -> Client:
        return self.clients.setdefault(name, Client(kind, name))

    def create_publisher(self, *given: Any) -> Any:
        return SimpleNamespace()

    def create_subscription(self, *given: Any, raw: bool) -> Any:
        return SimpleNamespace()


PARAMETERS = "recorder_node/set_parameters_atomically"


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def controls(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> ServiceControls:
    monkeypatch.setattr(module, "_POLL_INTERVAL", 0.0)
    found = ServiceControls(lab)
    accepted = SimpleNamespace(successful=True, reason="")
    lab.clients[PARAMETERS].answer = SimpleNamespace(result=accepted)
    return found


BUTTONS = {
    "tare": ("load_cell/tare", None),
    "fit": ("estimator/fit", None),
    "trigger-on": ("trigger/enable", True),
    "trigger-off": ("trigger/enable", False),
    "stop recording": ("recorder/record", False),
}


@pytest.mark.parametrize("what", BUTTONS)
def test_a_button_calls_its_service(what: str, controls: ServiceControls, lab: Lab) -> None:
    name, data = BUTTONS[what]
    assert controls.act(what, {}) == f"{name} is done"
    (request,) = lab.clients[name].requests
    assert getattr(request, "data", None) is data
    assert sum(len(client.requests) for client in lab.clients.values()) == 1


def test_a_trial_is_recorded_with_its_metadata(controls: ServiceControls, lab: Lab) -> None:
    given = {"trial": "stairs", "subject": "S02", "mass": "70.5"}
    assert controls.act("record", given) == "recorder/record is done"
    (request,) = lab.clients[PARAMETERS].requests
    values = {
        p.name: p.value.double_value if p.name == "next.mass" else p.value.string_value
        for p in request.parameters
    }
    assert values == {
        **{"next.name": "stairs", "next.subject": "S02", "next.mass": 70.5, "next.side": ""},
        **dict.fromkeys((f"next.{n}" for n in ("socket", "liner", "operator")), ""),
        **{"next.protocol": "", "next.notes": ""},
    }
    assert lab.clients["recorder/record"].requests[0].data is True


@pytest.mark.parametrize(
    ("what", "given", "words"),
    [
        ("record", {"mass": "heavy"}, "mass is 'heavy': give the body mass in kg"),
        ("jump", {}, "no button is called 'jump': load the page again"),
        ("mark", {"label": "2nd"}, "'2nd' is not a label of an event"),
    ],
    ids=["mass", "button", "label"],
)
def test_wrong_input_is_refused(
    what: str, given: dict[str, str], words: str, controls: ServiceControls, lab: Lab
) -> None:
    with refused(ConfigurationError, words):
        controls.act(what, given)
    assert not any(client.requests for client in lab.clients.values())


def test_refused_metadata_start_no_trial(controls: ServiceControls, lab: Lab) -> None:
    no = SimpleNamespace(successful=False, reason="side is 'up': did you mean 'left'?")
    lab.clients[PARAMETERS].answer = SimpleNamespace(result=no)
    with refused(TestbedError, "side is 'up': did you mean"):
        controls.act("record", {"side": "up"})
    assert not lab.clients["recorder/record"].requests


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("the load is 120 N: unload it", "the load is 120 N: unload it"),
        ("no", "refused: no"),
    ],
)
def test_a_refusal_is_passed_on(
    message: str, words: str, controls: ServiceControls, lab: Lab
) -> None:
    lab.clients["load_cell/tare"].answer = SimpleNamespace(success=False, message=message)
    with refused(TestbedError, words):
        controls.act("tare", {})


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("tare", "no node offers load_cell/tare: check that load_cell_node runs"),
        ("fit", "no node offers estimator/fit: check that estimator_node runs"),
        ("trigger-on", "no node offers trigger/enable: check that trigger_node runs"),
        ("stop recording", "no node offers recorder/record: start 'run' with --record DIR, or"),
    ],
)
def test_a_service_that_nobody_offers_is_named(
    what: str,
    words: str,
    controls: ServiceControls,
    lab: Lab,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_DISCOVERY_TIMEOUT", 0.0)
    for client in lab.clients.values():
        client.ready = False
    with refused(TestbedError, words):
        controls.act(what, {})


@pytest.mark.parametrize(
    ("what", "name", "node", "times", "within"),
    [
        ("tare", "load_cell/tare", "load_cell_node", 2, 5),
        ("fit", "estimator/fit", "estimator_node", 1, 120),  # slow, so it is asked once
    ],
)
def test_a_service_without_an_answer_is_asked_again(
    what: str,
    name: str,
    node: str,
    times: int,
    within: int,
    controls: ServiceControls,
    lab: Lab,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An answer is awaited for 5 s, asked twice; that of a fit for 120 s."""
    waits: list[float] = []

    def wait(condition: Any, duration: float) -> bool:
        waits.append(duration)
        return bool(condition())

    monkeypatch.setattr(module, "_wait", wait)
    lab.clients[name].answer = None
    words = f"{name} has not answered within {within} s: see what {node} reports"
    with refused(TestbedError, words):
        controls.act(what, {})
    assert len(lab.clients[name].requests) == times
    assert waits == [3.0] + [within / times] * times


# --- events


def test_a_mark_says_where_it_went(
    controls: ServiceControls, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[tuple[str, float]] = []

    def mark(label: str, when: float) -> Marked:
        called.append((label, when))
        return Marked(2, "s01" if label == "push" else "", label == "push")

    monkeypatch.setattr(controls._marker, "mark", mark)
    assert controls.act("mark", {"label": "push"}) == "marked 'push' in the trial s01"
    assert controls.act("mark", {}) == (
        "marked 'event'; no trial is being recorded: call recorder/record; no trigger received: the"
        " stamp is the system clock's"
    )
    assert called[0][1] == pytest.approx(time.monotonic(), abs=60.0)


class Graph:
    """Stands for a node in a graph with subscribers for events."""

    def __init__(self, subscribers: int, recorders: int = 0) -> None:
        self.subscribers, self.recorders = subscribers, recorders
        self.sent: list[Any] = []
        self.acknowledged = True
        self.heard: dict[str, Any] = {}

    def create_publisher(self, kind: Any, name: str, qos: Any) -> Any:
        return SimpleNamespace(
            topic_name=f"/lab/{name}",
            publish=self.sent.append,
            get_subscription_count=lambda: self.subscribers,
            wait_for_all_acked=lambda timeout: self.acknowledged,
        )

    def create_subscription(self, kind: Any, name: str, callback: Any, qos: Any, raw: bool) -> Any:
        self.heard[name] = callback
        return SimpleNamespace()

    def destroy_subscription(self, subscription: Any) -> None: ...

    def count_publishers(self, name: str) -> int:
        return self.recorders

    def count_subscribers(self, name: str) -> int:
        return int(name in {"/left/event", "/right/event"}) or self.subscribers

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        names = "/left/event", "/right/event", "/left/trigger"
        return [(name, []) for name in (names if not self.subscribers else ())]


def at_once(condition: Any, duration: float) -> bool:
    return bool(condition())


def test_an_event_tells_its_trial_and_subscribers() -> None:
    graph = Graph(subscribers=3, recorders=1)
    marker = EventMarker(graph, at_once)
    graph.heard["recorder/trial"](b"another program's")
    graph.heard["recorder/trial"](serialize_message(String(data="s01")))
    marked = marker.mark("push", time.monotonic() - 2.0)
    assert marked == Marked(3, "s01", False)
    (event,) = graph.sent
    stamp = event.header.stamp.sec + 1e-9 * event.header.stamp.nanosec
    assert event.label == "push" and event.header.frame_id == "load_cell"
    assert stamp == pytest.approx(time.time() - 2.0, abs=1.0)


def test_an_event_without_a_listener_is_refused() -> None:
    with refused(TestbedError, "no subscriber to /lab/event: give --namespace /left or /right"):
        EventMarker(Graph(subscribers=0), at_once).mark("push", 0.0)


def test_an_event_waits_for_the_recorder_s_word() -> None:
    """A recorder is there, and has not said which trial it records."""
    with pytest.raises(TestbedError):
        EventMarker(Graph(subscribers=1, recorders=1), at_once).mark("push", 0.0)


def test_an_unacknowledged_event_is_an_error() -> None:
    graph = Graph(subscribers=1)
    graph.acknowledged = False
    with refused(TestbedError, "the event was not acknowledged within 5 s: check that the rec"):
        EventMarker(graph, at_once).mark("push", 0.0)


@pytest.mark.parametrize(
    ("times", "span", "enough"),
    [((0.0, 0.5), 0.1, False), ((0.0, 0.5, 1.0), 1.0, True), ((0.0, 0.5, 0.9), 1.0, False)],
    ids=["two", "three", "short"],
)
def test_three_triggers_over_a_span_give_a_stamp(
    times: tuple[float, ...], span: float, enough: bool
) -> None:
    marker = EventMarker(Graph(subscribers=1), at_once)
    marker._triggers = [(when, round(1e9 * when)) for when in times]
    assert marker._has_triggers(span) is enough


def test_a_stamp_follows_the_triggers() -> None:
    """The trigger at 100.0 s has the stamp 7 s; the call was 1.5 s before it."""
    assert stamp_by_triggers(98.5, [(100.0, 7_000_000_000)]) == 5_500_000_000


# --- programs


def test_arguments_are_node_names_then_those_of_ros() -> None:
    split = program._split(["a_node", "b_node", "--ros-args", "-p", "x:=1"])
    assert split == (["a_node", "b_node"], ["--ros-args", "-p", "x:=1"])
    assert program._split(["a_node"]) == (["a_node"], [])


def test_a_node_is_found_by_its_name() -> None:
    assert program._node_class("calibration_node") is CalibrationNode
    with refused(ConfigurationError, "there is no node 'calibratoin_node': did you mean 'calib"):
        program._node_class("calibratoin_node")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["-m", "cluster_node", "mocap_node"], ["cluster_node", "mocap_node"]),
        (["/opt/lib/mocap_node", "--ros-args"], ["mocap_node"]),
    ],
    ids=["module", "program"],
)
def test_a_program_runs_the_node_it_names(
    words: list[str], names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[list[str]] = []
    monkeypatch.setattr(program.sys, "argv", words)
    monkeypatch.setattr(program, "_run", lambda found: ran.append(found) or 3)
    monkeypatch.setattr(program.os, "_exit", sys.exit)
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ran == [names] and ended.value.code == 3


class Stopped:
    """Stands for a node of a program, and notes what is done with it."""

    did: list[str] = []  # noqa: RUF012

    def __init__(self) -> None:
        self.settings = SimpleNamespace()

    def close(self) -> None:
        self.did.append("close")

    def destroy_node(self) -> None:
        self.did.append("destroy")

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.did.append)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """A program without ROS; the nodes that it spins."""
    spun: list[Any] = []
    ros = SimpleNamespace(
        init=lambda: None, ok=lambda: True, try_shutdown=lambda: Stopped.did.append("shutdown")
    )
    Stopped.did.clear()
    monkeypatch.setattr(program, "rclpy", ros)
    monkeypatch.setattr(program.signal, "signal", lambda *given: None)
    monkeypatch.setattr(program.sys, "setswitchinterval", lambda seconds: None)
    monkeypatch.setattr(program, "end_with_starter", lambda: None)
    monkeypatch.setattr(program, "schedule", lambda settings: ["refused: do this"])
    monkeypatch.setattr(program, "_spin", spun.append)
    return spun


def test_a_program_ends_its_nodes_cleanly(
    alone: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program, "_node_class", lambda name: Stopped)
    assert program._run(["a_node"]) == 0
    assert len(alone) == 1 and len(alone[0]) == 1
    assert Stopped.did == ["refused: do this", "close", "destroy", "shutdown"]


def test_a_program_s_error_is_one_line(
    alone: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert program._run(["cluster_nod"]) == 1
    assert capsys.readouterr().err == (
        "error: there is no node 'cluster_nod': did you mean 'cluster_node'?\n"
    )
    assert alone == [] and Stopped.did == ["shutdown"]


# --- what the status line listens to


def test_the_status_line_names_model_and_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    status = GraphStatus()
    listener = StatusListener(status, "/lab")
    try:
        own = serialize_message(ContactModel(variant="rigid_bias"))
        listener.add(topics.PARAMETERS, own)
        listener.add(topics.RECORDED_TRIAL, serialize_message(String(data="s01")))
        assert status.variant == "rigid_bias"
        listener.take()
        assert status.trial == ""  # its recorder has ended
        monkeypatch.setattr(listener._inbox.node, "count_publishers", lambda name: 1)
        listener.take()
        assert status.trial == "s01"
        assert not listener.set_paused(True)
    finally:
        listener.close()
