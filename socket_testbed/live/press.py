"""The press test: a person presses on each cluster, and its sign, place and order are established.

Limb out of the socket. What it cannot find is a gain, and two clusters that were pressed in the
other's place.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.errors import DeviceError
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.doctor import Finding
from socket_testbed.live.hardware import make_clusters, make_load_cell

WITHIN = 20.0  # [s]; for a press, and for letting go
_UNLOADED = 20  # readings before the first press
_LETS_GO = 1.0  # [s]; until the first of them
_PERIOD = 0.1  # [s]; between readings, over which the load cell is averaged
_LEAST = 4e3  # [Pa]; a finger presses with more,
_SIGMAS = 8.0  # and with more than so many standard deviations of the unloaded readings
_STEADY = 3  # readings that make a press
_PATIENCE = 10  # times as many, in which a busy computer missed the load cell's
_LEAST_FORCE = 1.0  # [N]
_ALONG = 0.5  # [-]; cosine between the load cell's force and the outward normal, at least
_RELEASED = 0.5  # [-]; of what makes a press


@dataclass(frozen=True)
class _Reading:
    normal: FloatArray  # of the clusters, shape (c,) [Pa]; NaN where there is none
    force: FloatArray  # of the load cell, shape (3,) [N]; likewise


def press_test(testbed: Testbed, ask: Callable[[str], None]) -> Iterator[Finding]:
    """Ask for a press on each cluster in turn, and tell what answered.

    Args:
        testbed: The testbed, of which no node runs.
        ask: Called with what the person shall do: `press on NAME` or `let go`.

    Yields:
        A finding for each cluster.

    Raises:
        DeviceError: If the clusters cannot be read, or are loaded at the start.
    """
    with ExitStack() as stack:
        bench = _Bench(testbed, stack)
        ask("let go")
        clocks.sleep(_LETS_GO)
        unloaded = [bench.read() for _ in range(_UNLOADED)]
        zero = _Reading(*_mean(unloaded))
        noise = np.nanstd([reading.normal for reading in unloaded], axis=0)
        dead = [n for n, value in zip(bench.names, zero.normal, strict=True) if np.isnan(value)]
        if dead:
            hint = "see what 'doctor' says of it without --press"
            raise DeviceError(f"cluster {dead[0]} gives no reading", hint)
        threshold = np.maximum(_LEAST, _SIGMAS * noise)
        for name in bench.names:
            ask(f"press on {name}")
            pressed = bench.wait(lambda reading: _is_over(reading, zero, threshold))
            yield _judge(bench, name, pressed, zero, threshold)
            if pressed is not None:
                ask("let go")
                bench.wait(lambda reading: _is_released(reading, zero, _RELEASED * threshold))


def _mean(readings: list[_Reading]) -> tuple[FloatArray, FloatArray]:
    columns = [reading.normal for reading in readings], [reading.force for reading in readings]
    masked = (np.ma.masked_invalid(np.array(column)) for column in columns)
    normal, force = (np.asarray(np.ma.filled(of.mean(axis=0), np.nan)) for of in masked)
    return normal, force


def _is_over(reading: _Reading, zero: _Reading, threshold: FloatArray) -> bool:
    """Whether a cluster is pressed, or pulled."""
    return bool((np.abs(reading.normal - zero.normal) > threshold).any())


def _is_released(reading: _Reading, zero: _Reading, threshold: FloatArray) -> bool:
    """Whether every cluster was read, and none is pressed."""
    return bool((np.abs(reading.normal - zero.normal) <= threshold).all())


def _judge(
    bench: _Bench, name: str, pressed: _Reading | None, zero: _Reading, threshold: FloatArray
) -> Finding:
    """What a press on a cluster says of its wiring."""
    what = f"press on {name}"
    if pressed is None:
        hint = "press in its middle with the thumb; if it stays silent: its cable, its calibration"
        return Finding(what, f"no cluster answered within {WITHIN:g} s", hint)
    change = pressed.normal - zero.normal
    answered = int((np.abs(change) / threshold).argmax())
    found = f"{bench.names[answered]} felt {1e-3 * change[answered]:+.1f} kPa"
    if bench.names[answered] != name:
        hint = f"exchange the places of {name} and {bench.names[answered]} in cluster_node's"
        return Finding(what, found, f"{hint} channels, or their cables; or press on {name} itself")
    if change[answered] < 0.0:
        hint = "its normal is the wrong way round: check its channels' order and its calibration"
        return Finding(what, found, hint)
    outward = -bench.geometry.rotations[bench.geometry.clusters[name], :, 2]
    more, hint = _judge_force(pressed.force - zero.force, outward)
    return Finding(what, f"{found}, {more}", hint)


def _judge_force(force: FloatArray, outward: FloatArray) -> tuple[str, str]:
    """What the load cell felt of a press along the outward normal of the wall, and a hint."""
    size = float(np.linalg.norm(force))
    if not size >= _LEAST_FORCE:
        return "the load cell felt nothing", "check the load cell's wiring"
    along, felt = float(force @ outward) / size, f"the load cell {size:.1f} N"
    if along <= -_ALONG:
        return f"{felt} the other way", "check the load cell's signs and matrix"
    if along < _ALONG:
        hint = "check how the load cell is turned, its matrix, and the cluster's place"
        return f"{felt} in another direction", hint
    return felt, ""


class _Bench:
    """The clusters and the load cell by their own drivers, read side by side."""

    def __init__(self, testbed: Testbed, stack: ExitStack) -> None:
        settings = testbed.settings
        self.geometry: SocketGeometry = read_socket(testbed.geometry)
        self._reader = make_clusters(settings.cluster_node)
        stack.callback(self._reader.close)
        self._cell = make_load_cell(settings.load_cell_node)
        self.names = tuple(settings.cluster_node.names)
        calibration = read_calibration(testbed.calibration)
        calibration.require(self.names, "the settings")
        self._calibration = calibration.stacked(self.names)
        stopping = threading.Event()
        polling = threading.Thread(target=self._poll, args=(stopping,), daemon=True)
        polling.start()

        def stop() -> None:
            stopping.set()
            polling.join()
            self._cell.close()

        stack.callback(stop)

    def read(self) -> _Reading:
        """One reading of all."""
        due = clocks.monotonic() + _PERIOD
        reading = self._reader.read(clocks.monotonic())
        stress, _ = self._calibration.apply(reading.capacitance, reading.status)
        clocks.sleep(max(0.0, due - clocks.monotonic()))
        wrench = self._cell.wrench_at(due - 0.7 * _PERIOD, 0.5 * _PERIOD).wrench
        return _Reading(stress[:, 0], wrench[3:])

    def wait(self, done: Callable[[_Reading], bool]) -> _Reading | None:
        """Read until something holds in several readings; their mean, or None where it does not."""
        ends = clocks.monotonic() + WITHIN
        found: list[_Reading] = []
        while clocks.monotonic() < ends:
            reading = self.read()
            if done(reading):
                found.append(reading)
            elif np.isfinite(reading.normal).all():  # a late reading tells nothing
                found.clear()
            felt = sum(np.isfinite(reading.force).all() for reading in found[1:])
            if felt >= _STEADY or len(found) > _PATIENCE * _STEADY:
                return _Reading(*_mean(found[1:]))  # the first one was on the way
        return None

    def _poll(self, stopping: threading.Event) -> None:
        while not stopping.is_set():
            self._cell.poll()
            clocks.sleep(self._cell.period)
