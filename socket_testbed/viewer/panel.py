"""What is beside the scene: plots, regions, sensors and buttons."""

from __future__ import annotations

from viser import ViserServer

from socket_testbed.viewer.source import Source


class Panel:
    """The panel of a page.

    Args:
        server: Serves the page.
        source: What is shown.
    """

    def __init__(self, server: ViserServer, source: Source) -> None:
        del server, source

    def update(self, source: Source) -> None:
        """Show how the source is now; called for every frame that is drawn."""
