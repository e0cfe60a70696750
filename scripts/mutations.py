"""Small changes to Python sources, each of a value that a user may read, for `mutants.py`.

A site is a place that can be changed in one or several ways. Docstrings, annotations, decorators,
error texts, logging, `__repr__`, `__all__` and f-strings' expressions have none.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

_ARITHMETIC = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
_COMPARISONS = {
    ast.Eq: ("==", ["!="]),
    ast.NotEq: ("!=", ["=="]),
    ast.Lt: ("<", ["<=", ">"]),
    ast.LtE: ("<=", ["<", ">="]),
    ast.Gt: (">", [">=", "<"]),
    ast.GtE: (">=", [">", "<="]),
    ast.In: ("in", ["not in"]),
    ast.NotIn: (r"not\s+in", ["in"]),
    ast.Is: ("is", ["is not"]),
    ast.IsNot: (r"is\s+not", ["is"]),
}
_LOGIC = {ast.And: ("and", "or"), ast.Or: ("or", "and")}
_PAIRS = ("min max", "nanmin nanmax", "argmin argmax", "nanargmin nanargmax", "minimum maximum")
_FUNCTIONS = {a: b for pair in _PAIRS for a, b in (pair.split(), reversed(pair.split()))}
_WORDS = {
    a: b
    for pair in ("low high", "x y", "left right", "mean peak", "normal shear", "first last")
    for a, b in (pair.split(), reversed(pair.split()))
}
_ONE_OF = re.compile(rf"\b({'|'.join(_WORDS)})\b")
_MAX_TEXT = 60  # [characters]; longer texts are prose
_SILENT = {"TypeVar", "NewType", "cast", "isinstance", "issubclass", "SystemExit", "setattr"}
_LOGGING = {"debug", "info", "warning", "error", "exception", "critical", "log", "get_logger"}
_SYMMETRIC = {*_FUNCTIONS, "isclose", "allclose", "hypot", "gcd", "array_equal", "zip"}
_FIELDS = {"setting", "fixed"}
_UNREAD = {"__all__", "__slots__", "fact", "hint"}  # names whose values are not results
_CACHES = {"cache", "lru_cache", "cached_property"}


@dataclass(frozen=True)
class Mutant:
    """One change of a source file.

    Attributes:
        path: The file, relative to the checkout.
        lines: The lines of the changed expression, first to last: what runs one of them tests it.
        once: Whether the lines run once and for all, at import or behind a cache: any test that
            runs a function of the file may notice the change.
        start: First byte that is replaced.
        end: Byte behind the last one that is replaced.
        new: What replaces them.
    """

    path: str
    lines: range
    once: bool
    start: int
    end: int
    new: bytes

    def apply(self, source: bytes) -> bytes:
        """The changed source."""
        return source[: self.start] + self.new + source[self.end :]

    def describe(self, source: bytes) -> str:
        """Place, old line and new line."""
        number = source.count(b"\n", 0, self.start)
        old, new = (text.split(b"\n")[number].decode() for text in (source, self.apply(source)))
        return f"{self.path}:{number + 1}: {old.strip()}  ->  {new.strip()}"


def find_sites(checkout: Path, path: str) -> list[list[Mutant]]:
    """The mutants of a file, those of one site together.

    Args:
        checkout: The folder of the checkout.
        path: The file, relative to it.
    """
    source = (checkout / path).read_bytes()
    visitor = _Visitor(path, source)
    visitor.visit(ast.parse(source))
    return visitor.sites


class _Visitor(ast.NodeVisitor):
    """Collects the sites of a file, in the order of the source."""

    def __init__(self, path: str, source: bytes) -> None:
        self.sites: list[list[Mutant]] = []
        self._path, self._source = path, source
        self._starts = [0, *(found.end() for found in re.finditer(b"\n", source))]
        self._conditions: set[ast.AST] = set()
        self._lines = range(0)  # of the outermost expression that is visited
        self._once = True

    def visit(self, node: ast.AST) -> None:
        """Visit a node, unless nobody reads its value."""
        if _is_silent(node):
            return
        outside = self._lines
        if isinstance(node, ast.expr | ast.AugAssign) and not outside:
            self._lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
        if isinstance(node, ast.expr) and node in self._conditions:
            start, end = self._span(node)
            self._add(start, end, [f"not ({self._source[start:end].decode()})"])
        super().visit(node)
        self._lines = outside

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        """Defaults run with the definition, the body does not."""
        for value in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
            self.visit(value)
        outside = self._once
        decorators = {name.id for part in node.decorator_list for name in _names(part)}
        self._once = not _CACHES.isdisjoint(decorators)
        for statement in node.body:
            self.visit(statement)
        self._once = outside

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """The body alone: no decorator, no base."""
        for statement in node.body:
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """The value alone, unless it is a type."""
        if node.value and "TypeAlias" not in ast.unparse(node.annotation):
            self.visit(node.value)

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        """The body alone."""
        for statement in node.body:
            self.visit(statement)

    def visit_If(self, node: ast.If | ast.While | ast.IfExp) -> None:
        """Negate the condition."""
        self._conditions.add(node.test)
        self.generic_visit(node)

    visit_While = visit_IfExp = visit_If

    def visit_comprehension(self, node: ast.comprehension) -> None:
        """Negate the conditions."""
        self._conditions.update(node.ifs)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp | ast.AugAssign) -> None:
        """Swap + and -, * and /, unless texts or paths are joined."""
        left, right = (
            (node.left, node.right) if isinstance(node, ast.BinOp) else (node.target, node.value)
        )
        joined = any(isinstance(each, ast.JoinedStr) or _is_text(each) for each in (left, right))
        if type(node.op) in _ARITHMETIC and not joined:
            old, new = _ARITHMETIC[type(node.op)]
            self._replace_between(left, right, re.escape(old), [new])
        self.generic_visit(node)

    visit_AugAssign = visit_BinOp

    def visit_Compare(self, node: ast.Compare) -> None:
        """Turn a comparison, or shift its limit."""
        for left, operator, right in zip(
            [node.left, *node.comparators], node.ops, node.comparators, strict=False
        ):
            self._replace_between(left, right, *_COMPARISONS[type(operator)])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """Swap and and or."""
        old, new = _LOGIC[type(node.op)]
        self._replace_between(node.values[0], node.values[1], old, [new])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """Drop a minus or a not."""
        start = self._span(node)[0]
        if isinstance(node.op, ast.USub):
            self._add(start, start + len("-"), [""])
            if ast.unparse(node.operand) == "1":
                return  # to NumPy -10 is often as good as -1
        elif isinstance(node.op, ast.Not):
            self._add(start, start + len("not"), [""])
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """Another number or text."""
        value = node.value
        if isinstance(value, str) and len(value) <= _MAX_TEXT and re.search("[A-Za-z]", value):
            self._add(*self._span(node), [json.dumps(_changed(value), ensure_ascii=False)])
        elif isinstance(value, int | float) and not isinstance(value, bool):
            others = dict.fromkeys(repr(each) for each in (10 * value, value + 1, 0 * value))
            self._add(*self._span(node), [each for each in others if each != repr(value)])

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Another letter of an f-string; places of its expressions are known from Python 3.12."""
        start, end = self._span(node)
        text = self._source[start:end].decode()
        for part in (str(part.value) for part in node.values if isinstance(part, ast.Constant)):
            if re.search("[A-Za-z]", part) and part in text and len(text) <= _MAX_TEXT:
                self._add(start, end, [text.replace(part, _changed(part), 1)])
                return

    def visit_Subscript(self, node: ast.Subscript) -> None:
        """Swap the indices 0 and 1."""
        index = node.slice
        if isinstance(index, ast.Constant) and index.value in (0, 1):
            self._add(*self._span(index), [str(1 - index.value)])
            self.visit(node.value)
        else:
            self.generic_visit(node)

    def visit_Tuple(self, node: ast.Tuple) -> None:
        """Swap two neighbours of like kind."""
        if isinstance(node.ctx, ast.Load):
            self._swap(node.elts)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        """Swap min and max, and two neighbouring arguments of like kind."""
        name = _called(node)
        if name in _FIELDS:  # its second argument is a description
            for value in (*node.args[:1], *node.args[2:]):
                self.visit(value)
            return
        if name in _FUNCTIONS:
            end = self._span(node.func)[1]
            self._add(end - len(name), end, [_FUNCTIONS[name]])
        if name not in _SYMMETRIC:
            self._swap(node.args)
        self.generic_visit(node)

    def _swap(self, values: list[ast.expr]) -> None:
        for one, other in pairwise(values):
            (start, middle), (then, end) = self._span(one), self._span(other)
            texts = [self._source[a:b].decode() for a, b in ((start, middle), (then, end))]
            if _kind(one) is _kind(other) is not None and texts[0] != texts[1]:
                between = self._source[middle:then].decode()
                self._add(start, end, [f"{texts[1]}{between}{texts[0]}"])

    def _replace_between(self, left: ast.expr, right: ast.expr, old: str, new: list[str]) -> None:
        """Replace an operator, which stands between its operands."""
        start, end = self._span(left)[1], self._span(right)[0]
        gap = re.sub(rb"#[^\n]*", lambda found: b" " * len(found[0]), self._source[start:end])
        operator = re.search(old.encode(), gap)
        assert operator, gap
        self._add(start + operator.start(), start + operator.end(), new)

    def _add(self, start: int, end: int, texts: list[str]) -> None:
        found = [
            Mutant(self._path, self._lines, self._once, start, end, text.encode()) for text in texts
        ]
        if found:
            self.sites.append(found)

    def _span(self, node: ast.expr) -> tuple[int, int]:
        """First byte of a node, and the one behind its last."""
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = self._starts[node.lineno - 1] + node.col_offset
        return start, self._starts[node.end_lineno - 1] + node.end_col_offset


def _is_silent(node: ast.AST) -> bool:
    """Whether nobody reads the value of a node, or it is not one."""
    if isinstance(node, ast.Expr):
        return _is_text(node.value)  # a docstring
    if isinstance(node, ast.FunctionDef):
        return node.name == "__repr__"
    if isinstance(node, ast.If):
        return bool({name.id for name in _names(node.test)} & {"TYPE_CHECKING", "__name__"})
    if isinstance(node, ast.Assign):
        return any(name.id in _UNREAD for target in node.targets for name in _names(target))
    if isinstance(node, ast.Call):
        name = _called(node)
        return name.endswith("Error") or name in _SILENT or name in _LOGGING
    return isinstance(node, ast.Assert)


def _names(node: ast.AST) -> Iterator[ast.Name]:
    return (name for name in ast.walk(node) if isinstance(name, ast.Name))


def _called(node: ast.Call) -> str:
    """The name of a called function or method; empty for another expression."""
    return str(getattr(node.func, "attr", getattr(node.func, "id", "")))


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _kind(node: ast.expr) -> Any:
    """What two expressions share that may be exchanged by mistake; None for others."""
    if isinstance(node, ast.Constant):
        return type(node.value)
    return type(node) if isinstance(node, ast.Name | ast.Attribute | ast.Subscript) else None


def _changed(text: str) -> str:
    """A text with the opposite of one of its words, or else another first letter."""
    if _ONE_OF.search(text):
        return _ONE_OF.sub(lambda found: _WORDS[found[0]], text, count=1)
    return re.sub("[A-Za-z]", lambda found: "z" if found[0] != "z" else "a", text, count=1)
