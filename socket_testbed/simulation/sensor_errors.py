"""Sizes of the errors of all sensors, and those of the load cell.

Simulated hardware needs no more than this: a node that reads it starts without the sensors' models.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray


@dataclass(frozen=True)
class SensorErrors:
    """Sizes of the errors of all sensors."""

    gain_mismatch: float = 0.02  # spread of the gains of a cluster's channels [-]
    offset: float = 0.03  # spread of the offsets of a cluster's channels [pF]
    cross_talk: float = 0.03  # part of a neighbouring channel's change that a channel picks up [-]
    capacitance_drift: float = 1.0e-4  # spread of the drift of a channel [pF/s]
    capacitance_noise: float = 0.002  # noise of a channel [pF]
    # largest offset of a cluster's three stresses, as a cluster has that is built into a socket
    # after its calibration; a fifth of it is the smallest [Pa]
    stress_offset: float = 0.0
    placement: float = 0.05  # spread of a cluster's rotation about its normal [rad]
    force_noise: float = 0.15  # noise of the load cell's forces [N]
    moment_noise: float = 0.01  # noise of the load cell's moments [N m]
    force_offset: float = 0.8  # spread of the forces' offsets after taring [N]
    moment_offset: float = 0.05  # spread of the moments' offsets after taring [N m]
    force_creep: float = 0.0  # by how much each force creeps under the largest load [N]
    moment_creep: float = 0.0  # by how much each moment creeps under the largest load [N m]
    force_vibration: float = 0.0  # amplitude of the load cell's forces as the stand vibrates [N]
    # mean amplitude of a cluster's stresses as its cable moves with it [Pa]
    stress_vibration: float = 0.0
    # noise of a marker's coordinate [m]; white from frame to frame, measured on the body at rest of
    # `sample_optitrack_take.csv` (120 Hz, a triad of 0.2 m; cmuphyscomp/hmv-s16 on GitHub). Long
    # lenses and large rooms have more
    marker_noise: float = 8.0e-6
    drop_out: float = 0.002  # chance that a marker is occluded in a frame [-]
    label_swap: float = 0.002  # chance that two labels of a body are swapped in a frame [-]
    registration: float = 5.0e-4  # spread of the error of a body's registration [m]
    registration_angle: float = 0.003  # the same for its rotation [rad]


# Errors as large as in the published experiment, whose causes are not known. Steady ones: the load
# cell creeps by 4 N and 0.9 N m, clusters have offsets of up to 150 N on their 9 cm^2. Beside
# offsets, 5 N was left there and 4 N on a cluster: more than the drift of a plateau, so faster.
LIKE_PAPER = SensorErrors(
    stress_offset=150.0 / 9e-4,
    force_creep=4.0,
    moment_creep=0.9,
    force_vibration=7.2,
    stress_vibration=5.5 / 9e-4,
)

_VIBRATION = 13.5  # [Hz]; of a stand; a trigger of 4 Hz sees 1.5 Hz
_LEVERS = (0.167, 0.03, 0.015)  # [m]; of its moments: the stand is weakest about x


def vibration(amplitudes: FloatArray, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Vibrations of m channels in random phases, shape (N, m).

    Args:
        amplitudes: Their amplitudes in any unit, shape (m,).
        time: Times, shape (N,) [s].
        rng: Source of the phases.
    """
    phases = rng.uniform(0.0, 2.0 * np.pi, len(amplitudes))
    return np.asarray(amplitudes * np.sin(2.0 * np.pi * _VIBRATION * time[:, None] + phases))


def wrench_vibration(errors: SensorErrors) -> FloatArray:
    """Amplitudes of the load cell's vibration, [M; F], shape (6,) [N m, N]."""
    return errors.force_vibration * np.array([*_LEVERS, 1.0, 1.0, 1.0])


def wrench_offset(errors: SensorErrors, rng: np.random.Generator) -> FloatArray:
    """The rest of the load cell's offset after taring, [M; F], shape (6,) [N m, N]."""
    return rng.normal(0.0, 1.0, 6) * np.repeat([errors.moment_offset, errors.force_offset], 3)


def wrench_noise(errors: SensorErrors, count: int, rng: np.random.Generator) -> FloatArray:
    """Noise of the load cell, [M; F], shape (count, 6) [N m, N]."""
    return rng.normal(0.0, 1.0, (count, 6)) * np.repeat(
        [errors.moment_noise, errors.force_noise], 3
    )
