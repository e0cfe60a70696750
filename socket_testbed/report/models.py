"""Models of a trial: their predictions, errors, and parameters on the tiles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.channels import FORCES_FIRST, wrench_figure
from socket_testbed.figures.engagement import engagement_figure
from socket_testbed.figures.style import THINNED
from socket_testbed.figures.tiles import tile_map_figure
from socket_testbed.identification.channel_errors import QUOTED, ChannelErrors, summarise_errors
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.paper import THEIRS
from socket_testbed.pages.document import numbers
from socket_testbed.report.page import Heading, ReportFigure, Section, line_chart
from socket_testbed.results.models import Evaluation
from socket_testbed.results.report import GIVEN, Results
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit
from socket_testbed.settings.identification import BIAS_VARIANTS
from socket_testbed.tables import Table, number, split_unit

ERRORS_FILE = "errors.csv"  # in the folder of every report, which it marks as one

_MEASURES = {"RMSE": "rmse", "MAE": "mae", "sigma": "sigma", "skill [-]": "skill"}


def section(results: Results) -> Section:
    """The section on the fitted models."""
    return Section("models", "Fitted models", [describe_models(results)])


def describe_models(results: Results) -> list[str]:
    """A statement on the segment, and one on every model."""
    load = results.quality.loads.frame.iloc[0]
    force, moment = load["mean force [N]"], load["mean moment [N m]"]
    return [
        f"Fitted to the segment, {results.segment}: {int(results.in_segment.sum())} of"
        f" {len(results.samples)} samples, mean force {number(force)} N, mean moment"
        f" {number(moment)} N m. Errors over it are {results.judged_on}, those over the rest"
        " held-out.",
        *(_describe(label, found) for label, found in results.candidates.items()),
    ]


def _describe(label: str, candidate: Evaluation) -> str:
    parts = []
    segment = "in-sample" if candidate.in_sample else "over the segment"
    for title, errors in ((segment, candidate.errors), ("held-out", candidate.held_out)):
        if errors:
            found = summarise_errors(errors)
            parts.append(f"{title}: {found.in_words()}, median skill {number(found.skill, 'z.2f')}")
    model = candidate.model.model
    of_wrench = model.of_wrench
    offset = float(np.linalg.norm(model.wrench_bias[3:]))
    if of_wrench is not None:
        parts.append(
            f"its wrench is predicted by {of_wrench.name}, not by the springs on the tiles"
        )
    elif offset > 0.0:
        parts.append(f"its constant force, carried by no tile, {number(offset)} N")
    return f"{label}: {'; '.join(parts)}."


def wrench_section(results: Results) -> Section:
    """The section on the wrench."""
    figure = _channels(results, "wrench", "Measured and predicted wrench", FORCES_FIRST)
    return Section("wrench", "Wrench", [figure])


def local_section(results: Results) -> Section:
    """The section on the local forces."""
    local = range(len(WRENCH_CHANNELS), len(results.samples.channels))
    title = "Measured and predicted forces in the clusters' frames"
    return Section("local", "Local forces", [_channels(results, "local_forces", title, local)])


def paper_section(results: Results) -> Section:
    """The section that compares the trial with the paper."""
    frame = results.paper.to_dataframe()
    known = frame[frame[THEIRS].notna().any(axis=1)]
    caption = "The figures of the paper, for its variants; 'paper' computes more, with its settings"
    table = Table("paper", caption, known, {THEIRS: ".2f"})
    return Section("paper-section", "This trial and the paper", [table])


def errors_section(results: Results) -> Section:
    """The section on the errors of every model, over the segment and over the rest."""
    parts = [
        f"Errors over the segment used for the fits: {results.judged_on}. Sigma is the standard"
        " deviation of the residual; skill is 1 - RMSE / RMSE of the best constant: 1 is perfect, 0"
        " no better than the channel's mean over these samples.",
        _errors(
            "errors",
            f"Errors over the segment ({results.judged_on}), in the unit of the channel",
            {label: found.errors for label, found in results.candidates.items()},
        ),
    ]
    judged = {label: found.held_out for label, found in results.candidates.items()}
    held_out = {label: errors for label, errors in judged.items() if errors}
    if held_out:
        caption = "Errors over the rest of the trial (held-out), in the unit of the channel"
        parts += [
            Heading("Held-out: the rest of the trial"),
            "Samples of the same trial outside the segment, not used for the fits: other loads and"
            " the changes between them, but the same session, so no substitute for another trial.",
            _errors("held-out", caption, held_out),
        ]
    every = pd.DataFrame(
        {
            "model": label,
            "samples of": part,
            "channel": error.name,
            "unit of RMSE, MAE, sigma": error.unit,
            "in objective": int(error.in_objective),
            "samples [1]": error.samples,
            **{title: getattr(error, field) for title, field in _MEASURES.items()},
        }
        for label, found in results.candidates.items()
        for part, errors in (("segment", found.errors), ("rest", found.held_out))
        for error in errors
    )
    return Section("errors-section", "Errors", parts, {ERRORS_FILE: every})


def _errors(name: str, caption: str, errors: Mapping[str, Sequence[ChannelErrors]]) -> Table:
    """Errors of models by label, a row per channel, then the summaries quoted by the paper."""
    rows = {
        channel[0].name: [
            channel[0].unit,
            *(getattr(error, field) for error in channel for field in _MEASURES.values()),
            _remark([*errors], channel),
        ]
        for channel in zip(*errors.values(), strict=True)
    }
    summaries = [*map(summarise_errors, errors.values())]
    none = [np.nan] * 3
    for field, title in QUOTED.items():
        figure, unit = split_unit(title)
        cells = [cell for summary in summaries for cell in (summary.quoted[field], *none)]
        rows[f"{figure} in the objective"] = [unit, *cells, ""]
    skills = [cell for summary in summaries for cell in (*none, summary.skill)]
    rows["median skill in the objective"] = ["-", *skills, ""]
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("channel")
    labels = [(label, title) for label in errors for title in _MEASURES]
    frame.columns = pd.MultiIndex.from_tuples([("", "unit"), *labels, ("", "remark")])
    return Table(name, caption, frame)


def _remark(labels: Sequence[str], errors: Sequence[ChannelErrors]) -> str:
    """The models without this channel in their objective."""
    pairs = zip(labels, errors, strict=True)
    left_out = [label for label, error in pairs if not error.in_objective]
    if len(left_out) in (0, len(errors)):
        return "not in objective" if left_out else ""
    return f"not in objective of {', '.join(left_out)}"


def _channels(results: Results, name: str, title: str, channels: Sequence[int]) -> ReportFigure:
    samples, measured = results.samples, results.samples.trusted_values
    columns: dict[str, FloatArray] = {}
    charts = []
    for i in channels:
        channel, unit = samples.channels[i], channel_unit(samples.channels[i])
        predicted = {label: found.predicted[:, i] for label, found in results.candidates.items()}
        columns[f"{channel} measured [{unit}]"] = measured[:, i]
        for label, values in predicted.items():
            columns[f"{channel} predicted {label} [{unit}]"] = values
        lines = {"measured": measured[:, i]} | predicted
        charts.append({"title": f"{channel} [{unit}]", "lines": lines})
    models = [(label, found.predicted, found.errors) for label, found in results.candidates.items()]
    heading = results.title(title)
    return ReportFigure(
        name,
        f"{title}; {results.segment} is shaded. Figures for print of a page's width add the errors"
        f" ({results.judged_on}). {THINNED}",
        lambda style: wrench_figure(samples, results.segment, models, heading, style, channels),
        results.series(columns),
        line_chart(samples.time, charts, [results.segment]),
    )


def surface_section(results: Results) -> Section:
    """The section on the models' parameters on the tiles."""
    text = (
        "The map at the top of the page also shows these parameters. For a rigid variant, they are"
        " in the tile's own frame (z along the inward normal), with rest positions relative to the"
        " reference pose; for the paper's variants, in {S}, with rest positions relative to the"
        " mean limb position of the segment. A cluster's offset is in its tile's frame; the"
        " wrench's offset belongs to no tile. Channels outside the objective have no offset."
    )
    offsets = _offsets(results)
    caption = "Constant offsets, added to the springs' predictions"
    models = [found.model.model for found in results.candidates.values()]
    if any(model.of_wrench is not None for model in models):
        caption += "; where another model predicts the wrench, its own offsets count"
    shown = Table("offsets", caption, offsets)
    return Section(
        "surface",
        "Parameters on the socket's surface",
        [text, *_tile_maps(results), _engaged_springs(results), shown],
        {"engaged_tiles.csv": _engaged_tiles(results), "offsets.csv": offsets},
    )


def model_values(results: Results, model: ContactModel) -> dict[str, dict[str, Any]]:
    """Parameters of a model on the n tiles for the map, by name.

    Args:
        results: The results of the trial, for the limb's mean position.
        model: The model.

    Returns:
        `values`, n numbers, and their `unit`, by name: stiffnesses [N/m] along x, y and z of {S},
        in the rigid variants of the tile's frame {L}; and rest positions [mm] along these axes
        from the limb's mean position over the segment, or from the reference pose.
    """
    frame = model.frame
    kinds = [
        ("stiffness", "N/m", model.stiffness),
        ("rest position", "mm", _rest_offsets(results, model)),
    ]
    return {
        f"{kind} along {axis} of {frame} [{unit}]": {"values": numbers(column), "unit": unit}
        for kind, unit, values in kinds
        for axis, column in _by_axis(values)
    }


def _rest_offsets(results: Results, model: ContactModel) -> FloatArray:
    """Rest displacements, or rest positions from the mean one of the limb, shape (n, 3) [mm]."""
    if model.law.IN_TILES:
        return 1e3 * model.rest_positions
    return 1e3 * (model.rest_positions - results.limb_position)


def _tile_maps(results: Results) -> Iterator[ReportFigure]:
    """Stiffnesses of every model, and its rest positions unless equal to the previous one's."""
    shown: FloatArray | None = None
    for label, candidate in results.candidates.items():
        model = candidate.model.model
        name, title = f"tile_stiffness_{label}", f"Stiffness of every tile, model {label}"
        yield _tile_map(results, model, name, title, model.stiffness, "k", "stiffness [N/m]")
        if shown is None or not np.array_equal(model.rest_positions, shown):
            shown = model.rest_positions
            shared = label != GIVEN and not model.law.IN_TILES
            name = "rest_positions" if shared else f"rest_positions_{label}"
            whose = "the same for the paper's variants" if shared else f"model {label}"
            values, title = _rest_offsets(results, model), f"Rest positions, {whose}"
            origin = "reference pose" if model.law.IN_TILES else "mean limb position"
            quantity = f"rest position from the {origin} [mm]"
            yield _tile_map(results, model, name, title, values, "q_r", quantity)


def _tile_map(
    results: Results,
    model: ContactModel,
    name: str,
    title: str,
    values: FloatArray,
    symbol: str,
    quantity: str,
) -> ReportFigure:
    """Maps of a quantity on the tiles along x, y, z, shape (n, 3)."""
    geometry, frame = results.trial.geometry, model.frame
    described, unit = split_unit(quantity)
    columns = {f"anchor {axis} in S [m]": column for axis, column in _by_axis(geometry.anchors)}
    columns |= {f"{described} {axis} [{unit}]": column for axis, column in _by_axis(values)}
    maps = {f"{symbol} along {axis} of {frame}": column for axis, column in _by_axis(values)}
    heading, side = f"{results.trial.name}: {title}", results.metadata.side
    return ReportFigure(
        name,
        f"{title}, along the axes of {frame}; the wall is unrolled and seen from outside. Tiles"
        " with a cluster are outlined.",
        lambda style: tile_map_figure(geometry, maps, quantity, heading, style, side=side),
        pd.DataFrame({"tile": geometry.names, "cluster": geometry.cluster_names, **columns}),
    )


def _by_axis(values: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    return zip("xyz", values.T, strict=True)


def _engaged_springs(results: Results) -> ReportFigure:
    """Engaged springs of every model, over time and over the socket."""
    models = {label: found.engagement() for label, found in results.candidates.items()}
    columns = [found.columns(f"{label}.springs.") for label, found in models.items()]
    return ReportFigure(
        "engaged_springs",
        "Engaged springs (compressed, with a stiffness above zero), and uncertain ones, which one"
        " standard deviation of the pose's noise can switch. The maps show the share of time in"
        " the shaded segment with the springs of a tile engaged; engaged_tiles.csv holds it for"
        f" each spring. {THINNED}",
        lambda style: engagement_figure(
            results.trial.geometry,
            results.samples.time,
            models,
            results.segment,
            results.title("Engaged springs"),
            style,
            results.metadata.side,
        ),
        results.series({name: share for found in columns for name, share in found.items()}),
    )


def _engaged_tiles(results: Results) -> pd.DataFrame:
    """Share of time on the segment with each spring engaged, a row per tile."""
    columns: dict[str, Any] = {"tile": results.trial.geometry.names}
    for label, candidate in results.candidates.items():
        gates = candidate.model.model.law.GATES
        axes = ["normal"] if gates == (2,) else ["xyz"[axis] for axis in gates]
        names = [f"{label}.{axis} engaged [-]" for axis in axes]
        columns |= dict(zip(names, candidate.engagement().time_share.T, strict=True))
    return pd.DataFrame(columns)


def _offsets(results: Results) -> pd.DataFrame:
    samples, zero = results.samples, np.zeros(3)
    models = {label: found.model.model for label, found in results.candidates.items()}
    columns = {
        f"offset {label} [unit of the row]": np.concatenate(
            [model.wrench_bias, *(model.force_bias.get(name, zero) for name in samples.clusters)]
        )
        for label, model in models.items()
        if model.variant in BIAS_VARIANTS
    }
    units = [channel_unit(name) for name in samples.channels]
    index = pd.Index(samples.channels, name="channel")
    return pd.DataFrame({"unit": units, **columns}, index=index)
