"""Load histories: what is put on the pylon above the limb, and when."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from socket_testbed.arrays import FloatArray

Scenario = Literal["static_hold", "ramp", "multi_direction"]
SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)

_GRAVITY = 9.81  # [m/s^2]
PYLON_MASS = 9.3  # [kg]; the paper's
ADDED_MASS = 19.0  # [kg]; the paper's
_PYLON_POINT = np.array([0.004, -0.003, 0.45])  # [m]; centre of mass of the pylon in {S}
_ADDED_POINT = np.array([0.010, 0.007, 0.50])  # [m]; where the mass is placed
_PLACING = 2.0  # [s]; to place or remove the mass
_SWAY_FORCE = 0.4  # [N]
_SWAY_TIME = 0.6  # [s]


def load_history(scenario: Scenario, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Wrench of the load on the limb about the origin of {S}.

    - `static_hold`: the pylon alone, the mass placed, held, removed, as in the paper;
    - `ramp`: the mass put on and taken off slowly, again and again;
    - `multi_direction`: the mass on, and pushed around from all sides.

    Args:
        scenario: Which history.
        time: Times since the start, shape (N,) [s].
        rng: Source of the sway of pylon and mass.

    Returns:
        Wrenches [M; F], shape (N, 6) [N m, N].
    """
    duration = float(time[-1]) if len(time) else 0.0
    added = np.zeros((len(time), 3))
    if scenario == "static_hold":
        share = _trapezoid(time, 0.15 * duration, 0.85 * duration)
    elif scenario == "ramp":
        share = 0.5 - 0.5 * np.cos(2.0 * np.pi * time / min(30.0, max(duration, 1e-9)))
    else:
        share = _trapezoid(time, 0.05 * duration, 0.95 * duration)
        around, up = 2.0 * np.pi * time / 11.0, 2.0 * np.pi * time / 17.0
        push = 35.0 * share * (0.6 + 0.4 * np.sin(2.0 * np.pi * time / 23.0))
        added[:, 0] = push * np.cos(around)
        added[:, 1] = push * np.sin(around)
        added[:, 2] = 60.0 * share * np.sin(up)
    added[:, 2] -= share * ADDED_MASS * _GRAVITY
    added[:, :2] += _sway(time, rng) * (0.3 + share[:, None])

    pylon = np.tile([0.0, 0.0, -PYLON_MASS * _GRAVITY], (len(time), 1))
    moment = np.cross(_PYLON_POINT, pylon) + np.cross(_ADDED_POINT, added)
    return np.hstack([moment, pylon + added])


def _trapezoid(time: FloatArray, on: float, off: float) -> FloatArray:
    """From 0 to 1 at `on` and back at `off`, smoothly, shape (N,)."""
    rising = np.clip((time - on) / _PLACING, 0.0, 1.0)
    falling = np.clip((off - time) / _PLACING, 0.0, 1.0)
    share = np.minimum(rising, falling)
    return share * share * (3.0 - 2.0 * share)


def _sway(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Horizontal forces of a person and a pylon that never stand quite still, (N, 2) [N]."""
    sway = np.zeros((len(time), 2))
    steps = np.diff(time, prepend=time[:1])
    kicks = rng.normal(0.0, _SWAY_FORCE, (len(time), 2))
    for k in range(1, len(time)):
        keep = np.exp(-steps[k] / _SWAY_TIME)
        sway[k] = keep * sway[k - 1] + np.sqrt(1.0 - keep**2) * kicks[k]
    return sway
