"""Messages of any type with random content, and what is in them, by the bag library."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from socket_testbed.wire.cdr import fields_of, typestore


class Maker:
    """Messages of any type with random numbers; strings and sequences as long as a seed says."""

    def __init__(self, lengths: int, numbers: int) -> None:
        self._lengths = np.random.default_rng(lengths)
        self._numbers = np.random.default_rng(numbers)

    def message(self, name: str) -> Any:
        own = {}
        for field in fields_of(name):
            number = self._lengths.integers(4) if field.number == 0 else field.number
            if number is None:
                own[field.name] = self.one(field.type)
            else:
                many = [self.one(field.type) for _ in range(number)]
                scalar = field.type != "string" and "/" not in field.type
                kind = {"byte": "int8", "char": "uint8"}.get(field.type, field.type)
                own[field.name] = np.array(many, dtype=kind) if scalar else many
        return typestore().types[name](**own)

    def one(self, kind: str) -> Any:
        if kind == "string":
            return "".join(self._lengths.choice(list("abä_"), self._lengths.integers(9)))
        if kind.startswith("float"):
            return float(np.float32(self._numbers.normal()))
        if "/" in kind:
            return self.message(kind)
        return int(self._numbers.integers(2 if kind == "bool" else 100))


def encode(message: Any, kind: str, little: bool) -> bytes:
    return bytes(typestore().serialize_cdr(message, kind, little_endian=little))


def numbers_of(message: Any, kind: str) -> list[float]:
    """All numbers of a message in the order of its fields, strings left out."""
    return [value for value in _values(message, kind) if isinstance(value, float)]


def strings_of(message: Any, kind: str) -> list[Any]:
    """All strings of a message and the lengths of its sequences, in the order of its fields."""
    return [value for value in _values(message, kind) if not isinstance(value, float)]


def _values(message: Any, kind: str) -> Iterator[float | str | int]:
    """All numbers as floats, all strings, and the lengths of sequences."""
    for field in fields_of(kind):
        value = getattr(message, field.name)
        if field.number is not None:
            yield len(value)
        for one in [value] if field.number is None else value:
            if "/" in field.type:
                yield from _values(one, field.type)
            else:
                yield one if field.type == "string" else float(one)
