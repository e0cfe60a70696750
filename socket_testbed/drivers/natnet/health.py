"""How the link to a NatNet server is, in a line of text for a person."""

from __future__ import annotations

from socket_testbed.drivers.natnet.protocol import ServerInfo
from socket_testbed.drivers.natnet.session import CONNECTED, SILENCE, Session

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
