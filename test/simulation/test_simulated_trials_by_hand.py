"""A simulated trial made by hand, read back message by message; and its live counterpart."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from socket_testbed.errors import TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.simulation import trial as module
from socket_testbed.simulation.trial import GroundTruth, SimulatedTrial, write_simulated_trial
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.truth import read_truth
from socket_testbed.wire import cdr

START = 1_767_258_000_000_000_000  # [ns]; 2026-01-01 09:00 UTC
PERIOD = 250_000_000  # [ns]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[int, Any]]]:
    """Two samples; delay of each message after its trigger [ns] and its content, by topic."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z
    rotations = np.stack([np.eye(3), quarter])
    poses = {
        "socket": Pose(rotations, np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])),
        "pylon": Pose(rotations, np.full((2, 3), np.nan)),
    }
    rest = np.zeros((2, 3))
    made = SimulatedTrial(
        START + PERIOD * np.arange(2),
        {"a": np.arange(8.0).reshape(2, 4), "b": np.array([[5.0] * 4, [5.0, np.nan, 5.0, 5.0]])},
        np.arange(12.0).reshape(2, 6),
        {"socket": np.full((2, 3, 3), 0.5), "pylon": np.full((2, 4, 3), 0.25)},
        poses,
        GroundTruth(("t",), np.zeros((2, 1, 3)), np.zeros((2, 6)), rest, rest),
    )
    path = tmp_path_factory.mktemp("simulated") / "s01"
    write_simulated_trial(made, path)
    found: dict[str, list[tuple[int, Any]]] = {}
    with BagReader(path) as bag:
        for raw in bag.messages():
            message = cdr.decode(raw.data, bag.types[raw.topic])
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            found.setdefault(raw.topic, []).append((raw.time - stamp, message))
            assert stamp in made.stamps
    assert (path / "ground_truth.npz").is_file()
    return found


DELAYS = {
    "/trigger": 0.0,
    "/load_cell/wrench": 3.0,
    "/load_cell/raw": 3.1,
    "/mocap/socket/pose": 8.0,
    "/mocap/pylon/pose": 8.1,
    "/mocap/markers": 8.2,
    "/clusters/capacitance": 17.0,
}


def test_each_measurement_has_its_delay(written: dict[str, list[tuple[int, Any]]]) -> None:
    """In milliseconds, as on hardware."""
    found = {name: [delay for delay, _ in entries] for name, entries in written.items()}
    assert found == {name: [round(1e6 * delay)] * 2 for name, delay in DELAYS.items()}


def test_each_measurement_is_that_of_its_row(written: dict[str, list[tuple[int, Any]]]) -> None:
    last = {name: entries[1][1] for name, entries in written.items()}
    assert [entry.sequence for _, entry in written["/trigger"]] == [0, 1]
    torque, force = last["/load_cell/wrench"].wrench.torque, last["/load_cell/wrench"].wrench.force
    assert (torque.x, torque.y, torque.z, force.x, force.y, force.z) == (6, 7, 8, 9, 10, 11)
    pose = last["/mocap/socket/pose"].pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (4.0, 5.0, 6.0)
    turn = pose.orientation
    half = np.sqrt(0.5)
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0.0, 0.0, half, half))
    assert np.isnan(last["/mocap/pylon/pose"].pose.position.x)
    first, second = last["/clusters/capacitance"].clusters
    assert (first.name, second.name) == ("a", "b")
    assert first.capacitance.tolist() == [4.0, 5.0, 6.0, 7.0]
    assert (first.status.tolist(), second.status.tolist()) == ([0] * 4, [0, 2, 0, 0])
    bodies = last["/mocap/markers"].bodies
    assert [(body.name, len(body.markers)) for body in bodies] == [("socket", 3), ("pylon", 4)]
    assert (bodies[0].markers[2].x, bodies[1].markers[3].z) == (0.5, 0.25)


def test_a_simulated_cell_was_never_tared(written: dict[str, list[tuple[int, Any]]]) -> None:
    """Its ratios give the wrench: the first row of the matrix gives Fx per mV/V."""
    raw = written["/load_cell/raw"][1][1]
    assert (raw.tared.sec, raw.tared.nanosec, raw.status) == (0, 0, 0)
    assert (raw.tare.force.z, raw.tare.torque.x) == (0.0, 0.0)
    rows = np.array([[812.0, 14.0, -6.0, 3.0, -9.0, 5.0], [0.2, -0.4, 0.1, 41.0, 0.5, -0.3]])
    assert rows @ (1e3 * raw.ratios) == pytest.approx([9.0, 6.0])


def test_the_frames_are_those_of_the_contract(written: dict[str, list[tuple[int, Any]]]) -> None:
    frames = {name: entries[0][1].header.frame_id for name, entries in written.items()}
    in_world = {name for name, frame in frames.items() if frame == "world"}
    assert in_world == {"/mocap/socket/pose", "/mocap/pylon/pose", "/mocap/markers"}
    assert {frame for name, frame in frames.items() if name not in in_world} == {"load_cell"}


@pytest.mark.parametrize(
    ("seen", "position"),
    [((1.0, 3.0), 2.0), ((np.nan, 3.0), 3.0), ((np.nan, np.nan), np.nan)],
    ids=["both", "one", "none"],
)
def test_the_mean_pose_ignores_unseen_frames(seen: tuple[float, ...], position: float) -> None:
    shift = np.array(seen)[:, None] * np.ones(3)
    turn = np.where(np.isnan(shift)[:, :, None], np.nan, np.eye(3))
    found = module._mean_poses(Pose(turn, shift), 1)
    np.testing.assert_allclose(found.translation, np.full((1, 3), position))
    expected = np.full((1, 3, 3), np.nan) if np.isnan(position) else np.eye(3)[None]
    np.testing.assert_allclose(found.rotation, expected, atol=1e-12)


def test_streams_are_separate_and_repeatable() -> None:
    first, again = module.random_streams(7), module.random_streams(7)
    drawn = [stream.normal() for stream in first]
    assert drawn == [stream.normal() for stream in again] and len(set(drawn)) == 7
    assert drawn[0] != module.random_streams(8)[0].normal()


def test_a_truth_of_one_time_is_damaged(tmp_path: Path) -> None:
    file = tmp_path / "ground_truth.npz"
    np.savez(file, stamps=np.array([1]), names=np.array(["t"]))
    with pytest.raises(TrialError) as found:
        read_truth(tmp_path)
    assert str(found.value) == (
        f"{file}: is damaged (it has fewer than two times): simulate the trial again, or remove the"
        " file"
    )
