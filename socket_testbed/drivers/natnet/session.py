"""The session with a NatNet server, connected, lost and connected again; and its takes."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from typing import TypeAlias

from socket_testbed.clocks import Backoff
from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.clock import EchoClock
from socket_testbed.drivers.natnet.connection import Answer, CommandQueue, Done, NatNetSockets
from socket_testbed.drivers.natnet.frame_filter import FrameFilter, LinkStatistics
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.settings.testbed import check_take_name

SILENCE = 0.3  # [s]; after which the server, or its stream, is lost
_KEEPALIVE = 1.0  # [s]
_QUICK_ECHOES = 10
_ECHO_QUICK, _ECHO_QUIET, _ECHO = 0.01, 0.1, 0.5  # [s]; at first, without frames, then
_ECHO_UNSURE = 0.13  # [s]; while the clock is known badly; in no step with beacons of 0.1 s
_PENDING = 64  # echoes
_MODELS_RETRY, _MODELS_AGAIN = 0.1, 1.0  # [s]
_SUBSCRIPTIONS = ("SubscribeToData,RigidBody,All", "SubscribeToData,LabeledMarkers,All")

_RETRY = 0.25  # [s]; from a command that failed to the next
_IN_FLIGHT = 0.1  # [s]; after which no frame is from before a command
_EVIDENCE = 0.3  # [s]; for the frames of a new session to show a recording
_CONTRADICTED = 1.0  # [s]

CONNECTING, CONNECTED, LOST = "connecting", "connected", "lost"

OnFrame: TypeAlias = Callable[[messages.MocapFrame, float, messages.BodiesByName | None], None]


class TakeKeeper:
    """Pursues the wanted take: named and started, stopped, and started again after a restart.

    `want` may be called from any thread, all else from one.

    Args:
        submit: Sends a command.
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

    def saw(self, recording: bool, now: float) -> None:
        """Take from a frame whether the server records."""
        if recording:
            self._idle_since = None
            if self._started is not None and now > self._moment:
                self._confirmed = True
        elif self._idle_since is None:
            self._idle_since = now

    def step(self, now: float, connected: bool) -> None:
        """Do what is due at a time of the steady clock [s]."""
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
        self._filter = FrameFilter(self.statistics)
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
        """Do what is due at a time of the steady clock [s]."""
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
        self._filter.reset()
        self._next_echo = self._next_keepalive = self._next_models = 0.0
        self._models_wanted = True
        self.last_frame = now
        self._connecting.succeeded()
        self.takes.restarted(now)

    def _negotiate(self, info: messages.ServerInfo) -> None:
        """Settle the version of the stream, and subscribe to what is needed: Wi-Fi is slow."""
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
        taken = self._filter.is_next(frame.number, now)
        if taken:
            self.takes.saw(frame.recording, now)
            self._watch_models(frame)
            moment = self.echoes.to_steady(frame.mid_exposure)
            if moment is None:
                return
            error = self.echoes.bound(frame.mid_exposure)
            taken = self._filter.is_plausible(moment, now, error)
            if taken:
                self.clock_error = error
                if error > self.settings.clock_uncertainty:
                    return
                self._on_frame(frame, moment, self.models)
                self.statistics.delivered(now)
        if not taken and self._filter.suspects(now):
            self._restart()

    def _watch_models(self, frame: messages.MocapFrame) -> None:
        changed = frame.models_changed and not self._models_changed
        self._models_changed = frame.models_changed
        if changed:
            self._next_models = 0.0
            self._models_wanted = True
        elif self.models is not None:
            known = {body.id for body in self.models.values()}
            if any(body.id not in known for body in frame.bodies):
                self._models_wanted = True  # at most once a second
