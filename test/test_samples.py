"""Samples as others see them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from socket_testbed.samples import Samples, Status
from socket_testbed.tables import write_table


@pytest.fixture
def samples() -> Samples:
    return Samples(
        stamps=np.array([5, 250_000_005, 500_000_005]),
        position=np.array([[0.01, 0.02, 0.03], [np.nan] * 3, [0.0, 0.0, 0.0]]),
        rotation=np.array([[0.1, 0.2, 0.3], [np.nan] * 3, [0.0, 0.0, 0.0]]),
        wrench=np.arange(18.0).reshape(3, 6),
        clusters=("distal", "cuff"),
        local_forces=np.arange(18.0).reshape(3, 2, 3),
        status=np.array([[0, 3], [0, 2], [1, 0]], dtype=np.uint8),
    )


def test_a_table_of_samples_has_a_unit_in_every_name_and_is_written_with_its_time(
    samples: Samples, tmp_path: Path
) -> None:
    frame = samples.to_dataframe()
    assert frame.index.name == "time [s]" and frame.index.tolist() == [0.0, 0.25, 0.5]
    np.testing.assert_array_equal(frame[["Mx [N m]", "Fz [N]"]], samples.wrench[:, [0, 5]])
    np.testing.assert_array_equal(frame[[f"q_{axis} [m]" for axis in "xyz"]], samples.position)
    np.testing.assert_array_equal(frame[[f"phi_{axis} [rad]" for axis in "xyz"]], samples.rotation)
    np.testing.assert_array_equal(frame["distal.Fx [N]"], samples.local_forces[:, 0, 0])
    np.testing.assert_array_equal(frame["cuff.Fz [N]"], samples.local_forces[:, 1, 2])
    assert frame["cuff.status [-]"].tolist() == [Status.OUT_OF_RANGE, Status.MISSING, Status.OK]
    assert len(frame.columns) == 6 + 6 + 2 * 4
    write_table(frame, tmp_path / "samples.parquet")
    found = pd.read_parquet(tmp_path / "samples.parquet").set_index("time [s]")
    pd.testing.assert_frame_equal(found, frame)
