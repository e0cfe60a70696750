"""Common interface of all results."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

from socket_testbed.documents import check_kind, check_number, finite_or_null, path_of
from socket_testbed.errors import ConfigurationError
from socket_testbed.figures.style import FigureStyle, Limits, figure_style, in_style, save_figure
from socket_testbed.files import PICTURES, check_suffix, write_text
from socket_testbed.tables import write_table
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PathLike: TypeAlias = str | os.PathLike[str]


class Result:
    """A result as a table, a JSON document, a file and a figure.

    `to_dataframe` of each result names its columns with their units, its index, and what NaN means.
    """

    def to_dataframe(self) -> pd.DataFrame:
        """The result as a pandas table, with units in the column names."""
        raise NotImplementedError

    def document(self) -> dict[str, Any]:
        """The result as a JSON-compatible dictionary.

        Returns:
            By default one key, `rows`: a list with a dictionary per row of `to_dataframe`, keyed by
            its column names, with a named index as the first; None for missing and infinite values.
        """
        table = self.to_dataframe()
        rows = table if table.index.name is None else table.reset_index()
        return {"rows": records(rows)}

    def to_json(self) -> str:
        """The `document` as a JSON string, null for missing and infinite values."""
        return json.dumps(self.document(), indent=1, allow_nan=False)

    def save(self, path: PathLike) -> None:
        """Write the result in the format of the file's suffix; an existing file is replaced.

        Args:
            path: `.csv`, `.parquet` or `.mat` for the table, `.json` for the document.
        """
        path = path_of(path, "the file")
        if path.suffix.lower() == ".json":
            write_text(path, self.to_json())
        else:
            write_table(self._saved_table(), path)

    _SCALED = False  # whether the figure has a colour scale of pressures

    def figure(
        self,
        width: float = 180,
        title: bool = True,
        vmin: float | None = None,
        vmax: float | None = None,
    ) -> Figure:
        """The result as a matplotlib figure.

        Args:
            width: Printed width, 88 or 180 [mm].
            title: Whether the figure has a title.
            vmin: Lower end of the colour scale of pressures [kPa]; by default 0.
            vmax: Upper end of that scale [kPa]; by default 50, or 100, 200 or 400 if a pressure of
                the figure needs it.

        Returns:
            The figure, not shown and not saved.

        Raises:
            ConfigurationError: The width is another one, the ends are not in order, or this kind of
                result has no figure, or none with such a scale.
        """
        self._check_scale(vmin, vmax)
        found: Figure = in_style(self._figure)(figure_style(width, title, (vmin, vmax)))
        return found

    def draw(
        self,
        path: PathLike | None = None,
        width: float = 180,
        title: bool = True,
        *,
        ax: Axes | None = None,
        vmin: float | None = None,
        vmax: float | None = None,
    ) -> None:
        """Write `figure` as `.png`, `.pdf` or `.svg`, or draw into your own axes.

        Args:
            path: The file; an existing one is replaced.
            width: As in `figure`.
            title: As in `figure`.
            ax: Matplotlib axes for the result's main panel (the wall and distal end of a map, a
                quantity over a cycle), drawn in your own style.
            vmin: As in `figure`.
            vmax: As in `figure`.

        Raises:
            ConfigurationError: Neither a file nor axes are given, the suffix or the width is
                another one, the ends of the scale are not in order, or this kind of result has no
                figure, no main panel or no such scale.
        """
        if path is None and ax is None:
            hint = "give one of them; in a notebook, figure() is shown"
            raise ConfigurationError("neither a file nor axes are given", hint)
        self._check_scale(vmin, vmax)
        if ax is not None:
            from matplotlib.axes import Axes as Panel

            check_kind(ax, Panel, "ax", "give axes, such as the second of plt.subplots()")
            self._draw_into(ax, (vmin, vmax))
        if path is not None:
            if hasattr(path, "get_figure"):
                raise ConfigurationError("the file is a part of a figure", "give axes as ax=...")
            check_suffix(path_of(path, "the file"), PICTURES, "picture")
            figure = self.figure(width, title, vmin, vmax)
            save_figure(figure, path_of(path, "the file"))

    def _saved_table(self) -> pd.DataFrame:
        return self.to_dataframe()

    def _figure(self, style: FigureStyle) -> Figure:
        fact = f"{type(self).__name__} has no figure"
        raise ConfigurationError(fact, "plot its table: see to_dataframe()")

    def _check_scale(self, vmin: float | None, vmax: float | None) -> None:
        if vmin is None and vmax is None:
            return
        if not self._SCALED:
            fact = f"{type(self).__name__} has no colour scale of pressures"
            raise ConfigurationError(fact, "leave vmin and vmax")
        for name, value in (("vmin", vmin), ("vmax", vmax)):
            if value is not None:
                check_number(value, name)
        low, high = 0.0 if vmin is None else vmin, np.inf if vmax is None else vmax
        if not low < high:
            raise ConfigurationError(
                f"the colour scale ends at {high:g} kPa but begins at {low:g} kPa",
                "give vmin below vmax",
            )

    def _draw_into(self, ax: Axes, limits: Limits) -> None:
        fact = f"{type(self).__name__} has no single panel to draw"
        raise ConfigurationError(fact, "leave ax: see figure()")


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table by column name, for JSON: without the index, None for NaN and infinity."""
    return [
        {name: finite_or_null(value) for name, value in row.items()}
        for row in table.to_dict("records")
    ]


def origin(trial: Trial, segment: Segment) -> dict[str, Any]:
    """Trial and segment of a result for JSON.

    Args:
        trial: The trial; its folder's name is given.
        segment: The part of the trial; its start and end are in seconds since the first sample.

    Returns:
        The keys `trial`, and `segment` with `kind`, `start` [s] and `end` [s].
    """
    return {
        "trial": trial.name,
        "segment": {"kind": segment.kind, "start": segment.start, "end": segment.end},
    }
