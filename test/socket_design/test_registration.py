"""From static takes to a registered socket: its transforms and their uncertainty."""

import copy
import dataclasses
from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import f, kstest
from support.motive_takes import (
    PYLON_NAMES,
    SOCKET_NAMES,
    Bench,
    between,
    make_bench,
    own_frame_of,
    refused,
    register,
    track,
)
from support.problems import PYLON_TRIAD, SOCKET_TRIAD, random_pose

from socket_testbed.geometry.marker_bodies import edge_lengths, fit_triad
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket, write_socket
from socket_testbed.socket_design.registration import Registration

UNITS = ["Meters", "Centimeters", "Millimeters"]


@pytest.fixture
def rng():
    return np.random.default_rng(23)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("how", [{"newline": "\n"}, {"newline": "\r\n", "bom": True}])
def test_a_take_without_errors_gives_the_truth(rng, tmp_path, unit, how):
    bench = make_bench(rng, noise=0.0, unit=unit)
    found = register(bench, tmp_path, **how)
    digits = {"Meters": 2e-6, "Centimeters": 2e-8, "Millimeters": 2e-9}[unit]  # of the file [m]
    for pose, truth in (
        (found.geometry.socket_body, bench.socket_body),
        (found.geometry.limb, bench.limb),
    ):
        distance, angle = between(pose, truth)
        assert distance < 10.0 * digits and angle < 100.0 * digits
    assert np.linalg.norm(found.limb_position - bench.q) < 5.0 * digits
    edges = edge_lengths(np.array([found.geometry.socket_markers, found.geometry.pylon_markers]))
    np.testing.assert_allclose(
        edges, edge_lengths(np.array([SOCKET_TRIAD, PYLON_TRIAD])), atol=digits * 4
    )
    assert found.geometry.names == bench.geometry.names
    assert not any("moved" in note or "off" in note for note in found.notes)


def test_a_body_of_more_markers_is_registered_as_well_as_its_frame_is_known(rng, tmp_path):
    """Two more markers on the socket; the body's frame is that of the first three."""
    bench = make_bench(rng)
    names, extra = list(SOCKET_NAMES), np.array([[0.02, 0.06, 0.01], [-0.05, 0.01, 0.045]])
    seen = np.array([bench.places[name] for name in SOCKET_NAMES])
    fit = fit_triad(SOCKET_TRIAD, seen[None]).pose
    markers, places = dict(bench.take.markers), Pose(fit.rotation[0], fit.translation[0])
    for k, place in enumerate(places.apply(extra)):
        names.append(f"Socket:Extra{k}")
        markers[names[-1]] = place + rng.normal(0.0, 1e-4, (len(bench.take), 3))
    document = copy.deepcopy(bench.document)
    document["bodies"]["socket"] = names
    larger = dataclasses.replace(
        bench, take=dataclasses.replace(bench.take, markers=markers), document=document
    )
    found = register(larger, tmp_path)
    body = found.geometry.socket_markers
    assert body.shape == (5, 3) and found.geometry.pylon_markers.shape == (3, 3)
    np.testing.assert_allclose(edge_lengths(body[:3]), edge_lengths(SOCKET_TRIAD), atol=2e-4)
    in_cell = found.geometry.socket_body.apply(body)
    true = bench.socket_body.apply(
        own_frame_of(SOCKET_TRIAD).inverse().apply(np.vstack([SOCKET_TRIAD, extra]))
    )
    np.testing.assert_allclose(in_cell, true, atol=5e-4)
    plain = register(bench, tmp_path)
    assert np.trace(found.single) < np.trace(plain.single)  # more markers, less noise
    path = tmp_path / "socket.yaml"
    write_socket(found.geometry, path)
    np.testing.assert_allclose(read_socket(path).socket_markers, body, atol=1e-12)


def later(bench: Bench, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The true triads in a later frame, when all has moved, and the limb in the socket, and q."""
    socket, pylon = (
        np.array([bench.places[name] for name in names]) for names in (SOCKET_NAMES, PYLON_NAMES)
    )
    cell_in_world = own_frame_of(socket) @ bench.socket_body.inverse()
    turn = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix()
    in_cell = Pose(turn, bench.q - turn @ bench.q + rng.normal(0.0, 0.005, 3))
    moved, away = cell_in_world @ in_cell @ cell_in_world.inverse(), random_pose(rng, 1.0)
    return away.apply(socket), away.apply(moved.apply(pylon)), in_cell.apply(bench.q)


def limb_position(found: Registration, socket: np.ndarray, pylon: np.ndarray) -> np.ndarray:
    """What a trial makes of two observed triads."""
    geometry = found.geometry
    in_world = [
        fit_triad(triad, observed[None]).pose
        for triad, observed in ((geometry.socket_markers, socket), (geometry.pylon_markers, pylon))
    ]
    return geometry.limb_pose(*in_world).translation[0]


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("motive", [False, True])
def test_a_later_trial_gives_the_limb_position(rng, tmp_path, motive, swap):
    bench = make_bench(rng, noise=0.0, unit="Millimeters")
    if motive:
        for name, names in (("Socket", SOCKET_NAMES), ("Pylon", PYLON_NAMES)):
            bench = track(bench, name, names, random_pose(rng, 0.05))
            bench.document["bodies"][name.lower()] = {"rigid_body": name}
    found = register(bench, tmp_path)
    socket, pylon, q = later(bench, rng)
    if swap:
        socket, pylon = socket[[1, 0, 2]], pylon[[2, 0, 1]]
    np.testing.assert_allclose(limb_position(found, socket, pylon), q, atol=1e-7)


def test_a_rigid_body_of_motive_keeps_its_frame(rng, tmp_path):
    bench = make_bench(rng, noise=0.0, unit="Millimeters")
    frame = random_pose(rng, 0.05)
    bench = track(bench, "Socket", SOCKET_NAMES, frame)
    bench.document["bodies"]["socket"] = {"rigid_body": "Socket"}
    found = register(bench, tmp_path).geometry
    plain = copy.deepcopy(bench.document)
    plain["bodies"]["socket"] = list(SOCKET_NAMES)
    own = register(dataclasses.replace(bench, document=plain), tmp_path).geometry
    distance, angle = between(own.socket_body @ frame, found.socket_body)
    assert distance < 1e-6 and angle < 1e-5
    distance, angle = between(own.limb, found.limb)
    assert distance == 0.0 and angle < 1e-12


def test_swaps_and_occlusions_of_single_frames_change_nothing(rng, tmp_path):
    bench = make_bench(rng, frames=80)
    calm = register(bench, tmp_path)
    markers = {name: positions.copy() for name, positions in bench.take.markers.items()}
    swapped = [5, 6, 30, 61]
    a, b = (markers[name][swapped].copy() for name in SOCKET_NAMES[:2])
    markers[SOCKET_NAMES[0]][swapped], markers[SOCKET_NAMES[1]][swapped] = b, a
    c, d = (markers[name][[9, 10]].copy() for name in ("Limb:1", "Limb:2"))
    markers["Limb:1"][[9, 10]], markers["Limb:2"][[9, 10]] = d, c
    markers["Cell:3"][40:50] = np.nan
    markers[PYLON_NAMES[2]][:4] = np.nan
    spoilt = dataclasses.replace(bench, take=dataclasses.replace(bench.take, markers=markers))
    found = register(spoilt, tmp_path)
    assert found.socket.still.used.sum() == 70 and found.socket.still.mislabelled == 0
    assert found.pylon.still.used.sum() == 74 and found.pylon.still.jumped == 2
    assert found.socket.still.occluded.tolist() == [0, 0, 0, 0, 0, 0, 10, 0]
    # Other frames, other means: within the noise of means of 80 frames at the levers here.
    assert np.linalg.norm(found.limb_position - calm.limb_position) < 5e-5
    assert between(found.geometry.socket_body, calm.geometry.socket_body)[0] < 5e-5


@pytest.mark.parametrize("landmarks", [3, 5])
def test_the_errors_are_within_the_stated_uncertainty(rng, tmp_path, landmarks):
    """Where the errors of the landmarks' places rule, they are an F of 3, 3k - 6 (nearly: q has
    two such estimates), which holds for the socket's body and the limb's pose."""
    shares: dict[str, list[float]] = {"socket": [], "pylon": [], "q": []}
    for _ in range(120):
        bench = make_bench(rng, frames=20, placement=4e-4, landmarks=landmarks)
        found = register(bench, tmp_path, force=landmarks == 3)  # three nearly level ones
        errors = {
            "socket": found.geometry.socket_body.translation - bench.socket_body.translation,
            "pylon": found.geometry.limb.translation - bench.limb.translation,
            "q": found.limb_position - bench.q,
        }
        turn = found.geometry.limb.rotation
        stated = {
            "socket": found.socket.covariance_at(found.geometry.socket_body.translation),
            "pylon": turn @ found.pylon.covariance_at(np.zeros(3)) @ turn.T,
            "q": found.covariance,
        }
        for name, error in errors.items():
            ratio = error @ np.linalg.solve(stated[name], error) / 3.0
            shares[name].append(f.cdf(ratio, 3, 3 * landmarks - 6))
    assert kstest(shares["socket"], "uniform").pvalue > 1e-3
    assert kstest(shares["pylon"], "uniform").pvalue > 1e-3
    assert 0.35 < np.mean(np.array(shares["q"]) < 0.5) < 0.75


@pytest.mark.slow
def test_the_uncertainty_of_perfect_landmarks_is_that_of_the_markers(rng, tmp_path):
    """Nothing but the markers' noise, which comes in by the landmarks and by the triads."""
    squares, stated = [], []
    for _ in range(100):
        bench = make_bench(rng, unit="Millimeters")
        found = register(bench, tmp_path)
        socket, pylon, q = later(bench, rng)
        squares.append(((limb_position(found, socket, pylon) - q) ** 2).sum())
        stated.append(np.trace(found.covariance))
    # Sigma is never taken below the noise of the means, which makes it a little too large.
    assert 0.6 < np.mean(squares) / np.mean(stated) < 1.2


def errors_of(found: Registration, bench: Bench) -> dict[str, np.ndarray]:
    """Errors of a registration, by what it says of their covariance and in its axes."""
    geometry, in_world, fitted = found.geometry, {}, {}
    for body, names in (("socket", SOCKET_NAMES), ("pylon", PYLON_NAMES)):
        places = np.array([bench.places[name] for name in names])
        markers = geometry.socket_markers if body == "socket" else geometry.pylon_markers
        in_world[body], batch = own_frame_of(places), fit_triad(markers, places[None]).pose
        fitted[body] = Pose(batch.rotation[0], batch.translation[0])
    cell_in_world = in_world["socket"] @ bench.socket_body.inverse()
    no_motion = geometry.socket_body @ fitted["socket"].inverse() @ cell_in_world
    limb = fitted["pylon"].inverse() @ in_world["pylon"] @ bench.limb
    at = geometry.socket_body.translation
    return {
        "socket": no_motion.apply(at) - at,
        "socket's turn": Rotation.from_matrix(no_motion.rotation).as_rotvec(),
        "limb": geometry.limb.translation - limb.translation,
        "limb's turn": Rotation.from_matrix(geometry.limb.rotation @ limb.rotation.T).as_rotvec(),
        "q": geometry.limb_pose(fitted["socket"], fitted["pylon"]).translation - bench.q,
    }


@pytest.mark.slow
def test_every_covariance_has_the_size_and_direction_of_the_errors(tmp_path):
    """One bench, measured again and again, with as much noise by the triads as by landmarks."""
    rng, count = np.random.default_rng(7), 250
    errors, stated = defaultdict(list), defaultdict(list)
    for _ in range(count):
        bench = make_bench(rng, 20, 2e-4, scene=np.random.default_rng(8), unit="Millimeters")
        found = register(bench, tmp_path)
        for name, error in errors_of(found, bench).items():
            errors[name].append(error)
        stated_now = (*found.socket_body_covariances(), *found.limb_covariances(), found.covariance)
        for name, covariance in zip(errors, stated_now, strict=True):
            stated[name].append(covariance)
    for name, samples in errors.items():
        factor = np.linalg.cholesky(np.mean(stated[name], axis=0))
        white = np.cov(np.linalg.solve(factor, np.transpose(samples)))
        # Sigma is never taken below the noise of the means, which makes it a little too large.
        assert np.linalg.eigvalsh(white).min() > 0.65, name
        assert np.linalg.eigvalsh(white).max() < 1.35, name


@pytest.mark.parametrize("landmarks", [3, 5])
def test_landmarks_are_never_surer_than_the_means_of_their_markers(rng, tmp_path, landmarks):
    for _ in range(20):
        bench = make_bench(rng, frames=20, landmarks=landmarks)
        found = register(bench, tmp_path, force=landmarks == 3)  # three nearly level ones
        for body in (found.socket, found.pylon):
            own = np.sqrt((body.landmarks.residual**2).sum() / body.landmarks.degrees)
            assert body.landmarks.noise == pytest.approx(max(own, body.still.noise))


def test_the_noise_of_a_single_frame_is_stated(rng, tmp_path):
    bench = make_bench(rng, frames=500, unit="Millimeters")
    found = register(bench, tmp_path)
    socket, pylon, _ = later(bench, rng)
    trials = [
        limb_position(found, *(triad + rng.normal(0.0, 1e-4, (3, 3)) for triad in (socket, pylon)))
        for _ in range(400)
    ]
    white = np.linalg.solve(np.linalg.cholesky(found.single), np.transpose(trials))
    # The limb has turned a little since the take, and 400 trials give a variance to 7 %.
    sizes = np.linalg.eigvalsh(np.cov(white))
    assert sizes.min() > 0.7 and sizes.max() < 1.35


def test_a_wrong_landmark_is_noted_then_refused_unless_forced(rng, tmp_path):
    bench = make_bench(rng)
    bench.document["limb"]["Limb:2"][0] += 0.006
    found = register(bench, tmp_path)
    assert any(note.startswith("limb: landmark Limb:2 is") for note in found.notes)
    bench.document["limb"]["Limb:2"][0] += 0.03
    error = refused(bench, tmp_path)
    assert "limb: landmark Limb:2 is" in error and "at most 10 mm" in error and "--force" in error
    forced = register(bench, tmp_path, force=True)
    assert forced.pylon.landmarks.residual.max() > 0.01
    assert np.trace(forced.covariance) > 30.0 * np.trace(found.covariance)


def mirror(bench: Bench, axis: int, *sides: str) -> None:
    for side in sides:
        for point in bench.document[side].values():
            point[axis] *= -1.0


def tilt(bench: Bench) -> Bench:
    """The bench with load-cell landmarks in a steep plane, away from which q is."""
    tilted = [[0.05, 0.0, 0.0], [-0.03, 0.04, 0.005], [-0.02, -0.05, 0.09]]
    frame = own_frame_of(np.array([bench.places[n] for n in SOCKET_NAMES]))
    in_world = frame @ bench.socket_body.inverse()
    for name, point in zip(bench.document["load_cell"], tilted, strict=True):
        bench.document["load_cell"][name] = point
        noise = bench.take.markers[name] - bench.places[name]
        bench.take.markers[name] = in_world.apply(np.array(point)) + noise
    return bench


SIDES = [("load_cell",), ("limb",), ("load_cell", "limb")]


@pytest.mark.parametrize("sides", SIDES, ids=" and ".join)
@pytest.mark.parametrize("axis", range(3))
def test_three_landmarks_a_side_are_never_mirrored_unseen(rng, tmp_path, axis, sides):
    bench = tilt(make_bench(rng, frames=20, landmarks=3))
    assert between(register(bench, tmp_path).geometry.socket_body, bench.socket_body)[0] < 1e-3
    mirror(bench, axis, *sides)
    error = refused(bench, tmp_path)
    assert "in one plane" in error and "fourth landmark" in error and "--force" in error
    register(bench, tmp_path, force=True)


def test_three_landmarks_whose_sign_nothing_shows_are_refused_as_they_are(rng, tmp_path):
    """Level ones: the limb would be in the socket with the other sign of z, too."""
    error = refused(make_bench(rng, landmarks=3), tmp_path)
    assert "both in the socket" in error and "fourth landmark" in error


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", ["load_cell", "limb"])
def test_four_mirrored_landmarks_are_not_called_swapped(rng, tmp_path, side, axis):
    bench = make_bench(rng, frames=20, landmarks=4)
    mirror(bench, axis, side)
    error = refused(bench, tmp_path)
    assert "mirrored" in error and "signs" in error and "exchange" not in error
