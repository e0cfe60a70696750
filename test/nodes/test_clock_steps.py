"""A system clock that is set while ROS waits: nobody falls silent, and everything is recorded."""

import sys
from pathlib import Path

import pytest
from support.clocks import SystemClock
from support.testbeds import MEASURED, LiveTestbed, Recorded
from support.verbs import program

from socket_testbed.wire.topics import WRENCH

pytestmark = pytest.mark.graph

NODES = ("trigger", "cluster", "load_cell", "mocap", "calibration", "estimator", "recorder")

# Calls of a timer of 0.05 s, up to ten, within 5 s of each setting of the clock.
CALLS = """
import os, struct, sys, threading, time
import rclpy
from socket_testbed.nodes.__main__ import _spin
from socket_testbed.nodes.base import TestbedNode, Waker
from socket_testbed.settings.fields import Settings

def set_clock(shift):
    with open(os.environ["SET_CLOCK"], "r+b") as file:
        file.write(struct.pack("q", round(1e9 * shift)))

def drive():
    for shift in (0, 3600, -7200, 0, -2):
        set_clock(shift)
        calls.clear()
        ends = time.monotonic() + 5.0
        while len(calls) < 10 and time.monotonic() < ends:
            time.sleep(0.01)
        print(f"{shift:+d} s: {min(len(calls), 10)} calls", flush=True)
    node.finished.set_result(None)

rclpy.init()
calls = []
node = TestbedNode("worker", Settings)
node.repeat(0.05, lambda: calls.append(1))
threading.Thread(target=drive, daemon=True).start()
if "verb" in sys.argv:
    with Waker([node]):
        while not node.finished.done():
            rclpy.spin_once(node, timeout_sec=0.1)
else:
    _spin([node])
os._exit(0)
"""


@pytest.mark.parametrize("spun", ["node", "verb"])
def test_timers_go_on_through_clock_steps(spun: str, tmp_path: Path) -> None:
    """As the program of the nodes spins them, and as a verb does."""
    clock = SystemClock(tmp_path)
    code, said, _ = program(sys.executable, "-c", CALLS, spun, **clock.environment)
    calls = [line for line in said.splitlines() if line.endswith(" calls")]  # not DDS's own words
    assert (code, calls) == (
        0,
        [f"{shift} s: 10 calls" for shift in ("+0", "+3600", "-7200", "+0", "-2")],
    )


@pytest.mark.slow
def test_nobody_falls_silent_after_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two hours back: reports, faults, the recorder's flush, and every value."""
    clock = SystemClock(tmp_path)
    for name, value in clock.environment.items():
        monkeypatch.setenv(name, value)
    with LiveTestbed(tmp_path / "trial") as live:
        live.wait_for_triggers(20)
        clock.set(-7200.0)
        seen = {node: len(live.probe.said(f"{node}_node")) for node in NODES}
        for node, before in seen.items():
            live.probe.wait(
                lambda node=node, before=before: len(live.probe.said(f"{node}_node")) > before + 3,
                f"reports of {node}_node",
            )
        live.switch("load_cell.unplugged", 1)
        live.wait_for("load_cell_node", "ERROR", "spidev0.0")
        live.switch("load_cell.unplugged", 0)
        live.wait_for("load_cell_node", "OK")
        live.wait_for_triggers(20)
    recorded = Recorded(tmp_path / "trial")
    assert not recorded.notes
    assert recorded.lacking() == dict.fromkeys((topic.name for topic in MEASURED), 0)
    assert recorded.check_values()[WRENCH.name] > 0
