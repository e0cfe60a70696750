"""The session with a NatNet server: connected, lost, connected again; which frames are used."""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from socket_testbed.clocks import Backoff
from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.connection import Answer, CommandQueue, NatNetSockets, TakeKeeper
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

KINDS = {
    "bad": "bad datagrams",
    "lost": "lost frames",
    "late": "duplicate or late frames",
    "implausible": "frames of implausible time",
    "failed": "frames that could not be used",
}

CONNECTING, CONNECTED, LOST = "connecting", "connected", "lost"

OnFrame: TypeAlias = Callable[[messages.MocapFrame, float, messages.BodiesByName | None], None]

_WINDOW = 200  # echoes
_OLDEST = 40.0  # [s]
_NEEDED = 3  # echoes, before times are mapped
_DRIFT = 6e-4  # [-]; of two crystals and what steers a computer's clock, at most
_WANDER = 1e-5  # [-]; change of the drift within the oldest echo's age, at most
_TOLERANCE = 0.005  # [s]; of an echo against the map

_Region: TypeAlias = list[tuple[float, float]]  # corners: offset [s], drift [-]


class _Map(NamedTuple):
    """The possible offsets at a time of the server, and drifts from it."""

    at: float
    base: float
    region: _Region

    def offsets(self, elapsed: float) -> tuple[float, float]:
        """Least and largest offset at a time of the server [s]."""
        ahead = elapsed - self.at
        offsets = [offset + drift * ahead for offset, drift in self.region]
        slack = _WANDER * abs(ahead)
        return self.base + min(offsets) - slack, self.base + max(offsets) + slack


class EchoClock:
    """Maps ticks of a server to the steady clock.

    The server reads its clock between an echo's request and its arrival, however the round trip
    is split, so each echo bounds the offset from both sides (Marzullo and Owicki 1983,
    doi:10.1145/800221.806730). Clocks drift steadily: offset and drift lie in the convex region
    that all echoes allow, each loosened by the possible change of the drift since. Times are
    mapped by the middle of the region. Half of its width is the largest error, whatever the
    asymmetry of the network, as long as the drift changes by no more than 1e-5 in 40 s.

    Args:
        frequency: Frequency of the server's clock [Hz]; 0: it has none.
    """

    def __init__(self, frequency: int) -> None:
        self._frequency = frequency
        # Time of the server, and the offset's bounds: request and arrival less that time [s].
        self._echoes: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        self._origin = 0  # [ticks]
        self._map = _Map(0.0, 0.0, [])
        self.uncertainty = 0.0  # largest error at the newest echo [s]

    def __len__(self) -> int:
        return len(self._echoes)

    def add(self, request: float, ticks: int, arrival: float) -> bool:
        """Take an echo.

        Args:
            request: When it was asked for, on the steady clock [s].
            ticks: The server's clock in the reply [ticks].
            arrival: When the reply came [s].

        Returns:
            False if it contradicts the map: this is another clock, and the map starts anew.
        """
        if self._frequency <= 0 or arrival < request:
            return True
        consistent = True
        if self._echoes:
            elapsed = self._elapsed(ticks)
            low, high = (offset + elapsed for offset in self._map.offsets(elapsed))
            slack = _TOLERANCE + 2.0 * _DRIFT * abs(elapsed - self._map.at)
            consistent = request - slack <= high and low <= arrival + slack
        if not consistent or not self._echoes:
            self._echoes.clear()
            self._origin = ticks
        elapsed = self._elapsed(ticks)
        self._echoes.append((elapsed, float(request - elapsed), float(arrival - elapsed)))
        while elapsed - self._echoes[0][0] > _OLDEST:
            self._echoes.popleft()
        self._fit()
        return consistent

    def to_steady(self, ticks: int) -> tuple[float, float] | None:
        """Steady time at the server's ticks, and its largest error [s]; None without a map."""
        if len(self._echoes) < _NEEDED:
            return None
        elapsed = self._elapsed(ticks)
        low, high = self._map.offsets(elapsed)
        return elapsed + 0.5 * (low + high), 0.5 * (high - low)

    def _elapsed(self, ticks: int) -> float:
        return (ticks - self._origin) / self._frequency

    def _fit(self) -> None:
        """Narrow the region by the echoes, from the newest on."""
        at, low, high = self._echoes[-1]
        base = 0.5 * (low + high)  # keeps the numbers small
        half = 0.5 * (high - low)
        region: _Region = [(-half, -_DRIFT), (half, -_DRIFT), (half, _DRIFT), (-half, _DRIFT)]
        for number, (elapsed, low, high) in enumerate(reversed(self._echoes)):
            age = at - elapsed
            slack = _WANDER * abs(age)
            region = _between(region, -age, low - slack - base, high + slack - base)
            if not region:  # the drift was another one then
                while len(self._echoes) > number:
                    self._echoes.popleft()
                break
            self._map = _Map(at, base, region)
        low, high = self._map.offsets(at)
        self.uncertainty = 0.5 * (high - low)


def _between(region: _Region, ahead: float, low: float, high: float) -> _Region:
    """The part of a convex region whose offset some time ahead is between two bounds [s]."""
    offsets = [offset + drift * ahead for offset, drift in region]
    if max(offsets) > high:
        region = _cut(region, [offset - high for offset in offsets])
        offsets = [offset + drift * ahead for offset, drift in region]
    if offsets and min(offsets) < low:
        region = _cut(region, [low - offset for offset in offsets])
    return region


def _cut(region: _Region, excess: list[float]) -> _Region:
    """The part of a convex region on one side of a line (Sutherland and Hodgman 1974)."""
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
        self._recent: deque[tuple[float, str, int]] = deque(maxlen=_MOST)  # faults: time [s], kind
        self._totals = dict.fromkeys(KINDS, 0)
        self._frames: deque[float] = deque(maxlen=_MOST)
        self._delivered = 0
        self._last_error = ""

    def count(self, kind: str, now: float, number: int = 1, error: str = "") -> None:
        """Count a fault."""
        with self._lock:
            self._totals[kind] += number
            self._recent.append((now, kind, number))
            self._last_error = error or self._last_error

    def delivered(self, now: float) -> None:
        """Count a frame that was delivered."""
        with self._lock:
            self._delivered += 1
            self._frames.append(now)

    def quiet(self, now: float) -> float:
        """Time since the last frame that was delivered, of two at least [s]."""
        with self._lock:
            return now - self._frames[-1] if len(self._frames) > 1 else float("inf")

    def rate(self, now: float) -> float:
        """Frames delivered per second, over the last one [Hz]."""
        with self._lock:
            while self._frames and self._frames[0] < now - _SPAN:
                self._frames.popleft()
            if len(self._frames) < 2:
                return 0.0
            return (len(self._frames) - 1) / max(self._frames[-1] - self._frames[0], 1e-6)

    def warning(self, now: float) -> str:
        """The faults of the last second in one line; empty for none."""
        counts = dict.fromkeys(KINDS, 0)
        with self._lock:
            for moment, kind, number in self._recent:
                counts[kind] += number if moment > now - _RECENT else 0
        text = ", ".join(f"{number} {KINDS[kind]}" for kind, number in counts.items() if number)
        last = f" (the last: {self._last_error})" if counts["bad"] or counts["failed"] else ""
        return text + last

    def figures(self) -> dict[str, object]:
        """All counts since the begin, by name."""
        with self._lock:
            totals = {KINDS[kind].replace(" ", "_"): n for kind, n in self._totals.items()}
            return {"frames": self._delivered, **totals}


class Session:
    """The client's side of the link; all of it on one thread."""

    def __init__(
        self,
        settings: MocapSettings,
        bitstream: messages.Version,
        sockets: NatNetSockets,
        commands: CommandQueue,
        on_frame: OnFrame,
    ) -> None:
        self.settings = settings
        self.state = CONNECTING  # one of connecting, connected and lost
        self.server: messages.ServerInfo | None = None  # how the server described itself last
        self.models: messages.BodiesByName | None = None  # its rigid bodies; None: not known yet
        self.echoes = EchoClock(0)  # the map of its clock
        self.clock_error = 0.0  # largest error of the last frame's time [s]
        self.statistics = LinkStatistics()
        self.takes = TakeKeeper(commands.submit)
        self.streaming = False  # whether the version of its frames is settled
        self.sessions = 0  # how often a session has begun
        self.last_frame = 0.0  # when a frame came last [s]
        self.stranger = ""  # the host, not the server, that a datagram came from last
        self.network = ""  # why the network takes nothing; empty: it does
        self._bitstream = bitstream
        self._version: messages.Version = bitstream
        self._sockets = sockets
        self._commands = commands
        self._on_frame = on_frame
        self._connecting = Backoff()
        self._awaiting = False
        self._heard = self._next_echo = self._next_keepalive = 0.0
        self._pending: deque[int] = deque(maxlen=_PENDING)  # echoes by when they were sent [ns]
        self._models_wanted = False
        self._next_models = 0.0
        self._models_changed = False
        self._number: int | None = None  # of the last frame
        self._handlers: dict[int, Callable[[bytes, float], None]] = {
            messages.SERVERINFO: self._take_server_info,
            messages.FRAME: self._take_frame,
            messages.MODELDEF: self._take_models,
            messages.ECHORESPONSE: self._take_echo,
            messages.DISCONNECT: lambda payload, now: self._restart(),
            messages.RESPONSE: lambda payload, now: commands.answer(Answer(payload), now),
            messages.UNRECOGNIZED: lambda payload, now: commands.answer(
                Answer(payload, recognized=False), now
            ),
        }

    def step(self, now: float) -> None:
        """Send all that is due at a time of the steady clock [s]."""
        if self.state == CONNECTED and now - self._heard > SILENCE:
            self._lose()
        silent = now - self.last_frame > SILENCE
        # A server that answers but streams nothing may have forgotten this client.
        if (self.state != CONNECTED or silent) and self._connecting.due(now):
            self._connect(now)
        if self.state == CONNECTED:
            self._stay(now)
        self._commands.step(now, self.send)
        self.takes.step(now, self.state == CONNECTED and self.streaming)

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
            self.network_failed(error)

    def network_failed(self, error: OSError) -> None:
        """Note that the network is not there, and open the sockets anew later."""
        self.network = error.strerror or str(error)
        self._lose()
        self._sockets.close()

    def _lose(self) -> None:
        if self.state == CONNECTED:
            self.state = LOST
        self._forget()
        if self.settings.multicast:  # the membership may have gone with the network
            self._sockets.close()

    def _restart(self) -> None:
        """The server is another one, or leaves."""
        self.state = CONNECTING
        self._forget()
        self._connecting.succeeded()

    def _forget(self) -> None:
        self.streaming = False
        self.models = None
        self.echoes = EchoClock(0)
        self.clock_error = 0.0
        self._pending.clear()

    def _connect(self, now: float) -> None:
        self._connecting.failed(now)  # until it is answered
        self._awaiting = True
        if not self._sockets.opened:
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
        if self._models_wanted and self.streaming and now >= self._next_models:
            self._next_models = now + _MODELS_RETRY
            self.send(messages.encode_message(messages.REQUEST_MODELDEF))

    def _take_server_info(self, payload: bytes, now: float) -> None:
        info = messages.parse_server_info(payload)
        if not self._awaiting:
            if self.state == CONNECTED and info != self.server:
                self._restart()
            return
        self._awaiting = False
        if self.state != CONNECTED or info != self.server:
            self._begin(info, now)
        self._negotiate(info)

    def _begin(self, info: messages.ServerInfo, now: float) -> None:
        self.state, self.server = CONNECTED, info
        self.sessions += 1
        self._forget()
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
            self._version, self.streaming = info.version, info.version >= messages.OLDEST
            return
        session = self.sessions
        wanted = min(self._bitstream, info.version)
        self.streaming = False

        def settle(answer: Answer) -> None:
            if session != self.sessions or self.state != CONNECTED:
                return
            if answer.raw is None:
                self._negotiate(info)
                return
            named = re.search(r"(\d+)\.(\d+)", answer.text)
            if not answer.accepted:
                self._version = info.version
            else:
                self._version = (int(named[1]), int(named[2])) if named else wanted
            self.streaming = True
            for text in _SUBSCRIPTIONS:
                subscribe(text)

        def subscribe(text: str) -> None:
            def done(answer: Answer) -> None:
                if answer.raw is None and session == self.sessions:
                    subscribe(text)

            self._commands.submit(text, done)

        self._commands.submit(f"Bitstream,{wanted[0]}.{wanted[1]}", settle)

    def _take_models(self, payload: bytes, now: float) -> None:
        if self.streaming:
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
        if not self.streaming:
            return
        frame = messages.parse_frame(payload, self._version)
        self.last_frame = now
        self._connecting.succeeded()
        if not self._is_next(frame.number, now):
            return
        self.takes.observe(frame.recording, now)
        self._watch_models(frame)
        if (exposed := self.echoes.to_steady(frame.mid_exposure)) is None:
            return
        moment, error = exposed
        if not now - _EARLIEST - error <= moment <= now + _LATEST + error:
            self.statistics.count("implausible", now)  # another clock: the next echo tells
            return
        self.clock_error = error
        if error <= self.settings.clock_uncertainty:
            self._on_frame(frame, moment, self.models)
            self.statistics.delivered(now)

    def _is_next(self, number: int, now: float) -> bool:
        """Whether a frame is newer than all before it."""
        step = 1 if self._number is None else number - self._number
        if -_LATEST_BY < step <= 0:
            self.statistics.count("late", now)
            return False
        if step > 1:
            self.statistics.count("lost", now, min(step - 1, _MOST_LOST))
        self._number = number
        return True

    def _watch_models(self, frame: messages.MocapFrame) -> None:
        changed = frame.models_changed and not self._models_changed
        self._models_changed = frame.models_changed
        if changed:
            self._next_models = 0.0
            self._models_wanted = True
        elif self.models is not None and not {body.id for body in self.models.values()}.issuperset(
            frame.bodies
        ):
            self._models_wanted = True  # at most once a second
