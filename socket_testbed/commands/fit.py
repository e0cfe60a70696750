"""`fit`: identify the contact model on a segment of a trial, or of every trial of a folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed import api
from socket_testbed.api import TrialFit
from socket_testbed.batch import Row
from socket_testbed.commands.options import (
    CHOICES,
    TrialVerb,
    add_identification,
    add_pose_smoothing,
    add_replace,
    add_segment,
    add_stage_one,
    add_trials,
    add_unloaded,
    choices,
)
from socket_testbed.commands.text import (
    error_columns,
    errors_table,
    number,
    segment_columns,
    skill_columns,
)
from socket_testbed.errors import IdentificationError
from socket_testbed.identification.evaluation import ChannelErrors
from socket_testbed.identification.information import LEAST_RATIO, share_warning
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.trials.trial import Trial


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trials(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_identification(parser)
    add_pose_smoothing(parser)
    add_stage_one(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="MODEL",
        help="file of the model, or the folder of the models of a folder of trials",
    )
    add_replace(parser)
    settings = ("segment", "unloaded", *CHOICES)
    parser.set_defaults(run=TrialVerb("fit", ".json", settings, _fit, _row, _show).run)


def _fit(options: argparse.Namespace, trial: Trial) -> TrialFit:
    found = api.fit(trial, options.segment, **choices(options))
    found.save(options.output)
    return found


def _show(options: argparse.Namespace, found: TrialFit) -> None:
    fit = found.fit
    samples = f"{fit.samples} of {len(found.trial.samples())} samples"
    print(f"{found.trial.name}: {found.segment}, {samples}")
    size = fit.model.stiffness.size
    print(
        f"variant {fit.model.variant}, theta {fit.settings.theta:g}, weights by"
        f" {fit.settings.weights}; the data determine {fit.determined:.0f} of {size} stiffness"
        " directions, the smoothness the others"
    )
    if fit.model.variant in PAPER_VARIANTS:
        print(f"stiffness k0 of Stage 1: {fit.settings.initial_stiffness:.4g} N/m")
    print(fit.status)
    print()
    print(errors_table(fit.errors))
    print()
    print(_information(found))
    print(f"\nmodel in {options.output}")


def _information(found: TrialFit) -> str:
    """Who bears the load, what the data show, and which motion they hold."""
    shares = found.load_shares()
    motion = found.motion()
    lines = [
        "share of the measured load that the springs bear: "
        + ", ".join(f"{share.name} {number(100 * share.springs, 0)} %" for share in shares)
    ]
    warning = share_warning(shares)
    lines += [f"warning: {warning}"] if warning else []
    lines.append(
        f"despite all noise, {number(found.known_directions(), 1)} of"
        f" {found.fit.model.stiffness.size} stiffness directions are known to"
        f" {found.fit.settings.stiffness_difference:g} N/m or better"
    )
    lines.append(
        f"the pose moves by {LEAST_RATIO:g} times its noise or more in {motion.directions} of 6"
        " independent directions"
    )
    return "\n".join([*lines, *(f"  {excitation}" for excitation in motion.excitations)])


def _unseen_half(found: TrialFit) -> tuple[ChannelErrors, ...]:
    try:
        return found.unseen_half()
    except IdentificationError as error:
        if found.trial.notify is not None:
            found.trial.notify(f"no skill on an unseen half: {error}")
        return ()


def _row(found: TrialFit) -> Row:
    fit = found.fit
    solutions = (fit.stage_one, fit.stage_two, fit.joint)
    certificates = [solution.certificate for solution in solutions if solution is not None]
    return {
        "samples": fit.samples,
        **segment_columns(found.segment),
        "variant": fit.model.variant,
        "theta [-]": fit.settings.theta,
        "force_on_springs [-]": finite_or_null(found.load_shares()[1].springs),
        "kkt_residual [-]": max(c.stationarity for c in certificates),
        "duality_gap [-]": max(c.gap for c in certificates),
        **error_columns(
            fit.errors,
            skill_columns(fit.errors, "_in_sample")
            | skill_columns(_unseen_half(found), "_unseen_half"),
        ),
    }
