"""A page: sections of text, tables, figures and a 3D scene, rendered as one self-contained file."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from pandas.api.types import is_numeric_dtype

from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    FONT,
    FigureStyle,
    save_figure,
    svg_of,
)
from socket_testbed.tables import write_table

NOTHING = "\N{EN DASH}"  # in a cell without a value
UNCERTAIN = ", uncertain"  # beside an interval that reaches far


def number(value: float, spec: str = ".3g") -> str:
    """A number for a reader, by a format specification; a dash if it is not finite."""
    return f"{value:{spec}}" if math.isfinite(value) else NOTHING


@dataclass(frozen=True)
class Table:
    """A table of a page.

    The index of its frame heads the rows; columns have one level, or two of which the first names
    groups of columns.
    """

    kind: ClassVar = "table"
    name: str  # its identifier on the page
    caption: str
    frame: pd.DataFrame
    formats: Mapping[str, str] = field(default_factory=dict)  # by title or group of numbers
    is_text: bool = False  # its cells hold running text, which wraps

    @property
    def columns(self) -> list[tuple[str, str, bool]]:
        """Group, title, and whether it holds numbers, of each of the other columns."""
        labels = [label if isinstance(label, tuple) else ("", label) for label in self.frame]
        numeric = map(is_numeric_dtype, self.frame.dtypes)
        return [(*label, is_number) for label, is_number in zip(labels, numeric, strict=True)]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Names of neighbouring columns' groups, each with its width; nothing for no group."""
        names = [group for group, *_ in self.columns]
        return [(name, len([*run])) for name, run in groupby(names)] if any(names) else []

    @property
    def rows(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """The heading and the cells of each row."""
        columns = []
        for (group, title, is_number), (_, cells) in zip(
            self.columns, self.frame.items(), strict=True
        ):
            spec = self.formats.get(title) or self.formats.get(group, "z.3f")
            columns.append([number(cell, spec) for cell in cells] if is_number else cells)
        return zip(self.frame.index, zip(*columns, strict=True), strict=True)


def pairs_table(name: str, caption: str, pairs: Sequence[tuple[str, str]]) -> Table:
    """A table of names and what they stand for, in words."""
    frame = pd.DataFrame([*pairs], columns=["name", "value"]).set_index("name")
    return Table(name, caption, frame, is_text=True)


@dataclass(frozen=True)
class ReportFigure:
    """A figure on a page, and beside it as files with its data."""

    kind: ClassVar = "figure"
    name: str  # of its files; empty for a figure that has none
    caption: str
    draw: Callable[[FigureStyle], Figure]
    description: str  # for who cannot see it
    data: pd.DataFrame = field(default_factory=pd.DataFrame)
    is_map: bool = False  # its colours stand for values: on a dark page they stay as they are

    def __post_init__(self) -> None:
        object.__setattr__(self, "draw", cache(self.draw))  # for the page and for its files

    @property
    def files(self) -> list[str]:
        """Names of its files."""
        return [f"{self.name}.{suffix}" for suffix in ("pdf", "png", "csv") if self.name]

    @property
    def svg(self) -> str:
        """The picture on the page."""
        return svg_of(self.draw(DEFAULT_STYLE))

    def write(self, folder: Path, style: FigureStyle) -> None:
        """Write its files to a folder."""
        pdf, png, csv = (folder / name for name in self.files)
        write_table(self.data, csv)
        for path in (pdf, png):
            save_figure(self.draw(style), path)


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    kind: ClassVar = "heading"
    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of statements; `notes` stand out."""

    kind: ClassVar = "bullets"
    lines: Sequence[str]
    style: str = ""


@dataclass(frozen=True)
class Folded:
    """Tables that are shown on demand, under a title."""

    kind: ClassVar = "folded"
    title: str
    tables: Sequence[Table]


@dataclass(frozen=True)
class Section:
    """A section of a page: paragraphs as text, headings, lists, tables, figures, a `Scene`."""

    name: str  # its identifier
    title: str
    parts: Sequence[Any]
    files: Mapping[str, pd.DataFrame] = field(default_factory=dict)  # further CSV files by name

    @property
    def figures(self) -> list[ReportFigure]:
        """Its figures."""
        return [part for part in self.parts if isinstance(part, ReportFigure)]


_NOT_DRAWN = re.compile(
    r'<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>|(?<=<g) id="[^"]*"', re.DOTALL
)
_COORDINATES = re.compile(r' d="[^"]*"|translate\([^)]*\)| [xy]="[^"]*"')
_RESERVED = str.maketrans({"%": "%25", "#": "%23", "&": "%26", '"': "'"})


def svg_url(svg: str) -> Markup:
    """A picture as the address of an image: to a hundredth of a point, no names, no comments."""
    drawn = _NOT_DRAWN.sub("", svg)
    drawn = _COORDINATES.sub(lambda part: re.sub(r"(\.\d\d)\d+", r"\1", part[0]), drawn)
    drawn = re.sub(r">\s+<", "><", drawn.replace("xlink:href", "href"))
    return Markup("data:image/svg+xml," + " ".join(drawn.split()).translate(_RESERVED))


def render(title: str, subtitle: str, sections: Sequence[Section], **content: Any) -> str:
    """A page as one self-contained file; every text in it is escaped."""
    return _template().render(title=title, subtitle=subtitle, sections=sections, **content)


@cache
def _template() -> Any:
    environment = Environment(
        loader=PackageLoader("socket_testbed", "report/templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["svg_url"] = svg_url
    environment.globals |= {"font": FONT, "uncertain": UNCERTAIN}
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment.get_template("page.html")
