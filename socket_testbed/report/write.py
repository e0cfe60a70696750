"""A report on the disk: the page, and a folder with its figures and their data beside it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output, check_outputs, refuse_existing
from socket_testbed.report.figures.style import DEFAULT_STYLE, FigureStyle
from socket_testbed.report.page import Section, render
from socket_testbed.report.results import Results
from socket_testbed.report.sections import (
    channels,
    fronts,
    pressure,
    quality,
    summary,
    surface,
    validation,
)
from socket_testbed.tables import write_table

_SUFFIXES = (".html", ".htm")
_ERRORS = "errors.csv"  # in the folder of every report

# In the order of the page; the origin, which needs the command, comes last.
SECTIONS: tuple[Callable[[Results], Section], ...] = (
    summary.section,
    pressure.section,
    channels.wrench_section,
    channels.local_section,
    channels.paper_section,
    channels.errors_section,
    validation.section,
    fronts.section,
    surface.section,
    quality.section,
)


def files_folder(page: Path) -> Path:
    """The folder beside a page, named after it."""
    return page.with_name(f"{page.stem}_files")


def check_page_path(page: Path, replace: bool = False) -> None:
    """Refuse a page that cannot be written, before long work."""
    if page.suffix.lower() not in _SUFFIXES:
        raise ConfigurationError(f"{page}: a report is a page", "let it end in .html")
    check_outputs(page, replace=replace)
    folder = files_folder(page)
    if not replace or (folder.exists() and not (folder / _ERRORS).is_file()):
        refuse_existing(folder)


def write_report(
    results: Results,
    page: Path,
    command: str,
    made: datetime,
    progress: Callable[[int, int], None] | None = None,
    replace: bool = False,
    style: FigureStyle = DEFAULT_STYLE,
) -> None:
    """Write the page and the folder with its files, both or none."""
    check_page_path(page, replace)
    folder = files_folder(page)
    sections = [make(results) for make in SECTIONS]
    sections.append(summary.origin_section(results, command, made))
    figures = [figure for section in sections for figure in section.figures]
    with atomic_output(page) as new_page, atomic_output(folder, replace) as new_folder:
        new_folder.mkdir()
        for section in sections:
            for name, frame in section.files.items():
                write_table(frame, new_folder / name)
        for done, figure in enumerate(figures, start=1):
            figure.write(new_folder, style)
            if progress is not None:
                progress(done, len(figures))
        text = render(
            f"Report on {results.trial.name}",
            f"{results.segment}, theta {results.settings.identification.theta:g}; measured against"
            " predicted wrench and local forces, with and without offsets",
            sections,
            metadata=results.trial.metadata.described(),
            folder=folder.name,
        )
        new_page.write_text(text, encoding="utf-8")
