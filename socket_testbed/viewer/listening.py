"""Where the page is served: addresses of this machine, and its port."""

from __future__ import annotations

import os
import socket
from ipaddress import ip_address

from socket_testbed.errors import ConfigurationError


def is_local(host: str) -> bool:
    """Whether a server that listens here is reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def is_any(host: str) -> bool:
    """Whether a server that listens here is reached by every address of this machine."""
    try:
        return ip_address(host).is_unspecified
    except ValueError:
        return False


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Args:
        host: Address or name of this machine.
        port: The port; 0 for one that is free.

    Raises:
        ConfigurationError: If the address is not one of this machine, or the port is taken.
    """
    try:
        family, *_, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        unknown = isinstance(error, socket.gaierror)
        reason = error.strerror if unknown else os.strerror(error.errno or 0)
        raise ConfigurationError(
            f"the page cannot listen on {host}:{port} ({reason})",
            "give another port, or an address of this machine",
        ) from None
