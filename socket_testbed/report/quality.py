"""Data quality: triggers, gaps, drop-outs, noise, and the plateaus of the trial."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from socket_testbed.arrays import (
    GAP,
    BoolArray,
    FloatArray,
    StatusArray,
    gaps,
    runs,
    usual_period,
)
from socket_testbed.identification.noise import channel_noise, noise_groups
from socket_testbed.report.page import Heading, ReportFigure, Section, line_chart
from socket_testbed.report.results import Results
from socket_testbed.report.style import (
    THINNED,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
    thin,
)
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, Status
from socket_testbed.tables import Table, number
from socket_testbed.trials.segment import Segment

_MOST_GAPS = 5  # in the list
_LOAD, _DROP_OUTS, _DROP_OUTS_AXIS = 36.0, 4.5, 16.0  # [mm]
_BINS = 400  # of the trial's time
_CHOSEN, _OTHER = "0.80", "0.93"  # greys
_COLOURS = ("#0072B2", "#D55E00")  # of force and moment


def section(results: Results) -> Section:
    """The section on the data of a trial."""
    samples, limits = results.samples, results.settings.plateau
    noise = pd.DataFrame.from_dict(
        noise_groups(channel_noise(samples), samples.clusters), "index", columns=["x", "y", "z"]
    ).rename_axis("measurement")
    drop_outs = find_drop_outs(samples, results.segment)
    counts = dict.fromkeys(drop_outs, ".0f") | {"missing [%]": ".2f", "longest [s]": ".2f"}
    found = find_gaps(samples.time)
    listed = [f"{length:.3f} s from {start:.2f} s" for start, length in found[:_MOST_GAPS]]
    return Section(
        "quality",
        "Data quality",
        [
            f"{len(samples)} samples in {samples.time[-1]:.2f} s at"
            f" {number(1.0 / usual_period(samples.time))} Hz, {int(samples.complete.sum())} with a"
            f" wrench and a limb position; {len(found)} gaps longer than {GAP:g} periods.",
            listed,
            _overview(results),
            Table("drop-outs", "Samples of the trial without a measurement", drop_outs, counts),
            Heading("The segment"),
            f"Asked for: {results.specification}; in use: {results.segment}. A plateau, of which"
            f" 'plateau' is the longest, lasts {limits.least_duration:g} s or more under a steady"
            f" load of {limits.least_force:g} N or more; its limits are among the settings below.",
            _plateaus(results),
            Heading("Noise"),
            "From the third differences of the trial, without outliers and steps. Motion from"
            " sample to sample, such as the sway of a person, counts as noise.",
            Table(
                "noise",
                "Standard deviation of the noise of one sample, along each axis",
                noise,
                dict.fromkeys(noise, ".2g"),
            ),
        ],
    )


def find_gaps(time: FloatArray) -> list[tuple[float, float]]:
    """Starts and durations [s] of the gaps, the longest first."""
    periods, found = np.diff(time), np.flatnonzero(gaps(time))
    longest_first = found[np.argsort(-periods[found], kind="stable")]
    return [(float(time[i]), float(periods[i])) for i in longest_first]


def states(samples: Samples) -> dict[str, StatusArray]:
    """State of every measurement, shape (N,) each: the wrench, the limb position, the clusters.

    A cluster's channels come together, with its status; the others are there or missing.
    """
    lost = {name: np.isnan(samples.wrench[:, i]) for i, name in enumerate(WRENCH_CHANNELS)}
    lost["limb position"] = np.asarray(np.isnan(samples.position).any(axis=1))
    found = {name: np.where(of, Status.MISSING, Status.OK) for name, of in lost.items()}
    return found | {
        f"{name} ({', '.join(LOCAL_CHANNELS)})": samples.status[:, column]
        for column, name in enumerate(samples.clusters)
    }


def find_drop_outs(samples: Samples, segment: Segment) -> pd.DataFrame:
    """What each measurement lacks: a row per channel of the wrench, limb position and cluster.

    Saturated readings and those out of range are counted for the clusters, NaN for the others.
    """
    rows = {}
    for row, (name, state) in enumerate(states(samples).items()):
        missing = state == Status.MISSING
        is_cluster = row > len(WRENCH_CHANNELS)
        rows[name] = {
            "missing [1]": missing.sum(),
            "missing [%]": 100.0 * missing.mean(),
            "of them in the segment [1]": missing[segment.rows].sum(),
            "longest [s]": _longest(missing, samples.time),
            "saturated [1]": (state == Status.SATURATED).sum() if is_cluster else np.nan,
            "out of range [1]": (state == Status.OUT_OF_RANGE).sum() if is_cluster else np.nan,
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("measurement")


def _longest(missing: BoolArray, time: FloatArray) -> float:
    """Longest time without a value, from the last one to the next, within the trial [s]."""
    start, end = runs(missing).T
    before, after = np.maximum(start - 1, 0), np.minimum(end, len(time) - 1)
    return float((time[after] - time[before]).max(initial=0.0))


def mean_and_sigma(vectors: FloatArray) -> tuple[float, float]:
    """Magnitude of the mean of the whole vectors, shape (N, 3), and the spread of magnitudes."""
    vectors = vectors[np.isfinite(vectors).all(axis=1)]
    if not len(vectors):
        return float("nan"), float("nan")
    magnitude = float(np.linalg.norm(vectors.mean(axis=0)))
    return magnitude, float(np.linalg.norm(vectors, axis=1).std())


def _plateaus(results: Results) -> Table:
    rows = {}
    for part in (results.segment, *results.plateaus):
        wrench = results.samples.wrench[part.rows]
        loads = (*mean_and_sigma(wrench[:, 3:]), *mean_and_sigma(wrench[:, :3]))
        rows[f"{part.start:.2f} to {part.end:.2f}"] = [part.end - part.start, *loads]
    formats = {
        "duration [s]": ".2f",
        "mean force [N]": ".1f",
        "its sigma [N]": ".2f",
        "mean moment [N m]": ".2f",
        "its sigma [N m]": ".3f",
    }
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=[*formats])
    caption = "The segment, then the plateaus, the longest first"
    return Table("plateaus", caption, frame.rename_axis("from, to [s]"), formats)


def _overview(results: Results) -> ReportFigure:
    samples = results.samples
    lacking = {name: state != Status.OK for name, state in states(samples).items()}
    loads = {
        "force magnitude [N]": np.linalg.norm(samples.wrench[:, 3:], axis=1),
        "moment magnitude [N m]": np.linalg.norm(samples.wrench[:, :3], axis=1),
    }
    flags = {f"{name} not usable [-]": of.astype(int) for name, of in lacking.items()}
    charts = [{"title": title, "lines": {"measured": of}} for title, of in loads.items()]
    return ReportFigure(
        "overview",
        "The measured load over the trial, with the plateaus in light and the segment in use in"
        " darker grey; below, the share of samples in which a measurement could not be used: it"
        " was missing, saturated, or out of the calibrated range, where it would be an"
        f" extrapolation. {THINNED}",
        lambda style: _draw_overview(results, loads, lacking, style),
        results.series(loads | flags),
        line_chart(samples.time, charts),
    )


@in_style
def _draw_overview(
    results: Results,
    loads: Mapping[str, FloatArray],
    lacking: Mapping[str, BoolArray],
    style: FigureStyle,
) -> Figure:
    """The magnitudes of force and moment, and the share of samples that cannot be used."""
    time = results.samples.time
    raster = _DROP_OUTS * len(lacking) + _DROP_OUTS_AXIS
    figure = style.figure(2.0 * _LOAD + raster)
    *axes, lowest = figure.subplots(3, 1, sharex=True, height_ratios=(_LOAD, _LOAD, raster))
    spans = [*((part, _OTHER) for part in results.plateaus), (results.segment, _CHOSEN)]
    for axis, (name, load), colour in zip(axes, loads.items(), _COLOURS, strict=True):
        for part, grey in spans:
            axis.axvspan(part.start, part.end, color=grey, linewidth=0.0)
        axis.plot(*thin(time, load), color=colour, linewidth=1.0)
        axis.set_ylabel(name.replace(" [", "\n["))
        style_axes(axis)
    count = max(1, min(_BINS, len(time) // 2))
    edges = np.linspace(time[0], max(time[-1], time[0] + 1e-3), count + 1)
    triggers, _ = np.histogram(time, edges)
    lost = [np.histogram(time, edges, weights=1.0 * of)[0] for of in lacking.values()]
    # Without a trigger nothing was measured at all.
    share = np.where(triggers > 0, np.array(lost) / np.maximum(triggers, 1), 1.0)
    rows = np.arange(len(lacking) + 1) - 0.5
    mesh = lowest.pcolormesh(edges, rows, share, cmap="Greys", vmin=0.0, vmax=1.0, rasterized=True)
    lowest.set_yticks(range(len(lacking)), list(lacking), parse_math=False)
    lowest.invert_yaxis()
    lowest.set_xlabel("time [s]")
    figure.colorbar(mesh, ax=lowest, pad=0.01, aspect=12).set_label("not usable [-]")
    return lay_out(figure)
