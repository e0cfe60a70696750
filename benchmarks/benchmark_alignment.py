"""Wrench and pose of foreign sources at triggers, against the truth and our own drivers.

Usage:
    python benchmarks/benchmark_alignment.py [--seeds 1 2 3] [--duration 60]

Foreign sources: a wrench at 500 Hz whose stamps are 20 ms and up to 3 ms more late, poses at 100 Hz
by a clock that drifts by 50 ppm. Our own drivers average a wrench at 500 Hz and frames at 240 Hz
with exact stamps. An error is the root mean square over the triggers, of a force, and of the
position of the limb in the socket's body. Then the error by a delay that is not corrected and by
the jitter of the stamps.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation import sensors
from socket_testbed.simulation.trial import SimulatedTrial, simulate

sys.path.append(str(Path(__file__).parents[1] / "test"))
from support.foreign import OUR_LAB, ForeignLab, errors_of

_RATES = 4.0, 25.0  # [Hz]; of the triggers
_DELAYS = 0.0, 0.005, 0.01, 0.02, 0.05  # [s]
_JITTERS = 0.0, 0.003, 0.01, 0.03  # [s]
_SIMULATED = 50.0  # [Hz]; between which the truth is linear


def main() -> None:
    """Simulate, align and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--duration", type=float, default=60.0, help="of each trial [s]")
    arguments = parser.parse_args()
    trials = {seed: _simulated(seed, arguments.duration) for seed in arguments.seeds}
    slow = replace(OUR_LAB, pose_rate=ForeignLab.pose_rate)
    print("| triggers | | our drivers | foreign | ratio |")
    print("|---|---|---|---|---|")
    for rate in _RATES:
        ours, slower, theirs = (
            _mean_errors(trials, lab, rate) for lab in (OUR_LAB, slow, ForeignLab())
        )
        for name, column, own, unit in (
            ("force", 0, ours, "N"),
            ("position", 1, ours, "um"),
            ("position, our cameras at 100 Hz", 1, slower, "um"),
        ):
            print(
                f"| {rate:g} Hz | {name} | {own[column]:.3g} {unit} | {theirs[column]:.3g} {unit}"
                f" | {theirs[column] / own[column]:.2f} |"
            )
    print(
        "\n| triggers | delay left",
        *(f"jitter {1e3 * j:g} ms" for j in _JITTERS),
        sep=" | ",
        end=" |\n",
    )
    print("|---" * (2 + len(_JITTERS)) + "|")
    for rate in _RATES:
        for delay in _DELAYS:
            cells = []
            for jitter in _JITTERS:
                lab = replace(ForeignLab(), wrench_delay=delay, jitter=jitter)
                error = _mean_errors(trials, lab, rate, corrected=0.5 * jitter)[0]
                cells.append(f"{error:.2f} N")
            print(f"| {rate:g} Hz | {1e3 * delay:g} ms | " + " | ".join(cells) + " |")


def _simulated(seed: int, duration: float) -> SimulatedTrial:
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    errors = sensors.SensorErrors(force_offset=0.0, moment_offset=0.0)
    return simulate(geometry, calibration, "protocol", duration, _SIMULATED, seed, errors)


def _mean_errors(
    trials: dict[int, SimulatedTrial],
    lab: ForeignLab,
    rate: float,
    corrected: float | None = None,
) -> FloatArray:
    """Errors of a force [N] and of the limb's position [um] over all trials, shape (2,)."""
    squares = [errors_of(trial, lab, rate, seed, corrected) ** 2 for seed, trial in trials.items()]
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


if __name__ == "__main__":
    main()
