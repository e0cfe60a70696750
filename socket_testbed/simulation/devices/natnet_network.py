"""A network that loses, cuts, repeats, reorders and corrupts what it is given."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from socket_testbed.simulation.devices.natnet_encoding import Message


class FaultyNetwork:
    """Sends datagrams of a socket, with the faults that are on.

    Args:
        udp: The socket.
        faults: The faults `mocap.*`, looked up live.
        rng: Source of what is random.
    """

    def __init__(
        self, udp: socket.socket, faults: Mapping[str, float], rng: np.random.Generator
    ) -> None:
        self._socket = udp
        self._faults = faults
        self._rng = rng
        self._held: list[tuple[bytes, tuple[str, int]]] = []

    def send(self, message: Message, address: tuple[str, int]) -> None:
        """Send a message, or what becomes of it."""
        if self._faults.get("mocap.unplugged", 0.0):
            self._held.clear()
            return
        if self._happens("drop"):
            return
        data = message.lying(self._rng) if self._happens("corrupt") else bytes(message.data)
        if self._happens("truncate"):
            data = data[: int(self._rng.integers(len(data)))]
        if not self._held and self._happens("reorder"):
            self._held.append((data, address))
            return
        self._put(data, address)
        if self._happens("duplicate"):
            self._put(data, address)
        held, self._held = self._held, []
        for late in held:
            self._put(*late)

    def _happens(self, fault: str) -> bool:
        probability = self._faults.get(f"mocap.{fault}", 0.0)
        return bool(probability) and self._rng.random() < probability

    def _put(self, data: bytes, address: tuple[str, int]) -> None:
        with suppress(OSError):  # a client that is gone, a buffer that is full
            self._socket.sendto(data, address)
