"""A NatNet client that survives failures of the network and the server.

It connects, reconnects after losing the server, and decides which frames to use.
"""

from __future__ import annotations

import math
import re
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import takewhile
from typing import TypeAlias

from socket_testbed import clocks
from socket_testbed.clocks import Backoff
from socket_testbed.drivers import ERROR, OK, RECENT, WARN
from socket_testbed.drivers.natnet import connection, messages
from socket_testbed.drivers.natnet.bodies import BodyWatch
from socket_testbed.drivers.natnet.clock import EchoClock
from socket_testbed.errors import DeviceError, joined
from socket_testbed.settings.acquisition import MocapSettings

_RECEIVE_TIMEOUT = 0.01  # [s]
_CLOSE_TIMEOUT = 0.3  # [s]; to stop a take
_SILENCE_TIMEOUT = 0.3  # [s]; then the server, or its stream, is lost
_KEEPALIVE_INTERVAL = 1.0  # [s]
_FAST_ECHOES = 10
_ECHO_FAST, _ECHO_NO_FRAMES, _ECHO_INTERVAL = 0.01, 0.1, 0.5  # [s]
_ECHO_UNCERTAIN = 0.13  # [s]; with an uncertain clock; not in step with Wi-Fi beacons (0.1 s)
_MAX_PENDING = 64  # echoes
_MODELS_RETRY, _MODELS_INTERVAL = 0.1, 1.0  # [s]
_MAX_MISREAD = 3  # frames in a row that only another layout explains
# One version of each layout of frames; 4.6 stands for all that are not known.
_LAYOUTS: tuple[messages.Version, ...] = (messages.NEWEST, (4, 1), (3, 1), (4, 6))
_SUBSCRIPTIONS = ("SubscribeToData,RigidBody,All", "SubscribeToData,LabeledMarkers,All")

_SPAN = 1.0  # [s]; for the frame rate
_HISTORY = 2000  # events
_MAX_AGE, _MAX_AHEAD = 1.0, 0.005  # [s]; of a frame's time relative to its arrival
_MAX_LATE_FRAMES = 100  # older numbers belong to another stream
_MAX_LOST = 1000  # frames

_FRAMES = "frames"
_BAD, _LOST, _LATE = "bad_datagrams", "lost_frames", "duplicate_or_late_frames"
_IMPLAUSIBLE, _FAILED = "frames_of_implausible_time", "frames_that_could_not_be_used"
_FAULTS = (_BAD, _LOST, _LATE, _IMPLAUSIBLE, _FAILED)

OnFrame: TypeAlias = Callable[[messages.MocapFrame, float, messages.BodiesByName | None], None]


class LinkStatistics:
    """Counts frames and faults; one thread counts, any thread may read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._totals = dict.fromkeys((_FRAMES, *_FAULTS), 0)
        self._events: deque[tuple[float, str, int]] = deque(maxlen=_HISTORY)  # time [s], kind, size
        self._last_frame = -math.inf  # [s]
        self._last_error = ""

    def count(self, kind: str, now: float, number: int = 1, error: str = "") -> None:
        """Count delivered frames or a fault.

        Args:
            kind: What to count, a key of `totals`, such as "frames" or "lost_frames".
            now: When it happened, on the steady clock [s].
            number: How many to count.
            error: Fact of the error behind it, for `warning`; empty for none.
        """
        with self._lock:
            self._totals[kind] += number
            self._events.append((now, kind, number))
            self._last_error = error or self._last_error
            # A single frame is not a stream.
            if kind == _FRAMES and self._totals[_FRAMES] > 1:
                self._last_frame = now

    def silence(self, now: float) -> float:
        """Time since the last delivered frame at a time of the steady clock [s].

        It is infinite until two frames were delivered.
        """
        return now - self._last_frame

    def rate(self, now: float) -> float:
        """Rate of delivered frames in the second before a time of the steady clock [s], in Hz."""
        with self._lock:
            times = [at for at, kind, _ in self._since(now - _SPAN) if kind == _FRAMES]
        return (len(times) - 1) / max(times[0] - times[-1], 1e-6) if len(times) > 1 else 0.0

    def _since(self, start: float) -> Iterator[tuple[float, str, int]]:
        """The events after a time [s], the newest first; needs the lock."""
        return takewhile(lambda event: event[0] > start, reversed(self._events))

    def warning(self, now: float) -> str:
        """Faults in the 0.8 s before a time of the steady clock [s], in one line.

        It is empty without any.
        """
        counts: Counter[str] = Counter()
        with self._lock:
            for _, kind, number in self._since(now - RECENT):
                counts[kind] += number
        found = [f"{counts[kind]} {kind.replace('_', ' ')}" for kind in _FAULTS if counts[kind]]
        last = f" (the last: {self._last_error})" if counts[_BAD] or counts[_FAILED] else ""
        return ", ".join(found) + last

    def totals(self) -> dict[str, int]:
        """Numbers of delivered frames and of each fault since the start, by name."""
        with self._lock:
            return dict(self._totals)


class NatNetClient:
    """Receives the frames of a server on its own thread.

    The constructor raises a `ConfigurationError` for wrong settings.

    Args:
        settings: Address of the server, its ports, and the stream to ask for.
        on_frame: Called on that thread with each frame, its mid-exposure on the steady clock [s],
            and the server's rigid bodies by name (None: not known yet).
    """

    def __init__(self, settings: MocapSettings, on_frame: OnFrame) -> None:
        self._settings = settings
        self._on_frame = on_frame
        self._address = connection.server_address(settings)
        self._where = f"{self._address[0]}:{self._address[1]}"
        self._bitstream = connection.bitstream_version(settings)
        self._sockets = connection.NatNetSockets(settings, self._address)
        self._commands = connection.CommandQueue()
        self._takes = connection.TakeKeeper(self._commands.submit)
        self._statistics = LinkStatistics()
        self._sessions = 0  # number of sessions started
        self._stranger = ""  # last host, other than the server, that sent a datagram
        self._network = ""  # why nothing can be sent; empty for no fault
        self._connecting = Backoff()
        self._awaiting = False  # whether a CONNECT is unanswered
        self._models_wanted = False
        self._number: int | None = None  # of the last frame
        self._last_frame = self._received = 0.0  # [s]
        self._next_echo = self._next_keepalive = self._next_models = 0.0  # [s]
        self._forget()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="natnet", daemon=True)

    def _forget(self) -> None:
        """Forget all about the server."""
        self._server: messages.ServerInfo | None = None  # None: not connected
        self._models: messages.BodiesByName | None = None  # None: not known yet
        self._version: messages.Version | None = None  # of its frames; None: not negotiated
        self._misread = 0  # frames in a row that only another layout explains
        self._other_layout = False  # whether its frames have another layout than it says
        self._bodies = BodyWatch()
        self._echoes = EchoClock(0)  # maps its clock
        self._clock_error = 0.0  # error bound of the last frame's time [s]
        self._pending: deque[int] = deque(maxlen=_MAX_PENDING)  # echoes by sending time [ns]

    def start(self) -> None:
        """Start the thread; it keeps trying until network and server are there."""
        with suppress(OSError):  # a port in use by another program is a DeviceError
            self._sockets.open()
        self._thread.start()

    def close(self) -> None:
        """Stop a running take, disconnect from the server and end the thread."""
        self.set_recording(None)
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._sockets.close()

    def set_recording(self, name: str | None) -> None:
        """Request a take of this name, or none (None); retried until the server complies.

        A name that Motive cannot take raises a `ConfigurationError`.
        """
        self._takes.request(name)

    @property
    def recording_fault(self) -> str:
        """Why the server does not record as requested; empty if it does."""
        return self._takes.fault

    @property
    def clock_fault(self) -> str:
        """Why the times of frames are too uncertain; empty if they are not."""
        error, limit = self._clock_error, self._settings.clock_uncertainty
        if error <= limit:
            return ""
        return (
            f"Motive's clock is known within {1e3 * error:.3g} ms only (clock_uncertainty is"
            f" {1e3 * limit:g} ms), so poses are missing: switch the Wi-Fi's power saving off"
            " (iw dev wlan0 set power_save off), or use a free channel or a cable"
        )

    @property
    def server(self) -> str:
        """The server's description of itself; empty if not connected."""
        return str(self._server or "")

    def figures(self) -> dict[str, float]:
        """Figures by name: counts since the start, and the state of the stream.

        The `rate` of delivered frames is in Hz; `clock_uncertainty` bounds the error of the
        server's clock [s].
        """
        return {
            **self._statistics.totals(),
            "sessions": self._sessions,
            "rate": round(self._statistics.rate(clocks.monotonic()), 1),
            "clock_uncertainty": round(self._echoes.uncertainty, 6),
        }

    def health(self, now: float) -> tuple[int, str]:
        """State of the link at a time of the steady clock [s]: OK, WARN or ERROR, and a text."""
        server = self._server
        if server is None:
            return ERROR, self._why_no_server()
        missing, warning = self._why_no_frames(server, now), self._statistics.warning(now)
        if not missing and (fault := self.clock_fault):
            return WARN, fault
        if self._statistics.silence(now) > _SILENCE_TIMEOUT:
            reason = warning or "its clock is not known yet"
            hint = _newer(server.version) if warning else ""
            return ERROR, missing or f"no frame from {self._where} can be used: {reason}{hint}"
        if wrong := self._doubts(now):
            return WARN, wrong
        known = f"{1e3 * self._echoes.uncertainty:.3g} ms"
        layout = f" in the layout of NatNet {_text(self._version)}" if self._other_layout else ""
        return OK, f"frames of {server} arrive{layout}, its clock is known within {known}"

    def _doubts(self, now: float) -> str:
        """What is wrong though frames arrive; empty if nothing is."""
        warning = self._statistics.warning(now)
        doubts = [f"{warning}: check the Wi-Fi"] if warning else []
        if self._models is None:
            doubts.append(f"{self.server} has not sent its rigid bodies yet")
        elif wrong := self._bodies.warning(now):
            doubts.append(wrong)
        return joined(doubts)

    def _why_no_server(self) -> str:
        if self._network:
            return f"no network to {self._where} ({self._network}): check the Wi-Fi"
        stranger = f", but from {self._stranger}" if self._stranger else ""
        return f"no answer from {self._where}{stranger}: {self._check_streaming()}"

    def _why_no_frames(self, server: messages.ServerInfo, now: float) -> str:
        """Why a server that answers sends no frames; empty if frames arrive but are unusable."""
        if not server.clock:
            return f"{server} is too old, NatNet 3.0 is needed: update Motive to 2.0 or later"
        if now - self._last_frame <= _SILENCE_TIMEOUT or self._statistics.warning(now):
            return ""
        if server.multicast and not self._settings.multicast:
            return (
                f"{server} at {self._where} streams to the group {server.group}: choose unicast in"
                f" Motive, or set multicast to {server.group}"
            )
        return f"{server} at {self._where} answers but streams no frames: {self._check_streaming()}"

    def _check_streaming(self) -> str:
        transport = "multicast" if self._settings.multicast else "unicast"
        return (
            f"check that Motive streams (Data Streaming, {transport}, Local Interface), and the"
            " Wi-Fi"
        )

    def _run(self) -> None:
        deadline = math.inf
        while True:
            now = clocks.monotonic()
            if self._closing.is_set():
                deadline = min(deadline, now + _CLOSE_TIMEOUT)
                if self._takes.settled or now > deadline:
                    break
            self._receive(now)
        self._send(messages.encode_message(messages.DISCONNECT))

    def _receive(self, now: float) -> None:
        """Handle received datagrams and send the messages that are due."""
        try:
            for datagram, sender in self._sockets.receive(_RECEIVE_TIMEOUT):
                arrival = clocks.monotonic()
                if sender != self._address[0]:
                    self._stranger = sender
                    continue
                try:
                    self._handle(datagram, arrival)
                except messages.MalformedDatagram as error:
                    self._statistics.count(_BAD, arrival, error=error.fact)
            # After the datagrams, so that a delayed thread does not lose the server.
            self._step(clocks.monotonic())
        except Exception as error:  # continue with the next datagram
            self._statistics.count(_FAILED, now, error=f"{type(error).__name__}: {error}")

    def _step(self, now: float) -> None:
        """Send all messages due at a time of the steady clock [s]."""
        if self._server is not None and now - self._received > _SILENCE_TIMEOUT:
            self._lose()
        silent = now - self._last_frame > _SILENCE_TIMEOUT
        # A server that answers without streaming may have forgotten this client.
        if (self._server is None or silent) and self._connecting.due(now):
            self._connect(now)
        if self._server is not None:
            self._maintain(now)
        self._commands.step(now, self._send)
        self._takes.step(now, self._version is not None)

    def _send(self, datagram: bytes) -> None:
        """Send a datagram; a failure counts as losing the server."""
        try:
            self._sockets.send(datagram)
            self._network = ""
        except OSError as error:
            self._network = error.strerror or str(error)
            self._lose()
            self._sockets.close()

    def _lose(self) -> None:
        self._forget()
        if self._settings.multicast:  # the membership may be lost as well
            self._sockets.close()

    def _restart(self) -> None:
        """Reconnect at once: the server has changed or disconnected."""
        self._forget()
        self._connecting.succeeded()

    def _connect(self, now: float) -> None:
        self._connecting.failed(now)  # until answered
        self._awaiting = True
        try:
            self._sockets.open()
        except (OSError, DeviceError) as error:
            self._network = str(error)
            return
        self._send(messages.encode_connect("socket_testbed", self._bitstream))

    def _maintain(self, now: float) -> None:
        """Keep the session alive, and its clock and rigid bodies up to date."""
        if now >= self._next_keepalive:
            self._next_keepalive = now + _KEEPALIVE_INTERVAL
            self._send(messages.encode_message(messages.KEEPALIVE))
        if now >= self._next_echo:
            fast = len(self._echoes) < _FAST_ECHOES
            no_frames = now - self._last_frame > 0.5 * _SILENCE_TIMEOUT
            uncertain = self._clock_error > 0.5 * self._settings.clock_uncertainty
            slow = _ECHO_UNCERTAIN if uncertain else _ECHO_INTERVAL
            self._next_echo = now + (_ECHO_FAST if fast else _ECHO_NO_FRAMES if no_frames else slow)
            stamp = round(now * 1e9)
            self._pending.append(stamp)
            self._send(messages.encode_echo(stamp))
        if self._models_wanted and self._version is not None and now >= self._next_models:
            self._next_models = now + _MODELS_RETRY
            self._send(messages.encode_message(messages.REQUEST_MODELDEF))

    def _handle(self, datagram: bytes, now: float) -> None:
        """Handle a datagram of the server."""
        self._received = now
        message, payload = messages.split_datagram(datagram)
        match message:
            case messages.SERVERINFO:
                self._handle_server_info(payload, now)
            case messages.FRAME:
                self._handle_frame(payload, now)
            case messages.MODELDEF:
                self._handle_models(payload, now)
            case messages.ECHORESPONSE:
                self._handle_echo(payload, now)
            case messages.DISCONNECT:
                self._restart()
            case messages.RESPONSE | messages.UNRECOGNIZED:
                known = message == messages.RESPONSE
                self._commands.answer(connection.Answer(payload, known), now)

    def _handle_server_info(self, payload: bytes, now: float) -> None:
        info = messages.parse_server_info(payload)
        if not self._awaiting:
            if self._server not in (None, info):
                self._restart()
            return
        self._awaiting = False
        if info != self._server:
            self._begin_session(info, now)
        self._negotiate(info)

    def _begin_session(self, info: messages.ServerInfo, now: float) -> None:
        self._forget()
        self._server = info
        self._sessions += 1
        self._echoes = EchoClock(info.clock)
        self._number = None
        self._next_echo = self._next_keepalive = self._next_models = 0.0
        self._models_wanted = True
        self._last_frame = now
        self._connecting.succeeded()
        self._takes.restarted(now)

    def _negotiate(self, info: messages.ServerInfo) -> None:
        """Negotiate the stream's version; subscribe only to needed sections to save bandwidth."""
        if self._settings.multicast or info.version < (4, 1):
            self._version = info.version if info.version >= messages.OLDEST else None
            return
        wanted = min(self._bitstream, info.version)
        self._version = None

        def settle(answer: connection.Answer) -> None:
            named = re.search(r"(\d+)\.(\d+)", answer.text)
            granted = (int(named[1]), int(named[2])) if named else wanted
            self._version = info.version if answer.fault("Bitstream") else granted
            for text in _SUBSCRIPTIONS:
                self._command(text)

        def unanswered() -> None:
            self._version = self._version or info.version

        self._command(f"Bitstream,{_text(wanted)}", settle, unanswered)

    def _command(
        self,
        text: str,
        then: Callable[[connection.Answer], None] = lambda answer: None,
        unanswered: Callable[[], None] = lambda: None,
    ) -> None:
        """Send a command until it is answered, within this session.

        Args:
            text: The command.
            then: Called once with the answer.
            unanswered: Called each time that ten attempts had no answer.
        """
        session = self._sessions

        def done(answer: connection.Answer) -> None:
            if session != self._sessions or self._server is None:
                return
            if answer.raw is None:
                unanswered()
                self._command(text, then, unanswered)
            else:
                then(answer)

        self._commands.submit(text, done)

    def _handle_models(self, payload: bytes, now: float) -> None:
        if self._version is not None:
            models = self._parse_models(payload, self._version)
            self._bodies.renewed(self._models, models, now)
            self._models = models
            self._models_wanted = False
            self._next_models = now + _MODELS_INTERVAL

    def _parse_models(self, payload: bytes, version: messages.Version) -> messages.BodiesByName:
        """The rigid bodies; frames without sizes do not tell whether markers have names here."""
        try:
            return messages.parse_model_definitions(payload, version)
        except messages.MalformedDatagram:
            if version >= messages.SIZED:
                raise
            return messages.parse_model_definitions(
                payload, (3, 1) if version >= (4, 0) else (4, 0)
            )

    def _handle_echo(self, payload: bytes, now: float) -> None:
        stamp, ticks = messages.parse_echo(payload)
        if stamp in self._pending:
            self._pending.remove(stamp)
            if not self._echoes.add(stamp * 1e-9, ticks, now):
                self._restart()

    def _handle_frame(self, payload: bytes, now: float) -> None:
        if self._version is None:
            return
        frame = self._parse_frame(payload, self._version)
        self._last_frame = now
        self._connecting.succeeded()
        if not self._is_next(frame.number, now):
            return
        self._takes.observe(frame.recording, now)
        known = {body.id for body in (self._models or {}).values()}
        if self._models is not None:
            self._bodies.observe(frame, self._models, now)
        changed = frame.models_changed or not known.issuperset(frame.bodies)
        if changed or self._bodies.stale(now):
            self._models_wanted = True  # at most once a second
        if (exposed := self._echoes.to_steady(frame.mid_exposure)) is None:
            return
        moment, error = exposed
        if not now - _MAX_AGE - error <= moment <= now + _MAX_AHEAD + error:
            self._statistics.count(_IMPLAUSIBLE, now)  # another clock, as the next echo will show
            return
        self._clock_error = error
        if error <= self._settings.clock_uncertainty:
            self._on_frame(frame, moment, self._models)
            self._statistics.count(_FRAMES, now)

    def _parse_frame(self, payload: bytes, version: messages.Version) -> messages.MocapFrame:
        """A frame, in the layout of its version or, if that fits no frame, in the one that does.

        Some servers, and some settings of Motive, stream another layout than they announce.
        """
        try:
            frame = messages.parse_frame(payload, version)
        except messages.MalformedDatagram:
            read = _first_that_fits(payload)
            self._misread = self._misread + 1 if read else 0
            if read is None or self._misread < _MAX_MISREAD:  # a damaged frame may fit by chance
                raise
            self._version, frame = read
            self._other_layout = True
            self._models, self._models_wanted = None, True
        self._misread = 0
        return frame

    def _is_next(self, number: int, now: float) -> bool:
        """Whether a frame is newer than all before it."""
        step = 1 if self._number is None else number - self._number
        if -_MAX_LATE_FRAMES < step <= 0:
            self._statistics.count(_LATE, now)
            return False
        if step > 1:
            self._statistics.count(_LOST, now, min(step - 1, _MAX_LOST))
        self._number = number
        return True


def _first_that_fits(payload: bytes) -> tuple[messages.Version, messages.MocapFrame] | None:
    """A frame in the first layout that fits it, and a version of that layout; None if none does."""
    for version in _LAYOUTS:
        with suppress(messages.MalformedDatagram):
            return version, messages.parse_frame(payload, version)
    return None


def _text(version: messages.Version | None) -> str:
    return ".".join(str(part) for part in version or ())


def _newer(version: messages.Version) -> str:
    """A hint, for a server newer than the layouts that are known; empty if it is not."""
    if version <= messages.NEWEST:
        return ""
    return (
        f"; NatNet {_text(version)} is newer than {_text(messages.NEWEST)}, the last that is known:"
        " let Motive stream unicast, which offers older layouts (setting bitstream)"
    )
