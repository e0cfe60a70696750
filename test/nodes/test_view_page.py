"""The view node's page: what the messages of a testbed say stands on it, and its buttons act.

Messages are packed from numbers in SI units, and the page's scripts run in `support.tabs`.
"""

from collections import defaultdict
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String
from std_srvs.srv import SetBool
from support.hand_outputs import GEOMETRY, MEASURED, OUTPUTS, PLACES, PRESSURE, REACH, SHEAR
from support.tabs import LIVE_PAGE, Tab, served

from socket_testbed.arrays import NORMAL_QUANTILE
from socket_testbed.geometry.regions import all_regions
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.nodes import base
from socket_testbed.nodes.controls import Service, ServiceControls
from socket_testbed.nodes.view_node import LiveSource
from socket_testbed.samples import Status
from socket_testbed.wire import messages, topics

EPOCH = 1_795_000_000_000_000_000  # [ns]


class Node:
    """A node that keeps what listens to its topics."""

    def __init__(self) -> None:
        self._listening: dict[topics.Topic, Callable[[Any], None]] = {}

    def get_fully_qualified_name(self) -> str:
        return "/view_node"

    def get_name(self) -> str:
        return "view_node"

    def count_publishers(self, _: str) -> int:
        return 1

    def listen(self, topic: topics.Topic, callback: Callable[[Any], None], *, needed: bool) -> None:
        assert not needed
        self._listening[topic] = callback

    def heard(self, topic: topics.Topic, message: Any) -> None:
        """Deliver a message to what listens to its topic."""
        self._listening[topic](message)


class Controls(ServiceControls):
    """The real choice of services, none of which is called."""

    def __init__(self) -> None:
        self.done: list[tuple[Any, Any]] = []

    def _ask(self, service: Any, request: Any) -> str:
        self.done.append((service, request.data if isinstance(request, SetBool.Request) else None))
        return "done"

    def _mark(self, label: str) -> str:
        self.done.append(("mark", label))
        return "marked"

    def _record(self, given: Any) -> str:
        self.done.append(("record", dict(given)))
        return "recording"


def opened(
    monkeypatch: pytest.MonkeyPatch, controls: Controls | None = None
) -> tuple[Tab, Node, dict[topics.Topic, list[bytes]]]:
    """The page of a testbed, its node and its queues of messages."""
    queues: dict[topics.Topic, list[bytes]] = defaultdict(list)
    inbox = Mock(take=lambda topic: [queues[topic].pop(0) for _ in queues[topic][:]])
    monkeypatch.setattr(LiveSource, "_subscribe", lambda _: inbox)
    node = Node()
    return Tab(LIVE_PAGE, served(LiveSource(node, GEOMETRY, controls))), node, queues


def send(queues: dict[topics.Topic, list[bytes]], stamp: int, force: float) -> None:
    """A sample whose axial force is given [N], under the stamp [ns]."""
    vectors = np.zeros((1, len(GEOMETRY), 3))
    fields = (PRESSURE, REACH / NORMAL_QUANTILE, SHEAR, SHEAR)
    estimate = MapEstimate(vectors, vectors, *(one[None] for one in fields), "measured: wrench")
    names = tuple(place.name for place in all_regions(GEOMETRY))
    assert len(names) == len(PLACES)
    status = np.where(np.isfinite(MEASURED), Status.OK, Status.MISSING).astype(np.uint8)
    stress = np.column_stack([MEASURED, 0.0 * MEASURED, 0.0 * MEASURED])
    # The limb presses the socket down: against proximal, which is z.
    measured, predicted = (np.array([1.0, 2.0, 3.0, 4.0, 5.0, -one]) for one in (force, 790.0))
    clusters = tuple(GEOMETRY.clusters)
    for topic, data in (
        (topics.FORCE_MAP, messages.force_map_packer(GEOMETRY.names)(stamp, estimate)),
        (topics.REGIONS, messages.regions_packer(names)(stamp, OUTPUTS)),
        (topics.STRESS, messages.stress_packer(clusters)(stamp, stress, status)),
        (topics.WRENCH, messages.wrench_packer()(stamp, measured)),
        (topics.ESTIMATED_WRENCH, messages.wrench_packer()(stamp, predicted)),
    ):
        queues[topic].append(data)


def test_page_shows_what_the_messages_say(monkeypatch: pytest.MonkeyPatch) -> None:
    tab, _, queues = opened(monkeypatch)
    for seconds, force in ((0, 100.0), (10, 800.0)):
        send(queues, EPOCH + 10**9 * seconds, force)
        tab.wait(0.2)
    assert tab.text("#when") == "at 10.00 s"
    picture = tab.picture("#map")
    highest, angle, height = picture.heatmap().highest()
    # 40 kPa at 90 degrees and 50 mm above the end; the grid is 12 degrees x 11 mm.
    assert highest == pytest.approx(40.0, rel=0.1)
    assert (angle, height) == (pytest.approx(90.0, abs=7.0), pytest.approx(50.0, abs=6.0))
    assert {"front: <b>21.3</b>", "side", "<b>peak 40.0</b>"} < set(picture.notes)
    assert tab.texts("h3")[:3] == ["Peak now", "Elsewhere now", "Data"]
    assert tab.texts("strong")[:2] == ["40.0 kPa", "40.0 kPa"]
    assert tab.texts(".interval") == ["95 %: 30.0 to 62.5"] * 2
    assert tab.texts(".said")[0] == "15.0 (12.0 to 18.0)"
    course = tab.picture("#course")
    lines = {line["name"]: line for line in course.traces if line.get("name")}
    assert lines["force along the socket [N]"]["x"] == [0, 10]
    assert lines["force along the socket [N]"]["y"] == [100, 800]
    assert lines["peak pressure [kPa]"]["y"] == [40, 40]
    assert lines["95 % interval"]["y"] == [30, 30]
    assert tab.rows("#wrench") == [
        ["", "measured", "predicted"],
        ["Mx [N m]", "1.00", "1.00"],
        ["My [N m]", "2.00", "2.00"],
        ["Mz [N m]", "3.00", "3.00"],
        ["Fx [N]", "4.00", "4.00"],
        ["Fy [N]", "5.00", "5.00"],
        ["Fz [N]", "-800.00", "-790.00"],
    ]


def test_page_of_a_silent_testbed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    tab, _, _ = opened(monkeypatch)
    assert tab.text("#title") == "socket_testbed, live"
    assert tab.text("#when") == "no force map"
    assert tab.texts("#cards") == ["Datanoneno data from the testbed"]
    assert not tab.picture("#map").of_type("heatmap")
    assert tab.get("#buttons", "hidden")


def test_page_lists_nodes_and_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    tab, node, _ = opened(monkeypatch)
    values = [KeyValue(key=base.ELAPSED, value="3"), KeyValue(key=base.FREE, value="12.5e9")]
    states = [
        DiagnosticStatus(name="/clock_node", level=DiagnosticStatus.WARN, message="late"),
        DiagnosticStatus(name="/recorder_node", message="recording", values=values),
    ]
    node.heard(topics.DIAGNOSTICS, DiagnosticArray(status=states))
    tab.wait(0.2)
    assert tab.rows("#sensors") == [
        ["\N{BLACK UP-POINTING TRIANGLE}", "clock", "late", ""],
        ["\N{BLACK CIRCLE}", "recorder", "recording", ""],
    ]
    assert tab.text("#recording") == "nothing is being recorded, 12.5 GB free"
    assert "clock: late" in tab.texts("#cards")[0]
    node.heard(topics.RECORDED_TRIAL, String(data="walk"))
    tab.wait(0.2)
    assert tab.text("#recording").startswith("recording walk for 0:0")
    assert tab.text("#record") == "■ Stop recording"


def test_each_button_calls_its_service(monkeypatch: pytest.MonkeyPatch) -> None:
    controls = Controls()
    tab, node, _ = opened(monkeypatch, controls)
    for button in ("tare", "fit", "trigger-off", "trigger-on", "mark", "record"):
        tab.click(f"#{button}")
    node.heard(topics.RECORDED_TRIAL, String(data="walk"))
    tab.wait(0.2)
    tab.click("#record")
    assert controls.done == [
        (Service.TARE, None),
        (Service.FIT, None),
        (Service.ENABLE_TRIGGER, False),
        (Service.ENABLE_TRIGGER, True),
        ("mark", "event"),
        ("record", {}),  # nothing is stated
        (Service.RECORD, False),
    ]
    assert tab.text("#said") == "stop recording: done"
