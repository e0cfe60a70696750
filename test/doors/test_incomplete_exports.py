"""Exports of the scene with holes: what is left out, what is NaN, and that the verb says so.

Missing are the wrench of the first sample and of those from 10.0 s to 10.75 s, the moment about x
at 22.5 s and 22.75 s, and the last marker at the first and the last sample and from 12.5 s to
13.0 s. The other numbers are those of `test_exports`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from support import holes, scene
from support.wording import refused

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.errors import TrialError

WRENCH = "7 samples without a wrench {} (2 of them measured in part), the longest gap 1.2 s"
LEFT_OUT = WRENCH.format("are left out")
PAUSE = (
    "OpenSim draws a spline across the pause from 9.75 s to 11.00 s: analyse the times before and"
    " after apart"
)
MARKERS = "5 samples without all markers hold NaN for those unseen, the longest gap 1.0 s"
STANDARD = (
    "7 samples without a complete load_cell/wrench are left out (2 of them measured in part), the"
    " longest gap 1.2 s"
)
NOTES = {
    ".mot": (LEFT_OUT, PAUSE),
    ".sto": (LEFT_OUT, PAUSE),
    ".trc": (MARKERS,),
    ".c3d": (MARKERS, WRENCH.format("are NaN in the file")),
    ".mcap": (STANDARD,),
    ".csv": (),
}
COLUMNS = {".mot": 9, ".sto": 9, ".trc": 18, ".c3d": 24}


@pytest.fixture(scope="module")
def holed(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return holes.with_holes(scene_folder, tmp_path_factory.mktemp("holed") / "holed")


@pytest.mark.parametrize("suffix", NOTES)
def test_the_verb_says_what_is_missing(
    suffix: str, holed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On its output, as the table that the function returns."""
    path = tmp_path / f"a{suffix}"
    assert run(["export", str(holed), "-o", str(path)]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert said == [f"note: {note}" for note in NOTES[suffix]]
    table = st.export(holed, tmp_path / f"b{suffix}")
    assert table.attrs["notes"] == NOTES[suffix]
    rows = 89 if suffix in {".mot", ".sto"} else 96
    assert len(table) == rows and table.attrs["rows"] == f"{rows} samples"


@pytest.mark.parametrize("suffix", NOTES)
def test_a_complete_segment_needs_no_note(suffix: str, holed: Path, tmp_path: Path) -> None:
    assert st.export(holed, tmp_path / f"a{suffix}", "14:16").attrs["notes"] == ()


@pytest.mark.parametrize("suffix", [".mot", ".sto"])
def test_loads_have_rows_with_a_wrench_alone(suffix: str, holed: Path, tmp_path: Path) -> None:
    table = st.export(holed, tmp_path / f"a{suffix}")
    lines = (tmp_path / f"a{suffix}").read_text().splitlines()
    assert lines[2] == "nRows=89" and "nan" not in "".join(lines[7:])
    read = pd.read_csv(tmp_path / f"a{suffix}", sep="\t", skiprows=6)
    lost = {0.0, 10.0, 10.25, 10.5, 10.75, 22.5, 22.75}
    assert read["time"].tolist() == [time for time in scene.TIME if time not in lost]
    assert table.index.tolist() == pytest.approx(read["time"].tolist(), abs=1e-9)
    assert read["socket_force_vz"][read["time"] == 20.0].item() == pytest.approx(-45.0)


def test_loads_without_a_wrench_are_refused(holed: Path, tmp_path: Path) -> None:
    words = "holed: no sample of the segment has a wrench: export another segment, or the markers"
    with refused(TrialError, words):
        st.export(holed, tmp_path / "a.mot", "10:10.75")
    assert not (tmp_path / "a.mot").exists()


def test_an_unseen_marker_is_nan_in_trc(holed: Path, tmp_path: Path) -> None:
    """Every row has all its fields."""
    st.export(holed, tmp_path / "a.trc")
    rows = [line.split("\t") for line in (tmp_path / "a.trc").read_text().splitlines()[6:]]
    assert len(rows) == 96 and {len(row) for row in rows} == {20}
    unseen = [float(row[1]) for row in rows if row[-3:] == ["nan"] * 3]
    assert unseen == [0.0, 12.5, 12.75, 13.0, 23.75]
    assert not any(field in {"", "nan"} for row in rows for field in row[:-3])


# --- C3D, by two libraries


def read_by_ezc3d(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Markers (N, m, 3) [mm], NaN where unseen, and wrench (N, 6) [N m, N]."""
    data = ezc3d.c3d(str(path))["data"]
    return data["points"][:3].transpose(2, 1, 0), data["analogs"][0].T


def read_by_c3d(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The same by the library c3d, which marks unseen markers by a residual of -1."""
    import c3d

    with path.open("rb") as file:
        reader = c3d.Reader(file)
        assert [label.strip() for label in reader.point_labels][::5] == ["socket_1", "pylon_3"]
        assert [label.strip() for label in reader.analog_labels][::5] == ["Mx", "Fz"]
        assert reader.point_rate == reader.analog_rate == 4.0
        frames = [(points, analog) for _, points, analog in reader.read_frames()]
    points = np.array([points[:, :3] for points, _ in frames], dtype=float)
    points[np.array([points[:, 3] == -1 for points, _ in frames])] = np.nan
    return points, np.array([analog[:, 0] for _, analog in frames])


@pytest.mark.parametrize("reads", [read_by_ezc3d, read_by_c3d])
def test_c3d_is_read_with_its_holes(
    reads: Callable[[Path], tuple[np.ndarray, np.ndarray]], holed: Path, tmp_path: Path
) -> None:
    st.export(holed, tmp_path / "a.c3d")
    points, wrench = reads(tmp_path / "a.c3d")
    assert points.shape == (96, 6, 3) and wrench.shape == (96, 6)
    assert wrench[48] == pytest.approx([0.55, 0.1, 0.5, 14.0, 3.0, -90.0], abs=1e-5)
    assert np.flatnonzero(np.isnan(wrench[:, 5])).tolist() == [0, 40, 41, 42, 43]
    assert np.flatnonzero(np.isnan(wrench[:, 0])).tolist() == [0, 40, 41, 42, 43, 90, 91]
    assert points[48, 0] == pytest.approx([1000.0, 2000.0, 500.0], abs=1e-3)
    assert np.flatnonzero(np.isnan(points[:, 5, 0])).tolist() == [0, 50, 51, 52, 95]
    assert np.isfinite(points[:, :5]).all()


def test_c3d_says_that_it_fills_pauses(holed: Path, tmp_path: Path) -> None:
    """Two samples, at 15.0 s and 15.25 s, were never triggered."""
    paused = holes.without_samples(holed, tmp_path / "paused", 60, 61)
    table = st.export(paused, tmp_path / "a.c3d", "14:16")
    assert table.attrs["notes"] == ("2 empty frames stand for times without samples",)
    assert len(table) == 7 and len(read_by_ezc3d(tmp_path / "a.c3d")[1]) == 9


# --- standard messages


def test_half_a_wrench_keeps_its_numbers(holed: Path, tmp_path: Path) -> None:
    """It is no message of the wrench; its force is still among the numbers by column."""
    st.export(holed, tmp_path / "a.mcap")
    types = get_typestore(Stores.ROS2_JAZZY)
    counts: dict[str, int] = {}
    forces: dict[float, Any] = {}
    with (tmp_path / "a.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if channel.topic == "/Fz_N":
                time = (message.log_time - scene.START) * 1e-9
                forces[time] = types.deserialize_cdr(message.data, schema.name).data
    assert counts["/load_cell/wrench"] == counts["/Mx_N_m"] == 89
    assert counts["/Fz_N"] == 91 and counts["/mocap/pylon/pose"] == 96
    # 1 - cos(2 pi 22.5 / 24) / 2 = 0.53806 of -60 N
    assert forces[22.5] == pytest.approx(-32.2836, abs=1e-3)
