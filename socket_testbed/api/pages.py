"""Web pages: the report of a trial, a comparison, a survey, and playback of a trial."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.api import trials
from socket_testbed.api.models import Model, model_for, predictions
from socket_testbed.api.pressure import prior_for
from socket_testbed.api.tradeoff import theta_values
from socket_testbed.documents import check_kind, path_of
from socket_testbed.figures.style import figure_style
from socket_testbed.files import PAGES, check_suffix
from socket_testbed.geometry.socket import SOCKET
from socket_testbed.identification.differences import DIFFERENCE, SAME_LIMB, VALUE, is_clear
from socket_testbed.identification.force_map import NORMAL_QUANTILE
from socket_testbed.pages.document import moment, pressure_card, socket_document
from socket_testbed.results.comparison import LEGEND, MAPPED, Comparison
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import LEGEND as SURVEY_LEGEND
from socket_testbed.results.survey import Survey
from socket_testbed.settings.identification import ReportChoices
from socket_testbed.settings.options import ReportOptions
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.tables import Table, pairs_table
from socket_testbed.trials.segment import Segment, Span, specification_of
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from socket_testbed.pages.server import PageServer
    from socket_testbed.results.report import Results

_HEADINGS = {
    "metadata": "Metadata of the trials",
    "trials": "Segments, sources and calibrations",
    "regions": "By region",
    "tiles": "Tile by tile",
    "limb": "Limb in the socket",
    "wrench": "Wrench",
}
_INDEPENDENT = (
    "Intervals of differences treat the errors of two limbs as independent, so that their variances"
    f" add, and those of one subject in one socket as correlated ({SAME_LIMB:g}), so that they"
    " partly cancel (Zou & Donner 2008). They cover the uncertainty left by the sensors under the"
    " prior of the force map. docs/compare.md reports their coverage."
)
_MAPS = (
    "Mean pressure on the unrolled wall and the distal end, on a common scale; the greyer, the less"
    " certain. Differences have their own scale, centred on zero, and are grey where the 95 %"
    " interval includes zero. Outlined: clusters."
)
_SURVEY_MAPS = (
    "Normal pressure on the unrolled wall and the distal end, mean over the like loads, on a common"
    " scale; the greyer, the less certain. Own: from the clusters of this trial alone; completed:"
    " from those of all trials; limb: what all donnings share. Outlined: tiles that a trial"
    " measured."
)


def write_report(
    trial: Trial | PathLike,
    page: PathLike,
    segment: str | Span | Segment = "plateau",
    *,
    model: Model | None = None,
    thetas: int = ReportOptions.thetas,
    params: PathLike | None = None,
    prior: Survey | PathLike | None = None,
    command: str = "socket_testbed.write_report",
    replace: bool = False,
    figures: bool = False,
    width: float = 180,
    title: bool = True,
    progress: trials.Progress | None = None,
    **choices: Unpack[ReportChoices],
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
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.
        command: The command that made the page, for the record.
        replace: Whether to replace an existing page and its folder; otherwise they are an error.
        figures: Whether to add figures for print to the folder, as `.pdf` and `.png`.
        width: Printed width of these figures, 88 or 180 [mm].
        title: Whether these figures have titles, and errors in their keys.
        progress: See `Progress`.
        choices: Settings as in `fit`, except `variant`.

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
    trial = trials.as_trial(trial)
    # Only pages need their libraries.
    from socket_testbed.report.write import check_page_path
    from socket_testbed.report.write import write_report as write_page
    from socket_testbed.results.report import compute_results

    page = path_of(page, "the page")
    values = theta_values(thetas)
    specification = specification_of(segment)
    check_page_path(page, replace)
    style = figure_style(width, title)  # fails before long work
    settings = trials.settings_of(trial, params, **choices)
    stored = None if model is None else model_for(trial, model)
    learnt = prior_for(trial, prior)
    with threadpool_limits(1):
        results = compute_results(
            trial,
            specification,
            settings,
            values,
            stored,
            trials.started(progress, "fitting, judging, mapping"),
            learnt,
        )
    for text in (*map(str, results.data), *results.bag_notes):
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


def _origin(command: str) -> Table:
    """When a page was made, and by which command."""
    from socket_testbed.report.page import utc

    rows = [("page made", utc(datetime.now(UTC))), ("command", command)]
    return pairs_table("provenance-table", "Provenance of the page", rows)


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
    # Only pages need their libraries.
    from socket_testbed.report.page import Maps, Section, write_page

    check_kind(found, Comparison, "the comparison", "give a result of st.compare")
    path = _page_path(page)
    count, *clearest = found.differing()
    data, titles = _map_data(found)
    cells = found.cells("regions").loc["socket"].rename_axis("output")
    parts = {name: _tables(found, name) for name in dict.fromkeys(found.table["part"])}
    numbers = [Section(name, _HEADINGS[name], parts.pop(name)) for name in MAPPED if name in parts]
    socket = Table("socket-table", "Outputs of the socket", cells)
    groups = {
        "": [
            *([Section("maps", "", [Maps(titles, _MAPS)])] if titles else []),
            Section("differing", "Differences", [[*clearest, f"{count}."]]),
            *([Section("notes", "Notes", [found.notes])] if found.notes else []),
            Section("socket", "Whole socket", [socket]),
        ],
        "Numbers": [Section("intervals", "Intervals", [_INDEPENDENT, LEGEND]), *numbers],
        "Data": [
            *(Section(name, _HEADINGS[name], tables) for name, tables in parts.items()),
            Section("provenance", "Provenance", [_origin(command)]),
        ],
    }
    title = f"Comparison of trials: {', '.join(found.items)}"
    write_page(path, title, found.title, groups, data | {"cards": _cards(found)})


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
    # Only pages need their libraries.
    from socket_testbed.report.page import Maps, Section, write_page

    check_kind(found, Survey, "the survey", "give a result of st.survey")
    path = _page_path(page)
    scores, judged = found.tables()
    pressures = Table("tiles", "Normal pressure", found.pressures())
    used = [
        (name, f"{segment}; {', '.join(f'{c} on {tile}' for c, tile in places.items())}")
        for name, segment, places in zip(found.trials, found.segments, found.clusters, strict=True)
    ]
    data, titles = _survey_maps(found)
    verdict = f"{found.verdict[0].upper()}{found.verdict[1:]}."
    groups = {
        "": [
            Section("verdict", "Verdict", [verdict, found.conclusions()]),
            *([Section("notes", "Notes", [found.notes])] if found.notes else []),
            Section("maps", "Own and completed maps", [Maps(titles, _SURVEY_MAPS)]),
            Section(
                "judged", "Judged", [f"{SURVEY_LEGEND[0].upper()}{SURVEY_LEGEND[1:]}.", scores]
            ),
        ],
        "Numbers": [
            Section("places", "Judged places", [judged]),
            Section("tiles", "Tile by tile", [pressures]),
        ],
        "Data": [
            Section("trials", "Trials", [pairs_table("trials-table", "Parts and clusters", used)]),
            Section("provenance", "Provenance", [_origin(command)]),
        ],
    }
    title = f"Survey of one limb: {', '.join(found.trials)}"
    subtitle = f"{found.states} like loads, {len(found.judgements.points)} judged places"
    write_page(path, title, subtitle, groups, data | {"cards": _survey_cards(found)})


def _survey_cards(found: Survey) -> list[dict[str, Any]]:
    """The errors of a single and of the completed map, and what donning and sensors explain."""
    judged = found.judgements
    shown = []
    for title, value, words in (
        ("Map of one trial", judged.error, "error between its clusters, of the force there"),
        ("Completed map", judged.completed, "error on tiles that no trial measured"),
        ("Donning and sensors", judged.explained, "share of the judged square"),
    ):
        known = np.isfinite(value.low)
        ends = f"{100.0 * value.low:.0f} to {100.0 * value.high:.0f} %" if known else ""
        shown.append(
            {
                "title": title,
                "value": f"{100.0 * value.value:.0f} %",
                "interval": ends,
                "words": words,
            }
        )
    return shown


def _survey_maps(found: Survey) -> tuple[dict[str, Any], dict[str, str]]:
    """Maps of every trial alone and completed, and of the limb, on one scale, and their titles."""
    table = found.pressures()
    titles = [name.removesuffix(" [kPa]") for name in table if not name.endswith(" sd [kPa]")]
    nothing = np.zeros(0)
    maps: list[dict[str, Any]] = []
    for number, title in enumerate(titles):
        pressure = 1e3 * table[f"{title} [kPa]"].to_numpy()
        reach = NORMAL_QUANTILE * 1e3 * table[f"{title} sd [kPa]"].to_numpy()
        shown = moment(0.0, pressure, reach, nothing, nothing) | {"highest": "highest"}
        maps.append({"box": f"map-{number}", "moment": shown, "range": None, "diverging": False})
    scale = float(max(table[f"{title} [kPa]"].max() for title in titles))
    data = {"socket": socket_document(found.surveyed, found.side), "maps": maps, "scale": scale}
    return data, {f"map-{number}": title for number, title in enumerate(titles)}


def _cards(found: Comparison) -> list[dict[str, Any]]:
    """Each trial's own peak, then differences of peak and mean pressure from the first trial."""
    table, shown = found.table, []
    rows = table[(table["part"] == "regions") & (table["name"] == SOCKET)]
    segments = table[(table["part"] == "trials") & (table["name"] == "segment")]
    spans = dict(zip(segments["item"], segments["text"], strict=True))
    for row in rows[rows["quantity"] == "peak pressure"].to_dict("records"):
        item = row["item"]
        mean = f"mean of {len(found.conditions[item])} trials, " * (len(found.conditions[item]) > 1)
        peak, low, high = (row[name] for name in VALUE)
        shown.append(pressure_card(f"Peak, {item}", peak, low, high, mean + spans[item]))
    others = rows[rows["item"] != found.items[0]]
    for quantity in ("peak pressure", "mean pressure"):
        for row in others[others["quantity"] == quantity].to_dict("records"):
            by, low, high = (row[name] for name in DIFFERENCE)
            title = f"{quantity.capitalize()}, {found.difference_title(row['item'])}"
            words = "a clear difference" if is_clear(low, high) else "no clear difference"
            shown.append(pressure_card(title, by, low, high, words, "+"))
    return shown


def _map_data(found: Comparison) -> tuple[dict[str, Any], dict[str, str]]:
    """Maps of the trials on a common scale, of the differences on another, and their titles."""
    if found.geometry is None:
        return {}, {}
    pressures, change = map(found.tile_pressures, (VALUE, DIFFERENCE))
    values, differences = pressures.value, change.value
    names = [*found.items, *map(found.difference_title, found.items[1:])]
    greys = [*[None] * len(values), *(1.0 * ~is_clear(change.low, change.high)[1:])]
    reaches = [*pressures.reach, *change.reach[1:]]
    both = zip([*values, *differences[1:]], reaches, greys, strict=True)
    limit = float(np.abs(differences[1:]).max()) or 1.0
    nothing = np.zeros(0)
    maps: list[dict[str, Any]] = [
        {
            "box": f"map-{number}",
            "moment": moment(0.0, 1e3 * value, 1e3 * reach, nothing, nothing, grey)
            | {"highest": "highest"},
            "range": None if grey is None else limit,
            "diverging": grey is not None,
        }
        for number, (value, reach, grey) in enumerate(both)
    ]
    data = {
        "socket": socket_document(found.geometry, found.side),
        "maps": maps,
        "scale": float(values.max()),
    }
    return data, {entry["box"]: name for entry, name in zip(maps, names, strict=True)}


def _tables(found: Comparison, part: str) -> list[Table]:
    rows = found.table[found.table["part"] == part]
    if part in MAPPED:
        titles = rows[["quantity", "unit"]].drop_duplicates().itertuples(index=False)
        return [
            Table(f"{part}-{number}", f"{name} [{unit}]", found.cells(part, name))
            for number, (name, unit) in enumerate(titles)
        ]
    cells = found.cells(part)
    cells.index = [": ".join(filter(None, names)) for names in cells.index]
    is_text = bool(rows["text"].notna().any())
    return [Table(f"{part}-table", _HEADINGS[part], cells, is_text=is_text)]


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
    trials.note_problems(trial)
    return PageServer(player, host, port, names)
