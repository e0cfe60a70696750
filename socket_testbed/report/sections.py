"""The sections of the page: tables and words."""

from __future__ import annotations

import hashlib
import html
import json
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import Calibration
from socket_testbed.identification.box_qp import BoxSolution
from socket_testbed.identification.evaluation import ChannelErrors, ErrorSummary, summarise_errors
from socket_testbed.identification.front import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front
from socket_testbed.report.figure_files import rest_offsets
from socket_testbed.report.figures.scene import SCENE_ID, value_scene
from socket_testbed.report.page import (
    NOTHING,
    bullets,
    column_groups,
    counted,
    number,
    paragraph,
    section,
    significant,
    table,
)
from socket_testbed.report.results import (
    Candidate,
    Results,
    count_drop_outs,
    describe_triggers,
    measure_steadiness,
)
from socket_testbed.report.summary import list_notes, summarise
from socket_testbed.samples import LOCAL_CHANNELS
from socket_testbed.trials.trial import PARAMETERS_FILE


@dataclass(frozen=True)
class PaperFigure:
    """A figure that the paper quotes for both variants.

    Attributes:
        name: What it is.
        unit: Its unit.
        without_bias: The paper's value for the variant `stiffness`.
        with_bias: The paper's value for the variant `stiffness_bias`.
    """

    name: str
    unit: str
    without_bias: float
    with_bias: float


PAPER_FIGURES = (
    PaperFigure("mean moment RMSE", "N m", 1.69, 0.44),
    PaperFigure("median local RMSE", "N", 90.07, 3.76),
    PaperFigure("RMSE of Mx", "N m", 3.99, 0.95),
)


def same_figures(errors: tuple[ChannelErrors, ...]) -> tuple[float, ...]:
    """A trial's own values of `PAPER_FIGURES`, in their order and units.

    Args:
        errors: Errors of every channel.
    """
    summary = summarise_errors(errors)
    return summary.moment_rmse, summary.local_rmse, errors[0].rmse


_LIBRARIES = ("socket_testbed", "numpy", "scipy", "osqp", "qpsolvers", "matplotlib", "plotly")
_DIGEST = 16  # hexadecimal digits: enough to tell files apart


def provenance(results: Results, command: str, made: datetime) -> list[tuple[str, str]]:
    """What the report was made from and with, as pairs of name and value.

    Args:
        results: The results.
        command: The command line.
        made: When the report was made.
    """
    trial, geometry = results.trial, results.trial.geometry
    rows = [
        ("report made", _moment(made)),
        ("command", command),
        ("trial", trial.name),
        ("trial, first sample", _of_stamp(int(results.samples.stamps[0]))),
        ("trial, last sample", _of_stamp(int(results.samples.stamps[-1]))),
        ("geometry", _file(trial.geometry_path, trial.socket_file is not None)),
        ("geometry, source", geometry.source or "not stated"),
        ("geometry, registration", geometry.registration or "none: nominal"),
        ("calibration", _file(trial.calibration_path, trial.calibration_file is not None)),
        *_calibration(trial.calibration),
    ]
    stored = trial.path / PARAMETERS_FILE
    if stored.is_file():
        rows.append(("parameters in the trial", _file(stored, given=False)))
    rows += [
        (f"model {candidate.label}", f"{candidate.model.variant} of {candidate.given.trial}")
        for candidate in results.candidates
        if candidate.given is not None
    ]
    rows += [(f"version of {name}", _version(name)) for name in _LIBRARIES]
    rows.append(("Python", f"{platform.python_version()} on {platform.system()}"))
    return rows


def settings_rows(results: Results) -> list[tuple[str, str]]:
    """Settings of the identification and of the plateaus, by their dotted names."""
    flat = results.settings.to_flat()
    return [
        (name, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))
        for name, value in flat.items()
        if name.startswith(("identification.", "plateau.")) and name != "identification.variant"
    ]


def _calibration(calibration: Calibration) -> Iterator[tuple[str, str]]:
    yield "calibration, source and date", f"{calibration.source} ({calibration.date})"
    for name, cluster in calibration.clusters.items():
        if cluster.bench:
            words = (
                f"{key} {cluster.bench[key]}" for key in ("source", "date") if key in cluster.bench
            )
            yield f"calibration of {name}", ", ".join(words) or "see its bench record"


def _file(path: Path, given: bool) -> str:
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGEST]
    origin = "given on the command line" if given else "stored in the trial"
    return f"{path.name}, {origin}, SHA-256 {digest}..."


def _of_stamp(stamp: int) -> str:
    return _moment(datetime.fromtimestamp(stamp * 1e-9, UTC)) + f" (stamp {stamp} ns)"


def _moment(moment: datetime) -> str:
    return moment.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # a checkout that is not installed
        return "not installed as a package"


_FIGURES = ("RMSE", "MAE", "sigma", "skill [-]")
_MARKS_HEADER = (
    *("variant", "solution", "theta [-]", "wrench error [-]", "local error [-]"),
    *("mean moment RMSE [N m]", "mean force RMSE [N]", "median local RMSE [N]", ""),
)


def summary_section(results: Results) -> str:
    """What was found, what to know of it, and the paper's figures beside this trial's."""
    notes = list_notes(results)
    return section(
        "summary",
        "Summary",
        [
            bullets(summarise(results)),
            *(["<h3>Notes</h3>", bullets(notes, "notes")] if notes else []),
            "<h3>This trial and the paper</h3>",
            _beside_the_paper(results),
        ],
    )


def errors_section(results: Results) -> str:
    """Errors of every model and channel, over the segment and over the rest of the trial."""
    parts = [
        paragraph(
            "In-sample: errors over the segment that the variants were fitted to. Sigma is the"
            " standard deviation of the residual; skill is 1 - RMSE / RMSE of the best constant:"
            " 1 is perfect, 0 no better than the channel's mean over these samples."
        ),
        _errors(results, "errors", [candidate.errors for candidate in results.candidates]),
    ]
    held_out = [candidate.held_out for candidate in results.candidates]
    if all(held_out):
        parts += [
            "<h3>Held-out: the rest of the trial</h3>",
            paragraph(
                "Samples of the same trial outside the segment, which the variants have not seen:"
                " other loads and the changes between them, but the same session, so no"
                " substitute for another trial."
            ),
            _errors(results, "held-out", held_out),
        ]
    return section("errors-section", "Errors", parts)


def fronts_section(results: Results, figure: str) -> str:
    """The trade-off fronts with the solutions that stand out."""
    if not results.fronts:
        return section("fronts", "Pareto fronts", [paragraph(f"None: {results.no_fronts}.")])
    verdicts = [f"{variant}: {front.knee.verdict}." for variant, front in results.fronts.items()]
    return section(
        "fronts",
        "Pareto fronts",
        [
            bullets(verdicts),
            figure,
            table(
                _MARKS_HEADER,
                [row for front in results.fronts.values() for row in _marks(front)],
                "marks",
            ),
        ],
    )


def certificates_section(results: Results) -> str:
    """How well every solution solves its problem, and what the data determine."""
    header = ["variant", "stage", "bound violation [-]", "stationarity [-]", "duality gap [-]"]
    header += ["found by", "the only solution"]
    tolerance = results.settings.identification.solver_tolerance
    lines = []
    for label, candidate in results.fitted.items():
        assert candidate.fit is not None
        lines.append(
            f"{label}: the data determine {candidate.fit.determined:.1f} of"
            f" {candidate.model.stiffness.size} stiffness directions."
        )
    for variant, front in results.fronts.items():
        flawed = int((~front.sound).sum())
        lines.append(
            f"Front of {variant}: {len(front.theta)} solutions, {flawed} left out as flawed,"
            f" largest KKT residual or gap of the others {front.worst_residual:.1e}."
        )
    lines += [
        f"{candidate.label}: {candidate.given.status}."
        for candidate in results.candidates
        if candidate.given is not None
    ]
    return section(
        "certificates",
        "Solver certificates",
        [
            paragraph(
                "Karush-Kuhn-Tucker residuals and duality gap in the scaled units of each stage,"
                f" judged by themselves, whatever the solver says; none may exceed {tolerance:g}."
            ),
            table(header, _certificates(results), "kkt"),
            bullets(lines),
        ],
    )


def provenance_section(results: Results, command: str, made: datetime) -> str:
    """What the report was made with."""
    return section(
        "provenance",
        "Provenance",
        [
            table(["what", "value"], provenance(results, command, made), "provenance-table"),
            "<details><summary>Settings of the identification and the plateaus</summary>",
            table(["setting", "value"], settings_rows(results), "settings"),
            "</details>",
        ],
    )


def _beside_the_paper(results: Results) -> str:
    fitted = list(results.fitted.values())
    own = [same_figures(candidate.errors) for candidate in fitted]
    rows = [
        [
            f"{paper.name} [{paper.unit}]",
            *(number(values[i]) for values in own),
            f"{paper.without_bias:.2f}",
            f"{paper.with_bias:.2f}",
        ]
        for i, paper in enumerate(PAPER_FIGURES)
    ]
    unsteady = [summarise_errors(candidate.errors).local_unsteadiness for candidate in fitted]
    rows.append(["sigma / RMSE of all local forces [-]", *map(number, unsteady), NOTHING, NOTHING])
    if results.fronts:
        depths = [number(results.fronts[c.model.variant].knee.depth, 2) for c in fitted]
        rows.append(["depth of the front's knee [-]", *depths, NOTHING, NOTHING])
    header = ["", "without bias", "with bias", "without bias", "with bias"]
    groups = column_groups(1, [("this trial", 2), ("the paper", 2)])
    return table(header, rows, "paper", groups)


def _errors(results: Results, name: str, errors: Sequence[Sequence[ChannelErrors]]) -> str:
    rows = []
    for of_channel in zip(*errors, strict=True):
        first = of_channel[0]
        cells = [number(value) for e in of_channel for value in (e.rmse, e.mae, e.sigma, e.skill)]
        rows.append([first.name, first.unit, *cells, _remark(results, of_channel)])
    rows += _summaries([summarise_errors(of_model) for of_model in errors])
    header = ["channel", "unit", *_FIGURES * len(errors), ""]
    groups = column_groups(2, [(candidate.label, 4) for candidate in results.candidates])
    return table(header, rows, name, groups)


def _remark(results: Results, errors: Sequence[ChannelErrors]) -> str:
    """Which models' fits did not see a channel."""
    pairs = zip(results.candidates, errors, strict=True)
    left_out = [candidate.label for candidate, error in pairs if not error.in_objective]
    if len(left_out) in (0, len(errors)):
        return "not in objective" if left_out else ""
    return f"not in objective of {', '.join(left_out)}"


def _summaries(summaries: Sequence[ErrorSummary]) -> Iterator[list[str]]:
    for title, unit, field in (
        ("mean of the moments", "N m", "moment_rmse"),
        ("mean of the forces", "N", "force_rmse"),
        ("median of the local forces", "N", "local_rmse"),
    ):
        cells = [
            cell for summary in summaries for cell in (number(getattr(summary, field)), "", "", "")
        ]
        yield [title, unit, *cells, ""]
    skills = [cell for s in summaries for cell in ("", "", "", number(s.skill))]
    yield ["median of all channels", "-", *skills, ""]


def _marks(front: Front) -> Iterator[list[str]]:
    for name in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
        index = front.marks.get(name)
        if index is None:
            yield [front.variant, name, *[NOTHING] * 6, "none"]
            continue
        errors = (front.wrench_error[index], front.local_error[index])
        sizes = (front.moment_rmse[index], front.force_rmse[index], front.local_rmse[index])
        yield [
            front.variant,
            name,
            f"{front.theta[index]:.3g}",
            *(significant(value, 4) for value in errors),
            *(number(value) for value in sizes),
            "" if front.non_dominated[index] else "dominated",
        ]


def _certificates(results: Results) -> Iterator[list[str]]:
    for label, candidate in results.fitted.items():
        assert candidate.fit is not None
        yield _certificate(label, "1, rest positions", candidate.fit.stage_one)
        yield _certificate(label, "2, stiffnesses", candidate.fit.stage_two)


def _certificate(label: str, stage: str, solution: BoxSolution) -> list[str]:
    certificate = solution.certificate
    sizes = (certificate.primal, certificate.stationarity, certificate.gap)
    return [
        label,
        stage,
        *(f"{size:.1e}" for size in sizes),
        solution.found_by,
        "yes" if solution.determined else "no",
    ]


_MOST_GAPS = 5  # in the list


def quality_section(results: Results, overview: str) -> str:
    """Triggers, plateaus, drop-outs and the autocorrelation of the residuals.

    Args:
        results: The results.
        overview: HTML of the figure of the trial at a glance.
    """
    return section(
        "quality",
        "Data quality",
        [
            overview,
            "<h3>Triggers</h3>",
            *_triggers(results),
            "<h3>The segment, and why</h3>",
            paragraph(_why(results)),
            _plateaus(results),
            "<h3>Drop-outs</h3>",
            paragraph(
                "A saturated reading has no value; one out of the calibrated range has one,"
                " but it is an extrapolation: nothing is fitted to it or judged by it."
            ),
            _drop_outs(results),
            "<h3>Autocorrelation of the residuals</h3>",
            paragraph(
                "Over the segment. The decorrelation time is the time after which a sample counts"
                " as a new one (Sokal's window over the autocorrelation); the effective number is"
                " what the samples are worth."
            ),
            _residuals(results),
        ],
    )


def _triggers(results: Results) -> list[str]:
    triggers = describe_triggers(results.samples)
    rate = 1.0 / triggers.period if triggers.period > 0.0 else float("nan")
    text = (
        f"{triggers.count} samples in {triggers.duration:.2f} s at {significant(rate)} Hz,"
        f" {triggers.complete} with a wrench and a limb position;"
        f" {counted(len(triggers.gaps), 'gap')} longer than one and a half periods"
    )
    gaps = [f"{gap.duration:.3f} s from {gap.start:.2f} s" for gap in triggers.gaps[:_MOST_GAPS]]
    more = len(triggers.gaps) - len(gaps)
    if more:
        gaps.append(f"and {more} shorter ones")
    return [paragraph(text + ("." if not gaps else ", the longest:")), bullets(gaps)]


def _why(results: Results) -> str:
    limits = results.settings.plateau
    criteria = (
        f"A plateau is a stretch of {limits.least_duration:g} s or more without an intended change"
        f" of load (the means over {limits.smoothing:g} s before and after agree within"
        f" {limits.force_change:g} N and {limits.moment_change:g} N m), with a steady mean wrench"
        f" (spread within {limits.force_drift:g} N and {limits.moment_drift:g} N m on every axis),"
        f" at most {100 * limits.missing_fraction:g} % missing channels, and a mean force of"
        f" {limits.least_force:g} N or more."
    )
    found = len(results.plateaus)
    if results.specification == "plateau":
        chosen = results.plateaus[0]
        others = f"the longest of {found}" if found > 1 else "the only one"
        return (
            f"The plateau from {chosen.start:.2f} s to {chosen.end:.2f} s was chosen because it is"
            f" {others}. {criteria}"
        )
    return (
        f"The segment was asked for as '{results.specification}'; the trial has"
        f" {counted(found, 'plateau')}."
        f" {criteria}"
    )


def _plateaus(results: Results) -> str:
    listed = [*results.plateaus]
    if results.segment not in listed:
        listed.insert(0, results.segment)
    rows = []
    for part in listed:
        load = measure_steadiness(results.samples[part.rows])
        rows.append(
            [
                f"{part.start:.2f} to {part.end:.2f}",
                number(part.end - part.start, 2),
                number(load.force, 1),
                number(load.force_sigma, 2),
                number(load.moment, 2),
                number(load.moment_sigma, 3),
                "in use" if part == results.segment else "",
            ]
        )
    header = ["from, to [s]", "duration [s]", "mean force [N]", "its sigma [N]"]
    header += ["mean moment [N m]", "its sigma [N m]", ""]
    return table(header, rows, "plateaus")


def _drop_outs(results: Results) -> str:
    count = len(results.samples)
    rows = [
        [
            lost.name,
            str(lost.missing),
            number(100.0 * lost.missing / count, 2),
            str(lost.missing_in_segment),
            number(lost.longest, 2),
            NOTHING if lost.saturated is None else str(lost.saturated),
            NOTHING if lost.out_of_range is None else str(lost.out_of_range),
        ]
        for lost in count_drop_outs(results.samples, results.segment)
    ]
    header = ["measurement", "missing [1]", "missing [%]", "of them in the segment [1]"]
    header += ["longest [s]", "saturated [1]", "out of range [1]"]
    return table(header, rows, "drop-outs")


def _residuals(results: Results) -> str:
    rows = [
        [
            results.samples.channels[i],
            *(
                cell
                for candidate in results.candidates
                for cell in (
                    number(candidate.residuals[i].lag_one, 2),
                    number(candidate.residuals[i].decorrelation, 2),
                    number(candidate.residuals[i].effective, 0),
                )
            ),
        ]
        for i in range(len(results.samples.channels))
    ]
    header = ["channel"]
    header += ["lag-1 [-]", "decorrelation [s]", "effective [1]"] * len(results.candidates)
    groups = column_groups(1, [(candidate.label, 3) for candidate in results.candidates])
    return table(header, rows, "residuals", groups)


_AXES = "xyz"
_SCRIPT = """\
<script>
(function () {
  const visible = %s;
  const model = document.getElementById("model"), value = document.getElementById("value");
  function limit() {
    for (const option of value.options) {
      option.disabled = !((model.value + " " + option.value) in visible);
    }
    if (value.selectedOptions[0].disabled) { value.selectedIndex = 0; }
  }
  function show() {
    limit();
    Plotly.restyle("%s", {visible: visible[model.value + " " + value.value]});
  }
  model.addEventListener("change", show);
  value.addEventListener("change", show);
  limit();
})();
</script>"""


def scene_section(results: Results, maps: str) -> str:
    """The scene, its switches and the figures of the same values for paper.

    Args:
        results: The results.
        maps: HTML of those figures.
    """
    values = {
        f"{candidate.label} {quantity}": of_tiles
        for candidate in results.candidates
        for quantity, of_tiles in _values(results, candidate).items()
    }
    scene = value_scene(results.trial.geometry, values)
    models = [candidate.label for candidate in results.candidates]
    quantities = list(dict.fromkeys(key.partition(" ")[2] for key in values))
    return section(
        "surface",
        "Parameters on the socket's surface",
        [
            paragraph(
                "Drag to turn, scroll or pinch to zoom; point at a tile for its name and value. The"
                " colour scale is that of the chosen values; tiles without a value are white, tiles"
                " with a cluster outlined. {S} is the frame of the load cell. A rest position"
                " is given from the mean limb position of the segment. The offset of a cluster"
                " is in the cluster's own frame; the wrench's offset belongs to no tile."
            ),
            '<div class="switches">'
            + _select("model", "Model", models)
            + _select("value", "Shown", quantities)
            + "</div>",
            f'<div class="scene">{scene.html}</div>',
            _SCRIPT % (_json(scene.visible), SCENE_ID),
            maps,
        ],
    )


def _values(results: Results, candidate: Candidate) -> dict[str, tuple[FloatArray, str]]:
    """Values of the tiles and what they are, by the name of the choice."""
    stiffness, rest = candidate.model.stiffness, rest_offsets(results, candidate)
    values = {
        f"stiffness {axis} [N/m]": (stiffness[:, i], f"stiffness along {axis} of {{S}} [N/m]")
        for i, axis in enumerate(_AXES)
    }
    values |= {
        f"rest position {axis} [mm]": (rest[:, i], f"rest position along {axis} of {{S}} [mm]")
        for i, axis in enumerate(_AXES)
    }
    if candidate.model.variant == "stiffness_bias":
        bias = np.full_like(stiffness, np.nan)
        for cluster, force in candidate.model.force_bias.items():
            bias[candidate.model.cluster_points[cluster]] = force
        for i, channel in enumerate(LOCAL_CHANNELS):
            unit = f"offset {channel} in the cluster's frame [N]"
            values[f"offset {channel} [N]"] = (bias[:, i], unit)
    return values


def _select(name: str, title: str, choices: list[str]) -> str:
    options = "".join(f"<option>{html.escape(choice)}</option>" for choice in choices)
    return f'<label>{html.escape(title)} <select id="{name}">{options}</select></label>'


def _json(document: dict[str, list[bool]]) -> str:
    """JSON that cannot end the script it stands in."""
    return json.dumps(document, separators=(",", ":")).replace("<", "\\u003c")
