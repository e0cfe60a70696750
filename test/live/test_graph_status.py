"""What the status line counts of serialised messages."""

from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from support.messages import Maker

from socket_testbed.live.graph_status import MEASURED, GraphStatus
from socket_testbed.nodes.controls import StatusListener
from socket_testbed.trials.layout import typestore
from socket_testbed.trials.messages import (
    capacitance_packer,
    pose_packer,
    trigger_packer,
    wrench_packer,
)
from socket_testbed.trials.topics import (
    CAPACITANCE,
    ESTIMATED_WRENCH,
    PARAMETERS,
    RECORDED_TRIAL,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
    Topic,
)

PERIOD = 250_000_000  # [ns]
COUNT = 240  # triggers
MEASURED_WRENCH = np.arange(6.0)
LOST = np.random.default_rng(0).random((COUNT, len(MEASURED))) < 0.125


def messages() -> Iterator[tuple[Topic, bytes]]:
    """Triggers, and measurements of which every eighth lacks something or does not come."""
    capacitance, pose, ones = capacitance_packer(("p", "q")), pose_packer(), np.ones((2, 4))
    for k in range(COUNT):
        stamp = (1 + k) * PERIOD
        yield TRIGGER, trigger_packer()(stamp, k)
        for topic, lost in zip(MEASURED, LOST[k], strict=True):
            lacking = np.nan if lost else 0.0
            if topic is CAPACITANCE:  # a saturated channel is there
                status = np.array([[0, 1, 2 * lost, 0], [0] * 4], np.uint8)
                yield topic, capacitance(stamp, ones, status)
            elif topic is WRENCH:
                yield topic, wrench_packer()(stamp, np.append(MEASURED_WRENCH[:5], 5.0 + lacking))
            elif topic is SOCKET_POSE or not lost:
                yield topic, pose(stamp, np.array([0.0, lacking, 0.0, 0.0, 0.0, 0.0, 1.0]))


def fed(found: Iterable[tuple[Topic, bytes]]) -> GraphStatus:
    status = GraphStatus()
    listener = StatusListener(status)
    for topic, data in found:
        listener.add(topic, data)
    listener.close()
    return status


def test_complete_samples_are_counted_and_go_on_when_time_jumps_back() -> None:
    content = [(topic, Maker(1, 0).message(topic.type)) for topic in (PARAMETERS, RECORDED_TRIAL)]
    named = [(t, bytes(typestore().serialize_cdr(m, t.type))) for t, m in content]
    complete = (~LOST).all(axis=1).sum()
    for times in (1, 2):
        status = fed([*messages()] * times + named)
        assert (status.triggers, status.complete) == (times * COUNT, times * complete)
        assert status.elapsed == pytest.approx(1e-9 * (COUNT - 1) * PERIOD)
        assert status.wrench is not None and (status.wrench[:5] == MEASURED_WRENCH[:5]).all()
        assert (status.variant, status.trial) == (content[0][1].variant, content[1][1].data)


def test_predictions_are_judged_over_the_last_seconds() -> None:
    """Predictions that are off by (3, 0, 0) N and (0, 0.2, 0) N m, and by far more long before."""
    found = []
    for k in range(COUNT):
        found.append((WRENCH, wrench_packer()(k * PERIOD, MEASURED_WRENCH)))
        off = [0.0, -0.2, 0.0, 30.0 if k < COUNT - 48 else 3.0, 0.0, 0.0]
        found.append((ESTIMATED_WRENCH, wrench_packer()(k * PERIOD, MEASURED_WRENCH + off)))
    assert fed(found[:1]).errors() is None
    assert fed(found).errors() == pytest.approx((np.sqrt(3.0), 0.2 / np.sqrt(3.0)))
