"""Arguments that several verbs share, and what they mean."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from functools import cache
from pathlib import Path

from socket_testbed.batch.pool import Pool
from socket_testbed.files import check_number
from socket_testbed.settings.identification import VARIANTS
from socket_testbed.settings.testbed import EstimatorSettings, read_testbed
from socket_testbed.trials.synchronise import parse_unloaded
from socket_testbed.trials.trial import Trial


def add_trial(parser: argparse.ArgumentParser, what: str = "folder of the trial") -> None:
    """A trial and what is used instead of the configuration stored in it."""
    parser.add_argument("trial", type=Path, metavar="TRIAL", help=what)
    parser.add_argument(
        "--geometry", type=Path, metavar="SOCKET.yaml", help="instead of the trial's socket.yaml"
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="CALIBRATION.yaml",
        help="instead of the trial's calibration.yaml",
    )


def add_trials(parser: argparse.ArgumentParser) -> None:
    """A trial, or a folder of trials and how they are worked on."""
    add_trial(parser, "folder of the trial, or a folder of trials")
    many = parser.add_argument_group("for a folder of trials")
    where = many.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=int, metavar="N", help="trials at a time (default: one a core)"
    )
    where.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster whose workers do it instead"
    )
    many.add_argument("--again", action="store_true", help="do again what is done already")


def pool_of(options: argparse.Namespace) -> Pool:
    """Where the trials of a folder are worked on."""
    if options.jobs is not None:
        check_number(options.jobs, "--jobs", 1)
    return Pool(options.jobs, options.dask)


def absolute_paths(options: argparse.Namespace) -> argparse.Namespace:
    """The same options for a worker that has another working directory."""
    return argparse.Namespace(
        **{
            name: value.absolute() if isinstance(value, Path) else value
            for name, value in vars(options).items()
        }
    )


def trial_of(options: argparse.Namespace) -> Trial:
    """The trial that is meant; each note on it goes to standard error once."""
    spans = getattr(options, "unloaded", None) or []
    return Trial(
        options.trial,
        options.geometry,
        options.calibration,
        cache(tell_note),
        parse_unloaded(spans),
    )


def tell_note(note: str) -> None:
    """Print a note on standard error."""
    warn(f"note: {note}")


def say(line: str) -> None:
    """Print a line on standard output at once, however it is buffered."""
    print(line, flush=True)


def warn(line: str) -> None:
    """Print a line on standard error."""
    print(line, file=sys.stderr)


def add_segment(parser: argparse.ArgumentParser, default: str = "plateau") -> None:
    """The segment of a trial."""
    parser.add_argument(
        "--segment",
        default=default,
        metavar="plateau|all|T0:T1",
        help="the plateau, all of the trial, or seconds since its first sample"
        f" (default: {default})",
    )


def add_unloaded(parser: argparse.ArgumentParser) -> None:
    """Spans without load."""
    parser.add_argument(
        "--unloaded",
        nargs="+",
        metavar="T0:T1",
        help="seconds without load before, and after: the clusters' drift is taken off by them",
    )


def add_identification(
    parser: argparse.ArgumentParser, variant: bool = True, theta: bool = True
) -> None:
    """Settings of the identification; what is not given comes from the trial's testbed.yaml."""
    add_model_choice(parser, variant, theta)
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )


def add_model_choice(
    parser: argparse.ArgumentParser, variant: bool = True, theta: bool = True
) -> None:
    """Settings of the identification that are often chosen for one run.

    Args:
        parser: The verb's parser.
        variant: Whether the verb leaves the choice of the variant.
        theta: Whether it leaves the choice of theta.
    """
    if variant:
        parser.add_argument("--variant", choices=VARIANTS, help="which offsets the model carries")
    if theta:
        parser.add_argument(
            "--theta", type=float, help="weight of the wrench against the clusters, 0 to 1"
        )
    parser.add_argument(
        "--smoothness", type=float, help="weight of the smoothness over neighbouring tiles"
    )
    parser.add_argument(
        "--leave-out",
        nargs="+",
        metavar="CHANNEL",
        help="channels to leave out of the objective, such as distal.Fx or Mz",
    )
    parser.add_argument("--solver", help="any solver that qpsolvers finds (default: osqp)")


def estimator_settings(options: argparse.Namespace, stored: EstimatorSettings) -> EstimatorSettings:
    """The estimator's settings: the command line's over the file's over the stored ones."""
    if options.params is not None:
        stored = read_testbed(options.params).estimator_node
    return choose_model(options, stored)


def choose_model(options: argparse.Namespace, settings: EstimatorSettings) -> EstimatorSettings:
    """The estimator's settings with what `add_model_choice` was given."""
    given = {
        name: value
        for name in ("variant", "theta", "smoothness", "leave_out", "solver")
        if (value := getattr(options, name, None)) is not None
    }
    identification = dataclasses.replace(settings.identification, **given)
    return dataclasses.replace(settings, identification=identification)
