"""Whole lines about tables that cannot be read, and their notes; lines and titles are counted."""

from pathlib import Path

import numpy as np
import pytest

from socket_testbed.alignment.table_file import TableFormat
from socket_testbed.alignment.tables import TableSeries, read_cluster_table, read_wrench_table
from socket_testbed.errors import ConfigurationError

COMPONENTS = "Fx [N],Fy [N],Fz [N],Mx [N m],My [N m],Mz [N m]"
ROW = "1,2,3,4,5,6"
STRESSES = "distal.normal [kPa],distal.shear_x [kPa],distal.shear_y [kPa]"


def wrench(*rows: str, titles: str = f"time [s],{COMPONENTS}") -> str:
    return "\n".join((titles, *rows)) + "\n"


def letters(number: int) -> str:
    """Titles of so many columns that are none of a wrench."""
    return ",".join("abcdefghijklmnop"[:number])


def read(folder: Path, name: str, text: str, stated: TableFormat | None = None) -> TableSeries:
    path = folder / name
    path.write_text(text)
    return (read_wrench_table if name == "cell.csv" else read_cluster_table)(path, stated)


MISSING = "no column for Mx, My, Mz, Fx, Fy, Fz"
TITLED = "'a', 'b', 'c', 'd', 'e', 'f', 'g', 'h', 'i', 'j', 'k', 'l'"
NAME_ALL = "name it with --columns Mx=NAME My=NAME Mz=NAME Fx=NAME Fy=NAME Fz=NAME"
REFUSED = {
    "two titles": (
        "cell.csv",
        wrench(f"0,{ROW}", titles=f"time [s],{COMPONENTS}".replace("Mz [N m]", "state")),
        "no column for Mz ('time [s]', 'Fx [N]', 'Fy [N]', 'Fz [N]', 'Mx [N m]', 'My [N m]',"
        " 'state'): name it with --columns Mz=NAME",
    ),
    "twelve titles": (
        "cell.csv",
        wrench(",".join("1" * 12), titles=letters(12)),
        f"{MISSING} ({TITLED}): {NAME_ALL}",
    ),
    "fifteen titles": (
        "cell.csv",
        wrench(",".join("1" * 15), titles=letters(15)),
        f"{MISSING} ({TITLED} and 3 more): {NAME_ALL}",
    ),
    "two alike": (
        "cell.csv",
        wrench(f"0,{ROW}", titles=f"time [s],{COMPONENTS}".replace("Fy [N]", "Force X [N]")),
        "'Fx [N]', 'Force X [N]' may each be Fx: name it with --columns Fx=NAME",
    ),
    "two times": (
        "cell.csv",
        wrench(f"0,0,{ROW}", titles=f"time [s],epoch [s],{COMPONENTS}"),
        "'time [s]', 'epoch [s]' may each be the time: name it with --columns time=NAME",
    ),
    "no time": (
        "cell.csv",
        wrench(ROW, titles=COMPONENTS),
        "no column holds the time ('Fx [N]', 'Fy [N]', 'Fz [N]', 'Mx [N m]', 'My [N m]',"
        " 'Mz [N m]'): name it with --columns time=NAME, or give the rate of the rows with"
        " --row-rate",
    ),
    "a time is lacking": (
        "cell.csv",
        wrench(f"0,{ROW}", f"0.01,{ROW}", f",{ROW}"),
        "line 4 has no time: give it, or remove the line",
    ),
    "a time is no date": (
        "cell.csv",
        wrench(f"2024-05-05 12:00:00,{ROW}", f"noon,{ROW}", titles=f"time,{COMPONENTS}"),
        "line 3, column 'time' holds 'noon': give the time as 2024-05-05 12:00:01.5 or in seconds",
    ),
    "back in time": (
        "cell.csv",
        wrench(f"0,{ROW}", f"2.5,{ROW}", f"0.5,{ROW}"),
        "line 4, column 'time [s]' goes back by 2 s: a restart of the device, or a counter that"
        " overflowed: cut the file there",
    ),
    "quick steps": (
        "cell.csv",
        wrench(f"0,{ROW}", f"0.02,{ROW}", titles=f"time [ms],{COMPONENTS}"),
        "column 'time [ms]' has steps of 0.02 in the median, 2e-05 s in its unit, which no sensor"
        " has: give the true unit with --units time=UNIT",
    ),
    "no number": (
        "cell.csv",
        wrench(f"0,{ROW}", "0.1,1,ERR,3,4,5,6"),
        "line 3, column 'Fy [N]' holds 'ERR': put a number there, leave the cell empty, or remove"
        " the line",
    ),
    "a long line": (
        "cell.csv",
        wrench(f"0,{ROW}", f"0.1,{ROW},7", f"0.2,{ROW}"),
        "line 3 has 8 columns, others 7: correct or remove that line; separate the columns with"
        " ';' if the numbers have decimal commas",
    ),
    "no rows": (
        "cell.csv",
        wrench(),
        "holds no row of numbers: give a row per reading below titles",
    ),
    "no channel": (
        "caps.csv",
        "t [s],a,b\n0,5,6\n",
        "no column is a channel of a cluster ('t [s]', 'a', 'b'): call them such as"
        " 'distal.0 [pF]', or name the clusters in order with --names",
    ),
    "one shear": (
        "caps.csv",
        f"t [s],{STRESSES.rpartition(',')[0]}\n0,5,6\n",
        "no column for distal.shear_y: give all three stresses of a cluster",
    ),
    "one channel twice": (
        "caps.csv",
        "t [s],distal.1 [pF],distal 1 [pF]\n0,5,6\n",
        "'distal.1 [pF]' and 'distal 1 [pF]' are both distal.1: rename one",
    ),
    "nothing read": (
        "caps.csv",
        "t [s],distal.1 [pF],distal.2 [pF]\n0,,\n1,,\n",
        "holds no reading: check the columns",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_table_is_refused_with_this_line(case: str, tmp_path: Path) -> None:
    name, text, line = REFUSED[case]
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, name, text)
    assert str(caught.value) == f"{name}: {line}"


NAMED = {
    "nowhere": (
        letters(13),
        f"no columns are called 'push', named for Fx: name one of {TITLED} and 1 more",
    ),
    "twice": (
        "push [N],push [kN]",
        "2 columns are called 'push', named for Fx: name one of 'push [N]', 'push [kN]'",
    ),
}


@pytest.mark.parametrize("case", NAMED)
def test_a_named_column_is_there_once(case: str, tmp_path: Path) -> None:
    titles, line = NAMED[case]
    row = ",".join("1" for _ in titles.split(","))
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, "cell.csv", f"{titles}\n{row}\n", TableFormat(columns={"Fx": "push"}))
    assert str(caught.value) == f"cell.csv: {line}"


def test_clusters_in_order_must_fill_the_columns(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, "caps.csv", "t [s],a,b,c,d,e\n0,1,2,3,4,5\n", TableFormat(names=("x", "y")))
    assert str(caught.value) == (
        "caps.csv: has 5 columns beside the time, and 2 clusters with 4 channels each are named:"
        " name the clusters in the order of the columns with --names, or channels by title"
    )


NOTES = {
    "one time twice": (
        wrench(f"0,{ROW}", f"0.1,{ROW}", f"0.1,{ROW}", f"0.1,{ROW}", f"0.2,{ROW}"),
        TableFormat(),
        "of 2 rows with the time of the next the last counts",
    ),
    "no zone": (
        wrench(f"2024-05-05 12:00:00,{ROW}", titles=f"time,{COMPONENTS}"),
        TableFormat(),
        "its dates have no zone, and are taken as UTC",
    ),
    "one short": (
        wrench(f"0,{ROW}", "0.1,1,2", f"0.2,{ROW}"),
        TableFormat(),
        "line 3 has fewer columns than the others, and may be cut short: left out",
    ),
    "two short": (
        wrench(f"0,{ROW}", "0.1,1,2", f"0.2,{ROW}", "0.3,1", f"0.4,{ROW}"),
        TableFormat(),
        "2 lines have fewer columns than the others, and may be cut short: left out",
    ),
    "no line end": (
        wrench(f"0,{ROW}", f"0.1,{ROW}", f"0.2,{ROW}").rstrip(),
        TableFormat(),
        "line 4, the last, has no line end, so it may be cut short: it is left out",
    ),
    "a rate": (
        wrench(f"0,{ROW}", f"0.1,{ROW}"),
        TableFormat(rate=10.0),
        "the times of 'time [s]' do not count: a rate is stated",
    ),
}


@pytest.mark.parametrize("case", NOTES)
def test_what_was_changed_is_noted(case: str, tmp_path: Path) -> None:
    text, stated, note = NOTES[case]
    assert read(tmp_path, "cell.csv", text, stated).notes == (f"cell.csv: {note}",)


def test_a_first_line_cut_short_is_noted(tmp_path: Path) -> None:
    row = ",".join("5" * 8)
    stated = TableFormat(units={"capacitance": "pF"}, rate=20.0, names=("x", "y"))
    found = read(tmp_path, "caps.csv", f"3,6.1\n{row}\n{row}\n", stated)
    assert found.notes == ("caps.csv: line 1 has 2 columns, others 8: it is left out",)


@pytest.mark.parametrize(
    "title",
    """
    time;t;timestamp;timestamps;time stamp;stamp;header.stamp;__time;%time;elapsed;elapsed time;
    relative time;time of day;zeit;datetime;date time;date/time;date_time;utc;epoch;unix time;date;
    datum;day
    """.replace("\n", "")
    .replace("    ", "")
    .split(";"),
)
def test_a_column_of_times_has_many_titles(title: str, tmp_path: Path) -> None:
    text = wrench(f"0,{ROW}", f"500,{ROW}", titles=f"{title} [ms],{COMPONENTS}")
    found = read(tmp_path, "cell.csv", text).series
    assert np.diff(found.times).tolist() == [500_000_000]


@pytest.mark.parametrize(
    ("title", "seconds"),
    {
        "seconds": 1.0, "secs": 1.0, "sec": 1.0, "s": 1.0, "x_value": 1.0,
        "millis": 1e-3, "ms": 1e-3, "micros": 1e-6, "us": 1e-6,
    }.items(),
)  # fmt: skip
def test_a_title_may_be_its_unit(title: str, seconds: float, tmp_path: Path) -> None:
    """The second row is half a second after the first, in that unit."""
    later = 0.5 / seconds
    text = wrench(f"0,{ROW}", f"{later:g},{ROW}", titles=f"{title},{COMPONENTS}")
    found = read(tmp_path, "cell.csv", text).series
    assert np.diff(found.times).tolist() == [500_000_000]
