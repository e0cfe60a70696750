"""The force map and its pressure outputs against limbs whose forces are known, beside a rival.

Usage:
    python benchmarks/benchmark_force_map.py [--seeds 100 ... 111] [--families ...] [--time-only]

The families are the package's simulator, soft and stiff, and the laws of `limbs.py`. The prior was
chosen on the seeds below 100: judge it by the others. An error is the root mean square over the
tiles without a sensor, relative to that of the true forces; predicting zero has 1. The rival is the
inverse-distance interpolation of the clusters with the smallest change that meets the wrench.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from limbs import FAMILIES, Limb, Trial
from machine import describe_machine, repeat
from scipy.special import ndtri

from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.pressure import THRESHOLD, pressure_outputs
from socket_testbed.identification.validation import (
    LEVELS,
    close_wrench,
    inverse_distance,
)
from socket_testbed.samples import Samples, Status, local_channels
from socket_testbed.simulation.limb import SCENARIOS, TISSUES
from socket_testbed.simulation.trial import simulate

sys.path.append(str(Path(__file__).parents[1] / "test"))
from support.outputs import outputs_of  # a second implementation, for the tests

_PROJECT = [f"project {tissue}" for tissue in TISSUES]
_OUTPUTS = ("mean", "peak", "area", "integral", "centre", "shear", "direction", "share")
_RATIOS = ("peak", "area", "integral")
_SAMPLES = 24  # of a trial
_LEAST_FORCE = 20.0  # [N]; below it the socket hangs free
_BUDGET = 1.0  # [s]


def main() -> None:
    """Make limbs, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(100, 112)))
    parser.add_argument("--families", nargs="+", default=[*_PROJECT, *FAMILIES])
    parser.add_argument("--time-only", action="store_true", help="only the time per sample")
    arguments = parser.parse_args()
    print(describe_machine(1))
    geometry = read_socket(packaged("config", "socket.yaml"))
    _print_times(geometry)
    if arguments.time_only:
        return
    print(f"\n{'':16} {'map: mean, worst':>17} {'rival':>7} {'worse':>6}   tiles' forces within"
          f" {', '.join(f'{100 * level:g}' for level in LEVELS)} %;"
          f" outputs of regions and socket within 95 %: {', '.join(_OUTPUTS)};"
          f" estimated over true of the socket: {', '.join(_RATIOS)}")  # fmt: skip
    for family in arguments.families:
        trials = (make(geometry, family, seed) for seed in arguments.seeds)
        print(_row(family, [judge(geometry, trial) for trial in trials]), flush=True)


def make(geometry: SocketGeometry, family: str, seed: int) -> Trial:
    """A trial of a family."""
    rng = np.random.default_rng(seed)
    if family in FAMILIES:
        return FAMILIES[family](Limb(geometry, rng))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    tissue, scenario = TISSUES[_PROJECT.index(family)], SCENARIOS[seed % len(SCENARIOS)]
    trial = simulate(geometry, calibration, scenario, 120.0, 2.0, seed, tissue=tissue)
    forces, status = [], []
    for cluster, capacitance in trial.capacitance.items():
        read = np.where(np.isfinite(capacitance), Status.OK, Status.MISSING).astype(np.uint8)
        stress, of_cluster = calibration.clusters[cluster].apply(capacitance, read)
        forces.append(geometry.cluster_force(cluster, stress))
        status.append(of_cluster)
    nothing, local = np.full((len(trial.stamps), 3), np.nan), np.stack(forces, axis=1)
    samples = Samples(
        trial.stamps, nothing, nothing, trial.wrench, tuple(trial.capacitance), local,
        np.stack(status, axis=1),
    )  # fmt: skip
    loaded = np.flatnonzero(np.linalg.norm(samples.wrench[:, 3:], axis=1) >= _LEAST_FORCE)
    rows = loaded[np.linspace(0, len(loaded) - 1, _SAMPLES).astype(int)]
    return Trial(samples[rows], trial.truth.forces[rows])


def judge(geometry: SocketGeometry, trial: Trial) -> dict[str, float]:
    """Errors of the map and its rival, and the shares of true values within the intervals [-]."""
    samples, truth = trial.samples, trial.forces
    tiles = list(geometry.clusters.values())
    free = np.setdiff1d(np.arange(len(geometry)), tiles)
    force_map = ForceMap(geometry, samples.clusters, trial=samples)
    estimate = force_map.estimate(samples)
    local = np.where((samples.status == Status.OK)[..., None], samples.local_forces, np.nan)
    rival = inverse_distance(geometry, samples.clusters, local)
    rival = close_wrench(geometry, rival, samples.wrench, tiles)
    size = _rms(truth[:, free])
    misses = np.abs(estimate.forces - truth)[:, free] / estimate.standard_deviations[:, free]
    found = {
        "map": _rms((estimate.forces - truth)[:, free]) / size,
        "rival": _rms((rival - truth)[:, free]) / size,
    } | {f"{level}": float(np.mean(misses < ndtri(0.5 + 0.5 * level))) for level in LEVELS}
    regions = all_regions(geometry)
    outputs = pressure_outputs(force_map, samples, geometry, regions, THRESHOLD).regions
    known = outputs_of(truth, samples.time, geometry, regions, THRESHOLD)
    socket = [region.name for region in regions].index("socket")
    for name in _OUTPUTS:
        quantity, true = getattr(outputs, name), known[name]
        if name == "direction":
            true = quantity.value + (true - quantity.value + np.pi) % (2.0 * np.pi) - np.pi
        if name in _RATIOS:
            found[f"{name} ratio"] = float(quantity.value[socket] / true[socket])
        within = (quantity.low - 1e-12 <= true) & (true <= quantity.high + 1e-12)
        found[name] = float(within[np.isfinite(true)].mean())
    return found


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _row(family: str, results: list[dict[str, float]]) -> str:
    columns = defaultdict(list)
    for result in results:
        for name, value in result.items():
            columns[name].append(value)
    mean = {name: statistics.mean(values) for name, values in columns.items()}
    worse = sum(one > other for one, other in zip(columns["map"], columns["rival"], strict=True))
    tiles = " ".join(f"{100 * mean[f'{level}']:4.0f}" for level in LEVELS)
    outputs = " ".join(f"{100 * mean[name]:4.0f}" for name in _OUTPUTS)
    ratios = " ".join(f"{mean[f'{name} ratio']:.2f}" for name in _RATIOS)
    return (
        f"{family:16} {mean['map']:9.3f}, {max(columns['map']):.3f} {mean['rival']:7.3f}"
        f" {worse:2d}/{len(results)}  {tiles} ; {outputs} ; {ratios}"
    )


def _print_times(geometry: SocketGeometry) -> None:
    random, clusters = np.random.default_rng(0), tuple(geometry.clusters)
    wrench, local = random.normal(0.0, 10.0, (1, 6)), random.normal(0.0, 3.0, (1, 4, 3))
    nothing, status = np.zeros((1, 3)), np.zeros((1, 4), dtype=np.uint8)
    present = Samples(np.zeros(1, np.int64), nothing, nothing, wrench, clusters, local, status)
    missing = present.without(local_channels(clusters[1]))
    force_map = ForceMap(geometry, clusters)

    def first_sample_without_a_cluster() -> None:
        force_map._conditioned.cache_clear()
        force_map.update(missing)

    for name, run in (
        (f"update, n = {len(geometry)}", lambda: force_map.update(present)),
        ("update as a cluster drops out", first_sample_without_a_cluster),
        ("prior and gains, once", lambda: ForceMap(geometry, clusters)),
    ):
        times = repeat(run, _BUDGET)
        print(f"{name:32} {1e3 * statistics.median(times):8.3f} ms (min {1e3 * min(times):.3f})")


if __name__ == "__main__":
    main()
