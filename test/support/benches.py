"""Bench data for tests: a load path, the simulated sensor, hysteresis, and files of it."""

from functools import cache
from pathlib import Path

import numpy as np

from socket_testbed.calibration.bench_data import BenchData
from socket_testbed.calibration.model import (
    ClusterCalibration,
    invert_calibration,
    read_calibration,
)
from socket_testbed.files import packaged
from socket_testbed.simulation.sensors import ClusterSensor, SensorErrors

HEADER = ("time [s]", "normal [kPa]", "shear_x [kPa]", "shear_y [kPa]")
HEADER += ("c0 [pF]", "c1 [pF]", "c2 [pF]", "c3 [pF]")
ERRORS = SensorErrors(capacitance_drift=0.0)
FULL_SCALE = np.array([60e3, 15e3, 15e3])


@cache
def nominal(cluster: str = "distal") -> ClusterCalibration:
    """A cluster of the package's own calibration."""
    return read_calibration(packaged("config", "calibration.yaml")).clusters[cluster]


def load_path(directions: int = 8, repeats: int = 2, steps: int = 30) -> np.ndarray:
    """Stresses (N, 3) [Pa] of cycles up and down: without shear, then in each direction in turn."""
    ramp = np.concatenate([np.linspace(0.0, 1.0, steps), np.linspace(1.0, 0.0, steps)[1:]])
    cycles = []
    for _ in range(repeats):
        cycles.append(np.outer(ramp, [FULL_SCALE[0], 0.0, 0.0]))
        for k in range(directions):
            angle = 2.0 * np.pi * k / directions
            size = np.array([(1.0, 0.4, 0.7)[k % 3], np.cos(angle), np.sin(angle)])
            cycles.append(np.outer(ramp, size * FULL_SCALE))
    return np.concatenate(cycles)


def felt_with_play(stress: np.ndarray, width: float) -> np.ndarray:
    """Stress behind an element with play, which lags by half the width [of the full scale]."""
    half = 0.5 * width * FULL_SCALE
    felt = np.empty_like(stress)
    state = stress[0]
    for i, value in enumerate(stress):
        state = np.clip(state, value - half, value + half)
        felt[i] = state
    return felt


def bench_of(capacitance: np.ndarray, stress: np.ndarray) -> BenchData:
    """Bench data of one file without names for its cycles."""
    rows = len(stress)
    return BenchData(
        files=("bench.csv",),
        file=np.zeros(rows, dtype=np.int64),
        line=np.arange(rows) + 2,
        time=0.1 * np.arange(rows),
        cycle=np.full(rows, -1),
        capacitance=capacitance,
        stress=stress,
    )


@cache
def exact_bench(steps: int = 30) -> BenchData:
    """Capacitances that the nominal calibration turns into the stresses exactly."""
    stress = load_path(steps=steps)
    return bench_of(invert_calibration(nominal(), stress), stress)


def sensor_bench(seed=0, play=0.0, directions=8, repeats=2) -> BenchData:
    """Readings of the simulated sensor of a seed on the bench."""
    stress = load_path(directions, repeats)
    sensor = ClusterSensor(nominal(), ERRORS, np.random.default_rng(seed))
    felt = felt_with_play(stress, play) if play else stress
    capacitance = sensor.respond(felt, np.zeros(len(stress)))
    noise = np.random.default_rng([seed, 0]).normal(size=capacitance.shape)
    return bench_of(capacitance + ERRORS.capacitance_noise * noise, stress)


def write_bench(path: Path, bench: BenchData, header: tuple[str, ...] = HEADER) -> Path:
    """Write bench data as a file with stresses in kPa."""
    columns = np.column_stack([bench.time, bench.stress / 1e3, bench.capacitance])
    lines = [",".join(f"{value:.9g}" for value in row) for row in columns]
    path.write_text("\n".join([",".join(header), *lines]) + "\n")
    return path
