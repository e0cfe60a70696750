"""Motive's CSV exports: ones of every kind, and broken ones."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.motive_takes import Written, motive_lines, write_lines, write_take
from support.problems import SOCKET_TRIAD, random_pose

from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.motive import MotiveTake, read_motive_csv

FIRST_FRAME = 7  # index of its line in formats until 1.22


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture
def scene(rng) -> Written:
    """A body with its triad and a loose marker over 30 frames, some of it occluded."""
    pose = random_pose(rng, 1.0, 30)
    triad = np.array([p.apply(SOCKET_TRIAD) for p in map(Pose, pose.rotation, pose.translation)])
    names = [f"Socket:Marker{i}" for i in (1, 2, 3)]
    markers = dict(
        zip(names, (triad + rng.normal(0.0, 1e-4, triad.shape)).swapaxes(0, 1), strict=True)
    )
    markers["Unlabeled:108"] = rng.uniform(-1.0, 1.0, (30, 3))
    markers["Socket:Marker2"][4:9] = np.nan
    solved = {f"Socket_{i + 1}": triad[:, i] for i in range(3)}
    return Written(markers, solved, {"Socket": pose})


def check(take: MotiveTake, scene: Written, within: float) -> None:
    """The take holds what the scene had, within the digits of the file [m]."""
    assert list(take.markers) == list(scene.markers) and list(take.solved) == list(scene.solved)
    for found, true in ((take.markers, scene.markers), (take.solved, scene.solved)):
        for name, positions in true.items():
            np.testing.assert_allclose(found[name], positions, atol=within)
    for name, pose in scene.bodies.items():
        found = take.body(name).pose
        np.testing.assert_allclose(found.translation, pose.translation, atol=within)
        np.testing.assert_allclose(found.rotation, pose.rotation, atol=3e-6)
        np.testing.assert_allclose(take.body(name).error, 5e-5, atol=within)


@pytest.mark.parametrize("version", ["1.2", "1.20", "1.21", "1.22", "1.23", "1.24", "1.25"])
def test_every_version_is_read(scene, tmp_path, version):
    scene = dataclasses.replace(scene, version=version)
    take = read_motive_csv(write_take(scene, tmp_path / "take.csv"))
    check(take, scene, 1e-6)
    assert take.version == version and take.frame_rate == 120.0 and take.notes == ()
    np.testing.assert_array_equal(take.frames, np.arange(30))
    np.testing.assert_allclose(take.times, np.arange(30) / 120.0, atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "within"), [("Meters", 1e-6), ("Centimeters", 1e-8), ("Millimeters", 1e-9)]
)
def test_lengths_come_in_metres(scene, tmp_path, unit, within):
    scene = dataclasses.replace(scene, unit=unit)
    take = read_motive_csv(write_take(scene, tmp_path / "take.csv"))
    check(take, scene, within)
    assert take.units == unit


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("bom", [False, True])
def test_line_ends_and_byte_order_marks_do_not_matter(scene, tmp_path, newline, bom):
    take = read_motive_csv(write_take(scene, tmp_path / "take.csv", newline, bom))
    check(take, scene, 1e-6)
    assert take.notes == ()


def test_blank_columns_at_the_end_do_not_matter(scene, tmp_path):
    lines = [line + ",,," if line else line for line in motive_lines(scene)]
    take = read_motive_csv(write_lines(lines, tmp_path / "take.csv"))
    check(take, scene, 1e-6)
    assert take.notes == ()


def test_a_time_code_and_bones_are_left_alone(scene, tmp_path):
    lines = motive_lines(dataclasses.replace(scene, version="1.24"))
    extra = [",Bone", ",Hips", ",0A", ",Position", ",X", *[",not read"] * 30]
    codes = ["", "", "", "", "TimeCode", *["15:26:46:12.02"] * 30]
    for i, (bone, code) in enumerate(zip(extra, codes, strict=True), start=2):
        frame, time, *cells = lines[i].split(",")
        lines[i] = ",".join([frame, time, code, *cells]) + bone
    check(read_motive_csv(write_lines(lines, tmp_path / "take.csv")), scene, 1e-6)


def test_a_comma_in_the_name_of_the_take_does_not_shift_the_header(scene, tmp_path):
    lines = motive_lines(dataclasses.replace(scene, unit="Millimeters"))
    lines[0] = lines[0].replace("Take 2024-05-05", "Static, left, 2024-05-05")
    check(read_motive_csv(write_lines(lines, tmp_path / "take.csv")), scene, 1e-9)


def test_q_and_minus_q_are_one_rotation(scene, tmp_path):
    lines = motive_lines(scene)
    for i in range(FIRST_FRAME, len(lines), 2):
        cells = lines[i].split(",")
        cells[2:6] = [f"{-float(cell):.6f}" for cell in cells[2:6]]
        lines[i] = ",".join(cells)
    check(read_motive_csv(write_lines(lines, tmp_path / "take.csv")), scene, 1e-6)


def test_a_body_that_was_lost_has_no_pose(scene, tmp_path):
    lines = motive_lines(scene)
    cells = lines[FIRST_FRAME + 3].split(",")
    cells[2:10] = [""] * 8
    lines[FIRST_FRAME + 3] = ",".join(cells)
    body = read_motive_csv(write_lines(lines, tmp_path / "take.csv")).body("Socket")
    lost = np.isnan(body.pose.rotation).all(axis=(1, 2)) & np.isnan(body.pose.translation).all(1)
    np.testing.assert_array_equal(np.flatnonzero(lost), [3])
    assert np.isnan(body.error[3])


def test_a_newer_version_is_read_with_a_note(scene, tmp_path):
    lines = motive_lines(dataclasses.replace(scene, version="1.25"))
    lines[0] = lines[0].replace("1.25", "1.31")
    take = read_motive_csv(write_lines(lines, tmp_path / "take.csv"))
    check(take, scene, 1e-6)
    assert "1.31" in take.notes[0]


def whole(scene: Written, tmp_path: Path) -> bytes:
    return write_take(scene, tmp_path / "whole.csv").read_bytes()


@pytest.mark.parametrize("lost", [1, 2, 4, 30, 200])
def test_a_take_that_was_cut_short_keeps_its_whole_frames(scene, tmp_path, lost):
    path = tmp_path / "take.csv"
    path.write_bytes(whole(scene, tmp_path)[:-lost])
    take = read_motive_csv(path)
    # What lost its line end may have lost digits, too; a lone carriage return is an end.
    kept = 30 if lost == 1 else 29
    assert len(take) == kept
    np.testing.assert_allclose(
        take.markers["Unlabeled:108"], scene.markers["Unlabeled:108"][:kept], atol=1e-6
    )
    assert (lost == 1) or ("cut short" in take.notes[0] and "30 were exported" in take.notes[1])


def test_a_last_line_with_too_few_columns_is_left_out(scene, tmp_path):
    lines = motive_lines(scene)
    lines[-1] = lines[-1][:40]
    take = read_motive_csv(write_lines(lines, tmp_path / "take.csv"))
    assert (
        len(take) == 29 and "cut short" in take.notes[0] and f"line {len(lines)}" in take.notes[0]
    )


def test_what_is_asked_for_and_not_there_is_named(scene, tmp_path):
    take = read_motive_csv(write_take(scene, tmp_path / "take.csv"))
    with pytest.raises(RegistrationError, match="no rigid body 'Pylon'") as caught:
        take.body("Pylon")
    assert "Socket" in caught.value.hint
    with pytest.raises(RegistrationError, match="no marker 'Sockt:Marker1'") as caught:
        take.stack(["Sockt:Marker1"])
    assert "did you mean 'Socket:Marker1'" in caught.value.hint
    with pytest.raises(RegistrationError, match="no marker 'LC1'") as caught:
        take.stack(["LC1"])
    assert "Socket:Marker3" in caught.value.hint and "108" not in caught.value.hint
    with pytest.raises(RegistrationError, match="not a measured one"):
        take.stack(["Socket_2"])


def test_measured_and_solved_markers_of_one_name_are_kept_apart(scene, tmp_path):
    """So they are called since format 1.22."""
    names = [name for name in scene.markers if name.startswith("Socket:")]
    solved = dict(zip(names, scene.solved.values(), strict=True))
    scene = dataclasses.replace(scene, solved=solved, version="1.23")
    check(read_motive_csv(write_take(scene, tmp_path / "take.csv")), scene, 1e-6)


def test_a_name_that_stands_twice_is_not_read(scene, tmp_path):
    lines = motive_lines(scene)
    lines[3] = lines[3].replace("Socket:Marker3", "Socket:Marker1")
    take = read_motive_csv(write_lines(lines, tmp_path / "take.csv"))
    assert "Socket:Marker1" not in take.markers and "Socket:Marker2" in take.markers
    with pytest.raises(RegistrationError, match="'Socket:Marker1' occurs twice"):
        take.stack(["Socket:Marker1"])


def replace_cell(line: int, column: int, cell: str):
    def change(lines: list[str]) -> list[str]:
        cells = lines[line].split(",")
        cells[column] = cell
        return [*lines[:line], ",".join(cells), *lines[line + 1 :]]

    return change


def replace_text(old: str, new: str):
    return lambda lines: [line.replace(old, new) for line in lines]


only_bodies = replace_text("Marker", "M")


def exchange(line: int):
    return lambda lines: [*lines[:line], lines[line + 1], lines[line], *lines[line + 2 :]]


@pytest.mark.parametrize(
    ("change", "fact", "hint"),
    [
        (lambda lines: [], "is empty", "export"),
        (lambda lines: [""] * 3, "is empty", "export"),
        (lambda lines: ["x,y,z", "1,2,3"], "not a Motive export", "header information"),
        (lambda lines: lines[FIRST_FRAME - 1 :], "not a Motive export", "header information"),
        (lambda lines: lines[:1], "no rows of types", "header information"),
        (lambda lines: lines[:1] + lines[6:], "no rows of types", "header information"),
        (lambda lines: lines[:FIRST_FRAME], "holds no frame", "export"),
        (replace_text("Length Units,Meters", "Length,Meters"), "'Length Units'", "export"),
        (replace_text("Rotation Type,Quaternion,", ""), "'Rotation Type'", "export"),
        (replace_text("Frame Rate,120.000000", "Rate,120"), "no frame rate", "export"),
        (replace_text("Frame Rate,120.000000", "Frame Rate,0"), "no frame rate", "export"),
        (replace_text("Quaternion", "XYZ"), "type XYZ", "export quaternions"),
        (replace_text(",Meters", ",Furlongs"), "'Furlongs'", "metres"),
        (replace_text("Global", "Local"), "'Local'", "global"),
        (replace_text("Version,1.21", "Version,1.1"), "version 1.1", "1.20 to 1.25"),
        (replace_text("Version,1.21", "Version,new"), "version new", "1.20 to 1.25"),
        (lambda lines: replace_text("Rigid Body", "B")(only_bodies(lines)), "neither", "markers"),
        (replace_cell(6, 5, "Q"), "rigid body 'Socket' has no column Rotation W", "all its"),
        (replace_cell(6, 22, "U"), "no column Position X", "all its"),
        (replace_cell(10, 7, "O.5"), "line 11, column 8 (Rigid Body Socket, Position", "number"),
        (replace_cell(10, 7, "inf"), "line 11, column 8", "number"),
        (replace_cell(12, 9, "-"), "(Rigid Body Socket, Error Per Marker) holds", "number"),
        (replace_cell(12, 23, "1e"), "line 13, column 24 (Marker Socket:Marker1", "number"),
        (replace_cell(9, 0, "x"), "line 10, column 1 (frame) holds 'x'", "number"),
        (replace_cell(9, 0, ""), "line 10: the frame does not follow", "export"),
        (replace_cell(9, 0, "1"), "line 10: the frame does not follow", "export"),
        (replace_cell(9, 1, "0.0"), "line 10: the time does not follow", "export"),
        (exchange(9), "line 11: the frame does not follow", "export"),
        (replace_cell(11, 2, "7.0"), "line 12: the quaternion of 'Socket'", "export"),
        (lambda lines: [*lines[:9], lines[9] + ",1.0", *lines[10:]], "line 10 has", "export"),
        (lambda lines: [*lines[:9], lines[9][:30], *lines[10:]], "line 10 has", "export"),
        (replace_text("Total", "x" * 140_000), "line 1 is not CSV", "export"),
    ],
)
def test_a_bad_file_is_named_with_its_place_and_the_hint(scene, tmp_path, change, fact, hint):
    path = write_lines(change(motive_lines(scene)), tmp_path / "take.csv")
    with pytest.raises(RegistrationError) as caught:
        read_motive_csv(path)
    assert str(path) in caught.value.fact and fact in caught.value.fact
    assert hint in caught.value.hint
    assert "\n" not in str(caught.value)


def test_what_is_no_text_or_not_there_is_named(tmp_path):
    path = tmp_path / "take.csv"
    with pytest.raises(RegistrationError, match="no such file"):
        read_motive_csv(path)
    path.write_bytes(b"Format Version,1.21\xff\xfe\x00")
    with pytest.raises(RegistrationError, match="not UTF-8 text"):
        read_motive_csv(path)
    with pytest.raises(RegistrationError, match="cannot be read"):
        read_motive_csv(tmp_path)


def test_a_damaged_file_is_refused_or_read_but_never_crashes(rng, scene, tmp_path):
    whole = write_take(scene, tmp_path / "take.csv").read_bytes()
    outcomes = set()
    for _ in range(300):
        damaged = bytearray(whole)
        start, length = rng.integers(len(whole)), rng.integers(1, 40)
        damaged[start : start + length] = rng.bytes(int(rng.integers(3)))
        (tmp_path / "take.csv").write_bytes(bytes(damaged))
        try:
            outcomes.add(len(read_motive_csv(tmp_path / "take.csv")) > 0)
        except RegistrationError as error:
            outcomes.add(str(error).startswith(str(tmp_path)) and "\n" not in str(error))
    assert outcomes == {True}
