"""The colour scale of pressures, the same in pictures for print and on pages."""

from __future__ import annotations

from typing import Any

POWER = 0.5  # [-]; exponent of the colours of pressures, finer at low ones
# [kPa]; of the colour scales of pressures; pages/static/socket.js has the same
FIXED_ENDS = (50.0, 100.0, 200.0, 400.0)
GREY: dict[str, Any] = {"colour": [150, 150, 150], "greyest": 0.85}  # of uncertain pressures


def fixed_end(highest: float) -> float:
    """End of the fixed colour scale of pressures [kPa]: the first of `FIXED_ENDS` that suffices.

    Equal pressures have equal colours in all pictures, unless one is above 50 kPa.

    Args:
        highest: The highest pressure of a picture [kPa].
    """
    return next((end for end in FIXED_ENDS if end >= highest), highest)
