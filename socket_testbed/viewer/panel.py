"""What is beside the scene: plots, regions, sensors and buttons."""

from __future__ import annotations

from viser import ViserServer

from socket_testbed.viewer.playback_panel import PlaybackPanel
from socket_testbed.viewer.source import Source


class Panel:
    """The panel of a page.

    Args:
        server: Serves the page.
        source: What is shown.
    """

    def __init__(self, server: ViserServer, source: Source) -> None:
        playback = source.playback
        self._playback = None if playback is None else PlaybackPanel(server, playback)

    def update(self, source: Source) -> None:
        """Show how the source is now; called for every frame that is drawn."""
        if self._playback is not None:
            self._playback.update()
