"""Software of an instrumented prosthetic-socket testbed.

The public names, such as `socket_testbed.fit`, are those of `socket_testbed.api`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from socket_testbed.api import (
        TestbedError,
        annotate,
        calibrate,
        compare,
        cycles,
        evaluate,
        export,
        fit,
        force_map,
        open_trial,
        pareto,
        predict,
        pressure,
        read_model,
        register,
        select_segment,
        simulate,
        tile,
        validate,
        view,
        write_comparison,
        write_report,
    )

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
