"""How a comparison is computed from the pressures of trials: shared outputs, differences, notes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SECTOR_TURNS, UNMEASURED
from socket_testbed.identification.differences import (
    DIFFERENCE,
    POWER,
    SAME_LIMB,
    VALUE,
    VALUES,
    Conditions,
)
from socket_testbed.results.comparison import COLUMNS, MAPPED, Comparison
from socket_testbed.results.pressure import Rows, TrialPressure
from socket_testbed.samples import WRENCH_CHANNELS, channel_unit
from socket_testbed.settings.options import Side
from socket_testbed.tables import split_unit
from socket_testbed.trials.metadata import FIELDS, NO_SIDE
from socket_testbed.trials.trial import Trial

_LOAD_TOLERANCE = 0.1  # [-]; relative difference in mean force that is noted
_TIME_TOLERANCE = 0.05  # [-]; relative difference in the integrated time that is noted


def compare_pressures(
    found: Sequence[TrialPressure],
    names: Sequence[str],
    conditions: Conditions,
    over: str,
    by_region: bool = False,
    one_prior: bool = False,
) -> Comparison:
    """Trials or conditions side by side.

    Args:
        found: The pressure of each of k trials, condition by condition, the reference first.
        names: Their names.
        conditions: The conditions, and which of them each trial belongs to.
        over: Segment and contact threshold, in words.
        by_region: Whether trials are compared by region alone; their sockets may then differ.
        one_prior: Whether all maps have one prior, whatever the trials' own settings say.
    """
    trials = [each.trial for each in found]
    first, sides = trials[0], {trial.metadata.side for trial in trials}
    one_socket = all(trial.geometry.same_tiles(first.geometry) for trial in trials)
    rows = _shared_rows(found, one_socket, by_region)
    values = values_table(conditions, rows, _correlation(trials, conditions))
    notes = [*_notes(found, names, rows, one_socket, conditions.freedom)]
    if not one_prior and len({trial.estimator.force_map for trial in trials}) > 1:
        notes.append(
            "the trials were recorded with different priors of the force map (force_map.*): give"
            " one with --params"
        )
    return Comparison(
        conditions=conditions.grouped(names),
        title=_detectable(values, conditions) + over,
        notes=tuple(notes),
        table=pd.concat([_texts(found, names, conditions), values], ignore_index=True),
        geometry=None if by_region else first.geometry,
        side=sides.pop() if len(sides) == 1 else None,
    )


def values_table(
    conditions: Conditions, rows: Sequence[Rows], correlation: FloatArray | float = 0.0
) -> pd.DataFrame:
    """A table with `COLUMNS` of the outputs shared by k trials, see `Conditions.columns`.

    Only errors of the force map are correlated. Angles are compared modulo 360 degrees. Repeated
    trials add columns for their spread.

    Args:
        conditions: The c conditions, and which of them each trial belongs to.
        rows: The outputs of each trial, the first trial's first; all have the same m keys in the
            same order. An output without `low` and `high` is exact.
        correlation: Correlation of the map's errors in each condition with those in the first, a
            number or shape (c, 1) [-].

    Returns:
        A row per output and condition, the conditions of one output one after the other, as in
        `Comparison.to_dataframe`.
    """
    keys = [(part, name, *split_unit(title)) for part, name, title in rows[0]]
    table = pd.DataFrame(keys, columns=[*COLUMNS[:4]])
    values, low, high = (
        np.array([[row.get(end, np.nan) for row in one.values()] for one in rows]) for end in VALUE
    )
    correlation = correlation * table["part"].isin(MAPPED).to_numpy()
    turn = np.where(table["unit"] == "deg", 1.0 / 360.0, 0.0)
    if conditions.freedom:  # exact values still vary between trials
        low, high = (np.where(np.isnan(end), values, end) for end in (low, high))
    # Bring the trials of a condition within half a turn of their mean direction.
    middle = np.degrees(np.angle(conditions.mean(np.exp(1j * np.radians(values)))))
    turns = 360.0 * np.round(turn * (values - middle[conditions.numbers]))
    columns = conditions.columns(values - turns, low - turns, high - turns, correlation)
    turns = 360.0 * np.round(turn * columns["difference"])
    columns |= {end: columns[end] - turns for end in DIFFERENCE}
    table = table.loc[table.index.repeat(len(conditions.names))].reset_index(drop=True)
    table["item"] = [*conditions.names] * len(keys)
    table = table.assign(**{name: column.T.ravel() for name, column in columns.items()})
    table.insert(COLUMNS.index("text"), "text", None)
    return table


def _shared_rows(found: Sequence[TrialPressure], one_socket: bool, by_region: bool) -> list[Rows]:
    """The outputs and the wrench of each trial that all trials share."""
    sides = {each.trial.metadata.side for each in found}
    mirrored = ("medial", "lateral") if sides == {"left", "right"} else ()
    rows: list[Rows] = []
    tiles: list[dict[str, tuple[int, ...]]] = []
    for each in found:
        side = each.trial.metadata.side if None in sides and len(sides) > 1 else None
        tiles.append({_without_side(place.name, side): tuple(place.tiles) for place in each.places})
        outputs = {
            (part, _without_side(name, side) if part == "regions" else name, title): row
            for (part, name, title), row in each.rows().items()
            if not (part == "tiles" and by_region)
        }
        rows.append(outputs | _wrench_rows(each))

    def is_shared(part: str, name: str) -> bool:
        if part == "tiles" and one_socket:  # another tile may be called like a cluster that moved
            return len({each.trial.geometry.names.index(name) for each in found}) == 1
        # Two trials' regions of one name may consist of different tiles.
        own = part == "regions" and one_socket and not name.startswith(mirrored)
        return not own or len({each.get(name) for each in tiles}) == 1

    keys = [key for key in rows[0] if all(key in row for row in rows) and is_shared(*key[:2])]
    return [{key: row[key] for key in keys} for row in rows]


def _without_side(name: str, side: Side | None) -> str:
    """A region's name in terms of left and right, for either leg."""
    if side is None:
        return name
    names = {turn: name for name, turn in SECTOR_TURNS[None].items()}
    sector, _, height = name.partition(" ")
    turn = SECTOR_TURNS[side].get(sector)
    return " ".join([sector if turn is None else names[turn], height]).strip()


def _wrench_rows(found: TrialPressure) -> Rows:
    """Mean and standard deviation of the wrench over the segment, ignoring missing values."""
    table = pd.DataFrame(found.outputs.samples.wrench, columns=list(WRENCH_CHANNELS))
    statistics = {"mean": table.mean(), "standard deviation": table.std(ddof=0)}
    return {
        ("wrench", name, f"{title} [{channel_unit(name)}]"): {"value": values[name]}
        for title, values in statistics.items()
        for name in WRENCH_CHANNELS
    }


def _detectable(table: pd.DataFrame, compared: Conditions) -> str:
    """The smallest detectable differences in words; empty without repeated trials."""
    if not compared.freedom:
        return ""
    rows = table.query("part == 'regions' and quantity == 'mean pressure'")
    smallest = rows.groupby("name")["detectable"].max()
    regions, counts = smallest.drop("socket"), np.bincount(compared.numbers)
    trials = " to ".join(map(str, sorted({counts.min(), counts.max()})))
    return (
        f"with {trials} trials per condition, differences of at least {smallest['socket']:.1f} kPa"
        f" are detectable in the socket's mean pressure, of {regions.min():.1f} to"
        f" {regions.max():.1f} kPa in that of its regions; "
    )


def _texts(
    found: Sequence[TrialPressure], names: Sequence[str], compared: Conditions
) -> pd.DataFrame:
    """Text entries of each condition; one text where its trials agree."""
    trials = [each.trial for each in found]
    described = [trial.metadata.described() for trial in trials]
    texts: dict[tuple[str, str], list[str]] = {}
    for field in FIELDS:
        if any(field in stated for stated in described):
            texts["metadata", field] = [stated.get(field, "not stated") for stated in described]
    if compared.freedom:
        texts["trials", "trials"] = [*names]
    texts |= {
        ("trials", "segment"): [str(each.segment) for each in found],
        ("trials", "samples"): [str(len(each.time)) for each in found],
        ("trials", "measured"): [each.outputs.source for each in found],
        ("trials", "socket"): [trial.geometry.source or "not stated" for trial in trials],
        ("trials", "calibration"): [trial.calibration.origin for trial in trials],
    }
    no_number = [np.nan] * len(VALUES)
    rows = []
    for (part, name), entries in texts.items():
        for item, different in compared.grouped(entries).items():
            text = "; ".join(dict.fromkeys(different))
            rows.append((part, name, "", "", item, *no_number, text))
    return pd.DataFrame(rows, columns=[*COLUMNS])


def _correlation(trials: Sequence[Trial], compared: Conditions) -> FloatArray:
    """Correlation of the map errors with those of the first condition, shape (c, 1) [-]."""
    agree = compared.grouped([_same_limb(trial, trials[0]) for trial in trials])
    of_one_limb = np.array([all(group) for group in agree.values()])
    related = of_one_limb & of_one_limb[0]
    return SAME_LIMB * related.astype(float)[:, None]


def _same_limb(trial: Trial, first: Trial) -> bool:
    """Whether two trials are of the same leg of one stated subject in one socket."""
    subject, side = trial.metadata.subject, trial.metadata.side
    if subject is None or (subject, side) != (first.metadata.subject, first.metadata.side):
        return False
    return trial.geometry.same_tiles(first.geometry)


def _notes(
    found: Sequence[TrialPressure],
    names: Sequence[str],
    rows: Sequence[Rows],
    one_socket: bool,
    freedom: int,
) -> Iterator[str]:
    trials = [each.trial for each in found]
    if not one_socket:
        yield (
            "the trials are of different sockets: regions are sectors and thirds of each socket's"
            " own height, and differ in area"
        )
    sides = [trial.metadata.side for trial in trials]
    if {"left", "right"} <= {*sides}:
        yield (
            "left and right legs are compared: medial with medial, lateral with lateral; tiles are"
            " compared where they are in the socket"
        )
    elif None in sides and any(sides):
        unknown = ", ".join(n for n, side in zip(names, sides, strict=True) if side is None)
        yield f"{unknown}: {NO_SIDE}"
    shared = {name for part, name, _ in rows[0] if part == "regions"}
    own = {name for trial in trials for name in trial.geometry.regions}
    own |= {place.name for each in found for place in each.places if place.name == UNMEASURED}
    if lacking := sorted(own - shared):
        yield f"not compared, because these regions differ between trials: {', '.join(lacking)}"
    subjects = {trial.metadata.subject for trial in trials}
    if freedom:
        yield (
            "values are means of repeated trials; spread: the standard deviation between donnings"
            f" (degrees of freedom: {freedom}), included in the intervals; detectable: the smallest"
            f" difference that {100 * POWER:.0f} % of such studies would tell from 0"
        )
    if freedom and len(subjects) > 1:
        yield "several limbs: the spread between donnings includes that between the limbs"
    elif freedom and None in subjects:
        yield (
            "no subject is stated: errors of one limb are assumed not to cancel in a difference;"
            " state it with 'annotate TRIAL --subject CODE'"
        )
    forces = [
        float(np.linalg.norm([row["wrench", f"F{axis}", "mean [N]"]["value"] for axis in "xyz"]))
        for row in rows
    ]
    times = [each.outputs.integrated for each in found]
    for name, force, time in zip(names[1:], forces[1:], times[1:], strict=True):
        if abs(force - forces[0]) > _LOAD_TOLERANCE * forces[0]:
            yield (
                f"the mean force is {force:.0f} N in {name} and {forces[0]:.0f} N in {names[0]}:"
                " differences in pressure include that of the load"
            )
        if abs(time - times[0]) > _TIME_TOLERANCE * times[0]:
            yield (
                f"the pressure-time integral covers {time:.1f} s in {name} and {times[0]:.1f} s in"
                f" {names[0]}: the times differ"
            )
