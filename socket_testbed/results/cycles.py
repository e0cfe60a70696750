"""Cycles of a trial: the courses of quantities over 0 to 100 % of a cycle, mean and spread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.figures.style import LINE_STYLES, FigureStyle, Limits, lay_out, panels, wrap
from socket_testbed.results.result import Result
from socket_testbed.tables import split_unit, stacked
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINTS = 101  # 0 to 100 % of a cycle
_MIN_CYCLES = 3  # for a band
MAX_PANELS = 12  # of a figure
_PANEL_HEIGHT, _HEADING_HEIGHT = 44.0, 12.0  # [mm]
_MAX_LINES = 30  # single cycles drawn in a panel
_OPACITY = 0.25  # [-]; of a band


@dataclass(frozen=True, repr=False)
class Cycles(Result):
    """The courses of m quantities over 0 to 100 % of each of K cycles of a trial.

    Attributes:
        trial: The trial.
        by: Label of the events that delimit the cycles, or two of them as `placed:removed`, see
            `st.cycles`.
        spans: Start and end of each cycle since the first sample of the trial, shape (K, 2) [s].
        left_out: Number of cycles that were left out because they contain a pause.
        titles: Titles of the quantities with their units, such as `Fz [N]`.
        curves: Their values at 0, 1, ... 100 % of each cycle, in the units of their titles, shape
            (K, 101, m); NaN where a value is missing or the recording has a break.
    """

    trial: Trial
    by: str
    spans: FloatArray
    left_out: int
    titles: tuple[str, ...]
    curves: FloatArray

    def __repr__(self) -> str:
        return f"Cycles({self})"

    def __str__(self) -> str:
        start, _, end = self.by.partition(":")
        following = f"'{end}'" if end else "one"
        durations = self.durations
        paused = f"; {self.left_out} left out, longer than twice the median" * bool(self.left_out)
        return (
            f"{len(self)} cycle{'s'[: len(self) > 1]} from each '{start}' to the next {following},"
            f" {np.median(durations):.2f} s ({durations.min():.2f} to {durations.max():.2f} s)"
            f"{paused}"
        )

    def __len__(self) -> int:
        return len(self.spans)

    @property
    def durations(self) -> FloatArray:
        """Durations of the cycles, shape (K,) [s]."""
        return np.asarray(self.spans[:, 1] - self.spans[:, 0])

    @property
    def counts(self) -> IntArray:
        """Number of cycles with a value at each percent, by quantity, shape (101, m)."""
        return np.asarray(np.isfinite(self.curves).sum(axis=0))

    @property
    def mean(self) -> FloatArray:
        """Mean over the cycles at each percent, in the units of `titles`, shape (101, m).

        NaN where no cycle has a value.
        """
        return np.asarray(np.ma.masked_invalid(self.curves).mean(axis=0).filled(np.nan))

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation over the cycles at each percent, in the units of `titles`, (101, m).

        The divisor is the number of cycles with a value, less one. NaN where fewer than three
        cycles have a value.
        """
        spread = np.ma.masked_invalid(self.curves).std(axis=0, ddof=1).filled(np.nan)
        return np.where(self.counts >= _MIN_CYCLES, spread, np.nan)

    def to_dataframe(self) -> pd.DataFrame:
        """A row per percent, indexed by `cycle [%]`.

        Each quantity has columns such as `Fz mean [N]`, `Fz sd [N]` and `Fz n [-]`: mean, standard
        deviation and number of the cycles that have a value there. The mean is NaN where no cycle
        has a value, the standard deviation where fewer than three have one.
        """
        statistics = {"mean": self.mean, "sd": self.deviation, "n": self.counts}
        columns = {
            f"{name} {label} [{'-' if label == 'n' else unit}]": values[:, number]
            for number, (name, unit) in enumerate(map(split_unit, self.titles))
            for label, values in statistics.items()
        }
        percent = np.linspace(0.0, 100.0, POINTS)
        return pd.DataFrame(columns, index=pd.Index(percent, name="cycle [%]"))

    def to_long(self) -> pd.DataFrame:
        """The single cycles in long form, a row per value; no named index.

        Columns: `trial`, its name; `cycle`, its number from 1; `cycle [%]`; `quantity` and `unit`,
        such as `Fz` and `N`; and the `value`, NaN if missing.
        """
        parts = [split_unit(title) for title in self.titles]
        numbers = np.arange(1, len(self) + 1)
        columns: dict[str, Any] = {
            "trial": [self.trial.name] * len(parts),
            "cycle": np.repeat(numbers, POINTS),
            "cycle [%]": np.tile(np.linspace(0.0, 100.0, POINTS), len(self)),
            "quantity": [name for name, _ in parts],
            "unit": [unit for _, unit in parts],
            "value": self.curves.reshape(-1, len(parts)),
        }
        return stacked(columns, POINTS * len(self))

    def _figure(self, style: FigureStyle) -> Figure:
        """Mean of each quantity, with a band of one standard deviation."""
        count = len(self.titles)
        if count > MAX_PANELS:
            raise ConfigurationError(
                f"a figure of {count} quantities",
                f"name {MAX_PANELS} at most, such as st.cycles(trial, ['Fz', 'Mx'])",
            )
        across = 1 if style.is_narrow else min(2, count)
        figure = style.figure(_HEADING_HEIGHT + -(-count // across) * _PANEL_HEIGHT)
        band = "mean and one standard deviation" if len(self) >= _MIN_CYCLES else "mean, no band"
        style.add_title(figure, f"{self.trial.name}: {self}; {band}")
        for number, panel in enumerate(panels(figure, count, across, "cycle [%]")):
            self._draw_quantity(panel, number)
            panel.set_ylabel(wrap(self.titles[number], 0.75 * _PANEL_HEIGHT), parse_math=False)
        return lay_out(figure)

    def _draw_into(self, ax: Axes, limits: Limits) -> None:
        if len(self.titles) != 1:
            raise ConfigurationError(
                f"axes show one of these {len(self.titles)} quantities",
                "name one, such as st.cycles(trial, 'Fz')",
            )
        self._draw_quantity(ax, 0)
        ax.set(xlabel="cycle [%]", ylabel=self.titles[0])

    def _draw_quantity(self, panel: Axes, number: int) -> None:
        """Mean of a quantity with its band, and the single cycles."""
        percent, colour = np.linspace(0.0, 100.0, POINTS), LINE_STYLES[1]["color"]
        mean, deviation = self.mean[:, number], self.deviation[:, number]
        if len(self) <= _MAX_LINES:
            panel.plot(percent, self.curves[:, :, number].T, color="0.8", linewidth=0.5)
        ends = mean - deviation, mean + deviation
        panel.fill_between(percent, *ends, color=colour, alpha=_OPACITY, linewidth=0.0)
        panel.plot(percent, mean, color=colour)
        if not np.isfinite(mean).any():
            middle: dict[str, Any] = {"transform": panel.transAxes, "ha": "center", "color": "0.3"}
            panel.text(0.5, 0.5, "no value", **middle)
            panel.set_yticks([])
        panel.set_xlim(0.0, 100.0)
