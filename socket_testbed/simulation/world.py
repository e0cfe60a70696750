"""The world of the simulated hardware and its faults, shared between processes through a file.

One process advances it (`simulation.testbed`). The simulated chips in the nodes' processes read
states, at any time of the steady clock, and active faults through `World`. They need only this
module, so a node starts without the physics.
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
    "trigger.missing": "no edge follows the pulse",
    "trigger.late": "delay of the edge [s]",
    "trigger.unplugged": "the GPIO chip is gone: its lines fail with ENODEV until it is back",
    "clusters.unplugged": "the bus is gone: every transfer fails with this errno; 1: ENODEV",
    "clusters.nack": "number of the cluster, from 1, whose chip does not answer (EREMOTEIO)",
    "clusters.timeout": "time after which every transfer times out (ETIMEDOUT) [s]",
    "clusters.stuck_done": "number of the cluster whose chip stops converting until it is reset",
    "clusters.rail": "number of the cluster whose chip reads full scale on all inputs",
    "clusters.shifted": "number of the cluster whose chip shifts its inputs until it is reset",
    "clusters.exchanged": "the cables of the first two clusters are exchanged",
    "clusters.brown_out": "number of the cluster whose chip resets itself repeatedly",
    "load_cell.unplugged": "the chip is gone: every byte reads 0x00",
    "load_cell.flipped_bits": "probability that a frame has a flipped bit [-]",
    "load_cell.rail": "1 + the input at a rail: a broken wire",
    "load_cell.brown_out": "interval at which the chip falls back to its reset state [s]",
    "load_cell.frozen": "the chip stops converting, DRDY stays high",
    "mocap.unplugged": "the network is down: nothing is sent or received",
    "mocap.drop": "probability that a datagram is dropped [-]",
    "mocap.truncate": "probability that a datagram is truncated [-]",
    "mocap.duplicate": "probability that a datagram is duplicated [-]",
    "mocap.reorder": "probability that a datagram is sent after the next one [-]",
    "mocap.corrupt": "probability that a count in a datagram is wrong [-]",
    "mocap.restart": "each new number restarts the server, with no clients and a new clock",
    "mocap.occlude": "1 + the marker occluded on both bodies",
    "mocap.swap": "probability that two labels of a body are swapped in a frame [-]",
    "mocap.exchange": "the ids of the two bodies are exchanged, and no frame flags it",
    "mocap.scale": "factor on all lengths of the stream, 1000 for millimetres [-]",
    "limb.out": "-1: the limb is out of the socket; n: also, a thumb presses the n-th cluster",
    "clock.step": "offset of the system clock [s]",
}


_FILE = "world"
_STATES = 32  # more than any chip looks back
MAX_CLUSTERS = 16
_CAPACITANCES = 4 * MAX_CLUSTERS
_STATE_SIZE = _CAPACITANCES + 6 + 14
_LAYOUT = np.dtype(
    [
        ("changes", np.uint64),
        ("newest", np.int64),
        ("port", np.int64),
        ("time", np.float64, (_STATES,)),
        ("state", np.float64, (_STATES, _STATE_SIZE)),
        ("faults", np.float64, (len(FAULTS),)),
        ("capacitance_noise", np.float64),
        ("wrench_noise", np.float64, (6,)),
    ]
)


class FaultSwitches(Mapping[str, float]):
    """The faults of a world by name, see `FAULTS` for their values; 0 is off.

    The constructor takes the values in the order of `FAULTS`, shape (f,); `switch` changes them in
    place.
    """

    def __init__(self, values: FloatArray) -> None:
        self._values = values
        # Chips read some 400 of them per trigger, and numpy takes five times as long for one.
        self._numbers = values.data
        self._index = {name: i for i, name in enumerate(FAULTS)}

    def __getitem__(self, name: str) -> float:
        return float(self._numbers[self._index[name]])

    def __iter__(self) -> Iterator[str]:
        return iter(FAULTS)

    def __len__(self) -> int:
        return len(FAULTS)

    def switch(self, name: str, value: float) -> None:
        """Set a fault, at once in all processes.

        Args:
            name: Name of the fault, a key of `FAULTS`.
            value: Its value, as `FAULTS` describes it; 1 for a fault without a number, 0 for off.
        """
        self._values[self._index[name]] = value


class _Segment(NamedTuple):
    """Two states with linear interpolation between them; later states do not change it."""

    start: float
    end: float
    state: FloatArray
    rate: FloatArray


class World:
    """A simulated world in a folder, accessible from any process.

    Between the states that were pushed it is interpolated linearly; before the oldest of the last
    32 and after the newest it is constant. Times are those of the steady clock [s]. The constructor
    raises a `ConfigurationError` if the folder has no world.

    Args:
        folder: The folder of its file.
        create: Whether to make a new world in it, with all values zero.

    Attributes:
        faults: The active faults.
        capacitance_noise: Standard deviation of a cluster's conversion, to be set in place, shape
            (1,) [pF].
        wrench_noise: Standard deviation of a wrench [M; F] averaged over one second, white, to be
            set in place, shape (6,) [N m, N].
    """

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
        self._segment = _Segment(0.0, 0.0, np.zeros(_STATE_SIZE), np.zeros(_STATE_SIZE))
        self.faults = FaultSwitches(shared["faults"][0])
        self.capacitance_noise = shared["capacitance_noise"]
        self.wrench_noise = shared["wrench_noise"][0]

    @property
    def port(self) -> int:
        """Command port of the simulated motion-capture server; 0 until it is running."""
        return int(self._shared["port"][0])

    @port.setter
    def port(self, port: int) -> None:
        self._shared["port"][0] = port

    def push(
        self, moment: float, capacitance: FloatArray, wrench: FloatArray, poses: FloatArray
    ) -> None:
        """Add the state at a time.

        Args:
            moment: Time on the steady clock, later than those of all states before [s].
            capacitance: Capacitances of c <= `MAX_CLUSTERS` clusters by the converter's input,
                without noise, shape (c, 4) [pF].
            wrench: Load on the load cell [M; F] in {S}, with the offset that its tare leaves and
                without noise, shape (6,) [N m, N].
            poses: Poses of the marker bodies of socket and pylon, in this order, in the world:
                position [m], then unit quaternion (x, y, z, w), shape (2, 7).
        """
        state = np.zeros(_STATE_SIZE)
        state[: capacitance.size] = capacitance.ravel()
        state[_CAPACITANCES:] = np.concatenate([wrench, poses.ravel()])
        # An odd count tells readers that a change is in progress.
        self._changes[0] += 1
        if self._changes[0] == 1:  # extend the first state into the past
            self._time[:] = moment - np.arange(_STATES, 0, -1)
            self._state[:] = state
        slot = (int(self._newest[0]) + 1) % _STATES
        self._time[slot] = moment
        self._state[slot] = state
        self._newest[0] = slot
        self._changes[0] += 1

    def capacitance(self, cluster: int, channel: int, moment: float) -> float:
        """Capacitance at an input of a cluster, without noise [pF].

        Args:
            cluster: Index of the cluster, from 0, in the order in which they were pushed.
            channel: Its converter's input, 0..3.
            moment: Time on the steady clock [s].
        """
        return float(self._at(moment)[4 * cluster + channel])

    def wrench(self, moment: float) -> FloatArray:
        """Load on the load cell [M; F] in {S} at a time [s], without noise, shape (6,) [N m, N]."""
        return self._at(moment)[_CAPACITANCES : _CAPACITANCES + 6]

    def poses(self, moment: float) -> FloatArray:
        """Poses of the marker bodies of socket and pylon in the world at a time [s], shape (2, 7).

        Each row is a position [m], then a unit quaternion (x, y, z, w).
        """
        poses = self._at(moment)[_CAPACITANCES + 6 :].reshape(2, 7)
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        return poses

    def wall_clock(self) -> int:
        """The simulated system clock since the epoch [ns]."""
        return self._clock.now() + round(self.faults["clock.step"] * 1e9)

    def _at(self, moment: float) -> FloatArray:
        """The state at a time of the steady clock, interpolated linearly."""
        segment = self._segment
        if not segment.start <= moment < segment.end:
            segment = self._segment = self._find(moment)
        return segment.state + (moment - segment.start) * segment.rate

    def _find(self, moment: float) -> _Segment:
        """The segment around a time; constant beyond the newest and oldest states."""
        while True:
            before = self._changes[0]
            newest = int(self._newest[0])
            later, after = newest, newest
            while self._time[after] > moment and (after - 1) % _STATES != newest:
                later, after = after, (after - 1) % _STATES
            start, end = float(self._time[after]), float(self._time[later])
            state, rate = self._state[after].copy(), np.zeros(_STATE_SIZE)
            if start <= moment < end:
                rate = (self._state[later] - state) / (end - start)
            else:
                end = start  # constant: holds for no other time
            if before % 2 == 0 and before == self._changes[0]:
                return _Segment(start, end, state, rate)
