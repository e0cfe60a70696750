"""The checksums that the load cell's converter can be told to use."""

from __future__ import annotations

import binascii


def _ansi_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        remainder = value << 8
        for _ in range(8):
            remainder = (remainder << 1) ^ (0x8005 if remainder & 0x8000 else 0)
        table.append(remainder & 0xFFFF)
    return tuple(table)


_ANSI_TABLE = _ansi_table()


def checksum(data: bytes, crc: str) -> int:
    """CRC-16 from 0xFFFF, not reflected: 'ccitt' (0x1021) or 'ansi' (0x8005)."""
    if crc == "ccitt":
        return binascii.crc_hqx(data, 0xFFFF)
    remainder = 0xFFFF
    for byte in data:
        remainder = ((remainder << 8) & 0xFFFF) ^ _ANSI_TABLE[(remainder >> 8) ^ byte]
    return remainder
