"""What the templates of the pages need: tables as cells, numbers as text, and the renderer."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from pandas.api.types import is_numeric_dtype

from socket_testbed.report.figures.style import FONT

NOTHING = "\N{EN DASH}"  # in a cell without a value
MASKED = "not determined"  # in a cell whose value is


def number(value: float, spec: str = ".3g") -> str:
    """A number for a reader, by a format specification; a dash if it is not finite."""
    return f"{value:{spec}}" if math.isfinite(value) else NOTHING


def counted(count: int, noun: str) -> str:
    """A number of things, in words."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


@dataclass(frozen=True)
class Column:
    """The header of a column.

    Attributes:
        group: Name of the columns that it belongs to; empty for none.
        title: Its name.
        is_number: Whether it holds numbers.
    """

    group: str
    title: str
    is_number: bool


@dataclass(frozen=True)
class Table:
    """A table of a page.

    Attributes:
        name: Its identifier on the page.
        caption: What it holds.
        frame: Its values. The index heads the rows; columns have one level, or two of which the
            first names groups of columns.
        formats: Format specifications of the columns with numbers, by title or group; three
            decimals unless given.
        is_text: Whether its cells hold running text, which wraps.
    """

    name: str
    caption: str
    frame: pd.DataFrame
    formats: Mapping[str, str] = field(default_factory=dict)
    is_text: bool = False

    @property
    def heading(self) -> str:
        """Title of the column that heads the rows."""
        return str(self.frame.index.name or "")

    @property
    def columns(self) -> list[Column]:
        """The headers of the other columns."""
        labels = [label if isinstance(label, tuple) else ("", label) for label in self.frame]
        return [
            Column(group, title, is_numeric_dtype(dtype))
            for (group, title), dtype in zip(labels, self.frame.dtypes, strict=True)
        ]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Names of neighbouring columns' groups, each with its width; nothing for no group."""
        names = [column.group for column in self.columns]
        return [(name, len([*run])) for name, run in groupby(names)] if any(names) else []

    @property
    def rows(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """The heading and the cells of each row."""
        columns = [
            [number(value, self._format(column)) for value in values]
            if column.is_number
            else values
            for column, (_, values) in zip(self.columns, self.frame.items(), strict=True)
        ]
        return zip(self.frame.index, zip(*columns, strict=True), strict=True)

    def _format(self, column: Column) -> str:
        return self.formats.get(column.title) or self.formats.get(column.group, "z.3f")


def pairs_table(name: str, caption: str, pairs: Sequence[tuple[str, str]]) -> Table:
    """A table of names and what they stand for, in words."""
    frame = pd.DataFrame([*pairs], columns=["name", "value"]).set_index("name")
    return Table(name, caption, frame, is_text=True)


_NOT_DRAWN = re.compile(
    r'<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>|(?<=<g) id="[^"]*"', re.DOTALL
)
_POLYLINE = re.compile(r"M[-\d.\s]+(?:L[-\d.\s]+)+")
_PLACE = re.compile(r'translate\([^)]*\)| [xy]="[^"]*"')
_RESERVED = str.maketrans({"%": "%25", "#": "%23", "&": "%26", '"': "'"})


def svg_url(svg: str) -> Markup:
    """A picture as the address of an image: lines to a tenth of a point, no names, no comments.

    Args:
        svg: What matplotlib writes, whose attributes hold no apostrophe.
    """
    drawn = _POLYLINE.sub(_shortened, _NOT_DRAWN.sub("", svg))
    drawn = _PLACE.sub(lambda place: re.sub(r"(\.\d)\d+", r"\1", place[0]), drawn)
    drawn = re.sub(r">\s+<", "><", drawn.replace("xlink:href", "href"))
    return Markup("data:image/svg+xml," + " ".join(drawn.split()).translate(_RESERVED))


def _shortened(polyline: re.Match[str]) -> str:
    """A line from point to point as steps; rounded points, so that no error adds up."""
    points = np.array(polyline[0].replace("M", " ").replace("L", " ").split(), dtype=float)
    tenths = np.round(10.0 * points.reshape(-1, 2)).astype(np.int64)
    start, *steps = np.diff(tenths, axis=0, prepend=0) / 10.0
    return f"M{start[0]:g} {start[1]:g}l" + " ".join(f"{x:g} {y:g}" for x, y in steps)


def render(template: str, **content: Any) -> str:
    """A page from its template; every text in it is escaped.

    Args:
        template: File in `report/templates`.
        content: What the template names; `markupsafe.Markup` stands as it is.
    """
    return _environment().get_template(template).render(**content)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("socket_testbed", "report/templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: dict[str, Callable[[Any], str]] = {
        "svg_url": svg_url,
        "g": lambda value: f"{value:g}",
    }
    environment.filters |= filters
    environment.globals |= {"font": FONT, "masked": MASKED}
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment
