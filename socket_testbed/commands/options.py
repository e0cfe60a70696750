"""Arguments that several verbs share, and what they mean."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from functools import cache
from pathlib import Path

from socket_testbed.contact import VARIANTS
from socket_testbed.settings import EstimatorSettings, read_parameters
from socket_testbed.trials.trial import Trial


def add_trial(parser: argparse.ArgumentParser) -> None:
    """A trial and what is used instead of the configuration stored in it."""
    parser.add_argument("trial", type=Path, metavar="TRIAL", help="folder of the trial")
    parser.add_argument(
        "--geometry", type=Path, metavar="SOCKET.yaml", help="instead of the trial's socket.yaml"
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="CALIBRATION.yaml",
        help="instead of the trial's calibration.yaml",
    )


def trial_of(options: argparse.Namespace) -> Trial:
    """The trial that is meant; each note on it goes to standard error once."""
    return Trial(options.trial, options.geometry, options.calibration, cache(_tell))


def _tell(note: str) -> None:
    print(f"note: {note}", file=sys.stderr)


def add_segment(parser: argparse.ArgumentParser) -> None:
    """The segment of a trial."""
    parser.add_argument(
        "--segment",
        default="plateau",
        metavar="plateau|all|T0:T1",
        help="the plateau (default), all of the trial, or seconds since its first sample",
    )


def add_identification(parser: argparse.ArgumentParser) -> None:
    """Settings of the identification; what is not given comes from the trial's testbed.yaml."""
    add_model_choice(parser)
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )


def add_model_choice(parser: argparse.ArgumentParser) -> None:
    """Settings of the identification that are often chosen for one run."""
    parser.add_argument("--variant", choices=VARIANTS, help="which offsets the model carries")
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
    settings = stored
    if options.params is not None:
        read = read_parameters(options.params).get("estimator_node", EstimatorSettings())
        assert isinstance(read, EstimatorSettings)
        settings = read
    return choose_model(options, settings)


def choose_model(options: argparse.Namespace, settings: EstimatorSettings) -> EstimatorSettings:
    """The estimator's settings with what `add_model_choice` was given."""
    given = {
        name: value
        for name in ("variant", "theta", "smoothness", "leave_out", "solver")
        if (value := getattr(options, name)) is not None
    }
    identification = dataclasses.replace(settings.identification, **given)
    return dataclasses.replace(settings, identification=identification)
