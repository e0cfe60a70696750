"""A person at a testbed: the stamp of an event, each service, the status line."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from std_msgs.msg import String
from std_srvs.srv import SetBool
from std_srvs.srv import Trigger as TriggerService
from support import HANGS
from support.graph import Probe
from support.testbeds import LiveTestbed
from support.wording import refused

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.live.processes import Graph
from socket_testbed.nodes import controls as module
from socket_testbed.nodes.controls import ServiceControls, StatusListener
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.settings.testbed import RecorderSettings
from socket_testbed.simulation.devices.natnet_server import NatNetServer
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.trials.events import stamp_by_triggers
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import messages, topics
from socket_testbed.wire.cdr import stamp_of

EPOCH = 1_795_000_000_000_000_000  # [ns]


# --- the stamp of an event


class Heard:
    """A marker of events that hears triggers while it waits."""

    def __init__(self) -> None:
        self.waiting: list[tuple[float, int]] = []
        node = Mock()
        node.count_publishers.return_value, node.count_subscribers.return_value = 0, 1
        self.publisher = node.create_publisher.return_value
        self.publisher.get_subscription_count.return_value = 1
        self.marker = module.EventMarker(node, self.wait)

    def wait(self, condition: Callable[[], bool], _: float) -> bool:
        while self.waiting and not condition():
            self.marker._triggers.append(self.waiting.pop(0))
        return condition()


@pytest.fixture(scope="module")
def heard() -> Heard:
    """One for all scales in their order: it hears the triggers of testbeds before, too."""
    return Heard()


@pytest.mark.parametrize("late", [0, 8], ids=["punctual", "late"])
@pytest.mark.parametrize(
    "scale", [1.0, 0.25, 0.0625, 1.0], ids=["real", "quarter", "sixteenth", "real again"]
)
def test_an_event_has_the_time_of_its_call(
    scale: float, late: int, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Late triggers count little; those of a testbed before, at another scale, not at all."""
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: 100.0))
    rng = np.random.default_rng(1)
    sent = 0.05 / scale * np.arange(400)  # 20 Hz in testbed time
    delays = 0.002 * rng.exponential(size=400)
    delays[:late] = 0.9  # as while a busy machine discovers a subscriber
    delays[8::6] += rng.uniform(0.1, 0.25 + 0.05 / scale, size=66)
    arrivals = np.maximum.accumulate(100.0 + sent + delays)
    stamps = EPOCH + np.round(sent * scale * 1e9).astype(np.int64)
    heard.waiting[:] = zip(arrivals.tolist(), stamps.tolist(), strict=True)
    heard.marker.mark("push", 96.0)
    found = stamp_of(heard.publisher.publish.call_args.args[0])
    assert found == pytest.approx(EPOCH - 4e9 * scale, abs=1e7 * scale)


def test_one_trigger_is_in_real_time() -> None:
    assert stamp_by_triggers(99.0, [(100.0, EPOCH)]) == EPOCH - 10**9


def test_a_burst_alone_is_in_real_time() -> None:
    two = [(100.0, EPOCH), (100.0 + 1e-5, EPOCH + 250_000_000)]
    assert stamp_by_triggers(100.0, two) == pytest.approx(two[1][1], abs=1e5)


# --- the status line

PERIOD = 250_000_000  # [ns]
WRENCHES = np.arange(6.0)


def fed(*batches: list[tuple[topics.Topic, bytes]]) -> GraphStatus:
    """A status after messages that came in batches, between two looks of the terminal each."""
    status = GraphStatus()
    listener = StatusListener(status)
    inbox = listener._inbox
    for batch in batches:
        came = {topic: [data for own, data in batch if own is topic] for topic, _ in batch}
        listener._inbox = SimpleNamespace(
            take=lambda topic, came=came: came.get(topic, []), node=inbox.node
        )
        listener.take()
    listener._inbox = inbox
    listener.close()
    return status


@pytest.mark.parametrize("times", [1, 2], ids=["once", "time jumps back"])
def test_complete_samples_are_counted(times: int) -> None:
    capacitance, pose = messages.capacitance_packer(("p", "q")), messages.pose_packer()
    trigger, wrench = messages.trigger_packer(), messages.wrench_packer()
    sent: list[tuple[topics.Topic, bytes]] = []
    for k in range(40):  # of five one is complete
        stamp, lacking = k * PERIOD, [np.nan if k % 5 == n else 0.0 for n in range(3)]
        absent = (Status.MISSING, Status.SATURATED)[k % 2] * (k % 5 == 0)
        status = np.array([[0, 0, absent, 0], [0] * 4], np.uint8)
        sent += [
            (topics.TRIGGER, trigger(stamp, k)),
            (topics.CAPACITANCE, capacitance(stamp, np.ones((2, 4)), status)),
            (topics.WRENCH, b"of another layout"),
            (topics.WRENCH, wrench(stamp, np.append(WRENCHES[:5], 5.0 + lacking[1]))),
            (topics.SOCKET_POSE, pose(stamp, np.eye(7)[6] + lacking[2])),
        ]
        if k % 5 != 3:
            sent.append((topics.PYLON_POSE, pose(stamp, np.eye(7)[6])))
    status = fed(*([message] for message in sent * times))
    assert (status.triggers, status.complete) == (times * 40, times * 8)
    assert status.elapsed == pytest.approx(1e-9 * 39 * PERIOD)


def test_predictions_are_judged_over_the_last_seconds() -> None:
    """Off by (3, 0, 0) N and (0, 0.2, 0) N m, by more long before; each comes after its wrench."""
    found = []
    for k in range(100):
        off = [0.0, -0.2, 0.0, 30.0 if k < 52 else 3.0, 0.0, 0.0]
        wrenches = {topics.WRENCH: WRENCHES, topics.ESTIMATED_WRENCH: WRENCHES + off}
        pack = messages.wrench_packer()
        found.append([(topic, pack(k * PERIOD, own)) for topic, own in wrenches.items()])
    assert fed(found[0][:1]).errors() is None
    assert fed(*found).errors() == pytest.approx((np.sqrt(3.0), 0.2 / np.sqrt(3.0)))


@pytest.mark.graph
def test_motive_records_while_the_recorder_does(tmp_path: Path) -> None:
    server = NatNetServer(lambda _: [])
    settings = MocapSettings(server=server.address[0], command_port=server.address[1])
    try:
        with Probe() as probe, Graph() as graph:
            graph.start("mocap_node", settings)
            graph.start("recorder_node", RecorderSettings(directory=str(tmp_path)))
            answer = probe.call(SetBool, "recorder/record", SetBool.Request(data=True))
            name = answer.message.rpartition("/")[2]
            probe.wait(lambda: server.recording, "a take")
            assert server.takes == [name]
            probe.call(SetBool, "recorder/record", SetBool.Request(data=False))
            probe.wait(lambda: not server.recording, "the end of the take")
            # Any program of the network may name the trial that is recorded.
            probe.publisher(topics.RECORDED_TRIAL).publish(String(data="x,StopRecording\n../y"))
            words = "cannot be that of a take"
            probe.wait(lambda: bool(probe.said("mocap_node", words)), "the refusal")
            assert server.takes == [name] and not server.recording
    finally:
        server.close()


# --- one testbed for what follows: its nodes would answer for those above


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveTestbed]:
    """A testbed that records, with the pylon alone for minutes."""
    record = tmp_path_factory.mktemp("controls") / "s01"
    still = Simulation("static_hold", 1800.0)
    with LiveTestbed(record, simulation=still, one_process=True) as live:
        yield live


@pytest.mark.graph
def test_doctor_hears_what_the_nodes_report(live: LiveTestbed) -> None:
    """On a busy machine these are faults, which another subscriber hears as well."""
    live.probe.said("cluster_node")
    live.wait_for_triggers(3)
    states = module.reported_states(("cluster_node", "trigger_node"), within=HANGS)
    live.wait_for_triggers(8)
    for node in ("cluster_node", "trigger_node"):
        said = {(status.level[0], status.message) for status in live.probe.said(node)}
        assert states[node] in said


@pytest.mark.graph
def test_a_node_that_is_not_there_reports_nothing(live: LiveTestbed) -> None:
    assert module.reported_states(("mocap_node",), "/elsewhere", within=0.1) == {}


@pytest.fixture(scope="module")
def act(live: LiveTestbed) -> Iterator[Callable[..., str]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_ANSWER_TIMEOUT", HANGS)  # on a machine that others use
        patch.setattr(module, "_ACKNOWLEDGE_TIMEOUT", HANGS)
        controls = ServiceControls(live.probe.node)
        yield lambda what, **given: controls.act(what, given)


def force_tare(live: LiveTestbed) -> None:
    """Tare, even while it records; on a busy machine a reading may be late, and the load moves."""
    name, request = "load_cell/force_tare", TriggerService.Request()
    live.probe.wait(lambda: live.probe.call(TriggerService, name, request).success, "a tare")
    live.probe.wait(lambda: abs(live.wrenches[-1].wrench.force.z) < 5.0, "its wrenches")


@pytest.mark.graph
def test_a_trial_is_recorded_as_stated(live: LiveTestbed, act: Callable[..., str]) -> None:
    announced = live.probe.listen(topics.RECORDED_TRIAL)
    live.probe.wait(lambda: [m.data for m in announced][-1:] == ["s01"], "the first trial")
    with refused(TestbedError, "cannot tare: the trial s01 is being recorded"):
        act("tare")
    force_tare(live)
    live.wait_for_triggers(20)
    with refused(TestbedError, "s01 is being recorded: stop it first"):
        act("record", trial="stairs")
    assert "s01" in act("stop recording")
    with refused(TestbedError, "trial's name"):
        act("record", trial="../stairs")
    with refused(ConfigurationError, "mass is 'heavy'"):
        act("record", trial="stairs", mass="heavy")
    assert act("record", trial="stairs", subject="S02", mass="70").endswith("s01_stairs")
    live.wait_for_triggers(5)
    recorder = live.graph._members["recorder_node"].process
    events = live.probe.listen(topics.EVENT)
    with ThreadPoolExecutor() as pool:  # at once, while the recorder stands
        recorder.send_signal(signal.SIGSTOP)
        try:
            marking = [pool.submit(act, "mark", label=label) for label in ("push", "step")]
            live.probe.wait(lambda: bool(events), "the first event")
            live.wait_for_triggers(10)  # nobody else waits for the recorder
            assert not any(mark.done() for mark in marking)
        finally:
            recorder.send_signal(signal.SIGCONT)
    marked = [mark.result() for mark in marking]
    assert marked == [f"marked '{label}' in the trial s01_stairs" for label in ("push", "step")]
    live.wait_for_triggers(5)
    act("stop recording")
    assert live.testbed.record is not None
    trial = Trial(live.testbed.record.with_name("s01_stairs"))
    assert trial.metadata == TrialMetadata("S02", mass=70.0)
    (event,) = [event for event in trial.events() if event.label == "push"]
    assert 0.0 < event.time < trial.samples().time[-1] - trial.samples().time[0]
    # The tare is in the trial, and can be taken back.
    first = Trial(live.testbed.record)
    labels = [event.label for event in first.events() if event.source == "recorded"]
    assert labels and all(label.startswith("tare removed Mx ") for label in labels)
    assert np.nanmax(np.abs(first.samples().wrench[-10:, 5])) < 5.0
    untared = Trial(live.testbed.record, tare="none").samples().wrench[:, 5]
    assert np.nanmax(np.abs(np.abs(untared) - 91.0)) < 5.0


@pytest.mark.graph
def test_triggers_stop_when_asked(live: LiveTestbed, act: Callable[..., str]) -> None:
    """While they rest, faults are seen all the same."""
    act("trigger-off")
    live.wait_for("trigger_node", "WARN", "not enabled: call trigger/enable")
    live.switch("clusters.nack", 1)
    live.wait_for("cluster_node", "ERROR", "channel 0")
    count = len(live.triggers)
    live.switch("clusters.nack", 0)
    live.wait_for("cluster_node", "OK")
    assert len(live.triggers) == count
    act("trigger-on")
    live.wait_for_triggers(40)
    assert {int(step) for step in np.diff([m.sequence for m in live.triggers])} == {1}
    stamps = [stamp_of(message) for message in live.triggers[count:]]
    assert 1e-9 * np.median(np.diff(stamps)) == pytest.approx(0.05, abs=2e-3)


@pytest.mark.graph
@pytest.mark.parametrize(
    ("node", "name", "least", "most"),
    [
        ("mocap_node", "averaged_frames", 10, 14),
        ("load_cell_node", "averaged_conversions", 22, 28),
    ],
    ids=["motion capture", "load cell"],
)
def test_a_mean_is_over_its_window(
    node: str, name: str, least: int, most: int, live: LiveTestbed
) -> None:
    """50 ms at 240 frames and 500 conversions a second, half of it after the trigger."""
    live.probe.wait(lambda: live.probe.figure(node, name) >= least, name)
    assert live.probe.figure(node, name) <= most


@pytest.mark.graph
def test_the_delay_is_half_the_window(live: LiveTestbed) -> None:
    live.probe.wait(lambda: live.probe.figure("mocap_node", "delay") > 0.02, "the delay")


@pytest.mark.graph
def test_a_tare_outlives_a_kill(live: LiveTestbed, act: Callable[..., str]) -> None:
    """91 N of pylon are taken off, and stay off."""
    act("stop recording")  # a tare would be refused
    force_tare(live)
    live.kill("testbed")
    count = len(live.wrenches)
    live.probe.wait(
        lambda: any(np.isfinite(m.wrench.force.z) for m in live.wrenches[count + 5 :]),
        "wrenches again",
    )
    assert np.nanmax(np.abs([m.wrench.force.z for m in live.wrenches[count:]])) < 5.0
