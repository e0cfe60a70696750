"""Values beyond any sensor, doubled stamps, ends of segments, and changed metadata."""

from typing import Any

import numpy as np
import pytest
from support import scene
from support.bags import rewrite

from socket_testbed.trials import events, synchronise
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.metadata import TrialMetadata, change_metadata
from socket_testbed.trials.synchronise import Measurements, read_measurements
from socket_testbed.wire import topics


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory: pytest.TempPathFactory) -> tuple[Measurements, list[str]]:
    """The scene with impossible values in rows 3, 5, 6 and 7, just possible ones in row 8."""
    folder = tmp_path_factory.mktemp("spoilt")
    counts: dict[str, int] = {}

    def spoil(topic: str, message: Any) -> Any:
        row = counts.setdefault(topic, 0)
        counts[topic] += 1
        if topic == "/load_cell/wrench":
            message.wrench.force.z = {3: 1.1e6, 5: -1.1e6, 8: -1e6}.get(row, -60.0)
            message.wrench.torque.x = {8: 1e6}.get(row, 0.5)
        if topic == "/mocap/socket/pose" and row == 7:
            message.pose.position.x = -2e6
        if topic == "/clusters/capacitance" and row in (6, 7):
            cluster = message.clusters[1]
            cluster.capacitance = np.array([6.0, 6.0, 3e6 if row == 6 else -3e6, 6.0])
        return message

    path = rewrite(scene.write(folder / "scene"), folder / "spoilt", spoil)
    notes: list[str] = []
    with BagReader(path) as bag:
        return read_measurements(bag, notes.append), notes


def test_impossible_forces_are_missing(spoilt: tuple[Measurements, list[str]]) -> None:
    force = spoilt[0].wrench[:, 5]
    assert np.flatnonzero(np.isnan(force)).tolist() == [3, 5]
    assert (force[4], force[8]) == (-60.0, -1e6)
    assert spoilt[0].wrench[8, 0] == 1e6


def test_an_impossible_place_is_missing(spoilt: tuple[Measurements, list[str]]) -> None:
    assert np.argwhere(np.isnan(spoilt[0].socket)).tolist() == [[7, 0]]
    assert np.isfinite(spoilt[0].pylon).all()


def test_impossible_capacitances_are_missing(spoilt: tuple[Measurements, list[str]]) -> None:
    assert np.argwhere(np.isnan(spoilt[0].capacitance)).tolist() == [[6, 1, 2], [7, 1, 2]]


@pytest.mark.parametrize(
    ("topic", "count"),
    [("clusters/capacitance", 2), ("load_cell/wrench", 2), ("socket/pose", 1)],
    ids=["clusters", "wrench", "pose"],
)
def test_impossible_values_are_counted_by_topic(
    topic: str, count: int, spoilt: tuple[Measurements, list[str]]
) -> None:
    (note,) = [note for note in spoilt[1] if f"{topic} holds" in note]
    assert note.endswith(
        f"{topic} holds {count} values beyond 1e+06, which count as missing: check the recording"
    )
    assert len(spoilt[1]) == 3


def test_every_replaced_value_is_counted() -> None:
    """Four values at one stamp and two at another: four are lost."""
    stamps = (1e9 * np.array([5.0, 5.0, 5.0, 5.0, 6.0, 6.0, 7.0])).astype(np.int64)
    (note,) = synchronise._stamp_notes({(topics.TRIGGER, "trigger"): [stamps]})
    assert note == (
        "the stamps of trigger are doubled, 2 times (at 0.00 s, at 1.00 s): 4 earlier values are"
        " replaced by later ones"
    )


@pytest.mark.parametrize(
    ("specification", "span"),
    [
        ("event:placed:removed-2", (2.0, 8.0)),  # 1 s would be before the start
        ("event:placed:removed", (2.0, 3.0)),
        ("event:placed:removed+2", (2.0, 5.0)),
    ],
    ids=["earlier", "at it", "later"],
)
def test_an_end_is_after_its_start(specification: str, span: tuple[float, float]) -> None:
    times = (("placed", 2.0), ("removed", 3.0), ("removed", 10.0))
    known = [events.Event(label, time, "found") for label, time in times]
    assert events.event_span(specification, known) == span


def test_a_field_removed_and_set_is_set() -> None:
    stored = TrialMetadata(subject="S01", liner="gel")
    found = change_metadata(stored, {"subject": "S02"}, ["subject", "liner"])
    assert found == TrialMetadata(subject="S02")
