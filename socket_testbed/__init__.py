"""Software of an instrumented prosthetic-socket testbed.

The public names, such as `socket_testbed.fit`, are listed in `socket_testbed.api`.
"""

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from socket_testbed.version import __version__ as __version__

if TYPE_CHECKING:
    from socket_testbed.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    # Heavy libraries are imported with the first name that needs them.
    if name == "__all__":
        return [*_public()]
    if not name.startswith("_") and find_spec(f"socket_testbed.{name}") is None:
        found = _public().get(name)
        if found is not None:
            return found
    raise AttributeError(f"module 'socket_testbed' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(["__version__", *_public()])


def _public() -> dict[str, Any]:
    """The names listed in the API, without its submodules."""
    names = vars(import_module("socket_testbed.api")).items()
    return {k: v for k, v in names if k[0] != "_" and not isinstance(v, ModuleType)}
