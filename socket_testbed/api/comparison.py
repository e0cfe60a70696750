r"""Trials side by side: values of every trial, and differences to the first.

The interval of a difference :math:`x_1 - x_0` comes from the intervals :math:`[l, u]` of both
values, with a + b - 2 r sqrt(a b) of the squares a and b of their reaches:

.. math:: \left[ d - \sqrt{a_l + b_u - 2 r \sqrt{a_l b_u}},\;
          d + \sqrt{a_u + b_l - 2 r \sqrt{a_u b_l}} \right], \quad
          a_l = (x_1 - l_1)^2, \; b_u = (u_0 - x_0)^2, \ldots

The errors have the correlation r: `SAME_LIMB` in trials of one subject in one socket, else 0.

A skew interval stays skew (Zou & Donner, Construction of confidence limits about effect measures,
Statistics in Medicine 27, 2008).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.api.pressure import OF_TILES, TrialPressure, pressure
from socket_testbed.api.result import Result, records
from socket_testbed.api.trials import PathLike, Progress, open_trial, started
from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import atomic_output
from socket_testbed.geometry.regions import Region, Side
from socket_testbed.geometry.socket import SOCKET, SocketGeometry
from socket_testbed.identification.pressure import (
    NORMAL_QUANTILE,
    SHARE,
    THRESHOLD,
    TITLES,
    read_column,
)
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit
from socket_testbed.tables import split_unit
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from socket_testbed.report.figures.style import FigureStyle

PAGES = (".html", ".htm")
_MOST = 12  # trials side by side
_OTHER_LOAD = 0.1  # [-]; of the mean force, from which on a note says so
_OTHER_TIME = 0.05  # [-]; likewise for the time that an integral covers
_VALUE = ("value", "low", "high")
_DIFFERENCE = ("difference", "difference low", "difference high")
_VALUES = (*_VALUE, *_DIFFERENCE)
COLUMNS = ("part", "name", "quantity", "unit", "item", *_VALUES, "text")
LEGEND = "value (95 % interval); *: the interval of the difference excludes 0."
_MEAN = "mean pressure [kPa]"
_HEADINGS = {
    "metadata": "Metadata of the trials",
    "trials": "Segments, sources and calibrations",
    "regions": "By region",
    "tiles": "Tile by tile",
    "limb": "Limb in the socket",
    "wrench": "Wrench",
}
# Correlation of the map's errors in two trials of one limb in one socket: docs/compare.md [-].
SAME_LIMB = 0.7
_INDEPENDENT = (
    "The interval of a difference takes the errors of two limbs as independent, so that their"
    f" variances add; those of one subject in one socket as correlated by {SAME_LIMB:g}, so that"
    " they cancel in part (Zou & Donner 2008). It covers what the sensors leave open under the"
    " prior of the force map. docs/compare.md states how often it held the true difference."
)
_MAPS = (
    "Mean pressure on the unrolled wall and the distal end, on one scale; the greyer, the less"
    " certain. Differences have a scale of their own with zero in its middle; they are grey where"
    " their 95 % interval holds zero. Outlined: clusters."
)
_NUMBERS = ("regions", "tiles")  # parts of the table
_DIGITS = {"1": 0, "-": 2, "N m": 2}  # behind the point; 1 unless given


def difference_intervals(
    values: FloatArray, low: FloatArray, high: FloatArray, correlation: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences to the first of k trials and the ends of their intervals, shape (k, m) each.

    The errors of each trial have a correlation with those of the first, shape (k, 1) [-].
    """
    below, above = np.maximum(values - low, 0.0), np.maximum(high - values, 0.0)
    difference = values - values[0]

    def reach(own: FloatArray, other: FloatArray) -> FloatArray:
        return np.sqrt(own**2 + other**2 - 2.0 * correlation * own * other)

    ends = difference - reach(below, above[0]), difference + reach(above, below[0])
    for row in (difference, *ends):
        row[0] = np.nan
    return difference, *ends


def values_table(
    part: str,
    names: Sequence[str],
    title: str,
    items: Sequence[str],
    values: FloatArray,
    low: FloatArray | None = None,
    high: FloatArray | None = None,
    correlation: FloatArray | float = 0.0,
) -> pd.DataFrame:
    """A quantity of m things in k trials, shape (k, m), in the columns of `COLUMNS`.

    `title` holds its unit; degrees repeat after 360. `correlation` as in `difference_intervals`.
    """
    import pandas as pd

    low, high = (np.full(values.shape, np.nan) if end is None else end for end in (low, high))
    difference, lower, upper = difference_intervals(values, low, high, correlation)
    name, unit = split_unit(title)
    turns = 360.0 * np.round(difference / 360.0) if unit == "deg" else 0.0
    columns = (values, low, high, difference - turns, lower - turns, upper - turns)
    table = {
        "part": part,
        "name": np.repeat(np.array(names, dtype=object), len(values)),
        "quantity": name,
        "unit": unit,
        "item": np.tile(np.array(items, dtype=object), len(names)),
        **{column: of.T.ravel() for column, of in zip(_VALUES, columns, strict=True)},
    }
    return pd.DataFrame(table).assign(text=None)[[*COLUMNS]]


def _texts_table(
    part: str, texts: Mapping[str, Sequence[str]], items: Sequence[str]
) -> pd.DataFrame:
    import pandas as pd

    rows = [
        (part, name, "", "", item, *[np.nan] * len(_VALUES), text)
        for name, of_items in texts.items()
        for item, text in zip(items, of_items, strict=True)
    ]
    return pd.DataFrame(rows, columns=[*COLUMNS])


@dataclass(frozen=True, repr=False)
class Comparison(Result):
    """Trials side by side."""

    items: tuple[str, ...]  # names of the trials
    title: str  # what they are compared over
    notes: tuple[str, ...]  # what a reader must know
    table: pd.DataFrame  # see `to_dataframe`
    geometry: SocketGeometry | None  # None: sockets differ, or regions alone are compared
    pressures: FloatArray  # (k, n) [kPa], means of the tiles
    deviations: FloatArray  # (k, n) [kPa], their standard deviations
    side: Side | None = None  # the leg that wears the socket, if that is stated

    def __repr__(self) -> str:
        names = self.table.groupby("part")["name"].nunique()
        counts = ", ".join(f"{names[p]} {p}" for p in ("regions", "tiles") if p in names)
        return f"Comparison(trials {', '.join(self.items)}; {counts})"

    def to_dataframe(self) -> pd.DataFrame:
        """Every value in long form.

        Columns: `part` (such as `regions`), `name` (such as `anterior proximal`), `quantity` and
        `unit`, `item` (the trial), `value` with the ends `low` and `high` of its 95 % interval,
        `difference` to the first trial with `difference low` and `difference high`, and `text` of
        what is no number.
        """
        return self.table.copy()

    def cells(self, part: str, quantity: str = "") -> pd.DataFrame:
        """A part as a reader sees it: values with intervals, a column per trial and difference.

        Args:
            part: The part, such as `regions`.
            quantity: One quantity, indexed by the names; empty for all, indexed by both.
        """
        import pandas as pd

        rows = self.table[self.table["part"] == part]
        if quantity:
            rows = rows[rows["quantity"] == quantity]
        found: dict[tuple[str, str], dict[str, str]] = {}
        for row in rows.to_dict("records"):
            what = f"{row['quantity']} [{row['unit']}]" if row["unit"] else row["quantity"]
            cells = found.setdefault((row["name"], what), {})
            cells[row["item"]] = row["text"] or _cell(row, _VALUE)
            if row["item"] != self.items[0] and not row["text"]:
                cells[self._difference(row["item"])] = _cell(row, _DIFFERENCE)
        table = pd.DataFrame.from_dict(found, orient="index").fillna("")
        table.index = pd.MultiIndex.from_tuples(found, names=["name", "quantity"])
        columns = [*self.items, *map(self._difference, self.items[1:])]
        table = table.reindex(columns=[name for name in columns if name in table])
        return table.droplevel("quantity") if quantity else table

    def differing(self, most: int = 10) -> list[str]:
        """Differences of regions whose interval excludes zero, the clearest first, in words.

        The first line counts them all: of intervals of 95 %, one in 20 excludes zero by chance.
        """
        rows = self.table[self.table["part"] == "regions"]
        low, high = rows["difference low"], rows["difference high"]
        rows = rows.assign(clear=(low + high).abs() / (high - low))[high > low]
        clear = rows[rows["clear"] > 1.0].sort_values("clear", ascending=False, kind="stable")
        lines = [
            f"{len(clear)} of {len(rows)} intervals of the regions' differences exclude 0; by"
            f" chance alone up to about {0.05 * len(rows):.0f} would"
        ]
        for row in clear.head(most).to_dict("records"):
            digits = _DIGITS.get(row["unit"], 1)
            by, *ends = (abs(row[name]) for name in _DIFFERENCE)
            low, high = sorted(ends)
            way = "lower" if row["difference"] < 0.0 else "higher"
            lines.append(
                f"{row['name']}: {row['quantity']} {by:.{digits}f} {row['unit']} {way} in"
                f" {row['item']} than in {self.items[0]} ({low:.{digits}f} to {high:.{digits}f})"
            )
        return lines

    def _difference(self, item: str) -> str:
        """Name of the column of a trial's difference."""
        return f"{item} - {self.items[0]}"

    def document(self) -> dict[str, Any]:
        """The comparison for JSON: the rows of `to_dataframe`, null where there is no value."""
        return {
            "kind": "trials",
            "items": list(self.items),
            "title": self.title,
            "notes": list(self.notes),
            "rows": records(self.table),
        }

    def _figure(self, style: FigureStyle) -> Figure:
        """Maps of the mean pressure on one colour scale."""
        if self.geometry is None:
            return super()._figure(style)
        from socket_testbed.report.figures.tiles import tile_map_figure

        return tile_map_figure(
            self.geometry,
            dict(zip(self.items, self.pressures, strict=True)),
            _MEAN,
            style=style,
            limits=(self.pressures.min(), self.pressures.max()),
            side=self.side or "",
            reach=dict(zip(self.items, NORMAL_QUANTILE * self.deviations, strict=True)),
        )


def _cell(row: Mapping[str, Any], columns: Sequence[str]) -> str:
    """A value or difference with its interval."""
    digits, sign = _DIGITS.get(row["unit"], 1), "+" if columns == _DIFFERENCE else ""
    value, low, high = (row[name] for name in columns)
    shown = f"{value:{sign}z.{digits}f}" if np.isfinite(value) else ""
    if not np.isfinite([low, high]).all():
        return shown
    differs = " *" if sign and (low > 0.0 or high < 0.0) else ""
    return f"{shown} ({low:z.{digits}f} to {high:z.{digits}f}){differs}"


def compare(
    *items: Trial | PathLike,
    segment: str = "plateau",
    threshold: float = 1e-3 * THRESHOLD,
    share: float = SHARE,
    by_region: bool = False,
    params: PathLike | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare trials: every value side by side, and differences to the first.

    The outputs of `st.pressure` by region and tile, with their differences and 95 % intervals, the
    mean wrench, and the metadata. All must be of one socket, unless `by_region`.

    The interval of a difference takes the errors of two limbs as independent, and those of one
    subject in one socket as correlated, see `socket_testbed.api.comparison`; docs/compare.md states
    how often it held the true difference.

    Args:
        items: Two to twelve trials, or their folders.
        segment: As `specification` in `st.select_segment`, of every trial.
        threshold: As in `st.pressure`.
        share: As in `st.pressure`.
        by_region: Whether trials, even of different sockets, are compared by region alone.
        params: A `testbed.yaml` to use instead of each trial's own.
        progress: See `Progress`.

    Raises:
        ConfigurationError: If there are fewer than two trials or too many, one is given twice or is
            a file, or they are of different sockets.
        TrialError: If a trial cannot be read or holds no such segment.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> found
    Comparison(trials hold, walk; 20 regions, 79 tiles)
    >>> found.cells("regions", "peak pressure").loc["socket", "walk - hold"]
    '... (... to ...)...'
    >>> found.save("comparison.csv")
    >>> st.write_comparison(found, "comparison.html")
    """
    trials = _open(items)
    names = _names([trial.path for trial in trials])
    first = trials[0].geometry
    other = next((trial for trial in trials if not trial.geometry.same_tiles(first)), None)
    if other is not None and not by_region:
        raise ConfigurationError(
            f"{other.path} is of another socket ({len(other.geometry)} tiles) than"
            f" {trials[0].path} ({len(first)} tiles)",
            "compare them by region with --by-region",
        )
    report = started(progress, "comparing") or (lambda done, total: None)
    found = []
    for done, (name, trial) in enumerate(zip(names, trials, strict=True), start=1):
        try:
            found.append(pressure(trial, segment, threshold=threshold, share=share, params=params))
        except TrialError as error:  # it does not always say of which trial
            raise TrialError(f"{name}: {error.fact}", error.hint) from None
        report(done, len(trials))
    sides = {trial.metadata.side for trial in trials}
    shared, rows = _shared_regions(found, other is None)
    tiles = [
        read_column(each.outputs.tiles, "mean pressure [kPa]") for each in found if not by_region
    ]
    return Comparison(
        items=names,
        title=f"segment {segment}, in contact above {threshold:g} kPa",
        notes=tuple(_notes(found, names, shared, other is None, params is None)),
        table=_table(found, names, shared, rows, by_region),
        geometry=None if by_region else first,
        pressures=np.array([of.value for of in tiles]),
        deviations=np.array([(of.high - of.low) / (2.0 * NORMAL_QUANTILE) for of in tiles]),
        side=sides.pop() if len(sides) == 1 else None,
    )


def write_comparison(
    found: Comparison, page: PathLike, command: str = "socket_testbed.write_comparison"
) -> None:
    """Write a comparison as one page that opens offline; an older one is replaced.

    Args:
        found: What `st.compare` found.
        page: The page, ending in `.html`.
        command: What made the page, for the record.

    Raises:
        ConfigurationError: If the page ends otherwise or cannot be written.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> st.write_comparison(found, "liners.html")
    """
    # matplotlib takes its time to import.
    from socket_testbed.report.page import Bullets, Cards, Maps, Section, Table, pairs_table, render

    path = Path(page)
    if path.suffix.lower() not in PAGES:
        raise ConfigurationError(f"{path}: a comparison is a page", "let it end in .html")
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    origin = [("page made", made), ("command", command)]
    count, *clearest = found.differing()
    data, titles = _map_data(found)
    cells = found.cells("regions").loc["socket"].rename_axis("output")
    parts = {name: _tables(found, name) for name in dict.fromkeys(found.table["part"])}
    numbers = [
        Section(name, _HEADINGS[name], parts.pop(name)) for name in _NUMBERS if name in parts
    ]
    socket = Table("socket-table", "Outputs of the socket", cells)
    made_with = pairs_table("provenance-table", "What the page was made with", origin)
    groups = {
        "": [
            Section("differing", "", [Cards(), Bullets([*clearest, f"{count}."])]),
            *([Section("maps", "Maps", [Maps(titles, _MAPS)])] if titles else []),
            Section("socket", "Whole socket", [socket]),
        ],
        "Numbers": [Section("intervals", "Intervals", [_INDEPENDENT, LEGEND]), *numbers],
        "Data": [
            Section("notes", "Notes", [Bullets(found.notes, "notes")]),
            *(Section(name, _HEADINGS[name], tables) for name, tables in parts.items()),
            Section("provenance", "Provenance", [made_with]),
        ],
    }
    title = f"Comparison of trials: {', '.join(found.items)}"
    text = render(title, found.title, groups, data | {"cards": _cards(found)})
    with atomic_output(path) as staging:
        staging.write_text(text, encoding="utf-8")


def _cards(found: Comparison) -> list[dict[str, Any]]:
    """The difference of the socket's peak and mean pressure of every trial to the first one."""
    of, shown = found.table, []
    rows = of[(of["part"] == "regions") & (of["name"] == SOCKET) & (of["item"] != found.items[0])]
    for quantity in ("peak pressure", "mean pressure"):
        for row in rows[rows["quantity"] == quantity].to_dict("records"):
            by, low, high = (row[name] for name in _DIFFERENCE)
            clear = low > 0.0 or high < 0.0
            shown.append(
                {
                    "title": f"{quantity.capitalize()}, {found._difference(row['item'])}",
                    "value": f"{by:+.1f} kPa",
                    "interval": f"{low:.1f} to {high:.1f}",
                    "words": "a clear difference" if clear else "no clear difference",
                }
            )
    return shown


def _map_data(found: Comparison) -> tuple[dict[str, Any], dict[str, str]]:
    """Maps of the trials on one scale, and of the differences on another, with their titles."""
    if found.geometry is None:
        return {}, {}
    from socket_testbed.pages.document import moment, socket_document

    table = found.table
    rows = table[(table["part"] == "tiles") & (table["quantity"] == "mean pressure")]
    difference, low, high = (
        rows[name].to_numpy().reshape(-1, len(found.items)).T[1:] for name in _DIFFERENCE
    )
    spread = (high - low) / (2.0 * NORMAL_QUANTILE)
    names = [*found.items, *map(found._difference, found.items[1:])]
    values = [*found.pressures, *difference]
    deviations = [*found.deviations, *spread]
    most = float(np.abs(difference).max()) or 1.0
    nothing = np.zeros(0)
    maps: list[dict[str, Any]] = [
        {
            "box": f"map-{number}",
            "moment": moment(0.0, 1e3 * value, 1e3 * deviation, nothing, nothing),
            "range": most if number >= len(found.items) else None,
            "diverging": number >= len(found.items),
        }
        for number, (value, deviation) in enumerate(zip(values, deviations, strict=True))
    ]
    data = {
        "socket": socket_document(found.geometry, found.side),
        "maps": maps,
        "scale": float(found.pressures.max()),
    }
    return data, {entry["box"]: name for entry, name in zip(maps, names, strict=True)}


def _tables(found: Comparison, part: str) -> list[Any]:
    """The tables of a part."""
    from socket_testbed.report.page import Table

    rows = found.table[found.table["part"] == part]
    if part in {"regions", "tiles"}:
        titles = rows[["quantity", "unit"]].drop_duplicates().itertuples(index=False)
        return [
            Table(f"{part}-{number}", f"{name} [{unit}]", found.cells(part, name))
            for number, (name, unit) in enumerate(titles)
        ]
    cells = found.cells(part)
    cells.index = [": ".join(filter(None, names)) for names in cells.index]
    is_text = bool(rows["text"].notna().any())
    return [Table(f"{part}-table", _HEADINGS[part], cells, is_text=is_text)]


def _open(items: Sequence[Trial | PathLike]) -> list[Trial]:
    """The trials, each given once."""
    if not 2 <= len(items) <= _MOST:
        raise ConfigurationError(
            f"{len(items)} trials are given to compare",
            f"give 2 to {_MOST}, or 'pressure FOLDER -o OUTPUT' for a table with a row per trial",
        )
    trials: list[Trial] = []
    for item in items:
        path = item.path if isinstance(item, Trial) else Path(item)
        if path.suffix.lower() in {".json", ".yaml", ".yml"}:
            raise ConfigurationError(
                f"{path}: compare takes trials", "judge a model by 'evaluate TRIAL --model MODEL'"
            )
        if path.resolve() in [trial.path.resolve() for trial in trials]:
            raise ConfigurationError(f"{path} is given twice", "give each trial once")
        trials.append(item if isinstance(item, Trial) else open_trial(item))
    return trials


def _names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names that differ: the last parts of the paths, as many as it takes."""
    parts = [path.resolve().parts for path in paths]
    tails = (tuple("/".join(part[-number:]) for part in parts) for number in count(1))
    return next(names for names in tails if len({*names}) == len(names))


def _table(
    found: Sequence[TrialPressure],
    names: Sequence[str],
    shared: Sequence[str],
    rows: Sequence[Sequence[int]],
    by_region: bool,
) -> pd.DataFrame:
    import pandas as pd

    described = [each.trial.metadata.described() for each in found]
    metadata = {
        name: [texts.get(name, "not stated") for texts in described]
        for name in FIELDS
        if any(name in texts for texts in described)
    }
    origins = {
        "segment": [str(each.segment) for each in found],
        "samples": [str(len(each.time)) for each in found],
        "measured": [each.outputs.source for each in found],
        "socket": [each.trial.geometry.source or "no source" for each in found],
        "calibration": [
            f"{each.trial.calibration.source} ({each.trial.calibration.date})" for each in found
        ],
    }
    tables = [
        _texts_table("metadata", metadata, names),
        _texts_table("trials", origins, names),
        *(_of_output("regions", title, shared, rows, found, names) for title in TITLES),
    ]
    if not by_region:
        tiles = found[0].trial.geometry.names
        every = [[*range(len(tiles))]] * len(found)
        tables += [_of_output("tiles", title, tiles, every, found, names) for title in OF_TILES]
    limbs = [each.limb() for each in found]
    if all(len(limb) for limb in limbs):
        for title in limbs[0].index:
            columns = (
                np.array([[limb.loc[title, end]] for limb in limbs], dtype=float)
                for end in ("value", "low", "high")
            )
            tables.append(values_table("limb", [""], title, names, *columns))
    wrenches = [_wrench(each) for each in found]
    for title, values in (
        ("mean", np.array([wrench.mean() for wrench in wrenches])),
        ("standard deviation", np.array([wrench.std(ddof=0) for wrench in wrenches])),
    ):
        for column, name in enumerate(WRENCH_CHANNELS):
            titled = f"{title} [{channel_unit(name)}]"
            tables.append(values_table("wrench", [name], titled, names, values[:, [column]]))
    return pd.concat([table for table in tables if len(table)], ignore_index=True)


def _shared_regions(
    found: Sequence[TrialPressure], alike: bool
) -> tuple[list[str], list[list[int]]]:
    """Names of the regions that all trials have, and which of each trial's regions they are."""
    sides = {each.trial.metadata.side for each in found}
    neutral = None in sides and len(sides) > 1
    names = [[_without_side(r, each) if neutral else r.name for r in each.places] for each in found]
    shared = [name for name in names[0] if all(name in others for others in names)]
    if alike:  # a region of the same name may have other tiles
        mirrored = ("medial", "lateral") if sides == {"left", "right"} else ()
        tiles = [
            {name: tuple(region.tiles) for name, region in zip(of, each.places, strict=True)}
            for of, each in zip(names, found, strict=True)
        ]
        shared = [n for n in shared if n.startswith(mirrored) or len({t[n] for t in tiles}) == 1]
    return shared, [[of.index(name) for name in shared] for of in names]


def _without_side(region: Region, found: TrialPressure) -> str:
    """Name of a region by left and right, whatever leg it is of."""
    side = found.trial.metadata.side
    if side is None:
        return region.name
    other = {"left": "right", "right": "left"}[side]
    sector, _, height = region.name.partition(" ")
    return " ".join([{"lateral": side, "medial": other}.get(sector, sector), height]).strip()


def _of_output(
    part: str,
    title: str,
    names: Sequence[str],
    rows: Sequence[Sequence[int]],
    found: Sequence[TrialPressure],
    items: Sequence[str],
) -> pd.DataFrame:
    """An output, of `TITLES`, of the things in some rows of each trial's `part`."""
    quantities = [read_column(getattr(each.outputs, part), title) for each in found]
    columns = [
        (q.value[row], q.low[row], q.high[row])
        for q, row in zip(quantities, map(list, rows), strict=True)
    ]
    values, low, high = map(np.array, zip(*columns, strict=True))
    return values_table(part, names, title, items, values, low, high, _correlation(found))


def _correlation(found: Sequence[TrialPressure]) -> FloatArray:
    """Correlation of the force map's errors with those of the first trial, shape (k, 1) [-]."""
    first = found[0].trial
    alike = [
        each.trial.metadata.subject is not None
        and each.trial.metadata.subject == first.metadata.subject
        and each.trial.geometry.same_tiles(first.geometry)
        for each in found
    ]
    return SAME_LIMB * np.array(alike, dtype=float)[:, None]


def _wrench(found: TrialPressure) -> pd.DataFrame:
    """The wrench over the segment, as a table whose statistics skip missing values."""
    import pandas as pd

    wrench = found.trial.samples()[found.segment.rows].wrench
    return pd.DataFrame(wrench, columns=list(WRENCH_CHANNELS))


def _notes(
    found: Sequence[TrialPressure],
    names: Sequence[str],
    shared: Sequence[str],
    alike: bool,
    own_params: bool,
) -> list[str]:
    trials = [each.trial for each in found]
    notes: list[str] = []
    if not alike:
        notes.append(
            "the trials are of different sockets: regions are sectors and thirds of each socket's"
            " own height, and hold other areas"
        )
    sides = [trial.metadata.side for trial in trials]
    if {"left", "right"} <= {*sides}:
        notes.append(
            "left and right legs are compared: medial with medial, lateral with lateral; tiles are"
            " compared where they are in the socket"
        )
    elif None in sides and any(sides):
        unknown = ", ".join(n for n, side in zip(names, sides, strict=True) if side is None)
        notes.append(
            f"no side is stated for {unknown}: the regions are left and right; state it with"
            " 'annotate TRIAL --side left|right'"
        )
    own = {name for trial in trials for name in trial.geometry.regions}
    if lacking := sorted(own.difference(shared)):
        notes.append(
            f"not compared, since not all trials have these regions alike: {', '.join(lacking)}"
        )
    forces = [float(np.linalg.norm(_wrench(each).mean()[3:])) for each in found]
    times = [each.outputs.integrated for each in found]
    for name, force, time in zip(names[1:], forces[1:], times[1:], strict=True):
        if abs(force - forces[0]) > _OTHER_LOAD * forces[0]:
            notes.append(
                f"the mean force is {force:.0f} N in {name} and {forces[0]:.0f} N in {names[0]}:"
                " differences in pressure hold that of the load"
            )
        if abs(time - times[0]) > _OTHER_TIME * times[0]:
            notes.append(
                f"the pressure-time integral covers {time:.1f} s in {name} and {times[0]:.1f} s in"
                f" {names[0]}: it is not of equal times"
            )
    if own_params and len({trial.estimator.force_map for trial in trials}) > 1:
        notes.append(
            "the trials were recorded with different priors of the force map (force_map.*): give"
            " one with --params"
        )
    return notes
