"""The figures of a report: what each shows, its files, and its data.

To add a figure, write a function of the results that yields a `ReportFigure`, and list it in
`FIGURES` under the section of the page that shows it.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.evaluation import trusted_values
from socket_testbed.identification.pareto import front_table
from socket_testbed.identification.pressure import of_deviations
from socket_testbed.identification.validation import judgements_table
from socket_testbed.report.figures.channels import (
    FORCES_FIRST,
    MOST_POINTS,
    Panel,
    Prediction,
    offsets_figure,
    overview_figure,
    panels_figure,
)
from socket_testbed.report.figures.pareto import pareto_figure
from socket_testbed.report.figures.pressure import (
    instant_maps,
    pressure_maps_figure,
    pressure_views_figure,
    region_bands,
    regions_figure,
)
from socket_testbed.report.figures.scene import Scene, TileValues, value_scene
from socket_testbed.report.figures.style import (
    COLUMN,
    DEFAULT_STYLE,
    FigureStyle,
    save_figure,
    svg_of,
)
from socket_testbed.report.figures.tile_maps import force_map_figure, tile_map_figure
from socket_testbed.report.figures.validation import validation_figure
from socket_testbed.report.results import Candidate, Results, unusable
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, channel_unit
from socket_testbed.settings.identification import BIAS_VARIANTS
from socket_testbed.tables import write_table

_PICTURES = (".pdf", ".png")
_AXES = "xyz"
_MAP_SHARE = 1.0  # [-]; as `SHARE` of pressure, in pictures: what is determined is not zero
_THINNED = (
    f"Lines of more than {MOST_POINTS} samples are drawn by the lowest and highest value of equally"
    " many, so every peak shows; the CSV holds all."
)


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report.

    Attributes:
        name: Name of its files.
        caption: What is to be seen.
        draw: Draws the figure; takes its `style`.
        description: What it shows, in words for who cannot see it.
        data: Its data, with units in the names of the columns.
        layout: How its pictures are laid out on the page: `panels`, `wide` or `single`.
        is_map: Whether its colours stand for values: on a dark page they stay as they are.
        panels: Pictures that the page shows in its place, each with its description.
    """

    name: str
    caption: str
    draw: Callable[..., Figure]
    description: str
    data: pd.DataFrame
    layout: str = "single"
    is_map: bool = False
    panels: tuple[tuple[Figure, str], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "draw", cache(self.draw))  # for the page and for its files

    @property
    def files(self) -> list[str]:
        """Names of its files."""
        return [f"{self.name}{suffix}" for suffix in (*_PICTURES, ".csv")]

    @property
    def pictures(self) -> list[tuple[str, str]]:
        """What the page shows: pictures as SVG with their descriptions."""
        shown = self.panels or ((self.draw(style=DEFAULT_STYLE), self.description),)
        return [(svg_of(figure), description) for figure, description in shown]

    def write(self, folder: Path, style: FigureStyle, worker: Executor) -> Future[None]:
        """Write its data, and have a worker process write the figure in a style."""
        write_table(self.data, folder / f"{self.name}.csv")
        # Packed here and now: the page draws the same figure meanwhile.
        return worker.submit(_save_pictures, pickle.dumps(self.draw(style=style)), self._at(folder))

    def write_here(self, folder: Path, style: FigureStyle) -> None:
        """Write the figure in this process."""
        _save_pictures(pickle.dumps(self.draw(style=style)), self._at(folder))

    def _at(self, folder: Path) -> list[Path]:
        return [folder / f"{self.name}{suffix}" for suffix in _PICTURES]


def _save_pictures(packed: bytes, paths: Sequence[Path]) -> None:
    """Write a pickled figure in the formats of some paths."""
    figure = pickle.loads(packed)
    for path in paths:
        save_figure(figure, path)


def wrench(results: Results) -> Iterator[ReportFigure]:
    """The wrench, a panel per channel."""
    yield _channels(results, "wrench", "Measured and predicted wrench", FORCES_FIRST)


def local_forces(results: Results) -> Iterator[ReportFigure]:
    """The local forces, a panel per channel."""
    local = range(len(WRENCH_CHANNELS), len(results.samples.channels))
    title = "Measured and predicted forces in the clusters' frames"
    yield _channels(results, "local_forces", title, local)


def overview(results: Results) -> Iterator[ReportFigure]:
    """The trial at a glance."""
    samples, lacking = results.samples, unusable(results.samples)
    columns = {
        "force magnitude [N]": np.linalg.norm(samples.wrench[:, 3:], axis=1),
        "moment magnitude [N m]": np.linalg.norm(samples.wrench[:, :3], axis=1),
    }
    columns |= {f"{name} not usable [-]": flags.astype(int) for name, flags in lacking.items()}
    yield ReportFigure(
        name="overview",
        caption=(
            "The measured load over the trial, with the plateaus in light and the segment in use in"
            " darker grey; below, the share of samples in which a measurement could not be used"
            f" (missing, saturated or out of range). {_THINNED}"
        ),
        draw=partial(
            overview_figure,
            samples.time,
            samples.wrench,
            [(part.start, part.end) for part in results.plateaus],
            (results.segment.start, results.segment.end),
            lacking,
        ),
        description=(
            "Magnitudes of the measured force and moment over time, and drop-outs by measurement"
        ),
        data=_series(results, columns),
    )


def pareto(results: Results) -> Iterator[ReportFigure]:
    """The fronts of the paper's variants, if there are any."""
    fronts = [*results.fronts.values()]
    if fronts:
        yield ReportFigure(
            name="pareto",
            caption=(
                "Normalised error of the clusters against that of the wrench over theta; both are"
                " the square roots of the terms of the objective, 1 stands for predicting zero."
                " Dominated solutions are faint."
            ),
            draw=partial(pareto_figure, fronts, _title(results, "Trade-off")),
            description=(
                "Pareto fronts of the paper's variants with the sensor-only, knee, wrench-only"
                " solutions"
            ),
            data=front_table(fronts),
            layout="wide",
        )


def validation(results: Results) -> Iterator[ReportFigure]:
    """Errors of forces that the estimates have not seen, if they were judged."""
    if results.validation:
        yield ReportFigure(
            name="validation",
            caption=(
                "Left: error of the forces on each cluster that was left out, over the root mean"
                " square of all clusters' forces, and on the tiles without a sensor where a"
                " simulation knows them. Right: share of the values within the force map's"
                " intervals; on the line, its uncertainty is right."
            ),
            draw=partial(
                validation_figure, results.validation, f"{results.trial.name}: Validation"
            ),
            description=(
                "Bars of the relative error by cluster for the force map and inverse distance, and"
                " the coverage of the force map's intervals"
            ),
            data=judgements_table(results.validation),
            layout="wide",
        )


def tile_maps(results: Results) -> Iterator[ReportFigure]:
    """The stiffnesses of every model, and its rest positions unless they are the last one's."""
    shown: FloatArray | None = None
    for candidate in results.candidates:
        model, label = candidate.model, candidate.label
        yield _tile_map(
            results,
            f"tile_stiffness_{label}",
            f"Stiffness, model {label}",
            f"Stiffness of every tile along the axes of {_frame(candidate)}, model {label}; the"
            " wall is unrolled and seen from outside. Tiles with a cluster are outlined.",
            model.stiffness,
            ("k", "stiffness", "N/m"),
            _frame(candidate),
        )
        if shown is None or not np.array_equal(model.rest_positions, shown):
            shown = model.rest_positions
            fitted = candidate.fit is not None and not model.is_rigid
            whose = "the same for the paper's variants" if fitted else f"model {label}"
            yield _tile_map(
                results,
                "rest_positions" if fitted else f"rest_positions_{label}",
                f"Rest positions, {whose}",
                f"Rest positions along the axes of {_frame(candidate)} from the"
                f" {'reference pose' if model.is_rigid else 'mean limb position of the segment'}"
                f" ({whose}): where a tile would begin to press.",
                _rest_offsets(results, candidate),
                ("q_r", "rest position from the mean limb position", "mm"),
                _frame(candidate),
            )


def pressure_maps(results: Results) -> Iterator[ReportFigure]:
    """Pressure over the segment and at its peak, unrolled and in 3D."""
    geometry, found = results.trial.geometry, results.pressure
    maps, determined = instant_maps(found.outputs, found.time, _MAP_SHARE, results.segment.kind)
    uncertain = (
        "Hatched, pale tiles are not determined: their 95 % interval reaches farther than the value"
        " itself. Tiles with a cluster are outlined."
    )
    values = {
        f"{name} [kPa]": np.where(determined[name], pressure, np.nan)
        for name, pressure in maps.items()
    }
    estimates = {f"{name}, estimate [kPa]": pressure for name, pressure in maps.items()}
    for name, draw, caption in (
        ("pressure_map", pressure_maps_figure, "Pressure on the unrolled socket"),
        ("pressure_views", pressure_views_figure, "The same in 3D, from in front and from behind"),
    ):
        yield ReportFigure(
            name=name,
            caption=f"{caption}, {results.segment}. {uncertain}",
            draw=partial(draw, geometry, maps, found.side or "", determined=determined),
            description=f"{caption}: the mean over the segment, and at its peak",
            data=pd.DataFrame({"tile": geometry.names, **values, **estimates}),
            layout="wide",
            is_map=True,
        )


def pressure_of_regions(results: Results) -> Iterator[ReportFigure]:
    """Pressure of the regions over the segment."""
    found = results.pressure
    bands = region_bands(found.outputs.mean_pressure(), [place.name for place in found.places])
    events = [(event.time, event.label) for event in results.events]
    columns = {
        f"{name}.mean pressure{end} [kPa]": values
        for name, band in bands.items()
        for end, values in (("", band.values), (" low", band.low), (" high", band.high))
    }
    yield ReportFigure(
        name="pressure_of_regions",
        caption=(f"Mean pressure of the regions over the segment, with 95 % intervals. {_THINNED}"),
        draw=partial(regions_figure, found.time, bands, events),
        description="Mean pressure of every region over the segment with its interval",
        data=pd.DataFrame({"time [s]": found.time, **columns}),
        layout="wide",
    )


def force_map(results: Results) -> Iterator[ReportFigure]:
    """The mean force map over the segment with its uncertainty."""
    geometry, outputs = results.trial.geometry, results.pressure.outputs
    mean = outputs.force_map.mean(outputs.samples)
    yield ReportFigure(
        name="force_map",
        caption=(
            "Mean normal pressure over the segment on every tile, and the standard deviation of its"
            f" error. {mean.source}. Pale tiles are uncertain; tiles with a cluster are outlined."
        ),
        draw=partial(force_map_figure, geometry, mean, _title(results, "Force map")),
        description="Normal pressure on the unrolled socket, and its standard deviation below",
        is_map=True,
        data=pd.DataFrame(
            {
                "tile": geometry.names,
                "pressure [kPa]": 1e-3 * mean.normal_pressure[0],
                "pressure.sd [kPa]": 1e-3 * mean.normal_pressure_standard_deviation[0],
                "shear [kPa]": 1e-3 * mean.shear[0],
                "shear.sd [kPa]": 1e-3 * mean.shear_standard_deviation[0],
            }
        ),
    )


def offsets(results: Results) -> Iterator[ReportFigure]:
    """The offsets of the models that have some."""
    samples = results.samples
    zero = np.zeros(3)
    by_label = {
        label: np.concatenate(
            [model.wrench_bias, *(model.force_bias.get(name, zero) for name in samples.clusters)]
        )
        for label, model in ((c.label, c.model) for c in results.candidates)
        if model.variant in BIAS_VARIANTS
    }
    columns = {f"offset {label} [unit of the row]": values for label, values in by_label.items()}
    units = [channel_unit(name) for name in samples.channels]
    yield ReportFigure(
        name="offsets",
        caption=(
            "The constant offsets of the models with offsets: of the wrench, and of each cluster"
            " in its own frame. They are added to what the springs predict; a channel that is not"
            " in the objective has none."
        ),
        draw=partial(offsets_figure, samples.channels, by_label),
        description="Bars of the fitted offset of every channel",
        data=pd.DataFrame({"channel": samples.channels, "unit": units, **columns}),
    )


# The figures by the section of the page that shows them, in their order there.
FIGURES: dict[str, tuple[Callable[[Results], Iterator[ReportFigure]], ...]] = {
    "pressure": (pressure_maps,),
    "pressure-over-time": (pressure_of_regions,),
    "force-map": (force_map,),
    "wrench": (wrench,),
    "local": (local_forces,),
    "validation": (validation,),
    "fronts": (pareto,),
    "surface": (tile_maps, offsets),
    "quality": (overview,),
}


def draw_figures(results: Results) -> dict[str, list[ReportFigure]]:
    """The figures of a report by section."""
    return {
        section: [figure for make in makers for figure in make(results)]
        for section, makers in FIGURES.items()
    }


def errors_table(candidates: Sequence[Candidate]) -> pd.DataFrame:
    """The errors of every model, over the segment and the rest, a row per channel."""
    return pd.DataFrame(
        {
            "model": candidate.label,
            "samples of": part,
            "channel": error.name,
            "unit of RMSE, MAE, sigma": error.unit,
            "in objective": int(error.in_objective),
            "samples [1]": error.samples,
            "RMSE": error.rmse,
            "MAE": error.mae,
            "sigma": error.sigma,
            "skill [-]": error.skill,
        }
        for candidate in candidates
        for part, errors in (("segment", candidate.errors), ("rest", candidate.held_out))
        for error in errors
    )


def residuals_table(candidates: Sequence[Candidate]) -> pd.DataFrame:
    """What the residuals have in common, a row per model and channel."""
    return pd.DataFrame(
        {
            "model": candidate.label,
            "channel": error.name,
            "samples [1]": common.samples,
            "lag-1 autocorrelation [-]": common.lag_one,
            "decorrelation time [s]": common.decorrelation,
            "effective samples [1]": common.effective,
        }
        for candidate in candidates
        for error, common in zip(candidate.errors, candidate.residuals, strict=True)
    )


def surface_scene(results: Results) -> Scene:
    """The tiles in 3D, in the colours of their pressure over time or of a model's parameters."""
    sets = {"force map": _pressure_values(results)} | {
        candidate.label: _scene_values(results, candidate) for candidate in results.candidates
    }
    return value_scene(
        results.trial.geometry, sets, "The tiles of the socket in the colours of their pressure"
    )


def _pressure_values(results: Results) -> dict[str, TileValues]:
    """Pressure and shear on the tiles, where they are determined, by the name of the choice."""
    found = results.pressure
    over_trial = found.over_trial
    pressures = of_deviations(
        over_trial.normal_pressure, over_trial.normal_pressure_standard_deviation
    )
    shears = of_deviations(over_trial.shear, over_trial.shear_standard_deviation)
    start = int(np.searchsorted(found.instants, found.peak_time))
    values = {
        f"{name}, mean over the segment": TileValues(
            f"mean {name} [kPa]", 1e-3 * quantity.masked(_MAP_SHARE)
        )
        for name, quantity in (
            ("pressure", found.outputs.tiles.mean),
            ("shear", found.outputs.tiles.shear),
        )
    }
    return values | {
        f"{name} over the trial": TileValues(
            f"{name} [kPa]", 1e-3 * quantity.masked(_MAP_SHARE), found.instants, start
        )
        for name, quantity in (("pressure", pressures), ("shear", shears))
    }


def _scene_values(results: Results, candidate: Candidate) -> dict[str, TileValues]:
    """Parameters of a model on the tiles, by the name of the choice."""
    model, frame = candidate.model, _frame(candidate)
    kinds = [
        ("stiffness", "N/m", model.stiffness),
        ("rest position", "mm", _rest_offsets(results, candidate)),
    ]
    values = {
        f"{kind} {axis} [{unit}]": TileValues(
            f"{kind} along {axis} of {frame} [{unit}]", of_tiles[:, i]
        )
        for kind, unit, of_tiles in kinds
        for i, axis in enumerate(_AXES)
    }
    if model.variant in BIAS_VARIANTS:
        bias = np.full_like(model.stiffness, np.nan)
        for cluster, force in model.force_bias.items():
            bias[model.cluster_points[cluster]] = force
        for i, channel in enumerate(LOCAL_CHANNELS):
            title = f"offset {channel} in the cluster's frame [N]"
            values[f"offset {channel} [N]"] = TileValues(title, bias[:, i])
    return values


def _frame(candidate: Candidate) -> str:
    """The frame of a model's stiffnesses and rest positions."""
    return "the tile's frame" if candidate.model.is_rigid else "{S}"


def _rest_offsets(results: Results, candidate: Candidate) -> FloatArray:
    """Rest positions from the mean limb position, in `_frame`, shape (n, 3) [mm]."""
    if candidate.model.is_rigid:
        return 1e3 * candidate.model.rest_positions
    return 1e3 * (candidate.model.rest_positions - results.mean_position)


def _tile_map(
    results: Results,
    name: str,
    title: str,
    caption: str,
    values: FloatArray,
    kind: tuple[str, str, str],
    frame: str,
) -> ReportFigure:
    """Maps of values of the tiles, shape (n, 3), of a symbol, a quantity and a unit, in a frame."""
    symbol, quantity, unit = kind
    geometry = results.trial.geometry
    clusters = {tile: cluster for cluster, tile in geometry.clusters.items()}
    columns = {f"anchor {axis} in S [m]": geometry.anchors[:, i] for i, axis in enumerate(_AXES)}
    columns |= {f"{quantity} {axis} [{unit}]": values[:, i] for i, axis in enumerate(_AXES)}
    return ReportFigure(
        name=name,
        caption=caption,
        draw=partial(
            tile_map_figure,
            geometry,
            {f"{symbol} along {axis} of {frame}": values[:, i] for i, axis in enumerate(_AXES)},
            f"{quantity} [{unit}]",
            f"{results.trial.name}: {title}",
        ),
        description=f"{title}: tiles of the unrolled socket in the colours of their values",
        is_map=True,
        data=pd.DataFrame(
            {
                "tile": geometry.names,
                "cluster": [clusters.get(tile, "") for tile in range(len(geometry))],
                **columns,
            }
        ),
        layout="wide",
    )


def _channels(results: Results, name: str, title: str, channels: Sequence[int]) -> ReportFigure:
    panels = [_panel(results, i) for i in channels]
    measured = trusted_values(results.samples)
    columns: dict[str, FloatArray] = {}
    for i in channels:
        channel = results.samples.channels[i]
        unit = channel_unit(channel)
        columns[f"{channel} measured [{unit}]"] = measured[:, i]
        for candidate in results.candidates:
            columns[f"{channel} predicted {candidate.label} [{unit}]"] = candidate.predicted[:, i]
    return ReportFigure(
        name=name,
        caption=(
            f"{title}, {results.segment}; the errors in the panels are over the shaded segment, to"
            f" which the variants were fitted (in-sample). {_THINNED}"
        ),
        draw=partial(panels_figure, panels, 3, _title(results, title)),
        description=title,
        data=_series(results, columns),
        layout="panels",
        panels=tuple(
            (panels_figure([panel], 1, style=FigureStyle(COLUMN)), _describe(panel))
            for panel in panels
        ),
    )


def _panel(results: Results, channel: int) -> Panel:
    return Panel(
        time=results.samples.time,
        measured=trusted_values(results.samples)[:, channel],
        predictions=tuple(
            Prediction(c.label, c.predicted[:, channel], c.errors[channel])
            for c in results.candidates
        ),
        span=(results.segment.start, results.segment.end),
    )


def _describe(panel: Panel) -> str:
    errors = ", ".join(
        f"{p.label} RMSE {p.errors.rmse:.3g} {panel.unit}" for p in panel.predictions
    )
    return f"{panel.name} [{panel.unit}] over time, measured and predicted: {errors}"


def _series(results: Results, columns: dict[str, FloatArray]) -> pd.DataFrame:
    """Columns of the samples behind their stamps and times."""
    samples = results.samples
    first = {
        "stamp [ns]": samples.stamps,
        "time [s]": samples.time,
        "in segment": results.in_segment.astype(int),
    }
    return pd.DataFrame(first | columns)


def _title(results: Results, what: str) -> str:
    return f"{results.trial.name}: {what}, {results.segment}"
