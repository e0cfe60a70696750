"""A client of a NatNet server that neither the network nor the server can end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError

from socket_testbed.acquisition_settings import MocapSettings
from socket_testbed.drivers.natnet.commands import Answer, CommandQueue
from socket_testbed.drivers.natnet.frames import Frame
from socket_testbed.drivers.natnet.health import describe_link, judge_link
from socket_testbed.drivers.natnet.models import ModelDefinitions
from socket_testbed.drivers.natnet.protocol import DISCONNECT, MalformedDatagram, encode_message
from socket_testbed.drivers.natnet.session import Session
from socket_testbed.drivers.natnet.sockets import (
    NatNetSockets,
    bitstream_version,
    server_address,
)
from socket_testbed.errors import DeviceError

OnFrame = Callable[[Frame, float, ModelDefinitions | None], None]

_TURN = 0.01  # [s]; longest wait for a datagram
_FAREWELL = 0.3  # [s]; time to stop a take on closing
_COMMAND_TIMEOUT = 2.0  # [s]; those that wait before it included


class NatNetClient:
    """Receives the frames of a server, on a thread of its own.

    Args:
        settings: The settings.
        on_frame: Called on that thread with each frame, the middle of its exposure on the
            steady clock [s], and the server's rigid bodies (None: not known yet).
        clock: The steady clock [s].

    Raises:
        ConfigurationError: If an address or the version of the stream is wrong.
    """

    def __init__(
        self,
        settings: MocapSettings,
        on_frame: OnFrame,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._address = server_address(settings)
        self._sockets = NatNetSockets(settings, self._address)
        self._commands = CommandQueue()
        self._session = Session(
            settings, bitstream_version(settings), self._sockets, self._commands, on_frame
        )
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin; a server or a network that is not there yet is waited for.

        Raises:
            DeviceError: If another program has the data port.
        """
        try:
            self._sockets.open()
        except OSError as error:
            self._session.network_failed(error, self._clock())
        self._thread = threading.Thread(target=self._run, name="natnet", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop a take that is on, leave the server and end the thread."""
        self.set_recording(None)
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._sockets.close()

    @property
    def state(self) -> str:
        """One of connecting, connected and lost."""
        return self._session.state

    @property
    def models(self) -> ModelDefinitions | None:
        """The server's rigid bodies; None: not known yet."""
        return self._session.models

    @property
    def recording_fault(self) -> str:
        """Why the server does not record as wanted; empty for nothing."""
        return self._session.takes.fault

    def set_recording(self, name: str | None) -> None:
        """Have the server record a take of this name, or none; this is pursued from now on."""
        self._session.takes.want(name)

    def command(self, text: str, timeout: float = _COMMAND_TIMEOUT) -> bytes:
        """Send a command and wait for its reply; not to be called from `on_frame`.

        Args:
            text: The command, such as "FrameRate".
            timeout: Longest wait, those before it included [s].

        Returns:
            The reply as it came: four bytes of a number, or a text.

        Raises:
            DeviceError: If there is no reply or the server does not know the command.
        """
        where = f"from {self._address[0]}:{self._address[1]}"
        name = text.partition(",")[0]
        silence = DeviceError(
            f"no answer to {name} {where}", "check that Motive runs and streams, and the Wi-Fi"
        )
        if self._thread is None:
            raise DeviceError(f"{name} was not sent", "start the client first")
        future: Future[Answer] = Future()
        self._commands.submit(text, future.set_result)
        try:
            answer = future.result(timeout)
        except FutureTimeoutError:
            raise silence from None
        if answer.response is None:
            raise silence
        if not answer.recognized:
            raise DeviceError(f"{name} is no command to the server {where}", "check its version")
        return answer.response.raw

    def health(self, now: float) -> tuple[int, str]:
        """How the link is at a time of the steady clock [s]: 0, 1 or 2, and a line of text."""
        if self._thread is None:
            return 2, "not started"
        return judge_link(self._session, self._address, now)

    def figures(self) -> dict[str, object]:
        """Counts since the begin, and the state of the clock and the rate, by name."""
        session = self._session
        return {
            **session.statistics.figures(),
            "sessions": session.sessions,
            "rate": round(session.statistics.rate(self._clock()), 1),
            "clock_uncertainty": round(session.echoes.uncertainty, 6),
            "clock_jitter": round(session.echoes.jitter, 6),
        }

    def describe(self) -> dict[str, str]:
        """The server and the link to it, by what is described."""
        return describe_link(self._session, self._address, self._clock())

    def _run(self) -> None:
        deadline = float("inf")
        while True:
            now = self._clock()
            if self._closing.is_set():
                deadline = min(deadline, now + _FAREWELL)
                if self._session.takes.settled or now > deadline:
                    break
            self._turn(now)
        self._session.send(encode_message(DISCONNECT), now)

    def _turn(self, now: float) -> None:
        session = self._session
        try:
            if not self._sockets.opened:
                self._closing.wait(_TURN)
            for datagram, sender in self._sockets.receive(_TURN):
                arrival = self._clock()
                if sender != self._address[0]:
                    session.stranger = sender
                    continue
                try:
                    session.take(datagram, arrival)
                except MalformedDatagram as error:
                    session.statistics.count("bad", arrival, error=error.fact)
            # After what has come: a thread that was held up has not lost the server.
            session.step(self._clock())
        except Exception as error:  # whatever it was, the next datagram is another one
            session.statistics.count("failed", now, error=f"{type(error).__name__}: {error}")
