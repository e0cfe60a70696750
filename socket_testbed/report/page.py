"""A single-file page: pictures of a socket, and sections of text, tables and charts."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.style import PAGE_LINES, FigureStyle, save_figure, thin
from socket_testbed.files import write_text
from socket_testbed.geometry.regions import socket_axis
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.pages.document import numbers, socket_document
from socket_testbed.tables import UNCERTAIN, Table, pairs_table, write_table

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure

    from socket_testbed.trials.segment import Segment


@dataclass(frozen=True)
class ReportFigure:
    """A chart on a page, with files next to it: its data and, on request, figures for print.

    Attributes:
        name: Name of its files without a suffix, and part of its identifier on the page.
        caption: Caption on the page.
        draw: Draws it for print in a style.
        data: What is drawn, with units in the column names; written as CSV.
        chart: Panels of lines for the page, see `line_chart` and report.js; None if it is drawn
            only for print or shown on the map of the socket.
    """

    kind: ClassVar = "figure"
    name: str
    caption: str
    draw: Callable[[FigureStyle], Figure]
    data: pd.DataFrame
    chart: Mapping[str, Any] | None = None

    def files(self, drawn: bool) -> list[str]:
        """Names of its files, including those for print if drawn."""
        return [f"{self.name}.{suffix}" for suffix in ["csv", *["pdf", "png"] * drawn]]

    def write(self, folder: Path, style: FigureStyle | None) -> None:
        """Write its files.

        Args:
            folder: The folder, which exists.
            style: Print layout of the `.pdf` and the `.png`; None writes only the CSV.
        """
        write_table(self.data, folder / f"{self.name}.csv")
        if style is not None:
            figure = self.draw(style)
            for suffix in ("pdf", "png"):
                save_figure(figure, folder / f"{self.name}.{suffix}")


def utc(moment: datetime) -> str:
    """A time in UTC as text, such as `2025-01-31 12:00:00 UTC`."""
    return moment.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def origin_table(command: str) -> Table:
    """When a page was made, and by which command."""
    rows = [("page made", utc(datetime.now(UTC))), ("command", command)]
    return pairs_table("provenance-table", "Provenance of the page", rows)


def line_chart(
    time: FloatArray, panels: Sequence[Mapping[str, Any]], shaded: Sequence[Segment]
) -> dict[str, Any]:
    """A chart of panels over time, thinned for the page.

    Args:
        time: Times of N samples since the first one, shape (N,) [s].
        panels: For each panel its `title`, with the unit, and `lines`: values by name, shape (N,),
            in this unit, NaN where missing. What is measured comes first, then models.
        shaded: Segments of the trial that are shaded, in the order in which they are drawn.

    Returns:
        `over`, the label of the x axis; `panels`, each line with its `x`, `y` and `style`; and
        `shaded`, starts and ends [s].
    """
    shown = []
    for panel in panels:
        lines = {}
        for (name, values), style in zip(panel["lines"].items(), PAGE_LINES, strict=False):
            x, y = thin(time, values)
            lines[name] = {"x": numbers(x), "y": numbers(y, 4), "style": style}
        shown.append({"title": panel["title"], "lines": lines})
    spans = [[segment.start, segment.end] for segment in shaded]
    return {"over": "time [s]", "panels": shown, "shaded": spans}


@dataclass(frozen=True)
class Pictures:
    """The socket: unrolled map and 3D view; if over time, also a course and bars of regions.

    Attributes:
        description: What the map shows, for readers who cannot see it.
        over_time: Whether the page holds moments of a trial and the mean over a segment.
    """

    kind: ClassVar = "pictures"
    description: str
    over_time: bool = True


@dataclass(frozen=True)
class Maps:
    """Unrolled maps side by side.

    Attributes:
        maps: Titles of the maps by their identifiers on the page, the `box` of the page's data.
        legend: A line below the maps.
    """

    kind: ClassVar = "maps"
    maps: Mapping[str, str]
    legend: str


@dataclass(frozen=True)
class Heading:
    """A heading within a section.

    Attributes:
        text: The heading.
    """

    kind: ClassVar = "heading"
    text: str


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes:
        name: Identifier on the page.
        title: Heading of the section; empty for none.
        parts: Contents in their order: strings are paragraphs, sequences of strings are lists; also
            `Heading`, `Table`, `ReportFigure`, `Pictures` and `Maps`.
        files: Further tables for the folder of the page, by the name of the file, such as
            `errors.csv`.
    """

    name: str
    title: str
    parts: Sequence[Any]
    files: Mapping[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def figures(self) -> list[ReportFigure]:
        """The figures among its parts."""
        return [part for part in self.parts if isinstance(part, ReportFigure)]


def write_page(
    path: Path,
    title: str,
    subtitle: str,
    groups: Mapping[str, Sequence[Section]],
    data: Mapping[str, Any],
    **content: Any,
) -> None:
    """Write a page as one self-contained file, or replace it; all text is escaped.

    Args:
        path: The file.
        title: Heading of the page.
        subtitle: A line below the heading.
        groups: Sections by the title under which they are folded; those of "" stay open.
        data: Plain data for the cards and pictures, see `pages.document` and report.js.
        content: Further variables of the template page.html: `metadata` (stated values as text),
            `folder` (name of the folder with the files) and `figures` (whether it holds those for
            print).
    """
    environment = Environment(
        loader=PackageLoader("socket_testbed", "pages/static"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    defaults = {"metadata": {}, "folder": "", "figures": False, "uncertain": UNCERTAIN}
    environment.globals |= defaults | {"viewer": _viewer()}
    found = {"title": title, "subtitle": subtitle, "groups": groups, "data": data}
    write_text(path, environment.get_template("page.html").render(found | content))


@cache
def _viewer() -> Markup:
    """The plotly.js shipped with plotly, compressed; the browser unpacks it."""
    return Markup(base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode())


def write_socket_page(
    surface: trimesh.Trimesh,
    geometry: SocketGeometry,
    path: Path,
    title: str,
    facts: Sequence[tuple[str, str]],
) -> None:
    """Write a single-file page with the interior surface of a socket and its tiles.

    Args:
        surface: The surface in {S} [m].
        geometry: The socket, whose tiles lie on the surface.
        path: The file, `.html`; an existing one is replaced.
        title: Heading of the page.
        facts: Names and values for the table below the pictures.
    """
    heights = 1e3 * socket_axis(geometry).heights(geometry.anchors)
    mesh = {"points": numbers(1e3 * surface.vertices, 1), "faces": surface.faces.tolist()}
    data = {
        "socket": socket_document(geometry) | {"surface": mesh},
        "moments": [{"time": 0.0, "words": f"{len(geometry)} tiles"}],
        "start": 0.0,
        "kinds": ["tiles"],
        "extras": {
            "area [mm^2]": {"values": numbers(1e6 * geometry.areas), "unit": "mm²"},
            "height [mm]": {"values": numbers(heights), "unit": "mm"},
        },
    }
    pictures = Pictures("The interior surface of the socket with its tiles", over_time=False)
    table = pairs_table("facts", "The socket and its tiles", facts)
    subtitle = "lengths in mm in {S}, the frame of the load cell"
    write_page(path, title, subtitle, {"": [Section("socket", "", [pictures, table])]}, data)
