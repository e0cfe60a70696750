"""NatNet datagrams: read back as written, and never read past their end."""

from dataclasses import replace
from struct import pack

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.wording import refused

from socket_testbed.drivers.natnet import messages
from socket_testbed.drivers.natnet.connection import Answer
from socket_testbed.simulation.devices import natnet_server as server

VERSIONS = [(3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3), (4, 4), (4, 5)]
EVERY_VERSION = pytest.mark.parametrize("version", VERSIONS, ids=[f"{a}.{b}" for a, b in VERSIONS])
INFO = messages.ServerInfo("Motive", (3, 1, 0, 0), (4, 1), 10_000_000, 1511, True, "239.255.42.99")
RNG = np.random.default_rng(1)
CONTENT = server.Content(
    number=4711,
    ticks=(123_456_789_012, 5, 6),
    bodies=[server.Body(k, RNG.normal(size=3), RNG.normal(size=4)) for k in (1, 2)],
    markers=[
        server.Marker(1, 1, RNG.normal(size=3)),
        server.Marker(1, 2, RNG.normal(size=3), server.OCCLUDED),
        server.Marker(2, 3, RNG.normal(size=3), server.MODEL_FILLED),
        server.Marker(2, 1, np.array([np.nan, 0.0, 0.0])),
    ],
    recording=True,
    models_changed=True,
)
DEFINITIONS = [
    messages.RigidBodyDefinition("socket", 3, RNG.normal(size=(3, 3))),
    messages.RigidBodyDefinition("Prothese \u00e4", 9, RNG.normal(size=(4, 3))),
]
ENCODED = {
    (version, kind): message
    for version in VERSIONS
    for kind, message in (
        (messages.FRAME, server.encode_frame(CONTENT, version)),
        (messages.MODELDEF, server.encode_model_definitions(DEFINITIONS, version)),
        (messages.SERVERINFO, server.encode_server_info(INFO)),
    )
}

# Frames by hand, every section of which holds something.
_RIGID = pack("<i3f4ffh", 5, 1, 2, 3, 0, 0, 0, 1, 1e-4, 1)
_SETS = b"socket\0" + pack("<i3f", 1, 0, 0, 0)
_SKELETON = pack("<ii", 7, 1) + _RIGID
_LABELLED = pack("<i3ffhf", 5 << 16 | 2, 4, 5, 6, 0.01, 10, 1e-4)
_PLATE = pack("<iii2fif", 9, 2, 2, 1.0, 2.0, 1, 3.0)
_ASSET = pack("<ii", 8, 1) + _RIGID + pack("<i", 1) + _LABELLED
FRAME_3_1 = pack("<i", 17)
for _part in (_SETS, pack("<3f", 9, 9, 9), _RIGID, _SKELETON, _LABELLED, _PLATE, _PLATE):
    FRAME_3_1 += pack("<i", 1) + _part
FRAME_3_1 += pack("<IIdQQQhi", 0, 0, 1.5, 1000, 1001, 1002, 1, 0)
FRAME_4_1 = pack("<i", 18)
for _part in (_SETS, pack("<3f", 9, 9, 9), _RIGID, _SKELETON, _ASSET, _LABELLED, _PLATE, _PLATE):
    FRAME_4_1 += pack("<ii", 1, len(_part)) + _part
_END = pack("<IIdQQQIIhi", 0, 0, 1.5, 1000, 1001, 1002, 0, 0, 2, 0)
_IMU, _GPIO = pack("<i10f", 11, *range(10)), pack("<iI", 12, 5)
_BEFORE_END = FRAME_4_1
FRAME_4_1 += _END
FRAME_4_5 = _BEFORE_END + pack("<ii", 1, 44) + _IMU + pack("<ii", 2, 16) + 2 * _GPIO + _END
# A section that nobody knows yet, whose elements have one byte.
FRAME_4_6 = FRAME_4_5[: -len(_END)] + pack("<ii", 3, 3) + b"abc" + _END

_KINDS = {messages.FRAME: "frame", messages.MODELDEF: "models", messages.SERVERINFO: "server"}
DATAGRAMS = [
    *((version, message.data) for (version, _), message in ENCODED.items()),
    ((3, 1), messages.encode_message(messages.FRAME, FRAME_3_1)),
    ((4, 1), messages.encode_message(messages.FRAME, FRAME_4_1)),
    ((4, 5), messages.encode_message(messages.FRAME, FRAME_4_5)),
]
DATAGRAM_NAMES = [
    *(f"{_KINDS[kind]}-{major}.{minor}" for (major, minor), kind in ENCODED),
    "full-frame-3.1",
    "full-frame-4.1",
    "full-frame-4.5",
]


def parse(datagram: bytes, version):
    message, payload = messages.split_datagram(datagram)
    if message == messages.FRAME:
        return messages.parse_frame(payload, version)
    if message == messages.MODELDEF:
        return messages.parse_model_definitions(payload, version)
    return messages.parse_server_info(payload)


@EVERY_VERSION
def test_a_frame_is_read_as_it_was_written(version):
    frame = parse(ENCODED[version, messages.FRAME].data, version)
    assert (frame.number, frame.mid_exposure, frame.bodies) == (4711, 123_456_789_012, (1, 2))
    assert frame.recording and frame.models_changed
    assert [(m.model, m.member) for m in frame.markers] == [(1, 1), (1, 2), (2, 3), (2, 1)]
    assert [m.seen for m in frame.markers] == [True, False, False, False]
    for found, written in zip(frame.markers, CONTENT.markers, strict=True):
        np.testing.assert_allclose(found.position, written.position, rtol=1e-6)


@EVERY_VERSION
def test_definitions_are_read_as_they_were_written(version):
    models = parse(ENCODED[version, messages.MODELDEF].data, version)
    assert {name: m.id for name, m in models.items()} == {"socket": 3, "Prothese \u00e4": 9}
    for written in DEFINITIONS:
        np.testing.assert_allclose(models[written.name].markers, written.markers, rtol=1e-6)


@EVERY_VERSION
def test_the_server_s_description_is_read_as_written(version):
    assert parse(ENCODED[version, messages.SERVERINFO].data, version) == INFO


@pytest.mark.parametrize(
    ("payload", "version"),
    [
        pytest.param(FRAME_3_1, (3, 1), id="3.1"),
        pytest.param(FRAME_4_1, (4, 1), id="4.1"),
        pytest.param(FRAME_4_5, (4, 5), id="4.5"),
        pytest.param(FRAME_4_1, (4, 6), id="4.1-for-4.6"),
        pytest.param(FRAME_4_6, (4, 6), id="4.6"),
    ],
)
def test_a_frame_with_every_section_is_read(payload, version):
    frame = messages.parse_frame(payload, version)
    sized = version >= (4, 1)
    assert (frame.number, frame.mid_exposure, frame.bodies) == (17 + sized, 1000, (5,))
    assert frame.markers == ((5, 2, (4.0, 5.0, 6.0), True),)
    assert (frame.recording, frame.models_changed) == (not sized, sized)


@pytest.mark.parametrize(
    ("section", "fact"),
    [
        pytest.param(pack("<ii", 1, 45) + _IMU, "frame of ", id="one-too-long"),
        pytest.param(pack("<ii", 1, 43) + _IMU, "frame of ", id="one-too-short"),
        pytest.param(pack("<ii", 1, 44) + _IMU[:-9], "frame of ", id="truncated"),
        pytest.param(pack("<ii", 1, 5000) + _IMU, "a count of 5000 before", id="beyond-the-end"),
        pytest.param(pack("<ii", 1, -1) + _IMU, "a count of -1 before", id="negative"),
        pytest.param(b"", "1 sections after the devices", id="missing"),
    ],
)
def test_an_unknown_section_whose_size_lies_is_malformed(section: bytes, fact: str) -> None:
    with refused(messages.MalformedDatagram, fact):
        messages.parse_frame(_BEFORE_END + section + pack("<ii", 1, 8) + _GPIO + _END, (4, 5))


@pytest.mark.parametrize("streamed", [(4, 1), (4, 2), (4, 4)], ids=["4.1", "4.2", "4.4"])
def test_definitions_of_another_version_are_read(streamed: tuple[int, int]) -> None:
    for version in ((4, 1), (4, 4), (4, 5)):
        models = parse(ENCODED[streamed, messages.MODELDEF].data, version)
        assert {name: (m.id, len(m.markers)) for name, m in models.items()} == {
            "socket": (3, 3),
            "Prothese \u00e4": (9, 4),
        }


@pytest.mark.parametrize(("version", "known"), [((4, 4), False), ((4, 5), True), ((5, 0), True)])
def test_a_longer_definition_keeps_name_and_id(version: tuple[int, int], known: bool) -> None:
    body = b"socket\0" + pack("<ii", 3, -1) + bytes(99)  # anchors, say, since 4.5
    payload = pack("<iii", 1, 1, len(body)) + body
    if not known:
        with refused(messages.MalformedDatagram, "ends elsewhere"):
            messages.parse_model_definitions(payload, version)
        return
    models = messages.parse_model_definitions(payload, version)
    assert models == {"socket": messages.RigidBodyDefinition("socket", 3, ())}


@pytest.mark.parametrize("version", [(3, 1), (4, 1), (4, 5), (4, 6)])
def test_a_crowded_frame_has_the_same_bodies(version: tuple[int, int]) -> None:
    crowded = server.encode_frame(replace(CONTENT, crowded=True), version).data
    plain = server.encode_frame(CONTENT, version).data
    assert len(crowded) > len(plain) + 100
    assert repr(parse(crowded, version)) == repr(parse(plain, version))


@pytest.mark.parametrize(
    ("version", "names"),
    [pytest.param((3, 1), b"", id="3.1"), pytest.param((4, 0), b"m\0", id="4.0")],
)
def test_definitions_besides_rigid_bodies_are_passed_over(version, names):
    rigid = pack("<ii3fi3f", 5, -1, 0, 0, 0, 1, 1, 2, 3) + bytes(4) + names
    others = {
        0: b"set\0" + pack("<i", 2) + b"a\0b\0",
        2: b"skeleton\0" + pack("<ii", 1, 1) + b"bone\0" + rigid,
        3: pack("<i", 1) + b"serial\0" + bytes(4 * 161 + 8) + pack("<i", 1) + b"Fx\0",
        4: pack("<i", 1) + b"device\0serial\0" + bytes(8) + pack("<i", 1) + b"0\0",
        5: b"camera\0" + bytes(28),
        1: b"socket\0" + rigid,
    }
    payload = pack("<i", 6) + b"".join(pack("<i", kind) + d for kind, d in others.items())
    models = messages.parse_model_definitions(payload, version)
    assert set(models) == {"socket"} and models["socket"].markers == ((1.0, 2.0, 3.0),)


@pytest.mark.parametrize(("version", "whole"), DATAGRAMS, ids=DATAGRAM_NAMES)
def test_a_message_cut_anywhere_is_malformed(version, whole):
    for end in range(len(whole)):
        # Also with a header that does not give it away.
        cut = whole[:2] + pack("<H", max(end - 4, 0)) + whole[4:end]
        for datagram in (whole[:end], cut):
            with pytest.raises(messages.MalformedDatagram):
                parse(datagram, version)


@settings(max_examples=500, derandomize=True, deadline=None)
@given(
    st.sampled_from(DATAGRAMS),
    st.lists(st.tuples(st.integers(4, 10_000), st.binary(min_size=1, max_size=4)), max_size=5),
    st.binary(max_size=40),
)
def test_noise_is_malformed_or_a_message(message, changes, rest):
    version, whole = message
    data = bytearray(whole)
    for at, new in changes:
        begin = 4 + at % (len(data) - 4)
        data[begin : begin + len(new)] = new
    for datagram in (bytes(data), bytes(data[:4]) + rest, rest):
        try:
            parse(datagram, version)
        except messages.MalformedDatagram as error:
            assert "\n" not in str(error)


def test_a_count_that_lies_does_no_harm(rng):
    found_out = 0
    for version in VERSIONS:
        truth = parse(ENCODED[version, messages.FRAME].data, version)
        for _ in range(100):
            try:
                frame = parse(ENCODED[version, messages.FRAME].corrupted(rng), version)
                assert repr(frame.markers) == repr(truth.markers)  # NaN is not equal to itself
                found = parse(ENCODED[version, messages.MODELDEF].corrupted(rng), version)
                assert {model.id for model in found.values()} <= {3, 9}, version
            except messages.MalformedDatagram:
                found_out += 1
    assert found_out > 300


def test_a_clock_of_0_hz_is_malformed():
    payload = ENCODED[(4, 1), messages.SERVERINFO].data[4:]
    with refused(messages.MalformedDatagram, "clock of 0 Hz"):
        messages.parse_server_info(payload[:264] + bytes(8) + payload[272:])


def test_requests_have_the_documented_bytes():
    command = messages.encode_command("FrameRate")
    assert command == pack("<HH", messages.REQUEST, 10) + b"FrameRate\0"
    assert messages.encode_echo(258) == pack("<HHQ", messages.ECHOREQUEST, 8, 258)
    connect = messages.encode_connect("x" * 300, (4, 1))
    assert connect[:4] == pack("<HH", messages.CONNECT, 269) and len(connect) == 4 + 269
    assert connect[4:260] == b"x" * 255 + b"\0" and connect[-5:] == bytes((0, 4, 1, 0, 0))


def test_answers_are_understood():
    assert messages.parse_echo(pack("<QQ", 1, 2**63)) == (1, 2**63)
    assert Answer(bytes(4)).fault("LiveMode") == ""
    assert Answer(pack("<i", -3)).fault("LiveMode") == "the server refuses LiveMode (-3)"
