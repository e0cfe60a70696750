"""Messages to a person: one line that names the thing, and a hint."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


def check_line(text: str, *names: str) -> None:
    """Check that a text is one line with a hint behind a colon, and names all of these."""
    assert "\n" not in text and ": " in text, text
    for name in names:
        assert name in text, f"{name!r} is not in {text!r}"


@contextmanager
def refused(kind: type[Exception], *names: str) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """Expect an error of a kind whose line names all of these."""
    with pytest.raises(kind) as caught:
        yield caught
    check_line(str(caught.value), *names)
