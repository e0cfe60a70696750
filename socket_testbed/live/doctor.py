"""Checks of the wiring: each device is opened with its own driver and asked."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.load_cell.ads131m0x import CHECK_WIRING
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker
from socket_testbed.errors import DeviceError, TestbedError
from socket_testbed.geometry.marker_bodies import FEWEST_MARKERS
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.hardware import make_clusters, make_load_cell, make_trigger
from socket_testbed.live.machine import LATEST, measure_lateness

_FRAMES = 1000
_PULSES = 5
_SERVER_WITHIN = 3.0  # [s]
_READINGS, _MOST_READINGS = 6, 18
_WATCHED = 1.0  # [s]; of the load cell's conversions
_LOOK = 0.05  # [s]
_PRIORITY = 10  # that is tried where none is set
_MODEL = Path("/proc/device-tree/model")  # of the computer
_SOUND_I2C = [6, 6, 28]  # the first packaged kernel with raspberrypi/linux#6071 (March 2024)
_OF_A_PERIOD = 0.25  # [-]; part of the trigger's period that a reading may be late


@dataclass(frozen=True)
class Finding:
    """The outcome of a check."""

    what: str  # the device or sensor
    found: str
    hint: str = ""  # empty if all is well


def examine(testbed: Testbed) -> list[Finding]:
    """Look at everything that is configured, one device after the other."""
    findings: list[Finding] = []
    for check in CHECKS:
        try:
            findings.extend(check(testbed))
        except TestbedError as error:
            what = check.__name__.removeprefix("check_").replace("_", " ")
            findings.append(Finding(what, error.fact, error.hint))
    return findings


def _failure(what: str, message: str) -> Finding:
    """A failing finding from a fact and its hint in one line."""
    fact, _, hint = message.rpartition(": ")
    return Finding(what, fact or message, hint if fact else "see docs/faults.md")


def check_kernel(testbed: Testbed) -> Iterator[Finding]:
    """Name the kernel of a Raspberry Pi."""
    if testbed.simulation is None and _MODEL.is_file():
        yield kernel_finding(_MODEL.read_text().rstrip("\0"), platform.release())


def kernel_finding(model: str, release: str) -> Finding:
    """Whether a kernel is one whose buses are known to fail on its Raspberry Pi."""
    found, version = f"{release} on {model}", re.findall(r"\d+", release)[:3]
    if "Raspberry Pi 5" in model and [*map(int, version)] < _SOUND_I2C:
        return Finding(
            "kernel",
            f"{found}: its I2C bus can lock up (raspberrypi/linux#5784)",
            f"update it to {'.'.join(map(str, _SOUND_I2C))} or newer",
        )
    return Finding("kernel", found)


def check_trigger(testbed: Testbed) -> Iterator[Finding]:
    """Make pulses and see their edges."""
    settings = testbed.settings.trigger_node
    trigger = make_trigger(settings)
    try:
        delays = []
        for _ in range(_PULSES):
            before = clocks.monotonic()
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


def check_scheduling(testbed: Testbed) -> Iterator[Finding]:
    """Measure how late threads wake up, with a real-time priority too where there is the right."""
    settings = testbed.settings.trigger_node
    rate, wanted = settings.rate, settings.scheduling.priority
    ordinary, urgent = measure_lateness(), measure_lateness(wanted or _PRIORITY)
    found = f"threads wake up {_late(ordinary)}"
    if len(urgent):
        found += f", with real-time priority {wanted or _PRIORITY} {_late(urgent)}"
    else:
        found += "; no right to a real-time priority"
    used = urgent if wanted and len(urgent) else ordinary
    enough = np.percentile(used, 99) <= min(LATEST, _OF_A_PERIOD / rate)
    found += f": {'soon enough' if enough else 'too late'} for {rate:g} Hz"
    hint = ""
    if not enough and testbed.simulation is None:
        hint = "end other programs, or set scheduling.priority of the nodes that measure"
        hint += " (docs/hardware.md)"
    elif not enough:
        found += " in real time; a simulated testbed may run slower"
    yield Finding("scheduling", found, hint)


def _late(late: FloatArray) -> str:
    return f"{1e3 * np.percentile(late, 99):.2g} ms late (p99; {1e3 * late.max():.2g} ms at most)"


def check_clusters(testbed: Testbed) -> Iterator[Finding]:
    """See which chip answers at each cluster's place."""
    settings = testbed.settings.cluster_node
    reader = make_clusters(settings)
    try:
        chips = reader.identify()
        for count in range(_MOST_READINGS):
            faults = reader.read(clocks.monotonic()).faults
            # The first ones may find the range of an input, and a busy machine reads some late.
            if count + 1 >= _READINGS and not faults:
                break
        for name, found in chips.items():
            if isinstance(found, DeviceError):
                yield Finding(f"cluster {name}", found.fact, found.hint)
            elif name in faults:
                yield _failure(f"cluster {name}", faults[name].partition("; ")[0])
            else:
                yield Finding(f"cluster {name}", found)
    finally:
        reader.close()


def check_load_cell(testbed: Testbed) -> Iterator[Finding]:
    """See which converter answers, and whether its frames are intact."""
    settings = testbed.settings.load_cell_node
    cell = make_load_cell(settings)
    try:
        yield Finding("load cell", cell.identify())
        corrupted = cell.check_frames(_FRAMES)
        hint = CHECK_WIRING if corrupted else ""
        yield Finding("load cell CRC", f"{corrupted} of {_FRAMES} frames corrupted", hint)
        ends = clocks.monotonic() + _WATCHED
        while clocks.monotonic() < ends:
            cell.poll()
            clocks.sleep(0.5 * cell.period)
        level, message = cell.health(clocks.monotonic())
        if (line := settings.data_ready_line) >= 0:
            counts = cell.figures()
            found = f"{counts['conversions']} edges on line {line}"
            found += f", STATUS disagrees with {counts['status_disagrees']}"
            yield Finding("load cell DRDY", found)
        yield (_failure if level else Finding)("load cell bridges", message)
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
        deadline = clocks.monotonic() + _SERVER_WITHIN
        while (health := client.health(clocks.monotonic()))[0] and clocks.monotonic() < deadline:
            clocks.sleep(_LOOK)
        clocks.sleep(settings.stale)
        seen = tracker.sample(clocks.monotonic() - 0.5 * settings.stale)
        link = client.describe()
    finally:
        client.close()
    level, message = health
    if level > 1:
        yield _failure("motion capture", message)
        return
    found = f"{link['server']}, {link['rate']}, at {link['address']}"
    yield Finding("motion capture", found)
    if level:
        yield _failure("motion capture stream", message)
    yield Finding("motion capture clock", f"known within {link['clock uncertainty']}")
    counts = (len(geometry.socket_markers), len(geometry.pylon_markers))
    names = (settings.socket_body, settings.pylon_body)
    for body, count, fault in zip(names, counts, seen.faults, strict=True):
        what, number = f"rigid body {body}", "three" if count == FEWEST_MARKERS else count
        yield _failure(what, fault) if fault else Finding(what, f"its {number} markers are seen")


CHECKS: tuple[Callable[[Testbed], Iterator[Finding]], ...] = (
    check_kernel,
    check_trigger,
    check_scheduling,
    check_clusters,
    check_load_cell,
    check_motion_capture,
)
