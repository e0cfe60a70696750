"""A client of a NatNet server that neither the network nor the server can end."""

from __future__ import annotations

import threading
from contextlib import suppress

from socket_testbed import clocks
from socket_testbed.drivers.natnet.connection import NatNetSockets, server_address
from socket_testbed.drivers.natnet.messages import (
    DISCONNECT,
    MalformedDatagram,
    ServerInfo,
    encode_message,
)
from socket_testbed.drivers.natnet.session import BAD, FAILED, SILENCE, OnFrame, Session
from socket_testbed.settings.acquisition import MocapSettings

OK, WARN, ERROR = 0, 1, 2

_RECEIVE = 0.01  # [s]; longest wait for a datagram
_FAREWELL = 0.3  # [s]; time to stop a take on closing


class NatNetClient:
    """Receives the frames of a server, on a thread of its own.

    There `on_frame` is called with each, the middle of its exposure on the steady clock [s], and
    the server's rigid bodies (None: not known yet).
    """

    def __init__(self, settings: MocapSettings, on_frame: OnFrame) -> None:
        self._address = server_address(settings)
        self._where = f"{self._address[0]}:{self._address[1]}"
        self._sockets = NatNetSockets(settings, self._address)
        self._session = Session(settings, self._sockets, on_frame)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="natnet", daemon=True)

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

    @property
    def recording_fault(self) -> str:
        """Why the server does not record as wanted; empty for nothing."""
        return self._session.takes.fault

    @property
    def clock_fault(self) -> str:
        """Why frames have no time that is known well enough; empty: they have."""
        known, limit = self._session.clock_error, self._session.settings.clock_uncertainty
        if known <= limit:
            return ""
        return (
            f"Motive's clock is known within {1e3 * known:.3g} ms only (clock_uncertainty is"
            f" {1e3 * limit:g} ms), so poses are missing: switch the Wi-Fi's power saving off"
            " (iw dev wlan0 set power_save off), or use a free channel or a cable"
        )

    def set_recording(self, name: str | None) -> None:
        """Have the server record a take of this name, or none; this is pursued from now on."""
        self._session.takes.want(name)

    def health(self, now: float) -> tuple[int, str]:
        """State of the link at a time of the steady clock [s]: 0, 1 or 2, and a line of text."""
        session, server = self._session, self._session.server
        if server is None:
            return ERROR, self._why_no_server()
        missing, warning = self._why_no_frames(server, now), session.statistics.warning(now)
        if not missing and (fault := self.clock_fault):
            return WARN, fault
        if session.statistics.quiet(now) > SILENCE:
            reason = warning or "its clock is not known yet"
            return ERROR, missing or f"no frame from {self._where} can be used: {reason}"
        if warning:
            return WARN, f"{warning}: check the Wi-Fi"
        if session.models is None:
            return WARN, f"{server} has not sent its rigid bodies yet"
        known = f"{1e3 * session.echoes.uncertainty:.3g} ms"
        return OK, f"frames of {server} come, its clock is known within {known}"

    def _why_no_server(self) -> str:
        session = self._session
        if session.network:
            return f"no network to {self._where} ({session.network}): check the Wi-Fi"
        stranger = f", but from {session.stranger}" if session.stranger else ""
        return f"no answer from {self._where}{stranger}: {self._check_streaming()}"

    def _why_no_frames(self, server: ServerInfo, now: float) -> str:
        """Why a server that answers gives no frames; empty: frames come, but none can be used."""
        session = self._session
        if not server.clock:
            return f"{server} is too old, NatNet 3.0 is needed: update Motive to 2.0 or later"
        if now - session.last_frame <= SILENCE or session.statistics.warning(now):
            return ""
        if server.multicast and not session.settings.multicast:
            return (
                f"{server} at {self._where} streams to the group {server.group}: choose unicast in"
                f" Motive, or set multicast to {server.group}"
            )
        return f"{server} at {self._where} answers but streams no frames: {self._check_streaming()}"

    def _check_streaming(self) -> str:
        transport = "multicast" if self._session.settings.multicast else "unicast"
        return (
            f"check that Motive streams (Data Streaming, {transport}, Local Interface), and the"
            " Wi-Fi"
        )

    @property
    def server(self) -> str:
        """The server's description of itself; empty: none is connected."""
        return str(self._session.server or "")

    def figures(self) -> dict[str, float]:
        """Counts since the begin, and the state of the clock and the rate, by name."""
        session = self._session
        return {
            **session.statistics.totals(),
            "sessions": session.sessions,
            "rate": round(session.statistics.rate(clocks.monotonic()), 1),
            "clock_uncertainty": round(session.echoes.uncertainty, 6),
        }

    def _run(self) -> None:
        deadline = float("inf")
        while True:
            now = clocks.monotonic()
            if self._closing.is_set():
                deadline = min(deadline, now + _FAREWELL)
                if self._session.takes.settled or now > deadline:
                    break
            self._receive(now)
        self._session.send(encode_message(DISCONNECT))

    def _receive(self, now: float) -> None:
        """Take the datagrams that have come, and send the messages that are due."""
        session = self._session
        try:
            for datagram, sender in self._sockets.receive(_RECEIVE):
                arrival = clocks.monotonic()
                if sender != self._address[0]:
                    session.stranger = sender
                    continue
                try:
                    session.take(datagram, arrival)
                except MalformedDatagram as error:
                    session.statistics.count(BAD, arrival, error=error.fact)
            # After the datagrams: a thread that was held up has not lost the server.
            session.step(clocks.monotonic())
        except Exception as error:  # whatever it was, the next datagram is another one
            session.statistics.count(FAILED, now, error=f"{type(error).__name__}: {error}")
