"""Tables with clocks of their own, brought to one clock by stated offsets or what they saw."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from socket_testbed.alignment.align import Series
from socket_testbed.alignment.events import Tap
from socket_testbed.errors import ConfigurationError, closest, listed

_SECOND = 1_000_000_000  # [ns]
UNDATED = 946_684_800 * _SECOND  # [ns]; 2000-01-01, where the clock of undated tables starts
MAX_OFFSET = 1e7  # [s]
_MAX_LISTED = 4


@dataclass(frozen=True)
class OwnClock:
    """The clock of a file.

    Attributes:
        file: The file's name.
        sources: Names of the sources that it holds.
        is_dated: Whether its times count from 1970.
        start: Its first time [ns].
    """

    file: str
    sources: tuple[str, ...]
    is_dated: bool
    start: int


@dataclass(frozen=True)
class Offset:
    """What is added to the times of a file to bring them to the common clock.

    Attributes:
        seconds: The time [s].
        error: Half the width of its 95 % interval [s]; NaN if it is stated.
        how: Where it is from, in words.
    """

    seconds: float
    error: float = float("nan")
    how: str = "stated"


def stated_offsets(
    clocks: Sequence[OwnClock], stated: Mapping[str, float], found: Collection[str] = ()
) -> dict[str, Offset]:
    """Offsets of files from what is stated by source.

    Files that tell the date need none if the first one does; an offset corrects the date. The times
    of others count from their own 0, or their first row, and need an offset.

    Args:
        clocks: The clocks of the files, that of the reference first.
        stated: Offsets by source [s].
        found: Sources whose files need none, because it is found otherwise; left out of the result.

    Raises:
        ConfigurationError: If one is missing, or a source has none in these files.
    """
    known = [source for clock in clocks for source in clock.sources]
    if unknown := [source for source in (*stated, *found) if source not in known]:
        raise ConfigurationError(f"offset names '{unknown[0]}'", closest(unknown[0], known))
    offsets: dict[str, Offset] = {}
    for number, clock in enumerate(clocks):
        own = {stated[source] for source in clock.sources if source in stated}
        if len(own) > 1:
            shown = ", ".join(f"{value:g}" for value in sorted(own))
            fact = f"{clock.file} has one clock, and the offsets {shown} s"
            raise ConfigurationError(fact, "state one offset for its sources")
        if own:
            offsets[clock.file] = Offset(own.pop())
        elif {*found} & {*clock.sources} and number > 0:
            continue
        elif number == 0:
            offsets[clock.file] = Offset(0.0, how="reference")
        elif clock.is_dated and clocks[0].is_dated:
            offsets[clock.file] = Offset(0.0, how="dates")
        else:
            raise ConfigurationError(
                f"{clock.file} has a clock of its own",
                f"state what to add to its times with --offset {clock.sources[0]}=S, counted as"
                f" those of {clocks[0].file}, or S=tap if both see a tap",
            )
    return offsets


def offset_by_tap(reference: tuple[OwnClock, Tap], other: tuple[OwnClock, Tap]) -> Offset:
    """The offset of a file whose tap is that of the reference.

    Args:
        reference: The clock of the reference, and when its source saw the tap.
        other: The clock of the file, and when its source saw the tap.
    """
    own = [tap.time - _zero(clock, reference[0]) for clock, tap in (reference, other)]
    error = (reference[1].error ** 2 + other[1].error ** 2) ** 0.5
    return Offset((own[0] - own[1]) / _SECOND, error, "tap")


def _zero(clock: OwnClock, reference: OwnClock) -> int:
    """The time of a file from which its offset counts [ns].

    That is the start of the reference if both tell the date, its first row if it alone does, else
    its 0.
    """
    if not clock.is_dated:
        return 0
    return reference.start if reference.is_dated else clock.start


def to_common_clock(series: Series, clock: OwnClock, offset: Offset, reference: OwnClock) -> Series:
    """A series at times of the common clock.

    Args:
        series: What a source of the file measured, at times of the file.
        clock: The clock of its file.
        offset: The offset of the file.
        reference: The clock of the file as whose times all count.
    """
    shift = round(offset.seconds * _SECOND) - _zero(clock, reference)
    shift += reference.start if reference.is_dated else UNDATED
    return dataclasses.replace(series, times=series.times + shift)


def clocks_in_words(clocks: Sequence[OwnClock], offsets: Mapping[str, Offset]) -> str:
    """The offsets in one line, for a note.

    Args:
        clocks: The clocks of the files, that of the reference first.
        offsets: Offsets by file.
    """
    parts = []
    for clock in clocks:
        own = offsets[clock.file]
        error = f" +- {own.error:.2g}" if own.error == own.error else ""
        parts.append(f"{clock.file} {own.seconds:+.6g}{error} s ({own.how})")
    return f"clocks: {listed(parts, _MAX_LISTED)}"
