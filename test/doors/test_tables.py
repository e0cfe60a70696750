"""The tables of `pressure` and `map`: each number of the scene, by its title, as known by hand.

The doors: the API's tables, the document for JSON, CSV, Parquet and MAT files, and the terminal.
"""

import io
import json
import re
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat
from support import scene

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.results.pressure import TrialMap, TrialPressure
from socket_testbed.samples import Status

PLACES = [*scene.ANSWERS]
TITLES = [*scene.ANSWERS["socket"]]
ENDS = ("", " low", " high")


def ended(title: str, end: str) -> str:
    """The title of an end of an interval: `shear low [kPa]`."""
    name, unit = title[:-1].split(" [")
    return f"{name}{end} [{unit}]"


def assert_is(found: float, title: str, answer: float) -> None:
    """A number as a table gives it: to the fourth decimal of the answer."""
    assert found == pytest.approx(answer, rel=2e-5, abs=1e-4), title


@pytest.fixture(scope="module")
def found(trial) -> TrialPressure:
    return st.pressure(trial, "all")


@pytest.fixture(scope="module")
def mapped(trial) -> TrialMap:
    return st.force_map(trial, "all")


# --- regions, over the whole trial

Read = Callable[[TrialPressure, Path], dict[str, dict[str, float]]]


def from_api(found: TrialPressure, folder: Path) -> dict[str, dict[str, float]]:
    return found.regions.to_dict("index")


def from_csv(found: TrialPressure, folder: Path) -> dict[str, dict[str, float]]:
    found.save(folder / "a.csv")
    return pd.read_csv(folder / "a.csv", index_col="region").to_dict("index")


def from_parquet(found: TrialPressure, folder: Path) -> dict[str, dict[str, float]]:
    found.save(folder / "a.parquet")
    return pd.read_parquet(folder / "a.parquet").set_index("region").to_dict("index")


def from_mat(found: TrialPressure, folder: Path) -> dict[str, dict[str, float]]:
    """By the names that MATLAB takes, with the units of the struct beside them."""
    found.save(folder / "a.mat")
    content = loadmat(folder / "a.mat", simplify_cells=True)
    units = content["units"]
    table = {}
    for row, place in enumerate(content["region"]):
        named = {n: content[n][row] for n in units if len(units[n])}
        table[place.strip()] = {f"{n.replace('_', ' ')} [{units[n]}]": v for n, v in named.items()}
    renamed = "pressure time integral", "pressure-time integral"
    return {p: {t.replace(*renamed): v for t, v in own.items()} for p, own in table.items()}


def from_json(found: TrialPressure, folder: Path) -> dict[str, dict[str, float]]:
    found.save(folder / "a.json")
    regions = json.loads((folder / "a.json").read_text())["regions"]
    keys = dict(zip(ENDS, ("value", "low", "high"), strict=True))
    return {
        place: {ended(title, e): regions[place][title][keys[e]] for title in TITLES for e in ENDS}
        for place in PLACES
    }


@pytest.mark.parametrize("end", ENDS, ids=["value", "low", "high"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("read", [from_api, from_csv, from_parquet, from_mat, from_json])
def test_regions_hold_the_known_outputs(
    read: Read, place: str, end: str, found: TrialPressure, tmp_path: Path
) -> None:
    own = read(found, tmp_path)[place]
    for title, answer in scene.ANSWERS[place].items():
        assert_is(own[ended(title, end)], title, answer[ENDS.index(end)])


def test_every_region_is_where_its_name_says(found: TrialPressure) -> None:
    """Left is medial on a right leg; `prox`, `mid` and `end` are the three heights."""
    sectors = {"ant": "anterior", "left": "medial", "post": "posterior", "right": "lateral"}
    heights = {"prox": "proximal", "mid": "middle", "end": "distal"}
    means = found.regions["mean pressure [kPa]"]
    for tile, (pressure, _, _) in scene.STRESS.items():
        sector, height = tile.split("_")
        own = means[f"{sectors[sector]} {heights[height]}"]
        assert own == pytest.approx(pressure, abs=1e-9), tile


@pytest.mark.parametrize(
    ("place", "nearest"),
    [("anterior", "ant_mid"), ("lateral", "right_prox"), ("lateral middle", "")],
)
def test_the_nearest_tile_is_named(found: TrialPressure, place: str, nearest: str) -> None:
    """`lateral middle` pulls, so that it has no centre of pressure."""
    assert found.regions.loc[place, "nearest tile"] == nearest


def test_own_regions_are_their_tiles(found: TrialPressure) -> None:
    """`tibia` is ant_prox and ant_mid: (16 + 40) / 2 kPa; `fibula` (30 - 1) / 2."""
    means = found.regions["mean pressure [kPa]"]
    assert means["tibia"] == pytest.approx(28.0)
    assert means["fibula"] == pytest.approx(14.5)


def test_bare_tiles_are_the_unmeasured_wall(found: TrialPressure) -> None:
    """Eight tiles, 16 + 20 + 2 - 1 + 15 + 4.5 + 6 kPa on 9 cm^2 and 8 kPa on 16: 690.5 / 79."""
    own = found.regions.loc["unmeasured wall"]
    assert own["mean pressure [kPa]"] == pytest.approx(690.5 / 79.0)
    assert own["peak pressure [kPa]"] == pytest.approx(30.0)  # 1.5 times post_prox


@pytest.mark.parametrize(
    ("rows", "bare"),
    [(slice(0, 0), False), (slice(0, 50), False), (slice(0, 96), True)],
    ids=["measured", "partly", "never"],
)
def test_a_tile_is_bare_if_never_measured(
    rows: slice, bare: bool, scene_folder: Path, by_hand: None
) -> None:
    """`distal` on post_end misses some of the 96 samples."""
    trial = st.open_trial(scene_folder)
    trial.samples().status[rows, trial.samples().clusters.index("distal")] = Status.MISSING
    regions = st.pressure(trial, "all").document()["regions"]
    assert ("post_end" in regions["unmeasured wall"]["tiles"]) is bare


# --- tiles

TILES = {
    # value, low, high; a turned cluster's tile among them
    "ant_mid": {
        "peak pressure [kPa]": (60.0, 57.55, 62.45),
        "mean pressure [kPa]": (40.0, 38.04, 41.96),
        "shear [kPa]": (5.0, 4.4811, 5.6427),  # |(-3 +- 0.98, 4)|
        "shear direction [deg]": (126.8699, 116.7938, 134.8564),
    },
    "left_prox": {
        "peak pressure [kPa]": (12.0, 9.55, 14.45),
        "mean pressure [kPa]": (8.0, 6.04, 9.96),
        "shear [kPa]": (2.0, 2.0, 2.2272),
        "shear direction [deg]": (90.0, 63.8951, 116.1049),
    },
    "right_mid": {
        "peak pressure [kPa]": (-0.5, -2.95, 1.95),  # it pulls least at half the load
        "mean pressure [kPa]": (-1.0, -2.96, 0.96),
    },
}


@pytest.mark.parametrize("tile", TILES)
def test_tiles_hold_the_known_outputs(tile: str, found: TrialPressure) -> None:
    own = found.tiles.loc[tile]
    for title, answers in TILES[tile].items():
        for end, answer in zip(ENDS, answers, strict=True):
            assert_is(own[ended(title, end)], title, answer)


def test_tiles_name_their_clusters(found: TrialPressure) -> None:
    named = {tile: cluster for tile, cluster in found.tiles["cluster"].items() if cluster}
    assert named == {tile: cluster for cluster, tile in scene.CLUSTERS.items()}


# --- over time

AT_PEAK = {
    # at 12.0 s, 1.5 times the means; +-1.96 times 1 kPa, and 0.5 kPa of shear
    "anterior.mean pressure": (35.5, 33.54, 37.46),
    "anterior.peak pressure": (60.0, 57.55, 62.45),
    "lateral.peak pressure": (45.0, 42.55, 47.45),
    "ant_mid.pressure": (60.0, 58.04, 61.96),
    "ant_mid.shear": (7.5, 6.52, 8.48),
    "left_mid.pressure": (3.0, 2.02, 3.98),
    "left_mid.shear": (0.0, 0.0, 0.98),  # a magnitude is never negative
}


@pytest.mark.parametrize("name", AT_PEAK)
def test_the_course_holds_the_known_outputs(name: str, found: TrialPressure) -> None:
    row = found.over_time().loc[12.0]
    for end, answer in zip(ENDS, AT_PEAK[name], strict=True):
        assert_is(row[f"{name}{end} [kPa]"], name, answer)


def test_the_course_begins_at_half_the_load(found: TrialPressure) -> None:
    table = found.over_time()
    assert table.index.name == "time [s]" and table.index[0] == 0.0
    assert table.index[-1] == pytest.approx(23.75)
    assert table["anterior.mean pressure [kPa]"].iloc[0] == pytest.approx(0.5 * 71.0 / 3.0)


def test_the_peak_is_at_its_time(found: TrialPressure) -> None:
    assert found.peak_time == pytest.approx(12.0)


# --- every interval, and every table's titles


def test_every_interval_is_in_order(found: TrialPressure) -> None:
    tables = {"regions": found.regions, "tiles": found.tiles, "course": found.over_time()}
    for name, table in tables.items():
        titles = [title for title in table if re.search(r" low \[", title)]
        assert len(titles) >= 6, name
        for title in titles:
            low, high = table[title], table[title.replace(" low [", " high [")]
            value = table[title.replace(" low [", " [")]
            known = value.notna()
            assert (low <= value + 1e-9)[known].all(), (name, title)
            assert (value <= high + 1e-9)[known].all(), (name, title)


# --- the limb in the socket


@pytest.mark.parametrize("title", scene.LIMB)
def test_the_limb_moves_as_it_is_suspended(title: str, found: TrialPressure) -> None:
    row = found.limb().loc[title]
    assert row["value"] == pytest.approx(scene.LIMB[title], rel=0.01)
    assert row["low"] <= row["value"] <= row["high"]
    assert not row["uncertain"]


def test_the_stiffness_is_diagonal_about_the_centre(found: TrialPressure) -> None:
    """Force by displacement in N/m, moment by rotation in N m/rad; no coupling was put in."""
    stiffness = found.suspension.stiffness.value
    degree = np.pi / 180.0
    own = np.array([40e3, 30e3, 20e3, 2.0 / degree, 3.0 / degree, 1.0 / degree])
    np.testing.assert_allclose(np.diag(stiffness), own, rtol=1e-3)
    coupling = (stiffness - np.diag(np.diag(stiffness))) / np.sqrt(np.outer(own, own))
    assert np.abs(coupling).max() < 0.1


# --- the verdict on an interval


@pytest.mark.parametrize(
    ("share", "uncertain"), [(0.05, False), (0.04, True)], ids=["wide", "narrow"]
)
def test_a_far_interval_is_uncertain(trial, share: float, uncertain: bool) -> None:
    """The peak of 60 kPa has an interval of +-2.45 kPa: 4.08 % of it."""
    rows = st.pressure(trial, "all", share=share).rows()
    assert rows["regions", "socket", "peak pressure [kPa]"]["uncertain"] is uncertain


@pytest.mark.parametrize("place", ["anterior proximal", "posterior middle", "medial proximal"])
def test_the_centre_of_one_tile_is_certain(place: str, found: TrialPressure) -> None:
    """It is the tile's own, whatever its pressure."""
    rows = found.rows()
    for axis in "xyz":
        assert not rows["regions", place, f"centre of pressure {axis} [mm]"]["uncertain"]


# --- the map

MAP = {
    # of the mean over the trial: force on the socket in {S} [N], pressure and shear [kPa]
    "ant_mid": ((36.0, 3.6, -2.7), 40.0, 5.0),  # outwards is +x; y of the tile is +y
    "right_prox": ((5.4, -27.0, -7.2), 30.0, 10.0),  # outwards is -y; y of the tile is +x
    "left_prox": ((-3.2, 12.8, 0.0), 8.0, 2.0),  # 16 cm^2; y of the tile is -x
    "post_end": ((1.8, 0.9, -12.6), 14.0, 2.2361),  # the end: x is anterior, pressed down
    "right_mid": ((0.0, 0.9, 0.0), -1.0, 0.0),  # it pulls: inwards
}


@pytest.mark.parametrize("tile", MAP)
def test_the_map_holds_the_known_forces(tile: str, mapped: TrialMap) -> None:
    force, pressure, shear = MAP[tile]
    table = mapped.to_dataframe()
    own = [table[f"{tile}.{axis} [N]"].mean() for axis in ("Fx", "Fy", "Fz")]
    assert own == pytest.approx(force, abs=1e-9)
    assert table[f"{tile}.pressure [Pa]"].mean() == pytest.approx(1e3 * pressure)
    assert table[f"{tile}.shear [Pa]"].mean() == pytest.approx(1e3 * shear, rel=1e-4)
    assert table[f"{tile}.pressure.sd [Pa]"].iloc[0] == 1000.0
    assert table[f"{tile}.shear.sd [Pa]"].iloc[0] == 500.0


def test_the_map_is_at_the_given_time(mapped: TrialMap) -> None:
    at_peak = mapped.at(12.1)
    assert at_peak.time == pytest.approx([12.0])
    assert at_peak.summary().loc["ant_mid", "pressure [kPa]"] == pytest.approx(60.0)


def test_the_summary_is_in_kilopascals(mapped: TrialMap) -> None:
    """The highest mean pressure first."""
    table = mapped.summary()
    assert [*table.index[:3]] == ["ant_mid", "right_prox", "post_mid"]
    assert table.index[-1] == "right_mid"
    first = table.iloc[0]
    assert first["cluster"] == "mid_anterior"
    assert first["pressure [kPa]"] == pytest.approx(40.0)
    assert first["pressure sd [kPa]"] == pytest.approx(1.0)
    assert first["shear [kPa]"] == pytest.approx(5.0)
    assert first["shear sd [kPa]"] == pytest.approx(0.5)


# --- the terminal

# Cells as printed, and in which of the six parts of the table; the limb's rows are the last part.
PRINTED = {
    "anterior": [
        "60.0 (57.6 to 62.5) 23.7 (21.7 to 25.6) 27 (27 to 27)",
        "565 (507 to 623) 34 (33 to 35) 1.9 (1.4 to 2.7)",
        "135 (105 to 150) 44 (43 to 44) 0 (0 to 0)",
        "151 (151 to 151)",
    ],
    "fibula": [  # 30 and -1 kPa at the right: only right_prox presses
        "45.0 (42.6 to 47.5) 14.5 (12.5 to 16.5) 9 (9 to 9)",
        "358 (329 to 387) 14 (11 to 17) 5.0 (4.3 to 5.8)",
        "143 (135 to 149) 0 (0 to 0) -50 (-50 to -50)",
        "210 (208 to 210)",
    ],
    "lateral middle": [  # it pulls: no centre of pressure
        "-0.5 (-3.0 to 1.9, uncertain) -1.0 (-3.0 to 1.0, uncertain) 0 (0 to 0)",
        "0 (0 to 0) 0 (-2 to 2, uncertain) 0.0 (0.0 to 1.0, uncertain)",
        "0 (-180 to 0, uncertain) - -",
        "-",
    ],
    "ant_mid, mid_anterior": [
        "60.0 (57.6 to 62.5) 40.0 (38.0 to 42.0) 955 (897 to 1013)",
        "5 (4 to 7) 5.0 (4.5 to 5.6) 127 (117 to 135)",
    ],
    "range of rotation about z [deg]": ["0.60 (0.59 to 0.60)"],
    "stiffness Fy [N/mm]": ["30.00 (29.99 to 30.00)"],
    "stiffness Mx [N m/deg]": ["2.00 (2.00 to 2.00)"],
}


@pytest.fixture(scope="module")
def printed(scene_folder: Path, by_hand: None) -> list[str]:
    """What the verb `pressure` prints, line by line, with runs of blanks as one."""
    text = io.StringIO()
    with redirect_stdout(text):
        assert run(["pressure", str(scene_folder), "--segment", "all"]) == 0
    return [" ".join(line.split()) for line in text.getvalue().splitlines()]


@pytest.mark.parametrize("place", PRINTED)
def test_the_terminal_shows_the_known_outputs(place: str, printed: list[str]) -> None:
    rows = [line for line in printed if line.startswith(place)]
    own = [row.removeprefix(place).strip() for row in rows]
    for cells in PRINTED[place]:
        assert cells in own


def test_the_terminal_heads_its_columns_in_order(printed: list[str]) -> None:
    heads = [line for line in printed if line.startswith("region ")]
    assert heads == [
        "region peak pressure [kPa] mean pressure [kPa] contact area [cm^2]",
        "region pressure-time integral [kPa s] share of load [%] shear [kPa]",
        "region shear direction [deg] centre of pressure x [mm] centre of pressure y [mm]",
        "region centre of pressure z [mm]",
    ]
    assert "in contact: above 5 kPa; the integrals cover 23.8 s" in printed
