"""A socket of five tiles, and data on it, whose pictures can be worked out by hand.

The wall is a cylinder of 50 mm about z, with anterior along x and left along y:

    tile   place on the wall or the end          cluster
    0      wall, 0 deg (anterior), 90 mm         front
    1      wall, 90 deg (left), 60 mm
    2      wall, 180 deg (posterior), 30 mm      <back>
    3      wall, -90 deg (right), 60 mm
    4      end, 10 mm towards right, 5 mm towards posterior     base
"""

import base64
import struct
from typing import Any

_UNIT = 2.0**-13  # of the stored weights, which are whole numbers of 16 bits

# The wall's grid. Each point has the mean of the four tiles on the wall, except those listed.
ANGLES, HEIGHTS = [-180.0, -90.0, 0.0, 90.0, 180.0], [30.0, 60.0, 90.0]
_MEAN = [0.25, 0.25, 0.25, 0.25, 0.0]
_WEIGHTS = {
    (0.0, 90.0): [1.0, 0.0, 0.0, 0.0, 0.0],
    (90.0, 60.0): [0.0, 1.0, 0.0, 0.0, 0.0],
    (-180.0, 30.0): [0.0, 0.0, 1.0, 0.0, 0.0],
    (180.0, 30.0): [0.0, 0.0, 1.0, 0.0, 0.0],
    (-90.0, 60.0): [0.0, 0.0, 0.0, 1.0, 0.0],
    # Beyond the tiles weights are negative, and others larger than one.
    (0.0, 30.0): [1.25, -0.25, 0.0, 0.0, 0.0],
    (-180.0, 60.0): [-0.25, 1.25, 0.0, 0.0, 0.0],
    (180.0, 60.0): [-0.25, 1.25, 0.0, 0.0, 0.0],
}
_NO_WALL = (180.0, 90.0)
_AROUND = {-180.0: (-50.0, 0.0), -90.0: (0.0, -50.0), 0.0: (50.0, 0.0), 90.0: (0.0, 50.0)}
_AROUND[180.0] = _AROUND[-180.0]

# The end's grid, with tile 4 everywhere except at one corner, where the wall is.
ACROSS = [-10.0, 0.0, 10.0]  # towards right, and towards anterior
_NO_END = (10.0, 10.0)


def _packed(weights: list[list[float]]) -> str:
    numbers = [round(weight / _UNIT) for row in weights for weight in row]
    return base64.b64encode(struct.pack(f"<{len(numbers)}h", *numbers)).decode()


def _wall() -> dict[str, Any]:
    places = [[(x, y) for x in ANGLES] for y in HEIGHTS]
    nothing = [None, None, None]
    points = [
        [nothing if place == _NO_WALL else [*_AROUND[place[0]], place[1]] for place in row]
        for row in places
    ]
    weights = [_WEIGHTS.get(place, _MEAN) for row in places for place in row]
    return {
        "name": "wall",
        "x": ANGLES,
        "y": HEIGHTS,
        "points": points,
        "unit": _UNIT,
        "weights": _packed(weights),
    }


def _end() -> dict[str, Any]:
    places = [[(right, anterior) for right in ACROSS] for anterior in ACROSS]
    # Right is -y of the socket, anterior is x.
    points = [
        [[None] * 3 if place == _NO_END else [place[1], -place[0], 20.0] for place in row]
        for row in places
    ]
    return {
        "name": "end",
        "x": ACROSS,
        "y": ACROSS,
        "points": points,
        "unit": _UNIT,
        "weights": _packed([[0.0, 0.0, 0.0, 0.0, 1.0]] * 9),
    }


def _square(x: float, y: float, width: float, height: float) -> list[list[float]]:
    """The closed outline of a square: from low left, counter-clockwise."""
    low, high, left, right = y - height / 2, y + height / 2, x - width / 2, x + width / 2
    return [[left, low], [right, low], [right, high], [left, high], [left, low]]


def hand_socket(**changed: Any) -> dict[str, Any]:
    """The socket as the pages are given it."""
    places = [[0.0, 90.0], [90.0, 60.0], [180.0, 30.0], [-90.0, 60.0], [10.0, -5.0]]
    wide = [_square(x, y, 30.0, 30.0) for x, y in places[:4]]
    found = {
        "names": ["t<0>", "t1", "t2", "t3", "t4"],
        "clusters": {"front": 0, "<back>": 2, "base": 4},
        "on_wall": [True, True, True, True, False],
        "places": places,
        "corners": [*wide, _square(10.0, -5.0, 20.0, 20.0)],
        # In space only the corners of tile 0 matter: 26 mm wide at x = 50 mm, 30 mm high.
        "squares": [
            [[50, -13, 75], [50, 13, 75], [50, 13, 105], [50, -13, 105], [50, -13, 75]],
            *[
                [[tile, 0, 0], [tile, 1, 0], [tile, 1, 1], [tile, 0, 1], [tile, 0, 0]]
                for tile in (1, 2, 3, 4)
            ],
        ],
        "sides": ["posterior", "right", "anterior", "left", "posterior"],
        "sectors": [-135, -45, 45, 135],
        "heights": ["distal", "middle", "proximal"],
        "thirds": [30.0, 50.0, 70.0, 90.0],
        "proximal": [0.0, 0.0, 1.0],
        "regions": {"a < b": [1, 3]},
        "grey": {"colour": [150, 150, 150], "greyest": 0.85},
        "power": 0.5,
        "patches": [_wall(), _end()],
    }
    return found | changed


def hand_moment(**changed: Any) -> dict[str, Any]:
    """Pressures, shears and what the three clusters measured [kPa]."""
    found = {
        "time": 12.5,
        "pressure": [10.0, 20.0, 30.0, 40.0, 45.0],
        "reach": [1.0, 12.0, 3.0, 4.0, 50.0],
        "grey": [1.0, 0.0, 0.5, 0.0, 0.2],
        "shear": [1.0, 2.0, 3.0, 4.0, 5.0],
        "measured": [11.26, None, 44.0],
    }
    return found | changed


def hand_course(**changed: Any) -> dict[str, Any]:
    """Force and peak pressure over 40 s, with two events."""
    found = {
        "time": [0.0, 10.0, 40.0],
        "force": [100.0, 800.0, -20.0],
        "peak": [5.0, 50.0, 8.0],
        "low": [2.0, 40.0, 6.0],
        "high": [9.0, 70.0, 11.0],
        "events": [{"time": 10.0, "label": "push"}, {"time": 25.0, "label": "a<b"}],
    }
    return found | changed


def hand_bars() -> dict[str, Any]:
    """Two outputs of three regions, each (value, low, high)."""
    return {
        "regions": ["anterior", "left", "socket"],
        "values": {
            "peak pressure [kPa]": [[20.0, 10.04, 40.06], [None, None, None], [50.0, 25.0, 100.0]],
            "share of load [%]": [[60.0, 40.0, 80.0], [-20.0, -30.0, -10.0], [100.0, 100.0, 100.0]],
        },
        "decimals": {"peak pressure [kPa]": 1, "share of load [%]": 0},
    }


def hand_cards() -> list[dict[str, Any]]:
    """A card with an interval, and one of bad data."""
    return [
        {
            "title": "Peak",
            "value": "45.0 kPa",
            "interval": "20.0 to 95.0",
            "words": "distal, <base>",
        },
        {"title": "Data", "value": "check clock", "words": "it stands still", "bad": True},
    ]
