"""Coming back: how long a node of the running testbed is away after kill -9.

The simulated testbed runs and records. Each node is killed in turn; the time runs from the kill to
the next message of the node at a subscriber that was there before, and for the recorder to the
first trigger in its next part and to the first sample that is complete there. The floors, in the
same run: a bare rclpy node with one subscription and one publisher that is killed and launched
again, until a trigger has passed through it; and the import of rclpy alone.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
from benchmark_acquisition import Arrivals, listening
from machine import describe_machine

from socket_testbed.clocks import BEGINNING, SteadyClock
from socket_testbed.live.bringup import end, simulated_testbed, start
from socket_testbed.live.processes import Graph
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.layout import decode, stamp_of
from socket_testbed.trials.topics import (
    CAPACITANCE,
    FORCE_MAP,
    REQUIRED,
    SOCKET_POSE,
    STRESS,
    TRIGGER,
    WRENCH,
    Topic,
)

OUTPUTS = {
    "trigger_node": TRIGGER,
    "cluster_node": CAPACITANCE,
    "load_cell_node": WRENCH,
    "mocap_node": SOCKET_POSE,
    "calibration_node": STRESS,
    "estimator_node": FORCE_MAP,
}
RELAYED = Topic("relayed", TRIGGER.type)
IMPORT = "import rclpy, rclpy.experimental.events_executor"
RELAY = f"""
{IMPORT}
from rclpy.task import Future
from socket_testbed_msgs.msg import Trigger
rclpy.init()
node = rclpy.create_node("relay")
publisher = node.create_publisher(Trigger, "{RELAYED.name}", 100)
node.create_subscription(Trigger, "{TRIGGER.name}", publisher.publish, 100, raw=True)
executor = rclpy.experimental.events_executor.EventsExecutor()
executor.add_node(node)
while rclpy.ok():
    executor.spin_until_future_complete(Future(), timeout_sec=0.5)
"""
HANGS = 30.0  # [s]


def launch(program: str) -> subprocess.Popen[bytes]:
    """Start a program."""
    return subprocess.Popen([sys.executable, "-c", program])


def import_time() -> float:
    """Time to start Python and import rclpy [s]."""
    began = time.monotonic()
    launch(IMPORT).wait()
    return time.monotonic() - began


class Away:
    """Waits for the messages that follow a kill."""

    def __init__(self, arrivals: dict[str, Arrivals]) -> None:
        self._arrivals = arrivals
        self._clock = SteadyClock()

    def measure(self, name: str, kill: Callable[[], None]) -> float:
        """Time from a kill to the first message that belongs to a trigger after it [s]."""
        killed = self._clock.now()
        kill()
        while (self._clock.now() - killed) * 1e-9 < HANGS:
            # The newest are at the end; nothing older is looked at twice.
            later = [a for s, a in self._arrivals[name].by_stamp.copy().items() if s > killed]
            if later:
                return (later[0] - killed) * 1e-9
            time.sleep(0.02)
        return np.nan


def first_recorded(part: Path) -> tuple[float, float]:
    """Time of the first trigger in a trial, and of what completes its first sample [ns]."""
    times: dict[int, dict[str, int]] = {}
    with BagReader(part) as bag:
        wanted = {f"/{topic.name}" for topic in REQUIRED}
        for raw in bag.messages(wanted):
            times.setdefault(stamp_of(decode(raw.data, raw.type)), {})[raw.topic] = raw.time
    first = (t["/trigger"] for t in times.values() if "/trigger" in t)
    complete = (max(t.values()) for t in times.values() if len(t) == len(wanted))
    return min(first, default=math.nan), min(complete, default=math.nan)


def run(folder: Path, options: argparse.Namespace) -> dict[str, list[float]]:
    """Times [s] by what was killed."""
    times: dict[str, list[float]] = {}
    recorder_kills: list[int] = []
    record = folder / "trial"
    testbed = simulated_testbed(record, options.rate, Simulation("multi_direction", 60.0, 1))
    done = threading.Event()
    clock = SteadyClock()
    with (
        (folder / "log").open("a") as log,
        listening(*OUTPUTS.values(), RELAYED) as arrivals,
        Graph(log) as graph,
    ):
        away = Away(dict(zip((*OUTPUTS, "relay"), arrivals, strict=True)))
        start(graph, testbed)
        watching = threading.Thread(target=graph.watch, args=(done.is_set, lambda line: None))
        watching.start()
        while not all(found.by_stamp for found in arrivals[:-1]):
            time.sleep(0.1)
        relay = launch(RELAY)

        def kill_relay() -> None:
            nonlocal relay
            relay.kill()
            relay.wait()
            relay = launch(RELAY)

        def kill(name: str) -> None:
            os.kill(graph._members[name].process.pid, signal.SIGKILL)

        for _ in range(options.rounds):
            for name in (*options.nodes, "relay"):
                time.sleep(options.settle)
                if name == "recorder_node":
                    recorder_kills.append(clock.now())
                    kill(name)
                    time.sleep(HANGS / 3.0)
                    continue  # how long it took is read from its trial
                found = away.measure(
                    name, kill_relay if name == "relay" else lambda name=name: kill(name)
                )
                times.setdefault(name, []).append(found)
            times.setdefault("import", []).append(import_time())
        relay.kill()
        relay.wait()
        time.sleep(options.settle)
        done.set()
        watching.join()
        end(graph, testbed)
    for i, killed in enumerate(recorder_kills):
        first, complete = first_recorded(record.with_name(f"trial_{2 + i}"))
        times.setdefault("recorder: trigger", []).append((first - killed) * 1e-9)
        times.setdefault("recorder: sample", []).append((complete - killed) * 1e-9)
    return times


def main() -> None:
    """Print a row for each node and for the floors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=10.0, help="of the trigger [Hz]")
    parser.add_argument("--nodes", nargs="+", default=[*OUTPUTS, "recorder_node"], metavar="NODE")
    parser.add_argument("--rounds", type=int, default=1, help="how often each node is killed")
    parser.add_argument("--settle", type=float, default=7.0, help="time between kills [s]")
    options = parser.parse_args()
    os.environ[BEGINNING] = str(SteadyClock().beginning)
    print(describe_machine(1), f"load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name:
        times = run(Path(name), options)
    floor = float(np.median(times["relay"]))
    print("away after kill -9 [s]      median     max  / bare relay")
    for name, found in times.items():
        print(
            f"{name:24} {np.median(found):9.2f} {max(found):7.2f} {np.median(found) / floor:13.2f}"
        )
    print(f"load at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
