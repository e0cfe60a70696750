"""Which input of the converter each channel is on, as the shear stresses show it."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.bench.bench_data import BenchData, scaled_stress
from socket_testbed.calibration import channel_features
from socket_testbed.errors import CalibrationError

_CORNERS = np.sign(np.column_stack(channel_features(np.eye(4))[1:]))  # (4, 2), sides of channels
_BULK = (1.0, 99.0)  # [%]; a spike beyond them must not decide


def find_wiring(capacitance: FloatArray, stress: FloatArray) -> IntArray:
    """Find the wiring for which a shear stress raises the channels on its own side.

    Args:
        capacitance: Capacitances by input, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Input that holds each channel, shape (4,).
    """
    design = np.column_stack([np.ones(len(stress)), scaled_stress(stress)])
    clipped = np.clip(capacitance, *np.percentile(capacitance, _BULK, axis=0))
    slopes = np.linalg.lstsq(design, clipped, rcond=None)[0][2:]
    slopes = slopes - slopes.mean(axis=1, keepdims=True)
    slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12)
    return linear_sum_assignment(_CORNERS @ slopes, maximize=True)[1].astype(np.int64)


def require_wiring(bench: BenchData, wiring: IntArray) -> None:
    """Refuse a wiring that nobody stated for this bench and that its data contradicts.

    Raises:
        CalibrationError: Naming the wiring that agrees with the data.
    """
    found = find_wiring(bench.capacitance, bench.stress)
    if not np.array_equal(found, wiring):
        raise CalibrationError(
            f"{', '.join(bench.files)}: the shear stresses do not raise the channels on their own"
            f" side with the wiring {_words(wiring)}, but do with {_words(found)}",
            f"give --wiring {_words(found)}, or --wiring {_words(wiring)} to keep it",
        )


def _words(wiring: IntArray) -> str:
    return " ".join(map(str, wiring.tolist()))
