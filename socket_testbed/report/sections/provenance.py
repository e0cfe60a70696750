"""Solver certificates, and what the report was made from and with."""

from __future__ import annotations

import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pandas as pd

from socket_testbed.report.page import Bullets, Folded, Section, Table, pairs_table
from socket_testbed.report.results import Results
from socket_testbed.trials.trial import PARAMETERS_FILE

_LIBRARIES = ("socket_testbed", "numpy", "scipy", "osqp", "qpsolvers", "matplotlib", "plotly")
_DIGEST = 16  # hexadecimal digits: enough to tell files apart


def certificates_section(results: Results) -> Section:
    """The section on the solvers' certificates."""
    return Section(
        "certificates",
        "Solver certificates",
        [
            "Karush-Kuhn-Tucker residuals and duality gap in the scaled units of each stage,"
            " computed from the solution, whatever the solver reports; none may exceed"
            f" {results.settings.identification.solver_tolerance:g}.",
            _certificates(results),
            Bullets(_certificate_lines(results)),
        ],
    )


def section(results: Results, command: str, made: datetime) -> Section:
    """The section on the origin of the report.

    Args:
        results: The results.
        command: The command line, for the record.
        made: When the report is made.
    """
    origin = provenance(results, command, made)
    settings = pairs_table(
        "settings", "Settings by their names in parameters.yaml", _settings(results)
    )
    return Section(
        "provenance",
        "Provenance",
        [
            pairs_table("provenance-table", "What the report was made from and with", origin),
            Folded("Settings of the identification and the plateaus", [settings]),
        ],
    )


def provenance(results: Results, command: str, made: datetime) -> list[tuple[str, str]]:
    """What the report was made from and with, as pairs of name and value.

    Args:
        results: The results.
        command: The command line.
        made: When the report was made.
    """
    trial, geometry = results.trial, results.trial.geometry
    calibration, stored = trial.calibration, trial.path / PARAMETERS_FILE
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
        ("calibration, source and date", f"{calibration.source} ({calibration.date})"),
    ]
    for name, cluster in calibration.clusters.items():
        if cluster.bench:
            words = [cluster.bench[key] for key in ("source", "date") if key in cluster.bench]
            rows.append((f"calibration of {name}", ", ".join(words) or "see its bench record"))
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


def _settings(results: Results) -> list[tuple[str, str]]:
    """Settings of the identification and of the plateaus, by their dotted names."""
    return [
        (name, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))
        for name, value in results.settings.to_flat().items()
        if name.startswith(("identification.", "plateau.")) and name != "identification.variant"
    ]


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


def _certificates(results: Results) -> Table:
    rows = [
        {
            "variant": label,
            "stage": stage,
            "bound violation [-]": solution.certificate.primal,
            "stationarity [-]": solution.certificate.stationarity,
            "duality gap [-]": solution.certificate.gap,
            "solver": solution.solver,
            "iterations": "" if solution.iterations is None else solution.iterations,
            "exchanges of pivoting": solution.exchanges,
            "the only solution": "yes" if solution.determined else "no",
        }
        for label, fit in results.fits.items()
        for stage, solution in (
            ("1, rest positions", fit.stage_one),
            ("2, stiffnesses", fit.stage_two),
            ("joint", fit.joint),
        )
        if solution is not None
    ]
    frame = pd.DataFrame(rows).set_index("variant")
    caption = "Residuals of both stages of each fit"
    formats = {title: ".1e" for title in frame if title.endswith("[-]")}
    return Table("kkt", caption, frame, formats)


def _certificate_lines(results: Results) -> list[str]:
    """What the data determine, the flaws of the fronts, and the state of a given model."""
    lines = [
        f"{label}: the data determine {fit.determined:.1f} of"
        f" {fit.model.stiffness.size} stiffness directions."
        for label, fit in results.fits.items()
    ]
    for variant, front in results.fronts.items():
        flawed = int((~front.sound).sum())
        lines.append(
            f"Front of {variant}: {len(front.theta)} solutions, {flawed} left out as flawed,"
            f" largest KKT residual or gap of the others {front.worst_residual:.1e}."
        )
    return lines + [
        f"{candidate.label}: {candidate.given.status}."
        for candidate in results.candidates
        if candidate.given is not None
    ]
