"""`simulate`: write a simulated trial with its ground truth, without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

from socket_testbed import api
from socket_testbed.commands.text import Progress
from socket_testbed.simulation.limb import SCENARIOS, TISSUES
from socket_testbed.simulation.trial import TRUTH_FILE, read_truth


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the new trial"
    )
    parser.add_argument(
        "--scenario",
        choices=SCENARIOS,
        default="static_hold",
        help="load history (default: static_hold)",
    )
    parser.add_argument(
        "--tissue",
        choices=TISSUES,
        default="soft",
        help="of the limb: soft silicone as published, or stiff (default: soft)",
    )
    parser.add_argument(
        "--like-paper",
        action="store_true",
        help="errors as large as published: the load cell creeps and vibrates, clusters have"
        " offsets to 150 N",
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
    trial = api.simulate(
        options.output,
        options.scenario,
        tissue=options.tissue,
        like_paper=options.like_paper,
        duration=options.duration,
        rate=options.rate,
        seed=options.seed,
        geometry=options.geometry,
        calibration=options.calibration,
        progress=Progress,
    )
    geometry = trial.geometry
    print(
        f"{options.output}: {options.scenario}, {options.tissue} tissue,"
        f" {len(read_truth(trial.path).wrench)} triggers at {options.rate:g} Hz,"
        f" {len(geometry)} tiles, {len(geometry.clusters)} clusters,"
        f" seed {options.seed}; truth in {options.output / TRUTH_FILE}"
    )
