"""What the live page sends to a browser, from messages made by hand, without a graph.

ROS packs the messages; the page's source reads them as it would in a running testbed. The node, its
inbox and the clock are stand-ins.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3, WrenchStamped
from rclpy.serialization import serialize_message
from socket_testbed_msgs import msg
from std_msgs.msg import String
from support import scene
from support.results_by_hand import tile
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.nodes import view_node
from socket_testbed.nodes.view_node import LiveSource
from socket_testbed.wire import topics

LEVELS = ("proximal", "middle", "distal")
SIDES = ("anterior", "posterior", "left", "right")
REGIONS = (  # a graph knows no leg
    *(*SIDES, *LEVELS),
    *(f"{side} {level}" for side in SIDES for level in LEVELS),
    *("tibia", "fibula", "unmeasured wall", "socket"),
)
START = 1_800_000_000 * 10**9  # [ns]
SIGNS = {
    "ok": "\N{BLACK CIRCLE}",
    "warn": "\N{BLACK UP-POINTING TRIANGLE}",
    "error": "\N{BLACK SQUARE}",
}


class Graph:
    """Stands for the node, its inbox, and the clock."""

    def __init__(self) -> None:
        self.now = 1000.0  # [s]
        self.heard: dict[topics.Topic, Callable[[Any], None]] = {}
        self.queue: dict[topics.Topic, list[bytes]] = {}
        self.recorders = 1

    def get_fully_qualified_name(self) -> str:
        return "/lab/view_node"

    def get_name(self) -> str:
        return "view_node"

    def get_namespace(self) -> str:
        return "/lab"

    def listen(self, topic: topics.Topic, callback: Callable[[Any], None], needed: bool) -> None:
        self.heard[topic] = callback

    def count_publishers(self, name: str) -> int:
        return self.recorders

    def take(self, topic: topics.Topic) -> list[bytes]:
        return self.queue.pop(topic, [])

    def send(self, topic: topics.Topic, message: Any, seconds: float) -> None:
        """Queue a message with a stamp, in seconds since the start."""
        stamp = START + round(1e9 * seconds)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        self.queue.setdefault(topic, []).append(serialize_message(message))

    def report(self, name: str, level: int, words: str, **values: object) -> None:
        """A node's diagnostics."""
        entries = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        status = DiagnosticStatus(name=name, level=bytes([level]), message=words, values=entries)
        self.heard[topics.DIAGNOSTICS](DiagnosticArray(status=[status]))


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    found = Graph()
    monkeypatch.setattr("socket_testbed.clocks.monotonic", lambda: found.now)
    monkeypatch.setattr(view_node.base, "Inbox", lambda *_: found)
    return found


@pytest.fixture
def source(graph: Graph) -> Iterator[LiveSource]:
    return LiveSource(graph, scene.geometry(), None)  # type: ignore[arg-type]


def force_map(names: tuple[str, ...] = scene.TILES) -> msg.ForceMap:
    """The scene's means in Pa, with errors of 1 kPa; `left_mid` has an error of 8 kPa."""
    pressure, along_x, along_y = 1e3 * np.array([*scene.STRESS.values()]).T
    deviation = np.full(12, 1e3)
    deviation[tile("left_mid")] = 8e3
    vectors = [Vector3(x=1.0, y=2.0, z=3.0)] * 12
    return msg.ForceMap(
        names=list(names),
        forces=vectors,
        standard_deviations=vectors,
        normal_pressure=pressure,
        normal_pressure_standard_deviation=deviation,
        shear=np.hypot(along_x, along_y),
        shear_standard_deviation=np.full(12, 500.0),
        source="by hand",
    )


def wrench(fz: float, mx: float = 0.25) -> WrenchStamped:
    found = WrenchStamped()
    found.wrench.torque.x, found.wrench.torque.y, found.wrench.torque.z = mx, 0.5, 0.75
    found.wrench.force.x, found.wrench.force.y, found.wrench.force.z = 14.0, 3.0, fz
    return found


def stresses() -> msg.ClusterStressArray:
    """In another order than the socket's; one is out of range, one is absent."""
    values = (("distal", 14e3, 3), ("mid_anterior", 40e3, 0), ("brim_lateral", 30e3, 0))
    return msg.ClusterStressArray(
        clusters=[
            msg.ClusterStress(name=name, normal=normal, shear_x=1e3, shear_y=2e3, status=status)
            for name, normal, status in values
        ]
    )


def regions(peak: float = 60e3) -> msg.RegionPressures:
    """Different values for each output; in region number k it is k times 100 Pa, or k %, larger."""
    steps = 100.0 * np.arange(len(REGIONS))
    found = {"mean": (20e3, 18e3, 23e3), "peak": (peak, 58e3, 63e3), "shear": (5e3, 4e3, 7e3)}
    fields = {
        f"{field}{end}": value + steps
        for field, values in found.items()
        for end, value in zip(("", "_low", "_high"), values, strict=True)
    }
    fields |= {
        f"load_share{end}": value + 1e-4 * steps
        for end, value in zip(("", "_low", "_high"), (0.25, 0.125, 0.5), strict=True)
    }
    return msg.RegionPressures(names=list(REGIONS), **fields)


def send_all(graph: Graph, seconds: float, fz: float = -60.0) -> None:
    """A trigger's messages."""
    graph.send(topics.WRENCH, wrench(fz), seconds)
    graph.send(topics.ESTIMATED_WRENCH, wrench(-55.0, mx=0.125), seconds)
    graph.send(topics.FORCE_MAP, force_map(), seconds)
    graph.send(topics.STRESS, stresses(), seconds)
    graph.send(topics.REGIONS, regions(), seconds)


@pytest.fixture
def now(graph: Graph, source: LiveSource) -> dict[str, Any]:
    """After a trigger at 2.5 s, the first wrench at 0 s."""
    graph.send(topics.WRENCH, wrench(-10.0), 0.0)
    send_all(graph, 2.5)
    return source.now(None)


# --- the page


def test_the_page_is_live_and_its_buttons_off(source: LiveSource) -> None:
    start = source.start()
    assert start["live"] is True and start["buttons"] is False
    assert start["title"] == "socket_testbed, live"
    assert start["socket"]["sides"] == ["posterior", "right", "anterior", "left", "posterior"]
    assert start["metadata"]["side"] == ("", "left", "right")
    assert [*start["metadata"]][:3] == ["subject", "side", "socket"]


def test_a_button_without_controls_is_refused(source: LiveSource) -> None:
    with refused(ConfigurationError, "the buttons are off", "--buttons"):
        source.act("tare", {})


# --- the moment


def test_the_moment_holds_the_newest_map(now: dict[str, Any]) -> None:
    moment = now["moment"]
    assert moment["time"] == 2.5
    pressure = [16.0, 8.0, 20.0, 30.0, 40.0, 2.0, 25.0, -1.0, 15.0, 4.5, 14.0, 6.0]
    assert moment["pressure"] == pytest.approx(pressure)
    assert moment["shear"][tile("ant_mid")] == pytest.approx(5.0)
    assert moment["shear"][tile("post_mid")] == pytest.approx(13.0)
    reach = [1.96] * 12
    reach[tile("left_mid")] = 15.68
    assert moment["reach"] == pytest.approx(reach, abs=0.005)
    assert moment["grey"][tile("left_mid")] == 1.0  # 15.7 of 5 kPa
    assert moment["grey"][tile("ant_mid")] == 0.0


def test_measured_pressures_are_in_the_socket_s_order(now: dict[str, Any]) -> None:
    """`posterior_distal` is absent, `distal` out of its range."""
    assert now["moment"]["measured"] == [30.0, 40.0, None, None]


def test_an_old_map_is_not_shown(graph: Graph, source: LiveSource, now: dict[str, Any]) -> None:
    graph.now += 1.9
    assert "pressure" in source.now(None)["moment"]
    graph.now += 0.2
    found = source.now(None)
    assert found["moment"] == {"time": 0.0, "words": "no force map"}
    assert found["wrench"][6] == ["Fz [N]", "none", "none"]
    assert "bars" not in found and len(found["cards"]) == 1


def test_a_map_of_another_socket_is_named(graph: Graph, source: LiveSource) -> None:
    graph.send(topics.FORCE_MAP, force_map(scene.TILES[::-1]), 0.0)
    found = source.now(None)
    assert found["moment"]["words"] == "no force map"
    assert found["cards"][-1]["words"] == (
        "the force map is of another socket: give 'view' its --geometry"
    )


def test_cards_and_map_are_of_one_message(graph: Graph, source: LiveSource) -> None:
    """The map of 2.5 s belongs to the regions of 2.5 s, not the newest one; so do the sensors."""
    graph.send(topics.WRENCH, wrench(-10.0), 0.0)
    send_all(graph, 2.5)
    later, pressed = force_map(), stresses()
    later.normal_pressure[tile("ant_mid")], pressed.clusters[1].normal = 55e3, 56e3
    graph.send(topics.FORCE_MAP, later, 2.75)
    graph.send(topics.STRESS, pressed, 2.75)
    moment = source.now(None)["moment"]
    assert moment["time"] == 2.5 and max(moment["pressure"]) == 40.0
    assert moment["measured"] == [30.0, 40.0, None, None]


def test_regions_wait_for_their_map(graph: Graph, source: LiveSource) -> None:
    graph.send(topics.WRENCH, wrench(-60.0), 2.5)
    graph.send(topics.REGIONS, regions(), 2.5)
    assert "bars" not in source.now(None)
    graph.send(topics.FORCE_MAP, force_map(), 2.5)
    found = source.now(None)
    assert found["cards"][0]["value"] == "62.2 kPa" and max(found["moment"]["pressure"]) == 40.0


def test_without_regions_the_newest_map_is_shown(graph: Graph, source: LiveSource) -> None:
    for seconds in (2.5, 2.75):
        graph.send(topics.FORCE_MAP, force_map(), seconds)
    found = source.now(None)
    assert max(found["moment"]["pressure"]) == 40.0 and len(found["cards"]) == 1


def test_shear_points_along_the_page(now: dict[str, Any]) -> None:
    """1, 2, 3 N in {S}: on `ant_mid` right is y and up is z; on the end right is -y, up is x."""
    arrows = now["moment"]["arrows"]
    assert arrows[tile("ant_mid")] == pytest.approx([2 / 0.9, 3 / 0.9], abs=0.01)
    assert arrows[tile("left_mid")] == pytest.approx([-1 / 0.9, 3 / 0.9], abs=0.01)
    assert arrows[tile("ant_end")] == pytest.approx([-2 / 0.9, 1 / 0.9], abs=0.01)


# --- cards, bars and the table of wrenches


def test_cards_name_peak_and_place(now: dict[str, Any]) -> None:
    """The socket is region 22, the wall without a sensor 21: 2.2 and 2.1 kPa more."""
    peak, elsewhere, _ = now["cards"]
    assert peak == {
        "title": "Peak now", "value": "62.2 kPa", "interval": "60.2 to 65.2",
        "words": "anterior middle, measured by mid_anterior",
    }  # fmt: skip
    assert elsewhere == {
        "title": "Elsewhere now", "value": "62.1 kPa", "interval": "60.1 to 65.1",
        "words": "highest where no sensor is: posterior proximal",
    }  # fmt: skip


BARS = {
    # value, low, high of the first region, and of the second
    "mean pressure [kPa]": ((20.0, 18.0, 23.0), (20.1, 18.1, 23.1)),
    "peak pressure [kPa]": ((60.0, 58.0, 63.0), (60.1, 58.1, 63.1)),
    # Of the map: three tiles of 9 cm^2 each, all above 5 kPa with all of their intervals.
    "contact area [cm^2]": ((27.0, 27.0, 27.0), (27.0, 27.0, 27.0)),
    "shear [kPa]": ((5.0, 4.0, 7.0), (5.1, 4.1, 7.1)),
    "share of load [%]": ((25.0, 12.5, 50.0), (26.0, 13.5, 51.0)),
}


@pytest.mark.parametrize("title", BARS)
def test_bars_hold_the_regions(title: str, now: dict[str, Any]) -> None:
    bars = now["bars"]
    assert bars["regions"] == [*SIDES, *LEVELS, *REGIONS[-4:]]
    assert tuple(bars["values"]) == (
        *("mean pressure [kPa]", "peak pressure [kPa]", "contact area [cm^2]"),
        *("share of load [%]", "shear [kPa]", "pressure-time integral, last 30 s [kPa s]"),
    )
    for found, answer in zip(bars["values"][title], BARS[title], strict=False):
        assert found == pytest.approx(answer)


def test_the_integral_is_of_the_last_half_minute(graph: Graph, source: LiveSource) -> None:
    """71 / 3 +-1.96 kPa on `anterior`, always in contact; `right_end` of 6 kPa, within 1.96."""
    for seconds in (0.0, 1.0, 2.0):
        send_all(graph, seconds)
        source.now(None)
    bars = source.now(None)["bars"]
    found = bars["values"]["pressure-time integral, last 30 s [kPa s]"]
    by_region = dict(zip(bars["regions"], found, strict=True))
    assert by_region["anterior"] == pytest.approx((47.3333, 43.4133, 51.2533), abs=1e-3)
    assert by_region["right"] == pytest.approx((24.0, 18.6933, 26.6133), abs=1e-3)


def test_the_wrench_table_tells_measured_from_predicted(now: dict[str, Any]) -> None:
    assert now["wrench"] == [
        ["", "measured", "predicted"],
        ["Mx [N m]", "0.25", "0.12"],
        ["My [N m]", "0.50", "0.50"],
        ["Mz [N m]", "0.75", "0.75"],
        ["Fx [N]", "14.00", "14.00"],
        ["Fy [N]", "3.00", "3.00"],
        ["Fz [N]", "-60.00", "-55.00"],
    ]


# --- the course


def test_the_course_holds_load_and_peak(
    graph: Graph, source: LiveSource, now: dict[str, Any]
) -> None:
    """The force along the socket is positive when pressed; times are since the first wrench."""
    graph.now += 0.5
    send_all(graph, 3.0, fz=-75.0)
    course = source.now(None)["course"]
    assert course["time"] == [2.5, 3.0] and course["force"] == [60.0, 75.0]
    ends = [course[name][1] for name in ("low", "peak", "high")]
    assert ends == pytest.approx([60.2, 62.2, 65.2])
    assert course["events"] == []


def test_the_course_keeps_half_a_minute(graph: Graph, source: LiveSource) -> None:
    for seconds in (0.0, 10.0, 30.0, 30.5):
        send_all(graph, seconds)
        source.now(None)
    assert source.now(None)["course"]["time"] == [10.0, 30.0, 30.5]


def test_a_restart_begins_a_new_course(graph: Graph, source: LiveSource) -> None:
    send_all(graph, 20.0)
    source.now(None)
    send_all(graph, 5.0)
    source.now(None)
    send_all(graph, 6.0)
    found = source.now(None)
    assert found["course"]["time"] == [0.0, 1.0]
    assert found["moment"]["time"] == 1.0


def test_a_load_without_its_wrench_is_unknown(graph: Graph, source: LiveSource) -> None:
    graph.send(topics.WRENCH, wrench(-60.0), 0.0)
    graph.send(topics.FORCE_MAP, force_map(), 0.25)
    graph.send(topics.REGIONS, regions(), 0.25)
    course = source.now(None)["course"]
    assert course["time"] == [0.25] and course["force"] == [None]


# --- the sensors and the data


def test_sensors_are_listed_with_sign_and_rate(graph: Graph, source: LiveSource) -> None:
    """200 samples more in 2 s; other namespaces and the page itself are not listed."""
    for count in (100, 300):
        graph.report("/lab/cluster_node", 0, "four clusters", samples=count)
        graph.report("/lab/load_cell_node", 1, "a channel is weak", samples=count // 2)
        graph.report("/lab/mocap_node", 2, "no camera")
        graph.report("/other/trigger_node", 2, "not ours")
        graph.report("/lab/view_node", 2, "itself")
        graph.now += 2.0 * (count == 100)
    assert source.now(None)["sensors"] == [
        [SIGNS["ok"], "cluster", "four clusters", "100 Hz"],
        [SIGNS["warn"], "load cell", "a channel is weak", "50 Hz"],
        [SIGNS["error"], "mocap", "no camera", ""],
    ]


def test_a_restarted_node_has_no_rate_yet(graph: Graph, source: LiveSource) -> None:
    for count in (300, 10):
        graph.report("/lab/cluster_node", 0, "four clusters", samples=count)
        graph.now += 2.0
    assert source.now(None)["sensors"][0][3] == ""


def test_a_silent_node_is_an_error(graph: Graph, source: LiveSource) -> None:
    """More than three reports late, which come each second."""
    graph.report("/lab/cluster_node", 0, "four clusters")
    graph.now += 2.9
    assert source.now(None)["sensors"][0][0] == SIGNS["ok"]
    graph.now += 1.1
    assert source.now(None)["sensors"] == [
        [SIGNS["error"], "cluster", "silent for 4 s; it said: four clusters", ""]
    ]


def data_card(source: LiveSource) -> dict[str, Any]:
    return source.now(None)["cards"][-1]


def test_the_data_is_good_if_all_nodes_are(graph: Graph, source: LiveSource) -> None:
    graph.report("/lab/cluster_node", 0, "four clusters")
    graph.report("/lab/mocap_node", 0, "two bodies")
    assert data_card(source) == {
        "title": "Data", "value": "good", "words": "all 2 nodes report OK",
    }  # fmt: skip


def test_the_worst_problem_comes_first(graph: Graph, source: LiveSource) -> None:
    graph.report("/lab/cluster_node", 1, "one cluster is late")
    graph.report("/lab/mocap_node", 2, "no camera")
    graph.report("/lab/recorder_node", 0, "ready", free=0)
    assert data_card(source) == {
        "title": "Data", "value": "check", "words": "mocap: no camera (and 1 more)", "bad": True,
    }  # fmt: skip


def test_the_estimator_s_finding_is_said_plainly(graph: Graph, source: LiveSource) -> None:
    graph.report("/lab/estimator_node", 1, "data: check distal: it is noisy; check its cable")
    assert data_card(source)["words"] == "distal: it is noisy; check its cable"


def test_a_cluster_s_fault_begins_with_its_name(graph: Graph, source: LiveSource) -> None:
    graph.report("/lab/cluster_node", 2, "distal: no answer: check its plug")
    assert data_card(source)["words"] == "distal: no answer: check its plug"
    graph.report("/lab/cluster_node", 2, "the bus is gone: check the adapter")
    assert data_card(source)["words"] == "cluster: the bus is gone: check the adapter"


def test_without_nodes_there_is_no_data(source: LiveSource) -> None:
    assert data_card(source) == {
        "title": "Data", "value": "none", "words": "no data from the testbed", "bad": True,
    }  # fmt: skip


# --- the recording


def test_a_recording_has_its_time_and_space(graph: Graph, source: LiveSource) -> None:
    """Reported after 88 s, two seconds ago; 12.5e9 bytes."""
    graph.heard[topics.RECORDED_TRIAL](String(data="walk"))
    graph.report("/lab/recorder_node", 0, "recording", elapsed=88.0, free=12.5e9)
    graph.now += 2.0
    assert source.now(None)["recording"] == {
        "on": True, "words": "recording walk for 0:01:30, 12.5 GB free",
    }  # fmt: skip


def test_no_recording_is_said(graph: Graph, source: LiveSource) -> None:
    assert source.now(None)["recording"] == {"on": False, "words": "nothing is being recorded"}
    graph.report("/lab/recorder_node", 0, "ready", elapsed=0.0, free=3e9)
    assert source.now(None)["recording"]["words"] == "nothing is being recorded, 3.0 GB free"


def test_a_recorder_that_ended_records_nothing(graph: Graph, source: LiveSource) -> None:
    graph.heard[topics.RECORDED_TRIAL](String(data="walk"))
    assert source.now(None)["recording"]["on"] is True
    graph.recorders = 0
    assert source.now(None)["recording"]["on"] is False
