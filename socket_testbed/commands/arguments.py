"""Command-line parser: options from the fields of a verb's call, one-line errors.

It stays with argparse. Of the libraries that derive a command line from types, cyclopts 5 would
leave 105 lines of our own in place of 135, takes 0.37 s of processor time for `--help` instead of
0.24 s, rounds whole numbers (`--thetas 3.5`) and loses `--notes "- cut"`; tyro has no public access
to its errors, and jsonargparse takes 1.4 s for `--help` (tried in November 2026).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, Field
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

from socket_testbed.errors import likely, option_of
from socket_testbed.settings.options import Options


class Parser(argparse.ArgumentParser):
    """A parser with one-line errors: what is wrong, then the likely option or the help.

    Attributes:
        words: The words of the command line, in which an unknown option is looked for.
    """

    words: Sequence[str] = ()

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with code 2."""
        hint = f"see '{self.prog} --help'"
        choice = re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message)
        if choice:
            hint = likely(choice[1], re.findall(r"[\w-]+", choice[2])) or hint
        if re.search(r"invalid \w+ value: '-?\d+,\d+'", message):
            hint = "write decimals with a point"
        known = re.findall(r"--[\w-]+", self.format_help())
        for word in self.words:
            option = word.partition("=")[0]
            if re.fullmatch(r"--[\w-]+", option) and option not in known:
                message = f"unknown option {option}"
                hint = likely(option, known) or hint
                break
        self.exit(2, f"{self.prog}: error: {message}: {hint}\n")


class _ExtendList(argparse.Action):
    """Collect values separated by spaces or commas, or from a repeated option."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Add the values to those given before."""
        added: list[Any] = []
        for value in values:
            listed = isinstance(value, str) and "=" not in value
            added += filter(None, value.split(",")) if listed else [value]
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), *added])


_SIMPLE: dict[Any, dict[str, Any]] = {
    bool: {"action": "store_true"},
    Path: {"type": Path, "metavar": "FILE"},
    **{kind: {"type": kind} for kind in (str, float, int)},
}
_SEVERAL: dict[Any, dict[str, Any]] = {
    Sequence: {"nargs": "+", "action": _ExtendList},
    Iterable: {"action": "append"},
    list: {"action": "append"},  # several positional arguments
    tuple: {},
}


def _declared(call: type[Options]) -> Iterator[tuple[type[Options], Field[Any]]]:
    """The fields of a call that are options, those of the class itself first, and their classes.

    A field that a class declares again counts there alone.
    """
    fields = {item.name: item for item in dataclasses.fields(call)}
    for kind in call.__mro__:
        for name in vars(kind).get("__annotations__", ()):
            item = fields.pop(name, None)
            if item is not None and not item.metadata.get("internal"):
                yield kind, item


def add_options(parser: argparse.ArgumentParser, call: type[Options]) -> None:
    """Add the options of a verb.

    `Literal` gives choices, `bool` a flag, `Path` a path, `Sequence` several values per option,
    `Iterable` a repeatable option, `tuple` a fixed number of values, `list` several positional
    arguments.

    Args:
        parser: The verb's parser.
        call: The class of the verb's call, such as `commands.calls.Fit`.
    """
    kinds = get_type_hints(call)
    groups: dict[tuple[str, str], Any] = {("", ""): parser}
    for owner, item in _declared(call):
        heading, either = owner.heading, item.metadata.get("either", "")
        if (heading, "") not in groups:
            groups[heading, ""] = parser.add_argument_group(heading)
        if (heading, either) not in groups:
            groups[heading, either] = groups[heading, ""].add_mutually_exclusive_group()
        keywords = _keywords(kinds[item.name])
        keywords["help"] = _help(item.metadata["text"], item.metadata["shown"])
        if "choices" not in keywords and keywords.get("action") != "store_true":
            unit = re.search(r"\[([a-zA-Z]\w*)\]", item.metadata["text"])
            usual = keywords.get("metavar") or (unit[1] if unit else item.name).upper()
            keywords["metavar"] = item.metadata.get("metavar") or usual
        if item.metadata.get("positional"):
            _add_argument(groups["", ""], item, keywords)
        else:
            _add_option(groups[heading, either], item, keywords)


def _add_argument(group: Any, item: Field[Any], keywords: dict[str, Any]) -> None:
    several = "+" if keywords.pop("action", "") else None
    count = several if item.default is MISSING else "*" if several else "?"
    group.add_argument(item.name, **keywords | {"nargs": count, "metavar": item.name.upper()})


def _add_option(group: Any, item: Field[Any], keywords: dict[str, Any]) -> None:
    name, default = item.name, item.default
    if default is not MISSING:
        keywords["default"] = [*default] if keywords.get("action") == "append" else default
    elif keywords.get("action") != "store_true":
        keywords["required"] = True
    flags = [option_of(name)]
    if default is True:
        flags, keywords["action"] = [f"--no-{name}"], "store_false"
        keywords["help"] = f"without {keywords['help']}"
    elif name == "output":
        flags = ["-o", *flags]
    group.add_argument(*flags, dest=name, **keywords)


def _keywords(kind: Any) -> dict[str, Any]:
    """Keywords for argparse by type."""
    union = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    parts = {get_origin(each) or each: get_args(each) for each in union}
    if words := parts.get(Literal):
        if float in parts:

            def number(text: str) -> str | float:
                return text if text in words else float(text)

            return {"type": number}
        return {"type": type(words[0]), "choices": words}
    for simple, keywords in _SIMPLE.items():
        if simple in parts:
            return {**keywords}
    for several, counted in _SEVERAL.items():
        if several in parts:
            count = {"nargs": len(parts[several])} if several is tuple else {}
            return _keywords(parts[several][0]) | counted | count
    raise TypeError(f"{kind} cannot be typed on a command line")


def _lists_words(kind: Any) -> bool:
    """Whether an option of a type takes several words."""
    return Sequence[str] in (kind, *get_args(kind))


def _help(text: str, shown: Any) -> str:
    """A text for the help: without the units of plain numbers, with the default."""
    text = re.sub(r" \[[-1]\]", "", text).replace("%", "%%")
    without = (MISSING, None, (), "")
    if shown in without or isinstance(shown, bool) or "(default" in text:
        return text
    return f"{text} (default: {f'{shown:g}' if isinstance(shown, float) else shown})"


def release_paths(words: Sequence[str], call: type[Options]) -> list[str]:
    """Move paths that follow the values of a list to the front.

    In `fit --leave-out Mz trials/hold` argparse would read the trial as a channel.

    Args:
        words: The arguments of a verb.
        call: The class of the verb's call, such as `commands.calls.Fit`.
    """
    names = {option_of(name) for name, kind in get_type_hints(call).items() if _lists_words(kind)}
    kept, paths = [], []
    place = -1  # number of the value in a list; below 0 outside of one
    for word in words:
        if word.startswith("-"):
            place = 0 if word in names else -1
        elif place >= 0:
            place += 1
        if place > 1 and "=" not in word and (os.sep in word or os.path.lexists(word)):
            paths.append(word)
        else:
            kept.append(word)
    return [*paths, *kept]
