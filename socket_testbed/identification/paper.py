"""The figures of the published experiment beside those of a trial.

`PUBLISHED` holds the printed numbers that are known here. To complete it from the paper, use the
names in the column `figure` of the verb `paper` as keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from socket_testbed.arrays import usual_period
from socket_testbed.identification.fit import QUOTED, ChannelErrors, summarise_errors
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front
from socket_testbed.samples import Samples, force_magnitude
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings, Variant
from socket_testbed.tables import split_unit

MEDIAN = QUOTED["median_local_rmse"]
# Without and with offsets
PUBLISHED: dict[str, tuple[float, float]] = {
    QUOTED["mean_moment_rmse"]: (1.69, 0.44),
    QUOTED["mean_force_rmse"]: (5.94, 5.25),
    MEDIAN: (90.07, 3.76),
    "RMSE of Mx [N m]": (3.99, 0.95),
}
# Conditions: a mass of 19 kg on the pylon, held, 1000 samples at 4 Hz, three channels left out.
PUBLISHED_LOAD = 300.0  # [N]
PUBLISHED_FRAMES = 1000
PUBLISHED_RATE = 4.0  # [Hz]
PUBLISHED_CHANNELS = 9  # of the clusters in the objective, of 12
PUBLISHED_SETTINGS = {"weights": "raw", "rest_position_limit": 0.008}

OURS, THEIRS = "this trial", "the paper"
WITHOUT, WITH = "without offsets", "with offsets"
NOT_HERE = "the number is not in this package"

_LOAD_TOLERANCE = 0.2  # [-]; for a comparable load
_RATE_TOLERANCE = 0.05  # [-]
_MAX_HOLD_DEVIATION = 10.0  # [N]; of the force


def beside_published(
    errors: Mapping[Variant, Sequence[ChannelErrors]],
    fronts: Mapping[Variant, Front],
    samples: Samples,
    settings: IdentificationSettings,
) -> pd.DataFrame:
    """The figures of the paper for a trial, next to the printed ones.

    Args:
        errors: Errors of the paper's two variants on every channel, the wrench's six first.
        fronts: Fronts of the two variants; empty to omit the thetas.
        samples: Samples of the fits.
        settings: Settings of the fits, whose `leave_out` marks channels that do not compare.

    Returns:
        One row per figure, indexed by its name and unit: the values without and with offsets for
        this trial and for the paper, NaN if unknown, and a remark: why the two are not comparable,
        or that the printed number is unknown.
    """
    both = [_figures(errors[variant], fronts.get(variant)) for variant in PAPER_VARIANTS]
    conditions = [*differing_conditions(samples, settings)]
    local = [error.in_objective for error in errors["stiffness"][6:]]
    left_out = {
        f"RMSE of {name}": "not comparable: left out of the objective"
        for name in settings.leave_out
    }
    rows = {}
    for name in both[0]:
        theirs = PUBLISHED.get(name, (np.nan, np.nan))
        differing = [*conditions]
        if name == MEDIAN and sum(local) != PUBLISHED_CHANNELS:
            differing.append(f"{sum(local)} of {len(local)} channels counted, {PUBLISHED_CHANNELS}")
        remark = "" if name in PUBLISHED else NOT_HERE
        if name in PUBLISHED and differing:
            remark = f"not comparable: {'; '.join(differing)} in the paper"
        remark = left_out.get(split_unit(name)[0], remark)
        rows[name] = [*(ours[name] for ours in both), *theirs, remark]
    frame = pd.DataFrame.from_dict(rows, orient="index")
    pairs = [(source, variant) for source in (OURS, THEIRS) for variant in (WITHOUT, WITH)]
    frame.columns = pd.MultiIndex.from_tuples([*pairs, ("", "remark")])
    frame.index.name = "figure"
    return frame


def _figures(errors: Sequence[ChannelErrors], front: Front | None) -> dict[str, float]:
    """Summary figures, RMSE of every channel, sigma of the wrench, thetas of the marks."""
    quoted = summarise_errors(errors).quoted
    figures = {QUOTED[name]: value for name, value in quoted.items()}
    figures |= {f"RMSE of {error.name} [{error.unit}]": error.rmse for error in errors}
    figures |= {f"sigma of {error.name} [{error.unit}]": error.sigma for error in errors[:6]}
    if front is not None:
        for mark in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
            index = front.marks.get(mark)
            figures[f"theta, {mark} [-]"] = np.nan if index is None else float(front.theta[index])
    return figures


def differing_conditions(samples: Samples, settings: IdentificationSettings) -> Iterator[str]:
    """Differences from the published experiment and fit, in words.

    Each states this trial's value, then the paper's.

    Args:
        samples: Samples of the fit, some of them with a pose and a wrench.
        settings: Settings of the fit, compared with `PUBLISHED_SETTINGS`.
    """
    force = force_magnitude(samples.wrench[samples.has_pose_and_wrench])
    load, rate = float(np.median(force)), 1.0 / usual_period(samples.time)
    if abs(load - PUBLISHED_LOAD) > _LOAD_TOLERANCE * PUBLISHED_LOAD:
        yield f"load of {load:.0f} N, about {PUBLISHED_LOAD:.0f} N"
    if float(np.std(force)) > _MAX_HOLD_DEVIATION:
        yield f"load that varies by {np.std(force):.0f} N, a hold"
    if len(samples) != PUBLISHED_FRAMES:
        yield f"{len(samples)} samples, {PUBLISHED_FRAMES}"
    if abs(rate - PUBLISHED_RATE) > _RATE_TOLERANCE * PUBLISHED_RATE:
        yield f"{rate:.3g} Hz, {PUBLISHED_RATE:g} Hz"
    for name, theirs in PUBLISHED_SETTINGS.items():
        if getattr(settings, name) != theirs:
            yield f"{name} {getattr(settings, name)}, {theirs}"
