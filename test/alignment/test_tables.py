"""Tables of load cells and clusters, as programs and microcontrollers write them, by hand."""

from pathlib import Path

import numpy as np
import pytest
from support.wording import refused

from socket_testbed.alignment.table_file import TableFormat
from socket_testbed.alignment.tables import read_cluster_table, read_wrench_table
from socket_testbed.errors import ConfigurationError

STEP = 10_000_000  # [ns]
NAN = float("nan")
# Two readings 10 ms apart, [M; F] in N m and N.
WRENCH = [[0.1, 0.2, 0.3, 1.5, 2.5, -3.5], [0.4, 0.5, 0.6, 4.5, 5.5, -6.5]]
PLAIN = """time [s],Fx [N],Fy [N],Fz [N],Mx [N m],My [N m],Mz [N m]
0.00,1.5,2.5,-3.5,0.1,0.2,0.3
0.01,4.5,5.5,-6.5,0.4,0.5,0.6
"""
LABVIEW = """LabVIEW Measurement\t
Writer_Version\t2
Separator\tTab
Decimal_Separator\t,
X_Columns\tOne
Date\t2024/05/05
Time\t12:00:00,5
***End_of_Header***\t

Channels\t6
Samples\t2\t2\t2\t2\t2\t2
Y_Unit_Label\tN\tN\tN\tN m\tN m\tN m
X0\t0,0\t0,0\t0,0\t0,0\t0,0\t0,0
Delta_X\t0,01\t0,01\t0,01\t0,01\t0,01\t0,01
***End_of_Header***\t
X_Value\tFx\tFy\tFz\tMx\tMy\tMz\tComment
0,00\t1,5\t2,5\t-3,5\t0,1\t0,2\t0,3
0,01\t4,5\t5,5\t-6,5\t0,4\t0,5\t0,6
"""
WITHOUT_X = LABVIEW.replace("\n0,00\t", "\n\t").replace("\n0,01\t", "\n\t")
TITLES = "time [s],Fx [N],Fy [N],Fz [N],Mx [N m],My [N m],Mz [N m]"
BODY = PLAIN.split("\n", 1)[1]


def titled(titles: str, body: str = BODY) -> str:
    return f"{titles}\n{body}"


def scaled(values: str) -> str:
    """The plain table with other numbers for its two rows, in the order of its titles."""
    return "".join(f"{line}\n" for line in values.split(" | "))


WRENCHES = {
    "plain": PLAIN,
    "brackets": PLAIN.replace("[", "(").replace("]", ")"),
    "words": titled(
        "Time (Seconds),Force X [N],Force Y [N],Force Z [N],Torque X [Nm],Torque Y [Nm],"
        "Torque Z [Nm]"
    ),
    "suffixes": titled("time_s,fx_N,fy_N,fz_N,tx_Nm,ty_Nm,tz_Nm"),
    "paths": titled(
        "t [s],/ft/force.x [N],/ft/force.y [N],/ft/force.z [N],/ft/torque.x [N-m],"
        "/ft/torque.y [N-m],/ft/torque.z [N-m]"
    ),
    "axes first": titled(
        "t [s],X force (N),Y force (N),Z force (N),X moment (N*m),Y moment (N*m),Z moment (N*m)"
    ),
    "other order": "Mx [Nm],My [Nm],Mz [Nm],Fx [N],Fy [N],Fz [N],time [s]\n"
    "0.1,0.2,0.3,1.5,2.5,-3.5,0\n0.4,0.5,0.6,4.5,5.5,-6.5,0.01\n",
    "row of units": "Time,Fx,Fy,Fz,Mx,My,Mz\ns,N,N,N,N m,N m,N m\n" + BODY,
    "millimetres": titled(
        TITLES.replace("N m", "N mm"),
        scaled("0,1.5,2.5,-3.5,100,200,300 | 0.01,4.5,5.5,-6.5,400,500,600"),
    ),
    "centimetres": titled(
        TITLES.replace("N m", "Ncm"),
        scaled("0,1.5,2.5,-3.5,10,20,30 | 0.01,4.5,5.5,-6.5,40,50,60"),
    ),
    "kilonewtons": titled(
        TITLES.replace("[N]", "[kN]"),
        scaled("0,0.0015,0.0025,-0.0035,0.1,0.2,0.3 | 0.01,0.0045,0.0055,-0.0065,0.4,0.5,0.6"),
    ),
    "milliseconds": titled(TITLES.replace("[s]", "[ms]"), BODY.replace("0.01", "10")),
    "microseconds": titled(TITLES.replace("[s]", "[µs]"), BODY.replace("0.01", "10000")),
    "millis": titled(TITLES.replace("time [s]", "millis"), BODY.replace("0.01", "10")),
    "semicolons": PLAIN.replace(",", ";").replace(".", ","),
    "stated separator": "sep=;\n" + PLAIN.replace(",", ";"),
    "tabs": PLAIN.replace(",", "\t"),
    "decimal commas": PLAIN.replace(",", "\t").replace(".", ","),
    "spaces": PLAIN.replace(" [", "[").replace("N m", "Nm").replace(",", "  "),
    "comments": "// ATI Gamma\n# tared at 12:00\n" + PLAIN,
    "title in a comment": "# " + PLAIN,
    "serial preamble": "Booting...\nHX711 ready, gain 128\nRate,100\n\n" + PLAIN,
    "quotes": "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) for line in PLAIN.strip().split("\n")
    )
    + "\n",
    "other columns": "\n".join(
        f"{line},{more}"
        for line, more in zip(PLAIN.split("\n"), ("state", "ok", "ok"), strict=False)
    )
    + "\n",
    "trailing separators": PLAIN.replace("\n", ",\n"),
    "LabVIEW": LABVIEW,
    "LabVIEW without times": WITHOUT_X,
}


def written(path: Path, text: str, code: str = "utf-8") -> Path:
    path.write_bytes(text.encode(code))
    return path


@pytest.mark.parametrize("kind", WRENCHES)
def test_a_wrench_from_a_table(tmp_path: Path, kind: str) -> None:
    found = read_wrench_table(written(tmp_path / "cell.csv", WRENCHES[kind]))
    np.testing.assert_allclose(found.series.values, WRENCH, atol=1e-12)
    assert (found.series.times - found.series.times[0]).tolist() == [0, STEP]
    assert not found.is_dated


@pytest.mark.parametrize("code", ["utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_any_encoding_and_line_end(tmp_path: Path, code: str, line_end: str) -> None:
    text = PLAIN.replace("[s]", "[µs]").replace("0.01", "10000").replace("\n", line_end)
    found = read_wrench_table(written(tmp_path / "cell.csv", text, code))
    np.testing.assert_allclose(found.series.values, WRENCH)


@pytest.mark.parametrize(
    ("unit", "newtons"), [("lbf", 4.4482216), ("kgf", 9.80665), ("mN", 1e-3), ("newtons", 1.0)]
)
def test_a_force_in_other_units(tmp_path: Path, unit: str, newtons: float) -> None:
    text = PLAIN.replace("[N]", f"[{unit}]")
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    np.testing.assert_allclose(found.series.values[0, 3:], np.multiply(WRENCH[0][3:], newtons))


@pytest.mark.parametrize(
    ("unit", "newton_metres"), [("lbf-in", 0.1129848), ("lbf ft", 1.3558179), ("mNm", 1e-3)]
)
def test_a_moment_in_other_units(tmp_path: Path, unit: str, newton_metres: float) -> None:
    text = PLAIN.replace("[N m]", f"[{unit}]")
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    expected = np.multiply(WRENCH[0][:3], newton_metres)
    np.testing.assert_allclose(found.series.values[0, :3], expected, rtol=1e-6)


TIMES = {  # of two rows, and the first time since 1970 [ns]
    "ISO": ("2024-05-05T12:00:00.000Z", "2024-05-05T12:00:00.010Z"),
    "space": ("2024-05-05 12:00:00.000", "2024-05-05 12:00:00.010"),
    "zone": ("2024-05-05T14:00:00.000+02:00", "2024-05-05T14:00:00.010+02:00"),
    "German": ("05.05.2024 12:00:00.000", "05.05.2024 12:00:00.010"),
}
NOON = 1_714_910_400_000_000_000  # [ns]; 2024-05-05 12:00 UTC


def with_times(title: str, first: str, second: str) -> str:
    lines = PLAIN.split("\n")
    rows = [line.partition(",")[2] for line in lines[:3]]
    return "".join(f"{a},{b}\n" for a, b in zip((title, first, second), rows, strict=True))


@pytest.mark.parametrize("kind", TIMES)
def test_dates_of_rows(tmp_path: Path, kind: str) -> None:
    text = with_times("Timestamp", *TIMES[kind])
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert found.series.times.tolist() == [NOON, NOON + STEP]
    assert found.is_dated


JUNE_5 = 1_717_588_800_000_000_000  # [ns]; 2024-06-05 12:00 UTC
FIFTH_OF_JUNE = {  # the day is not the month
    "German": ("Timestamp", "05.06.2024 12:00:00.000", "05.06.2024 12:00:00.010"),
    "German without zeros": ("Timestamp", "5.6.2024 12:00:00.00", "5.6.2024 12:00:00.01"),
    "German date alone": ("Date,Time", "05.06.2024,12:00:00.000", "05.06.2024,12:00:00.010"),
    "ISO": ("Timestamp", "2024-06-05T12:00:00.000", "2024-06-05T12:00:00.010"),
    "ISO date alone": ("Date,Time", "2024-06-05,12:00:00.000", "2024-06-05,12:00:00.010"),
    "underscore": ("Timestamp", "2024-06-05_12:00:00.000", "2024-06-05_12:00:00.010"),
}


@pytest.mark.parametrize("kind", FIFTH_OF_JUNE)
def test_day_and_month_keep_their_places(tmp_path: Path, kind: str) -> None:
    found = read_wrench_table(written(tmp_path / "cell.csv", with_times(*FIFTH_OF_JUNE[kind])))
    assert found.series.times.tolist() == [JUNE_5, JUNE_5 + STEP]
    assert found.is_dated


def test_a_day_after_the_twelfth_goes_on(tmp_path: Path) -> None:
    text = with_times("Timestamp", "12.06.2024 23:59:59.995", "13.06.2024 00:00:00.005")
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert np.diff(found.series.times).tolist() == [STEP]


@pytest.mark.parametrize(
    ("first", "second", "seconds"),
    [
        pytest.param("1:02:03.00", "1:02:03.01", 3723, id="hours"),
        pytest.param("02:03", "02:04", 123, id="minutes and seconds"),
    ],
)
def test_a_time_of_day_in_seconds(tmp_path: Path, first: str, second: str, seconds: int) -> None:
    found = read_wrench_table(written(tmp_path / "cell.csv", with_times("Time", first, second)))
    assert found.series.times[0] == seconds * 1_000_000_000


@pytest.mark.parametrize(
    ("title", "first", "second"),
    [
        ("epoch [s]", "1714910400.00", "1714910400.01"),
        ("stamp [ms]", "1714910400000", "1714910400010"),
        ("%time [ns]", "1714910400000000000", "1714910400010000000"),
    ],
    ids=["s", "ms", "ns"],
)
def test_seconds_since_1970(tmp_path: Path, title: str, first: str, second: str) -> None:
    found = read_wrench_table(written(tmp_path / "cell.csv", with_times(title, first, second)))
    assert found.is_dated
    np.testing.assert_allclose(found.series.times - NOON, [0, STEP], atol=300)


@pytest.mark.parametrize(
    ("title", "first", "second", "nanoseconds"),
    [
        (
            *("stamp [ns]", "1714910400123456789", "1714910400133456781"),
            [1_714_910_400_123_456_789, 1_714_910_400_133_456_781],
        ),
        (
            *("stamp [us]", "1714910400123457", "1714910400133457"),
            [1_714_910_400_123_457_000, 1_714_910_400_133_457_000],
        ),
    ],
    ids=["ns", "us"],
)
def test_whole_stamps_keep_their_last_digit(
    tmp_path: Path, title: str, first: str, second: str, nanoseconds: list[int]
) -> None:
    """As floats such stamps are 256 ns apart."""
    text = with_times(title, first, second)
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert found.series.times.tolist() == nanoseconds


def test_a_date_beside_a_time_of_day(tmp_path: Path) -> None:
    text = with_times("Date,Time", "2024-05-05,12:00:00.000", "2024-05-05,12:00:00.010")
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert found.series.times.tolist() == [NOON, NOON + STEP]


def test_a_time_of_day_has_no_date(tmp_path: Path) -> None:
    text = with_times("Time", "00:00:01.000", "00:00:01.010")
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert found.series.times.tolist() == [1_000_000_000, 1_000_000_000 + STEP]
    assert not found.is_dated


def test_units_and_columns_may_be_stated(tmp_path: Path) -> None:
    titles = "t,Fx,Fy,Fz,Mx,My,spin"
    stated = TableFormat({"Mz": "spin"}, {"time": "s", "force": "N", "moment": "N m"})
    found = read_wrench_table(written(tmp_path / "cell.csv", titled(titles)), stated)
    np.testing.assert_allclose(found.series.values, WRENCH)


def test_rows_without_times_follow_at_a_rate(tmp_path: Path) -> None:
    text = "\n".join(line.partition(",")[2] for line in PLAIN.split("\n"))
    path = written(tmp_path / "cell.csv", text)
    found = read_wrench_table(path, TableFormat(rate=100.0))
    assert found.series.times.tolist() == [0, STEP]
    with refused(ConfigurationError, "cell.csv", "--row-rate"):
        read_wrench_table(path)


def test_a_stated_rate_counts_more_than_times(tmp_path: Path) -> None:
    path = written(tmp_path / "cell.csv", PLAIN.replace("0.01", "0.02"))
    found = read_wrench_table(path, TableFormat(rate=100.0))
    assert found.series.times.tolist() == [0, STEP]
    assert "the times of 'time [s]' do not count" in found.notes[0]


def test_an_empty_cell_is_missing(tmp_path: Path) -> None:
    text = PLAIN.replace("5.5", "").replace("0.6", "NaN")
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    np.testing.assert_array_equal(found.series.values[1], [0.4, 0.5, NAN, 4.5, NAN, -6.5])


@pytest.mark.parametrize(
    "word", ["nan", "NaN", "NAN", "-nan", "na", "NA", "n/a", "#N/A", "none", "NULL", "-", "--"]
)
@pytest.mark.parametrize("among", ["-6.5", "None "], ids=["numbers", "texts"])
def test_a_word_for_nothing_is_missing(word: str, among: str, tmp_path: Path) -> None:
    text = PLAIN.replace("5.5", word).replace("-6.5", among)
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    last = -6.5 if among == "-6.5" else NAN
    np.testing.assert_array_equal(found.series.values[1], [0.4, 0.5, 0.6, 4.5, NAN, last])


def test_a_first_line_cut_short_is_left_out(tmp_path: Path) -> None:
    path = written(tmp_path / "caps.txt", f"3,6.1\n{ROW}\n{ROW}\n")
    found = read_cluster_table(
        path, TableFormat(units={"capacitance": "pF"}, rate=20.0, names=NAMES)
    )
    assert len(found.series.times) == 2
    assert "line 1" in found.notes[0]


def test_a_line_cut_short_is_left_out(tmp_path: Path) -> None:
    found = read_wrench_table(written(tmp_path / "cell.csv", f"{PLAIN}0.02,7.5"))
    assert len(found.series.times) == 2
    assert "line 4" in found.notes[0]


def test_a_line_cut_short_amid_others_is_left_out(tmp_path: Path) -> None:
    text = f"{PLAIN}0.02,7.\n0.03,1.5,2.5,-3.5,0.1,0.2,0.3\n"
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert (found.series.times / STEP).tolist() == [0, 1, 3]
    assert "line 4 has fewer columns" in found.notes[0]


def test_of_equal_times_the_last_counts(tmp_path: Path) -> None:
    text = PLAIN + "0.01,9.5,5.5,-6.5,0.4,0.5,0.6\n"
    found = read_wrench_table(written(tmp_path / "cell.csv", text))
    assert found.series.values[:, 3].tolist() == [1.5, 9.5]
    assert "1 rows" in found.notes[0]


REFUSED = {
    "no unit": (PLAIN.replace("Fx [N]", "Fx"), "'Fx' has no unit"),
    "another unit": (PLAIN.replace("Fx [N]", "Fx [V]"), "'Fx [V]' is in 'V'"),
    "no unit of time": (PLAIN.replace("time [s]", "time"), "'time' has no unit"),
    "no moment": (PLAIN.replace("Mz [N m]", "temperature"), "no column for Mz"),
    "one title twice": (PLAIN.replace("My [N m]", "Fx [N]"), "rename one"),
    "two forces": (PLAIN.replace("My [N m]", "Force X [N]"), "may each be Fx"),
    "text": (PLAIN.replace("5.5", "ERR"), "line 3, column 'Fy [N]' holds 'ERR'"),
    "comma in a number": (PLAIN.replace("1.5", "1,5") + "0.02,1,1,1,1,1,1\n", "line 2 has 8"),
    "comma below": (PLAIN.replace("4.5", "4,5") + "0.02,1,1,1,1,1,1\n", "line 3 has 8"),
    "back in time": (PLAIN + "0.00,1,1,1,1,1,1\n", "line 4, column 'time [s]' goes back by 0.01 s"),
    "milliseconds as seconds": (PLAIN.replace("0.01", "1000"), "steps of 1e+03"),
    "no numbers": ("time [s],Fx [N]\n", "no row of numbers"),
    "day or month first": (
        with_times("Time", "05/06/2024 12:00:00", "05/06/2024 12:00:01"),
        "05/06/2024",
    ),
    "no time": (PLAIN.replace("time [s]", "count"), "no column holds the time"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_table_that_cannot_be_read(tmp_path: Path, kind: str) -> None:
    text, fact = REFUSED[kind]
    with refused(ConfigurationError, "cell.csv: ", fact):
        read_wrench_table(written(tmp_path / "cell.csv", text))


# Two clusters, four capacitances each [pF]; and the stresses of one [Pa].
PICOFARADS = [[[5.0, 5.1, 5.2, 5.3], [6.0, 6.1, 6.2, 6.3]]]
ROW = "5.0,5.1,5.2,5.3,6.0,6.1,6.2,6.3"
NAMES = ("brim_lateral", "distal")


def channels(form: str) -> str:
    return ",".join(form.format(name, k) for name in NAMES for k in range(4))


CAPACITANCES = {
    "dots": f"t [s],{channels('{}.{} [pF]')}\n0,{ROW}\n",
    "spaces": f"t [s],{channels('{} {} (pF)')}\n0,{ROW}\n",
    "letters": f"t [s],{channels('{}_c{} [pF]')}\n0,{ROW}\n",
}


@pytest.mark.parametrize("kind", CAPACITANCES)
def test_capacitances_from_a_table(tmp_path: Path, kind: str) -> None:
    found = read_cluster_table(written(tmp_path / "caps.csv", CAPACITANCES[kind]))
    assert found.series.clusters == NAMES
    np.testing.assert_allclose(found.series.values, PICOFARADS)


def test_capacitances_in_femtofarads(tmp_path: Path) -> None:
    text = "t [s],distal.0 [fF],distal.1 [fF],distal.2 [fF],distal.3 [fF]\n0,5000,1,2,3\n"
    found = read_cluster_table(written(tmp_path / "caps.csv", text))
    np.testing.assert_allclose(found.series.values[0, 0], [5.0, 0.001, 0.002, 0.003])


def test_channels_in_a_stated_order(tmp_path: Path) -> None:
    text = f"millis;{';'.join('abcdefgh')}\n20;{ROW.replace(',', ';')}\n"
    path = written(tmp_path / "caps.txt", text)
    stated = TableFormat(units={"capacitance": "pF"}, names=NAMES)
    found = read_cluster_table(path, stated)
    np.testing.assert_allclose(found.series.values, PICOFARADS)
    assert found.series.times.tolist() == [20_000_000]
    with refused(ConfigurationError, "8 columns beside the time, and 1 clusters"):
        read_cluster_table(path, TableFormat(names=("distal",)))


def test_channels_without_any_titles(tmp_path: Path) -> None:
    path = written(tmp_path / "caps.txt", f"{ROW}\n{ROW}\n")
    stated = TableFormat(units={"capacitance": "pF"}, rate=20.0, names=NAMES)
    found = read_cluster_table(path, stated)
    np.testing.assert_allclose(found.series.values, PICOFARADS * 2)
    assert found.series.times.tolist() == [0, 50_000_000]


def test_a_missing_channel_and_another_quantity(tmp_path: Path) -> None:
    text = "t [s],distal.0 [pF],distal.1 [pF],distal.2 [pF],board 1 [degC]\n0,5,6,7,20\n"
    found = read_cluster_table(written(tmp_path / "caps.csv", text))
    assert found.series.clusters == ("distal",)
    np.testing.assert_array_equal(found.series.values[0, 0], [5.0, 6.0, 7.0, NAN])


@pytest.mark.parametrize(
    ("unit", "pascals"), [("kPa", 1e3), ("Pa", 1.0), ("N/cm2", 1e4), ("psi", 6894.757)]
)
def test_stresses_from_a_table(tmp_path: Path, unit: str, pascals: float) -> None:
    titles = ",".join(f"distal.{name} [{unit}]" for name in ("normal", "shear_x", "shear y"))
    found = read_cluster_table(written(tmp_path / "s.csv", f"t [s],{titles}\n0,30,-2,1\n"))
    assert found.series.are_stresses
    np.testing.assert_allclose(found.series.values[0, 0], np.multiply([30, -2, 1], pascals))


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("t [s],distal.0\n0,5\n", "'distal.0' has no unit"),
        ("t [s],a [pF],b [pF]\n0,5,6\n", "no column is a channel"),
        ("t [s],distal.normal [kPa]\n0,5\n", "no column for distal.shear_x"),
        ("t [s],distal.0 [pF],distal 0 [pF]\n0,5,6\n", "are both distal.0"),
    ],
    ids=["no unit", "no channel", "no shear", "twice"],
)
def test_channels_that_cannot_be_read(tmp_path: Path, text: str, fact: str) -> None:
    with refused(ConfigurationError, "caps.csv", fact):
        read_cluster_table(written(tmp_path / "caps.csv", text))
