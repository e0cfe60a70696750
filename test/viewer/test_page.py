"""The page draws while a browser is open, and answers nobody but its own page."""

import http.client
import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import rich
from support import HANGS
from support.sources import NOTHING, StillSource, estimate_of
from support.wording import refused
from viser import __version__ as viser_version
from viser._messages import ShareUrlRequest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from socket_testbed.errors import ConfigurationError
from socket_testbed.viewer.page import Page, PageServer
from socket_testbed.viewer.source import Instant

CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": (1, 0, 0, 0), "position": (1, 0, 0), "fov": 1.0, "near": 0.1, "far": 10.0},
    **{"image_height": 100, "image_width": 100, "look_at": (0, 0, 0), "up_direction": (0, 0, 1)},
}


class Moving(StillSource):
    """A source whose every instant is another."""

    def __init__(self) -> None:
        self.random = np.random.default_rng(1)
        self.drawn = 0
        self.is_watched = threading.Event()
        self.is_alone = threading.Event()
        self.silent = False

    def instant(self) -> Instant:
        self.drawn += 1
        pressure = self.random.uniform(0.0, 20e3, len(self.geometry))
        shown = None if self.silent else estimate_of(pressure, "measured: all")
        return Instant(self.drawn, 0.05 * self.drawn, shown, NOTHING, NOTHING, None, None)

    def watched(self, on: bool) -> None:
        (self.is_watched if on else self.is_alone).set()


@pytest.fixture
def source() -> Moving:
    return Moving()


@pytest.fixture
def page(source: Moving) -> Iterator[Page]:
    page = Page(source, PageServer("127.0.0.1", 0))
    yield page
    page.close()


def browse(page: Page, **options: Any) -> ClientConnection:
    protocol: Any = [f"viser-v{viser_version}"]
    url = page._server.url.replace("http", "ws")
    browser = connect(url, subprotocols=protocol, **options)
    browser.send(msgspec.msgpack.encode(CAMERA))
    return browser


def test_nothing_is_drawn_while_no_browser_is_open(source: Moving, page: Page) -> None:
    assert not source.is_watched.is_set() and source.drawn == 0
    with browse(page):
        assert source.is_watched.wait(HANGS)
        assert not source.is_alone.is_set()
    assert source.is_alone.wait(HANGS)
    drawn = source.drawn
    source.is_watched.clear()
    with browse(page):  # it comes back
        assert source.is_watched.wait(HANGS)
        while source.drawn == drawn:
            pass


def test_a_browser_that_reads_nothing_makes_no_queue(source: Moving, page: Page) -> None:
    def buffered() -> int:
        return len(page._server.viser._websock_server._broadcast_buffer.message_from_id)

    for _ in range(5):
        page.draw()
    before = buffered()
    # It takes no more than the network's own buffers hold, until it reads.
    with browse(page, max_queue=1) as browser:
        assert source.is_watched.wait(HANGS)
        for _ in range(500):
            page.draw()
        assert buffered() <= before + 5
        assert len(browser.recv(HANGS)) > 0


def test_an_estimator_that_is_silent_leaves_no_map(source: Moving, page: Page) -> None:
    page.draw()
    assert page._scene._pictures[0]._values.batched_scales.max() > 0.0
    source.silent = True
    page.draw()
    assert page._scene._pictures[0]._values.batched_scales.max() == 0.0
    assert "no force map" in page._legend._words.content


# --- who may ask


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    found = PageServer("127.0.0.1", 0, ("lab-pi.example.org",))
    yield found
    found.close()


def port_of(server: PageServer) -> int:
    return int(server.url.rpartition(":")[2])


def status_of(server: PageServer, headers: dict[str, str]) -> tuple[int, Any]:
    """Status and headers of the answer to a request for the page."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(server), timeout=HANGS)
    connection.putrequest("GET", "/", skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value.format(port=port_of(server)))
    connection.endheaders()
    answer = connection.getresponse()
    connection.close()
    return answer.status, answer.headers


def test_the_page_is_served_by_its_own_names(server: PageServer) -> None:
    for name in ("127.0.0.1", "localhost", "LocalHost", "lab-pi.example.org"):
        host = name + ":{port}"
        assert status_of(server, {"Host": host})[0] == 200
        assert status_of(server, {"Host": host, "Origin": f"http://{host.lower()}"})[0] == 200
    policy = status_of(server, {})[1]["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "http" not in policy and "*" not in policy


def test_requests_of_other_sites_are_refused(server: PageServer) -> None:
    upgrade = {
        **{"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"},
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    own = "127.0.0.1:{port}"
    for headers in (
        {"Host": "attacker.example:{port}"},  # a name that was made to point to this machine
        {"Host": "attacker.example"},
        {"Host": "127.0.0.1"},  # another port
        {"Host": "127.0.0.1:1"},
        {"Host": "10.1.2.3:{port}"},  # it did not arrive there
        {"Host": own, "Origin": "http://attacker.example"},
        {"Host": own, "Origin": "http://127.0.0.1:1"},  # another program's page
        {"Host": own, "Origin": f"https://{own}"},
        {"Host": own, "Origin": "null"},  # a file, or a page in a sandbox
    ):
        assert status_of(server, headers)[0] == 403, headers
        assert status_of(server, headers | upgrade)[0] == 403, headers
    url = f"ws://127.0.0.1:{port_of(server)}"
    with pytest.raises(InvalidStatus):
        connect(url, origin="http://attacker.example")  # type: ignore[arg-type]
    connect(url, origin=f"http://127.0.0.1:{port_of(server)}").close()  # type: ignore[arg-type]
    assert ShareUrlRequest not in server.viser._websock_server._incoming_handlers


def test_a_taken_port_and_a_foreign_address_are_errors(server: PageServer) -> None:
    for host, port, why in (("127.0.0.1", port_of(server), "in use"), ("192.0.2.1", 0, "")):
        with refused(ConfigurationError, f"cannot listen on {host}:{port}", why):
            PageServer(host, port)


def test_it_knows_where_it_listens_and_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    for host, local in (("127.0.0.1", True), ("localhost", True), ("0.0.0.0", False)):
        found = PageServer(host, 0)
        assert found.is_local == local
        assert found.url.startswith("http://") and "0.0.0.0" not in found.url
        # Served to all, it is found by the address that a request arrives at.
        assert status_of(found, {"Host": "127.0.0.1:{port}"})[0] == 200
        assert status_of(found, {"Host": "127.0.0.2:{port}"})[0] == 403
        found.close()
    assert capfd.readouterr() == ("", "")
    assert not rich.get_console().quiet
