"""A client of a NatNet server that neither the network nor the server can end.

It connects, loses the server and connects again, and decides which frames are used.
"""

from __future__ import annotations

import math
import re
import threading
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from typing import TypeAlias

from socket_testbed import clocks
from socket_testbed.clocks import Backoff
from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.clock import EchoClock
from socket_testbed.drivers.natnet.connection import (
    Answer,
    CommandQueue,
    NatNetSockets,
    TakeKeeper,
    bitstream_version,
    server_address,
)
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import MocapSettings

OK, WARN, ERROR = 0, 1, 2

_RECEIVE = 0.01  # [s]; longest wait for a datagram
_FAREWELL = 0.3  # [s]; time to stop a take on closing
_SILENCE = 0.3  # [s]; after which the server, or its stream, is lost
_KEEPALIVE = 1.0  # [s]
_QUICK_ECHOES = 10
_ECHO_QUICK, _ECHO_QUIET, _ECHO = 0.01, 0.1, 0.5  # [s]; at first, without frames, then
_ECHO_UNSURE = 0.13  # [s]; while the clock is known badly; in no step with beacons of 0.1 s
_PENDING = 64  # echoes
_MODELS_RETRY, _MODELS_AGAIN = 0.1, 1.0  # [s]
_SUBSCRIPTIONS = ("SubscribeToData,RigidBody,All", "SubscribeToData,LabeledMarkers,All")

_RECENT = 0.8  # [s]; a fault that ended is no longer reported within a second
_SPAN = 1.0  # [s]; over which the rate is measured
_MOST = 2000  # events
_EARLIEST, _LATEST = 1.0, 0.005  # [s]; before and after its arrival that a frame can be from
_LATEST_BY = 100  # frames; numbers further back are those of another stream
_MOST_LOST = 1000  # frames

_FRAMES = "frames"
_BAD, _LOST, _LATE = "bad_datagrams", "lost_frames", "duplicate_or_late_frames"
_IMPLAUSIBLE, _FAILED = "frames_of_implausible_time", "frames_that_could_not_be_used"
_FAULTS = (_BAD, _LOST, _LATE, _IMPLAUSIBLE, _FAILED)

OnFrame: TypeAlias = Callable[[messages.MocapFrame, float, messages.BodiesByName | None], None]


class LinkStatistics:
    """Counts frames and faults; any thread may ask, one counts."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._totals = dict.fromkeys((_FRAMES, *_FAULTS), 0)
        self._events: deque[tuple[float, str, int]] = deque(maxlen=_MOST)  # time [s], kind, number
        self._last_frame = -math.inf  # [s]
        self._last_error = ""

    def count(self, kind: str, now: float, number: int = 1, error: str = "") -> None:
        """Count frames that were delivered, or a fault."""
        with self._lock:
            self._totals[kind] += number
            self._events.append((now, kind, number))
            self._last_error = error or self._last_error
            # One frame alone is no stream.
            if kind == _FRAMES and self._totals[_FRAMES] > 1:
                self._last_frame = now

    def quiet(self, now: float) -> float:
        """Time since the last frame that was delivered [s]."""
        return now - self._last_frame

    def rate(self, now: float) -> float:
        """Frames delivered per second, over the last one [Hz]."""
        with self._lock:
            times = [at for at, kind, _ in self._events if kind == _FRAMES and at > now - _SPAN]
        return (len(times) - 1) / max(times[-1] - times[0], 1e-6) if len(times) > 1 else 0.0

    def warning(self, now: float) -> str:
        """The faults of the last second in one line; empty for none."""
        counts: Counter[str] = Counter()
        with self._lock:
            for at, kind, number in self._events:
                counts[kind] += number if at > now - _RECENT else 0
        found = [f"{counts[kind]} {kind.replace('_', ' ')}" for kind in _FAULTS if counts[kind]]
        last = f" (the last: {self._last_error})" if counts[_BAD] or counts[_FAILED] else ""
        return ", ".join(found) + last

    def totals(self) -> dict[str, int]:
        """All counts since the begin, by name."""
        with self._lock:
            return dict(self._totals)


class NatNetClient:
    """Receives the frames of a server, on a thread of its own.

    There `on_frame` is called with each, the middle of its exposure on the steady clock [s], and
    the server's rigid bodies (None: not known yet).
    """

    def __init__(self, settings: MocapSettings, on_frame: OnFrame) -> None:
        self._settings = settings
        self._on_frame = on_frame
        self._address = server_address(settings)
        self._where = f"{self._address[0]}:{self._address[1]}"
        self._bitstream = bitstream_version(settings)
        self._sockets = NatNetSockets(settings, self._address)
        self._commands = CommandQueue()
        self._takes = TakeKeeper(self._commands.submit)
        self._statistics = LinkStatistics()
        self._sessions = 0  # how often one has begun
        self._stranger = ""  # the host, not the server, that a datagram came from last
        self._network = ""  # why the network takes nothing; empty: it does
        self._connecting = Backoff()
        self._awaiting = False  # an answer to that
        self._models_wanted = False
        self._number: int | None = None  # of the last frame
        self._last_frame = self._heard = 0.0  # [s]
        self._next_echo = self._next_keepalive = self._next_models = 0.0  # [s]
        self._forget()
        self._handlers: dict[int, Callable[[bytes, float], None]] = {
            messages.SERVERINFO: self._take_server_info,
            messages.FRAME: self._take_frame,
            messages.MODELDEF: self._take_models,
            messages.ECHORESPONSE: self._take_echo,
            messages.DISCONNECT: lambda payload, now: self._restart(),
            messages.RESPONSE: lambda payload, now: self._commands.answer(Answer(payload), now),
            messages.UNRECOGNIZED: lambda payload, now: self._commands.answer(
                Answer(payload, recognized=False), now
            ),
        }
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="natnet", daemon=True)

    def _forget(self) -> None:
        """Know nothing of a server."""
        self._server: messages.ServerInfo | None = None  # its description; None: not connected
        self._models: messages.BodiesByName | None = None  # its rigid bodies; None: not known yet
        self._version: messages.Version | None = None  # of its frames; None: not settled
        self._echoes = EchoClock(0)  # the map of its clock
        self._clock_error = 0.0  # largest error of the last frame's time [s]
        self._pending: deque[int] = deque(maxlen=_PENDING)  # echoes by when they were sent [ns]

    def start(self) -> None:
        """Begin; a server or a network that is not there yet is waited for."""
        with suppress(OSError):  # a port that another program has is no OSError
            self._sockets.open()
        self._thread.start()

    def close(self) -> None:
        """Stop a take that is on, leave the server and end the thread."""
        self.set_recording(None)
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._sockets.close()

    def set_recording(self, name: str | None) -> None:
        """Have the server record a take of this name, or none; this is pursued from now on."""
        self._takes.want(name)

    @property
    def recording_fault(self) -> str:
        """Why the server does not record as wanted; empty for nothing."""
        return self._takes.fault

    @property
    def clock_fault(self) -> str:
        """Why frames have no time that is known well enough; empty: they have."""
        known, limit = self._clock_error, self._settings.clock_uncertainty
        if known <= limit:
            return ""
        return (
            f"Motive's clock is known within {1e3 * known:.3g} ms only (clock_uncertainty is"
            f" {1e3 * limit:g} ms), so poses are missing: switch the Wi-Fi's power saving off"
            " (iw dev wlan0 set power_save off), or use a free channel or a cable"
        )

    @property
    def server(self) -> str:
        """The server's description of itself; empty: none is connected."""
        return str(self._server or "")

    def figures(self) -> dict[str, float]:
        """Counts since the begin, and the state of the clock and the rate, by name."""
        return {
            **self._statistics.totals(),
            "sessions": self._sessions,
            "rate": round(self._statistics.rate(clocks.monotonic()), 1),
            "clock_uncertainty": round(self._echoes.uncertainty, 6),
        }

    def health(self, now: float) -> tuple[int, str]:
        """State of the link at a time of the steady clock [s]: 0, 1 or 2, and a line of text."""
        server = self._server
        if server is None:
            return ERROR, self._why_no_server()
        missing, warning = self._why_no_frames(server, now), self._statistics.warning(now)
        if not missing and (fault := self.clock_fault):
            return WARN, fault
        if self._statistics.quiet(now) > _SILENCE:
            reason = warning or "its clock is not known yet"
            return ERROR, missing or f"no frame from {self._where} can be used: {reason}"
        if warning:
            return WARN, f"{warning}: check the Wi-Fi"
        if self._models is None:
            return WARN, f"{server} has not sent its rigid bodies yet"
        known = f"{1e3 * self._echoes.uncertainty:.3g} ms"
        return OK, f"frames of {server} come, its clock is known within {known}"

    def _why_no_server(self) -> str:
        if self._network:
            return f"no network to {self._where} ({self._network}): check the Wi-Fi"
        stranger = f", but from {self._stranger}" if self._stranger else ""
        return f"no answer from {self._where}{stranger}: {self._check_streaming()}"

    def _why_no_frames(self, server: messages.ServerInfo, now: float) -> str:
        """Why a server that answers gives no frames; empty: frames come, but none can be used."""
        if not server.clock:
            return f"{server} is too old, NatNet 3.0 is needed: update Motive to 2.0 or later"
        if now - self._last_frame <= _SILENCE or self._statistics.warning(now):
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
                deadline = min(deadline, now + _FAREWELL)
                if self._takes.settled or now > deadline:
                    break
            self._receive(now)
        self._send(messages.encode_message(messages.DISCONNECT))

    def _receive(self, now: float) -> None:
        """Take the datagrams that have come, and send the messages that are due."""
        try:
            for datagram, sender in self._sockets.receive(_RECEIVE):
                arrival = clocks.monotonic()
                if sender != self._address[0]:
                    self._stranger = sender
                    continue
                try:
                    self._take(datagram, arrival)
                except messages.MalformedDatagram as error:
                    self._statistics.count(_BAD, arrival, error=error.fact)
            # After the datagrams: a thread that was held up has not lost the server.
            self._step(clocks.monotonic())
        except Exception as error:  # whatever it was, the next datagram is another one
            self._statistics.count(_FAILED, now, error=f"{type(error).__name__}: {error}")

    def _step(self, now: float) -> None:
        """Send all that is due at a time of the steady clock [s]."""
        if self._server is not None and now - self._heard > _SILENCE:
            self._lose()
        silent = now - self._last_frame > _SILENCE
        # A server that answers but streams nothing may have forgotten this client.
        if (self._server is None or silent) and self._connecting.due(now):
            self._connect(now)
        if self._server is not None:
            self._stay(now)
        self._commands.step(now, self._send)
        self._takes.step(now, self._version is not None)

    def _send(self, datagram: bytes) -> None:
        """Send a datagram; a network that does not take it is a lost server."""
        try:
            self._sockets.send(datagram)
            self._network = ""
        except OSError as error:
            self._network = error.strerror or str(error)
            self._lose()
            self._sockets.close()

    def _lose(self) -> None:
        self._forget()
        if self._settings.multicast:  # the membership may have gone with the network
            self._sockets.close()

    def _restart(self) -> None:
        """The server is another one, or leaves."""
        self._forget()
        self._connecting.succeeded()

    def _connect(self, now: float) -> None:
        self._connecting.failed(now)  # until it is answered
        self._awaiting = True
        try:
            self._sockets.open()
        except (OSError, DeviceError) as error:
            self._network = str(error)
            return
        self._send(messages.encode_connect("socket_testbed", self._bitstream))

    def _stay(self, now: float) -> None:
        """Keep the session alive and its knowledge fresh."""
        if now >= self._next_keepalive:
            self._next_keepalive = now + _KEEPALIVE
            self._send(messages.encode_message(messages.KEEPALIVE))
        if now >= self._next_echo:
            quick = len(self._echoes) < _QUICK_ECHOES
            quiet = now - self._last_frame > 0.5 * _SILENCE
            unsure = self._clock_error > 0.5 * self._settings.clock_uncertainty
            pause = _ECHO_QUIET if quiet else _ECHO_UNSURE if unsure else _ECHO
            self._next_echo = now + (_ECHO_QUICK if quick else pause)
            stamp = round(now * 1e9)
            self._pending.append(stamp)
            self._send(messages.encode_echo(stamp))
        if self._models_wanted and self._version is not None and now >= self._next_models:
            self._next_models = now + _MODELS_RETRY
            self._send(messages.encode_message(messages.REQUEST_MODELDEF))

    def _take(self, datagram: bytes, now: float) -> None:
        """Take a datagram of the server."""
        self._heard = now
        message, payload = messages.split_datagram(datagram)
        if (handler := self._handlers.get(message)) is not None:
            handler(payload, now)

    def _take_server_info(self, payload: bytes, now: float) -> None:
        info = messages.parse_server_info(payload)
        if not self._awaiting:
            if self._server not in (None, info):
                self._restart()
            return
        self._awaiting = False
        if info != self._server:
            self._begin(info, now)
        self._negotiate(info)

    def _begin(self, info: messages.ServerInfo, now: float) -> None:
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
        """Settle the version of the stream, and subscribe to the needed sections: Wi-Fi is slow."""
        if self._settings.multicast or info.version < (4, 1):
            self._version = info.version if info.version >= messages.OLDEST else None
            return
        wanted = min(self._bitstream, info.version)
        self._version = None

        def settle(answer: Answer) -> None:
            named = re.search(r"(\d+)\.(\d+)", answer.text)
            granted = (int(named[1]), int(named[2])) if named else wanted
            self._version = info.version if answer.fault("Bitstream") else granted
            for text in _SUBSCRIPTIONS:
                self._command(text)

        self._command(f"Bitstream,{wanted[0]}.{wanted[1]}", settle)

    def _command(self, text: str, then: Callable[[Answer], None] = lambda answer: None) -> None:
        """Have a command answered in this session, however often it takes."""
        session = self._sessions

        def done(answer: Answer) -> None:
            if session != self._sessions or self._server is None:
                return
            if answer.raw is None:
                self._command(text, then)
            else:
                then(answer)

        self._commands.submit(text, done)

    def _take_models(self, payload: bytes, now: float) -> None:
        if self._version is not None:
            self._models = messages.parse_model_definitions(payload, self._version)
            self._models_wanted = False
            self._next_models = now + _MODELS_AGAIN

    def _take_echo(self, payload: bytes, now: float) -> None:
        stamp, ticks = messages.parse_echo(payload)
        if stamp in self._pending:
            self._pending.remove(stamp)
            if not self._echoes.add(stamp * 1e-9, ticks, now):
                self._restart()

    def _take_frame(self, payload: bytes, now: float) -> None:
        if self._version is None:
            return
        frame = messages.parse_frame(payload, self._version)
        self._last_frame = now
        self._connecting.succeeded()
        if not self._is_next(frame.number, now):
            return
        self._takes.observe(frame.recording, now)
        known = {body.id for body in (self._models or {}).values()}
        if frame.models_changed or not known.issuperset(frame.bodies):
            self._models_wanted = True  # at most once a second
        if (exposed := self._echoes.to_steady(frame.mid_exposure)) is None:
            return
        moment, error = exposed
        if not now - _EARLIEST - error <= moment <= now + _LATEST + error:
            self._statistics.count(_IMPLAUSIBLE, now)  # another clock: the next echo tells
            return
        self._clock_error = error
        if error <= self._settings.clock_uncertainty:
            self._on_frame(frame, moment, self._models)
            self._statistics.count(_FRAMES, now)

    def _is_next(self, number: int, now: float) -> bool:
        """Whether a frame is newer than all before it."""
        step = 1 if self._number is None else number - self._number
        if -_LATEST_BY < step <= 0:
            self._statistics.count(_LATE, now)
            return False
        if step > 1:
            self._statistics.count(_LOST, now, min(step - 1, _MOST_LOST))
        self._number = number
        return True
