"""A recorder beside an earlier trial goes on saying so."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.nodes import Maker, running_ros

from socket_testbed.nodes.base import OK, WARN
from socket_testbed.nodes.recorder_node import RecorderNode


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    mask = os.umask(0)  # a recorder changes it
    with running_ros():
        yield
    os.umask(mask)


TOPICS = (
    *("/trigger", "/clusters/capacitance", "/load_cell/wrench"),
    *("/mocap/socket/pose", "/mocap/pylon/pose"),
)


@pytest.mark.parametrize("earlier", [False, True], ids=["alone", "beside a trial"])
def test_arriving_messages_take_no_warning_back(earlier: bool, make: Maker, tmp_path: Path) -> None:
    folder = tmp_path / "trials"
    if earlier:
        make(RecorderNode, directory=folder, record="true").close()
    node = make(RecorderNode, directory=folder, record="true")
    for name in TOPICS:
        node._on_message(name, bytes(64))
    node.check()
    beside = f"recording {folder}_2: {folder} holds a trial and stays as it is"
    assert make.state() == ((WARN, beside) if earlier else (OK, f"recording {folder}"))
