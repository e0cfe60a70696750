"""The family of errors that users see: each states the fact and the hint in one line."""

from __future__ import annotations

import copyreg
from collections.abc import Collection
from typing import Any


class TestbedError(Exception):
    """Base of every error of this package that is meant for a person.

    Attributes:
        fact: What is wrong, with the name of the file, field, topic or channel.
        hint: What to do about it.
    """

    __test__ = False  # not a test class, whatever pytest makes of its name

    def __init__(self, fact: str, hint: str) -> None:
        self.fact = _one_line(fact)
        self.hint = _one_line(hint)
        super().__init__(self.fact, self.hint)

    def __str__(self) -> str:
        return f"{self.fact}: {self.hint}"

    def __reduce__(self) -> tuple[Any, ...]:
        # Errors come back from worker processes whatever their constructors take.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


_LONGEST = 2000  # [characters]


def _one_line(text: str) -> str:
    """A text on one line that every terminal shows as it is, whatever a file wrote into it."""
    text = " ".join(text.split())
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    return "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text
    )


class ConfigurationError(TestbedError):
    """A configuration file or a setting is wrong."""


class CalibrationError(TestbedError):
    """A calibration cannot be applied to these clusters."""


class TrialError(TestbedError):
    """A trial cannot be read, or lacks the requested data."""


class IdentificationError(TestbedError):
    """The contact model cannot be identified from these samples."""


class DeviceError(TestbedError):
    """A device or its bus fails."""


class ScanError(TestbedError):
    """A scan of a socket cannot be read, or lacks the requested data."""


class RegistrationError(TestbedError):
    """Frames cannot be registered with these markers and landmarks."""


def likely(word: str, known: Collection[str]) -> str:
    """A hint with the known word that is most like another one; empty if none is."""
    import difflib  # for an error alone

    found = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean '{found[0]}'?" if found else ""


def closest(word: str, known: Collection[str]) -> str:
    """A hint for an unknown word: the likely one, or the list of the known ones."""
    return likely(word, known) or "use one of " + (", ".join(sorted(known)) or "(none)")
