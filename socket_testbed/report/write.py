"""A report on the disk: the page, and a folder with its figures and their data beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Self

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output, refuse_existing
from socket_testbed.report import figure_files
from socket_testbed.report.figure_files import ReportFigure, write_errors, write_residuals
from socket_testbed.report.page import compose_page, section
from socket_testbed.report.results import Results
from socket_testbed.report.sections import (
    certificates_section,
    errors_section,
    fronts_section,
    provenance_section,
    quality_section,
    scene_section,
    summary_section,
)

_SUFFIXES = (".html", ".htm")


def files_folder(page: Path) -> Path:
    """The folder beside a page, named after it."""
    return page.with_name(f"{page.stem}_files")


def check_page_path(page: Path) -> None:
    """Refuse a page that cannot be written, before long work.

    Raises:
        ConfigurationError: If it is no HTML file, or it or its folder exists.
    """
    if page.suffix.lower() not in _SUFFIXES:
        raise ConfigurationError(f"{page}: a report is a page", "let it end in .html")
    refuse_existing(page)
    refuse_existing(files_folder(page))


def write_report(
    results: Results,
    page: Path,
    command: str,
    made: datetime,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the page and the folder with its files, both or none.

    Args:
        results: The results.
        page: The page, which must not exist, nor the folder beside it.
        command: The command line, for the record.
        made: When the report is made.
        progress: Told the number of figures written and of all.

    Raises:
        ConfigurationError: If they exist or cannot be written.
    """
    check_page_path(page)
    folder = files_folder(page)
    with atomic_output(page) as new_page, atomic_output(folder) as new_folder:
        new_folder.mkdir()
        made_figures = _Figures.of(results, new_folder)
        made_figures.write(new_folder, progress)
        write_errors(results.candidates, new_folder / "errors.csv")
        write_residuals(results.candidates, new_folder / "residuals.csv")
        text = _compose(results, made_figures, folder.name, command, made)
        new_page.write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class _Figures:
    """The figures of a report, by the sections that show them."""

    wrench: ReportFigure
    local: ReportFigure
    overview: ReportFigure
    fronts: tuple[ReportFigure, ...]
    maps: tuple[ReportFigure, ...]

    @classmethod
    def of(cls, results: Results, scratch: Path) -> Self:
        """Draw them."""
        wrench, local = figure_files.channel_figures(results)
        return cls(
            wrench=wrench,
            local=local,
            overview=figure_files.overview(results),
            fronts=(figure_files.pareto(results, scratch),) if results.fronts else (),
            maps=(*figure_files.tile_figures(results), figure_files.offsets(results)),
        )

    def write(self, folder: Path, progress: Callable[[int, int], None] | None) -> None:
        """Write them with their data."""
        every = (self.wrench, self.local, self.overview, *self.fronts, *self.maps)
        for done, figure in enumerate(every, start=1):
            figure.write(folder)
            if progress is not None:
                progress(done, len(every))


def _compose(results: Results, drawn: _Figures, folder: str, command: str, made: datetime) -> str:
    """The page, which links to the files in the folder of this name."""

    def show(*several: ReportFigure) -> str:
        return "\n".join(figure.to_html(folder) for figure in several)

    sections = [
        summary_section(results),
        section("wrench", "Wrench", [show(drawn.wrench)]),
        section("local", "Local forces", [show(drawn.local)]),
        errors_section(results),
        fronts_section(results, show(*drawn.fronts)),
        scene_section(results, show(*drawn.maps)),
        quality_section(results, show(drawn.overview)),
        certificates_section(results),
        provenance_section(results, command, made),
    ]
    identification = results.settings.identification
    subtitle = (
        f"{results.segment}, theta {identification.theta:g}; measured against predicted wrench and"
        " local forces, with and without offsets"
    )
    return compose_page(f"Report on {results.trial.name}", subtitle, sections)
