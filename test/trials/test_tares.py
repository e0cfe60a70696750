"""The tares of a trial, in its messages and in words."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from socket_testbed.trials.tares import RecordedTare, read_tares, tares_in_words
from socket_testbed.wire import messages, topics

SECOND = 10**9  # [ns]
START = 1_795_000_000 * SECOND  # 2026-11-18 11:06:40 UTC
OFFSETS = np.array([0.1, 0.2, 0.3, 4.0, 5.0, -61.0])


def bag_of(*tares: tuple[int, np.ndarray]) -> SimpleNamespace:
    """A bag of a message a second, each with when its tare was taken [ns], and the tare."""
    pack = messages.load_cell_raw_packer()
    data = [
        pack(START + k * SECOND, np.zeros(6), wrench, taken, 0)
        for k, (taken, wrench) in enumerate(tares)
    ]
    name = "/lab/load_cell/raw"
    return SimpleNamespace(
        path=Path("trial"),
        types={name: topics.LOAD_CELL_RAW.type},
        blocks=lambda wanted: iter([(name, data[:2]), (name, data[2:])]),
    )


def test_each_tare_of_a_trial_is_found_once() -> None:
    """The second is taken in the third second, 6 min after the first."""
    first, second = (START - 300 * SECOND, OFFSETS), (START + 2 * SECOND, 2.0 * OFFSETS)
    found = read_tares(bag_of(first, first, first, second, second))
    assert [(t.taken, t.since) for t in found] == [
        (START - 300 * SECOND, START),
        (START + 2 * SECOND, START + 3 * SECOND),
    ]
    assert found[1].wrench.tolist() == (2.0 * OFFSETS).tolist()


def test_a_bag_without_raw_readings_has_no_tare() -> None:
    bag = bag_of((0, OFFSETS))
    bag.types = {"/load_cell/wrench": topics.WRENCH.type}
    assert read_tares(bag) == []
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
