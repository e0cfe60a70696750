"""NatNet datagrams: read back as written, and never read past their end."""

import pickle
import time
from struct import pack

import numpy as np
import pytest

from socket_testbed.drivers.natnet.connection import Answer
from socket_testbed.drivers.natnet.messages import (
    CONNECT,
    ECHOREQUEST,
    FRAME,
    MODELDEF,
    REQUEST,
    SERVERINFO,
    MalformedDatagram,
    ServerInfo,
    encode_command,
    encode_connect,
    encode_echo,
    parse_echo,
    parse_frame,
    parse_model_definitions,
    parse_server_info,
    split_datagram,
)
from socket_testbed.simulation.devices.natnet_encoding import (
    MODEL_FILLED,
    OCCLUDED,
    Body,
    Content,
    Definition,
    Marker,
    Message,
    encode_frame,
    encode_model_definitions,
    encode_server_info,
)

VERSIONS = [
    (2, 6), (2, 7), (2, 9), (2, 10), (2, 11), (3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3),
    (4, 4),
]  # fmt: skip
INFO = ServerInfo("Motive", (3, 1, 0, 0), (4, 1), 10_000_000, 1511, True, "239.255.42.99")


def body(rng, identity, tracked=True):
    return Body(identity, rng.normal(size=3), rng.normal(size=4), rng.normal(size=(3, 3)), tracked)


def content(rng) -> Content:
    """A frame in which no section is empty."""
    return Content(
        number=4711,
        ticks=(123_456_789_012, 5, 6),
        timestamp=12.5,
        bodies=[body(rng, 1), body(rng, 2, tracked=False)],
        markers=[
            Marker(1, 1, rng.normal(size=3)),
            Marker(1, 2, rng.normal(size=3), OCCLUDED),
            Marker(2, 3, rng.normal(size=3), MODEL_FILLED),
            Marker(2, 1, np.array([np.nan, 0.0, 0.0])),
        ],
        marker_sets={"all": rng.normal(size=(4, 3)), "": np.empty((0, 3))},
        others=rng.normal(size=(2, 3)),
        skeletons=[(7, [body(rng, 71), body(rng, 72)])],
        assets=[(8, [body(rng, 81)], [Marker(8, 1, rng.normal(size=3))])],
        plates=[(9, [[1.0, 2.0], [3.0]])],
        devices=[(10, [[], [4.0]])],
        recording=True,
        models_changed=True,
    )


def definitions(rng) -> list[Definition]:
    return [Definition("socket", 3, rng.normal(size=(3, 3))),
            Definition("Prothese \u00e4", 9, rng.normal(size=(4, 3)))]  # fmt: skip


def messages(version, rng) -> dict[int, Message]:
    return {
        FRAME: encode_frame(content(rng), version),
        MODELDEF: encode_model_definitions(definitions(rng), version),
        SERVERINFO: encode_server_info(INFO),
    }


def parse(datagram: bytes, version):
    """Whatever a client makes of a datagram."""
    message, payload = split_datagram(datagram)
    if message == FRAME:
        return parse_frame(payload, version)
    if message == MODELDEF:
        return parse_model_definitions(payload, version)
    return parse_server_info(payload)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_is_read_as_it_was_written(version):
    rng = np.random.default_rng(1)
    truth = content(rng)
    frame = parse(bytes(encode_frame(truth, version).data), version)
    assert frame.number == 4711
    assert frame.timestamp == 12.5
    assert frame.mid_exposure == (123_456_789_012 if version >= (3, 0) else 0)
    assert frame.recording and frame.models_changed and not frame.bitstream_changed
    assert [(b.id, b.tracked) for b in frame.bodies] == [(1, True), (2, False)]
    for found, written in zip(frame.bodies, truth.bodies, strict=True):
        np.testing.assert_allclose(found.position, written.position, rtol=1e-6)
        np.testing.assert_allclose(found.quaternion, written.quaternion, rtol=1e-6)
    assert [(m.model, m.member) for m in frame.markers] == [(1, 1), (1, 2), (2, 3), (2, 1)]
    assert [m.occluded for m in frame.markers] == [False, True, False, True]
    assert [m.model_filled for m in frame.markers] == [False, False, True, False]
    for found, written in zip(frame.markers, truth.markers, strict=True):
        np.testing.assert_allclose(found.position, written.position, rtol=1e-6)


@pytest.mark.parametrize("version", VERSIONS)
def test_an_empty_frame_is_one(version):
    frame = parse(bytes(encode_frame(Content(number=0), version).data), version)
    assert frame.bodies == frame.markers == ()


@pytest.mark.parametrize("version", VERSIONS)
def test_definitions_are_read_as_they_were_written(version):
    truth = definitions(np.random.default_rng(1))
    models = parse(bytes(encode_model_definitions(truth, version).data), version)
    assert {model.id for model in models.values()} == {3, 9}
    for written in truth:
        found = models[written.name]
        assert (found.name, found.id) == (written.name, written.id)
        if version >= (3, 0):
            np.testing.assert_allclose(found.markers, written.markers, rtol=1e-6)


def test_what_is_defined_besides_rigid_bodies_is_passed_over():
    triad = pack("<i", 1) + pack("<3f", 1, 2, 3) + bytes(4)

    def rigid(name, names):
        return name + pack("<ii3f", 5, -1, 0, 0, 0) + triad + names

    for version, names in (((3, 1), b""), ((4, 0), b"m\0")):
        others = {
            0: b"set\0" + pack("<i", 2) + b"a\0b\0",
            2: b"skeleton\0" + pack("<ii", 1, 1) + rigid(b"bone\0", names),
            3: pack("<i", 1) + b"serial\0" + bytes(4 * 161 + 8) + pack("<i", 1) + b"Fx\0",
            4: pack("<i", 1) + b"device\0serial\0" + bytes(8) + pack("<i", 1) + b"0\0",
            5: b"camera\0" + bytes(28),
        }
        payload = pack("<i", 6)
        for kind, data in others.items():
            payload += pack("<i", kind) + data
        payload += pack("<i", 1) + rigid(b"socket\0", names)
        models = parse_model_definitions(payload, version)
        assert models["socket"].markers == ((1.0, 2.0, 3.0),)
        assert set(models) == {"socket"}
    sized = pack("<iii", 2, 99, 5) + b"what?" + pack("<ii", 1, len(rigid(b"a\0", b"m\0")))
    assert set(parse_model_definitions(sized + rigid(b"a\0", b"m\0"), (4, 1))) == {"a"}
    with pytest.raises(MalformedDatagram, match="unknown type 99"):
        parse_model_definitions(pack("<ii", 1, 99) + bytes(50), (3, 1))


def test_a_frame_of_3_1_by_hand():
    payload = (
        pack("<i", 17)
        + pack("<i", 1) + b"socket\0" + pack("<i3f", 1, 0, 0, 0)  # marker sets
        + pack("<i3f", 1, 9, 9, 9)  # other markers
        + pack("<i", 1) + pack("<i3f4ffh", 5, 1, 2, 3, 0, 0, 0, 1, 1e-4, 1)  # rigid bodies
        + pack("<i", 0)  # skeletons
        + pack("<i", 1) + pack("<i3ffhf", 5 << 16 | 2, 4, 5, 6, 0.01, 10, 1e-4)  # labelled
        + pack("<i", 0)  # force plates
        + pack("<i", 0)  # devices
        + pack("<IIdQQQhi", 0, 0, 1.5, 1000, 1001, 1002, 1, 0)
    )  # fmt: skip
    frame = parse_frame(payload, (3, 1))
    assert (frame.number, frame.timestamp, frame.mid_exposure) == (17, 1.5, 1000)
    assert frame.bodies == ((5, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), True),)
    assert frame.markers == ((5, 2, (4.0, 5.0, 6.0), False, False),)
    assert frame.recording and not frame.models_changed


def test_a_frame_of_4_1_by_hand():
    payload = (
        pack("<i", 18)
        + pack("<ii", 1, 7 + 16) + b"socket\0" + pack("<i3f", 1, 0, 0, 0)
        + pack("<ii3f", 1, 12, 9, 9, 9)
        + pack("<ii", 1, 38) + pack("<i3f4ffh", 5, 1, 2, 3, 0, 0, 0, 1, 1e-4, 0)
        + pack("<ii", 0, 0)
        + pack("<ii", 0, 0)  # assets
        + pack("<ii", 1, 26) + pack("<i3ffhf", 5 << 16 | 3, 4, 5, 6, 0.01, 5, 1e-4)
        + pack("<ii", 0, 0)
        + pack("<ii", 0, 0)
        + pack("<IIdQQQIIhi", 0, 0, 1.5, 1000, 1001, 1002, 0, 0, 2, 0)
    )  # fmt: skip
    frame = parse_frame(memoryview(payload), (4, 1))
    assert (frame.number, frame.mid_exposure) == (18, 1000)
    assert frame.bodies == ((5, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), False),)
    assert frame.markers == ((5, 3, (4.0, 5.0, 6.0), True, True),)
    assert frame.models_changed and not frame.recording


@pytest.mark.parametrize("version", VERSIONS)
def test_a_message_cut_anywhere_is_malformed_and_nothing_worse(version):
    for message in messages(version, np.random.default_rng(2)).values():
        whole = bytes(message.data)
        parse(whole, version)
        for end in range(len(whole)):
            with pytest.raises(MalformedDatagram):
                parse(whole[:end], version)
            # The same with a header that does not give it away.
            cut = whole[:2] + pack("<H", max(end - 4, 0)) + whole[4:end]
            with pytest.raises(MalformedDatagram):
                parse(cut, version)


@pytest.mark.parametrize("version", VERSIONS)
def test_noise_is_malformed_or_a_message_and_nothing_worse(version):
    rng = np.random.default_rng(3)
    whole = [bytes(message.data) for message in messages(version, rng).values()]
    start = time.process_time()
    for round_ in range(1500):
        parse(whole[round_ % len(whole)], version)
    sound = time.process_time() - start
    malformed = 0
    start = time.process_time()
    for round_ in range(1500):
        data = bytearray(whole[round_ % len(whole)])
        for _ in range(int(rng.integers(1, 6))):
            data[int(rng.integers(4, len(data)))] = int(rng.integers(256))
        try:
            parse(bytes(data), version)
        except MalformedDatagram:
            malformed += 1
    for _ in range(300):
        try:
            parse(rng.bytes(int(rng.integers(0, 400))), version)
        except MalformedDatagram:
            malformed += 1
    assert malformed > 100
    # A count that lies is found out at once, not element by element.
    assert time.process_time() - start < 10.0 * sound


@pytest.mark.parametrize("version", [v for v in VERSIONS if v >= (3, 0)])
def test_a_count_that_lies_is_found_out_or_does_no_harm(version):
    rng = np.random.default_rng(4)
    message = encode_frame(content(rng), version)
    truth = parse(bytes(message.data), version)
    found_out = 0
    for _ in range(1500):
        try:
            frame = parse(message.corrupted(rng), version)
        except MalformedDatagram:
            found_out += 1
            continue
        assert frame.mid_exposure == truth.mid_exposure
        assert repr(frame.markers) == repr(truth.markers)  # NaN is not equal to itself
    assert found_out > 500
    models = encode_model_definitions(definitions(rng), version)
    for _ in range(500):
        try:
            found = parse(models.corrupted(rng), version)
            assert {model.id for model in found.values()} <= {3, 9}
        except MalformedDatagram:
            found_out += 1


def test_too_old_a_stream_is_malformed():
    with pytest.raises(MalformedDatagram, match="too old"):
        parse_frame(bytes(100), (2, 5))


def test_a_server_tells_of_itself():
    _, payload = split_datagram(bytes(encode_server_info(INFO).data))
    assert parse_server_info(payload) == INFO
    assert parse_server_info(payload[:264][:-4] + bytes((2, 10, 0, 0))).clock == 0
    with pytest.raises(MalformedDatagram, match="clock of 0 Hz"):
        parse_server_info(payload[:264] + bytes(8) + payload[272:])


def test_requests_have_the_documented_bytes():
    assert encode_command("FrameRate") == pack("<HH", REQUEST, 10) + b"FrameRate\0"
    assert encode_echo(258) == pack("<HHQ", ECHOREQUEST, 8, 258)
    connect = encode_connect("x" * 300, (4, 1))
    assert connect[:4] == pack("<HH", CONNECT, 269)
    assert len(connect) == 4 + 269
    assert connect[4:260] == b"x" * 255 + b"\0"
    assert connect[-5:] == bytes((0, 4, 1, 0, 0))


def test_replies():
    assert parse_echo(pack("<QQ", 1, 2**63)) == (1, 2**63)
    with pytest.raises(MalformedDatagram):
        parse_echo(bytes(15))
    assert Answer(bytes(4)).accepted
    assert not Answer(pack("<i", 1)).accepted
    assert not Answer(bytes(4), recognized=False).accepted
    assert Answer(pack("<i", -3)).text == "-3"
    assert Answer(b"Bitstream,4.1\0").text == "Bitstream,4.1"


def test_the_error_survives_a_process_boundary():
    with pytest.raises(MalformedDatagram) as raised:
        parse_frame(b"", (4, 1))
    again = pickle.loads(pickle.dumps(raised.value))
    assert (again.fact, again.hint) == (raised.value.fact, raised.value.hint)
