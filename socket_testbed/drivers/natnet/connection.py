"""UDP sockets to a NatNet server, its commands and its takes."""

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

_BUFFER_SIZE = 1 << 20  # [bytes]; frames of one second
_MAX_DATAGRAMS = 64  # per call
_MAX_ATTEMPTS = 10
_ATTEMPT_INTERVAL = 0.02  # [s]; as in the maker's client
_DUPLICATE_WAIT = 0.01  # [s]; for a second copy of an answer
_REPEAT_WAIT = 0.06  # [s]; for answers to repetitions

_RETRY_INTERVAL = 0.25  # [s]; after a failed command
_FRAME_DELAY = 0.1  # [s]; later frames are from after a command
_EVIDENCE_WAIT = 0.3  # [s]; for frames of a new session to show a recording
_IDLE_TIMEOUT = 1.0  # [s]


def server_address(settings: MocapSettings) -> tuple[str, int]:
    """Address of the server's command port: its IPv4 address and the port.

    Raises:
        ConfigurationError: `server` is empty or not known, or `multicast` or `interface` is not the
            address that it should be.
    """
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
    """The version of the stream to ask for, major and minor, from the setting `bitstream`.

    Raises:
        ConfigurationError: The setting is not of the form 4.1, or older than 3.0.
    """
    fact = f"mocap_node: bitstream is '{settings.bitstream}'"
    parts = re.fullmatch(r"([0-9]{1,2})\.([0-9]{1,2})", settings.bitstream)
    if parts is None:
        raise ConfigurationError(fact, "give a version such as 4.1")
    version = int(parts[1]), int(parts[2])
    if version < OLDEST:
        raise ConfigurationError(f"{fact}, which is too old", "give 3.0 or later, such as 4.1")
    return version


class NatNetSockets:
    """One socket for commands and unicast data, another for multicast data.

    Args:
        settings: Own address, multicast group (empty for unicast) and its data port.
        server: IPv4 address and command port of the server, see `server_address`.
    """

    def __init__(self, settings: MocapSettings, server: tuple[str, int]) -> None:
        self._settings = settings
        self._server = server
        self._sockets: list[socket.socket] = []  # the command socket first

    def open(self) -> None:
        """Open the sockets if they are closed; OSError if there is no network yet.

        Raises:
            DeviceError: Another program has the data port.
        """
        if self._sockets:
            return
        interface, group = self._settings.interface, self._settings.multicast
        try:
            self._add((interface, 0))
            if group:
                data = self._add((group, self._settings.data_port))  # only this group
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
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_SIZE)
        if address[1]:
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        udp.bind(address)
        return udp

    def send(self, datagram: bytes) -> None:
        """Send a datagram to the server.

        Raises:
            OSError: The sockets are closed, or there is no network.
        """
        if not self._sockets:
            raise OSError(errno.ENOTCONN, "no socket")
        with suppress(BlockingIOError):
            self._sockets[0].sendto(datagram, self._server)

    def receive(self, timeout: float) -> Iterator[tuple[bytes, str]]:
        """Received datagrams and the IPv4 addresses that sent them.

        It waits up to a timeout [s] of the testbed's clock for the first.
        """
        for udp in select.select(self._sockets, [], [], clocks.real(timeout))[0]:
            for _ in range(_MAX_DATAGRAMS):
                try:
                    datagram, sender = udp.recvfrom(LARGEST_DATAGRAM)
                except BlockingIOError:
                    break
                except OSError:  # a host on the way refused a datagram
                    continue
                yield datagram, sender[0]

    def close(self) -> None:
        """Close the sockets."""
        for udp in self._sockets:
            udp.close()
        self._sockets.clear()


@dataclass(frozen=True)
class Answer:
    """The reply to a command.

    Attributes:
        raw: Its payload: a little-endian i32 or f32 (0: accepted), or a text; None for no reply.
        recognized: Whether the server knows the command.
    """

    raw: bytes | None
    recognized: bool = True

    @property
    def text(self) -> str:
        """The reply as text: a number of four bytes in decimal; empty for no reply."""
        raw = self.raw or b""
        if len(raw) == 4:
            return str(int.from_bytes(raw, "little", signed=True))
        return raw.partition(b"\0")[0].decode("utf-8", "replace")

    def fault(self, command: str) -> str:
        """Why the command, such as "SetRecordTakeName,walk", failed; empty if it did not."""
        name = command.partition(",")[0]
        if self.raw is None:
            return f"no answer to {name}"
        if not self.recognized:
            return f"the server does not know {name}"
        refused = len(self.raw) == 4 and any(self.raw)
        return f"the server refuses {name} ({self.text})" if refused else ""


Done = Callable[[Answer], None]


class CommandQueue:
    """Sends commands one at a time, since replies do not name their command.

    A command is repeated until it is answered. Before the next one, the queue waits for answers to
    the repetitions. `submit` is thread-safe; the other methods are for one thread.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[str, Done]] = deque()  # the current one first
        self._sent = 0  # unanswered attempts
        self._next = 0.0  # [s]

    def submit(self, text: str, done: Done) -> None:
        """Queue a command.

        Args:
            text: The command with its arguments, separated by commas.
            done: Called once with the answer, on the thread of the other methods; after ten
                attempts without a reply, with an `Answer` whose `raw` is None.
        """
        self._waiting.append((text, done))

    def step(self, now: float, send: Callable[[bytes], None]) -> None:
        """Send the command that is due, if any.

        Args:
            now: The present time of the steady clock [s].
            send: Sends a datagram to the server.
        """
        if now < self._next or not self._waiting:
            return
        if self._sent == _MAX_ATTEMPTS:
            self._finish(Answer(None), now)
            return
        self._sent += 1
        self._next = now + _ATTEMPT_INTERVAL
        send(encode_command(self._waiting[0][0]))

    def answer(self, answer: Answer, now: float) -> None:
        """Handle a reply; it is ignored if no command waits for one.

        Args:
            answer: The reply.
            now: The present time of the steady clock [s].
        """
        if self._sent:
            self._finish(answer, now)

    def _finish(self, answer: Answer, now: float) -> None:
        self._next = now + (_REPEAT_WAIT if self._sent > 1 else _DUPLICATE_WAIT)
        self._sent = 0
        _, done = self._waiting.popleft()
        done(answer)


class TakeKeeper:
    """Names, starts and stops the requested take, and restarts it after a server restart.

    Idle: none is wanted or started. Naming: one is wanted. Starting: it is started, so it may run.
    Recording: an answer or a frame has confirmed that. Stopping: a started take is not wanted any
    more. A restart of the server leads from recording back to naming, unless a frame confirms it.

    `request` is thread-safe; the other methods are for one thread. The constructor takes the
    function that queues commands, `CommandQueue.submit`.

    Attributes:
        fault: Why the server does not record as requested, in one line; empty if it does.
    """

    def __init__(self, submit: Callable[[str, Done], None]) -> None:
        self._submit = submit
        self._wanted: str | None = None
        self._started: str | None = None  # the take that may be running
        self._confirmed = False
        self._busy = False
        self._next = 0.0  # [s]; next command
        self._moment = 0.0  # [s]; earlier frames may be from a previous take
        self._idle_since: float | None = None
        self._session = 0
        self.fault = ""

    @property
    def settled(self) -> bool:
        """Whether the server is in the requested state."""
        wanted = self._wanted
        return not self._busy and self._started == wanted and (wanted is None or self._confirmed)

    def request(self, name: str | None) -> None:
        """Request a take of this name, or none.

        A name that Motive cannot take raises a `ConfigurationError`, and none is requested.
        """
        if name != self._wanted:  # else another thread would see none for a moment
            self._wanted = None
            self._wanted = None if name is None else check_take_name(name)

    def restarted(self, now: float) -> None:
        """Note a new session at a time of the steady clock [s].

        The server may have forgotten the take.
        """
        self._session += 1
        self._confirmed = False
        self._moment = now
        self._next = now + (0.0 if self._started is None else _EVIDENCE_WAIT)
        self._idle_since = None

    def observe(self, recording: bool, now: float) -> None:
        """Note whether a frame shows that the server records.

        Args:
            recording: The frame's flag.
            now: When the frame arrived, on the steady clock [s].
        """
        if recording:
            self._idle_since = None
            if self._started is not None and now > self._moment:
                self._confirmed = True
        elif self._idle_since is None:
            self._idle_since = now

    def step(self, now: float, connected: bool) -> None:
        """Submit the command that is due, if any.

        Args:
            now: The present time of the steady clock [s].
            connected: Whether the server is connected and its stream's version known.
        """
        if self.settled:
            idle = self._idle_since is not None and now - self._idle_since > _IDLE_TIMEOUT
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
                fault = ""  # an idle server may refuse to stop
            self._note(fault)
            if fault:
                self._next = now + _RETRY_INTERVAL
            elif session != self._session:
                return
            elif command == "StopRecording":
                self._started, self._confirmed = None, False
            elif command == "StartRecording":
                self._confirmed, self._idle_since = True, None
            elif wanted == self._wanted:
                self._started, self._moment = wanted, now + _FRAME_DELAY
                self._issue("StartRecording", now)

        self._busy = True
        self._submit(command, done)

    def _note(self, reason: str) -> None:
        wanted = self._wanted
        doing = "no take is stopped" if wanted is None else f"take '{wanted}' is not recorded"
        unwanted = wanted is None and self._started is None
        self.fault = f"{doing}: {reason}" if reason and not unwanted else ""
