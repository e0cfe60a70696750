"""Pressure outputs as text: their decimals, and values with their 95 % intervals."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

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
