"""A trial in a browser: played, paused, sought."""

from __future__ import annotations

from typing import TYPE_CHECKING

from socket_testbed.api.models import Model, model_for
from socket_testbed.api.trials import PathLike, as_trial
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from socket_testbed.pages.server import PageServer


def view(
    trial: Trial | PathLike,
    model: Model | None = None,
    *,
    port: int = 0,
    host: str = "127.0.0.1",
    names: tuple[str, ...] = (),
) -> PageServer:
    """Show a trial in a browser: play, pause, seek; the pressure on the socket at every instant.

    It opens at the peak. The map and the outputs by region are computed for the instant that is
    drawn. Nothing is written.

    Args:
        trial: The trial.
        model: A fit, a model that `read_model` read, or the path of its file, to show the wrench
            that it predicts.
        port: Port of the page; 0 for one that is free.
        host: Address of this machine that serves the page, `0.0.0.0` for all of them; only this
            machine sees the page at `127.0.0.1`.
        names: Further names of this machine by which browsers may call the page.

    Returns:
        The page: a context manager with its `url`, served until `close`, or until the program ends.

    Raises:
        ConfigurationError: If the port is taken, or the model was fitted on another socket.
        IdentificationError: If the limb positions are in another unit or frame.
        TrialError: If the trial cannot be read.

    >>> with st.view(st.open_trial("trials/hold")) as page:
    ...     print(page.url)
    http://127.0.0.1:...
    """
    trial = as_trial(trial)
    from socket_testbed.pages.player import Player
    from socket_testbed.pages.server import PageServer

    player = Player(trial, None if model is None else model_for(trial, model))
    return PageServer(player, host, port, names)
