"""The page's server: viser's, behind a guard against requests from other sites."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any

import rich
import websockets.asyncio.server as websockets
from viser import ViserServer
from viser._messages import ShareUrlDisconnect, ShareUrlRequest
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from socket_testbed.errors import ConfigurationError

LOCAL = ("127.0.0.1", "localhost", "::1")
# The page asks nobody but its own server, and no other page shows it in a frame.
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval';"
    " frame-ancestors 'none'"
)


def is_local(host: str) -> bool:
    """Whether a server that listens here is reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Args:
        host: Address or name of this machine.
        port: The port; 0 for one that is free.

    Raises:
        ConfigurationError: If the address is not one of this machine, or the port is taken.
    """
    try:
        family, *_, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise ConfigurationError(
            f"the page cannot listen on {host}:{port} ({error.strerror})",
            "give another port, or an address of this machine",
        ) from None


class Guard:
    """Lets through requests for this server that come from its own page.

    Another site's page may send requests to this machine: they carry that site as their origin, or
    its name as their host where the name is made to point to this machine (DNS rebinding).

    Args:
        names: Names and addresses by which the server may be called.
        port: Its port.
    """

    def __init__(self, names: set[str], port: int) -> None:
        self._hosts = {f"[{n}]:{port}" if ":" in n else f"{n}:{port}" for n in names}

    def refuses(self, request: Request) -> str:
        """Why a request is refused; empty if it is not."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return "this page is not served under that name: see --host of 'socket-testbed view'"
        origins = request.headers.get_all("Origin")
        if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
            return "requests from other pages are refused"
        return ""


class PageServer:
    """Serves the page; a context manager.

    Args:
        host: Address that it listens on.
        port: Its port; 0 for one that is free.
        names: Further names by which it may be called.

    Attributes:
        viser: The server's scene and panels.
        url: Where a browser finds the page.

    Raises:
        ConfigurationError: If it cannot listen there.
    """

    def __init__(self, host: str, port: int, names: tuple[str, ...] = ()) -> None:
        listening = listen(host, port)
        port = listening.getsockname()[1]
        own = LOCAL if is_local(host) else (*LOCAL, host)
        guard = Guard({name.lower() for name in (*own, *names)}, port)
        self._was_quiet = rich.get_console().quiet
        rich.get_console().quiet = True  # viser prints with it
        with _serving(listening, guard):
            self.viser = ViserServer(host, port, verbose=False)
        # Nobody hands the page on to the internet.
        for message in (ShareUrlRequest, ShareUrlDisconnect):
            self.viser._websock_server.unregister_handler(message)
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False)
        self.viser.gui.set_panel_label("socket_testbed")
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{port}"

    def close(self) -> None:
        """Stop serving."""
        self.viser.stop()
        rich.get_console().quiet = self._was_quiet


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
            if refusal := guard.refuses(request):
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
