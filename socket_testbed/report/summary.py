"""The first and the last sections: what was found, what to know before using it, and its origin."""

from __future__ import annotations

import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.identification.evaluation import summarise_errors
from socket_testbed.identification.information import share_warning
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.report.page import Heading, Section
from socket_testbed.report.pressure import describe_pressure
from socket_testbed.report.quality import find_gaps, mean_and_sigma
from socket_testbed.report.results import Candidate, Results
from socket_testbed.tables import Table, number, pairs_table
from socket_testbed.trials.trial import PARAMETERS_FILE
from socket_testbed.version import __version__

_LIBRARIES = ("numpy", "scipy", "osqp", "qpsolvers", "matplotlib", "plotly")
_DIGEST = 16  # hexadecimal digits: enough to tell files apart


def section(results: Results) -> Section:
    """The section on the models that were fitted."""
    return Section("models", "Fitted models", [summarise(results)[2:]])


def notes_section(results: Results) -> Section:
    """The section with what to know of the data."""
    lines = [*map(str, results.data), *list_notes(results)] or ["Nothing."]
    return Section("notes", "Notes", [lines])


def summarise(results: Results) -> list[str]:
    """A statement each on the pressure, the data and every model."""
    wrench = results.samples.wrench[results.segment.rows]
    (force, _), (moment, _) = mean_and_sigma(wrench[:, 3:]), mean_and_sigma(wrench[:, :3])
    return [
        describe_pressure(results.pressure),
        "; ".join(map(str, results.data)).capitalize() or "Data: good.",
        f"Fitted to the segment, {results.segment}: {int(results.in_segment.sum())} of"
        f" {len(results.samples)} samples, mean force {number(force)} N, mean moment"
        f" {number(moment)} N m. Errors over it are in-sample, those over the rest held-out.",
        *(_describe(candidate) for candidate in results.candidates),
    ]


def _describe(candidate: Candidate) -> str:
    parts = []
    for title, errors in (("in-sample", candidate.errors), ("held-out", candidate.held_out)):
        if errors:
            found = summarise_errors(errors)
            parts.append(
                f"{title} the mean RMSE of the moments {number(found.moment_rmse)} N m and of the"
                f" forces {number(found.force_rmse)} N, the median RMSE of the local forces"
                f" {number(found.local_rmse)} N, the median skill {number(found.skill, 'z.2f')}"
            )
    offset = float(np.linalg.norm(candidate.model.wrench_bias[3:]))
    if offset > 0.0:
        parts.append(f"its constant force, which no tile bears, {number(offset)} N")
    return f"{candidate.label}: {'; '.join(parts)}."


def list_notes(results: Results) -> list[str]:
    """What a reader must know of the trial before using the figures."""
    samples, geometry = results.samples, results.trial.geometry
    notes = [*results.bag_notes]
    for found in results.implausible:
        fate = f"It is in the objective; --leave-out {found.channel} leaves it out."
        if found.channel in results.settings.identification.leave_out:
            fate = "It was left out of the objective."
        notes.append(f"{found.channel} looks implausible: {found.reason}. {fate}")
    gaps = find_gaps(samples.time)
    if gaps:
        notes.append(
            f"Gaps of the triggers: {len(gaps)}, the longest of {gaps[0][1]:.2f} s after"
            f" {gaps[0][0]:.2f} s."
        )
    inside = int(results.in_segment.sum())
    unfitted = inside - max(c.fit.samples for c in results.candidates if c.fit is not None)
    if unfitted:
        notes.append(
            f"{unfitted} of the segment's {inside} samples are in no fit: they lack the limb"
            " position or a channel of the wrench that is in the objective."
        )
    warnings = {c.label: share_warning(c.shares) for c in results.candidates}
    notes += [f"{label}: {warning}." for label, warning in warnings.items() if warning]
    if results.trial.metadata.side is None:
        notes.append(
            "No side of the leg is stated: regions are left and right, not medial and lateral."
            f" 'annotate {results.trial.name} --side left|right' states it."
        )
    if not geometry.registration:
        notes.append(
            "The marker bodies are not registered with the socket: their placement in socket.yaml"
            " is nominal, and every limb position rests on it."
        )
    bare = [name for name in geometry.clusters if name not in samples.clusters]
    if bare:
        notes.append(f"No reading of the clusters {', '.join(bare)} is in this trial.")
    dead = summarise_errors(results.candidates[0].errors).without_value
    if dead:
        notes.append(f"Never measured over the segment: {', '.join(dead)}.")
    return notes


def origin_section(results: Results, command: str, made: datetime) -> Section:
    """The section on the origin of the report and the solvers' certificates."""
    settings = [
        (name, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))
        for name, value in results.settings.to_flat().items()
        if name.startswith(("identification.", "plateau.")) and name != "identification.variant"
    ]
    tolerance = results.settings.identification.solver_tolerance
    return Section(
        "provenance",
        "Provenance",
        [
            pairs_table(
                "provenance-table",
                "What the report was made from and with",
                provenance(results, command, made),
            ),
            Heading("Solver certificates"),
            "Karush-Kuhn-Tucker residuals and duality gap in the scaled units of each stage,"
            " computed from the solution, whatever the solver reports; none may exceed"
            f" {tolerance:g}.",
            _certificates(results),
            Heading("Settings of the identification and the plateaus"),
            pairs_table("settings", "Settings by their names in parameters.yaml", settings),
        ],
    )


def provenance(results: Results, command: str, made: datetime) -> list[tuple[str, str]]:
    """What the report was made from and with, as pairs of name and value."""
    trial, geometry = results.trial, results.trial.geometry
    calibration, stored = trial.calibration, trial.path / PARAMETERS_FILE
    stamps = [int(results.samples.stamps[end]) for end in (0, -1)]
    first, last = (
        f"{_moment(datetime.fromtimestamp(1e-9 * stamp, UTC))} (stamp {stamp} ns)"
        for stamp in stamps
    )
    rows = [
        ("report made", _moment(made)),
        ("command", command),
        ("trial", trial.name),
        ("trial, first sample", first),
        ("trial, last sample", last),
        ("geometry", _file(trial.geometry_path, trial.socket_file is not None)),
        ("geometry, source", geometry.source or "not stated"),
        ("geometry, registration", geometry.registration or "none: nominal"),
        ("calibration", _file(trial.calibration_path, trial.calibration_file is not None)),
        ("calibration, source and date", f"{calibration.source} ({calibration.date})"),
    ]
    for name, cluster in calibration.clusters.items():
        if cluster.bench:
            words = [cluster.bench[key] for key in ("source", "date") if key in cluster.bench]
            rows.append((f"calibration of {name}", ", ".join(words) or "see its bench record"))
    if stored.is_file():
        rows.append(("parameters in the trial", _file(stored, given=False)))
    for candidate in results.candidates:
        if isinstance(given := candidate.source, StoredModel):
            described = f"{candidate.model.variant} of {given.trial}; {given.status}"
            rows.append((f"model {candidate.label}", described))
    versions = {"socket_testbed": __version__} | {name: version(name) for name in _LIBRARIES}
    rows += [(f"version of {name}", found) for name, found in versions.items()]
    return [*rows, ("Python", f"{platform.python_version()} on {platform.system()}")]


def _file(path: Path, given: bool) -> str:
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGEST]
    origin = "given on the command line" if given else "stored in the trial"
    return f"{path.name}, {origin}, SHA-256 {digest}..."


def _moment(moment: datetime) -> str:
    return moment.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _certificates(results: Results) -> Table:
    rows: list[tuple[Any, ...]] = []
    for candidate in results.candidates:
        if (fit := candidate.fit) is not None:
            determined = f"{fit.determined:.1f} of {fit.model.stiffness.size}"
            names = ("1, rest positions", "2, stiffnesses", "joint")
            stages = zip(names, (fit.stage_one, fit.stage_two, fit.joint), strict=True)
            for stage, solution in stages:
                if solution is not None:
                    found = solution.certificate
                    residuals = found.primal, found.stationarity, found.gap
                    rows.append((candidate.label, stage, *residuals, solution.solver, determined))
    for variant, front in results.fronts.items():
        stage = f"front, {int(front.sound.sum())} of {len(front.theta)} solutions sound"
        rows.append((variant, stage, np.nan, front.worst_residual, np.nan, "", ""))
    titles = ["bound violation [-]", "stationarity [-]", "duality gap [-]"]
    columns = ["variant", "stage", *titles, "solver", "determined stiffnesses"]
    frame = pd.DataFrame(rows, columns=columns).set_index("variant")
    caption = "Residuals of both stages of each fit, and the largest of each front"
    return Table("kkt", caption, frame, dict.fromkeys(titles, ".1e"))
