"""The data of the pages of the scene at 12.0 s, against hand values.

This is what `view TRIAL` sends to a browser: the socket, the course, a moment, bars and cards.
Pressures are 1.5 times the means. The scripts that draw it are tested beside it.
"""

import base64
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.wall import patches
from socket_testbed.geometry.regions import all_regions
from socket_testbed.pages import document
from socket_testbed.pages.player import Player

TILE = {name: number for number, name in enumerate(scene.TILES)}


@pytest.fixture(scope="module")
def player(trial) -> Player:
    return Player(trial)


@pytest.fixture(scope="module")
def start(player: Player) -> dict[str, Any]:
    return player.start()


@pytest.fixture(scope="module")
def now(player: Player) -> dict[str, Any]:
    return player.now(12.1)


# --- the socket

PLACES = {
    # on the wall: degrees from anterior towards left, mm above the distal end
    "ant_prox": (True, (0.0, 120.0)),
    "left_mid": (True, (90.0, 60.0)),
    "right_prox": (True, (-90.0, 120.0)),
    # on the end, seen from inside with anterior up: mm towards right, mm towards anterior
    "ant_end": (False, (0.0, 20.0)),
    "left_end": (False, (-20.0, 0.0)),
    "right_end": (False, (20.0, 0.0)),
}


@pytest.mark.parametrize("tile", PLACES)
def test_a_tile_is_drawn_at_its_place(tile: str, start: dict[str, Any]) -> None:
    socket = start["socket"]
    on_wall, place = PLACES[tile]
    assert socket["on_wall"][TILE[tile]] is on_wall
    assert socket["places"][TILE[tile]] == pytest.approx(place, abs=0.05)


def test_a_square_s_corners_are_at_its_place(start: dict[str, Any]) -> None:
    """30 mm at the front: +-15 mm in height, and +-atan(15 / 50) = 16.7 degrees."""
    corners = np.array(start["socket"]["corners"][TILE["ant_prox"]])
    assert corners.shape == (5, 2) and corners[0].tolist() == corners[4].tolist()
    np.testing.assert_allclose(np.sort(np.unique(corners[:, 0])), [-16.7, 16.7], atol=0.05)
    np.testing.assert_allclose(np.sort(np.unique(corners[:, 1])), [105.0, 135.0], atol=0.05)
    squares = np.array(start["socket"]["squares"][TILE["left_prox"]])  # 40 mm, at y = 50 mm
    np.testing.assert_allclose(squares.min(axis=0), [-20.0, 50.0, 190.0], atol=0.05)
    np.testing.assert_allclose(squares.max(axis=0), [20.0, 50.0, 230.0], atol=0.05)


def test_the_socket_s_parts_have_names(start: dict[str, Any]) -> None:
    """On a right leg the left side is medial; heights are from the distal end up."""
    socket = start["socket"]
    assert socket["sides"] == ["posterior", "lateral", "anterior", "medial", "posterior"]
    assert [*socket["heights"]] == ["distal", "middle", "proximal"]
    assert socket["thirds"] == pytest.approx([0.0, 40.0, 80.0, 120.0])
    assert tuple(socket["sectors"]) == (-135, -45, 45, 135)
    assert socket["proximal"] == [0.0, 0.0, 1.0]
    assert socket["regions"] == {"tibia": [0, 4], "fibula": [3, 7]}


@pytest.mark.parametrize(
    ("side", "names"),
    [
        ("left", ["posterior", "medial", "anterior", "lateral", "posterior"]),
        (None, ["posterior", "right", "anterior", "left", "posterior"]),
    ],
    ids=["left", "unstated"],
)
def test_the_sides_follow_the_leg(side: Any, names: list[str]) -> None:
    """From -180 to 180 degrees; +90 degrees is the left side, lateral on a left leg."""
    assert document.socket_document(scene.geometry(), side)["sides"] == names


def test_clusters_are_on_their_tiles(start: dict[str, Any]) -> None:
    found = {c: scene.TILES[tile] for c, tile in start["socket"]["clusters"].items()}
    assert found == scene.CLUSTERS


# --- the surface between the tiles


@pytest.mark.parametrize("name", ["wall", "end"])
def test_the_surface_has_a_tile_s_value_there(name: str) -> None:
    """At a tile's centre the interpolated value is the tile's, and a uniform field stays so."""
    geometry = scene.geometry()
    patch = next(patch for patch in patches(geometry, step=0.1) if patch.name == name)
    pressure = np.array([own[0] for own in scene.STRESS.values()])
    field = patch.weights @ pressure
    tiles = {"wall": ("ant_mid", "left_prox", "right_mid"), "end": ("ant_end", "right_end")}[name]
    for tile in tiles:
        x, y = PLACES_OF[tile]
        at = np.abs(patch.y - y).argmin(), np.abs(patch.x - x).argmin()
        assert field[at] == pytest.approx(pressure[TILE[tile]], abs=1.5), tile
        point = 1e3 * patch.points[at]
        np.testing.assert_allclose(point, 1e3 * geometry.anchors[TILE[tile]], atol=4.0)
    np.testing.assert_allclose(patch.weights.sum(axis=-1), 1.0)


@pytest.mark.parametrize(
    ("name", "tile"), [("wall", "ant_mid"), ("wall", "left_prox"), ("end", "ant_end")]
)
def test_the_page_s_weights_give_a_tile_s_value(name: str, tile: str) -> None:
    """As `socket.js` reads them: 16-bit integers of 1 / 8192, a row of tiles for each point."""
    found = document.socket_document(scene.geometry())["patches"]
    patch = next(each for each in found if each["name"] == name)
    stored = np.frombuffer(base64.b64decode(patch["weights"]), "<i2")
    weights = stored.reshape(len(patch["y"]), len(patch["x"]), 12) / 8192.0
    assert patch["unit"] == 1.0 / 8192.0
    x, y = PLACES_OF[tile]
    at = np.abs(np.array(patch["y"]) - y).argmin(), np.abs(np.array(patch["x"]) - x).argmin()
    pressure = np.array([own[0] for own in scene.STRESS.values()])
    assert weights[at].sum() == pytest.approx(1.0, abs=1e-3)
    assert weights[at] @ pressure == pytest.approx(scene.STRESS[tile][0], abs=2.5)


PLACES_OF = {
    "ant_mid": (0.0, 60.0),
    "left_prox": (90.0, 120.0),
    "right_mid": (-90.0, 60.0),
    "ant_end": (0.0, 20.0),
    "right_end": (20.0, 0.0),
}


# --- a moment


def test_a_moment_holds_the_known_stresses(now: dict[str, Any]) -> None:
    moment = now["moment"]
    assert moment["time"] == 12.0
    pressure = [24.0, 12.0, 30.0, 45.0, 60.0, 3.0, 37.5, -1.5, 22.5, 6.75, 21.0, 9.0]
    assert moment["pressure"] == pytest.approx(pressure)
    assert moment["shear"][TILE["ant_mid"]] == pytest.approx(7.5)
    assert moment["shear"][TILE["right_prox"]] == pytest.approx(15.0)
    reach = [1.96] * 12
    reach[TILE["left_mid"]], reach[TILE["right_end"]] = 0.98, 1.18
    assert moment["reach"] == pytest.approx(reach)


def test_a_moment_holds_the_measured_pressures(now: dict[str, Any]) -> None:
    """In the order of the socket's clusters."""
    assert now["moment"]["measured"] == [45.0, 60.0, 37.5, 21.0]


@pytest.mark.parametrize(
    ("reach", "grey"),
    [(10.0, 0.0), (17.5, 0.5), (25.0, 1.0), (40.0, 1.0)],
    ids=["once", "halfway", "greyest", "beyond"],
)
def test_a_far_interval_is_grey(reach: float, grey: float) -> None:
    """10 kPa: full colour up to an interval of once the value, greyest from 2.5 times on."""
    one = np.array([1e4])
    found = document.moment(0.0, one, np.array([1e3 * reach]), one, one)
    assert found["grey"] == pytest.approx([grey])


def test_an_unknown_pressure_is_null() -> None:
    one = np.array([1e4])
    found = document.moment(0.0, one, one, one, np.array([np.nan]))
    assert found["measured"] == [None]


# --- the course


def test_the_course_holds_load_and_peak(start: dict[str, Any]) -> None:
    course = start["course"]
    assert len(course["time"]) == 96 and course["time"][48] == 12.0
    assert course["force"][0] == 30.0 and course["force"][48] == 90.0  # along the socket, pressed
    ends = [course[name][48] for name in ("low", "peak", "high")]
    assert ends == [57.55, 60.0, 62.45]
    assert [course[name][0] for name in ("low", "peak", "high")] == [17.55, 20.0, 22.45]


def test_the_course_marks_its_events(start: dict[str, Any]) -> None:
    """The load of 30 to 90 N passes half its range going up near 6 s, down near 18 s."""
    events = start["course"]["events"]
    assert [event["label"] for event in events] == ["placed", "removed"]
    times = [event["time"] for event in events]
    assert times == pytest.approx([6.0, 18.0], abs=1.0)


def test_a_course_has_its_digits() -> None:
    """Milliseconds, tenths of a newton, and pascals as kPa; None where unknown."""
    peak = document.Quantity(*(np.array([value, np.nan]) for value in (1234.56, 1034.4, 1434.6, 1)))
    found = document.course(np.array([0.12345, 1.0]), np.array([90.449, np.nan]), peak, [])
    assert found == {
        **{"time": [0.123, 1.0], "force": [90.4, None], "events": []},
        **{"peak": [1.23, None], "low": [1.03, None], "high": [1.43, None]},
    }


def test_many_events_of_a_label_are_not_marked() -> None:
    nothing = np.zeros(1)
    peak = document.Quantity(nothing, nothing, nothing, nothing)
    listed = [(float(k), "step") for k in range(21)] + [(3.0, "placed")]
    found = document.course(nothing, nothing, peak, listed)
    assert found["events"] == [{"time": 3.0, "label": "placed"}]
    found = document.course(nothing, nothing, peak, listed[:20])
    assert len(found["events"]) == 20


def test_a_trial_opens_at_its_peak(start: dict[str, Any]) -> None:
    assert start["start"] == 12.0 and start["end"] == 23.75
    assert start["title"] == "scene"
    assert start["facts"] == {
        "subject": "S01", "side": "right", "socket": "scene", "mass": "61.2 kg",
    }  # fmt: skip


# --- bars, cards and the table of wrenches

BARS = {
    "mean pressure [kPa]": {"anterior": (35.5, 33.54, 37.46), "lateral": (17.5, 15.8013, 19.1987)},
    "peak pressure [kPa]": {"anterior": (60.0, 57.55, 62.45), "fibula": (45.0, 42.55, 47.45)},
    "share of load [%]": {"anterior": (33.6283, 33.0258, 34.2533), "socket": (100.0,) * 3},
    "shear [kPa]": {"anterior": (2.8284, 2.2451, 3.5889)},
    # Of `lateral` 45 and 9 +-1.47 kPa are above 5 kPa, -1.5 kPa are not.
    "contact area [cm^2]": {"anterior": (27.0,) * 3, "lateral": (18.0,) * 3},
    "pressure-time integral, whole trial [kPa s]": {
        place: scene.ANSWERS[place]["pressure-time integral [kPa s]"]
        for place in ("anterior", "lateral", "socket")
    },
}


@pytest.mark.parametrize("title", BARS)
def test_bars_hold_the_known_outputs(title: str, now: dict[str, Any]) -> None:
    bars = now["bars"]
    for place, answer in BARS[title].items():
        found = bars["values"][title][bars["regions"].index(place)]
        assert found == pytest.approx(answer, rel=1e-4), place


def test_bars_leave_out_parts_of_sectors(now: dict[str, Any]) -> None:
    assert now["bars"]["regions"] == [
        *("anterior", "posterior", "medial", "lateral", "proximal", "middle", "distal"),
        *("tibia", "fibula", "unmeasured wall", "socket"),
    ]
    assert now["bars"]["decimals"] == {
        "mean pressure [kPa]": 1, "peak pressure [kPa]": 1, "contact area [cm^2]": 0,
        "share of load [%]": 0, "shear [kPa]": 1,
        "pressure-time integral, whole trial [kPa s]": 0,
    }  # fmt: skip


def test_cards_name_peak_and_place(now: dict[str, Any]) -> None:
    peak, elsewhere, data = now["cards"]
    assert peak["value"] == "60.0 kPa" and peak["words"] == (
        "anterior middle, measured by mid_anterior"
    )
    assert peak["title"] == "Peak at this moment"
    assert elsewhere["value"] == "30.0 kPa"
    assert elsewhere["words"].endswith("where no sensor is: posterior proximal")
    assert (data["title"], data["value"]) == ("Data", "good")


def test_a_card_s_interval_is_in_order(now: dict[str, Any]) -> None:
    for card in now["cards"][:2]:
        low, high = (float(end) for end in card["interval"].split(" to "))
        assert low < float(card["value"].removesuffix(" kPa")) < high
        assert high - low == pytest.approx(4.9, abs=0.1)


def cards_of(pressure: FloatArray) -> list[document.Document]:
    """Cards of the tiles' pressures [Pa]; every peak is 60 kPa, and `mid_anterior` has no value."""
    places = all_regions(scene.geometry(), "right")
    value = np.full(len(places), 6e4)
    own = document.Quantity(value, value - 1e3, value + 2e3, value)
    outputs = document.RegionOutputs(*[own] * 8)
    measured = np.array([3e4, np.nan, 2e4, 1e4])
    return document.cards(scene.geometry(), places, outputs, pressure, measured)


def test_a_peak_without_its_sensor_is_estimated() -> None:
    """`mid_anterior` has no reading."""
    peak, _ = cards_of(1e3 * np.array([own[0] for own in scene.STRESS.values()]))
    assert peak == {
        "title": "Peak", "value": "60.0 kPa", "interval": "59.0 to 62.0",
        "words": "anterior middle, estimated",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("tile", "place"),
    [
        ("ant_prox", "anterior proximal"),
        ("left_mid", "medial middle"),
        ("right_mid", "lateral middle"),
        ("left_end", "the distal end"),
    ],
)
def test_the_second_card_names_its_tile_s_place(tile: str, place: str) -> None:
    """Beside tiles with clusters, whose pressures are higher."""
    geometry = scene.geometry()
    pressure = np.where(geometry.covered, 6e4, 1e4)
    pressure[geometry.names.index(tile)] = 3e4
    _, elsewhere = cards_of(pressure)
    assert elsewhere["words"] == f"highest where no sensor is: {place}"


def test_the_wrench_table_has_units(now: dict[str, Any]) -> None:
    assert now["wrench"] == [
        ["", "measured", "predicted"],
        ["Mx [N m]", "0.55", "none"],
        ["My [N m]", "0.10", "none"],
        ["Mz [N m]", "0.50", "none"],
        ["Fx [N]", "14.00", "none"],
        ["Fy [N]", "3.00", "none"],
        ["Fz [N]", "-90.00", "none"],
    ]


def test_the_wrench_table_tells_measured_from_predicted() -> None:
    rows = document.wrench_rows(np.arange(6.0), 10.0 + np.arange(6.0))
    assert rows[1] == ["Mx [N m]", "0.00", "10.00"] and rows[6] == ["Fz [N]", "5.00", "15.00"]
