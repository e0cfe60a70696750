"""The comparison of the scene with its second trial, an hour later, against hand values.

There all forces and the load are 1.25 times as large, the errors the same. Both trials are of one
limb in one socket, whose errors correlate by 0.7: a difference of two values +-1.96 kPa has an
interval of +-1.96 sqrt(2 - 1.4) = +-1.518 kPa. Differences are those of the second from the first.
"""

import io
import json
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib import colormaps
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support import scene
from support.pages import Page
from support.results_by_hand import tile

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.geometry.socket import write_socket
from socket_testbed.results.comparison import Comparison
from socket_testbed.trials.trial import Trial

VALUE = ("value", "low", "high")
DIFFERENCE = ("difference", "difference low", "difference high")


@pytest.fixture(scope="module")
def second_folder(by_hand: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write(tmp_path_factory.mktemp("later") / "second", second=True)


@pytest.fixture(scope="module")
def found(trial: Trial, second_folder: Path) -> Comparison:
    return st.compare(trial, second_folder, segment="all")


@pytest.fixture(scope="module")
def reverse(trial: Trial, second_folder: Path) -> Comparison:
    return st.compare(second_folder, trial, segment="all")


@pytest.fixture(scope="module")
def page(found: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Page:
    path = tmp_path_factory.mktemp("page") / "both.html"
    st.write_comparison(found, path, "by hand")
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def data(page: Page) -> dict[str, Any]:
    return json.loads(page.script("page-data"))


def test_tiles_of_one_name_elsewhere_are_not_compared(
    trial: Trial, second_folder: Path, tmp_path: Path
) -> None:
    """A tile is called like the cluster on it, and the cluster moved from tile 10 to tile 0."""
    geometry = scene.geometry()
    compared = []
    for number, tile_under in enumerate((10, 0)):
        names = [*geometry.names]
        names[tile_under] = "distal"
        clusters = geometry.clusters | {"distal": tile_under}
        path = tmp_path / f"{number}.yaml"
        write_socket(replace(geometry, names=tuple(names), clusters=clusters), path)
        folder = (trial.path, second_folder)[number]
        compared.append(st.open_trial(folder, geometry=path))
    table = st.compare(*compared, segment="all").to_dataframe()
    tiles = {*table.loc[table["part"] == "tiles", "name"]}
    assert "distal" not in tiles and "post_end" not in tiles
    assert len(tiles) == 10


def row_of(found: Comparison, part: str, name: str, quantity: str, item: str) -> pd.Series:
    """A row of the table in long form."""
    table = found.to_dataframe().set_index(["part", "name", "quantity", "item"]).sort_index()
    return table.loc[(part, name, quantity, item)]


# --- the table

ROWS = {
    # unit; second trial: value, low, high; difference, low, high
    ("regions", "anterior", "peak pressure"): (  # +-1.25 * 1.96, times sqrt(0.6)
        *("kPa", (75.0, 72.55, 77.45)),
        (15.0, 13.1022, 16.8978),
    ),
    ("regions", "anterior", "mean pressure"): (
        *("kPa", (29.5833, 27.6233, 31.5433)),
        (5.9167, 4.3985, 7.4349),
    ),
    ("regions", "lateral", "mean pressure"): (  # +-1.69867
        *("kPa", (14.5833, 12.8847, 16.282)),
        (2.9167, 1.6009, 4.2325),
    ),
    ("regions", "lateral middle", "mean pressure"): (
        *("kPa", (-1.25, -3.21, 0.71)),
        (-0.25, -1.7682, 1.2682),
    ),
    ("regions", "anterior", "contact area"): ("cm^2", (27.0, 27.0, 27.0), (0.0, 0.0, 0.0)),
    ("regions", "anterior", "pressure-time integral"): (  # +-1.25 * 1.96 * 23.75 kPa s
        *("kPa s", (706.2981, 648.1106, 764.4856)),
        (141.2596, 96.1878, 186.3315),
    ),
    # the same share of a larger load, with errors that matter less: 34.2 N of 101.7 N; draws:
    # 34.2 N of 100.3084 and of 103.0916 N
    ("regions", "anterior", "share of load"): (
        *("%", (33.6283, 32.9079, 34.381)),
        (0.0, -0.6782, 0.6519),
    ),
    # |(-3.75 +- 0.98, 5)| and |(-3 +- 0.98, 4)| kPa: the lower end of a difference comes from the
    # lower end of the second and the upper end of the first
    ("tiles", "ant_mid", "shear"): ("kPa", (6.25, 5.716, 6.8828), (1.25, 0.7834, 1.7082)),
    ("tiles", "ant_mid", "mean pressure"): ("kPa", (50.0, 48.04, 51.96), (10.0, 8.4818, 11.5182)),
}


@pytest.mark.parametrize(("part", "name", "quantity"), ROWS)
def test_differences_are_the_known_ones(
    part: str, name: str, quantity: str, found: Comparison
) -> None:
    unit, values, differences = ROWS[part, name, quantity]
    row = row_of(found, part, name, quantity, "second")
    assert row["unit"] == unit
    assert [row[end] for end in VALUE] == pytest.approx(values, rel=2e-5, abs=1e-4)
    assert [row[end] for end in DIFFERENCE] == pytest.approx(differences, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("place", ["anterior", "lateral", "socket"])
def test_the_first_trial_is_the_scene(place: str, found: Comparison) -> None:
    for title, answer in scene.ANSWERS[place].items():
        quantity, unit = title[:-1].split(" [")
        row = row_of(found, "regions", place, quantity, "scene")
        assert row["unit"] == unit
        assert [row[end] for end in VALUE] == pytest.approx(answer, rel=2e-5, abs=1e-4)
        assert np.isnan(row["difference"])


WRENCH = {
    # unit, first, second: 60 N / sqrt(8) is the deviation of Fz
    ("Mx", "mean"): ("N m", 0.55, 0.6875),
    ("Mz", "mean"): ("N m", 0.5, 0.625),
    ("Fx", "mean"): ("N", 14.0, 17.5),
    ("Fz", "mean"): ("N", -60.0, -75.0),
    ("Fz", "standard deviation"): ("N", 21.2132, 26.5165),
}


@pytest.mark.parametrize(("channel", "kind"), WRENCH)
def test_the_wrench_is_in_its_units(channel: str, kind: str, found: Comparison) -> None:
    unit, first, second = WRENCH[channel, kind]
    rows = [row_of(found, "wrench", channel, kind, item) for item in ("scene", "second")]
    assert [row["unit"] for row in rows] == [unit, unit]
    assert [row["value"] for row in rows] == pytest.approx([first, second], rel=1e-5)
    assert rows[1]["difference"] == pytest.approx(second - first, rel=1e-4)


LIMB = {
    "pistoning": ("mm", 3.75, 0.75),
    "range of rotation about x": ("deg", 0.625, 0.125),
    "range of rotation about z": ("deg", 0.75, 0.15),
    "stiffness Fz": ("N/mm", 20.0, 0.0),
    "stiffness Mx": ("N m/deg", 2.0, 0.0),
}


@pytest.mark.parametrize("quantity", LIMB)
def test_the_limb_moves_farther(quantity: str, found: Comparison) -> None:
    """1.25 times as far, in a suspension of the same stiffness."""
    unit, value, difference = LIMB[quantity]
    row = row_of(found, "limb", "", quantity, "second")
    assert row["unit"] == unit
    assert row["value"] == pytest.approx(value, rel=0.01)
    assert row["difference"] == pytest.approx(difference, rel=0.02, abs=1e-3)


def test_the_other_order_turns_the_signs(reverse: Comparison) -> None:
    assert reverse.items == ("second", "scene")
    row = row_of(reverse, "regions", "anterior", "peak pressure", "scene")
    ends = [row[end] for end in DIFFERENCE]
    assert ends == pytest.approx([-15.0, -16.8978, -13.1022], rel=1e-4)
    row = row_of(reverse, "tiles", "ant_mid", "shear", "scene")
    assert [row[end] for end in DIFFERENCE] == pytest.approx([-1.25, -1.7082, -0.7834], rel=1e-3)


def test_errors_of_two_limbs_do_not_cancel(trial: Trial, tmp_path: Path) -> None:
    """+-1.96 sqrt(2) kPa."""
    other = scene.write(tmp_path / "other" / "second", subject="S02", second=True)
    row = row_of(
        st.compare(trial, other, segment="all"), "tiles", "ant_mid", "mean pressure", "second"
    )
    ends = [row[end] for end in DIFFERENCE]
    assert ends == pytest.approx([10.0, 7.2281, 12.7719], rel=1e-4)


def test_a_document_holds_the_rows(found: Comparison) -> None:
    document = json.loads(found.to_json())
    assert document["items"] == ["scene", "second"] and document["kind"] == "trials"
    (row,) = [
        row
        for row in document["rows"]
        if (row["name"], row["quantity"], row["item"]) == ("anterior", "peak pressure", "second")
    ]
    assert row["unit"] == "kPa"
    assert row["difference high"] == pytest.approx(16.8978, rel=1e-4)
    assert row["difference low"] == pytest.approx(13.1022, rel=1e-4)


# --- in words

CELLS = {
    ("regions", "peak pressure", "socket"): (
        *("60.0 (57.6 to 62.5)", "75.0 (72.5 to 77.5)", "+15.0 (13.1 to 16.9) *"),
    ),
    ("regions", "share of load", "anterior"): (
        *("34 (33 to 35)", "34 (33 to 34)", "+0.0 (-0.7 to 0.7)"),
    ),
    ("regions", "mean pressure", "medial distal"): (
        *("4.5 (2.5 to 6.5)", "5.6 (3.7 to 7.6)", "+1.1 (-0.4 to 2.6)"),
    ),
    # all of its tiles are at 210 mm: rounding is no difference
    ("regions", "centre of pressure z", "proximal"): (
        *("210 (210 to 210)", "210 (210 to 210)", "+0.0 (0.0 to 0.0)"),
    ),
    ("tiles", "mean pressure", "right_prox"): (
        *("30.0 (28.0 to 32.0)", "37.5 (35.5 to 39.5)", "+7.5 (6.0 to 9.0) *"),
    ),
}


@pytest.mark.parametrize(("part", "quantity", "name"), CELLS)
def test_cells_hold_values_and_differences(
    part: str, quantity: str, name: str, found: Comparison
) -> None:
    table = found.cells(part, quantity)
    assert [*table] == ["scene", "second", "second - scene"]
    assert tuple(table.loc[name]) == CELLS[part, quantity, name]


def test_a_lower_value_has_a_minus(reverse: Comparison) -> None:
    row = reverse.cells("regions", "peak pressure").loc["socket"]
    assert row["scene - second"] == "-15.0 (-16.9 to -13.1) *"


def test_the_clearest_differences_are_said(found: Comparison, reverse: Comparison) -> None:
    words = "anterior: peak pressure 15.0 kPa higher in second than in scene (13.1 to 16.9)"
    assert words in found.differing()
    words = "anterior: peak pressure 15.0 kPa lower in scene than in second (13.1 to 16.9)"
    assert words in reverse.differing()


def test_only_clear_differences_are_counted(found: Comparison) -> None:
    """Peaks and means rise by a quarter, in three of 23 regions by less than their reach.

    `medial distal` by 1.125 of 1.518 and 1.69 of 1.898 kPa, `medial middle` by 0.5 of 0.759 and
    0.75 of 0.949, and `lateral middle` falls by 0.25 and 0.125 kPa.
    """
    table = found.to_dataframe()
    chosen = table["quantity"].isin(["peak pressure", "mean pressure"])
    rows = table[chosen & (table["part"] == "regions")]
    only = Comparison(found.conditions, "", (), rows, None).differing()
    assert only[0].startswith("40 of 46 intervals")
    assert only[0].endswith("by chance alone up to about 2 would")


def test_the_load_is_noted(found: Comparison) -> None:
    """|(14, 3, -60)| N and 1.25 times as much."""
    assert found.notes == (
        "the mean force is 77 N in second and 62 N in scene: differences in pressure include that"
        " of the load",
    )


# --- the page


def test_the_page_s_cards_hold_peaks_then_differences(data: dict[str, Any]) -> None:
    assert data["cards"] == [
        {
            "title": "Peak, scene", "value": "60.0 kPa", "interval": "57.6 to 62.5",
            "words": "all 0.00 s to 23.75 s",
        },
        {
            "title": "Peak, second", "value": "75.0 kPa", "interval": "72.5 to 77.5",
            "words": "all 0.00 s to 23.75 s",
        },
        {
            "title": "Peak pressure, second - scene", "value": "+15.0 kPa",
            "interval": "13.1 to 16.9", "words": "a clear difference",
        },
        {
            "title": "Mean pressure, second - scene", "value": "+3.6 kPa",
            "interval": "2.2 to 5.0", "words": "a clear difference",
        },
    ]  # fmt: skip


def test_the_page_s_maps_share_a_scale(data: dict[str, Any]) -> None:
    first, second, difference = data["maps"]
    assert first["moment"]["pressure"][tile("ant_mid")] == pytest.approx(40.0)
    assert second["moment"]["pressure"][tile("ant_mid")] == pytest.approx(50.0)
    assert second["moment"]["reach"][tile("ant_mid")] == pytest.approx(1.96)
    assert first["moment"]["highest"] == "highest"  # not the peak of the trial
    assert data["scale"] == pytest.approx(50.0)
    assert [m["diverging"] for m in data["maps"]] == [False, False, True]
    assert [m["range"] for m in (first, second)] == [None, None]
    assert difference["range"] == pytest.approx(10.0)


def test_the_page_s_difference_is_signed_and_grey(data: dict[str, Any]) -> None:
    """A quarter of the first trial's; grey where it is less than its +-1.518 kPa."""
    moment = data["maps"][2]["moment"]
    found = [4.0, 2.0, 5.0, 7.5, 10.0, 0.5, 6.25, -0.25, 3.75, 1.125, 3.5, 1.5]
    assert moment["pressure"] == pytest.approx(found)
    weak = {tile(name) for name in ("left_mid", "right_mid", "left_end")}
    assert moment["grey"] == [1.0 if number in weak else 0.0 for number in range(12)]
    assert moment["reach"][tile("ant_mid")] == pytest.approx(1.52)


def test_the_page_names_its_maps(page: Page) -> None:
    captions = [text for text in page.said["strong"] if text]
    assert captions == ["scene", "second", "second - scene"]
    boxes = [a["id"] for _, a in page.tags if (a.get("class") or "") == "map small"]
    assert boxes == ["map-0", "map-1", "map-2"]


def test_the_page_s_tables_hold_the_known_values(page: Page) -> None:
    assert page.tables["socket-table"][0] == ["output", "scene", "second", "second - scene"]
    rows = page.rows("socket-table")
    assert rows["peak pressure [kPa]"][2] == "+15.0 (13.1 to 16.9) *"
    assert rows["contact area [cm^2]"] == [
        *("85 (75 to 94)", "91 (82 to 97)", "+6.1 (-1.0 to 13.1)")
    ]
    captions = dict(zip(page.tables, page.said["caption"], strict=True))
    name = next(name for name, caption in captions.items() if caption == "mean pressure [kPa]")
    assert page.rows(name)["anterior"][1:] == ["29.6 (27.6 to 31.5)", "+5.9 (4.4 to 7.4) *"]
    assert page.rows("wrench-table")["Fz: mean [N]"] == ["-60.0", "-75.0", "-15.0"]
    assert page.rows("wrench-table")["Mx: mean [N m]"] == ["0.55", "0.69", "+0.14"]
    assert page.rows("metadata-table")["side"] == ["right", "right"]
    assert page.rows("trials-table")["samples"] == ["96", "96"]


def test_the_page_explains_its_intervals(page: Page) -> None:
    assert "those of one subject in one socket as correlated (0.7)" in page.text
    assert "value (95 % interval); *: the interval of the difference excludes 0." in page.text


# --- the figure


def test_the_figure_has_one_scale(found: Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fixed one, 0 to 50 kPa; 40 kPa are at the square root of 40 / 50."""
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
    figure = found.figure()
    maps = {axis.get_title("left"): axis for axis in figure.axes if axis.get_title("left")}
    assert [*maps] == ["scene", "second"]
    (bar,) = [axis for axis in figure.axes if axis.get_ylabel() == "mean pressure [kPa]"]
    assert bar.get_ylim() == pytest.approx((0.0, 50.0))
    for name, share in (("scene", 0.894), ("second", 1.0)):
        (image,) = maps[name].images
        pixels = np.asarray(image.get_array())
        left, right, low, high = image.get_extent()
        row = int((60.0 - low) / (high - low) * pixels.shape[0])
        column = int((0.0 - left) / (right - left) * pixels.shape[1])
        expected = colormaps["viridis"](share)[:3]
        assert pixels[row, column, :3] == pytest.approx(expected, abs=0.06)


# --- the terminal


def test_the_terminal_shows_the_differences(
    scene_folder: Path, second_folder: Path, by_hand: None
) -> None:
    text = io.StringIO()
    with redirect_stdout(text):
        assert run(["compare", str(scene_folder), str(second_folder), "--segment", "all"]) == 0
    lines = [" ".join(line.split()) for line in text.getvalue().splitlines()]
    assert lines[0].startswith("trials scene, second: segment all")
    assert any("+15.0 (13.1 to 16.9) *" in line and "75.0" in line for line in lines)
