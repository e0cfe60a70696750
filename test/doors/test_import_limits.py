"""What options of an import may be, at both ends of each limit, and their lines in full."""

from pathlib import Path
from typing import Any

import pytest

import socket_testbed as st
from socket_testbed.errors import ConfigurationError

# The least and the largest value of each option, whose unit is a second or a hertz, and one beyond.
LIMITS = {
    "delay": (-10, 10, 10.1, "10.1: give a number from -10 to 10"),
    "negative delay": (-10, 0, -10.1, "-10.1: give a number from -10 to 10"),
    "offset": (-1e7, 1e7, 1.1e7, "11000000.0: give a number from -1e+07 to 1e+07"),
    "row rate": (0.1, 20000, 0.09, "0.09: give a number from 0.1 to 20000"),
}


def imported(folder: Path, **options: Any) -> str:
    """The line with which an import of a bag that is not there ends."""
    with pytest.raises(st.TestbedError) as caught:
        st.import_trial(folder / "bag", folder / "trial", **options)
    return str(caught.value)


@pytest.mark.parametrize("case", LIMITS)
def test_a_number_of_a_source_has_its_limits(case: str, tmp_path: Path) -> None:
    least, most, beyond, limits = LIMITS[case]
    option = case.replace("negative ", "").replace(" ", "_")
    for good in (least, most):
        assert str(tmp_path / "bag") in imported(tmp_path, **{option: {"wrench": good}})
    assert (
        imported(tmp_path, **{option: {"wrench": beyond}}) == f"the {option} of wrench is {limits}"
    )


LINES: dict[str, tuple[dict[str, Any], str]] = {
    "delay in words": (
        {"delay": "wrench=soon"},
        "the delay of wrench is 'soon': give a source and a number, such as wrench=0.02, or"
        " wrench=auto",
    ),
    "offset in words": (
        {"offset": ["clusters=soon"]},
        "the offset of clusters is 'soon': give a source and a number, such as wrench=3, or"
        " wrench=tap",
    ),
    "row rate in words": (
        {"row_rate": "clusters=auto"},
        "the row_rate of clusters is 'auto': give a source and a number, such as wrench=100",
    ),
    "no source": (
        {"delay": ["wrench=0", "0.02", "0.03"]},
        "delay is '0.02': give a source and a number, such as wrench=0.02, or wrench=auto",
    ),
    "no column": ({"columns": ["Fx"]}, "columns is 'Fx': give a column and its title"),
    "no quantity": ({"units": ["N"]}, "units is 'N': give a quantity and its unit"),
    "rate too low": ({"rate": 0.05}, "--rate is 0.05: give a number from 0.1 to 1000"),
    "rate too high": ({"rate": 1001}, "--rate is 1001: give a number from 0.1 to 1000"),
    "both": ({"rate": 4, "trigger": "/x"}, "rate and trigger are both given: give one of them"),
    "of whom": (
        {"wrench_of": "sockets"},
        "wrench_of is 'sockets': did you mean 'socket'?",
    ),
}


@pytest.mark.parametrize("case", LINES)
def test_a_wrong_option_has_this_line(case: str, tmp_path: Path) -> None:
    options, line = LINES[case]
    with pytest.raises(ConfigurationError) as caught:
        st.import_trial(tmp_path / "bag", tmp_path / "trial", **options)
    assert str(caught.value) == line


MAPPINGS = {
    "delay": (
        "wrench: {delay: -10.1}", "wrench: delay is -10.1: give a number from -10 to 10 or auto",
    ),
    "delay in words": (
        "wrench: {delay: soon}", "wrench: delay is 'soon': give a number from -10 to 10 or auto",
    ),
    "offset": (
        "clusters: {offset: 1.1e+7}",
        "clusters: offset is 11000000.0: give a number from -1e+07 to 1e+07 or tap",
    ),
    "row rate": (
        "wrench: {row_rate: 0.09}",
        "wrench: row_rate is 0.09: give a number from 0.1 to 20000",
    ),
    "rate": ("rate: 1001", "rate is 1001: give a number from 0.1 to 1000"),
    "of whom": ("wrench: {of: sockets}", "wrench: of is 'sockets': did you mean 'socket'?"),
}  # fmt: skip


@pytest.mark.parametrize("case", MAPPINGS)
def test_a_wrong_mapping_has_this_line(case: str, tmp_path: Path) -> None:
    text, line = MAPPINGS[case]
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(text)
    assert imported(tmp_path, mapping=mapping) == f"{mapping}: {line}"


@pytest.mark.parametrize(
    "text",
    [
        *("wrench: {delay: -10}", "wrench: {delay: 10}", "wrench: {delay: auto}"),
        *("wrench: {row_rate: 0.1}", "wrench: {row_rate: 20000}", "rate: 0.1", "rate: 1000"),
    ],
)
def test_a_mapping_s_limits_are_within(text: str, tmp_path: Path) -> None:
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(text)
    assert str(tmp_path / "bag") in imported(tmp_path, mapping=mapping)
