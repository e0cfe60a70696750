"""The NatNet client against a simulated server on the loopback, with every fault."""

import itertools
import socket
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
from support.clocks import careful_time_scale
from support.natnet import Link, scene, until
from support.wording import refused

from socket_testbed import clocks
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.simulation.devices import natnet_server
from socket_testbed.simulation.devices.natnet_server import NatNetServer

ACCURACY = 1e-3  # [m]; of a marker that moves at 0.3 m/s, with the loopback's delays
GROUP = "239.255.77.13"


@pytest.fixture(scope="module", autouse=True)
def testbed_time():
    """Real threads and sockets run in testbed time, as slow as this machine needs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clocks, "_scale", careful_time_scale())
        yield


@pytest.fixture
def link():
    with Link() as link:
        link.until_level(0)
        yield link


@pytest.fixture
def group() -> tuple[str, int]:
    """A group and a port on the loopback, if the machine has multicast there."""
    local = socket.inet_aton("127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.settimeout(1.0)
        try:
            udp.bind((GROUP, 0))
            membership = socket.inet_aton(GROUP) + local
            udp.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            udp.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, local)
            udp.sendto(b"?", udp.getsockname())
            udp.recv(10)
        except OSError as error:
            pytest.skip(f"no multicast on the loopback: {error}")
        return udp.getsockname()


@pytest.mark.parametrize(
    "version", [(3, 0), (4, 0), (4, 1), (4, 5)], ids=["3.0", "4.0", "4.1", "4.5"]
)
def test_frames_have_their_exposure_on_the_steady_clock(version: tuple[int, int]):
    with Link(version=version) as link:
        link.until_level(0)
        assert min(link.worst() for _ in range(5)) < ACCURACY
        link.restart()
        assert min(link.worst() for _ in range(5)) < ACCURACY
        numbers, moments = zip(*link.frames, strict=True)
        # They begin anew with the server that restarted.
        assert sum(a >= b for a, b in itertools.pairwise(numbers)) <= 1
        assert all(a < b for a, b in itertools.pairwise(moments))


@pytest.mark.parametrize(
    ("server", "layout"),
    [
        pytest.param({"version": (4, 5)}, "", id="refuses-bitstream"),
        pytest.param({"version": (4, 6)}, "", id="newer"),
        pytest.param({"layout": (4, 1)}, "in the layout of NatNet 4.1", id="older"),
        pytest.param({"layout": (3, 1)}, "in the layout of NatNet 3.1", id="without-sizes"),
        pytest.param({"layout": (4, 0)}, "in the layout of NatNet 3.1", id="named-without-sizes"),
        pytest.param(
            {"version": (3, 1), "layout": (4, 5)}, "in the layout of NatNet 4.5", id="with-sizes"
        ),
    ],
)
def test_a_server_that_refuses_bitstream_gives_frames(server: dict[str, Any], layout: str):
    refuses = ("Bitstream", "SubscribeToData")
    with Link(crowded=True, refused=refuses, **server) as link:
        link.until_level(0, layout)
        until_known = link.client.figures()["bad_datagrams"]
        assert min(link.worst() for _ in range(5)) < ACCURACY
        assert link.client.figures()["bad_datagrams"] == until_known


def test_exchanged_ids_are_read_again(link):
    """And exchanged back. No frame flags either."""
    for value, ids in ((1.0, "socket 2 instead of 1, pylon 1 instead of 2"), (0.0, "socket 1")):
        link.faults["mocap.exchange"] = value
        link.until_level(1, f"Motive has changed the ids of its rigid bodies ({ids}")
        assert min(link.worst() for _ in range(5)) < ACCURACY
    link.until_level(0)
    assert link.client.figures()["sessions"] == 1


@pytest.mark.parametrize(
    ("scale", "unit"),
    [
        pytest.param(1000.0, "millimetres", id="mm"),
        pytest.param(100.0, "centimetres", id="cm"),
        pytest.param(1.0 / 0.0254, "inches", id="in"),
    ],
)
def test_a_stream_in_another_unit_is_named(link, scale: float, unit: str):
    link.faults["mocap.scale"] = scale
    link.until_level(1, "the stream is not in metres, but in millimetres or the like: set Motive's")
    until(lambda: unit in link.tracker.sample(clocks.monotonic() - 0.03)[0].fault, unit)
    link.faults["mocap.scale"] = 1.0
    link.until_level(0)


@pytest.mark.parametrize(
    ("bodies", "text"),
    [
        pytest.param(True, "the frames hold rigid bodies but none of their markers", id="bodies"),
        pytest.param(False, "the frames hold no rigid body", id="nothing"),
    ],
)
def test_frames_without_labelled_markers_are_explained(link, monkeypatch, bodies: bool, text: str):
    content = link.server._scene.content

    def emptied(*given):
        found = content(*given)
        unlabelled = [natnet_server.Marker(0, k, m.position) for k, m in enumerate(found.markers)]
        return replace(found, bodies=found.bodies if bodies else (), markers=unlabelled)

    monkeypatch.setattr(link.server._scene, "content", emptied)
    link.until_level(1, text)
    monkeypatch.undo()
    link.until_level(0)


def test_a_version_before_3_0_is_too_old():
    with Link(version=(2, 10)) as link:
        link.until_level(2, "NatNet 2.10 is too old, NatNet 3.0 is needed: update Motive to 2.0")
        assert not link.frames


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        pytest.param({"server": ""}, "server is empty", id="empty-server"),
        pytest.param(
            {"server": "no such host.invalid"},
            "server 'no such host.invalid' is not known",
            id="unknown-server",
        ),
        pytest.param(
            {"bitstream": "2.10"}, "bitstream is '2.10', which is too old", id="old-bitstream"
        ),
        pytest.param({"multicast": "10.0.0.1"}, "multicast is '10.0.0.1'", id="unicast-group"),
    ],
)
def test_a_wrong_address_is_refused_at_once(changes: dict[str, str], text: str):
    with refused(ConfigurationError, f"mocap_node: {text}"):
        NatNetClient(MocapSettings(**{"server": "127.0.0.1"} | changes), lambda *_: None)


def test_a_server_that_starts_later_is_found():
    with Link(client=False) as link:
        address = link.server.address
        link.server.close()
        link.client.start()
        link.until_level(2, "check that Motive streams (Data Streaming, unicast")
        link.server = NatNetServer(scene, address=address, faults=link.faults, seed=9)
        assert link.until_level(0) < 1.5
        assert link.worst() < ACCURACY


def test_an_interface_without_a_network_is_named():
    with Link(settings={"interface": "192.0.2.77"}) as link:  # which is not there yet
        link.until_level(2, "no network")


def test_changed_rigid_bodies_are_asked_for():
    names = ["socket", "other"]

    def renamed(moment):
        return [(name, *rest[1:]) for name, rest in zip(names, scene(moment), strict=True)]

    with Link(bodies=renamed) as link:
        link.until_level(0)
        names[1] = "pylon"
        until(lambda: "pylon" in link.client._models, "the new body")


def test_a_client_that_was_forgotten_comes_back(link):
    link.server._clients = {}  # at once: its thread goes through the old ones
    received = len(link.frames)
    until(lambda: len(link.frames) > received + 10, "frames")
    link.until_level(0)
    assert link.client.figures()["sessions"] == 1  # the same server, and the same clock


def test_strangers_do_not_end_the_stream(link):
    _, port = link.client._sockets._sockets[0].getsockname()
    bad = link.client.figures()["bad_datagrams"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in (b"", b"\x00", b"\x07\x00\xff\xff", b"\x07\x00\x04\x00abcd", bytes(5000)):
            sender.sendto(data, ("127.0.0.1", port))
        until(lambda: link.client.figures()["bad_datagrams"] >= bad + 3, "the bad datagrams")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.2", 0))
        for _ in range(100):
            stranger.sendto(b"\x09\x00\x00\x00", ("127.0.0.1", port))  # DISCONNECT, not from it
    assert link.worst() < ACCURACY
    assert link.client.figures()["sessions"] == 1


def test_a_failing_callback_does_not_end_the_stream(link):
    link.client._on_frame = take = Mock(side_effect=ValueError("the callback's own"))
    until(lambda: take.call_count > 10, "frames")
    assert "the callback's own" in link.health()[1]


def test_takes_have_their_names_though_replies_are_lost(link):
    link.faults["mocap.drop"] = 0.3  # lost replies are asked for again and make no more takes
    link.client.set_recording("trial_1")
    until(lambda: link.server.recording, "the recording")
    until(lambda: link.client._takes.settled, "the answer")
    link.faults.clear()
    link.client.set_recording(None)
    until(lambda: not link.server.recording, "the end")
    link.client.set_recording("trial_2")
    until(lambda: link.server.takes == ["trial_1", "trial_2"], "another take")
    until(lambda: link.client.recording_fault == "", "the end of all faults")


def test_a_take_that_somebody_stopped_is_reported(link):
    link.client.set_recording("stopped")
    until(lambda: link.server.recording and link.client._takes.settled, "the recording")
    until(lambda: link.client.recording_fault == "", "the end of all faults")
    link.server.recording = False
    until(lambda: "does not record" in link.client.recording_fault, "the fault")
    link.client.set_recording(None)
    until(lambda: link.client._takes.settled, "the stop")


def test_a_client_that_closes_ends_its_take(link):
    link.client.set_recording("last")
    until(lambda: link.server.recording, "the recording")
    link.client.close()
    assert not link.server.recording
    until(lambda: not link.server._clients, "the farewell")


def has_no_fault(link) -> bool:
    return link.client.recording_fault == "" and link.health()[0] == 0


@pytest.fixture
def recording(link):
    link.client.set_recording("long")
    until(lambda: link.client._takes.settled and link.server.recording, "it")
    return link


def test_a_take_goes_on_after_a_lost_network(recording):
    recording.faults["mocap.unplugged"] = 1.0
    recording.until_level(2)
    recording.faults.clear()
    until(lambda: has_no_fault(recording), "the end of faults")
    assert recording.server.takes == ["long"]


def test_a_take_is_started_again_after_a_restart(recording):
    recording.faults["mocap.restart"] = 1.0
    until(lambda: recording.server.takes == ["long", "long"], "another take")
    until(lambda: has_no_fault(recording), "the end of faults")


def test_a_take_is_stopped_once_the_network_returns(recording):
    recording.faults["mocap.unplugged"] = 1.0
    recording.until_level(2)
    recording.client.set_recording(None)
    until(lambda: "no take is stopped: no conn" in recording.client.recording_fault, "the fault")
    recording.faults["mocap.unplugged"] = 0.0
    until(lambda: not recording.server.recording, "the end")


def test_a_group_is_heard_again_after_faults(group):
    with Link(multicast=group, crowded=True) as link:
        link.until_level(0)
        link.faults["mocap.unplugged"] = 1.0
        link.until_level(2)
        link.faults.clear()
        link.until_level(0)
        link.restart()
        assert link.worst() < ACCURACY


def test_a_data_port_of_another_program_is_named(group):
    with (
        Link(multicast=group, version=(4, 2), client=False) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        other.bind(("", group[1]))
        with refused(DeviceError, f"another program has the data port {group[1]}"):
            link.client.start()
