"""Bench files: units, and values that cannot be."""

import csv
import dataclasses

import numpy as np
import pytest
from support.benches import HEADER, bench_of, exact_bench, write_bench

from socket_testbed.calibration.bench_data import join_benches, read_bench, read_unloaded
from socket_testbed.errors import CalibrationError


def refusal(path, columns=None, units=None, area=None) -> CalibrationError:
    with pytest.raises(CalibrationError) as caught:
        read_bench(path, columns or {}, units or {}, area)
    assert "\n" not in str(caught.value)
    assert path.name in caught.value.fact
    return caught.value


def edit(path, change):
    """Rewrite a bench file cell by cell."""
    with path.open(newline="") as stream:
        rows = list(csv.reader(stream))
    rows = change(rows)
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return path


@pytest.fixture
def bench_file(tmp_path):
    return write_bench(tmp_path / "bench.csv", exact_bench())


def test_a_file_gives_back_what_was_written(bench_file):
    bench, found = exact_bench(), read_bench(bench_file, {}, {})
    assert found.files == ("bench.csv",) and found.place(0) == "bench.csv line 2"
    np.testing.assert_allclose(found.stress, bench.stress, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(found.capacitance, bench.capacitance, rtol=1e-8)
    np.testing.assert_allclose(found.time, bench.time, rtol=1e-8)
    assert (found.cycle == -1).all()


@pytest.mark.parametrize(
    ("header", "scales", "area"),
    [
        (("time_ms", "normal_Pa", "shear_x (MPa)", "shear_y [kPa]"), (1e3, 1e3, 1e-3, 1.0), None),
        (("time_s", "normal_N", "shear_x_N", "shear_y [Pa]"), (1.0, 0.9, 0.9, 1e3), 9e-4),
    ],
)
def test_units_bring_all_to_the_same_numbers(tmp_path, bench_file, header, scales, area):
    header = (*header, "c0 [fF]", "c1 [nF]", "c2 [pF]", "c3_pF")
    factors = np.array([*scales, 1e3, 1e-3, 1.0, 1.0])
    values = np.loadtxt(bench_file, delimiter=",", skiprows=1) * factors
    other = tmp_path / "other.csv"
    lines = [",".join(map(repr, row)) for row in values.tolist()]
    other.write_text("\n".join([",".join(header), *lines]))
    found, expected = read_bench(other, {}, {}, area), read_bench(bench_file, {}, {})
    for field in ("time", "capacitance", "stress"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), rtol=1e-12)


def test_time_and_cycles_may_be_missing(bench_file):
    edit(bench_file, lambda rows: [row[1:] for row in rows])
    found = read_bench(bench_file, {}, {})
    assert np.isnan(found.time).all() and (found.cycle == -1).all()


def test_cycles_have_any_names(bench_file):
    def name(rows):
        return [[*rows[0], "run"]] + [[*row, "ab"[k % 2]] for k, row in enumerate(rows[1:])]

    cycle = read_bench(edit(bench_file, name), {"cycle": "run"}, {}).cycle
    assert set(cycle) == {0, 1} and (cycle[::2] == cycle[0]).all() and cycle[0] != cycle[1]


def with_title(column: int, title: str):
    def change(rows):
        rows[0][column] = title
        return rows

    return change


def with_cell(row: int, column: int, value: str):
    def change(rows):
        rows[row][column] = value
        return rows

    return change


def with_column(column: int, value: str):
    def change(rows):
        return [rows[0]] + [[*row[:column], value, *row[column + 1 :]] for row in rows[1:]]

    return change


@pytest.mark.parametrize(
    ("change", "facts", "hint"),
    [
        (with_title(4, "c0 [fF]"), ("'c0 [fF]'", "line 2", "outside 10 to"), "--units c0=UNIT"),
        (with_title(4, "c0 [nF]"), ("'c0 [nF]'", "line 2"), "--units c0=UNIT"),
        (with_title(1, "normal [MPa]"), ("'normal [MPa]'", "outside"), "unit"),
        (with_title(2, "shear_x [MPa]"), ("'shear_x [MPa]'", "outside"), "unit"),
        (with_cell(7, 1, "-50"), ("-50 kPa in line 8", "outside -1 to 2000 kPa"), "sign"),
        (with_title(0, "time [ms]"), ("'time [ms]'", "0.1 ms in the median"), "--units time=s"),
        (with_cell(9, 0, "0.1"), ("does not increase at line 10",), "order"),
        (with_column(6, "6.5"), ("'c2 [pF]' is 6.5 pF in every row",), "wire"),
        (with_title(1, "normal [N]"), ("force in N",), "--area"),
        (lambda rows: [*rows[:50], rows[0], *rows[50:]], ("line 51 repeats the header",), "file"),
        (with_cell(3, 5, ""), ("'c1 [pF]' is empty in line 4",), "fill"),
        (with_cell(3, 5, "O.5"), ("'O.5' in line 4",), "number"),
        (lambda rows: [row[:-1] for row in rows], ("no column for c3",), "c3=NAME"),
        (with_title(7, "c2 [pF]"), ("c2 is in 2 columns",), "rename"),
        (with_title(7, "c3"), ("no unit for c3",), "c3=pF"),
    ],
)
def test_a_bad_file_is_named_with_its_hint(bench_file, change, facts, hint):
    error = refusal(edit(bench_file, change))
    for fact in facts:
        assert fact in error.fact
    assert hint in error.hint


def test_milliseconds_under_seconds_are_named(tmp_path):
    bench = exact_bench()
    path = write_bench(tmp_path / "b.csv", dataclasses.replace(bench, time=bench.time * 1e3))
    assert "--units time=ms" in refusal(path).hint
    np.testing.assert_allclose(read_bench(path, {}, {"time": "ms"}).time, bench.time, atol=1e-9)


def test_unloaded_readings_need_no_stress(tmp_path):
    path = tmp_path / "before.csv"
    path.write_text("c3 [fF],c0 [pF],c1 [pF],c2 [pF],normal\n4000,1,2,3,\n4001,1,2,3,\n")
    np.testing.assert_allclose(read_unloaded(path, {}, {}), [[1, 2, 3, 4], [1, 2, 3, 4.001]])


def test_files_are_joined_in_their_order():
    first, second = exact_bench(), bench_of(np.ones((3, 4)), np.ones((3, 3)))
    joined = join_benches([join_benches([first, second]), second])
    assert len(joined) == len(first) + 6 and joined.files == ("bench.csv",) * 3
    assert np.bincount(joined.file).tolist() == [len(first), 3, 3]
    np.testing.assert_array_equal(joined[joined.file == 2].stress, second.stress)


def test_a_real_log_is_refused_for_the_columns_it_lacks(shared_data):
    error = refusal(shared_data / "fdc1004_orthosis" / "Data2.csv")
    assert "no column for normal, shear_x, shear_y, c0, c3" in error.fact
    assert "'timestamp(ms)'" in error.fact and "--columns normal=NAME" in error.hint


def test_a_real_log_s_seconds_are_not_taken_for_milliseconds(shared_data, tmp_path):
    with (shared_data / "fdc1004_orthosis" / "Data2.csv").open(newline="") as stream:
        times = [row[0] for row in csv.reader(stream)][1:]
    rows = np.column_stack([np.full(len(times), 10.0)] * 3 + [np.linspace(5, 6, len(times))] * 4)
    path = tmp_path / "log.csv"
    lines = [f"{t},{','.join(map(repr, row))}" for t, row in zip(times, rows.tolist(), strict=True)]
    path.write_text("\n".join([",".join(("timestamp(ms)", *HEADER[1:])), *lines]))
    columns = {"time": "timestamp"}
    error = refusal(path, columns)
    assert "'timestamp(ms)'" in error.fact and "--units time=s" in error.hint
    assert np.ptp(read_bench(path, columns, {"time": "s"}).time) == pytest.approx(14.996)


def test_a_real_sheet_is_refused_until_its_columns_are_named(shared_data):
    path = shared_data / "fdc1004_orthosis" / "Book1.csv"
    assert "c1 is in 3 columns: 'C1 pF', 'C1 (2)', 'C1(3)'" in refusal(path).fact.replace("  ", " ")
    columns = {"normal": "Distance_diminué", "shear_x": "Tour", "shear_y": "d"}
    columns |= {"c0": "C1  pF", "c1": "C1 (2)", "c2": "C1(3)", "c3": "C2 avce C1 (2)"}
    assert "c1 is in '2', not one of its units" in refusal(path, columns).fact
    units = dict.fromkeys(("c1", "c2", "c3"), "pF")
    assert "no unit for normal, shear_x, shear_y" in refusal(path, columns, units).fact
    units |= dict.fromkeys(("normal", "shear_x", "shear_y"), "kPa")
    found = read_bench(path, columns, units)
    assert len(found) == 31 and found.stress[:, 0].max() == 7500.0
