"""HTTP server for the page of a trial or a running testbed; rejects requests of other sites."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from plotly.offline import get_plotlyjs

from socket_testbed.documents import check_number, decimal
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.pages.document import Document

_LOCAL = ("127.0.0.1", "localhost", "::1")
_HTTP = 80  # the port omitted by browsers
# The page loads only from its own server, and no other page may frame it.
_POLICY = "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; frame-ancestors 'none'"
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_MAX_LENGTH = 20_000  # [bytes]; of a request's body
_IDLE_TIMEOUT = 30.0  # [s]


class Source(Protocol):
    """Content of a page: a trial or a running testbed; `act` may be called meanwhile."""

    def start(self) -> Document:
        """The socket, and everything else that does not change, as plain data for JSON."""

    def now(self, time: float | None) -> Document:
        """State at a time since the first sample [s], or if None of the newest sample."""

    def act(self, what: str, given: dict[str, Any]) -> str:
        """Press a button.

        Args:
            what: Name of the button, such as `tare`.
            given: Values that the page sends with it, by name.

        Returns:
            The outcome, one line.

        Raises:
            TestbedError: It failed; the page shows the line.
        """


class PageServer(ThreadingHTTPServer):
    """Serves a source until closed; a context manager.

    The page is at `url`; the lock `asking` is held while the source is asked for its state.
    """

    def __init__(self, source: Source, host: str, port: int, names: tuple[str, ...] = ()) -> None:
        """Listen and serve in a thread.

        Args:
            source: What the page shows.
            host: Address or name of this machine to listen on; `0.0.0.0` for all addresses.
            port: Port to listen on; 0 for any free one.
            names: Further host names under which browsers may open the page.
        """
        listening = listen(host, port)
        super().__init__((host, port), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening
        self.source, self.asking, self.closing = source, threading.Lock(), False
        address, self._port = _address(host), listening.getsockname()[1]
        name = "localhost" if is_local(host) else socket.gethostname()
        shown = name if address is not None and address.is_unspecified else host
        self.url = f"http://{_bracketed(shown)}:{self._port}"
        names = (*_LOCAL, host, name, f"{name}.local", *names)
        self._names = {_bracketed(name.lower()) for name in names}
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    def __repr__(self) -> str:
        return f"PageServer({self.url})"

    def __exit__(self, *_: object) -> None:
        self.close()

    def refuses(self, hosts: list[str], origins: list[str], address: str) -> str:
        """Reason to refuse a request with these Host and Origin headers; empty to accept it.

        Pages of other sites may send requests to this machine: they carry that site as Origin, or
        its name as Host if the name is made to resolve to this machine (DNS rebinding).

        Args:
            hosts: Values of the Host headers; exactly one is accepted.
            origins: Values of the Origin headers, if any.
            address: Local address of the connection, always a valid host.
        """
        hosts = [host.lower() for host in hosts]
        names = self._names | {_bracketed(address)}
        allowed = {f"{name}:{self._port}" for name in names}
        allowed |= names if self._port == _HTTP else set()
        if len(hosts) != 1 or hosts[0] not in allowed:
            return "the page is not served by this name: give it with --allow-host"
        if any(origin.lower() != f"http://{hosts[0]}" for origin in origins):
            return "requests from other pages are refused"
        return ""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error of a request, unless the browser has gone, as with a closed tab.

        Args:
            request: The socket of the connection.
            client_address: Address and port of the browser.
        """
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def close(self) -> None:
        """Stop serving, including on open connections."""
        self.closing = True
        self.shutdown()
        self.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    """Answers one browser."""

    protocol_version = "HTTP/1.1"
    timeout = _IDLE_TIMEOUT
    server: PageServer

    def do_GET(self) -> None:
        """Serve the page, its files, and data of the source."""
        if self._is_refused():
            return
        address, source = urlsplit(self.path), self.server.source
        if address.path not in ("/start", "/now"):
            self._answer_file(address.path)
            return
        asked = parse_qs(address.query).get("t")
        try:
            time = decimal(asked[0]) if asked else None
        except ValueError:
            self._answer(HTTPStatus.BAD_REQUEST, b"the time is not a number\n")
            return
        with self.server.asking:  # not while it is sent: a browser may be slow to take it
            found = source.start() if address.path == "/start" else source.now(time)
        self._answer_json(found)

    def do_POST(self) -> None:
        """Press a button."""
        length = self.headers.get("Content-Length", "")
        if self._is_refused():
            return
        if not length.isdigit() or int(length) > _MAX_LENGTH:
            self.close_connection = True  # the body is not read
            self._answer(HTTPStatus.BAD_REQUEST, b"too long\n")
            return
        try:
            given = json.loads(self.rfile.read(int(length)))
            what = str(given.pop("do"))
        except (ValueError, AttributeError, KeyError, TypeError):
            self._answer(HTTPStatus.BAD_REQUEST, b"no button\n")
            return
        try:
            self._answer_json({"said": self.server.source.act(what, given)})
        except TestbedError as error:
            self._answer_json({"said": str(error), "failed": True})

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""

    def _is_refused(self) -> bool:
        address = self.connection.getsockname()[0]
        hosts, origins = (self.headers.get_all(name) or [] for name in ("Host", "Origin"))
        refusal = self.server.refuses(hosts, origins, address)
        status = HTTPStatus.FORBIDDEN if refusal else HTTPStatus.SERVICE_UNAVAILABLE
        if refusal or self.server.closing:
            self.close_connection = True
            self._answer(status, f"{refusal or 'the page is closed'}\n".encode())
            return True
        return False

    def _answer_json(self, found: Document) -> None:
        body = json.dumps(found, separators=(",", ":"), allow_nan=False).encode()
        self._answer(HTTPStatus.OK, body, "application/json")

    def _answer_file(self, path: str) -> None:
        body, kind = _static().get(path, (b"no such page\n", ""))
        self._answer(HTTPStatus.OK if kind else HTTPStatus.NOT_FOUND, body, kind or "text/plain")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)


@cache
def _static() -> dict[str, tuple[bytes, str]]:
    """Contents and types of the page's files, by path."""
    found = {"/plotly.js": (get_plotlyjs().encode(), _TYPES[".js"])}
    for file in (files("socket_testbed") / "pages" / "static").iterdir():
        kind = _TYPES[os.path.splitext(file.name)[1]]  # noqa: PTH122 - no path in a zip file
        found[f"/{file.name}"] = (file.read_bytes(), kind)
    return found | {"/": found["/live.html"]}


def is_local(host: str) -> bool:
    """Whether a host is reachable only from this machine."""
    address = _address(host)
    return address is not None and address.is_loopback


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address or name of this machine.

    Args:
        host: The address or name; `0.0.0.0` for all addresses.
        port: The port, 0 to 65535; 0 for any free one.

    Raises:
        ConfigurationError: The address is unknown or of another machine, or the port is taken.
    """
    check_number(port, "the port of the page", 0, 65535)
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
    try:
        return ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return None


def _bracketed(name: str) -> str:
    """A name or address in URL notation."""
    return f"[{name}]" if ":" in name else name
