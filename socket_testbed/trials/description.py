"""A trial in words and tables: its samples, drop-outs, loads and noise."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from socket_testbed.arrays import GAP, StatusArray, gaps, runs, usual_period
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.samples import WITHOUT_VALUE, WRENCH_CHANNELS, Samples, Status, mean_and_sigma
from socket_testbed.tables import Table, number
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

_MAX_GAPS = 5  # listed, the longest


def summary(path: Path) -> str:
    """The numbers of triggers and of measurements without a value, in one line.

    The trial's folder is given; reading it raises the errors of `Trial.samples`.
    """
    samples = Trial(path).samples()
    lacking = [
        f"{name} {without.name.lower()} {count}"
        for name, state in samples.states.items()
        for without in WITHOUT_VALUE[::-1]
        if (count := (state == without).sum())
    ]
    found = ", ".join(lacking) if lacking else f"all {len(samples)} complete"
    return f"{path}: {len(samples)} triggers, {found}"


def describe_samples(samples: Samples) -> str:
    """Number, rate and gaps of some samples, in words."""
    time, steps = samples.time, np.diff(samples.time)
    found = np.flatnonzero(gaps(time))
    longest_first = found[np.argsort(-steps[found], kind="stable")]
    listed = [f"{steps[i]:.3f} s from {time[i]:.2f} s" for i in longest_first[:_MAX_GAPS]]
    rate = number(1.0 / usual_period(time), ".2f")
    text = (
        f"{len(samples)} samples at {rate} Hz in {time[-1]:.2f} s,"
        f" {samples.has_pose_and_wrench.sum()} with a wrench and a limb position; gaps longer than"
        f" {GAP:g} periods: {len(found)}"
    )
    return f"{text}, the longest {', '.join(listed)}" if listed else text


def states_by_channel(samples: Samples) -> dict[str, StatusArray]:
    """State of every measurement, shape (N,) each: the wrench, the limb position, the clusters.

    A cluster's channels share its status; other measurements are present or missing.
    """
    measured = np.column_stack([np.isfinite(samples.wrench), samples.has_pose])
    states = np.hstack([np.where(measured, Status.OK, Status.MISSING), samples.status])
    names = (*WRENCH_CHANNELS, "limb position", *samples.clusters)
    return dict(zip(names, states.T, strict=True))


def drop_outs(samples: Samples, segment: slice | None = None) -> Table:
    """Drop-outs of wrench channels, limb position and clusters.

    Args:
        samples: All samples of the trial.
        segment: Rows in which missing values are counted once more, in a column of their own; None
            for no such column.

    Returns:
        A table with a row per measurement: missing samples as a count [1] and share [%], the
        longest time between two values across missing ones [s], and saturated and out-of-range
        samples [1], which are counted for clusters and NaN for other measurements.
    """
    found = {}
    for name, state in states_by_channel(samples).items():
        missing, is_cluster = state == Status.MISSING, name in samples.clusters
        start, end = runs(missing).T
        before, after = np.maximum(start - 1, 0), np.minimum(end, len(samples) - 1)
        found[name] = {
            "missing [1]": missing.sum(),
            "missing [%]": 100.0 * missing.mean(),
            **({"of them in the segment [1]": missing[segment].sum()} if segment else {}),
            # from one value to the next across missing ones, within the trial
            "longest [s]": (samples.time[after] - samples.time[before]).max(initial=0.0),
            "saturated [1]": (state == Status.SATURATED).sum() if is_cluster else np.nan,
            "out of range [1]": (state == Status.OUT_OF_RANGE).sum() if is_cluster else np.nan,
        }
    frame = pd.DataFrame.from_dict(found, orient="index").rename_axis("measurement")
    formats = dict.fromkeys(frame, ".0f") | {"missing [%]": ".2f", "longest [s]": ".2f"}
    return Table("drop-outs", "Samples of the trial without a measurement", frame, formats)


def loads_table(samples: Samples, parts: Iterable[Segment]) -> Table:
    """Duration and mean load of some parts of a trial, such as its plateaus.

    Args:
        samples: All samples of the trial.
        parts: The parts, one row each.

    Returns:
        A table with the duration [s], the magnitude of the mean force [N] and of the mean moment in
        {S} [N m], and the standard deviation of the magnitude of each within the part.
    """
    formats = {
        "duration [s]": ".2f",
        "mean force [N]": ".1f",
        "its sigma [N]": ".2f",
        "mean moment [N m]": ".2f",
        "its sigma [N m]": ".3f",
    }
    rows = {}
    for part in parts:
        wrench = samples.wrench[part.rows]
        loads = (*mean_and_sigma(wrench[:, 3:]), *mean_and_sigma(wrench[:, :3]))
        rows[str(part)] = [part.end - part.start, *loads]
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=[*formats])
    return Table("plateaus", "Load of parts of the trial", frame.rename_axis("part"), formats)


def noise_table(clusters: tuple[str, ...], noise: ChannelNoise) -> Table:
    """Noise along x, y and z of each group of channels, with the unit in the group's name.

    Args:
        clusters: Names of the c clusters.
        noise: Noise of every channel.
    """
    local = zip(clusters, noise.local_forces, strict=True)
    groups = {
        "moment [N m]": noise.wrench[:3],
        "force [N]": noise.wrench[3:],
        "limb position [mm]": 1e3 * noise.pose[:3],
        "limb rotation [mrad]": 1e3 * noise.pose[3:],
        **{f"{name} [N]": deviations for name, deviations in local},
    }
    frame = pd.DataFrame.from_dict(groups, "index", columns=["x", "y", "z"])
    caption = "Standard deviation of the noise of a single sample, along each axis"
    return Table("noise", caption, frame.rename_axis("measurement"), dict.fromkeys(frame, ".2g"))
