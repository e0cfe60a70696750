"""The options of a verb, read from the text of functions: signatures and Google-style docstrings.

Nothing is imported but this package's light modules: the API takes seconds, for its libraries, and
`--help`, a wrong call and the shell's completion need only what is written.
"""

from __future__ import annotations

import ast
import dataclasses
import pkgutil
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from typing import Any, TypeVar

_PACKAGE = "socket_testbed"
_REFERENCE = re.compile(r"As (?:`(?P<name>\w+)` )?in `(?:st\.)?(?P<function>[\w.]+)`")
REQUIRED = object()  # the default of a parameter without one
F = TypeVar("F", bound=Callable[..., Any])


def takes(
    *functions: str, without: str = "", exclusive: str = "", epilog: str = ""
) -> Callable[[F], F]:
    """Give a verb the options that other functions take.

    Where two have the same parameter, the verb's own goes first, then that of the function named
    first. What a function works on, its first parameter, is no option.

    Args:
        functions: Functions of the API, such as `fit`, or of a module, such as `batch.run_batch`.
        without: Parameters that are no options of the verb, separated by spaces.
        exclusive: Parameters of which one at most may be given.
        epilog: What the help says below the options.
    """
    return lambda verb: verb  # `options_of` reads it from the module's text


@dataclass(frozen=True)
class Parameter:
    """A parameter of a function."""

    name: str
    type: Callable[[], Any]  # evaluated where it is needed: it may name a library's class
    default: Any
    text: str  # what its docstring says of it
    positional: bool
    shown: Any = None  # the default as the help shows it
    exclusive: bool = False  # only one such parameter may be given


@dataclass(frozen=True)
class Function:
    """A function, and the arguments of its decorator `takes`."""

    summary: str
    parameters: dict[str, Parameter]
    takes: tuple[str, ...] = ()
    without: str = ""
    exclusive: str = ""
    epilog: str = ""


class _Module(dict[str, Any]):
    """The names of a module, each evaluated from the module's text when it is first used."""

    def __init__(self, name: str) -> None:
        self._name = name
        path = name.replace(".", "/")
        try:
            text = pkgutil.get_data(_PACKAGE, f"{path}.py")
        except FileNotFoundError:
            text = pkgutil.get_data(_PACKAGE, f"{path}/__init__.py")
        self._nodes: dict[str, Any] = {}
        for node in ast.parse(text or "").body:
            # Below an `if` are the imports for types alone.
            for each in node.body if isinstance(node, ast.If) else [node]:
                self._define(each)

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
        match self._nodes[name]:  # a KeyError: Python looks among the builtins
            case (module, original):
                self[name] = _imported(module, original)
            case ast.FunctionDef() as node:
                self[name] = self._function(node)
            case ast.ClassDef() as node:
                self[name] = type(name, (), dict(self._fields(node)))  # stands for the class
            case expression:
                self[name] = self._value(expression)
        return self[name]

    def _value(self, expression: ast.expr) -> Any:
        return eval(compile(ast.Expression(expression), self._name, "eval"), {}, self)

    def _fields(self, node: ast.ClassDef) -> Iterator[tuple[str, Any]]:
        """The fields of a class whose default is written out."""
        for each in node.body:
            match each:
                case ast.AnnAssign(target=ast.Name(name), value=ast.Constant(value)):
                    yield name, value
                case ast.AnnAssign(target=ast.Name(name), value=ast.Call(args=[default, *_])):
                    yield name, getattr(default, "value", None)  # of setting(default, ...)

    def _function(self, node: ast.FunctionDef) -> Function:
        docstring = ast.get_docstring(node) or ""
        texts, given = _descriptions(docstring), node.args
        plain: list[Any] = [None] * (len(given.args) - len(given.defaults)) + given.defaults
        parameters = {
            each.arg: Parameter(
                each.arg,
                partial(self._value, each.annotation or ast.Constant(None)),
                REQUIRED if default is None else self._value(default),
                texts.get(each.arg, ""),
                each in given.args,
            )
            for each, default in zip(
                [*given.args, *given.kwonlyargs], [*plain, *given.kw_defaults], strict=True
            )
        }
        function = Function(docstring.partition("\n")[0].rstrip("."), parameters)
        for call in node.decorator_list:
            if isinstance(call, ast.Call):
                named = {f"{word.arg}": self._value(word.value) for word in call.keywords}
                taken = tuple(map(self._value, call.args))
                return dataclasses.replace(function, takes=taken, **named)
        return function


_read_module = cache(_Module)


def _imported(module: str, name: str) -> Any:
    if module.startswith(f"{_PACKAGE}."):
        return _read_module(module.removeprefix(f"{_PACKAGE}."))[name]
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


def options_of(verb: str) -> dict[str, list[Parameter]]:
    """The options of a verb, by the heading below which the help lists them.

    A function whose summary begins with "For" gives its options that heading.

    Args:
        verb: The verb's function, such as `commands.models.fit`.
    """
    own = read_function(verb)
    functions = {verb: own, **{name: read_function(name) for name in own.takes}}
    found: dict[str, list[Parameter]] = {}
    known = set(own.without.split())
    exclusive = {name for each in functions.values() for name in each.exclusive.split()}
    for name, function in functions.items():
        heading = function.summary if function.summary.startswith("For ") else ""
        for number, parameter in enumerate(function.parameters.values()):
            worked_on = number == 0 and parameter.positional and function is not own
            if parameter.name not in known and not worked_on:
                known.add(parameter.name)
                option = dataclasses.replace(
                    parameter,
                    text=_text(parameter.name, functions),
                    shown=_setting(parameter) if name == "fit" else parameter.default,
                    positional=parameter.positional and function is own,
                    exclusive=parameter.name in exclusive,
                )
                found.setdefault(heading, []).append(option)
    return found


def _setting(parameter: Parameter) -> Any:
    """The default, or that of a setting of the identification, which `fit` takes from the trial."""
    settings = _read_module("settings.identification")["IdentificationSettings"]
    return getattr(settings, parameter.name, parameter.default)


def _text(name: str, functions: dict[str, Function]) -> str:
    """The first description that a function gives of a parameter; references are followed."""
    for function in functions.values():
        text = function.parameters[name].text if name in function.parameters else ""
        if reference := _REFERENCE.match(text):
            there = reference["function"]
            return _text(reference["name"] or name, {there: read_function(there)})
        if text:
            return text
    return ""
