"""Message types and layouts: the positions of the numbers in a serialised message, as a dtype.

Messages of one type with strings and sequences of equal lengths hold each number at the same
offset. A `Layout` is derived from one such message; it then reads many of them at once without
building message objects. A message has the layout if all bytes that are neither numbers nor
padding equal those of the first message.

The types are those of the rosbags library and of this testbed; any other needs its definition, the
text of its `.msg` file and of those that it names. The encoding is plain CDR, big or little endian
(OMG formal/02-06-51, 15.3): every number is aligned to its size, counted from the end of the
four-byte encapsulation header.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
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
"""Numbers of messages of one layout by field name, with the dtype of their `Layout`."""

_HEADER_SIZE = 4  # [bytes]; encapsulation header: two for the kind, two for options
_MAX_PADDING = 3  # [bytes] after a message
_NUMBER_TYPES = {
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


@cache
def types_of(message_type: str, definition: str = "") -> Typestore:
    """The types that a message consists of.

    Args:
        message_type: Its type, as `package/msg/Type`.
        definition: Its definition, for a type that `typestore` does not hold.

    Raises:
        ValueError: If such a type has no definition, or one that cannot be read.
    """
    known = typestore()
    if message_type in known.fielddefs:
        return known
    if not definition:
        raise ValueError(f"the definition of {message_type} is not known")
    store = Typestore()
    store.fielddefs |= known.fielddefs
    store.types |= known.types
    try:
        store.register(get_types_from_msg(definition, message_type))
        store.get_msgdef(message_type)
    except Exception:  # the library may raise any exception
        raise ValueError(f"the definition of {message_type} cannot be read") from None
    return store


_NAMES_IN_CLASSES = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
_ARRAY = re.compile(
    r"(?:sequence<(?P<many>.+?)(?:, (?P<most>\d+))?>|(?P<some>.+)\[(?P<count>\d+)\])"
)


def define(message_type: str, class_of: Callable[[str], Any]) -> str:
    """The definition of a message type that ROS has as classes.

    Args:
        message_type: The type, as `package/msg/Type`.
        class_of: Returns the class of a type, which states its fields as those of rosidl do.

    Returns:
        The definition with all types that it names; empty for a type that `typestore` holds.
    """
    known, left = {*typestore().fielddefs}, [message_type]
    text = ""
    for name in left:  # which grows
        if name in known:
            continue
        known.add(name)
        if text:
            text += f"{'=' * 80}\nMSG: {name.replace('/msg/', '/')}\n"
        for field, described in class_of(name).get_fields_and_field_types().items():
            kind = _as_written(described)
            text += f"{kind} {field}\n"
            package, slash, nested = kind.partition("[")[0].partition("/")
            if slash:
                left.append(f"{package}/msg/{nested}")
    return text


def _as_written(described: str) -> str:
    """A field's type as in a `.msg` file, such as `float64[3]` of a class's `double[3]`."""
    if found := _ARRAY.fullmatch(described):
        most = f"<={found['most']}" if found["most"] else ""
        return f"{_as_written(found['many'] or found['some'])}[{found['count'] or most}]"
    return _NAMES_IN_CLASSES.get(described, described.replace("string<", "string<=").rstrip(">"))


def decode(raw: bytes | memoryview, message_type: str, definition: str = "") -> Any:
    """Deserialise a message.

    Args:
        raw: The message, serialised (CDR).
        message_type: Its type, as `package/msg/Type`.
        definition: Its definition, see `types_of`.

    Returns:
        The message as an object of rosbags, with the fields of its type as attributes.
    """
    return types_of(message_type, definition).deserialize_cdr(raw, message_type)


def encode(message: Any, message_type: str) -> bytes:
    """Serialise a message.

    Args:
        message: The message as an object of rosbags, see `make_message`.
        message_type: Its type, as `package/msg/Type`.

    Returns:
        The message in little-endian CDR, with its encapsulation header.
    """
    return bytes(typestore().serialize_cdr(message, message_type))


def stamp_of(message: Any) -> int:
    """Stamp in the header of a message, from rosbags or ROS, since the epoch [ns]."""
    return nanoseconds(message.header.stamp)


def nanoseconds(time: Any) -> int:
    """A builtin_interfaces/Time, from rosbags or ROS, since the epoch [ns]."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


class Field(NamedTuple):
    """A field of a message type.

    Attributes:
        name: Its name in the message.
        type: Type of the field or of its elements: a number such as `float64`, `string`, or a
            message type as `package/msg/Type`.
        number: Length of an array; 0 for a sequence of any length; None for a single value.
    """

    name: str
    type: str
    number: int | None = None


def fields_of(message_type: str) -> tuple[Field, ...]:
    """The fields of a message type, given as `package/msg/Type`."""
    return _fields(message_type, types_of(message_type))


@cache
def _fields(message_type: str, types: Typestore) -> tuple[Field, ...]:
    return tuple(_field(*field) for field in types.get_msgdef(message_type).fields)


def _field(name: str, described: Any, number: int | None = None) -> Field:
    """A field from the library's description: its kind and the arguments of that kind."""
    kind, content = described
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        element, bound = content
        return _field(name, element, bound if kind == Nodetype.ARRAY else 0)
    return Field(name, content[0] if kind == Nodetype.BASE else content, number)


def make_message(message_type: str, **given: Any) -> Any:
    """A message with some fields given; all others are zero or empty.

    Args:
        message_type: Its type, as `package/msg/Type`.
        given: Values by field name, in the units of the message definition. A nested message is a
            dictionary of its own fields; an array or sequence is a list, in which None stands for
            a blank element: `[None] * n` gives n of them.

    Returns:
        The message as an object of rosbags, with the fields of its type as attributes.
    """
    content = {}
    for name, kind, number in fields_of(message_type):
        if number is None:
            content[name] = _made(kind, given.get(name))
        else:
            many = [_made(kind, value) for value in given.get(name, [None] * number)]
            content[name] = np.array(many, _NUMBER_TYPES[kind]) if kind in _NUMBER_TYPES else many
    return typestore().types[message_type](**content)


def _made(kind: str, given: Any) -> Any:
    if kind == "string":
        return given or ""
    return (given or 0) if kind in _NUMBER_TYPES else make_message(kind, **(given or {}))


class Layout:
    """The layout that a serialised message shares with others of its type.

    Its `dtype` holds the numbers by field name, in the message's byte order. A nested message is a
    structured field; one whose fields are numbers of one type, such as a vector, a point or a
    quaternion, is an array. So are arrays and sequences of numbers or of such messages, shape (n,)
    or (n, k); other sequences have a field for each element: "0", "1", ... Strings are left out.

    Args:
        sample: A message, serialised (CDR), from which the layout is derived.
        message_type: Its type, as `package/msg/Type`.
        definition: Its definition, see `types_of`.

    Attributes:
        dtype: The numbers by field name; its item size is the length of the message [bytes].

    Raises:
        ValueError: If the bytes are not such a message.
    """

    def __init__(self, sample: bytes | bytearray, message_type: str, definition: str = "") -> None:
        walk = _Walk(bytes(sample), types_of(message_type, definition))
        self.dtype = walk.message(message_type)
        self._size = len(sample)
        self._fixed = np.flatnonzero(walk.fixed)
        self._expected = np.frombuffer(sample, np.uint8)[self._fixed]
        self._mask = int.from_bytes((255 * walk.fixed.astype(np.uint8)).tobytes(), "little")
        self._masked = int.from_bytes(sample, "little") & self._mask

    def record(self, message: bytes | bytearray) -> Record | None:
        """The numbers of one message, shape (), as a view of it; None if its layout differs."""
        if len(message) != self._size:
            return None
        if int.from_bytes(message, "little") & self._mask != self._masked:
            return None
        return np.ndarray((), self.dtype, message)

    def records(self, messages: Sequence[bytes]) -> tuple[Record, BoolArray]:
        """The numbers of many serialised messages.

        Returns:
            The numbers of the k messages with this layout, in order, shape (k,), and a mask of
            these among all N messages, shape (N,).
        """
        fits = np.fromiter(map(len, messages), np.int64, len(messages)) == self._size
        joined = b"".join(messages if fits.all() else compress(messages, fits))
        rows = np.frombuffer(joined, np.uint8).reshape(-1, self._size)
        equal = (rows[:, self._fixed] == self._expected).all(axis=1)
        records = np.frombuffer(joined, self.dtype)
        fits[fits] = equal
        return records if equal.all() else records[equal], fits


def blank(message_type: str, **content: Any) -> tuple[bytearray, Record]:
    """A serialised message to fill in.

    Args:
        message_type: Its type, as `package/msg/Type`.
        content: Its strings, lengths of its sequences and other values, as in `make_message`.

    Returns:
        The message (CDR), and its numbers, shape (), as a view that writes into it.
    """
    serialised = bytearray(encode(make_message(message_type, **content), message_type))
    return serialised, np.ndarray((), Layout(serialised, message_type).dtype, serialised)


def elements(records: Record, field: str) -> list[Record]:
    """The numbers of each message in a sequence of messages.

    Args:
        records: Numbers of messages of one layout, of any shape.
        field: Name of the sequence.

    Returns:
        For each element of the sequence its numbers, with the shape of the records; empty for an
        empty sequence.
    """
    if field not in (records.dtype.names or ()):
        return []
    sequence = records[field]
    return [sequence[number] for number in sequence.dtype.names or ()]


def stamps_of(records: Record) -> IntArray:
    """Header stamps of messages since the epoch [ns], with the shape of the records."""
    return times_of(records["header"]["stamp"])


def times_of(records: Record) -> IntArray:
    """Times of builtin_interfaces/Time since the epoch [ns], with the shape of the records."""
    return np.asarray(records["sec"].astype(np.int64) * 1_000_000_000 + records["nanosec"])


_Placed: TypeAlias = tuple[int, np.dtype[Any]] | None
"""Offset of a part in its message [bytes], and its type; None if it holds no number."""


class _Walk:
    """Parses a message once; `fixed` marks the bytes that are neither numbers nor padding."""

    def __init__(self, content: bytes, types: Typestore) -> None:
        self._types = types
        if content[:2] not in (b"\0\0", b"\0\1"):
            raise ValueError("the message is not plain CDR")
        self._order: Literal["<", ">"] = "<" if content[1] else ">"
        self._content = content
        self._position = _HEADER_SIZE
        self.fixed = np.zeros(len(content), dtype=bool)
        self.fixed[:2] = True

    def message(self, message_type: str) -> np.dtype[Any]:
        """The type of the whole message."""
        placed = self._message(message_type)
        if placed is None or not 0 <= len(self._content) - self._position <= _MAX_PADDING:
            raise ValueError(f"not a {message_type}: the message has another length")
        return placed[1]

    def _message(self, name: str) -> _Placed:
        return self._group({field.name: self._field(field) for field in _fields(name, self._types)})

    def _field(self, field: Field) -> _Placed:
        if field.number is None:
            return self._one(field.type)
        count = field.number or self._length()
        if field.type in _NUMBER_TYPES:
            return self._numbers(field.type, count)
        if count > len(self._content):
            raise ValueError("a sequence is longer than the message")
        parts = [self._one(field.type) for _ in range(count)]
        if parts and parts[0] is not None and parts[0][1].shape:
            start, vector = parts[0]
            return start, np.dtype((vector, (count,)))
        return self._group({str(number): part for number, part in enumerate(parts)})

    def _one(self, name: str) -> _Placed:
        if name in _NUMBER_TYPES:
            return self._numbers(name)
        if name == "string":
            length = self._length()
            if length == 0 or self._take(length)[-1:] != b"\0":
                raise ValueError("a string has no end")
            self.fixed[self._position - length : self._position] = True
            return None
        fields = _fields(name, self._types)
        kinds = {field.type for field in fields}
        single = all(field.number is None for field in fields)
        if single and len(fields) > 1 and len(kinds) == 1 and kinds <= _NUMBER_TYPES.keys():
            return self._numbers(fields[0].type, len(fields))
        return self._message(name)

    def _numbers(self, name: str, count: int | None = None) -> tuple[int, np.dtype[Any]]:
        dtype = np.dtype(_NUMBER_TYPES[name]).newbyteorder(self._order)
        if count != 0:
            self._position += -(self._position - _HEADER_SIZE) % dtype.itemsize
        start = self._position
        placed = dtype if count is None else np.dtype((dtype, (count,)))
        self._take(placed.itemsize)
        return start, placed

    def _length(self) -> int:
        start, dtype = self._numbers("uint32")
        self.fixed[start : self._position] = True
        return int(np.frombuffer(self._content, dtype, 1, start)[0])

    def _take(self, size: int) -> bytes:
        self._position += size
        if self._position > len(self._content):
            raise ValueError("the message is too short")
        return self._content[self._position - size : self._position]

    def _group(self, parts: dict[str, _Placed]) -> _Placed:
        """A type with named parts at their offsets; as long as the message."""
        placed = {name: part for name, part in parts.items() if part is not None}
        if not placed:
            return None
        starts, kinds = zip(*placed.values(), strict=True)
        names, size = list(placed), len(self._content)
        return 0, np.dtype({"names": names, "formats": kinds, "offsets": starts, "itemsize": size})
