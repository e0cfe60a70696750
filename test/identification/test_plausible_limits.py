"""What is implausible for a limb in a socket, at its limits: each rule a little below and above.

The socket is the scene's: its farthest tiles are 0.215870 m from the load cell, sqrt(0.05^2 +
0.21^2), and its clusters cover 9 cm^2 each.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support import scene

from socket_testbed.errors import IdentificationError
from socket_testbed.identification import plausibility
from socket_testbed.samples import Samples, Status

GEOMETRY = scene.geometry()
REACH = 0.2158703
COUNT = 100
MX, MY, MZ, FX, FY, FZ = range(6)
DISTAL = 3
ALL = slice(None)


def plain(count: int = COUNT) -> Samples:
    """A steady load of 100 N downwards, 10 N of it on each cluster; the limb rests at 150 mm."""
    wrench, forces = np.zeros((count, 6)), np.zeros((count, 4, 3))
    wrench[:, FZ], forces[:, :, 2] = -100.0, -10.0
    return Samples(
        stamps=scene.START + 250_000_000 * np.arange(count, dtype=np.int64),
        position=np.tile([0.0, 0.0, 0.15], (count, 1)),
        rotation=np.zeros((count, 3)),
        wrench=wrench,
        clusters=tuple(scene.CLUSTERS),
        local_forces=forces,
        status=np.zeros((count, 4), dtype=np.uint8),
    )


def put(samples: Samples, name: str, value: object, *place: object) -> Samples:
    """The samples with a value in one place of an array."""
    values = getattr(samples, name).copy()
    values[place] = value
    return replace(samples, **{name: values})


# --- limits of the channels and of the position


def test_each_channel_has_its_limit() -> None:
    """500 N m, 5000 N, and 2 MPa on 9 cm^2: 1800 N."""
    found = plausibility.channel_limits(GEOMETRY, ("distal", "brim_lateral"))
    np.testing.assert_allclose(found, [500.0] * 3 + [5000.0] * 3 + [1800.0] * 6)


def test_a_larger_tile_bears_more() -> None:
    """`left_prox` has 16 cm^2."""
    wide = replace(GEOMETRY, clusters={"wide": GEOMETRY.names.index("left_prox")})
    assert plausibility.channel_limits(wide, ("wide",))[6:] == pytest.approx([3200.0] * 3)


def test_another_sockets_clusters_have_no_limits() -> None:
    assert (
        np.isinf(plausibility.channel_limits(GEOMETRY, ("distal", "heel"))).tolist() == [True] * 12
    )


UNITS: dict[str, tuple[Callable[[Samples], Samples], str, str]] = {
    # change, refusal (empty: accepted), hint
    "as measured": (lambda s: s, "", ""),
    "moment at its limit": (lambda s: put(s, "wrench", 500.0, ALL, MY), "", ""),
    "moment": (
        lambda s: put(s, "wrench", 501.0, ALL, MY),
        "My reaches 501 N m in a quarter of the samples, but no person applies more than 500 N m",
        "it is likely in newton millimetres: divide it by 1000 (or leave it out with --leave-out"
        " My)",
    ),
    "force": (
        lambda s: put(s, "wrench", -5010.0, ALL, FZ),
        "Fz reaches 5.01e+03 N in a quarter of the samples, but no person applies more than"
        " 5e+03 N",
        "it is likely in millinewtons: divide it by 1000 (or leave it out with --leave-out Fz)",
    ),
    "cluster": (
        lambda s: put(s, "local_forces", -1810.0, ALL, DISTAL, 2),
        "distal.Fz reaches 1.81e+03 N in a quarter",
        "millinewtons",
    ),
    "a fifth of them": (lambda s: put(s, "wrench", 501.0, slice(0, 20), MY), "", ""),
    "a third of them": (lambda s: put(s, "wrench", 501.0, slice(0, 33), MY), "My reaches 501", ""),
    # Twice the farthest tile's distance is 0.4317 m; the spread may be 0.2159 m.
    "far": (lambda s: put(s, "position", [0.0, 0.0, 0.43], ALL), "", ""),
    "too far": (
        lambda s: put(s, "position", [0.0, 0.0, 0.44], ALL),
        "the limb position is 0.44 m from the load cell and moves by 0 m, where the farthest tile"
        " is 0.216 m away",
        "it is likely in millimetres: divide it by 1000, or check the marker bodies and their"
        " frames in socket.yaml",
    ),
    "moves": (lambda s: put(s, "position", 0.21, slice(0, 40), 0), "", ""),
    "moves too far": (
        lambda s: put(s, "position", 0.22, slice(0, 40), 0),
        "the limb position is 0.15 m from the load cell and moves by 0.22 m",
        "millimetres",
    ),
    "nowhere": (
        lambda s: put(s, "position", 1e3, ALL),
        "1.73e+03 m",
        "check the marker bodies and",
    ),
    "unknown": (lambda s: put(s, "position", np.nan, ALL), "", ""),
}


@pytest.mark.parametrize("case", UNITS)
def test_another_unit_is_refused(case: str) -> None:
    change, fact, hint = UNITS[case]
    if not fact:
        plausibility.require_units(change(plain()), GEOMETRY)
        return
    with pytest.raises(IdentificationError) as refusal:
        plausibility.require_units(change(plain()), GEOMETRY)
    assert fact in refusal.value.fact and hint in refusal.value.hint


def test_a_position_far_beyond_is_no_millimetre() -> None:
    with pytest.raises(IdentificationError) as refusal:
        plausibility.require_units(put(plain(), "position", 1e3, ALL), GEOMETRY)
    assert refusal.value.hint.startswith("check the marker bodies")


def test_a_channel_left_out_may_exceed() -> None:
    plausibility.require_units(put(plain(), "wrench", 501.0, ALL, MY), GEOMETRY, ("My",))


LOADS = {
    # moments [N m], forces [N], channels in the objective, refused
    "neither": (0.09, 0.9, "111111", True),
    "a moment": (0.11, 0.9, "111111", False),
    "a force": (0.09, 1.1, "111111", False),
    "no moment at all": (0.0, 100.0, "111111", True),
    "no force at all": (100.0, 0.0, "111111", True),
    "moments left out": (0.0, 100.0, "000111", False),
    "load left out": (100.0, 100.0, "000000", False),
    "negative": (-0.2, -100.0, "111111", False),
    "a moment alone, left out": (100.0, 0.9, "000111", True),
}


@pytest.mark.parametrize("case", LOADS)
def test_a_wrench_without_load_is_refused(case: str) -> None:
    moment, force, counts, refused = LOADS[case]
    samples = put(plain(), "wrench", np.repeat([moment, force], 3), ALL)
    counted = np.array([each == "1" for each in counts])
    if not refused:
        plausibility.require_load(samples, counted)
        return
    with pytest.raises(IdentificationError, match="holds no load"):
        plausibility.require_load(samples, counted)


def test_the_refusal_names_what_counts() -> None:
    samples = put(plain(), "wrench", [9.0, 9.0, 9.0, 0.5, 0.25, 0.0], ALL)
    with pytest.raises(IdentificationError) as refusal:
        plausibility.require_load(samples, np.arange(6) > 2)
    assert refusal.value.fact.startswith("the wrench never exceeds 0.5 N and 0 N m in 100 samples")


# --- outliers


def marked(samples: Samples, leave_out: tuple[str, ...] = ()) -> list[tuple[int, str]]:
    """Rows and channels of the outliers."""
    found = plausibility.find_outliers(samples, GEOMETRY, leave_out)
    values = [(int(row), samples.channels[column]) for row, column in np.argwhere(found.values)]
    return [(int(row), "position") for row in np.flatnonzero(found.position)] + values


OUTLIERS: dict[str, tuple[Callable[[Samples], Samples], list[tuple[int, str]]]] = {
    "none": (lambda s: s, []),
    "beyond its limit": (lambda s: put(s, "wrench", 501.0, 7, MX), [(7, "Mx")]),
    # A single value three times the usual ones, which nothing else feels.
    "spike": (lambda s: put(s, "wrench", -310.0, 7, FZ), [(7, "Fz")]),
    "no spike": (lambda s: put(s, "wrench", -290.0, 7, FZ), []),
    "felt by clusters": (
        lambda s: put(put(s, "wrench", -310.0, 7, FZ), "local_forces", -16.0, 7, ALL, 2),
        [],
    ),
    "hardly felt": (
        lambda s: put(put(s, "wrench", -310.0, 7, FZ), "local_forces", -14.0, 7, ALL, 2),
        [(7, "Fz")],
    ),
    "three in a row": (lambda s: put(s, "wrench", -310.0, slice(7, 10), FZ), []),
    "of a cluster": (
        lambda s: put(s, "local_forces", 35.0, 50, DISTAL, 0),
        [(50, "distal.Fx")],
    ),
    # From the middle 0.2159 m at most, from the load cell twice that
    "position": (lambda s: put(s, "position", 0.22, 3, 0), [(3, "position")]),
    "position within": (lambda s: put(s, "position", 0.21, 3, 0), []),
    "half of the positions": (lambda s: put(s, "position", 0.22, slice(0, 50), 0), []),
    "fewer positions": (
        lambda s: put(s, "position", 0.22, slice(0, 3), 0),
        [(0, "position"), (1, "position"), (2, "position")],
    ),
    "another unit": (lambda s: put(s, "wrench", 501.0, slice(0, 50), MX), []),
}


@pytest.mark.parametrize("case", OUTLIERS)
def test_outliers_are_single_values(case: str) -> None:
    change, expected = OUTLIERS[case]
    assert marked(change(plain())) == expected


SQUARES = {
    # samples, force of one of them that clusters feel [N], outlier. The others have 100 N:
    # v^2 / (v^2 + 99 * 100^2) is 1 / 3 for v = 703 N. From 600 samples on, 200 mean squares count
    # as many: v^2 / (v^2 + 699 * 100^2) is 200 / 700 for v = 1672 N.
    "a third of the sum": (100, 710.0, True),
    "less than a third": (100, 690.0, False),
    "200 mean squares": (700, 1690.0, True),
    "less than 200": (700, 1650.0, False),
    "few": (29, 4900.0, False),
}


@pytest.mark.parametrize("case", SQUARES)
def test_one_value_dominates_no_group(case: str) -> None:
    count, force, outlier = SQUARES[case]
    samples = put(plain(count), "wrench", -force, 7, FZ)
    samples = put(samples, "local_forces", -16.0, 7, ALL, 2)
    assert marked(samples) == [(7, "Fz")] * outlier


def test_few_values_have_no_spikes() -> None:
    """30 or more are needed."""
    spoiled = put(plain(), "wrench", -310.0, 7, FZ)
    assert marked(spoiled[:29]) == [] and marked(spoiled[:30]) == [(7, "Fz")]


def test_an_outlier_is_not_measured() -> None:
    spoiled = put(put(plain(), "wrench", 501.0, 7, MX), "position", 0.22, 3, 0)
    outliers = plausibility.find_outliers(spoiled, GEOMETRY)
    assert np.flatnonzero(outliers.rows).tolist() == [3, 7]
    left = outliers.taken_from(spoiled)
    assert np.isnan(left.position[3]).all() and np.isnan(left.position).sum() == 3
    assert np.isnan(left.wrench[7, MX]) and np.isnan(left.values).sum() == 1


def test_outliers_are_named_with_their_times() -> None:
    spoiled = put(put(plain(), "wrench", 501.0, [4, 8], MX), "position", [0.3, 0.0, 0.4], 3)
    notes = [*plausibility.outlier_notes(spoiled, plausibility.find_outliers(spoiled, GEOMETRY))]
    assert notes == [
        "limb position has an outlier (0.5 m at 0.75 s): left out",
        "Mx has 2 outliers (501 N m at 1.00 s, 501 N m at 2.00 s): left out",
    ]


def test_many_outliers_are_not_all_named() -> None:
    spoiled = put(plain(), "local_forces", 2e3, [4, 8, 12, 16, 20], DISTAL, 0)
    (note,) = plausibility.outlier_notes(spoiled, plausibility.find_outliers(spoiled, GEOMETRY))
    assert note.startswith("distal.Fx has 5 outliers (2e+03 N at 1.00 s, 2e+03 N at 2.00 s, 2e+03")
    assert "4.00 s" not in note


# --- the sign of the wrench


def pulled(force: float, *clusters: float) -> Samples:
    """A force towards the proximal end, and the clusters' normal forces."""
    samples = put(plain(), "wrench", force, ALL, FZ)
    return put(samples, "local_forces", np.array(clusters), ALL, ALL, 2)


SIGNS = {
    # force along the socket [N], normal forces in compression < 0 [N], noted
    "negated": (51.0, (-10.0, -10.0, -10.0, 5.0), True),
    "a hanging prosthesis": (49.0, (-10.0, -10.0, -10.0, 5.0), False),
    "half of the clusters": (51.0, (-10.0, -10.0, 5.0, 5.0), False),
    "more pull than pressure": (51.0, (-1.0, -1.0, -1.0, 5.0), False),
    "pressed": (-51.0, (-10.0, -10.0, -10.0, -10.0), False),
}


@pytest.mark.parametrize("case", SIGNS)
def test_a_negated_wrench_is_noted(case: str) -> None:
    force, clusters, noted = SIGNS[case]
    note = plausibility.sign_note(pulled(force, *clusters), flared())
    assert (note is not None) is noted


def flared():
    """The scene's socket, whose walls lean 0.1 rad outwards, so that it opens upwards."""
    lean = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    rotations = GEOMETRY.rotations.copy()
    rotations[:8] = rotations[:8] @ lean
    return replace(GEOMETRY, rotations=rotations)


def test_the_note_has_its_numbers() -> None:
    note = plausibility.sign_note(pulled(51.0, -10.0, -10.0, -10.0, 5.0), flared()) or ""
    assert "with 51 N in the median, while 3 of 4 clusters are pressed (25 N)" in note


# --- channels to leave out


IMPLAUSIBLE: dict[str, tuple[Callable[[Samples], Samples], list[tuple[str, str]]]] = {
    "none": (lambda s: s, []),
    # 100 N at twice 0.21587 m: 43.17 N m
    "lever": (lambda s: put(s, "wrench", -43.0, ALL, MY), []),
    "too long a lever": (
        lambda s: put(s, "wrench", -44.0, ALL, MY),
        [
            (
                "My",
                "the median magnitude of 44 N m would take the load of 100 N at a lever of 0.44 m,"
                " where the farthest tile is 0.22 m away",
            )
        ],
    ),
    "less than the load": (lambda s: put(s, "local_forces", 99.0, ALL, DISTAL, 1), []),
    "more than the load": (
        lambda s: put(s, "local_forces", 250.0, ALL, DISTAL, 1),
        [
            (
                "distal.Fy",
                "the median magnitude of 250 N on one tile is 2.5 times the total load of 100 N",
            )
        ],
    ),
    # The highest of 100 samples does not count.
    "a peak": (lambda s: put(s, "local_forces", -310.0, 5, DISTAL, 1), []),
    "lower peaks": (lambda s: put(s, "local_forces", -290.0, [5, 6, 7], DISTAL, 1), []),
    "peaks": (
        lambda s: put(s, "local_forces", -310.0, [5, 6, 7], DISTAL, 1),
        [
            (
                "distal.Fy",
                "its peaks of 310 N on one tile are 3.1 times the largest load of 100 N",
            )
        ],
    ),
    # 10 N, as 5 % of the load are less
    "slight pull": (lambda s: put(s, "local_forces", 9.9, ALL, DISTAL, 2), []),
    "pull": (
        lambda s: put(s, "local_forces", 10.1, ALL, DISTAL, 2),
        [
            (
                "distal.Fz",
                "the wall would pull at the limb with 10.1 N in the median, more than 10 N under a"
                " load of 100 N",
            )
        ],
    ),
    "heavier load": (
        lambda s: put(put(s, "wrench", -400.0, ALL, FZ), "local_forces", 19.9, ALL, DISTAL, 2),
        [],
    ),
    "pull under a heavier load": (
        lambda s: put(put(s, "wrench", -400.0, ALL, FZ), "local_forces", 20.1, ALL, DISTAL, 2),
        [
            (
                "distal.Fz",
                "the wall would pull at the limb with 20.1 N in the median, more than 20 N under a"
                " load of 400 N",
            )
        ],
    ),
    "pull along the wall": (lambda s: put(s, "local_forces", 30.0, ALL, DISTAL, 0), []),
    "half out of range": (
        lambda s: put(s, "status", Status.OUT_OF_RANGE, slice(0, 50), DISTAL),
        [],
    ),
    "missing": (lambda s: put(s, "status", Status.MISSING, slice(0, 60), DISTAL), []),
}


@pytest.mark.parametrize("case", IMPLAUSIBLE)
def test_implausible_channels_are_proposed(case: str) -> None:
    change, expected = IMPLAUSIBLE[case]
    found = plausibility.find_implausible(change(plain()), GEOMETRY)
    assert [(each.channel, each.reason) for each in found] == expected


def test_a_cluster_out_of_range_is_proposed() -> None:
    """Of 80 readings, 30 are out of range and 11 saturated: more than half."""
    samples = put(plain(), "status", Status.MISSING, slice(0, 20), DISTAL)
    samples = put(samples, "status", Status.OUT_OF_RANGE, slice(20, 50), DISTAL)
    samples = put(samples, "status", Status.SATURATED, slice(50, 61), DISTAL)
    found = plausibility.find_implausible(samples, GEOMETRY)
    assert [each.channel for each in found] == ["distal.Fx", "distal.Fy", "distal.Fz"]
    reason = "41 of 80 readings are saturated or out of the calibrated range"
    assert {each.reason for each in found} == {reason}


def test_without_load_sizes_say_nothing() -> None:
    """20 N is the least load."""
    light = put(plain(), "local_forces", 30.0, ALL, DISTAL, 0)
    below, above = (put(light, "wrench", -load, ALL, FZ) for load in (19.9, 20.1))
    assert plausibility.find_implausible(below, GEOMETRY) == ()
    assert [p.channel for p in plausibility.find_implausible(above, GEOMETRY)] == ["distal.Fx"]


def test_proposals_are_in_the_channels_order() -> None:
    samples = put(plain(), "local_forces", 150.0, ALL, ALL, 0)
    samples = put(samples, "status", Status.OUT_OF_RANGE, slice(0, 60), 0)
    samples = put(samples, "wrench", 60.0, ALL, MZ)
    found = [each.channel for each in plausibility.find_implausible(samples, GEOMETRY)]
    assert found == [
        *("Mz", "brim_lateral.Fx", "brim_lateral.Fx", "brim_lateral.Fy", "brim_lateral.Fz"),
        *("mid_anterior.Fx", "posterior_distal.Fx", "distal.Fx"),
    ]
