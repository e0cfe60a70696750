"""Check that `help()` explains every public parameter, field and error of the package.

A public function with two parameters or more names each in `Args:`, a public class each of its
fields in `Attributes:`, and a public function each error that its own body raises in `Raises:`.
What an entry says is for readers to judge. Prints a line per gap; exits with 1 if there is any.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, get_origin

ROOT = Path(__file__).resolve().parents[1]
_TITLE = re.compile(r"^(Args|Attributes|Raises|Returns|Yields|Example|Examples|Note):$")
_ENTRY = re.compile(r"^ {4}(?:\*{0,2})(?P<names>[\w., *]+?)(?: \(.*?\))?:")
_INHERITED = {"args", "kwargs", "options", "_"}
_SILENT = {"NotImplementedError", "AssertionError", "SystemExit"}  # nobody outside acts on them


def entries(documented: Any, section: str) -> set[str]:
    """Names that a section of a Google-style docstring explains, as `help()` shows it.

    Args:
        documented: A class or function.
        section: The section's title, such as `Args`.
    """
    found: set[str] = set()
    inside = False
    for line in (inspect.getdoc(documented) or "").splitlines():
        title = _TITLE.match(line)
        if title:
            inside = title[1] == section
        entry = _ENTRY.match(line) if inside else None
        if entry:
            found |= {name.strip(" *") for name in entry["names"].split(",")}
    return found


def parameters(function: Any) -> list[str]:
    """Names of a function's parameters that a caller gives."""
    names = inspect.signature(function).parameters
    return [n for n in names if n not in {"self", "cls"} | _INHERITED and not n.startswith("_")]


def raised(function: Any) -> set[str]:
    """Names of the errors that a function's own body raises anew and does not catch."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    caught = {
        statement
        for attempt in ast.walk(tree)
        if isinstance(attempt, ast.Try)
        for part in attempt.body
        for statement in ast.walk(part)
        if isinstance(statement, ast.Raise) and _is_caught(statement, attempt)
    }
    calls = (n.exc for n in ast.walk(tree) if isinstance(n, ast.Raise) and n not in caught)
    names = {ast.unparse(call.func) for call in calls if isinstance(call, ast.Call)}
    return {name for name in names if name[:1].isupper() and name not in _SILENT}


def _is_caught(statement: ast.Raise, attempt: ast.Try) -> bool:
    """Whether one of the handlers of a `try` catches what a statement raises, if it is built in."""
    called = getattr(statement.exc, "func", None)
    error = getattr(builtins, getattr(called, "id", ""), None)
    kinds = (
        getattr(builtins, name.id, None)
        for handler in attempt.handlers
        for name in ast.walk(handler.type or ast.Name("BaseException"))
        if isinstance(name, ast.Name)
    )
    return error is not None and any(kind and issubclass(error, kind) for kind in kinds)


def gaps_of_function(function: Any, verb: bool) -> Iterator[str]:
    """What the docstring of a function does not explain.

    Args:
        function: The function.
        verb: Whether it is a verb of the command line, whose options the API explains.
    """
    named = [] if verb else parameters(function)
    if len(named) > 1:
        yield from (f"Args: {name}" for name in named if name not in entries(function, "Args"))
    for error in sorted(raised(function) - entries(function, "Raises")):
        yield f"Raises: {error}"


def fields(kind: Any) -> list[str]:
    """Names of the public fields that a class itself declares."""
    declared = vars(kind).get("__annotations__", {})
    return [
        name
        for name, annotation in declared.items()
        if not name.startswith("_")
        and "ClassVar" not in str(annotation)
        and get_origin(annotation) is not ClassVar
    ]


def gaps_of_module(module: Any) -> Iterator[tuple[str, str]]:
    """Public names of a module, and what their docstrings do not explain."""
    verbs = module.__name__.startswith("socket_testbed.commands")
    for name, value in vars(module).items():
        if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(value):
            yield from ((name, gap) for gap in gaps_of_function(value, verbs))
        if not inspect.isclass(value):
            continue
        explained = entries(value, "Attributes")
        yield from ((name, f"Attributes: {f}") for f in fields(value) if f not in explained)
        for method, found in vars(value).items():
            function = getattr(found, "__func__", found)
            if inspect.isfunction(function) and not method.startswith("_"):
                bound = getattr(value, method)
                yield from ((f"{name}.{method}", gap) for gap in gaps_of_function(bound, False))


def main(places: list[str]) -> int:
    """Print every gap below some files or folders of the package, by default all of it."""
    chosen = [Path(place).resolve() for place in places] or [ROOT / "socket_testbed"]
    files = sorted(file for place in chosen for file in [place, *place.rglob("*.py")])
    count = 0
    for file in files:
        if file.suffix != ".py" or file.name == "__main__.py":
            continue
        parts = file.relative_to(ROOT).with_suffix("").parts
        module = import_module(".".join(parts).removesuffix(".__init__"))
        for name, gap in gaps_of_module(module):
            count += 1
            print(f"{file.relative_to(ROOT)}: {name}: {gap}")
    if count:
        print(f"{count} parameters, fields and errors that help() does not explain")
    return int(count > 0)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main(sys.argv[1:]))
