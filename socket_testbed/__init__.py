"""Software of an instrumented prosthetic-socket testbed.

The public names, such as `socket_testbed.fit`, are those of `socket_testbed.api`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    # From the modules that define them: api.compare is a module, and the name of a function.
    from socket_testbed.api.compare import compare, write_comparison
    from socket_testbed.api.cycles import cycles
    from socket_testbed.api.design import calibrate, register, tile
    from socket_testbed.api.maps import force_map
    from socket_testbed.api.models import (
        evaluate,
        export,
        fit,
        pareto,
        predict,
        read_model,
        write_report,
    )
    from socket_testbed.api.paper import paper
    from socket_testbed.api.pressure import pressure
    from socket_testbed.api.trials import annotate, open_trial, select_segment, simulate
    from socket_testbed.api.validation import validate
    from socket_testbed.api.view import view
    from socket_testbed.errors import TestbedError

__all__ = [
    "TestbedError",
    "__version__",
    "annotate",
    "calibrate",
    "compare",
    "cycles",
    "evaluate",
    "export",
    "fit",
    "force_map",
    "open_trial",
    "paper",
    "pareto",
    "predict",
    "pressure",
    "read_model",
    "register",
    "select_segment",
    "simulate",
    "tile",
    "validate",
    "view",
    "write_comparison",
    "write_report",
]


def __getattr__(name: str) -> Any:
    # Importing the package stays light: its libraries come with the first name that needs them.
    if name in __all__:
        return getattr(import_module("socket_testbed.api"), name)
    raise AttributeError(f"module 'socket_testbed' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
