"""NatNet messages: requests encoded, short replies parsed, all within the datagram's bounds."""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import Any, TypeAlias

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

_HEADER = Struct("<HH")
_I32 = Struct("<i")
_ECHO = Struct("<QQ")
_NAME = 256  # [bytes]
_LARGEST_CLOCK = 10**11  # [Hz]


class MalformedDatagram(DeviceError):  # noqa: N818  (what it is, not that it is an error)
    """A datagram that does not hold what its counts say."""

    def __init__(self, fact: str) -> None:
        super().__init__(fact, "it was dropped; if this goes on, check the Wi-Fi and the version")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.fact,)


class Reader:
    """Reads a payload from its begin on, never past its end.

    Args:
        payload: The payload.
        what: What it is, for the error.
    """

    def __init__(self, payload: bytes, what: str) -> None:
        self.payload = payload
        self.end = len(payload)
        self.offset = 0
        self._what = what

    def bad(self, fact: str) -> MalformedDatagram:
        """The error of this payload."""
        return MalformedDatagram(f"{self._what} of {self.end} bytes: {fact} at byte {self.offset}")

    def skip(self, size: int) -> int:
        """Go on by some bytes; the offset before them."""
        begin = self.offset
        if size < 0 or size > self.end - begin:
            raise self.bad(f"{size} bytes wanted, {self.end - begin} left")
        self.offset = begin + size
        return begin

    def unpack(self, layout: Struct) -> tuple[Any, ...]:
        """The next values of a layout."""
        return layout.unpack_from(self.payload, self.skip(layout.size))

    def integer(self) -> int:
        """The next i32."""
        return int(_I32.unpack_from(self.payload, self.skip(4))[0])

    def count(self, smallest: int) -> int:
        """The next i32 as a number of elements.

        Args:
            smallest: Size of the smallest element possible [bytes].
        """
        number = self.integer()
        if number < 0 or number * smallest > self.end - self.offset:
            raise self.bad(f"a count of {number} before")
        return number

    def text(self) -> str:
        """The next text, up to its NUL."""
        stop = self.payload.find(0, self.offset)
        if stop < 0:
            raise self.bad("a text without an end")
        begin, self.offset = self.offset, stop + 1
        return self.payload[begin:stop].decode("utf-8", "replace")


@dataclass(frozen=True)
class ServerInfo:
    """What a server says of itself.

    Attributes:
        name: Name of the application.
        app_version: Its version, four numbers.
        version: Its NatNet version.
        clock: Frequency of its clock; 0: it stamps no exposures [Hz].
        data_port: Its data port.
        multicast: Whether it streams to a group.
        group: The group's address.
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


@dataclass(frozen=True)
class Response:
    """The reply to a command: four bytes of a number (0 is yes), or a text."""

    raw: bytes

    @property
    def accepted(self) -> bool:
        """Whether it is no refusal."""
        return len(self.raw) != 4 or self.raw == bytes(4)

    @property
    def text(self) -> str:
        """What it says, for a person."""
        if len(self.raw) == 4:
            return str(_I32.unpack(self.raw)[0])
        return self.raw.partition(b"\0")[0].decode("utf-8", "replace")


def encode_message(message: int, payload: bytes = b"") -> bytes:
    """A datagram of an id and a payload."""
    return _HEADER.pack(message, len(payload)) + payload


def encode_connect(name: str, bitstream: Version) -> bytes:
    """CONNECT, for all data, in a version if the server can."""
    sender = name.encode()[: _NAME - 1].ljust(_NAME, b"\0") + bytes(4) + bytes((*bitstream, 0, 0))
    return encode_message(CONNECT, sender + bytes((0, *bitstream, 0, 0)))


def encode_command(text: str) -> bytes:
    """REQUEST of a command."""
    return encode_message(REQUEST, text.encode() + b"\0")


def encode_echo(stamp: int) -> bytes:
    """ECHOREQUEST with a stamp of the client's own, such as [ns]."""
    return encode_message(ECHOREQUEST, stamp.to_bytes(8, "little"))


def split_datagram(datagram: bytes) -> tuple[int, bytes]:
    """Id and payload of a datagram.

    Raises:
        MalformedDatagram: If it is shorter than its header says.
    """
    reader = Reader(datagram, "datagram")
    message, size = reader.unpack(_HEADER)
    begin = reader.skip(size)
    return int(message), datagram[begin : begin + size]


def parse_server_info(payload: bytes) -> ServerInfo:
    """Parse SERVERINFO; before NatNet 3.0 it ends after the versions."""
    reader = Reader(payload, "server info")
    begin = reader.skip(_NAME)
    name = payload[begin : begin + _NAME].partition(b"\0")[0].decode("utf-8", "replace")
    app, version = (tuple(payload[(at := reader.skip(4)) : at + 4]) for _ in range(2))
    natnet = (version[0], version[1])
    if natnet < (3, 0):
        return ServerInfo(name, app, natnet)
    clock, port, multicast, *group = reader.unpack(Struct("<QHB4B"))
    if not 1 <= clock <= _LARGEST_CLOCK:
        raise reader.bad(f"a clock of {clock} Hz")
    return ServerInfo(
        name, app, natnet, clock, port, bool(multicast), ".".join(str(part) for part in group)
    )


def parse_response(payload: bytes) -> Response:
    """Parse RESPONSE."""
    return Response(bytes(payload))


def parse_echo(payload: bytes) -> tuple[int, int]:
    """Parse ECHORESPONSE: the request's stamp, and the server's clock [ticks]."""
    stamp, ticks = Reader(payload, "echo").unpack(_ECHO)
    return stamp, ticks
