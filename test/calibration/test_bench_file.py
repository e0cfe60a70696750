"""Bench files: however they are written they give the same numbers, and no unit is guessed."""

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.benches import HEADER, exact_bench, write_bench
from support.wording import refused

from socket_testbed.calibration.bench_data import read_bench, read_unloaded
from socket_testbed.errors import TestbedError

QUANTITIES = ("time", "normal", "shear_x", "shear_y", "c0", "c1", "c2", "c3")
STRESS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "N": 1.0 / 9e-4, "kN": 1e3 / 9e-4}
CAPACITANCE = {"pF": 1.0, "fF": 1e-3, "nF": 1e3, "counts": 2.0**-19, "words": 2.0**-11}
SCALES = [{"s": 1.0, "ms": 1e-3, "sec": 1.0}, *[STRESS] * 3, *[CAPACITANCE] * 4]


@settings(max_examples=60, deadline=None)
@given(
    units=st.tuples(*[st.sampled_from([*scales]) for scales in SCALES]),
    order=st.permutations(range(8)),
    style=st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{}  {}", "{}_({})", "below"]),
    dialect=st.sampled_from([",.", ";.", ";,", "\t,", "\t."]),
    ending=st.sampled_from(["\n", "\r\n"]),
    quoted=st.booleans(),
    blank=st.booleans(),
    bom=st.booleans(),
)
def test_every_way_of_writing_reads_alike(units, order, style, dialect, ending, quoted, blank, bom):
    bench = exact_bench()[np.arange(0, 200, 9)]
    separator, point = dialect
    scales = [table[unit] for table, unit in zip(SCALES, units, strict=True)]
    columns = np.column_stack([bench.time, bench.stress, bench.capacitance]) / scales
    titles = [style.format(*pair) for pair in zip(QUANTITIES, units, strict=True)]
    rows = [[repr(value).replace(".", point) for value in row] for row in columns.tolist()]
    if style == "below":
        titles = list(QUANTITIES)
        rows.insert(0, [f"({unit})" for unit in units])
    lines = [
        separator.join(f'"{row[i]}"' if quoted else f" {row[i]} ".strip("\t") for i in order)
        for row in [titles, *rows]
    ]
    if blank:
        lines[:1] = ["", lines[0], ""]
        lines.insert(5, separator * 7)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bench.csv"
        text = ending.join(lines) + ending
        path.write_bytes(text.encode("utf-8-sig" if bom else "utf-8"))
        found = read_bench(path, {}, {}, area=9e-4)
    np.testing.assert_allclose(found.stress, bench.stress, rtol=1e-12)
    np.testing.assert_allclose(found.capacitance, bench.capacitance, rtol=1e-12)
    np.testing.assert_allclose(found.time, bench.time, rtol=1e-12)
    last = [number for number, line in enumerate(lines, 1) if line.strip(separator)][-1]
    assert found.line[-1] == last and found.place(len(found) - 1) == f"bench.csv line {last}"


def lines_of(tmp_path: Path, separator: str = ",") -> list[str]:
    path = write_bench(tmp_path / "plain.csv", exact_bench()[np.arange(0, 200, 9)])
    text = path.read_text()
    if separator != ",":
        text = text.replace(",", separator).replace(".", ",")
    return text.splitlines()


def hashed(lines: list[str]) -> list[str]:
    return ["# bench of 3 March, by X", *lines[:5], "# the cable moved", *lines[5:], "#end"]


@pytest.mark.parametrize(
    ("separator", "dress", "line"),
    [
        pytest.param(",", hashed, 3, id="comments"),
        pytest.param(",", lambda lines: ["% made by a script", *lines], 3, id="percent"),
        pytest.param(",", lambda lines: ["# X", "#", f"# {lines[0]}", *lines[1:]], 4, id="savetxt"),
        pytest.param(",", lambda lines: ['"# bench, of March"', *lines], 3, id="quoted"),
        pytest.param(",", lambda lines: [lines[0], "#", *lines[1:]], 3, id="below-the-header"),
        pytest.param(";", lambda lines: ["# bench;;;;;;;", *lines], 3, id="saved-again"),
        pytest.param(",", lambda lines: ["sep=,", *lines], 3, id="comma-stated"),
        pytest.param(";", lambda lines: ["sep=;", *lines], 3, id="semicolon-stated"),
        pytest.param("\t", lambda lines: ["SEP=\t", *lines], 3, id="tab-stated"),
        pytest.param(";", lambda lines: ['"sep=;"', *lines], 3, id="stated-in-quotes"),
        pytest.param(";", lambda lines: ["# X", "sep=;", *lines], 4, id="stated-below-a-comment"),
        pytest.param(",", lambda lines: ["sep=;", *lines], 3, id="wrongly-stated"),
    ],
)
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"], ids=["lf", "crlf", "cr"])
def test_comments_and_stated_separators_are_read(tmp_path, separator, dress, line, ending):
    path = tmp_path / "bench.csv"
    lines = dress(lines_of(tmp_path, separator))
    path.write_bytes((ending.join(lines) + ending).encode())
    found, plain = read_bench(path, {}, {}), read_bench(tmp_path / "plain.csv", {}, {})
    np.testing.assert_array_equal(found.capacitance, plain.capacitance)
    np.testing.assert_array_equal(found.stress, plain.stress)
    assert found.line[0] == line


@pytest.mark.parametrize("word", ["#N/A", "#REF!", "#DIV/0!"])
def test_an_error_of_a_spreadsheet_is_no_comment(tmp_path, word: str):
    path = edit(write_bench(tmp_path / "bench.csv", exact_bench()), with_cell(3, 0, word))
    with refused(TestbedError, f"'time [s]' holds '{word}' in line 4"):
        read_bench(path, {}, {})


@settings(max_examples=80, deadline=None)
@given(cell=st.text(st.characters(codec="utf-8", exclude_characters='\r\n,"'), max_size=8))
@example("nan")
@example("1_000")
@example("#N/A")
@example("")
@example("٣")
@example("\x1f0\x85")
def test_a_cell_is_a_number_or_is_named(cell):
    bench = exact_bench()[np.arange(0, 200, 9)]
    try:
        plain = float(text) if (text := cell.strip()).isascii() and "_" not in text else np.nan
    except ValueError:
        plain = np.nan
    with TemporaryDirectory() as folder:
        path = write_bench(Path(folder) / "bench.csv", bench)
        edit(path, with_cell(3, 2, cell))
        if np.isfinite(plain) and abs(plain) <= 1e3:
            assert read_bench(path, {}, {}).stress[2, 1] == pytest.approx(1e3 * plain, rel=1e-12)
        else:
            with refused(TestbedError, "bench.csv", "line 4", "'shear_x [kPa]'"):
                read_bench(path, {}, {})


def edit(path, change):
    rows = change([line.split(",") for line in path.read_text(encoding="utf-8").splitlines()])
    path.write_text("\n".join(",".join(row) for row in rows), encoding="utf-8")
    return path


def with_cell(row: int, column: int, value: str):
    def change(rows):
        rows[row][column] = value
        return rows

    return change


def with_constant_c3(rows):
    return [[*row[:7], row[7] if row is rows[0] else "6.5"] for row in rows]


def without_last_column(rows):
    return [row[:-1] for row in rows]


BAD = {  # changes, facts, and a hint
    "tension": (with_cell(7, 1, "-50"), ("-50 kPa in line 8", "-1 to 2000 kPa"), "sign"),
    "too-large": (with_cell(7, 1, "2500"), ("2500 kPa in line 8", "-1 to 2000 kPa"), "unit"),
    "time-in-ms": (
        with_cell(0, 0, "time [ms]"),
        ("'time [ms]'", "0.1 ms in the"),
        "--units time=s",
    ),
    "time-stands": (with_cell(9, 0, "0.1"), ("does not increase at line 10",), "order"),
    "force": (with_cell(0, 1, "normal [N]"), ("force in N",), "--area"),
    "no-unit": (with_cell(0, 7, "c3"), ("'c3' has no unit",), "c3=pF"),
    "no-column": (without_last_column, ("no column for c3",), "c3=NAME"),
    "millipascals": (with_cell(0, 1, "normal [mPa]"), ("'mPa'",), "MPa"),
    "constant": (with_constant_c3, ("'c3 [pF]' is 6.5 pF in every row",), "wire"),
}


@pytest.mark.parametrize(("change", "facts", "hint"), BAD.values(), ids=BAD)
def test_a_bad_file_is_named_with_its_hint(tmp_path, change, facts, hint):
    path = edit(write_bench(tmp_path / "bench.csv", exact_bench()), change)
    with refused(TestbedError, "bench.csv") as caught:
        read_bench(path, {}, {})
    assert all(fact in caught.value.fact for fact in facts) and hint in caught.value.hint


def write_counts(path: Path, per_picofarad: float, offset: float, bits: int, unit: str) -> Path:
    """A bench file of readings as registers hold them, of capacitances less an offset [pF]."""
    bench = exact_bench()[np.arange(0, 200, 9)]
    counts = np.round((bench.capacitance - offset) * per_picofarad) % 2**bits
    header = (*HEADER[:4], *(f"c{k} [{unit}]" for k in range(4)))
    return write_bench(path, dataclasses.replace(bench, capacitance=counts), header)


@pytest.mark.parametrize(
    ("per_picofarad", "offset", "bits", "unit", "fact", "hint"),
    [
        pytest.param(
            2**11, 0.0, 16, "counts", "likely the upper 16 bits", "c0=words", id="upper-words"
        ),
        pytest.param(
            2**11,
            7.0,
            16,
            "counts",
            "likely the upper 16 bits",
            "c0=words",
            id="unsigned-as-counts",
        ),
        pytest.param(
            2**19, 7.0, 24, "counts", "an unsigned reading of -", "subtract 16777216", id="unsigned"
        ),
        pytest.param(
            2**11, 7.0, 16, "words", "an unsigned reading of -", "subtract 65536", id="words"
        ),
        pytest.param(
            2**27, 0.0, 32, "counts", "beyond the 24 bits", "divide by 256", id="both-registers"
        ),
    ],
)
def test_other_counts_of_the_converter_are_named(
    tmp_path, per_picofarad, offset, bits, unit, fact, hint
):
    path = write_counts(tmp_path / "bench.csv", per_picofarad, offset, bits, unit)
    with refused(TestbedError, f"'c0 [{unit}]' is ", fact) as caught:
        read_bench(path, {}, {})
    assert hint in caught.value.hint


def test_words_are_2048_per_picofarad(tmp_path):
    """The upper 16 of 24 bits, of which 2^19 are a picofarad."""
    path = tmp_path / "bench.csv"
    path.write_text("c0 [words],c1 [words],c2 [counts24],c3 [counts]\n2048,10240,26214.4,2621440\n")
    np.testing.assert_allclose(read_unloaded(path, {}, {}), [[1.0, 5.0, 0.05, 5.0]])


@pytest.mark.parametrize("title", ["sigma [Pa]", "sigma"], ids=["with-unit", "without-unit"])
def test_a_column_is_named_and_its_unit_replaced(tmp_path, title: str):
    path, bench = tmp_path / "bench.csv", exact_bench()
    late = dataclasses.replace(bench, time=bench.time * 1e3)
    edit(write_bench(path, late), with_cell(0, 1, "sigma [Pa]"))
    found = read_bench(path, {"normal": title}, {"normal": "kPa", "time": "ms"})
    np.testing.assert_allclose(found.stress, bench.stress, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(found.time, bench.time, atol=1e-9)


def test_time_is_optional(tmp_path):
    path = write_bench(tmp_path / "bench.csv", exact_bench())
    edit(path, lambda rows: [row[1:] for row in rows])
    found = read_bench(path, {}, {})
    assert np.isnan(found.time).all() and (found.cycle == -1).all()


def test_cycles_may_have_any_names(tmp_path):
    path = write_bench(tmp_path / "bench.csv", exact_bench())
    edit(path, lambda rows: [[*row, "ab"[k % 2] if k else "run"] for k, row in enumerate(rows)])
    cycle = read_bench(path, {"cycle": "run"}, {}).cycle
    np.testing.assert_array_equal(cycle, 1 - np.arange(len(cycle)) % 2)


def test_unloaded_readings_need_no_stress(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("c3 [fF],c0 [pF],c1 [pF],c2 [pF],normal\n4000,1,2,3,\n4001,1,2,3,\n")
    np.testing.assert_allclose(read_unloaded(path, {}, {}), [[1, 2, 3, 4], [1, 2, 3, 4.001]])


def test_a_real_sheet_needs_names_of_columns(shared_data):
    path = shared_data / "fdc1004_orthosis" / "Book1.csv"
    with refused(TestbedError, "Book1.csv", "c1 is in 3 columns: 'C1 pF', 'C1 (2)', 'C1(3)'"):
        read_bench(path, {}, {})
    columns = {"normal": "Distance_diminué", "shear_x": "Tour", "shear_y": "d"}
    columns |= {"c0": "C1  pF", "c1": "C1 (2)", "c2": "C1(3)", "c3": "C2 avce C1 (2)"}
    units = dict.fromkeys(("normal", "shear_x", "shear_y"), "kPa")
    units |= dict.fromkeys(("c1", "c2", "c3"), "pF")
    found = read_bench(path, columns, units)
    assert len(found) == 31 and found.stress[:, 0].max() == 7500.0
