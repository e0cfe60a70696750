"""Pressures by hand: ends and certainty of intervals, colours, titles, and outputs of a span.

The outputs are those of the scene with known answers (`support/scene.py`), in SI units, without a
trial on disk. Its regions are `anterior` (tiles ant_*), `lateral` (right_*) and the others.
"""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.errors import TrialError
from socket_testbed.geometry.regions import Region, all_regions
from socket_testbed.identification import pressure
from socket_testbed.identification.pressure import PressureOutputs, Quantity
from socket_testbed.samples import Samples, Status

GEOMETRY = scene.geometry()
REGIONS = all_regions(GEOMETRY, "right")
NAMES = [region.name for region in REGIONS]
ANTERIOR, LATERAL = NAMES.index("anterior"), NAMES.index("lateral")
THRESHOLD = 5e3  # [Pa]
SECOND = 1_000_000_000  # [ns]


def quantity(value: float, low: float, high: float, scale: float) -> Quantity:
    return Quantity(*(np.array(each) for each in (value, low, high, scale)))


def scene_samples() -> Samples:
    tiles = [*GEOMETRY.clusters.values()]
    limb = scene.limb()
    return Samples(
        stamps=scene.STAMPS,
        position=limb.translation,
        rotation=limb.rotation_vector(),
        wrench=scene.wrench(),
        clusters=tuple(scene.CLUSTERS),
        local_forces=scene.forces_in_tiles(scene.STAMPS)[:, tiles],
        status=np.zeros((len(scene.STAMPS), len(tiles)), dtype=np.uint8),
    )


def outputs(samples: Samples, threshold: float = THRESHOLD) -> PressureOutputs:
    force_map = scene.HandMap(GEOMETRY, samples.clusters)
    return pressure.pressure_outputs(force_map, samples, GEOMETRY, REGIONS, threshold)


@pytest.fixture(scope="module")
def found() -> PressureOutputs:
    return outputs(scene_samples())


# --- a quantity


@pytest.mark.parametrize(
    ("low", "high", "reach"), [(8.0, 11.0, 2.0), (9.0, 13.0, 3.0)], ids=["below", "above"]
)
def test_the_reach_is_of_the_farther_end(low: float, high: float, reach: float) -> None:
    assert quantity(10.0, low, high, 10.0).reach == reach


CERTAINTY = {
    # value, low, high, scale, share, verdict
    "half of it": (10.0, 5.0, 12.0, 10.0, 0.5, True),
    "more than half": (10.0, 4.99, 12.0, 10.0, 0.5, False),
    "of the scale": (1.0, -3.0, 2.0, 8.0, 0.5, True),
    "another share": (10.0, 8.0, 11.0, 10.0, 0.1, False),
    "more than no scale": (1.0, 1.0 - 2e-9, 1.0, 0.0, 0.5, False),
    "unknown": (np.nan, np.nan, np.nan, np.nan, 0.5, False),
}


@pytest.mark.parametrize("case", CERTAINTY)
def test_a_value_is_certain_by_reach(case: str) -> None:
    value, low, high, scale, share, verdict = CERTAINTY[case]
    assert bool(quantity(value, low, high, scale).certain(share)) is verdict


def test_half_the_scale_is_the_default() -> None:
    assert quantity(10.0, 5.0, 10.0, 10.0).certain() and not quantity(10.0, 4.9, 10, 10).certain()


def test_a_part_has_its_unit_throughout() -> None:
    values = np.arange(24.0).reshape(4, 2, 3)  # of value, low, high, scale
    part = Quantity(*values).part((..., 2), 1e-3)
    assert [of.tolist() for of in vars(part).values()] == [
        [0.002, 0.005],
        [0.008, 0.011],
        [0.014, 0.017],
        [0.02, 0.023],
    ]


def test_a_normal_value_reaches_two_deviations() -> None:
    """1.96 times 2.0 either side of -10; the scale is the magnitude."""
    made = pressure.normal_quantity(np.array(-10.0), np.array(2.0))
    found = [float(of) for of in (made.value, made.low, made.high, made.scale)]
    assert found == pytest.approx([-10.0, -13.92, -6.08, 10.0], abs=1e-3)


# --- titles and colours


DECIMALS = {
    "peak pressure [kPa]": 1,
    "mean pressure [kPa]": 1,
    "contact area [cm^2]": 0,
    "pressure-time integral [kPa s]": 0,
    "share of load [%]": 0,
    "shear [kPa]": 1,
    "shear direction [deg]": 0,
    "centre of pressure x [mm]": 0,
    "centre of pressure y [mm]": 0,
    "centre of pressure z [mm]": 0,
    "load [N]": 1,
    "stiffness Fz [N/mm]": 2,
    "pistoning [mm]": 2,
}


@pytest.mark.parametrize("title", DECIMALS)
def test_an_output_has_its_decimals(title: str) -> None:
    assert pressure.decimals_of(title) == DECIMALS[title]


def test_titles_are_in_the_tables_order() -> None:
    assert tuple(DECIMALS)[:10] == pressure.TITLES


def test_the_ends_follow_their_column() -> None:
    columns = pressure.with_interval("shear [kPa]", quantity(2.0, 1.0, 4.0, 2.0))
    assert {title: float(of) for title, of in columns.items()} == {
        "shear [kPa]": 2.0,
        "shear low [kPa]": 1.0,
        "shear high [kPa]": 4.0,
    }
    assert [*columns] == ["shear [kPa]", "shear low [kPa]", "shear high [kPa]"]


GREYS = {
    # value [Pa], reach [Pa], greyness: full colour up to its value, greyest from 2.5 times it on
    "certain": (20e3, 10e3, 0.0),
    "at its value": (20e3, 20e3, 0.0),
    "halfway": (20e3, 35e3, 0.5),
    "a third": (20e3, 30e3, 1.0 / 3.0),
    "greyest": (20e3, 50e3, 1.0),
    "beyond": (20e3, 80e3, 1.0),
    "pull": (-20e3, 35e3, 0.5),
    "small, as 5 kPa": (1e3, 8.75e3, 0.5),
    "small in full colour": (0.0, 5e3, 0.0),
}


@pytest.mark.parametrize("case", GREYS)
def test_a_pressure_is_grey_by_reach(case: str) -> None:
    value, reach, expected = GREYS[case]
    assert pressure.greyness(np.array(value), np.array(reach)) == pytest.approx(expected)


# --- what is measured, and for how long


def test_breaks_are_left_out_of_time() -> None:
    """Trapezoids of 0.25 s; the step of 0.74 s is no break, that of 0.76 s is one."""
    steps = np.array([0.25] * 30 + [0.74] + [0.25] * 30 + [0.76] + [0.25] * 30)
    weights = pressure.integration_weights(np.append(0.0, np.cumsum(steps)))
    expected = np.full(93, 0.25)
    expected[[0, -1, 61 + 1, 61]] = 0.125  # the ends and either side of the break
    expected[[30, 31]] = 0.495  # half of 0.25 s and half of 0.74 s
    np.testing.assert_allclose(weights, expected, atol=1e-9)


def test_a_single_sample_covers_no_time() -> None:
    assert pressure.integration_weights(np.array([3.0])).tolist() == [0.0]


def test_one_channel_makes_a_sample_measured() -> None:
    samples = scene_samples()[:5]
    wrench, forces, status = (
        getattr(samples, name).copy() for name in ("wrench", "local_forces", "status")
    )
    wrench[1:], forces[1:] = np.nan, np.nan
    wrench[2, 5], forces[3, 0, 2], forces[4] = -1.0, -2.0, -3.0
    status[4] = Status.OUT_OF_RANGE  # not trusted
    spoiled = replace(samples, wrench=wrench, local_forces=forces, status=status)
    assert pressure.measured_rows(spoiled).tolist() == [True, False, True, True, False]


def test_nothing_measured_is_refused() -> None:
    samples = replace(
        scene_samples()[:5], wrench=np.full((5, 6), np.nan), status=np.full((5, 4), Status.MISSING)
    )
    with pytest.raises(TrialError) as refusal:
        outputs(samples)
    assert refusal.value.hint == "choose another segment"


# --- outputs of the span


@pytest.mark.parametrize("title", scene.ANSWERS["anterior"])
@pytest.mark.parametrize("place", ["anterior", "lateral"])
def test_a_column_has_its_unit(place: str, title: str, found: PressureOutputs) -> None:
    """Its values and ends, by the answers of the scene."""
    columns = pressure.columns_of(found.regions, [title])
    own = [float(values[NAMES.index(place)]) for values in columns.values()]
    assert own == pytest.approx(scene.ANSWERS[place][title], rel=2e-5, abs=1e-4)


def test_the_peak_is_at_its_sample(found: PressureOutputs) -> None:
    assert found.peak_row == scene.PEAK_ROW
    assert found.peak_map.normal_pressure.shape == (1, 12)
    assert found.peak_map.normal_pressure[0, 4] == pytest.approx(60e3)  # ant_mid, 1.5 times 40


def test_the_span_knows_its_samples(found: PressureOutputs) -> None:
    assert found.integrated == pytest.approx(23.75)
    assert found.threshold == THRESHOLD
    assert found.source == "made by hand"
    assert found.estimate.normal_pressure.shape == (96, 12)


SCALES = {
    # By region: the square root of the mean squared distance of the tiles from their mean, and
    # magnitudes of the values. `anterior`: (50, 0, 210), (50, 0, 150), (20, 0, 90) mm are
    # 3700, 100 and 4000 mm^2 from (40, 0, 150): the square root of 2600. A single tile has a
    # nanometre, above what rounding leaves.
    "anterior": ("centre", 0.0509902),
    "anterior middle": ("centre", 1e-9),
    "lateral": ("direction", 1.5707963),
    "lateral middle": ("mean", 1e3),  # -1 kPa
    "socket": ("share", 1.0),
}


@pytest.mark.parametrize("place", SCALES)
def test_certainty_has_its_reference(place: str, found: PressureOutputs) -> None:
    name, scale = SCALES[place]
    own = getattr(found.regions, name).scale[NAMES.index(place)]
    np.testing.assert_allclose(own, scale, rtol=1e-6, atol=1e-12)


def test_contact_is_above_the_threshold_alone() -> None:
    """At the mean pressure of ant_mid, 40 kPa at row 24, half a turn of the factor."""
    one = scene_samples()[24:25]
    at, below = (outputs(one, threshold) for threshold in (40.1e3, 39.9e3))
    tile = GEOMETRY.names.index("ant_mid")
    # Four fifths of the draws are exact, a tenth is higher, a tenth lower by 2.45 kPa.
    ends = (("value", 0.0, 9e-4), ("low", 0.0, 0.0), ("high", 9e-4, 9e-4))
    for end, if_not, if_so in ends:
        assert getattr(at.tiles.area, end)[tile] == pytest.approx(if_not, abs=1e-9)
        assert getattr(below.tiles.area, end)[tile] == pytest.approx(if_so, abs=1e-9)


def test_area_and_integral_count_the_same_tiles() -> None:
    """From 33.1 to 38 kPa, either both are above zero or both are zero."""
    span = scene_samples()[20:24]
    for threshold in np.arange(33.1e3, 38e3, 0.5e3):
        found = outputs(span, threshold).tiles
        np.testing.assert_array_equal(found.area.value > 0.0, found.integral.value > 0.0)
        np.testing.assert_array_equal(found.area.high > 0.0, found.integral.high > 0.0)


# --- at instants


@pytest.fixture(scope="module")
def gappy() -> PressureOutputs:
    """Nothing is measured at the rows 10 to 12."""
    samples = scene_samples()
    wrench, status = samples.wrench.copy(), samples.status.copy()
    wrench[10:13], status[10:13] = np.nan, Status.MISSING
    return outputs(replace(samples, wrench=wrench, status=status))


INSTANTS = {
    # name, region, row, value, low, high in SI units
    # At the peak, factor 1.5: ant_mid 60 kPa +-1.25 * 1.96; (24 + 60 + 22.5) / 3 kPa +-1.96.
    "peak": ("peak", ANTERIOR, 48, 60e3, 57.55e3, 62.45e3),
    "mean": ("mean", ANTERIOR, 48, 35.5e3, 33.54e3, 37.46e3),
    # Row 0, factor 0.5: half of (8 + 20 + 7.5) / 3 kPa.
    "first mean": ("mean", ANTERIOR, 0, 35.5e3 / 3.0, 35.5e3 / 3.0 - 1960, 35.5e3 / 3.0 + 1960),
    "area": ("area", ANTERIOR, 48, 27e-4, 27e-4, 27e-4),
    # 45, -1.5 and 9 kPa: two tiles; the pull stays below.
    "lateral area": ("area", LATERAL, 48, 18e-4, 18e-4, 18e-4),
}


@pytest.mark.parametrize("case", INSTANTS)
def test_an_instant_has_its_own_outputs(case: str, found: PressureOutputs) -> None:
    name, region, row, *expected = INSTANTS[case]
    own = getattr(found.series, name)
    ends = [float(of[row, region]) for of in (own.value, own.low, own.high)]
    assert ends == pytest.approx(expected, rel=1e-4)


def test_a_single_sample_has_no_integral() -> None:
    """Its contact area is known, its duration is not."""
    alone = outputs(scene_samples()[24:25])
    assert np.isnan(alone.regions.integral.value).all() and alone.integrated == 0.0
    assert alone.regions.area.value[NAMES.index("anterior")] == pytest.approx(27e-4)


def test_an_instant_has_no_integral(found: PressureOutputs) -> None:
    assert np.isnan(found.series.integral.value).all()
    assert found.series.integral.value.shape == (96, len(REGIONS))


def test_the_unmeasured_instant_is_unknown(gappy: PressureOutputs) -> None:
    unknown = np.isin(np.arange(96), [10, 11, 12])
    for name in ("mean", "peak", "area", "share", "shear", "direction"):
        values = getattr(gappy.series, name).low[:, -1]
        np.testing.assert_array_equal(np.isnan(values), unknown, err_msg=name)
    assert gappy.peak_row == 48


def test_rows_stay_in_their_place(gappy: PressureOutputs) -> None:
    """ant_mid has 40 kPa times the factor, also behind the rows that are unknown."""
    peaks = gappy.series.peak.value[:, ANTERIOR]
    known = np.isfinite(peaks)
    np.testing.assert_allclose(peaks[known], 40e3 * scene.FACTOR[known])


def test_the_quick_mean_is_the_series(gappy: PressureOutputs) -> None:
    quick = gappy.mean_pressure
    for name in ("value", "low", "high", "scale"):
        np.testing.assert_allclose(getattr(quick, name), getattr(gappy.series.mean, name))


# --- long spans, whose draws are thinned


@pytest.fixture(scope="module")
def thinned() -> PressureOutputs:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pressure, "MAX_DRAWN", 30)  # of 96 samples: every fourth is drawn
        return outputs(scene_samples())


def test_a_thinned_span_keeps_its_values(thinned: PressureOutputs, found: PressureOutputs) -> None:
    for name in ("mean", "peak", "integral", "shear", "direction", "share"):
        values = (getattr(each.regions, name).value for each in (thinned, found))
        np.testing.assert_allclose(*values, rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("end", ["low", "high"])
def test_a_thinned_span_keeps_its_intervals(
    end: str, thinned: PressureOutputs, found: PressureOutputs
) -> None:
    """The errors are equal at all samples; 24 groups of 4 make the same means to 1.5 %."""
    for name in ("mean", "peak", "integral"):
        ends = (getattr(getattr(each.regions, name), end) for each in (thinned, found))
        np.testing.assert_allclose(*ends, rtol=0.015, atol=10.0, err_msg=name)


def test_a_short_peak_survives_thinning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each tile peaks at row 48, which no group of three draws: 60 kPa +-1.25 * 1.96."""
    monkeypatch.setattr(pressure, "MAX_DRAWN", 3)  # rows 15 (0.8), 47 and 79 (1.2)
    found = outputs(scene_samples()[:60])
    own = found.tiles.peak
    tile = GEOMETRY.names.index("ant_mid")
    ends = [float(of[tile]) for of in (own.value, own.low, own.high)]
    assert ends == pytest.approx([60e3, 57.55e3, 62.45e3], rel=1e-4)


# --- intervals from draws


READER = pressure._Regions(GEOMETRY, [Region("column", np.array([0, 1]))])
DRAWN = {
    # name, value, draws (their 2.5 %, 50 % and 97.5 % quantiles by hand), low, high.
    # 41 draws 0 to 40: places 1, 20 and 39.
    "around the value": ("mean", 20.0, np.arange(41.0), 1.0, 39.0),
    "all above": ("mean", -10.0, np.arange(41.0), -10.0, 39.0),
    "all below": ("mean", 50.0, np.arange(41.0), 1.0, 50.0),
    # A convex output: -19 and +19 about the median, shifted to the value, and those of the draws.
    "convex": ("peak", 15.0, np.arange(41.0), -4.0, 39.0),
    "convex below": ("peak", 25.0, np.arange(41.0), 1.0, 44.0),
    "never negative": ("shear", 15.0, np.arange(41.0), 0.0, 39.0),
    "integral": ("integral", 15.0, np.arange(41.0), 0.0, 39.0),
    "share": ("share", 15.0, np.arange(41.0) - 30.0, -29.0, 15.0),
    # 9 and 16 cm^2 at most
    "area": ("area", 20e-4, 1e-4 * np.arange(41.0), 1e-4, 25e-4),
    "area above zero": ("area", 2e-4, 1e-4 * (np.arange(41.0) - 20.0), 0.0, 21e-4),
    # Half a turn is no distance: +-0.1 about pi.
    "direction": ("direction", 3.1, 3.1 + 0.01 * np.arange(-20.0, 21.0), 2.91, 3.29),
    "direction beyond": ("direction", 3.1, 3.1 + 0.01 * np.arange(-20, 21) - 2 * np.pi, 2.91, 3.29),
    "direction before": (
        "direction",
        -3.1,
        0.01 * np.arange(-20, 21) + 2 * np.pi - 3.1,
        *(-3.29, -2.91),
    ),
    # Unknown draws do not count; 10 known ones, 0 to 9: places 0.225 and 8.775.
    "unknown draws": ("share", 4.0, np.r_[np.arange(10.0), [np.nan] * 5], 0.225, 8.775),
    "between draws": ("mean", 4.0, np.arange(10.0)[::-1], 0.225, 8.775),
}


@pytest.mark.parametrize("case", DRAWN)
def test_an_interval_comes_from_its_draws(case: str) -> None:
    name, value, drawn, low, high = DRAWN[case]
    made = READER.interval(name, np.array([value]), np.asarray(drawn)[:, None])
    assert [float(made.value[0]), float(made.low[0]), float(made.high[0])] == pytest.approx(
        [value, low, high], abs=1e-9
    )


def test_an_interval_of_a_centre_is_by_axis() -> None:
    draws = np.arange(41.0)[:, None, None] * [1.0, 10.0, 100.0]
    made = READER.interval("centre", np.array([[20.0, 200.0, 2000.0]]), draws)
    assert made.low.tolist() == [pytest.approx([1.0, 10.0, 100.0])]
    assert made.high.tolist() == [pytest.approx([39.0, 390.0, 3900.0])]


def test_without_known_draws_ends_are_unknown() -> None:
    made = READER.interval("share", np.array([np.nan]), np.full((41, 1), np.nan))
    assert np.isnan([made.value, made.low, made.high]).all()


def test_the_highest_row_is_that_of_the_pressure() -> None:
    """18 N on 9 cm^2 are 20 kPa, before 24 N on 16 cm^2, 15 kPa, and a pull of 90 N."""
    forces = np.zeros((3, 12, 3))
    forces[0, scene.TILES.index("ant_mid"), 2] = 90.0
    forces[1, scene.TILES.index("post_mid"), 2] = -18.0
    forces[2, scene.TILES.index("left_prox"), 2] = -24.0
    drawn = SimpleNamespace(rows=np.arange(3), mean=lambda: forces.reshape(3, 36))
    force_map: Any = SimpleNamespace(sample=lambda samples, count: iter([drawn]))
    assert pressure.highest_row(force_map, scene_samples()[:3], GEOMETRY) == 1
