"""What the readings of a trial show: each rule on a written trial, and the sound one is good."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bags import copying

import socket_testbed as st
from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.simulation.trial import SimulatedTrial, simulate, write_simulated_trial
from socket_testbed.trials import raw_check
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics
from socket_testbed.wire.cdr import decode, encode, make_message, stamp_of
from socket_testbed.wire.messages import load_cell_raw_packer

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
COUNT = 120  # 30 s at 4 Hz
FROZEN = slice(20, 60)  # 40 readings in 9.75 s


@pytest.fixture(scope="module")
def simulated() -> SimulatedTrial:
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    return simulate(GEOMETRY, calibration, "ramp", 30.0, 4.0, 7)


def written(trial: SimulatedTrial, path: Path) -> list[tuple[str, str]]:
    write_simulated_trial(trial, path / "trial")
    return [(found.source, found.fact) for found in Trial(path / "trial").problems()]


Damage = Callable[[SimulatedTrial], SimulatedTrial]


def of_cluster(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda trial: replace(
        trial, capacitance={**trial.capacitance, name: change(trial.capacitance[name].copy())}
    )


def of_body(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    def damage(trial: SimulatedTrial) -> SimulatedTrial:
        pose = Pose.from_vector(change(trial.poses[name].vector.copy()))
        return replace(trial, poses={**trial.poses, name: pose})

    return damage


def of_wrench(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda trial: replace(trial, wrench=change(trial.wrench.copy()))


def frozen(*columns: int, rows: slice = FROZEN) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        for column in columns or range(values.shape[1]):
            values[rows, column] = values[rows, column][0]
        return values

    return change


def repeated(values: np.ndarray) -> np.ndarray:
    """Every second reading is the one before."""
    values[1::2] = values[::2]
    return values


def noisy(values: np.ndarray) -> np.ndarray:
    values[:, 1] += np.random.default_rng(0).normal(0.0, 0.1, len(values))
    return values


def peaked(channel: int, size: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(wrench: np.ndarray) -> np.ndarray:
        wrench[:, channel] *= size / np.sort(np.abs(wrench[:, channel]))[-3]
        return wrench

    return change


def without(name: str) -> Damage:
    return lambda trial: replace(
        trial, capacitance={k: v for k, v in trial.capacitance.items() if k != name}
    )


ALL = slice(None)
DAMAGED: dict[str, tuple[Damage, str, str]] = {
    "input": (of_cluster("distal", frozen(2)), "distal", "input 2 does not change for 9.8 s"),
    "input-always": (
        of_cluster("mid_anterior", frozen(1, rows=ALL)),
        "mid_anterior",
        "its input 1 does not change for 29.8 s",
    ),
    "inputs": (
        of_cluster("distal", frozen(0, 3)),
        "distal",
        "its inputs 0, 3 do not change for 9.8 s",
    ),
    "inputs-one-for-longer": (
        of_cluster("distal", lambda read: frozen(3, rows=ALL)(frozen(0)(read))),
        "distal",
        "its inputs 0, 3 do not change for 9.8 s",
    ),
    "socket": (
        of_body("socket", frozen()),
        "the limb pose",
        "the pose of the socket does not change for 9.8 s",
    ),
    "pylon": (
        of_body("pylon", frozen(rows=ALL)),
        "the limb pose",
        "the pose of the pylon does not change for 29.8 s",
    ),
    "position-alone": (
        of_body("pylon", frozen(0, 1, 2, rows=ALL)),
        "the limb pose",
        "the pose of the pylon does not change for 29.8 s",
    ),
    "orientation-alone": (
        of_body("socket", frozen(3, 4, 5, 6, rows=ALL)),
        "the limb pose",
        "the pose of the socket does not change for 29.8 s",
    ),
    "repeating-cluster": (
        of_cluster("brim_lateral", repeated),
        "brim_lateral",
        "50 % of its readings repeat the one before",
    ),
    "repeating-pose": (
        of_body("pylon", repeated),
        "the limb pose",
        "50 % of its readings repeat the one before",
    ),
    "repeating-wrench": (
        of_wrench(repeated),
        "the wrench",
        "50 % of its readings repeat the one before",
    ),
    "noisy-input": (
        of_cluster("distal", noisy),
        "distal",
        "the noise of its input 1 is 0.",
    ),
    "same-cluster": (
        lambda trial: of_cluster("distal", lambda _: trial.capacitance["mid_anterior"])(trial),
        "distal",
        "4 inputs read the same as those of mid_anterior",
    ),
    "same-input": (
        of_cluster("distal", lambda read: read[:, [0, 0, 2, 3]]),
        "distal",
        "an input reads the same as another one",
    ),
    "no-message": (
        without("distal"),
        "distal",
        "socket.yaml declares it, and no message contains it",
    ),
    # The simulated cell: 2000 N along z, 50 N m.
    "overload": (
        of_wrench(peaked(5, 2776.0)),
        "the load cell",
        "Fz is above 130 % of its full scale of 2000 N",
    ),
    "moment": (
        of_wrench(peaked(1, 56.0)),
        "the load cell",
        "My is above 110 % of its full scale of 50 N m",
    ),
}


def test_a_sound_trial_has_good_readings(simulated, tmp_path: Path) -> None:
    assert written(simulated, tmp_path) == []


@pytest.mark.parametrize("case", DAMAGED)
def test_a_written_trial_names_its_source(simulated, tmp_path: Path, case: str) -> None:
    damage, source, fact = DAMAGED[case]
    found = written(damage(simulated), tmp_path)
    assert any(name == source and fact in text for name, text in found), found
    assert {name for name, _ in found} <= {source, "the wrench"}, found


def test_a_noisy_input_is_set_against_the_others(simulated, tmp_path: Path) -> None:
    """0.1 pF, and simulated inputs have 0.002 pF."""
    damage, _, _ = DAMAGED["noisy-input"]
    texts = [text for _, text in written(damage(simulated), tmp_path) if "noise of its" in text]
    (found,) = [re.search(r"is ([\d.]+) pF, (\d+) times that of its others", t) for t in texts]
    assert found is not None
    assert float(found[1]) == pytest.approx(0.1, rel=0.2)
    assert float(found[2]) == pytest.approx(50.0, rel=0.3)


def with_ratio(trial: SimulatedTrial, ratio: float, folder: Path) -> Trial:
    """A copy whose bridge 4 always reads `ratio`, beside the same wrenches."""
    write_simulated_trial(trial, folder / "trial")
    pack = load_cell_raw_packer()
    with copying(folder / "trial", folder / "copy") as (old, new):
        for raw in old.messages():
            data = raw.data
            if raw.topic == "/load_cell/raw":
                message = decode(raw.data, raw.type)
                ratios = message.ratios.copy()
                ratios[3] = ratio
                data = pack(stamp_of(message), ratios, np.zeros(6), 0, 0)
            new.write(raw.topic, raw.time, data)
    return Trial(folder / "copy")


@pytest.mark.parametrize(
    ("ratio", "fact"),
    [
        pytest.param(0.25, "the ratio of bridge 4 does not change for 29.8 s", id="still"),
        pytest.param(
            np.nan,
            "100 % of the ratios of bridge 4 are missing beside a complete wrench",
            id="missing",
        ),
    ],
)
def test_a_faulty_bridge_is_named(simulated, tmp_path: Path, ratio: float, fact: str) -> None:
    (found,) = with_ratio(simulated, ratio, tmp_path).problems()
    assert found.source == "the load cell"
    assert found.fact == fact


def test_the_capacity_is_that_of_the_cell(simulated, tmp_path: Path) -> None:
    """277 N on a cell of 100 N; the same load on one of 2000 N is good."""
    write_simulated_trial(simulated, tmp_path / "trial")
    stored = tmp_path / "trial" / "testbed.yaml"
    cell = read_testbed(stored).load_cell_node
    assert not Trial(tmp_path / "trial").problems()
    text = stored.read_text().replace("2000.0", "100.0")
    assert text != stored.read_text() and cell.full_scale[2] == 2000.0
    stored.write_text(text)
    (found,) = Trial(tmp_path / "trial").problems()
    assert found.fact == "Fz is above 270 % of its full scale of 100 N"
    assert "full_scale in testbed.yaml" in found.hint


def test_a_wrench_unlike_its_ratios_is_named(simulated, tmp_path: Path) -> None:
    """Another gain of bridge 3 in the trial's testbed.yaml than while it was recorded."""
    write_simulated_trial(simulated, tmp_path / "trial")
    stored = tmp_path / "trial" / "testbed.yaml"
    stored.write_text(stored.read_text().replace("1630.0", "1300.0"))
    (found,) = Trial(tmp_path / "trial").problems()
    assert found.source == "the load cell"
    assert found.fact.startswith("100 % of the wrenches are not what its ratios and its matrix say")


# --- what the nodes reported


def reporting(
    trial: SimulatedTrial, path: Path, states: list[tuple[float, int, str, str]]
) -> Trial:
    """A trial with diagnostics: times [s] since the first sample, levels, nodes and messages."""
    write_simulated_trial(trial, path / "trial")
    first = int(trial.stamps[0])
    with copying(path / "trial", path / "reported") as (old, new):
        new.add_topic("/diagnostics", topics.DIAGNOSTICS)
        for raw in old.messages():
            new.write(raw.topic, raw.time, raw.data)
        for time, level, name, message in states:
            stamp = first + round(time * 1e9)
            at = dict(zip(("sec", "nanosec"), divmod(stamp, 10**9), strict=True))
            status = {"level": level, "name": name, "message": message}
            made = make_message(topics.DIAGNOSTICS.type, header={"stamp": at}, status=[status])
            new.write("/diagnostics", stamp, encode(made, topics.DIAGNOSTICS.type))
    return Trial(path / "reported")


OVERLOAD = "Fz is above 130 % of its full scale of 2000 N: unload the cell"


def test_a_reported_error_is_told_again(simulated, tmp_path: Path) -> None:
    states = [
        (float(k), 2 if 5 <= k <= 12 else 0, "/lab/load_cell_node", OVERLOAD) for k in range(20)
    ]
    (found,) = reporting(simulated, tmp_path, states).problems()
    assert found.source == "load_cell_node"
    assert found.fact == (
        "it reported an ERROR from 5 to 12 s: Fz is above 130 % of its full scale of 2000 N"
    )
    assert found.hint == "unload the cell"


@pytest.mark.parametrize(
    "state",
    [
        pytest.param((5.0, 1, "/cluster_node", "a warning: look"), id="warning"),
        pytest.param((-3.0, 2, "/cluster_node", "a bus hangs: check it"), id="before"),
        pytest.param((40.0, 2, "/cluster_node", "a bus hangs: check it"), id="after"),
        pytest.param((5.0, 2, "/estimator_node", "no fit: wait"), id="estimator"),
    ],
)
def test_other_reports_are_not_told(simulated, tmp_path: Path, state) -> None:
    assert reporting(simulated, tmp_path, [state]).problems() == ()


def test_a_report_without_hint_has_one(simulated, tmp_path: Path) -> None:
    (found,) = reporting(simulated, tmp_path, [(5.0, 2, "camera", "broken")]).problems()
    assert (found.source, found.fact) == ("camera", "it reported an ERROR at 5 s: broken")


# --- parts


def test_coarse_steps_are_no_repetitions(rng: np.random.Generator) -> None:
    """Rounded noise repeats by chance and comes back; an old value does not."""
    coarse = np.round(rng.normal(0.0, 0.5, (400, 1)))
    assert (np.diff(coarse, axis=0) == 0.0).mean() > 0.3
    assert raw_check._repeated(coarse) == 0.0
    fine = rng.normal(size=(400, 4))
    assert raw_check._repeated(fine) == 0.0
    assert raw_check._repeated(repeated(fine.copy())) == 0.5


def test_a_left_out_cluster_is_not_reported(simulated, tmp_path: Path) -> None:
    write_simulated_trial(of_cluster("distal", frozen(2))(simulated), tmp_path / "trial")
    left = ("distal.Fx", "distal.Fy", "distal.Fz")
    assert Trial(tmp_path / "trial").problems() and not Trial(tmp_path / "trial").problems(left)


def test_the_check_is_the_same_everywhere(simulated, tmp_path: Path) -> None:
    write_simulated_trial(of_cluster("distal", frozen(2))(simulated), tmp_path / "trial")
    assert st.check_data(tmp_path / "trial") == Trial(tmp_path / "trial").problems()


# --- quaternions


def quaternions(places: list[int], sign: float = 1.0) -> Callable[[np.ndarray], np.ndarray]:
    """Poses whose quaternions have x, y, z and w from these places, the first three by a sign."""

    def change(poses: np.ndarray) -> np.ndarray:
        poses[:, 3:] = poses[:, 3:][:, places] * [sign, sign, sign, 1.0]
        return poses

    return change


QUATERNIONS = {
    "w first": (quaternions([3, 0, 1, 2]), "written as (w, x, y, z)"),
    "w first, read as last": (quaternions([1, 2, 3, 0]), "written as (y, z, w, x)"),
    "inverted": (quaternions([0, 1, 2, 3], -1.0), "those of the world in the body"),
}


@pytest.mark.parametrize("case", QUATERNIONS)
@pytest.mark.parametrize("body", ["socket", "pylon"])
def test_another_quaternion_is_named_with_its_order(
    body: str, case: str, simulated: SimulatedTrial, tmp_path: Path
) -> None:
    """And nothing else is judged by the pose."""
    change, how = QUATERNIONS[case]
    fact = f"the {body} turns as its markers do if its quaternions are {how}"
    assert written(of_body(body, change)(simulated), tmp_path) == [("the limb pose", fact)]


def test_a_quaternion_of_other_axes_is_left_to_others() -> None:
    """A body that is turned by 0.5 rad against its markers is none of these."""
    turns = Rotation.from_rotvec(np.linspace(0.0, 0.4, 12)[:, None] * [0.5, 1.0, -0.3] + 0.3)
    other = turns * Rotation.from_rotvec([0.0, 0.0, 0.5])
    shown = Pose(turns.as_matrix(), np.zeros((12, 3)))
    assert raw_check._other_quaternion(other.as_quat(), shown) == ""
    assert raw_check._other_quaternion(turns.as_quat(), shown) == ""
    first = turns.as_quat()[:, [3, 0, 1, 2]]
    assert raw_check._other_quaternion(first, shown) == "written as (w, x, y, z)"
    few = Pose(turns.as_matrix()[:9], np.zeros((9, 3)))
    assert raw_check._other_quaternion(first[:9], few) == ""
