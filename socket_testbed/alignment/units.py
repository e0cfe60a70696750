"""Units of other laboratories' tables, as their titles write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from socket_testbed.errors import ConfigurationError

_POUND = 4.4482216152605  # [N]
_INCH = 0.0254  # [m]
_KILOGRAM = 9.80665  # [N]; its weight

UNITS: dict[str, dict[str, float]] = {
    "time": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
        **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
        **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microseconds"), 1e-6),
        **dict.fromkeys(("ns", "nsec", "nanoseconds"), 1e-9),
        "min": 60.0,
    },
    "force": {
        **dict.fromkeys(("N", "newton", "newtons"), 1.0),
        "kN": 1e3,
        "mN": 1e-3,
        **dict.fromkeys(("lbf", "lb", "lbs"), _POUND),
        "kgf": _KILOGRAM,
    },
    "moment": {
        **dict.fromkeys(("N m", "newton metres", "newton meters"), 1.0),
        "N mm": 1e-3,
        "N cm": 1e-2,
        "kN m": 1e3,
        "mN m": 1e-3,
        **dict.fromkeys(("lbf in", "in lbf", "lb in", "in lb"), _POUND * _INCH),
        **dict.fromkeys(("lbf ft", "ft lbf", "lb ft", "ft lb"), _POUND * 12.0 * _INCH),
        "kgf m": _KILOGRAM,
        "kgf cm": 1e-2 * _KILOGRAM,
    },
    "capacitance": {"pF": 1.0, "fF": 1e-3, "nF": 1e3},
    "stress": {
        "Pa": 1.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "hPa": 1e2,
        "mbar": 1e2,
        "bar": 1e5,
        "psi": _POUND / _INCH**2,
        **dict.fromkeys(("N/cm2", "N/cm^2", "N/cm²"), 1e4),
        **dict.fromkeys(("N/mm2", "N/mm^2", "N/mm²"), 1e6),
    },
    "length": {
        **dict.fromkeys(("m", "metres", "meters"), 1.0),
        **dict.fromkeys(("mm", "millimetres", "millimeters"), 1e-3),
        **dict.fromkeys(("cm", "centimetres", "centimeters"), 1e-2),
    },
}
"""Units of each quantity with their factors to s, N, N m, pF, Pa and m."""

_SPELLINGS = (" ", "", "*", "·", "⋅", "-", ".", "_")  # of the product in a unit
WRITTEN = frozenset(
    unit.replace(" ", sign) for own in UNITS.values() for unit in own for sign in _SPELLINGS
)
"""Units as titles may write them."""


def factor(quantity: str, written: str) -> float | None:
    """Factor of a unit to the SI, or to pF; None if the quantity has no such unit.

    Case counts only in a prefix M or m, of mega or milli.

    Args:
        quantity: A key of `UNITS`.
        written: The unit, such as `N-mm`.
    """
    own = {_plain(unit): value for unit, value in UNITS[quantity].items()}
    wanted = _plain(written)
    if wanted in own:
        return own[wanted]
    alike = [
        value
        for unit, value in own.items()
        if unit.lower() == wanted.lower() and {unit[:1], wanted[:1]} != {"m", "M"}
    ]
    return alike[0] if alike else None


def _plain(unit: str) -> str:
    return re.sub(r"[\s*·⋅._-]", "", unit)


def common_factor(quantity: str, units: Sequence[str], title: str) -> float:
    """Factor of the unit of a column, from what is stated or its title.

    Args:
        quantity: A key of `UNITS`.
        units: The unit stated by the user, then that of the title; empty where there is none.
        title: The title, for errors.

    Raises:
        ConfigurationError: If there is no unit, or it is not one of the quantity.
    """
    written = next((unit for unit in units if unit), "")
    usual = next(iter(UNITS[quantity]))
    if not written:
        raise ConfigurationError(
            f"column '{title}' has no unit",
            f"write it into the title, such as '{title} [{usual}]', or give --units"
            f" {quantity}='{usual}'",
        )
    found = factor(quantity, written)
    if found is None:
        raise ConfigurationError(
            f"column '{title}' is in '{written}', which is no unit of {quantity}",
            f"name one of {', '.join(UNITS[quantity])} in the title or with --units"
            f" {quantity}=UNIT",
        )
    return found
