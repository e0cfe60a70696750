"""Writing a report: the page, and a folder of its figures and data next to it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from socket_testbed.figures.style import FigureStyle
from socket_testbed.files import PAGES, atomic_output, check_outputs, check_suffix, refuse_existing
from socket_testbed.identification.data_finding import GOOD
from socket_testbed.report import fronts, models, pressure, quality, validation
from socket_testbed.report.page import Section, write_page
from socket_testbed.results.pressure_text import describe_pressure
from socket_testbed.results.report import Results
from socket_testbed.tables import write_table

# In page order, by the title of their fold; the provenance, which needs the command, comes last.

SECTIONS: dict[str, tuple[Callable[[Results], Section], ...]] = {
    "": (pressure.head_section,),
    "Numbers": (pressure.section,),
    "Model": (
        models.section,
        models.wrench_section,
        models.local_section,
        models.errors_section,
        validation.section,
        fronts.section,
        models.paper_section,
        models.surface_section,
    ),
    "Data": (quality.notes_section, quality.section),
}


def files_folder(page: Path) -> Path:
    """The folder next to a page, named after it."""
    return page.with_name(f"{page.stem}_files")


def check_page_path(page: Path, replace: bool = False) -> None:
    """Refuse a page that cannot be written, before long work.

    Args:
        page: The page, ending in `.html`.
        replace: Whether it may replace a page, and next to it the folder of a report.
    """
    check_suffix(page, PAGES, "report")
    check_outputs(page, replace=replace)
    folder = files_folder(page)
    if not replace or (folder.exists() and not (folder / models.ERRORS_FILE).is_file()):
        refuse_existing(folder)


def write_report(
    results: Results,
    page: Path,
    command: str,
    made: datetime,
    progress: Callable[[int, int], None] | None = None,
    replace: bool = False,
    style: FigureStyle | None = None,
) -> None:
    """Write the page and its folder atomically.

    Args:
        results: The results of a trial.
        page: The page, ending in `.html`; the folder next to it is named after it.
        command: The command that made the page, for the record.
        made: Time at which the page was made.
        progress: Called with the number of figures drawn for print and their total; None reports
            nothing.
        replace: Whether to replace an existing page and folder.
        style: Print layout of the figures for print; None draws none.
    """
    check_page_path(page, replace)
    folder = files_folder(page)
    groups = {group: [make(results) for make in makers] for group, makers in SECTIONS.items()}
    groups["Data"].append(quality.origin_section(results, command, made))
    sections = [section for group in groups.values() for section in group]
    figures = [figure for section in sections for figure in section.figures]
    with atomic_output(page) as new_page, atomic_output(folder, replace) as new_folder:
        new_folder.mkdir()
        for section in sections:
            for name, frame in section.files.items():
                write_table(frame, new_folder / name)
        for done, figure in enumerate(figures, start=1):
            figure.write(new_folder, style)
            if progress is not None and style is not None:
                progress(done, len(figures))
        write_page(
            new_page,
            results.trial.name,
            f"{results.pressure.segment}",
            groups,
            pressure.page_data(results),
            metadata=results.metadata.described(),
            folder=folder.name,
            figures=style is not None,
        )


def summarise(results: Results) -> list[str]:
    """One statement each on the pressure, the data, the segment and every model."""
    return [
        describe_pressure(results.pressure),
        "; ".join(map(str, results.checked.findings)) or GOOD,
        *models.describe_models(results),
    ]
