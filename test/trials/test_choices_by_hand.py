"""Which value, name or order of several a trial gives, where more than one could be meant."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import scene
from support.problems import make_samples

from socket_testbed.errors import TrialError
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials import description, events, reprocess, segment, synchronise
from socket_testbed.trials.events import Event
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.wire import topics

SECOND = 10**9  # [ns]


# --- events


class Read:
    """Stands for a `Reader`: stamps and labels are the messages themselves."""

    def __init__(self, topic: topics.Topic, where: object) -> None:
        self.refused: list[TrialError] = []

    def read(self, data: Any) -> Any:
        return data


@pytest.mark.parametrize(
    ("stamp", "time"),
    [(5.0, 5.0), (-9.5, -9.5), (69.0, 69.0), (-10.5, 30.0), (70.5, 30.0), (0.0 - 1e6, 30.0)],
    ids=["within", "just before", "just after", "before", "after", "another clock"],
)
def test_a_stamp_far_off_is_that_of_its_recording(
    stamp: float, time: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Triggers at 0 and 60 s are recorded 5 s later, the event in the middle of them."""
    monkeypatch.setattr(events, "Reader", Read)
    first, late = 10**6 * SECOND, 5 * SECOND

    def raw(own: float, data: Any) -> Any:
        return SimpleNamespace(time=first + late + round(own * SECOND), data=data)

    recorded = {
        "/event": [raw(30.0, (first + round(stamp * SECOND), "push"))],
        "/trigger": [raw(0.0, (first, 0)), raw(60.0, (first + 60 * SECOND, 1))],
    }
    bag: Any = SimpleNamespace(
        types={"/event": topics.EVENT.type, "/trigger": topics.TRIGGER.type}, path=Path("s01"),
        messages=lambda names: recorded[names[0]],
    )  # fmt: skip
    (found,) = events.read_events(bag, first + SECOND // 4 * np.arange(241), print)
    assert (found.label, found.source) == ("push", "recorded")
    assert found.time == pytest.approx(time)


@pytest.mark.parametrize(
    ("label", "shown"), [("a\x07b", "a b"), (" push ", "push"), ("\x07 ", "unnamed")], ids=repr
)
def test_a_recorded_label_is_printable(label: str, shown: str) -> None:
    assert events._printable(label) == shown


def test_a_trial_starts_loaded_before_it_is_removed() -> None:
    removed, placed = Event("removed", 5.0, "found"), Event("placed", 9.0, "found")
    other = Event("push", 1.0, "recorded")
    found = [events.is_loaded([other, removed, placed], time) for time in (2.0, 5.0, 8.9, 9.0)]
    assert found == [True, False, False, True]
    assert not events.is_loaded([other, placed], 8.9) and events.is_loaded([other], 2.0)


# --- segments


def held(*spans: tuple[int, int], load: float = -280.0) -> Samples:
    """100 s at 4 Hz, under load in these spans [s]."""
    wrench = np.zeros((400, 6))
    for start, end in spans:
        wrench[4 * start : 4 * end, 5] = load
    return make_samples(np.zeros((400, 6)), wrench, {"a": np.zeros((400, 3))})


def test_the_longest_hold_wins_over_the_first() -> None:
    samples = held((5, 25), (40, 90))
    found = segment.select_segment(samples, "hold", PlateauSettings())
    assert found.kind == "hold" and found.start == pytest.approx(40.0, abs=2.0)
    assert found.end == pytest.approx(90.0, abs=2.5)
    auto = segment.select_segment(samples, "auto", PlateauSettings())
    assert (auto.kind, auto.start, auto.end) == ("hold", found.start, found.end)


def test_a_left_out_channel_ends_no_hold() -> None:
    samples = held((10, 90))
    samples.local_forces[200:, 0, 2] = -50.0
    settings = PlateauSettings()
    cut = segment.select_segment(samples, "hold", settings)
    whole = segment.select_segment(samples, "hold", settings, ("a.Fx", "a.Fy", "a.Fz"))
    assert cut.end - cut.start < 42.0 and whole.end - whole.start > 75.0
    plateau = segment.select_segment(samples, "plateau", settings, ("a.Fx", "a.Fy", "a.Fz"))
    assert (plateau.kind, plateau.rows) == ("plateau", whole.rows)


def test_the_first_frames_of_a_segment_are_kept() -> None:
    samples = held((10, 90))
    part = segment.Segment("span", 10.0, 20.0, slice(40, 81))
    few = segment.first_frames(part, samples, 5)
    assert (few.kind, few.start, few.end, few.rows) == ("span", 10.0, 11.0, slice(40, 45))
    assert segment.first_frames(part, samples, 0) is part
    assert segment.first_frames(part, samples, 41) is part


# --- measurements


def test_four_stamps_are_cut_after_three() -> None:
    stamps = np.array([0, 2, 1, 4, 3, 6, 5, 8, 7]) * SECOND
    wrong: Any = {(topics.WRENCH, "load_cell/wrench"): [stamps]}
    assert [*synchronise._stamp_notes(wrong)] == [
        "the stamps of load_cell/wrench jump back, 4 times (from 2.00 s to 1.00 s, from 4.00 s to"
        " 3.00 s, from 6.00 s to 5.00 s and 1 more); samples are in the order of their stamps:"
        " check the clock of the recording"
    ]
    doubled: Any = {(topics.MARKERS, "socket"): [np.repeat(np.arange(2), [1, 3]) * SECOND]}
    assert [*synchronise._stamp_notes(doubled)] == [
        "the stamps of mocap/markers of socket are doubled, once (at 1.00 s): 2 earlier values are"
        " replaced by later ones"
    ]


def measured(count: int = 9) -> Measurements:
    """One a second; 15 N along z, of which a tare was taken off."""
    wrench = np.zeros((count, 6))
    wrench[:, 5] = 15.0
    rest = np.tile(np.eye(7)[6], (count, 1))
    return Measurements(
        np.arange(count) * SECOND, wrench, rest, rest, ("distal",), np.full((count, 1, 4), 5.0),
        np.zeros((count, 1, 4), np.uint8), np.zeros((count, 6)), np.zeros((count, 6)),
        np.zeros(count, np.int64), {},
    )  # fmt: skip


def test_the_last_tare_is_told() -> None:
    """It changed during the trial; the last row has no wrench."""
    given, notes = measured(), list[str]()
    given.tares[:4, 5], given.tares[4:, 5] = 3.0, 7.0
    given.wrench[8], given.tares[8] = np.nan, 99.0
    reprocess.remake_wrenches(given, LoadCellSettings(), None, "recorded", "s01", notes.append)
    assert notes == [
        "the wrenches are recomputed from load_cell/raw, with the tare recorded: Mx 0 N m, My 0 N"
        " m, Mz 0 N m, Fx 0 N, Fy 0 N, Fz 7 N"
    ]


def test_a_limb_turns_as_its_pylon() -> None:
    """About z by 0.1 rad at the socket's own place, seen in {S}."""
    geometry = replace(
        scene.geometry(),
        **{name: replace(scene.geometry().limb, rotation=np.eye(3), translation=np.zeros(3))
           for name in ("limb", "socket_body")},
    )  # fmt: skip
    given = measured(1)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.1]).as_quat()
    pylon = np.concatenate([[0.01, 0.02, 0.03], turn])[None]
    found = synchronise.make_samples(replace(given, pylon=pylon), scene.calibration(), geometry)
    np.testing.assert_allclose(found.rotation, [[0.0, 0.0, 0.1]], atol=1e-12)
    np.testing.assert_allclose(found.position, [[0.01, 0.02, 0.03]], atol=1e-12)


def test_missing_comes_before_saturated(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = make_samples(np.zeros((5, 6)), np.zeros((5, 6)), {"a": np.zeros((5, 3))})
    samples.status[:3, 0] = [Status.SATURATED, Status.MISSING, Status.MISSING]
    monkeypatch.setattr(description.Trial, "samples", lambda trial: samples)
    assert description.summary(Path("s01")) == "s01: 5 triggers, a missing 2, a saturated 1"
