"""What a report was made with, so that it can be made again."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from socket_testbed.calibration import Calibration
from socket_testbed.report.results import Results
from socket_testbed.trials.trial import PARAMETERS_FILE

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
