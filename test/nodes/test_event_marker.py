"""The stamp of an event by triggers that arrive late, in bursts, or of a slower testbed."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import HANGS
from support.graph import Probe

from socket_testbed.nodes import event_marker, service_controls
from socket_testbed.nodes.event_marker import EventMarker, stamp_by_triggers
from socket_testbed.trials.topics import EVENT

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
import os, signal, rclpy
from socket_testbed_msgs.msg import Event
rclpy.init()
node = rclpy.create_node("stopped")
node.create_subscription(Event, "event", lambda event: None, 10)
while not node.count_publishers("event"):
    rclpy.spin_once(node, timeout_sec=0.05)
os.kill(os.getpid(), signal.SIGSTOP)
rclpy.spin(node)
"""


@pytest.mark.graph
def test_a_subscriber_that_is_stopped_holds_up_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An event waits for it to go on, while the node's other threads work."""
    monkeypatch.setattr(event_marker, "_TRIGGERED_WITHIN", 0.0)
    monkeypatch.setattr(event_marker, "_HEARD_WITHIN", HANGS)
    polls: list[float] = []
    program = [sys.executable, "-c", STOPPED]
    with Probe() as probe, subprocess.Popen(program, stdout=subprocess.PIPE) as stopped:
        heard = probe.listen(EVENT)

        def wait(condition: Callable[[], bool], duration: float) -> bool:
            def poll() -> bool:
                begin = time.monotonic()
                done = condition()
                polls.append(time.monotonic() - begin)
                if heard and not done:
                    stopped.send_signal(signal.SIGCONT)
                return done

            return service_controls._wait(poll, duration)

        marker = EventMarker(probe.node, wait)
        state = Path(f"/proc/{stopped.pid}/status")
        try:
            probe.wait(lambda: "T (stopped)" in state.read_text(), "it is stopped")
            assert marker.mark("push", time.monotonic()).subscribers == 2
        finally:
            stopped.kill()
    assert heard and max(polls) < 2.0  # [s]; to wait for it in one go takes 5 s
