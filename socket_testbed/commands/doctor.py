"""`doctor`: what is wired and what is not, as a table, with the hint of what is not."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

from socket_testbed.commands.hardware_options import (
    add_simulation,
    add_testbed,
    simulation_of,
    testbed_of,
)
from socket_testbed.commands.text import table
from socket_testbed.drivers.clusters.reader import ClusterReader
from socket_testbed.drivers.load_cell.load_cell import LoadCell
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker
from socket_testbed.errors import DeviceError, TestbedError
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.bringup import Testbed, simulate_hardware
from socket_testbed.live.hardware import i2c_opener, make_trigger, spi_opener
from socket_testbed.live.processes import Graph

_FRAMES = 1000
_PULSES = 5
_SERVER_WITHIN = 3.0  # [s]
_READINGS = 6
_WATCHED = 1.0  # [s]; of the load cell's conversions
_LOOK = 0.05  # [s]


@dataclass(frozen=True)
class Finding:
    """A row of the table.

    Attributes:
        what: What was looked at.
        found: What was found there.
        hint: What to do; empty if all is well.
    """

    what: str
    found: str
    hint: str = ""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_testbed(parser)
    add_simulation(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Look at everything that is configured."""
    simulation, faults = simulation_of(options)
    testbed = testbed_of(options, simulation)
    with ExitStack() as stack:
        if simulation is not None:
            graph = stack.enter_context(Graph())
            testbed, world = simulate_hardware(graph, testbed, simulation)
            for name, value in faults.items():
                world.faults.switch(name, value)
        findings = [finding for check in CHECKS for finding in _guarded(check, testbed)]
    rows = [[f.what, "failed" if f.hint else "ok", f.found, f.hint] for f in findings]
    print(table(["what", "", "found", "hint"], rows))
    failing = sum(bool(finding.hint) for finding in findings)
    if failing:
        raise DeviceError(f"{failing} of {len(findings)} checks failed", "see the table's hints")


Check = Callable[[Testbed], Iterator[Finding]]


def _guarded(check: Check, testbed: Testbed) -> Iterator[Finding]:
    try:
        yield from check(testbed)
    except TestbedError as error:
        yield Finding(
            check.__name__.removeprefix("check_").replace("_", " "), error.fact, error.hint
        )


def _of_message(what: str, message: str) -> Finding:
    """A failing row from a fact and its hint in one line."""
    fact, _, hint = message.rpartition(": ")
    return Finding(what, fact or message, hint if fact else "see docs/faults.md")


def check_trigger(testbed: Testbed) -> Iterator[Finding]:
    """Make pulses and see their edges."""
    settings = testbed.settings.trigger_node
    trigger = make_trigger(settings)
    try:
        delays = []
        for _ in range(_PULSES):
            before = time.monotonic()
            delays.append(trigger.fire() - before)
            trigger.rest()
    finally:
        trigger.close()
    found = "the steady clock; no wire"
    if settings.source == "gpio":
        found = (
            f"{settings.chip}, line {settings.output_line} to {settings.input_line},"
            f" edge within {max(delays) * 1e6:.0f} us"
        )
    yield Finding("trigger", found)


def check_clusters(testbed: Testbed) -> Iterator[Finding]:
    """See which chip answers at each cluster's place."""
    settings = testbed.settings.cluster_node
    reader = ClusterReader(settings, i2c_opener(settings))
    try:
        chips = reader.identify()
        for _ in range(_READINGS):  # the first ones may find the range of an input
            faults = reader.read(time.monotonic()).faults
        for name, found in chips.items():
            if isinstance(found, DeviceError):
                yield Finding(f"cluster {name}", found.fact, found.hint)
            elif name in faults:
                yield _of_message(f"cluster {name}", faults[name].partition("; ")[0])
            else:
                yield Finding(f"cluster {name}", found)
    finally:
        reader.close()


def check_load_cell(testbed: Testbed) -> Iterator[Finding]:
    """See which converter answers, and whether its frames are whole."""
    settings = testbed.settings.load_cell_node
    cell = LoadCell(settings, spi_opener(settings))
    try:
        yield Finding("load cell", cell.identify())
        corrupted = cell.check_frames(_FRAMES)
        hint = "check the wiring, or lower load_cell_node's spi_clock" if corrupted else ""
        yield Finding("load cell CRC", f"{corrupted} of {_FRAMES} frames corrupted", hint)
        ends = time.monotonic() + _WATCHED
        while time.monotonic() < ends:
            cell.poll()
            time.sleep(0.5 * cell.period)
        level, message = cell.health(time.monotonic())
        yield (
            _of_message("load cell bridges", message)
            if level
            else Finding("load cell bridges", message)
        )
    finally:
        cell.close()


def check_motion_capture(testbed: Testbed) -> Iterator[Finding]:
    """See which server answers, how well its clock is known, and whether it has the bodies."""
    settings = testbed.settings.mocap_node
    geometry = read_socket(testbed.geometry)
    tracker = BodyTracker(settings, geometry.socket_markers, geometry.pylon_markers)
    client = NatNetClient(settings, tracker.add)
    client.start()
    try:
        deadline = time.monotonic() + _SERVER_WITHIN
        while (health := client.health(time.monotonic()))[0] and time.monotonic() < deadline:
            time.sleep(_LOOK)
        time.sleep(settings.stale)
        seen = tracker.sample(time.monotonic() - 0.5 * settings.stale)
        link = client.describe()
    finally:
        client.close()
    level, message = health
    if level > 1:
        yield _of_message("motion capture", message)
        return
    server = f"{link['server']} {link['application']}, NatNet {link['NatNet']}, {link['rate']}"
    yield Finding("motion capture", f"{server}, at {link['address']}")
    if level:
        yield _of_message("motion capture stream", message)
    clock = f"known within {link['clock uncertainty']}, jitter {link['clock jitter']}"
    yield Finding("motion capture clock", clock)
    for body, fault in zip((settings.socket_body, settings.pylon_body), seen.faults, strict=True):
        what = f"rigid body {body}"
        yield _of_message(what, fault) if fault else Finding(what, "its three markers are seen")


CHECKS: tuple[Check, ...] = (
    check_trigger,
    check_clusters,
    check_load_cell,
    check_motion_capture,
)
