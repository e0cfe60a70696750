"""The force map against the simulated truth, beside inverse distance, and its time per sample.

Usage:
    python benchmarks/benchmark_force_map.py [--seeds 10 11 12 13 14] [--offset 0]
        [--duration 120] [--time-only]

The prior was chosen with the seeds 0 to 4 and others above 1000: judge it by the rest. An error is
the root mean square over the tiles without a sensor and the samples under load, relative to that of
the true forces; predicting zero has 1.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import dataclass

import numpy as np
from machine import describe_machine
from measure import repeat
from problems import CLUSTERS, cylinder

from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.validation import close_wrench, inverse_distance
from socket_testbed.samples import Samples, Status
from socket_testbed.simulation.limb import SCENARIOS, TISSUES, Scenario, TissueKind
from socket_testbed.simulation.trial import SimulatedTrial, simulate

_RATE = 2.0  # [Hz]
_LEAST_FORCE = 20.0  # [N]; below it the socket hangs free
_LEVELS = {"50 %": 0.6745, "80 %": 1.2816, "95 %": 1.9600}  # [-]; standard deviations
_BUDGET = 1.0  # [s]


@dataclass(frozen=True)
class Result:
    """Errors of a trial [-], and the share of the true forces within the map's intervals [-]."""

    map: float
    inverse_distance: float
    closed: float
    coverage: tuple[float, ...]


def main() -> None:
    """Simulate, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12, 13, 14])
    parser.add_argument(
        "--offset", type=float, default=0.0, help="added to the clusters' channels, unknown [N]"
    )
    parser.add_argument("--duration", type=float, default=120.0, help="of a trial [s]")
    parser.add_argument("--time-only", action="store_true", help="only the time per sample")
    arguments = parser.parse_args()
    print(describe_machine(1))
    _print_times()
    if arguments.time_only:
        return
    print(f"\n{'tissue':6} {'scenario':16} {'map: mean, worst':>17} {'inverse distance':>17}"
          f" {'wrench met':>11} {'worse':>6}  within {', '.join(_LEVELS)}")  # fmt: skip
    found: list[Result] = []
    for tissue in TISSUES:
        for scenario in SCENARIOS:
            results = [
                judge(tissue, scenario, seed, arguments.duration, arguments.offset)
                for seed in arguments.seeds
            ]
            print(_row(tissue, scenario, results), flush=True)
            found += results
    print(_row("all", f"{len(found)} trials", found))


def judge(
    tissue: TissueKind, scenario: Scenario, seed: int, duration: float, offset: float
) -> Result:
    """Simulate a trial and judge the map and its rivals.

    Args:
        tissue: Kind of the tissue.
        scenario: The load history.
        seed: Seed of all that is random.
        duration: Duration [s].
        offset: Standard deviation of an unknown offset of each channel of a cluster [N].
    """
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    trial = simulate(geometry, calibration, scenario, duration, _RATE, seed, tissue=tissue)
    samples = _samples(geometry, calibration, trial)
    shift = np.random.default_rng(seed).normal(0.0, offset, samples.local_forces.shape[1:])
    samples.local_forces[:] += shift
    loaded = np.linalg.norm(samples.wrench[:, 3:], axis=1) >= _LEAST_FORCE
    samples, truth = samples[loaded], trial.truth.forces[loaded]

    tiles = list(geometry.clusters.values())
    free = np.setdiff1d(np.arange(len(geometry)), tiles)
    estimate = ForceMap(geometry, samples.clusters).estimate(samples)
    rival = inverse_distance(geometry, samples.clusters, samples.local_forces)
    closed = close_wrench(geometry, rival, samples.wrench, tiles)
    size = _rms(truth[:, free])
    misses = np.abs(estimate.forces - truth)[:, free] / estimate.standard_deviations[:, free]
    return Result(
        map=_rms((estimate.forces - truth)[:, free]) / size,
        inverse_distance=_rms((rival - truth)[:, free]) / size,
        closed=_rms((closed - truth)[:, free]) / size,
        coverage=tuple(float(np.mean(misses < level)) for level in _LEVELS.values()),
    )


def _samples(geometry: SocketGeometry, calibration: Calibration, trial: SimulatedTrial) -> Samples:
    """What the testbed measures, without the poses, which the map does not use."""
    forces, status = [], []
    for cluster, capacitance in trial.capacitance.items():
        read = np.where(np.isfinite(capacitance), Status.OK, Status.MISSING).astype(np.uint8)
        stress, of_cluster = calibration.clusters[cluster].apply(capacitance, read)
        forces.append(geometry.cluster_force(cluster, stress))
        status.append(of_cluster)
    nothing = np.full((len(trial.stamps), 3), np.nan)
    return Samples(
        stamps=trial.stamps,
        position=nothing,
        rotation=nothing,
        wrench=trial.wrench,
        clusters=tuple(trial.capacitance),
        local_forces=np.stack(forces, axis=1),
        status=np.stack(status, axis=1),
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _row(tissue: str, scenario: str, results: list[Result]) -> str:
    errors = np.array([(r.map, r.inverse_distance, r.closed) for r in results])
    coverage = np.mean([r.coverage for r in results], axis=0)
    worse = int((errors[:, 0] > errors[:, 2]).sum())
    mean = errors.mean(axis=0)
    return (
        f"{tissue:6} {scenario:16} {mean[0]:10.3f}, {errors[:, 0].max():.3f} {mean[1]:17.3f}"
        f" {mean[2]:11.3f} {worse:6d}  {', '.join(f'{share:.3f}' for share in coverage)}"
    )


def _print_times() -> None:
    geometry = cylinder(100)
    random = np.random.default_rng(0)
    wrench, local = random.normal(0.0, 10.0, 6), random.normal(0.0, 3.0, (4, 3))
    present, missing = np.zeros((2, 4), dtype=np.uint8)
    missing[1] = Status.MISSING
    force_map = ForceMap(geometry, CLUSTERS)

    def first_sample_without_a_cluster() -> None:
        force_map._patterns.clear()
        force_map.update(wrench, local, missing)

    for name, run in (
        ("update, n = 100", lambda: force_map.update(wrench, local, present)),
        ("update as a cluster drops out", first_sample_without_a_cluster),
        ("prior and gains, once", lambda: ForceMap(geometry, CLUSTERS)),
    ):
        times = repeat(run, _BUDGET)
        print(f"{name:32} {1e3 * statistics.median(times):8.3f} ms (min {1e3 * min(times):.3f})")


if __name__ == "__main__":
    main()
