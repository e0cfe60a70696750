"""A report on the disk: the page, and a folder with its figures and their data beside it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from joblib.externals.loky import ProcessPoolExecutor

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output, check_outputs, refuse_existing
from socket_testbed.report.figure_files import (
    draw_figures,
    errors_table,
    residuals_table,
    surface_scene,
)
from socket_testbed.report.figures.style import DEFAULT_STYLE, FigureStyle
from socket_testbed.report.page import render
from socket_testbed.report.pressure import regions_frame
from socket_testbed.report.results import Results
from socket_testbed.report.sections import page_content
from socket_testbed.tables import write_table

_SUFFIXES = (".html", ".htm")
_ERRORS = "errors.csv"


def files_folder(page: Path) -> Path:
    """The folder beside a page, named after it."""
    return page.with_name(f"{page.stem}_files")


def check_page_path(page: Path, replace: bool = False) -> None:
    """Refuse a page that cannot be written, before long work.

    Args:
        page: The page.
        replace: Whether an older page and its folder are replaced.

    Raises:
        ConfigurationError: If it is not an HTML file, if it or its folder exists and is not to be
            replaced, or if its folder is not that of a report.
    """
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
    """Write the page and the folder with its files, both or none.

    Args:
        results: The results.
        page: The page.
        command: The command line, for the record.
        made: When the report is made.
        progress: Called with the number of figures written and of all.
        replace: Whether an older page and the folder beside it are replaced.
        style: How the figures in the folder are set.

    Raises:
        ConfigurationError: If they cannot be written, see `check_page_path`.
    """
    check_page_path(page, replace)
    folder = files_folder(page)
    with (
        atomic_output(page) as new_page,
        atomic_output(folder, replace) as new_folder,
        worker_process() as worker,
    ):
        new_folder.mkdir()
        figures = draw_figures(results)
        drawn = [figure for of_section in figures.values() for figure in of_section]
        written = [figure.write(new_folder, style, worker) for figure in drawn]
        write_table(errors_table(results.candidates), new_folder / _ERRORS)
        write_table(regions_frame(results.pressure), new_folder / "pressure.csv")
        write_table(residuals_table(results.candidates), new_folder / "residuals.csv")
        text = render(
            "report.html",
            title=f"Report on {results.trial.name}",
            subtitle=(
                f"{results.segment}, theta {results.settings.identification.theta:g}; measured"
                " against predicted wrench and local forces, with and without offsets"
            ),
            segment=str(results.segment),
            figures=figures,
            folder=folder.name,
            scene=surface_scene(results),
            **page_content(results, command, made),
        )
        new_page.write_text(text, encoding="utf-8")
        for done, (figure, files) in enumerate(zip(drawn, written, strict=True), start=1):
            try:
                files.result()
            except BrokenProcessPool:  # the worker was killed, as for want of memory
                figure.write_here(new_folder, style)
            if progress is not None:
                progress(done, len(drawn))


@contextmanager
def worker_process() -> Iterator[Executor]:
    """A process beside this one; Ctrl-C reaches both, and it is left to this one."""
    ignored = (signal.SIGINT, signal.SIG_IGN)
    worker = ProcessPoolExecutor(1, initializer=signal.signal, initargs=ignored)
    try:
        yield worker
    finally:
        worker.shutdown(kill_workers=True)
