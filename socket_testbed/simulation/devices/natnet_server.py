"""A NatNet server on real sockets: its cameras, the faults of its network, its commands."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from struct import pack
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.natnet import messages
from socket_testbed.simulation.devices import natnet_encoding as encoding
from socket_testbed.simulation.devices.natnet_encoding import Message

# Name, markers in the world (m, 3) [m], position (3,) [m], quaternion (4,) of each body.
Bodies: TypeAlias = Callable[[float], Sequence[tuple[str, FloatArray, FloatArray, FloatArray]]]
Address: TypeAlias = tuple[str, int]

CLOCK = 10_000_000  # [Hz]
_LATENCY = 0.004  # [s]; from mid-exposure to transmission
_BEHIND = 0.25  # [s]; frames that are later than this are left out
_SILENCE = 10.0  # [s]; after which a client is forgotten
_CHANGED = 24  # frames that say that the rigid bodies have changed
_VERSIONS = {  # a stream can be asked for
    f"{major}.{minor}": (major, minor)
    for major, minor in ((3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3), (4, 4))
}


class Scene:
    """Makes frames of bodies with noise [m] and the faults `mocap.occlude` and `mocap.swap`."""

    def __init__(
        self, bodies: Bodies, faults: Mapping[str, float], noise: float, rng: np.random.Generator
    ) -> None:
        self._bodies = bodies
        self._faults = faults
        self._noise = noise
        self._rng = rng
        self._ids: dict[str, int] = {}
        self._names: tuple[str, ...] = ()
        self._seen: dict[tuple[str, int], FloatArray] = {}  # by name and number of markers
        self._changed = 0

    def restart(self) -> None:
        """Forget all that was seen, as a server that restarts."""
        self._seen.clear()
        self._names = ()

    def definitions(self, moment: float) -> list[messages.RigidBodyDefinition]:
        """The rigid bodies as they are defined at a time of the steady clock [s]."""
        found = []
        for name, markers, position, quaternion in self._bodies(moment):
            in_body = Rotation.from_quat(quaternion).inv().apply(markers - position)
            places = tuple((float(x), float(y), float(z)) for x, y, z in in_body)
            found.append(messages.RigidBodyDefinition(name, self._identify(name), places))
        return found

    def content(
        self, moment: float, number: int, ticks: tuple[int, int, int], recording: bool
    ) -> encoding.Content:
        """The frame that is exposed at a time of the steady clock [s]."""
        bodies: list[encoding.Body] = []
        labelled: list[encoding.Marker] = []
        sets: dict[str, FloatArray] = {}
        scene = self._bodies(moment)
        names = tuple(name for name, *_ in scene)
        if names != self._names:
            self._changed = _CHANGED if self._names else 0
            self._names = names
        self._changed = max(0, self._changed - 1)
        for name, true, position, quaternion in scene:
            identity = self._identify(name)
            markers, hidden = self._observe(name, np.asarray(true, dtype=float))
            bodies.append(encoding.Body(identity, position, quaternion, not hidden.any()))
            sets[name] = markers
            for k in range(len(markers)):
                flags = encoding.HAS_MODEL | (encoding.OCCLUDED if hidden[k] else encoding.SOLVED)
                labelled.append(encoding.Marker(identity, k + 1, markers[k], flags))
        return encoding.Content(
            number=number,
            ticks=ticks,
            bodies=bodies,
            markers=labelled,
            marker_sets=sets,
            others=np.array([[1.0, 2.0, 0.5]]),  # a reflection on the floor
            recording=recording,
            models_changed=self._changed > 0,
        )

    def _identify(self, name: str) -> int:
        return self._ids.setdefault(name, len(self._ids) + 1)

    def _observe(self, name: str, true: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Markers by their labels, and which of them are hidden."""
        markers = (
            true + self._rng.normal(0.0, self._noise, true.shape) if self._noise else true.copy()
        )
        hidden = np.zeros(len(markers), dtype=bool)
        occluded = round(self._faults.get("mocap.occlude", 0.0)) - 1
        if 0 <= occluded < len(markers):  # its last position goes out, as from Motive
            hidden[occluded] = True
            markers[occluded] = self._seen.get((name, len(markers)), markers)[occluded]
        self._seen[name, len(markers)] = markers.copy()
        if self._rng.random() < self._faults.get("mocap.swap", 0.0):
            a, b = self._rng.choice(len(markers), 2, replace=False)
            markers[[a, b]] = markers[[b, a]]
            hidden[[a, b]] = hidden[[b, a]]
        return markers, hidden


# By fault, the bytes of a message that are sent, and how often.
_STRIKES: dict[str, Callable[[Message, bytes, np.random.Generator], tuple[bytes, int]]] = {
    "corrupt": lambda message, data, rng: (message.corrupted(rng), 1),
    "truncate": lambda message, data, rng: (data[: int(rng.integers(len(data)))], 1),
    "duplicate": lambda message, data, rng: (data, 2),
    "drop": lambda message, data, rng: (data, 0),
}


class FaultyNetwork:
    """Sends datagrams of a socket, with the faults that are on."""

    def __init__(
        self, udp: socket.socket, faults: Mapping[str, float], rng: np.random.Generator
    ) -> None:
        self._socket = udp
        self._faults = faults
        self._rng = rng
        self._held: list[tuple[bytes, Address]] = []

    def send(self, message: Message, address: Address) -> None:
        """Send a message as the faults leave it."""
        if self._faults.get("mocap.unplugged", 0.0):
            self._held.clear()
            return
        data, copies = bytes(message.data), 1
        for fault, strike in _STRIKES.items():
            if self._happens(fault):
                data, copies = strike(message, data, self._rng)
        if copies and not self._held and self._happens("reorder"):
            self._held.append((data, address))
            return
        for _ in range(copies):
            self._put(data, address)
        held, self._held = self._held, []
        for late in held:
            self._put(*late)

    def _happens(self, fault: str) -> bool:
        probability = self._faults.get(f"mocap.{fault}", 0.0)
        return bool(probability) and self._rng.random() < probability

    def _put(self, data: bytes, address: Address) -> None:
        with suppress(OSError):  # a client that is gone, a buffer that is full
            self._socket.sendto(data, address)


@dataclass
class _Client:
    heard: float
    version: messages.Version
    subscriptions: set[str] = field(default_factory=set)  # of sections; none: it gets everything


class NatNetServer:
    """Streams bodies to its clients, from its construction until it is closed.

    Args:
        bodies: The rigid bodies at a time of the steady clock [s]: each its name, its markers
            in the world, shape (m, 3) [m], its position [m] and quaternion (x, y, z, w).
        rate: Frame rate [Hz].
        version: NatNet version.
        address: Address of its command port; port 0 takes a free one.
        multicast: Group and data port that it streams to; None: unicast.
        faults: The faults `mocap.*` of `socket_testbed.simulation.world`, looked up live.
        noise: Standard deviation of a marker's coordinate [m].
    """

    def __init__(
        self,
        bodies: Bodies,
        rate: float = 240.0,
        version: messages.Version = (4, 1),
        address: Address = ("127.0.0.1", 0),
        multicast: Address | None = None,
        faults: Mapping[str, float] | None = None,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.takes: list[str] = []  # names of the takes recorded, the one that is on included
        self.recording = False
        self.commands: list[str] = []  # all commands that came, as they came
        self._take = ""
        self._rate = rate
        self._version = version
        self._multicast = multicast
        self._faults: Mapping[str, float] = {} if faults is None else faults
        clock_rng, network_rng, scene_rng = (
            np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)
        )
        self._rng = clock_rng
        self._scene = Scene(bodies, self._faults, noise, scene_rng)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(address)
        if multicast is not None:
            interface = socket.inet_aton(address[0])
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        self._network = FaultyNetwork(self._socket, self._faults, network_rng)
        self._answers: dict[int, Callable[[bytes, Address, float], Message | None]] = {
            messages.CONNECT: self._connect,
            messages.REQUEST: self._request,
            messages.REQUEST_MODELDEF: self._define_models,
            messages.KEEPALIVE: lambda payload, client, now: None,
            messages.ECHOREQUEST: self._echo,
            messages.DISCONNECT: self._disconnect,
        }
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
        """End without notice to the clients."""
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
        return self._offset + round((moment - self._origin) * CLOCK)

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
                if now < due + _BEHIND:
                    self._stream(now)
                self._number += 1

    def _listen(self) -> None:
        for _ in range(64):
            try:
                datagram, client = self._socket.recvfrom(messages.LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # a client that is gone
                continue
            if self._faults.get("mocap.unplugged", 0.0):
                continue
            try:
                message, payload = messages.split_datagram(datagram)
            except messages.MalformedDatagram:
                continue
            now = clocks.monotonic()
            if client in self._clients:
                self._clients[client].heard = now
            answer = self._answers.get(message, self._unrecognized)
            if (reply := answer(payload, client, now)) is not None:
                self._network.send(reply, client)

    def _unrecognized(self, payload: bytes, client: Address, now: float) -> Message:
        return Message.of(messages.UNRECOGNIZED)

    def _connect(self, payload: bytes, client: Address, now: float) -> Message:
        """Accept any of the three forms that clients send."""
        if self._multicast is None:
            self._clients[client] = _Client(now, self._version)
        group, port = self._multicast or ("", 1511)
        app, version = (3, 1, 0, 0), self._version
        return encoding.encode_server_info(
            messages.ServerInfo("simulated Motive", app, version, CLOCK, port, bool(group), group)
        )

    def _disconnect(self, payload: bytes, client: Address, now: float) -> None:
        self._clients.pop(client, None)

    def _echo(self, payload: bytes, client: Address, now: float) -> Message | None:
        if len(payload) < 8:
            return None
        return Message.of(messages.ECHORESPONSE, payload[:8] + pack("<Q", self._ticks(now)))

    def _define_models(self, payload: bytes, client: Address, now: float) -> Message:
        known = self._clients.get(client)
        version = known.version if known else self._version
        return encoding.encode_model_definitions(self._scene.definitions(now), version)

    def _request(self, payload: bytes, client: Address, now: float) -> Message:
        text = payload.partition(b"\0")[0].decode("utf-8", "replace")
        self.commands.append(text)
        reply = self._obey(*text.partition(",")[::2], self._clients.get(client))
        return Message.of(
            messages.UNRECOGNIZED if reply is None else messages.RESPONSE, reply or b""
        )

    def _obey(self, name: str, argument: str, client: _Client | None) -> bytes | None:
        """The reply to a command; None for an unknown one."""
        if self._version < (4, 0):
            client = None  # nothing can be set for it
        match name:
            case "StartRecording":
                if not self.recording:
                    self.takes.append(self._take or f"Take {len(self.takes) + 1}")
                self.recording = True
            case "StopRecording":
                self.recording = False
            case "SetRecordTakeName":
                self._take = argument
            case "FrameRate":
                return pack("<f", self._rate)
            case "UnitsToMillimeters":
                return pack("<f", 1000.0)
            case "Bitstream" if client is not None:
                wanted = _VERSIONS.get(argument, (9, 9))
                if wanted > self._version:
                    return pack("<i", 1)
                client.version = wanted
            case "SubscribeToData" if client is not None:
                client.subscriptions.add(argument.partition(",")[0])
            case _:
                return None
        return bytes(4)

    def _stream(self, now: float) -> None:
        moment = self._origin + self._number / self._rate
        self._clients = {a: c for a, c in self._clients.items() if now - c.heard <= _SILENCE}
        targets = self._clients
        if self._multicast is not None:
            targets = {self._multicast: _Client(now, self._version)}
        if not targets:
            return
        ticks = (self._ticks(moment), self._ticks(moment + 0.5 * _LATENCY), self._ticks(now))
        content = self._scene.content(moment, self._number, ticks, self.recording)
        for address, client in targets.items():
            self._network.send(
                encoding.encode_frame(_subscribed(content, client), client.version), address
            )


def _subscribed(content: encoding.Content, client: _Client) -> encoding.Content:
    """The part of a frame that a client has subscribed to."""
    if not client.subscriptions:
        return content
    return replace(
        content,
        bodies=content.bodies if "RigidBody" in client.subscriptions else (),
        markers=content.markers if "LabeledMarkers" in client.subscriptions else (),
        marker_sets={},
        others=np.empty((0, 3)),
    )
