"""Tables and their columns: what is wrong is named with its line, and no unit is guessed."""

import numpy as np
import pytest

from socket_testbed.calibration.bench_data import (
    BenchColumn,
    find_columns,
    read_table,
    split_title,
)
from socket_testbed.errors import CalibrationError


def table_of(tmp_path, text: str, encoding: str = "utf-8"):
    path = tmp_path / "bench.csv"
    path.write_bytes(text.encode(encoding))
    return read_table(path)


def refusal(call, *arguments) -> CalibrationError:
    with pytest.raises(CalibrationError) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize(
    "text",
    [
        "a,b\n1.5,-2e3\n.25,7\n",
        "a;b\n1,5;-2e3\n,25;7\n",
        "a;b\n1.5;-2e3\n.25;7\n",
        "a\tb\n1,5\t-2e3\n0,25\t7\n",
        '"a","b"\r\n"1.5","-2e3"\r\n\r\n"0.25","7"\r\n,\r\n',
        "\ufeffa,b\n 1.5 ,-2000\n0.25,+7",
    ],
)
def test_a_table_is_the_same_however_it_is_written(tmp_path, text):
    table = table_of(tmp_path, text)
    assert table.header == ("a", "b")
    np.testing.assert_array_equal(BenchColumn(table, "a", 0).numbers(), [1.5, 0.25])
    np.testing.assert_array_equal(BenchColumn(table, "b", 1).numbers(), [-2000.0, 7.0])


def test_lines_are_those_of_the_file(tmp_path):
    table = table_of(tmp_path, "\na,b\n\n1,2\n\n\n3,4\n")
    assert table.lines.tolist() == [4, 7]


@pytest.mark.parametrize(
    ("text", "fact", "hint"),
    [
        ("", "no row", "header"),
        ("a,b\n", "no row", "header"),
        ("a,b\n1,2\na,b\n3,4\n", "line 3 repeats the header", "file of its own"),
        ("a,b\n1,2,3\n", "line 2 has 3 fields under a header of 2", "decimal commas"),
        ("a,b\n1\n", "line 2 has 1 fields under a header of 2", "as many"),
        ("a;b\n1;2\n1;2;3\n", "line 3 has 3 fields", "as many"),
        (",".join("abcdefghijklm") + "\n" + ",".join("1" * 25), "has 25 fields", "decimal commas"),
    ],
)
def test_a_bad_shape_is_named(tmp_path, text, fact, hint):
    error = refusal(table_of, tmp_path, text)
    assert fact in error.fact and "bench.csv" in error.fact
    assert hint in error.hint


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("", "is empty"),
        ("x", "'x'"),
        ("nan", "'nan'"),
        ("inf", "'inf'"),
        ("1_000", "'1_000'"),
        ("3 kPa", "'3 kPa'"),
        ("#N/A", "'#N/A'"),
        ("1.234,5", "'1.234,5'"),
    ],
)
def test_a_cell_that_is_no_number_is_named(tmp_path, cell, words):
    table = table_of(tmp_path, f"a;load\n1;2\n3;{cell}\n")
    error = refusal(BenchColumn(table, "load", 1).numbers)
    assert words in error.fact and "line 3" in error.fact and "'load'" in error.fact


def test_a_file_that_is_no_text_gives_one_line(tmp_path):
    (tmp_path / "sheet.xlsx").write_bytes(b"PK\x03\x04\xff\xfe\x00\x9c")
    for path in (tmp_path / "sheet.xlsx", tmp_path / "none.csv", tmp_path):
        assert str(path) in refusal(read_table, path).fact
    assert "UTF-8" in refusal(table_of, tmp_path, "a,°\n1,2", "latin-1").hint


@pytest.mark.parametrize(
    ("title", "parts"),
    [
        ("normal [kPa]", ("normal", "kPa")),
        ("normal (kPa)", ("normal", "kPa")),
        ("normal_(kPa)", ("normal", "kPa")),
        ("normal_kPa", ("normal", "kPa")),
        ("shear_x_kPa", ("shear_x", "kPa")),
        ("C1  pF", ("C1", "pF")),
        ("time[s]", ("time", "s")),
        ("shear_x", ("shear_x", "")),
        ("normal [psi]", ("normal", "psi")),
        ("d", ("d", "")),
    ],
)
def test_a_title_has_a_name_and_perhaps_a_unit(title, parts):
    assert split_title(title) == parts


def columns_of(tmp_path, header: str, titles=None, units=None):
    table = table_of(tmp_path, f"{header}\n{','.join('1' * (header.count(',') + 1))}\n")
    return find_columns(table, ("normal", "c0"), ("time",), titles or {}, units or {})


def test_a_unit_comes_from_the_header_or_the_command_line(tmp_path):
    found = columns_of(tmp_path, "c0 [fF],x,Normal (pa),time_ms", None, {"time": "s"})
    assert {name: column.index for name, column in found.items()} == {
        "c0": 0,
        "normal": 2,
        "time": 3,
    }
    assert [found[name].scale for name in ("c0", "normal", "time")] == [1e-3, 1.0, 1.0]


@pytest.mark.parametrize("named", ["sigma [kPa]", "sigma"])
def test_a_column_may_be_named_with_or_without_its_unit(tmp_path, named):
    found = columns_of(tmp_path, "normal [Pa],sigma [kPa],c0 [pF]", {"normal": named})
    assert (found["normal"].index, found["normal"].scale) == (1, 1e3)


@pytest.mark.parametrize(
    ("header", "titles", "units", "fact", "hint"),
    [
        ("c0 [pF],x", {}, {}, "no column for normal", "--columns normal=NAME"),
        ("normal,c0 [pF]", {}, {}, "no unit for normal", "--units normal=Pa"),
        ("normal [Pa],c0", {}, {}, "no unit for c0", "'c0 [pF]'"),
        ("normal [psi],c0 [pF]", {}, {}, "'psi'", "--units normal=UNIT"),
        ("normal [mPa],c0 [pF]", {}, {}, "'mPa'", "MPa"),
        ("normal [Pa],c0 [pF]", {}, {"normal": "pF"}, "'pF'", "Pa"),
        ("normal [Pa],NORMAL_kPa,c0 [pF]", {}, {}, "2 columns", "--columns normal=NAME"),
        ("normal [Pa],c0 [pF]", {"c0": "c9"}, {}, "no column 'c9' for c0", "c0"),
        ("normal [Pa],u,u,c0 [pF]", {"normal": "u"}, {}, "2 columns", "rename"),
        ("normal [Pa],c0 [pF]", {"time": "normal"}, {"time": "s"}, "both normal and time", "own"),
    ],
)
def test_nothing_about_a_column_is_guessed(tmp_path, header, titles, units, fact, hint):
    error = refusal(columns_of, tmp_path, header, titles, units)
    assert fact in error.fact and "bench.csv" in error.fact
    assert hint in error.hint
