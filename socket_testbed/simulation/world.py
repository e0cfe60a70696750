"""The world that simulated hardware is in, shared by processes through a file, with its faults.

One process moves it on (`live.simulated_world`); the simulated chips in the nodes' processes look
at it through `World`, at any time of the steady clock, and see the faults that are on. They need
no more than this module: such a node starts without the physics.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.clocks import SteadyClock
from socket_testbed.errors import ConfigurationError

FAULTS = {
    "trigger.missing": "the pulse makes no edge",
    "trigger.late": "the edge comes so much later [s]",
    "clusters.unplugged": "the bus is gone: every transfer fails with ENODEV",
    "clusters.nack": "number of the cluster, from 1, whose chip does not answer (EREMOTEIO)",
    "clusters.timeout": "every transfer times out (ETIMEDOUT) after so long [s]",
    "clusters.stuck_done": "number of the cluster whose chip converts no more, until it is reset",
    "clusters.rail": "number of the cluster whose chip reads full scale on all inputs",
    "clusters.shifted": "number of the cluster whose chip shifts its inputs, until it is reset",
    "clusters.brown_out": "number of the cluster whose chip resets itself, again and again",
    "load_cell.unplugged": "the chip is gone: every byte reads 0x00",
    "load_cell.flipped_bits": "probability that a frame has a flipped bit [-]",
    "load_cell.rail": "1 + the input that is at a rail: a broken wire",
    "load_cell.brown_out": "the chip falls back to its reset state every so often [s]",
    "load_cell.frozen": "the chip converts no more, DRDY stays high",
    "mocap.unplugged": "the network is down: nothing goes out or comes in",
    "mocap.drop": "probability that a datagram is dropped [-]",
    "mocap.truncate": "probability that a datagram is cut somewhere [-]",
    "mocap.duplicate": "probability that a datagram comes twice [-]",
    "mocap.reorder": "probability that a datagram comes after the next one [-]",
    "mocap.corrupt": "probability that a count in a datagram is wrong [-]",
    "mocap.restart": "each new number restarts the server: clients forgotten, another clock",
    "mocap.occlude": "1 + the marker that is occluded on both bodies",
    "mocap.swap": "probability that two labels of a body are swapped in a frame [-]",
    "limb.out": "-1: the limb is out of the socket; n: and a thumb presses on the n-th cluster",
    "clock.step": "the system clock is off by so much [s]",
}


_FILE = "world"
_KEPT = 32  # states; more than any chip looks back
_MOST_CLUSTERS = 16
_INPUTS = 4 * _MOST_CLUSTERS  # capacitances
_WIDTH = _INPUTS + 6 + 14
_LAYOUT = np.dtype(
    [
        ("changes", np.uint64),
        ("newest", np.int64),
        ("port", np.int64),
        ("time", np.float64, (_KEPT,)),
        ("state", np.float64, (_KEPT, _WIDTH)),
        ("faults", np.float64, (len(FAULTS),)),
        ("capacitance_noise", np.float64),
        ("wrench_noise", np.float64, (6,)),
    ]
)


class FaultSwitches(Mapping[str, float]):
    """The faults of a world by their names; 0 is off."""

    def __init__(self, values: FloatArray) -> None:
        self._values = values
        self._index = {name: i for i, name in enumerate(FAULTS)}

    def __getitem__(self, name: str) -> float:
        return float(self._values[self._index[name]])

    def __iter__(self) -> Iterator[str]:
        return iter(FAULTS)

    def __len__(self) -> int:
        return len(FAULTS)

    def switch(self, name: str, value: float) -> None:
        """Switch a fault on, or off with 0."""
        self._values[self._index[name]] = value


class _Segment(NamedTuple):
    """Between two states the world is linear: it stays so, whatever comes later."""

    start: float
    end: float
    state: FloatArray
    rate: FloatArray


class World:
    """A simulated world in a folder, seen from any process."""

    def __init__(self, folder: Path, create: bool = False) -> None:
        path = folder / _FILE
        if create:
            np.zeros((), _LAYOUT).tofile(path)
        try:
            self._shared = np.asarray(np.memmap(path, _LAYOUT, "r+", shape=(1,)))
        except (OSError, ValueError):
            raise ConfigurationError(
                f"{folder}: there is no simulated world", "start one with 'run --simulated'"
            ) from None
        shared = self._shared
        self._changes, self._newest = shared["changes"], shared["newest"]
        self._time, self._state = shared["time"][0], shared["state"][0]
        self._clock = SteadyClock()
        self._segment = _Segment(0.0, 0.0, np.zeros(_WIDTH), np.zeros(_WIDTH))
        self.faults = FaultSwitches(shared["faults"][0])
        # noise of the converters, white, to be set in place: of a conversion, shape (1,) [pF]; of
        # a wrench [M; F] in a mean over one second, shape (6,) [N m, N]
        self.capacitance_noise = shared["capacitance_noise"]
        self.wrench_noise = shared["wrench_noise"][0]

    @property
    def port(self) -> int:
        """Command port of the simulated motion-capture server; 0 until it is up."""
        return int(self._shared["port"][0])

    @port.setter
    def port(self, port: int) -> None:
        self._shared["port"][0] = port

    def push(
        self, moment: float, capacitance: FloatArray, wrench: FloatArray, poses: FloatArray
    ) -> None:
        """Add the state at a time of the steady clock [s] later than all before.

        It is what the methods below return: capacitances by cluster and input, shape (c, 4) [pF],
        c at most 16, wrench and poses.
        """
        state = np.zeros(_WIDTH)
        state[: capacitance.size] = capacitance.ravel()
        state[_INPUTS:] = np.concatenate([wrench, poses.ravel()])
        # While the count of changes is odd, readers know that a change is under way.
        self._changes[0] += 1
        if self._changes[0] == 1:  # before the first state it was as it is then
            self._time[:] = moment - np.arange(_KEPT, 0, -1)
            self._state[:] = state
        place = (int(self._newest[0]) + 1) % _KEPT
        self._time[place] = moment
        self._state[place] = state
        self._newest[0] = place
        self._changes[0] += 1

    def capacitance(self, cluster: int, channel: int, moment: float) -> float:
        """Capacitance at an input of a cluster [pF]."""
        return float(self._at(moment)[4 * cluster + channel])

    def wrench(self, moment: float) -> FloatArray:
        """Load on the load cell [M; F], shape (6,) [N m, N]."""
        return self._at(moment)[_INPUTS : _INPUTS + 6]

    def poses(self, moment: float) -> FloatArray:
        """Positions [m] and quaternions (x, y, z, w) of the two bodies, shape (2, 7)."""
        poses = self._at(moment)[_INPUTS + 6 :].reshape(2, 7)
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        return poses

    def wall_clock(self) -> int:
        """The simulated system clock since the epoch [ns]."""
        return self._clock.now() + round(self.faults["clock.step"] * 1e9)

    def _at(self, moment: float) -> FloatArray:
        """The state at a time of the steady clock, linear between the two around it."""
        segment = self._segment
        if not segment.start <= moment < segment.end:
            segment = self._segment = self._find(moment)
        return segment.state + (moment - segment.start) * segment.rate

    def _find(self, moment: float) -> _Segment:
        """The states around a time; beyond the newest and the oldest nothing changes."""
        while True:
            before = self._changes[0]
            newest = int(self._newest[0])
            later, after = newest, newest
            while self._time[after] > moment and (after - 1) % _KEPT != newest:
                later, after = after, (after - 1) % _KEPT
            start, end = float(self._time[after]), float(self._time[later])
            state, rate = self._state[after].copy(), np.zeros(_WIDTH)
            if start <= moment < end:
                rate = (self._state[later] - state) / (end - start)
            if before % 2 == 0 and before == self._changes[0]:
                return _Segment(start, end, state, rate)
