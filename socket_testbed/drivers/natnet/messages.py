"""NatNet 3.0 to 4.5: requests, replies, rigid bodies and frames; later ones as far as they agree.

Every read is checked: a datagram whose counts contradict its size raises `MalformedDatagram`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from math import isfinite
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

from socket_testbed.errors import DeviceError

CONNECT = 0
SERVERINFO = 1
REQUEST = 2
RESPONSE = 3
REQUEST_MODELDEF = 4
MODELDEF = 5
FRAME = 7
DISCONNECT = 9
KEEPALIVE = 10
ECHOREQUEST = 12
ECHORESPONSE = 13
UNRECOGNIZED = 100

LARGEST_DATAGRAM = 65535  # [bytes]

Version: TypeAlias = tuple[int, int]  # of NatNet: major, minor
Position: TypeAlias = tuple[float, float, float]

OLDEST = (3, 0)  # of Motive 2.0; older frames have no exposure time
NEWEST = (4, 5)  # of Motive 3.5; the last known layout
_LATER_SECTIONS = 2  # after the devices: IMUs, GPIOs
SIZED = (4, 1)  # the first version whose sections and definitions begin with their size
_BODIES_KNOWN = (4, 4)  # last version whose definition of a rigid body is known to its end

_HEADER = Struct("<HH")
_I32 = Struct("<i")
_ECHO = Struct("<QQ")
_NAME_SIZE = 256  # [bytes]
_MAX_CLOCK = 10**11  # [Hz]
_BODY = Struct("<i8fh")  # id, position, quaternion, error, flags
_MARKER = Struct("<i4fhf")  # id, position, size, flags, residual
_SUFFIX_3 = Struct("<IIdQQQhi")
_SUFFIX_4_1 = Struct("<IIdQQQIIhi")
_OCCLUDED, _MODEL_FILLED = 1, 4
_RECORDING, _MODELS_CHANGED = 1, 2

# A layout holds texts, numbers of bytes, and tuples: the layout of each counted element.
_TEXT = str
_Layout: TypeAlias = tuple[Any, ...]

_MARKER_SET: _Layout = (_TEXT, (12,))
_BODIES: _Layout = (4, (_BODY.size,))  # a skeleton, an asset: id, bodies
_CHANNELS: _Layout = (4, ((4,),))  # a force plate, a device: id, values by channel
_RIGID_BODY, _SKELETON = 1, 2
_DEFINITIONS: dict[int, _Layout] = {  # all others, by type
    0: (_TEXT, (_TEXT,)),  # marker set: name, markers
    _SKELETON: (_TEXT, 4),  # name, id; its bones follow
    # force plate: id, serial number; size, origin, calibration, corners; two types; channels
    3: (4, _TEXT, 4 * (2 + 3 + 144 + 12) + 8, (_TEXT,)),
    4: (4, _TEXT, _TEXT, 8, (_TEXT,)),  # device: id, name, serial number, two types, channels
    5: (_TEXT, 28),  # camera: name, position, orientation
}


@cache
def _min_size(layout: _Layout) -> int:
    """Minimum size of a layout [bytes]."""
    return sum(part if isinstance(part, int) else 1 if part is _TEXT else 4 for part in layout)


class MalformedDatagram(DeviceError):  # noqa: N818  (the datagram's name, not the error's)
    """A datagram whose counts contradict its size."""


class Reader:
    """Reads a payload from its start, never past its end.

    Methods that read or skip raise `MalformedDatagram` where the payload is too short.

    Args:
        payload: The payload, little-endian and packed.
        kind: What it is, for errors, such as "frame".

    Attributes:
        payload: The payload.
        end: Its size [bytes].
        offset: Offset of the next value from its start [bytes].
    """

    def __init__(self, payload: bytes, kind: str) -> None:
        self.payload = payload
        self.end = len(payload)
        self.offset = 0
        self._kind = kind

    def bad(self, fact: str) -> MalformedDatagram:
        """An error for this payload, with a fact about the present offset."""
        return MalformedDatagram(
            f"{self._kind} of {self.end} bytes: {fact} at byte {self.offset}",
            "it was dropped; if this continues, check the Wi-Fi and the version",
        )

    def skip(self, size: int) -> int:
        """Skip a number of bytes; returns the offset before them.

        Raises:
            MalformedDatagram: Fewer bytes are left, or the number is negative.
        """
        begin = self.offset
        if size < 0 or size > self.end - begin:
            raise self.bad(f"{size} bytes wanted, {self.end - begin} left")
        self.offset = begin + size
        return begin

    def unpack(self, layout: Struct) -> tuple[Any, ...]:
        """The next values, as many as the layout has."""
        return layout.unpack_from(self.payload, self.skip(layout.size))

    def integer(self) -> int:
        """The next i32."""
        return int(_I32.unpack_from(self.payload, self.skip(4))[0])

    def count(self, smallest: int) -> int:
        """The next i32 as a number of elements of at least `smallest` bytes each.

        Raises:
            MalformedDatagram: The number is negative, or so many elements do not fit into the rest.
        """
        number = self.integer()
        if number < 0 or number * smallest > self.end - self.offset:
            raise self.bad(f"a count of {number} before")
        return number

    def pass_over(self, *layout: Any) -> None:
        """Skip the parts of a layout: texts, numbers of bytes, and counted elements (tuples)."""
        for part in layout:
            if part is _TEXT:
                self.text()
            elif isinstance(part, int):
                self.skip(part)
            else:
                for _ in range(self.count(_min_size(part))):
                    self.pass_over(*part)

    def text(self) -> str:
        """The next text in UTF-8, up to its NUL.

        Raises:
            MalformedDatagram: There is no NUL.
        """
        stop = self.payload.find(0, self.offset)
        if stop < 0:
            raise self.bad("a text without an end")
        begin, self.offset = self.offset, stop + 1
        return self.payload[begin:stop].decode("utf-8", "replace")


@dataclass(frozen=True)
class ServerInfo:
    """A server's description of itself.

    Attributes:
        name: Name of the program, such as Motive.
        app_version: Version of the program, four numbers 0..255.
        version: Its NatNet version, major and minor.
        clock: Frequency of its clock [Hz]; 0 for a server before NatNet 3.0, which gives no
            exposure times.
        data_port: Port to which it sends multicast frames; 0 before NatNet 3.0.
        multicast: Whether it streams to a multicast group, otherwise to each client.
        group: IPv4 address of the multicast group, 0.0.0.0 if the server gives none; empty before
            NatNet 3.0.
    """

    name: str
    app_version: tuple[int, ...]
    version: Version
    clock: int = 0
    data_port: int = 0
    multicast: bool = False
    group: str = ""

    def __str__(self) -> str:
        app = ".".join(str(part) for part in self.app_version[:2])
        return f"{self.name} {app}, NatNet {self.version[0]}.{self.version[1]}"


def encode_message(message: int, payload: bytes = b"") -> bytes:
    """A datagram: header (id and size of the payload, u16 each), then the payload.

    Args:
        message: Id of the message, such as `CONNECT`.
        payload: Its content, 65535 bytes at most.
    """
    return _HEADER.pack(message, len(payload)) + payload


def encode_connect(name: str, bitstream: Version) -> bytes:
    """CONNECT for all data.

    Args:
        name: Name of the client; 255 bytes of it are sent.
        bitstream: Version of the stream to ask for, which the server may not support.
    """
    sender = name.encode()[: _NAME_SIZE - 1].ljust(_NAME_SIZE, b"\0")
    sender += bytes((0, 0, 0, 0, *bitstream, 0, 0))
    return encode_message(CONNECT, sender + bytes((0, *bitstream, 0, 0)))


def encode_command(text: str) -> bytes:
    """REQUEST with the text of a command, such as "StartRecording"."""
    return encode_message(REQUEST, text.encode() + b"\0")


def encode_echo(stamp: int) -> bytes:
    """ECHOREQUEST with a stamp chosen by the client, 0 to 2^64 - 1, such as a time [ns]."""
    return encode_message(ECHOREQUEST, stamp.to_bytes(8, "little"))


def split_datagram(datagram: bytes) -> tuple[int, bytes]:
    """Id and payload of a datagram; bytes after the payload are ignored.

    Raises:
        MalformedDatagram: The datagram is shorter than its header says.
    """
    reader = Reader(datagram, "datagram")
    message, size = reader.unpack(_HEADER)
    begin = reader.skip(size)
    return int(message), datagram[begin : begin + size]


def parse_server_info(payload: bytes) -> ServerInfo:
    """Parse SERVERINFO; before NatNet 3.0 it ends after the versions, without a clock.

    Raises:
        MalformedDatagram: The payload is too short, or its clock is not 1 Hz to 100 GHz.
    """
    reader = Reader(payload, "server info")
    begin = reader.skip(_NAME_SIZE)
    name = payload[begin : begin + _NAME_SIZE].partition(b"\0")[0].decode("utf-8", "replace")
    versions = reader.unpack(Struct("<8B"))
    app, natnet = versions[:4], (versions[4], versions[5])
    if natnet < OLDEST:
        return ServerInfo(name, app, natnet)
    clock, port, multicast, *group = reader.unpack(Struct("<QHB4B"))
    if not 1 <= clock <= _MAX_CLOCK:
        raise reader.bad(f"a clock of {clock} Hz")
    return ServerInfo(
        name, app, natnet, clock, port, bool(multicast), ".".join(str(part) for part in group)
    )


def parse_echo(payload: bytes) -> tuple[int, int]:
    """Parse ECHORESPONSE: the request's stamp, and the server's clock [ticks]; two u64."""
    stamp, ticks = Reader(payload, "echo").unpack(_ECHO)
    return stamp, ticks


@dataclass(frozen=True)
class RigidBodyDefinition:
    """A rigid body as the server defines it.

    Attributes:
        name: Its name in Motive.
        id: Its streaming id, which is the `model` of its labelled markers.
        markers: Positions (x, y, z) of its k markers in its own frame, in the server's order, shape
            (k, 3) [m]; empty if the server's layout is not known.
    """

    name: str
    id: int
    markers: tuple[Position, ...]


BodiesByName: TypeAlias = dict[str, RigidBodyDefinition]


def parse_model_definitions(payload: bytes, version: Version) -> BodiesByName:
    """Parse MODELDEF; returns only the rigid bodies, by name.

    Args:
        payload: Payload of the message.
        version: Version of the stream, which determines the layout: as negotiated with the server.

    Raises:
        MalformedDatagram: Its counts contradict its size, or a stream before 4.1 has an unknown
            type of model.
    """
    reader = Reader(bytes(payload), "model definitions")
    bodies: BodiesByName = {}
    for _ in range(reader.count(8)):
        kind, stop = reader.integer(), None
        if version >= SIZED:
            size = reader.count(1)
            stop = reader.offset + size
        if kind == _RIGID_BODY:
            body = (
                _rigid_body(reader, version)
                if stop is None
                else _sized_rigid_body(reader, version, size)
            )
            bodies[body.name] = body
        elif stop is None:
            if kind not in _DEFINITIONS:
                raise reader.bad(f"an unknown type {kind}")
            reader.pass_over(*_DEFINITIONS[kind])
            if kind == _SKELETON:
                for _ in range(reader.count(20)):
                    _rigid_body(reader, version)
        if stop is not None:
            reader.offset = stop
    return bodies


def _sized_rigid_body(reader: Reader, version: Version, size: int) -> RigidBodyDefinition:
    """A rigid body of a definition of so many bytes, in any layout that ends there.

    A server may answer in the layout of another version than that of its frames. Of a layout that
    is not known, the name and the id are read, which come first; the markers are then empty.

    Raises:
        MalformedDatagram: No layout fits, of a version whose layout is known.
    """
    begin = reader.offset
    for layout in dict.fromkeys((version, (4, 2), (4, 1))):
        reader.offset = begin
        with suppress(MalformedDatagram):
            body = _rigid_body(reader, layout)
            if reader.offset == begin + size:
                return body
    reader.offset = begin
    name, identity = reader.text(), reader.integer()
    if version <= _BODIES_KNOWN or reader.offset > begin + size:
        raise reader.bad(f"a definition of {size} bytes ends elsewhere")
    return RigidBodyDefinition(name, identity, ())


def _rigid_body(reader: Reader, version: Version) -> RigidBodyDefinition:
    name, identity = reader.text(), reader.integer()
    reader.skip(4 + 12 + (16 if version >= (4, 2) else 0))  # parent, offset, its quaternion
    count = reader.count(16)
    values = reader.unpack(Struct(f"<{3 * count}f"))
    reader.skip(4 * count)  # labels of active markers
    if version >= (4, 0):
        reader.pass_over(*[_TEXT] * count)
    markers = tuple(zip(values[::3], values[1::3], values[2::3], strict=True))
    return RigidBodyDefinition(name, identity, markers)


class LabelledMarker(NamedTuple):
    """A labelled marker in a frame.

    Attributes:
        model: Streaming id of its body; 0 for none.
        member: Its number in the body, from 1.
        position: Position (x, y, z) in the world of the motion capture [m]; if the marker is not
            seen, its last or an assumed one.
        seen: Whether cameras measured the position; otherwise it is occluded or model-filled.
    """

    model: int
    member: int
    position: Position
    seen: bool


@dataclass(frozen=True, slots=True)
class MocapFrame:
    """A frame of the cameras.

    Attributes:
        number: Number of the frame; it increases within a session of the server.
        bodies: Streaming ids of the rigid bodies in the frame, tracked or not.
        markers: All labelled markers of the frame.
        mid_exposure: Middle of the exposure on the server's clock [ticks], see `EchoClock`.
        recording: Whether the server records a take.
        models_changed: Whether the server's rigid bodies have changed: ask for them again.
    """

    number: int
    bodies: tuple[int, ...]
    markers: tuple[LabelledMarker, ...]
    mid_exposure: int
    recording: bool
    models_changed: bool


def parse_frame(payload: bytes | memoryview, version: Version) -> MocapFrame:
    """Parse the payload of a frame, of NatNet 3.0 or later.

    From 4.1 on, each section has its size, so that those between the devices and the suffix are
    skipped: of IMUs and GPIOs (4.5), and any number of unknown ones of later versions.

    Args:
        payload: Payload of the message.
        version: Version of the stream, which determines the layout: as negotiated with the server.

    Raises:
        MalformedDatagram: Its counts contradict its size, or the version is older than 3.0.
    """
    sized = version >= SIZED
    reader = Reader(bytes(payload), "frame")
    if version < OLDEST:
        raise reader.bad(f"NatNet {version[0]}.{version[1]} is too old")
    number = reader.integer()
    _skip_section(reader, sized, _MARKER_SET)
    _skip_section(reader, sized, (12,))  # other markers
    bodies = tuple(identity for identity, *_ in _elements(reader, sized, _BODY))
    _skip_section(reader, sized, _BODIES)  # skeletons
    if sized:
        _skip_section(reader, sized, _BODIES)  # assets
    markers = tuple(
        LabelledMarker(
            identity >> 16 & 0xFFFF,
            identity & 0xFFFF,
            (x, y, z),
            not flags & (_OCCLUDED | _MODEL_FILLED) and isfinite(x + y + z),
        )
        for identity, x, y, z, _, flags, _ in _elements(reader, sized, _MARKER)
    )
    for _ in range(2):  # force plates, devices
        _skip_section(reader, sized, _CHANNELS)
    suffix = _SUFFIX_4_1 if sized else _SUFFIX_3
    later = 0
    while sized and reader.end - reader.offset > suffix.size:
        _skip_section(reader, sized, ())
        later += 1
    # A cut frame may end with zeros that look like a suffix, so known versions need their number.
    if version <= NEWEST and later != (_LATER_SECTIONS if version >= NEWEST else 0):
        raise reader.bad(f"{later} sections after the devices")
    _, _, _, ticks, *_, flags, end = reader.unpack(suffix)
    if end != 0 or reader.offset != reader.end:  # a wrong count or size misses the end tag
        raise reader.bad(f"end tag {end} and {reader.end - reader.offset} bytes left")
    changed = bool(flags & _MODELS_CHANGED)
    return MocapFrame(number, bodies, markers, ticks, bool(flags & _RECORDING), changed)


def _skip_section(reader: Reader, sized: bool, elements: _Layout) -> None:
    """Skip a section: by its size from 4.1 on, element by element before.

    An empty layout is that of an unknown section, whose elements may have any size.
    """
    if not sized:
        reader.pass_over(elements)
        return
    count = reader.count(smallest := _min_size(elements))
    size = reader.count(1)
    if size < count * smallest or (elements and size and not count):
        raise reader.bad(f"a section of {size} bytes for {count}")
    reader.skip(size)


def _elements(reader: Reader, sized: bool, layout: Struct) -> Iterator[tuple[Any, ...]]:
    """Elements of a section with a fixed layout."""
    count = reader.count(layout.size)
    if sized and (size := reader.integer()) != count * layout.size:
        raise reader.bad(f"a section of {size} bytes for {count} of {layout.size}")
    begin = reader.skip(count * layout.size)
    return layout.iter_unpack(reader.payload[begin : reader.offset])
