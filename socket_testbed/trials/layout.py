"""Message types and layouts: where the numbers of a serialised message are, as a numpy type.

Messages of one type whose strings and sequences are as long as each other's have every number at
the same byte. A `Layout` is found from one such message; it then reads any number of them at once
without building message objects. Whether a message has the layout is checked byte by byte: all that
is neither number nor alignment has to be as in the sample.

The types are those of the rosbags library and this testbed's. The encoding is plain CDR, big or
little endian (OMG formal/02-06-51, 15.3): every number is aligned to its size, counted from behind
the four bytes of the encapsulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import compress
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from socket_testbed.arrays import BoolArray, IntArray
from socket_testbed.files import packaged

Record: TypeAlias = NDArray[np.void]

_HEADER = 4  # [bytes] of the encapsulation: two of its kind, two of options
_PADDING = 3  # [bytes] that may follow a message
_NUMBERS = {
    **{name: name for name in ("int8", "int16", "int32", "int64", "float32", "float64")},
    **{name: name for name in ("uint8", "uint16", "uint32", "uint64", "bool")},
    **{"byte": "int8", "char": "uint8"},
}


@cache
def typestore() -> Typestore:
    """The types of ROS 2 Jazzy and of this testbed."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in packaged("msg", "Trigger.msg").parent.glob("*.msg"):
        text = path.read_text(encoding="utf-8")
        types |= get_types_from_msg(text, f"socket_testbed_msgs/msg/{path.stem}")
    store.register(types)
    return store


def message_class(name: str) -> Any:
    """The class of a message type, given as `package/msg/Type`."""
    return typestore().types[name]


def decode(raw: bytes | memoryview, message_type: str) -> Any:
    """A message from its serialised bytes."""
    return typestore().deserialize_cdr(raw, message_type)


def encode(message: Any, message_type: str) -> bytes:
    """The serialised bytes of a message."""
    return bytes(typestore().serialize_cdr(message, message_type))


def stamp_of(message: Any) -> int:
    """Stamp of a message's header since the epoch [ns]."""
    return nanoseconds(message.header.stamp)


def nanoseconds(time: Any) -> int:
    """A builtin_interfaces/Time, the library's or ROS's, since the epoch [ns]."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


class Field(NamedTuple):
    """A field of a message type."""

    name: str
    type: str  # a number such as `float64`, `string`, or a message type
    number: int | None = None  # how many; 0 for a sequence of any length; None for one


@cache
def fields_of(message_type: str) -> tuple[Field, ...]:
    """The fields of a message type, given as `package/msg/Type`."""
    return tuple(_field(*field) for field in typestore().get_msgdef(message_type).fields)


def _field(name: str, described: Any, number: int | None = None) -> Field:
    """A field as the library describes it: by its kind, and what that takes."""
    kind, content = described
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        element, bound = content
        return _field(name, element, bound if kind == Nodetype.ARRAY else 0)
    return Field(name, content[0] if kind == Nodetype.BASE else content, number)


def make_message(message_type: str, **given: Any) -> Any:
    """A message with some of its fields given, those of a message in it as a dictionary.

    All other fields are zero or empty. `[None] * n` are n blank elements of a sequence.
    """
    content = {}
    for name, kind, number in fields_of(message_type):
        if number is None:
            content[name] = _made(kind, given.get(name))
        else:
            many = [_made(kind, value) for value in given.get(name, [None] * number)]
            content[name] = np.array(many, _NUMBERS[kind]) if kind in _NUMBERS else many
    return message_class(message_type)(**content)


def _made(kind: str, given: Any) -> Any:
    if kind == "string":
        return given or ""
    return (given or 0) if kind in _NUMBERS else make_message(kind, **(given or {}))


class Layout:
    """The layout that a serialised message and others of its type share.

    Its `dtype` has the numbers by the names of their fields, in the message's byte order. A message
    in it is a field of fields. One of several equal numbers, such as a vector, a point or a
    quaternion, is an array of them. So are arrays and sequences of numbers or of such messages,
    shape (n,) or (n, k); other ones have a field for each element: "0", "1", ... Strings are left
    out. A ValueError is raised if the bytes are not such a message.
    """

    def __init__(self, sample: bytes | bytearray, message_type: str) -> None:
        walk = _Walk(bytes(sample))
        self.dtype = walk.message(message_type)
        self._size = len(sample)
        self._fixed = np.flatnonzero(walk.fixed)
        self._expected = np.frombuffer(sample, np.uint8)[self._fixed]
        self._mask = int.from_bytes((255 * walk.fixed.astype(np.uint8)).tobytes(), "little")
        self._masked = int.from_bytes(sample, "little") & self._mask

    def record(self, message: bytes | bytearray) -> Record | None:
        """The numbers of one message, shape (); None if it has another layout.

        They are views of the message: what changes it changes them.
        """
        if len(message) != self._size:
            return None
        if int.from_bytes(message, "little") & self._mask != self._masked:
            return None
        return np.ndarray((), self.dtype, message)

    def records(self, messages: Sequence[bytes]) -> tuple[Record, BoolArray]:
        """The numbers of many messages.

        Returns:
            Those of the messages that have this layout, in their order, shape (k,); and which of
            the messages have it.
        """
        fits = np.fromiter(map(len, messages), np.int64, len(messages)) == self._size
        joined = b"".join(messages if fits.all() else compress(messages, fits))
        rows = np.frombuffer(joined, np.uint8).reshape(-1, self._size)
        equal = (rows[:, self._fixed] == self._expected).all(axis=1)
        records = np.frombuffer(joined, self.dtype)
        fits[fits] = equal
        return records if equal.all() else records[equal], fits


def blank(message_type: str, **content: Any) -> tuple[bytearray, Record]:
    """A serialised message to be filled, and its numbers as views of it; see `make_message`."""
    serialised = bytearray(encode(make_message(message_type, **content), message_type))
    return serialised, np.ndarray((), Layout(serialised, message_type).dtype, serialised)


def elements(records: Record, field: str) -> list[Record]:
    """The numbers of the messages in a sequence, none where it is empty."""
    if field not in (records.dtype.names or ()):
        return []
    sequence = records[field]
    return [sequence[number] for number in sequence.dtype.names or ()]


def stamps_of(records: Record) -> IntArray:
    """Stamps of messages' headers since the epoch, of the records' shape [ns]."""
    stamp = records["header"]["stamp"]
    return np.asarray(stamp["sec"].astype(np.int64) * 1_000_000_000 + stamp["nanosec"])


_Placed: TypeAlias = tuple[int, np.dtype[Any]] | None
"""Where in a message [bytes] a part of it is, and its type; None if there is no number in it."""


class _Walk:
    """Goes through a message once; `fixed` are the bytes that are neither numbers nor alignment."""

    def __init__(self, content: bytes) -> None:
        if content[:2] not in (b"\0\0", b"\0\1"):
            raise ValueError("the message is not plain CDR")
        self._order: Literal["<", ">"] = "<" if content[1] else ">"
        self._content = content
        self._at = _HEADER
        self.fixed = np.zeros(len(content), dtype=bool)
        self.fixed[:2] = True

    def message(self, message_type: str) -> np.dtype[Any]:
        """The type of the whole message."""
        placed = self._message(message_type)
        if placed is None or not 0 <= len(self._content) - self._at <= _PADDING:
            raise ValueError(f"not a {message_type}: the message has another length")
        return placed[1]

    def _message(self, name: str) -> _Placed:
        return self._group({field.name: self._field(field) for field in fields_of(name)})

    def _field(self, field: Field) -> _Placed:
        if field.number is None:
            return self._one(field.type)
        count = field.number or self._length()
        if field.type in _NUMBERS:
            return self._numbers(field.type, count)
        if count > len(self._content):
            raise ValueError("a sequence is longer than the message")
        parts = [self._one(field.type) for _ in range(count)]
        if parts and parts[0] is not None and parts[0][1].shape:
            start, vector = parts[0]
            return start, np.dtype((vector, (count,)))
        return self._group({str(number): part for number, part in enumerate(parts)})

    def _one(self, name: str) -> _Placed:
        if name in _NUMBERS:
            return self._numbers(name)
        if name == "string":
            length = self._length()
            if length == 0 or self._take(length)[-1:] != b"\0":
                raise ValueError("a string has no end")
            self.fixed[self._at - length : self._at] = True
            return None
        fields = fields_of(name)
        kinds = {field.type for field in fields}
        single = all(field.number is None for field in fields)
        if single and len(fields) > 1 and len(kinds) == 1 and kinds <= _NUMBERS.keys():
            return self._numbers(fields[0].type, len(fields))
        return self._message(name)

    def _numbers(self, name: str, count: int | None = None) -> tuple[int, np.dtype[Any]]:
        dtype = np.dtype(_NUMBERS[name]).newbyteorder(self._order)
        if count != 0:
            self._at += -(self._at - _HEADER) % dtype.itemsize
        start = self._at
        placed = dtype if count is None else np.dtype((dtype, (count,)))
        self._take(placed.itemsize)
        return start, placed

    def _length(self) -> int:
        start, dtype = self._numbers("uint32")
        self.fixed[start : self._at] = True
        return int(np.frombuffer(self._content, dtype, 1, start)[0])

    def _take(self, size: int) -> bytes:
        self._at += size
        if self._at > len(self._content):
            raise ValueError("the message is too short")
        return self._content[self._at - size : self._at]

    def _group(self, parts: dict[str, _Placed]) -> _Placed:
        """A type of named parts; as long as the message, so that its parts are where they are."""
        placed = {name: part for name, part in parts.items() if part is not None}
        if not placed:
            return None
        starts, kinds = zip(*placed.values(), strict=True)
        names, size = list(placed), len(self._content)
        return 0, np.dtype({"names": names, "formats": kinds, "offsets": starts, "itemsize": size})
