"""The page of a survey of one limb: verdict, cards, maps, and judged places."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import NORMAL_QUANTILE
from socket_testbed.pages.document import moment, socket_document
from socket_testbed.report.page import Maps, Section, origin_table, write_page
from socket_testbed.results.survey import LEGEND, Survey
from socket_testbed.tables import Table, pairs_table

_MAPS = (
    "Normal pressure on the unrolled wall and the distal end, mean over the like loads, on a common"
    " scale; the greyer, the less certain. Own: from the clusters of this trial alone; completed:"
    " from those of all trials; limb: what all donnings share. Outlined: tiles that a trial"
    " measured."
)


def write_survey(found: Survey, path: Path, command: str) -> None:
    """Write a survey as one page that opens offline, or replace it.

    Args:
        found: The survey.
        path: The page, ending in `.html`.
        command: The command that made the page, for the record.
    """
    scores, judged = found.tables()
    pressures = Table("tiles", "Normal pressure", found.pressures())
    used = [
        (name, f"{segment}; {', '.join(f'{c} on {tile}' for c, tile in places.items())}")
        for name, segment, places in zip(found.trials, found.segments, found.clusters, strict=True)
    ]
    data, titles = _map_data(found)
    verdict = f"{found.verdict[0].upper()}{found.verdict[1:]}."
    groups = {
        "": [
            Section("verdict", "Verdict", [verdict, found.conclusions()]),
            *([Section("notes", "Notes", [found.notes])] if found.notes else []),
            Section("maps", "Own and completed maps", [Maps(titles, _MAPS)]),
            Section("judged", "Judged", [f"{LEGEND[0].upper()}{LEGEND[1:]}.", scores]),
        ],
        "Numbers": [
            Section("places", "Judged places", [judged]),
            Section("tiles", "Tile by tile", [pressures]),
        ],
        "Data": [
            Section("trials", "Trials", [pairs_table("trials-table", "Parts and clusters", used)]),
            Section("provenance", "Provenance", [origin_table(command)]),
        ],
    }
    title = f"Survey of one limb: {', '.join(found.trials)}"
    subtitle = f"{found.states} like loads, {len(found.judgements.points)} judged places"
    write_page(path, title, subtitle, groups, data | {"cards": _cards(found)})


def _cards(found: Survey) -> list[dict[str, Any]]:
    """The errors of a single and of the completed map, and what donning and sensors explain."""
    judged = found.judgements
    shown = []
    for title, value, words in (
        ("Map of one trial", judged.error, "error between its clusters, of the force there"),
        ("Completed map", judged.completed, "error on tiles that no trial measured"),
        ("Donning and sensors", judged.explained, "share of the judged square"),
    ):
        known = np.isfinite(value.low)
        ends = f"{100.0 * value.low:.0f} to {100.0 * value.high:.0f} %" if known else ""
        shown.append(
            {
                "title": title,
                "value": f"{100.0 * value.value:.0f} %",
                "interval": ends,
                "words": words,
            }
        )
    return shown


def _map_data(found: Survey) -> tuple[dict[str, Any], dict[str, str]]:
    """Maps of every trial alone and completed, and of the limb, on one scale, and their titles."""
    table = found.pressures()
    titles = [name.removesuffix(" [kPa]") for name in table if not name.endswith(" sd [kPa]")]
    nothing = np.zeros(0)
    maps: list[dict[str, Any]] = []
    for number, title in enumerate(titles):
        pressure = 1e3 * table[f"{title} [kPa]"].to_numpy()
        reach = NORMAL_QUANTILE * 1e3 * table[f"{title} sd [kPa]"].to_numpy()
        shown = moment(0.0, pressure, reach, nothing, nothing) | {"highest": "highest"}
        maps.append({"box": f"map-{number}", "moment": shown, "range": None, "diverging": False})
    scale = float(max(table[f"{title} [kPa]"].max() for title in titles))
    data = {"socket": socket_document(found.surveyed, found.side), "maps": maps, "scale": scale}
    return data, {f"map-{number}": title for number, title in enumerate(titles)}
