"""`replay`: publish a trial with /clock, with the estimator if wanted."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import IO

from socket_testbed.commands.options import (
    add_identification,
    add_trial,
    estimator_settings,
    trial_of,
)
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_number
from socket_testbed.identification.fit import check_names
from socket_testbed.identification.model_file import read_model
from socket_testbed.live.processes import Graph
from socket_testbed.settings.testbed import (
    CalibrationNodeSettings,
    EstimatorSettings,
    ReplaySettings,
)
from socket_testbed.trials.synchronise import check_trial
from socket_testbed.trials.trial import (
    Trial,
    recorded_namespace,
)

_ESTIMATING = ("calibration_node", "estimator_node")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_identification(parser)
    parser.add_argument(
        "--rate", type=float, default=1.0, metavar="X", help="speed against the recording"
    )
    parser.add_argument("--loop", action="store_true", help="start again at the end")
    parser.add_argument("--paused", action="store_true", help="start paused (replay/pause)")
    parser.add_argument(
        "--estimate", action="store_true", help="run the calibration and estimator nodes too"
    )
    parser.add_argument(
        "--model",
        type=Path,
        metavar="MODEL",
        help="predict with this model and fit none",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Replay until the end of the trial."""
    check_number(options.rate, "--rate", 1e-3, 1e4)
    trial = trial_of(options)
    replay = ReplaySettings(
        trial=str(trial.path.resolve()),
        rate=options.rate,
        loop=options.loop,
        paused=options.paused,
    )
    if not options.estimate:
        if options.model is not None:
            raise ConfigurationError("--model is for the estimator", "add --estimate")
        with trial.open():
            pass  # a trial that cannot be read is named before any node starts
        with Graph() as graph:
            graph.start("replay_node", replay)
            graph.wait("replay_node")
        return
    settings = estimator_settings(options, trial.estimator)
    if options.model is not None:
        read_model(options.model)
        model = str(options.model.resolve())
        settings = dataclasses.replace(settings, model=model, auto_fit=False)
    replay_with_estimator(trial, replay, settings)


def replay_with_estimator(
    trial: Trial,
    replay: ReplaySettings,
    estimator: EstimatorSettings,
    output: IO[str] | None = None,
) -> None:
    """Replay a trial through the calibration and estimator nodes.

    Args:
        trial: The trial; its geometry and calibration are used.
        replay: How it is replayed.
        estimator: Settings of the estimator.
        output: Where the nodes print to; None for this process's own output.

    Raises:
        TestbedError: If the trial or its configuration is wrong, or a node fails.
    """
    # What is wrong with the files is named here, in one line, before any node starts.
    clusters = check_trial(trial)
    check_names(estimator.identification, clusters)
    namespace = recorded_namespace(trial)
    calibration = CalibrationNodeSettings(calibration=str(trial.calibration_path.resolve()))
    estimator = dataclasses.replace(estimator, geometry=str(trial.geometry_path.resolve()))
    wait_for = (*_ESTIMATING, *replay.wait_for)
    replay = dataclasses.replace(replay, measured_only=True, wait_for=wait_for)
    with Graph(output) as graph:
        graph.start("calibration_node", calibration, namespace, use_sim_time=True)
        graph.start("estimator_node", estimator, namespace, use_sim_time=True)
        graph.start("replay_node", replay)
        graph.wait("replay_node")
