"""The live testbed on simulated hardware: what is lost, how late the estimates are, what it costs.

For each rate and way of running, the whole graph runs and records for a while; a subscriber outside
takes the time at which the trigger and its estimate arrive. Latencies stand beside that of the bare
trigger, in the same run and to the same subscriber.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import resource
import struct
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import rclpy
from machine import describe_machine
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future

from socket_testbed.__main__ import run as verb
from socket_testbed.clocks import BEGINNING, SteadyClock
from socket_testbed.live.bringup import end, simulated_testbed, start
from socket_testbed.live.processes import Graph
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.nodes.base import message_type, subscriber_qos
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.topics import ESTIMATED_WRENCH, REQUIRED, TRIGGER, match_topics
from socket_testbed.trials.trial import Trial


class Arrivals:
    """When the messages of a topic arrived, by their stamps [ns]."""

    def __init__(self) -> None:
        self.by_stamp: dict[int, int] = {}
        self._clock = SteadyClock()

    def __call__(self, data: bytes) -> None:
        """Take a serialised message, whose header is its first field."""
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        self.by_stamp[seconds * 1_000_000_000 + nanoseconds] = self._clock.now()

    def latencies(self) -> np.ndarray:
        """Time from stamp to arrival, shape (n,) [ms]."""
        return np.array([(a - s) * 1e-6 for s, a in sorted(self.by_stamp.items())])


@contextmanager
def listening(*topics: object) -> Iterator[list[Arrivals]]:
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


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run showed."""

    triggers: int
    lost: int
    incomplete: int
    estimates: int
    trigger: np.ndarray
    estimate: np.ndarray
    cores: float


def measure(folder: Path, model: Path, rate: float, duration: float, one_process: bool) -> Result:
    """Run the testbed once."""
    path = folder / f"{rate:g}_{one_process}"
    testbed = simulated_testbed(path, rate, Simulation("multi_direction", 60.0, 1))
    estimator = dataclasses.replace(
        testbed.settings.estimator_node, model=str(model), auto_fit=False
    )
    settings = dataclasses.replace(testbed.settings, estimator_node=estimator)
    testbed = dataclasses.replace(testbed, settings=settings, one_process=one_process)
    before = children_seconds()
    with (
        (folder / "log").open("a") as log,
        listening(TRIGGER, ESTIMATED_WRENCH) as (triggers, estimates),
        Graph(log) as graph,
    ):
        start(graph, testbed)
        graph.watch(lambda: len(triggers.by_stamp) > 0, print)
        began = time.monotonic()
        graph.watch(lambda: time.monotonic() - began > duration, print)
        end(graph, testbed)
    cores = (children_seconds() - before) / (time.monotonic() - began)
    with BagReader(path) as bag:
        counts = {t: bag.counts[name] for t, name in match_topics(bag.counts, "").items()}
    samples = Trial(path).samples()
    fine = samples.complete & (samples.status == 0).all(axis=1)
    return Result(
        triggers=counts[TRIGGER],
        lost=sum(counts[TRIGGER] - counts[topic] for topic in REQUIRED),
        incomplete=int((~fine).sum()),
        estimates=counts[ESTIMATED_WRENCH],
        trigger=triggers.latencies(),
        estimate=estimates.latencies(),
        cores=cores,
    )


def children_seconds() -> float:
    """Processor time of the processes that have ended [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Print a row a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rates", type=float, nargs="+", default=[4.0, 50.0, 100.0])
    parser.add_argument("--duration", type=float, default=60.0, help="of each run [s]")
    parser.add_argument("--separate", action="store_true", help="separate processes alone")
    options = parser.parse_args()
    os.environ[BEGINNING] = str(SteadyClock().beginning)
    print(describe_machine(1))
    print(
        "  rate  processes  triggers  lost  incomplete  estimates |"
        " trigger p50   p99 | estimate p50   p99   max [ms] | /trigger | cores"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verb(["simulate", "-o", str(folder / "hold"), "--duration", "60"])
        verb(["fit", str(folder / "hold"), "-o", str(folder / "model.json")])
        for rate in options.rates:
            for one_process in (False,) if options.separate else (False, True):
                r = measure(folder, folder / "model.json", rate, options.duration, one_process)
                t50, t99 = np.percentile(r.trigger, [50, 99])
                e50, e99 = np.percentile(r.estimate, [50, 99])
                print(
                    f"{rate:6g}  {'one' if one_process else 'separate':>9}  {r.triggers:8}"
                    f"  {r.lost:4}  {r.incomplete:10}  {r.estimates:9} |"
                    f" {t50:11.2f}  {t99:4.1f} | {e50:12.1f}  {e99:4.1f}  {r.estimate.max():4.0f}"
                    f"      | {e50 / t50:8.0f} | {r.cores:5.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
