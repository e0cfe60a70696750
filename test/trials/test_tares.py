"""The tares of a trial, in its messages and in words."""

from pathlib import Path

import numpy as np
import pytest
from support.bags import copying

from socket_testbed.trials.tares import RecordedTare, tares_in_words
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import decode, stamp_of
from socket_testbed.wire.messages import load_cell_raw_packer

SECOND = 10**9  # [ns]
START = 1_795_000_000 * SECOND  # 2026-11-18 11:06:40 UTC
OFFSETS = np.array([0.1, 0.2, 0.3, 4.0, 5.0, -61.0])


FIRST = (START - 300 * SECOND, OFFSETS)
SECOND_TARE = (START + 2 * SECOND, 2.0 * OFFSETS)


def taken_off(trial: Path, tares: list[tuple[int, np.ndarray]], path: Path) -> Trial:
    """A copy of a trial whose first readings have some tares, and all later ones the last."""
    pack, left = load_cell_raw_packer(), iter(tares)
    taken, wrench = tares[-1]
    with copying(trial, path) as (old, new):
        for raw in old.messages():
            data = raw.data
            if raw.topic == "/load_cell/raw":
                taken, wrench = next(left, (taken, wrench))
                data = pack(stamp_of(decode(data, raw.type)), np.zeros(6), wrench, taken, 0)
            new.write(raw.topic, raw.time, data)
    return Trial(path)


def test_each_tare_is_found_once(hold: Path, tmp_path: Path) -> None:
    """The second one is subtracted from the fourth reading on, after one without any tare."""
    missing = (0, np.full(6, np.nan))
    tares = [FIRST, FIRST, missing, SECOND_TARE, SECOND_TARE]
    trial = taken_off(hold, tares, tmp_path / "tared")
    found = trial.tares
    stamps = trial.samples().stamps.tolist()
    assert [(t.taken, t.since) for t in found] == [
        (START - 300 * SECOND, stamps[0]),
        (START + 2 * SECOND, stamps[3]),
    ]
    assert found[1].wrench.tolist() == (2.0 * OFFSETS).tolist()


def test_a_trial_without_raw_readings_has_no_tare(hold: Path, tmp_path: Path) -> None:
    with copying(hold, tmp_path / "plain") as (old, new):
        for raw in old.messages([name for name in old.counts if name != "/load_cell/raw"]):
            new.write(raw.topic, raw.time, raw.data)
    assert Trial(tmp_path / "plain").tares == ()
    assert tares_in_words([], START) == ["tare: not recorded"]


@pytest.mark.parametrize(
    ("taken", "line"),
    [
        (0, "tare: none, the load cell was never tared"),
        (
            START,
            "tare: Mx 0.1 N m, My 0.2 N m, Mz 0.3 N m, Fx 4 N, Fy 5 N, Fz -61 N, taken at"
            " 2026-11-18T11:06:40+00:00",
        ),
    ],
    ids=["never", "once"],
)
def test_a_tare_is_shown_with_its_time(taken: int, line: str) -> None:
    assert tares_in_words([RecordedTare(OFFSETS, taken, START)], START) == [line]


def test_a_later_tare_is_shown_with_its_second() -> None:
    tares = [RecordedTare(OFFSETS, 0, START), RecordedTare(OFFSETS, START, START + 2 * SECOND)]
    assert tares_in_words(tares, START)[1].startswith("tare: from 2.00 s: Mx 0.1 N m, My")
