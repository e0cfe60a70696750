"""Whole fits of every variant: both stages, the joint refinement, the errors; and one prediction.

The samples are those of a simulated limb that is pushed from all sides. Processor seconds of one
thread count, because a busy machine stretches the clock.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from machine import describe_machine

import socket_testbed as st
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.settings.identification import VARIANTS, IdentificationSettings

RATE = 4.0  # [Hz]; of the trigger
PREDICTIONS = 500


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=[1000, 10000])
    arguments = parser.parse_args()
    print(describe_machine(1))
    with tempfile.TemporaryDirectory() as folder:
        for count in arguments.samples:
            path = Path(folder) / str(count)
            trial = st.simulate(path, "multi_direction", duration=count / RATE, rate=RATE, seed=0)
            measure(trial)


def measure(trial: st.Trial) -> None:
    """Print a row for each variant."""
    samples, geometry = trial.samples(), trial.geometry
    pose = samples.pose[samples.complete][:1]
    for variant in VARIANTS:
        started, clock = time.process_time(), time.perf_counter()
        fit = fit_contact_model(samples, geometry, IdentificationSettings(variant=variant))
        spent, waited = time.process_time() - started, time.perf_counter() - clock
        started = time.process_time()
        for _ in range(PREDICTIONS):
            fit.model.wrench(pose), fit.model.forces(pose)
        each = (time.process_time() - started) / PREDICTIONS
        print(
            f"n = {len(geometry)}, N = {len(samples)}, {variant}: fit {spent:.2f} s of processor"
            f" time ({waited:.2f} s by the clock), one prediction {1e6 * each:.0f} us\n"
            f"  {fit.status}",
            flush=True,
        )


if __name__ == "__main__":
    main()
