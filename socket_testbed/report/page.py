"""A page: pictures of a socket and sections of text, tables and charts, as one file."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from socket_testbed.arrays import FloatArray
from socket_testbed.pages.document import numbers
from socket_testbed.report.figures.style import FigureStyle, save_figure, thin
from socket_testbed.tables import UNCERTAIN, Table, write_table


@dataclass(frozen=True)
class ReportFigure:
    """A chart on a page, and beside it as files: its data, and on demand for print."""

    kind: ClassVar = "figure"
    name: str  # of its files
    caption: str
    draw: Callable[[FigureStyle], Figure]  # for print
    description: str  # for who cannot see it
    data: pd.DataFrame
    # Panels of lines for the page, see report.js; None for what is on the map of the socket
    chart: Mapping[str, Any] | None = None

    def files(self, drawn: bool) -> list[str]:
        """Names of its files, with those for print if they are drawn."""
        return [f"{self.name}.{suffix}" for suffix in ["csv", *["pdf", "png"] * drawn]]

    def write(self, folder: Path, style: FigureStyle | None) -> None:
        """Write its files to a folder, those for print in a style."""
        write_table(self.data, folder / f"{self.name}.csv")
        if style is not None:
            figure = self.draw(style)
            for suffix in ("pdf", "png"):
                save_figure(figure, folder / f"{self.name}.{suffix}")


def line_chart(time: FloatArray, panels: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A chart of panels, each a title and lines by their names, over time (N,) [s], thinned."""
    shown = []
    for panel in panels:
        lines = {}
        for name, values in panel["lines"].items():
            x, y = thin(time, values)
            lines[name] = {"x": numbers(x), "y": numbers(y, 4)}
        shown.append({"title": panel["title"], "lines": lines})
    return {"over": "time [s]", "panels": shown}


@dataclass(frozen=True)
class Pictures:
    """The socket: cards, its map unrolled and in 3D, a course over time, regions as bars."""

    kind: ClassVar = "pictures"
    description: str
    has_mean: bool = True  # whether the mean over a segment can be chosen
    has_course: bool = True


@dataclass(frozen=True)
class Cards:
    """The page's cards alone."""

    kind: ClassVar = "cards"


@dataclass(frozen=True)
class Maps:
    """Unrolled maps side by side, by their identifiers on the page with their titles."""

    kind: ClassVar = "maps"
    maps: Mapping[str, str]
    legend: str


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
    """A section of a page: paragraphs as text, headings, lists, tables, figures, pictures."""

    name: str  # its identifier
    title: str
    parts: Sequence[Any]
    files: Mapping[str, pd.DataFrame] = field(default_factory=dict)  # further CSV files by name

    @property
    def figures(self) -> list[ReportFigure]:
        """Its figures."""
        return [part for part in self.parts if isinstance(part, ReportFigure)]


def render(
    title: str,
    subtitle: str,
    groups: Mapping[str, Sequence[Section]],
    data: Mapping[str, Any] | None = None,
    **content: Any,
) -> str:
    """A page as one self-contained file; every text in it is escaped.

    Args:
        title: Its heading.
        subtitle: What it is of.
        groups: Sections by the title under which they are folded; those of "" are open.
        data: What its pictures show, see report.js.
        content: What else the template takes.
    """
    defaults = {"metadata": {}, "folder": "", "figures": False, "viewer": _viewer()}
    return _template().render(
        title=title, subtitle=subtitle, groups=groups, data=data, **(defaults | content)
    )


@cache
def _viewer() -> Markup:
    """plotly.js as it comes with plotly, compressed: the browser unpacks it."""
    return Markup(base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode())


@cache
def _template() -> Any:
    environment = Environment(
        loader=PackageLoader("socket_testbed", "pages/static"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"uncertain": UNCERTAIN}
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment.get_template("page.html")
