"""What the tests of single nodes share."""

from collections.abc import Iterator

import pytest
from support.nodes import Maker


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Maker]:
    """Makes nodes whose messages are caught, and ends them."""
    maker = Maker(monkeypatch)
    yield maker
    maker.close()
