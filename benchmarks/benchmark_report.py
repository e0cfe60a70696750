"""What the page of a long trial takes, beside reading the trial.

    .venv/bin/python benchmarks/benchmark_report.py [MINUTES ...]

The trials are made as in benchmark_long_trials.py, of a hold and of pushes from all sides, for 10
minutes. The floor is `Trial.samples()`, without the start of Python; `report`, on all of the trial,
is measured with it: with the page, the folder of its figures as PDF, PNG and CSV.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

from benchmark_long_trials import PIECE, RATE, apart, read, repeat, verb

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation.limb import Scenario
from socket_testbed.simulation.trial import simulate, write_simulated_trial

SCENARIOS: tuple[Scenario, ...] = ("static_hold", "multi_direction")


def main() -> None:
    """Measure and print."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    lengths = [float(word) for word in sys.argv[1:]] or [10.0]
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    print("report                      by the clock  processor  / reading    memory      page")
    with tempfile.TemporaryDirectory() as folder:
        for scenario in SCENARIOS:
            piece = Path(folder) / scenario
            write_simulated_trial(
                simulate(geometry, calibration, scenario, PIECE, RATE, seed=0), piece
            )
            for length in lengths:
                path = Path(folder) / f"{scenario}_{length:g}min"
                repeat(piece, path, round(60.0 * length / PIECE))
                floor, _ = apart(read, path)
                page = path.with_suffix(".html")
                start = time.perf_counter()
                seconds, memory = verb(["report", str(path), "--segment", "all", "-o", str(page)])
                clock = time.perf_counter() - start
                print(
                    f"{scenario:15s} {length:4g} min {clock:11.1f} s {seconds:8.1f} s"
                    f" {seconds / floor:10.2f} {memory:7.0f} MB"
                    f" {1e-6 * page.stat().st_size:6.2f} MB",
                    flush=True,
                )


if __name__ == "__main__":
    main()
