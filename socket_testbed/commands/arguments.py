"""The parser of the command line: options from signatures, errors of one line."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NoReturn, Union, get_args, get_origin

from socket_testbed.commands.signatures import REQUIRED, Parameter, options_of
from socket_testbed.errors import likely

_METAVARS = {
    "segment": "plateau|hold|auto|all|T0:T1|event:A:B",
    "tare": "T0:T1|none|recorded",
    "unloaded": "T0:T1",
    "leave_out": "CHANNEL",
    "initial_stiffness": "K0|auto",
    "model": "MODEL",
    "record": "DIR",
    "jobs": "N",
    "dask": "ADDRESS",
    "cycles": "LABEL",
    "fault": "NAME=VALUE",
    "condition": "NAME=TRIAL,...",
    "columns": "QUANTITY=HEADER",
    "units": "QUANTITY=UNIT",
    "wiring": "C",
    "points": "'X Y Z'",
}


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


class _ExtendList(argparse.Action):
    """Values one after another, separated by commas, or of the option given again."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Add the values to those that were given before."""
        added: list[Any] = []
        for value in values:
            listed = isinstance(value, str) and "=" not in value
            added += filter(None, value.split(",")) if listed else [value]
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), *added])


_SIMPLE: dict[Any, dict[str, Any]] = {
    bool: {"action": "store_true"},
    os.PathLike: {"type": Path, "metavar": "FILE"},
    Path: {"type": Path, "metavar": "FILE"},
    **{kind: {"type": kind} for kind in (str, float, int)},
}
_SEVERAL: dict[Any, dict[str, Any]] = {
    Sequence: {"nargs": "+", "action": _ExtendList},
    Iterable: {"action": "append"},
    list: {"action": "append"},  # of positional arguments: several
    tuple: {},
}


def add_options(parser: argparse.ArgumentParser, verb: str) -> None:
    """Add the options of a verb; what nobody can type, such as a function, is left out.

    `Literal` gives choices, `bool` a flag, `PathLike` a path, `Sequence` several values after one
    option, `Iterable` a value each time that it is given, `tuple` as many values as it has. A list
    is of positional arguments.

    Args:
        parser: The verb's parser.
        verb: The verb's function, such as `commands.models.fit`.
    """
    for heading, parameters in options_of(verb).items():
        group = parser.add_argument_group(heading.lower()) if heading else parser
        exclusive: Any = None
        for parameter in parameters:
            keywords = _keywords(parameter.type())
            if parameter.exclusive:
                exclusive = exclusive or group.add_mutually_exclusive_group()
            if keywords is not None:
                _add(exclusive if parameter.exclusive else group, parameter, keywords)


def _add(group: Any, parameter: Parameter, keywords: dict[str, Any]) -> None:
    name, default = parameter.name, parameter.default
    keywords["help"] = _help(parameter)
    if parameter.positional:
        several = "+" if keywords.pop("action", "") else None
        count = several if default is REQUIRED else "*" if several else "?"
        group.add_argument(name, **keywords | {"nargs": count, "metavar": name.upper()})
        return
    if "choices" not in keywords and keywords.get("action") != "store_true":
        unit = re.search(r"\[(\w+)\]", parameter.text)
        usual = keywords.get("metavar") or (unit[1] if unit else name).upper()
        keywords["metavar"] = _METAVARS.get(name, usual)
    if default is REQUIRED:
        keywords["required"] = True
    else:
        keywords["default"] = [*default] if keywords.get("action") == "append" else default
    flags = [f"--{name.replace('_', '-')}"]
    if default is True:
        flags, keywords["action"] = [f"--no-{name}"], "store_false"
        keywords["help"] = f"without {keywords['help']}"
    elif name == "output":
        flags = ["-o", *flags]
    group.add_argument(*flags, dest=name, **keywords)


def _keywords(kind: Any) -> dict[str, Any] | None:
    """How argparse reads values of a type; None if nobody can type one."""
    union = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    parts = {get_origin(each) or each: get_args(each) for each in union}
    if words := parts.get(Literal):
        if float in parts:
            return {"type": lambda text: text if text in words else float(text)}
        return {"type": type(words[0]), "choices": words}
    for simple, keywords in _SIMPLE.items():
        if simple in parts:
            return {**keywords}
    for several, counted in _SEVERAL.items():
        entry = _keywords(parts[several][0]) if several in parts else None
        if entry is not None:
            return entry | counted | ({"nargs": len(parts[several])} if several is tuple else {})
    return None


def _help(parameter: Parameter) -> str:
    """A description as the help shows it: without marks of code, with the default."""
    text = re.sub(r"^Whether |, see `[^`]*`|`| \[-\]|\.$", "", parameter.text).replace("%", "%%")
    if text[1:2].islower() or text[1:2] == " ":
        text = text[0].lower() + text[1:]
    shown = parameter.shown
    if shown in (REQUIRED, None, (), "") or isinstance(shown, bool) or "(default" in text:
        return text
    return f"{text} (default: {f'{shown:g}' if isinstance(shown, float) else shown})"


def release_paths(words: Sequence[str], parser: argparse.ArgumentParser) -> list[str]:
    """Put paths that follow a list's values before the options.

    In `fit --leave-out Mz trials/hold` argparse would take the trial as a channel.

    Args:
        words: The arguments of a verb.
        parser: The verb's parser.
    """
    lists = [a for a in parser._actions if a.nargs == "+" and a.option_strings]
    names = {name for action in lists if action.type is str for name in action.option_strings}
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
