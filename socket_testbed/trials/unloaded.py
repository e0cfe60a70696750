"""Spans of a trial without load: the clusters' drift is measured on them and taken off."""

from __future__ import annotations

import dataclasses

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.bench.drift import (
    DRIFT_LIMIT,
    Baseline,
    average_baseline,
    correct_drift,
    measure_drift,
)
from socket_testbed.errors import ConfigurationError
from socket_testbed.trials.measurements import Measurements
from socket_testbed.trials.trial import Trial

_MOST = 2  # before and after


def parse_unloaded(spans: list[str]) -> tuple[tuple[float, float], ...]:
    """Spans written as `T0:T1`, in seconds since the trial's first sample.

    Raises:
        ConfigurationError: If they are none, or more than two.
    """
    if len(spans) > _MOST:
        raise ConfigurationError(
            f"--unloaded has {len(spans)} spans", "give one before, or one before and one after"
        )
    return tuple(_parse(span) for span in spans)


def _parse(span: str) -> tuple[float, float]:
    try:
        start, end = (float(part) for part in span.split(":"))
    except ValueError:
        start, end = np.nan, np.nan
    if not start < end:
        raise ConfigurationError(
            f"--unloaded is '{span}'", "give seconds as T0:T1, with T0 before T1"
        )
    return start, end


def take_off_drift(trial: Trial, measured: Measurements) -> Measurements:
    """Bring the clusters' readings to the baseline of their calibration, span by span linear.

    Without a stored baseline of the calibration only the drift since the first span is taken
    off. The drift between two spans is told, and flagged where it is large.

    Args:
        trial: The trial, with its unloaded spans.
        measured: Its measurements.

    Raises:
        CalibrationError: If a span holds too few readings of a cluster.
    """
    time = (measured.stamps - measured.stamps[0]) * 1e-9
    capacitance = measured.capacitance.copy()
    for column, name in enumerate(measured.clusters):
        baselines = [
            _baseline(trial, name, time, capacitance[:, column], span) for span in trial.unloaded
        ]
        cluster = trial.calibration.clusters[name]
        before, after = baselines[0], baselines[1] if len(baselines) == _MOST else None
        capacitance[:, column] = correct_drift(
            capacitance[:, column], time, before, after, cluster.baseline
        )
        if after is not None and trial.tell is not None:
            drift = measure_drift(cluster, before, after)
            stress = 1e-3 * drift.stress
            flag = f", more than {1e-3 * DRIFT_LIMIT:g} kPa" if drift.flagged else ""
            trial.tell(
                f"{name} drifted by {stress[0]:+.2f} kPa normal, {stress[1]:+.2f} and"
                f" {stress[2]:+.2f} kPa shear without load, taken off{flag}"
            )
    return dataclasses.replace(measured, capacitance=capacitance)


def _baseline(
    trial: Trial,
    name: str,
    time: FloatArray,
    capacitance: FloatArray,
    span: tuple[float, float],
) -> Baseline:
    rows = (time >= span[0]) & (time <= span[1])
    where = f"{trial.path}: {name} from {span[0]:g} s to {span[1]:g} s"
    return average_baseline(0.5 * (span[0] + span[1]), capacitance[rows], where)
