"""Whole fits of every variant: both stages, the joint refinement, the errors; and one prediction.

Usage:
    python benchmarks/benchmark_rigid.py [--points 100] [--samples 1000 10000]

The samples are a limb that turns and moves on a bed of the rigid law, with noise. Processor seconds
of one thread count, because a busy machine stretches the clock.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from machine import describe_machine
from problems import cylinder

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import VARIANTS, IdentificationSettings

_NOISE = np.array([1e-5] * 3 + [1e-4] * 3)  # [m, rad]; of a pose
_MOTION = np.array([5e-4, 5e-4, 2e-3, 0.02, 0.02, 0.005])  # [m, rad]
_PREDICTIONS = 500


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100, help="number of points of interest")
    parser.add_argument("--samples", type=int, nargs="+", default=[1000, 10000])
    arguments = parser.parse_args()
    print(describe_machine(1))
    geometry = cylinder(arguments.points)
    for count in arguments.samples:
        samples = _samples(geometry, count)
        for variant in VARIANTS:
            _measure(samples, geometry, variant)


def _measure(samples: Samples, geometry: SocketGeometry, variant: str) -> None:
    started, clock = time.process_time(), time.perf_counter()
    fit = fit_contact_model(samples, geometry, IdentificationSettings(variant=variant))
    spent, waited = time.process_time() - started, time.perf_counter() - clock
    pose = samples.pose[:1]
    started = time.process_time()
    for _ in range(_PREDICTIONS):
        fit.model.wrench(pose), fit.model.forces(pose)
    each = (time.process_time() - started) / _PREDICTIONS
    print(
        f"n = {len(geometry)}, N = {len(samples)}, {variant}: fit {spent:.2f} s of processor time"
        f" ({waited:.2f} s by the clock), one prediction {1e6 * each:.0f} us\n  {fit.status}"
    )


def _samples(geometry: SocketGeometry, count: int) -> Samples:
    random = np.random.default_rng(0)
    points = len(geometry)
    bed = ContactModel(
        variant="rigid",
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=random.uniform(0.5, 1.5, (points, 3)) * [200.0, 200.0, 1300.0],
        rest_positions=random.normal([-0.006, 0.0, 0.002], 0.001, (points, 3)),
        sharpness=300.0,
        wrench_bias=np.zeros(6),
        force_bias={},
        cluster_points=geometry.clusters,
        reference_pose=np.array([*geometry.anchors.mean(axis=0), 0.0, 0.0, 0.0]),
    )
    seconds = np.arange(count)[:, None] / 4.0
    frequency = np.array([0.09, 0.07, 0.06, 0.11, 0.13, 0.05])
    pose = bed.reference_pose + _MOTION * np.sin(2.0 * np.pi * frequency * seconds)
    forces = bed.cluster_forces(pose)
    seen = pose + _NOISE * random.standard_normal(pose.shape)
    noise = random.standard_normal((count, 6)) * [0.02, 0.02, 0.02, 0.2, 0.2, 0.2]
    return Samples(
        stamps=np.round(seconds[:, 0] * 1e9).astype(np.int64),
        position=seen[:, :3],
        rotation=seen[:, 3:],
        wrench=bed.wrench(pose) + noise,
        clusters=tuple(forces),
        local_forces=np.stack([*forces.values()], axis=1),
        status=np.zeros((count, len(forces)), dtype=np.uint8),
    )


if __name__ == "__main__":
    main()
