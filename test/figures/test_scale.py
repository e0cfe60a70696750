"""The fixed colour scale of pressures."""

import pytest

from socket_testbed.figures.scale import fixed_end


@pytest.mark.parametrize(
    ("highest", "end"),
    [(0.0, 50.0), (50.0, 50.0), (51.0, 100.0), (101.0, 200.0), (201.0, 400.0), (401.0, 401.0)],
    ids=["none", "usual", "above usual", "high", "very high", "beyond all"],
)
def test_a_scale_ends_at_a_fixed_pressure(highest: float, end: float) -> None:
    """In kPa."""
    assert fixed_end(highest) == end
