"""`view`: see the running testbed, or a trial, in a browser."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from socket_testbed import api
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import open_given
from socket_testbed.commands.terminal import say
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError
from socket_testbed.live.processes import Graph
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.trials.reprocess import RECORDED

_LOOK = 0.2  # [s]; between looks at the time


@takes("commands.options.open_given", "view", without="unloaded names")
def view(
    trial: Path | None = None,
    *,
    namespace: str | None = None,
    duration: float | None = None,
    host: str = ViewSettings.host,
    port: int = ViewSettings.port,
    allow_host: Iterable[str] = (),
    buttons: bool = False,
    model: Path | None = None,
    **options: Any,
) -> None:
    """See the running testbed, or play a trial, in a browser: pressure map, wrench, sensors.

    Args:
        trial: Folder of a trial to play; without one the running testbed is seen.
        namespace: Namespace of the running testbed (default: /).
        duration: End by itself after so many seconds [s].
        allow_host: As `names` in `view`.
        model: A model that 'fit' wrote, to show the wrench that it predicts.
        buttons: Allow the buttons (tare, record, ...) even where other machines see the page.
    """
    if duration is not None:
        check_number(duration, "--duration", 0.1, 1e6)
    ends = time.monotonic() + (duration or math.inf)
    served: dict[str, Any] = {"host": host, "port": port, "names": tuple(allow_host)}
    if trial is None:
        options["model"] = model
        _follow(ViewSettings(**served, buttons=buttons), namespace, ends, options)
        return
    if namespace is not None:
        raise ConfigurationError("--namespace is for the running testbed", "leave out the trial")
    with api.view(open_given(trial, **options), model, **served) as page:
        say(f"the trial is seen at {page.url}; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            while time.monotonic() < ends:
                time.sleep(_LOOK)


def check_page(settings: ViewSettings) -> None:
    """Refuse a page that cannot be served, before any node starts."""
    from socket_testbed.pages.server import listen

    listen(settings.host, settings.port).close()


def _follow(
    settings: ViewSettings, namespace: str | None, ends: float, options: Mapping[str, Any]
) -> None:
    """Serve the page of the running testbed until a time [s]."""
    for name in ("model", "calibration", "load_cell", "tare"):
        if options[name] not in (None, RECORDED):
            option = name.replace("_", "-")
            raise ConfigurationError(f"--{option} is for a trial", "give the folder of the trial")
    if options["geometry"] is not None:
        settings = dataclasses.replace(settings, geometry=str(options["geometry"].resolve()))
    check_page(settings)
    with Graph() as graph:
        graph.start("view_node", settings, namespace=f"/{(namespace or '').strip('/')}")
        say("Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            graph.watch(lambda: time.monotonic() >= ends, say)
