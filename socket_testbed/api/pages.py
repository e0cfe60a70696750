"""Web pages: the report of a trial, a comparison, a survey, and playback of a trial."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from threadpoolctl import threadpool_limits

from socket_testbed.api import trials
from socket_testbed.api.models import Model, model_for
from socket_testbed.api.pressure import prior_for
from socket_testbed.api.tradeoff import theta_values
from socket_testbed.documents import check_kind, path_of
from socket_testbed.figures.style import figure_style
from socket_testbed.files import PAGES, check_suffix
from socket_testbed.results.comparison import Comparison
from socket_testbed.results.models import predictions
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.settings.identification import Weights
from socket_testbed.settings.options import ReportOptions, SettingsOptions
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from socket_testbed.pages.server import PageServer
    from socket_testbed.results.report import Results


def write_report(
    trial: Trial | PathLike,
    page: PathLike,
    segment: str | Span | Segment = ReportOptions.segment,
    *,
    model: Model | None = None,
    thetas: int = ReportOptions.thetas,
    params: PathLike | None = None,
    theta: float | None = None,
    weights: Weights | None = None,
    smoothness: float | None = None,
    leave_out: Sequence[str] | None = None,
    pose_smoothing: float | None = None,
    frames: int | None = None,
    initial_stiffness: float | Literal["auto"] | None = None,
    solver: str | None = None,
    prior: Survey | PathLike | None = None,
    command: str = "socket_testbed.write_report",
    replace: bool = False,
    figures: bool = False,
    width: float = 180,
    title: bool = True,
    progress: trials.Progress | None = None,
) -> Results:
    """Write the results of a trial as one page, with a folder of its data next to it.

    The paper's variants are fitted, along with the variant of the settings (`rigid_bias` by
    default); the trade-off over theta is computed for the paper's variants.

    Args:
        trial: The trial.
        page: The page, ending in `.html`.
        segment: As in `fit`.
        model: A further model to show.
        thetas: Number of values of theta from 0 to 1.
        params: As in `fit`.
        theta: As in `fit`.
        weights: As in `fit`.
        smoothness: As in `fit`.
        leave_out: As in `fit`.
        pose_smoothing: As in `fit`.
        frames: As in `fit`.
        initial_stiffness: As in `fit`.
        solver: As in `fit`.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.
        command: The command that made the page, for the record.
        replace: Whether to replace an existing page and its folder; otherwise they are an error.
        figures: Whether to add figures for print to the folder, as `.pdf` and `.png`.
        width: Printed width of these figures, 88 or 180 [mm].
        title: Whether these figures have titles, and errors in their keys.
        progress: See `Progress`.

    Returns:
        The results shown on the page: `fitted` are the models by variant, `fronts`, `pressure` and
        `validation` the results behind the figures.

    Raises:
        ConfigurationError: The page exists already, a setting or a file is wrong, or the survey is
            of another socket or holds the trial.
        TrialError: The trial cannot be read or has no such segment.
        IdentificationError: The samples cannot be fitted.

    >>> results = st.write_report(st.open_trial("trials/hold"), "hold.html", thetas=5)
    >>> list(results.fitted)
    ['stiffness', 'stiffness_bias', 'rigid_bias']
    """
    options = SettingsOptions(
        params=trials.as_path(params),
        theta=theta,
        weights=weights,
        smoothness=smoothness,
        leave_out=leave_out,
        pose_smoothing=pose_smoothing,
        frames=frames,
        initial_stiffness=initial_stiffness,
        solver=solver,
    )
    trial = trials.as_trial(trial)
    # Only pages need their libraries.
    from socket_testbed.report.write import check_page_path
    from socket_testbed.report.write import write_report as write_page
    from socket_testbed.results.report import compute_results

    page = path_of(page, "the page")
    values = theta_values(thetas)
    check_page_path(page, replace)
    style = figure_style(width, title)  # fails before long work
    settings = trial.settings_for(options)
    stored = None if model is None else model_for(trial, model)
    learnt = prior_for(trial, prior)
    with threadpool_limits(1):
        results = compute_results(
            trial,
            segment,
            settings,
            values,
            stored,
            trials.started(progress, "fitting, judging, mapping"),
            learnt,
        )
    for text in results.bag_notes:
        trial.note(text)
    drawing = trials.started(progress, "drawing") if figures else None
    made, printed = datetime.now(UTC), style if figures else None
    write_page(results, page, command, made, drawing, replace, printed)
    return results


def _page_path(page: PathLike) -> Path:
    """The path of a page, which must end as one."""
    path = path_of(page, "the page")
    check_suffix(path, PAGES, "page")
    return path


def write_comparison(
    found: Comparison, page: PathLike, command: str = "socket_testbed.write_comparison"
) -> None:
    """Write a comparison as one page that opens offline; an existing one is replaced.

    Args:
        found: A result of `st.compare`.
        page: The page, ending in `.html`.
        command: The command that made the page, for the record.

    Raises:
        ConfigurationError: The page does not end in `.html`, or cannot be written.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> st.write_comparison(found, "liners.html")
    """
    from socket_testbed.report.comparison import write_comparison as write

    check_kind(found, Comparison, "the comparison", "give a result of st.compare")
    write(found, _page_path(page), command)


def write_survey(
    found: Survey, page: PathLike, command: str = "socket_testbed.write_survey"
) -> None:
    """Write a survey as one page that opens offline; an existing one is replaced.

    Args:
        found: A result of `st.survey`.
        page: The page, ending in `.html`.
        command: The command that made the page, for the record.

    Raises:
        ConfigurationError: The page does not end in `.html`, or cannot be written.

    >>> again = st.simulate("trials/again", duration=40, donning=2, geometry="moved.yaml")
    >>> st.write_survey(st.survey("trials/hold", again), "survey.html")
    """
    from socket_testbed.report.survey import write_survey as write

    check_kind(found, Survey, "the survey", "give a result of st.survey")
    write(found, _page_path(page), command)


def view(
    trial: Trial | PathLike,
    model: Model | None = None,
    *,
    prior: Survey | PathLike | None = None,
    port: int = 0,
    host: str = ViewSettings.host,
    names: tuple[str, ...] = (),
) -> PageServer:
    """Show a trial in a browser: play, pause, seek; the pressure on the socket at every instant.

    The page opens at the peak. Map and regional outputs are computed for the instant shown.
    Nothing is written.

    Args:
        trial: The trial.
        model: A fit, a model from `read_model`, or the path of its file, to show its predictions.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.
        port: Port of the page; 0 for any free port.
        host: Address of this machine to serve the page on, `0.0.0.0` for all; at `127.0.0.1` only
            this machine can open it.
        names: Further host names of this machine under which browsers may open the page.

    Returns:
        The page: a context manager with its `url`, served until `close` or the program's end.

    Raises:
        ConfigurationError: The page cannot be served at this address, the model or the survey is of
            another socket, or the survey holds the trial.
        TrialError: The trial cannot be read.

    >>> with st.view(st.open_trial("trials/hold")) as page:
    ...     print(page.url)
    http://127.0.0.1:...
    """
    trial = trials.as_trial(trial)
    from socket_testbed.pages.player import Player
    from socket_testbed.pages.server import PageServer

    check_kind(host, str, "host", "give an address, such as 127.0.0.1")
    predicted = None if model is None else predictions(trial, model_for(trial, model))
    player = Player(trial, predicted, prior_for(trial, prior))
    trial.note_problems()
    return PageServer(player, host, port, names)
