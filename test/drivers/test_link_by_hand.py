"""Figures and lines of a link to Motive, against frames and faults counted by hand."""

import pytest

from socket_testbed.drivers.natnet.client import LinkStatistics, NatNetClient
from socket_testbed.drivers.natnet.connection import bitstream_version, server_address
from socket_testbed.errors import ConfigurationError
from socket_testbed.settings.acquisition import MocapSettings

NOW = 100.0  # [s]


def counted(*events: tuple[float, str, int]) -> LinkStatistics:
    """Statistics of events: how long before NOW [s], what, and how many."""
    found = LinkStatistics()
    for before, kind, number in events:
        found.count(kind, NOW - before, number, error=f"the {number}" if "bad" in kind else "")
    return found


@pytest.mark.parametrize(
    ("events", "line"),
    [
        ([], ""),
        ([(0.5, "frames", 30)], ""),
        ([(0.7, "lost_frames", 3), (0.1, "lost_frames", 2)], "5 lost frames"),
        ([(0.9, "lost_frames", 3), (0.1, "lost_frames", 2)], "2 lost frames"),
        ([(0.2, "duplicate_or_late_frames", 1)], "1 duplicate or late frames"),
        ([(0.2, "frames_of_implausible_time", 4)], "4 frames of implausible time"),
        (
            [(0.2, "bad_datagrams", 1), (0.1, "bad_datagrams", 2)],
            "3 bad datagrams (the last: the 2)",
        ),
        (
            [(0.2, "frames_that_could_not_be_used", 1), (0.1, "bad_datagrams", 2)],
            "2 bad datagrams, 1 frames that could not be used (the last: the 2)",
        ),
    ],
    ids=["none", "frames", "sum", "old", "late", "implausible", "last", "two"],
)
def test_recent_faults_are_counted_in_a_line(
    events: list[tuple[float, str, int]], line: str
) -> None:
    assert counted(*events).warning(NOW) == line


def test_totals_count_all_since_the_start() -> None:
    found = counted((60.0, "lost_frames", 3), (0.1, "lost_frames", 2), (0.1, "frames", 1))
    assert {name: number for name, number in found.totals().items() if number} == {
        "frames": 1,
        "lost_frames": 5,
    }


def test_the_rate_is_that_of_the_last_second() -> None:
    """Eleven frames in the second, 0.08 s apart, after many quick ones."""
    quick = [(2.0 - 0.001 * row, "frames", 1) for row in range(900)]
    steady = [(0.9 - 0.08 * row, "frames", 1) for row in range(11)]
    assert counted(*quick, *steady).rate(NOW) == pytest.approx(12.5)
    assert counted(*steady[:1]).rate(NOW) == 0.0


def test_silence_begins_with_the_second_frame() -> None:
    assert counted((0.9, "frames", 1)).silence(NOW) == float("inf")
    assert counted((0.9, "frames", 1), (0.25, "frames", 1)).silence(NOW) == pytest.approx(0.25)


def test_lost_and_late_frames_are_told_by_number() -> None:
    """8 and 9 are lost; 9 comes late, and 10 again."""
    client = NatNetClient(MocapSettings(server="127.0.0.1"), lambda *_: None)
    newer = [client._is_next(number, NOW) for number in (7, 10, 9, 10, 11)]
    assert newer == [True, True, False, False, True]
    figures = client.figures()
    assert (figures["lost_frames"], figures["duplicate_or_late_frames"]) == (2, 2)


@pytest.mark.parametrize(
    ("setting", "version"), [("3.0", (3, 0)), ("4.1", (4, 1)), ("10.12", (10, 12))]
)
def test_a_bitstream_is_major_and_minor(setting: str, version: tuple[int, int]) -> None:
    assert bitstream_version(MocapSettings(bitstream=setting)) == version


REFUSED = {
    "no server": ({}, "server is empty: give the address of the computer that runs Motive"),
    "no address": (
        {"interface": "eth0"}, "interface is 'eth0': give an IPv4 address, or nothing",
    ),
    "no group": (
        {"multicast": "223.255.255.255"},
        "multicast is '223.255.255.255', which is not a multicast group: give 239.255.42.99, say",
    ),
    "old": (
        {"bitstream": "2.99"},
        "bitstream is '2.99', which is too old: give 3.0 or later, such as 4.1",
    ),
    "no version": ({"bitstream": "4"}, "bitstream is '4': give a version such as 4.1"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_address_has_this_line(case: str) -> None:
    changes, line = REFUSED[case]
    server = {"server": "127.0.0.1"} if changes else {}
    with pytest.raises(ConfigurationError) as caught:
        NatNetClient(MocapSettings(**server, **changes), lambda *_: None)
    assert str(caught.value) == f"mocap_node: {line}"


def test_a_server_has_its_address_and_command_port() -> None:
    """The first group of the range of groups is one."""
    settings = MocapSettings(server=" 127.0.0.1 ", command_port=1512, multicast="224.0.0.0")
    assert server_address(settings) == ("127.0.0.1", 1512)
