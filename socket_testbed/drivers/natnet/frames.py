"""Frames of NatNet 2.6 to 4.4, parsed within the datagram's bounds."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from struct import Struct
from typing import NamedTuple, TypeAlias

from socket_testbed.drivers.natnet.protocol import MalformedDatagram, Reader, Version

OLDEST = (2, 6)  # before it, markers do not say whether they are occluded

Position: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

_BODY = Struct("<i8fh")  # id, position, quaternion, error, flags
_MARKER = Struct("<i4fhf")  # id, position, size, flags, residual
_MARKER_2 = Struct("<i4fh")
_SUFFIX_2 = Struct("<IIdhi")
_SUFFIX_3 = Struct("<IIdQQQhi")
_SUFFIX_4_1 = Struct("<IIdQQQIIhi")
_NEWEST = (4, 4)  # whose layout is known
_TRACKED = 1
_OCCLUDED, _MODEL_FILLED = 1, 4
_RECORDING, _MODELS_CHANGED, _BITSTREAM_CHANGED = 1, 2, 8


class RigidBody(NamedTuple):
    """A rigid body in a frame.

    Attributes:
        id: Its streaming id.
        position: Its position [m].
        quaternion: Its orientation (x, y, z, w) [-].
        tracked: Whether the server tracks it in this frame.
    """

    id: int
    position: Position
    quaternion: Quaternion
    tracked: bool


class LabelledMarker(NamedTuple):
    """A labelled marker in a frame.

    Attributes:
        model: Streaming id of the body that it belongs to; 0: none.
        member: Its number in the body, from 1.
        position: Its position [m]; where it is occluded, the last or an assumed one.
        occluded: Whether no camera sees it, or its position is no number.
        model_filled: Whether the position is that of the body's model, not of the marker.
    """

    model: int
    member: int
    position: Position
    occluded: bool
    model_filled: bool


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame of the cameras.

    Attributes:
        number: Its number; it counts up within a session.
        bodies: Rigid bodies.
        markers: Labelled markers.
        timestamp: Time since the server's begin [s].
        mid_exposure: Middle of the exposure by the server's clock; 0 before 3.0 [ticks].
        recording: Whether the server records.
        models_changed: Whether its rigid bodies have changed.
        bitstream_changed: Whether its stream has changed version.
    """

    number: int
    bodies: tuple[RigidBody, ...]
    markers: tuple[LabelledMarker, ...]
    timestamp: float
    mid_exposure: int
    recording: bool
    models_changed: bool
    bitstream_changed: bool


def parse_frame(payload: bytes | memoryview, version: Version) -> Frame:
    """Parse a frame.

    Args:
        payload: The payload of the datagram.
        version: NatNet version of the stream.

    Raises:
        MalformedDatagram: If it does not hold what its counts say.
    """
    if version < OLDEST:
        raise MalformedDatagram(f"frame of NatNet {version[0]}.{version[1]}, which is too old")
    reader = Reader(bytes(payload), "frame")
    number = reader.integer()
    if version >= (4, 1):
        for smallest in (5, 12):  # marker sets, other markers
            _skip_sized(reader, smallest)
        bodies = _bodies(reader, _sized_count(reader, _BODY.size))
        for smallest in (8, 12):  # skeletons, assets
            _skip_sized(reader, smallest)
        markers = _markers(reader, _sized_count(reader, _MARKER.size), _MARKER)
        for _ in range(2):  # force plates, devices
            _skip_sized(reader, 8)
    else:
        for _ in range(reader.count(5)):
            reader.text()
            reader.skip(12 * reader.count(12))
        reader.skip(12 * reader.count(12))
        bodies = _any_bodies(reader, version)
        for _ in range(reader.count(8)):
            reader.skip(4)
            _any_bodies(reader, version)
        layout = _MARKER if version >= (3, 0) else _MARKER_2
        markers = _markers(reader, reader.count(layout.size), layout)
        if version >= (2, 9):
            _skip_channels(reader)
        if version >= (2, 11):
            _skip_channels(reader)
        if version < (3, 0):
            reader.skip(4)  # latency
    timestamp, ticks, flags = _suffix(reader, version)
    return Frame(
        number,
        bodies,
        markers,
        timestamp,
        ticks,
        bool(flags & _RECORDING),
        bool(flags & _MODELS_CHANGED),
        bool(flags & _BITSTREAM_CHANGED),
    )


def _sized_count(reader: Reader, element: int) -> int:
    """Number of elements of a section whose elements all have one size."""
    count, size = reader.count(element), reader.integer()
    if size != count * element:
        raise reader.bad(f"a section of {size} bytes for {count} of {element}")
    return count


def _skip_sized(reader: Reader, smallest: int) -> None:
    count, size = reader.count(smallest), reader.count(1)
    if size < count * smallest:
        raise reader.bad(f"a section of {size} bytes for {count}")
    reader.skip(size)


def _bodies(reader: Reader, count: int) -> tuple[RigidBody, ...]:
    size = count * _BODY.size
    begin = reader.skip(size)
    return tuple(
        RigidBody(
            identity, (x, y, z), (qx, qy, qz, qw), bool(flags & _TRACKED) and isfinite(x + y + z)
        )
        for identity, x, y, z, qx, qy, qz, qw, _, flags in _BODY.iter_unpack(
            reader.payload[begin : begin + size]
        )
    )


def _any_bodies(reader: Reader, version: Version) -> tuple[RigidBody, ...]:
    """Bodies before 4.1; before 3.0 each carries its markers."""
    if version >= (3, 0):
        return _bodies(reader, reader.count(_BODY.size))
    found: list[RigidBody] = []
    for _ in range(reader.count(_BODY.size + 4)):
        begin = reader.skip(32)
        reader.skip(20 * reader.count(20))  # markers: position, id, size
        tail = reader.skip(6)
        whole = reader.payload[begin : begin + 32] + reader.payload[tail : tail + 6]
        found += _bodies(Reader(whole, "rigid body"), 1)
    return tuple(found)


def _markers(reader: Reader, count: int, layout: Struct) -> tuple[LabelledMarker, ...]:
    size = count * layout.size
    begin = reader.skip(size)
    return tuple(
        LabelledMarker(
            (identity >> 16) & 0xFFFF,
            identity & 0xFFFF,
            (x, y, z),
            bool(flags & _OCCLUDED) or not isfinite(x + y + z),
            bool(flags & _MODEL_FILLED),
        )
        for identity, x, y, z, _, flags, *_ in layout.iter_unpack(
            reader.payload[begin : begin + size]
        )
    )


def _skip_channels(reader: Reader) -> None:
    """Force plates or devices before 4.1."""
    for _ in range(reader.count(8)):
        reader.skip(4)
        for _ in range(reader.count(4)):
            reader.skip(4 * reader.count(4))


def _suffix(reader: Reader, version: Version) -> tuple[float, int, int]:
    """Timestamp [s], mid-exposure [ticks] and flags."""
    ticks = 0
    if version >= (4, 1):
        _, _, timestamp, ticks, *_, flags, end = reader.unpack(_SUFFIX_4_1)
    elif version >= (3, 0):
        _, _, timestamp, ticks, *_, flags, end = reader.unpack(_SUFFIX_3)
    elif version >= (2, 7):
        _, _, timestamp, flags, end = reader.unpack(_SUFFIX_2)
    else:
        _, _, timestamp, flags, end = reader.unpack(Struct("<IIfhi"))
    # A count that lies leads elsewhere than to the end tag. A newer version may hold more.
    if end != 0 or (version <= _NEWEST and reader.offset != reader.end):
        raise reader.bad(f"end tag {end} and {reader.end - reader.offset} bytes left")
    return float(timestamp), int(ticks), int(flags)
