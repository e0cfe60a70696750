"""Has a NatNet server record takes as they are wanted, whatever becomes of single commands."""

from __future__ import annotations

from collections.abc import Callable

from socket_testbed.drivers.natnet.commands import Answer, Done
from socket_testbed.drivers.natnet.protocol import Response

_RETRY = 0.25  # [s]; from a command that failed to the next
_IN_FLIGHT = 0.1  # [s]; after which no frame is from before a command
_EVIDENCE = 0.3  # [s]; how long the frames of a new session are given to show a recording
_CONTRADICTED = 1.0  # [s]


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
        self._now = 0.0
        self._next = 0.0
        self._moment = 0.0  # frames before it may be of an earlier take
        self._idle_since: float | None = None
        self._session = 0
        self._trouble = ""
        self.fault = ""

    @property
    def settled(self) -> bool:
        """Whether the server does what is wanted."""
        wanted = self._wanted
        return not self._busy and self._started == wanted and (wanted is None or self._confirmed)

    def want(self, name: str | None) -> None:
        """Want a take recorded, or none."""
        self._wanted = None if name is None else name.replace("\0", "")

    def restarted(self, now: float) -> None:
        """A session has begun: the server may have forgotten the take."""
        self._session += 1
        self._confirmed = False
        self._moment = now
        self._next = now + (0.0 if self._started is None else _EVIDENCE)
        self._idle_since = None

    def saw(self, recording: bool, now: float) -> None:
        """A frame says whether the server records."""
        if recording:
            self._idle_since = None
            if self._started is not None and now > self._moment:
                self._confirmed = True
        elif self._idle_since is None:
            self._idle_since = now

    def step(self, now: float, connected: bool) -> None:
        """Do what is due at a time of the steady clock [s]."""
        self._judge(now, connected)
        if self._busy or self.settled or not connected or now < self._next:
            return
        wanted = self._wanted
        self._now = now
        if self._started is not None and self._started != wanted:
            self._issue("StopRecording", self._stopped)
        elif wanted is not None:
            self._issue(f"SetRecordTakeName,{wanted}", lambda _: self._start(wanted))

    def _start(self, name: str) -> None:
        if name == self._wanted:
            self._started, self._moment = name, self._now + _IN_FLIGHT
            self._issue("StartRecording", self._confirm)

    def _confirm(self, answer: Answer) -> None:
        self._confirmed = True
        self._idle_since = None

    def _stopped(self, answer: Answer) -> None:
        self._started, self._confirmed = None, False

    def _issue(self, command: str, then: Callable[[Answer], None]) -> None:
        session = self._session

        def done(answer: Answer) -> None:
            self._busy = False
            # A server that does not record may refuse to stop: then that is what was wanted.
            if then == self._stopped and answer.response and self._idle_since is not None:
                answer = Answer(Response(bytes(4)))
            self._trouble = answer.fault(command)
            if self._trouble:
                self._next = self._now + _RETRY
            elif session == self._session:
                then(answer)

        self._busy = True
        self._submit(command, done)

    def _judge(self, now: float, connected: bool) -> None:
        wanted = self._wanted
        doing = "no take is stopped" if wanted is None else f"take '{wanted}' is not recorded"
        if not self.settled:
            reason = self._trouble if connected else "no connection"
            self.fault = f"{doing}: {reason}" if reason else ""
            return
        self._trouble = self.fault = ""
        if wanted is not None and self._idle_since and now - self._idle_since > _CONTRADICTED:
            self.fault = f"{doing}: the frames say that the server does not record"
