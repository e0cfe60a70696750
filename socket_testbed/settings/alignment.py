"""Settings of sources that know no trigger; their defaults are defined only here."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.settings.acquisition import MAX_SPAN
from socket_testbed.settings.fields import Settings, setting

MAX_DELAY = 10.0  # [s]; of a source
USUAL_STALE = 0.05, 2.5  # [s], [-]; longest distance of readings: that, or so many usual steps


@dataclass(frozen=True)
class SourceSettings(Settings):
    """How the readings of one source that knows no trigger are brought to triggers."""

    delay: float = setting(
        0.0, "delay of the stamps behind the measurement; subtracted from each [s]",
        -MAX_DELAY, MAX_DELAY,
    )  # fmt: skip
    method: str = setting(
        "line",
        "line: of a least-squares line through the window, at the trigger; mean: of the window;"
        " last: the last reading before the trigger [-]",
        choices=("line", "mean", "last"),
    )
    window: float = setting(
        -1.0, "span centred on a trigger whose readings are used; negative: the trigger's period,"
        f" at most {MAX_SPAN}; 0: between the two readings around the trigger [s]", -1.0, 5.0,
    )  # fmt: skip
    stale: float = setting(
        -1.0, "longest distance between the two readings around a trigger, or age of the last one;"
        f" negative: {USUAL_STALE[1]} usual steps of the source, at least {USUAL_STALE[0]} [s]",
        -1.0, 10.0,
    )  # fmt: skip
