"""What the page says besides its figures: tables, and words with numbers."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.identification.evaluation import ChannelErrors, summarise_errors
from socket_testbed.identification.information import LEAST_RATIO
from socket_testbed.identification.noise import channel_noise, noise_groups
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY
from socket_testbed.identification.pressure import SHARE, THRESHOLD
from socket_testbed.identification.validation import LEVELS, summarise_judgements
from socket_testbed.report.page import Table, counted, number, pairs_table
from socket_testbed.report.pressure import pressure_tables
from socket_testbed.report.results import (
    Results,
    describe_triggers,
    find_drop_outs,
    measure_steadiness,
)
from socket_testbed.report.summary import list_notes, summarise
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.trials.trial import PARAMETERS_FILE

# What the paper quotes, without and with bias.
PAPER_FIGURES = {
    "mean moment RMSE [N m]": (1.69, 0.44),
    "median local RMSE [N]": (90.07, 3.76),
    "RMSE of Mx [N m]": (3.99, 0.95),
}

# The sections of the page, titles by their ids.
CONTENTS = {
    "summary": "Summary",
    "pressure": "Pressure",
    "wrench": "Wrench",
    "local": "Local forces",
    "paper-section": "The paper",
    "errors-section": "Errors",
    "validation": "Validation",
    "fronts": "Pareto fronts",
    "surface": "Surface",
    "quality": "Data quality",
    "certificates": "Certificates",
    "provenance": "Provenance",
}

_TRUTH = "tiles without a sensor (simulated truth)"
_MEASURES = {"RMSE": "rmse", "MAE": "mae", "sigma": "sigma", "skill [-]": "skill"}
_LIBRARIES = ("socket_testbed", "numpy", "scipy", "osqp", "qpsolvers", "matplotlib", "plotly")
_DIGEST = 16  # hexadecimal digits: enough to tell files apart
_MOST_GAPS = 5  # in the list


def page_content(results: Results, command: str, made: datetime) -> dict[str, Any]:
    """What `report.html` names, but for its title, its figures and its scene.

    Args:
        results: The results.
        command: The command line, for the record.
        made: When the report is made.
    """
    triggers, gaps = _triggers(results)
    origin = provenance(results, command, made)
    tables = [
        *pressure_tables(results.pressure, results.trial.geometry),
        _beside_the_paper(results),
        _errors(
            results,
            "errors",
            "Errors over the segment (in-sample), in the unit of the channel",
            [candidate.errors for candidate in results.candidates],
        ),
        _plateaus(results),
        _drop_outs(results),
        _noise(results),
        _residuals(results),
        _shares(results),
        _certificates(results),
        pairs_table("provenance-table", "What the report was made from and with", origin),
        pairs_table("settings", "Settings by their names in parameters.yaml", _settings(results)),
    ]
    held_out = [candidate.held_out for candidate in results.candidates]
    if all(held_out):
        caption = "Errors over the rest of the trial (held-out), in the unit of the channel"
        tables.append(_errors(results, "held-out", caption, held_out))
    if results.fronts:
        tables.append(_marks(results))
    tables += _validation(results)
    return {
        "contents": CONTENTS,
        "metadata": results.trial.metadata.described(),
        "threshold": 1e-3 * THRESHOLD,
        "share": 100.0 * SHARE,
        "source": results.pressure.outputs.source,
        "summary": summarise(results),
        "notes": list_notes(results),
        "tables": {table.name: table for table in tables},
        "verdicts": [f"{name}: {front.knee.verdict}." for name, front in results.fronts.items()],
        "no_fronts": results.no_fronts,
        "triggers": triggers,
        "gaps": gaps,
        "choice": _choice(results),
        "limits": results.settings.plateau,
        "solver_tolerance": results.settings.identification.solver_tolerance,
        "certificates": _certificate_lines(results),
        "no_validation": results.no_validation,
        "directions": results.motion.directions,
        "least_ratio": LEAST_RATIO,
        "motion": [str(excitation) for excitation in results.motion.excitations],
        "known": [
            f"{candidate.label}: {number(candidate.known, '.1f')} of"
            f" {candidate.model.stiffness.size} stiffness directions."
            for candidate in results.candidates
        ],
        "known_to": results.settings.identification.stiffness_difference,
    }


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


def _beside_the_paper(results: Results) -> Table:
    fitted = [results.fitted[variant] for variant in PAPER_VARIANTS]
    summaries = [summarise_errors(candidate.errors) for candidate in fitted]
    own = (
        [summary.moment_rmse for summary in summaries],
        [summary.local_rmse for summary in summaries],
        [candidate.errors[0].rmse for candidate in fitted],
    )
    nothing = [np.nan, np.nan]
    rows = {
        name: [*ours, *theirs]
        for (name, theirs), ours in zip(PAPER_FIGURES.items(), own, strict=True)
    }
    unsteady = [summary.local_unsteadiness for summary in summaries]
    rows["sigma / RMSE of all local forces [-]"] = [*unsteady, *nothing]
    if results.fronts:
        depths = [front.knee.depth for front in results.fronts.values()]
        rows["depth of the front's knee [-]"] = [*depths, *nothing]
    variants = ("without bias", "with bias")
    frame = pd.DataFrame.from_dict(rows, orient="index")
    frame.columns = pd.MultiIndex.from_product([("this trial", "the paper"), variants])
    frame.index.name = "figure"
    caption = "The figures that the paper quotes, for its variants"
    return Table("paper", caption, frame, {"the paper": ".2f"})


def _errors(
    results: Results, name: str, caption: str, errors: Sequence[Sequence[ChannelErrors]]
) -> Table:
    """Errors of every model, a row per channel, and below them what the paper quotes."""
    rows = {
        of_channel[0].name: [
            of_channel[0].unit,
            *(getattr(error, field) for error in of_channel for field in _MEASURES.values()),
            _remark(results, of_channel),
        ]
        for of_channel in zip(*errors, strict=True)
    }
    summaries = [summarise_errors(of_model) for of_model in errors]
    none = [np.nan] * 3
    for title, unit, field in (
        ("mean of the moments", "N m", "moment_rmse"),
        ("mean of the forces", "N", "force_rmse"),
        ("median of the local forces", "N", "local_rmse"),
    ):
        cells = [cell for summary in summaries for cell in (getattr(summary, field), *none)]
        rows[title] = [unit, *cells, ""]
    skills = [cell for summary in summaries for cell in (*none, summary.skill)]
    rows["median of all channels"] = ["-", *skills, ""]
    frame = pd.DataFrame.from_dict(rows, orient="index")
    frame.columns = pd.MultiIndex.from_tuples(
        [
            ("", "unit"),
            *((candidate.label, title) for candidate in results.candidates for title in _MEASURES),
            ("", "remark"),
        ]
    )
    frame.index.name = "channel"
    return Table(name, caption, frame)


def _remark(results: Results, errors: Sequence[ChannelErrors]) -> str:
    """Which models' fits did not see a channel."""
    pairs = zip(results.candidates, errors, strict=True)
    left_out = [candidate.label for candidate, error in pairs if not error.in_objective]
    if len(left_out) in (0, len(errors)):
        return "not in objective" if left_out else ""
    return f"not in objective of {', '.join(left_out)}"


def _marks(results: Results) -> Table:
    rows = []
    for front in results.fronts.values():
        for name in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
            row: dict[str, Any] = {"variant": front.variant, "solution": name, "remark": "none"}
            index = front.marks.get(name)
            if index is not None:
                row |= {
                    "theta [-]": front.theta[index],
                    "wrench error [-]": front.wrench_error[index],
                    "local error [-]": front.local_error[index],
                    "mean moment RMSE [N m]": front.moment_rmse[index],
                    "mean force RMSE [N]": front.force_rmse[index],
                    "median local RMSE [N]": front.local_rmse[index],
                    "remark": "" if front.non_dominated[index] else "dominated",
                }
            rows.append(row)
    frame = pd.DataFrame(rows).set_index("variant")
    frame["remark"] = frame.pop("remark")  # the last column
    formats = {"theta [-]": ".3g", "wrench error [-]": ".4g", "local error [-]": ".4g"}
    return Table("marks", "The solutions that stand out on each front", frame, formats)


def _validation(results: Results) -> list[Table]:
    """Forces on left-out clusters and bare tiles, and the wrench from the pose alone."""
    if not results.validation:
        return []
    summary = summarise_judgements(results.validation)
    percent = {f"within {100 * level:g} % [-]": f"in {100 * level:g} % [%]" for level in LEVELS}
    forces = summary[["error [-]", *percent]].rename(columns=percent)
    forces[[*percent.values()]] *= 100.0
    figures = [title for title in summary if title.startswith(("moment", "force"))]
    formats = {"error [-]": ".2f", **dict.fromkeys(percent.values(), ".0f")}
    skills = {title: "z.2f" for title in figures if "skill" in title}
    return [
        _side_by_side(
            "validation-forces",
            "Forces estimated without having seen them",
            {"a cluster left out": ("cluster", "left out"), _TRUTH: ("tiles", "second half")},
            forces,
            formats,
        ),
        _side_by_side(
            "validation-wrench",
            "The wrench predicted from the pose alone, fitted on the first half under load",
            {
                "the other half": ("wrench", "second half"),
                "the half that was fitted (in-sample)": ("wrench", "in-sample"),
            },
            summary[figures],
            skills,
        ),
    ]


def _side_by_side(
    name: str,
    caption: str,
    groups: dict[str, tuple[str, str]],
    summary: pd.DataFrame,
    formats: dict[str, str],
) -> Table:
    """A row per predictor, a group of columns per question and test that was answered."""
    parts = {
        title: summary[[place == key for place in summary.index.droplevel("predictor")]]
        for title, key in groups.items()
    }
    parts = {title: part.droplevel([0, 1]) for title, part in parts.items() if len(part)}
    longest = max(parts.values(), key=len)
    return Table(name, caption, pd.concat(parts, axis=1).reindex(longest.index), formats)


def _shares(results: Results) -> Table:
    columns = {
        (candidate.label, f"{part} [%]"): [
            100.0 * getattr(share, part) for share in candidate.shares
        ]
        for candidate in results.candidates
        for part in ("springs", "offsets", "residual")
    }
    names = [share.name for share in results.candidates[0].shares]
    frame = pd.DataFrame(columns, index=pd.Index(names, name="measured"))
    formats = dict.fromkeys((title for _, title in columns), ".0f")
    return Table("shares", "Who bears the measured load over the segment", frame, formats)


def _certificates(results: Results) -> Table:
    rows = [
        {
            "variant": label,
            "stage": stage,
            "bound violation [-]": solution.certificate.primal,
            "stationarity [-]": solution.certificate.stationarity,
            "duality gap [-]": solution.certificate.gap,
            "found by": solution.found_by,
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


def _triggers(results: Results) -> tuple[str, list[str]]:
    """The triggers in a sentence, and their longest gaps."""
    triggers = describe_triggers(results.samples)
    rate = 1.0 / triggers.period if triggers.period > 0.0 else np.nan
    text = (
        f"{triggers.count} samples in {triggers.duration:.2f} s at {number(rate)} Hz,"
        f" {triggers.complete} with a wrench and a limb position;"
        f" {counted(len(triggers.gaps), 'gap')} longer than one and a half periods"
    )
    gaps = [f"{gap.duration:.3f} s from {gap.start:.2f} s" for gap in triggers.gaps[:_MOST_GAPS]]
    more = len(triggers.gaps) - len(gaps)
    if more:
        gaps.append(f"and {more} shorter ones")
    return text + (", the longest:" if gaps else "."), gaps


def _choice(results: Results) -> str:
    """Why this segment."""
    found = len(results.plateaus)
    if results.specification != "plateau":
        return (
            f"The segment was asked for as '{results.specification}'; the trial has"
            f" {counted(found, 'plateau')}."
        )
    chosen = results.plateaus[0]
    others = f"the longest of {found}" if found > 1 else "the only one"
    return (
        f"The plateau from {chosen.start:.2f} s to {chosen.end:.2f} s was chosen because it is"
        f" {others}."
    )


def _plateaus(results: Results) -> Table:
    listed = [*results.plateaus]
    if results.segment not in listed:
        listed.insert(0, results.segment)
    rows = []
    for part in listed:
        load = measure_steadiness(results.samples[part.rows])
        rows.append(
            {
                "from, to [s]": f"{part.start:.2f} to {part.end:.2f}",
                "duration [s]": part.end - part.start,
                "mean force [N]": load.force,
                "its sigma [N]": load.force_sigma,
                "mean moment [N m]": load.moment,
                "its sigma [N m]": load.moment_sigma,
                "remark": "in use" if part == results.segment else "",
            }
        )
    formats = {"mean force [N]": ".1f", "its sigma [N m]": ".3f"}
    formats = dict.fromkeys(rows[0], ".2f") | formats
    frame = pd.DataFrame(rows).set_index("from, to [s]")
    return Table("plateaus", "The plateaus, the longest first", frame, formats)


def _drop_outs(results: Results) -> Table:
    frame = find_drop_outs(results.samples, results.segment)
    formats = dict.fromkeys(frame, ".0f") | {"missing [%]": ".2f", "longest [s]": ".2f"}
    return Table("drop-outs", "Samples of the trial without a measurement", frame, formats)


def _noise(results: Results) -> Table:
    samples = results.samples
    frame = pd.DataFrame.from_dict(
        noise_groups(channel_noise(samples), samples.clusters), "index", columns=["x", "y", "z"]
    ).rename_axis("measurement")
    caption = "Standard deviation of the noise of one sample, along each axis"
    return Table("noise", caption, frame, dict.fromkeys(frame, ".2g"))


def _residuals(results: Results) -> Table:
    formats = {"lag-1 [-]": "z.2f", "decorrelation [s]": ".2f", "effective [1]": ".0f"}
    columns = {
        (candidate.label, title): [getattr(common, field) for common in candidate.residuals]
        for candidate in results.candidates
        for title, field in zip(formats, ("lag_one", "decorrelation", "effective"), strict=True)
    }
    frame = pd.DataFrame(columns, index=pd.Index(results.samples.channels, name="channel"))
    caption = "What the residuals of each channel have in common"
    return Table("residuals", caption, frame, formats)
