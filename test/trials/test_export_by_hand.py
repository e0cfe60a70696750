"""Files for gait laboratories from tables of a few rows, letter by letter."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import ezc3d
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from support import scene
from support.wording import refused

from socket_testbed.errors import TrialError
from socket_testbed.trials import export
from socket_testbed.trials.trial import Trial

NAN = float("nan")


def markers(time: list[float]) -> pd.DataFrame:
    """Two markers that move by 1 mm a sample; the second is unseen in the first sample."""
    rows = [[k, 10.0 + k, 20.0 + k, 100.0 + k, 110.0 + k, 120.0 + k] for k in range(len(time))]
    names = [f"{label}_{axis}" for label in ("a_1", "a_2") for axis in "xyz"]
    table = pd.DataFrame(rows, columns=names, index=pd.Index(time, name="time [s]"), dtype=float)
    table.iloc[0, 3:] = np.nan
    return table


def test_opensim_s_markers_are_laid_out_by_the_book() -> None:
    text = export._markers_text(markers([12.0, 12.25, 12.5]), ["a_1", "a_2"], "a.trc")
    assert text.splitlines() == [
        "PathFileType\t4\t(X/Y/Z)\ta.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame"
        "\tOrigNumFrames",
        "4\t4\t3\t2\tmm\t4\t1\t3",
        "Frame#\tTime\ta_1\t\t\ta_2\t\t",
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2",
        "",
        "1\t12.000000\t0.0000\t10.0000\t20.0000\tnan\tnan\tnan",
        "2\t12.250000\t1.0000\t11.0000\t21.0000\t101.0000\t111.0000\t121.0000",
        "3\t12.500000\t2.0000\t12.0000\t22.0000\t102.0000\t112.0000\t122.0000",
    ]


def test_a_single_frame_has_a_rate_of_one() -> None:
    text = export._markers_text(markers([12.0]), ["a_1", "a_2"], "a.trc")
    assert text.splitlines()[2] == "1\t1\t1\t2\tmm\t1\t1\t1"
    text = export._markers_text(markers([12.0, 12.25]), ["a_1", "a_2"], "a.trc")
    assert text.splitlines()[2] == "4\t4\t2\t2\tmm\t4\t1\t2"


def test_opensim_s_loads_are_laid_out_by_the_book() -> None:
    table = pd.DataFrame({"a": [1.0, 2.0], "b": [-2.5, 3.0]}, index=[0.25, 0.5])
    assert export._storage(table).splitlines() == [
        *("socket", "version=1", "nRows=2", "nColumns=3", "inDegrees=no", "endheader"),
        *("time\ta\tb", "0.250000\t1.000000\t-2.500000", "0.500000\t2.000000\t3.000000"),
    ]


@pytest.mark.parametrize(
    ("title", "topic"),
    [
        ("distal.normal [Pa]", "/distal/normal_Pa"),
        ("Mx [N m]", "/Mx_N_m"),
        ("pressure.mid anterior.contact area [cm^2]", "/pressure/mid_anterior/contact_area_cm_2"),
        ("engaged share [-]", "/engaged_share"),
        ("plain", "/plain"),
    ],
)
def test_a_column_s_topic_is_its_name_and_unit(title: str, topic: str) -> None:
    assert export._topic_name(title) == topic


# --- what is missing

TIMES = [0.25 * k for k in range(8)]


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        ([], None),
        ([3], "1 sample without a wrench is left out, the longest gap 0.5 s"),
        ([1, 3, 4], "3 samples without a wrench are left out, the longest gap 0.75 s"),
        ([0, 1, 2], "3 samples without a wrench are left out, the longest gap 0.75 s"),
        ([2, 3, 4, 5, 6], "5 samples without a wrench are left out, the longest gap 1.5 s"),
        ([5, 6, 7], "3 samples without a wrench are left out, the longest gap 0.75 s"),
    ],
    ids=["none", "one", "two gaps", "first", "long", "last"],
)
def test_missing_samples_have_a_note(missing: list[int], words: str | None) -> None:
    """Their number, and the longest time between those with a wrench, or to the end."""
    values = np.ones((8, 6))
    values[missing] = NAN
    notes = export.missing_notes(np.array(TIMES), values, "a wrench", export._LEFT_OUT)
    assert notes == (() if words is None else (words,))


def test_a_part_of_a_wrench_is_none() -> None:
    values = np.ones((8, 6))
    values[2] = values[3, :5] = NAN
    (note,) = export.missing_notes(np.array(TIMES), values, "a wrench", export._AS_NAN)
    assert note == (
        "2 samples without a wrench are NaN in the file (1 of them measured in part), the longest"
        " gap 0.75 s"
    )


def test_a_long_pause_is_named_by_its_times() -> None:
    """Three periods are no pause; OpenSim's spline would leave all measured values in a longer."""
    assert export._pause_notes(np.array([0.0, 0.25, 0.5, 1.25, 1.5, 1.75])) == ()
    assert export._pause_notes(np.array([0.0, 0.25, 0.5, 1.5, 1.75, 2.0])) == (
        "OpenSim draws a spline across the pause from 0.50 s to 1.50 s: analyse the times before"
        " and after apart",
    )
    (note,) = export._pause_notes(np.array([0.0, 0.25, 0.5, 1.5, 1.75, 2.0, 4.0]))
    assert "the pauses from 0.50 s to 1.50 s, 2.00 s to 4.00 s: analyse" in note


# --- C3D


def frames(time: list[float], path: Path) -> Any:
    """A C3D file of markers and a wrench that counts samples, read back."""
    table = markers(time)
    for k, name in enumerate(("Mx", "My", "Mz", "Fx", "Fy", "Fz")):
        table[name] = 10.0 * np.arange(len(time)) + k
    export._write_c3d(path, table, ["a_1", "a_2"])
    return ezc3d.c3d(str(path))


def test_c3d_frames_are_at_their_times(tmp_path: Path) -> None:
    """A gap of four periods is three empty frames; an unseen marker is none."""
    file = frames([12.0, 12.25, 12.5, 13.5, 13.75], tmp_path / "a.c3d")
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == 4.0
    wrench = file["data"]["analogs"][0]
    assert wrench.shape == (6, 8)
    assert wrench[0, [0, 1, 2, 6, 7]].tolist() == [0.0, 10.0, 20.0, 30.0, 40.0]
    assert wrench[5, 7] == 45.0 and np.isnan(wrench[:, 3:6]).all()
    points = file["data"]["points"]
    assert points[:3, 1, 7].tolist() == [104.0, 114.0, 124.0]
    assert np.isnan(points[:3, 1, 0]).all() and points[:3, 0, 0].tolist() == [0.0, 10.0, 20.0]
    assert file["parameters"]["POINT"]["LABELS"]["value"] == ["a_1", "a_2"]


def test_c3d_has_one_rate(tmp_path: Path) -> None:
    """A sample may be a frame and a half from its place."""
    jittery = [0.0, 0.25, 0.55, 0.75, 1.0]
    assert frames(jittery, tmp_path / "a.c3d")["data"]["analogs"].shape[2] == 5
    changed = [*np.arange(0.0, 10.0, 0.25), *np.arange(10.0, 20.0, 0.05)]
    with refused(TrialError, "the rate changes within the segment: export spans of one rate"):
        frames(changed, tmp_path / "b.c3d")


def test_c3d_has_frames_it_can_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert export._MAX_FRAMES == 65_535
    monkeypatch.setattr(export, "_MAX_FRAMES", 8)
    times = [0.25 * k for k in range(9)]
    assert frames(times[:8], tmp_path / "a.c3d")["data"]["analogs"].shape[2] == 8
    words = "9 frames are more than C3D holds (8): export a shorter segment"
    with refused(TrialError, words):
        frames(times, tmp_path / "b.c3d")


# --- what is written of the scene


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    return Trial(scene.write(tmp_path_factory.mktemp("scenes") / "scene"))


@pytest.mark.parametrize(("suffix", "columns"), [(".MOT", 9), (".trc", 18), (".C3D", 24)])
def test_the_written_table_is_returned(
    suffix: str, columns: int, trial: Trial, tmp_path: Path
) -> None:
    """Two triads are 18 coordinates; a C3D file has the wrench as well."""
    path = tmp_path / f"a{suffix}"
    table = export.write_gait_file(trial, slice(48, 51), path)
    assert table.shape == (3, columns) and path.is_file()
    assert table.index.name == "time [s]" and table.index.tolist() == [12.0, 12.25, 12.5]
    if columns == 24:
        assert table["Mx"].iloc[0] == pytest.approx(0.55)
        assert table["Fz"].iloc[0] == pytest.approx(-90.0)
    if columns >= 18:
        assert table["socket_2_y"].iloc[0] == pytest.approx(2083.8835, abs=1e-3)


def test_a_trial_without_markers_is_refused(
    trial: Trial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = SimpleNamespace(markers={})
    monkeypatch.setattr(export, "read_measurements", lambda *given, **more: none)
    with refused(TrialError, "scene: has no markers: export the wrench as .mot"):
        export.write_gait_file(trial, slice(0, 3), tmp_path / "a.trc")


def test_a_standard_bag_leaves_out_missing_values(trial: Trial, tmp_path: Path) -> None:
    """One wrench lacks a channel, one number is missing; whole numbers are no topic."""
    measured = trial.measurements()
    measured.wrench[49, 0] = np.nan
    table = pd.DataFrame({"a.b [N]": [1.5, NAN, 2.5], "count [1]": [1, 2, 3]})
    path = tmp_path / "a.mcap"
    notes = export.write_standard_bag(measured, slice(48, 51), table, path)
    assert notes == (
        "1 sample without a complete load_cell/wrench is left out (1 of them measured in part),"
        " the longest gap 0.5 s",
    )
    types, found = get_typestore(Stores.ROS2_JAZZY), dict[str, list[Any]]()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None and message.log_time == message.publish_time
            value = types.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time - scene.START, value))
    assert set(found) == {
        *("/load_cell/wrench", "/mocap/socket/pose", "/mocap/pylon/pose", "/a/b_N")
    }
    times = {name: [round(1e-9 * time, 3) for time, _ in own] for name, own in found.items()}
    assert times["/load_cell/wrench"] == times["/a/b_N"] == [12.0, 12.5]
    assert times["/mocap/pylon/pose"] == [12.0, 12.25, 12.5]
    assert [value.data for _, value in found["/a/b_N"]] == [1.5, 2.5]


@pytest.mark.parametrize("kind", [sorted, list], ids=["sorted", "as they come"])
def test_predictions_are_by_channel(kind: Callable[..., Any], trial: Trial) -> None:
    measured, samples = trial.measurements_and_samples()
    segment = SimpleNamespace(rows=slice(48, 50))
    predicted = np.tile(np.arange(18.0), (96, 1))
    table = export.sample_table(measured, samples, trial.calibration, segment, predicted)
    assert table["predicted.Mx [N m]"].tolist() == [0.0, 0.0]
    assert table["predicted.Fz [N]"].iloc[0] == 5.0
    assert table["predicted.brim_lateral.Fx [N]"].iloc[0] == 6.0
    assert table["predicted.distal.Fz [N]"].iloc[1] == 17.0
    assert kind(table["stamp [ns]"]) == [scene.START + 12 * 10**9, scene.START + 12_250_000_000]
    titles = [title for title in table if title.startswith("distal.")]
    assert titles == [
        *(f"distal.C{i} [pF]" for i in range(4)),
        *("distal.status [-]", "distal.normal [Pa]", "distal.shear_x [Pa]", "distal.shear_y [Pa]"),
        *("distal.Fx [N]", "distal.Fy [N]", "distal.Fz [N]"),
    ]
