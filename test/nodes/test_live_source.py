"""The live page's data, from messages of the scene at 12.0 s, against hand values.

Pressures are 1.5 times the means. The node and its subscriptions are stand-ins, the clock is false.
"""

from collections import defaultdict
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String
from support import scene
from support.clocks import FakeClock
from support.nodes import Maker, running_ros
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.regions import all_regions
from socket_testbed.identification.pressure import Quantity
from socket_testbed.nodes import view_node
from socket_testbed.nodes.view_node import LiveSource, ViewNode
from socket_testbed.samples import Samples
from socket_testbed.wire import messages, topics

STAMP = scene.START
PLACES = [place.name for place in all_regions(scene.geometry())]
CIRCLE, TRIANGLE, SQUARE = "●▲■"


class Lab:
    """Stands for the view node in /lab and for its inbox."""

    def __init__(self) -> None:
        self.queued: dict[topics.Topic, list[bytes]] = defaultdict(list)
        self.heard: dict[topics.Topic, Any] = {}
        self.recorders, self.closed = 1, 0

    def get_fully_qualified_name(self) -> str:
        return "/lab/view_node"

    def get_name(self) -> str:
        return "view_node"

    def listen(self, topic: topics.Topic, callback: Any, needed: bool) -> None:
        assert not needed
        self.heard[topic] = callback

    def count_publishers(self, name: str) -> int:
        return self.recorders

    def take(self, topic: topics.Topic) -> list[bytes]:
        return self.queued.pop(topic, [])

    def close(self) -> None:
        self.closed += 1

    def say(self, name: str, level: int, text: str, **figures: object) -> None:
        values = [KeyValue(key=key, value=str(value)) for key, value in figures.items()]
        status = DiagnosticStatus(level=bytes([level]), name=name, message=text, values=values)
        self.heard[topics.DIAGNOSTICS](DiagnosticArray(status=[status]))

    def send(self, stamp: int = STAMP, wrench: Any = None, names: Any = scene.TILES) -> None:
        """A map, wrenches, the clusters' stresses and the regions of one sample.

        The peak of the socket is 60 kPa, between 57.4 and 62.4 kPa.
        """
        estimate = scene.HandMap(scene.geometry(), ()).estimate(peak_sample())
        measured = scene.wrench()[scene.PEAK_ROW] if wrench is None else wrench
        stresses = np.array([[45e3, 0, 0], [60e3, 0, 0], [37.5e3, 0, 0], [21e3, 0, 0]])
        count = len(PLACES)
        ends = [np.full(count, x) for x in (60e3, 57.4e3, 62.4e3)]
        quantity = Quantity(*ends, ends[0])
        outputs = SimpleNamespace(mean=quantity, peak=quantity, shear=quantity, share=quantity)
        states = np.array([0, 0, 1, 0], np.uint8)
        queue = self.queued
        queue[topics.FORCE_MAP].append(messages.force_map_packer(names)(stamp, estimate))
        queue[topics.WRENCH].append(messages.wrench_packer()(stamp, measured))
        queue[topics.ESTIMATED_WRENCH].append(messages.wrench_packer()(stamp, np.arange(6.0)))
        pack = messages.stress_packer([*scene.CLUSTERS])
        queue[topics.STRESS].append(pack(stamp, stresses, states))
        queue[topics.REGIONS].append(messages.regions_packer(PLACES)(stamp, outputs))


def peak_sample() -> Any:
    stamps = np.array([scene.START + 12 * 10**9])
    blank = np.zeros((1, 3))
    return Samples(
        stamps, blank, blank, np.zeros((1, 6)), (), np.zeros((1, 0, 3)), np.zeros((1, 0))
    )


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock().install(monkeypatch)


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def source(lab: Lab, clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> LiveSource:
    monkeypatch.setattr(LiveSource, "_subscribe", lambda own: lab)
    return LiveSource(lab, scene.geometry(), None)


def test_the_page_begins_without_buttons(source: LiveSource) -> None:
    start = source.start()
    assert start["title"] == "socket_testbed, live" and start["live"] and not start["buttons"]
    assert start["metadata"]["side"] == ("", "left", "right") and start["metadata"]["mass"] == ()
    with refused(ConfigurationError, "the buttons are off: start 'view' with --buttons"):
        source.act("tare", {})


def test_buttons_pass_on_what_was_filled_in(lab: Lab, clock: FakeClock) -> None:
    asked = []
    controls = SimpleNamespace(act=lambda what, given: asked.append((what, given)) or "done")
    source = LiveSource(lab, scene.geometry(), controls)
    assert source.start()["buttons"]
    assert source.act("record", {"subject": "S01", "mass": 70.5, "notes": ""}) == "done"
    assert asked == [("record", {"subject": "S01", "mass": "70.5"})]


def test_the_newest_map_is_shown_in_kilopascals(source: LiveSource, lab: Lab) -> None:
    """`posterior_distal` is saturated."""
    lab.send()
    lab.send(STAMP + 2 * 10**9)
    moment = source.now(None)["moment"]
    assert moment["time"] == 2.0
    place = scene.TILES.index("ant_mid")
    assert moment["pressure"][place] == 60.0 and moment["shear"][place] == 7.5
    assert moment["reach"][place] == 1.96
    assert moment["measured"] == [45.0, 60.0, None, 21.0]


def test_the_wrenches_are_measured_then_predicted(source: LiveSource, lab: Lab) -> None:
    lab.send()
    rows = source.now(None)["wrench"]
    assert rows[0] == ["", "measured", "predicted"]
    assert rows[1] == ["Mx [N m]", "0.55", "0.00"] and rows[6] == ["Fz [N]", "-90.00", "5.00"]


def test_the_course_is_force_and_peak(source: LiveSource, lab: Lab) -> None:
    """90 N downwards press along the socket."""
    for second in (0, 1, 29):
        lab.send(STAMP + second * 10**9)
        source.now(None)
    course = source.now(None)["course"]
    assert course["time"] == [0.0, 1.0, 29.0] and course["force"] == [90.0] * 3
    assert (course["peak"], course["low"], course["high"]) == ([60.0] * 3, [57.4] * 3, [62.4] * 3)


def test_the_course_covers_thirty_seconds(source: LiveSource, lab: Lab) -> None:
    for tenth in (0, 6, 300, 305):
        lab.send(STAMP + tenth * 10**8)
    assert source.now(None)["course"]["time"] == [0.6, 30.0, 30.5]


def test_the_cards_are_of_now(source: LiveSource, lab: Lab) -> None:
    """The highest tile has a cluster; elsewhere `post_prox` is the highest."""
    lab.send()
    found = source.now(None)
    peak, elsewhere, data = found["cards"]
    assert (peak["title"], peak["value"], peak["interval"]) == (
        "Peak now",
        "60.0 kPa",
        "57.4 to 62.4",
    )
    assert peak["words"] == "anterior middle, measured by mid_anterior"
    assert elsewhere["title"] == "Elsewhere now"
    assert elsewhere["words"] == "highest where no sensor is: posterior proximal"
    assert data["value"] == "none" and data["words"] == "no data from the testbed"
    assert found["bars"]["values"]["peak pressure [kPa]"][0] == [60.0, 57.4, 62.4]


def test_old_data_is_not_shown_as_current(source: LiveSource, lab: Lab, clock: FakeClock) -> None:
    lab.send()
    source.now(None)
    clock.sleep(1.9)
    assert source.now(None)["moment"]["pressure"] and "bars" in source.now(None)
    clock.sleep(0.2)
    found = source.now(None)
    assert found["moment"] == {"time": 0.0, "words": "no force map"}
    assert "bars" not in found and found["wrench"][1] == ["Mx [N m]", "none", "none"]


def test_another_socket_s_map_is_not_shown(source: LiveSource, lab: Lab) -> None:
    lab.send(names=[f"tile_{i}" for i in range(12)])
    found = source.now(None)
    assert found["moment"]["words"] == "no force map"
    (data,) = found["cards"]
    assert data["words"] == "the force map is of another socket: give 'view' its --geometry"
    assert data["bad"]


def test_a_restarted_graph_begins_a_new_course(source: LiveSource, lab: Lab) -> None:
    for stamp in (STAMP, STAMP + 10**9, STAMP - 10**9):
        lab.send(stamp)
        source.now(None)
    assert source.now(None)["course"]["time"] == [0.0]


def test_the_inbox_is_closed_without_a_browser(
    source: LiveSource, lab: Lab, clock: FakeClock
) -> None:
    source.now(None)
    clock.sleep(2.9)
    source.unsubscribe_if_idle()
    assert lab.closed == 0
    clock.sleep(0.2)
    source.unsubscribe_if_idle()
    source.unsubscribe_if_idle()
    assert lab.closed == 1


# --- the nodes


def test_each_node_has_a_row_with_its_rate(source: LiveSource, lab: Lab, clock: FakeClock) -> None:
    """Another testbed's nodes and the page's own are left out."""
    for count in (0, 20):
        lab.say("/lab/load_cell_node", 0, "500 conversions a second", samples=count)
        lab.say("/lab/cluster_node", 1, "distal missing", missing=3)
        lab.say("/lab/trigger_node", 2, "another trigger", triggers=2 * count)
        lab.say("/lab/view_node", 2, "the page itself")
        lab.say("/other/mocap_node", 2, "another testbed")
        clock.sleep(1.0)
    found = source.now(None)
    assert found["sensors"] == [
        [TRIANGLE, "cluster", "distal missing", ""],
        [CIRCLE, "load cell", "500 conversions a second", "20 Hz"],
        [SQUARE, "trigger", "another trigger", "40 Hz"],
    ]
    (data,) = found["cards"]
    assert data["words"] == "trigger: another trigger (and 1 more)"


def test_good_nodes_are_counted(source: LiveSource, lab: Lab) -> None:
    lab.say("/lab/cluster_node", 0, "4 clusters answer")
    lab.say("/lab/mocap_node", 0, "240 frames a second")
    (data,) = source.now(None)["cards"]
    assert data == {"title": "Data", "value": "good", "words": "all 2 nodes report OK"}


def test_the_estimator_s_look_leads_the_card(source: LiveSource, lab: Lab) -> None:
    lab.say("/lab/estimator_node", 1, "data: check Fx: it stands still; no model yet")
    (data,) = source.now(None)["cards"]
    assert data["words"].startswith("Fx: it stands still") and data["value"] == "check"


def test_a_silent_node_is_an_error(source: LiveSource, lab: Lab, clock: FakeClock) -> None:
    lab.say("/lab/cluster_node", 0, "4 clusters answer")
    clock.sleep(2.9)
    assert source.now(None)["sensors"][0][0] == CIRCLE
    clock.sleep(1.1)
    sign, _, words, _ = source.now(None)["sensors"][0]
    assert (sign, words) == (SQUARE, "silent for 4 s; it said: 4 clusters answer")


def test_a_node_is_silent_beside_others_that_report(
    source: LiveSource, lab: Lab, clock: FakeClock
) -> None:
    """For 20 s, after which others no longer count a participant; then it reports again."""
    lab.say("/lab/cluster_node", 0, "4 clusters answer")
    for _ in range(20):
        lab.say("/lab/mocap_node", 0, "240 frames a second")
        clock.sleep(1.0)
    found = source.now(None)
    assert [(sign, words) for sign, _, words, _ in found["sensors"]] == [
        (SQUARE, "silent for 20 s; it said: 4 clusters answer"),
        (CIRCLE, "240 frames a second"),
    ]
    (data,) = found["cards"]
    assert data["words"] == "cluster: silent for 20 s; it said: 4 clusters answer"
    lab.say("/lab/cluster_node", 0, "4 clusters answer")
    assert source.now(None)["sensors"][0][0] == CIRCLE


def test_a_restarted_node_s_rate_is_unknown(source: LiveSource, lab: Lab, clock: FakeClock) -> None:
    for count in (50, 100, 3):
        lab.say("/lab/cluster_node", 0, "", samples=count)
        clock.sleep(1.0)
    assert source.now(None)["sensors"][0][3] == ""
    lab.say("/lab/cluster_node", 0, "", samples=13)
    assert source.now(None)["sensors"][0][3] == "10 Hz"


# --- the recording


def test_the_recording_is_told_with_its_duration(
    source: LiveSource, lab: Lab, clock: FakeClock
) -> None:
    """The recorder reported 60 s, 30 s ago."""
    lab.heard[topics.RECORDED_TRIAL](String(data="s01"))
    assert source.now(None)["recording"] == {"on": True, "words": "recording s01"}
    lab.say("/lab/recorder_node", 0, "recording", elapsed=60.0, free=12_340_000_000)
    clock.sleep(30.5)
    expected = {"on": True, "words": "recording s01 for 0:01:30, 12.3 GB free"}
    assert source.now(None)["recording"] == expected


@pytest.mark.parametrize("text", ["", "soon", "nan", "1e300"])
def test_a_recorder_s_texts_are_no_figures(text: str, source: LiveSource, lab: Lab) -> None:
    """Another program's node may have the recorder's name."""
    lab.heard[topics.RECORDED_TRIAL](String(data="s01"))
    lab.say("/lab/recorder_node", 0, "recording", elapsed=text, free="soon", samples=text)
    lab.say("/lab/recorder_node", 0, "recording")
    assert source.now(None)["recording"] == {"on": True, "words": "recording s01"}


def test_the_duration_counts_from_the_newest_trial(
    source: LiveSource, lab: Lab, clock: FakeClock
) -> None:
    lab.say("/lab/recorder_node", 0, "recorded", elapsed=0.0, free=5_000_000_000)
    clock.sleep(10.0)
    lab.heard[topics.RECORDED_TRIAL](String(data="s02"))
    clock.sleep(4.5)
    assert source.now(None)["recording"]["words"] == "recording s02 for 0:00:04, 5.0 GB free"


def test_nothing_is_recorded_without_a_recorder(source: LiveSource, lab: Lab) -> None:
    lab.heard[topics.RECORDED_TRIAL](String(data="s01"))
    lab.recorders = 0
    expected = {"on": False, "words": "nothing is being recorded"}
    assert source.now(None)["recording"] == expected


# --- the node itself


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Maker]:
    with running_ros():
        maker = Maker(monkeypatch)
        yield maker
        maker.close()


@pytest.mark.parametrize(
    ("host", "buttons", "allowed"),
    [("127.0.0.1", "false", True), ("0.0.0.0", "false", False), ("0.0.0.0", "true", True)],
    ids=["local", "open", "open with buttons"],
)
def test_buttons_are_for_this_machine_unless_allowed(
    host: str, buttons: str, allowed: bool, make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is opened here."""

    def serve(source: Any, own: str, *given: Any) -> Any:
        return SimpleNamespace(url=f"http://{own}:9", close=lambda: None)

    monkeypatch.setattr(view_node, "PageServer", serve)
    node = make(ViewNode, host=host, buttons=buttons)
    assert make.state() == (0, f"the testbed is shown at http://{host}:9")
    assert node._live.start()["buttons"] is allowed


def test_the_page_listens_while_a_browser_asks(make: Maker, clock: FakeClock) -> None:
    """To five topics, without any retransmission."""
    node = make(ViewNode, port=0)
    node.check()
    assert node._live._inbox is None
    found = node._live.now(None)
    assert found["moment"]["words"] == "no force map"
    inbox = node._live._inbox
    assert inbox is not None and len(inbox._subscriptions) == 5
    assert inbox.node.get_name() == "_view_node_inbox"
    clock.sleep(3.1)
    node.check()
    assert node._live._inbox is None
