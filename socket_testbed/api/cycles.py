"""Cycles of a trial: quantities normalised to 0 to 100 % of a cycle, with mean and spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from socket_testbed.api.trials import as_trial
from socket_testbed.arrays import BREAK, FloatArray, IntArray, gaps
from socket_testbed.documents import described, texts_of
from socket_testbed.errors import ConfigurationError, TrialError, closest
from socket_testbed.results.result import PathLike, Result
from socket_testbed.tables import split_unit, stacked
from socket_testbed.trials.events import PLACED, cycle_spans
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from socket_testbed.figures.style import FigureStyle, Limits

_POINTS = 101  # 0 to 100 % of a cycle
_MAX_DURATION = 2.0  # [-]; over the median; a longer cycle contains a pause
_MIN_CYCLES = 3  # for a band
_MIN_SAMPLES = 10  # per cycle
MAX_PANELS = 12  # of a figure
_PANEL_HEIGHT, _HEADING_HEIGHT = 44.0, 12.0  # [mm]
_MAX_LINES = 30  # single cycles drawn in a panel
_OPACITY = 0.25  # [-]; of a band
_TIME = "time [s]"


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
        percent = np.linspace(0.0, 100.0, _POINTS)
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
            "cycle": np.repeat(numbers, _POINTS),
            "cycle [%]": np.tile(np.linspace(0.0, 100.0, _POINTS), len(self)),
            "quantity": [name for name, _ in parts],
            "unit": [unit for _, unit in parts],
            "value": self.curves.reshape(-1, len(parts)),
        }
        return stacked(columns, _POINTS * len(self))

    def _figure(self, style: FigureStyle) -> Figure:
        """Mean of each quantity, with a band of one standard deviation."""
        from socket_testbed.figures.style import lay_out, panels, wrap

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
        from socket_testbed.figures.style import LINE_STYLES

        percent, colour = np.linspace(0.0, 100.0, _POINTS), LINE_STYLES[1]["color"]
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


def cycles(
    trial: Trial | PathLike,
    quantity: str | Sequence[str] | pd.DataFrame | None = None,
    *,
    by: str | tuple[str, str] = PLACED,
    segment: str | Span | Segment = "all",
) -> Cycles:
    """Normalise quantities to 0 to 100 % of each cycle, interpolating linearly between samples.

    A cycle longer than twice the median duration contains a pause and is left out. A missing value
    or a break affects only the cycles that reach it.

    Args:
        trial: The trial.
        quantity: Channels of the samples, such as `"Fz"`; or any table over `time [s]`, as index or
            column, such as `st.pressure(trial, "all").over_time()`; None for all channels. Table
            columns in degrees are skipped, because directions have no mean, and so are status and
            non-numeric columns.
        by: A label of `trial.events()`: cycles run from each such event to the next. Or a pair, as
            `placed:removed` or `("placed", "removed")`: from each event of the first to the next of
            the second.
        segment: The part of the trial in which the cycles must lie.

    Returns:
        The cycles: `curves` holds each one, `to_dataframe()` their mean and standard deviation,
        which needs at least three.

    Raises:
        TrialError: The trial cannot be read, or no cycle lies within the segment.
        ConfigurationError: The trial has no such channel, or the table has no time.

    >>> trial = st.simulate("trials/cycles", "ramp", duration=130, seed=1)
    >>> found = st.cycles(trial, "Fz")
    >>> found
    Cycles(4 cycles from each 'placed' to the next one, 30.00 s (30.00 to 30.01 s))
    >>> list(found.to_dataframe())
    ['Fz mean [N]', 'Fz sd [N]', 'Fz n [-]']
    """
    trial = as_trial(trial)
    by = cycles_by(by)
    time, titles, values = _series(trial, quantity)
    chosen = trial.select(segment, trial.estimator)
    all_spans = cycle_spans(trial.events(), by)
    start, end = max(chosen.start, float(time[0])), min(chosen.end, float(time[-1]))
    spans = np.array([s for s in all_spans if start <= s[0] and s[1] <= end]).reshape(-1, 2)
    if len(spans) == 0:
        raise TrialError(
            f"no cycle by '{by}' lies within {start:.2f} s to {end:.2f} s",
            f"the trial has {len(all_spans)}: give the segment 'all', or see 'info'",
        )
    durations = spans[:, 1] - spans[:, 0]
    kept = durations <= _MAX_DURATION * np.median(durations)
    spans = spans[kept]
    shares = np.linspace(0.0, 1.0, _POINTS)
    moments = spans[:, :1] + shares * (spans[:, 1:] - spans[:, :1])
    samples = np.median(np.diff(np.searchsorted(time, spans), axis=1))
    breaks = np.flatnonzero(gaps(time, BREAK)) + 1  # no line holds across them
    time = np.insert(time, breaks, 0.5 * (time[breaks - 1] + time[breaks]))
    values = np.insert(values, breaks, np.nan, axis=0)
    curves = np.stack([np.interp(moments, time, column) for column in values.T], axis=-1)
    if samples < _MIN_SAMPLES:
        few = f"a cycle by '{by}' has {samples:.0f} samples"
        trial.note(f"{few}: the course between them is interpolated, record at a higher rate")
    return Cycles(trial, by, spans, int((~kept).sum()), titles, curves)


def cycles_by(by: object) -> str:
    """The label of the events that delimit cycles, or two of them as `A:B`, from a text or a pair.

    Raises:
        ConfigurationError: It is neither.
    """
    if isinstance(by, str):
        return by
    if isinstance(by, list | tuple) and len(by) in (1, 2):
        return ":".join(texts_of(by, "by"))
    fact = f"the cycles' events are {described(by)}"
    raise ConfigurationError(fact, "give a label, such as 'placed', or two, ('placed', 'removed')")


def _series(
    trial: Trial, quantity: str | Sequence[str] | pd.DataFrame | None
) -> tuple[FloatArray, tuple[str, ...], FloatArray]:
    """Times [s], titles and values, shape (N, m), of the chosen quantities."""
    if isinstance(quantity, pd.Series):
        quantity = quantity.to_frame()
    table = quantity if isinstance(quantity, pd.DataFrame) else trial.samples().to_dataframe()
    if _TIME in table.columns:
        table = table.set_index(_TIME)
    if table.index.name != _TIME or len(table) == 0:
        raise ConfigurationError(
            f"the table has no column '{_TIME}', or no rows",
            "give one with a row per sample, such as trial.samples().to_dataframe()",
        )
    usable = [
        title
        for title in table.select_dtypes("number").columns
        if not title.endswith((" [deg]", "status [-]", "stamp [ns]"))
    ]
    if quantity is not None and not isinstance(quantity, pd.DataFrame):
        titles = {split_unit(title)[0]: title for title in usable}
        wanted = texts_of(quantity, "the quantity")
        names = [split_unit(name)[0] if name in usable else name for name in wanted]
        for name in names:
            if name not in titles:
                hint = closest(name, titles)
                raise ConfigurationError(f"the trial has no channel '{name}'", hint)
        usable = [titles[name] for name in names]
    if not usable:
        raise ConfigurationError("no quantity is given", "name one, such as Fz")
    values = table[usable].to_numpy(dtype=float)
    return table.index.to_numpy(dtype=float), tuple(usable), values
