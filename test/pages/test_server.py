"""The page's server answers its own page alone, and nothing that it is sent ends it."""

import http.client
import json
import socket
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


def test_the_page_is_served_by_its_own_names(server: PageServer) -> None:
    for name in ("127.0.0.1", "LocalHost", "lab-pi.example.org"):
        host = name + ":{port}"
        assert answer(server, Host=host)[0] == 200
        assert answer(server, Host=host, Origin=f"http://{host.lower()}")[0] == 200
    _, headers, text = answer(server)
    policy = headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "*" not in policy and b"http" not in text
    assert answer(server, "/live.js")[0] == 200
    assert answer(server, "/../server.py")[0] == answer(server, "/etc/passwd")[0] == 404


def test_requests_of_other_sites_are_refused(server: PageServer) -> None:
    own = "127.0.0.1:{port}"
    for headers in (
        {"Host": "attacker.example:{port}"},  # a name that was made to point to this machine
        {"Host": "127.0.0.1"},  # another port
        {"Host": "10.1.2.3:{port}"},  # it did not arrive there
        {"Host": own, "Origin": "http://attacker.example"},
        {"Host": own, "Origin": "http://127.0.0.1:1"},  # another program's page
        {"Host": own, "Origin": f"https://{own}"},
        {"Host": own, "Origin": "null"},  # a file, or a page in a sandbox
    ):
        for path, method, body in (("/", "GET", None), ("/do", "POST", b'{"do": "fit"}')):
            assert answer(server, path, method, body, **headers)[0] == 403, headers


def test_the_source_is_asked_and_buttons_say_what_came_of_them(server: PageServer) -> None:
    assert json.loads(answer(server, "/start")[2]) == {"title": "still"}
    assert json.loads(answer(server, "/now")[2]) == {"asked": None}
    assert json.loads(answer(server, "/now?t=7.5")[2]) == {"asked": 7.5}
    for given, expected in (
        ({"do": "mark", "label": "step"}, {"said": "mark {'label': 'step'}"}),
        ({"do": "tare"}, {"said": "the load cell is loaded: take the limb out", "failed": True}),
    ):
        status, _, text = answer(server, "/do", "POST", json.dumps(given).encode())
        assert (status, json.loads(text)) == (200, expected)
    with socket.create_connection(("127.0.0.1", port_of(server))) as slow:  # reads no further
        slow.sendall(b"GET /now?t=8 HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n" % port_of(server))
        assert slow.recv(1) and not server.asking.locked()
    # Nonsense is refused, and the page goes on.
    assert answer(server, "/now?t=soon")[0] == answer(server, "/now?t=nan")[0] == 400
    for body in (b"", b"tare", b"[]", b"{}", b"7", b"\xff", b'{"do"'):
        assert answer(server, "/do", "POST", body)[0] == 400, body
    assert answer(server, "/do", "POST")[0] == 400
    assert answer(server, "/do", "PUT", b"{}")[0] == 501
    assert answer(server)[0] == 200


def test_it_is_found_where_it_listens_if_the_address_is_free(server: PageServer) -> None:
    for host, port, why in (("127.0.0.1", port_of(server), "in use"), ("192.0.2.1", 0, "")):
        with refused(ConfigurationError, f"cannot listen on {host}:{port}", why):
            PageServer(Still(), host, port)
    for host in ("127.0.0.1", "localhost", "0.0.0.0"):
        found = PageServer(Still(), host, 0)
        assert found.url.startswith("http://") and "0.0.0.0" not in found.url
        # Served to all, it is found by the address that a request arrives at.
        assert answer(found, Host="127.0.0.1:{port}")[0] == 200
        assert answer(found, Host="127.0.0.2:{port}")[0] == 403
        found.close()
