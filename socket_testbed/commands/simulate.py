"""`simulate`: write a simulated trial with its ground truth, without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed.calibration.model import read_calibration
from socket_testbed.commands.text import Progress
from socket_testbed.files import check_number, packaged, refuse_existing
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation.limb import SCENARIOS
from socket_testbed.simulation.trial import TRUTH_FILE, simulate, write_simulated_trial

_MOST_TRIGGERS = 1_000_000


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the new trial"
    )
    parser.add_argument(
        "--scenario",
        choices=SCENARIOS,
        default="static_hold",
        help="load history (default: the paper's static hold)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of all that is random")
    parser.add_argument(
        "--duration", type=float, default=120.0, metavar="S", help="duration [s] (default: 120)"
    )
    parser.add_argument(
        "--rate", type=float, default=4.0, metavar="HZ", help="trigger rate [Hz] (default: 4)"
    )
    parser.add_argument("--geometry", type=Path, metavar="SOCKET.yaml", help="another socket")
    parser.add_argument(
        "--calibration", type=Path, metavar="CALIBRATION.yaml", help="another calibration"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Simulate and write."""
    check_number(options.duration, "--duration", 1.0, 36000.0)
    check_number(options.rate, "--rate", 0.1, 1000.0)
    check_number(options.seed, "--seed", 0)
    check_number(options.duration * options.rate, "--duration times --rate", 2, _MOST_TRIGGERS)
    refuse_existing(options.output)
    geometry = read_socket(options.geometry or packaged("config", "socket.yaml"))
    calibration = read_calibration(options.calibration or packaged("config", "calibration.yaml"))
    trial = simulate(
        geometry,
        calibration,
        options.scenario,
        options.duration,
        options.rate,
        options.seed,
        progress=Progress("simulating"),
    )
    write_simulated_trial(trial, options.output, options.geometry, options.calibration)
    print(
        f"{options.output}: {options.scenario}, {len(trial.stamps)} triggers at"
        f" {options.rate:g} Hz, {len(geometry)} tiles, {len(geometry.clusters)} clusters,"
        f" seed {options.seed}; truth in {options.output / TRUTH_FILE}"
    )
