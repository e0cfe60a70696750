"""What was found in a trial and how far to trust it, in words with numbers."""

from __future__ import annotations

import math

import numpy as np

from socket_testbed.identification.evaluation import summarise_errors
from socket_testbed.identification.information import share_warning
from socket_testbed.identification.pareto import Front
from socket_testbed.report.page import counted, number
from socket_testbed.report.pressure import describe_pressure
from socket_testbed.report.results import (
    Candidate,
    Results,
    describe_triggers,
    effective_samples,
    measure_steadiness,
)
from socket_testbed.settings.identification import PAPER_VARIANTS, Variant

_LITTLE_SKILL = 0.1  # [-]; below it, a model says no more than a mean
_STEADY = 0.5  # [-]; sigma over RMSE, below which residuals are mostly an offset
_COLLAPSE = 2.0  # [-]; of the fronts' sizes
_FEW = 0.5  # [-]; of the directions, below which the smoothness decides most
_PLAIN: Variant = "stiffness"
_BIAS: Variant = "stiffness_bias"


def summarise(results: Results) -> list[str]:
    """Four to seven statements: what was found, and how far to trust it."""
    plain, bias = results.fitted[_PLAIN], results.fitted[_BIAS]
    other = _beside_the_paper(results)
    lines = [
        describe_pressure(results.pressure, results.trial.geometry),
        _what(results),
        _offsets(results, plain, bias, other),
        _skill(bias),
        _trust(results, bias),
    ]
    if results.fronts:
        lines.append(_fronts(results.fronts[_PLAIN], results.fronts[_BIAS]))
    if bias.held_out:
        lines.append(_held_out(plain, bias, other))
    return lines


def list_notes(results: Results) -> list[str]:
    """What a reader must know of the trial before using the figures."""
    return [
        *results.bag_notes,
        *_implausible(results),
        *_gaps(results),
        *_unborne(results),
        *_configuration(results),
    ]


def _what(results: Results) -> str:
    load = measure_steadiness(results.samples[results.segment.rows])
    sizes = [(load.force, "force", "N"), (load.moment, "moment", "N m")]
    under = " and ".join(
        f"a mean {what} of {number(size)} {unit}"
        for size, what, unit in sizes
        if math.isfinite(size)
    )
    return (
        f"The variants {', '.join(results.fits)} were fitted to {results.fits[_BIAS].samples} of"
        f" {len(results.samples)} samples: {results.segment}{', under ' if under else ''}{under}."
        " Errors over this segment are in-sample."
    )


def _beside_the_paper(results: Results) -> Candidate | None:
    """The variant of the settings, if it was fitted beside the paper's."""
    others = [c for label, c in results.fitted.items() if label not in PAPER_VARIANTS]
    return others[0] if others else None


def _offsets(
    results: Results, without: Candidate, with_offsets: Candidate, other: Candidate | None
) -> str:
    plain, bias = summarise_errors(without.errors), summarise_errors(with_offsets.errors)
    share = plain.local_unsteadiness
    steady = "steady offsets" if share < _STEADY else "more than steady offsets"
    return (
        f"Without offsets the mean moment RMSE is {number(plain.moment_rmse)} N m, the mean"
        f" force RMSE {number(plain.force_rmse)} N and the median local RMSE"
        f" {number(plain.local_rmse)} N; over all clusters sigma is {number(share, '.2g')} of"
        f" the RMSE, so their residuals are {steady}. With one constant per channel these RMSE are"
        f" {number(bias.moment_rmse)} N m, {number(bias.force_rmse)} N and"
        f" {number(bias.local_rmse)} N." + _borne(results, with_offsets)
    ) + _by_the_pose(other)


def _by_the_pose(other: Candidate | None) -> str:
    """Errors of the variant of the settings beside the paper's."""
    if other is None:
        return ""
    errors = summarise_errors(other.errors)
    return (
        f" {other.label}, which reads the limb's complete pose, has"
        f" {number(errors.moment_rmse)} N m, {number(errors.force_rmse)} N and"
        f" {number(errors.local_rmse)} N."
    )


def _skill(bias: Candidate) -> str:
    skill = summarise_errors(bias.errors).skill
    known = [error.skill for error in bias.errors if math.isfinite(error.skill)]
    if not known:
        return "No channel varies over the segment, so no model can show skill."
    useful = sum(value >= _LITTLE_SKILL for value in known)
    start = (
        f"With offsets, the median skill is {number(skill, 'z.2f')} and {useful} of {len(known)}"
        f" channels reach {_LITTLE_SKILL:g}"
    )
    if skill < _LITTLE_SKILL:
        return (
            f"{start}: over this segment the model says hardly more of most channels than their"
            " mean. Where an RMSE is small, the constants make it so: it says nothing about forces"
            " under another load."
        )
    return f"{start}: the springs explain variation that no constant could."


def _borne(results: Results, bias: Candidate) -> str:
    """How much of the load the constants bear, which no tile does."""
    load = measure_steadiness(results.samples[results.segment.rows])
    offset = float(np.linalg.norm(bias.model.wrench_bias[3:]))
    beside = f", beside a mean force of {number(load.force)} N" * math.isfinite(load.force)
    return (
        f" The constant of the wrench's force is {number(offset)} N{beside}: no tile"
        " of the map bears that part."
    )


def _trust(results: Results, bias: Candidate) -> str:
    fit = results.fits[_BIAS]
    directions = bias.model.stiffness.size
    least, median = effective_samples(bias)
    few = fit.determined < _FEW * directions
    reading = (
        "the smoothness decides the others, so read the stiffness map as an assumption, not as a"
        " measurement"
        if few
        else "the smoothness decides the others"
    )
    text = (
        f"With offsets, the data determine {fit.determined:.0f} of {directions} stiffness"
        f" directions; {reading}."
    )
    if math.isfinite(median):
        text += (
            f" By the autocorrelation of the residuals the {fit.samples} samples are worth"
            f" {median:.0f} independent ones in the median channel, {least:.0f} in the worst."
        )
    return text


def _fronts(plain: Front, bias: Front) -> str:
    text = (
        "Trade-off between wrench and clusters, in normalised errors: without offsets,"
        f" {_knee(plain)}; with offsets, {_knee(bias)}."
    )
    extents = [float(np.hypot(*front.knee.span)) for front in (plain, bias)]
    if 0.0 < _COLLAPSE * extents[1] < extents[0]:
        times = float(number(extents[0] / extents[1], ".2g"))
        text += f" The offsets make the front {times:.0f} times smaller."
    return text


def _knee(front: Front) -> str:
    index = front.knee.index
    at = "" if index is None else f" (at theta {front.theta[index]:.3g})"
    return front.knee.verdict + at


def _held_out(plain: Candidate, bias: Candidate, other: Candidate | None) -> str:
    without, with_offsets = (summarise_errors(c.held_out) for c in (plain, bias))
    samples = max(error.samples for error in bias.held_out)
    return (
        f"On the other {samples} samples of the trial, which the fit has not seen, the mean moment"
        f" RMSE is {number(without.moment_rmse)} N m without and"
        f" {number(with_offsets.moment_rmse)} N m with offsets, the median local RMSE"
        f" {number(without.local_rmse)} N and {number(with_offsets.local_rmse)} N, the"
        f" median skill {number(without.skill, 'z.2f')} and {number(with_offsets.skill, 'z.2f')}."
        + _held_out_by_the_pose(other)
    )


def _held_out_by_the_pose(other: Candidate | None) -> str:
    if other is None or not other.held_out:
        return ""
    errors = summarise_errors(other.held_out)
    return (
        f" {other.label} has {number(errors.moment_rmse)} N m, {number(errors.local_rmse)} N and a"
        f" median skill of {number(errors.skill, 'z.2f')}."
    )


def _implausible(results: Results) -> list[str]:
    lines = []
    for proposal in results.implausible:
        name = proposal.channel
        left_out = name in results.settings.identification.leave_out
        state = (
            "It was left out of the objective."
            if left_out
            else f"It is in the objective all the same; --leave-out {name} leaves it out."
        )
        lines.append(f"{name} looks implausible: {proposal.reason}. {state}")
    return lines


def _unborne(results: Results) -> list[str]:
    warnings = {c.label: share_warning(c.shares) for c in results.candidates}
    return [f"{label}: {warning}." for label, warning in warnings.items() if warning]


def _gaps(results: Results) -> list[str]:
    triggers = describe_triggers(results.samples)
    lines = []
    if triggers.gaps:
        longest = triggers.gaps[0]
        lines.append(
            f"The triggers have {counted(len(triggers.gaps), 'gap')}, the longest of"
            f" {longest.duration:.2f} s after {longest.start:.2f} s."
        )
    fit = results.fits[_BIAS]
    inside = int(results.in_segment.sum())
    if fit.samples < inside:
        lines.append(
            f"{inside - fit.samples} of the segment's {inside} samples are in no fit: they lack the"
            " limb position or a channel of the wrench that is in the objective."
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
