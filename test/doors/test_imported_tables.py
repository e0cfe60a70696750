"""Tables of other sensors become a trial: values, units, clocks and refusals by hand."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.foreign import ForeignLab, course_of, simulate_foreign, write_tables
from support.takes import Written, write_take
from support.verbs import call
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.trials.trial import Trial

ROWS = 241  # two seconds at 120 Hz, as the take
NAMES = ("brim_lateral", "distal")
START_2000 = 946_684_800_000_000_000  # [ns]
QUATERNION = np.array([0.0, 0.0, 0.6, 0.8])


def cell(path: Path, start: float = 0.0) -> Path:
    """Fz falls by 1 N in 10 ms, from -100 N at its own time `start` [s]; moments in N mm."""
    rows = [f"{start + 0.01 * k:.2f};10;20;{-100 - k};1000;2000;3000" for k in range(201)]
    titles = "Time (s);Fx (N);Fy (N);Fz (N);Mx (N mm);My (N mm);Mz (N mm)"
    path.write_text("\n".join([titles, *rows, ""]))
    return path


def capacitances(path: Path, start: int = 0) -> Path:
    """All rise by 0.001 pF in 10 ms, from 5.0, 5.1, ... pF at its own time `start` [ms]."""
    titles = ",".join(f"{name}.{k} [pF]" for name in NAMES for k in range(4))
    rows = []
    for row in range(41):  # at 20 Hz
        values = np.arange(5.0, 5.75, 0.1) + 0.005 * row
        rows.append(f"{start + 50 * row}," + ",".join(f"{value:.4f}" for value in values))
    path.write_text("\n".join([f"time [ms],{titles}", *rows, ""]))
    return path


def moving() -> Pose:
    """A pose that moves by 1 mm in 10 ms along x."""
    seconds = np.arange(ROWS) / 120.0
    places = np.column_stack([0.1 * seconds, np.full((ROWS, 2), [0.2, 0.3])])
    return Pose.from_quaternion(places, np.tile(QUATERNION, (ROWS, 1)))


def take(path: Path, *names: str, unit: str = "Millimeters") -> Path:
    bodies = {name: moving() for name in names or ("Socket", "Pylon")}
    extra = {"extra": np.zeros((ROWS, 3))}
    return write_take(Written(extra, {}, bodies, "1.23", unit), path)


def opened(path: Path, *files: Path, **options: Any) -> tuple[Trial, list[str]]:
    """The trial that tables become, and the notes."""
    notes: list[str] = []
    trial = st.import_trial([*files], path / "trial", notify=notes.append, **options)
    return trial, notes


def three(path: Path) -> list[Path]:
    """Three tables that start together: the cell at 3 s, the take at 0, capacitances at 7 s."""
    return [
        cell(path / "cell.csv", 3.0),
        take(path / "take.csv"),
        capacitances(path / "caps.csv", 7000),
    ]


OFFSETS = {"socket_pose": 3.0, "clusters": -4.0}


def test_three_tables_become_a_trial(tmp_path: Path) -> None:
    """At 0, 0.25, ... 2 s of the common clock, which counts as that of the cell."""
    trial, notes = opened(tmp_path, *three(tmp_path), offset=OFFSETS)
    measured = trial.measurements()
    times = measured.stamps - START_2000
    assert times.tolist() == [3_000_000_000 + 250_000_000 * k for k in range(9)]
    for row in range(9):
        expected = [1.0, 2.0, 3.0, 10.0, 20.0, -100.0 - 25.0 * row]
        np.testing.assert_allclose(measured.wrench[row], expected, atol=1e-9)
    np.testing.assert_allclose(
        measured.capacitance[4, 1], np.array([5.4, 5.5, 5.6, 5.7]) + 0.1, atol=1e-9
    )
    np.testing.assert_allclose(measured.pylon[4, :3], [0.1, 0.2, 0.3], atol=1e-6)
    assert any("2000-01-01" in note for note in notes)


def test_the_tables_stay_in_the_trial(tmp_path: Path) -> None:
    files = three(tmp_path)
    opened(tmp_path, *files, offset=OFFSETS)
    for file in files:
        copy = tmp_path / "trial" / "originals" / file.name
        assert copy.read_bytes() == file.read_bytes()
    record = yaml.safe_load((tmp_path / "trial" / "import.yaml").read_text())
    assert record["files"] == ["cell.csv", "take.csv", "caps.csv"]
    assert record["clocks"]["take.csv"] == {"offset": 3.0, "how": "stated"}
    assert record["wrench"]["topic"] == "cell.csv"
    assert record["pylon_pose"]["topic"] == "take.csv:Pylon"


def test_dated_tables_need_no_offset(tmp_path: Path) -> None:
    cell_file = cell(tmp_path / "cell.csv", 1_714_910_400.0)
    caps_file = capacitances(tmp_path / "caps.csv", 1_714_910_400_000)
    trial, _ = opened(tmp_path, cell_file, caps_file)
    assert trial.measurements().stamps[0] == 1_714_910_400_000_000_000


def test_the_verb_makes_a_trial_of_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(file) for file in three(tmp_path)]
    offsets = ["--offset", "socket_pose=3", "clusters=-4"]
    code, out, _ = call(capsys, "import", *files, "-o", tmp_path / "trial", *offsets)
    assert code == 0
    assert "9 samples in 2.00 s, 2 clusters" in out


def test_one_table_is_enough(tmp_path: Path) -> None:
    trial, notes = opened(tmp_path, cell(tmp_path / "cell.csv"))
    last = trial.measurements().wrench[-1]
    np.testing.assert_allclose(last, [1.0, 2.0, 3.0, 10.0, 20.0, -300.0], atol=1e-9)
    assert any("no clusters" in note for note in notes)


def test_one_table_may_hold_load_and_clusters(tmp_path: Path) -> None:
    """Both have one clock, of 2 s at 100 Hz."""
    titles = "time [s],Fx [N],Fy [N],Fz [N],Mx [Nm],My [Nm],Mz [Nm]"
    titles += "".join(f",distal.{k} [pF]" for k in range(4))
    rows = [f"{0.01 * k:.2f},1,2,-3,4,5,6,5.0,5.1,5.2,5.3" for k in range(201)]
    file = tmp_path / "daq.csv"
    file.write_text("\n".join([titles, *rows, ""]))
    measured = opened(tmp_path, file)[0].measurements()
    np.testing.assert_allclose(measured.wrench[4], [4, 5, 6, 1, 2, -3])
    np.testing.assert_allclose(measured.capacitance[4, 0], [5.0, 5.1, 5.2, 5.3])


def test_one_table_may_hold_everything(tmp_path: Path) -> None:
    """A table of all topics, at times since 1970; no offset is needed."""
    titles = ["stamp [s]", *(f"/ft/force.{axis} [N]" for axis in "xyz")]
    titles += [f"/ft/torque.{axis} [N m]" for axis in "xyz"]
    for body in ("socket", "limb"):
        titles += [f"/{body}/pose.position.{axis} [m]" for axis in "xyz"]
        titles += [f"/{body}/pose.orientation.{axis}" for axis in "xyzw"]
    titles += [f"distal.{k} [pF]" for k in range(4)]
    pose = "0.1,0.2,0.3,0,0,0.6,0.8"
    rows = [
        f"{1_714_910_400 + 0.01 * k:.2f},1,2,-3,4,5,6,{pose},{pose},5.0,5.1,5.2,5.3"
        for k in range(201)
    ]
    file = tmp_path / "topics.csv"
    file.write_text("\n".join([",".join(titles), *rows, ""]))
    trial, notes = opened(tmp_path, file)
    measured = trial.measurements()
    assert measured.stamps[0] == 1_714_910_400_000_000_000
    np.testing.assert_allclose(measured.wrench[4], [4, 5, 6, 1, 2, -3])
    np.testing.assert_allclose(measured.pylon[4], [0.1, 0.2, 0.3, 0, 0, 0.6, 0.8])
    np.testing.assert_allclose(measured.capacitance[4, 0], [5.0, 5.1, 5.2, 5.3])
    assert not any("2000-01-01" in note for note in notes)


def test_columns_units_and_rates_are_stated(tmp_path: Path) -> None:
    """Fz in kN falls by 1 N in 10 ms from -100 N, without times: -200 N after a second."""
    path = tmp_path / "cell.csv"
    rows = [f"0.01,0.02,{-0.1 - 1e-3 * k:.3f},1,2,3" for k in range(201)]
    path.write_text("\n".join(["a,b,c,d,e,f", *rows, ""]))
    trial, _ = opened(
        tmp_path,
        path,
        columns=dict(zip(("Fx", "Fy", "Fz", "Mx", "My", "Mz"), "abcdef", strict=True)),
        units={"force": "kN", "moment": "N m"},
        row_rate={"wrench": 100.0},
    )
    wrench = trial.samples().wrench
    np.testing.assert_allclose(wrench[4], [1, 2, 3, 10, 20, -200], atol=1e-6)  # at 1 s


def test_an_offset_corrects_a_date(tmp_path: Path) -> None:
    """The clusters' clock is 100 s late; the trial has the dates of the load cell."""
    cell_file = cell(tmp_path / "cell.csv", 1_714_910_400.0)
    caps_file = capacitances(tmp_path / "caps.csv", 1_714_910_500_000)
    trial, _ = opened(tmp_path, cell_file, caps_file, offset={"clusters": -100.0})
    measured = trial.measurements()
    assert measured.stamps[0] == 1_714_910_400_000_000_000
    np.testing.assert_allclose(measured.capacitance[4, 1, 0], 5.5, atol=1e-9)


def test_a_dated_table_beside_one_without_dates(tmp_path: Path) -> None:
    """The take starts 0.5 s after the load cell's first row."""
    cell_file = cell(tmp_path / "cell.csv", 1_714_910_400.0)
    file = take(tmp_path / "take.csv")
    with refused(ConfigurationError, "take.csv has a clock of its own"):
        opened(tmp_path, cell_file, file)
    trial, _ = opened(tmp_path, cell_file, file, offset={"pylon_pose": 0.5})
    measured = trial.measurements()
    assert measured.stamps[0] == 1_714_910_400_500_000_000
    np.testing.assert_allclose(measured.wrench[0, 5], -150.0)
    np.testing.assert_allclose(measured.pylon[2, 0], 0.05, atol=1e-6)


def test_a_table_that_is_too_short(tmp_path: Path) -> None:
    file = cell(tmp_path / "cell.csv")
    file.write_text("".join(line + "\n" for line in file.read_text().split("\n")[:3]))
    with refused(TrialError, "the wrench lasts 0.01 s, too little at 4 Hz"):
        opened(tmp_path, file)


def test_bodies_are_named_where_names_do_not_tell(tmp_path: Path) -> None:
    file = take(tmp_path / "take.csv", "A", "B")
    trial, _ = opened(tmp_path, file, socket_pose="A", pylon_pose="take.csv:B")
    measured = trial.measurements()
    np.testing.assert_allclose(measured.socket[4], [0.1, 0.2, 0.3, 0, 0, 0.6, 0.8], atol=1e-6)
    np.testing.assert_allclose(measured.pylon, measured.socket)


def test_tables_are_imported_like_others(tmp_path: Path) -> None:
    """Under other names, with the bodies, columns, units and offsets of the first ones."""
    load = cell(tmp_path / "cell.csv", 3.0)
    load.write_text(load.read_text().replace("Fx (N)", "Ch1"))
    files = [load, take(tmp_path / "take.csv", "A", "B")]
    model, _ = opened(
        tmp_path, *files, socket_pose="A", pylon_pose="take.csv:B", columns=["Fx=Ch1"],
        units=["force=N"], offset=["socket_pose=3"], rate=10.0,
    )  # fmt: skip
    others = [file.rename(file.with_stem(f"{file.stem}_02")) for file in files]
    trial = st.import_trial(others, tmp_path / "like", like=model.path, notify=print)
    np.testing.assert_array_equal(trial.measurements().wrench, model.measurements().wrench)
    np.testing.assert_array_equal(trial.measurements().pylon, model.measurements().pylon)
    record = yaml.safe_load((trial.path / "import.yaml").read_text())
    assert record["mapping"] == {
        "socket_pose": {"topic": "A", "offset": 3.0}, "pylon_pose": {"topic": "B"},
        "rate": 10.0, "columns": {"Fx": "Ch1"}, "units": {"force": "N"},
    }  # fmt: skip


def test_markers_are_fitted_to_the_socket(tmp_path: Path) -> None:
    """Markers of socket.yaml, moved by 1 mm in 10 ms without turning."""
    bodies = read_socket(packaged("config", "socket.yaml")).markers
    shift = np.column_stack([0.1 * np.arange(ROWS) / 120.0, np.full((ROWS, 2), [0.2, 0.3])])
    markers = {
        f"{title}:Marker{k + 1}": marker + shift
        for title, body in (("Socket", "socket"), ("Limb", "pylon"))
        for k, marker in enumerate(bodies[body])
    }
    file = write_take(Written(markers, unit="Meters"), tmp_path / "take.csv")
    trial, notes = opened(tmp_path, file)
    pose = trial.measurements().pylon[4]
    np.testing.assert_allclose(pose[:3], [0.1, 0.2, 0.3], atol=2e-6)
    np.testing.assert_allclose(np.abs(pose[3:]), [0, 0, 0, 1], atol=1e-4)
    assert any("'Limb' is fitted to the markers of socket.yaml" in note for note in notes)


SPAN = "give seconds as T0:T1, the earlier first, such as 12.5:60"
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "another source": (
        {"offset": ["cell=1"]},
        "offset names 'cell': use one of clusters, pylon_pose, socket_pose, wrench",
    ),
    "no file": (
        {"wrench": "cel.csv"},
        "cel.csv of --wrench is none of the tables: did you mean 'cell.csv'?",
    ),
    "no body": (
        {"socket_pose": "take.csv:Shank"},
        "take.csv: has no body or marker 'Shank': use one of Pylon, Socket, extra",
    ),
    "a topic": (
        {"trigger": "/trigger"},
        "tables hold no topic for --trigger: give --rate instead",
    ),
    "no title": (
        {"columns": {"Fx": "Ch1"}},
        "no column is called 'Ch1', named for Fx, in cell.csv, caps.csv: check its title",
    ),
    "no column": (
        {"columns": {"force": "Fx"}},
        "columns names 'force': name time, Fx to Mz, or a channel such as distal.0",
    ),
    "no unit": (
        {"units": {"force": "V"}},
        "'V' is no unit of force: use one of N, newton, newtons, kN, mN, lbf, lb, lbs, kgf",
    ),
    "no quantity": ({"units": {"forces": "N"}}, "units names 'forces': did you mean 'force'?"),
    "a tap for nothing": (
        {"tap": "0:5"},
        "--tap is given, and no offset is to be found from a tap: give --offset SOURCE=tap too, or"
        " leave it out",
    ),
    "a tap that ends early": ({"tap": (5, 1)}, f"--tap is '5:1': {SPAN}"),
    "one number of a tap": ({"tap": 5}, f"--tap is '5': {SPAN}"),
    "two offsets": (
        {"offset": {"socket_pose": 3, "pylon_pose": 4, "clusters": -4}},
        "take.csv has one clock, and the offsets 3, 4 s: state one offset for its sources",
    ),
    "no offset of a take": (
        {"offset": {}},
        "take.csv has a clock of its own: state what to add to its times with --offset"
        " socket_pose=S, counted as those of cell.csv, or S=tap if both see a tap",
    ),
    "no offset": (
        {"offset": {"socket_pose": 3}},
        "caps.csv has a clock of its own: state what to add to its times with --offset clusters=S,"
        " counted as those of cell.csv, or S=tap if both see a tap",
    ),
    "one left over": (
        {"wrench": "none", "offset": OFFSETS},
        "cell.csv: is none of the sources (it has 'Time (s)', 'Fx (N)', 'Fy (N)', 'Fz (N)',"
        " 'Mx (N mm)', 'My (N mm)', 'Mz (N mm)'): state what it is, such as --wrench cell.csv, or"
        " leave it out",
    ),
    "a take of clusters": (
        {"clusters": "take.csv", "offset": OFFSETS},
        "caps.csv: is none of the sources (it has 'time [ms]', 'brim_lateral.0 [pF]',"
        " 'brim_lateral.1 [pF]', 'brim_lateral.2 [pF]', 'brim_lateral.3 [pF]', 'distal.0 [pF]',"
        " 'distal.1 [pF]', 'distal.2 [pF]', 'distal.3 [pF]'): state what it is, such as --wrench"
        " caps.csv, or leave it out",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_option_for_tables(tmp_path: Path, kind: str) -> None:
    options, line = WRONG[kind]
    with pytest.raises(st.TestbedError) as caught:
        opened(tmp_path, *three(tmp_path), **{"offset": OFFSETS, **options})
    assert str(caught.value) == line
    assert not (tmp_path / "trial").exists()


UNCLEAR: dict[str, tuple[tuple[str, ...], dict[str, Any], str]] = {
    "two load cells": (
        ("cell.csv", "cell2.csv"),
        {},
        "cell.csv, cell2.csv may each be the wrench: choose with --wrench FILE, or leave it out"
        " with --wrench none",
    ),
    "two bodies": (
        ("A", "B"),
        {},
        "take.csv: cannot tell whose pose A, B is: state it with --socket-pose take.csv:BODY and"
        " --pylon-pose take.csv:BODY, or none instead of a body",
    ),
    "the other body": (
        ("A", "B"),
        {"socket_pose": "A"},
        "take.csv: cannot tell whose pose B is: state it with --pylon-pose take.csv:BODY, or none"
        " instead of a body",
    ),
    "a file of two": (
        ("A", "B"),
        {"socket_pose": "take.csv"},
        "take.csv: cannot tell which body is the socket pose (it has A, B): name it with"
        " --socket-pose take.csv:BODY",
    ),
    "two sockets": (
        ("Socket", "Socket 2", "Pylon"),
        {},
        "take.csv: Socket, Socket 2 may each be the socket pose: choose with --socket-pose"
        " take.csv:BODY",
    ),
    "a take of forces": (
        ("Socket", "Pylon"),
        {"wrench": "take.csv"},
        "take.csv: is a take of motion capture, not the wrench: name another file with --wrench",
    ),
    "no poses": (
        ("cell.csv",),
        {"socket_pose": "cell.csv"},
        "cell.csv: holds no poses, for --socket-pose: export a take with its header, or columns"
        " such as 'socket.x [m]' to 'socket.qw'",
    ),
}


@pytest.mark.parametrize("case", UNCLEAR)
def test_what_is_what_is_asked_for(case: str, tmp_path: Path) -> None:
    names, options, line = UNCLEAR[case]
    files = [cell(tmp_path / name) for name in names if name.endswith(".csv")]
    with pytest.raises(st.TestbedError) as caught:
        opened(tmp_path, *(files or [take(tmp_path / "take.csv", *names)]), **options)
    assert str(caught.value) == line


def test_tables_are_noted_with_rates_and_clocks(tmp_path: Path) -> None:
    _, notes = opened(tmp_path, *three(tmp_path), offset=OFFSETS)
    of_motive = "is that of Motive's rigid body: socket.yaml must state its place"
    assert notes == [
        "clocks: cell.csv +0 s (reference), take.csv +3 s (stated), caps.csv -4 s (stated)",
        "cell.csv tells no date: the trial's times count from 2000-01-01",
        "wrench: cell.csv (table, 201 readings at 100 Hz)",
        "socket pose: take.csv:Socket (Motive take, 241 readings at 120 Hz, frame world)",
        f"take.csv: the pose of 'Socket' {of_motive}",
        "pylon pose: take.csv:Pylon (Motive take, 241 readings at 120 Hz, frame world)",
        f"take.csv: the pose of 'Pylon' {of_motive}",
        "clusters: caps.csv (table, 41 readings at 20 Hz)",
    ]


def test_tables_are_not_mixed_with_bags(tmp_path: Path) -> None:
    with refused(TrialError, "is no table"):
        opened(tmp_path, cell(tmp_path / "cell.csv"), tmp_path / "bag")


OF_TABLES: dict[str, dict[str, Any]] = {
    "offset": {"offset": {"wrench": 1}},
    "row-rate": {"row_rate": ["wrench=100"]},
    "columns": {"columns": {"Fx": "Ch1"}},
    "units": {"units": ["force=N"]},
    "tap": {"tap": "0:5"},
}


@pytest.mark.parametrize("option", OF_TABLES)
def test_a_bag_takes_no_option_of_tables(tmp_path: Path, option: str) -> None:
    with refused(ConfigurationError, f"--{option} is for tables"):
        st.import_trial(tmp_path / "bag", tmp_path / "trial", **OF_TABLES[option])


def test_a_file_that_is_nothing(tmp_path: Path) -> None:
    other = tmp_path / "emg.csv"
    other.write_text("time [s],EMG1 [mV],EMG2 [mV]\n0,1,2\n1,2,3\n")
    with refused(TrialError, "emg.csv: is none of the sources", "'EMG1 [mV]'"):
        opened(tmp_path, cell(tmp_path / "cell.csv"), other)


def tapped(path: Path, start: float, rate: float, size: float, what: str) -> Path:
    """A table of a source that feels a tap 1.2 s after the others' start; its clock is `start`."""
    since = np.arange(0.0, 10.0, 1.0 / rate)
    random = np.random.default_rng(round(rate))
    course = size * np.where(since < 1.2, 0.0, np.exp(-(since - 1.2) / 0.1))
    course += random.normal(0.0, 1e-3 * abs(size), len(since))
    if what == "wrench":
        rows = [f"{start + t:.4f},0,0,0,0,0,{v:.4f}" for t, v in zip(since, course, strict=True)]
        titles = "time [s],Mx [Nm],My [Nm],Mz [Nm],Fx [N],Fy [N],Fz [N]"
    else:
        titles = "time [s]," + ",".join(f"distal.{k} [pF]" for k in range(4))
        rows = [
            f"{start + t:.4f},{5 + v:.5f},{5 + v:.5f},5,5"
            for t, v in zip(since, course, strict=True)
        ]
    path.write_text("\n".join([titles, *rows, ""]))
    return path


def test_a_tap_brings_tables_together(tmp_path: Path) -> None:
    """The cell's clock is 3 s, that of the clusters 7 s, when both start."""
    files = (
        tapped(tmp_path / "cell.csv", 3.0, 500.0, -60.0, "wrench"),
        tapped(tmp_path / "caps.csv", 7.0, 20.0, 0.5, "clusters"),
    )
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("clusters: {offset: tap}\n")
    _, notes = opened(tmp_path, *files, mapping=mapping, tap="0:5")
    record = yaml.safe_load((tmp_path / "trial" / "import.yaml").read_text())
    found = record["clocks"]["caps.csv"]
    assert found["how"] == "tap"
    assert found["error"] == pytest.approx(np.hypot(0.001, 0.025), abs=1e-6)
    assert abs(found["offset"] + 4.0) <= found["error"]
    assert any("caps.csv -3.9" in note or "caps.csv -4" in note for note in notes)


def test_a_tap_corrects_a_date(tmp_path: Path) -> None:
    """Both clocks tell the date; that of the clusters is 4 s ahead."""
    files = (
        tapped(tmp_path / "cell.csv", 1_714_910_400.0, 500.0, -60.0, "wrench"),
        tapped(tmp_path / "caps.csv", 1_714_910_404.0, 20.0, 0.5, "clusters"),
    )
    trial, _ = opened(tmp_path, *files, offset=["clusters=tap"])
    record = yaml.safe_load((tmp_path / "trial" / "import.yaml").read_text())
    assert abs(record["clocks"]["caps.csv"]["offset"] + 4.0) <= 0.026
    assert abs(trial.measurements().stamps[0] - 1_714_910_400_000_000_000) <= 30_000_000


def test_a_tap_that_nobody_saw(tmp_path: Path) -> None:
    with refused(TrialError, "cell.csv: sees no tap"):
        opened(tmp_path, *three(tmp_path), offset={**OFFSETS, "clusters": "tap"})


def test_a_mapping_with_another_word_for_an_offset(tmp_path: Path) -> None:
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("clusters: {offset: knock}\n")
    with refused(ConfigurationError, "mapping.yaml: clusters: offset is 'knock'"):
        opened(tmp_path, *three(tmp_path), mapping=mapping)


def test_the_mapping_states_what_options_do(tmp_path: Path) -> None:
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(
        "socket_pose:\n  offset: 3\nclusters:\n  offset: -4\n  topic: caps.csv\nrate: 2\n"
    )
    trial, _ = opened(tmp_path, *three(tmp_path), mapping=mapping)
    assert len(trial.measurements().stamps) == 5


@pytest.mark.slow
def test_a_fit_reads_a_trial_of_tables(tmp_path: Path) -> None:
    """Forces are those of the simulation within its noise, and of the fit within 2 N."""
    lab = ForeignLab(wrench_delay=0.0, jitter=0.0, pose_drift=0.0)
    truth = simulate_foreign(tmp_path / "bag", "protocol", 60.0, 0, lab)
    files = write_tables(tmp_path, truth, (-3.0, 0.0, -7.0), lab)
    trial, _ = opened(tmp_path, *files, offset=OFFSETS)
    measured = trial.measurements()
    since = (measured.stamps - measured.stamps[0]) * 1e-9
    error = (measured.wrench - course_of(truth, truth.truth.wrench, since))[:, 3:]
    assert np.sqrt(np.nanmean(error**2)) < 0.5
    text = str(st.fit(trial))
    predicted = re.search(r"mean force RMSE ([\d.]+) N", text)
    assert predicted is not None and float(predicted[1]) < 2.0
