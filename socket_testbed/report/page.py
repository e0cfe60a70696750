"""The page of a report: one file that opens offline and loads nothing."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Sequence
from string import Template

from socket_testbed.report.figures.scene import FONT, POLICY

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


_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="$policy">
<title>$title</title>
<style>
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 84rem; font: 1rem/1.5 $font;
  color: #222; background: #fff; }
h1 { margin: 0; font-size: 1.6rem; line-height: 1.25; overflow-wrap: anywhere; }
h2 { margin: 2.5rem 0 0.75rem; padding-bottom: 0.25rem; border-bottom: 2px solid #0072B2;
  font-size: 1.3rem; }
h3 { margin: 1.5rem 0 0.5rem; font-size: 1.05rem; }
p, li { max-width: 60rem; overflow-wrap: anywhere; }
ul { padding-left: 1.25rem; }
li { margin-bottom: 0.35rem; }
a { color: #00588A; }
.subtitle { margin: 0.25rem 0 1rem; color: #555; }
nav ul { display: flex; flex-wrap: wrap; gap: 0.25rem 1.25rem; padding: 0; margin: 0;
  list-style: none; }
nav li { margin: 0; }
.notes { padding: 0.75rem 1rem 0.5rem 2rem; border-left: 4px solid #D55E00; background: #FBF3EC; }
.scroll { overflow-x: auto; margin: 0.5rem 0 1rem; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.25rem 0.9rem 0.25rem 0; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; font-variant-numeric: tabular-nums; }
thead th { border-bottom: 2px solid #888; vertical-align: bottom; }
.groups th, .groups td { border-bottom: none; }
th { font-weight: 600; }
.number { text-align: right; }
tbody th { white-space: nowrap; font-weight: 500; }
td { white-space: nowrap; }
#provenance-table td, #settings td { white-space: normal; overflow-wrap: anywhere;
  min-width: 14rem; }
figure { margin: 1rem 0 1.5rem; }
figure img { display: block; width: 100%; height: auto; }
figcaption { max-width: 60rem; margin-top: 0.5rem; font-size: 0.9rem; color: #444; }
.files { white-space: nowrap; }
.panels { display: grid; gap: 1rem 1.5rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); }
.single { max-width: 46rem; }
.wide { max-width: 52rem; overflow-x: auto; }
.wide img { min-width: 34rem; }
.switches { display: flex; flex-wrap: wrap; gap: 0.5rem 1.5rem; margin: 0.75rem 0; }
select { font: inherit; padding: 0.2rem 0.4rem; max-width: 100%; }
.scene { height: min(75vh, 40rem); min-height: 24rem; border: 1px solid #ddd; }
summary { cursor: pointer; }
@media (max-width: 40rem) { .single { overflow-x: auto; } .single img { min-width: 26rem; } }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  nav, .switches, .files { display: none; }
  figure, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  .scroll, .wide { overflow: visible; }
  table { font-size: 7.5pt; }
  th, td { padding-right: 0.4rem; }
  .panels { display: block; }
  .panels img { display: inline-block; width: 49%; break-inside: avoid; }
}
</style>
</head>
<body>
<header>
<h1>$title</h1>
<p class="subtitle">$subtitle</p>
<nav aria-label="Contents"><ul>
$contents
</ul></nav>
</header>
<main>
$sections
</main>
</body>
</html>
""")

CONTENTS = (
    ("summary", "Summary"),
    ("wrench", "Wrench"),
    ("local", "Local forces"),
    ("errors-section", "Errors"),
    ("fronts", "Pareto fronts"),
    ("surface", "Surface"),
    ("quality", "Data quality"),
    ("certificates", "Certificates"),
    ("provenance", "Provenance"),
)


def compose_page(title: str, subtitle: str, sections: Sequence[str]) -> str:
    """The page with its contents.

    Args:
        title: Heading, as text.
        subtitle: What stands below it, as text.
        sections: HTML of the sections that `CONTENTS` names.
    """
    contents = "\n".join(f'<li><a href="#{name}">{word}</a></li>' for name, word in CONTENTS)
    return _PAGE.substitute(
        title=html.escape(title),
        subtitle=html.escape(subtitle),
        font=FONT,
        policy=POLICY,
        contents=contents,
        sections="\n".join(sections),
    )
