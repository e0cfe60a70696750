"""The nodes that measure, one at a time and without a graph: messages, counts, health in words.

The instruments are stand-ins whose readings are literals.
"""

import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import String
from support import HANGS, scene
from support.clocks import FakeClock
from support.nodes import Maker, running_ros
from support.wording import refused

from socket_testbed import clocks
from socket_testbed.calibration.model import write_calibration
from socket_testbed.drivers.clusters.reader import ClusterReading
from socket_testbed.drivers.gpio import GpioTrigger
from socket_testbed.drivers.load_cell.load_cell import WrenchReading
from socket_testbed.drivers.natnet.tracker import SeenBody
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.geometry.socket import write_socket
from socket_testbed.nodes import cluster_node, load_cell_node, mocap_node, trigger_node
from socket_testbed.nodes.calibration_node import CalibrationNode
from socket_testbed.samples import Status
from socket_testbed.simulation.devices.gpio import SimulatedLines
from socket_testbed.simulation.world import FAULTS
from socket_testbed.wire.messages import Capacitances

OK, WARN, ERROR = 0, 1, 2
STAMP = scene.START + 12 * 10**9
STAMP_PARTS = (1_800_000_012, 0)  # [s], [ns]


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with running_ros():
        yield


def stamp_of(message: Any) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


# --- names


@pytest.mark.parametrize(
    ("fixture", "name"),
    [
        ("calibrating", "calibration_node"),
        ("reading", "cluster_node"),
        ("weighing", "load_cell_node"),
        ("seeing", "mocap_node"),
        ("triggering", "trigger_node"),
    ],
)
def test_a_node_has_its_name(fixture: str, name: str, request: pytest.FixtureRequest) -> None:
    """Diagnostics, parameters and other nodes call it by this."""
    assert request.getfixturevalue(fixture).get_name() == name


# --- the calibration node


@pytest.fixture
def calibrating(make: Maker, tmp_path: Path) -> CalibrationNode:
    write_calibration(scene.calibration(), tmp_path / "calibration.yaml")
    return make(CalibrationNode, calibration=tmp_path / "calibration.yaml")


def readings(*names: str, status: tuple[int, ...] = ()) -> Capacitances:
    """The readings of the scene at 12.0 s; those of an unknown cluster are 5 pF."""
    own = [
        scene.capacitances(name)[scene.PEAK_ROW] if name in scene.CLUSTERS else np.full(4, 5.0)
        for name in names
    ]
    states = np.zeros((len(names), 4), np.uint8)
    states[:, 0] = status or 0
    return Capacitances(names, np.array(own), states)


def test_the_calibration_node_publishes_the_known_stresses(
    calibrating: CalibrationNode, make: Maker
) -> None:
    calibrating._on_capacitance(STAMP, readings(*scene.CLUSTERS))
    (message,) = make.sent["clusters/stress"]
    assert stamp_of(message) == STAMP_PARTS and message.header.frame_id == "load_cell"
    found = {c.name: (c.normal, c.shear_x, c.shear_y, c.status) for c in message.clusters}
    assert found["brim_lateral"] == pytest.approx((45e3, -12e3, 9e3, 0))
    assert found["mid_anterior"] == pytest.approx((60e3, 6e3, 4.5e3, 0))
    assert calibrating.figures() == {"messages": 1, "newest_stamp": STAMP}
    assert make.state() == (OK, "4 clusters calibrated")


def test_an_uncalibrated_cluster_is_missing(calibrating: CalibrationNode, make: Maker) -> None:
    calibrating._on_capacitance(STAMP, readings("foreign", "distal"))
    (message,) = make.sent["clusters/stress"]
    foreign, distal = message.clusters
    assert (foreign.name, foreign.status) == ("foreign", 2) and np.isnan(foreign.normal)
    assert (distal.name, distal.status) == ("distal", 0)
    assert distal.normal == pytest.approx(21e3)
    expected = "no calibration for foreign: give these clusters' calibration.yaml"
    assert make.state() == (ERROR, expected)


def test_faulty_clusters_are_named_with_their_status(
    calibrating: CalibrationNode, make: Maker
) -> None:
    names = "brim_lateral", "mid_anterior", "distal"
    calibrating._on_capacitance(STAMP, readings(*names, status=(1, 0, 2)))
    assert make.state() == (WARN, "brim_lateral saturated, distal missing")
    calibrating._on_capacitance(STAMP, readings(*names))
    assert make.state() == (OK, "3 clusters calibrated")


# --- the cluster node


class Clusters:
    """Stands for the reader of two clusters; the second has no value on three inputs."""

    def __init__(self) -> None:
        self.faults: dict[str, tuple[str, ...]] = {"distal": ("no answer: check it",)}
        self.read_at: list[float] = []

    def read(self, moment: float) -> ClusterReading:
        self.read_at.append(moment)
        values = np.array([[5.0, 6.0, 7.0, 8.0], [9.0, np.nan, np.nan, np.nan]])
        status = np.array([[0, 0, 0, 0], [0, 1, 2, 2]], np.uint8)
        return ClusterReading(values, status, self.faults)

    def close(self) -> None: ...


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock().install(monkeypatch)


@pytest.fixture
def reader() -> Clusters:
    return Clusters()


@pytest.fixture
def reading(
    make: Maker, reader: Clusters, monkeypatch: pytest.MonkeyPatch
) -> cluster_node.ClusterNode:
    monkeypatch.setattr(cluster_node, "make_clusters", lambda settings: reader)
    monkeypatch.setattr("socket_testbed.nodes.sensor_node._IDLE_AFTER", 1e3)
    names = {"names": "[brim,distal]", "buses": "[1,3]", "channels": "[0,1]"}
    return make(cluster_node.ClusterNode, **names)


def test_the_cluster_node_publishes_what_it_reads(
    reading: cluster_node.ClusterNode, reader: Clusters, make: Maker
) -> None:
    reading.measure(STAMP, 7.5)
    (message,) = make.sent["clusters/capacitance"]
    assert stamp_of(message) == STAMP_PARTS
    brim, distal = message.clusters
    assert (brim.name, distal.name) == ("brim", "distal") and reader.read_at == [7.5]
    assert brim.capacitance.tolist() == [5.0, 6.0, 7.0, 8.0]
    assert distal.status.tolist() == [0, 1, 2, 2] and distal.capacitance[0] == 9.0
    assert reading.figures() == {"samples": 0, "missing_channels": 3}
    assert reading.device == "i2c-1, i2c-3"


def test_a_cluster_s_fault_is_reported_while_recent(
    clock: FakeClock, reading: cluster_node.ClusterNode, reader: Clusters
) -> None:
    assert reading.health() is None  # nothing is known yet
    reading.idle()
    assert reading.health() == (ERROR, "distal: no answer: check it")
    clock.sleep(0.79)
    assert reading.health() == (ERROR, "distal: no answer: check it")
    clock.sleep(0.02)  # 0.8 s after it
    reader.faults = {}
    assert reading.health() == (OK, "2 clusters answer")


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        pytest.param(
            {"distal": ("no answer: check it", "slow: check it")},
            "distal: no answer; distal: slow: check it",
            id="two",
        ),
        pytest.param({"brim": ("gone",), "distal": ("gone",)}, "gone", id="bus"),
    ],
)
def test_a_fault_names_its_clusters(
    faults: dict[str, tuple[str, ...]],
    expected: str,
    clock: FakeClock,
    reading: cluster_node.ClusterNode,
    reader: Clusters,
) -> None:
    """A fault of all clusters is that of their bus."""
    reader.faults = faults
    reading.idle()
    assert reading.health() == (ERROR, expected)


def test_a_hanging_bus_is_an_error(clock: FakeClock, reading: cluster_node.ClusterNode) -> None:
    reading.busy_since = clock.now
    clock.sleep(0.49)
    assert reading.health() is None
    clock.sleep(0.02)  # 0.5 s after the start
    expected = "a bus hangs: check the clusters' wires and supply"
    assert reading.health() == (ERROR, expected)


# --- what all nodes that measure share


def test_triggers_are_measured_in_order(
    reading: cluster_node.ClusterNode, reader: Clusters, make: Maker
) -> None:
    """The stamps are of now; the fourth trigger knows the period, that of three intervals."""
    first = reading.trigger_time.stamp(time.monotonic())
    stamps = [first + 1_000_000 * k for k in range(5)]
    for number, stamp in enumerate(stamps):
        reading._on_trigger(stamp, number)
    deadline = time.monotonic() + HANGS
    while reading.samples < 5 and time.monotonic() < deadline:
        time.sleep(1e-3)
    sent = [s * 10**9 + ns for s, ns in map(stamp_of, make.sent["clusters/capacitance"])]
    assert sent == stamps and reading.figures() == {"samples": 5, "missing_channels": 15}
    assert reading.period == pytest.approx(1e-3) and reading.busy_since is None


def test_a_fault_while_starting_is_a_warning(
    clock: FakeClock, reading: cluster_node.ClusterNode, make: Maker
) -> None:
    """A device has 5 s to answer."""
    reading.idle()
    reading.check()
    assert make.state() == (WARN, "starting: distal: no answer: check it")
    clock.sleep(5.1)
    reading.idle()
    reading.check()
    assert make.state() == (ERROR, "distal: no answer: check it")


def test_a_clock_set_between_starts_is_a_warning(
    clock: FakeClock, reading: cluster_node.ClusterNode, reader: Clusters, make: Maker
) -> None:
    """The process's own clock is 2.5 s behind: it was set back by as much."""
    clock.sleep(6.0)
    reader.faults = {}
    reading.idle()
    reading.trigger_time.shift = 2.5
    reading.check()
    assert make.state() == (
        WARN,
        "the system clock was set by -2.500 s between the starts of nodes: triggers are timed by"
        " their arrival, within 1 ms",
    )


def test_a_node_that_stopped_measuring_is_an_error(
    clock: FakeClock, reading: cluster_node.ClusterNode, make: Maker
) -> None:
    clock.sleep(6.0)
    reading._due.put(None)
    reading._measuring.join()
    reading.check()
    expected = "it stopped measuring: see what it printed, and start it again"
    assert make.state() == (ERROR, expected)


# --- the load-cell node

WRENCH = np.array([0.1, 0.2, 0.3, 14.0, 3.0, -90.0])
TARE = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])


class Cell:
    """Stands for the load cell: 25 conversions around each time, then a fault."""

    def __init__(self) -> None:
        self.converter = SimpleNamespace(poll_until=lambda stopped, wake: wake(), close=lambda: 0)
        self.spans: list[float] = []
        self.tares: list[tuple[int, bool]] = []
        self.fault, self.level = "", OK
        self.settings: Any = None

    def end_time(self, moment: float, span: float) -> float:
        return moment

    def ready(self, moment: float, span: float) -> bool:
        return True

    def wrench_at(self, moment: float, span: float) -> WrenchReading:
        self.spans.append(span)
        wrench, ratios = WRENCH, np.arange(6.0)
        if self.fault:
            wrench = ratios = np.full(6, np.nan)
        state = Status.MISSING if self.fault else Status.OK
        return WrenchReading(wrench, ratios, TARE, 5_000_000_007, state, 25, self.fault)

    def figures(self) -> dict[str, object]:
        return {"conversions": 1000}

    def tare(self, stamp: int, forced: bool) -> np.ndarray:
        self.tares.append((stamp, forced))
        return TARE

    def health(self, now: float) -> tuple[int, str]:
        return self.level, "500 conversions a second"


@pytest.fixture
def cell() -> Cell:
    return Cell()


@pytest.fixture
def weighing(
    make: Maker, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> load_cell_node.LoadCellNode:
    monkeypatch.setattr(load_cell_node, "make_load_cell", lambda settings: cell)
    monkeypatch.setattr(load_cell_node, "check_settings", lambda settings: None)
    monkeypatch.setattr("socket_testbed.nodes.sensor_node._IDLE_AFTER", 1e3)
    return make(load_cell_node.LoadCellNode)


def test_the_load_cell_node_publishes_wrench_and_raw(
    weighing: load_cell_node.LoadCellNode, cell: Cell, make: Maker
) -> None:
    """Ratios are sent in V/V. The span is the period of the triggers."""
    weighing.period = 0.2
    weighing.measure(STAMP, time.monotonic())
    (wrench,), (raw,) = make.sent["load_cell/wrench"], make.sent["load_cell/raw"]
    assert stamp_of(wrench) == stamp_of(raw) == STAMP_PARTS
    torque, force = wrench.wrench.torque, wrench.wrench.force
    assert (torque.x, torque.y, torque.z, force.x, force.y, force.z) == tuple(WRENCH)
    assert raw.ratios.tolist() == pytest.approx([0.0, 1e-3, 2e-3, 3e-3, 4e-3, 5e-3])
    assert (raw.tare.torque.y, raw.tare.force.y, raw.status) == (2.0, 5.0, 0)
    assert (raw.tared.sec, raw.tared.nanosec) == (5, 7)
    assert cell.spans == [0.2] and weighing.device == "spidev0.0"
    assert weighing.figures() == {
        "samples": 0,
        "missing": 0,
        "averaged_conversions": 25,
        "conversions": 1000,
    }


def test_a_missing_wrench_is_counted_and_explained(
    weighing: load_cell_node.LoadCellNode, cell: Cell, make: Maker
) -> None:
    words = "1 of 25 conversions around the trigger: relieve the computer if this happens often"
    cell.fault = words
    weighing.measure(STAMP, time.monotonic())
    assert weighing.figures()["missing"] == 1 and make.sent["load_cell/raw"][-1].status == 2
    assert np.isnan(make.sent["load_cell/wrench"][-1].wrench.force.z)
    assert weighing.health() == (WARN, words)
    cell.level = ERROR  # the converter's own fault comes first
    assert weighing.health() == (ERROR, "500 conversions a second")


def test_a_sound_load_cell_is_ok(weighing: load_cell_node.LoadCellNode, cell: Cell) -> None:
    assert weighing.health() == (OK, "500 conversions a second")
    assert cell.settings is weighing.settings


REMOVED = "removed Mx 1 N m, My 2 N m, Mz 3 N m, Fx 4 N, Fy 5 N, Fz 6 N"


@pytest.mark.parametrize("forced", [False, True], ids=["at rest", "forced"])
def test_a_tare_is_an_event(
    forced: bool, weighing: load_cell_node.LoadCellNode, cell: Cell, make: Maker
) -> None:
    assert weighing._taring.tare(forced=forced) == f"tared: {REMOVED}"
    ((stamp, was_forced),) = cell.tares
    (event,) = make.sent["event"]
    assert event.label == f"tare {REMOVED}" and was_forced is forced
    assert stamp_of(event) == divmod(stamp, 10**9)
    assert stamp == pytest.approx(time.time_ns(), abs=60e9)


def test_a_recorded_trial_refuses_a_tare(
    weighing: load_cell_node.LoadCellNode, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless its recorder has ended without a word."""
    weighing._taring._on_recorded(String(data="s01"))
    weighing._taring.tare()
    monkeypatch.setattr(weighing, "count_publishers", lambda name: int(name == "recorder/trial"))
    with refused(DeviceError, "cannot tare: the trial s01 is being recorded", "force_tare"):
        weighing._taring.tare()
    weighing._taring.tare(forced=True)
    assert [forced for _, forced in cell.tares] == [False, True]


def test_a_pressed_cluster_refuses_a_tare(
    weighing: load_cell_node.LoadCellNode, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless its stress is older than a second."""
    clock = FakeClock().install(monkeypatch)
    weighing._taring._on_stress(5, {"distal": (np.array([12.3e3, 0.0, 0.0]), 0)})
    words = "cannot tare: distal (12.3 kPa) is pressed by more than 5 kPa: take the limb out"
    with refused(DeviceError, words, "force_tare"):
        weighing._taring.tare()
    weighing._taring.tare(forced=True)
    clock.sleep(1.1)
    weighing._taring.tare()
    assert [forced for _, forced in cell.tares] == [True, False]


# --- the motion-capture node

SOCKET = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8])
PYLON = np.array([4.0, 5.0, 6.0, 0.0, 0.0, 0.0, 1.0])


class Bodies:
    """Stands for tracker and client: the socket over 12 frames, the pylon over 11."""

    def __init__(self) -> None:
        self.asked: list[tuple[float, float]] = []
        self.waited: list[float] = []
        self.fault = self.clock_fault = self.recording_fault = ""
        self.state = OK, "240 frames a second"
        self.takes: list[str | None] = []

    def wait(self, moment: float, until: float, window: float) -> None:
        self.waited.append(until - moment)

    def sample(self, moment: float, window: float) -> tuple[SeenBody, ...]:
        self.asked.append((moment, window))
        markers = np.arange(9.0).reshape(3, 3)
        pylon = SeenBody(markers + 10.0, np.full(7, np.nan) if self.fault else PYLON, 11)
        return SeenBody(markers, SOCKET, 12), pylon._replace(fault=self.fault)

    def set_recording(self, name: str | None) -> None:
        self.takes.append(name)
        if name == "a,b":
            raise ConfigurationError("the name cannot be that of a take", "give letters")

    def health(self, now: float) -> tuple[int, str]:
        return self.state

    def figures(self) -> dict[str, object]:
        return {"frames": 7}

    def add(self, frame: Any) -> None: ...

    def start(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture
def bodies() -> Bodies:
    return Bodies()


@pytest.fixture
def seeing(
    make: Maker, bodies: Bodies, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> mocap_node.MocapNode:
    monkeypatch.setattr(mocap_node, "BodyTracker", lambda *given: bodies)
    monkeypatch.setattr(mocap_node, "NatNetClient", lambda *given: bodies)
    monkeypatch.setattr("socket_testbed.nodes.sensor_node._IDLE_AFTER", 1e3)
    write_socket(scene.geometry(), tmp_path / "socket.yaml")
    return make(mocap_node.MocapNode, geometry=tmp_path / "socket.yaml", server="10.0.0.2")


def test_the_mocap_node_publishes_poses_and_markers(
    seeing: mocap_node.MocapNode, bodies: Bodies, make: Maker
) -> None:
    """It waits for half of the window and 50 ms more."""
    seeing.period = 0.1
    seeing.measure(STAMP, time.monotonic() - 0.5)
    (socket,), (pylon,) = make.sent["mocap/socket/pose"], make.sent["mocap/pylon/pose"]
    assert stamp_of(socket) == stamp_of(pylon) == STAMP_PARTS
    assert socket.header.frame_id == "world"
    position, turn = socket.pose.position, socket.pose.orientation
    assert (position.x, position.y, position.z, turn.z, turn.w) == (1.0, 2.0, 3.0, 0.6, 0.8)
    assert pylon.pose.position.x == 4.0
    (message,) = make.sent["mocap/markers"]
    assert [body.name for body in message.bodies] == ["socket", "pylon"]
    assert (message.bodies[0].markers[1].x, message.bodies[1].markers[1].x) == (3.0, 13.0)
    assert bodies.asked[-1][1] == 0.1 and bodies.waited == pytest.approx([0.05 + 0.05])
    figures = seeing.figures()
    assert figures["averaged_frames"] == 11 and figures["frames"] == 7
    assert 0.5 <= figures["delay"] < 0.5 + HANGS and figures["missing"] == 0
    assert seeing.device == "NatNet 10.0.0.2"


def test_the_bodies_are_on_tf(seeing: mocap_node.MocapNode, make: Maker) -> None:
    seeing.measure(STAMP, time.monotonic())
    (message,) = make.sent["tf"]
    assert [t.child_frame_id for t in message.transforms] == ["socket", "limb"]
    assert message.transforms[0].transform.translation.z == 3.0


def test_an_unseen_body_is_counted_and_explained(
    seeing: mocap_node.MocapNode, bodies: Bodies, make: Maker
) -> None:
    bodies.fault = "pylon: a marker is hidden"
    seeing.measure(STAMP, time.monotonic())
    assert np.isnan(make.sent["mocap/pylon/pose"][-1].pose.position.x)
    assert seeing.figures()["missing"] == 1
    assert seeing.health() == (WARN, "pylon: a marker is hidden")
    bodies.state = WARN, "the stream is in millimetres"  # what explains it comes first
    assert seeing.health() == (WARN, "the stream is in millimetres; pylon: a marker is hidden")
    bodies.clock_fault = "the clock is unknown"  # the cause of all others
    seeing.idle()
    assert seeing.health() == (WARN, "the clock is unknown")
    bodies.state = ERROR, "no frames"
    assert seeing.health() == (ERROR, "no frames")


def test_between_triggers_it_looks_at_settled_frames(
    clock: FakeClock, seeing: mocap_node.MocapNode, bodies: Bodies
) -> None:
    """50 ms ago, at single frames."""
    seeing.idle()
    assert bodies.asked == [(pytest.approx(clock.now - 0.05), 0.0)]


def test_motive_records_the_trial(seeing: mocap_node.MocapNode, bodies: Bodies) -> None:
    seeing._on_recorded(String(data="s01"))
    seeing._on_recorded(String())
    assert bodies.takes == ["s01", None]
    assert seeing.health() == (OK, "240 frames a second")


def test_a_refused_take_is_a_warning(seeing: mocap_node.MocapNode, bodies: Bodies) -> None:
    seeing._on_recorded(String(data="a,b"))
    expected = "no take is recorded: the name cannot be that of a take: give letters"
    assert seeing.health() == (WARN, expected)


def test_a_take_ends_with_its_recorder(seeing: mocap_node.MocapNode, bodies: Bodies) -> None:
    """At the fifth check in a row without a recorder: discovery may pause."""
    seeing._on_recorded(String(data="s01"))
    for _ in range(4):
        seeing.health()
    assert bodies.takes == ["s01"]
    seeing.health()
    assert bodies.takes == ["s01", None]


def test_motive_s_recording_fault_is_a_warning(
    seeing: mocap_node.MocapNode, bodies: Bodies
) -> None:
    bodies.recording_fault = "Motive does not record"
    assert seeing.health() == (WARN, "Motive does not record")
    bodies.state = WARN, "frames are late"
    assert seeing.health() == (WARN, "frames are late")


def test_without_takes_nothing_is_recorded(
    make: Maker, bodies: Bodies, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mocap_node, "BodyTracker", lambda *given: bodies)
    monkeypatch.setattr(mocap_node, "NatNetClient", lambda *given: bodies)
    make(mocap_node.MocapNode, record_takes="false")._on_recorded(String(data="s01"))
    assert bodies.takes == []


# --- the trigger node


@pytest.fixture
def triggering(make: Maker) -> trigger_node.TriggerNode:
    return make(trigger_node.TriggerNode, source="timer", rate=50.0)


def wait_for_triggers(make: Maker, count: int) -> list[Any]:
    deadline = time.monotonic() + HANGS
    while len(make.sent["trigger"]) < count and time.monotonic() < deadline:
        time.sleep(1e-3)
    return make.sent["trigger"]


def test_triggers_have_the_rate_and_a_sequence(
    triggering: trigger_node.TriggerNode, make: Maker
) -> None:
    sent = wait_for_triggers(make, 8)[:8]
    assert [message.sequence for message in sent] == [*range(1, 9)]
    stamps = [s * 10**9 + ns for s, ns in map(stamp_of, sent)]
    assert np.median(np.diff(stamps)) == pytest.approx(20e6, rel=0.2)
    assert stamps[0] == pytest.approx(time.time_ns(), abs=60e9)
    triggering.check()
    assert make.state() == (OK, "triggering at 50 Hz")
    figures = triggering.figures()
    assert figures["triggers"] >= 8 and figures["unseen"] == figures["stray_edges"] == 0


def test_a_slowed_testbed_publishes_its_clock(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    """The steady clock runs at half the speed: its time is that of the stamps."""
    monkeypatch.setattr(clocks, "_scale", 0.5)
    node = make(trigger_node.TriggerNode, source="timer", rate=50.0)
    before, _, after = node._epoch.now(), node._tick(), node._epoch.now()
    clock = make.sent["/clock"][-1].clock
    assert before <= clock.sec * 10**9 + clock.nanosec <= after


def test_in_real_time_there_is_no_clock(triggering: trigger_node.TriggerNode, make: Maker) -> None:
    wait_for_triggers(make, 1)
    assert "/clock" not in make.sent


def test_a_disabled_trigger_says_so(triggering: trigger_node.TriggerNode, make: Maker) -> None:
    wait_for_triggers(make, 1)
    assert triggering._on_enable(False) == "not triggering"
    triggering.check()
    assert make.state() == (WARN, "not enabled: call trigger/enable")
    assert triggering._on_enable(True) == "triggering"
    triggering.check()
    assert make.state() == (OK, "triggering at 50 Hz")


def test_another_testbed_s_trigger_is_an_error(
    triggering: trigger_node.TriggerNode, make: Maker
) -> None:
    own = wait_for_triggers(make, 1)[0]
    triggering._on_trigger(stamp_of(own)[0] * 10**9 + stamp_of(own)[1], 1)
    triggering.check()
    assert make.state()[0] == OK
    triggering._on_trigger(7, 1)
    triggering.check()
    level, text = make.state()
    assert level == ERROR and text.startswith("another trigger is active on this ROS_DOMAIN_ID:")


@pytest.mark.parametrize(
    ("step", "shown"),
    [
        pytest.param(3_650_000_000, "+3.6", id="forward"),
        pytest.param(-3_650_000_000, "-3.6", id="back"),
    ],
)
def test_a_step_of_the_clock_is_a_warning(
    step: int,
    shown: str,
    triggering: trigger_node.TriggerNode,
    make: Maker,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By 3.65 s, of which two digits do not depend on when the two clocks are read."""
    wait_for_triggers(make, 1)
    monkeypatch.setattr(triggering._epoch, "_wall", lambda: time.time_ns() + step)
    triggering.check()
    level, text = make.state()
    assert level == WARN and text.startswith(f"the system clock was set by {shown}")
    assert text.endswith("restart after the trial to adopt the new time")


def test_a_lost_pulse_leaves_a_gap(
    triggering: trigger_node.TriggerNode, make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_for_triggers(make, 2)

    def fail() -> float:
        raise DeviceError("no edge came back", "check the wire")

    with monkeypatch.context() as patch:
        patch.setattr(triggering._trigger, "fire", fail)
        deadline = time.monotonic() + HANGS
        while triggering.figures()["unseen"] < 2 and time.monotonic() < deadline:
            time.sleep(1e-3)
        triggering.check()
        assert make.state() == (ERROR, "no edge came back: check the wire")
    unseen = triggering.figures()["unseen"]
    sent = wait_for_triggers(make, len(make.sent["trigger"]) + 2)
    steps = np.diff([message.sequence for message in sent])
    assert unseen - 1 <= steps.max() - 1 <= unseen + 1


@pytest.fixture
def wired(make: Maker, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A trigger node on lines whose chip can be unplugged, with its faults."""
    faults = dict.fromkeys(FAULTS, 0.0)
    monkeypatch.setattr(
        trigger_node, "make_trigger", lambda own: GpioTrigger(SimulatedLines(faults), own)
    )
    # A busy machine delays the simulated wire.
    node = make(trigger_node.TriggerNode, source="gpio", rate=50.0, edge_within=0.1)
    return SimpleNamespace(node=node, faults=faults)


def test_a_lost_chip_is_opened_again(wired: Any, make: Maker) -> None:
    wait_for_triggers(make, 2)
    wired.faults["trigger.unplugged"] = 1.0
    deadline = time.monotonic() + HANGS
    while not wired.node.figures()["unseen"] and time.monotonic() < deadline:
        time.sleep(1e-3)
    wired.node.check()
    level, text = make.state()
    assert level == ERROR and text.startswith("the GPIO lines of pinctrl-rp1 are gone (")
    assert text.endswith("check the chip's overlay or adapter; it is opened again automatically")
    wired.faults["trigger.unplugged"] = 0.0
    sent = wait_for_triggers(make, len(make.sent["trigger"]) + 3)
    numbers = [message.sequence for message in sent]
    assert numbers == sorted(set(numbers)) and wired.node.figures()["unseen"] == 1


@pytest.mark.parametrize(
    ("is_open", "waits"), [(False, [2.5]), (True, [])], ids=["chip away", "pulse lost"]
)
def test_a_chip_that_is_away_is_opened_after_a_pause(
    is_open: bool, waits: list[float], clock: FakeClock
) -> None:
    """A pulse that only got lost is followed by the next one at once."""

    def fail() -> Any:
        raise DeviceError("no chip", "plug it in")

    found: list[float] = []
    trigger = SimpleNamespace(fire=fail, end_pulse=lambda: None) if is_open else None
    own: Any = SimpleNamespace(
        _sequence=0,
        _unseen=0,
        _lost="",
        _trigger=trigger,
        _opened=lambda: trigger or fail(),
        _fault=SimpleNamespace(note=lambda text: None),
        _reopening=SimpleNamespace(failed=lambda now: 2.5),
        _stopping=SimpleNamespace(wait=found.append),
    )
    trigger_node.TriggerNode._fire(own)
    assert found == waits and own._unseen == is_open


def test_a_chip_that_was_away_costs_no_pulse(wired: Any, make: Maker) -> None:
    """It vanished and returned between two pulses."""
    wait_for_triggers(make, 2)
    wired.node._trigger._lines._is_gone = True
    sent = wait_for_triggers(make, len(make.sent["trigger"]) + 3)
    assert [message.sequence for message in sent] == [*range(1, len(sent) + 1)]
    assert wired.node.figures()["unseen"] == 0


def test_skipped_pulses_are_counted(clock: FakeClock) -> None:
    """At 10 Hz a pulse takes 0.45 s: the three that were due meanwhile are skipped."""
    fired: list[float] = []

    def fire() -> None:
        fired.append(clock.now)
        clock.sleep(0.45 if len(fired) == 1 else 0.01)

    def wait(seconds: float) -> bool:
        clock.sleep(seconds)
        return len(fired) == 3

    always = SimpleNamespace(is_set=lambda: True)
    own = SimpleNamespace(
        until_ros_ends=nullcontext,
        settings=SimpleNamespace(rate=10.0),
        _followers=SimpleNamespace(await_links=lambda patience: ""),
        _stopping=SimpleNamespace(is_set=lambda: False, wait=wait),
        _enabled=always,
        _trigger=None,
        _skipped=0,
        _stream=None,
        _fire=fire,
    )
    trigger_node.TriggerNode._run(own)
    assert fired == pytest.approx([100.1, 100.55, 100.65]) and own._skipped == 3
