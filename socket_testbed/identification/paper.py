"""The figures of the published experiment beside those of a trial.

`PUBLISHED` holds every result and `PUBLISHED_CONDITIONS` every condition that the paper prints.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd

from socket_testbed.arrays import usual_period
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.channel_errors import QUOTED, ChannelErrors, summarise_errors
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front
from socket_testbed.samples import WRENCH_CHANNELS, Samples, force_magnitude
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings, Variant
from socket_testbed.settings.options import PaperOptions
from socket_testbed.tables import split_unit

MEDIAN = QUOTED["median_local_rmse"]
_NAN = float("nan")  # the paper does not print it
# Results, without and with offsets, by the name in the column `figure` of the verb `paper`. Means
# and medians are those over channels, as here. The normal forces of the clusters are printed in the
# paper's order of the clusters; its discussion names that of brim_lateral.
PUBLISHED: dict[str, tuple[float, float]] = {
    QUOTED["mean_moment_rmse"]: (1.69, 0.44),
    QUOTED["mean_force_rmse"]: (5.94, 5.25),
    MEDIAN: (90.07, 3.76),
    "RMSE of Mx [N m]": (3.99, 0.95),
    "RMSE of My [N m]": (_NAN, 0.13),
    "RMSE of Mz [N m]": (_NAN, 0.25),
    "RMSE of Fy [N]": (6.76, _NAN),
    "RMSE of Fz [N]": (7.85, 8.03),
    "RMSE of brim_lateral.Fx [N]": (46.90, 8.85),
    "RMSE of brim_lateral.Fy [N]": (34.26, _NAN),
    "RMSE of brim_lateral.Fz [N]": (57.86, 2.39),
    "RMSE of mid_anterior.Fx [N]": (136.52, 7.78),
    "RMSE of mid_anterior.Fz [N]": (90.07, 2.52),
    "RMSE of posterior_distal.Fy [N]": (_NAN, 112.83),
    "RMSE of posterior_distal.Fz [N]": (107.99, 2.21),
    "RMSE of distal.Fz [N]": (153.04, 0.99),
    "sigma of Mx [N m]": (0.83, _NAN),
}
PUBLISHED_LEFT_OUT = ("distal.Fx", "distal.Fy", "posterior_distal.Fx")
PUBLISHED_LOAD = 300.0  # [N]; "about"
PUBLISHED_FRAMES = PaperOptions.frames
PUBLISHED_RATE = 4.0  # [Hz]
PUBLISHED_CHANNELS = 9  # of the clusters in the objective, of 12
PUBLISHED_SETTINGS = {"weights": "raw", "rest_position_limit": 0.008}
# Conditions and settings, by the name in the column `figure`, with the paper's own reservation.
PUBLISHED_CONDITIONS: dict[str, tuple[float, str]] = {
    "load [N]": (PUBLISHED_LOAD, "about, in the paper"),
    "mass of the pylon [kg]": (9.3, ""),
    "mass placed on the pylon [kg]": (19.0, ""),
    "duration of the hold [min]": (10.0, "about, in the paper"),
    "samples [1]": (float(PUBLISHED_FRAMES), ""),
    "rate [Hz]": (PUBLISHED_RATE, ""),
    "rest position limit [mm]": (8.0, "about, in the paper; its largest compression"),
    "clusters [1]": (4.0, ""),
    "edge of a tile [mm]": (30.0, ""),
    "markers per body [1]": (3.0, ""),
    "cluster channels in the objective [1]": (float(PUBLISHED_CHANNELS), ""),
    "cluster channels left out [1]": (float(len(PUBLISHED_LEFT_OUT)), ""),
    "largest force left out [N]": (1000.0, "above that, in the paper"),
}

OURS, THEIRS = "this trial", "the paper"
WITHOUT, WITH = "without offsets", "with offsets"
NOT_PRINTED = "not printed in the paper"
NOT_KNOWN = "not known from a trial"

_LOAD_TOLERANCE = 0.2  # [-]; for a comparable load
_RATE_TOLERANCE = 0.05  # [-]
_MAX_HOLD_DEVIATION = 10.0  # [N]; of the force


def beside_published(
    errors: Mapping[Variant, Sequence[ChannelErrors]],
    fronts: Mapping[Variant, Front],
    samples: Samples,
    settings: IdentificationSettings,
    geometry: SocketGeometry,
) -> pd.DataFrame:
    """The figures of the paper for a trial, next to the printed ones.

    Args:
        errors: Errors of the paper's two variants on every channel, the wrench's six first.
        fronts: Fronts of the two variants; empty to omit the thetas.
        samples: Samples of the fits.
        settings: Settings of the fits, whose `leave_out` marks channels that do not compare.
        geometry: The socket.

    Returns:
        One row per figure, indexed by its name and unit, the results before the conditions: the
        values without and with offsets for this trial and for the paper, NaN if unknown, and a
        remark: why the two are not comparable, or that the paper does not print the number.
    """
    both = [_figures(errors[variant], fronts.get(variant)) for variant in PAPER_VARIANTS]
    conditions = [*differing_conditions(samples, settings)]
    local = [error.in_objective for error in errors["stiffness"][6:]]
    rows = {}
    for name in both[0]:
        theirs = PUBLISHED.get(name, (_NAN, _NAN))
        differing = [*conditions]
        if name == MEDIAN and sum(local) != PUBLISHED_CHANNELS:
            differing.append(f"{sum(local)} of {len(local)} channels counted, {PUBLISHED_CHANNELS}")
        remark = _remark(name, theirs, differing, settings.leave_out)
        rows[name] = [*(ours[name] for ours in both), *theirs, remark]
    ours = _conditions(samples, errors["stiffness"], geometry, settings)
    for name, (printed, remark) in PUBLISHED_CONDITIONS.items():
        value = ours.get(name, _NAN)
        rows[name] = [value, value, printed, printed, remark if name in ours else NOT_KNOWN]
    frame = pd.DataFrame.from_dict(rows, orient="index")
    pairs = [(source, variant) for source in (OURS, THEIRS) for variant in (WITHOUT, WITH)]
    frame.columns = pd.MultiIndex.from_tuples([*pairs, ("", "remark")])
    frame.index.name = "figure"
    return frame


def _remark(
    name: str,
    theirs: tuple[float, float],
    differing: Sequence[str],
    left_out: Sequence[str],
) -> str:
    """The remark on a result: why it does not compare, and what the paper does not print."""
    channel = split_unit(name)[0].rpartition(" of ")[2]
    if channel in left_out:
        return "not comparable: left out of the objective"
    if channel in PUBLISHED_LEFT_OUT:
        return f"{NOT_PRINTED}: left out of its objective"
    without, with_offsets = np.isfinite(theirs)
    if not without and not with_offsets:
        return NOT_PRINTED
    parts = []
    if differing:
        parts.append(f"not comparable: {'; '.join(differing)} in the paper")
    if not (without and with_offsets):
        parts.append(f"{NOT_PRINTED} {WITHOUT if with_offsets else WITH}")
    return "; ".join(parts)


def _conditions(
    samples: Samples,
    errors: Sequence[ChannelErrors],
    geometry: SocketGeometry,
    settings: IdentificationSettings,
) -> dict[str, float]:
    """This trial's values of the `PUBLISHED_CONDITIONS` that a trial tells."""
    local = errors[len(WRENCH_CHANNELS) :]
    outside = [error.name for error in local if not error.in_objective]
    columns = [
        number
        for number, name in enumerate(samples.channels[len(WRENCH_CHANNELS) :])
        if name in outside
    ]
    left_out = np.abs(samples.local_forces.reshape(len(samples), -1)[:, columns])
    known = np.isfinite(left_out).any()
    force = force_magnitude(samples.wrench[samples.has_pose_and_wrench])
    return {
        "load [N]": float(np.median(force)),
        "samples [1]": float(len(samples)),
        "rate [Hz]": 1.0 / usual_period(samples.time),
        "rest position limit [mm]": 1e3 * settings.rest_position_limit,
        "clusters [1]": float(len(samples.clusters)),
        "edge of a tile [mm]": 1e3 * float(np.median(np.sqrt(geometry.areas))),
        "markers per body [1]": float(min(map(len, geometry.markers.values()))),
        "cluster channels in the objective [1]": float(len(local) - len(outside)),
        "cluster channels left out [1]": float(len(outside)),
        "largest force left out [N]": float(np.nanmax(left_out)) if known else _NAN,
    }


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
