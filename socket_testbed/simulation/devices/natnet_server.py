"""A NatNet server, 3.0 to 4.5, on real sockets, with simulated cameras and network faults."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from struct import pack, pack_into
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.messages import RigidBodyDefinition, ServerInfo, Version

OCCLUDED, SOLVED, MODEL_FILLED, HAS_MODEL = 1, 2, 4, 8  # flags of a marker

# Name, markers in the world (m, 3) [m], position (3,) [m], quaternion (4,) of each body.
Bodies: TypeAlias = Callable[[float], Sequence[tuple[str, FloatArray, FloatArray, FloatArray]]]
Address: TypeAlias = tuple[str, int]
Parts: TypeAlias = list[bytes | int]  # of a message, in order; an int is a count

_WRONG_COUNTS = (-1, 0, 1, 2, 7, 1000, 0x7FFFFFFF, -0x80000000)
_CLOCK = 10_000_000  # [Hz]
_LATENCY = 0.004  # [s]; from mid-exposure to transmission
_MAX_DELAY = 0.25  # [s]; later frames are dropped
_TIMEOUT = 10.0  # [s]; of a silent client
_CHANGE_FRAMES = 24  # frames that flag changed rigid bodies
_VERSIONS = {  # of the stream on request
    f"{major}.{minor}": (major, minor)
    for major, minor in ((3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3), (4, 4), (4, 5))
}


@dataclass(frozen=True)
class Body:
    """A rigid body in a frame.

    Attributes:
        id: Its streaming id.
        position: Position of its origin in the world, shape (3,) [m].
        quaternion: Its rotation to the world, a unit quaternion (x, y, z, w), shape (4,) [-].
    """

    id: int
    position: FloatArray
    quaternion: FloatArray


@dataclass(frozen=True)
class Marker:
    """A labelled marker in a frame.

    Attributes:
        model: Streaming id of its body; 0 for none.
        member: Its number in the body, from 1.
        position: Its position in the world, shape (3,) [m].
        flags: Sum of the flags `OCCLUDED`, `SOLVED`, `MODEL_FILLED` and `HAS_MODEL`.
    """

    model: int
    member: int
    position: FloatArray
    flags: int = SOLVED | HAS_MODEL


@dataclass(frozen=True)
class Content:
    """A frame; unless it is crowded, sections besides bodies and labelled markers are empty.

    Attributes:
        number: Number of the frame; it increases within a session of the server.
        ticks: The server's clock at mid-exposure, at data received and at transmission [ticks of
            100 ns].
        bodies: The rigid bodies.
        markers: The labelled markers of all bodies.
        recording: Whether the server records a take.
        models_changed: Whether the rigid bodies have changed.
        crowded: Whether every other section holds something, from a marker set to a GPIO.
    """

    number: int
    ticks: tuple[int, int, int] = (0, 0, 0)
    bodies: Sequence[Body] = ()
    markers: Sequence[Marker] = ()
    recording: bool = False
    models_changed: bool = False
    crowded: bool = False


@dataclass(frozen=True)
class Message:
    """A message, and the offsets of the counts in it.

    Attributes:
        data: The datagram: header (id and size of the payload, u16 each), then the payload.
        counts: Offsets of its counts and sizes, i32 each, from the start of the datagram [bytes].
    """

    data: bytes
    counts: Sequence[int]

    @classmethod
    def of(cls, kind: int, *parts: bytes | int) -> Message:
        """Build a message from its parts.

        Args:
            kind: Id of the message, such as `messages.FRAME`.
            *parts: Its payload, in order: bytes, and counts or sizes as numbers.
        """
        payload, counts = _join(parts)
        return cls(pack("<HH", kind, len(payload)) + payload, [4 + at for at in counts])

    def corrupted(self, rng: np.random.Generator) -> bytes:
        """Its bytes with one count changed, or the header's size if there are no counts."""
        data = bytearray(self.data)
        if not self.counts:
            pack_into("<H", data, 2, (len(data) - 4 + int(rng.integers(1, 60000))) % 65536)
            return bytes(data)
        at = int(rng.choice(self.counts))
        true = int.from_bytes(data[at : at + 4], "little", signed=True)
        wrong = [count for count in (*_WRONG_COUNTS, true - 1, true + 1) if count != true]
        pack_into("<i", data, at, int(rng.choice(wrong)))
        return bytes(data)


def encode_server_info(info: ServerInfo) -> Message:
    """SERVERINFO; before NatNet 3.0 it ends after the versions."""
    data = info.name.encode()[:255].ljust(256, b"\0")
    data += bytes(info.app_version) + bytes((*info.version, 0, 0))
    if info.version >= messages.OLDEST:
        group = socket.inet_aton(info.group or "0.0.0.0")
        data += pack("<QHB", info.clock, info.data_port, info.multicast) + group
    return Message.of(messages.SERVERINFO, data)


def encode_frame(content: Content, version: Version) -> Message:
    """FRAME with all its sections.

    Args:
        content: The frame.
        version: Version of the stream, 3.0 or later, which determines the layout; one after 4.5
            has another section, of a kind that no client knows.
    """
    sized = version >= messages.SIZED
    bodies: Parts = [_encode_body(body) for body in content.bodies]
    markers: Parts = [_encode_marker(marker) for marker in content.markers]

    def other(element: bytes) -> tuple[int, Parts]:
        return (1, [element]) if content.crowded else (0, [])

    sections: list[tuple[int, Parts]] = [
        other(_MARKER_SET),
        other(_OTHER_MARKER),
        (len(bodies), bodies),
        other(_SKELETON),
        *([other(_ASSET)] if sized else []),
        (len(markers), markers),
        other(_FORCE_PLATE),
        other(_DEVICE),
        *[other(element) for since, element in _LATER if version >= since],
    ]
    parts: Parts = [pack("<i", content.number)]
    for number, section in sections:
        parts += [number, *_sized(section, sized)]
    flags = content.recording | 2 * content.models_changed
    precision = (0, 0) if sized else ()
    since_begin = (content.ticks[0] % 10**14) * 1e-7  # [s]
    suffix = (0, 0, since_begin, *content.ticks, *precision, flags, 0)
    end = pack("<IIdQQQIIhi" if sized else "<IIdQQQhi", *suffix)
    return Message.of(messages.FRAME, *parts, end)


def _encode_body(body: Body) -> bytes:
    return pack("<i8fh", body.id, *body.position, *body.quaternion, 1e-4, True)


def _encode_marker(marker: Marker) -> bytes:
    identity = marker.model << 16 | marker.member
    return pack("<i4fhf", identity, *marker.position, 0.014, marker.flags, 2e-4)


# An element of each section that a crowded frame holds besides its bodies and markers.
_BONE = _encode_body(Body(1, np.ones(3), np.array([0.0, 0.0, 0.0, 1.0])))
_MARKER_SET = b"all\0" + pack("<i3f", 1, 0.1, 0.2, 0.3)
_OTHER_MARKER = pack("<3f", 0.1, 0.2, 0.3)
_SKELETON = pack("<ii", 7, 1) + _BONE
_ASSET = pack("<ii", 8, 1) + _BONE + pack("<i", 1) + _encode_marker(Marker(8, 1, np.ones(3)))
_FORCE_PLATE = pack("<iii2f", 9, 1, 2, 10.0, 20.0)
_DEVICE = pack("<iii2f", 10, 1, 2, 1.0, 2.0)
_IMU = pack("<i10f", 11, *range(10))
_GPIO = pack("<iI", 12, 5)
_UNKNOWN = bytes(range(1, 24))
_LATER: tuple[tuple[Version, bytes], ...] = (((4, 5), _IMU), ((4, 5), _GPIO), ((4, 6), _UNKNOWN))
"""Elements of the sections that follow the devices, with the version that has them first."""


def encode_model_definitions(
    definitions: Iterable[RigidBodyDefinition], version: Version
) -> Message:
    """MODELDEF of rigid bodies, each with its marker set as in Motive.

    Args:
        definitions: The rigid bodies.
        version: Version of the stream, 3.0 to 4.5, which determines the layout.
    """
    parts: Parts = []
    number = 0
    for definition in definitions:
        count = len(definition.markers)
        names = b"".join(_text(f"Marker {k + 1}") for k in range(count))
        marker_set: Parts = [_text(definition.name), count, names]
        body: Parts = [_text(definition.name), pack("<ii3f", definition.id, -1, 0.0, 0.0, 0.0)]
        body += [pack("<4f", 0.0, 0.0, 0.0, 1.0)] if version >= (4, 2) else []
        body += [count, np.asarray(definition.markers, "<f4").tobytes(), bytes(4 * count)]
        body += [names] if version >= (4, 0) else []
        for kind, part in enumerate((marker_set, body)):
            number += 1
            parts += [pack("<i", kind), *_sized(part, version >= (4, 1))]
    return Message.of(messages.MODELDEF, number, *parts)


def _join(parts: Iterable[bytes | int]) -> tuple[bytes, list[int]]:
    """The bytes of parts, and the offsets of the counts."""
    data, counts = bytearray(), []
    for part in parts:
        if isinstance(part, int):
            counts.append(len(data))
        data += pack("<i", part) if isinstance(part, int) else part
    return bytes(data), counts


def _sized(parts: Parts, sized: bool) -> Parts:
    """Parts, preceded by their size if the version has it."""
    return [len(_join(parts)[0]), *parts] if sized else parts


def _text(text: str) -> bytes:
    return text.encode() + b"\0"


class Scene:
    """Generates frames with noise and the faults of markers and bodies.

    The faults are `mocap.occlude`, `mocap.swap`, `mocap.exchange` and `mocap.scale`.

    Args:
        bodies: Gives the bodies at a time of the steady clock [s]: the name of each, its m true
            markers in the world, shape (m, 3) [m], the position of its origin in the world, shape
            (3,) [m], and its quaternion (x, y, z, w), shape (4,) [-].
        faults: Faults of `simulation.world`, read at each frame.
        noise: Standard deviation of each coordinate of a marker [m].
        rng: Random numbers of the noise and the swaps.
        crowded: Whether frames hold every other section, see `Content.crowded`, and an unlabelled
            marker.
    """

    def __init__(
        self,
        bodies: Bodies,
        faults: Mapping[str, float],
        noise: float,
        rng: np.random.Generator,
        crowded: bool = False,
    ) -> None:
        self._bodies = bodies
        self._crowded = crowded
        self._faults = faults
        self._noise = noise
        self._rng = rng
        self._ids: dict[str, int] = {}
        self._names: tuple[str, ...] = ()
        self._seen: dict[tuple[str, int], FloatArray] = {}  # by name and number of markers
        self._changed = 0

    def restart(self) -> None:
        """Forget all earlier frames, as after a restart of the server."""
        self._seen.clear()
        self._names = ()

    def definitions(self, moment: float) -> list[RigidBodyDefinition]:
        """Definitions of the rigid bodies at a time of the steady clock [s].

        Their markers are in the body's frame [m].
        """
        found = []
        for name, markers, position, quaternion in self._bodies(moment):
            in_body = Rotation.from_quat(quaternion).inv().apply(markers - position) * self._scale
            places = tuple((float(x), float(y), float(z)) for x, y, z in in_body)
            found.append(RigidBodyDefinition(name, self._identify(name), places))
        return found

    def content(
        self, moment: float, number: int, ticks: tuple[int, int, int], recording: bool
    ) -> Content:
        """The frame exposed at a time.

        Args:
            moment: Middle of the exposure on the steady clock [s].
            number: Number of the frame.
            ticks: The server's clock at mid-exposure, at data received and at transmission [ticks].
            recording: Whether the server records a take.
        """
        bodies: list[Body] = []
        labelled: list[Marker] = []
        scene = self._bodies(moment)
        names = tuple(name for name, *_ in scene)
        if names != self._names:
            self._changed = _CHANGE_FRAMES if self._names else 0
            self._names = names
        self._changed = max(0, self._changed - 1)
        for name, true, position, quaternion in scene:
            identity = self._identify(name)
            markers, hidden = self._observe(name, np.asarray(true, dtype=float))
            bodies.append(Body(identity, position * self._scale, quaternion))
            for k, (marker, is_hidden) in enumerate(zip(markers, hidden, strict=True)):
                flags = HAS_MODEL | (OCCLUDED if is_hidden else SOLVED)
                labelled.append(Marker(identity, k + 1, marker * self._scale, flags))
        if self._crowded:
            labelled.append(Marker(0, 1, np.ones(3) * self._scale, SOLVED))
        changed = self._changed > 0
        return Content(number, ticks, bodies, labelled, recording, changed, self._crowded)

    @property
    def _scale(self) -> float:
        """Factor on all lengths [-]."""
        return self._faults.get("mocap.scale", 0.0) or 1.0

    def _identify(self, name: str) -> int:
        """Streaming id of a body, from 1 in the order of their first frame."""
        identity = self._ids.setdefault(name, len(self._ids) + 1)
        if self._faults.get("mocap.exchange", 0.0) and identity <= 2:
            return 3 - identity
        return identity

    def _observe(self, name: str, true: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Markers by label, and which of them are hidden."""
        markers = true + (self._rng.normal(0.0, self._noise, true.shape) if self._noise else 0.0)
        hidden = np.zeros(len(markers), dtype=bool)
        occluded = round(self._faults.get("mocap.occlude", 0.0)) - 1
        if 0 <= occluded < len(markers):  # send its last position, like Motive
            hidden[occluded] = True
            markers[occluded] = self._seen.get((name, len(markers)), markers)[occluded]
        self._seen[name, len(markers)] = markers.copy()
        if self._rng.random() < self._faults.get("mocap.swap", 0.0):
            a, b = self._rng.choice(len(markers), 2, replace=False)
            markers[[a, b]] = markers[[b, a]]
            hidden[[a, b]] = hidden[[b, a]]
        return markers, hidden


class FaultyNetwork:
    """Sends datagrams on a socket, with the active faults.

    Args:
        udp: The socket.
        faults: Faults of `simulation.world`, read at each datagram.
        rng: Random numbers of the faults.
    """

    def __init__(
        self, udp: socket.socket, faults: Mapping[str, float], rng: np.random.Generator
    ) -> None:
        self._socket = udp
        self._faults = faults
        self._rng = rng
        self._held: list[tuple[bytes, Address]] = []

    def send(self, message: Message, address: Address) -> None:
        """Send a message, subject to the faults.

        Args:
            message: The message.
            address: IPv4 address and port of the receiver.
        """
        if self._faults.get("mocap.unplugged", 0.0):
            self._held.clear()
            return
        data, copies = message.data, 1
        if self._happens("corrupt"):
            data = message.corrupted(self._rng)
        if self._happens("truncate"):
            data = data[: int(self._rng.integers(len(data)))]
        if self._happens("duplicate"):
            copies = 2
        if self._happens("drop"):
            copies = 0
        if copies and not self._held and self._happens("reorder"):
            self._held.append((data, address))
            return
        due, self._held = [*[(data, address)] * copies, *self._held], []
        for datagram in due:
            with suppress(OSError):  # client gone or buffer full
                self._socket.sendto(*datagram)

    def _happens(self, fault: str) -> bool:
        probability = self._faults.get(f"mocap.{fault}", 0.0)
        return bool(probability) and self._rng.random() < probability


@dataclass
class _Client:
    last: float  # time of its last message [s]
    version: Version


class NatNetServer:
    """Streams bodies to its clients, from its construction until it is closed.

    Args:
        bodies: Gives the bodies at a time of the steady clock [s], see `Scene`.
        rate: Rate of the frames [Hz].
        version: NatNet version of the server, major and minor; its frames can be 3.0 to 4.5 on
            request.
        address: IPv4 address and command port; port 0 selects a free one.
        multicast: Multicast group and its data port; None to stream to each client.
        faults: Faults of `simulation.world`, read live; None for none.
        noise: Standard deviation of each coordinate of a marker [m].
        seed: Seed of the random numbers.
        refused: Names of commands that it does not know, such as "Bitstream".
        crowded: Whether frames hold every section, from a marker set to a GPIO, as of a server with
            skeletons, assets (trained marker sets), force plates and devices.
        layout: Version of the frames' layout if it is not that of the server; None if it is.

    Attributes:
        takes: Names of the recorded takes in order, including the current one.
        recording: Whether a take is being recorded.
        commands: Texts of all received commands, in order.
    """

    def __init__(
        self,
        bodies: Bodies,
        rate: float = 240.0,
        version: Version = messages.NEWEST,
        address: Address = ("127.0.0.1", 0),
        multicast: Address | None = None,
        faults: Mapping[str, float] | None = None,
        noise: float = 0.0,
        seed: int = 0,
        refused: Collection[str] = (),
        crowded: bool = False,
        layout: Version | None = None,
    ) -> None:
        self.takes: list[str] = []
        self.recording = False
        self.commands: list[str] = []
        self._take = ""
        self._rate = rate
        self._version = version
        self._layout = layout or version
        self._refused = frozenset(refused)
        self._multicast = multicast
        self._faults: Mapping[str, float] = {} if faults is None else faults
        self._rng, network_rng, scene_rng = np.random.default_rng(seed).spawn(3)
        self._scene = Scene(bodies, self._faults, noise, scene_rng, crowded)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(address)
        if multicast is not None:
            interface = socket.inet_aton(address[0])
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        self._network = FaultyNetwork(self._socket, self._faults, network_rng)
        self._restarts = self._faults.get("mocap.restart", 0.0)
        self._restart(clocks.monotonic())
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="natnet-server", daemon=True)
        self._thread.start()

    @property
    def address(self) -> Address:
        """Host and port of the command port."""
        host, port = self._socket.getsockname()
        return host, port

    def close(self) -> None:
        """Stop without notifying the clients."""
        self._closing.set()
        self._thread.join()
        self._socket.close()

    def _restart(self, now: float) -> None:
        self._clients: dict[Address, _Client] = {}
        self._origin = now
        self._offset = int(self._rng.integers(10**9, 10**14))
        self._number = 0
        self.recording = False
        self._scene.restart()

    def _ticks(self, moment: float) -> int:
        return self._offset + round((moment - self._origin) * _CLOCK)

    def _run(self) -> None:
        while not self._closing.is_set():
            due = self._origin + self._number / self._rate + _LATENCY
            wait = clocks.real(max(0.0, due - clocks.monotonic()))
            readable = select.select([self._socket], [], [], wait)[0]
            now = clocks.monotonic()
            restarts = self._faults.get("mocap.restart", 0.0)
            if restarts and restarts != self._restarts:
                self._restart(now)
            self._restarts = restarts
            if readable:
                self._listen()
            if now >= due:
                if now < due + _MAX_DELAY:
                    self._stream(now)
                self._number += 1

    def _listen(self) -> None:
        for _ in range(64):
            try:
                datagram, client = self._socket.recvfrom(messages.LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # client gone
                continue
            if self._faults.get("mocap.unplugged", 0.0):
                continue
            with suppress(messages.MalformedDatagram):
                kind, payload = messages.split_datagram(datagram)
                answer = self._answer(kind, payload, client, clocks.monotonic())
                if answer is not None:
                    self._network.send(answer, client)

    def _answer(self, kind: int, payload: bytes, address: Address, now: float) -> Message | None:
        """The answer to a client's message, if any."""
        client = self._clients.get(address)
        if client is not None:
            client.last = now
        answer: Message | None = Message.of(messages.UNRECOGNIZED)
        match kind:
            case messages.CONNECT:  # in any of the three forms that clients send
                if self._multicast is None:
                    self._clients[address] = _Client(now, self._layout)
                group, port = self._multicast or ("", 1511)
                who, app, is_group = "simulated Motive", (3, 5, 0, 0), bool(group)
                info = ServerInfo(who, app, self._version, _CLOCK, port, is_group, group)
                answer = encode_server_info(info)
            case messages.REQUEST:
                text = payload.partition(b"\0")[0].decode("utf-8", "replace")
                self.commands.append(text)
                reply = self._obey(*text.partition(",")[::2], client)
                if reply is not None:
                    answer = Message.of(messages.RESPONSE, reply)
            case messages.REQUEST_MODELDEF:
                version = client.version if client else self._layout
                answer = encode_model_definitions(self._scene.definitions(now), version)
            case messages.ECHOREQUEST if len(payload) >= 8:
                ticks = pack("<Q", self._ticks(now))
                answer = Message.of(messages.ECHORESPONSE, payload[:8], ticks)
            case messages.DISCONNECT:
                self._clients.pop(address, None)
                answer = None
            case messages.KEEPALIVE | messages.ECHOREQUEST:
                answer = None
        return answer

    def _obey(self, name: str, argument: str, client: _Client | None) -> bytes | None:
        """The reply to a command; None for an unknown one."""
        if self._version < (4, 0):
            client = None  # it has no settings
        if name in self._refused:
            return None
        match name:
            case "StartRecording":
                if not self.recording:
                    self.takes.append(self._take or f"Take {len(self.takes) + 1}")
                self.recording = True
            case "StopRecording":
                self.recording = False
            case "SetRecordTakeName":
                self._take = argument
            case "Bitstream" if client is not None:
                wanted = _VERSIONS.get(argument, (9, 9))
                if wanted > self._version:
                    return pack("<i", 1)
                client.version = wanted
            case "SubscribeToData" if client is not None:
                pass  # every client receives everything
            case _:
                return None
        return bytes(4)

    def _stream(self, now: float) -> None:
        moment = self._origin + self._number / self._rate
        self._clients = {a: c for a, c in self._clients.items() if now - c.last <= _TIMEOUT}
        targets = self._clients
        if self._multicast is not None:
            targets = {self._multicast: _Client(now, self._layout)}
        if not targets:
            return
        ticks = (self._ticks(moment), self._ticks(moment + 0.5 * _LATENCY), self._ticks(now))
        content = self._scene.content(moment, self._number, ticks, self.recording)
        for address, client in targets.items():
            self._network.send(encode_frame(content, client.version), address)
