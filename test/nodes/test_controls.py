"""What a person does to a testbed: the stamp of an event, and what came of each service."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from support import HANGS
from support.graph import Probe
from support.testbeds import LiveTestbed

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.nodes import controls as module
from socket_testbed.nodes.controls import EventMarker, ServiceControls, stamp_by_triggers
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.topics import EVENT, RECORDED_TRIAL
from socket_testbed.trials.trial import Trial

EPOCH = 1_795_000_000_000_000_000  # [ns]


def triggers(
    speed: float, delays: np.ndarray, period: float = 0.25
) -> tuple[list[tuple[float, int]], float]:
    """Arrivals [s] and stamps [ns] of triggers with delays [s], in the order of arrival.

    The period is in testbed time. The zero of the monotonic clock is EPOCH.
    """
    sent = 100.0 + period / speed * np.arange(len(delays))
    arrivals = np.maximum.accumulate(sent + delays)
    stamps = EPOCH + np.round(sent * speed * 1e9).astype(np.int64)
    return list(zip(arrivals.tolist(), stamps.tolist(), strict=True)), float(sent[0])


@pytest.mark.parametrize("speed", [1.0, 0.5, 0.25, 2.0])
@pytest.mark.parametrize("ago", [0.0, 2.0])
def test_the_stamp_is_when_it_was_called(speed: float, ago: float) -> None:
    late = 0.002 * np.random.default_rng(1).exponential(size=8)
    heard, begin = triggers(speed, late)
    called = begin - ago
    expected = EPOCH + round(called * speed * 1e9)
    assert abs(stamp_by_triggers(called, heard) - expected) < 20e6  # 20 ms


def test_triggers_that_a_busy_machine_held_up_count_little() -> None:
    delays = np.zeros(20)
    delays[[3, 4, 5]] = 0.8, 0.55, 0.3  # a burst
    delays[[9, 14, 17]] = 0.2, 0.4, 0.15
    heard, begin = triggers(1.0, delays)
    assert stamp_by_triggers(begin - 5.0, heard) == EPOCH + round((begin - 5.0) * 1e9)


def test_one_trigger_or_a_burst_alone_runs_in_real_time() -> None:
    one = [(100.0, EPOCH)]
    assert stamp_by_triggers(99.0, one) == EPOCH - 10**9
    burst = [(100.0, EPOCH), (100.0 + 1e-5, EPOCH + 250_000_000)]
    assert stamp_by_triggers(100.0, burst) == pytest.approx(EPOCH + 250_000_000, abs=1e5)


STOPPED = """
import rclpy
from socket_testbed_msgs.msg import Event
rclpy.init()
node = rclpy.create_node("stopped")
node.create_subscription(Event, "event", lambda event: None, 10)
rclpy.spin(node)
"""


@pytest.mark.graph
def test_a_subscriber_that_is_stopped_holds_up_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An event waits for it to go on, while the node's other threads work."""
    monkeypatch.setattr(module, "_TRIGGERED_WITHIN", 0.0)
    monkeypatch.setattr(module, "_HEARD_WITHIN", HANGS)
    polls: list[bool] = []
    program = [sys.executable, "-c", STOPPED]
    with Probe() as probe, subprocess.Popen(program, stdout=subprocess.PIPE) as stopped:
        heard = probe.listen(EVENT)

        def wait(condition: Callable[[], bool], duration: float) -> bool:
            def poll() -> bool:
                polls.append(condition())
                if heard and not polls[-1]:
                    stopped.send_signal(signal.SIGCONT)
                return polls[-1]

            return module._wait(poll, duration)

        marker = EventMarker(probe.node, wait)
        state = Path(f"/proc/{stopped.pid}/status")
        try:
            publisher = marker._publisher
            probe.wait(lambda: publisher.get_subscription_count() == 2, "it is found")
            stopped.send_signal(signal.SIGSTOP)
            probe.wait(lambda: "T (stopped)" in state.read_text(), "it is stopped")
            assert marker.mark("push", time.monotonic()).subscribers == 2
        finally:
            stopped.kill()
    assert heard and False in polls[:-1]  # asked again and again, not waited for in one go


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveTestbed]:
    record = tmp_path_factory.mktemp("controls") / "s01"
    with LiveTestbed(record, 10.0, Simulation("static_hold")) as live:
        yield live


@pytest.fixture(scope="module")
def controls(live: LiveTestbed) -> Iterator[ServiceControls]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_ANSWERS_WITHIN", HANGS)  # on a machine that others use
        yield ServiceControls(live.probe.node)


@pytest.mark.graph
def test_a_trial_is_recorded_with_a_name_and_metadata_and_an_event(
    live: LiveTestbed, controls: ServiceControls
) -> None:
    announced = live.probe.listen(RECORDED_TRIAL)
    live.probe.wait(lambda: [m.data for m in announced][-1:] == ["s01"], "the first trial")
    with pytest.raises(TestbedError, match="s01 is being recorded: stop it first"):
        controls.record("stairs", {})
    assert "s01" in controls.stop_recording()
    with pytest.raises(TestbedError, match="trial's name"):
        controls.record("../stairs", {})
    with pytest.raises(TestbedError, match="did you mean 'left'"):
        controls.record("stairs", {"side": "lft"})
    with pytest.raises(ConfigurationError, match="mass is 'heavy'"):
        controls.record("stairs", {"mass": "heavy"})
    assert controls.record("stairs", {"subject": "S02", "mass": "70"}).endswith("s01_stairs")
    live.wait_for_triggers(5)
    assert controls.event("push") == "marked 'push' in the trial s01_stairs"
    live.wait_for_triggers(5)
    controls.stop_recording()
    assert live.testbed.record is not None
    trial = Trial(live.testbed.record.with_name("s01_stairs"))
    assert trial.metadata == TrialMetadata("S02", mass=70.0)
    (event,) = [event for event in trial.events() if event.label == "push"]
    assert 0.0 < event.time < trial.samples().time[-1] - trial.samples().time[0]


@pytest.mark.graph
def test_events_that_are_marked_at_once_are_all_heard(
    live: LiveTestbed, controls: ServiceControls
) -> None:
    said: list[str] = []
    threads = [
        threading.Thread(target=lambda: said.append(controls.event("step"))) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(HANGS)
    assert len(said) == 2 and all(line.startswith("marked 'step'") for line in said)


@pytest.mark.graph
def test_the_testbed_is_tared_and_its_trigger_switched(
    live: LiveTestbed, controls: ServiceControls
) -> None:
    controls.trigger(False)
    live.wait_for("trigger_node", "WARN", "not enabled")
    controls.trigger(True)
    live.wait_for_triggers(3)

    def tared() -> bool:
        try:
            return controls.tare().startswith("tared")
        except TestbedError as error:
            assert "moves" in str(error)  # it is loaded just now
            return False

    live.probe.wait(tared, "a tare")
    live.probe.wait(lambda: abs(live.wrenches[-1].wrench.force.z) < 5.0, "the tare")


@pytest.mark.graph
def test_what_does_not_answer_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_FOUND_WITHIN", 0.1)
    with Probe() as probe:
        nowhere = rclpy.create_node("page", namespace="/nowhere", context=probe.context)
        alone = ServiceControls(nowhere)
        with pytest.raises(TestbedError, match="nobody offers load_cell/tare: check that load_"):
            alone.tare()
        with pytest.raises(TestbedError, match="start 'run' with --record DIR, or 'record DIR'"):
            alone.record("stairs", {})
        nowhere.destroy_node()
