"""The live testbed on simulated hardware: what is lost, how late estimates are, what nodes cost.

The whole graph runs and records, and programs read its page as browsers do (they drop what they
read: a browser would take its own share of this machine). A subscriber outside takes the times at
which the trigger and its estimate arrive. The floor, in the same run: a bare relay, which
subscribes to the clusters' messages, decodes and publishes them, and does nothing else. With
`--foreign` other drivers' topics take the place of ours, which another program plays: a wrench at
500 Hz, two poses at 100 Hz and capacitances at 20 Hz.

Processor time is per trigger. On a machine that others use, a time scale below 1 lets the testbed
keep up; nodes then wake up more often for each trigger, so compare figures of one scale alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

import numpy as np
import rclpy
from machine import describe_machine, processes
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future

from socket_testbed.__main__ import run as verb
from socket_testbed.clocks import BEGINNING, SteadyClock
from socket_testbed.live.bringup import Testbed, end, simulated_testbed, start
from socket_testbed.live.processes import Graph, GraphNode, graph_environment
from socket_testbed.nodes.base import message_type, publisher_qos, subscriber_qos
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.alignment import (
    AlignSettings,
    LiveClusterSettings,
    LiveSourceSettings,
    LiveWrenchSettings,
)
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.description import summary
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.topics import (
    CAPACITANCE,
    ESTIMATED_WRENCH,
    REQUIRED,
    TRIGGER,
    Topic,
    match_topics,
)

sys.path.append(str(Path(__file__).parents[1] / "test"))
from support.foreign import CAPACITANCES, LIMB, SOCKET, WRENCH, simulate_foreign
from support.graph import Probe
from support.player import Player

RELAYED = Topic("relayed", CAPACITANCE.type)
SETTLED = 8.0  # [s]; after the first trigger: nodes are imported, the first model is fitted
PORT = 8437
PERIOD = 0.15  # [s]; between the questions of a page


class Arrivals:
    """When the messages of a topic arrived, by their stamps [ns]."""

    def __init__(self) -> None:
        self.by_stamp: dict[int, int] = {}
        self._clock = SteadyClock()

    def __call__(self, data: bytes) -> None:
        """Take a serialised message, whose header is its first field."""
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        self.by_stamp[seconds * 1_000_000_000 + nanoseconds] = self._clock.now()

    def percentiles(self) -> np.ndarray:
        """Median, 99th percentile and maximum of the time from stamp to arrival [ms]."""
        latencies = [(a - s) * 1e-6 for s, a in self.by_stamp.items()]
        return np.percentile(latencies, [50, 99, 100]) if latencies else np.full(3, np.nan)


@contextmanager
def listening(*topics: Topic) -> Iterator[list[Arrivals]]:
    """Subscribe as another program would."""
    rclpy.init()
    node = rclpy.create_node("latency")
    arrivals = [Arrivals() for _ in topics]
    for topic, arrival in zip(topics, arrivals, strict=True):
        kind = message_type(topic)
        node.create_subscription(kind, topic.name, arrival, subscriber_qos(topic), raw=True)
    executor, done = EventsExecutor(), Future()
    executor.add_node(node)

    def spin() -> None:
        while not done.done():
            executor.spin_until_future_complete(done, timeout_sec=0.2)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield arrivals
    finally:
        done.set_result(None)
        thread.join()
        executor.remove_node(node)
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()


def relay() -> None:
    """Publish every message of capacitances again; ends with the process that started it."""
    rclpy.init()
    node, kind = rclpy.create_node("bare_relay"), message_type(CAPACITANCE)
    publisher = node.create_publisher(kind, RELAYED.name, publisher_qos(RELAYED))
    node.create_subscription(kind, CAPACITANCE.name, publisher.publish, subscriber_qos(CAPACITANCE))
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        while True:
            executor.spin_until_future_complete(Future(), timeout_sec=1.0)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass


def browse(count: int) -> None:
    """Ask as so many pages do, until killed."""

    def read() -> None:
        page = HTTPConnection("127.0.0.1", PORT)
        while True:
            page.request("GET", "/now")
            page.getresponse().read()
            time.sleep(PERIOD)

    readers = [threading.Thread(target=read) for _ in range(count)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()


def play(bag: Path) -> None:
    """Publish what other drivers sent, again and again, until killed."""
    with Probe() as probe, Player(probe, bag):
        while True:
            time.sleep(1.0)


def processor_seconds(helpers: dict[int, str]) -> dict[str, float]:
    """Processor time of this process's descendants by what they are [s]."""
    times = processes()
    found: dict[str, float] = {}
    for process, (parent, seconds) in times.items():
        if parent == os.getpid():
            name = helpers.get(process) or name_of(process)
        elif times.get(parent, (0, 0.0))[0] == os.getpid():
            name = f"{name_of(parent)}: fits"
        else:
            continue
        found[name] = found.get(name, 0.0) + seconds
    return found


def name_of(process: int) -> str:
    """The node of a process, or its module."""
    words = Path(f"/proc/{process}/cmdline").read_bytes().decode().split("\0")
    after = words.index("socket_testbed.nodes") + 1 if "socket_testbed.nodes" in words else 2
    return words[after] if after < len(words) else words[0]


def testbed_of(folder: Path, options: argparse.Namespace) -> Testbed:
    """The testbed to run, with a fitted model unless it fits its own in the background."""
    simulation = Simulation("multi_direction", 60.0, 1, time_scale=options.time_scale)
    testbed = simulated_testbed(folder / "trial", options.rate, simulation)
    testbed = dataclasses.replace(testbed, one_process=options.one_process)
    if options.foreign:
        settings = dataclasses.replace(
            testbed.settings,
            trigger_node=TriggerSettings(source="timer", rate=options.rate),
            align_node=AlignSettings(
                wrench=LiveWrenchSettings(topic=WRENCH, delay=0.02),
                socket_pose=LiveSourceSettings(topic=SOCKET),
                pylon_pose=LiveSourceSettings(topic=LIMB),
                clusters=LiveClusterSettings(topic=CAPACITANCES),
            ),
        )
        testbed = dataclasses.replace(testbed, simulation=None, settings=settings)
    if options.fits:
        return testbed
    model = folder / "model.json"
    verb(["simulate", "-o", str(folder / "hold"), "--duration", "60"])
    verb(["fit", str(folder / "hold"), "-o", str(model)])
    estimator = testbed.settings.estimator_node
    estimator = dataclasses.replace(estimator, model=str(model), auto_fit=False)
    settings = dataclasses.replace(testbed.settings, estimator_node=estimator)
    return dataclasses.replace(testbed, settings=settings)


def main() -> None:
    """Run the testbed once; print what came, when, and a row for each process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=100.0, help="of the trigger [Hz]")
    parser.add_argument("--duration", type=float, default=40.0, help="what is measured [s]")
    parser.add_argument("--time-scale", type=float, default=1.0)
    parser.add_argument("--one-process", action="store_true", help="most nodes share a process")
    parser.add_argument("--fits", action="store_true", help="fit models in the background")
    parser.add_argument("--foreign", action="store_true", help="other drivers, not ours")
    parser.add_argument("--browsers", type=int, help="serve the page, and read it so many times")
    options = parser.parse_args()
    os.environ |= graph_environment()  # the transports of `run`, without shared memory
    os.environ[BEGINNING] = str(SteadyClock().beginning)
    print(describe_machine(1), f"load {os.getloadavg()[0]:.1f}")
    context = multiprocessing.get_context("spawn")
    helpers = [context.Process(target=relay, name="bare relay", daemon=True)]
    if options.browsers:
        arguments = (options.browsers,)
        helpers.append(context.Process(target=browse, args=arguments, name="browsers", daemon=True))
    with tempfile.TemporaryDirectory() as name, (Path(name) / "log").open("w") as log:
        testbed = testbed_of(Path(name), options)
        if options.foreign:
            bag = Path(name) / "bag"
            simulate_foreign(bag, "multi_direction", duration=30.0)
            helpers.append(
                context.Process(target=play, args=(bag,), name="other drivers", daemon=True)
            )
        with (
            listening(TRIGGER, ESTIMATED_WRENCH) as (triggers, estimates),
            Graph(log) as graph,
        ):
            for helper in helpers:
                helper.start()
            names = {helper.pid: helper.name for helper in helpers}
            start(graph, testbed)
            if options.browsers is not None:
                graph.start_nodes([GraphNode("view_node", ViewSettings(port=PORT))])
            graph.watch(lambda: len(triggers.by_stamp) > 0, print)
            settled = time.monotonic() + SETTLED
            graph.watch(lambda: time.monotonic() > settled, print)
            before, count = processor_seconds(names), len(triggers.by_stamp)
            ends = time.monotonic() + options.duration
            graph.watch(lambda: time.monotonic() > ends, print)
            after, count = processor_seconds(names), len(triggers.by_stamp) - count
            end(graph, testbed)
        for helper in helpers:
            helper.kill()
            helper.join()
        spent = {who: after[who] - before.get(who, 0.0) for who in after}
        show_costs({who: each for who, each in spent.items() if each > 0.0}, count, options.rate)
        show_arrivals(testbed.record, triggers, estimates)


def show_costs(spent: dict[str, float], count: int, rate: float) -> None:
    """Print the processor time of each process, and of all nodes together."""
    helpers = ("bare relay", "browsers", "other drivers", "socket_testbed.simulation.testbed")
    spent["all nodes"] = sum(each for who, each in spent.items() if who not in helpers)
    relay = spent.setdefault("bare relay", 0.0)  # 0 if it used less than a tick of the kernel
    print(f"{'process':36} {'ms a trigger':>12} {f'% at {rate:g} Hz':>12} / relay")
    for who, seconds in sorted(spent.items(), key=lambda entry: entry[1]):
        each = seconds / max(count, 1)
        ratio = f"{seconds / relay:7.2f}" if relay else f"{'-':>7}"
        print(f"{who:36} {1e3 * each:12.2f} {100 * each * rate:12.1f} {ratio}")


def show_arrivals(path: Path, triggers: Arrivals, estimates: Arrivals) -> None:
    """Print what was recorded, and when it came."""
    with BagReader(path) as bag:
        recorded = {t: bag.counts[n] for t, n in match_topics(bag.types, "").items()}
    lost = sum(recorded[TRIGGER] - recorded[topic] for topic in REQUIRED)
    samples = Trial(path).samples()
    seen = samples.complete
    print(summary(path))
    print(f"messages lost: {lost}; incomplete samples: {(~seen).sum()} of {len(samples)}")
    for what, arrivals in (("trigger", triggers), ("estimate", estimates)):
        p50, p99, longest = arrivals.percentiles()
        print(f"{what:9} after the pulse: p50 {p50:.2f}, p99 {p99:.1f}, longest {longest:.0f} ms")


if __name__ == "__main__":
    main()
