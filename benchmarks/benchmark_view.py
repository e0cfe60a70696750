"""What the live page costs: processor time of its node, and the latency of the estimates.

The simulated testbed runs, and with it the page's node. Meanwhile none, one and five programs
read the page as browsers do, and drop what they read: a browser would take its own share of this
machine. Each number comes in every round, so that the load of a busy machine hits them alike.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

import numpy as np
from benchmark_acquisition import Arrivals, listening
from machine import describe_machine

from socket_testbed.__main__ import run as verb
from socket_testbed.clocks import BEGINNING, SteadyClock
from socket_testbed.live.bringup import end, simulated_testbed, start
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.trials.topics import ESTIMATED_WRENCH, FORCE_MAP, TRIGGER

PORT = 8437
PERIOD = 0.15  # [s]; between a page's questions
TICK = os.sysconf("SC_CLK_TCK")  # [Hz]


def browse(count: int) -> None:
    """Ask as so many pages do, and print how many answers came, until killed."""
    received = [0] * count

    def read(number: int) -> None:
        page = HTTPConnection("127.0.0.1", PORT)
        while True:
            page.request("GET", "/now")
            page.getresponse().read()
            received[number] += 1
            time.sleep(PERIOD)

    for number in range(count):
        threading.Thread(target=read, args=(number,), daemon=True).start()
    for _ in sys.stdin:
        print(sum(received), flush=True)


class Browsers:
    """Programs that read the page."""

    def __init__(self, count: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--browse", str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def messages(self) -> int:
        """How many messages have come to all of them."""
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        """End them."""
        self._process.kill()
        self._process.wait()


@contextmanager
def browsers(count: int):
    """So many browsers; their messages are counted."""
    found = Browsers(count)
    try:
        yield found
    finally:
        found.close()


def processor_seconds(pid: int) -> float:
    """Processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


@dataclasses.dataclass
class Phase:
    """What was measured with a number of browsers."""

    shares: list[float] = dataclasses.field(default_factory=list)
    windows: list[float] = dataclasses.field(default_factory=list)
    maps: list[np.ndarray] = dataclasses.field(default_factory=list)
    estimates: list[np.ndarray] = dataclasses.field(default_factory=list)


def since(arrivals: Arrivals, known: set[int]) -> np.ndarray:
    """Latencies of the messages that are not known [ms]."""
    return np.array([(a - s) * 1e-6 for s, a in arrivals.by_stamp.copy().items() if s not in known])


def percentiles(latencies: list[np.ndarray]) -> np.ndarray:
    """Median and 99th percentile [ms]; NaN where a machine that is too busy let nothing arrive."""
    found = np.concatenate(latencies)
    return np.percentile(found, [50, 99]) if len(found) else np.full(2, np.nan)


def measure(folder: Path, options: argparse.Namespace) -> dict[int, Phase]:
    """Run the testbed, with numbers of browsers in turn."""
    testbed = simulated_testbed(None, options.rate, Simulation("multi_direction", 60.0, 1))
    settings = testbed.settings
    estimator = dataclasses.replace(
        settings.estimator_node, model=str(folder / "model.json"), auto_fit=False
    )
    settings = dataclasses.replace(settings, estimator_node=estimator)
    testbed = dataclasses.replace(testbed, settings=settings, one_process=True)
    phases = {count: Phase() for count in (0, 1, 5)}
    with (
        (folder / "log").open("a") as log,
        listening(TRIGGER, FORCE_MAP, ESTIMATED_WRENCH) as (triggers, maps, estimates),
        Graph(log) as graph,
    ):
        start(graph, testbed)
        graph.start_nodes([GraphNode("view_node", ViewSettings(port=PORT))])
        graph.watch(lambda: len(triggers.by_stamp) > 5 * options.rate, print)
        pid = graph._members["view_node"].process.pid
        for _ in range(options.rounds):
            for count, phase in phases.items():
                with browsers(count) as opened:
                    settle = time.monotonic() + 4.0
                    graph.watch(lambda ends=settle: time.monotonic() > ends, print)
                    known = [set(found.by_stamp) for found in (maps, estimates)]
                    before, read, began = (
                        processor_seconds(pid),
                        opened.messages(),
                        time.monotonic(),
                    )
                    ends = began + options.duration
                    graph.watch(lambda ends=ends: time.monotonic() > ends, print)
                    passed = time.monotonic() - began
                    phase.shares.append((processor_seconds(pid) - before) / passed)
                    phase.windows.append((opened.messages() - read) / passed / max(count, 1))
                    phase.maps.append(since(maps, known[0]))
                    phase.estimates.append(since(estimates, known[1]))
        end(graph, testbed)
    return phases


def main() -> None:
    """Print a row for each number of browsers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=100.0, help="of the trigger [Hz]")
    parser.add_argument("--duration", type=float, default=15.0, help="of each phase [s]")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--browse", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.browse is not None:
        browse(options.browse)
        return
    os.environ[BEGINNING] = str(SteadyClock().beginning)
    print(describe_machine(1), f"load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verb(["simulate", "-o", str(folder / "hold"), "--duration", "60"])
        verb(["fit", str(folder / "hold"), "-o", str(folder / "model.json")])
        phases = measure(folder, options)
    print("browsers  core [%]  messages/s each | map p50   p99 [ms] | estimate p50   p99 [ms]")
    for count, phase in phases.items():
        m50, m99 = percentiles(phase.maps)
        e50, e99 = percentiles(phase.estimates)
        print(
            f"{count:8}  {100 * np.median(phase.shares):8.1f}  {np.median(phase.windows):15.1f}"
            f" | {m50:7.1f}  {m99:4.1f}      | {e50:12.1f}  {e99:4.1f}"
        )
    print(f"load at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
