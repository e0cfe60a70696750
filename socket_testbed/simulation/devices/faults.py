"""The faults that the simulated hardware can be given, each by a number: 0 is off."""

from __future__ import annotations

FAULTS = {
    "trigger.missing": "the pulse makes no edge",
    "trigger.late": "the edge comes so much later [s]",
    "clusters.unplugged": "the bus is gone: every transfer fails with ENODEV",
    "clusters.nack": "1 + the multiplexer channel whose chip does not answer (EREMOTEIO)",
    "clusters.timeout": "every transfer times out (ETIMEDOUT) after so long [s]",
    "clusters.stuck_done": "1 + the channel whose chip converts no more, until it is reset",
    "clusters.rail": "1 + the channel whose chip reads full scale on all inputs",
    "clusters.shifted": "1 + the channel whose chip shifts its inputs by one, until it is reset",
    "clusters.brown_out": "1 + the channel whose chip resets itself, again and again",
    "load_cell.unplugged": "the chip is gone: every byte reads 0x00",
    "load_cell.flipped_bits": "probability that a frame has a flipped bit [-]",
    "load_cell.rail": "1 + the input that is at a rail: a broken wire",
    "load_cell.brown_out": "the chip falls back to its reset state every so often [s]",
    "load_cell.frozen": "the chip converts no more, DRDY stays high",
    "mocap.unplugged": "the network is down: nothing goes out or comes in",
    "mocap.drop": "probability that a datagram is dropped [-]",
    "mocap.truncate": "probability that a datagram is cut somewhere [-]",
    "mocap.duplicate": "probability that a datagram comes twice [-]",
    "mocap.reorder": "probability that a datagram comes after the next one [-]",
    "mocap.corrupt": "probability that a datagram's counts lie [-]",
    "mocap.restart": "each new number restarts the server: clients forgotten, another clock",
    "mocap.occlude": "1 + the marker that is occluded on both bodies",
    "mocap.swap": "probability that two labels of a body are swapped in a frame [-]",
    "clock.step": "the system clock is off by so much [s]",
}
