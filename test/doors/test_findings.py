"""Each finding of the data check, one at a time, on the scene with one thing spoiled.

The scene itself is good. Every case says where to look and what is wrong, with its number in its
unit, as it is read in `info`, on the page's card and above every result.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support import scene

from socket_testbed.identification.data_check import check_data
from socket_testbed.pages.document import check_card
from socket_testbed.samples import Samples, Status

BRIM, MID, POSTERIOR, DISTAL = range(4)  # columns of the clusters
X, Y, Z = range(3)
FX, FZ = 3, 5  # columns of the wrench
LATE = 20  # samples, 5 s at 4 Hz


@pytest.fixture(scope="module")
def samples(scene_folder, trial) -> Samples:
    return trial.samples()


def check(samples: Samples, mass: float | None = None) -> dict[str, list[str]]:
    """Facts by source."""
    found: dict[str, list[str]] = {}
    for finding in check_data(samples, scene.geometry(), mass):
        found.setdefault(finding.source, []).append(finding.fact)
    return found


def changed(samples: Samples, name: str, change: Callable[[np.ndarray], object]) -> Samples:
    """The samples with a copy of one array changed in place."""
    values = getattr(samples, name).copy()
    change(values)
    return replace(samples, **{name: values})


def put(*place: object, value: float) -> Callable[[np.ndarray], object]:
    return lambda values: values.__setitem__(tuple(place), value)


def times(*place: object, factor: float) -> Callable[[np.ndarray], object]:
    def change(values: np.ndarray) -> None:
        values[tuple(place)] = factor * values[tuple(place)]

    return change


def shifted(by: int, *place: object) -> Callable[[np.ndarray], object]:
    """Later by so many samples; the first or last value fills up."""

    def change(values: np.ndarray) -> None:
        own = values[tuple(place)]
        rolled = np.roll(own, by, axis=0)
        edge = slice(0, by) if by > 0 else slice(by, None)
        rolled[edge] = own[0] if by > 0 else own[-1]
        values[tuple(place)] = rolled

    return change


def noisy(size: float, *place: object) -> Callable[[np.ndarray], object]:
    def change(values: np.ndarray) -> None:
        values[tuple(place)] += np.random.default_rng(0).normal(0.0, size, 96)

    return change


ALL = slice(None)
CASES: dict[str, tuple[str, Callable[[np.ndarray], object], str, str]] = {
    # array, its damage, source, and part of the fact
    "millinewtons": (
        "wrench",
        times(ALL, slice(3, 6), factor=1e3),
        "the units",
        "N in a quarter of",
    ),
    "millimetres": ("position", times(ALL, factor=1e3), "the units", "147 m from the load cell"),
    "lever": (  # 80 N m at about 60 N: 1.3 m, the farthest tile is 0.216 m away
        *("wrench", put(ALL, 0, value=80.0), "the wrench"),
        "a lever of 1.3 m, where the farthest tile is 0.22 m away",
    ),
    "too much on one tile": (
        *("local_forces", times(ALL, BRIM, Z, factor=10.0), "brim_lateral"),
        "brim_lateral.Fz: the median magnitude of 270 N on one tile is 4.3 times the total load",
    ),
    "pull": (
        *("local_forces", put(ALL, DISTAL, Z, value=45.0), "distal"),
        "the wall would pull at the limb with 45 N in the median",
    ),
    "turned limb": (
        # A wrong order of the quaternion: half a radian to either side in turn, twice
        *("rotation", lambda v: v.__setitem__((ALL, 2), np.where(np.arange(96) % 2, 0.8, -0.8))),
        *("the limb pose", "the limb turns by 46 deg in the socket"),
    ),
    "negated wrench": ("wrench", np.negative, "the wrench", "looks negated"),
    "weak clusters": (  # 98.1 N together; 0.35355 of it is their standard deviation
        *("local_forces", times(ALL, factor=1e-4), "the clusters"),
        "their forces change by 0.0035 N while the load does by 21 N",
    ),
    "strong clusters": (
        *("local_forces", times(ALL, ALL, Z, factor=2.1), "the wrench"),
        "its force along the socket changes by 21 N while those of the clusters change by 73 N",
    ),
    "late clusters": (
        *("local_forces", shifted(LATE, ALL, ALL, Z), "the clusters"),
        "late by 5.0 s against the load cell",
    ),
    "early clusters": (
        *("local_forces", shifted(-LATE, ALL, ALL, Z), "the clusters"),
        "early by 5.0 s against the load cell",
    ),
    "late pose": (
        *("position", shifted(LATE), "the limb pose"),
        "late by 5.0 s against the load cell",
    ),
    "reversed cluster": (
        *("local_forces", lambda v: v.__setitem__((ALL, MID, Z), -72.0 - v[:, MID, Z])),
        *("mid_anterior", "it is pressed less the more the limb is loaded (correlation -1.00)"),
    ),
    "loose cluster": (
        *("local_forces", lambda v: v.__setitem__((ALL, MID, Z), -36 - 13 * np.sin(PHASE))),
        *("mid_anterior", "it does not follow the load (correlation"),
    ),
    "sideways limb": (
        *("position", lambda v: v.__setitem__((ALL, [0, 2]), v[:, [2, 0]]), "the limb pose"),
        "the limb does not sink as it is loaded: it moves at",
    ),
    "disagreeing cluster": (
        *("local_forces", times(ALL, DISTAL, Z, factor=5.0), "distal"),
        "kPa where the others and the wrench say",
    ),
    "missing wrench": (
        *("wrench", put(slice(40, 52), value=np.nan), "the wrench"),
        "12 % of its samples are missing or out of range",
    ),
    "missing pose": (
        *("position", put(slice(40, 52), value=np.nan), "the limb pose"),
        "12 % of its samples are missing or out of range",
    ),
    "overloaded cluster": (
        *("status", put(slice(40, 52), POSTERIOR, value=Status.OUT_OF_RANGE)),
        *("posterior_distal", "12 % of its samples are missing or out of range"),
    ),
    "saturated cluster": (
        *("status", put(slice(40, 52), POSTERIOR, value=Status.SATURATED)),
        *("posterior_distal", "12 % of its samples are missing or out of range"),
    ),
    "still pose": (
        *("position", put(slice(30, 60), value=0.145), "the limb pose"),
        "it stands still",
    ),
    "still channel": (
        *("wrench", put(slice(40, 60), 2, value=0.5), "Mz"),
        "it does not change for 5.0 s",
    ),
    "clipped high": (
        *("wrench", put(slice(0, 96, 8), 1, value=2.5), "My"),
        "12 % of its values are at one end, 2.5 N m",
    ),
    "clipped low": (
        *("wrench", put(slice(0, 96, 8), 1, value=-2.5), "My"),
        "12 % of its values are at one end, -2.5 N m",
    ),
    "noisy force": ("wrench", noisy(40.0, ALL, FX), "Fx", "its noise is"),
    "noisy moment": ("wrench", noisy(6.0, ALL, 2), "Mz", "its noise is"),
    "spike": ("wrench", put(44, FX, value=4000.0), "single values", "Fx has an outlier"),
}
PHASE = 2.0 * np.pi * np.arange(96) * 9.0 / 96.0


@pytest.mark.parametrize("case", CASES)
def test_a_defect_is_found_where_it_is(case: str, samples: Samples) -> None:
    name, change, source, fact = CASES[case]
    if change is np.negative:
        spoiled = replace(samples, **{name: -getattr(samples, name)})
    else:
        spoiled = changed(samples, name, change)
    found = check(spoiled)
    assert any(fact in own for own in found.get(source, ())), found


def test_the_scene_itself_is_good(samples: Samples) -> None:
    assert check(samples) == {}
    assert check(samples, mass=61.2) == {}


@pytest.mark.parametrize(
    ("mass", "weights"), [(1000.0, "0.0093"), (1.0, "9.3")], ids=["too light", "too heavy"]
)
def test_the_load_is_compared_with_the_mass(mass: float, weights: str, samples: Samples) -> None:
    """95 % of the samples have less than 91 N: 0.0093 of 9810 N, 9.3 times 9.81 N."""
    (fact,) = check(samples, mass)["the wrench"]
    assert fact == f"its force of 91 N is {weights} weights of the stated {mass:g} kg"


def test_lost_triggers_are_found(samples: Samples) -> None:
    """12 of 96 triggers, 3 of 23.75 s, in one piece."""
    kept = np.r_[0:40, 52:96]
    assert check(samples[kept])["the trigger"] == ["13 % of the time has no sample"]


def test_few_samples_are_not_judged(samples: Samples) -> None:
    assert check(samples[:29])["the trial"] == ["29 samples are too few to judge it"]


def test_several_findings_hide_none(samples: Samples) -> None:
    """Different kinds: a noisy moment beside missing poses."""
    both = changed(samples, "wrench", noisy(6.0, ALL, 2))
    both = changed(both, "position", put(slice(40, 52), value=np.nan))
    assert {"Mz", "the limb pose"} <= set(check(both))


def test_the_card_shows_the_first_finding(samples: Samples) -> None:
    spoiled = changed(samples, "position", put(slice(40, 52), value=np.nan))
    card = check_card(check_data(spoiled, scene.geometry()), ())
    assert card["title"] == "Data" and card["bad"] is True
    assert "12 % of its samples" in card["words"]
