"""The summary: numbers in fixed sentences, and what a reader must know before using them."""

from __future__ import annotations

import numpy as np

from socket_testbed.identification.evaluation import summarise_errors
from socket_testbed.identification.information import share_warning
from socket_testbed.report.page import Bullets, Heading, Section, number
from socket_testbed.report.results import Candidate, Results
from socket_testbed.report.sections.pressure import describe_pressure
from socket_testbed.report.sections.quality import find_gaps, mean_and_sigma


def section(results: Results) -> Section:
    """The section with the summary and the notes."""
    notes = list_notes(results)
    listed = [Heading("Notes"), Bullets(notes, "notes")] if notes else []
    return Section("summary", "Summary", [Bullets(summarise(results)), *listed])


def summarise(results: Results) -> list[str]:
    """What was found: a statement each on pressure, data, every model, and the fronts."""
    wrench = results.samples.wrench[results.segment.rows]
    (force, _), (moment, _) = mean_and_sigma(wrench[:, 3:]), mean_and_sigma(wrench[:, :3])
    fronts = "; ".join(f"{name}, {front.knee.verdict}" for name, front in results.fronts.items())
    return [
        describe_pressure(results.pressure, results.trial.geometry),
        f"Fitted to the segment, {results.segment}: {int(results.in_segment.sum())} of"
        f" {len(results.samples)} samples, mean force {number(force)} N, mean moment"
        f" {number(moment)} N m. Errors over it are in-sample, those over the rest held-out.",
        *(_describe(candidate) for candidate in results.candidates),
        f"Trade-off between wrench and clusters, in normalised errors: {fronts or 'none'}.",
    ]


def _describe(candidate: Candidate) -> str:
    """Errors of a model, and what it rests on."""
    model, parts = candidate.model, []
    for title, errors in (("in-sample", candidate.errors), ("held-out", candidate.held_out)):
        if errors:
            found = summarise_errors(errors)
            parts.append(
                f"{title} the mean RMSE of the moments {number(found.moment_rmse)} N m and of the"
                f" forces {number(found.force_rmse)} N, the median RMSE of the local forces"
                f" {number(found.local_rmse)} N, the median skill {number(found.skill, 'z.2f')}"
            )
    offset = float(np.linalg.norm(model.wrench_bias[3:]))
    if offset > 0.0:
        parts.append(f"its constant force, which no tile bears, {number(offset)} N")
    if candidate.fit is not None:
        parts.append(
            f"the data determine {candidate.fit.determined:.0f} of {model.stiffness.size}"
            " stiffness directions, the smoothness the others"
        )
    return f"{candidate.label}: {'; '.join(parts)}."


def list_notes(results: Results) -> list[str]:
    """What a reader must know of the trial before using the figures."""
    warnings = {c.label: share_warning(c.shares) for c in results.candidates}
    return [
        *results.bag_notes,
        *_implausible(results),
        *_gaps(results),
        *(f"{label}: {warning}." for label, warning in warnings.items() if warning),
        *_configuration(results),
    ]


def _implausible(results: Results) -> list[str]:
    left_out = results.settings.identification.leave_out
    return [
        f"{found.channel} looks implausible: {found.reason}. "
        + (
            "It was left out of the objective."
            if found.channel in left_out
            else f"It is in the objective; --leave-out {found.channel} leaves it out."
        )
        for found in results.implausible
    ]


def _gaps(results: Results) -> list[str]:
    lines = []
    gaps = find_gaps(results.samples.time)
    if gaps:
        lines.append(
            f"Gaps of the triggers: {len(gaps)}, the longest of {gaps[0][1]:.2f} s after"
            f" {gaps[0][0]:.2f} s."
        )
    inside = int(results.in_segment.sum())
    unfitted = inside - max(fit.samples for fit in results.fits.values())
    if unfitted:
        lines.append(
            f"{unfitted} of the segment's {inside} samples are in no fit: they lack the limb"
            " position or a channel of the wrench that is in the objective."
        )
    return lines


def _configuration(results: Results) -> list[str]:
    geometry = results.trial.geometry
    lines = []
    if results.pressure.side is None:
        lines.append(
            "No side of the leg is stated: regions are left and right, not medial and lateral."
            f" 'annotate {results.trial.name} --side left|right' states it."
        )
    if not geometry.registration:
        lines.append(
            "The marker bodies are not registered with the socket: their placement in socket.yaml"
            " is nominal, and every limb position rests on it."
        )
    bare = [name for name in geometry.clusters if name not in results.samples.clusters]
    if bare:
        lines.append(f"No reading of the clusters {', '.join(bare)} is in this trial.")
    dead = summarise_errors(results.candidates[0].errors).without_value
    if dead:
        lines.append(f"Never measured over the segment: {', '.join(dead)}.")
    return lines
