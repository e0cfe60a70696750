"""The verb `register` on a take that is placed by hand.

In {S}, in mm, the socket's markers are at (30, -80, 100), 100 mm further along y and 60 mm further
along -x: its body is turned by 90 degrees about z. The limb's origin is at (5, 10, 130), its x is
the x of {S}, its y the z of {S}, its z the -y of {S}. In the limb's frame the pylon's markers are
at (10, -20, -150), 100 mm further along z and 60 mm further along y: the limb in the pylon's body
is turned by 90 degrees about its y. In the world, {S} is turned by 90 degrees about z, and moved.

The load cell's four landmarks lie symmetrically about (0, 0, 20), and are seen 2 % farther from it:
this shifts and turns nothing, and leaves residuals of 2 % of 63.25 and 82.46 mm, with a squared sum
of 8.64 mm^2 over 6 degrees of freedom: 1.2 mm for a coordinate. Everything else fits exactly.
"""

import io
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scene, takes, verbs

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.marker_bodies import PoseUncertainty
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry, read_socket, write_socket
from socket_testbed.socket_design import registration

FRAMES = 62
# Places in mm: in {S}, and in the limb's frame
IN_CELL = {
    **{"Socket:Marker1": (30, -80, 100), "Socket:Marker2": (30, 20, 100)},
    **{"Socket:Marker3": (-30, -80, 100), "Cell:1": (60, 0, 0), "Cell:2": (-60, 0, 0)},
    **{"Cell:3": (0, 80, 40), "Cell:4": (0, -80, 40)},
}
CELLS = ("Cell:1", "Cell:2", "Cell:3", "Cell:4")
IN_LIMB = {
    **{"Pylon:Marker1": (10, -20, -150), "Pylon:Marker2": (10, -20, -50)},
    **{"Pylon:Marker3": (10, 40, -150), "Limb:1": (0, 70, 100), "Limb:2": (50, -30, 120)},
    **{"Limb:3": (-60, -20, 90), "Limb:4": (20, 20, 40)},
}
LIMB_IN_CELL = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([5, 10, 130])
CELL_IN_WORLD = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1000, 2000, 500])


def place(pose: tuple[np.ndarray, np.ndarray], point: np.ndarray) -> np.ndarray:
    return pose[0] @ point + pose[1]


def seen(stretch: float = 1.02) -> dict[str, np.ndarray]:
    """The markers in the world over the take [m], all at rest."""
    found = {}
    for name, point in IN_CELL.items():
        own = np.array(point, dtype=float)
        if name.startswith("Cell"):
            own = [0, 0, 20] + stretch * (own - [0, 0, 20])
        found[name] = place(CELL_IN_WORLD, own)
    for name, point in IN_LIMB.items():
        found[name] = place(CELL_IN_WORLD, place(LIMB_IN_CELL, np.array(point, dtype=float)))
    return {name: np.tile(1e-3 * own, (FRAMES, 1)) for name, own in found.items()}


def spoiled() -> dict[str, np.ndarray]:
    """The take with each fault that is counted or noted, none of which changes a mean.

    Socket: 8 frames without Cell:2, 2 with a wrong distance; Cell:3 steps by 0.3 mm halfway.
    Pylon: 2 frames in which Limb:2 jumps by 20 mm; Limb:1 goes to and fro by 0.5 mm.
    """
    markers = seen()
    markers["Cell:2"][[*range(4), *range(FRAMES - 4, FRAMES)]] = np.nan
    markers["Socket:Marker2"][[20, 41], 0] += 0.03
    markers["Cell:3"][:, 2] += np.where(np.arange(FRAMES) < FRAMES // 2, -1.5e-4, 1.5e-4)
    markers["Limb:2"][[10, 11], 2] += 0.02
    markers["Limb:1"][:, 1] += np.where(np.arange(FRAMES) % 2, 5e-4, -5e-4)
    return markers


def landmarks() -> dict[str, Any]:
    """What LANDMARKS.yaml says: coordinates in metres."""
    document: dict[str, Any] = {
        "bodies": {"socket": list(takes.SOCKET_NAMES), "pylon": list(takes.PYLON_NAMES)}
    }
    for key, places, kind in (("load_cell", IN_CELL, "Cell"), ("limb", IN_LIMB, "Limb")):
        chosen = {name: point for name, point in places.items() if name.startswith(kind)}
        document[key] = {name: [1e-3 * x for x in point] for name, point in chosen.items()}
    return document


def write(folder: Path, markers: dict[str, np.ndarray], document: dict[str, Any]) -> list[str]:
    """The words of a call on files in a folder."""
    take = takes.write_take(takes.Written(markers, unit="Millimeters"), folder / "take.csv")
    known = takes.write_landmarks(document, folder / "landmarks.yaml")
    write_socket(scene.geometry(), folder / "socket.yaml")
    return [
        *("register", str(take), "--landmarks", str(known)),
        *("--socket", str(folder / "socket.yaml"), "-o", str(folder / "new.yaml")),
    ]


class Registered:
    """What one run of the verb printed and wrote."""

    def __init__(self, words: list[str]) -> None:
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            assert run(words) == 0, err.getvalue()
        self.lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
        self.notes = err.getvalue().splitlines()
        self.socket: SocketGeometry = read_socket(Path(words[-1]))


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Registered:
    return Registered(write(tmp_path_factory.mktemp("registered"), spoiled(), landmarks()))


# --- the socket file


def test_the_socket_s_body_is_in_the_load_cell(registered: Registered) -> None:
    body = registered.socket.socket_body
    assert 1e3 * body.translation == pytest.approx([30.0, -80.0, 100.0], abs=1e-3)
    np.testing.assert_allclose(body.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)


def test_the_limb_is_in_the_pylon_s_body(registered: Registered) -> None:
    """The body's x is the limb's z, its y the limb's y, its z the limb's -x."""
    limb = registered.socket.limb
    assert 1e3 * limb.translation == pytest.approx([150.0, 20.0, 10.0], abs=1e-3)
    np.testing.assert_allclose(limb.rotation, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-6)


def test_the_markers_are_in_their_bodies(registered: Registered) -> None:
    triad = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.06, 0.0]]
    np.testing.assert_allclose(registered.socket.socket_markers, triad, atol=1e-6)
    np.testing.assert_allclose(registered.socket.pylon_markers, triad, atol=1e-6)


def test_the_file_says_how_well_the_landmarks_fit(registered: Registered) -> None:
    assert registered.socket.registration == (
        "take.csv, landmarks within 1.47 mm (load cell) and 0.00 mm (limb)"
    )


def test_the_tiles_are_kept(registered: Registered) -> None:
    assert registered.socket.same_tiles(scene.geometry())
    assert registered.socket.clusters == scene.geometry().clusters


# --- the terminal

# 1 sigma of rotations: 1.2 mm over the roots of sums of squared distances from an axis through the
# centroid, 14400, 8800 and 20000 mm^2: 0.01, 0.01279 and 0.00849 rad. 1 sigma of a point at (x, y,
# z) from the centroid: 0.6 mm, and these times their levers. The socket's body is at (30, -80, 80)
# from it, the limb at (5, 10, 110).
PRINTED = {
    "take": "62 frames at 120 Hz, format 1.21, lengths in millimeters",
    "socket frames": "socket and load_cell: 52 frames used, 10 left out (8 occluded, 2 mislabelled,"
    " 0 jumped)",
    "limb frames": "pylon and limb: 60 frames used, 2 left out (0 occluded, 0 mislabelled, 2"
    " jumped)",
    "titles": "marker occluded spread [mm] drift [mm] residual [mm]",
    "own marker": "Socket:Marker1 0 0.000 0.000 -",
    "occluded": "Cell:2 8 0.000 0.000 1.265",
    "drifted": "Cell:3 0 0.150 0.300 1.649",
    "to and fro": "Limb:1 0 0.500 0.000 0.000",
    "load cell": "load_cell: 4 landmarks, residual 1.470 mm rms (6 degrees of freedom), so 1 sigma"
    " of a coordinate is 1.200 mm",
    "limb": "limb: 4 landmarks, residual 0.000 mm rms (6 degrees of freedom), so 1 sigma of a"
    " coordinate is 0.000 mm",
    "body": "socket body in {S}: at (30.00, -80.00, 100.00) mm, turned by 90.00 deg about (0.000,"
    " 0.000, 1.000)",
    "body's sigma": "1 sigma: (1.37, 1.03, 1.07) mm, (0.573, 0.733, 0.486) deg about x, y, z",
    "limb in pylon": "limb in the pylon's body: at (150.00, 20.00, 10.00) mm, turned by 90.00 deg"
    " about (0.000, 1.000, 0.000)",
    "q": "limb position q in {S}: (5.00, 10.00, 130.00) mm",
    "q's sigma": "1 sigma: (1.53, 1.25, 0.61) mm, 2.07 mm in all; noise of a single frame: 0.00 mm",
}


def with_limb_errors(folder: Path) -> list[str]:
    """The words of a call on a take where the limb's landmarks do not fit, and the cell's do.

    The limb's landmarks are seen 2 % too far from (0, 0, 120), and the cell's are right.

    They are placed as the cell's, so that 1 sigma of rotations about the limb's x, y and z is again
    0.01, 0.01279 and 0.00849 rad. Its origin is 120 mm from there: along x 0.6 mm and 120 mm of
    0.01279, together 1.648 mm; along y 0.6 mm and 1.2 mm, together 1.342 mm; along z 0.6 mm. The
    limb's y is the z of {S}, and its z the -y: (1.648, 0.6, 1.342) mm in {S}, 2.208 mm in all. The
    pylon's body has the limb's z, y and -x as its x, y and z.
    """
    centre = np.array([0.0, 0.0, 120.0])
    places = {f"Limb:{name[-1]}": np.array(IN_CELL[name]) + [0, 0, 100] for name in CELLS}
    markers, document = seen(stretch=1.0), landmarks()
    for name, known in places.items():
        own = centre + 1.02 * (known - centre)
        at = place(CELL_IN_WORLD, place(LIMB_IN_CELL, own))
        markers[name] = np.tile(1e-3 * at, (FRAMES, 1))
        document["limb"][name] = [1e-3 * float(x) for x in known]
    return write(folder, markers, document)


def test_the_limb_s_errors_are_in_the_socket_s_axes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = verbs.call(capsys, *with_limb_errors(tmp_path))
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert code == 0
    assert (
        "1 sigma: (1.65, 0.60, 1.34) mm, 2.21 mm in all; noise of a single frame: 0.00 mm" in lines
    )
    assert "1 sigma: (0.60, 1.34, 1.65) mm, (0.486, 0.733, 0.573) deg about x, y, z" in lines


def test_the_limb_s_errors_turn_with_its_body(tmp_path: Path) -> None:
    """A body whose y, z and x are the limb's x, y and z has the variances in this order."""
    words = with_limb_errors(tmp_path)
    found = st.register(words[1], words[3], words[5])
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    body = replace(found.geometry, limb=Pose(turn, np.zeros(3)))
    position, rotation = replace(found, geometry=body).limb_covariances()
    assert 1e3 * np.sqrt(np.diag(position)) == pytest.approx([0.6, 1.648, 1.342], abs=1e-3)
    assert np.sqrt(np.diag(rotation)) == pytest.approx([0.00849, 0.01, 0.01279], abs=1e-5)


def test_a_frame_s_noise_is_in_the_socket_s_axes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pylon's noise of 1, 2 and 3 mm along the limb's axes, beside none of the socket's."""
    noise = {"Limb": np.diag([1e-6, 4e-6, 9e-6]), "Socket": np.zeros((3, 3))}
    real = registration._register_body

    def noisy(take: Any, side: Any, force: bool) -> Any:
        body = "Limb" if side.frame == "limb" else "Socket"
        single = PoseUncertainty(np.zeros(3), noise[body], np.zeros((3, 3)))
        return replace(real(take, side, force), single=single)

    monkeypatch.setattr(registration, "_register_body", noisy)
    words = write(tmp_path, seen(), landmarks())
    found = st.register(words[1], words[3], words[5])
    np.testing.assert_allclose(1e6 * found.single, np.diag([1.0, 9.0, 4.0]), atol=1e-9)


@pytest.mark.parametrize("name", PRINTED)
def test_the_verb_prints_the_known_numbers(name: str, registered: Registered) -> None:
    if name == "take":
        assert registered.lines[0].endswith(f"take.csv: {PRINTED[name]}")
    else:
        assert PRINTED[name] in registered.lines


def test_moving_markers_are_noted_in_millimetres(registered: Registered) -> None:
    assert registered.notes == [
        "note: load_cell: Cell:3 drifted by 0.30 mm over the take",
        "note: limb: Limb:1 moved about by 0.50 mm over the take",
    ]


def test_the_noise_of_a_frame_is_in_millimetres(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """sqrt(0.2^2 + 0.1^2 + 0.2^2) = 0.3."""
    words = write(tmp_path, seen(), landmarks())
    found = st.register(words[1], words[3], words[5])
    single = np.diag([4e-8, 1e-8, 4e-8])
    changed = replace(found, single=single)
    monkeypatch.setattr("socket_testbed.api.register", lambda *_, **__: changed)
    assert "noise of a single frame: 0.30 mm" in verbs.call(capsys, *words)[1]


def test_a_registration_is_shown_in_one_line(tmp_path: Path) -> None:
    words = write(tmp_path, seen(), landmarks())
    found = st.register(words[1], words[3], words[5])
    assert repr(found) == f"Registration({words[1]}: 62 frames; 1.47 and 0.00 mm rms)"


# --- wrong landmarks


def exchanged(document: dict[str, Any]) -> None:
    """The names of the first and the third landmark: 100 mm from each other."""
    known = document["load_cell"]
    known["Cell:1"], known["Cell:3"] = known["Cell:3"], known["Cell:1"]


def mirrored(document: dict[str, Any]) -> None:
    """Left for right, which no turn undoes."""
    for point in document["limb"].values():
        point[1] = -point[1]


def in_millimetres(document: dict[str, Any]) -> None:
    for point in document["load_cell"].values():
        point[:] = [1e3 * x for x in point]


def raised(document: dict[str, Any]) -> None:
    """The limb's origin 300 mm lower among its landmarks: along z of the limb, y of {S}."""
    for point in document["limb"].values():
        point[2] += 0.3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (exchanged, ["load_cell: landmark Cell:", " mm off (at most 10 mm; rms "]),
        (mirrored, ["limb: landmark Limb:", " mm off (at most 10 mm; rms "]),
        (in_millimetres, ["landmarks.yaml", "load_cell", "coordinates [m]"]),
        (raised, ["load_cell: the limb would be at (5, 310, 130) mm of {S}, outside the socket"]),
    ],
    ids=["exchanged", "mirrored", "millimetres", "origin"],
)
def test_wrong_landmarks_are_refused(
    change: Callable[[dict[str, Any]], None],
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    document = landmarks()
    change(document)
    call = write(tmp_path, seen(), document)
    verbs.refused(capsys, *call, named=words)
    assert not (tmp_path / "new.yaml").exists()


def test_a_landmark_off_its_place_is_named(tmp_path: Path) -> None:
    """50 mm: the fit shares it among the four, and most of the rest is at this one."""
    document = landmarks()
    document["limb"]["Limb:3"][0] -= 0.05
    words = write(tmp_path, seen(stretch=1.0), document)
    with pytest.raises(RegistrationError) as found:
        st.register(words[1], words[3], words[5])
    assert "limb: landmark Limb:3 is " in found.value.fact


def test_a_take_of_the_wrong_scale_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its header says centimetres: everything is ten times as large."""
    words = write(tmp_path, seen(stretch=1.0), landmarks())
    text = Path(words[1]).read_text(encoding="utf-8")
    Path(words[1]).write_text(text.replace("Millimeters", "Centimeters"), encoding="utf-8")
    line = verbs.refused(capsys, *words, named=[" mm off (at most 10 mm; rms "])
    assert float(line.split(" mm off")[0].rsplit(" ", 1)[1]) > 400.0


def test_landmarks_in_one_plane_are_noted(tmp_path: Path) -> None:
    document = landmarks()
    for name in ("Cell:3", "Cell:4"):
        document["load_cell"][name][2] = 0.0
    markers = seen(stretch=1.0)
    for name in ("Cell:3", "Cell:4"):
        markers[name][:, 2] -= 0.04
    found = st.register(*(write(tmp_path, markers, document)[k] for k in (1, 3, 5)))
    assert found.notes == (
        "load_cell: Cell:1, Cell:2, Cell:3, Cell:4 lie in one plane: a wrong sign of a coordinate"
        " would not be seen",
    )


# --- the smallest files


def smallest(frames: int, unit: str, folder: Path) -> list[str]:
    """Some frames with three landmarks for each frame, in a unit of the take."""
    document = landmarks()
    kept = {"load_cell": ("Cell:2", "Cell:3", "Cell:4"), "limb": ("Limb:1", "Limb:2", "Limb:3")}
    for key, names in kept.items():
        document[key] = {name: document[key][name] for name in names}
    markers = {name: own[:frames] for name, own in seen(stretch=1.0).items()}
    words = write(folder, markers, document)
    takes.write_take(takes.Written(markers, unit=unit), folder / "take.csv")
    return words


@pytest.mark.parametrize("unit", takes.UNITS)
def test_a_take_in_every_unit_gives_one_place(unit: str, tmp_path: Path) -> None:
    """Twenty frames and three landmarks are enough; six decimals of a metre are a micrometre."""
    found = st.register(*(smallest(20, unit, tmp_path)[k] for k in (1, 3, 5)))
    assert 1e3 * found.geometry.socket_body.translation == pytest.approx([30, -80, 100], abs=0.01)
    assert 1e3 * found.geometry.limb.translation == pytest.approx([150, 20, 10], abs=0.01)
    assert 1e3 * found.limb_position == pytest.approx([5, 10, 130], abs=0.01)
    assert found.take.units == unit and found.socket.landmarks.degrees == 3


def test_too_few_frames_are_refused(tmp_path: Path) -> None:
    words = smallest(19, "Meters", tmp_path)
    with pytest.raises(RegistrationError, match="19 of 19 frames show all of"):
        st.register(words[1], words[3], words[5])
