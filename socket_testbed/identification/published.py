"""The figures that the paper prints, and those of a trial beside them.

`PUBLISHED` holds the printed numbers that are known here. Whoever has the paper completes it: every
name that `paper` prints in its column `figure` is a key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.identification.evaluation import ChannelErrors, summarise_errors
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings, Variant

if TYPE_CHECKING:
    import pandas as pd

MOMENTS = "mean RMSE of the moments [N m]"
FORCES = "mean RMSE of the forces [N]"
MEDIAN = "median RMSE of the clusters in the objective [N]"

# Without and with offsets.
PUBLISHED: dict[str, tuple[float, float]] = {
    MOMENTS: (1.69, 0.44),
    FORCES: (5.94, 5.25),
    MEDIAN: (90.07, 3.76),
    "RMSE of Mx [N m]": (3.99, 0.95),
}
# Under what: a mass of 19 kg on the pylon, held, 1000 samples at 4 Hz, three channels left out.
PUBLISHED_LOAD = 300.0  # [N]
PUBLISHED_FRAMES = 1000
PUBLISHED_RATE = 4.0  # [Hz]
PUBLISHED_CHANNELS = 9  # of the clusters in the objective, of 12
PUBLISHED_SETTINGS = {"weights": "raw", "rest_position_limit": 0.008}

OURS, THEIRS = "this trial", "the paper"
WITHOUT, WITH = "without offsets", "with offsets"
NOT_HERE = "the number is not in this package"

_LOAD_SHARE = 0.2  # [-]; by which another load is still comparable
_RATE_SHARE = 0.05  # [-]
_UNSTEADY = 10.0  # [N]; standard deviation of the force that is no hold


def beside_published(
    errors: Mapping[Variant, Sequence[ChannelErrors]],
    fronts: Mapping[Variant, Front],
    samples: Samples,
    settings: IdentificationSettings,
) -> pd.DataFrame:
    """The figures of the paper for a trial, beside the printed ones.

    Args:
        errors: Errors of the paper's two variants on every channel.
        fronts: Their fronts over theta; none where there are no thetas to state.
        samples: The samples of the fits.
        settings: Settings of the fits.

    Returns:
        A row per figure, indexed by its name and unit: for this trial and for the paper the values
        without and with offsets, NaN where unknown, and a remark: why the two are not comparable,
        or that the printed number is not known here.
    """
    import pandas as pd

    ours = _figures([errors[variant] for variant in PAPER_VARIANTS])
    for mark in (SENSOR_ONLY, KNEE, WRENCH_ONLY) if fronts else ():
        found = [(fronts[variant], fronts[variant].marks.get(mark)) for variant in PAPER_VARIANTS]
        thetas = [np.nan if i is None else float(front.theta[i]) for front, i in found]
        ours[f"theta, {mark} [-]"] = thetas
    conditions = differing_conditions(samples, settings)
    local = [error.in_objective for error in errors["stiffness"][6:]]
    left_out = {
        f"RMSE of {name}": "not comparable: left out of the objective"
        for name in settings.leave_out
    }
    rows = {}
    for name, values in ours.items():
        theirs = PUBLISHED.get(name, (np.nan, np.nan))
        differing = [*conditions]
        if name == MEDIAN and sum(local) != PUBLISHED_CHANNELS:
            differing.append(f"{sum(local)} of {len(local)} channels counted, {PUBLISHED_CHANNELS}")
        remark = "" if name in PUBLISHED else NOT_HERE
        if name in PUBLISHED and differing:
            remark = f"not comparable: {'; '.join(differing)} in the paper"
        remark = left_out.get(name.rpartition(" [")[0], remark)
        rows[name] = [*values, *theirs, remark]
    frame = pd.DataFrame.from_dict(rows, orient="index")
    pairs = [(source, variant) for source in (OURS, THEIRS) for variant in (WITHOUT, WITH)]
    frame.columns = pd.MultiIndex.from_tuples([*pairs, ("", "remark")])
    frame.index.name = "figure"
    return frame


def _figures(errors: Sequence[Sequence[ChannelErrors]]) -> dict[str, list[float]]:
    """Quoted means and median, RMSE of every channel, sigma of the wrench, for two variants."""
    summaries = [summarise_errors(of_variant) for of_variant in errors]
    figures = {
        MOMENTS: [summary.moment_rmse for summary in summaries],
        FORCES: [summary.force_rmse for summary in summaries],
        MEDIAN: [summary.local_rmse for summary in summaries],
    }
    channels = [*zip(*errors, strict=True)]
    for pair in channels:
        figures[f"RMSE of {pair[0].name} [{pair[0].unit}]"] = [error.rmse for error in pair]
    for pair in channels[:6]:
        figures[f"sigma of {pair[0].name} [{pair[0].unit}]"] = [error.sigma for error in pair]
    return figures


def differing_conditions(samples: Samples, settings: IdentificationSettings) -> list[str]:
    """What differs from the published experiment and fit: here, then there."""
    force = np.linalg.norm(samples.wrench[samples.complete, 3:], axis=1)
    load, rate = float(np.median(force)), 1.0 / float(np.median(np.diff(samples.time)))
    found = []
    if abs(load - PUBLISHED_LOAD) > _LOAD_SHARE * PUBLISHED_LOAD:
        found.append(f"load of {load:.0f} N, about {PUBLISHED_LOAD:.0f} N")
    if float(np.std(force)) > _UNSTEADY:
        found.append(f"load that varies by {np.std(force):.0f} N, a hold")
    if len(samples) != PUBLISHED_FRAMES:
        found.append(f"{len(samples)} samples, {PUBLISHED_FRAMES}")
    if abs(rate - PUBLISHED_RATE) > _RATE_SHARE * PUBLISHED_RATE:
        found.append(f"{rate:.3g} Hz, {PUBLISHED_RATE:g} Hz")
    for name, theirs in PUBLISHED_SETTINGS.items():
        if getattr(settings, name) != theirs:
            found.append(f"{name} {getattr(settings, name)}, {theirs}")
    return found
