"""Poses of rigid bodies from the messages of mocap4r2's drivers, whose definition changed."""

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from support.foreign import header, wrench_fields
from support.rigid_bodies import DEFINITIONS, KIND, Body, message, types_of
from support.wording import refused

import socket_testbed as st
from socket_testbed.alignment.series import PoseSeries
from socket_testbed.errors import TrialError
from socket_testbed.trials import foreign
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import cdr

START, STEP = 1_700_000_000_000_000_000, 10_000_000  # [ns]
ROWS = 101  # one second at 100 Hz
FT, BODIES = "/ft/wrench", "/rigid_bodies"
WRENCH = "geometry_msgs/msg/WrenchStamped"
LOST, LOST_WITH_TURN = [0.0] * 7, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def place(row: float) -> list[float]:
    """A pose that moves by 1 mm in 10 ms."""
    return [0.001 * row, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8]


def bodies(row: int, names: Sequence[str] = ("socket.socket", "limb.limb")) -> list[Body]:
    """Two bodies, 0.1 m apart, whose number of markers changes from message to message."""
    other = [0.001 * row + 0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8]
    return [Body(names[0], place(row), row % 3), Body(names[1], other, row % 5)]


def frames(
    definition: str, names: Sequence[str] = ("socket.socket", "limb.limb")
) -> list[RawMessage]:
    times = [START + row * STEP for row in range(ROWS)]
    return [message(definition, at, bodies(row, names)) for row, at in enumerate(times)]


def wrenches() -> list[RawMessage]:
    content = {"wrench": wrench_fields(np.array([0.0, 0.0, 0.0, 1.0, 2.0, -100.0]))}
    times = [START + row * STEP for row in range(ROWS)]
    return [
        RawMessage(FT, WRENCH, at, cdr.encode(
            cdr.make_message(WRENCH, header=header(at, "ft"), **content), WRENCH
        ))
        for at in times
    ]  # fmt: skip


def recorded(
    path: Path, messages: Sequence[RawMessage], definition: str, storage: StoragePlugin, told: bool
) -> Path:
    """A bag as ROS 2 writes it, of Jazzy with the definitions of types, of Humble without."""
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for raw in sorted(messages, key=lambda raw: raw.time):
            if raw.topic not in connections:
                connections[raw.topic] = writer.add_connection(
                    raw.topic, raw.type, typestore=types_of(definition)
                )
            writer.write(connections[raw.topic], raw.time, raw.data)
    if not told:
        (file,) = path.glob("*.db3")
        with sqlite3.connect(file) as database:
            database.execute("DELETE FROM message_definitions")
        database.close()
    return path


def opened(path: Path, messages: Sequence[RawMessage], **options: Any) -> Trial:
    definition = options.pop("definition", "present")
    storage, told = options.pop("storage", StoragePlugin.MCAP), options.pop("told", True)
    bag = recorded(path / "bag", [*wrenches(), *messages], definition, storage, told)
    return st.import_trial(bag, path / "trial", notify=options.pop("notify", print), **options)


@pytest.mark.parametrize("storage", StoragePlugin, ids=lambda plugin: plugin.name.lower())
@pytest.mark.parametrize("definition", DEFINITIONS)
def test_bodies_are_read_by_the_recording_s_definition(
    tmp_path: Path, definition: str, storage: StoragePlugin
) -> None:
    notes: list[str] = []
    sent = frames(definition)
    trial = opened(tmp_path, sent, definition=definition, storage=storage, notify=notes.append)
    measured = trial.measurements()
    np.testing.assert_allclose(measured.socket[2], place(50), atol=1e-9)
    np.testing.assert_allclose(measured.pylon[2, :3], [0.15, 0.2, 0.3], atol=1e-9)
    described = f"socket pose: {BODIES}:socket.socket ({KIND}, 101 readings at 100 Hz, frame map)"
    assert described in notes
    record = yaml.safe_load((trial.path / "import.yaml").read_text())
    assert record["pylon_pose"]["topic"] == f"{BODIES}:limb.limb"


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_the_trial_keeps_bodies_and_their_definition(tmp_path: Path, definition: str) -> None:
    sent = frames(definition)
    trial = opened(tmp_path, sent, definition=definition)
    with BagReader(trial.path) as bag:
        kept = list(bag.messages([BODIES]))
    assert [(own.time, own.data) for own in kept] == [(own.time, own.data) for own in sent]
    named = {
        "wrench": FT,
        "socket_pose": f"{BODIES}:socket.socket",
        "pylon_pose": "none",
        "clusters": "none",
    }
    again = st.import_trial(trial.path, tmp_path / "again", **named, notify=print)
    np.testing.assert_allclose(again.measurements().socket[2], place(50), atol=1e-9)


def test_the_library_agrees_on_the_stored_definition(tmp_path: Path) -> None:
    """What the trial stores is the type that rosbags knows, by its hash."""
    trial = opened(tmp_path, frames("first"), definition="first")
    stated = yaml.safe_load((trial.path / "metadata.yaml").read_text())
    topics = stated["rosbag2_bagfile_information"]["topics_with_message_count"]
    hashes = {own["topic_metadata"]["name"]: own["topic_metadata"]["type_description_hash"]
              for own in topics}  # fmt: skip
    assert hashes[BODIES] == types_of("first").hash_rihs01(KIND)


def test_a_recording_without_definitions_tells_what_to_do(tmp_path: Path) -> None:
    """As those of ROS 2 Humble in SQLite."""
    options = {"storage": StoragePlugin.SQLITE3, "told": False}
    with refused(TrialError, f"{BODIES}: the definition of {KIND} is not known", "'ros2 bag conv"):
        opened(tmp_path, frames("present"), **options)


@pytest.fixture(params=[0, 8], ids=["one by one", "by layout"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways in which messages are read: the first where more layouts differ."""
    monkeypatch.setattr(foreign, "_MAX_BODY_LAYOUTS", request.param)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("lost", [LOST, LOST_WITH_TURN, None], ids=["zeros", "no place", "absent"])
def test_a_body_out_of_sight_has_no_reading(lost: list[float] | None) -> None:
    """The second of three messages lacks it."""
    seen = [[Body("a", place(row))] for row in range(3)]
    seen[1] = [] if lost is None else [Body("a", lost)]
    sent = [message("present", START + row * STEP, own) for row, own in enumerate(seen)]
    series = foreign.read_source("socket_pose", f"{BODIES}:a", {BODIES: sent}).series
    assert isinstance(series, PoseSeries)
    assert ((series.times - START) // STEP).tolist() == [0, 2]
    np.testing.assert_allclose(series.positions[:, 0], [0.0, 0.002])


@pytest.mark.usefixtures("way")
def test_a_body_s_own_stamp_counts() -> None:
    """The message is stamped 3 ms later than the body's capture, where the body has a stamp."""
    sent = [
        message("first", START + row * STEP + 3_000_000, [Body("a", place(row), 0, stamp)])
        for row, stamp in enumerate([START, START + STEP])
    ]
    found = foreign.read_source("socket_pose", f"{BODIES}:a", {BODIES: sent}).series
    assert (found.times - START).tolist() == [0, STEP]


def test_bodies_of_one_frame_as_triggers() -> None:
    sent = [message("present", START + row * STEP, bodies(row)) for row in (0, 2, 5)]
    assert ((foreign.read_stamps(sent) - START) // STEP).tolist() == [0, 2, 5]


@pytest.mark.usefixtures("way")
def test_damaged_messages_are_left_out() -> None:
    sent = frames("present")
    sent[3] = sent[3]._replace(data=sent[3].data[:-20])
    found = foreign.read_source("socket_pose", f"{BODIES}:limb.limb", {BODIES: sent})
    assert len(found.series.times) == ROWS - 1
    assert found.notes == (f"{BODIES}: 1 messages cannot be decoded, and are left out",)


UNCLEAR: dict[str, tuple[Sequence[str], dict[str, str], tuple[str, ...]]] = {
    "numbers as names": (
        ("1", "2"), {},
        (f"cannot tell whose pose {BODIES}:1, {BODIES}:2 is", "--socket-pose TOPIC and --pylon"),
    ),
    "two sockets": (
        ("socket.brim", "socket.tip"), {"pylon_pose": "none"},
        (f"{BODIES}:socket.brim, {BODIES}:socket.tip may each be the socket pose",),
    ),
    "no such body": (
        ("socket", "limb"), {"socket_pose": f"{BODIES}:sokket"},
        (f"{BODIES}: no body is called sokket (there are: socket, limb)", "did you mean 'socket'"),
    ),
    "no body": (
        ("socket", "limb"), {"socket_pose": BODIES},
        (f"{BODIES} of --socket-pose is a {KIND}", f"name one of its bodies, such as {BODIES}:s"),
    ),
    "a body of a wrench": (
        ("socket", "limb"), {"wrench": f"{FT}:a"}, (f"--wrench is '{FT}:a'", "give a topic"),
    ),
    "a body of another type": (
        ("socket", "limb"), {"socket_pose": f"{FT}:a"},
        (f"{FT} of --socket-pose is a {WRENCH}", f"name a topic of type {KIND}"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", UNCLEAR)
def test_bodies_that_do_not_suit_are_refused(tmp_path: Path, case: str) -> None:
    names, options, words = UNCLEAR[case]
    with refused(TrialError, *words):
        opened(tmp_path, frames("present", names), **options)


def test_a_body_that_is_never_tracked_is_refused(tmp_path: Path) -> None:
    sent = [message("present", START, [Body("socket", LOST), Body("limb", place(0))])]
    with refused(TrialError, f"{BODIES}: the body socket is not tracked", "into view"):
        opened(tmp_path, sent)


class Fields:
    """A message class of ROS, of which the fields alone matter."""

    def __init__(self, **fields: str) -> None:
        self._fields = fields

    def get_fields_and_field_types(self) -> dict[str, str]:
        return self._fields


CLASSES = {
    KIND: Fields(
        header="std_msgs/Header", frame_number="uint32",
        rigidbodies="sequence<mocap4r2_msgs/RigidBody>",
    ),
    "mocap4r2_msgs/msg/RigidBody": Fields(
        rigid_body_name="string", markers="sequence<mocap4r2_msgs/Marker>",
        pose="geometry_msgs/Pose",
    ),
    "mocap4r2_msgs/msg/Marker": Fields(
        id_type="int8", marker_index="int32", marker_name="string",
        translation="geometry_msgs/Point",
    ),
}  # fmt: skip


def test_the_classes_of_ros_tell_the_definition() -> None:
    """The same type by its hash; types of ROS itself are not looked up."""
    text = cdr.define(KIND, CLASSES.__getitem__)
    expected = types_of("present").hash_rihs01(KIND)
    assert cdr.types_of(KIND, text).hash_rihs01(KIND) == expected
    assert cdr.define("geometry_msgs/msg/Pose", CLASSES.__getitem__) == ""


WRITTEN = {
    "boolean": "bool", "octet": "byte", "float": "float32", "double[3]": "float64[3]",
    "sequence<double, 5>": "float64[<=5]", "sequence<string<9>>": "string<=9[]",
    "string<4>[2]": "string<=4[2]", "a_msgs/B[7]": "a_msgs/B[7]",
}  # fmt: skip


@pytest.mark.parametrize("described", WRITTEN)
def test_a_class_s_field_as_in_a_file(described: str) -> None:
    fields = {"b_msgs/msg/A": Fields(own=described), "a_msgs/msg/B": Fields(x="uint8")}
    assert cdr.define("b_msgs/msg/A", fields.__getitem__).startswith(f"{WRITTEN[described]} own\n")


def test_a_definition_that_cannot_be_read_is_refused() -> None:
    sent = [message("present", START, [Body("a", place(0))])._replace(definition="string [")]
    with refused(TrialError, f"the definition of {KIND} cannot be read"):
        foreign.read_source("socket_pose", f"{BODIES}:a", {BODIES: sent})
