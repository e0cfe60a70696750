"""Command-line parser: options from signatures and docstrings, one-line errors.

Options are read from the source text of functions, so that `--help`, wrong calls and shell
completion import only light modules of this package: importing the API takes seconds.
"""

from __future__ import annotations

import argparse
import ast
import os
import pkgutil
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from inspect import Parameter
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin

from socket_testbed.errors import likely, option_of

_PACKAGE = "socket_testbed"
_REFERENCE = re.compile(r"As (?:`(?P<name>\w+)` )?in `(?:st\.)?(?P<function>[\w.]+)`")
F = TypeVar("F", bound=Callable[..., Any])

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


def takes(
    *functions: str, without: str = "", exclusive: str = "", epilog: str = ""
) -> Callable[[F], F]:
    """Give a verb the options of other functions, recursively.

    For a parameter of several functions, the verb's own takes precedence, then that of the function
    named first. The first parameter of these functions, their subject, is not an option.

    Args:
        functions: Functions of the API, such as `fit`, or of a module, such as `batch.run_batch`.
        without: Parameters that are not options of the verb, separated by spaces.
        exclusive: Mutually exclusive parameters, separated by spaces.
        epilog: Text below the options in the help.
    """
    return lambda verb: verb  # `_Module` reads it from the source text


@dataclass(frozen=True)
class Function:
    """A function and the arguments of its decorator `takes`.

    Attributes:
        summary: First line of its docstring, without the full stop.
        texts: Descriptions of its parameters, by name, from `Args:` of its docstring.
        parameters: Its parameters with their defaults; positional ones are `POSITIONAL_ONLY`, the
            others `KEYWORD_ONLY`. An annotation is a function that returns the type, because a type
            may need a library that is slow to import.
        takes: Names of the functions whose options it takes, see `takes`.
        without: Parameters that are not options of the verb, separated by spaces.
        exclusive: Mutually exclusive parameters, separated by spaces.
        epilog: Text below the options in the help.
    """

    summary: str
    texts: dict[str, str]
    parameters: tuple[Parameter, ...]
    takes: tuple[str, ...] = ()
    without: str = ""
    exclusive: str = ""
    epilog: str = ""


class _Module(dict[str, Any]):
    """The names of a module, each evaluated lazily from the source text."""

    def __init__(self, name: str) -> None:
        self._name = name
        path = name.replace(".", "/")
        try:
            text = pkgutil.get_data(_PACKAGE, f"{path}.py")
        except FileNotFoundError:
            text = pkgutil.get_data(_PACKAGE, f"{path}/__init__.py")
        self._nodes: dict[str, Any] = {}
        for node in ast.parse(text or "").body:
            # Type-only imports stand below an `if`.
            for each in node.body if isinstance(node, ast.If) else [node]:
                self._define(each)

    def __getattr__(self, name: str) -> Any:
        return self[name]

    def _define(self, node: ast.stmt) -> None:
        match node:
            case ast.ImportFrom() | ast.Import():
                module = node.module if isinstance(node, ast.ImportFrom) else ""
                for alias in node.names:
                    self._nodes[alias.asname or alias.name] = module, alias.name
            case ast.FunctionDef() | ast.ClassDef():
                self._nodes[node.name] = node
            case ast.Assign(targets=[ast.Name(name)]) | ast.AnnAssign(target=ast.Name(name)):
                self._nodes[name] = node.value

    def __missing__(self, name: str) -> Any:
        match self._nodes[name]:  # on KeyError Python looks up the builtins
            case (module, original):
                self[name] = _imported(module, original)
            case ast.FunctionDef() as node:
                self[name] = self._function(node)
            case ast.ClassDef() as node:
                self[name] = type(name, (), dict(self._fields(node)))  # a stand-in for the class
            case expression:
                self[name] = self._value(expression)
        return self[name]

    def _value(self, expression: ast.expr) -> Any:
        return eval(compile(ast.Expression(expression), self._name, "eval"), {}, self)

    def _fields(self, node: ast.ClassDef) -> Iterator[tuple[str, Any]]:
        """Fields of a class with literal defaults."""
        for each in node.body:
            match each:
                case ast.AnnAssign(target=ast.Name(name), value=ast.Constant(value)):
                    yield name, value
                case ast.AnnAssign(target=ast.Name(name), value=ast.Call(args=[default, *_])):
                    yield name, getattr(default, "value", None)  # of setting(default, ...)

    def _function(self, node: ast.FunctionDef) -> Function:
        docstring, given = ast.get_docstring(node) or "", node.args
        plain: list[Any] = [None] * (len(given.args) - len(given.defaults)) + given.defaults
        names, defaults = [*given.args, *given.kwonlyargs], [*plain, *given.kw_defaults]
        parameters = tuple(
            Parameter(
                each.arg,
                Parameter.POSITIONAL_ONLY if each in given.args else Parameter.KEYWORD_ONLY,
                default=Parameter.empty if default is None else self._value(default),
                annotation=partial(self._value, each.annotation or ast.Constant(None)),
            )
            for each, default in zip(names, defaults, strict=True)
        )
        decorators = [call for call in node.decorator_list if isinstance(call, ast.Call)]
        taken = [self._value(name) for call in decorators for name in call.args]
        named = {
            f"{word.arg}": self._value(word.value) for call in decorators for word in call.keywords
        }
        summary = docstring.partition("\n")[0].rstrip(".")
        return Function(summary, _descriptions(docstring), parameters, tuple(taken), **named)


_read_module = cache(_Module)


def _imported(module: str, name: str) -> Any:
    if module.startswith(f"{_PACKAGE}."):
        own = module.removeprefix(f"{_PACKAGE}.")
        try:
            return _read_module(own)[name]
        except KeyError:
            return _read_module(f"{own}.{name}")
    return getattr(import_module(module), name) if module else import_module(name)


def _descriptions(docstring: str) -> dict[str, str]:
    """The description of each argument in a Google-style docstring."""
    section = docstring.partition("\nArgs:\n")[2]
    section = re.split(r"^\S", section, maxsplit=1, flags=re.MULTILINE)[0]
    found = re.findall(r"^    (\w+): (.*?)(?=^    \w|\Z)", section, re.DOTALL | re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


def read_function(name: str) -> Function:
    """A function of the API, such as `fit`, or of a module, such as `batch.run_batch`."""
    module, _, function = name.rpartition(".")
    found: Function = _read_module(module or "api")[function]
    return found


def _taken(name: str) -> Iterator[tuple[str, Function]]:
    """A function and, recursively, those it takes."""
    function = read_function(name)
    yield name, function
    for taken in function.takes:
        yield from _taken(taken)


def _setting(parameter: Parameter) -> Any:
    """The default of a parameter of `fit`, taken from the identification settings if it is one."""
    settings = _read_module("settings.identification")["IdentificationSettings"]
    return getattr(settings, parameter.name, parameter.default)


def _text(name: str, functions: Iterable[Function]) -> str:
    """The first description of a parameter among the functions, following references."""
    text = next((each.texts[name] for each in functions if name in each.texts), "")
    if reference := _REFERENCE.match(text):
        return _text(reference["name"] or name, [read_function(reference["function"])])
    return text


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
    os.PathLike: {"type": Path, "metavar": "FILE"},
    Path: {"type": Path, "metavar": "FILE"},
    **{kind: {"type": kind} for kind in (str, float, int)},
}
_SEVERAL: dict[Any, dict[str, Any]] = {
    Sequence: {"nargs": "+", "action": _ExtendList},
    Iterable: {"action": "append"},
    list: {"action": "append"},  # several positional arguments
    tuple: {},
}


def add_options(parser: argparse.ArgumentParser, verb: str) -> None:
    """Add the options of a verb; parameters that cannot be typed, such as functions, are skipped.

    `Literal` gives choices, `bool` a flag, `PathLike` a path, `Sequence` several values per option,
    `Iterable` a repeatable option, `tuple` a fixed number of values, `list` several positional
    arguments. A function whose summary begins with "For" gives its options that heading.

    Args:
        parser: The verb's parser.
        verb: The verb's function, such as `commands.results.fit`.
    """
    functions = dict(_taken(verb))
    known = set(functions[verb].without.split())
    exclusive = {name for each in functions.values() for name in each.exclusive.split()}
    groups: dict[tuple[str, bool], Any] = {("", False): parser}
    for name, function in functions.items():
        heading = function.summary.lower() if function.summary.startswith("For ") else ""
        if (heading, False) not in groups:
            groups[heading, False] = parser.add_argument_group(heading)
        for number, parameter in enumerate(function.parameters):
            positional = parameter.kind is Parameter.POSITIONAL_ONLY
            is_subject = number == 0 and positional and name != verb
            if is_subject or parameter.name in known:
                continue
            if (keywords := _keywords(parameter.annotation())) is None:
                continue
            known.add(parameter.name)
            alone = parameter.name in exclusive
            if (heading, alone) not in groups:
                groups[heading, alone] = groups[heading, False].add_mutually_exclusive_group()
            shown = _setting(parameter) if name == "fit" else parameter.default
            text = _text(parameter.name, functions.values())
            keywords["help"] = _help(text, shown)
            if "choices" not in keywords and keywords.get("action") != "store_true":
                unit = re.search(r"\[(\w+)\]", text)
                usual = keywords.get("metavar") or (unit[1] if unit else parameter.name).upper()
                keywords["metavar"] = _METAVARS.get(parameter.name, usual)
            _add(groups[heading, alone], parameter, positional and name == verb, keywords)


def _add(group: Any, parameter: Parameter, positional: bool, keywords: dict[str, Any]) -> None:
    name, default = parameter.name, parameter.default
    if positional:
        several = "+" if keywords.pop("action", "") else None
        count = several if default is Parameter.empty else "*" if several else "?"
        group.add_argument(name, **keywords | {"nargs": count, "metavar": name.upper()})
        return
    if default is not Parameter.empty:
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


def _keywords(kind: Any) -> dict[str, Any] | None:
    """Keywords for argparse by type; None for a type that cannot be typed."""
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
        entry = _keywords(parts[several][0]) if several in parts else None
        if entry is not None:
            return entry | counted | ({"nargs": len(parts[several])} if several is tuple else {})
    return None


def _help(text: str, default: Any) -> str:
    """A description for the help: without code markup, with the default."""
    text = re.sub(r"^Whether (to )?|, see `[^`]*`|`| \[-\]|\.$", "", text).replace("%", "%%")
    if text[1:2].islower() or text[1:2] == " ":
        text = text[0].lower() + text[1:]
    without = (Parameter.empty, None, (), "")
    if default in without or isinstance(default, bool) or "(default" in text:
        return text
    return f"{text} (default: {f'{default:g}' if isinstance(default, float) else default})"


def release_paths(words: Sequence[str], parser: argparse.ArgumentParser) -> list[str]:
    """Move paths that follow the values of a list to the front.

    In `fit --leave-out Mz trials/hold` argparse would read the trial as a channel.

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
