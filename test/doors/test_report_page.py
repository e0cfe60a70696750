"""The page of a report on the scene and the files beside it, against hand values.

Pressures are over the whole trial, models are fitted on its first half by hand: see
`support.results_by_hand`, whose numbers the comments use. `distal.Fx` is not in the objective.
"""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh
from support import scene
from support.pages import Page
from support.results_by_hand import tile

from socket_testbed.identification.pressure import Quantity
from socket_testbed.report import pressure
from socket_testbed.report.page import write_socket_page
from socket_testbed.report.write import summarise

NOTHING = "\N{EN DASH}"
MODELS = ("stiffness", "stiffness_bias", "rigid_bias")


@pytest.fixture(scope="module")
def data(report) -> dict[str, Any]:
    """What the cards and the pictures are drawn from."""
    return json.loads(report.page.script("page-data"))


def chart(report, name: str) -> dict[str, Any]:
    """The data of a chart."""
    return json.loads(report.page.script(f"chart-{name}-data"))


def csv(report, name: str, index: str) -> pd.DataFrame:
    """A file beside the page."""
    return pd.read_csv(report.files / f"{name}.csv").set_index(index)


def cell(report, table: str, row: str, title: str) -> str:
    """A cell of a table whose titles are in one row."""
    titles = report.page.tables[table][0]
    return report.page.rows(table)[row][titles.index(title) - 1]


def grouped_cell(report, table: str, row: str, group: str, title: str) -> str:
    """A cell of a table whose columns are grouped by models, the first of them under no group."""
    groups, titles = report.page.tables[table][:2]
    names = [name for name in groups if name]
    places = [place for place, found in enumerate(titles) if found == title]
    return report.page.rows(table)[row][places[names.index(group)] - 1]


# --- pressure

PRESSURE = {
    # the hand values of `scene.ANSWERS`, as printed
    "anterior": {
        "peak pressure [kPa]": "60.0\n57.6 to 62.5",
        "mean pressure [kPa]": "23.7\n21.7 to 25.6",
        "contact area [cm²]": "27\n27 to 27",
        "pressure-time integral [kPa s]": "565\n507 to 623",
        "share of load [%]": "34\n33 to 35",
    },
    "lateral": {
        "peak pressure [kPa]": "45.0\n42.6 to 47.5",
        "mean pressure [kPa]": "11.7\n10.0 to 13.4",
        "contact area [cm²]": "15\n13 to 16",
        "pressure-time integral [kPa s]": "275\n243 to 311",
        "share of load [%]": "25\n24 to 25",
    },
    "lateral middle": {  # it pulls by 1 kPa, +-1.96
        "mean pressure [kPa]": "-1.0\n-3.0 to 1.0, uncertain",
        "contact area [cm²]": "0\n0 to 0",
    },
    "socket": {
        "mean pressure [kPa]": "14.5\n12.7 to 16.4",
        "contact area [cm²]": "85\n75 to 94",
    },
}
SHEAR = {
    "anterior": {
        "shear [kPa]": "1.9\n1.4 to 2.7",
        "shear direction [deg]": "135\n105 to 150",
        "centre of pressure x [mm]": "44\n43 to 44",
        "centre of pressure y [mm]": "0\n0 to 0",
        "centre of pressure z [mm]": "151\n151 to 151",
    },
    "lateral": {
        "shear [kPa]": "3.3\n2.6 to 4.2",
        "shear direction [deg]": "143\n130 to 151",
        "centre of pressure x [mm]": "0\n0 to 0",
        "centre of pressure y [mm]": "-45\n-46 to -45",
        "centre of pressure z [mm]": "190\n187 to 192",
    },
    "lateral middle": {"shear [kPa]": "0.0\n0.0 to 1.0, uncertain"},
    "lateral proximal": {  # a single tile: its centre is certain
        "centre of pressure y [mm]": "-50\n-50 to -50",
        "centre of pressure z [mm]": "210\n210 to 210",
    },
    "posterior distal": {
        "centre of pressure x [mm]": "-20\n-20 to -20",
        "centre of pressure z [mm]": "90\n90 to 90",
    },
}


@pytest.mark.parametrize("place", PRESSURE)
def test_the_pressure_table_holds_the_known_outputs(place: str, report) -> None:
    for title, answer in PRESSURE[place].items():
        assert cell(report, "pressure-regions", place, title) == answer, title


@pytest.mark.parametrize("place", SHEAR)
def test_the_shear_table_holds_the_known_outputs(place: str, report) -> None:
    for title, answer in SHEAR[place].items():
        assert cell(report, "pressure-shear", place, title) == answer, title


LIMB = {
    # what is printed, within the 2.5 % that the range leaves out at either end
    "pistoning [mm]": ("2.99", "3.00"),
    "range of rotation about x [deg]": ("0.50",),
    "range of rotation about y [deg]": ("0.33",),
    "range of rotation about z [deg]": ("0.60",),
    "stiffness Fx [N/mm]": ("40.00",),
    "stiffness Fy [N/mm]": ("30.00",),
    "stiffness Fz [N/mm]": ("20.00",),
    "stiffness Mx [N m/deg]": ("2.00",),
    "stiffness My [N m/deg]": ("3.00",),
    "stiffness Mz [N m/deg]": ("1.00",),
}


@pytest.mark.parametrize("title", LIMB)
def test_the_limb_moves_as_it_is_suspended(title: str, report) -> None:
    value, _, _ = cell(report, "limb", title, "over the segment").partition(" ")
    assert value in LIMB[title]


def test_uncertain_cells_look_so(report) -> None:
    """And only they: of cells that name an interval."""
    cells = [cell for table in report.page.tables.values() for row in table for cell in row]
    named = sum(cell.endswith(", uncertain") for cell in cells)
    marked = sum(
        tag == "td" and attributes.get("class") == "uncertain"
        for tag, attributes in report.page.tags
    )
    assert marked == named > 10


def test_progress_counts_the_stages_done(report) -> None:
    task = "fitting, judging, mapping"
    assert report.progress == [(task, done, 5) for done in range(1, 6)]


def test_the_pressure_is_said_in_words(report) -> None:
    assert summarise(report.results)[0] == (
        "Pressure over the segment, with 95 % intervals: peak pressure 60.0 (57.6 to 62.5) kPa;"
        " mean pressure 14.5 (12.7 to 16.4) kPa; contact area 85 (75 to 94) cm². The peak is on"
        " ant_mid at 12.00 s."
    )


def test_the_page_says_what_counts_as_contact(report) -> None:
    text = " ".join(report.page.text.split())
    assert "Over all 0.00 s to 23.75 s. A value is marked uncertain if its 95 % interval" in text
    assert "reaches farther than 50 % of it; in contact: above 5 kPa; the integrals" in text
    assert "integrals cover 23.8 s" in text


def test_the_page_names_trial_and_person(report) -> None:
    assert report.page.said["h1"] == ["scene"]
    text = " ".join(report.page.text.split())
    assert "all 0.00 s to 23.75 s subject S01 side right socket scene mass 61.2 kg" in text


# --- files of the pressure


@pytest.mark.parametrize("place", ["anterior", "lateral", "socket"])
def test_the_file_of_regions_holds_the_known_outputs(place: str, report) -> None:
    row = csv(report, "pressure", "region").loc[place]
    for title, (value, low, high) in scene.ANSWERS[place].items():
        name, unit = title[:-1].split(" [")
        found = [row[f"{name}{end} [{unit}]"] for end in ("", " low", " high")]
        assert found == pytest.approx([value, low, high], rel=2e-5, abs=1e-4), title


def test_the_file_of_courses_holds_the_known_pressures(report) -> None:
    """At 12.0 s 1.5 times the means of 71 / 3 and 35 / 3 kPa."""
    row = csv(report, "pressure_of_regions", "time [s]").loc[12.0]
    ends = ("", " low", " high")
    anterior, lateral = (
        [row[f"{place}.mean pressure{end} [kPa]"] for end in ends]
        for place in ("anterior", "lateral")
    )
    assert anterior == pytest.approx([35.5, 33.54, 37.46])
    assert lateral == pytest.approx([17.5, 15.8013, 19.1987], rel=1e-4)


def test_the_map_s_file_holds_known_stresses(report) -> None:
    table = csv(report, "force_map", "tile")
    row = table.loc["ant_mid"]
    assert row["cluster"] == "mid_anterior"
    titles = ("pressure [kPa]", "pressure sd [kPa]", "shear [kPa]", "shear sd [kPa]")
    assert [row[title] for title in titles] == pytest.approx([40.0, 1.0, 5.0, 0.5], rel=1e-4)
    assert table.loc["right_mid", "pressure [kPa]"] == pytest.approx(-1.0)


def test_the_overview_s_file_tells_mean_from_peak(report) -> None:
    row = csv(report, "pressure_map", "tile").loc["right_prox"]
    assert row["mean over the segment [kPa]"] == pytest.approx(30.0)
    assert row["at the peak, 12.00 s [kPa]"] == pytest.approx(45.0)


# --- the map, the cards and the bars


def test_the_map_opens_at_the_peak(data: dict[str, Any]) -> None:
    assert data["start"] == 12.0
    (moment,) = [moment for moment in data["moments"] if moment["time"] == 12.0]
    assert moment["pressure"][tile("ant_mid")] == pytest.approx(60.0)
    assert moment["pressure"][tile("right_mid")] == pytest.approx(-1.5)
    assert moment["measured"] == [45.0, 60.0, 37.5, 21.0]


def test_the_map_holds_the_mean(data: dict[str, Any]) -> None:
    mean = data["mean"]
    assert mean["time"] is None and mean["words"] == "mean over all 0.00 s to 23.75 s"
    pressure = [16.0, 8.0, 20.0, 30.0, 40.0, 2.0, 25.0, -1.0, 15.0, 4.5, 14.0, 6.0]
    assert mean["pressure"] == pytest.approx(pressure)
    reach = [1.96] * 12
    reach[tile("left_mid")], reach[tile("right_end")] = 0.98, 1.18
    assert mean["reach"] == pytest.approx(reach)
    assert mean["shear"][tile("ant_mid")] == pytest.approx(5.0)
    assert mean["shear"][tile("right_prox")] == pytest.approx(10.0)
    assert mean["measured"] == [30.0, 40.0, 25.0, 14.0]


def test_the_mean_is_grey_where_it_is_uncertain(data: dict[str, Any]) -> None:
    """+-1.96 kPa never reach beyond 5 kPa, the least that counts as a value."""
    assert data["mean"]["grey"] == [0.0] * 12


def test_the_course_holds_load_and_peak(data: dict[str, Any]) -> None:
    course = data["course"]
    assert len(course["time"]) == 96  # up to 150 samples are all shown
    row = course["time"].index(12.0)
    assert course["force"][row] == 90.0
    assert [course[name][row] for name in ("low", "peak", "high")] == [57.55, 60.0, 62.45]
    assert [event["label"] for event in course["events"]] == ["placed", "removed"]


def test_the_cards_hold_the_known_peaks(data: dict[str, Any]) -> None:
    peak, elsewhere, found = data["cards"]
    assert peak == {
        "title": "Peak", "value": "60.0 kPa", "interval": "57.6 to 62.5",
        "words": "anterior middle, measured by mid_anterior, in the trial",
    }  # fmt: skip
    assert elsewhere == {
        "title": "Elsewhere", "value": "30.0 kPa", "interval": "27.6 to 32.5",
        "words": "highest where no sensor is: posterior proximal",
    }  # fmt: skip
    assert (found["title"], found["value"]) == ("Data", "good")


def test_the_bars_are_over_the_segment(data: dict[str, Any]) -> None:
    bars = data["bars"]
    assert [*bars["values"]] == [
        *("mean pressure [kPa]", "peak pressure [kPa]", "contact area [cm^2]"),
        *("pressure-time integral [kPa s]", "share of load [%]", "shear [kPa]"),
    ]
    for title in bars["values"]:
        for place in ("anterior", "lateral"):
            found = bars["values"][title][bars["regions"].index(place)]
            assert found == pytest.approx(scene.ANSWERS[place][title], rel=2e-5, abs=1e-4), title


EXTRAS = {
    # tile and value; rest positions of {S} from the mean position, (0.35, 0.1705, 147.0313) mm
    "stiffness: stiffness along x of {S} [N/m]": ("ant_prox", 1.0, "N/m"),
    "stiffness: stiffness along z of {S} [N/m]": ("post_end", 5000.0, "N/m"),
    "stiffness_bias: stiffness along y of {S} [N/m]": ("left_mid", 0.5, "N/m"),
    "stiffness: rest position along x of {S} [mm]": ("ant_prox", 0.15, "mm"),
    "stiffness: rest position along y of {S} [mm]": ("left_mid", 0.83, "mm"),
    "stiffness: rest position along z of {S} [mm]": ("post_end", 2.97, "mm"),
    "rigid_bias: stiffness along z of the tile's frame [N/m]": ("right_prox", 4000.0, "N/m"),
    "rigid_bias: rest position along x of the tile's frame [mm]": ("ant_mid", 3.0, "mm"),
    "rigid_bias: rest position along z of the tile's frame [mm]": ("left_prox", 20.0, "mm"),
}


@pytest.mark.parametrize("name", EXTRAS)
def test_the_map_shows_a_model_s_parameters(name: str, data: dict[str, Any]) -> None:
    place, answer, unit = EXTRAS[name]
    found = data["extras"][name]
    assert found["unit"] == unit
    assert found["values"][tile(place)] == pytest.approx(answer)


# --- measured and predicted channels

AT_PEAK = {
    # measured, then predicted by the models at 12.0 s, where F = 1.5
    ("wrench", "Fx [N]"): (14.0, 0.0, 4.0, 14.0),
    ("wrench", "Fy [N]"): (3.0, 0.0, 0.0, 0.0),
    ("wrench", "Fz [N]"): (-90.0, -22.5, -52.5, 0.0),
    ("wrench", "Mx [N m]"): (0.55, 0.0, 0.0, 0.0),
    ("wrench", "My [N m]"): (0.1, -0.45, -0.45, 0.0),  # -22.5 N at x = -20 mm
    ("wrench", "Mz [N m]"): (0.5, 0.0, 0.9, 0.0),
    ("local_forces", "brim_lateral.Fx [N]"): (-10.8, 0.0, 1.0, 0.0),
    ("local_forces", "brim_lateral.Fy [N]"): (8.1, 0.0, 2.0, 0.0),
    ("local_forces", "brim_lateral.Fz [N]"): (-40.5, 0.0, -50.0, 0.0),
    ("local_forces", "mid_anterior.Fy [N]"): (5.4, 0.0, 0.0, 0.0),
    ("local_forces", "distal.Fz [N]"): (-18.9, -22.5, -22.5, 0.0),
}


@pytest.mark.parametrize(("name", "title"), AT_PEAK)
def test_a_chart_holds_measured_and_predicted(name: str, title: str, report) -> None:
    found = chart(report, name)
    (panel,) = [panel for panel in found["panels"] if panel["title"] == title]
    assert [*panel["lines"]] == ["measured", *MODELS]
    for line, answer in zip(panel["lines"].values(), AT_PEAK[name, title], strict=True):
        assert line["x"][48] == 12.0
        assert line["y"][48] == pytest.approx(answer, abs=0.003)


@pytest.mark.parametrize(("name", "title"), AT_PEAK)
def test_a_file_holds_measured_and_predicted(name: str, title: str, report) -> None:
    row = csv(report, name, "time [s]").loc[12.0]
    channel, unit = title[:-1].split(" [")
    kinds = ("measured", *(f"predicted {model}" for model in MODELS))
    found = [row[f"{channel} {kind} [{unit}]"] for kind in kinds]
    assert found == pytest.approx(AT_PEAK[name, title], abs=0.003)


def test_charts_show_forces_first_and_the_segment(report) -> None:
    found = chart(report, "wrench")
    units = ("Fx [N]", "Fy [N]", "Fz [N]", "Mx [N m]", "My [N m]", "Mz [N m]")
    assert tuple(panel["title"] for panel in found["panels"]) == units
    assert found["over"] == "time [s]" and found["shaded"] == [[0.0, 11.75]]


def test_files_mark_the_fitted_samples(report) -> None:
    table = csv(report, "wrench", "time [s]")
    inside = table["in segment"]
    assert inside.loc[11.75] == 1 and inside.loc[12.0] == 0 and inside.sum() == 48
    assert table["stamp [ns]"].loc[12.0] == 1_800_000_012_000_000_000


def test_the_overview_holds_the_load(report) -> None:
    """At 12.0 s |(14, 3, -90)| N and |(0.55, 0.1, 0.5)| N m."""
    panels = {panel["title"]: panel["lines"] for panel in chart(report, "overview")["panels"]}
    force, moment = panels["force magnitude [N]"], panels["moment magnitude [N m]"]
    assert force["measured"]["y"][48] == pytest.approx(91.1318, abs=1e-3)
    assert moment["measured"]["y"][48] == pytest.approx(0.75, abs=1e-3)
    row = csv(report, "overview", "time [s]").loc[12.0]
    assert row["force magnitude [N]"] == pytest.approx(91.1318, abs=1e-3)
    assert row["moment magnitude [N m]"] == pytest.approx(0.75)
    assert row["brim_lateral not usable [-]"] == 0


# --- errors

MEASURES = ("RMSE", "MAE", "sigma", "skill [-]")
ERRORS = {
    # Fx: a constant 0 against 14 + 10 sin: rms sqrt(196 + 50), deviation sqrt(50)
    ("errors", "Fx", "stiffness"): ("15.684", "14.000", "7.071", "-1.218"),
    # 4 N against it: sqrt(100 + 50)
    ("errors", "Fx", "stiffness_bias"): ("12.247", "10.000", "7.071", "-0.732"),
    # -5 sin: sqrt(12.5); the mean of |sin| over 48 samples is 0.63571
    ("errors", "Fx", "rigid_bias"): ("3.536", "3.179", "3.536", "0.500"),
    # Mz: mean 0.526805, mean square 0.321805; 0.9 N m against it
    ("errors", "Mz", "stiffness"): ("0.567", "0.527", "0.210", "-1.696"),
    ("errors", "Mz", "stiffness_bias"): ("0.428", "0.373", "0.210", "-1.036"),
    # brim_lateral: -27 F N, against -50
    ("errors", "brim_lateral.Fz", "stiffness_bias"): ("25.161", "23.281", "9.542", "-1.637"),
    # distal: -12.6 F N, against -15 F
    ("errors", "distal.Fz", "stiffness"): ("2.522", "2.375", "0.848", "0.434"),
    # in the other half the mean of Mz is 0.473195, its mean square 0.268195
    ("held-out", "Mz", "stiffness"): ("0.518", "0.473", "0.210", "-1.461"),
    ("held-out", "Mz", "stiffness_bias"): ("0.476", "0.427", "0.210", "-1.261"),
    ("held-out", "Fx", "rigid_bias"): ("3.536", "3.179", "3.536", "0.500"),
    ("held-out", "brim_lateral.Fz", "stiffness_bias"): ("24.641", "22.719", "9.542", "-1.582"),
}


@pytest.mark.parametrize(("table", "channel", "model"), ERRORS)
def test_errors_are_the_known_ones(table: str, channel: str, model: str, report) -> None:
    for title, answer in zip(MEASURES, ERRORS[table, channel, model], strict=True):
        assert grouped_cell(report, table, channel, model, title) == answer, title


@pytest.mark.parametrize("table", ["errors", "held-out"])
def test_errors_have_their_units(table: str, report) -> None:
    rows = report.page.rows(table)
    assert rows["Mx"][0] == "N m" and rows["Fx"][0] == "N" and rows["distal.Fz"][0] == "N"
    assert rows["mean moment RMSE in the objective"][0] == "N m"
    assert rows["mean force RMSE in the objective"][0] == "N"
    assert rows["median local RMSE in the objective"][0] == "N"
    assert rows["median skill in the objective"][0] == "-"


@pytest.mark.parametrize("table", ["errors", "held-out"])
def test_errors_name_what_was_left_out(table: str, report) -> None:
    remarks = {name: cells[-1] for name, cells in report.page.rows(table).items()}
    assert remarks["distal.Fx"] == "not in objective"
    assert remarks["distal.Fy"] == "" and remarks["Fx"] == ""


SUMMARIES = {
    # local, without distal.Fx: 5.4 * 1.05079 N (brim_lateral.Fy) and 4.5 * 1.05079 N
    # (posterior_distal.Fx) are the sixth of eleven
    ("median local RMSE in the objective", "stiffness", "RMSE"): "5.674",
    ("median local RMSE in the objective", "stiffness_bias", "RMSE"): "4.729",
    # most channels are predicted as 0: 1 - 1.05079 / 0.35340
    ("median skill in the objective", "stiffness", "skill [-]"): "-1.973",
}


@pytest.mark.parametrize(("row", "model", "title"), SUMMARIES)
def test_summaries_count_the_objective(row: str, model: str, title: str, report) -> None:
    answer = SUMMARIES[row, model, title]
    assert grouped_cell(report, "errors", row, model, title) == answer


def test_mean_errors_are_of_their_channels(report) -> None:
    """The third of the sum of three rows."""
    for kind in "MF":
        name = {"M": "mean moment RMSE", "F": "mean force RMSE"}[kind]
        rows = [grouped_cell(report, "errors", f"{kind}{x}", "rigid_bias", "RMSE") for x in "xyz"]
        found = grouped_cell(report, "errors", f"{name} in the objective", "rigid_bias", "RMSE")
        assert float(found) == pytest.approx(sum(map(float, rows)) / 3.0, abs=1e-3)


def test_the_file_of_errors_tells_the_parts_apart(report) -> None:
    table = pd.read_csv(report.files / "errors.csv").set_index(["model", "samples of", "channel"])
    row = table.loc["stiffness_bias", "segment", "Mz"]
    found = [row[title] for title in MEASURES]
    assert found == pytest.approx([0.428434, 0.373195, 0.210432, -1.03597], rel=1e-4)
    assert row["unit of RMSE, MAE, sigma"] == "N m" and row["samples [1]"] == 48
    assert table.loc[("stiffness", "rest", "Mz"), "RMSE"] == pytest.approx(0.517875, rel=1e-4)
    assert table.loc[("stiffness", "segment", "distal.Fx"), "in objective"] == 0
    assert table.loc[("stiffness", "segment", "distal.Fy"), "in objective"] == 1


def test_models_are_described_in_words(report) -> None:
    """The mean force is |(14, 3 + 10 * 0.21153, -60 * 0.98958)| N."""
    first, *models = summarise(report.results)[2:]
    assert first.startswith(
        "Fitted to the segment, all 0.00 s to 11.75 s: 48 of 96 samples, mean force 61.2 N"
    )
    assert first.endswith("Errors over it are in-sample, those over the rest held-out.")
    assert [line.partition(":")[0] for line in models] == [*MODELS]
    assert "median local RMSE 5.67 N, median skill -1.97; held-out:" in models[0]
    assert models[1].endswith("its constant force, carried by no tile, 30.3 N.")  # |(4, 0, -30)|


# --- load shares, offsets, springs

SHARES = {
    # 15 of 60 N; 30 * 60 * 0.98958 of 3600 * 1.10417 N^2; against the whole force, whose mean
    # square is 4292.7 N^2: 993.75 and 4 * 14 + 1781.25
    ("Fz", "stiffness"): ("25", "0", "75"),
    ("Fz", "stiffness_bias"): ("25", "45", "30"),
    ("force", "stiffness"): ("23", "0", "77"),
    ("force", "stiffness_bias"): ("23", "43", "34"),
}


@pytest.mark.parametrize(("row", "model"), SHARES)
def test_shares_of_the_load_are_the_known_ones(row: str, model: str, report) -> None:
    titles = ("springs [%]", "offsets [%]", "residual [%]")
    found = [grouped_cell(report, "shares", row, model, title) for title in titles]
    assert found == [*SHARES[row, model]]


def test_weak_springs_are_noted(report) -> None:
    text = " ".join(report.page.text.split())
    assert (
        "stiffness_bias: the springs bear only 23 % of the measured force (25 % of Fz), the"
        " offsets 43 %"
    ) in text


OFFSETS = {"Mz": ("N m", "0.900", "0.000"), "Fx": ("N", "4.000", "7.000")}
OFFSETS |= {"Fz": ("N", "-30.000", "0.000"), "brim_lateral.Fx": ("N", "1.000", "0.000")}
OFFSETS |= {"brim_lateral.Fz": ("N", "-50.000", "0.000"), "distal.Fz": ("N", "0.000", "0.000")}


@pytest.mark.parametrize("channel", OFFSETS)
def test_offsets_are_the_known_ones(channel: str, report) -> None:
    assert report.page.tables["offsets"][0][1:] == [
        *("unit", "offset stiffness_bias [unit of the row]", "offset rigid_bias [unit of the row]")
    ]
    assert report.page.rows("offsets")[channel] == [*OFFSETS[channel]]
    row = csv(report, "offsets", "channel").loc[channel]
    assert [row["unit"], *map("{:.3f}".format, row.iloc[1:])] == [*OFFSETS[channel]]


TILES = {
    # file, tile, title, value
    "stiffness": ("tile_stiffness_stiffness", "post_end", "stiffness z [N/m]", 5000.0),
    "bias": ("tile_stiffness_stiffness_bias", "left_mid", "stiffness y [N/m]", 0.5),
    "rigid": ("tile_stiffness_rigid_bias", "right_prox", "stiffness z [N/m]", 4000.0),
    "anchor": ("tile_stiffness_rigid_bias", "right_prox", "anchor y in S [m]", -0.05),
    "rest": (
        *("rest_positions", "left_mid"),
        *("rest position from the mean limb position y [mm]", 0.82949),
    ),
    "rigid rest": (
        *("rest_positions_rigid_bias", "right_prox"),
        *("rest position from the reference pose z [mm]", -20.0),
    ),
}


@pytest.mark.parametrize("name", TILES)
def test_files_hold_parameters_by_tile(name: str, report) -> None:
    file, place, title, answer = TILES[name]
    assert csv(report, file, "tile").loc[place, title] == pytest.approx(answer, rel=1e-4)


def test_files_hold_the_engaged_springs(report) -> None:
    """`ant_prox` lets go while sin > 0.6: in 15 of 48 samples, at 3 s among them."""
    table = csv(report, "engaged_tiles", "tile")
    assert table.loc["ant_prox", "stiffness.x engaged [-]"] == pytest.approx(33 / 48)
    assert table.loc["post_end", "stiffness.z engaged [-]"] == 1.0
    assert table.loc["post_end", "stiffness.x engaged [-]"] == 0.0
    assert table.loc["left_prox", "rigid_bias.normal engaged [-]"] == 1.0
    assert table.loc["right_prox", "rigid_bias.normal engaged [-]"] == 0.0
    row = csv(report, "engaged_springs", "time [s]").loc[3.0]
    assert row["stiffness.springs.engaged [1]"] == 1
    assert row["stiffness.springs.engaged_share [-]"] == pytest.approx(1 / 36)
    assert row["rigid_bias.springs.engaged_share [-]"] == pytest.approx(1 / 12)


# --- fronts

MARKS = {
    ("stiffness", "sensor-only"): ("0", "1.0000", "0.1000", "4.000", "40.000", "5.000", ""),
    ("stiffness", "knee"): ("0.4", "0.3000", "0.2000", "3.000", "30.000", "6.000", ""),
    ("stiffness", "wrench-only"): ("1", "0.1000", "1.0000", "1.000", "10.000", "8.000", ""),
    ("stiffness_bias", "knee"): ("0.4", "0.2000", "0.3000", "3.000", "30.000", "6.000", ""),
}


@pytest.mark.parametrize(("variant", "solution"), MARKS)
def test_marked_solutions_are_the_known_ones(variant: str, solution: str, report) -> None:
    titles, *rows = report.page.tables["marks"]
    assert titles == [
        *("variant", "solution", "theta [-]", "wrench error [-]", "local error [-]"),
        *("mean moment RMSE [N m]", "mean force RMSE [N]", "median local RMSE [N]", "remark"),
    ]
    (row,) = [row for row in rows if row[:2] == [variant, solution]]
    assert row[2:] == [*MARKS[variant, solution]]


def test_the_chart_of_the_front_has_wrench_across(report) -> None:
    """Without the dominated solution, in the order of the wrench's error."""
    found = chart(report, "pareto")
    assert found["over"] == "wrench error √J_w [-]"
    (panel,) = found["panels"]
    assert panel["title"] == "local error √J_f [-]"
    line = panel["lines"]["stiffness: knee at θ = 0.4"]
    assert line["x"] == [0.1, 0.3, 1.0] and line["y"] == [1.0, 0.2, 0.1]
    assert found["log"] and found["dots"]


def test_the_knee_is_said_in_words(report) -> None:
    """1 - (0.2 / 0.9 + 0.1 / 0.9) below the chord."""
    assert "stiffness: knee of depth 0.67: the front spans 0.9 by 0.9." in report.page.text


def test_the_file_of_the_front_holds_every_solution(report) -> None:
    table = csv(report, "pareto", "variant").loc["stiffness"]
    assert table["theta [-]"].tolist() == [0.0, 0.4, 0.8, 1.0]
    assert table["wrench error [-]"].tolist() == [1.0, 0.3, 0.35, 0.1]
    assert table["local error [-]"].tolist() == [0.1, 0.2, 0.6, 1.0]
    assert table["non-dominated"].tolist() == [1, 1, 0, 1]
    assert table["RMSE Fx [N]"].tolist() == [40.0, 30.0, 20.0, 10.0]


# --- this trial and the paper


def test_the_paper_s_figures_are_beside_this_trial_s(report) -> None:
    groups, titles, *_ = report.page.tables["paper"]
    assert [group for group in groups if group] == ["this trial", "the paper"]
    assert titles == ["figure", *["without offsets", "with offsets"] * 2, "remark"]
    rows = report.page.rows("paper")
    assert rows["median local RMSE [N]"][:4] == ["5.674", "4.729", "90.07", "3.76"]
    assert rows["mean moment RMSE [N m]"][2:4] == ["1.69", "0.44"]
    assert rows["mean force RMSE [N]"][2:4] == ["5.94", "5.25"]
    remark = rows["median local RMSE [N]"][4]
    assert "load of 61 N, about 300 N" in remark and "48 samples, 1000" in remark
    assert "11 of 12 channels counted, 9 in the paper" in remark


# --- validation

JUDGED = {
    "cluster-left-out": {
        "inverse distance": {"error [-]": "0.80", "in 95 % [%]": NOTHING},
        "inverse distance, wrench met": {"error [-]": "0.50"},
        "force map": {
            "error [-]": "0.30", "in 50 % [%]": "55", "in 80 % [%]": "85", "in 95 % [%]": "97",
        },
    },
    "tiles-second-half": {
        "inverse distance": {"error [-]": "1.20"},
        "force map": {"error [-]": "0.45", "in 50 % [%]": "40", "in 95 % [%]": "90"},
    },
    "wrench-second-half": {
        "rigid_bias": {
            "moment RMSE [N m]": "0.500", "force RMSE [N]": "8.00",
            "moment skill [-]": "0.75", "force skill [-]": "0.60",
        },
        "best constant": {"moment RMSE [N m]": "2.000", "force RMSE [N]": "20.00"},
    },
    "wrench-in-sample": {
        "rigid_bias": {"moment RMSE [N m]": "0.250", "force RMSE [N]": "4.00"},
    },
}  # fmt: skip


@pytest.mark.parametrize("table", JUDGED)
def test_judgements_are_the_known_ones(table: str, report) -> None:
    for predictor, answers in JUDGED[table].items():
        for title, answer in answers.items():
            assert cell(report, table, predictor, title) == answer, (predictor, title)


def test_in_sample_judgements_are_called_so(report) -> None:
    captions = report.page.said["caption"]
    assert "Wrench from the pose alone, IN-SAMPLE: on the fitted half" in captions
    names = [*report.page.tables]
    place = names.index("wrench-in-sample")
    assert captions[place].endswith("IN-SAMPLE: on the fitted half")
    assert captions[names.index("tiles-second-half")].endswith("against the simulated truth")


def test_the_file_of_judgements_holds_shares(report) -> None:
    table = csv(report, "validation", "question").loc["tiles"].set_index("predictor")
    row = table.loc["force map"]
    titles = ("within 50 % [-]", "within 80 % [-]", "within 95 % [-]")
    assert [row[title] for title in titles] == [0.4, 0.7, 0.9]
    assert row["error [-]"] == 0.45 and row["samples [1]"] == 48


# Deviations over the first half: 0.25 / sqrt(2) mm; 1/3 * 0.67471 mm; 3 * 0.35340 mm;
# 0.3 * 0.70145 deg about z; the noise is far smaller.
MOTIONS = {
    "position x": "0.18 mm",
    "position y": "0.22 mm",
    "position z": "1.1 mm",
    "rotation about z": "3.7 mrad",
}


@pytest.mark.parametrize("name", MOTIONS)
def test_the_motion_is_the_known_one(name: str, report) -> None:
    assert any(
        text.startswith(f"{name}: {MOTIONS[name]} of motion, ") for text in report.page.said["li"]
    )


# --- data


def test_the_segment_s_load_is_known(report) -> None:
    """|(14, 5.1153, -59.375)| N and |(0.2327, 0.1631, 0.5268)| N m over 11.75 s."""
    assert report.page.tables["plateaus"][0] == [
        *("part", "duration [s]", "mean force [N]", "its sigma [N]"),
        *("mean moment [N m]", "its sigma [N m]"),
    ]
    row = report.page.rows("plateaus")["all 0.00 s to 11.75 s"]
    assert row[:2] == ["11.75", "61.2"]
    assert row[3] == "0.60"


NOISE = {
    # the smallest step of the channel over sqrt(12): 10 N * (1 - cos 7.5 deg), and 30 N, 1.5 mm,
    # 13.5 N times (1 - cos 3.75 deg)
    ("force [N]", "x"): "0.025",
    ("force [N]", "z"): "0.019",
    ("limb position [mm]", "z"): "0.00093",
    ("brim_lateral [N]", "z"): "0.0083",
    # third differences of 0.25 deg at 15 deg a sample: 4.363 mrad * 0.01780 / sqrt(40) / 0.9866
    ("limb rotation [mrad]", "x"): "0.012",
}


@pytest.mark.parametrize(("row", "axis"), NOISE)
def test_noise_is_in_its_unit(row: str, axis: str, report) -> None:
    assert cell(report, "noise", row, axis) == NOISE[row, axis]


def test_no_sample_dropped_out(report) -> None:
    titles = report.page.tables["drop-outs"][0]
    assert titles == [
        *("measurement", "missing [1]", "missing [%]", "of them in the segment [1]"),
        *("longest [s]", "saturated [1]", "out of range [1]"),
    ]
    rows = report.page.rows("drop-outs")
    assert rows["Mx"] == ["0", "0.00", "0", "0.00", NOTHING, NOTHING]
    assert rows["distal"] == ["0", "0.00", "0", "0.00", "0", "0"]


KKT = {
    # bound violation, stationarity, gap
    ("stiffness", "1, rest positions"): ("1.0e-12", "2.0e-12", "3.0e-12", "osqp", "20 of 36"),
    ("stiffness", "2, stiffnesses"): ("2.0e-11", "4.0e-11", "6.0e-11", "warm start", "20 of 36"),
    ("rigid_bias", "joint"): ("3.0e-10", "6.0e-10", "9.0e-10", "osqp", "20 of 36"),
    ("stiffness", "front, 4 of 4 solutions sound"): (NOTHING, "4.0e-12", NOTHING, "", ""),
}


@pytest.mark.parametrize(("variant", "stage"), KKT)
def test_certificates_are_the_known_ones(variant: str, stage: str, report) -> None:
    titles, *rows = report.page.tables["kkt"]
    assert titles[2:5] == ["bound violation [-]", "stationarity [-]", "duality gap [-]"]
    (row,) = [row for row in rows if row[:2] == [variant, stage]]
    assert row[2:] == [*KKT[variant, stage]]


def test_the_provenance_holds_the_span_in_utc(report) -> None:
    rows = report.page.rows("provenance-table")
    first, last = rows["trial, first sample"][0], rows["trial, last sample"][0]
    assert first == "2027-01-15 08:00:00 UTC (stamp 1800000000000000000 ns)"
    assert last == "2027-01-15 08:00:23 UTC (stamp 1800000023750000000 ns)"
    assert rows["calibration, source and date"] == ["made by hand (2026-01-01)"]
    assert rows["command"] == ["by hand"]


def test_the_settings_are_those_in_use(report) -> None:
    rows = report.page.rows("settings")
    assert rows["identification.frames"] == ["48"]
    assert rows["identification.leave_out"] == ["distal.Fx"]


# --- the page of a socket alone


def test_a_socket_s_page_has_areas_and_heights(tmp_path: Path) -> None:
    """16 cm^2 at 120 mm above the distal end, 9 cm^2 on the end."""
    path = tmp_path / "socket.html"
    mesh = trimesh.creation.icosphere(1, radius=0.05)
    write_socket_page(mesh, scene.geometry(), path, "a socket", [("tiles", "12")])
    page = Page(path.read_text(encoding="utf-8"))
    extras = json.loads(page.script("page-data"))["extras"]
    area, height = extras["area [mm^2]"], extras["height [mm]"]
    assert (area["unit"], height["unit"]) == ("mm²", "mm")
    assert area["values"][tile("left_prox")] == pytest.approx(1600.0)
    assert area["values"][tile("ant_mid")] == pytest.approx(900.0)
    assert height["values"][tile("left_prox")] == pytest.approx(120.0)
    assert height["values"][tile("ant_mid")] == pytest.approx(60.0)
    assert height["values"][tile("right_end")] == pytest.approx(0.0, abs=1e-9)
    assert page.rows("facts")["tiles"] == ["12"]


@pytest.mark.parametrize(
    ("own", "highest", "words"),
    [
        pytest.param(30.5e3, 31.2e3, "; highest of the trial 31.2 at 48 s", id="elsewhere"),
        pytest.param(31.2e3, 31.2e3, "", id="in the segment"),
        pytest.param(31.16e3, 31.2e3, "", id="equal as printed"),
    ],
)
def test_a_card_names_the_trial_s_highest(own: float, highest: float, words: str) -> None:
    values = np.array([1e3, own])  # the socket is the last region
    regions = SimpleNamespace(peak=Quantity(values, values, values, values))
    found: Any = SimpleNamespace(outputs=SimpleNamespace(regions=regions))
    course: Any = SimpleNamespace(highest=highest, highest_time=47.75)
    assert pressure._highest(found, course) == words
