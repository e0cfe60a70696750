"""The page's server: viser's, behind a guard against requests from other sites."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import rich
import websockets.asyncio.server as websockets
from viser import ViserServer
from viser._messages import ShareUrlDisconnect, ShareUrlRequest
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from socket_testbed.viewer.listening import is_any, is_local, listen

_LOCAL = ("127.0.0.1", "localhost", "::1")
_HTTP = 80  # the port that a browser does not name
# The page asks nobody but its own server, and no other page shows it in a frame.
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval';"
    " frame-ancestors 'none'"
)


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
        """Why a request is refused; empty if it is not.

        Args:
            request: The request.
            address: Address of this machine that it arrived at.
        """
        hosts = [host.lower() for host in request.headers.get_all("Host")]
        allowed = {self._with_port(name) for name in (*self._names, address)}
        if self._port == _HTTP:
            allowed |= {_bracketed(name) for name in (*self._names, address)}
        if len(hosts) != 1 or hosts[0] not in allowed:
            return "the page is not served by this name: give it with --allow-host"
        if any(origin != f"http://{hosts[0]}" for origin in request.headers.get_all("Origin")):
            return "requests from other pages are refused"
        return ""

    def _with_port(self, name: str) -> str:
        return f"{_bracketed(name)}:{self._port}"


def _bracketed(name: str) -> str:
    """A name or an address as it stands in a URL."""
    return f"[{name}]" if ":" in name else name


class PageServer:
    """Serves the page.

    Args:
        host: Address that it listens on.
        port: Its port; 0 for one that is free.
        names: Further names by which it may be called.

    Attributes:
        viser: The server's scene and panels.
        is_local: Whether this machine alone reaches it.
        url: Where a browser finds the page.

    Raises:
        ConfigurationError: If it cannot listen there.
    """

    def __init__(self, host: str, port: int, names: tuple[str, ...] = ()) -> None:
        listening = listen(host, port)
        port = listening.getsockname()[1]
        self.is_local = is_local(host)
        name = "localhost" if self.is_local else socket.gethostname()
        guard = Guard({*_LOCAL, host, name, f"{name}.local", *names}, port)
        with _quiet(), _serving(listening, guard):
            self.viser = ViserServer(host, port, verbose=False)
        # Nobody hands the page on to the internet.
        for message in (ShareUrlRequest, ShareUrlDisconnect):
            self.viser._websock_server.unregister_handler(message)
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False)
        self.viser.gui.set_panel_label("socket_testbed")
        self.url = f"http://{_bracketed(name if is_any(host) else host)}:{port}"

    def close(self) -> None:
        """Stop serving."""
        with _quiet():
            self.viser.stop()


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
