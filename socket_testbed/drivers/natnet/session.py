"""The session with a NatNet server: connected, lost, connected again; which frames are used."""

from __future__ import annotations

import math
import re
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import TypeAlias

from socket_testbed.clocks import Backoff
from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.connection import (
    Answer,
    CommandQueue,
    NatNetSockets,
    TakeKeeper,
    bitstream_version,
)
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import MocapSettings

SILENCE = 0.3  # [s]; after which the server, or its stream, is lost
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

FRAMES = "frames"
BAD, LOST, LATE = "bad_datagrams", "lost_frames", "duplicate_or_late_frames"
IMPLAUSIBLE, FAILED = "frames_of_implausible_time", "frames_that_could_not_be_used"
_FAULTS = (BAD, LOST, LATE, IMPLAUSIBLE, FAILED)

OnFrame: TypeAlias = Callable[[messages.MocapFrame, float, messages.BodiesByName | None], None]

_WINDOW = 200  # echoes
_OLDEST = 40.0  # [s]
_NEEDED = 3  # echoes, before times are mapped
_DRIFT = 6e-4  # [-]; of two crystals and what steers a computer's clock, at most
_WANDER = 1e-5  # [-]; change of the drift within the oldest echo's age, at most
_TOLERANCE = 0.005  # [s]; of an echo against the map

_Region: TypeAlias = list[tuple[float, float]]  # corners: offset [s], drift [-]


class EchoClock:
    """Maps ticks of a server to the steady clock.

    The server reads its clock between an echo's request and its arrival, however the round trip
    is split, so each echo bounds the offset from both sides (Marzullo and Owicki 1983,
    doi:10.1145/800221.806730). Clocks drift steadily: offset and drift lie in the convex region
    that all echoes allow, each loosened by the possible change of the drift since. Times are
    mapped by the middle of the region. Half of its width is the largest error, whatever the
    asymmetry of the network, as long as the drift changes by no more than 1e-5 in 40 s.
    """

    def __init__(self, frequency: int) -> None:
        self.uncertainty = 0.0  # largest error at the newest echo [s]
        self._frequency = frequency  # of the server's clock [Hz]; 0: it has none
        # Both clocks are counted from the first echo on: the server's, and the request.
        self._origin = 0, 0.0  # [ticks], [s]
        # Time of the server, and the offset's bounds: request and arrival less that time [s].
        self._echoes: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        # The possible offsets at the newest echo's time, and drifts from it.
        self._region: _Region = []

    def __len__(self) -> int:
        return len(self._echoes)

    def add(self, request: float, ticks: int, arrival: float) -> bool:
        """Take an echo: the server's clock [ticks], read between request and arrival [s].

        False if it contradicts the map: this is another clock, and the map starts anew.
        """
        if self._frequency <= 0 or arrival < request:
            return True
        consistent = True
        if self._echoes:
            low, high = self._bounds(ticks)
            ahead = self._elapsed(ticks) - self._echoes[-1][0]
            slack = _TOLERANCE + 2.0 * _DRIFT * abs(ahead)
            consistent = request - slack <= high and low <= arrival + slack
        if not consistent or not self._echoes:
            self._echoes.clear()
            self._origin = ticks, request
        elapsed = self._elapsed(ticks)
        begun = self._origin[1] + elapsed
        self._echoes.append((elapsed, request - begun, arrival - begun))
        while elapsed - self._echoes[0][0] > _OLDEST:
            self._echoes.popleft()
        self._fit()
        return consistent

    def to_steady(self, ticks: int) -> tuple[float, float] | None:
        """Steady time at the server's ticks, and its largest error [s]; None without a map."""
        if len(self._echoes) < _NEEDED:
            return None
        low, high = self._bounds(ticks)
        return 0.5 * (low + high), 0.5 * (high - low)

    def _elapsed(self, ticks: int) -> float:
        return (ticks - self._origin[0]) / self._frequency

    def _bounds(self, ticks: int) -> tuple[float, float]:
        """Earliest and latest steady time of the server's ticks [s]."""
        elapsed = self._elapsed(ticks)
        ahead, begun = elapsed - self._echoes[-1][0], self._origin[1] + elapsed
        offsets = [offset + drift * ahead for offset, drift in self._region]
        slack = _WANDER * abs(ahead)
        return begun + min(offsets) - slack, begun + max(offsets) + slack

    def _fit(self) -> None:
        """Narrow the region by the echoes, from the newest on."""
        at, least, most = self._echoes[-1]
        region = [(least, -_DRIFT), (most, -_DRIFT), (most, _DRIFT), (least, _DRIFT)]
        for number, (elapsed, low, high) in enumerate(reversed(self._echoes)):
            ahead = elapsed - at
            slack = _WANDER * abs(ahead)
            region = _below(_below(region, ahead, high + slack), ahead, low - slack, sign=-1.0)
            if not region:  # the drift was another one then
                while len(self._echoes) > number:
                    self._echoes.popleft()
                break
            self._region = region
        offsets = [offset for offset, _ in self._region]
        self.uncertainty = 0.5 * (max(offsets) - min(offsets))


def _below(region: _Region, ahead: float, limit: float, sign: float = 1.0) -> _Region:
    """The part of a convex region whose offset some time ahead is below a limit [s].

    With the sign -1, the part above it (Sutherland and Hodgman 1974).
    """
    excess = [sign * (offset + drift * ahead - limit) for offset, drift in region]
    if max(excess, default=0.0) <= 0.0:
        return region
    kept: _Region = []
    for k, (corner, over) in enumerate(zip(region, excess, strict=True)):
        (x, y), over_before = region[k - 1], excess[k - 1]
        if (over > 0.0) != (over_before > 0.0):
            share = over_before / (over_before - over)
            kept.append((x + share * (corner[0] - x), y + share * (corner[1] - y)))
        if over <= 0.0:
            kept.append(corner)
    return kept


class LinkStatistics:
    """Counts frames and faults; any thread may ask, one counts."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._totals = dict.fromkeys((FRAMES, *_FAULTS), 0)
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
            if kind == FRAMES and self._totals[FRAMES] > 1:
                self._last_frame = now

    def quiet(self, now: float) -> float:
        """Time since the last frame that was delivered [s]."""
        return now - self._last_frame

    def rate(self, now: float) -> float:
        """Frames delivered per second, over the last one [Hz]."""
        with self._lock:
            times = [at for at, kind, _ in self._events if kind == FRAMES and at > now - _SPAN]
        return (len(times) - 1) / max(times[-1] - times[0], 1e-6) if len(times) > 1 else 0.0

    def warning(self, now: float) -> str:
        """The faults of the last second in one line; empty for none."""
        counts: Counter[str] = Counter()
        with self._lock:
            for at, kind, number in self._events:
                counts[kind] += number if at > now - _RECENT else 0
        found = [f"{counts[kind]} {kind.replace('_', ' ')}" for kind in _FAULTS if counts[kind]]
        last = f" (the last: {self._last_error})" if counts[BAD] or counts[FAILED] else ""
        return ", ".join(found) + last

    def totals(self) -> dict[str, int]:
        """All counts since the begin, by name."""
        with self._lock:
            return dict(self._totals)


class Session:
    """The client's side of the link; all of it on one thread."""

    def __init__(self, settings: MocapSettings, sockets: NatNetSockets, on_frame: OnFrame) -> None:
        self.settings = settings
        self.server: messages.ServerInfo | None = None  # its description; None: not connected
        self.models: messages.BodiesByName | None = None  # its rigid bodies; None: not known yet
        self.echoes = EchoClock(0)  # the map of its clock
        self.clock_error = 0.0  # largest error of the last frame's time [s]
        self.statistics = LinkStatistics()
        self.sessions = 0  # how often a session has begun
        self.last_frame = 0.0  # when a frame came last [s]
        self.stranger = ""  # the host, not the server, that a datagram came from last
        self.network = ""  # why the network takes nothing; empty: it does
        self._bitstream = bitstream_version(settings)
        self._version: messages.Version | None = None  # of its frames; None: not settled
        self._sockets = sockets
        self._commands = CommandQueue()
        self.takes = TakeKeeper(self._commands.submit)
        self._on_frame = on_frame
        self._connecting = Backoff()
        self._awaiting = False
        self._heard = self._next_echo = self._next_keepalive = self._next_models = 0.0
        self._pending: deque[int] = deque(maxlen=_PENDING)  # echoes by when they were sent [ns]
        self._models_wanted = False
        self._number: int | None = None  # of the last frame
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

    def step(self, now: float) -> None:
        """Send all that is due at a time of the steady clock [s]."""
        if self.server is not None and now - self._heard > SILENCE:
            self._lose()
        silent = now - self.last_frame > SILENCE
        # A server that answers but streams nothing may have forgotten this client.
        if (self.server is None or silent) and self._connecting.due(now):
            self._connect(now)
        if self.server is not None:
            self._stay(now)
        self._commands.step(now, self.send)
        self.takes.step(now, self._version is not None)

    def take(self, datagram: bytes, now: float) -> None:
        """Take a datagram of the server."""
        self._heard = now
        message, payload = messages.split_datagram(datagram)
        handler = self._handlers.get(message)
        if handler is not None:
            handler(payload, now)

    def send(self, datagram: bytes) -> None:
        """Send a datagram; a network that does not take it is a lost server."""
        try:
            self._sockets.send(datagram)
            self.network = ""
        except OSError as error:
            self.network = error.strerror or str(error)
            self._lose()
            self._sockets.close()

    def _lose(self) -> None:
        self._forget()
        if self.settings.multicast:  # the membership may have gone with the network
            self._sockets.close()

    def _restart(self) -> None:
        """The server is another one, or leaves."""
        self._forget()
        self._connecting.succeeded()

    def _forget(self) -> None:
        self.server = self.models = self._version = None
        self.echoes = EchoClock(0)
        self.clock_error = 0.0
        self._pending.clear()

    def _connect(self, now: float) -> None:
        self._connecting.failed(now)  # until it is answered
        self._awaiting = True
        try:
            self._sockets.open()
        except (OSError, DeviceError) as error:
            self.network = str(error)
            return
        self.send(messages.encode_connect("socket_testbed", self._bitstream))

    def _stay(self, now: float) -> None:
        """Keep the session alive and its knowledge fresh."""
        if now >= self._next_keepalive:
            self._next_keepalive = now + _KEEPALIVE
            self.send(messages.encode_message(messages.KEEPALIVE))
        if now >= self._next_echo:
            quick = len(self.echoes) < _QUICK_ECHOES
            quiet = now - self.last_frame > 0.5 * SILENCE
            unsure = self.clock_error > 0.5 * self.settings.clock_uncertainty
            pause = _ECHO_QUIET if quiet else _ECHO_UNSURE if unsure else _ECHO
            self._next_echo = now + (_ECHO_QUICK if quick else pause)
            stamp = round(now * 1e9)
            self._pending.append(stamp)
            self.send(messages.encode_echo(stamp))
        if self._models_wanted and self._version is not None and now >= self._next_models:
            self._next_models = now + _MODELS_RETRY
            self.send(messages.encode_message(messages.REQUEST_MODELDEF))

    def _take_server_info(self, payload: bytes, now: float) -> None:
        info = messages.parse_server_info(payload)
        if not self._awaiting:
            if self.server not in (None, info):
                self._restart()
            return
        self._awaiting = False
        if info != self.server:
            self._begin(info, now)
        self._negotiate(info)

    def _begin(self, info: messages.ServerInfo, now: float) -> None:
        self._forget()
        self.server = info
        self.sessions += 1
        self.echoes = EchoClock(info.clock)
        self._number = None
        self._next_echo = self._next_keepalive = self._next_models = 0.0
        self._models_wanted = True
        self.last_frame = now
        self._connecting.succeeded()
        self.takes.restarted(now)

    def _negotiate(self, info: messages.ServerInfo) -> None:
        """Settle the version of the stream, and subscribe to the needed sections: Wi-Fi is slow."""
        if self.settings.multicast or info.version < (4, 1):
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

    def _command(self, text: str, then: Callable[[Answer], None] | None = None) -> None:
        """Have a command answered in this session, however often it takes."""
        session = self.sessions

        def done(answer: Answer) -> None:
            if session != self.sessions or self.server is None:
                return
            if answer.raw is None:
                self._command(text, then)
            elif then is not None:
                then(answer)

        self._commands.submit(text, done)

    def _take_models(self, payload: bytes, now: float) -> None:
        if self._version is not None:
            self.models = messages.parse_model_definitions(payload, self._version)
            self._models_wanted = False
            self._next_models = now + _MODELS_AGAIN

    def _take_echo(self, payload: bytes, now: float) -> None:
        stamp, ticks = messages.parse_echo(payload)
        if stamp in self._pending:
            self._pending.remove(stamp)
            if not self.echoes.add(stamp * 1e-9, ticks, now):
                self._restart()

    def _take_frame(self, payload: bytes, now: float) -> None:
        if self._version is None:
            return
        frame = messages.parse_frame(payload, self._version)
        self.last_frame = now
        self._connecting.succeeded()
        if not self._is_next(frame.number, now):
            return
        self.takes.observe(frame.recording, now)
        known = {body.id for body in (self.models or {}).values()}
        if frame.models_changed or not known.issuperset(frame.bodies):
            self._models_wanted = True  # at most once a second
        if (exposed := self.echoes.to_steady(frame.mid_exposure)) is None:
            return
        moment, error = exposed
        if not now - _EARLIEST - error <= moment <= now + _LATEST + error:
            self.statistics.count(IMPLAUSIBLE, now)  # another clock: the next echo tells
            return
        self.clock_error = error
        if error <= self.settings.clock_uncertainty:
            self._on_frame(frame, moment, self.models)
            self.statistics.count(FRAMES, now)

    def _is_next(self, number: int, now: float) -> bool:
        """Whether a frame is newer than all before it."""
        step = 1 if self._number is None else number - self._number
        if -_LATEST_BY < step <= 0:
            self.statistics.count(LATE, now)
            return False
        if step > 1:
            self.statistics.count(LOST, now, min(step - 1, _MOST_LOST))
        self._number = number
        return True
