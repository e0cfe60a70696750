"""The UDP sockets towards a NatNet server, the commands sent over them, and its takes."""

from __future__ import annotations

import errno
import ipaddress
import re
import select
import socket
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from socket_testbed import clocks
from socket_testbed.drivers.natnet.messages import LARGEST_DATAGRAM, OLDEST, Version, encode_command
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.settings.testbed import check_take_name

_BUFFER = 1 << 20  # [bytes]; the frames of a second
_AT_ONCE = 64  # datagrams
_ATTEMPTS = 10
_INTERVAL = 0.02  # [s]; as the maker's own client
_DUPLICATES = 0.01  # [s]; how long a second copy of an answer may take
_STRAYS = 0.06  # [s]; how long answers to repetitions may take

_RETRY = 0.25  # [s]; from a command that failed to the next
_IN_FLIGHT = 0.1  # [s]; after which no frame is from before a command
_EVIDENCE = 0.3  # [s]; for the frames of a new session to show a recording
_CONTRADICTED = 1.0  # [s]


def server_address(settings: MocapSettings) -> tuple[str, int]:
    """Address of the server's command port."""
    if not settings.server.strip():
        raise ConfigurationError(
            "mocap_node: server is empty", "give the address of the computer that runs Motive"
        )
    for name, value in (("multicast", settings.multicast), ("interface", settings.interface)):
        if not value:
            continue
        fact = f"mocap_node: {name} is '{value}'"
        try:
            address = ipaddress.IPv4Address(value)
        except ValueError:
            raise ConfigurationError(fact, "give an IPv4 address, or nothing") from None
        if name == "multicast" and not address.is_multicast:
            fact = f"{fact}, which is not a multicast group"
            raise ConfigurationError(fact, "give 239.255.42.99, say")
    try:
        found = socket.getaddrinfo(
            settings.server.strip(), settings.command_port, socket.AF_INET, socket.SOCK_DGRAM
        )
    except (OSError, UnicodeError) as error:
        raise ConfigurationError(
            f"mocap_node: server '{settings.server}' is not known ({error})",
            "give the address of the computer that runs Motive, such as 192.168.1.2",
        ) from None
    return str(found[0][4][0]), settings.command_port


def bitstream_version(settings: MocapSettings) -> Version:
    """The version of the stream to ask for."""
    fact = f"mocap_node: bitstream is '{settings.bitstream}'"
    parts = re.fullmatch(r"([0-9]{1,2})\.([0-9]{1,2})", settings.bitstream)
    if parts is None:
        raise ConfigurationError(fact, "give a version such as 4.1")
    version = int(parts[1]), int(parts[2])
    if version < OLDEST:
        raise ConfigurationError(f"{fact}, which is too old", "give 3.0 or later, such as 4.1")
    return version


class NatNetSockets:
    """One socket for commands and, in unicast, data; another for a group's data."""

    def __init__(self, settings: MocapSettings, server: tuple[str, int]) -> None:
        self._settings = settings
        self._server = server
        self._sockets: list[socket.socket] = []  # that of the commands first

    def open(self) -> None:
        """Open the sockets, unless they are."""
        if self._sockets:
            return
        interface, group = self._settings.interface, self._settings.multicast
        try:
            self._add((interface, 0))
            if group:
                data = self._add((group, self._settings.data_port))  # other groups stay out
                membership = socket.inet_aton(group) + socket.inet_aton(interface or "0.0.0.0")
                data.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            self.close()
            if error.errno != errno.EADDRINUSE:
                raise
            raise DeviceError(
                f"mocap_node: another program has the data port {self._settings.data_port}",
                "end the other NatNet client, or stream unicast",
            ) from None

    def _add(self, address: tuple[str, int]) -> socket.socket:
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sockets.append(udp)
        udp.setblocking(False)
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        if address[1]:
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        udp.bind(address)
        return udp

    def send(self, datagram: bytes) -> None:
        """Send a datagram to the server."""
        if not self._sockets:
            raise OSError(errno.ENOTCONN, "no socket")
        with suppress(BlockingIOError):
            self._sockets[0].sendto(datagram, self._server)

    def receive(self, timeout: float) -> Iterator[tuple[bytes, str]]:
        """Datagrams that came, waiting so long for the first [s], and the host each is from."""
        for udp in select.select(self._sockets, [], [], clocks.real(timeout))[0]:
            for _ in range(_AT_ONCE):
                try:
                    datagram, sender = udp.recvfrom(LARGEST_DATAGRAM)
                except BlockingIOError:
                    break
                except OSError:  # a host on the way refused one
                    continue
                yield datagram, sender[0]

    def close(self) -> None:
        """Close the sockets."""
        for udp in self._sockets:
            udp.close()
        self._sockets.clear()


@dataclass(frozen=True)
class Answer:
    """The reply to a command: four bytes of a number (0 is yes), or a text."""

    raw: bytes | None  # the reply as it came; None: none came
    recognized: bool = True  # whether the server knows the command

    @property
    def text(self) -> str:
        """The reply for a person."""
        raw = self.raw or b""
        if len(raw) == 4:
            return str(int.from_bytes(raw, "little", signed=True))
        return raw.partition(b"\0")[0].decode("utf-8", "replace")

    def fault(self, command: str) -> str:
        """The reason of a failure; empty for none."""
        name = command.partition(",")[0]
        if self.raw is None:
            return f"no answer to {name}"
        if not self.recognized:
            return f"the server does not know {name}"
        refused = len(self.raw) == 4 and any(self.raw)
        return f"the server refuses {name} ({self.text})" if refused else ""


Done = Callable[[Answer], None]


class CommandQueue:
    """Sends commands one after the other, since replies do not name their command.

    A command is repeated until it is answered; before the next one, the answers to the
    repetitions are awaited. `submit` may be called from any thread, all else from one.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[str, Done]] = deque()  # the one that is being sent first
        self._sent = 0  # how often without an answer
        self._next = 0.0  # [s]

    def submit(self, text: str, done: Done) -> None:
        """Have a command sent; `done` is called with its answer."""
        self._waiting.append((text, done))

    def step(self, now: float, send: Callable[[bytes], None]) -> None:
        """Send the command that is due at a time of the steady clock [s], if any."""
        if now < self._next or not self._waiting:
            return
        if self._sent == _ATTEMPTS:
            self._finish(Answer(None), now)
            return
        self._sent += 1
        self._next = now + _INTERVAL
        send(encode_command(self._waiting[0][0]))

    def answer(self, answer: Answer, now: float) -> None:
        """Take a reply."""
        if self._sent:
            self._finish(answer, now)

    def _finish(self, answer: Answer, now: float) -> None:
        self._next = now + (_STRAYS if self._sent > 1 else _DUPLICATES)
        self._sent = 0
        _, done = self._waiting.popleft()
        done(answer)


class TakeKeeper:
    """Pursues the wanted take: named and started, stopped, and started again after a restart.

    `want` may be called from any thread, all else from one.
    """

    def __init__(self, submit: Callable[[str, Done], None]) -> None:
        self._submit = submit
        self._wanted: str | None = None
        self._started: str | None = None  # the take that may be on
        self._confirmed = False
        self._busy = False
        self._next = 0.0  # [s]; of a command
        self._moment = 0.0  # [s]; frames before it may be of an earlier take
        self._idle_since: float | None = None
        self._session = 0
        self.fault = ""

    @property
    def settled(self) -> bool:
        """Whether the server does what is wanted."""
        wanted = self._wanted
        return not self._busy and self._started == wanted and (wanted is None or self._confirmed)

    def want(self, name: str | None) -> None:
        """Want a take recorded, or none."""
        self._wanted = None
        self._wanted = None if name is None else check_take_name(name)

    def restarted(self, now: float) -> None:
        """A session has begun: the server may have forgotten the take."""
        self._session += 1
        self._confirmed = False
        self._moment = now
        self._next = now + (0.0 if self._started is None else _EVIDENCE)
        self._idle_since = None

    def observe(self, recording: bool, now: float) -> None:
        """Note whether a frame says that the server records."""
        if recording:
            self._idle_since = None
            if self._started is not None and now > self._moment:
                self._confirmed = True
        elif self._idle_since is None:
            self._idle_since = now

    def step(self, now: float, connected: bool) -> None:
        """Issue the command that is due at a time of the steady clock [s], if any."""
        if self.settled:
            idle = self._idle_since is not None and now - self._idle_since > _CONTRADICTED
            self._note("the frames say that the server does not record" if idle else "")
        elif not connected:
            self._note("no connection")
        elif not self._busy and now >= self._next:
            stop = self._started not in (None, self._wanted)
            self._issue("StopRecording" if stop else f"SetRecordTakeName,{self._wanted}", now)

    def _issue(self, command: str, now: float) -> None:
        session, wanted = self._session, self._wanted

        def done(answer: Answer) -> None:
            self._busy = False
            fault = answer.fault(command)
            idle = self._idle_since is not None and answer.raw is not None
            if command == "StopRecording" and idle:
                fault = ""  # a server that does not record may refuse to stop
            self._note(fault)
            if fault:
                self._next = now + _RETRY
            elif session != self._session:
                return
            elif command == "StopRecording":
                self._started, self._confirmed = None, False
            elif command == "StartRecording":
                self._confirmed, self._idle_since = True, None
            elif wanted == self._wanted:
                self._started, self._moment = wanted, now + _IN_FLIGHT
                self._issue("StartRecording", now)

        self._busy = True
        self._submit(command, done)

    def _note(self, reason: str) -> None:
        wanted = self._wanted
        doing = "no take is stopped" if wanted is None else f"take '{wanted}' is not recorded"
        unwanted = wanted is None and self._started is None
        self.fault = f"{doing}: {reason}" if reason and not unwanted else ""
