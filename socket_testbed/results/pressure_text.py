"""Pressure outputs as text: values with their 95 % intervals."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from socket_testbed.identification import pressure
from socket_testbed.identification.suspension import Suspension
from socket_testbed.tables import NOTHING, UNCERTAIN

INLINE = "{} ({})"  # a value and its interval


def cells(
    names: Iterable[str],
    found: pressure.RegionOutputs,
    form: str = INLINE,
    share: float = pressure.SHARE,
) -> pd.DataFrame:
    """Formatted outputs: values with their 95 % intervals as text.

    Args:
        names: Names of the R places, which give the rows.
        found: Their outputs over a span, shape (R,), in SI units.
        form: Text with two fields, for the value and for its interval.
        share: An interval that reaches farther from its value than this share of it is marked
            uncertain [-]; of a coordinate it is a share of the region's extent, of a direction one
            of a right angle.

    Returns:
        A row per place, a column per title of `pressure.TITLES`, in the unit of the title.
    """
    columns = {
        title: _formatted(title, pressure.read_column(found, title), form, share)
        for title in pressure.TITLES
    }
    return pd.DataFrame(columns, index=[*names])


def limb_cells(found: Suspension, share: float = pressure.SHARE) -> dict[str, str]:
    """Formatted outputs of the limb in the socket, by title with unit.

    Args:
        found: Motion and stiffness of the limb in the socket.
        share: An interval that reaches farther from its value than this share of it is marked
            uncertain [-].
    """
    outputs = found.outputs().items()
    unknown = f"{NOTHING} (the load does not change in every direction)"
    return {
        title: unknown if np.isnan(value.value) else _formatted(title, value, INLINE, share)[0]
        for title, value in outputs
    }


def _formatted(title: str, quantity: pressure.Quantity, form: str, share: float) -> list[str]:
    """Values with their intervals; a dash for unknown ones."""
    columns = (quantity.value, quantity.low, quantity.high, quantity.certain(share))
    number = f"{{:z.{pressure.decimals_of(title)}f}}"
    return [
        form.format(
            number.format(value),
            f"{number} to {number}".format(low, high) + UNCERTAIN * (not certain),
        )
        if np.isfinite([low, high]).all()
        else NOTHING
        for value, low, high, certain in zip(*map(np.atleast_1d, columns), strict=True)
    ]
