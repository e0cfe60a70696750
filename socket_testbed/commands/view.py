"""`view`: see the running testbed, or a trial, in a browser."""

from __future__ import annotations

import argparse
import math
import time
from contextlib import suppress
from pathlib import Path

from socket_testbed import api
from socket_testbed.api.view import require_viewer
from socket_testbed.commands.options import add_trial, trial_of
from socket_testbed.commands.text import say
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError
from socket_testbed.live.processes import Graph
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.trials.reprocess import RECORDED

_LOOK = 0.2  # [s]; between looks at the time


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser, "folder of a trial to play; without one the running testbed is seen", "?")
    parser.add_argument(
        "--model", type=Path, metavar="MODEL", help="show what it predicts of the trial"
    )
    parser.add_argument("--namespace", metavar="NAME", help="of the running testbed (default: /)")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="end by itself after S seconds [s]"
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
    parser.add_argument(
        "--allow-host", action="append", default=[], metavar="NAME",
        help="a further name of this machine by which browsers may call the page",
    )  # fmt: skip
    parser.add_argument(
        "--buttons", action="store_true",
        help="allow the buttons (tare, record, ...) even where other machines see the page",
    )  # fmt: skip


def page_settings(options: argparse.Namespace) -> ViewSettings:
    """The settings of the page.

    Raises:
        ConfigurationError: If a setting is wrong, or the page cannot be served.
    """
    geometry = str(options.geometry.resolve()) if options.geometry else ""
    settings = ViewSettings(
        geometry=geometry,
        host=options.host,
        port=options.port,
        names=tuple(options.allow_host),
        buttons=options.buttons,
    )
    check_page(settings)
    return settings


def check_page(settings: ViewSettings) -> None:
    """Refuse a page that cannot be served, before any node starts.

    Raises:
        ConfigurationError: If what serves it is not installed, or its port is taken.
    """
    require_viewer()
    from socket_testbed.viewer.page import listen

    listen(settings.host, settings.port).close()


def run(options: argparse.Namespace) -> None:
    """Serve the page until interrupted."""
    if options.duration is not None:
        check_number(options.duration, "--duration", 0.1, 1e6)
    ends = time.monotonic() + (options.duration or math.inf)
    if options.trial is not None:
        _play(options, ends)
    else:
        _follow(options, ends)


def _play(options: argparse.Namespace, ends: float) -> None:
    """Serve the page of a trial until a time [s]."""
    if options.namespace is not None:
        raise ConfigurationError("--namespace is for the running testbed", "leave out the trial")
    page = api.view(
        trial_of(options),
        options.model,
        port=options.port,
        host=options.host,
        names=tuple(options.allow_host),
    )
    with page, suppress(KeyboardInterrupt):
        say(f"the trial is seen at {page.url}; Ctrl-C ends it")
        while time.monotonic() < ends:
            time.sleep(_LOOK)


def _follow(options: argparse.Namespace, ends: float) -> None:
    """Serve the page of the running testbed until a time [s]."""
    for name in ("model", "calibration", "load_cell", "tare"):
        if getattr(options, name) not in (None, RECORDED):
            option = name.replace("_", "-")
            raise ConfigurationError(f"--{option} is for a trial", "give the folder of the trial")
    settings = page_settings(options)
    with Graph() as graph:
        namespace = (options.namespace or "/").strip("/")
        graph.start("view_node", settings, namespace=f"/{namespace}")
        say("Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            graph.watch(lambda: time.monotonic() >= ends, say)
