"""Cycles of a trial: quantities normalised to 0 to 100 % of a cycle, with mean and spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from socket_testbed.api.trials import as_trial
from socket_testbed.arrays import BREAK, FloatArray, gaps
from socket_testbed.documents import described, texts_of
from socket_testbed.errors import ConfigurationError, TrialError, closest
from socket_testbed.results.cycles import POINTS, Cycles
from socket_testbed.results.result import PathLike
from socket_testbed.tables import split_unit
from socket_testbed.trials.events import PLACED, cycle_spans
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial

_MAX_DURATION = 2.0  # [-]; over the median; a longer cycle contains a pause
_MIN_SAMPLES = 10  # per cycle
_TIME = "time [s]"


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
    if not isinstance(quantity, pd.DataFrame | pd.Series):  # a table is the caller's own
        trial.note_problems()
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
    shares = np.linspace(0.0, 1.0, POINTS)
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
