"""Small pieces of HTML: tables, lists and pictures, with every text escaped."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Sequence

NOTHING = "\N{EN DASH}"  # in a cell without a value


def number(value: float, digits: int = 3) -> str:
    """A number for a person; a dash where there is none."""
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else NOTHING


def significant(value: float, digits: int = 3) -> str:
    """A number with so many digits that count; a dash where there is none."""
    return f"{value:.{digits}g}" if math.isfinite(value) else NOTHING


def counted(count: int, noun: str) -> str:
    """A number of things, in words."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], name: str, group: str = "") -> str:
    """A table that scrolls inside itself where it is too wide.

    Args:
        header: Names of the columns.
        rows: Cells; the first of each row is its heading.
        name: Identifier on the page.
        group: A row of HTML above the header, for names of groups of columns.
    """
    rows = list(rows)
    numeric = [all(_is_number(cell) for cell in column) for column in zip(*rows, strict=True)]
    head = "".join(
        f'<th scope="col"{_kind(is_numeric)}>{html.escape(cell)}</th>'
        for cell, is_numeric in zip(header, numeric or [False] * len(header), strict=True)
    )
    body = "\n".join(_row(row) for row in rows)
    return (
        f'<div class="scroll" tabindex="0"><table id="{html.escape(name)}">\n'
        f"<thead>{group}<tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def column_groups(first: int, groups: Iterable[tuple[str, int]]) -> str:
    """A row of names of groups of columns, behind so many columns without one."""
    cells = "".join(
        f'<th scope="colgroup" colspan="{width}">{html.escape(name)}</th>' for name, width in groups
    )
    return f'<tr class="groups"><td colspan="{first}"></td>{cells}</tr>'


def bullets(lines: Iterable[str], kind: str = "") -> str:
    """A list of texts; nothing for none."""
    items = "\n".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f'<ul class="{kind}">\n{items}\n</ul>' if items else ""


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph."""
    return f'<p class="{kind}">{html.escape(text)}</p>' if kind else f"<p>{html.escape(text)}</p>"


def picture(svg: str, alt: str) -> str:
    """A stand-alone SVG within the page, apart from its names and styles."""
    data = base64.b64encode(svg.encode()).decode()
    return f'<img src="data:image/svg+xml;base64,{data}" alt="{html.escape(alt)}">'


def figure(pictures: Sequence[str], caption: str, downloads: Sequence[str], kind: str) -> str:
    """A figure with its caption and links to its files.

    Args:
        pictures: HTML of the pictures.
        caption: What is to be seen.
        downloads: Paths of its files, relative to the page.
        kind: Class that says how the pictures are laid out.
    """
    links = ", ".join(
        f'<a href="{html.escape(path)}">{html.escape(path.rpartition(".")[2].upper())}</a>'
        for path in downloads
    )
    return (
        f'<figure>\n<div class="{kind}">\n' + "\n".join(pictures) + "\n</div>\n"
        f'<figcaption>{html.escape(caption)} <span class="files">Files: {links}.</span>'
        "</figcaption>\n</figure>"
    )


def section(name: str, title: str, parts: Iterable[str]) -> str:
    """A section of the page with its heading."""
    body = "\n".join(part for part in parts if part)
    return f'<section id="{name}">\n<h2>{html.escape(title)}</h2>\n{body}\n</section>'


def _row(cells: Sequence[str]) -> str:
    first, *rest = cells
    columns = "".join(f"<td{_kind(_is_number(cell))}>{html.escape(cell)}</td>" for cell in rest)
    return f'<tr><th scope="row">{html.escape(first)}</th>{columns}</tr>'


def _kind(is_numeric: bool) -> str:
    return ' class="number"' if is_numeric else ""


def _is_number(cell: str) -> bool:
    if cell in ("", NOTHING):
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True
