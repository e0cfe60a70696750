"""How time and memory of the verbs grow with a trial: 10 and 60 minutes at 100 Hz.

    .venv/bin/python benchmarks/benchmark_long_trials.py [MINUTES ...]

The trial is a simulated static hold of 2 minutes, repeated with its stamps going on; each verb is
a process of its own, and its peak memory what the kernel counted. The ratios are to the first of
the lengths: linear growth is the ratio of the lengths.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation.trial import SimulatedTrial, simulate, write_simulated_trial

RATE = 100.0  # [Hz]
PIECE = 120.0  # [s]


def repeat(trial: SimulatedTrial, times: int) -> SimulatedTrial:
    """The same trial again and again."""
    period = round(1e9 / RATE)
    count = len(trial.stamps) * times

    def again(array: np.ndarray) -> np.ndarray:
        return np.tile(array, (times, *([1] * (array.ndim - 1))))

    def poses(pose: Pose) -> Pose:
        return Pose(again(pose.rotation), again(pose.translation))

    truth = replace(
        trial.truth,
        **{name: again(getattr(trial.truth, name)) for name in ("wrench", "position", "rotation")},
        forces=np.zeros((count, 0, 3)),
    )
    return replace(
        trial,
        tiles=(),
        stamps=trial.stamps[0] + period * np.arange(count),
        capacitance={name: again(values) for name, values in trial.capacitance.items()},
        wrench=again(trial.wrench),
        socket_markers=again(trial.socket_markers),
        pylon_markers=again(trial.pylon_markers),
        socket_pose=poses(trial.socket_pose),
        pylon_pose=poses(trial.pylon_pose),
        truth=truth,
    )


def measure(words: list[str]) -> tuple[float, float]:
    """Seconds and peak memory [MB] of a verb."""
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-m", "socket_testbed", *words], stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(child.pid, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{words[0]} failed")
    return time.perf_counter() - start, usage.ru_maxrss / 1024.0


def main() -> None:
    """Measure and print."""
    minutes = [float(word) for word in sys.argv[1:]] or [10.0, 60.0]
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    piece = simulate(geometry, calibration, "static_hold", PIECE, RATE, seed=0)
    first: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for length in minutes:
            trial = Path(folder) / f"{length:g}min"
            times = max(1, round(60.0 * length / PIECE))
            write_simulated_trial(repeat(piece, times), trial)
            model = trial.with_suffix(".json")
            verbs = {
                "info": [],
                "fit": ["--segment", "all", "-o", str(model)],
                "evaluate": ["--segment", "all", "--model", str(model)],
                "export": ["-o", str(trial.with_suffix(".parquet"))],
                "report": ["--segment", "all", "-o", str(trial.with_suffix(".html"))],
            }
            for verb, words in verbs.items():
                seconds, memory = measure([verb, str(trial), *words])
                base = first.setdefault(verb, (seconds, memory))
                print(
                    f"{length:4g} min  {verb:9s} {seconds:7.1f} s  x {seconds / base[0]:5.2f}"
                    f"   {memory:6.0f} MB  x {memory / base[1]:5.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
