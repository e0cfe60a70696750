"""The parser of the command line: errors of one line, and lists that end at a path."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from socket_testbed.errors import likely

_LISTS = ("--leave-out", "--unloaded", "--columns", "--units")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line: what is wrong, and the likely option or the help."""

    words: Sequence[str] = ()

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with 2."""
        hint = f"see '{self.prog} --help'"
        choice = re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message)
        if choice:
            hint = likely(choice[1], re.findall(r"[\w-]+", choice[2])) or hint
        known = re.findall(r"--[\w-]+", self.format_help())
        for word in self.words:
            option = word.partition("=")[0]
            if re.fullmatch(r"--[\w-]+", option) and option not in known:
                message = f"unknown option {option}"
                hint = likely(option, known) or hint
                break
        self.exit(2, f"{self.prog}: error: {message}: {hint}\n")


class ExtendList(argparse.Action):
    """Values one after another, separated by commas, or of the option given again."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Add the values to those that were given before."""
        added = [part for value in values for part in value.split(",") if part]
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), *added])


def release_paths(words: Sequence[str]) -> list[str]:
    """Put paths that follow a list's values before the options.

    In `fit --leave-out Mz trials/hold` argparse would take the trial as a channel.

    Args:
        words: A verb and its arguments.
    """
    kept, paths = [], []
    place = -1  # number of the value in a list; below 0 outside of one
    for word in words[1:]:
        if word.startswith("-"):
            place = 0 if word in _LISTS else -1
        elif place >= 0:
            place += 1
        if place > 1 and _is_path(word):
            paths.append(word)
        else:
            kept.append(word)
    return [*words[:1], *paths, *kept]


def _is_path(word: str) -> bool:
    return "=" not in word and (os.sep in word or os.path.lexists(word))
