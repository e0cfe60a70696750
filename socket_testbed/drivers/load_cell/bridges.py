"""The load cell's bridges: from the converter's codes to a wrench."""

from __future__ import annotations

import math

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.drivers.load_cell.ads131m0x import check_device, conversion_period, volts
from socket_testbed.errors import ConfigurationError
from socket_testbed.settings.acquisition import LoadCellSettings

AXES = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
UNITS = ("N m", "N m", "N m", "N", "N", "N")
_MAKERS_ORDER = (3, 4, 5, 0, 1, 2)  # of Fx Fy Fz Mx My Mz, to have the moments first
_BRIDGES = 6
_WORST_CONDITION = 1e6  # [-]; of the maker's matrix with rows of length one


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
    _check_power_of_two("oversampling", settings.oversampling, 128, 16384)
    _check_power_of_two("gain", settings.gain, 1, 128)
    _check_count("inputs", settings.inputs, "the input of each of the six bridges")
    if len(set(settings.inputs)) < _BRIDGES:
        raise _wrong("inputs names an input twice", "give each bridge an input of its own")
    if max(settings.inputs) >= settings.channels:
        raise _wrong(
            f"inputs names input {max(settings.inputs)} of a converter of {settings.channels}",
            f"give inputs from 0 to {settings.channels - 1}",
        )
    _check_count("amplifier_gain", settings.amplifier_gain, "the gain of each of the six bridges")
    _check_count("sign", settings.sign, "the sign of each of the six bridges")
    if any(abs(sign) != 1.0 for sign in settings.sign):
        raise _wrong("sign holds a value other than 1 and -1", "give 1 or -1 for each bridge")
    _check_count("full_scale", settings.full_scale, "the maker's full scale of each axis")
    _check_matrix(settings.matrix)
    period = conversion_period(settings.clock_in, settings.oversampling)
    if settings.window < period:
        raise _wrong(
            f"window is {settings.window:g} s, shorter than a conversion ({period:g} s)",
            "give a longer window or less oversampling",
        )


def _check_matrix(values: tuple[float, ...]) -> None:
    if len(values) != _BRIDGES * _BRIDGES:
        count = f"has {len(values)} numbers" if values else "is empty"
        raise _wrong(f"matrix {count}", "give the maker's 36 numbers, row by row")
    matrix = np.array(values).reshape(_BRIDGES, _BRIDGES)
    if not np.isfinite(matrix).all():
        raise _wrong("matrix holds a value that is not finite", "give the maker's 36 numbers")
    # Forces and moments differ in size by their units; that is no fault of a matrix.
    lengths = np.linalg.norm(matrix, axis=1, keepdims=True)
    if not lengths.all() or np.linalg.cond(matrix / lengths) > _WORST_CONDITION:
        raise _wrong("matrix cannot be inverted", "check the maker's 36 numbers, row by row")


def _check_count(name: str, values: tuple[float, ...], what: str) -> None:
    if len(values) != _BRIDGES:
        count = f"has {len(values)} numbers" if values else "is empty"
        raise _wrong(f"{name} {count}", f"give {what}, 6 numbers")


def _check_power_of_two(name: str, value: int, low: int, high: int) -> None:
    if value.bit_count() != 1 or not low <= value <= high:
        raise _wrong(f"{name} is {value}", f"give a power of two from {low} to {high}")


def _wrong(fact: str, hint: str) -> ConfigurationError:
    return ConfigurationError(f"load_cell_node: {fact}", hint)
