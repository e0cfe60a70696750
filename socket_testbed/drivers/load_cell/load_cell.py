"""The load cell: from the converter's codes to wrenches around given times; health and tare."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray, line_weights
from socket_testbed.clocks import SteadyClock
from socket_testbed.documents import Document, read_document
from socket_testbed.drivers.gpio import EdgeLine
from socket_testbed.drivers.load_cell.ads131m0x import (
    SpiDevice,
    at_rail,
    check_device,
    conversion_period,
    volts,
)
from socket_testbed.drivers.load_cell.converter_reader import ConverterReader
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.files import atomic_output, make_folder
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import LoadCellSettings

AXES = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
UNITS = ("N m", "N m", "N m", "N", "N", "N")
_MAKERS_ORDER = (3, 4, 5, 0, 1, 2)  # of Fx Fy Fz Mx My Mz, to have the moments first
_NUMBERS = {  # settings with a number for each bridge or axis
    "inputs": "give the input of each of the six bridges, 6 numbers",
    "amplifier_gain": "give the gain of each of the six bridges, 6 numbers",
    "sign": "give the sign of each of the six bridges, 6 numbers",
    "full_scale": "give the maker's full scale of each axis, 6 numbers",
    "matrix": "give the maker's 36 numbers, row by row",
}
_WORST_CONDITION = 1e6  # [-]; of the maker's matrix with rows of length one

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_BROKEN_WIRE = 5  # conversions in a row at a rail
_AFTER = 0.25  # part of the window that is after the trigger
_WORST = 3.0  # variance of a wrench from what is left of a window, against the complete one's
_NEARLY_ALL = 0.9  # part of the conversions in a span that are averaged, at least
_RECENT = 0.8  # [s]; span of a report of health


class Bridges:
    """The bridges as the settings describe them, checked.

    `ratio = sign * mV / (excitation * amplifier_gain)`, `wrench = C @ ratio`, with the voltage
    at the converter's input, so that the converter's own gain is out of it already.
    """

    def __init__(self, settings: LoadCellSettings) -> None:
        check_settings(settings)
        order = list(_MAKERS_ORDER)
        # input of the converter that each bridge is on, shape (6,)
        self.inputs: IntArray = np.array(settings.inputs, dtype=np.int64)
        # wrench [M; F] over the bridges' ratios, shape (6, 6) [N m, N per mV/V]
        self.matrix: FloatArray = np.array(settings.matrix).reshape(6, 6)[order]
        # full scale of [M; F], shape (6,) [N m, N]
        self.full_scale: FloatArray = np.array(settings.full_scale)[order]
        self._gain = settings.gain
        self._scale: FloatArray = (
            1e3 * np.array(settings.sign) / settings.excitation / np.array(settings.amplifier_gain)
        )

    def ratios(self, codes: IntArray) -> FloatArray:
        """Ratios of the bridges, shape (n, 6) [mV/V], of codes by input, shape (n, channels)."""
        return self._scale * volts(codes[:, self.inputs], self._gain)

    def wrenches(self, ratios: FloatArray) -> FloatArray:
        """Wrenches [M; F], shape (..., 6) [N m, N], of ratios, shape (..., 6) [mV/V]."""
        return ratios @ self.matrix.T

    def ratios_at(self, wrenches: FloatArray) -> FloatArray:
        """Ratios, shape (..., 6) [mV/V], of wrenches [M; F], shape (..., 6): undoes `wrenches`."""
        return np.asarray(wrenches @ np.linalg.inv(self.matrix).T)

    def ratios_from(self, other: Bridges, ratios: FloatArray) -> FloatArray:
        """Ratios, shape (..., 6) [mV/V], of the voltages that make given ones by other settings.

        The converter's own gain was set in it, and is that of the other settings.
        """
        if lacking := sorted(set(self.inputs.tolist()) - set(other.inputs.tolist())):
            raise _wrong(
                f"inputs names input {lacking[0]}, which was not recorded",
                f"give inputs of {', '.join(map(str, sorted(other.inputs.tolist())))}",
            )
        bridges = [other.inputs.tolist().index(place) for place in self.inputs]
        return np.asarray((ratios / other._scale)[..., bridges] * self._scale)

    def overload(self, peak: FloatArray) -> tuple[int, str]:
        """How far absolute values of [M; F], shape (6,), go beyond the cell.

        Returns:
            0, 1 above 80 % of a full scale or 2 above all of it, with the fact and the hint.
        """
        share = peak / self.full_scale
        worst = int(share.argmax())
        # In steps, so that a message stands while the load moves about.
        tenths = math.floor(10.0 * share[worst] + 1e-9)
        level = 2 if share[worst] > 1.0 else 1 if share[worst] > 0.8 else 0
        if level == 0:
            return 0, ""
        limit = f"{10 * tenths} % of its full scale of {self.full_scale[worst]:g} {UNITS[worst]}"
        hint = "unload the cell" if level == 2 else "do not load it further"
        return level, f"{AXES[worst]} is above {limit}: {hint}"


def in_words(wrench: FloatArray) -> str:
    """The values of [M; F], shape (6,) [N m, N], with their names and units."""
    values = zip(AXES, wrench, UNITS, strict=True)
    return ", ".join(f"{axis} {value:.4g} {unit}" for axis, value, unit in values)


def check_settings(settings: LoadCellSettings) -> None:
    """Check that the settings fit together, beyond the range of each."""
    check_device(settings.device)
    if settings.channels not in (6, 8):
        raise _wrong(f"channels is {settings.channels}", "give 6 (ADS131M06) or 8 (ADS131M08)")
    for name, low, high in (("oversampling", 128, 16384), ("gain", 1, 128)):
        value = getattr(settings, name)
        if value.bit_count() != 1 or not low <= value <= high:
            raise _wrong(f"{name} is {value}", f"give a power of two from {low} to {high}")
    for name, hint in _NUMBERS.items():
        values = getattr(settings, name)
        if len(values) != (36 if name == "matrix" else 6):
            count = f"has {len(values)} numbers" if values else "is empty"
            raise _wrong(f"{name} {count}", hint)
    if len(set(settings.inputs)) < len(settings.inputs):
        raise _wrong("inputs names an input twice", "give each bridge an input of its own")
    if max(settings.inputs) >= settings.channels:
        raise _wrong(
            f"inputs names input {max(settings.inputs)} of a converter of {settings.channels}",
            f"give inputs from 0 to {settings.channels - 1}",
        )
    if any(abs(sign) != 1.0 for sign in settings.sign):
        raise _wrong("sign holds a value other than 1 and -1", "give 1 or -1 for each bridge")
    matrix = np.array(settings.matrix).reshape(6, 6)
    if not np.isfinite(matrix).all():
        raise _wrong("matrix holds a value that is not finite", "give the maker's 36 numbers")
    # Forces and moments differ in size by their units; that is no fault of a matrix.
    lengths = np.linalg.norm(matrix, axis=1, keepdims=True)
    if not lengths.all() or np.linalg.cond(matrix / lengths) > _WORST_CONDITION:
        raise _wrong("matrix cannot be inverted", "check the maker's 36 numbers, row by row")
    period = conversion_period(settings.clock_in, settings.oversampling)
    if settings.window < period:
        raise _wrong(
            f"window is {settings.window:g} s, shorter than a conversion ({period:g} s)",
            "give a longer window or less oversampling",
        )


def _wrong(fact: str, hint: str) -> ConfigurationError:
    return ConfigurationError(f"load_cell_node: {fact}", hint)


class Tare:
    """The ratios of the bridges that stand for no load, kept in a file if a path is given."""

    def __init__(self, path: str) -> None:
        self._path = Path(path).expanduser() if path else None
        self._writing = threading.Lock()
        # ratios at no load, shape (6,) [mV/V], and when they were taken, since the epoch [ns]; 0 if
        # never
        self.no_load: tuple[FloatArray, int] = np.zeros(6), 0
        if self._path is not None and self._path.exists():
            try:
                document = read_document(self._path, _TareDocument)
            except ConfigurationError as error:
                raise ConfigurationError(error.fact, "remove the file and tare again") from None
            microseconds = (document.time - _EPOCH) // timedelta(microseconds=1)
            self.no_load = np.array(document.offsets_mV_per_V), 1000 * microseconds

    def set(self, offsets: FloatArray, time: int) -> None:
        """Take other ratios and write them to the file.

        Args:
            offsets: Ratios at no load, shape (6,) [mV/V].
            time: When they were taken, since the epoch [ns]; kept to a microsecond.
        """
        with self._writing:
            if self._path is not None:
                content = {"offsets_mV_per_V": offsets.tolist(), "time": _written(time)}
                make_folder(self._path.parent)
                with atomic_output(self._path) as path:
                    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            self.no_load = offsets.copy(), 1000 * (time // 1000)


def _written(time: int) -> str:
    """A time since the epoch [ns] in the form of ISO 8601, to a microsecond."""
    return (_EPOCH + timedelta(microseconds=time // 1000)).isoformat()


_Ratio = Annotated[float, Meta(ge=-1e3, le=1e3)]  # [mV/V]; no bridge comes near it


class _TareDocument(Document):
    offsets_mV_per_V: tuple[_Ratio, _Ratio, _Ratio, _Ratio, _Ratio, _Ratio]
    time: Annotated[datetime, Meta(tz=True)]


@dataclass(frozen=True)
class WrenchReading:
    """The wrench around a time."""

    wrench: FloatArray  # wrench [M; F], shape (6,) [N m, N]; all NaN if it was not measured
    ratios: FloatArray  # ratios of the bridges that it was made of, shape (6,) [mV/V]; NaN likewise
    tare: FloatArray  # subtracted, [M; F], shape (6,) [N m, N]
    tared: int  # when that was taken, since the epoch [ns]; 0 if never
    status: Status  # OK, SATURATED or MISSING
    conversions: int  # number of conversions around the time
    fault: str  # empty for none. An overload leaves the wrench as it is


class LoadCell:
    """A load cell behind an ADS131M06 or ADS131M08.

    One thread polls it and closes it in the end; any other thread may ask for the rest.

    Args:
        open_device: Opens its bus; called again after a failure.
        open_line: Opens the line that DRDY is wired to; None: it is not wired.
    """

    def __init__(
        self,
        settings: LoadCellSettings,
        open_device: Callable[[], SpiDevice],
        clock: Callable[[], float] = clocks.monotonic,
        sleep: Callable[[float], None] = clocks.sleep,
        open_line: Callable[[], EdgeLine] | None = None,
    ) -> None:
        # others may be assigned, of which the window and those of the tare are followed
        self.settings = settings
        self._clock = clock
        self._bridges = Bridges(settings)
        self._tare = Tare(settings.tare_file)
        self._reader = ConverterReader(settings, open_device, clock, sleep, open_line)

    @property
    def period(self) -> float:
        """Time from one conversion to the next [s]: how often to poll."""
        return self._reader.period

    def poll(self) -> None:
        """Read the conversions that wait, and connect to the converter again after a failure.

        `health` reports a device that fails; nothing is raised. A pause of two periods or
        more costs the conversions since, whose times nobody knows.
        """
        self._reader.poll()

    def close(self) -> None:
        """Give the bus back."""
        self._reader.close()

    def identify(self) -> str:
        """Which converter this is; for a thread that does not poll at the same time."""
        converter = self._reader.connect()
        settings = self.settings
        return (
            f"ADS131M{settings.channels:02d} on spidev{settings.device}, "
            f"ID 0x{converter.identity:04X}"
        )

    def check_frames(self, count: int) -> int:
        """Number of corrupted frames out of so many; as `identify`, and loses conversions."""
        return self._reader.connect().check_frames(count)

    def figures(self) -> dict[str, object]:
        """Numbers of conversions, of corrupted frames and of restarts, and the tare."""
        offsets, time = self._tare.no_load
        tare = {
            "tare": in_words(self._bridges.wrenches(offsets)),
            "tared": _written(time) if time else "never",
        }
        return {**self._reader.counts(), **tare}

    def over(self, moment: float, span: float = 0.0) -> float:
        """When the last conversion ends that makes the wrench at a time [s].

        Args:
            moment: The time on the steady clock [s].
            span: Span centred on it that is averaged where the window is shorter [s].
        """
        return self._reader.over(moment + self._reach(span)[1])

    def ready(self, moment: float, span: float = 0.0) -> bool:
        """Whether waiting adds nothing to the wrench at a time; arguments as of `over`.

        Either all conversions around it are in, or they are over and the converter fails.
        """
        if self._reader.has_all(moment + self._reach(span)[1]):
            return True
        now = self._clock()
        return now >= self.over(moment, span) and self._reader.trouble(now)[0] > 1

    def wrench_at(self, moment: float, span: float = 0.0) -> WrenchReading:
        """The wrench at a time; arguments as of `over`.

        It is the value there of the line through the conversions of the window, three quarters
        of which are before it: that is as little late as a mean over half of the window around
        it, and twice as many conversions may be missing. Less than half of them, too few near
        the time, or one at a rail make it NaN.

        A span that reaches further than the window widens it, if nearly all of its conversions
        are there: once it is centred on the time, the line's value is their mean.
        """
        before, after = self._reach(span)
        window = before + after
        end = moment + after
        times, ratios, rails = self._between(end - window, end)
        if span > 0.0 and (rails.any() or len(times) < _NEARLY_ALL * window / self.period):
            return self.wrench_at(moment)
        missing = np.full(6, np.nan)
        if rails.any():
            fault = self._saturated(rails)
            return self._reading(missing, len(times), Status.SATURATED, fault)
        expected = window / self.period
        weights = line_weights(times - moment)
        # The line of all conversions has a variance of 1.75 / expected of theirs: see _AFTER.
        uncertain = weights @ weights > _WORST * 1.75 / expected
        if len(times) < max(1.0, 0.5 * expected) or uncertain:
            fault = f"{len(times)} of {expected:.0f} conversions around the trigger"
            level, fact, hint = self._reader.trouble(self._clock())
            fault = f"{fault}; {fact}: {hint}" if level else fault
            return self._reading(missing, len(times), Status.MISSING, fault)
        return self._reading(weights @ ratios, len(times))

    def _reading(
        self, ratios: FloatArray, conversions: int, status: Status = Status.OK, fault: str = ""
    ) -> WrenchReading:
        """The reading of ratios, shape (6,) [mV/V], which are NaN unless the status is OK."""
        offsets, time = self._tare.no_load
        wrench = self._bridges.wrenches(ratios - offsets)
        if status is Status.OK:
            level, text = self._bridges.overload(np.abs(wrench))
            fault = text if level > 1 else ""
        tare = self._bridges.wrenches(offsets)
        return WrenchReading(wrench, ratios, tare, time, status, conversions, fault)

    def health(self, now: float) -> tuple[int, str]:
        """How it is at a time [s].

        Returns:
            0 (well), 1 (a warning) or 2 (an error), and the fact with the hint.
        """
        level, fact, hint = self._reader.trouble(now)
        found = [(level, f"{fact}: {hint}")] if level else []
        _, ratios, rails = self._between(now - _RECENT, now)
        newest = at_rail(self._reader.newest(_BROKEN_WIRE)[:, self._bridges.inputs])
        broken = newest.sum(axis=0) == _BROKEN_WIRE
        if broken.any():
            fact = f"{self._saturated(broken)} for {_BROKEN_WIRE} conversions or more"
            found.append((2, f"{fact}: a broken wire? check the bridge and its wiring"))
        elif rails.any():
            fact = self._saturated(rails)
            found.append((1, f"{fact} at times: unload the cell, or lower the gain"))
        valid = ratios[~rails.any(axis=1)]
        wrenches = self._bridges.wrenches(valid - self._tare.no_load[0])
        found.append(self._bridges.overload(np.abs(wrenches).max(axis=0, initial=0.0)))
        level, text = max(found, key=lambda entry: entry[0])
        return level, text if level else f"spidev{self.settings.device} converts"

    def tare(self, now: float | None = None, forced: bool = False) -> str:
        """Let the load of the last `tare_duration` stand for no load.

        Args:
            now: End of that span [s]; None for the present.
            forced: Whether a load above `tare_load` is removed, too.

        Returns:
            The load that was removed, in words.
        """
        settings = self.settings
        now = self._clock() if now is None else now
        level, fact, hint = self._reader.trouble(now)
        if level > 1:
            raise DeviceError(f"cannot tare: {fact}", hint)
        _, ratios, rails = self._between(now - settings.tare_duration, now)
        expected = settings.tare_duration / self.period
        if len(ratios) < 0.5 * expected:
            raise DeviceError(
                f"cannot tare: {len(ratios)} of {expected:.0f} conversions in the last "
                f"{settings.tare_duration:g} s",
                "wait that long, or set a shorter tare_duration",
            )
        if rails.any():
            raise DeviceError(
                f"cannot tare: {self._saturated(rails)}",
                "unload the cell, or check the bridge and its wiring",
            )
        spread = self._bridges.wrenches(ratios).std(axis=0)
        limits = np.repeat([settings.tare_moment, settings.tare_force], 3)
        worst = int((spread / limits).argmax())
        if spread[worst] > limits[worst]:
            raise DeviceError(
                f"cannot tare: {AXES[worst]} moves by {spread[worst]:.3g} {UNITS[worst]} "
                f"(standard deviation), more than {limits[worst]:g} {UNITS[worst]}",
                "hold the cell still and tare again",
            )
        offsets = ratios.mean(axis=0)
        removed = self._bridges.wrenches(offsets - self._tare.no_load[0])
        force = float(np.linalg.norm(removed[3:]))
        if force > settings.tare_load and not forced:
            raise DeviceError(
                f"cannot tare: the cell bears {force:.0f} N, more than {settings.tare_load:g} N",
                "take the limb out of the socket; if nothing loads the cell, force it"
                " (load_cell/force_tare)",
            )
        self._tare.set(offsets, SteadyClock().to_epoch(now))
        return f"tared: removed {in_words(removed)}"

    def _between(self, start: float, end: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Times [s] of the conversions, ratios [mV/V] and which are clipped, shape (n, 6) each."""
        times, codes = self._reader.between(start, end)
        return times, self._bridges.ratios(codes), at_rail(codes[:, self._bridges.inputs])

    def _reach(self, span: float) -> tuple[float, float]:
        """How far before and after a time the conversions are that make its wrench [s]."""
        window, half = self.settings.window, 0.5 * span
        return max((1.0 - _AFTER) * window, half), max(_AFTER * window, half)

    def _saturated(self, rails: BoolArray) -> str:
        """Says which bridges are at a rail, shape (6,) or (n, 6)."""
        which = np.flatnonzero(np.atleast_2d(rails).any(axis=0))
        names = [f"bridge {k + 1} (input {self._bridges.inputs[k]})" for k in which]
        return ", ".join(names) + (" is at its rail" if len(names) == 1 else " are at their rails")
