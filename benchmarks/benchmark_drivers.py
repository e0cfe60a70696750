"""The drivers and the simulated chips behind them: processor time per trigger, beside a floor.

Each driver runs without ROS, as its node calls it, in the simulated world of another process. What
the calls of a bus take is the simulated chip's with its physics; what is left of the threads' time
is the driver's. The floor is a bare loop: for the clusters it sleeps for the time on the bus of the
fewest transfers that read 16 inputs, for the load cell it wakes up for each conversion, for the
motion capture it receives as many datagrams.
"""

from __future__ import annotations

import argparse
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine, processes

from socket_testbed import clocks
from socket_testbed.drivers.clusters.reader import ClusterReader
from socket_testbed.drivers.load_cell.converter_reader import ConverterReader
from socket_testbed.drivers.load_cell.load_cell import LoadCell
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.bringup import Testbed, simulate_hardware, simulated_testbed
from socket_testbed.live.hardware import capacitive_chip, i2c_opener, spi_opener
from socket_testbed.live.processes import Graph
from socket_testbed.settings.acquisition import averaging_span
from socket_testbed.simulation.sensors import CAMERA_RATE
from socket_testbed.simulation.testbed import Simulation

_TRANSFERS, _ON_BUS = 44, 107e-6  # fewest per trigger; their mean time at 400 kHz [s]
_DATAGRAM = 407  # [bytes]; a frame of two triads


class Metered:
    """A bus whose transfers are metered."""

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self.spent, self.calls = 0.0, 0  # processor time [s] and number of the transfers
        self.close = bus.close

    def i2c_rdwr(self, *messages: Any) -> None:
        """Transfer messages."""
        self._meter(self._bus.i2c_rdwr, *messages)

    def xfer2(self, data: Any) -> Any:
        """Exchange a frame."""
        return self._meter(self._bus.xfer2, data)

    def _meter(self, transfer: Callable[..., Any], *data: Any) -> Any:
        begun = time.thread_time()
        answer = transfer(*data)
        self.spent += time.thread_time() - begun
        self.calls += 1
        return answer


class Bench:
    """Calls work at each trigger of a rate [Hz] for a while [s]."""

    def __init__(self, rate: float, duration: float) -> None:
        self.period = 1.0 / rate
        self.triggers = round(rate * duration)

    def __call__(self, work: Callable[[float], object]) -> float:
        """Processor time of this thread [s] for work, called with each trigger's time [s]."""
        first = clocks.monotonic()
        begun = time.thread_time()
        for k in range(self.triggers):
            moment = first + k * self.period
            clocks.sleep(max(0.0, moment - clocks.monotonic()))
            work(moment)
        return time.thread_time() - begun

    def row(self, what: str, chip: float, driver: float, floor: float, found: str) -> None:
        """Print processor times [s] per trigger."""
        to = 1e3 / self.triggers
        print(
            f"{what:15} {chip * to:9.2f} {driver * to:8.2f} {floor * to:7.2f}"
            f" {(chip + driver) / floor:14.1f} {driver / floor:13.1f}   {found}",
            flush=True,
        )


def clusters(bench: Bench, testbed: Testbed) -> None:
    """Read all clusters at each trigger."""
    settings = testbed.settings.cluster_node
    opener, buses = i2c_opener(settings), []

    def open_bus(number: int) -> Any:
        buses.append(Metered(opener(number)))
        return buses[-1]

    reader = ClusterReader(settings, capacitive_chip(settings)[0], open_bus)
    reader.read(clocks.monotonic())
    bus, missing = buses[0], 0
    bus.spent, bus.calls = 0.0, 0

    def read(moment: float) -> None:
        nonlocal missing
        missing += bool(reader.read(moment).status.any())

    total = bench(read)
    reader.close()
    floor = bench(lambda moment: [time.sleep(_ON_BUS) for _ in range(_TRANSFERS)])
    found = f"{bus.calls / bench.triggers:.0f} transfers a trigger, {missing} incomplete"
    bench.row("clusters", bus.spent, total - bus.spent, floor, found)


def load_cell(bench: Bench, testbed: Testbed) -> None:
    """Poll the converter as load_cell_node does, and average around each trigger."""
    settings = testbed.settings.load_cell_node
    opener, devices = spi_opener(settings), []

    def open_device() -> Any:
        devices.append(Metered(opener()))
        return devices[-1]

    cell = LoadCell(settings, ConverterReader(settings, open_device))
    converter = cell.converter
    span = averaging_span(settings.average_over, bench.period)
    stopping, spent, missing = threading.Event(), 0.0, 0

    def poll() -> None:
        nonlocal spent
        due = clocks.monotonic()
        while not stopping.is_set():
            converter.poll()
            due = max(due + converter.period, clocks.monotonic() - converter.period)
            clocks.sleep(max(0.0, due - clocks.monotonic()))
        spent = time.thread_time()

    def measure(moment: float) -> None:
        nonlocal missing
        over = cell.end_time(moment, span)
        clocks.sleep(max(0.0, over - clocks.monotonic()))
        while not cell.ready(moment, span) and clocks.monotonic() < over + 0.05:
            clocks.sleep(1e-3)
        missing += bool(np.isnan(cell.wrench_at(moment, span).wrench).any())

    thread = threading.Thread(target=poll)
    thread.start()
    clocks.sleep(0.5)
    total = bench(measure)
    stopping.set()
    thread.join()
    converter.close()
    per_trigger = round(bench.period / converter.period)
    floor = bench(lambda moment: [time.sleep(0.8 * converter.period) for _ in range(per_trigger)])
    bus = devices[0]
    found = f"{bus.calls / bench.triggers:.0f} frames a trigger, {missing} incomplete"
    bench.row("load cell", bus.spent, total + spent - bus.spent, floor, found)


def mocap(bench: Bench, testbed: Testbed, world: Callable[[], float]) -> None:
    """Follow the motion capture and place the bodies at each trigger; the server is apart."""
    settings = testbed.settings.mocap_node
    geometry = read_socket(testbed.geometry)
    tracker = BodyTracker(settings, *geometry.markers.values())
    client = NatNetClient(settings, tracker.add)
    window = averaging_span(settings.window, bench.period)
    alone, missing = world(), 0
    bench(lambda moment: None)
    alone = world() - alone

    def place(moment: float) -> None:
        nonlocal missing
        tracker.wait(moment, moment + 0.5 * window + settings.stale, window)
        missing += any(body.fault for body in tracker.sample(moment, window))

    client.start()
    while not tracker.ready(clocks.monotonic() - 0.1):
        clocks.sleep(0.1)
    thread = next(t for t in threading.enumerate() if t.name == "natnet")
    clock = time.pthread_getcpuclockid(thread.ident or 0)
    streaming, received = world(), time.clock_gettime(clock)
    placing = bench(place)
    streaming, received = world() - streaming, time.clock_gettime(clock) - received
    client.close()
    floor = _bare_socket(bench)
    found = f"{CAMERA_RATE * bench.period:.1f} frames a trigger, {missing} incomplete"
    bench.row("motion capture", streaming - alone, received + placing, floor, found)
    print(
        f"{'physics':15} {1e3 * alone / bench.triggers:9.2f}   the world's process without stream"
    )


def _bare_socket(bench: Bench) -> float:
    """Processor time of a bare socket that receives the camera's frames [s]."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(1.0)
        frames = round(bench.triggers * bench.period * CAMERA_RATE)
        data = bytes(_DATAGRAM)

        def send() -> None:
            for _ in range(frames):
                time.sleep(1.0 / CAMERA_RATE)
                sender.sendto(data, receiver.getsockname())

        thread = threading.Thread(target=send)
        thread.start()
        begun = time.thread_time()
        for _ in range(frames):
            receiver.recv(65535)
        spent = time.thread_time() - begun
        thread.join()
        return spent


def _spent_by_children() -> float:
    """Processor time of the processes that this one has started [s]."""
    return sum(seconds for parent, seconds in processes().values() if parent == os.getpid())


def main() -> None:
    """Print a row for each driver."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=100.0, help="of the trigger [Hz]")
    parser.add_argument("--duration", type=float, default=8.0, help="of each part [s]")
    options = parser.parse_args()
    bench = Bench(options.rate, options.duration)
    print(describe_machine(1))
    print("processor time [ms] per trigger at", f"{options.rate:g} Hz")
    print("                simulated   driver   floor  both / floor  driver / floor")
    with tempfile.TemporaryDirectory() as name, (Path(name) / "log").open("w") as log:
        testbed = simulated_testbed(None, options.rate, Simulation("multi_direction", 60.0, 1))
        with Graph(log) as graph:
            assert testbed.simulation is not None
            testbed, _ = simulate_hardware(graph, testbed, testbed.simulation)
            clusters(bench, testbed)
            load_cell(bench, testbed)
            mocap(bench, testbed, _spent_by_children)


if __name__ == "__main__":
    main()
