"""The page: its scene and its panel, drawn again and again while a browser is open."""

from __future__ import annotations

import threading
import time

from viser import ClientHandle

from socket_testbed.viewer.legend import Legend
from socket_testbed.viewer.panel import Panel
from socket_testbed.viewer.scene import Scene
from socket_testbed.viewer.server import PageServer
from socket_testbed.viewer.source import Source

_PERIOD = 0.055  # [s]; between frames


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
        server.viser.on_client_connect(self._on_change)
        server.viser.on_client_disconnect(self._on_change)

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

    def _on_change(self, client: ClientHandle) -> None:
        del client
        self._changed.set()

    def _run(self) -> None:
        while not self._closed:
            self._changed.wait()
            self._changed.clear()
            if not self._server.viser.get_clients():
                continue
            self._source.watched(True)
            self._draw_on()
            self._source.watched(False)

    def _draw_on(self) -> None:
        due = time.monotonic()
        while not self._closed and self._server.viser.get_clients():
            self.draw()
            due = max(due + _PERIOD, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
