"""Reads the load cell's converter continuously and keeps its conversions with their times.

If DRDY is wired, its edges give the times. Otherwise the DRDY bits of STATUS show which frames
hold new conversions, and the times are inferred from those frames.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Callable

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.drivers import ERROR, OK, RECENT, WARN
from socket_testbed.drivers.gpio import EdgeLine, lines_failed
from socket_testbed.drivers.load_cell import ads131m0x
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import MAX_TARE, LoadCellSettings

_MAX_FRAMES = 8  # read in a row; two conversions can wait, and frames can be corrupted
_MAX_READ_TIME = 0.25  # periods; normally a frame takes less
_SILENCE_TIMEOUT = 0.1  # [s] without a conversion
_HISTORY = MAX_TARE + 1.0  # [s]
_MAX_PAUSE = 1.95  # periods after the first waiting conversion; a third one would be lost
_CLOCK_ERROR = 2e-3  # of the period; of the converter's clock relative to the steady clock
_POLL_MARGIN = 0.1  # periods; of a poll after the end of a conversion
_FIFO_SIZE = 2  # conversions
_MAX_ATTEMPTS = 5  # to empty the FIFO without an edge in between
_MAX_ROWS = 200_000
_CHECK_CLOCK = "check the converter's clock and its supply"


class ConversionClock:
    """Infers the end times of conversions from the times when frames were read.

    A frame without new data means that no conversion was waiting: the next one ends later, within
    one period. A frame with new data means that its conversion had ended. Conversions are equally
    spaced by the `period` [s], so all these bounds hold for the next conversion as well, and
    together they are much tighter than the polling interval. All times are on the steady clock.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        # Earliest and latest end of the next conversion to be read; None if it cannot be told
        # which one that will be.
        self._bounds: tuple[float, float] | None = None
        self._last: float | None = None
        self._continuous = False

    @property
    def earliest(self) -> float | None:
        """Time until which the next conversion has not ended [s]; None if unknown."""
        return None if self._bounds is None else self._bounds[0]

    @property
    def expected(self) -> float | None:
        """When the next conversion is expected to have ended [s]; None if unknown.

        Reading a little earlier or later than it ends is what keeps its bounds close.
        """
        if self._bounds is None:
            return None
        return 0.5 * sum(self._bounds) + _POLL_MARGIN * self._period

    def lose(self) -> None:
        """Lose track, after a lost frame or an unknown delay, until the FIFO is empty."""
        self._bounds = None
        self._continuous = False

    def nothing_waits(self, begin: float, read: float) -> None:
        """Note that a frame held no new data.

        Args:
            begin: Time before the frame was read [s].
            read: Time after it was read [s]; if it took a quarter of a period or longer, that alone
                does not tell which conversion is the next.
        """
        low, high = self._bounds or (begin, math.inf)
        if begin > high:  # conversions had paused
            low, high, self._last = begin, math.inf, None
        elif self._bounds is None and read - begin >= _MAX_READ_TIME * self._period:
            return
        self._bounds = max(low, begin), min(high, read + self._period)

    def conversion_end(self, read: float) -> float | None:
        """End time [s] of the conversion in a new frame, from the time after it was read [s].

        None if the conversion cannot be identified.
        """
        if self._bounds is None:
            return None
        low, high = self._bounds
        high = min(high, read)
        if high < low:  # the converter is faster than it should be
            self._last = None
        if high < low or read - low > _MAX_PAUSE * self._period:
            self.lose()
            return None
        end = middle = 0.5 * (low + high)
        if self._last is not None:
            # One period after the last; if some were lost, the number closest to the middle.
            steps = 1 if self._continuous else round((middle - self._last) / self._period)
            end = self._last + self._period * steps
        self._last = min(max(end, low), high)
        self._continuous = True
        self._bounds = (
            low + (1.0 - _CLOCK_ERROR) * self._period,
            high + (1.0 + _CLOCK_ERROR) * self._period,
        )
        return self._last


class ConverterReader:
    """The converter of a load cell and its recent conversions.

    One thread polls and finally closes it; the other methods are thread-safe. After a failure the
    bus is reopened, and the DRDY line if it is wired. All times are on the steady clock [s].

    Args:
        settings: The converter's channels, clock, oversampling, gain and checksum.
        open_device: Opens its bus; may raise a `DeviceError`, and is then called again later.
        open_line: Opens the line of its DRDY, with an edge per conversion; None if not wired.

    Attributes:
        period: Time between conversions [s].
        open_line: The argument of this name; a new value takes effect at the next connection.
    """

    def __init__(
        self,
        settings: LoadCellSettings,
        open_device: Callable[[], ads131m0x.SpiDevice],
        open_line: Callable[[], EdgeLine] | None = None,
    ) -> None:
        self.period = ads131m0x.conversion_period(settings.clock_in, settings.oversampling)
        self.open_line = open_line
        self._silence = max(_SILENCE_TIMEOUT, 5.0 * self.period)  # error without a conversion [s]
        self._delay = ads131m0x.group_delay(settings.clock_in, settings.oversampling)
        self._settings = settings
        self._open_device = open_device
        self._name = f"spidev{settings.device}"

        self._line: EdgeLine | None = None
        self._synchronised = False  # with DRDY: every waiting conversion still has its edge
        self._spi: ads131m0x.SpiDevice | None = None
        self._converter: ads131m0x.Ads131m0x | None = None
        self._backoff = clocks.Backoff()
        self._ends = ConversionClock(self.period)
        self._connected = -np.inf  # [s]
        self._matched = -np.inf  # time of the last valid frame [s]
        self._transfer_failed = False  # the last one
        # frames since the last conversion with a known time: not matching their checksum, or valid
        self._frames_corrupted = self._frames_valid = 0

        self._lock = threading.Lock()  # for all fields below
        # The last conversions in order of time [s], with their codes.
        self._capacity = min(math.ceil(_HISTORY / self.period), _MAX_ROWS)
        self._times: list[float] = []
        self._codes: list[IntArray] = []
        self._emptied = self._corrupted = self._failed = -np.inf  # [s]
        # times of the last conversion, and of the last one with a known time [s]
        self._arrived = self._stored = clocks.monotonic()
        self._polled = self._arrived  # begin of the last poll [s]
        self._fault: DeviceError | None = None
        self._counts = dict.fromkeys(
            ("conversions", "checksum_errors", "failed_transfers", "restarts"), 0
        )
        self._polling = False  # a poll is in progress
        if open_line is not None:
            self._counts["status_disagrees"] = 0

    def poll_until(
        self, stopped: Callable[[], bool], polled: Callable[[], None] = lambda: None
    ) -> None:
        """Poll at the converter's own rate, soon after each conversion, until stopped.

        Args:
            stopped: Whether to stop; asked before each poll.
            polled: Called after each poll, such as to wake a thread that waits for conversions.
        """
        due = clocks.monotonic()
        while not stopped():
            self.poll()
            polled()
            due = max(due + self.period, clocks.monotonic() - self.period)
            if self._line is None and self._converter is not None:
                due = self._ends.expected or due
            clocks.sleep(max(0.0, due - clocks.monotonic()))

    def poll(self) -> None:
        """Read the waiting conversions, or reconnect to the converter when due.

        It never raises; `fault_at` reports failures. After a pause of two or more periods, the
        conversions in between are lost, as their times are unknown.
        """
        self._polled = clocks.monotonic()
        self._polling = True
        try:
            if self._converter is None:
                if self._backoff.due(clocks.monotonic()):
                    self.connect()
            elif self._line is not None:
                self._read_edges(self._converter, self._line)
            else:
                self._read_waiting(self._converter)
        except DeviceError as error:
            self._fail(error)
        finally:
            self._polling = False

    def connect(self) -> ads131m0x.Ads131m0x:
        """Connect and configure the converter; not for use while another thread polls."""
        if self._converter is None:
            settings = self._settings
            self.close()
            self._spi = self._open_device()
            converter = ads131m0x.Ads131m0x(self._spi, settings.channels, settings.crc, self._name)
            converter.reset_and_configure(settings.oversampling, settings.gain, settings.clock_in)
            if self.open_line is not None:
                self._line, self._synchronised = self.open_line(), False
            self._frames_corrupted = self._frames_valid = 0
            self._ends = ConversionClock(self.period)  # a reset restarts the conversions
            self._connected = clocks.monotonic()
            self._converter = converter
        return self._converter

    def close(self) -> None:
        """Release the bus and the line."""
        self._converter = None
        for opened in (self._spi, self._line):
            if opened is not None:
                opened.close()
        self._spi = self._line = None

    def between(self, start: float, end: float) -> tuple[FloatArray, IntArray]:
        """The n conversions of a span: times, shape (n,) [s], and codes, shape (n, channels) [1].

        The time of a conversion is the middle of its filter; the codes have 24 bits and a sign.

        Args:
            start: Begin of the span, not included [s].
            end: End of the span, included [s].
        """
        with self._lock:
            rows = slice(bisect_right(self._times, start), bisect_right(self._times, end))
            return np.array(self._times[rows]), self._stacked(self._codes[rows])

    def newest(self, count: int) -> IntArray:
        """Codes of the last `count` conversions, shape (n, channels) [1]; n is smaller at first."""
        with self._lock:
            return self._stacked(self._codes[-count:])

    def _stacked(self, codes: list[IntArray]) -> IntArray:
        return np.array(codes, dtype=np.int64).reshape(-1, self._settings.channels)

    def end_time(self, until: float) -> float:
        """When the conversions measured until a time [s] will have ended [s].

        It is later by the filter's `group_delay`.
        """
        return until + self._delay

    def has_all(self, until: float) -> bool:
        """Whether all conversions measured until a time [s] were read."""
        with self._lock:
            return self._emptied >= self.end_time(until)

    def counts(self) -> dict[str, int]:
        """Numbers since the start, of conversions, corrupted or failed frames, and restarts.

        They are `conversions`, `checksum_errors`, `failed_transfers` and `restarts`.

        With a DRDY line also `status_disagrees`: conversions with an edge that STATUS did not show.
        """
        with self._lock:
            return dict(self._counts)

    def fault_at(self, now: float) -> tuple[int, DeviceError | None]:
        """The converter's level at a time [s], OK, WARN or ERROR, and its fault; None if OK."""
        found: tuple[int, DeviceError | None] = OK, None
        with self._lock:
            silent = now - self._arrived > self._silence > 2.0 * (now - self._polled)
            undated = now - self._stored > self._silence
            if (fault := self._fault) is not None and self._failed >= self._stored:
                found = ERROR, fault
            elif silent or (undated and self._mostly_corrupted):
                found = ERROR, self._silence_error(now)
            elif self._polling and now - self._polled > self._silence:
                hint = "see dmesg for the SPI controller, or relieve the computer"
                found = ERROR, self._error("a transfer does not end", hint)
            elif undated:
                hint = "relieve the computer, or raise load_cell_node's oversampling"
                found = ERROR, self._error("conversions are read too late to date them", hint)
            elif fault is not None and now - self._failed < RECENT:
                found = WARN, DeviceError(f"{fault.fact}, but has recovered", fault.hint)
            elif now - self._corrupted < RECENT:
                fact = "frames do not match their checksums and are left out"
                found = WARN, self._error(fact, ads131m0x.CHECK_WIRING)
            elif not self._counts["conversions"]:
                found = WARN, self._error("no conversion yet", "wait for the first")
        return found

    @property
    def _mostly_corrupted(self) -> bool:
        return self._frames_corrupted > self._frames_valid

    def _silence_error(self, now: float) -> DeviceError:
        """Why none comes at a time [s]: corrupted frames hide them, or the converter stopped."""
        if not self._mostly_corrupted:
            return self._error("no longer converts", _CHECK_CLOCK)
        share = "no" if now - self._matched > self._silence else "hardly any"
        return self._error(f"{share} frame matches its checksum", ads131m0x.CHECK_WIRING)

    def _error(self, fact: str, hint: str) -> DeviceError:
        return DeviceError(f"{self._name}: {fact}", hint)

    def _read_waiting(self, converter: ads131m0x.Ads131m0x) -> None:
        for _ in range(_MAX_FRAMES):
            begin = clocks.monotonic()
            if (frame := self._read(converter, begin)) is None:
                # It may have held a conversion, so the following ones are ambiguous.
                self._ends.lose()
                continue
            if not frame.new:
                self._ends.nothing_waits(begin, self._matched)
                with self._lock:
                    self._emptied = begin
                break
            self._take(frame, self._ends.conversion_end(self._matched))
            following = self._ends.earliest
            if following is not None and clocks.monotonic() < following:  # nothing waits
                with self._lock:
                    self._emptied = following
                break
        self._expect_conversions()

    def _read(
        self, converter: ads131m0x.Ads131m0x, begin: float
    ) -> ads131m0x.ConverterFrame | None:
        """Read a frame, starting at a time [s]; None if it is corrupted, or once if it fails."""
        try:
            frame = converter.read()
        except ads131m0x.TransferError:
            if self._transfer_failed:
                raise
            self._transfer_failed = True
            with self._lock:
                self._counts["failed_transfers"] += 1
            return None
        except ads131m0x.ChecksumError:
            self._frames_corrupted += 1
            with self._lock:
                self._corrupted = begin
                self._counts["checksum_errors"] += 1
            self._transfer_failed = False
            return None
        self._transfer_failed = False
        self._frames_valid += 1
        self._matched = clocks.monotonic()
        return frame

    def _read_edges(self, converter: ads131m0x.Ads131m0x, line: EdgeLine) -> None:
        """Read a frame for each edge; drops ambiguous ones."""
        begin = clocks.monotonic()
        edges = self._edges(line)
        if edges and not (self._synchronised and len(edges) <= _FIFO_SIZE):
            self._synchronise(converter, line)
            edges = []
        for edge in edges:
            frame = self._read(converter, begin)
            # A corrupted frame may have held a conversion; a late one may follow the loss of the
            # first of three.
            if frame is None or self._matched > edges[0] + _MAX_PAUSE * self.period:
                self._synchronised = False
                return
            self._take(frame, edge)
            with self._lock:
                self._counts["status_disagrees"] += not frame.new
        with self._lock:
            self._emptied = begin
        self._expect_conversions()

    def _synchronise(self, converter: ads131m0x.Ads131m0x, line: EdgeLine) -> None:
        """Drop all waiting conversions (datasheet SBAS950B, 8.5.1.9) between two edges."""
        for _ in range(_MAX_ATTEMPTS):
            converter.check_frames(_FIFO_SIZE)
            if not self._edges(line):
                self._synchronised = True
                return

    def _edges(self, line: EdgeLine) -> list[float]:
        try:
            return line.edges(0.0)
        except OSError as error:
            raise lines_failed(f"{self._name}: the edges of DRDY", error) from None

    def _take(self, frame: ads131m0x.ConverterFrame, end: float | None) -> None:
        """Store the conversion just read, with its end time [s]; None: unknown."""
        with self._lock:
            self._arrived = self._matched
            if end is None:
                return
            self._stored = self._matched
            self._frames_corrupted = self._frames_valid = 0
            self._counts["conversions"] += 1
            self._times.append(end - self._delay)
            self._codes.append(frame.codes)
            if len(self._times) >= 2 * self._capacity:
                del self._times[: -self._capacity], self._codes[: -self._capacity]

    def _expect_conversions(self) -> None:
        now = clocks.monotonic()
        if now - max(self._arrived, self._connected) <= self._silence:
            return
        if self._mostly_corrupted:
            raise self._silence_error(now)
        if self._line is not None and self._converter is not None and self._converter.read().new:
            raise self._error(
                f"converts, but no edge comes on line {self._settings.data_ready_line}",
                "check the wire from DRDY, or set load_cell_node's data_ready_line to -1",
            )
        raise self._silence_error(now)

    def _fail(self, error: DeviceError) -> None:
        now = clocks.monotonic()
        # A converter that worked until now is retried at once: its supply may be back.
        if self._converter is not None and self._arrived > self._connected:
            self._backoff.succeeded()
        else:
            self._backoff.failed(now)
        self.close()
        with self._lock:
            self._fault, self._failed = error, now
            self._counts["restarts"] += 1
