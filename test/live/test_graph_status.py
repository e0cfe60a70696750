"""What the status line counts, compared with what the bag library decodes."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import pose_vector, wrench_vector
from support.messages import Maker

from socket_testbed.live.graph_status import MEASURED, GraphStatus
from socket_testbed.nodes.controls import StatusListener
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


def is_whole(topic: Topic, message: Any) -> bool:
    if topic is CAPACITANCE:
        return not any((cluster.status == 2).any() for cluster in message.clusters)
    vector = wrench_vector(message.wrench) if topic is WRENCH else pose_vector(message.pose)
    return bool(np.isfinite(vector).all())


@pytest.fixture(scope="module")
def hearing(hold: Path) -> tuple[Messages, dict[int, int]]:
    """Messages of a trial of which every eighth lacks something; how many are whole by stamp."""
    rng = np.random.default_rng(0)
    found, whole = [], {}
    with BagReader(hold) as bag:
        topics = {name: topic for topic, name in match_topics(bag.counts, str(hold)).items()}
        for raw in bag.messages():
            topic, message = topics[raw.topic], decode(raw.data, raw.type)
            if topic not in (TRIGGER, *MEASURED):
                continue
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
            stamp = stamp_of(message)
            whole[stamp] = whole.get(stamp, 0) + (topic is not TRIGGER and is_whole(topic, message))
    return found, whole


def fed(messages: Messages) -> GraphStatus:
    status = GraphStatus()
    listener = StatusListener(status)
    for topic, message in messages:
        listener.add(topic, bytes(typestore().serialize_cdr(message, topic.type)))
    listener.close()
    return status


def test_samples_are_counted_as_they_are_decoded_and_again_when_time_jumps_back(hearing) -> None:
    measured, whole = hearing
    status = fed(measured)
    stamps = [stamp_of(message) for topic, message in measured if topic is TRIGGER]
    assert status.triggers == len(stamps)
    assert status.complete == list(whole.values()).count(4)
    assert 0.4 < status.complete / status.triggers < 0.8
    assert status.elapsed == pytest.approx(1e-9 * (stamps[-1] - stamps[0]))
    (*_, last) = (message for topic, message in measured if topic is WRENCH)
    assert status.wrench == pytest.approx(np.array(wrench_vector(last.wrench)), nan_ok=True)
    named = [(topic, Maker(1, 0).message(topic.type)) for topic in (PARAMETERS, RECORDED_TRIAL)]
    twice = fed(measured + measured + named)
    assert twice.triggers == 2 * status.triggers and twice.complete == 2 * status.complete
    assert twice.elapsed == status.elapsed
    assert (twice.variant, twice.trial) == (named[0][1].variant, named[1][1].data)


def test_predictions_are_judged_over_the_last_seconds(hearing) -> None:
    """Predictions that are off by (3, 0, 0) N and (0, 0.2, 0) N m, and by far more long before."""
    messages: Messages = []
    last = max(hearing[1])
    for topic, message in hearing[0]:
        if topic is WRENCH:
            predicted = copy.deepcopy(message)
            predicted.wrench.force.x += 30.0 if stamp_of(message) < last - 12e9 else 3.0
            predicted.wrench.torque.y -= 0.2
            messages += [(topic, message), (ESTIMATED_WRENCH, predicted)]
    assert fed(messages[:1]).errors() is None
    assert fed(messages).errors() == pytest.approx((np.sqrt(3.0), 0.2 / np.sqrt(3.0)))
