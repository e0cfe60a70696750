"""A client of a NatNet server that neither the network nor the server can end."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError

from socket_testbed import clocks
from socket_testbed.drivers.natnet.connection import (
    Answer,
    CommandQueue,
    NatNetSockets,
    bitstream_version,
    server_address,
)
from socket_testbed.drivers.natnet.messages import (
    DISCONNECT,
    Frame,
    MalformedDatagram,
    ModelDefinitions,
    ServerInfo,
    encode_message,
)
from socket_testbed.drivers.natnet.session import CONNECTED, SILENCE, Session
from socket_testbed.errors import DeviceError
from socket_testbed.settings.acquisition import MocapSettings

OK, WARN, ERROR = 0, 1, 2


def judge_link(session: Session, address: tuple[str, int], now: float) -> tuple[int, str]:
    """Level (0 fine, 1 warning, 2 error) and a line of text, at a time of the steady clock [s]."""
    server, where = session.server, f"{address[0]}:{address[1]}"
    if session.state != CONNECTED or server is None:
        if session.network:
            return ERROR, f"no network to {where} ({session.network}): check the Wi-Fi"
        return ERROR, f"no answer from {where}{_stranger(session)}: {_check(session)}"
    warning = session.statistics.warning(now)
    if session.statistics.quiet(now) > SILENCE:
        return ERROR, _why_no_frames(session, server, where, now) or (
            f"no frame from {where} can be used: {warning or 'its clock is not known yet'}"
        )
    if warning:
        return WARN, f"{warning}: check the Wi-Fi"
    if session.models is None:
        return WARN, f"{server} has not told its rigid bodies yet"
    return OK, _fine(session, server, now)


def _why_no_frames(session: Session, server: ServerInfo, where: str, now: float) -> str:
    """Why a server that answers gives no frames; empty: frames come, but none can be used."""
    if not server.clock:
        return f"{server} stamps no exposures: update Motive to 2.0 or later"
    if now - session.last_frame <= SILENCE or session.statistics.warning(now):
        return ""
    if server.multicast and not session.settings.multicast:
        return (
            f"{server} at {where} streams to the group {server.group}: choose unicast in Motive,"
            f" or set multicast to {server.group}"
        )
    return f"{server} at {where} answers but streams no frames: {_check(session)}"


def _check(session: Session) -> str:
    transport = "multicast" if session.settings.multicast else "unicast"
    return (
        f"check that Motive streams (Data Streaming, {transport}, Local Interface), and the Wi-Fi"
    )


def _fine(session: Session, server: ServerInfo, now: float) -> str:
    return (
        f"{session.statistics.told_rate(now):.0f} Hz from {server.name}"
        f" (Motive {_app(server)}, NatNet {_natnet(server)}),"
        f" clock +- {_rounded(session.echoes.uncertainty)} ms"
    )


def describe_link(session: Session, address: tuple[str, int], now: float) -> dict[str, str]:
    """The server and the link to it, by what is described."""
    server, echoes, models = session.server, session.echoes, session.models
    table = {"address": f"{address[0]}:{address[1]}", "state": session.state}
    if server is not None:
        table |= {
            "server": server.name,
            "application": _app(server),
            "NatNet": _natnet(server),
        }
    if len(echoes):
        table |= {
            "clock uncertainty": f"{1e3 * echoes.uncertainty:.2f} ms",
            "clock jitter": f"{1e3 * echoes.jitter:.2f} ms",
        }
    table["rate"] = f"{session.statistics.rate(now):.0f} Hz"
    if models is not None:
        table["bodies"] = ", ".join(sorted(models.bodies)) or "none"
    return table


def _app(server: ServerInfo) -> str:
    return ".".join(str(part) for part in server.app_version[:2])


def _natnet(server: ServerInfo) -> str:
    return ".".join(str(part) for part in server.version)


def _stranger(session: Session) -> str:
    return f", but from {session.stranger}" if session.stranger else ""


def _rounded(uncertainty: float) -> str:
    """In ms, and in steps, that the text changes seldom."""
    for step in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0):
        if 1e3 * uncertainty <= step:
            return f"{step:g}"
    return f"{1e3 * uncertainty:.0f}"


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

    Raises:
        ConfigurationError: If an address or the version of the stream is wrong.
    """

    def __init__(self, settings: MocapSettings, on_frame: OnFrame) -> None:
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
            self._session.network_failed(error, clocks.monotonic())
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
            answer = future.result(clocks.real(timeout))
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
            "rate": round(session.statistics.rate(clocks.monotonic()), 1),
            "clock_uncertainty": round(session.echoes.uncertainty, 6),
            "clock_jitter": round(session.echoes.jitter, 6),
        }

    def describe(self) -> dict[str, str]:
        """The server and the link to it, by what is described."""
        return describe_link(self._session, self._address, clocks.monotonic())

    def _run(self) -> None:
        deadline = float("inf")
        while True:
            now = clocks.monotonic()
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
                self._closing.wait(clocks.real(_TURN))
            for datagram, sender in self._sockets.receive(_TURN):
                arrival = clocks.monotonic()
                if sender != self._address[0]:
                    session.stranger = sender
                    continue
                try:
                    session.take(datagram, arrival)
                except MalformedDatagram as error:
                    session.statistics.count("bad", arrival, error=error.fact)
            # After what has come: a thread that was held up has not lost the server.
            session.step(clocks.monotonic())
        except Exception as error:  # whatever it was, the next datagram is another one
            session.statistics.count("failed", now, error=f"{type(error).__name__}: {error}")
