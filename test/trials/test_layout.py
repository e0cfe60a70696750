"""Layouts read messages of every type as the library does, in both byte orders.

Messages that are filled are compared with those of ROS in `test/nodes/test_messages.py`.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest
from support.messages import Maker, encode, numbers_in, numbers_of, strings_of

from socket_testbed.trials.layout import Layout, decode, typestore

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
