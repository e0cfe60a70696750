"""Trials, models or sockets side by side: what is the same, what differs, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from socket_testbed.api.models import TrialFit, read_model
from socket_testbed.api.pressure import OF_TILES, TrialPressure, pressure
from socket_testbed.api.trials import PathLike, Progress, open_trial, started
from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.comparison.models import compare_models
from socket_testbed.comparison.sockets import compare_sockets
from socket_testbed.comparison.table import Compared, Comparison, Kind, joined, texts_table
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.geometry.regions import Region
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.identification.pressure import SHARE, THRESHOLD, TITLES, read_column
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit
from socket_testbed.trials.metadata import FIELDS
from socket_testbed.trials.trial import Trial

Comparable: TypeAlias = Trial | StoredModel | TrialFit | PathLike

PAGES = (".html", ".htm")

_MOST = 12  # items side by side
_OTHER_LOAD = 0.1  # [-]; of the mean force, from which on a note says so
_OTHER_TIME = 0.05  # [-]; likewise for the time that an integral covers
_MODEL, _SOCKET = (".json",), (".yaml", ".yml")
_BY_REGION = "compare them by region with --by-region, or their socket.yaml side by side"


def compare(
    *items: Comparable,
    segment: str = "plateau",
    threshold: float = 1e-3 * THRESHOLD,
    share: float = SHARE,
    by_region: bool = False,
    params: PathLike | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare trials, models or sockets: every value side by side, and differences to the first.

    - Trials: the outputs of `st.pressure` by region and tile, their differences with 95 %
      intervals, the mean wrench, the metadata. All must be of one socket, unless `by_region`.
    - Models: settings, errors, offsets, and the stiffness by region, and tile by tile where the
      sockets have the same tiles.
    - Sockets: tiles, areas, regions, clusters, and how far apart their tiles are.

    The interval of a difference takes the errors of both trials as independent, see
    `socket_testbed.comparison.table`; docs/compare.md states how often it held the true difference.

    Args:
        items: Two or more: trials or their folders; models, fits or files that end in `.json`;
            or files of sockets that end in `.yaml`.
        segment: The segment of every trial, or its specification.
        threshold: Pressure above which a tile is in contact [kPa].
        share: As in `st.pressure` [-].
        by_region: Whether trials of different sockets are compared by region alone.
        params: A `testbed.yaml` to use instead of each trial's own.
        progress: See `Progress`.

    Raises:
        ConfigurationError: If there are fewer than two items or too many, one is given twice, they
            are of different kinds, or trials are of different sockets.
        TrialError: If a trial cannot be read or holds no such segment.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> found
    Comparison(trials hold, walk; 20 regions, 79 tiles)
    >>> found.cells("regions", "peak pressure").loc["socket", "walk - hold"]
    '... (... to ...)...'
    >>> found.save("comparison.csv")
    >>> st.write_comparison(found, "comparison.html")
    """
    kind, opened, paths = _open(items)
    names = _names(paths)
    if kind == "trials":
        trials = [item for item in opened if isinstance(item, Trial)]
        return _compare_trials(
            trials, names, segment, by_region, params, threshold, share, progress
        )
    if kind == "models":
        return compare_models([m for m in opened if isinstance(m, StoredModel)], names)
    return compare_sockets([g for g in opened if isinstance(g, SocketGeometry)], names)


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

    >>> found = st.compare("trials/hold/socket.yaml", "trials/walk/socket.yaml")
    >>> st.write_comparison(found, "sockets.html")
    """
    # matplotlib takes its time to import.
    from socket_testbed.report.comparison_page import write_page

    path = Path(page)
    if path.suffix.lower() not in PAGES:
        raise ConfigurationError(f"{path}: a comparison is a page", "let it end in .html")
    write_page(found, path, command, datetime.now(UTC))


def _open(
    items: Sequence[Comparable],
) -> tuple[Kind, list[Trial | StoredModel | SocketGeometry], list[Path]]:
    """The items opened, all of one kind, and the paths that name them."""
    if len(items) < 2:
        given = f"only {_path(items[0])} is given" if items else "nothing is given"
        raise ConfigurationError(f"{given} to compare", "give two or more")
    if len(items) > _MOST:
        raise ConfigurationError(
            f"{len(items)} are given to compare, and {_MOST} fit side by side",
            "give fewer, or 'pressure FOLDER -o OUTPUT' for a table with a row per trial",
        )
    kinds = [_kind(item) for item in items]
    paths = [_path(item) for item in items]
    for path, kind in zip(paths, kinds, strict=True):
        if kind != kinds[0]:
            raise ConfigurationError(
                f"{paths[0]} is one of the {kinds[0]} and {path} one of the {kind}",
                "compare trials with trials, models (.json) with models, sockets (.yaml) with"
                " sockets",
            )
    places = [path.resolve() for path in paths]
    for number, item in enumerate(items):
        twice = any(item is other for other in items[:number])
        if twice or (not _is_open_model(item) and places[number] in places[:number]):
            raise ConfigurationError(f"{paths[number]} is given twice", "give each once")
    return kinds[0], [_opened(item, kinds[0]) for item in items], paths


def _is_open_model(item: Comparable) -> bool:
    return isinstance(item, StoredModel | TrialFit)


def _kind(item: Comparable) -> Kind:
    if isinstance(item, Trial):
        return "trials"
    if isinstance(item, StoredModel | TrialFit):
        return "models"
    path = Path(item)
    if path.is_dir():
        return "trials"
    suffix = path.suffix.lower()
    return "models" if suffix in _MODEL else "sockets" if suffix in _SOCKET else "trials"


def _path(item: Comparable) -> Path:
    """What names an item."""
    if isinstance(item, Trial):
        return item.path
    if isinstance(item, StoredModel):
        return Path(item.trial)
    return Path(item.trial.name) if isinstance(item, TrialFit) else Path(item)


def _opened(item: Comparable, kind: Kind) -> Trial | StoredModel | SocketGeometry:
    if isinstance(item, Trial | StoredModel):
        return item
    if isinstance(item, TrialFit):
        return item.stored()
    if kind == "trials":
        return open_trial(item)
    return read_model(item) if kind == "models" else read_socket(Path(item))


def _names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names that differ: the last parts of the paths, as many as it takes."""
    known = [path.with_suffix("") if path.suffix in (*_MODEL, *_SOCKET) else path for path in paths]
    most = max(len(path.parts) for path in known)
    for count in range(1, most + 1):
        names = ["/".join(path.parts[-count:]) for path in known]
        if len(set(names)) == len(names):
            return tuple(names)
    return tuple(f"{name} ({number})" for number, name in enumerate(names, start=1))


def _compare_trials(
    trials: Sequence[Trial],
    names: tuple[str, ...],
    segment: str,
    by_region: bool,
    params: PathLike | None,
    threshold: float,
    share: float,
    progress: Progress | None,
) -> Comparison:
    first = trials[0]
    alike = all(trial.geometry.same_tiles(first.geometry) for trial in trials)
    if not alike and not by_region:
        other = next(t for t in trials if not t.geometry.same_tiles(first.geometry))
        raise ConfigurationError(
            f"{other.path} is of another socket ({len(other.geometry)} tiles) than {first.path}"
            f" ({len(first.geometry)} tiles)",
            _BY_REGION,
        )
    report = started(progress, "comparing") or (lambda done, total: None)
    found = []
    for done, (name, trial) in enumerate(zip(names, trials, strict=True), start=1):
        try:
            found.append(pressure(trial, segment, threshold=threshold, share=share, params=params))
        except TrialError as error:  # it does not always say of which trial
            raise TrialError(f"{name}: {error.fact}", error.hint) from None
        report(done, len(trials))
    tables = [
        texts_table("metadata", _metadata(trials), names),
        texts_table("trials", _origins(found), names),
        *(part.to_dataframe(names) for part in _of_regions(found, alike)),
    ]
    of_tiles = [] if by_region else _of_tiles(found)
    tables += [part.to_dataframe(names) for part in of_tiles]
    tables += [part.to_dataframe(names) for part in _of_wrench(found)]
    side = trials[0].metadata.side
    return Comparison(
        kind="trials",
        items=names,
        title=f"segment {segment}, in contact above {threshold:g} kPa",
        notes=tuple(_trial_notes(found, names, alike, params is None)),
        table=joined(tables),
        mapped=of_tiles[0] if of_tiles else None,  # the mean pressure
        geometry=first.geometry,
        side=side if side and all(t.metadata.side == side for t in trials) else "",
    )


def _metadata(trials: Sequence[Trial]) -> dict[str, list[str]]:
    described = [trial.metadata.described() for trial in trials]
    return {
        name: [texts.get(name, "not stated") for texts in described]
        for name in FIELDS
        if any(name in texts for texts in described)
    }


def _origins(found: Sequence[TrialPressure]) -> dict[str, list[str]]:
    return {
        "segment": [str(each.segment) for each in found],
        "samples": [str(len(each.time)) for each in found],
        "measured": [each.outputs.source for each in found],
        "socket": [each.trial.geometry.source or "no source" for each in found],
        "calibration": [
            f"{each.trial.calibration.source} ({each.trial.calibration.date})" for each in found
        ],
    }


def _of_regions(found: Sequence[TrialPressure], alike: bool) -> list[Compared]:
    """The outputs of the regions that all trials have; their names are those of all."""
    sides = {each.trial.metadata.side for each in found}
    neutral = None in sides and len(sides) > 1
    names = [[_without_side(r, each) if neutral else r.name for r in each.places] for each in found]
    shared = [name for name in names[0] if all(name in others for others in names)]
    if alike:  # a region of the same name may have other tiles
        shared = [name for name in shared if _same_tiles(found, names, name)]
    return _outputs("regions", TITLES, shared, found, names)


def _same_tiles(found: Sequence[TrialPressure], names: Sequence[Sequence[str]], name: str) -> bool:
    tiles = [e.places[n.index(name)].tiles for e, n in zip(found, names, strict=True)]
    sides = {each.trial.metadata.side for each in found}
    mirrored = sides == {"left", "right"} and name.startswith(("medial", "lateral"))
    return mirrored or all(np.array_equal(tiles[0], other) for other in tiles)


def _without_side(region: Region, found: TrialPressure) -> str:
    """Name of a region by left and right, whatever leg it is of."""
    side = found.trial.metadata.side
    if side is None:
        return region.name
    other = {"left": "right", "right": "left"}[side]
    sector, _, height = region.name.partition(" ")
    return " ".join([{"lateral": side, "medial": other}.get(sector, sector), height]).strip()


def _of_tiles(found: Sequence[TrialPressure]) -> list[Compared]:
    names = list(found[0].trial.geometry.names)
    return _outputs("tiles", OF_TILES, names, found, [names] * len(found))


def _outputs(
    part: Literal["regions", "tiles"],
    titles: Sequence[str],
    shared: Sequence[str],
    found: Sequence[TrialPressure],
    names: Sequence[Sequence[str]],
) -> list[Compared]:
    """Every output of things that all trials have.

    Args:
        part: What the things are.
        titles: The outputs, of `TITLES`.
        shared: Names of the things that are compared.
        found: The trials.
        names: Names of all things of each trial, in the order of its outputs.
    """
    outputs = [getattr(each.outputs, part) for each in found]
    rows = [[of_one.index(name) for name in shared] for of_one in names]

    def in_rows(columns: Sequence[FloatArray | BoolArray]) -> Any:
        return np.array([column[row] for column, row in zip(columns, rows, strict=True)])

    compared = []
    for title in titles:
        quantities = [read_column(of_one, title) for of_one in outputs]
        compared.append(
            Compared(
                part,
                shared,
                title,
                in_rows([quantity.value for quantity in quantities]),
                in_rows([quantity.low for quantity in quantities]),
                in_rows([quantity.high for quantity in quantities]),
                in_rows(
                    [q.determined(each.share) for q, each in zip(quantities, found, strict=True)]
                ),
                turn=360.0 if title.endswith("[deg]") else float("inf"),
            )
        )
    return compared


def _of_wrench(found: Sequence[TrialPressure]) -> list[Compared]:
    """Mean and standard deviation of the wrench over the segment; the load cell has no interval."""
    wrenches = [each.trial.samples()[each.segment.rows].wrench for each in found]
    compared = []
    means = np.array([_mean(wrench) for wrench in wrenches])
    squares = [_mean((w - mean) ** 2) for w, mean in zip(wrenches, means, strict=True)]
    for of_name, values in (("mean", means), ("standard deviation", np.sqrt(squares))):
        for column, channel in enumerate(WRENCH_CHANNELS):
            title = f"{of_name} [{channel_unit(channel)}]"
            chosen = values[:, column : column + 1]
            compared.append(Compared.plain("wrench", [channel], title, chosen))
    return compared


def _mean(values: FloatArray) -> FloatArray:
    """Means of the finite values of each column; NaN without any."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0))


def _trial_notes(
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
    own = {name for each in found for name in each.trial.geometry.regions}
    lacking = sorted(n for n in own if any(n not in t.geometry.regions for t in trials))
    if lacking:
        notes.append(f"not compared, since not all trials have these regions: {', '.join(lacking)}")
    forces = [_mean_force(each) for each in found]
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


def _mean_force(found: TrialPressure) -> float:
    wrench = found.trial.samples()[found.segment.rows].wrench
    return float(np.linalg.norm(_mean(wrench[:, 3:])))
