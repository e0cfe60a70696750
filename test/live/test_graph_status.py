"""What the status line counts, compared with what the bag library decodes."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import wrench_vector
from support.messages import Maker

from socket_testbed.live.graph_status import MEASURED, GraphStatus
from socket_testbed.nodes.listeners import StatusListener
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.layout import decode, stamp_of, typestore
from socket_testbed.trials.topics import (
    CAPACITANCE,
    ESTIMATED_WRENCH,
    PARAMETERS,
    RECORDED_TRIAL,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
    Topic,
    match_topics,
)

Messages = list[tuple[Topic, Any]]


@pytest.fixture(scope="module")
def measured(hold: Path) -> Messages:
    """The messages of a trial in which every eighth measurement of each kind is missing."""
    rng = np.random.default_rng(0)
    found = []
    with BagReader(hold) as bag:
        topics = {name: topic for topic, name in match_topics(bag.counts, str(hold)).items()}
        for raw in bag.messages():
            topic, message = topics[raw.topic], decode(raw.data, raw.type)
            lost = rng.random() < 0.125
            if lost and topic is CAPACITANCE:
                message.clusters[rng.integers(4)].status = np.array([0, 1, 2, 0], dtype=np.uint8)
            elif lost and topic is WRENCH:
                message.wrench.torque.z = np.nan
            elif lost and topic is SOCKET_POSE:
                message.pose.position.x = np.nan
            elif lost and topic is not TRIGGER:
                continue
            found.append((topic, message))
    return found


def fed(messages: Messages) -> GraphStatus:
    status = GraphStatus()
    listener = StatusListener(status)
    for topic, message in messages:
        listener.add(topic, bytes(typestore().serialize_cdr(message, topic.type)))
    listener.close()
    return status


def is_whole(topic: Topic, message: Any) -> bool:
    if topic is CAPACITANCE:
        return not any((cluster.status == 2).any() for cluster in message.clusters)
    if topic is WRENCH:
        return bool(np.isfinite(wrench_vector(message.wrench)).all())
    position = message.pose.position
    return bool(np.isfinite([position.x, position.y, position.z]).all())


def test_samples_are_counted_as_they_are_decoded(measured: Messages) -> None:
    status = fed([(t, m) for t, m in measured if t in (TRIGGER, *MEASURED)])
    stamps = [stamp_of(message) for topic, message in measured if topic is TRIGGER]
    whole: dict[int, int] = {}
    for topic, message in measured:
        if topic in MEASURED and is_whole(topic, message):
            whole[stamp_of(message)] = whole.get(stamp_of(message), 0) + 1
    assert status.triggers == len(stamps)
    assert status.complete == list(whole.values()).count(4)
    assert 0.4 < status.complete / status.triggers < 0.8
    assert status.elapsed == pytest.approx(1e-9 * (stamps[-1] - stamps[0]))
    (*_, last) = (message for topic, message in measured if topic is WRENCH)
    assert status.wrench == pytest.approx(np.array(wrench_vector(last.wrench)), nan_ok=True)


def test_predictions_are_judged_over_the_last_seconds(measured: Messages) -> None:
    """Predictions that are off by (3, 0, 0) N and (0, 0.2, 0) N m, and by far more long before."""
    messages: Messages = []
    last = max(stamp_of(message) for topic, message in measured if topic is TRIGGER)
    for topic, message in measured:
        if topic is WRENCH:
            predicted = copy.deepcopy(message)
            predicted.wrench.force.x += 30.0 if stamp_of(message) < last - 12e9 else 3.0
            predicted.wrench.torque.y -= 0.2
            messages += [(topic, message), (ESTIMATED_WRENCH, predicted)]
    assert fed(messages[:1]).errors() is None
    assert fed(messages).errors() == pytest.approx((np.sqrt(3.0), 0.2 / np.sqrt(3.0)))


def test_time_that_jumps_back_starts_over(measured: Messages) -> None:
    measured = [(t, m) for t, m in measured if t in (TRIGGER, *MEASURED)]
    once, twice = fed(measured), fed(measured + measured)
    assert twice.triggers == 2 * once.triggers and twice.complete == 2 * once.complete
    assert twice.elapsed == once.elapsed


def test_names_are_read() -> None:
    messages = [(topic, Maker(1, 0).message(topic.type)) for topic in (PARAMETERS, RECORDED_TRIAL)]
    status = fed(messages)
    parameters, trial = (message for _, message in messages)
    assert (status.variant, status.trial) == (parameters.variant, trial.data)
