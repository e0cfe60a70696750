"""Layouts read and fill messages as the library's own code does, of every type, in both orders."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import pytest
from support.messages import Maker, encode, numbers_in, numbers_of, strings_of

from socket_testbed.trials.layout import Layout, blank, decode, fields_of, typestore

TYPES = (
    *sorted(name for name in typestore().types if name.startswith("socket_testbed_msgs/")),
    *("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"),
    *("visualization_msgs/msg/MarkerArray", "diagnostic_msgs/msg/DiagnosticArray"),
    *("sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/BatteryState"),
    *("std_msgs/msg/Float64MultiArray", "shape_msgs/msg/Mesh", "std_msgs/msg/Empty"),
)


def test_numbers_are_those_of_the_library() -> None:
    for kind, lengths, little in product(TYPES, range(6), (True, False)):
        messages = [Maker(lengths, n).message(kind) for n in range(3)]
        raws = [encode(message, kind, little) for message in messages]
        layout = Layout(raws[0], kind)
        records, fits = layout.records(raws)
        assert fits.all()
        for message, raw, record in zip(messages, raws, records, strict=True):
            alone = layout.record(raw)
            assert alone is not None
            assert numbers_in(record) == numbers_in(alone) == numbers_of(message, kind)


def as_given(message: Any, kind: str) -> dict[str, Any]:
    """The strings of a message, and as many blank elements as its sequences have."""
    given = {}
    for name, of, number in fields_of(kind):
        value = getattr(message, name)
        if of == "string":
            given[name] = value
        elif "/" in of:
            given[name] = (
                as_given(value, of) if number is None else [as_given(v, of) for v in value]
            )
        elif number is not None:
            given[name] = [None] * len(value)
    return given


def test_a_filled_blank_is_the_message() -> None:
    for kind in TYPES:
        message = Maker(3, 1).message(kind)
        sent = encode(message, kind, True)
        content, record = blank(kind, **as_given(message, kind))
        assert not any(numbers_of(decode(content, kind), kind))
        assert strings_of(decode(content, kind), kind) == strings_of(message, kind)
        found = Layout(content, kind).record(sent)
        assert found is not None
        for name in record.dtype.names or ():
            record[name] = found[name]
        assert numbers_of(decode(content, kind), kind) == numbers_of(message, kind)


CLUSTERS = "socket_testbed_msgs/msg/ClusterCapacitanceArray"


@pytest.mark.parametrize("kind", [CLUSTERS, "socket_testbed_msgs/msg/ForceMap"])
def test_any_other_byte_is_read_as_the_library_reads_it(kind: str) -> None:
    """A message with one byte changed fits if only numbers or what aligns them changed."""
    message = Maker(7, 0).message(kind)
    raw = encode(message, kind, True)
    layout, before = Layout(raw, kind), strings_of(decode(raw, kind), kind)
    records, fits = layout.records([raw[:-1], raw, b"", encode(message, kind, False), raw])
    assert fits.tolist() == [False, True, False, False, True] and len(records) == 2
    outcomes = set()
    for at in range(len(raw)):
        changed = bytearray(raw)
        changed[at] ^= 0xA5
        record = layout.record(changed)
        try:
            message = decode(bytes(changed), kind)
            same = strings_of(message, kind) == before
        except Exception:
            same = False
        assert (record is not None) == same
        if record is not None:
            np.testing.assert_array_equal(numbers_in(record), numbers_of(message, kind))
        outcomes.add(same)
    assert outcomes == {True, False}


def damaged(kind: str) -> Iterator[bytes]:
    rng = np.random.default_rng(0)
    raw = encode(Maker(3, 0).message(kind), kind, True)
    yield raw + bytes(4)
    for _ in range(60):
        torn = bytearray(raw)
        torn[rng.integers(len(torn))] = rng.integers(256)
        yield from (bytes(torn), raw[: rng.integers(len(raw))])


def test_bytes_that_are_no_such_message_are_refused() -> None:
    """Whatever is accepted is what the library accepts, too."""
    for kind, bad in ((name, bad) for name in TYPES for bad in damaged(name)):
        try:
            Layout(bad, kind)
        except ValueError:
            continue
        try:
            decode(bad, kind)
        except Exception as error:
            assert "utf-8" in str(error)  # a string's bytes: nobody reads them from a layout
