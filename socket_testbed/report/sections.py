"""The sections of the page that are tables and words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime

from socket_testbed.evaluation import ChannelErrors, ErrorSummary, summarise_errors
from socket_testbed.identification.box_qp import BoxSolution
from socket_testbed.identification.front import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front
from socket_testbed.report.markup import (
    NOTHING,
    bullets,
    column_groups,
    number,
    paragraph,
    section,
    significant,
    table,
)
from socket_testbed.report.paper import PAPER_FIGURES, same_figures
from socket_testbed.report.provenance import provenance, settings_rows
from socket_testbed.report.results import Results
from socket_testbed.report.summary import list_notes, summarise

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
