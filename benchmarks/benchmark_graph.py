"""What each node of the live testbed costs, beside a bare relay of messages in the same run.

The whole testbed runs and records on simulated hardware. The relay is what rclpy itself takes: it
subscribes to the clusters' messages, decodes and publishes them, and does nothing else (events
executor). Processor time is per trigger: on a machine that others use, a time scale below 1 lets
the testbed keep up, and the figures are those of full speed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import rclpy
from machine import describe_machine
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future

from socket_testbed.live.bringup import end, simulated_testbed, start, summary
from socket_testbed.live.processes import Graph
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.nodes.base import (
    PolledSubscription,
    message_type,
    publisher_qos,
    subscriber_qos,
)
from socket_testbed.samples import Status
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.topics import CAPACITANCE, REQUIRED, STRESS, TRIGGER, Topic, match_topics
from socket_testbed.trials.trial import Trial

_RELAYED = Topic("relayed", CAPACITANCE.type)
_SETTLED = 8.0  # [s]; after the first trigger: nodes are imported, the first model is fitted
_TICKS = os.sysconf("SC_CLK_TCK")
_RELAY, _NODES, _WORLD = "bare relay", "all nodes", "simulated world"


def relay() -> None:
    """Publish every message of capacitances again; ends with the process that started it."""
    rclpy.init()
    node = rclpy.create_node("bare_relay")
    publisher = node.create_publisher(
        message_type(CAPACITANCE), _RELAYED.name, publisher_qos(_RELAYED)
    )
    node.create_subscription(
        message_type(CAPACITANCE), CAPACITANCE.name, publisher.publish, subscriber_qos(CAPACITANCE)
    )
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        while True:
            executor.spin_until_future_complete(Future(), timeout_sec=1.0)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass


def processor_seconds() -> dict[str, float]:
    """Processor time of this process's descendants by what they are [s]."""
    times: dict[int, tuple[int, float]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended meanwhile
        times[int(folder.name)] = int(fields[1]), (int(fields[11]) + int(fields[12])) / _TICKS
    found: dict[str, float] = {}
    for process, (parent, seconds) in times.items():
        if parent == os.getpid():
            name = _name(process)
        elif times.get(parent, (0, 0.0))[0] == os.getpid():
            name = f"{_name(parent)}: fits"
        else:
            continue
        found[name] = found.get(name, 0.0) + seconds
    return found


def _name(process: int) -> str:
    words = Path(f"/proc/{process}/cmdline").read_bytes().decode().split("\0")
    if "socket_testbed.nodes" in words:
        return words[words.index("socket_testbed.nodes") + 1]
    return _WORLD if "socket_testbed.live.simulated_world" in words else _RELAY


def main() -> None:
    """Run the testbed once and print a row for each process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=100.0, help="of the trigger [Hz]")
    parser.add_argument("--duration", type=float, default=60.0, help="what is measured [s]")
    parser.add_argument("--time-scale", type=float, default=1.0)
    options = parser.parse_args()
    print(describe_machine(1))
    simulation = Simulation("multi_direction", 60.0, 1, time_scale=options.time_scale)
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("w") as log:
        path = Path(folder) / "trial"
        testbed = simulated_testbed(path, options.rate, simulation)
        rclpy.init()
        node = rclpy.create_node("benchmark")
        heard = {
            topic: PolledSubscription(node, topic, subscriber_qos(topic))
            for topic in (TRIGGER, _RELAYED)
        }
        context = multiprocessing.get_context("spawn")
        bare = context.Process(target=relay, daemon=True)
        counts = dict.fromkeys(heard, 0)

        def listen(until: float | None = None) -> bool:
            """Count what has come; whether it is time, or a trigger has come."""
            for topic, subscription in heard.items():
                counts[topic] += len(subscription.take())
            return counts[TRIGGER] > 0 if until is None else time.monotonic() > until

        with Graph(log) as graph:
            start(graph, testbed)
            bare.start()
            graph.watch(listen, print)
            settled = time.monotonic() + _SETTLED
            graph.watch(lambda: listen(settled), print)
            before, triggers, began = processor_seconds(), counts[TRIGGER], time.monotonic()
            graph.watch(lambda: listen(began + options.duration), print)
            after, triggers = processor_seconds(), counts[TRIGGER] - triggers
            end(graph, testbed)
        listen()
        bare.terminate()
        bare.join()
        rclpy.shutdown()
        spent = {name: after[name] - before.get(name, 0.0) for name in after}
        spent[_NODES] = sum(spent.values()) - spent[_RELAY] - spent[_WORLD]
        print(f"{'process':28} {'ms a trigger':>12} {f'% at {options.rate:g} Hz':>12} / relay")
        for what, seconds in sorted(spent.items(), key=lambda entry: entry[1]):
            each = seconds / triggers
            ratio = seconds / spent[_RELAY]
            print(f"{what:28} {1e3 * each:12.2f} {100 * each * options.rate:12.1f} {ratio:7.2f}")
        with BagReader(path) as bag:
            recorded = {t: bag.counts[n] for t, n in match_topics(bag.counts, "").items()}
        samples = Trial(path).samples()
        seen = samples.complete & (samples.status != Status.MISSING).all(axis=1)
        lost = {t.name: recorded[TRIGGER] - recorded[t] for t in (*REQUIRED, STRESS)}
        print(
            f"{recorded[TRIGGER]} triggers in all; messages lost: {sum(lost.values())};"
            f" incomplete samples: {int((~seen).sum())}; relayed: {counts[_RELAYED]}"
        )
        print(summary(path))


if __name__ == "__main__":
    main()
