"""Times of bench readings must increase."""

import pandas as pd
import pytest
from support.wording import refused

from socket_testbed.calibration import bench_data
from socket_testbed.errors import CalibrationError


@pytest.mark.parametrize(
    ("third", "ok"), [("0.3", True), ("0.2", False), ("0.1", False)], ids=["on", "equal", "back"]
)
def test_times_of_a_bench_increase(third: str, ok: bool) -> None:
    cells = pd.Series(["0.1", "0.2", third, "0.4"], index=[2, 3, 4, 5])
    column = bench_data._Column("time", "bench.csv", "time [s]", cells, "s", 1.0)
    if ok:
        assert column.times().tolist() == [0.1, 0.2, 0.3, 0.4]
        return
    with refused(CalibrationError, "bench.csv: 'time [s]' does not increase at line 4"):
        column.times()
