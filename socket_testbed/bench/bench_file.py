"""Bench files: readings with known stresses, and baselines without any."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.bench.bench_data import UNNAMED, BenchData
from socket_testbed.bench.columns import INPUTS, NEWTON, STRESSES, Column, find_columns
from socket_testbed.bench.table import Table, read_table
from socket_testbed.errors import CalibrationError

# What a reading can be; beyond it, the unit is not the one that is named.
_CAPACITANCE_RANGE = (0.01, 100.0)  # [pF]
_STRESS_RANGES = {
    "normal": (-1e3, 2e6),  # [Pa]; a load cell's zero may be a little off
    "shear_x": (-1e6, 1e6),
    "shear_y": (-1e6, 1e6),
}
_STEP_RANGE = (1e-3, 60.0)  # [s] between readings, in the median


def read_bench(
    path: Path,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    area: float | None = None,
) -> BenchData:
    """Read a bench file.

    It has a header and a row a reading, with the columns `normal`, `shear_x`, `shear_y` and
    `c0` to `c3` (the converter's inputs), and, if it likes, `time` and `cycle`. Their units
    stand in the header, such as `normal [kPa]`. Other columns are ignored.

    Args:
        path: The file; commas, semicolons or tabs separate its columns.
        columns: Names in the header of quantities that it calls otherwise.
        units: Units of quantities, instead of the header's: pF, fF or nF; Pa, kPa, MPa or N;
            s or ms.
        area: Area on which a stress in N acts [m^2].

    Raises:
        CalibrationError: If the file is not as it must be, naming line, column and mend.
    """
    table = read_table(path)
    found = find_columns(table, (*STRESSES, *INPUTS), ("time", "cycle"), columns, units)
    rows = len(table)
    return BenchData(
        files=(table.name,),
        file=np.zeros(rows, dtype=np.int64),
        line=table.lines,
        time=_time(table, found),
        cycle=_cycles(table, found),
        capacitance=_capacitances(table, found, refuse_constant=True),
        stress=np.column_stack([_stress(table, name, found[name], area) for name in STRESSES]),
    )


def read_unloaded(path: Path, columns: Mapping[str, str], units: Mapping[str, str]) -> FloatArray:
    """Read a file of baseline readings: the capacitances `c0` to `c3` of the unloaded cluster.

    Args:
        path: The file; see `read_bench`. All but its capacitances is ignored.
        columns: Names in the header of quantities that it calls otherwise.
        units: Units of quantities, instead of the header's.

    Returns:
        Capacitances by input, shape (N, 4) [pF].

    Raises:
        CalibrationError: If the file is not as it must be, naming line, column and mend.
    """
    table = read_table(path)
    found = find_columns(table, INPUTS, (), columns, units)
    return _capacitances(table, found, refuse_constant=False)


def _time(table: Table, columns: Mapping[str, Column]) -> FloatArray:
    if "time" not in columns:
        return np.full(len(table), np.nan)
    column = columns["time"]
    time = table.numbers(column.index) * column.scale
    steps = np.diff(time)
    backwards = np.flatnonzero(steps <= 0.0)
    if len(backwards):
        raise CalibrationError(
            f"{table.name}: '{column.title}' does not increase at line"
            f" {table.lines[backwards[0] + 1]}",
            "give the readings in their order, and each run as a file of its own",
        )
    usual = float(np.median(steps)) if len(steps) else _STEP_RANGE[0]
    if not _STEP_RANGE[0] <= usual <= _STEP_RANGE[1]:
        other = "ms" if column.unit == "s" else "s"
        raise CalibrationError(
            f"{table.name}: the steps of '{column.title}' are {usual / column.scale:.3g}"
            f" {column.unit} in the median, which no bench reads at",
            f"mend the header, or give --units time={other} if these are {other}",
        )
    return time


def _cycles(table: Table, columns: Mapping[str, Column]) -> IntArray:
    if "cycle" not in columns:
        return np.full(len(table), UNNAMED)
    _, cycles = np.unique(table.texts(columns["cycle"].index), return_inverse=True)
    return cycles.astype(np.int64)


def _capacitances(table: Table, columns: Mapping[str, Column], refuse_constant: bool) -> FloatArray:
    readings = []
    for name in INPUTS:
        column = columns[name]
        reading = table.numbers(column.index)
        _refuse_impossible(table, name, column, reading, _CAPACITANCE_RANGE, column.scale)
        if refuse_constant and np.ptp(reading) == 0.0:
            raise CalibrationError(
                f"{table.name}: '{column.title}' is {reading[0]:g} {column.unit} in every row",
                "check this input's wire, or name the column that holds it",
            )
        readings.append(reading * column.scale)
    return np.column_stack(readings)


def _stress(table: Table, name: str, column: Column, area: float | None) -> FloatArray:
    scale = column.scale
    if column.unit == NEWTON:
        if area is None:
            raise CalibrationError(
                f"{table.name}: '{column.title}' is a force in N",
                "give the area it acts on with --area, in m^2, or with --geometry",
            )
        scale = 1.0 / area
    reading = table.numbers(column.index)
    _refuse_impossible(table, name, column, reading, _STRESS_RANGES[name], scale)
    return reading * scale


def _refuse_impossible(
    table: Table,
    name: str,
    column: Column,
    reading: FloatArray,
    limits: tuple[float, float],
    scale: float,
) -> None:
    low, high = (limit / scale for limit in limits)
    outside = np.flatnonzero((reading < low) | (reading > high))
    if not len(outside):
        return
    raise CalibrationError(
        f"{table.name}: '{column.title}' is {reading[outside[0]]:g} {column.unit} in line"
        f" {table.lines[outside[0]]}, outside {low:g} to {high:g} {column.unit}",
        f"check the value, its sign and its unit; --units {name}=UNIT names another",
    )
