"""Numbers in tables, hints for wrong values, refused outputs, clocks: by hand."""

import math
import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from msgspec import Meta
from scipy.io import loadmat
from support.wording import refused

import socket_testbed
from socket_testbed import clocks, documents, files, tables
from socket_testbed.errors import ConfigurationError
from socket_testbed.tables import Table

# --- tables


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (0.12345, ".3g", "0.123"),
        (12.345, ".1f", "12.3"),
        (float("nan"), ".3g", "\N{EN DASH}"),
        (float("-inf"), ".3g", "\N{EN DASH}"),
    ],
)
def test_a_number_has_digits_or_a_dash(value: float, spec: str, text: str) -> None:
    assert tables.number(value, spec) == text
    assert tables.number(1234.56) == "1.23e+03"


@pytest.mark.parametrize(("seconds", "text"), [(90.9, "0:01:30"), (3661.0, "1:01:01")])
def test_a_duration_is_in_hours_minutes_seconds(seconds: float, text: str) -> None:
    assert tables.duration_text(seconds) == text


@pytest.mark.parametrize(
    ("title", "parts"),
    [
        ("distal.Fz [N]", ("distal.Fz", "N")),
        ("status [-]", ("status", "-")),
        ("cluster", ("cluster", "")),
        ("a [b] [N m]", ("a [b]", "N m")),
    ],
)
def test_a_title_is_split_into_name_and_unit(title: str, parts: tuple[str, str]) -> None:
    assert tables.split_unit(title) == parts


@pytest.fixture
def grouped() -> Table:
    """Numbers of two groups, and words."""
    columns = [("force", "mean [N]"), ("force", "peak [N]"), ("", "words"), ("count", "n [1]")]
    rows = [[1.23456, -0.0004, "a", 3], [np.nan, 2.0, "b", 4]]
    frame = pd.DataFrame(rows, index=["x", "y"], columns=pd.MultiIndex.from_tuples(columns))
    return Table("name", "caption", frame, {"mean [N]": ".1f", "count": "d"})


def test_a_table_has_groups_titles_and_kinds(grouped: Table) -> None:
    assert grouped.groups == [("force", 2), ("", 1), ("count", 1)]
    assert grouped.columns == [
        ("force", "mean [N]", True),
        ("force", "peak [N]", True),
        ("", "words", False),
        ("count", "n [1]", True),
    ]
    plain = Table("name", "caption", grouped.frame["force"])
    assert plain.groups == [] and plain.columns[0] == ("", "mean [N]", True)


def test_cells_have_the_format_of_column_or_group(grouped: Table) -> None:
    """By default three decimals, and no negative zero."""
    assert dict(grouped.rows) == {
        "x": ("1.2", "0.000", "a", "3"),
        "y": ("\N{EN DASH}", "2.000", "b", "4"),
    }


def test_pairs_are_rows_of_text() -> None:
    found = tables.pairs_table("facts", "Facts", [("side", "left"), ("mass", "61 kg")])
    assert (found.name, found.caption, found.is_text) == ("facts", "Facts", True)
    assert dict(found.rows) == {"side": ("left",), "mass": ("61 kg",)}
    assert found.frame.index.name == "name" and [*found.frame] == ["value"]


def test_matlab_names_are_valid_and_unique() -> None:
    given = ["a.b", "a b", "7", "units", "_x", "c" * 70, "c" * 71]
    assert tables.matlab_names(given) == [
        *("a_b", "a_b_2", "x7", "units_2", "x_x", "c" * 63, f"{'c' * 61}_2"),
    ]


def test_matlab_reads_missing_text_and_numbers(tmp_path: Path) -> None:
    frame = pd.DataFrame(
        {
            "words": ["a", None],
            "x [N]": [1.0, np.nan],
            "none [m]": pd.Series([None, None], dtype=object),
            "flag": [True, False],
        }
    )
    tables.write_table(frame, tmp_path / "a.mat")
    content = loadmat(tmp_path / "a.mat")
    assert [str(own[0][0]) if own[0].size else "" for own in content["words"]] == ["a", ""]
    assert content["x"].shape == (2, 1) and np.isnan(content["x"][1, 0])
    assert np.isnan(content["none"]).all() and content["flag"].ravel().tolist() == [1, 0]
    units = content["units"][0, 0]
    assert units["x"][0] == "N" and units["none"][0] == "m"


def test_a_column_without_values_keeps_its_kind(tmp_path: Path) -> None:
    frame = pd.DataFrame({"x [N]": [None, None], "words": [None, None]}, dtype=object)
    tables.write_table(frame, tmp_path / "a.parquet")
    schema = pq.read_schema(tmp_path / "a.parquet")
    assert [str(own.type) for own in schema] == ["double", "string"]


def test_a_table_has_one_of_three_formats(tmp_path: Path) -> None:
    with refused(
        ConfigurationError,
        "a.txt: '.txt' is not the format of a table: name a .csv, .parquet or .mat file",
    ):
        tables.write_table(pd.DataFrame({"a": [1]}), tmp_path / "a.txt")
    assert files.PICTURES == (".png", ".pdf", ".svg") and files.PAGES == (".html", ".htm")
    files.check_suffix(tmp_path / "a.CSV", files.TABLES, "table")


# --- hints for wrong values

TIMES = Annotated[float, Meta(ge=0.5, le=20.0, description="how long [s]")]
OPEN_ENDED = Annotated[float, Meta(ge=2.0, le=documents.FINITE)]
TENS = Annotated[float, Meta(ge=1.0, le=10.0)]
AT_MOST = Annotated[int, Meta(le=3)]


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        (int, 1.5, "x is 1.5: give a whole number that is finite"),
        (float, "a", "x is 'a': give a number that is finite"),
        (OPEN_ENDED, 1.0, "x is 1.0: give a finite number of at least 2"),
        (OPEN_ENDED, math.inf, "x is inf: give a finite number of at least 2"),
        (AT_MOST, 4, "x is 4: give a whole number of at most 3"),
        (TIMES, 21.0, "x is 21.0: give a number from 0.5 to 20: how long [s]"),
        (bool, 1, "x is 1: give true or false"),
        (str, True, "x is True: give a text, in quotes"),
        (list[int], {}, "x is an empty mapping: give a list"),
        (tuple[int, ...], 3, "x is 3: give a list"),
        (tuple[int, int], [1], "x is a list of 1: give a list of 2"),
        (tuple[tuple[int, int], ...], 3, "x is 3: give a list"),
        (tuple[tuple[int, int, int], tuple[int, int, int]], 3, "give a list of 2 lists of 3"),
        (dict[str, int], 3, "x is 3: give 'key: value' lines"),
        (dict[str, int], None, "x is empty: give 'key: value' lines"),
        (int | None, "a", "x is 'a': give a whole number that is finite"),
        (float | str, [], "x is a list of 0: give a text, in quotes"),
        (Literal["a", "bcd"], "bce", "x is 'bce': did you mean 'bcd'?"),
        (TENS | Literal["auto"], "c", "x is 'c': give a number from 1 to 10 or auto"),
        (Literal["a", "b"] | int, 1.5, "x is 1.5: give a or b or a whole number that is finite"),
        (Annotated[list[int], Meta(min_length=2, max_length=2)], [1], "give a list of 2"),
        (Annotated[list[int], Meta(min_length=2, max_length=4)], [1], "give a list of 2 to 4"),
        (int, {"a": 1}, "x is a mapping: give a whole number"),
        (list[int], [1, "b"], "x[1] is 'b': give a whole number"),
        (dict[str, list[int]], {"k": [1, 2, None]}, "x: k[2] is empty: give a whole number"),
    ],
)
def test_a_wrong_value_has_a_hint(kind: Any, value: Any, words: str) -> None:
    with refused(ConfigurationError, words):
        documents.convert(value, kind, "x")


@pytest.mark.parametrize(
    ("value", "text"),
    [("a" * 60, f"'{'a' * 60}'"), ("a" * 61, f"'{'a' * 60}...'"), ([1, 2], "a list of 2")],
    ids=["sixty", "longer", "list"],
)
def test_a_shown_value_is_short(value: Any, text: str) -> None:
    assert documents.shown(value) == text


def test_a_number_is_checked_by_its_limits() -> None:
    assert documents.check_number(np.float64(2.0), "--rate", 2.0, 5.0) == 2.0
    assert documents.check_number(5, "--rate", 2.0, 5.0) == 5.0
    for value in (1.999, 5.001, float("nan"), "a"):
        with refused(ConfigurationError, "--rate is ", ": give a number from 2 to 5"):
            documents.check_number(value, "--rate", 2.0, 5.0)


@pytest.mark.parametrize(
    ("text", "value"), [("-1.5e3", -1500.0), ("+.5", 0.5), ("7.", 7.0), ("1E2", 100.0)]
)
def test_decimal_digits_are_a_number(text: str, value: float) -> None:
    assert documents.decimal(text) == value


@pytest.mark.parametrize("text", ["nan", "1_000", " 1", "1e999", "", "0x1", "1e", "inf", "."])
def test_other_texts_are_no_number(text: str) -> None:
    with pytest.raises(ValueError, match="is not a number"):
        documents.decimal(text)


def test_json_has_null_for_what_is_not_finite() -> None:
    given = (1.5, float("nan"), (float("inf"), "a", 2))
    assert documents.finite_or_null(given) == [1.5, None, [None, "a", 2]]


def depth(levels: int) -> str:
    return "a: " + "[" * levels + "]" * levels


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (depth(49), ""),
        (depth(50), "too deep"),
        # The anchored list has 11 values with itself; 10 aliases of it make 110 more.
        ("a: &a [" + "1, " * 10 + "]\nb: [" + "*a, " * 18_180 + "]", ""),
        ("a: &a [" + "1, " * 10 + "]\nb: [" + "*a, " * 18_181 + "]", "holds more than 200000"),
        ("a: &a 1\nb: [" + "*a, " * 100_000 + "]", ""),
    ],
    ids=["deep", "too deep", "aliases", "bomb", "scalar"],
)
def test_yaml_has_limits(text: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    if not problem:
        assert "a" in documents.load_yaml(path)
        return
    with refused(ConfigurationError, problem, "correct the YAML there"):
        documents.load_yaml(path)


def test_an_unreadable_text_says_why(tmp_path: Path) -> None:
    with refused(ConfigurationError, "none.json: no such model: check the path"):
        documents.read_text(tmp_path / "none.json", "a model")
    with refused(ConfigurationError, "none.json: no such file: check the path"):
        documents.read_text(tmp_path / "none.json")
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xff\xfe")
    with refused(ConfigurationError, "a.txt: is not UTF-8 text: save it as text in UTF-8"):
        documents.read_text(path)
    with refused(ConfigurationError, "a.txt: is not a model (not UTF-8 text): save it"):
        documents.read_text(path, "a model")
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n")
    pointer = (
        "a.txt: is a Git LFS pointer, not the file itself: fetch the content with 'git lfs pull'"
    )
    with refused(ConfigurationError, pointer):
        documents.read_text(path)
    path.write_bytes(b"\xef\xbb\xbfab")
    assert documents.read_text(path) == "ab"
    path.write_text("x" * 2**20)
    assert len(documents.read_text(path, largest=2**20)) == 2**20
    with refused(ConfigurationError, "cannot be read (larger than 3 MiB): check that it is a scan"):
        path.write_text("x" * (3 * 2**20 + 1))
        documents.read_text(path, "a scan", 3 * 2**20)
    with refused(ConfigurationError, "cannot be read (Is a directory): check that it is a file"):
        documents.read_text(tmp_path)


def test_written_texts_that_look_like_numbers_come_back(tmp_path: Path) -> None:
    given = {"a": "2e1", "b": "010", "c": 1.5e-7, "d": "true", "e": "1:30", "f": [0.5, 3]}
    path = tmp_path / "a.yaml"
    path.write_text(documents.dump_yaml(given))
    assert documents.load_yaml(path) == given and [*documents.load_yaml(path)] == [*given]


# --- outputs


def test_an_existing_output_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.touch()
    with refused(ConfigurationError, f"{path} exists already: name another output or remove it"):
        files.refuse_existing(path)
    words = "name another output, or replace it with --replace (in Python, replace=True)"
    with refused(ConfigurationError, words):
        files.check_outputs(path, replace=False)
    files.check_outputs(path, replace=True)
    with refused(ConfigurationError, "exists already as a folder: name a file"):
        files.check_outputs(tmp_path, replace=True)
    with refused(ConfigurationError, "a.csv is not a folder", "make the folder first"):
        files.check_outputs(path / "b.csv", replace=True)
    with refused(ConfigurationError, "no such folder as", "make the folder first"):
        files.check_new_folder(tmp_path / "x" / "y" / "z")
    files.check_new_folder(tmp_path / "x" / "y")


def test_the_package_s_own_files_stand_in() -> None:
    assert files.file_or_packaged("", "socket.yaml").parts[-2:] == ("config", "socket.yaml")
    assert files.file_or_packaged("/a/b.yaml", "socket.yaml") == Path("/a/b.yaml")
    assert files.packaged("msg", "Trigger.msg").parts[-2:] == ("msg", "Trigger.msg")
    with refused(ConfigurationError, "config/none.yaml of the package is not installed"):
        files.packaged("config", "none.yaml")
    assert files.CONFIGURATION_FILES == ("socket.yaml", "calibration.yaml", "testbed.yaml")


def test_a_held_folder_is_seen(tmp_path: Path) -> None:
    assert not files.is_held(tmp_path)
    descriptor = files.hold(tmp_path)
    assert files.is_held(tmp_path)
    os.close(descriptor)
    assert not files.is_held(tmp_path)


@pytest.mark.parametrize(("age", "left"), [(50.0, True), (70.0, False)], ids=["young", "old"])
def test_remains_of_killed_processes_are_removed(
    age: float, left: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    mark = tmp_path / "socket_testbed_x" / ".temporary"
    mark.parent.mkdir()
    mark.touch()
    os.utime(mark, (time.time() - age,) * 2)
    with files.TemporaryFolder() as name:
        assert mark.exists() is left and Path(name).name.startswith("socket_testbed_")


@pytest.mark.parametrize(("parent", "ended"), [(7, False), (8, True)], ids=["lives", "ended"])
def test_a_process_ends_with_its_starter(
    parent: int, ended: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel sends SIGTERM when the starter ends; it may have ended before."""
    asked: list[tuple[int, int]] = []
    sent: list[tuple[int, int]] = []
    libc = SimpleNamespace(prctl=lambda *given: asked.append(given))
    monkeypatch.setattr(files.ctypes, "CDLL", lambda name: libc)
    monkeypatch.setattr(files.os, "kill", lambda *given: sent.append(given))
    monkeypatch.setattr(files.os, "getppid", lambda: parent)
    monkeypatch.delenv(files.PARENT, raising=False)
    files.end_with_starter()
    assert asked == []
    monkeypatch.setenv("SOCKET_TESTBED_PARENT", "7")
    files.end_with_starter()
    assert asked == [(1, signal.SIGTERM)]
    assert sent == [(os.getpid(), signal.SIGTERM)] * ended


# --- clocks


def test_a_slow_testbed_s_seconds_are_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a quarter of real time, 4 s of the machine are 1 s of the testbed."""
    slept: list[float] = []
    monkeypatch.setattr(clocks, "_scale", 0.25)
    monkeypatch.setattr(clocks.time, "monotonic", lambda: 40.0)
    monkeypatch.setattr(clocks.time, "monotonic_ns", lambda: 40_000_000_004)
    monkeypatch.setattr(clocks.time, "sleep", slept.append)
    assert clocks.time_scale() == 0.25
    assert (clocks.monotonic(), clocks.monotonic_ns()) == (10.0, 10_000_000_001)
    clocks.sleep(2.0)
    assert slept == [8.0] and clocks.real(2.0) == 8.0
    monkeypatch.setattr(clocks, "_scale", 1.0)
    monkeypatch.setattr(clocks.time, "monotonic_ns", lambda: 2**60 + 1)
    assert clocks.monotonic_ns() == 2**60 + 1  # to the nanosecond, which a float could not hold


def test_processes_of_a_graph_share_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clocks.time, "monotonic_ns", lambda: 40)
    monkeypatch.setattr(clocks.time, "time_ns", lambda: 1000)
    assert clocks.shared_environment(0.25) == {
        "SOCKET_TESTBED_TIME_SCALE": "0.25",
        "SOCKET_TESTBED_BEGINNING": "990",
    }
    assert clocks.shared_environment()["SOCKET_TESTBED_BEGINNING"] == "960"


@pytest.mark.parametrize(("text", "scale"), [("1", 1.0), ("0.0625", 0.0625)])
def test_the_scale_is_inherited(text: str, scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOCKET_TESTBED_TIME_SCALE", text)
    assert clocks._inherited_scale() == scale
    monkeypatch.delenv("SOCKET_TESTBED_TIME_SCALE")
    assert clocks._inherited_scale() == 1.0


@pytest.mark.parametrize("text", ["0", "1.001", "-1", "fast", "nan"])
def test_a_wrong_scale_ends_the_program(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOCKET_TESTBED_TIME_SCALE", text)
    with pytest.raises(SystemExit, match=f"TIME_SCALE={text}: set a number above 0, 1 at most"):
        clocks._inherited_scale()


def test_waits_double_up_to_the_longest() -> None:
    backoff = clocks.Backoff()
    assert backoff.due(0.0)
    assert [backoff.failed(10.0) for _ in range(5)] == [0.05, 0.1, 0.2, 0.4, 0.4]
    assert not backoff.due(10.39) and backoff.due(10.4)
    backoff.succeeded()
    assert backoff.due(0.0) and backoff.failed(0.0) == 0.05
    assert [clocks.Backoff(0.05).failed(0.0)] == [0.05]


def clock_at(wall: int) -> clocks.SteadyClock:
    return clocks.SteadyClock(lambda: wall, lambda: 5_000_000_000)


@pytest.mark.parametrize(
    ("late", "known"),
    [(-0.0019, True), (-0.0021, False), (0.0, True), (0.499, True), (0.501, False)],
)
def test_a_soon_trigger_s_time_is_known(
    late: float, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2 ms before it by two processes' clocks, or half a second after it."""
    monkeypatch.delenv(clocks.BEGINNING, raising=False)
    trigger = clocks.TriggerTime(clock_at(1_000_000_000_000))
    stamp = 1_000_000_000_000 + 3_000_000_000
    expected = 8.0 if known else -np.inf
    assert trigger.steady(stamp, 8.0 + late) == pytest.approx(expected)


@pytest.mark.parametrize(("spread", "found"), [(0.0049, True), (0.0051, False)])
def test_five_triggers_of_one_delay_give_the_shift(
    spread: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock was set forward by 60 s; a trigger takes 0.5 ms."""
    monkeypatch.delenv(clocks.BEGINNING, raising=False)
    trigger = clocks.TriggerTime(clock_at(1_000_000_000_000))
    for k in range(5):
        stamp = 1_000_000_000_000 + k * 1_000_000_000 + 60_000_000_000
        when = trigger.steady(stamp, 5.0 + k + 0.0005 + spread * (k == 2))
    assert (when == pytest.approx(9.0)) is found
    assert trigger.shift == pytest.approx(-60.0 if found else 0.0)


def test_the_period_is_the_last_five_s_middle() -> None:
    period, now, found = clocks.TriggerPeriod(), 0, []
    for number, step in enumerate((0, 5, 5, 5, 5, 5, 9, 9, 9)):
        now += step * 10**9
        found.append(period.add(now, number))
    assert found == pytest.approx([0, 0, 0, 5, 5, 5, 5, 5, 9])


# --- the package


def test_completion_offers_the_version_and_the_functions() -> None:
    offered = dir(socket_testbed)
    assert {"__version__", "open_trial", "pressure", "compare"} <= {*offered}
    assert offered == sorted(offered) and hasattr(socket_testbed, offered[0])
