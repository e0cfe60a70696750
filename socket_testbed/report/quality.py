"""Data of a trial: notes, quality and plateaus, and the provenance of the report."""

from __future__ import annotations

import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.figures.overview import overview_figure
from socket_testbed.figures.style import THINNED
from socket_testbed.files import PARAMETERS_FILE
from socket_testbed.identification.fit import Fit
from socket_testbed.report.page import Heading, ReportFigure, Section, line_chart, utc
from socket_testbed.results.report import GIVEN, Results
from socket_testbed.tables import Table, pairs_table
from socket_testbed.version import __version__

_LIBRARIES = ("numpy", "scipy", "osqp", "qpsolvers", "matplotlib", "plotly")
_DIGEST_LENGTH = 16  # hexadecimal digits


def section(results: Results) -> Section:
    """The section on the data of a trial."""
    quality, limits = results.quality, results.settings.plateau
    return Section(
        "quality",
        "Data quality",
        [
            f"{quality.words}.",
            _overview(results),
            quality.drop_outs,
            Heading("The segment"),
            f"Requested: {results.specification}; in use: {results.segment}. A plateau lasts"
            f" {limits.least_duration:g} s or more under a steady load of {limits.least_force:g} N"
            " or more; 'plateau' is the longest one. The limits are among the settings below.",
            quality.loads,
            Heading("Noise"),
            "From the third differences of the trial, without outliers and steps. Motion from"
            " sample to sample, such as a person's sway, counts as noise.",
            quality.noise,
        ],
    )


def _overview(results: Results) -> ReportFigure:
    time, load, lacking = results.samples.time, results.quality.load, results.quality.lacking
    flags = {f"{name} not usable [-]": rows.astype(int) for name, rows in lacking.items()}
    charts = [{"title": title, "lines": {"measured": values}} for title, values in load.items()]
    return ReportFigure(
        "overview",
        "Measured load over the trial, with plateaus in light and the segment in darker grey."
        " Figures for print also show the share of samples in which a measurement was unusable:"
        f" missing, saturated, or out of the calibrated range. {THINNED}",
        lambda style: overview_figure(
            time, load, lacking, results.plateaus, results.segment, style
        ),
        results.series(load | flags),
        line_chart(time, charts, [*results.plateaus, results.segment]),
    )


def notes_section(results: Results) -> Section:
    """The section with notes on the data."""
    return Section("notes", "Notes", [[*results.notes] or ["Nothing."]])


def origin_section(results: Results, command: str, made: datetime) -> Section:
    """The section on the provenance of the report and the solvers' certificates.

    Args:
        results: The results of the report.
        command: The command that made the page.
        made: Time at which the page was made.
    """
    settings = [
        (name, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))
        for name, value in results.settings.to_flat().items()
        if name.startswith(("identification.", "plateau.", "force_map."))
        and name != "identification.variant"
    ]
    tolerance = results.settings.identification.solver_tolerance
    return Section(
        "provenance",
        "Provenance",
        [
            pairs_table(
                "provenance-table",
                "Inputs and software of the report",
                provenance(results, command, made),
            ),
            Heading("Solver certificates"),
            "Karush-Kuhn-Tucker residuals and duality gap in the scaled units of each stage,"
            " computed from the solution independently of the solver. Those of the stages never"
            f" exceed {tolerance:g}; a joint refinement that does was stopped early.",
            _certificates(results),
            Heading("Settings of identification, plateaus and force map"),
            pairs_table("settings", "Settings by name in testbed.yaml", settings),
        ],
    )


def provenance(results: Results, command: str, made: datetime) -> list[tuple[str, str]]:
    """Inputs and software of the report, as pairs of name and value, with hashes of its files.

    Args:
        results: The results of the report.
        command: The command that made the page.
        made: Time at which the page was made.
    """
    trial, geometry = results.trial, results.trial.geometry
    calibration, stored = trial.calibration, trial.path / PARAMETERS_FILE
    stamps = [int(results.samples.stamps[end]) for end in (0, -1)]
    first, last = (
        f"{utc(datetime.fromtimestamp(1e-9 * stamp, UTC))} (stamp {stamp} ns)" for stamp in stamps
    )
    rows = [
        ("report made", utc(made)),
        ("command", command),
        ("trial", trial.name),
        ("trial, first sample", first),
        ("trial, last sample", last),
        ("geometry", _file(trial.geometry_path, trial.socket_file is not None)),
        ("geometry, source", geometry.source or "not stated"),
        ("geometry, registration", geometry.bodies),
        ("calibration", _file(trial.calibration_path, trial.calibration_file is not None)),
        ("calibration, source and date", calibration.origin),
    ]
    rows += [(name.replace("_", " "), f"{value}") for name, value in trial.replaced.items()]
    for name, cluster in calibration.clusters.items():
        if cluster.bench:
            words = [cluster.bench[key] for key in ("source", "date") if key in cluster.bench]
            rows.append((f"calibration of {name}", ", ".join(words) or "see its bench record"))
    if stored.is_file():
        rows.append(("parameters in the trial", _file(stored, given=False)))
    if GIVEN in results.candidates:
        given = results.candidates[GIVEN].model
        described = f"{given.model.variant} of {given.trial}; {given.status}"
        rows.append((f"model {GIVEN}", described))
    versions = {"socket_testbed": __version__} | {name: version(name) for name in _LIBRARIES}
    rows += [(f"version of {name}", found) for name, found in versions.items()]
    return [*rows, ("Python", f"{platform.python_version()} on {platform.system()}")]


def _file(path: Path, given: bool) -> str:
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGEST_LENGTH]
    origin = "given on the command line" if given else "stored in the trial"
    return f"{path.name}, {origin}, SHA-256 {digest}..."


def _certificates(results: Results) -> Table:
    rows: list[tuple[Any, ...]] = []
    for label, candidate in results.fitted.items():
        if isinstance(fit := candidate.model, Fit):
            determined = f"{fit.determined:.0f} of {fit.model.stiffness.size}"
            names = ("1, rest positions", "2, stiffnesses", "joint")
            stages = zip(names, (fit.stage_one, fit.stage_two, fit.joint), strict=True)
            for stage, solution in stages:
                if solution is not None:
                    found = solution.certificate
                    residuals = found.primal, found.stationarity, found.gap
                    rows.append((label, stage, *residuals, solution.solver, determined))
    for variant, front in results.fronts.items():
        stage = f"front, {int(front.sound.sum())} of {len(front.theta)} solutions sound"
        rows.append((variant, stage, np.nan, front.worst_residual, np.nan, "", ""))
    titles = ["bound violation [-]", "stationarity [-]", "duality gap [-]"]
    columns = ["variant", "stage", *titles, "solver", "determined stiffnesses"]
    frame = pd.DataFrame(rows, columns=columns).set_index("variant")
    caption = "Residuals of both stages of each fit, and the largest of each front"
    return Table("kkt", caption, frame, dict.fromkeys(titles, ".1e"))
