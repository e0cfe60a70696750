"""From static takes to a registered socket: the files, stillness, landmarks, uncertainty."""

import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import f, kstest
from support import takes, wording
from support.problems import SOCKET_TRIAD, random_pose

from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.socket_design.motive import MotiveTake, read_motive_csv
from socket_testbed.socket_design.registration import average_still, register_landmarks


def test_a_body_s_first_markers_give_its_frame(rng, tmp_path):
    bench = takes.make_bench(rng)
    names, markers = [*takes.SOCKET_NAMES, "Extra0", "Extra1"], bench.take.markers
    extra = np.array([[0.02, 0.06, 0.01], [-0.05, 0.01, 0.045]])
    into_own = takes.own_frame_of(SOCKET_TRIAD).inverse()
    own = takes.own_frame_of(triads(bench)[0])
    for name, place in zip(names[3:], own.apply(into_own.apply(extra)), strict=True):
        markers[name] = place + rng.normal(0.0, 1e-4, (len(bench.take), 3))
    exchanged = np.array([markers[names[-1]][:20], markers[names[0]][:20]])  # labels, at first
    markers[names[0]][:20], markers[names[-1]][:20] = exchanged
    markers[names[3]][50] = np.nan
    bench.document["bodies"]["socket"] = names
    found = takes.register(bench, tmp_path)
    assert found.socket.still.used.sum() == 59
    true = bench.socket_body.apply(into_own.apply(np.vstack([SOCKET_TRIAD, extra])))
    body = found.geometry.socket_body.apply(found.geometry.socket_markers)
    np.testing.assert_allclose(body, true, atol=5e-4)


def triads(bench: takes.Bench) -> list[np.ndarray]:
    """True places of the markers of the socket and of the pylon [m]."""
    bodies = (takes.SOCKET_NAMES, takes.PYLON_NAMES)
    return [np.array([bench.places[name] for name in names]) for names in bodies]


def later(bench: takes.Bench, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """The true triads in a later frame, when all has moved, and the limb in the socket, and q."""
    socket, pylon = triads(bench)
    cell_in_world = takes.own_frame_of(socket) @ bench.socket_body.inverse()
    turn = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix()
    in_cell = Pose(turn, bench.q - turn @ bench.q + rng.normal(0.0, 0.005, 3))
    moved, away = cell_in_world @ in_cell @ cell_in_world.inverse(), random_pose(rng, 1.0)
    return away.apply(socket), away.apply(moved.apply(pylon)), in_cell.apply(bench.q)


def limb_position(found: takes.Registration, socket: np.ndarray, pylon: np.ndarray) -> np.ndarray:
    """The limb position that a trial finds from two observed triads."""
    geometry = found.geometry
    in_world = [
        fit_body(triad, observed[None]).pose
        for triad, observed in ((geometry.socket_markers, socket), (geometry.pylon_markers, pylon))
    ]
    return geometry.limb_pose(*in_world).translation[0]


@pytest.fixture
def tracked(rng) -> tuple[takes.Bench, takes.Bench, Pose]:
    """A bench, the same with rigid bodies of Motive, and the frame of its socket there.

    Motive's tracking of the socket goes wrong at times.
    """
    bench = takes.make_bench(rng, noise=0.0, unit="Millimeters")
    frame = random_pose(rng, 0.05)
    tracked = takes.track(bench, "Socket", takes.SOCKET_NAMES, frame)
    tracked = takes.track(tracked, "Pylon", takes.PYLON_NAMES, random_pose(rng, 0.05))
    bodies = {name: {"rigid_body": name.title()} for name in ("socket", "pylon")}
    tracked.document = bench.document | {"bodies": bodies}
    pose = tracked.take.bodies["Socket"]
    pose.rotation[:9] = random_pose(rng, count=9).rotation
    pose.translation[9:20] = np.nan
    return bench, tracked, frame


def test_a_rigid_body_of_motive_keeps_its_frame(tracked, tmp_path):
    bench, with_bodies, frame = tracked
    own, motive = takes.register(bench, tmp_path), takes.register(with_bodies, tmp_path)
    expected = own.geometry.socket_body @ frame
    assert takes.between(expected, motive.geometry.socket_body)[0] < 1e-6


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]], ids=["in-order", "labels-exchanged"])
@pytest.mark.parametrize("of_motive", [False, True], ids=["own-frame", "frame-of-motive"])
def test_a_later_trial_gives_the_limb_position(tracked, rng, tmp_path, of_motive, order):
    bench, with_bodies, _ = tracked
    found = takes.register(with_bodies if of_motive else bench, tmp_path)
    socket, pylon, q = later(bench, rng)
    np.testing.assert_allclose(limb_position(found, socket[order], pylon), q, atol=1e-7)


def test_a_body_that_was_hardly_tracked_is_refused(tracked, tmp_path):
    _, with_bodies, _ = tracked
    with_bodies.take.bodies["Socket"].translation[20:40] = np.nan
    with wording.refused(RegistrationError, "tracked its rigid body in 29 of 60 frames"):
        takes.register(with_bodies, tmp_path)


# --- labels and stillness


def still_markers(rng, frames: int = 60, noise: float = 1e-4) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (4, 3)) + rng.normal(0.0, noise, (frames, 4, 3))


def average(positions: np.ndarray, fits: np.ndarray | bool = True):
    return average_still("ABCD", positions, np.full(len(positions), fits), "take.csv: socket")


def test_frames_are_counted_by_their_fault(rng):
    positions, fits = still_markers(rng), np.ones(60, dtype=bool)
    positions[3:8, 1], positions[6:10, 2] = np.nan, np.nan
    fits[20:23] = False
    positions[30:32, 0] += 0.02
    still = average(positions, fits)
    left_out = [*range(3, 10), 20, 21, 22, 30, 31]
    np.testing.assert_array_equal(np.flatnonzero(~still.used), left_out)
    np.testing.assert_array_equal(still.occluded, [0, 5, 4, 0])
    assert (still.mislabelled, still.jumped, still.notes) == (3, 2, ())
    np.testing.assert_allclose(still.mean, np.delete(positions, left_out, 0).mean(0), atol=1e-15)
    np.testing.assert_allclose(still.spread, np.sqrt(3.0) * 1e-4, rtol=0.2)
    assert still.noise == pytest.approx(1e-4 / np.sqrt(48), rel=0.3)
    slow = average(np.repeat(rng.normal(0.0, 1e-4, (10, 4, 3)), 60, axis=0))
    assert slow.noise == pytest.approx(1e-4 / np.sqrt(10), rel=0.3)  # what frames share counts


RAMP, SHAKE = np.linspace(0.0, 1.0, 60), (-1.0) ** np.arange(60)


def moving(rng, motion: np.ndarray) -> np.ndarray:
    """Markers of which C moves along x [m]."""
    positions = still_markers(rng, noise=2e-5)
    positions[:, 2, 0] += motion
    return positions


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        pytest.param(6e-4 * RAMP, "C drifted by 0.4", id="drift"),
        pytest.param(6e-4 * SHAKE, "C moved about by 0.6", id="shake"),
    ],
)
def test_a_little_motion_is_noted(rng, motion: np.ndarray, words: str):
    (note,) = average(moving(rng, motion)).notes
    assert words in note


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        pytest.param(3e-3 * RAMP, "socket: C drifted by 2.0", id="drift"),
        pytest.param(
            0.03 * (RAMP > 0.7),
            "in 18 of 60 frames a marker, mostly C, is more than 5 mm",
            id="jump",
        ),
        pytest.param(
            np.where(RAMP < 0.25, 0.0, np.nan),
            "show all of A, B, C, D (C is occluded in 45",
            id="occluded",
        ),
    ],
)
def test_more_motion_is_refused(rng, motion: np.ndarray, words: str):
    with wording.refused(RegistrationError, "take.csv: socket", words):
        average(moving(rng, motion))


# --- landmarks

TARGET = np.array([0.02, -0.03, 0.25])  # [m]; off the landmarks, as the limb is
NOISE = 4e-4  # [m]


NAMES = tuple(f"LC{i + 1}" for i in range(len(takes.CELL)))


def normalised(fit, pose: Pose) -> float:
    """Squared error at the target over its stated covariance."""
    error = pose.rotation.T @ (fit.pose.apply(TARGET) - pose.apply(TARGET))
    return float(error @ np.linalg.solve(fit.uncertainty.at(TARGET), error))


@pytest.mark.parametrize("count", [3, 5], ids=["3-landmarks", "5-landmarks"])
def test_landmarks_give_poses_within_their_uncertainty(rng, count: int):
    """With a noise from the residuals it is an F of 3, 3k - 6; the fit: test_marker_bodies.py."""
    known, names, found = takes.CELL[:count], NAMES[:count], []
    for _ in range(400):
        pose = random_pose(rng, 1.0)
        measured = pose.apply(known) + rng.normal(0.0, NOISE, known.shape)
        fit = register_landmarks(known, measured, names)
        found.append(normalised(fit, pose) / 3.0)
    assert kstest(found, f(3, 3 * count - 6).cdf).pvalue > 1e-3


NEAR = takes.CELL[[0, 1, 2, 1]] + 1e-3 * np.eye(4, 3)
ON_A_LINE = np.outer(np.arange(5), [0.02, 0.03, 0.0])
ON_A_LINE += np.random.default_rng(1).normal(0.0, 1e-3, (5, 3))


@pytest.mark.parametrize(
    ("known", "measured", "fact"),
    [
        pytest.param(takes.CELL[:2], takes.CELL[:2], "2 landmarks", id="two"),
        pytest.param(NEAR, NEAR, "LC2 and LC4 are given 1.0 mm apart", id="too-near"),
        pytest.param(takes.CELL, ON_A_LINE, "were measured on one line", id="on-a-line"),
    ],
)
def test_landmarks_that_hold_no_frame_are_refused(rng, known, measured, fact):
    with wording.refused(RegistrationError, fact):
        register_landmarks(known, random_pose(rng).apply(measured), NAMES[: len(known)])


def test_a_wrong_landmark_is_noted(rng, tmp_path):
    """That it is refused unless forced: commands/test_register.py."""
    bench = takes.make_bench(rng)
    bench.document["limb"]["Limb:2"][0] += 0.006
    found = takes.register(bench, tmp_path)
    assert any(note.startswith("limb: landmark Limb:2 is") for note in found.notes)
    bench.document["limb"]["Limb:2"][0] += 0.03
    forced = takes.register(bench, tmp_path, force=True)
    assert np.trace(forced.covariance) > 30.0 * np.trace(found.covariance)


@pytest.mark.parametrize("side", ["load_cell", "limb"])
def test_a_mirrored_frame_is_refused(rng, tmp_path, side: str):
    bench = takes.make_bench(rng, frames=20, landmarks=4)
    for point in bench.document[side].values():
        point[1] *= -1.0  # mirrored, and off a plane
    with wording.refused(RegistrationError, "mm off"):
        takes.register(bench, tmp_path)


def test_landmarks_in_one_plane_are_noted(rng, tmp_path):
    bench = takes.make_bench(rng, frames=20, landmarks=3)
    notes = takes.register(bench, tmp_path).notes
    for side in ("load_cell: Cell:0, Cell:1, Cell:2", "limb: Limb:0, Limb:1, Limb:2"):
        assert any(note.startswith(f"{side} lie in one plane") for note in notes), side


def test_a_limb_outside_the_socket_is_refused(rng, tmp_path):
    bench = takes.make_bench(rng, frames=20, landmarks=3)
    for point in bench.document["limb"].values():
        point[2] *= -1.0  # the limb goes to the other side of its landmarks
    with wording.refused(RegistrationError, "outside the socket", "signs", "--force"):
        takes.register(bench, tmp_path)
    takes.register(bench, tmp_path, force=True)


# --- uncertainty


@pytest.mark.slow
def test_the_covariances_are_those_of_the_errors(tmp_path):
    """One bench, measured again and again, with as much noise by the triads as by landmarks."""
    rng, errors, stated = np.random.default_rng(7), [], []
    for _ in range(250):
        bench = takes.make_bench(rng, 20, 2e-4, scene=np.random.default_rng(8), unit="Millimeters")
        found = takes.register(bench, tmp_path)
        socket, pylon = triads(bench)
        noisy = (triad + rng.normal(0.0, 2e-4, (3, 3)) for triad in (socket, pylon))
        position = limb_position(found, socket, pylon)
        errors.append([position - bench.q, limb_position(found, *noisy) - position])
        stated.append([found.covariance, found.single])
    for error, mean in zip(np.swapaxes(errors, 0, 1), np.mean(stated, axis=0), strict=True):
        white = np.linalg.eigvalsh(np.cov(np.linalg.solve(np.linalg.cholesky(mean), error.T)))
        # Sigma is never taken below the noise of the means, which makes it a little too large.
        assert white.min() > 0.65 and white.max() < 1.35


# --- Motive's CSV exports: of every version, broken, and of a real system


FIRST_FRAME = 7  # index of its line in formats until 1.22


@pytest.fixture
def scene() -> takes.Written:
    """A body with its triad and a loose marker over 30 frames, some of it occluded."""
    rng = np.random.default_rng(5)
    pose = random_pose(rng, 1.0, 30)
    triad = np.array([p.apply(SOCKET_TRIAD) for p in map(Pose, pose.rotation, pose.translation)])
    noisy = (triad + rng.normal(0.0, 1e-4, triad.shape)).swapaxes(0, 1)
    markers = {f"Socket:Marker{i + 1}": noisy[i] for i in range(3)}
    markers["Unlabeled:108"] = rng.uniform(-1.0, 1.0, (30, 3))
    markers["Socket:Marker2"][4:9] = np.nan
    solved = {f"Socket_{i + 1}": triad[:, i] for i in range(3)}
    return takes.Written(markers, solved, {"Socket": pose})


def read(lines: list[str], folder: Path) -> MotiveTake:
    return read_motive_csv(takes.write_lines(lines, folder / "take.csv"))


def check(take: MotiveTake, scene: takes.Written, within: float = 1e-6) -> None:
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


@pytest.mark.parametrize("version", ["1.2", "1.20", "1.21", "1.22", "1.23", "1.24", "1.25"])
def test_every_version_is_read(scene, tmp_path, version: str):
    written = takes.write_take(replace(scene, version=version), tmp_path / "take.csv")
    check(read_motive_csv(written), scene)


@pytest.mark.parametrize("unit", takes.UNITS)
def test_every_unit_is_read(scene, tmp_path, unit: str):
    written = takes.write_take(replace(scene, unit=unit), tmp_path / "take.csv")
    check(read_motive_csv(written), scene, 1e-6 * takes.UNITS[unit])


def test_line_feeds_behind_byte_order_marks_are_read(scene, tmp_path):
    path = tmp_path / "take.csv"
    takes.write_lines(takes.motive_lines(scene), path, "\n", "utf-8-sig")
    check(read_motive_csv(path), scene)


def saved_again(
    lines: list[str], separator: str, comma: bool, quoting: int = csv.QUOTE_MINIMAL
) -> str:
    """A take as a spreadsheet program writes it: all rows of one width, perhaps decimal commas."""
    rows = list(csv.reader(lines))
    width = max(map(len, rows))
    written = io.StringIO()
    writer = csv.writer(written, delimiter=separator, quoting=quoting, lineterminator="\r\n")
    for row in rows:
        cells = [re.sub(r"^(-?\d+)\.(\d+)$", r"\1,\2", c) if comma else c for c in row]
        writer.writerow(cells + [""] * (width - len(row)))
    return written.getvalue()


@pytest.mark.parametrize(
    ("separator", "comma", "quoting", "above"),
    [
        pytest.param(",", False, csv.QUOTE_MINIMAL, "", id="filled-rows"),
        pytest.param(",", False, csv.QUOTE_ALL, "", id="quoted"),
        pytest.param(",", True, csv.QUOTE_MINIMAL, "", id="quoted-decimal-commas"),
        pytest.param(";", False, csv.QUOTE_MINIMAL, "", id="semicolons"),
        pytest.param(";", True, csv.QUOTE_MINIMAL, "", id="decimal-commas"),
        pytest.param(";", True, csv.QUOTE_ALL, "sep=;\r\n", id="stated"),
        pytest.param("\t", False, csv.QUOTE_MINIMAL, "", id="tabs"),
        pytest.param("\t", True, csv.QUOTE_MINIMAL, "", id="tabs-decimal-commas"),
    ],
)
def test_a_take_saved_by_a_spreadsheet_is_read(
    scene, tmp_path, separator: str, comma: bool, quoting: int, above: str
):
    path = tmp_path / "take.csv"
    text = saved_again(takes.motive_lines(scene), separator, comma, quoting)
    path.write_text(above + text, encoding="utf-8-sig", newline="")
    found = read_motive_csv(path)
    names = {";": "semicolons separate", "\t": "tabs separate"}
    assert [names[separator] in note for note in found.notes] == [True] * (separator != ",")
    assert found.version == "1.21"
    check(replace(found, notes=()), scene)


def test_a_version_taken_for_a_date_is_named(scene, tmp_path):
    lines = takes.motive_lines(scene)
    lines[0] = lines[0].replace("1.21", "21. Jan")
    with wording.refused(
        RegistrationError, "the format version '21. Jan', which is not a number"
    ) as error:
        read(lines, tmp_path)
    assert "a spreadsheet program has taken it for a date" in error.value.hint


def test_a_newer_version_is_read_and_noted(scene, tmp_path):
    path = tmp_path / "take.csv"
    newer = read_motive_csv(takes.write_take(replace(scene, version="1.31"), path))
    assert "1.31" in newer.notes[0] and len(newer) == 30


def with_more(scene: takes.Written) -> list[str]:
    """Lines with bones, time codes, reversed quaternions and a comma in the name of the take."""
    lines = takes.motive_lines(replace(scene, version="1.24"))
    extra = [",Bone", ",Hips", ",0A", ",Position", ",X", *[",not read"] * 30]
    codes = ["", "", "", "", "TimeCode", *["15:26:46:12.02"] * 30]
    for i, (bone, code) in enumerate(zip(extra, codes, strict=True), start=2):
        frame, time, *cells = lines[i].split(",")
        if i >= FIRST_FRAME and i % 2:
            cells[:4] = [f"{-float(cell):.6f}" for cell in cells[:4]]
        lines[i] = ",".join([frame, time, code, *cells]) + bone + ",,,"
    # A comma in the name of the take shifts the pairs of the header.
    lines[0] = lines[0].replace("Take 2024-05-05", "Static, left, 2024-05-05")
    return lines


def test_what_is_not_needed_does_not_matter(scene, tmp_path):
    check(read(with_more(scene), tmp_path), scene)


def test_a_lost_body_has_no_pose(scene, tmp_path):
    lines = with_more(scene)
    cells = lines[FIRST_FRAME + 3].split(",")
    lines[FIRST_FRAME + 3] = ",".join([*cells[:3], *[""] * 8, *cells[11:]])
    pose = read(lines, tmp_path).body("Socket")
    lost = np.isnan(pose.rotation).all(axis=(1, 2)) & np.isnan(pose.translation).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), [3])


@pytest.mark.parametrize("lost", [1, 2, 30, 200], ids="{}-bytes".format)
def test_a_cut_take_keeps_its_whole_frames(scene, tmp_path, lost: int):
    path = tmp_path / "take.csv"
    path.write_bytes(takes.write_take(scene, path).read_bytes()[:-lost])
    take = read_motive_csv(path)
    # Without its line end it may have lost digits, too; a lone carriage return is an end.
    kept = 30 if lost == 1 else 29
    expected = scene.markers["Unlabeled:108"][:kept]
    np.testing.assert_allclose(take.markers["Unlabeled:108"], expected, atol=1e-6)
    assert lost == 1 or ("cut short" in take.notes[0] and "30 were exported" in take.notes[1])


def test_a_marker_that_is_missing_is_named(scene, tmp_path):
    take = read(takes.motive_lines(scene), tmp_path)
    with wording.refused(RegistrationError, "no marker 'Sockt:", "mean 'Socket:Marker1'"):
        take.stack(["Sockt:Marker1"])


def test_a_solved_marker_is_not_a_measured_one(scene, tmp_path):
    take = read(takes.motive_lines(scene), tmp_path)
    with wording.refused(RegistrationError, "not a measured one", "Markers"):
        take.stack(["Socket_2"])


def test_a_doubled_name_is_named(scene, tmp_path):
    lines = takes.motive_lines(scene)
    lines[3] = lines[3].replace("Socket:Marker3", "Socket:Marker1")
    with wording.refused(RegistrationError, "'Socket:Marker1' occurs twice"):
        read(lines, tmp_path).stack(["Socket:Marker1"])


def test_solved_markers_may_have_names_of_measured(scene, tmp_path):
    """Since format 1.22 they do."""
    take = read(takes.motive_lines(scene), tmp_path)
    solved = dict(zip(take.markers_of("Socket"), scene.solved.values(), strict=False))
    both = replace(scene, solved=solved, version="1.23")
    check(read(takes.motive_lines(both), tmp_path), both)


def text(old: str, new: str, line: int = 0):
    """What replaces a text, once in one line."""
    return lambda lines: [*lines[:line], lines[line].replace(old, new, 1), *lines[line + 1 :]]


BAD = {  # a change of the lines, and what the error says of it
    "no-header": (
        *(lambda lines: lines[FIRST_FRAME - 1 :], "not a Motive export", "header information"),
    ),
    "no-frame": (lambda lines: lines[:FIRST_FRAME], "holds no frame", "export"),
    "no-unit": (text("Length Units,Meters", "Length,Meters"), "'Length Units'", "export"),
    "angles": (text("Quaternion", "XYZ"), "type XYZ", "export quaternions"),
    "unknown-unit": (text(",Meters", ",Furlongs"), "'Furlongs'", "metres"),
    "old-version": (text("Version,1.21", "Version,1.1"), "version 1.1", "1.20 to 1.25"),
    "more-cells": (
        *(lambda lines: [*lines[:9], lines[9] + ",1.0", *lines[10:]], "line 10 has", "export"),
    ),
    "fewer-cells": (
        lambda lines: [*lines[:9], lines[9].rpartition(",")[0], *lines[10:]],
        "line 10 has",
        "export",
    ),
    "no-column": (text(",W,", ",Q,", 6), "rigid body 'Socket' has no column Rotation W", "all its"),
    "no-number": (text("0.", "O.", 10), "line 11, column 2 (time) holds 'O.025000'", "number"),
    "frame-again": (text("2,", "1,", 9), "line 10: the frame does not follow", "export"),
    "no-rotation": (
        *(text("0.033333,", "0.033333,7", 11), "line 12: the quaternion of 'Socket'", "export"),
    ),
}


@pytest.mark.parametrize(("change", "fact", "hint"), BAD.values(), ids=BAD)
def test_a_bad_file_is_named_with_its_place(scene, tmp_path, change, fact, hint):
    with wording.refused(RegistrationError, str(tmp_path / "take.csv"), fact, hint):
        read(change(takes.motive_lines(scene)), tmp_path)


@pytest.mark.parametrize("separator", [";", "\t"], ids=["semicolons", "tabs"])
def test_a_real_take_saved_again_is_the_same(shared_data, tmp_path, separator: str):
    source, path = shared_data / "motive_csv" / "sample_optitrack_take.csv", tmp_path / "take.csv"
    lines = source.read_text(encoding="utf-8").splitlines()
    path.write_text(saved_again(lines, separator, comma=True), newline="")
    real, again = read_motive_csv(source), read_motive_csv(path)
    assert len(again) == 250
    for name, positions in real.markers.items():
        np.testing.assert_array_equal(again.markers[name], positions)


@pytest.mark.parametrize(
    ("kind", "labels"),
    [
        pytest.param("measured", [1, 0, 2], id="measured-markers"),
        pytest.param("solved", [2, 0, 1], id="solved-markers"),
    ],
)
def test_a_real_take_gives_motive_s_pose(shared_data, kind: str, labels: list[int]):
    real = read_motive_csv(shared_data / "motive_csv" / "sample_optitrack_take.csv")
    assert len(real) == 250 and real.frame_rate == 120.0 and real.notes == ()
    motive = real.body("Rigid Body 1")
    if kind == "measured":
        markers = real.stack(real.markers_of("Rigid Body 1"))
    else:
        markers = np.stack([*real.solved.values()], axis=1)
    move = random_pose(np.random.default_rng(3), 1.0)  # the body hardly moves: move the scene
    expected = move @ motive
    arms = markers - motive.translation[:, None]
    observed = (markers @ move.rotation.T + move.translation)[:, labels]
    fit = fit_body((arms @ motive.rotation).mean(axis=0), observed)
    off = np.linalg.norm(fit.pose.translation - expected.translation, axis=1)
    turn = np.swapaxes(expected.rotation, 1, 2) @ fit.pose.rotation
    assert off.max() < 5e-5 and Rotation.from_matrix(turn).magnitude().max() < 3e-4
