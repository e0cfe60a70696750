"""Every unit that a title may state, against its size as handbooks state it."""

from pathlib import Path

import numpy as np
import pytest

from socket_testbed.alignment.table_file import TableFormat, read_table
from socket_testbed.alignment.tables import read_cluster_table, read_wrench_table
from socket_testbed.alignment.takes import table_take
from socket_testbed.alignment.units import UNITS

SIZES = {
    "time": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
        **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 0.001),
        **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microseconds"), 0.000001),
        **dict.fromkeys(("ns", "nsec", "nanoseconds"), 0.000000001),
        "min": 60.0,
    },
    "force": {
        **dict.fromkeys(("N", "newton", "newtons"), 1.0),
        "kN": 1000.0,
        "mN": 0.001,
        **dict.fromkeys(("lbf", "lb", "lbs"), 4.44822),
        "kgf": 9.80665,
    },
    "moment": {
        **dict.fromkeys(("N m", "newton metres", "newton meters"), 1.0),
        "N mm": 0.001,
        "N cm": 0.01,
        "kN m": 1000.0,
        "mN m": 0.001,
        **dict.fromkeys(("lbf in", "in lbf", "lb in", "in lb"), 0.112985),
        **dict.fromkeys(("lbf ft", "ft lbf", "lb ft", "ft lb"), 1.35582),
        "kgf m": 9.80665,
        "kgf cm": 0.0980665,
    },
    "capacitance": {"pF": 1.0, "fF": 0.001, "nF": 1000.0},
    "stress": {
        "Pa": 1.0,
        "kPa": 1000.0,
        "MPa": 1000000.0,
        "hPa": 100.0,
        "mbar": 100.0,
        "bar": 100000.0,
        "psi": 6894.76,
        **dict.fromkeys(("N/cm2", "N/cm^2", "N/cm²"), 10000.0),
        **dict.fromkeys(("N/mm2", "N/mm^2", "N/mm²"), 1000000.0),
    },
    "length": {
        **dict.fromkeys(("m", "metres", "meters"), 1.0),
        **dict.fromkeys(("mm", "millimetres", "millimeters"), 0.001),
        **dict.fromkeys(("cm", "centimetres", "centimeters"), 0.01),
    },
}  # [s, N, N m, pF, Pa, m]


def units_of(quantity: str) -> pytest.MarkDecorator:
    own = [pytest.param(unit, size, id=unit) for unit, size in SIZES[quantity].items()]
    return pytest.mark.parametrize(("unit", "size"), own)


def written(path: Path, titles: str, *rows: str) -> Path:
    path.write_text("\n".join([titles, *rows, ""]), encoding="utf-8")
    return path


def wrench_table(path: Path, force: str, moment: str) -> Path:
    """Forces of 3, 4 and 5, and moments of 6, 7 and 8 units."""
    forces = ",".join(f"{name} [{force}]" for name in ("Fx", "Fy", "Fz"))
    moments = ",".join(f"{name} [{moment}]" for name in ("Mx", "My", "Mz"))
    return written(path, f"t [s],{forces},{moments}", "0,3,4,5,6,7,8", "0.01,3,4,5,6,7,8")


def test_no_unit_is_forgotten_here() -> None:
    assert {name: set(own) for name, own in SIZES.items()} == {
        name: set(own) for name, own in UNITS.items()
    }


@units_of("force")
def test_a_force_in_any_unit(tmp_path: Path, unit: str, size: float) -> None:
    found = read_wrench_table(wrench_table(tmp_path / "cell.csv", unit, "N m")).series.values
    np.testing.assert_allclose(found[0, 3:], [3.0 * size, 4.0 * size, 5.0 * size], rtol=1e-5)
    np.testing.assert_allclose(found[0, :3], [6.0, 7.0, 8.0])


@units_of("moment")
def test_a_moment_in_any_unit(tmp_path: Path, unit: str, size: float) -> None:
    found = read_wrench_table(wrench_table(tmp_path / "cell.csv", "N", unit)).series.values
    np.testing.assert_allclose(found[0, :3], [6.0 * size, 7.0 * size, 8.0 * size], rtol=1e-5)
    np.testing.assert_allclose(found[0, 3:], [3.0, 4.0, 5.0])


@units_of("capacitance")
def test_a_capacitance_in_any_unit(tmp_path: Path, unit: str, size: float) -> None:
    titles = ",".join(f"distal.{channel} [{unit}]" for channel in range(4))
    path = written(tmp_path / "caps.csv", f"t [s],{titles}", "0,5,6,7,8")
    found = read_cluster_table(path).series.values[0, 0]
    np.testing.assert_allclose(found, [5.0 * size, 6.0 * size, 7.0 * size, 8.0 * size])


@units_of("stress")
def test_a_stress_in_any_unit(tmp_path: Path, unit: str, size: float) -> None:
    titles = ",".join(f"distal.{name} [{unit}]" for name in ("normal", "shear_x", "shear_y"))
    path = written(tmp_path / "stresses.csv", f"t [s],{titles}", "0,30,-2,1")
    found = read_cluster_table(path).series.values[0, 0]
    np.testing.assert_allclose(found, [30.0 * size, -2.0 * size, size], rtol=1e-5)


@units_of("length")
def test_a_position_in_any_unit(tmp_path: Path, unit: str, size: float) -> None:
    places = ",".join(f"socket.{axis} [{unit}]" for axis in "xyz")
    turns = ",".join(f"socket.q{axis}" for axis in "xyzw")
    path = written(tmp_path / "poses.csv", f"t [s],{places},{turns}", "0,1,-2,3,0,0,0,1")
    take = table_take(path, read_table(path), TableFormat())
    np.testing.assert_allclose(take.bodies["socket"].translation, [[size, -2.0 * size, 3.0 * size]])


# Steps that a sensor has, of 0.5 s, by the size of the unit
STEPS = {1.0: "0.5", 0.001: "500", 0.000001: "500000", 0.000000001: "500000000", 60.0: "0.00833333"}


@units_of("time")
def test_a_time_in_any_unit(tmp_path: Path, unit: str, size: float) -> None:
    titles = f"time [{unit}],Fx [N],Fy [N],Fz [N],Mx [N m],My [N m],Mz [N m]"
    path = written(tmp_path / "cell.csv", titles, "0,1,1,1,1,1,1", f"{STEPS[size]},1,1,1,1,1,1")
    times = read_wrench_table(path).series.times
    np.testing.assert_allclose(times, [0, 500_000_000], rtol=1e-6)
