"""TI TCA9548A: one I2C bus to one of eight."""

from __future__ import annotations

from socket_testbed.drivers.clusters.i2c import I2cPort


class Multiplexer:
    """The multiplexer, which connects one channel or none.

    Its chips share one address: two channels at once would put them on the same wires.
    """

    def __init__(self, port: I2cPort) -> None:
        self._port = port

    def select(self, channel: int) -> None:
        """Connect one channel, 0..7 [1], and it alone.

        It is always written: after a brown-out a remembered selection would be wrong.

        Raises:
            BusError: If the multiplexer does not take it.
        """
        self._port.write_byte(1 << channel)

    def off(self) -> None:
        """Connect no channel.

        Raises:
            BusError: If the multiplexer does not take it.
        """
        self._port.write_byte(0)
