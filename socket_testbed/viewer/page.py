"""The page in a browser: a server that answers its own page alone, and the thread that draws."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any

import rich
import websockets.asyncio.server as websockets
from viser import ViserServer
from viser._messages import ShareUrlDisconnect, ShareUrlRequest
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from socket_testbed.errors import ConfigurationError
from socket_testbed.viewer.panel import Panel
from socket_testbed.viewer.scene import Legend, Scene
from socket_testbed.viewer.source import Source

_PERIOD = 0.055  # [s]; between frames
_LOCAL = ("127.0.0.1", "localhost", "::1")
_HTTP = 80  # the port that a browser does not name
# The page asks nobody but its own server, and no other page shows it in a frame.
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval';"
    " frame-ancestors 'none'"
)


class Page:
    """Draws a source on a server's page in a thread of its own, while a browser is open.

    Args:
        source: What is drawn.
        server: Serves the page; it is closed with the page.
    """

    def __init__(self, source: Source, server: PageServer) -> None:
        self._source, self._server = source, server
        self._scene = Scene(server.viser, source.geometry)
        self._legend = Legend(server.viser, source.geometry)
        self._panel = Panel(server.viser, source)
        self._changed = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()
        server.viser.on_client_connect(lambda client: self._changed.set())
        server.viser.on_client_disconnect(lambda client: self._changed.set())

    @property
    def works(self) -> bool:
        """Whether it draws, or would if a browser were open."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop drawing and serving."""
        self._closed = True
        self._changed.set()
        self._thread.join()
        self._server.close()

    def draw(self) -> None:
        """Draw one frame."""
        instant = self._source.instant()
        with self._server.viser.atomic():
            self._legend.update(instant.map if instant else None)
            if instant is not None:
                self._scene.update(instant, self._legend)
            self._panel.update(self._source)

    def _run(self) -> None:
        while not self._closed:
            self._changed.wait()
            self._changed.clear()
            if not self._server.viser.get_clients():
                continue
            self._source.watched(True)
            due = time.monotonic()
            while not self._closed and self._server.viser.get_clients():
                self.draw()
                due = max(due + _PERIOD, time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
            self._source.watched(False)


class PageServer:
    """viser's server, behind a guard against requests from other sites.

    Args:
        host: Address that it listens on.
        port: Its port; 0 for one that is free.
        names: Further names by which it may be called.

    Attributes:
        viser: The server's scene and panels.
        is_local: Whether this machine alone reaches it.
        url: Where a browser finds the page.
    """

    def __init__(self, host: str, port: int, names: tuple[str, ...] = ()) -> None:
        listening = listen(host, port)
        port = listening.getsockname()[1]
        address = _address(host)
        self.is_local = address is not None and address.is_loopback
        name = "localhost" if self.is_local else socket.gethostname()
        guard = Guard({*_LOCAL, host, name, f"{name}.local", *names}, port)
        with _quiet(), _serving(listening, guard):
            self.viser = ViserServer(host, port, verbose=False)
        # Nobody hands the page on to the internet.
        for message in (ShareUrlRequest, ShareUrlDisconnect):
            self.viser._websock_server.unregister_handler(message)
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False)
        self.viser.gui.set_panel_label("socket_testbed")
        if address is not None and address.is_unspecified:
            host = name
        self.url = f"http://{_bracketed(host)}:{port}"

    def close(self) -> None:
        """Stop serving."""
        with _quiet():
            self.viser.stop()


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address or name of this machine; port 0 for one that is free.

    Raises:
        ConfigurationError: If the address is not one of this machine, or the port is taken.
    """
    try:
        family, *_, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        unknown = isinstance(error, socket.gaierror)
        reason = error.strerror if unknown else os.strerror(error.errno or 0)
        raise ConfigurationError(
            f"the page cannot listen on {host}:{port} ({reason})",
            "give another port, or an address of this machine",
        ) from None


def _address(host: str) -> IPv4Address | IPv6Address | None:
    """The address of a host; None for a name."""
    try:
        return ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return None


def _bracketed(name: str) -> str:
    """A name or an address as it stands in a URL."""
    return f"[{name}]" if ":" in name else name


class Guard:
    """Lets through requests for this server that come from its own page.

    Another site's page may send requests to this machine: they carry that site as their origin, or
    its name as their host where the name is made to point to this machine (DNS rebinding).

    Args:
        names: Names and addresses by which the server may be called, besides the address that a
            request arrives at: no other site has that as its name.
        port: Its port.
    """

    def __init__(self, names: Iterable[str], port: int) -> None:
        self._names = {name.lower() for name in names}
        self._port = port

    def refuses(self, request: Request, address: str) -> str:
        """Why a request that arrived at an address is refused; empty if it is not."""
        hosts = [host.lower() for host in request.headers.get_all("Host")]
        names = {_bracketed(name) for name in (*self._names, address)}
        allowed = {f"{name}:{self._port}" for name in names}
        if self._port == _HTTP:
            allowed |= names
        if len(hosts) != 1 or hosts[0] not in allowed:
            return "the page is not served by this name: give it with --allow-host"
        if any(origin != f"http://{hosts[0]}" for origin in request.headers.get_all("Origin")):
            return "requests from other pages are refused"
        return ""


@contextmanager
def _quiet() -> Iterator[None]:
    """Within this, viser prints nothing."""
    console = rich.get_console()
    was, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = was


@contextmanager
def _serving(listening: socket.socket, guard: Guard) -> Iterator[None]:
    """Within this, viser serves on a socket that listens, behind a guard.

    viser takes no socket, tries other ports unasked, and has no place for a check of its requests.
    """
    module: Any = websockets
    plain = module.serve

    def serve(
        handler: Any, host: str, port: int, *, process_request: Callable[..., Any], **options: Any
    ) -> Any:
        del host, port

        def guarded(connection: ServerConnection, request: Request) -> Response | None:
            if refusal := guard.refuses(request, connection.local_address[0]):
                return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
            response: Response | None = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = _POLICY
            return response

        return plain(handler, sock=listening, process_request=guarded, **options)

    module.serve = serve
    try:
        yield
    finally:
        module.serve = plain
