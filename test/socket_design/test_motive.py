"""Motive's CSV exports: of every version, broken, and of a real system."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.motive_takes import UNITS, Written, motive_lines, write_lines, write_take
from support.problems import SOCKET_TRIAD, random_pose
from support.wording import refused

from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.motive import MotiveTake, read_motive_csv

FIRST_FRAME = 7  # index of its line in formats until 1.22


@pytest.fixture
def scene() -> Written:
    """A body with its triad and a loose marker over 30 frames, some of it occluded."""
    rng = np.random.default_rng(5)
    pose = random_pose(rng, 1.0, 30)
    triad = np.array([p.apply(SOCKET_TRIAD) for p in map(Pose, pose.rotation, pose.translation)])
    noisy = (triad + rng.normal(0.0, 1e-4, triad.shape)).swapaxes(0, 1)
    markers = {f"Socket:Marker{i + 1}": noisy[i] for i in range(3)}
    markers["Unlabeled:108"] = rng.uniform(-1.0, 1.0, (30, 3))
    markers["Socket:Marker2"][4:9] = np.nan
    solved = {f"Socket_{i + 1}": triad[:, i] for i in range(3)}
    return Written(markers, solved, {"Socket": pose})


def read(lines: list[str], folder: Path) -> MotiveTake:
    return read_motive_csv(write_lines(lines, folder / "take.csv"))


def check(take: MotiveTake, scene: Written, within: float = 1e-6) -> None:
    """The take holds all of the scene, within the digits of the file [m]."""
    for found, true in ((take.markers, scene.markers), (take.solved, scene.solved)):
        assert list(found) == list(true)
        for name, positions in true.items():
            np.testing.assert_allclose(found[name], positions, atol=within)
    for name, pose in scene.bodies.items():
        np.testing.assert_allclose(take.body(name).translation, pose.translation, atol=within)
        np.testing.assert_allclose(take.body(name).rotation, pose.rotation, atol=3e-6)
    np.testing.assert_array_equal(take.frames, np.arange(30))
    np.testing.assert_allclose(take.times, np.arange(30) / 120.0, atol=1e-6)
    assert take.notes == () and take.frame_rate == 120.0


def test_every_version_unit_and_line_end_is_read(scene, tmp_path):
    path = tmp_path / "take.csv"
    for version in ("1.2", "1.20", "1.21", "1.22", "1.23", "1.24", "1.25"):
        check(read_motive_csv(write_take(replace(scene, version=version), path)), scene)
    for unit, metres in UNITS.items():
        take = read_motive_csv(write_take(replace(scene, unit=unit), path))
        check(take, scene, 1e-6 * metres)
    check(read_motive_csv(write_lines(motive_lines(scene), path, "\n", "utf-8-sig")), scene)
    newer = read_motive_csv(write_take(replace(scene, version="1.31"), path))
    assert "1.31" in newer.notes[0] and len(newer) == 30


def test_what_is_not_needed_and_the_sign_of_q_do_not_matter_and_a_lost_body_has_no_pose(
    scene, tmp_path
):
    lines = motive_lines(replace(scene, version="1.24"))
    extra = [",Bone", ",Hips", ",0A", ",Position", ",X", *[",not read"] * 30]
    codes = ["", "", "", "", "TimeCode", *["15:26:46:12.02"] * 30]
    for i, (bone, code) in enumerate(zip(extra, codes, strict=True), start=2):
        frame, time, *cells = lines[i].split(",")
        if i >= FIRST_FRAME and i % 2:
            cells[:4] = [f"{-float(cell):.6f}" for cell in cells[:4]]
        lines[i] = ",".join([frame, time, code, *cells]) + bone + ",,,"
    # A comma in the name of the take shifts the pairs of the header.
    lines[0] = lines[0].replace("Take 2024-05-05", "Static, left, 2024-05-05")
    check(read(lines, tmp_path), scene)
    cells = lines[FIRST_FRAME + 3].split(",")
    lines[FIRST_FRAME + 3] = ",".join([*cells[:3], *[""] * 8, *cells[11:]])
    pose = read(lines, tmp_path).body("Socket")
    lost = np.isnan(pose.rotation).all(axis=(1, 2)) & np.isnan(pose.translation).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), [3])


def test_a_take_that_was_cut_short_keeps_its_whole_frames(scene, tmp_path):
    path = tmp_path / "take.csv"
    whole = write_take(scene, path).read_bytes()
    for lost in (1, 2, 30, 200):
        path.write_bytes(whole[:-lost])
        take = read_motive_csv(path)
        # Without its line end it may have lost digits, too; a lone carriage return is an end.
        kept = 30 if lost == 1 else 29
        expected = scene.markers["Unlabeled:108"][:kept]
        np.testing.assert_allclose(take.markers["Unlabeled:108"], expected, atol=1e-6)
        assert lost == 1 or ("cut short" in take.notes[0] and "30 were exported" in take.notes[1])


def test_missing_and_doubled_names_are_named(scene, tmp_path):
    lines = motive_lines(scene)
    take = read(lines, tmp_path)
    for name, *words in (
        ("Sockt:Marker1", "no marker 'Sockt:", "mean 'Socket:Marker1'"),
        ("Socket_2", "not a measured one", "Markers"),
    ):
        with refused(RegistrationError, *words):
            take.stack([name])
    lines[3] = lines[3].replace("Socket:Marker3", "Socket:Marker1")
    take = read(lines, tmp_path)
    assert "Socket:Marker1" not in take.markers and "Socket:Marker2" in take.markers
    with refused(RegistrationError, "'Socket:Marker1' occurs twice"):
        take.stack(["Socket:Marker1"])
    # Since format 1.22 solved markers have the names of measured ones.
    solved = dict(zip(take.markers_of("Socket"), scene.solved.values(), strict=False))
    both = replace(scene, solved=solved, version="1.23")
    check(read(motive_lines(both), tmp_path), both)


def text(old: str, new: str, line: int = 0):
    """What replaces a text, once in one line."""
    return lambda lines: [*lines[:line], lines[line].replace(old, new, 1), *lines[line + 1 :]]


BAD = [  # a change of the lines, and what the error says of it
    (lambda lines: lines[FIRST_FRAME - 1 :], "not a Motive export", "header information"),
    (lambda lines: lines[:FIRST_FRAME], "holds no frame", "export"),
    (text("Length Units,Meters", "Length,Meters"), "'Length Units'", "export"),
    (text("Quaternion", "XYZ"), "type XYZ", "export quaternions"),
    (text(",Meters", ",Furlongs"), "'Furlongs'", "metres"),
    (text("Version,1.21", "Version,1.1"), "version 1.1", "1.20 to 1.25"),
    (lambda lines: [*lines[:9], lines[9] + ",1.0", *lines[10:]], "line 10 has", "export"),
    (text(",W,", ",Q,", 6), "rigid body 'Socket' has no column Rotation W", "all its"),
    (text("0.", "O.", 10), "line 11, column 2 (time) holds 'O.025000'", "number"),
    (text("2,", "1,", 9), "line 10: the frame does not follow", "export"),
    (text("0.033333,", "0.033333,7", 11), "line 12: the quaternion of 'Socket'", "export"),
]


def test_a_bad_file_is_named_with_its_place_and_a_hint(scene, tmp_path):
    for change, *words in BAD:
        with refused(RegistrationError, str(tmp_path / "take.csv"), *words):
            read(change(motive_lines(scene)), tmp_path)


def test_the_markers_of_a_real_take_give_the_pose_of_motive(shared_data):
    real = read_motive_csv(shared_data / "motive_csv" / "sample_optitrack_take.csv")
    assert len(real) == 250 and real.frame_rate == 120.0 and real.notes == ()
    motive = real.body("Rigid Body 1")
    measured = real.stack(real.markers_of("Rigid Body 1"))
    solved = np.stack([*real.solved.values()], axis=1)
    move = random_pose(np.random.default_rng(3), 1.0)  # the body hardly moves: move the scene
    expected = move @ motive
    for markers, labels in ((measured, [1, 0, 2]), (solved, [2, 0, 1])):
        arms = markers - motive.translation[:, None]
        observed = (markers @ move.rotation.T + move.translation)[:, labels]
        fit = fit_body((arms @ motive.rotation).mean(axis=0), observed)
        off = np.linalg.norm(fit.pose.translation - expected.translation, axis=1)
        turn = np.swapaxes(expected.rotation, 1, 2) @ fit.pose.rotation
        assert off.max() < 5e-5 and Rotation.from_matrix(turn).magnitude().max() < 3e-4
