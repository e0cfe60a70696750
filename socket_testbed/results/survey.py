"""A survey of one limb: single maps judged by moved clusters, and the map completed from all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from socket_testbed.arrays import NORMAL_QUANTILE, FloatArray, rms
from socket_testbed.documents import finite_or_null
from socket_testbed.figures.style import FigureStyle
from socket_testbed.figures.tiles import pressure_limits, tile_map_figure
from socket_testbed.geometry.regions import DISTAL_END, anatomical_regions, place_of
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import survey as numerics
from socket_testbed.identification.survey import Field, Interval, JudgedPoint, Judgements
from socket_testbed.identification.survey_prior import FORMAT, SurveyPrior
from socket_testbed.identification.validation import LEVELS
from socket_testbed.results.result import Result, records
from socket_testbed.settings.options import Side
from socket_testbed.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BANDS = (0.0, 0.04, 0.06, np.inf)  # [m]; distances from the nearest cluster
LIMB = "limb"
"""Name of the map of what all donnings share."""
LEGEND = (
    "error: rms difference between the map of one trial and what clusters measured elsewhere in"
    " another, over the rms of the measured forces; rival: inverse distance with the wrench"
    " matched; bias: how much too hard the map presses; in 50, 80, 95 %: share of the measured"
    " values within these intervals of map and sensor"
)


@dataclass(frozen=True, repr=False)
class Survey(Result):
    """The force map of one limb, judged and completed by trials with moved clusters.

    Attributes:
        trials: Names of the J trials.
        segments: The part of each trial, in words.
        geometry: The socket of the first trial.
        clusters: The tile under each cluster by its name, for each trial.
        states: Number S of like loads that all trials share.
        mismatch: RMS difference of these loads between trials, over the force [-].
        change: What a donning changes over the limb's forces, RMS over all tiles, as estimated [-].
        judgements: What the maps were judged by, and their errors.
        single: Each trial's own map, in the tiles' frames.
        completed: The map of each trial from all trials.
        limb: The map of what all donnings share.
        learnt: What serves as the prior of the next trial, see `st.pressure`.
        next_tiles: Names of the tiles where the next trial's clusters tell most.
        next_error: Expected error of the limb's map after that trial over the one before it [-].
        side: The leg that wears the socket; None if it is not stated or differs between trials.
        notes: Remarks for the reader.
    """

    _SCALED = True

    trials: tuple[str, ...]
    segments: tuple[str, ...]
    geometry: SocketGeometry
    clusters: tuple[Mapping[str, str], ...]
    states: int
    mismatch: float
    change: float
    judgements: Judgements
    single: tuple[Field, ...]
    completed: tuple[Field, ...]
    limb: Field
    learnt: SurveyPrior
    next_tiles: tuple[str, ...]
    next_error: float
    side: Side | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Survey({len(self.trials)} trials {', '.join(self.trials)};"
            f" {3 * len(self.judgements.points)} judged values, error"
            f" {self.judgements.error.value:.2f})"
        )

    @property
    def verdict(self) -> str:
        """How wrong a trial's map is between its clusters, in a sentence."""
        counts = sorted({len(each) for each in self.clusters})
        several = " to ".join(map(str, {counts[0]: 0, counts[-1]: 0}))
        found, whole = self.judgements, numerics.score(self.judgements.points)
        return (
            f"on this limb a map of {several} clusters is within {_ranged(found.error)} of the"
            f" force between them; {100.0 * whole.coverage[-1]:.0f} % of {whole.values} measured"
            f" values lie in its {100.0 * LEVELS[-1]:.0f} % intervals; donning and sensors explain"
            f" {_percent(found.explained)} of the judged square"
        )

    def conclusions(self) -> list[str]:
        """What completes the verdict: the completed map, what donning changes, the next trial."""
        found = self.judgements
        lines = [
            f"completed by {len(self.trials)} trials: within {_ranged(found.completed)} of the"
            " force on tiles that no trial measured",
            f"a donning changes the forces by {self.change:.2f} of the limb's",
        ]
        if found.repeats:
            lines[-1] += (
                f"; what {found.repeats} pair{'s'[: found.repeats > 1]} of clusters left in place"
                f" measured differs by {found.repeated:.2f} of the force"
            )
        else:
            lines[-1] += (
                ": no cluster was left in place, so that this rests on the map alone; repeat a"
                " trial without moving them"
            )
        if self.next_tiles:
            lines.append(
                f"next trial: clusters on {', '.join(self.next_tiles)} would lower the expected"
                f" error of the limb's map by {100.0 * (1.0 - self.next_error):.0f} %"
            )
        lines.append(
            f"{self.states} like loads, which differ by {100.0 * self.mismatch:.1f} % of the force"
            " between trials"
        )
        return lines

    def to_dataframe(self) -> pd.DataFrame:
        """A row per judged place: a cluster of one trial under the map of another; no named index.

        Columns; forces and pressures are means over the like loads:

        - `map`, `measured in`, `cluster`, `tile`, `region`: the trial whose map is judged, the
          trial that measured, its cluster, and where it was;
        - `distance [mm]`: to the nearest cluster of the judged trial;
        - `measured pressure [kPa]`, `pressure [kPa]`, `pressure sd [kPa]`, `rival pressure [kPa]`:
          normal pressure as measured, of the map, the standard deviation of the difference that
          map and sensor explain, and of the rival;
        - `measured force [N]`, `difference [N]`, `rival difference [N]`: RMS of the force vector,
          and of the differences from it;
        - `within 50 % [-]`, `within 80 % [-]`, `within 95 % [-]`: share of the three components
          over all states within these intervals.
        """
        return pd.DataFrame([self._judged_row(point) for point in self.judgements.points])

    def _judged_row(self, point: JudgedPoint) -> dict[str, Any]:
        geometry, area = self.geometry, self.geometry.areas[point.tile]
        found = numerics.score([point])

        def pressure(forces: FloatArray) -> float:
            return -1e-3 * float(forces[:, 2].mean()) / area

        def size(forces: FloatArray) -> float:
            return float(np.sqrt((forces**2).sum(axis=1).mean()))

        return {
            "map": self.trials[point.trial],
            "measured in": self.trials[point.other],
            "cluster": [*self.clusters[point.other]][point.cluster],
            "tile": geometry.names[point.tile],
            "region": self._region(point.tile),
            "distance [mm]": 1e3 * point.distance,
            "measured pressure [kPa]": pressure(point.measured),
            "pressure [kPa]": pressure(point.estimated),
            "pressure sd [kPa]": 1e-3 * rms(point.deviations[:, 2]) / area,
            "rival pressure [kPa]": pressure(point.rival),
            "measured force [N]": size(point.measured),
            "difference [N]": size(point.estimated - point.measured),
            "rival difference [N]": size(point.rival - point.measured),
            **dict(zip(_WITHIN, found.coverage, strict=True)),
        }

    @property
    def surveyed(self) -> SocketGeometry:
        """The socket with a cluster on every tile that a trial measured, named like its tile."""
        names = {tile for each in self.clusters for tile in each.values()}
        tiles = {name: tile for tile, name in enumerate(self.geometry.names) if name in names}
        return replace(self.geometry, clusters=tiles, turned={})

    def _region(self, tile: int) -> str:
        """Sector of the wall that a tile is on, such as `anterior`, or the distal end."""
        places = anatomical_regions(self.geometry, self.side)
        found = place_of(self.geometry, places, tile)
        return found if found == DISTAL_END else found.split(" ")[0]

    def scores(self) -> pd.DataFrame:
        """How well the maps predict what other trials measured, indexed by `judged`.

        Rows: all judged places together, then by map, by region, and by distance from the nearest
        cluster. Columns: `values [1]` (three per place), `error [-]` and `rival [-]` (RMS
        difference over the RMS of the measured forces), `bias [-]` (mean excess of compression over
        its mean), and `within 50 % [-]`, `within 80 % [-]`, `within 95 % [-]`.
        """
        groups: dict[str, list[JudgedPoint]] = {"all": [*self.judgements.points]}
        for name, number in zip(self.trials, range(len(self.trials)), strict=True):
            groups[f"map of {name}"] = [p for p in groups["all"] if p.trial == number]
        for region in sorted({self._region(point.tile) for point in groups["all"]}):
            groups[region] = [p for p in groups["all"] if self._region(p.tile) == region]
        for low, high in pairwise(_BANDS):
            end = f"to {1e3 * high:.0f} mm" if np.isfinite(high) else "mm and more"
            inside = [p for p in groups["all"] if low <= p.distance < high]
            groups[f"{1e3 * low:.0f} {end} from a cluster"] = inside
        rows = {}
        for name, points in groups.items():
            if points:
                found = numerics.score(points)
                rows[name] = {
                    "values [1]": found.values,
                    "error [-]": found.error,
                    "rival [-]": found.rival,
                    "bias [-]": found.bias,
                    **dict(zip(_WITHIN, found.coverage, strict=True)),
                }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("judged")

    def pressures(self) -> pd.DataFrame:
        """Normal pressure on every tile, mean over the like loads, indexed by `tile`.

        For each trial its own map and the completed one, then the limb's, each with its standard
        deviation, such as `a own [kPa]`, `a own sd [kPa]`, `a completed [kPa]` and `limb [kPa]`.
        """
        names = pd.Index(self.geometry.names, name="tile")
        columns: dict[str, FloatArray] = {}
        for title, field in self._maps():
            pressure, deviation = self._pressure_of(field)
            columns[f"{title} [kPa]"] = pressure
            columns[f"{title} sd [kPa]"] = deviation
        return pd.DataFrame(columns, index=names)

    def _maps(self) -> Iterator[tuple[str, Field]]:
        """Titles and maps: each trial's own and completed one, then the limb's."""
        for name, own, completed in zip(self.trials, self.single, self.completed, strict=True):
            yield f"{name} own", own
            yield f"{name} completed", completed
        yield LIMB, self.limb

    def _pressure_of(self, field: Field) -> tuple[FloatArray, FloatArray]:
        """Mean normal pressures of a map and their standard deviations, shape (n,) each [kPa]."""
        areas = 1e3 * self.geometry.areas
        deviation = np.sqrt((field.deviations[..., 2] ** 2).mean(axis=0))
        return -field.forces[..., 2].mean(axis=0) / areas, deviation / areas

    def tables(self) -> list[Table]:
        """The scores and the judged places, for terminal and page."""
        scores = self.scores()
        shown = scores[["values [1]", "error [-]", "rival [-]"]].copy()
        shown["bias [%]"] = 100.0 * scores["bias [-]"]
        formats = {"values [1]": ".0f", "error [-]": ".2f", "rival [-]": ".2f", "bias [%]": "z.0f"}
        for level, title in zip(LEVELS, _WITHIN, strict=True):
            shown[f"in {100 * level:g} % [%]"] = 100.0 * scores[title]
            formats[f"in {100 * level:g} % [%]"] = ".0f"
        judged = self.to_dataframe()
        places = judged[["measured in", "tile", "region", "distance [mm]"]].copy()
        formats_of = {"distance [mm]": ".0f"}
        for title in ("measured pressure [kPa]", "pressure [kPa]", "pressure sd [kPa]"):
            places[title] = judged[title]
            formats_of[title] = "z.1f"
        for title in ("difference [N]", "measured force [N]"):
            places[title] = judged[title]
            formats_of[title] = ".1f"
        places.index = pd.Index(judged["map"], name="map of")
        return [
            Table("scores", "Maps of single trials, judged by the others", shown, formats),
            Table(
                "judged", "Judged places: what a cluster measured, and the map", places, formats_of
            ),
        ]

    def document(self) -> dict[str, Any]:
        """The survey for JSON.

        Returns:
            `verdict`, `conclusions` and `notes` in words; `trials` (name, segment, and the tile
            under each cluster); `states` and `mismatch [-]`; `error [-]`, `completed error [-]` and
            `explained [-]`, each with `value`, `low` and `high`; `repeated [-]` and the number of
            `repeats`; `change [-]`; `next` (`tiles`, `error [-]`); `scores` as in `scores()`,
            `judged` as in `to_dataframe()`, `tiles` as in `pressures()`; `format`, and `prior`,
            what another trial takes as its prior: see `survey_prior`.
        """
        found = self.judgements
        tables = {
            name: records(table.reset_index())
            for name, table in (("scores", self.scores()), ("tiles", self.pressures()))
        }
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "conclusions": self.conclusions(),
            "notes": list(self.notes),
            "trials": [
                {"name": name, "segment": segment, "clusters": dict(clusters)}
                for name, segment, clusters in zip(
                    self.trials, self.segments, self.clusters, strict=True
                )
            ],
            "states": self.states,
            "mismatch [-]": self.mismatch,
            "error [-]": _interval(found.error),
            "completed error [-]": _interval(found.completed),
            "explained [-]": _interval(found.explained),
            "repeated [-]": finite_or_null(found.repeated),
            "repeats": found.repeats,
            "change [-]": self.change,
            "next": {"tiles": list(self.next_tiles), "error [-]": finite_or_null(self.next_error)},
            "scores": tables["scores"],
            "judged": records(self.to_dataframe()),
            "tiles": tables["tiles"],
            "prior": self.learnt.document(),
        }

    def _figure(self, style: FigureStyle) -> Figure:
        """Each trial's own map beside the completed one, and the limb's."""
        maps = {title: self._pressure_of(field) for title, field in self._maps()}
        values = {title: pressure for title, (pressure, _) in maps.items()}
        return tile_map_figure(
            self.surveyed,
            values,
            "normal pressure [kPa]",
            f"Survey of {', '.join(self.trials)}",
            style,
            limits=pressure_limits(np.array([*values.values()]), style.limits),
            side=self.side,
            reach={title: NORMAL_QUANTILE * sd for title, (_, sd) in maps.items()},
        )


_WITHIN = tuple(f"within {100 * level:g} % [-]" for level in LEVELS)


def _interval(found: Interval) -> dict[str, float | None]:
    return {name: finite_or_null(value) for name, value in vars(found).items()}


def _ranged(found: Interval) -> str:
    if not np.isfinite(found.low):
        return f"{found.value:.2f}"
    return f"{found.value:.2f} ({found.low:.2f} to {found.high:.2f})"


def _percent(found: Interval) -> str:
    shown = f"{100.0 * found.value:.0f} %"
    if not np.isfinite(found.low):
        return shown
    return f"{shown} ({100.0 * found.low:.0f} to {100.0 * found.high:.0f} %)"
