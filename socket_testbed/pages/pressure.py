"""How pressure outputs look: decimals, values with their intervals, grey where uncertain."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.pressure import (
    DECIMALS,
    SHARE,
    TITLES,
    Quantity,
    RegionOutputs,
    read_column,
)
from socket_testbed.identification.suspension import Suspension
from socket_testbed.tables import NOTHING, UNCERTAIN

if TYPE_CHECKING:
    import pandas as pd

INLINE = "{} ({})"  # a value and its interval
# Uncertain pressures turn grey in pictures: full colour up to a ratio of interval reach to value,
# the greyest from another on. Lower values are treated as `_MIN_GREYED`.
_FULL_COLOUR, _GREYEST = 1.0, 2.5  # [-]
_MIN_GREYED = 5e3  # [Pa]


def greyness(value: FloatArray, reach: FloatArray) -> FloatArray:
    """Greyness of pressures by the reach of 95 % intervals [Pa]: 0 full colour, 1 greyest."""
    share = reach / np.maximum(np.abs(value), _MIN_GREYED)
    return np.asarray(np.clip((share - _FULL_COLOUR) / (_GREYEST - _FULL_COLOUR), 0.0, 1.0))


def decimals_of(title: str) -> int:
    """Displayed decimals of an output by its title, such as `stiffness Fz [N/mm]`."""
    return DECIMALS.get(title, 1 if title.endswith("[N]") else 2)


def cells(
    names: Iterable[str], found: RegionOutputs, form: str = INLINE, share: float = SHARE
) -> pd.DataFrame:
    """Formatted outputs, a row per place: values and intervals in a form.

    An interval that reaches farther than a share of its value is marked uncertain.
    """
    import pandas as pd

    columns = {title: _formatted(title, read_column(found, title), form, share) for title in TITLES}
    return pd.DataFrame(columns, index=[*names])


def limb_cells(found: Suspension, share: float = SHARE) -> dict[str, str]:
    """Formatted outputs of the limb in the socket, by title."""
    outputs = found.outputs().items()
    return {title: _formatted(title, value, INLINE, share)[0] for title, value in outputs}


def _formatted(title: str, quantity: Quantity, form: str, share: float) -> list[str]:
    """Values with their intervals; a dash for unknown ones."""
    columns = (quantity.value, quantity.low, quantity.high, quantity.certain(share))
    number = f"{{:z.{decimals_of(title)}f}}"
    return [
        form.format(
            number.format(value),
            f"{number} to {number}".format(low, high) + UNCERTAIN * (not certain),
        )
        if np.isfinite([low, high]).all()
        else NOTHING
        for value, low, high, certain in zip(*map(np.atleast_1d, columns), strict=True)
    ]
