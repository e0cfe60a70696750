"""Trials side by side: their values, and the differences to the first."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.api.comparison import Comparison, texts_table, values_table
from socket_testbed.api.pressure import OF_TILES, TrialPressure, pressure
from socket_testbed.api.trials import PathLike, Progress, open_trial, started
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.geometry.regions import Region
from socket_testbed.identification.pressure import (
    NORMAL_QUANTILE,
    SHARE,
    THRESHOLD,
    TITLES,
    read_column,
)
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    import pandas as pd

PAGES = (".html", ".htm")

_MOST = 12  # trials side by side
_OTHER_LOAD = 0.1  # [-]; of the mean force, from which on a note says so
_OTHER_TIME = 0.05  # [-]; likewise for the time that an integral covers


def compare(
    *items: Trial | PathLike,
    segment: str = "plateau",
    threshold: float = 1e-3 * THRESHOLD,
    share: float = SHARE,
    by_region: bool = False,
    params: PathLike | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare trials: every value side by side, and differences to the first.

    The outputs of `st.pressure` by region and tile, with their differences and 95 % intervals, the
    mean wrench, and the metadata. All must be of one socket, unless `by_region`.

    The interval of a difference takes the errors of both trials as independent, see
    `socket_testbed.api.comparison`; docs/compare.md states how often it held the true difference.

    Args:
        items: Two to twelve trials, or their folders.
        segment: As `specification` in `st.select_segment`, of every trial.
        threshold: As in `st.pressure`.
        share: As in `st.pressure`.
        by_region: Whether trials, even of different sockets, are compared by region alone.
        params: A `testbed.yaml` to use instead of each trial's own.
        progress: See `Progress`.

    Raises:
        ConfigurationError: If there are fewer than two trials or too many, one is given twice or is
            a file, or they are of different sockets.
        TrialError: If a trial cannot be read or holds no such segment.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> found
    Comparison(trials hold, walk; 20 regions, 79 tiles)
    >>> found.cells("regions", "peak pressure").loc["socket", "walk - hold"]
    '... (... to ...)...'
    >>> found.save("comparison.csv")
    >>> st.write_comparison(found, "comparison.html")
    """
    trials = _open(items)
    names = _names([trial.path for trial in trials])
    first = trials[0].geometry
    other = next((trial for trial in trials if not trial.geometry.same_tiles(first)), None)
    if other is not None and not by_region:
        raise ConfigurationError(
            f"{other.path} is of another socket ({len(other.geometry)} tiles) than"
            f" {trials[0].path} ({len(first)} tiles)",
            "compare them by region with --by-region",
        )
    report = started(progress, "comparing") or (lambda done, total: None)
    found = []
    for done, (name, trial) in enumerate(zip(names, trials, strict=True), start=1):
        try:
            found.append(pressure(trial, segment, threshold=threshold, share=share, params=params))
        except TrialError as error:  # it does not always say of which trial
            raise TrialError(f"{name}: {error.fact}", error.hint) from None
        report(done, len(trials))
    sides = {trial.metadata.side for trial in trials}
    tiles = [
        read_column(each.outputs.tiles, "mean pressure [kPa]") for each in found if not by_region
    ]
    return Comparison(
        items=names,
        title=f"segment {segment}, in contact above {threshold:g} kPa",
        notes=tuple(_notes(found, names, other is None, params is None)),
        table=_table(found, names, other is None, by_region),
        geometry=None if by_region else first,
        pressures=np.array([of.value for of in tiles]),
        deviations=np.array([(of.high - of.low) / (2.0 * NORMAL_QUANTILE) for of in tiles]),
        side=(sides.pop() or "") if len(sides) == 1 else "",
    )


def write_comparison(
    found: Comparison, page: PathLike, command: str = "socket_testbed.write_comparison"
) -> None:
    """Write a comparison as one page that opens offline; an older one is replaced.

    Args:
        found: What `st.compare` found.
        page: The page, ending in `.html`.
        command: What made the page, for the record.

    Raises:
        ConfigurationError: If the page ends otherwise or cannot be written.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> st.write_comparison(found, "liners.html")
    """
    path = Path(page)
    if path.suffix.lower() not in PAGES:
        raise ConfigurationError(f"{path}: a comparison is a page", "let it end in .html")
    found.write_page(path, command)


def _open(items: Sequence[Trial | PathLike]) -> list[Trial]:
    """The trials, each given once."""
    if not 2 <= len(items) <= _MOST:
        raise ConfigurationError(
            f"{len(items)} trials are given to compare",
            f"give 2 to {_MOST}, or 'pressure FOLDER -o OUTPUT' for a table with a row per trial",
        )
    trials: list[Trial] = []
    for item in items:
        path = item.path if isinstance(item, Trial) else Path(item)
        if path.suffix.lower() in {".json", ".yaml", ".yml"}:
            raise ConfigurationError(
                f"{path}: compare takes trials", "judge a model by 'evaluate TRIAL --model MODEL'"
            )
        if path.resolve() in [trial.path.resolve() for trial in trials]:
            raise ConfigurationError(f"{path} is given twice", "give each trial once")
        trials.append(item if isinstance(item, Trial) else open_trial(item))
    return trials


def _names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names that differ: the last parts of the paths, as many as it takes."""
    parts = [path.resolve().parts for path in paths]
    tails = (tuple("/".join(part[-number:]) for part in parts) for number in count(1))
    return next(names for names in tails if len({*names}) == len(names))


def _table(
    found: Sequence[TrialPressure], names: Sequence[str], alike: bool, by_region: bool
) -> pd.DataFrame:
    import pandas as pd

    described = [each.trial.metadata.described() for each in found]
    metadata = {
        name: [texts.get(name, "not stated") for texts in described]
        for name in FIELDS
        if any(name in texts for texts in described)
    }
    origins = {
        "segment": [str(each.segment) for each in found],
        "samples": [str(len(each.time)) for each in found],
        "measured": [each.outputs.source for each in found],
        "socket": [each.trial.geometry.source or "no source" for each in found],
        "calibration": [
            f"{each.trial.calibration.source} ({each.trial.calibration.date})" for each in found
        ],
    }
    shared, rows = _shared_regions(found, alike)
    tables = [
        texts_table("metadata", metadata, names),
        texts_table("trials", origins, names),
        *(_of_output("regions", title, shared, rows, found, names) for title in TITLES),
    ]
    if not by_region:
        tiles = found[0].trial.geometry.names
        every = [[*range(len(tiles))]] * len(found)
        tables += [_of_output("tiles", title, tiles, every, found, names) for title in OF_TILES]
    wrenches = [_wrench(each) for each in found]
    for title, values in (
        ("mean", np.array([wrench.mean() for wrench in wrenches])),
        ("standard deviation", np.array([wrench.std(ddof=0) for wrench in wrenches])),
    ):
        for column, name in enumerate(WRENCH_CHANNELS):
            titled = f"{title} [{channel_unit(name)}]"
            tables.append(values_table("wrench", [name], titled, names, values[:, [column]]))
    return pd.concat([table for table in tables if len(table)], ignore_index=True)


def _shared_regions(
    found: Sequence[TrialPressure], alike: bool
) -> tuple[list[str], list[list[int]]]:
    """Names of the regions that all trials have, and which of each trial's regions they are."""
    sides = {each.trial.metadata.side for each in found}
    neutral = None in sides and len(sides) > 1
    names = [[_without_side(r, each) if neutral else r.name for r in each.places] for each in found]
    shared = [name for name in names[0] if all(name in others for others in names)]
    if alike:  # a region of the same name may have other tiles
        mirrored = ("medial", "lateral") if sides == {"left", "right"} else ()
        tiles = [
            {name: tuple(region.tiles) for name, region in zip(of, each.places, strict=True)}
            for of, each in zip(names, found, strict=True)
        ]
        shared = [n for n in shared if n.startswith(mirrored) or len({t[n] for t in tiles}) == 1]
    return shared, [[of.index(name) for name in shared] for of in names]


def _without_side(region: Region, found: TrialPressure) -> str:
    """Name of a region by left and right, whatever leg it is of."""
    side = found.trial.metadata.side
    if side is None:
        return region.name
    other = {"left": "right", "right": "left"}[side]
    sector, _, height = region.name.partition(" ")
    return " ".join([{"lateral": side, "medial": other}.get(sector, sector), height]).strip()


def _of_output(
    part: str,
    title: str,
    names: Sequence[str],
    rows: Sequence[Sequence[int]],
    found: Sequence[TrialPressure],
    items: Sequence[str],
) -> pd.DataFrame:
    """An output, of `TITLES`, of the things in some rows of each trial's `part`."""
    quantities = [read_column(getattr(each.outputs, part), title) for each in found]
    columns = [
        (q.value[row], q.low[row], q.high[row], q.determined(each.share)[row])
        for q, row, each in zip(quantities, map(list, rows), found, strict=True)
    ]
    return values_table(part, names, title, items, *map(np.array, zip(*columns, strict=True)))


def _wrench(found: TrialPressure) -> pd.DataFrame:
    """The wrench over the segment, as a table whose statistics skip missing values."""
    import pandas as pd

    wrench = found.trial.samples()[found.segment.rows].wrench
    return pd.DataFrame(wrench, columns=list(WRENCH_CHANNELS))


def _notes(
    found: Sequence[TrialPressure], names: Sequence[str], alike: bool, own_params: bool
) -> list[str]:
    trials = [each.trial for each in found]
    notes = []
    if not alike:
        notes.append(
            "the trials are of different sockets: regions are sectors and thirds of each socket's"
            " own height, and hold other areas"
        )
    sides = [trial.metadata.side for trial in trials]
    if {"left", "right"} <= {*sides}:
        notes.append(
            "left and right legs are compared: medial with medial, lateral with lateral; tiles are"
            " compared where they are in the socket"
        )
    elif None in sides and any(sides):
        unknown = ", ".join(n for n, side in zip(names, sides, strict=True) if side is None)
        notes.append(
            f"no side is stated for {unknown}: the regions are left and right; state it with"
            " 'annotate TRIAL --side left|right'"
        )
    own = {name for trial in trials for name in trial.geometry.regions}
    if lacking := sorted(own.difference(_shared_regions(found, alike)[0])):
        notes.append(
            f"not compared, since not all trials have these regions alike: {', '.join(lacking)}"
        )
    forces = [float(np.linalg.norm(_wrench(each).mean()[3:])) for each in found]
    times = [each.outputs.integrated for each in found]
    for name, force, time in zip(names[1:], forces[1:], times[1:], strict=True):
        if abs(force - forces[0]) > _OTHER_LOAD * forces[0]:
            notes.append(
                f"the mean force is {force:.0f} N in {name} and {forces[0]:.0f} N in {names[0]}:"
                " differences in pressure hold that of the load"
            )
        if abs(time - times[0]) > _OTHER_TIME * times[0]:
            notes.append(
                f"the pressure-time integral covers {time:.1f} s in {name} and {times[0]:.1f} s in"
                f" {names[0]}: it is not of equal times"
            )
    if own_params and len({trial.estimator.force_map for trial in trials}) > 1:
        notes.append(
            "the trials were recorded with different priors of the force map (force_map.*): give"
            " one with --params"
        )
    return notes
