"""The page's server answers its own page alone, and nothing that it is sent ends it."""

import http.client
import json
import re
import socket
import struct
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from support import HANGS
from support.wording import refused

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.pages.server import PageServer


class Still:
    """A source that says what it was asked."""

    def start(self) -> dict[str, Any]:
        return {"title": "still"}

    def now(self, time: float | None) -> dict[str, Any]:
        return {"asked": time, **({"long": "x" * 2**23} if time == 8.0 else {})}

    def act(self, what: str, given: dict[str, Any]) -> str:
        if what == "tare":
            raise TestbedError("the load cell is loaded", "take the limb out")
        return f"{what} {given}"


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    found = PageServer(Still(), "127.0.0.1", 0, ("lab-pi.example.org",))
    yield found
    found.close()


def port_of(server: PageServer) -> int:
    return int(server.url.rpartition(":")[2])


def answer(
    server: PageServer, path: str = "/", method: str = "GET", body: Any = None, **headers: str
) -> tuple[int, Any, Any]:
    """Status, headers and body of the answer to a request."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(server), timeout=HANGS)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value.format(port=port_of(server)))
    if body is not None:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body)
    found = connection.getresponse()
    text = found.read()
    connection.close()
    return found.status, found.headers, text


@pytest.mark.parametrize("path", ["/start", "/plotly.js"], ids=["waiting", "reading"])
def test_a_browser_that_goes_is_no_error(
    path: str, server: PageServer, capfd: pytest.CaptureFixture[str]
) -> None:
    """A closed tab resets its connection; the terminal belongs to the status of the graph."""
    address = server.socket.getsockname()
    with socket.create_connection(address) as tab:
        tab.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        tab.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost:{address[1]}\r\n\r\n".encode())
        tab.recv(1)
    for thread in threading.enumerate():
        if "process_request" in thread.name:
            thread.join(HANGS)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["127.0.0.1", "LocalHost", "lab-pi.example.org"])
def test_the_page_is_served_by_its_own_names(name: str, server: PageServer) -> None:
    host = name + ":{port}"
    assert answer(server, Host=host)[0] == 200
    assert answer(server, Host=host, Origin=f"http://{host.lower()}")[0] == 200


def test_the_page_loads_nothing_from_elsewhere(server: PageServer) -> None:
    _, headers, text = answer(server)
    policy = headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "*" not in policy and b"http" not in text


def test_all_that_the_page_loads_is_served(server: PageServer) -> None:
    page = answer(server)[2].decode()
    loaded = re.findall(r'<(?:script src|link rel="stylesheet" href)="([^"]+)"', page)
    assert loaded == ["page.css", "plotly.js", "socket.js", "live.js"]
    kinds = {"css": "text/css", "js": "text/javascript"}
    for name in loaded:
        status, headers, text = answer(server, f"/{name}")
        assert status == 200 and text
        assert headers["Content-Type"].startswith(kinds[name.rpartition(".")[2]])


def test_the_page_s_script_is_served(server: PageServer) -> None:
    assert answer(server, "/live.js")[0] == 200


@pytest.mark.parametrize("path", ["/../server.py", "/etc/passwd"])
def test_no_other_file_is_served(path: str, server: PageServer) -> None:
    assert answer(server, path)[0] == 404


OWN = "127.0.0.1:{port}"
FOREIGN = {
    "name made to point here": {"Host": "attacker.example:{port}"},
    "other port": {"Host": "127.0.0.1"},
    "other address": {"Host": "10.1.2.3:{port}"},  # it did not arrive there
    "other site's page": {"Host": OWN, "Origin": "http://attacker.example"},
    "other program's page": {"Host": OWN, "Origin": "http://127.0.0.1:1"},
    "other scheme": {"Host": OWN, "Origin": f"https://{OWN}"},
    "file or sandbox": {"Host": OWN, "Origin": "null"},
}


@pytest.mark.parametrize(
    ("path", "method", "body"),
    [("/", "GET", None), ("/do", "POST", b'{"do": "fit"}')],
    ids=["page", "button"],
)
@pytest.mark.parametrize("site", FOREIGN)
def test_requests_of_other_sites_are_refused(
    site: str, path: str, method: str, body: bytes | None, server: PageServer
) -> None:
    assert answer(server, path, method, body, **FOREIGN[site])[0] == 403


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/start", {"title": "still"}),
        ("/now", {"asked": None}),
        ("/now?t=7.5", {"asked": 7.5}),
    ],
    ids=["start", "now", "instant"],
)
def test_the_source_is_asked(path: str, expected: dict[str, Any], server: PageServer) -> None:
    assert json.loads(answer(server, path)[2]) == expected


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"do": "mark", "label": "step"}, {"said": "mark {'label': 'step'}"}),
        ({"do": "tare"}, {"said": "the load cell is loaded: take the limb out", "failed": True}),
    ],
    ids=["done", "failed"],
)
def test_a_button_states_what_came_of_it(
    given: dict[str, str], expected: dict[str, Any], server: PageServer
) -> None:
    status, _, text = answer(server, "/do", "POST", json.dumps(given).encode())
    assert (status, json.loads(text)) == (200, expected)


def test_a_slow_reader_holds_nobody_up(server: PageServer) -> None:
    with socket.create_connection(("127.0.0.1", port_of(server))) as slow:  # reads no further
        slow.sendall(b"GET /now?t=8 HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n" % port_of(server))
        assert slow.recv(1) and not server.asking.locked()
    assert answer(server)[0] == 200


@pytest.mark.parametrize("time", ["soon", "nan", "inf"])
def test_an_instant_that_is_no_number_is_refused(time: str, server: PageServer) -> None:
    assert answer(server, f"/now?t={time}")[0] == 400


@pytest.mark.parametrize(
    "body",
    [b"", b"tare", b"[]", b"{}", b"7", b"\xff", b'{"do"', None],
    ids=["empty", "word", "list", "no button", "number", "no text", "cut", "none"],
)
def test_nonsense_is_refused(body: bytes | None, server: PageServer) -> None:
    """And the page goes on."""
    assert answer(server, "/do", "POST", body)[0] == 400
    assert answer(server)[0] == 200


def test_another_method_is_refused(server: PageServer) -> None:
    assert answer(server, "/do", "PUT", b"{}")[0] == 501
    assert answer(server)[0] == 200


def test_a_taken_port_is_refused(server: PageServer) -> None:
    port = port_of(server)
    with refused(ConfigurationError, f"cannot listen on 127.0.0.1:{port}", "in use"):
        PageServer(Still(), "127.0.0.1", port)


def test_another_machine_s_address_is_refused() -> None:
    with refused(ConfigurationError, "cannot listen on 192.0.2.1:0"):
        PageServer(Still(), "192.0.2.1", 0)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "0.0.0.0"])
def test_a_server_is_found_where_it_listens(host: str) -> None:
    """Served to all, it is found by the address that a request arrives at."""
    found = PageServer(Still(), host, 0)
    assert found.url.startswith("http://") and "0.0.0.0" not in found.url
    assert answer(found, Host="127.0.0.1:{port}")[0] == 200
    assert answer(found, Host="127.0.0.2:{port}")[0] == 403
    found.close()
