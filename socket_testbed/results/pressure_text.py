"""Pressure in words and tables: values with their 95 % intervals, for terminal, report and pages.

The numbers come from `identification.pressure` and from `TrialPressure`; `figures.pressure` draws
them. Pages import this module, so that it imports pandas only where tables are made.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.documents import finite_or_null
from socket_testbed.identification import pressure
from socket_testbed.identification.pressure import TITLES
from socket_testbed.identification.suspension import Suspension
from socket_testbed.tables import NOTHING, UNCERTAIN, Table, split_unit

if TYPE_CHECKING:
    import pandas as pd

    from socket_testbed.results.pressure import TrialPressure

INLINE = "{} ({})"  # a value and its interval
_COLUMNS = 3  # outputs per table in the terminal
_SENTENCE = ["peak pressure [kPa]", "mean pressure [kPa]", "contact area [cm^2]"]


def number(title: str, value: float, sign: str = "-", least: int = 0) -> str:
    """An output with its displayed decimals.

    Args:
        title: Its title, such as `peak pressure [kPa]`.
        value: The output, in the unit of the title.
        sign: `+` to show the sign of a positive value, `-` not to.
        least: Decimals to show at least.
    """
    return f"{value:{sign}z.{max(least, pressure.decimals_of(title))}f}"


def interval(title: str, low: float, high: float) -> str:
    """The 95 % interval of an output, such as `31.2 to 40.8`.

    Args:
        title: Its title, such as `peak pressure [kPa]`.
        low: Lower end, in the unit of the title.
        high: Upper end, in the unit of the title.
    """
    return f"{number(title, low)} to {number(title, high)}"


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
    import pandas as pd

    columns = {
        title: _formatted(title, pressure.read_column(found, title), form, share)
        for title in TITLES
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
    return [
        form.format(number(title, value), interval(title, low, high) + UNCERTAIN * (not certain))
        if np.isfinite([low, high]).all()
        else NOTHING
        for value, low, high, certain in zip(*map(np.atleast_1d, columns), strict=True)
    ]


def printed_tables(found: TrialPressure) -> list[Table]:
    """Tables for the terminal: outputs of regions, of tiles under a cluster, and of the limb.

    Args:
        found: The outputs over a segment; its `share` says which are marked uncertain.
    """
    import pandas as pd

    geometry, outputs = found.trial.geometry, found.outputs
    names = [place.name for place in found.places]
    regions = cells(names, outputs.regions, share=found.share).rename_axis("region")
    tiles = cells(geometry.names, outputs.tiles, share=found.share)
    clusters = tiles.iloc[[*geometry.clusters.values()]]
    clusters.index = [
        ", ".join(dict.fromkeys(names))
        for names in zip(clusters.index, geometry.clusters, strict=True)
    ]
    clusters = clusters[[*pressure.TILE_TITLES]].rename_axis("tile under a cluster")
    frames = [
        frame.iloc[:, start : start + _COLUMNS]
        for frame in (regions, clusters)
        for start in range(0, frame.shape[1], _COLUMNS)
    ]
    if found.suspension is not None:
        limb = pd.DataFrame({"value": limb_cells(found.suspension, found.share)})
        frames.append(limb.rename_axis("limb in the socket"))
    return [Table("outputs", "", frame) for frame in frames]


def legend(found: TrialPressure) -> str:
    """What the `printed_tables` show, in two lines."""
    return (
        "best estimate under the posterior (95 % interval); uncertain: the interval reaches"
        f" farther from the value than {found.share:g} of it\n{found.contact}"
    )


def summary_row(found: TrialPressure) -> dict[str, float | None]:
    """Outputs of the whole socket with the ends of their 95 % intervals, for a row per trial.

    Values by column name with the unit, such as `peak pressure low [kPa]`; None where unknown.
    """
    socket = found.regions.iloc[-1]
    ends = (pressure.interval_end(title, end) for title in TITLES for end in ("low", "high"))
    return {name: finite_or_null(socket[name]) for name in (*TITLES, *ends)}


def page_tables(found: TrialPressure) -> list[Table]:
    """Tables for a page: outputs of the regions, the last one the socket, and of the limb.

    Args:
        found: The outputs over a segment.
    """
    import pandas as pd

    shown = cells([place.name for place in found.places], found.outputs.regions, "{}\n{}")
    shown = shown.rename(columns=_raised).rename_axis("region")
    below = "by region, the 95 % interval below each value"
    shear = TITLES.index("shear [kPa]")
    first, second = shown.iloc[:, :shear], shown.iloc[:, shear:]
    tables = [
        Table("pressure-regions", f"Pressure and load {below}", first),
        Table("pressure-shear", f"Shear and centre of pressure {below}", second),
    ]
    if found.suspension is not None:
        column = pd.DataFrame({"over the segment": limb_cells(found.suspension)})
        tables.append(Table("limb", "Limb in the socket, about the centre of the tiles", column))
    return tables


def describe_pressure(found: TrialPressure) -> str:
    """The pressure on the socket in a sentence."""
    socket = cells([place.name for place in found.places], found.outputs.regions).iloc[-1]
    parts = []
    for title, value in socket[_SENTENCE].items():
        name, unit = split_unit(_raised(title))
        parts.append(f"{name} {value} {unit}")
    peak = found.outputs.peak_map.normal_pressure[0].argmax()
    return (
        f"Pressure over the segment, with 95 % intervals: {'; '.join(parts)}. The peak is on"
        f" {found.trial.geometry.names[peak]} at {found.peak_time:.2f} s."
    )


def _raised(title: str) -> str:
    """A title with its square as a raised digit."""
    return title.replace("^2", "\N{SUPERSCRIPT TWO}")
