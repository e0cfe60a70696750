"""Reads the load cell's converter all the time, and connects to it again after a failure."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.clocks import Backoff
from socket_testbed.drivers.load_cell.ads131m0x import (
    Ads131m0x,
    ChecksumError,
    ConversionClock,
    ConversionRing,
    SpiDevice,
    at_rail,
    conversion_period,
    group_delay,
)
from socket_testbed.drivers.load_cell.bridges import Bridges
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import LoadCellSettings

_FRAMES = 8  # read in a row at most; two conversions can wait, and frames can be corrupted
_HELD_UP = 0.25  # periods; a frame takes less
_SILENCE = 0.1  # [s] without a conversion
_RECENT = 0.8  # [s]; how long a trouble that is over is told
_KEPT = 61.0  # [s]; more than the longest tare


class ConverterReader:
    """The converter of a load cell, with the conversions that it made.

    One thread calls `poll` and `close`; the other methods may be called from any.

    Args:
        settings: Settings of the load cell.
        bridges: Its bridges.
        open_device: Opens its bus; called again after a failure.
        clock: The steady clock that all times are of [s].
        sleep: Waits for a time [s].

    Attributes:
        period: Time from one conversion to the next [s].
        silence: Time without a conversion that is an error [s].
    """

    def __init__(
        self,
        settings: LoadCellSettings,
        bridges: Bridges,
        open_device: Callable[[], SpiDevice],
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
    ) -> None:
        self.period = conversion_period(settings.clock_in, settings.oversampling)
        self.silence = max(_SILENCE, 5.0 * self.period)
        self._delay = group_delay(settings.clock_in, settings.oversampling)
        self._settings = settings
        self._bridges = bridges
        self._open_device = open_device
        self._clock = clock
        self._sleep = sleep
        self._name = f"spidev{settings.device}"

        self._spi: SpiDevice | None = None
        self._converter: Ads131m0x | None = None
        self._backoff = Backoff()
        self._times = ConversionClock(self.period)
        self._converts = False  # since it was connected
        self._watched = clock()  # since when a conversion is due [s]
        self._matched = -np.inf  # last frame that matched its checksum [s]

        self._lock = threading.Lock()  # of all below
        self._ring = ConversionRing(self.period, _KEPT)
        self._rail_runs = np.zeros(6, dtype=np.int64)
        self._emptied = self._corrupted = self._failed = -np.inf  # [s]
        self._arrived = self._stored = clock()  # a conversion; one whose time is known [s]
        self._fault: DeviceError | None = None
        self._counts = {"conversions": 0, "checksum_errors": 0, "restarts": 0}

    def poll(self) -> None:
        """Read what waits in the converter, or connect to it again when that is due."""
        try:
            if self._converter is not None:
                self._read_waiting(self._converter)
            elif self._backoff.due(self._clock()):
                self.connect()
        except DeviceError as error:
            self._fail(error)

    def connect(self) -> Ads131m0x:
        """The converter, connected and configured.

        Raises:
            DeviceError: If it cannot be reached or is another one.
        """
        if self._converter is None:
            settings = self._settings
            self.close()
            self._spi = self._open_device()
            converter = Ads131m0x(
                self._spi, settings.channels, settings.crc, self._name, self._sleep
            )
            converter.reset_and_configure(settings.oversampling, settings.gain, settings.clock_in)
            self._times = ConversionClock(self.period)  # a reset begins another train of them
            self._converts = False
            self._watched = self._clock()
            self._converter = converter
        return self._converter

    def close(self) -> None:
        """Give the bus back."""
        self._converter = None
        if self._spi is not None:
            self._spi.close()
            self._spi = None

    def between(self, start: float, end: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Conversions measured after `start` and until `end` [s], as `ConversionRing.between`."""
        with self._lock:
            return self._ring.between(start, end)

    def has_all(self, until: float) -> bool:
        """Whether no conversion measured until a time [s] is still to come."""
        with self._lock:
            return self._emptied - self._delay >= until

    def rail_runs(self) -> IntArray:
        """How many conversions in a row each bridge has been at a rail, shape (6,)."""
        with self._lock:
            return self._rail_runs.copy()

    def counts(self) -> dict[str, int]:
        """Numbers of conversions, of corrupted frames and of restarts."""
        with self._lock:
            return dict(self._counts)

    def trouble(self, now: float) -> tuple[int, str, str]:
        """What is wrong with the converter at a time [s].

        Returns:
            0 (nothing), 1 (a warning) or 2 (an error), with the fact and the hint.
        """
        with self._lock:
            return self._error(now) or self._warning(now) or (0, "", "")

    def _error(self, now: float) -> tuple[int, str, str] | None:
        if self._fault is not None and self._failed >= self._stored:
            return 2, self._fault.fact, self._fault.hint
        if now - self._stored <= self.silence:
            return None
        if now - self._arrived > self.silence:
            return 2, f"{self._name}: converts no more", "check its clock and its supply"
        fact = f"{self._name}: conversions are read too late to know their times"
        return 2, fact, "relieve the computer, or raise load_cell_node's oversampling"

    def _warning(self, now: float) -> tuple[int, str, str] | None:
        if self._fault is not None and now - self._failed < _RECENT:
            return 1, f"{self._fault.fact}, and is read again", self._fault.hint
        if now - self._corrupted < _RECENT:
            fact = f"{self._name}: frames do not match their checksums and are left out"
            return 1, fact, "check the wiring, or lower load_cell_node's spi_clock"
        if not self._counts["conversions"]:
            return 1, f"{self._name}: no conversion yet", "wait for the first"
        return None

    def _read_waiting(self, converter: Ads131m0x) -> None:
        for _ in range(_FRAMES):
            begin = self._clock()
            try:
                frame = converter.read()
            except ChecksumError:
                # It may have held a conversion: those behind it cannot be told apart.
                self._times.lose()
                with self._lock:
                    self._corrupted = begin
                    self._counts["checksum_errors"] += 1
                continue
            self._matched = read = self._clock()
            if not frame.new:
                # Held up in the middle of a frame, nobody knows when nothing waited.
                if read - begin < _HELD_UP * self.period:
                    self._times.nothing_waits(begin)
                else:
                    self._times.lose()
                with self._lock:
                    self._emptied = begin
                break
            self._take(frame.codes, read)
        self._expect_conversions()

    def _take(self, codes: IntArray, read: float) -> None:
        self._converts = True
        self._watched = read
        end = self._times.conversion_end(read)
        rails = at_rail(codes[self._bridges.inputs])
        with self._lock:
            self._arrived = read
            if end is None:
                return
            self._stored = read
            self._rail_runs = np.where(rails, self._rail_runs + 1, 0)
            self._counts["conversions"] += 1
            self._ring.add(end - self._delay, self._bridges.ratios(codes), rails)

    def _expect_conversions(self) -> None:
        now = self._clock()
        if now - self._watched <= self.silence:
            return
        if now - self._matched > self.silence:
            raise ChecksumError(
                f"{self._name}: no frame matches its checksum",
                "check the wiring, or lower load_cell_node's spi_clock",
            )
        raise DeviceError(
            f"{self._name}: converts no more", "check the converter's clock and its supply"
        )

    def _fail(self, error: DeviceError) -> None:
        now = self._clock()
        # What worked until now is tried again at once: a supply that dipped is back already.
        if self._converter is not None and self._converts:
            self._backoff.succeeded()
        else:
            self._backoff.failed(now)
        self.close()
        with self._lock:
            self._fault, self._failed = error, now
            self._counts["restarts"] += 1
