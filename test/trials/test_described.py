"""What is said of a trial: counts, gaps, drop-outs, loads, noise, and how it was recomputed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import scene
from support.problems import GEOMETRY
from support.wording import refused

from socket_testbed.calibration.drift import Drift
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.identification.noise import channel_noise
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.trials import description, reprocess
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.synchronise import Measurements


@pytest.fixture
def samples() -> Samples:
    """Ten samples at 4 Hz, then a gap of 1.25 s, then two more; two clusters.

    Fx lacks the rows 3 and 4, the limb position row 11; `a` is missing in row 0, `b` saturated in
    rows 1 and 2 and out of range in row 5.
    """
    stamps = np.array([*range(10), 14, 15]) * 250_000_000
    wrench = np.tile([0.3, 0.4, 0.0, 3.0, 4.0, 12.0], (12, 1))
    wrench[3:5, 3] = np.nan
    position = np.zeros((12, 3))
    position[11] = np.nan
    status = np.zeros((12, 2), np.uint8)
    status[0, 0] = Status.MISSING
    status[1:3, 1] = Status.SATURATED
    status[5, 1] = Status.OUT_OF_RANGE
    forces = np.zeros((12, 2, 3))
    return Samples(stamps, position, np.zeros((12, 3)), wrench, ("a", "b"), forces, status)


def test_samples_are_counted_with_rate_and_gaps(samples: Samples) -> None:
    assert description.describe_samples(samples) == (
        "12 samples at 4.00 Hz in 3.75 s, 9 with a wrench and a limb position; gaps longer than 1.5"
        " periods: 1, the longest 1.250 s from 2.25 s"
    )
    assert description.describe_samples(samples[:3]) == (
        "3 samples at 4.00 Hz in 0.50 s, 3 with a wrench and a limb position; gaps longer than 1.5"
        " periods: 0"
    )


def test_the_five_longest_gaps_are_listed_longest_first(samples: Samples) -> None:
    """One sample is lost between 2 and 3 s; then two, four, three, five and six."""
    steps = [1] * 60
    for place, long in zip((8, 20, 30, 40, 50, 55), (2, 3, 5, 4, 6, 7), strict=True):
        steps[place] = long
    stamps = np.concatenate([[0], np.cumsum(steps)]) * 250_000_000
    many = samples[np.zeros(61, dtype=int)]
    text = description.describe_samples(replace(many, stamps=stamps))
    longest = text.partition("periods: 6, the longest ")[2].split(", ")
    assert [own.split()[0] for own in longest] == ["1.750", "1.500", "1.250", "1.000", "0.750"]


def test_drop_outs_are_counted_by_measurement(samples: Samples) -> None:
    table = description.drop_outs(samples, slice(4, 12))
    assert table.caption == "Samples of the trial without a measurement"
    frame = table.frame
    assert [*frame.index] == [*("Mx", "My", "Mz", "Fx", "Fy", "Fz"), "limb position", "a", "b"]
    assert [*frame] == [
        *("missing [1]", "missing [%]", "of them in the segment [1]", "longest [s]"),
        *("saturated [1]", "out of range [1]"),
    ]
    cells = dict(table.rows)
    assert cells["Fx"] == ("2", "16.67", "1", "0.75", *2 * ("\N{EN DASH}",))
    assert "of them in the segment [1]" not in description.drop_outs(samples).frame


# Missing, as a share [%], in the segment; longest [s]; saturated and out of range, of clusters
DROP_OUTS = {
    "Fx": (2, 100 / 6, 1, 0.75, np.nan, np.nan),
    "limb position": (1, 100 / 12, 1, 0.25, np.nan, np.nan),
    "a": (1, 100 / 12, 0, 0.25, 0, 0),
    "b": (0, 0.0, 0, 0.0, 2, 1),
    "Mx": (0, 0.0, 0, 0.0, np.nan, np.nan),
}


@pytest.mark.parametrize("name", DROP_OUTS)
def test_a_measurement_has_its_drop_outs(name: str, samples: Samples) -> None:
    """`longest` is from the value before to the one after: 1.25 s to 0.5 s around the rows 3, 4."""
    row = description.drop_outs(samples, slice(4, 12)).frame.loc[name]
    np.testing.assert_allclose(row.to_numpy(float), DROP_OUTS[name])


def test_the_longest_of_two_drop_outs_counts(samples: Samples) -> None:
    """Fx lacks row 7 as well: 0.5 s beside 0.75 s."""
    wrench = samples.wrench.copy()
    wrench[7, 3] = np.nan
    frame = description.drop_outs(replace(samples, wrench=wrench)).frame
    assert frame.loc["Fx", ["missing [1]", "longest [s]"]].tolist() == [3, 0.75]


def test_loads_of_parts_are_magnitudes(samples: Samples) -> None:
    """|(3, 4, 12)| = 13 N, |(0.3, 0.4, 0)| = 0.5 N m; 26 N in half of the second part."""
    samples.wrench[8:10] *= 2.0
    parts = [Segment("plateau", 1.25, 1.75, slice(5, 8)), Segment("hold", 1.5, 2.25, slice(6, 10))]
    table = description.loads_table(samples, parts)
    assert [*table.frame.index] == ["plateau 1.25 s to 1.75 s", "hold 1.50 s to 2.25 s"]
    cells = dict(table.rows)
    assert [*table.frame] == [
        *("duration [s]", "mean force [N]", "its sigma [N]"),
        *("mean moment [N m]", "its sigma [N m]"),
    ]
    assert cells["plateau 1.25 s to 1.75 s"] == ("0.50", "13.0", "0.00", "0.50", "0.000")
    assert cells["hold 1.50 s to 2.25 s"] == ("0.75", "19.5", "6.50", "0.75", "0.250")
    assert table.caption == "Load of parts of the trial"


def test_noise_is_in_its_row_s_unit() -> None:
    """White noise: moments 0.01, 0.02, 0.03 N m, positions 1, 2, 3 mm, turns 4, 5, 6 mrad."""
    rng, count = np.random.default_rng(0), 8000
    noise = rng.normal(size=(count, 15)) * [
        *(0.01, 0.02, 0.03, 0.1, 0.2, 0.3),
        *(1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3),
        *(0.7, 0.8, 0.9),
    ]
    stamps = 250_000_000 * np.arange(count)
    status = np.zeros((count, 1), np.uint8)
    own = Samples(
        stamps, noise[:, 6:9], noise[:, 9:12], noise[:, :6], ("a",), noise[:, None, 12:], status
    )
    table = description.noise_table(own.clusters, channel_noise(own))
    expected = {
        "moment [N m]": (0.01, 0.02, 0.03),
        "force [N]": (0.1, 0.2, 0.3),
        "limb position [mm]": (1.0, 2.0, 3.0),
        "limb rotation [mrad]": (4.0, 5.0, 6.0),
        "a [N]": (0.7, 0.8, 0.9),
    }
    assert [*table.frame.index] == [*expected] and [*table.frame] == ["x", "y", "z"]
    for name, values in expected.items():
        np.testing.assert_allclose(table.frame.loc[name], values, rtol=0.08, err_msg=name)
    assert all(len(cell.lstrip("0.")) <= 2 for _, row in table.rows for cell in row)


def test_a_trial_is_summed_up_in_a_line(scene_trial: Path) -> None:
    assert description.summary(scene_trial) == f"{scene_trial}: 96 triggers, all 96 complete"


@pytest.fixture(scope="module")
def scene_trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write(tmp_path_factory.mktemp("scenes") / "scene")


def test_what_lacks_is_summed_up(monkeypatch: pytest.MonkeyPatch, samples: Samples) -> None:
    monkeypatch.setattr(description.Trial, "samples", lambda trial: samples)
    assert description.summary(Path("s01")) == (
        "s01: 12 triggers, wrench missing 2, limb position missing 1, a missing 1, b saturated 2"
    )


# --- measurements, recomputed

TARE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])


def measured(count: int = 9) -> Measurements:
    """One a second, Fz at 20 N but for a tare of 5 N; a body that rests; a cluster at 5 pF."""
    wrench = np.zeros((count, 6))
    wrench[:, 5] = 15.0
    rest = np.tile(np.eye(7)[6], (count, 1))
    return Measurements(
        stamps=np.arange(count) * 10**9,
        wrench=wrench,
        socket=rest,
        pylon=rest,
        clusters=("distal",),
        capacitance=np.full((count, 1, 4), 5.0),
        status=np.zeros((count, 1, 4), np.uint8),
        ratios=np.zeros((count, 6)),
        tares=np.tile(TARE, (count, 1)),
        tared=np.zeros(count, np.int64),
        markers={},
    )


LIMITS = LoadCellSettings()


def retared(given: Measurements, tare: str) -> tuple[Measurements, str]:
    notes: list[str] = []
    found = reprocess.remake_wrenches(given, LIMITS, None, tare, "s01", notes.append)
    (note,) = notes
    return found, note


@pytest.mark.parametrize(
    ("tare", "fz", "words"),
    [("none", 20.0, "Fz 0 N"), ("recorded", 15.0, "Fz 5 N"), ("2:4", 0.0, "Fz 20 N")],
)
def test_another_tare_is_taken_off(tare: str, fz: float, words: str) -> None:
    found, note = retared(measured(), tare)
    assert found.wrench[:, 5] == pytest.approx(fz)
    start = f"the wrenches are recomputed from load_cell/raw, with the tare {tare}: Mx 0 N m, "
    assert note.startswith(start) and note.endswith(words)


def test_wrenches_without_a_raw_reading_are_counted() -> None:
    given = measured()
    given.tares[3:5] = np.nan
    found, note = retared(given, "none")
    assert np.isnan(found.wrench[3:5]).all() and note.endswith(
        "; 2 have no raw reading and are missing"
    )


def test_a_tare_s_span_holds_a_resting_load() -> None:
    with refused(TrialError, "s01: --tare 20:30 holds no wrench: give seconds since", "0 to 8"):
        retared(measured(), "20:30")
    moving = measured()
    moving.wrench[3, 5] = 30.0
    with refused(TrialError, "s01: --tare 2:4: Fz moves by", ": give a span without load, at rest"):
        retared(moving, "2:4")


@pytest.mark.parametrize(
    ("by", "differ"), [(0.9e-6, ()), (1.2e-6, ("socket",))], ids=["same", "other"]
)
def test_markers_differ_by_more_than_a_micrometre(by: float, differ: tuple[str, ...]) -> None:
    moved = GEOMETRY.socket_markers + np.array([0.0, by, 0.0])
    other = replace(GEOMETRY, socket_markers=moved)
    assert reprocess.other_markers(GEOMETRY, other) == differ
    fewer = replace(GEOMETRY, pylon_markers=np.vstack([GEOMETRY.pylon_markers, [[1.0, 1.0, 1.0]]]))
    assert reprocess.other_markers(GEOMETRY, fewer) == ("pylon",)


def test_a_refit_tells_how_far_poses_moved() -> None:
    """Nine rows: markers moved by 2 mm and turned by 3 mrad, in row 0 by 4 mm and not turned.

    Row 1 has no marker, row 2 had no pose.
    """
    given = measured()
    turn = Rotation.from_rotvec([0.0, 0.0, 3e-3]).as_matrix()
    seen = np.tile(GEOMETRY.socket_markers @ turn.T + np.array([2e-3, 0.0, 0.0]), (9, 1, 1))
    seen[0] = GEOMETRY.socket_markers + np.array([0.0, 4e-3, 0.0])
    seen[1] = np.nan
    socket = given.socket.copy()
    socket[2] = np.nan
    given = replace(given, socket=socket, markers={"socket": seen})
    notes: list[str] = []
    found = reprocess.refit_poses(given, GEOMETRY, ("socket",), "s01", notes.append)
    assert notes == [
        "socket: poses refitted to the recorded markers: 8 of 9 found, 1 of the recorded ones"
        " refused, 1 new; moved by 2 mm and 3 mrad (median), 4 mm and 3 mrad (largest)"
    ]
    np.testing.assert_allclose(found.socket[3, :3], [2e-3, 0.0, 0.0], atol=1e-9)
    assert found.socket[3, 5] == pytest.approx(1.5e-3, rel=1e-4)  # half of the angle
    np.testing.assert_array_equal(found.pylon, given.pylon)


def test_a_body_has_its_model_s_markers() -> None:
    seen = np.zeros((9, 4, 3))
    with refused(TrialError, "s01: 4 markers of the socket were recorded, and the geometry has 3"):
        given = replace(measured(), markers={"socket": seen})
        reprocess.refit_poses(given, GEOMETRY, ("socket",), "s01", lambda note: None)


def test_a_drift_is_told_in_kilopascals() -> None:
    def told(*stress: float) -> str:
        return reprocess._describe(Drift(np.zeros(4), np.array(stress)))

    assert told(900.0, -300.0, 50.0) == (
        "drifted by +0.90 kPa normal, -0.30 and +0.05 kPa shear between the spans, corrected"
    )
    assert told(0.0, -1001.0, 0.0).endswith("between the spans, corrected, more than 1 kPa")


@pytest.mark.parametrize(
    ("spans", "words"),
    [
        (((0.0, 1.0), (2.0, 3.0), (4.0, 5.0)), "--unloaded has 3 spans"),
        (((3.0, 2.0),), "--unloaded is '3.0:2.0'"),
        (((0.0, 5.0), (4.0, 8.0)), "--unloaded: 4:8 does not begin after 0:5"),
        (((0.0, 5.0), (5.0, 8.0)), "--unloaded: 5:8 does not begin after 0:5"),
    ],
    ids=["three", "reversed", "overlap", "touch"],
)
def test_unusable_spans_are_refused(spans: tuple[tuple[float, float], ...], words: str) -> None:
    with refused(ConfigurationError, words):
        reprocess.check_unloaded(spans)
    reprocess.check_unloaded(((0.0, 5.0), (6.0, 8.0)))


def test_a_tare_is_a_span_or_a_word() -> None:
    assert reprocess.parse_tare("1:2.5") == (1.0, 2.5)
    assert reprocess.parse_tare("none") is reprocess.parse_tare("recorded") is None
    with refused(ConfigurationError, "--tare is 'x': give", "12.5:60, or none, recorded"):
        reprocess.parse_tare("x")
    assert reprocess.parse_unloaded(["0:5", "6:8"]) == ((0.0, 5.0), (6.0, 8.0))


def corrected(
    given: Measurements, *spans: tuple[float, float], baseline: float | None = None
) -> tuple[Measurements, list[str]]:
    """With a calibration of 20 kPa/pF; the load cell bears more than 30 N where loaded."""
    notes: list[str] = []
    calibration = scene.calibration()
    if baseline is not None:
        own = replace(calibration.clusters["distal"], baseline=np.full(4, baseline))
        calibration = replace(calibration, clusters=calibration.clusters | {"distal": own})
    found = reprocess.correct_measurements(given, spans, calibration, 30.0, "s01", notes.append)
    return found, notes


def test_drift_between_two_spans_is_linear() -> None:
    """From 5 pF around 1 s to 5.6 pF around 7 s: 0.1 pF/s, and 20 kPa/pF make 12 kPa."""
    given = measured()
    time = np.arange(9.0)
    given.capacitance[:] = (5.0 + 0.1 * np.clip(time - 1.0, 0.0, 6.0))[:, None, None]
    given.capacitance[[0, 1, 2], 0] = 5.0
    given.capacitance[[6, 7, 8], 0] = 5.6
    found, notes = corrected(given, (0.0, 2.0), (6.0, 8.0))
    np.testing.assert_allclose(found.capacitance[3:6], 5.0, atol=1e-9)
    assert notes == [
        "distal drifted by +12.00 kPa normal, +0.00 and +0.00 kPa shear between the spans,"
        " corrected, more than 1 kPa"
    ]


def test_one_span_corrects_to_the_stored_baseline() -> None:
    found, notes = corrected(measured(), (0.0, 4.0), baseline=4.0)
    np.testing.assert_allclose(found.capacitance, 4.0)
    assert notes == []


def test_one_span_without_a_baseline_corrects_nothing() -> None:
    found, notes = corrected(measured(), (0.0, 4.0))
    np.testing.assert_allclose(found.capacitance, 5.0)
    assert notes == [
        "one span without load and no stored baseline in use: the drift of distal is not"
        " corrected: give a second span, after the load"
    ]


def test_a_borne_weight_keeps_the_baseline_out() -> None:
    given = measured()
    given.wrench[:, 5] = -92.4
    found, notes = corrected(given, (0.0, 4.0), baseline=4.0)
    np.testing.assert_allclose(found.capacitance, 5.0)
    assert notes[0] == (
        "the load cell measured 92 N in 0:4: creep of the limb there counts as drift of the"
        " clusters; give spans with the limb out of the socket; the stored baseline is not used"
    )


@pytest.mark.parametrize(("load", "is_loaded"), [(44.0, False), (46.0, True)])
def test_a_span_under_load_is_refused(load: float, is_loaded: bool) -> None:
    """More than 30 N above the least load, 15 N."""
    given = measured(40)
    given.wrench[20:, 5] = load
    if not is_loaded:
        corrected(given, (25.0, 30.0), baseline=4.0)
        return
    words = "s01: 25:30 is not without load, the load cell measured 46 N there: give a span as at "
    with refused(TrialError, words, "0.0 s, where it measured 15 N"):
        corrected(given, (25.0, 30.0))
