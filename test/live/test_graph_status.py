"""What the status line counts of serialised messages."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.messages import Maker, encode

from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.nodes.controls import StatusListener
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
    PYLON_POSE,
    RECORDED_TRIAL,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
    Topic,
)

PERIOD = 250_000_000  # [ns]
WRENCHES = np.arange(6.0)


def fed(*batches: list[tuple[Topic, bytes]]) -> GraphStatus:
    """A status after messages that came in batches, between two looks of the terminal each."""
    status = GraphStatus()
    listener = StatusListener(status)
    inbox = listener._inbox
    for batch in batches:
        came = {topic: [data for own, data in batch if own is topic] for topic, _ in batch}
        listener._inbox = SimpleNamespace(take=lambda topic, came=came: came.get(topic, []))
        listener.take()
    listener._inbox = inbox
    listener.close()
    return status


def test_complete_samples_are_counted_and_go_on_when_time_jumps_back() -> None:
    capacitance, pose, ones = capacitance_packer(("p", "q")), pose_packer(), np.ones((2, 4))
    messages: list[tuple[Topic, bytes]] = []
    for k in range(40):  # of five one is complete: a saturated input lacks nothing
        stamp, lacking = k * PERIOD, [np.nan if k % 5 == n else 0.0 for n in range(3)]
        status = np.array([[0, 1, 2 * (k % 5 == 0), 0], [0] * 4], np.uint8)
        messages += [
            (TRIGGER, trigger_packer()(stamp, k)),
            (CAPACITANCE, capacitance(stamp, ones, status)),
            (WRENCH, wrench_packer()(stamp, np.append(WRENCHES[:5], 5.0 + lacking[1]))),
            (SOCKET_POSE, pose(stamp, np.array([0.0, lacking[2], 0.0, 0.0, 0.0, 0.0, 1.0]))),
        ]
        if k % 5 != 3:
            messages.append((PYLON_POSE, pose(stamp, np.eye(7)[6])))
    content = [(topic, Maker(1, 0).message(topic.type)) for topic in (PARAMETERS, RECORDED_TRIAL)]
    named = [(topic, encode(message, topic.type, little=True)) for topic, message in content]
    for times in (1, 2):
        status = fed(*([message] for message in messages * times), named)
        assert (status.triggers, status.complete) == (times * 40, times * 8)
        assert status.elapsed == pytest.approx(1e-9 * 39 * PERIOD)
        assert status.wrench is not None and (status.wrench == WRENCHES).all()
        assert (status.variant, status.trial) == (content[0][1].variant, content[1][1].data)


def test_predictions_are_judged_over_the_last_seconds() -> None:
    """Predictions that are off by (3, 0, 0) N and (0, 0.2, 0) N m, and by far more long before.

    They come right after the wrench that they are of.
    """
    found = []
    for k in range(100):
        off = [0.0, -0.2, 0.0, 30.0 if k < 52 else 3.0, 0.0, 0.0]
        wrenches = {WRENCH: WRENCHES, ESTIMATED_WRENCH: WRENCHES + off}
        found.append([(t, wrench_packer()(k * PERIOD, own)) for t, own in wrenches.items()])
    assert fed(found[0][:1]).errors() is None
    assert fed(*found).errors() == pytest.approx((np.sqrt(3.0), 0.2 / np.sqrt(3.0)))
