"""Averages around a trigger: which span they have, and that they do not lag."""

import numpy as np
import pytest

from socket_testbed.arrays import line_weights
from socket_testbed.nodes.sensor_node import averaging_span
from socket_testbed.settings.acquisition import LoadCellSettings, MocapSettings


def test_the_span_is_the_setting_or_the_trigger_s_period() -> None:
    for wanted, period, span in (
        (-1.0, 0.01, 0.01), (-1.0, 0.25, 0.25), (-1.0, 1.0, 0.25), (-1.0, 0.0, 0.0),
        (0.0, 0.05, 0.0), (0.1, 0.05, 0.1), (0.5, 0.0, 0.5),
    ):  # fmt: skip
        assert averaging_span(wanted, period) == span
    assert LoadCellSettings().average_over == MocapSettings().window < 0.0


def test_the_weights_are_those_of_the_line_at_the_trigger() -> None:
    for count in (2, 3, 7, 60):
        rng = np.random.default_rng(count)
        offsets = np.sort(rng.uniform(-0.1, 0.15, count))
        values = rng.normal(size=count)
        expected = np.polynomial.Polynomial.fit(offsets, values, 1)(0.0)
        assert line_weights(offsets) @ values == pytest.approx(expected, abs=1e-9)
    np.testing.assert_allclose(line_weights(np.linspace(-0.1, 0.1, 9)), 1 / 9, atol=1e-15)
    assert line_weights(np.array([0.07])).tolist() == [1.0]
    assert len(line_weights(np.array([]))) == 0
