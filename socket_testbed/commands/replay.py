"""`replay`: publish a trial with /clock, with the estimator if wanted."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed.commands.options import (
    CHOICES,
    add_identification,
    add_trial,
    estimator_settings,
    trial_of,
)
from socket_testbed.commands.status_line import StatusLine
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError
from socket_testbed.live.bringup import predict_with, replay_nodes
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.settings.testbed import ReplaySettings
from socket_testbed.trials.reprocess import RECORDED
from socket_testbed.trials.trial import Trial, recorded_namespace

_ESTIMATING = ("model", "geometry", "calibration", "load_cell", "tare", "params", *CHOICES)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_identification(parser)
    parser.add_argument(
        "--rate", type=float, default=1.0, metavar="X", help="speed against the recording"
    )
    parser.add_argument("--loop", action="store_true", help="start again at the end")
    parser.add_argument("--paused", action="store_true", help="start paused: the space bar goes on")
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
    nodes = _nodes(options, trial, replay)
    namespace = recorded_namespace(trial)
    with trial.open() as bag:  # a trial that cannot be read is named before any node starts
        duration = bag.duration
    pause = f"{nodes[-1].namespace.rstrip('/')}/replay/pause"
    with (
        StatusLine(duration=duration, pause=pause, paused=options.paused) as status,
        Graph(status.output, status.renew) as graph,
    ):
        graph.start_nodes(nodes)
        status.follow(namespace)
        graph.wait("replay_node")


def _nodes(options: argparse.Namespace, trial: Trial, replay: ReplaySettings) -> list[GraphNode]:
    """The nodes of the graph, the replay node last."""
    if not options.estimate:
        for name, value in vars(options).items():
            if name in _ESTIMATING and value not in (None, RECORDED):
                option = name.replace("_", "-")
                raise ConfigurationError(f"--{option} is for the estimator", "add --estimate")
        return [GraphNode("replay_node", replay)]
    settings = estimator_settings(options, trial.estimator)
    if options.model is not None:
        settings = predict_with(options.model, settings, trial.geometry)
    return replay_nodes(trial, replay, settings)
