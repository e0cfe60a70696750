"""The load cell: wrenches at given times from the converter's codes; health and tare."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray, line_weights
from socket_testbed.documents import Document, read_document
from socket_testbed.drivers import ERROR, OK, RECENT, WARN
from socket_testbed.drivers.load_cell import ads131m0x
from socket_testbed.drivers.load_cell.converter_reader import ConverterReader
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.files import make_folder, write_text
from socket_testbed.samples import WRENCH_CHANNELS, Status, channel_unit
from socket_testbed.settings.acquisition import LoadCellSettings, TareSettings

_UNITS = tuple(map(channel_unit, WRENCH_CHANNELS))
_LENGTHS = {  # settings that are lists: length and hint
    "inputs": (6, "give the input of each of the six bridges"),
    "amplifier_gain": (6, "give the gain of each of the six bridges"),
    "sign": (6, "give the sign, 1 or -1, of each of the six bridges"),
    "full_scale": (6, "give the maker's full scale of each axis, 6 numbers"),
    "matrix": (36, "give the maker's 36 numbers, row by row"),
}
_MAX_CONDITION = 1e6  # [-]; of the maker's matrix with normalised rows

_MOMENTS_FIRST = [3, 4, 5, 0, 1, 2]  # from the maker's Fx Fy Fz Mx My Mz
_CLIPPED_HINT = "unload the cell, or lower the gain"
_FEW_HINT = "relieve the computer if this happens often"
_BROKEN_WIRE = 5  # conversions in a row at a rail
_AFTER = 0.25  # fraction of the window after the trigger
# Variance of a line's value at the trigger relative to that of the mean, 1 + 12 d^2 with d windows
# from the middle [-]
_LINE_VARIANCE = 1.0 + 12.0 * (0.5 - _AFTER) ** 2
_MAX_VARIANCE = 3.0  # [-]; of a wrench from an incomplete window, relative to a complete one
_MIN_COMPLETE = 0.9  # fraction of the conversions in a span required for its mean


class Bridges:
    """The bridges according to the settings, which are checked.

    `ratio = sign * mV / (excitation * amplifier_gain)`, `wrench = C @ ratio`. The voltage is that
    at the converter's input, so the converter's own gain is already removed. The wrench is in the
    load cell's frame {S}, not tared.

    Attributes:
        inputs: Converter input of each bridge, shape (6,).
        matrix: C, the wrench [M; F] from the bridges' ratios, rows Mx My Mz Fx Fy Fz, shape (6, 6)
            [N m per mV/V, N per mV/V].
        full_scale: Full scale of [M; F], shape (6,) [N m, N].
    """

    def __init__(self, settings: LoadCellSettings) -> None:
        check_settings(settings)
        self.inputs: IntArray = np.array(settings.inputs, dtype=np.int64)
        self.matrix: FloatArray = np.array(settings.matrix).reshape(6, 6)[_MOMENTS_FIRST]
        self.full_scale: FloatArray = full_scale_of(settings)
        self._gain = settings.gain
        self._scale: FloatArray = (
            1e3 * np.array(settings.sign) / settings.excitation / np.array(settings.amplifier_gain)
        )

    @property
    def description(self) -> str:
        """The settings on which the ratios depend, as text: inputs, gain and scale."""
        return f"inputs {self.inputs.tolist()}, gain {self._gain}, scale {self._scale.tolist()}"

    def ratios(self, codes: IntArray) -> FloatArray:
        """Ratios of the bridges, (n, 6) [mV/V], of signed 24-bit codes by input, (n, channels)."""
        return self._scale * ads131m0x.volts(codes[:, self.inputs], self._gain)

    def wrenches(self, ratios: FloatArray) -> FloatArray:
        """Wrenches [M; F] in {S}, shape (..., 6) [N m, N], of ratios, shape (..., 6) [mV/V]."""
        return ratios @ self.matrix.T

    def ratios_at(self, wrenches: FloatArray) -> FloatArray:
        """Ratios, shape (..., 6) [mV/V], of wrenches [M; F], shape (..., 6) [N m, N].

        It is the inverse of `wrenches`.
        """
        return np.asarray(wrenches @ np.linalg.inv(self.matrix).T)

    def ratios_from(self, other: Bridges, ratios: FloatArray) -> FloatArray:
        """Ratios, shape (..., 6) [mV/V], of voltages whose ratios were computed by other settings.

        The converter's own gain was applied in hardware, so it is that of the other settings.

        Args:
            other: The bridges by the other settings.
            ratios: The ratios that they gave, shape (..., 6) [mV/V].

        Raises:
            ConfigurationError: These bridges use an input that the other settings did not record.
        """
        if lacking := sorted(set(self.inputs.tolist()) - set(other.inputs.tolist())):
            raise _wrong(
                f"inputs names input {lacking[0]}, which was not recorded",
                f"give inputs of {', '.join(map(str, sorted(other.inputs.tolist())))}",
            )
        bridges = [other.inputs.tolist().index(place) for place in self.inputs]
        return np.asarray((ratios / other._scale)[..., bridges] * self._scale)

    def overload(self, peak: FloatArray) -> tuple[int, str]:
        """Check absolute values of [M; F], shape (6,) [N m, N], for overload: see `overload`."""
        return overload(peak, self.full_scale)


def overload(peak: FloatArray, full_scale: FloatArray) -> tuple[int, str]:
    """Check absolute values of a wrench for overload.

    Args:
        peak: Largest absolute values of [M; F], shape (6,) [N m, N].
        full_scale: Full scale of [M; F], shape (6,) [N m, N].

    Returns:
        The level: WARN above 80 % of an axis's full scale, ERROR above the full scale, otherwise
        OK; and fact with hint in one line, empty if OK.
    """
    share = peak / full_scale
    worst = int(share.argmax())
    # In steps, so that the message is stable while the load varies.
    tenths = math.floor(10.0 * share[worst] + 1e-9)
    level = ERROR if share[worst] > 1.0 else WARN if share[worst] > 0.8 else OK
    if level == OK:
        return OK, ""
    limit = f"{10 * tenths} % of its full scale of {full_scale[worst]:g} {_UNITS[worst]}"
    hint = "unload the cell" if level == ERROR else "do not load it further"
    return level, f"{WRENCH_CHANNELS[worst]} is above {limit}: {hint}"


def full_scale_of(settings: LoadCellSettings) -> FloatArray:
    """Full scale of [M; F] by the settings, shape (6,) [N m, N]; settings without it have none."""
    return np.array(settings.full_scale)[_MOMENTS_FIRST]


def in_words(wrench: FloatArray) -> str:
    """The values of [M; F], shape (6,) [N m, N], with their names and units."""
    values = zip(WRENCH_CHANNELS, wrench, _UNITS, strict=True)
    return ", ".join(f"{axis} {value:.4g} {unit}" for axis, value, unit in values)


def pressed(stresses: Mapping[str, tuple[FloatArray, int]], settings: TareSettings) -> str:
    """The clusters that are pressed too much for a tare, in words; empty if none is.

    Args:
        stresses: By cluster the normal stress (positive in compression) and shears along x and y of
            its own frame, shape (3,) [Pa], NaN if missing, and the `Status`.
        settings: The largest normal stress, `tare_pressure` [Pa].
    """
    found = [
        f"{name} ({1e-3 * stress[0]:.3g} kPa)"
        for name, (stress, status) in stresses.items()
        if status in (Status.OK, Status.OUT_OF_RANGE) and stress[0] > settings.tare_pressure
    ]
    if not found:
        return ""
    verb = "is" if len(found) == 1 else "are"
    limit = f"{1e-3 * settings.tare_pressure:g} kPa"
    return f"{', '.join(found)} {verb} pressed by more than {limit}"


def unrest(wrenches: FloatArray, settings: TareSettings) -> str:
    """The channel that moves too much for a tare, in words; empty if all are at rest.

    Args:
        wrenches: n wrenches [M; F], shape (n, 6) [N m, N].
        settings: The largest standard deviations, `tare_moment` [N m] and `tare_force` [N].
    """
    spread = wrenches.std(axis=0)
    limits = np.repeat([settings.tare_moment, settings.tare_force], 3)
    worst = int((spread / limits).argmax())
    if spread[worst] <= limits[worst]:
        return ""
    unit = _UNITS[worst]
    moved = f"{spread[worst]:.3g} {unit} (standard deviation)"
    return f"{WRENCH_CHANNELS[worst]} moves by {moved}, more than {limits[worst]:g} {unit}"


def refuse_tare(
    wrenches: FloatArray, removed: FloatArray, settings: TareSettings, forced: bool
) -> None:
    """Refuse a tare while the load moves, or that removes the weight of a person.

    Args:
        wrenches: n wrenches [M; F] during the tare, shape (n, 6) [N m, N].
        removed: The load that it removes, [M; F], shape (6,) [N m, N].
        settings: The limits.
        forced: Whether to remove even a force above `tare_load`.

    Raises:
        DeviceError: The load moves, or its force is above `tare_load` and not forced.
    """
    if moving := unrest(wrenches, settings):
        raise DeviceError(f"cannot tare: {moving}", "hold the cell still and tare again")
    force = float(np.linalg.norm(removed[3:]))
    if force > settings.tare_load and not forced:
        raise DeviceError(
            f"cannot tare: the cell bears {force:.0f} N, more than {settings.tare_load:g} N",
            "take the limb out of the socket; if nothing loads the cell, force it"
            " (load_cell/force_tare)",
        )


def check_settings(settings: LoadCellSettings) -> None:
    """Check that the settings fit together, beyond the range of each.

    Raises:
        ConfigurationError: A list has the wrong length or holds a wrong value, the matrix cannot be
            inverted, or the window is shorter than a conversion.
    """
    ads131m0x.check_device(settings.device)
    if settings.channels not in (6, 8):
        raise _wrong(f"channels is {settings.channels}", "give 6 (ADS131M06) or 8 (ADS131M08)")
    for name in ("oversampling", "gain"):
        if (value := getattr(settings, name)).bit_count() != 1:
            raise _wrong(f"{name} is {value}", "give a power of two")
    for name, (count, hint) in _LENGTHS.items():
        if (given := len(getattr(settings, name))) != count:
            raise _wrong(f"{name} has {given} numbers" if given else f"{name} is empty", hint)
    if len(set(settings.inputs)) < len(settings.inputs):
        raise _wrong("inputs names an input twice", "give each bridge an input of its own")
    if max(settings.inputs) >= settings.channels:
        raise _wrong(
            f"inputs names input {max(settings.inputs)} of a converter of {settings.channels}",
            f"give inputs from 0 to {settings.channels - 1}",
        )
    if any(abs(sign) != 1.0 for sign in settings.sign):
        raise _wrong("sign holds a value other than 1 and -1", _LENGTHS["sign"][1])
    matrix = np.array(settings.matrix).reshape(6, 6)
    # Rows are normalised, since forces and moments have different units.
    norms = np.linalg.norm(matrix, axis=1, keepdims=True)
    if not norms.all() or np.linalg.cond(matrix / norms) > _MAX_CONDITION:
        raise _wrong("matrix cannot be inverted", "check the maker's 36 numbers, row by row")
    period = ads131m0x.conversion_period(settings.clock_in, settings.oversampling)
    if settings.window < period:
        raise _wrong(
            f"window is {settings.window:g} s, shorter than a conversion ({period:g} s)",
            "give a longer window or less oversampling",
        )


def _wrong(fact: str, hint: str) -> ConfigurationError:
    return ConfigurationError(f"load_cell_node: {fact}", hint)


class Tare:
    """The bridges' ratios at no load, stored in a file if a path is given.

    The constructor raises a `ConfigurationError` if the file is damaged or of other settings.

    Args:
        path: The file; empty for none.
        taken_with: Description of the settings on which the ratios depend, see
            `Bridges.description`: with others, a stored tare is wrong.

    Attributes:
        no_load: Ratios at no load, shape (6,) [mV/V], and their time since the epoch [ns], rounded
            down to a microsecond; zeros and 0 if never taken.
    """

    def __init__(self, path: str, taken_with: str) -> None:
        self._path = Path(path).expanduser() if path else None
        self._taken_with = taken_with
        self._writing = threading.Lock()
        self.no_load: tuple[FloatArray, int] = np.zeros(6), 0
        if self._path is not None and self._path.exists():
            try:
                document = read_document(self._path, _TareDocument)
            except ConfigurationError as error:
                raise ConfigurationError(error.fact, "remove the file and tare again") from None
            if document.taken_with not in ("", taken_with):
                fact = f"{self._path}: was taken with other inputs, signs, gains or excitation"
                raise ConfigurationError(fact, "remove the file and tare again")
            microseconds = round(1e6 * document.time.timestamp())
            self.no_load = np.array(document.offsets_mV_per_V), 1000 * microseconds

    def set(self, offsets: FloatArray, time: int) -> None:
        """Set new ratios and write them to the file.

        Args:
            offsets: Ratios of the bridges at no load, shape (6,) [mV/V].
            time: When they were taken, since the epoch [ns].
        """
        with self._writing:
            if self._path is not None:
                content = {
                    "offsets_mV_per_V": offsets.tolist(),
                    "time": iso_time(time),
                    "taken_with": self._taken_with,
                }
                make_folder(self._path.parent)
                write_text(self._path, json.dumps(content, indent=2) + "\n")
            self.no_load = offsets.copy(), 1000 * (time // 1000)


def iso_time(time: int) -> str:
    """A time since the epoch [ns] in ISO 8601 format, to a microsecond."""
    return datetime.fromtimestamp((time // 1000) / 1e6, UTC).isoformat()


_Ratio = Annotated[float, Meta(ge=-1e3, le=1e3)]  # [mV/V]; far beyond any bridge


class _TareDocument(Document):
    offsets_mV_per_V: tuple[_Ratio, _Ratio, _Ratio, _Ratio, _Ratio, _Ratio]
    time: Annotated[datetime, Meta(tz=True)]
    taken_with: str = ""  # unknown in files of older versions


@dataclass(frozen=True)
class WrenchReading:
    """The wrench at a time.

    Attributes:
        wrench: Wrench [M; F] in {S}, tared, shape (6,) [N m, N]; all NaN unless the status is OK.
        ratios: Ratios of the bridges before the tare, shape (6,) [mV/V]; all NaN unless the status
            is OK.
        tare: Wrench [M; F] that was subtracted, shape (6,) [N m, N]; zeros if never tared.
        tared: Time of the tare since the epoch [ns]; 0 if never tared.
        status: OK, SATURATED (a bridge is at its rail) or MISSING (too few conversions).
        conversions: Number of conversions around the time.
        fault: Why there is no wrench, or which axis is overloaded, in one line of fact and hint;
            empty for none. An overload does not invalidate the wrench.
    """

    wrench: FloatArray
    ratios: FloatArray
    tare: FloatArray
    tared: int
    status: Status
    conversions: int
    fault: str


class LoadCell:
    """A load cell on an ADS131M06 or ADS131M08; all methods are thread-safe.

    The constructor takes the attributes. Settings that do not fit together, or a file of the tare
    that does not fit them, raise a `ConfigurationError`.

    Attributes:
        settings: Its settings. They may be reassigned: changes of the window and of the tare's
            duration and limits take effect.
        converter: Its converter; a thread must poll it.
    """

    def __init__(self, settings: LoadCellSettings, converter: ConverterReader) -> None:
        self.settings = settings
        self.converter = converter
        self._bridges = Bridges(settings)
        self._tare = Tare(settings.tare_file, self._bridges.description)

    def figures(self) -> dict[str, object]:
        """Figures by name: the converter's `counts`, the tare [M; F] with units, and its time.

        The time is in ISO 8601 format, or "never".
        """
        offsets, time = self._tare.no_load
        tare = in_words(self._bridges.wrenches(offsets))
        tared = iso_time(time) if time else "never"
        return {**self.converter.counts(), "tare": tare, "tared": tared}

    def end_time(self, moment: float, span: float = 0.0) -> float:
        """When the last conversion for the wrench at a time ends, on the steady clock [s].

        Args:
            moment: Time of the wrench on the steady clock [s].
            span: Averaging time centred on the moment [s]; where it reaches further than the
                settings' `window`, on either side, it widens the window. 0: the window alone.
        """
        return self.converter.end_time(moment + self._reach(span)[1])

    def ready(self, moment: float, span: float = 0.0) -> bool:
        """Whether the wrench at a time needs no further waiting.

        Either all its conversions were read, or they have ended and the converter has failed.

        Args:
            moment: Time of the wrench on the steady clock [s].
            span: Averaging time centred on the moment, see `end_time` [s].
        """
        if self.converter.has_all(moment + self._reach(span)[1]):
            return True
        now = clocks.monotonic()
        return now >= self.end_time(moment, span) and self.converter.fault_at(now)[0] >= ERROR

    def wrench_at(self, moment: float, span: float = 0.0) -> WrenchReading:
        """The wrench at a time, from the conversions around it.

        It is the value at that time of a line fitted to the conversions in the window, three
        quarters of which lie before it. Its delay is that of a mean over half a window centred on
        the time, but twice as many conversions may be missing. It is NaN if fewer than half are
        there, if too few are near the time, or if one is at a rail.

        A longer span widens the window if nearly all its conversions are there. If it is centred
        on the time, the line's value is their mean.

        Args:
            moment: Time of the wrench on the steady clock [s].
            span: Averaging time centred on the moment, see `end_time` [s].
        """
        before, after = self._reach(span)
        times, ratios, rails = self._between(moment - before, moment + after)
        count, expected = len(times), (before + after) / self.converter.period
        if span > 0.0 and (rails.any() or count < _MIN_COMPLETE * expected):
            return self.wrench_at(moment)
        weights = line_weights(times - moment)
        uncertain = weights @ weights > _MAX_VARIANCE * _LINE_VARIANCE / expected
        value, status, fault = np.full(6, np.nan), Status.MISSING, ""
        if rails.any():
            status, fault = Status.SATURATED, f"{self._saturated(rails)}: {_CLIPPED_HINT}"
        elif count < max(1.0, 0.5 * expected) or uncertain:
            fault = f"{count} of {expected:.0f} conversions around the trigger"
            _, cause = self.converter.fault_at(clocks.monotonic())
            fault = f"{fault}; {cause}" if cause else f"{fault}: {_FEW_HINT}"
        else:
            value, status = weights @ ratios, Status.OK
        offsets, tared = self._tare.no_load
        wrench, tare = self._bridges.wrenches(np.array([value - offsets, offsets]))
        if status is Status.OK:
            level, text = self._bridges.overload(np.abs(wrench))
            fault = text if level == ERROR else ""
        return WrenchReading(wrench, value, tare, tared, status, count, fault)

    def health(self, now: float) -> tuple[int, str]:
        """State at a time of the steady clock [s]: OK, WARN or ERROR, with fact and hint."""
        level, fault = self.converter.fault_at(now)
        found = [(level, str(fault))]
        _, ratios, rails = self._between(now - RECENT, now)
        newest = ads131m0x.at_rail(self.converter.newest(_BROKEN_WIRE)[:, self._bridges.inputs])
        broken = newest.sum(axis=0) == _BROKEN_WIRE
        if broken.any():
            fact = f"{self._saturated(broken)} for {_BROKEN_WIRE} conversions or more"
            found.append((ERROR, f"{fact}: a broken wire? check the bridge and its wiring"))
        elif rails.any():
            fact = self._saturated(rails)
            found.append((WARN, f"{fact} at times: {_CLIPPED_HINT}"))
        valid = ratios[~rails.any(axis=1)]
        wrenches = self._bridges.wrenches(valid - self._tare.no_load[0])
        found.append(self._bridges.overload(np.abs(wrenches).max(axis=0, initial=0.0)))
        level, text = max(found, key=lambda entry: entry[0])
        return level, text if level else f"spidev{self.settings.device} converts"

    def tare(self, stamp: int, forced: bool = False) -> FloatArray:
        """Tare: take the mean over the last `tare_duration` as zero load.

        Args:
            stamp: The present time since the epoch [ns].
            forced: Whether to remove even a force above the settings' `tare_load`.

        Returns:
            The removed load, what the tared wrench [M; F] in {S} was before, shape (6,) [N m, N].

        Raises:
            DeviceError: The converter fails, conversions are missing, a bridge is at its rail, the
                load moves, or its force is above `tare_load` and not forced.
        """
        settings = self.settings
        now = clocks.monotonic()
        level, fault = self.converter.fault_at(now)
        if fault and level == ERROR:
            raise DeviceError(f"cannot tare: {fault.fact}", fault.hint)
        _, ratios, rails = self._between(now - settings.tare_duration, now)
        expected = settings.tare_duration / self.converter.period
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
        offsets = ratios.mean(axis=0)
        removed = self._bridges.wrenches(offsets - self._tare.no_load[0])
        refuse_tare(self._bridges.wrenches(ratios), removed, settings, forced)
        self._tare.set(offsets, stamp)
        return removed

    def _between(self, start: float, end: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Times [s] of conversions; ratios [mV/V] and whether clipped, shape (n, 6) each."""
        times, codes = self.converter.between(start, end)
        return times, self._bridges.ratios(codes), ads131m0x.at_rail(codes[:, self._bridges.inputs])

    def _reach(self, span: float) -> tuple[float, float]:
        """Spans before and after a time that contribute to its wrench [s]."""
        window, half = self.settings.window, 0.5 * span
        return max((1.0 - _AFTER) * window, half), max(_AFTER * window, half)

    def _saturated(self, rails: BoolArray) -> str:
        """Fact naming the bridges at a rail, from shape (6,) or (n, 6)."""
        which = np.flatnonzero(np.atleast_2d(rails).any(axis=0))
        names = [f"bridge {k + 1} (input {self._bridges.inputs[k]})" for k in which]
        return ", ".join(names) + (" is at its rail" if len(names) == 1 else " are at their rails")
