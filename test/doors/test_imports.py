"""A bag of other sensors becomes a trial: values, signs, frames and times by hand."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support import CHECKOUT
from support.foreign import header, pose_fields, pushes, vector, wrench_fields, write_bag
from support.verbs import call
from support.verbs import refused as refused_verb
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import CalibrationError, ConfigurationError, TrialError
from socket_testbed.files import packaged
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.trials.trial import Trial

START = 1_700_000_000_000_000_000  # [ns]
STEP = 10_000_000  # [ns]
ROWS = 101  # one second at 100 Hz
NAN = float("nan")
FT, SOCKET, LIMB, CLUSTERS = "/ft/wrench", "/rig/socket", "/rig/limb", "/uc/capacitances"
NAMES = ("brim_lateral", "distal")


def ramp(row: int) -> np.ndarray:
    """[M; F], of which Fz falls by 1 N in 10 ms, from -100 N."""
    return np.array([1.0, 2.0, 3.0, 10.0, 20.0, -100.0 - row])


def place(row: float) -> np.ndarray:
    """A pose that moves by 1 mm in 10 ms."""
    return np.array([0.001 * row, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8])


def sent(
    fields: Callable[[int], dict[str, Any]],
    frame: str | None = "world",
    late: float = 0.0,
    arrival: int = START,
    more: dict[str, Any] | None = None,
) -> list[tuple[int, dict[str, Any]]]:
    """A second of messages at 100 Hz, with a header if they have a frame."""
    messages = []
    for row in range(ROWS):
        stamp = START + row * STEP + round(1e9 * late)
        stamped = {} if frame is None else {"header": header(stamp, frame)}
        messages.append((arrival + row * STEP, {**stamped, **(more or {}), **fields(row)}))
    return messages


def stamped_wrench(late: float = 0.0, **options: Any) -> tuple[str, Any]:
    fields = lambda row: {"wrench": wrench_fields(ramp(row))}  # noqa: E731
    return "geometry_msgs/msg/WrenchStamped", sent(fields, "ft", late, **options)


def stamped_pose() -> tuple[str, Any]:
    return "geometry_msgs/msg/PoseStamped", sent(lambda row: {"pose": pose_fields(place(row))})


def picofarads(row: int) -> np.ndarray:
    """Four capacitances of each of two clusters; all rise by 0.001 pF in 10 ms."""
    return np.arange(5.0, 5.8, 0.1).reshape(2, 4) + 0.001 * row


def numbers() -> tuple[str, Any]:
    fields = lambda row: {"data": picofarads(row).ravel().tolist()}  # noqa: E731
    return "std_msgs/msg/Float64MultiArray", sent(fields, None)


def opened(path: Path, content: dict[str, Any], **options: Any) -> tuple[Trial, list[str]]:
    """The trial that a bag of these topics becomes, and the notes."""
    notes: list[str] = []
    write_bag(path / "bag", content)
    trial = st.import_trial(path / "bag", path / "trial", notify=notes.append, **options)
    return trial, notes


def wrench_alone(path: Path, content: tuple[str, Any], **options: Any) -> np.ndarray:
    trial, _ = opened(path, {FT: content}, **options)
    return trial.measurements().wrench


WRENCHES = {
    "stamped": stamped_wrench(),
    "plain": ("geometry_msgs/msg/Wrench", sent(lambda row: wrench_fields(ramp(row)), None)),
}


@pytest.mark.parametrize("kind", WRENCHES)
def test_a_wrench_at_triggers(tmp_path: Path, kind: str) -> None:
    """At 0, 0.25, ... 1 s; the ends have no reading before or after but their own."""
    wrench = wrench_alone(tmp_path, WRENCHES[kind])
    expected = np.array([ramp(row) for row in (0, 25, 50, 75, 100)])
    np.testing.assert_allclose(wrench, expected, atol=1e-9)


def test_a_delay_moves_the_values(tmp_path: Path) -> None:
    trial, _ = opened(tmp_path, {FT: stamped_wrench(late=0.02)}, delay={"wrench": 0.02})
    measured = trial.measurements()
    assert measured.stamps[0] == START
    np.testing.assert_allclose(measured.wrench[:, 5], [-100.0, -125.0, -150.0, -175.0, -200.0])


def pushed(late: dict[str, float]) -> dict[str, tuple[str, Any]]:
    """Half a minute of pushes at 50 Hz, and the limb that they move by 0.1 mm/N, 20 ms late."""
    time = np.arange(0.0, 30.0, 0.02)
    forces = pushes(time)
    turn = np.array([0.0, 0.0, 0.0, 1.0])
    wrenches, poses = [], []
    for at, force in zip(START + np.round(1e9 * time).astype(int), forces, strict=True):
        stamps = {name: int(at) + round(1e9 * delay) for name, delay in late.items()}
        wrench = {"wrench": wrench_fields(np.concatenate([0.0 * force, force]))}
        pose = {"pose": pose_fields(np.concatenate([1e-4 * force, turn]))}
        wrenches.append((int(at), {"header": header(stamps["wrench"], "ft"), **wrench}))
        poses.append((int(at), {"header": header(stamps["pylon_pose"], "world"), **pose}))
    types = "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/PoseStamped"
    return {FT: (types[0], wrenches), LIMB: (types[1], poses)}


@pytest.mark.parametrize("source", ["wrench", "pylon_pose"])
def test_the_load_tells_a_delay(tmp_path: Path, source: str) -> None:
    late = {"wrench": 0.0, "pylon_pose": 0.0} | {source: 0.02}
    trial, notes = opened(tmp_path, pushed(late), delay=[f"{source}=auto"], rate=50.0)
    record = yaml.safe_load((trial.path / "import.yaml").read_text())
    assert record[source]["delay"] == pytest.approx(0.02, abs=0.001)
    low, high = record[source]["delay_interval"]
    assert low <= record[source]["delay"] <= high < 0.025
    behind = "pylon pose" if source == "wrench" else "wrench"
    said = [note for note in notes if f"behind the {behind}: " in note]
    assert len(said) == 1 and (": 20." in said[0] or ": 19." in said[0])
    measured = trial.measurements()
    moved = 1e4 * measured.pylon[:, :3]
    expected = pushes((measured.stamps - START) * 1e-9)
    np.testing.assert_allclose(moved[1:-1], expected[1:-1], atol=0.5)
    np.testing.assert_allclose(measured.wrench[1:-1, 3:], expected[1:-1], atol=0.5)


def test_a_force_on_the_limb_is_negated(tmp_path: Path) -> None:
    wrench = wrench_alone(tmp_path, stamped_wrench(), wrench_of="socket")
    np.testing.assert_allclose(wrench[2], [-1.0, -2.0, -3.0, -10.0, -20.0, 150.0])


def test_a_tare_is_subtracted(tmp_path: Path) -> None:
    """From 0.1 to 0.3 s Fz is -110 to -130 N, -120 N in the mean."""
    wrench = wrench_alone(tmp_path, stamped_wrench(), tare="0.1:0.3")
    np.testing.assert_allclose(wrench[2], [0.0, 0.0, 0.0, 0.0, 0.0, -30.0], atol=1e-9)
    record = yaml.safe_load((tmp_path / "trial" / "import.yaml").read_text())
    expected = {"span": "0.1:0.3", "values": [1.0, 2.0, 3.0, 10.0, 20.0, -120.0]}
    assert record["wrench"]["tare"] == expected


def test_another_frame_becomes_the_load_cells(tmp_path: Path) -> None:
    """A cell turned by 90 deg about z, 0.1 m above {S}: F (-20, 10, Fz), M + p x F.

    R M = (-2, 1, 3), and p x F = (0, 0, 0.1) x (-20, 10, -150) = (-1, -2, 0).
    """
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(
        "wrench:\n  pose:\n    rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]\n"
        "    translation: [0, 0, 0.1]\n"
    )
    wrench = wrench_alone(tmp_path, stamped_wrench(), mapping=mapping)
    np.testing.assert_allclose(wrench[2], [-3.0, -1.0, 3.0, -20.0, 10.0, -150.0], atol=1e-9)


def transform(row: int) -> dict[str, Any]:
    value = place(row)
    return {"translation": vector(value[:3]), "rotation": vector(value[3:], "xyzw")}


def tree(row: int) -> dict[str, Any]:
    """A transform among others, whose names begin with a slash at times."""
    own = {"header": header(START + row * STEP, "world"), "transform": transform(row)}
    other = {"header": header(START + row * STEP, "world"), "child_frame_id": "camera"}
    return {"transforms": [other, own | {"child_frame_id": "/rig"}]}


COVARIANCE = [0.0] * 36
POSES = {
    "pose": (SOCKET, stamped_pose()),
    "covariance": (
        SOCKET,
        (
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            sent(lambda row: {"pose": {"pose": pose_fields(place(row)), "covariance": COVARIANCE}}),
        ),
    ),
    "transform": (
        SOCKET,
        (
            "geometry_msgs/msg/TransformStamped",
            sent(lambda row: {"transform": transform(row)}, more={"child_frame_id": "rig"}),
        ),
    ),
    "tree": ("/tf", ("tf2_msgs/msg/TFMessage", sent(tree, None))),
}


@pytest.mark.parametrize("kind", POSES)
def test_a_pose_at_triggers(tmp_path: Path, kind: str) -> None:
    topic, content = POSES[kind]
    source = "tf:world/rig" if topic == "/tf" else topic
    trial, _ = opened(tmp_path, {FT: stamped_wrench(), topic: content}, socket_pose=source,
                      pylon_pose="none")  # fmt: skip
    socket = trial.measurements().socket
    np.testing.assert_allclose(socket[2], [0.05, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8], atol=1e-9)
    assert np.isnan(trial.measurements().pylon).all()


def named_values(row: int) -> dict[str, Any]:
    """Channels of two clusters out of order, beside a temperature."""
    values = picofarads(row)
    order = [(1, 2), (0, 1), (0, 0), (1, 0), (0, 2), (0, 3), (1, 3), (1, 1)]
    return {
        "name": ["temperature", *(f"{NAMES[c]}.{channel}" for c, channel in order)],
        "position": [21.0, *(float(values[c, channel]) for c, channel in order)],
    }


def our_array(row: int) -> dict[str, Any]:
    values = picofarads(row)
    clusters = [
        {"name": name, "capacitance": own.tolist(), "status": [0, 0, 0, 0]}
        for name, own in zip(NAMES, values, strict=True)
    ]
    return {"clusters": clusters}


CAPACITANCES = {
    "array": numbers(),
    "named": ("sensor_msgs/msg/JointState", sent(named_values)),
    "ours": ("socket_testbed_msgs/msg/ClusterCapacitanceArray", sent(our_array)),
}


@pytest.mark.parametrize("kind", CAPACITANCES)
def test_capacitances_at_triggers(tmp_path: Path, kind: str) -> None:
    content = {FT: stamped_wrench(), CLUSTERS: CAPACITANCES[kind]}
    names = NAMES if kind == "array" else ()
    trial, _ = opened(tmp_path, content, clusters=CLUSTERS, names=names)
    measured = trial.measurements()
    own = [measured.clusters.index(name) for name in NAMES]
    np.testing.assert_allclose(measured.capacitance[2, own], picofarads(50), atol=1e-9)
    assert not measured.status.any()


def with_status(row: int, status: int, rows: range) -> dict[str, Any]:
    """Our array, with a status of input 1 of brim_lateral in some rows, where 15 pF stand."""
    fields = our_array(row)
    if row in rows:
        fields["clusters"][0]["capacitance"][1] = 15.0
        fields["clusters"][0]["status"][1] = status
    return fields


def with_bad_input(path: Path, status: int, rows: range) -> Measurements:
    """What is imported of both clusters, brim_lateral first, at 0, 0.25, ... 1 s."""
    content = sent(lambda row: with_status(row, status, rows))
    kind = "socket_testbed_msgs/msg/ClusterCapacitanceArray"
    trial, _ = opened(path, {FT: stamped_wrench(), CLUSTERS: (kind, content)}, clusters=CLUSTERS)
    assert trial.measurements().clusters == NAMES
    return trial.measurements()


@pytest.mark.parametrize("status", [1, 2], ids=["saturated", "missing"])
def test_an_input_without_a_reading_is_missing(tmp_path: Path, status: int) -> None:
    measured = with_bad_input(tmp_path, status, range(ROWS))
    assert np.isnan(measured.capacitance[:, 0, 1]).all()
    assert (measured.status[:, 0, 1] == 2).all()
    others = [0, 2, 3]
    np.testing.assert_allclose(measured.capacitance[2, 0, others], [5.05, 5.25, 5.35], atol=1e-9)
    np.testing.assert_allclose(measured.capacitance[2, 1], [5.45, 5.55, 5.65, 5.75], atol=1e-9)
    assert not measured.status[:, 0, others].any() and not measured.status[:, 1].any()


@pytest.mark.parametrize("status", [1, 2], ids=["saturated", "missing"])
def test_an_input_is_missing_while_it_has_no_reading(tmp_path: Path, status: int) -> None:
    """From 0.4 to 0.6 s; its cluster misses the trigger at 0.5 s, and the other one none."""
    measured = with_bad_input(tmp_path, status, range(40, 61))
    assert measured.status[:, 0, 1].tolist() == [0, 0, 2, 0, 0]
    np.testing.assert_allclose(
        measured.capacitance[:, 0, 1], [5.1, 5.125, NAN, 5.175, 5.2], atol=1e-9
    )
    np.testing.assert_allclose(
        measured.capacitance[:, 1, 1], [5.5, 5.525, 5.55, 5.575, 5.6], atol=1e-9
    )


def test_stresses_come_back(tmp_path: Path) -> None:
    """Normal 20 kPa and shears 3 and -2 kPa of distal: forces 900 mm^2 times these."""
    cluster = {"name": "distal", "normal": 2e4, "shear_x": 3e3, "shear_y": -2e3, "status": 0}
    content = (
        "socket_testbed_msgs/msg/ClusterStressArray",
        sent(lambda row: {"clusters": [cluster]}),
    )
    trial, notes = opened(tmp_path, {FT: stamped_wrench(), CLUSTERS: content})
    geometry = trial.geometry
    expected = geometry.cluster_force("distal", np.array([[2e4, 3e3, -2e3]]))[0]
    np.testing.assert_allclose(trial.samples().local_forces[2, 0], expected, atol=1e-6)
    assert np.linalg.norm(expected) == pytest.approx(9e-4 * np.sqrt(4e8 + 9e6 + 4e6))
    assert any("stored as the capacitances" in note for note in notes)


@pytest.mark.parametrize(
    ("status", "is_lacking"),
    [
        pytest.param(0, False, id="ok"),
        pytest.param(1, True, id="saturated"),
        pytest.param(2, True, id="missing"),
        pytest.param(3, False, id="out of range"),
    ],
)
def test_a_stress_counts_by_its_status(tmp_path: Path, status: int, is_lacking: bool) -> None:
    """A stress of 5 kPa stands in each message, whatever its status."""
    cluster = {"name": "distal", "normal": 5e3, "shear_x": 0.0, "shear_y": 0.0, "status": status}
    other = {"name": "brim_lateral", "normal": 2e4, "shear_x": 0.0, "shear_y": 0.0, "status": 0}
    content = (
        "socket_testbed_msgs/msg/ClusterStressArray",
        sent(lambda row: {"clusters": [other, cluster]}),
    )
    trial, _ = opened(tmp_path, {FT: stamped_wrench(), CLUSTERS: content})
    samples = trial.samples()
    normal = {
        name: trial.geometry.cluster_stress(name, samples.local_forces[2, column])[0]
        for column, name in enumerate(samples.clusters)
    }
    assert normal["brim_lateral"] == pytest.approx(2e4, rel=1e-6)
    assert normal["distal"] == pytest.approx(NAN if is_lacking else 5e3, rel=1e-6, nan_ok=True)


def test_triggers_of_a_topic(tmp_path: Path) -> None:
    camera = [
        (START, {"header": header(START + at * 1_000_000, "camera")}) for at in (103, 555, 901)
    ]
    content = {FT: stamped_wrench(), "/camera/sync": ("sensor_msgs/msg/TimeReference", camera)}
    trial, _ = opened(tmp_path, content, trigger="/camera/sync")
    measured = trial.measurements()
    assert ((measured.stamps - START) // 1_000_000).tolist() == [103, 555, 901]
    np.testing.assert_allclose(measured.wrench[:, 5], [-110.3, -155.5, -190.1], atol=1e-6)


def test_a_clock_set_otherwise_is_corrected(tmp_path: Path) -> None:
    """Stamps an hour behind the arrival: the arrivals count, and a note says it."""
    trial, notes = opened(tmp_path, {FT: stamped_wrench(late=-3600.0)})
    assert trial.measurements().stamps[0] == START
    assert any("+3600.000 s behind" in note for note in notes)


def some_unstamped() -> list[tuple[int, dict[str, Any]]]:
    """Every fifth message but the first and last has no stamp: 19 of 101."""
    messages = stamped_wrench()[1]
    for _, fields in messages[5:96:5]:
        fields["header"] = header(0, "ft")
    return messages


def some_twice() -> list[tuple[int, dict[str, Any]]]:
    """Messages 10, 20 and 30 bear the stamp of the next."""
    messages = stamped_wrench()[1]
    for row in (10, 20, 30):
        messages[row][1]["header"] = messages[row + 1][1]["header"]
    return messages


def late_and_slow() -> list[tuple[int, dict[str, Any]]]:
    """A clock that is 2 s behind."""
    return stamped_wrench(late=-2.0)[1]


NOTED: dict[str, tuple[Any, str]] = {
    "no stamp": (some_unstamped, "19 messages without a stamp are left out"),
    "one stamp twice": (
        some_twice,
        "of 3 readings with the stamp of the next the last counts",
    ),
    "another clock": (
        late_and_slow,
        "its clock is not that of the recording (+2.000 s behind at first, then +0 us more each"
        " second): corrected",
    ),
}


@pytest.mark.parametrize("case", NOTED)
def test_what_was_changed_is_noted(case: str, tmp_path: Path) -> None:
    messages, note = NOTED[case]
    trial, notes = opened(tmp_path, {FT: ("geometry_msgs/msg/WrenchStamped", messages())})
    assert f"{FT}: {note}" in notes
    record = yaml.safe_load((trial.path / "import.yaml").read_text())
    assert record["notes"] == [f"{FT}: {note}"]


def test_a_source_beside_all_triggers_is_refused(tmp_path: Path) -> None:
    """Triggers come 5 to 5.5 s after the wrench begins, which lasts a second."""
    camera = [
        (START, {"header": header(START + 5 * 10**9 + at * STEP, "camera")}) for at in (0, 25, 50)
    ]
    content = {FT: stamped_wrench(), "/sync": ("sensor_msgs/msg/TimeReference", camera)}
    with pytest.raises(TrialError) as caught:
        opened(tmp_path, content, trigger="/sync")
    assert str(caught.value) == (
        f"{FT}: no trigger has readings of the wrench around it (they last from -5 to -4 s after"
        " the first trigger): check its clock and delay, or set its stale in a mapping.yaml"
    )


def test_what_came_in_stays_unchanged(tmp_path: Path) -> None:
    """A topic that is called like the testbed's has another name beside it."""
    content = {"/lab/load_cell/wrench": stamped_wrench(), SOCKET: stamped_pose()}
    trial, _ = opened(tmp_path, content, pylon_pose="none")
    with BagReader(tmp_path / "bag") as before, BagReader(trial.path) as after:
        for name in content:
            kept = f"{name}/original" if name.endswith("load_cell/wrench") else name
            given = [(m.time, m.data) for m in before.messages([name])]
            assert [(m.time, m.data) for m in after.messages([kept])] == given


def test_the_record_states_how_it_was_made(tmp_path: Path) -> None:
    content = {FT: stamped_wrench(late=0.02), CLUSTERS: numbers()}
    trial, _ = opened(tmp_path, content, names=NAMES, rate=20.0, delay=["wrench=0.02"])
    record = yaml.safe_load((trial.path / "import.yaml").read_text())
    assert record["triggers"] == {"rate": 20.0, "number": 21}
    assert record["wrench"] == {
        "topic": FT, "type": "geometry_msgs/msg/WrenchStamped", "delay": 0.02, "method": "line",
        "window": 0.05, "readings_per_trigger": 5.0, "age": 0.0, "missing": 0.0, "of": "limb",
    }  # fmt: skip
    assert record["notes"] == [f"{CLUSTERS}: has no stamps, so the times of its arrival count"]
    assert record["mapping"] == {
        "wrench": {"topic": FT, "delay": 0.02},
        "clusters": {"topic": CLUSTERS, "names": [*NAMES]}, "rate": 20.0,
    }  # fmt: skip


def test_notes_propose_and_tell_what_is_missing(tmp_path: Path) -> None:
    _, notes = opened(
        tmp_path, {FT: stamped_wrench(), SOCKET: stamped_pose(), LIMB: stamped_pose()}
    )
    shown = "(geometry_msgs/msg/WrenchStamped, 101 readings at 100 Hz, frame ft)"
    assert f"wrench: {FT} {shown}" in notes
    assert any(note.startswith(f"socket pose: {SOCKET} (") for note in notes)
    assert any(note.startswith(f"pylon pose: {LIMB} (") for note in notes)
    assert any(note.startswith("no clusters: ") for note in notes)


@pytest.mark.parametrize(("up", "doubted"), [(False, False), (True, True)], ids=["down", "up"])
def test_a_load_that_pulls_is_doubted(tmp_path: Path, up: bool, doubted: bool) -> None:
    content = {FT: stamped_wrench()}
    _, notes = opened(tmp_path, content, wrench_of="socket" if up else "limb")
    assert any("give --wrench-of limb" in note for note in notes) == doubted
    # The median of the loads above half of the largest, 100 to 200 N.
    assert any("(+150 N towards the brim)" in note for note in notes) == doubted


TWO = {FT: stamped_wrench(), "/ft/filtered": stamped_wrench()}
REFUSED: dict[str, tuple[Any, ...]] = {
    "two wrenches": (TWO, {}, TrialError, ("/ft/filtered, /ft/wrench", "--wrench TOPIC")),
    "whose pose": (
        {FT: stamped_wrench(), "/body_1": stamped_pose()},
        {},
        TrialError,
        ("whose pose /body_1 is", "--socket-pose TOPIC and --pylon-pose TOPIC"),
    ),
    "nothing": (
        {"/chatter": ("std_msgs/msg/String", [(START, {"data": "hello"})])},
        {},
        TrialError,
        ("no topic is a wrench", "std_msgs/msg/String"),
    ),
    "unknown topic": (
        {FT: stamped_wrench()},
        {"wrench": "/ft/wrensh"},
        TrialError,
        ("/ft/wrensh of --wrench is not in the bag", f"did you mean '{FT}'?"),
    ),
    "another type": (
        {FT: stamped_wrench()},
        {"socket_pose": FT},
        TrialError,
        ("--socket-pose is a geometry_msgs/msg/WrenchStamped", "PoseStamped"),
    ),
    "no tree": (
        {FT: stamped_wrench()},
        {"socket_pose": "tf:world/rig"},
        TrialError,
        ("holds no tf2_msgs/msg/TFMessage", "record /tf"),
    ),
    "other transform": (
        {FT: stamped_wrench(), "/tf": POSES["tree"][1]},
        {"socket_pose": "tf:world/foot"},
        TrialError,
        ("tf:world/foot: holds no reading of the socket pose",),
    ),
    "no names": (
        {FT: stamped_wrench(), CLUSTERS: numbers()},
        {},
        TrialError,
        ("has 8 values, and 0 clusters are named", "--names"),
    ),
    "not calibrated": (
        {FT: stamped_wrench(), CLUSTERS: numbers()},
        {"names": ["heel", "distal"]},
        CalibrationError,
        (f"the calibration has no cluster heel of the topic {CLUSTERS} (it has ",),
    ),
    "unknown source": (
        {FT: stamped_wrench()},
        {"delay": ["wrnech=1"]},
        ConfigurationError,
        ("delay names 'wrnech'", "did you mean 'wrench'?"),
    ),
    "no seconds": (
        {FT: stamped_wrench()},
        {"delay": ["wrench=soon"]},
        ConfigurationError,
        ("the delay of wrench is 'soon'",),
    ),
    "nothing tells the delay": (
        {FT: stamped_wrench()},
        {"delay": ["wrench=auto"]},
        TrialError,
        ("the delay of the wrench is auto, and no other source",),
    ),
    "no load tells the delay": (
        {SOCKET: stamped_pose()},
        {"delay": ["socket_pose=auto"], "pylon_pose": "none"},
        TrialError,
        ("the delay of the socket pose is auto, and there is no wrench",),
    ),
    "no limb tells the delay": (
        {FT: stamped_wrench(), SOCKET: stamped_pose()},
        {"delay": ["socket_pose=auto"], "pylon_pose": "none"},
        TrialError,
        ("the delay of the socket pose is auto, and there is no pose of the pylon",),
    ),
    "tare in words": (
        {FT: stamped_wrench()},
        {"tare": "start"},
        ConfigurationError,
        ("--tare is 'start'", "give seconds as T0:T1"),
    ),
    "tare of no time": (
        {FT: stamped_wrench()},
        {"tare": "5:6"},
        TrialError,
        ("/ft/wrench has no reading in the span 5:6 s of the tare", "between 0 and 1 s"),
    ),
    "rate and trigger": (
        {FT: stamped_wrench()},
        {"rate": 4.0, "trigger": FT},
        ConfigurationError,
        ("rate and trigger are both given",),
    ),
    "no trigger": (
        {FT: stamped_wrench()},
        {"trigger": "/sync"},
        TrialError,
        ("/sync of --trigger holds no message",),
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_imported_is_refused(tmp_path: Path, case: str) -> None:
    content, options, kind, words = REFUSED[case]
    with refused(kind, *words):
        opened(tmp_path, content, **options)
    assert not (tmp_path / "trial").exists()


def test_the_page_s_mapping_is_read(tmp_path: Path) -> None:
    """The mapping of docs/foreign-data.md, on a bag of its topics."""
    page = (CHECKOUT / "docs" / "foreign-data.md").read_text()
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(page.partition("```yaml\n")[2].partition("```")[0].replace("0:3", "0:0.2"))

    def body(name: str, row: int) -> dict[str, Any]:
        stamped = {"header": header(START + row * STEP, "world"), "child_frame_id": name}
        return stamped | {"transform": transform(row)}

    both = sent(lambda row: {"transforms": [body("socket", row), body("pylon", row)]}, None)
    content = {
        "/ft_sensor/wrench": stamped_wrench(late=0.004),
        "/tf": ("tf2_msgs/msg/TFMessage", both),
        "/clusters_uc": numbers(),
    }
    trial, _ = opened(tmp_path, content, mapping=mapping)
    measured = trial.measurements()
    # Fz of the limb is minus that of the socket less its tare, -110 N: 40 N at 0.5 s.
    row = int(np.argmin(np.abs(measured.stamps - START - 50 * STEP)))
    moved = (measured.stamps[row] - START) / STEP
    np.testing.assert_allclose(measured.wrench[row, 5], moved - 10.0, atol=0.01)
    np.testing.assert_allclose(measured.pylon[row, :3], place(moved)[:3], atol=1e-6)


def alike(path: Path, model: Trial, content: dict[str, Any], **options: Any) -> Trial:
    """The trial that another bag becomes like a model."""
    bag = write_bag(path / "bag_2", content)
    return st.import_trial(bag, path / "like", like=model.path, notify=print, **options)


OPTIONS: dict[str, Any] = {
    "delay": ["wrench=0.02"], "rate": 20.0, "wrench_of": "socket", "tare": "0.1:0.3",
    "names": NAMES, "socket_pose": SOCKET, "pylon_pose": "none",
}  # fmt: skip


def test_a_trial_is_imported_like_another(tmp_path: Path) -> None:
    """All options count again, and so does the socket, whose first tile was moved."""
    socket = tmp_path / "socket.yaml"
    document = yaml.safe_load(packaged("config", "socket.yaml").read_text())
    first = next(iter(document["tiles"].values()))
    first["anchor"][2] += 0.001
    socket.write_text(yaml.safe_dump(document))
    content = {FT: stamped_wrench(late=0.02), SOCKET: stamped_pose(), CLUSTERS: numbers()}
    model, _ = opened(tmp_path, content, geometry=socket, **OPTIONS)
    trial = alike(tmp_path, model, {**content, "/other": stamped_wrench(), LIMB: stamped_pose()})
    first_record, record = (
        yaml.safe_load((own.path / "import.yaml").read_text()) for own in (model, trial)
    )
    assert record["from"] == "bag_2"
    assert {**record, "from": "bag"} == first_record
    assert (trial.path / "socket.yaml").read_bytes() == socket.read_bytes()
    np.testing.assert_array_equal(trial.measurements().wrench, model.measurements().wrench)


def test_options_win_over_the_trial_they_follow(tmp_path: Path) -> None:
    content = {FT: stamped_wrench(), SOCKET: stamped_pose(), "/other": stamped_wrench()}
    given = {**OPTIONS, "wrench": FT, "delay": ["wrench=0.03"]}
    model, _ = opened(tmp_path, content, **given)
    trial = alike(tmp_path, model, content, wrench="/other", rate=5.0, delay=["wrench=0.01"])
    record = yaml.safe_load((trial.path / "import.yaml").read_text())
    used = (record["wrench"]["topic"], record["wrench"]["delay"], record["triggers"]["rate"])
    assert used == ("/other", 0.01, 5.0) and record["wrench"]["of"] == "socket"


def test_a_delay_that_was_found_is_used_again(tmp_path: Path) -> None:
    model, _ = opened(tmp_path, pushed({"wrench": 0.0, "pylon_pose": 0.02}), rate=50.0,
                      delay=["pylon_pose=auto"])  # fmt: skip
    found = yaml.safe_load((model.path / "import.yaml").read_text())["pylon_pose"]["delay"]
    trial = alike(tmp_path, model, {FT: stamped_wrench(), LIMB: stamped_pose()})
    record = yaml.safe_load((trial.path / "import.yaml").read_text())["pylon_pose"]
    assert record["delay"] == found and "delay_interval" not in record


def test_topics_that_another_bag_lacks_are_named(tmp_path: Path) -> None:
    content = {FT: stamped_wrench(), SOCKET: stamped_pose(), CLUSTERS: numbers()}
    options = {**OPTIONS, "trigger": SOCKET}
    del options["rate"]
    model, _ = opened(tmp_path, content, **options)
    words = f"holds no message of {SOCKET} of --socket-pose and {CLUSTERS} of --clusters"
    with refused(TrialError, f"{words} and {SOCKET} of --trigger: name other topics"):
        alike(tmp_path, model, {FT: stamped_wrench()})


def test_only_an_imported_trial_is_followed(tmp_path: Path) -> None:
    model, _ = opened(tmp_path, {FT: stamped_wrench()})
    record = model.path / "import.yaml"
    with refused(ConfigurationError, "mapping and like are both given"):
        alike(tmp_path, model, {FT: stamped_wrench()}, mapping=record)
    for text, words in (("from: bag\n", "states no mapping: import that"), (None, "holds no imp")):
        record.unlink() if text is None else record.write_text(text)
        with refused(ConfigurationError, words):
            st.import_trial(tmp_path / "bag", tmp_path / "like", like=model.path)


def test_the_verb_makes_the_same_trial(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "bag", {FT: stamped_wrench(late=0.02)})
    code, out, err = call(
        capsys, "import", bag, "-o", tmp_path / "trial", "--rate", 20, "--delay", "wrench=0.02"
    )
    assert code == 0, err
    assert out.startswith(f"{tmp_path / 'trial'}: 21 samples in 1.00 s, 0 clusters")
    assert f"note: wrench: {FT} (" in err
    wrench = st.open_trial(tmp_path / "trial").measurements().wrench
    np.testing.assert_allclose(wrench[1], [1.0, 2.0, 3.0, 10.0, 20.0, -105.0])
    line = refused_verb(capsys, "import", bag, "-o", tmp_path / "trial", named=["exists already"])
    assert "name another output" in line
