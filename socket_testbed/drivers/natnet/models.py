"""The rigid bodies that a NatNet server defines, parsed within the datagram's bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct

from socket_testbed.drivers.natnet.protocol import Reader, Version


@dataclass(frozen=True)
class RigidBodyDefinition:
    """A rigid body as the server defines it.

    Attributes:
        name: Its name.
        id: Its streaming id; labelled markers carry it as their model.
        markers: Its markers in its own frame [m]; empty before NatNet 3.0.
    """

    name: str
    id: int
    markers: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class ModelDefinitions:
    """The rigid bodies of a server, by name."""

    bodies: dict[str, RigidBodyDefinition]

    def ids(self) -> frozenset[int]:
        """The streaming ids there are."""
        return frozenset(body.id for body in self.bodies.values())


def parse_model_definitions(payload: bytes, version: Version) -> ModelDefinitions:
    """Parse MODELDEF; of all that is defined, the rigid bodies are kept.

    Raises:
        MalformedDatagram: If it does not hold what its counts say.
    """
    sized = version >= (4, 1)
    reader = Reader(bytes(payload), "model definitions")
    bodies: dict[str, RigidBodyDefinition] = {}
    for _ in range(reader.count(8)):
        kind = reader.integer()
        stop = None
        if sized:
            size = reader.count(1)
            stop = reader.offset + size
        if kind == 1:
            body = _rigid_body(reader, version)
            bodies[body.name] = body
        elif stop is None:
            if kind not in _SKIPS:
                raise reader.bad(f"an unknown type {kind}")
            _SKIPS[kind](reader, version)
        if stop is not None:
            if reader.offset > stop or (kind == 1 and reader.offset != stop):
                raise reader.bad(f"a definition of {size} bytes ends elsewhere")
            reader.offset = stop
    return ModelDefinitions(bodies)


def _rigid_body(reader: Reader, version: Version) -> RigidBodyDefinition:
    name = reader.text() if version >= (2, 0) else ""
    identity = reader.integer()
    reader.skip(4 + 12 + (16 if version >= (4, 2) else 0))  # parent, offset, its quaternion
    markers: tuple[tuple[float, float, float], ...] = ()
    if version >= (3, 0):
        count = reader.count(16)
        values = reader.unpack(Struct(f"<{3 * count}f"))
        markers = tuple(zip(values[::3], values[1::3], values[2::3], strict=True))
        reader.skip(4 * count)  # labels of active markers
        if version >= (4, 0):
            _skip_names(reader, count)
    return RigidBodyDefinition(name, identity, markers)


def _skip_names(reader: Reader, count: int) -> None:
    for _ in range(count):
        reader.text()


def _skip_marker_set(reader: Reader, version: Version) -> None:
    reader.text()
    _skip_names(reader, reader.count(1))


def _skip_skeleton(reader: Reader, version: Version) -> None:
    reader.text()
    reader.skip(4)
    for _ in range(reader.count(20)):
        _rigid_body(reader, version)


def _skip_force_plate(reader: Reader, version: Version) -> None:
    reader.skip(4)
    reader.text()  # serial number
    reader.skip(4 * (2 + 3 + 144 + 12) + 8)  # size, origin, calibration, corners; two types
    _skip_names(reader, reader.count(1))


def _skip_device(reader: Reader, version: Version) -> None:
    reader.skip(4)
    _skip_names(reader, 2)  # name and serial number
    reader.skip(8)
    _skip_names(reader, reader.count(1))


def _skip_camera(reader: Reader, version: Version) -> None:
    reader.text()
    reader.skip(28)


_SKIPS: dict[int, Callable[[Reader, Version], None]] = {
    0: _skip_marker_set,
    2: _skip_skeleton,
    3: _skip_force_plate,
    4: _skip_device,
    5: _skip_camera,
}
