"""Networks of all kinds between a NatNet server and its client, in simulated time."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from struct import pack

import numpy as np

from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.connection import CommandQueue
from socket_testbed.drivers.natnet.session import Session
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.simulation.devices.natnet_server import (
    Content,
    Message,
    encode_frame,
    encode_model_definitions,
    encode_server_info,
)

FREQUENCY = 10_000_000  # [Hz]; of the server's clock
_BEGIN = 5000.0  # [s]; of the client's clock
_FRAMES = 100.0  # [Hz]
_LATENCY = 0.004  # [s]; from mid-exposure to transmission
_STEP = 0.01  # [s]; the client's longest wait
_INFO = messages.ServerInfo("Motive", (3, 1, 0, 0), (4, 1), FREQUENCY, 1511)

# How long a datagram that is sent at a time [s] of the link takes [s].
Delay = Callable[[float, np.random.Generator], float]


def jitter(shortest: float, mean: float) -> Delay:
    """A way of a shortest time and an exponential rest [s]."""
    return lambda at, rng: shortest + rng.exponential(mean)


def queue(shortest: float, depth: float, period: float) -> Delay:
    """A queue that fills up to a depth [s] and empties, again and again in a period [s]."""
    return lambda at, rng: shortest + depth * (at / period % 1.0) + rng.exponential(0.2e-3)


def queue_at_first(length: float, until: float, then: Delay) -> Delay:
    """A full queue [s] until a time [s]."""
    return lambda at, rng: then(at, rng) + (length if at < until else 0.0)


def power_save(awake: float, beacon: float = 0.1024) -> Delay:
    """A radio that is awake for a share of the time; datagrams wait for the next beacon [s]."""

    def delay(at: float, rng: np.random.Generator) -> float:
        phase = at % beacon
        sleeps_from = awake * beacon * 2.0 * np.random.default_rng(int(at / beacon)).random()
        return (0.0 if phase < sleeps_from else beacon - phase) + 0.6e-3 + rng.exponential(0.3e-3)

    return delay


@dataclass
class NatNetLink:
    """A server and a client's session with a network between them."""

    way: Delay
    back: Delay
    rate_error: Callable[[float], float] = lambda at: 0.0
    seed: int = 0
    settings: MocapSettings = field(default_factory=lambda: MocapSettings(server="127.0.0.1"))

    def __post_init__(self) -> None:
        self.opened = True
        # Time, error and stated uncertainty of each frame that was used [s].
        self.frames: list[tuple[float, float, float]] = []
        self._rng = np.random.default_rng(self.seed)
        self._numbers = count()
        self._events: list[tuple[float, int, Callable[[float], None]]] = []
        self._arrived = dict.fromkeys(("way", "back"), 0.0)
        self._now = 0.0
        self._exposed = 0.0
        self.session = Session(self.settings, (4, 1), self, CommandQueue(), self._take)

    def run(self, duration: float) -> NatNetLink:
        """Let the link be used for a time [s]."""
        self._at(self._now, self._wait)
        self._at(self._now, self._expose)
        while self._events and (event := heapq.heappop(self._events))[0] <= duration:
            self._now = event[0]
            event[2](self._now)
        self._events.clear()
        return self

    def open(self) -> None:
        """There are no sockets."""

    close = open

    def send(self, datagram: bytes) -> None:
        """Send a datagram of the client to the server."""
        self._carry("way", self.way, lambda at: self._answer(datagram, at))

    def _at(self, at: float, what: Callable[[float], None]) -> None:
        heapq.heappush(self._events, (at, next(self._numbers), what))

    def _carry(self, name: str, delay: Delay, what: Callable[[float], None]) -> None:
        """Datagrams keep their order."""
        at = max(self._now + delay(self._now, self._rng), self._arrived[name] + 1e-5)
        self._arrived[name] = at
        self._at(at, what)

    def _reply(self, message: Message) -> None:
        data = bytes(message.data)
        self._carry("back", self.back, lambda at: self._receive(data, at))

    def _receive(self, data: bytes, at: float) -> None:
        self.session.take(data, _BEGIN + at)
        self.session.step(_BEGIN + at)

    def _wait(self, at: float) -> None:
        self.session.step(_BEGIN + at)
        self._at(at + _STEP, self._wait)

    def _ticks(self, at: float) -> int:
        return round((1e4 + at + self.rate_error(at)) * FREQUENCY)

    def _answer(self, datagram: bytes, at: float) -> None:
        message, payload = messages.split_datagram(datagram)
        if message == messages.CONNECT:
            self._reply(encode_server_info(_INFO))
        elif message == messages.ECHOREQUEST:
            reply = payload + pack("<Q", self._ticks(at))
            self._reply(Message.of(messages.ECHORESPONSE, reply))
        elif message == messages.REQUEST_MODELDEF:
            self._reply(encode_model_definitions([], (4, 1)))
        elif message == messages.REQUEST:
            self._reply(Message.of(messages.RESPONSE, pack("<i", 0)))

    def _expose(self, at: float) -> None:
        ticks = self._ticks(at - _LATENCY)
        number = round(at * _FRAMES)
        content = Content(number, ticks=(ticks, ticks, ticks))
        data = bytes(encode_frame(content, (4, 1)).data)

        def arrive(now: float) -> None:
            self._exposed = at - _LATENCY
            self._receive(data, now)

        self._carry("back", self.back, arrive)
        self._at(at + 1.0 / _FRAMES, self._expose)

    def _take(self, frame, moment, models) -> None:
        error = moment - _BEGIN - self._exposed
        _, stated = self.session.echoes.to_steady(frame.mid_exposure)
        self.frames.append((self._exposed, error, stated))
