"""The page's server: who may ask, and that nothing is printed or handed on."""

import http.client
from collections.abc import Iterator
from typing import Any

import pytest
import rich
from viser._messages import ShareUrlRequest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from socket_testbed.errors import ConfigurationError
from socket_testbed.viewer.server import PageServer


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    found = PageServer("127.0.0.1", 0, ("lab-pi.example.org",))
    yield found
    found.close()


def port_of(server: PageServer) -> int:
    return int(server.url.rpartition(":")[2])


def status_of(server: PageServer, headers: dict[str, str]) -> tuple[int, Any]:
    """Status and headers of the answer to a request for the page."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(server), timeout=60)
    connection.putrequest("GET", "/", skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value.format(port=port_of(server)))
    connection.endheaders()
    answer = connection.getresponse()
    connection.close()
    return answer.status, answer.headers


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LocalHost", "lab-pi.example.org"])
def test_the_page_is_served_by_its_own_names(server: PageServer, name: str) -> None:
    host = name + ":{port}"
    assert status_of(server, {"Host": host})[0] == 200
    assert status_of(server, {"Host": host, "Origin": f"http://{host.lower()}"})[0] == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "attacker.example:{port}"},  # a name that was made to point to this machine
        {"Host": "attacker.example"},
        {"Host": "127.0.0.1"},  # another port
        {"Host": "127.0.0.1:1"},
        {"Host": "10.1.2.3:{port}"},  # it did not arrive there
        {"Host": "127.0.0.1:{port}", "Origin": "http://attacker.example"},
        {"Host": "127.0.0.1:{port}", "Origin": "http://127.0.0.1:1"},  # another program's page
        {"Host": "127.0.0.1:{port}", "Origin": "https://127.0.0.1:{port}"},
        {"Host": "127.0.0.1:{port}", "Origin": "null"},  # a file, or a page in a sandbox
    ],
)
def test_requests_of_other_sites_are_refused(server: PageServer, headers: dict[str, str]) -> None:
    assert status_of(server, headers)[0] == 403
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    assert status_of(server, headers | upgrade)[0] == 403


def test_a_websocket_needs_the_same(server: PageServer) -> None:
    url = f"ws://127.0.0.1:{port_of(server)}"
    with pytest.raises(InvalidStatus):
        connect(url, origin="http://attacker.example")  # type: ignore[arg-type]
    connect(url, origin=f"http://127.0.0.1:{port_of(server)}").close()  # type: ignore[arg-type]


def test_the_browser_itself_refuses_what_is_not_of_this_page(server: PageServer) -> None:
    policy = status_of(server, {})[1]["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "http" not in policy and "*" not in policy


def test_nobody_hands_the_page_on(server: PageServer) -> None:
    assert ShareUrlRequest not in server.viser._websock_server._incoming_handlers


def test_a_taken_port_and_a_foreign_address_are_errors(server: PageServer) -> None:
    with pytest.raises(ConfigurationError, match=r"cannot listen on 127\.0\.0\.1:\d+ .*in use"):
        PageServer("127.0.0.1", port_of(server))
    with pytest.raises(ConfigurationError, match="cannot listen"):
        PageServer("192.0.2.1", 0)


def test_it_says_where_it_listens_and_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    for host, local in (("127.0.0.1", True), ("localhost", True), ("0.0.0.0", False)):
        found = PageServer(host, 0)
        assert found.is_local == local
        assert found.url.startswith("http://") and "0.0.0.0" not in found.url
        found.close()
    assert capfd.readouterr() == ("", "")
    assert not rich.get_console().quiet


def test_served_to_all_it_is_found_by_the_address_of_a_request() -> None:
    found = PageServer("0.0.0.0", 0)
    assert status_of(found, {"Host": "127.0.0.1:{port}"})[0] == 200
    assert status_of(found, {"Host": "127.0.0.2:{port}"})[0] == 403
    found.close()
