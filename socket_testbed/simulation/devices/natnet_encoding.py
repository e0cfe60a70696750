"""Messages of a NatNet server, 3.0 to 4.4, and the same with a wrong count."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from struct import Struct, pack, pack_into

import numpy as np
from numpy.typing import ArrayLike

from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.natnet.messages import (
    FRAME,
    MODELDEF,
    OLDEST,
    SERVERINFO,
    RigidBodyDefinition,
    ServerInfo,
    Version,
)

OCCLUDED, SOLVED, MODEL_FILLED, HAS_MODEL, UNLABELLED = 1, 2, 4, 8, 16

_HEADER = Struct("<HH")
_BODY = Struct("<i8fh")
_MARKER = Struct("<i4fhf")
_WRONG_COUNTS = (-1, 0, 1, 2, 7, 1000, 0x7FFFFFFF, -0x80000000)


@dataclass(frozen=True)
class Body:
    """A rigid body in a frame: id, position [m], quaternion (x, y, z, w)."""

    id: int
    position: FloatArray
    quaternion: FloatArray
    tracked: bool = True


@dataclass(frozen=True)
class Marker:
    """A labelled marker in a frame: model, member, position [m], flags."""

    model: int
    member: int
    position: FloatArray
    flags: int = SOLVED | HAS_MODEL


@dataclass(frozen=True)
class Content:
    """A frame: its sections of skeletons, assets, force plates and devices are empty."""

    number: int
    # server's clock at mid-exposure, at data received and at transmission [ticks]
    ticks: tuple[int, int, int] = (0, 0, 0)
    bodies: Sequence[Body] = ()
    markers: Sequence[Marker] = ()
    # positions of the markers of each set, shape (m, 3) [m]
    marker_sets: dict[str, FloatArray] = field(default_factory=dict)
    others: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # unlabelled markers [m]
    recording: bool = False
    models_changed: bool = False


@dataclass
class Message:
    """A message as it is written: its bytes, and where in them counts stand."""

    data: bytearray
    counts: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, message: int, payload: bytes = b"") -> Message:
        """A message with a payload that holds no counts."""
        return cls(bytearray(_HEADER.pack(message, len(payload)) + payload))

    def finished(self) -> Message:
        """The message with its size in the header."""
        pack_into("<H", self.data, 2, len(self.data) - 4)
        return self

    def corrupted(self, rng: np.random.Generator) -> bytes:
        """Its bytes with one count changed; its header's size if there is no other."""
        data = bytearray(self.data)
        if not self.counts:
            pack_into("<H", data, 2, (len(data) - 4 + int(rng.integers(1, 60000))) % 65536)
            return bytes(data)
        at = int(rng.choice(self.counts))
        true = int.from_bytes(data[at : at + 4], "little", signed=True)
        wrong = [count for count in (*_WRONG_COUNTS, true - 1, true + 1) if count != true]
        pack_into("<i", data, at, int(rng.choice(wrong)))
        return bytes(data)

    def text(self, text: str) -> None:
        """Append a text."""
        self.data += text.encode() + b"\0"

    def count(self, number: int) -> None:
        """Append a count."""
        self.counts.append(len(self.data))
        self.data += pack("<i", number)

    def append(self, other: Message) -> None:
        """Append another message."""
        self.counts += [len(self.data) + at for at in other.counts]
        self.data += other.data

    def section(self, number: int, sized: bool, content: Message) -> None:
        """Append a section: number of elements, size where the version has it, content."""
        self.count(number)
        if sized:
            self.count(len(content.data))
        self.append(content)


def encode_server_info(info: ServerInfo) -> Message:
    """SERVERINFO; before NatNet 3.0 it ends after the versions."""
    data = info.name.encode()[:255].ljust(256, b"\0")
    data += bytes(info.app_version) + bytes((*info.version, 0, 0))
    if info.version >= OLDEST:
        group = bytes(int(part) for part in (info.group or "0.0.0.0").split("."))
        data += pack("<QHB", info.clock, info.data_port, info.multicast) + group
    return Message.of(SERVERINFO, data)


def encode_frame(content: Content, version: Version) -> Message:
    """FRAME with all its sections."""
    sized = version >= (4, 1)
    frame = Message.of(FRAME, pack("<i", content.number))
    empty = Message(bytearray())
    sets = Message(bytearray())
    for name, positions in content.marker_sets.items():
        sets.text(name)
        sets.section(len(positions), False, Message(_floats(positions)))
    frame.section(len(content.marker_sets), sized, sets)
    frame.section(len(content.others), sized, Message(_floats(content.others)))
    frame.section(len(content.bodies), sized, _bodies(content.bodies))
    for _ in range(2 if sized else 1):  # skeletons; assets
        frame.section(0, sized, empty)
    frame.section(len(content.markers), sized, _markers(content.markers))
    for _ in range(2):  # force plates, devices
        frame.section(0, sized, empty)
    flags = int(content.recording) | 2 * int(content.models_changed)
    precision = (0, 0) if sized else ()
    since_begin = (content.ticks[0] % 10**14) * 1e-7  # [s]
    suffix = (0, 0, since_begin, *content.ticks, *precision, flags, 0)
    frame.data += pack("<IIdQQQIIhi" if sized else "<IIdQQQhi", *suffix)
    return frame.finished()


def encode_model_definitions(
    definitions: Iterable[RigidBodyDefinition], version: Version
) -> Message:
    """MODELDEF of rigid bodies, with the marker set that Motive makes of each."""
    message, content = Message.of(MODELDEF), Message(bytearray())
    number = 0
    for definition in definitions:
        for kind, part in enumerate((_marker_set(definition), _definition(definition, version))):
            number += 1
            content.data += pack("<i", kind)
            if version >= (4, 1):
                content.count(len(part.data))
            content.append(part)
    message.section(number, False, content)
    return message.finished()


def _marker_set(definition: RigidBodyDefinition) -> Message:
    part = Message(bytearray())
    part.text(definition.name)
    part.count(len(definition.markers))
    _name_markers(part, definition)
    return part


def _definition(definition: RigidBodyDefinition, version: Version) -> Message:
    part = Message(bytearray())
    part.text(definition.name)
    part.data += pack("<ii3f", definition.id, -1, 0.0, 0.0, 0.0)
    if version >= (4, 2):
        part.data += pack("<4f", 0.0, 0.0, 0.0, 1.0)
    part.count(len(definition.markers))
    part.data += _floats(definition.markers) + bytes(4 * len(definition.markers))
    if version >= (4, 0):
        _name_markers(part, definition)
    return part


def _name_markers(part: Message, definition: RigidBodyDefinition) -> None:
    for k in range(len(definition.markers)):
        part.text(f"Marker {k + 1}")


def _floats(values: ArrayLike) -> bytearray:
    return bytearray(np.asarray(values, dtype="<f4").tobytes())


def _bodies(bodies: Iterable[Body]) -> Message:
    return Message(
        bytearray().join(
            _BODY.pack(body.id, *body.position, *body.quaternion, 1e-4, int(body.tracked))
            for body in bodies
        )
    )


def _markers(markers: Iterable[Marker]) -> Message:
    return Message(
        bytearray().join(
            _MARKER.pack(m.model << 16 | m.member, *m.position, 0.014, m.flags, 2e-4)
            for m in markers
        )
    )
