"""`view`: see the running testbed in a browser."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

from socket_testbed.errors import ConfigurationError
from socket_testbed.settings.testbed import ViewSettings


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("--geometry", type=Path, metavar="SOCKET.yaml", help="the socket")
    parser.add_argument(
        "--namespace", default="/", metavar="NAME", help="namespace of the testbed (default: /)"
    )
    add_page(parser)
    parser.set_defaults(run=run)


def add_page(parser: argparse.ArgumentParser) -> None:
    """Where the page is served, and to whom."""
    defaults = ViewSettings()
    parser.add_argument(
        "--host", default=defaults.host, metavar="ADDRESS",
        help="serve the page on this address of the machine, 0.0.0.0 for all of them"
        f" (default: {defaults.host}, which only this machine sees)",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=defaults.port, metavar="N",
        help=f"port of the page, 0 for one that is free (default: {defaults.port})",
    )  # fmt: skip


def page_settings(options: argparse.Namespace) -> ViewSettings:
    """The settings of the page.

    Raises:
        ConfigurationError: If a setting is wrong, or what serves the page is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise ConfigurationError(
            "viser, which serves the page, is not installed", "pip install 'socket_testbed[view]'"
        )
    geometry = str(options.geometry.resolve()) if options.geometry else ""
    return ViewSettings(geometry=geometry, host=options.host, port=options.port)


def run(options: argparse.Namespace) -> None:
    """Serve the page until interrupted."""
    from socket_testbed.live.processes import Graph

    settings = page_settings(options)
    with Graph() as graph:
        graph.start("view_node", settings, namespace=f"/{options.namespace.strip('/')}")
        print("Ctrl-C ends it", file=sys.stderr)
        try:
            graph.wait("view_node")
        except KeyboardInterrupt:
            graph.stop()
