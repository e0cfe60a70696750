"""Errors shown to users: each states a fact and a hint in one line."""

from __future__ import annotations

import copyreg
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any


class TestbedError(Exception):
    """Base of all errors of this package that are meant for the user.

    Attributes:
        fact: What is wrong, with the name of the file, field, topic or channel.
        hint: What to do about it.
    """

    __test__ = False  # not a test class, despite its name

    def __init__(self, fact: str, hint: str) -> None:
        self.fact = _one_line(fact)
        self.hint = _one_line(hint)
        super().__init__(self.fact, self.hint)

    def __str__(self) -> str:
        return f"{self.fact}: {self.hint}"

    def __reduce__(self) -> tuple[Any, ...]:
        # Lets worker processes return errors, whatever arguments their constructors take.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


@contextmanager
def naming(place: object, *kinds: type[TestbedError]) -> Iterator[None]:
    """Errors raised within the context begin with a place, such as `a.yaml: ...`.

    Args:
        place: The place, such as the path of a file or the name of a trial.
        kinds: Classes of the errors that begin with it; none for every `TestbedError`.
    """
    kinds = kinds or (TestbedError,)
    try:
        yield
    except kinds as error:
        raise type(error)(f"{place}: {error.fact}", error.hint) from None


_ENCLOSED = re.compile(r"\([^()]*\)|\[[^][]*\]|\{[^{}]*\}|\"[^\"]*\"|(?<!\w)'[^']*'(?!\w)")


def fact_and_hint(line: str) -> tuple[str, str]:
    """Fact and hint of a `TestbedError`'s line; without a hint all of it is the fact.

    Args:
        line: The line. Its hint begins after the last colon outside of brackets and quotes.
    """
    blanked = _ENCLOSED.sub(lambda found: "_" * len(found.group()), line)
    fact, colon, _ = blanked.rpartition(": ")
    return (line[: len(fact)], line[len(fact) + len(colon) :]) if fact else (line, "")


def joined(lines: Iterable[str]) -> str:
    """Lines of facts and hints as one line: all facts, then each different hint once.

    Args:
        lines: Lines as `TestbedError` writes them, with or without a hint.
    """
    split = [fact_and_hint(line) for line in lines]
    facts = "; ".join(dict.fromkeys(fact for fact, _ in split))
    hints = "; ".join(dict.fromkeys(hint for _, hint in split if hint))
    return f"{facts}: {hints}" if hints else facts


_MAX_LENGTH = 2000  # [characters]


def _one_line(text: str) -> str:
    """A text as one printable line, whatever a file put into it."""
    text = " ".join(text.split())
    if len(text) > _MAX_LENGTH:
        text = f"{text[: _MAX_LENGTH // 2]} ... {text[-_MAX_LENGTH // 2 :]}"
    return "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text
    )


class ConfigurationError(TestbedError):
    """A configuration file or a setting is wrong."""


class CalibrationError(TestbedError):
    """Bench data, a calibration or its baselines cannot be used."""


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
    """A hint naming the most similar known word, such as `did you mean 'fit'?`.

    Args:
        word: The unknown word.
        known: The words that would be accepted.

    Returns:
        The hint; empty if no known word is similar.
    """
    import difflib  # needed only for errors

    found = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean '{found[0]}'?" if found else ""


def listed(parts: Sequence[str], most: int) -> str:
    """Parts in one line, such as `a, b and 3 more`.

    Args:
        parts: The parts, in the order in which they are listed.
        most: Number of parts to show; the others are only counted.
    """
    more = f" and {len(parts) - most} more" * (len(parts) > most)
    return ", ".join(parts[:most]) + more


def option_of(name: str) -> str:
    """The option of a parameter's name, such as `--load-cell` of `load_cell`."""
    return f"--{name.replace('_', '-')}"


def first_of(problems: Sequence[object]) -> str:
    """The first of some problems (one or more), and the number of the others in brackets."""
    return f"{problems[0]}" + f" (and {len(problems) - 1} more)" * (len(problems) > 1)


def closest(word: str, known: Collection[str]) -> str:
    """A hint for an unknown word: a similar known word, or the list of them.

    Args:
        word: The unknown word.
        known: The words that would be accepted.
    """
    return likely(word, known) or "use one of " + (", ".join(sorted(known)) or "(none)")
