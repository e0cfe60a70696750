"""Settings as frozen dataclasses; construction checks the type and range of every field.

A field's description, range and choices are stated once, in its call of `setting`. From there come
the checks, the parameters' descriptions in ROS, and the `Attributes:` that `help()` shows.
"""

from __future__ import annotations

import dataclasses
import inspect
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from operator import attrgetter
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from socket_testbed.documents import FINITE, Document, convert, plain, refuse_unknown
from socket_testbed.errors import ConfigurationError

S = TypeVar("S", bound="Settings")

# Switches in older files that were removed; accepted if they are off.
_RETIRED = ("noise_correction",)
# Settings in older files that were removed; accepted with any value, as nothing reads them.
_UNREAD = ("wrench_sharpness",)

_WIDTH = 92  # [characters]; of the lines of a section `Attributes:`

_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)  # cached: a front makes hundreds


def setting(
    default: Any,
    description: str,
    low: float = -FINITE,
    high: float = FINITE,
    choices: Sequence[str] = (),
    fixed: bool = False,
    auto: float | None = None,
) -> Any:
    """A field of a settings class.

    Args:
        default: The default value, in the field's unit.
        description: What the field is, for a reader who sees this field alone. It ends with the
            unit in brackets: `[1]` for counts and numbers of things, `[-]` for other dimensionless
            values and texts.
        low: The least number allowed, of each item in a tuple; in the field's unit.
        high: The largest number allowed, of each item in a tuple; in the field's unit.
        choices: The texts allowed; empty for any.
        fixed: Whether a node reads the field only at startup.
        auto: The value that the text `auto` stands for; None if `auto` is not allowed.
    """
    metadata = {"description": description, "low": low, "high": high}
    metadata |= {"choices": choices, "fixed": fixed, "auto": auto}
    return field(default=default, metadata=metadata)


fixed = partial(setting, fixed=True)


@cache
def _document(kind: Any) -> type[msgspec.Struct]:
    """A document type with the fields of settings, without nested settings."""
    items = (item for item in dataclasses.fields(kind) if item.metadata)
    declared = [(item.name, _checked(_hints(kind)[item.name], item.metadata)) for item in items]
    return msgspec.defstruct(kind.__name__, declared, bases=(Document,))


def renew_choices() -> None:
    """Let settings that are made from now on take choices that were added to a field."""
    _document.cache_clear()


def _checked(kind: Any, limits: Mapping[str, Any]) -> Any:
    """A type annotated with the limits of its field."""
    if get_origin(kind) is tuple:
        return tuple[_checked(get_args(kind)[0], limits), ...]  # type: ignore[misc]
    if limits["choices"]:
        return Literal[tuple(limits["choices"])]
    span = {"ge": limits["low"], "le": limits["high"]} if kind in (int, float) else {}
    return Annotated[kind, Meta(description=limits["description"], **span)]


def _explained(declared: Settings | dataclasses.Field[Any]) -> str:
    """Description, default, and range or choices of a field; the class of nested settings."""
    if isinstance(declared, Settings):
        return f"nested settings, a `{type(declared).__name__}`"
    if not declared.metadata:
        return f"nested settings, a `{declared.default_factory.__name__}`"  # type: ignore[union-attr]
    limits = declared.metadata
    text = f"{limits['description']}; default {declared.default!r}"
    if limits["choices"]:
        return f"{text}; one of {', '.join(map(repr, limits['choices']))}"
    low, high = limits["low"], limits["high"]
    each = "each " if isinstance(declared.default, tuple) else ""
    if low > -FINITE and high < FINITE:
        return f"{text}; {each}from {low:g} to {high:g}"
    if low > -FINITE:
        return f"{text}; {each}at least {low:g}"
    return f"{text}; {each}at most {high:g}" if high < FINITE else text


def _entry(name: str, declared: Settings | dataclasses.Field[Any]) -> str:
    """The lines of a field in the section `Attributes:` of a docstring.

    Args:
        name: The field's name.
        declared: What the class's body assigns to it.
    """
    return textwrap.fill(
        f"{name}: {_explained(declared)}.",
        _WIDTH,
        initial_indent="    ",
        subsequent_indent="        ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _inherited(base: type[Any]) -> list[tuple[str, Settings | dataclasses.Field[Any]]]:
    """The fields of a base class that is a dataclass, by name."""
    found = dataclasses.fields(base) if dataclasses.is_dataclass(base) else ()
    return [
        (item.name, item.default if isinstance(item.default, Settings) else item) for item in found
    ]


@dataclass(frozen=True)
class Settings:
    """Base class of all settings; construction checks the type and range of every field.

    Texts such as `1e-08` are accepted as numbers, since ROS may pass them. A subclass documents
    its fields by their descriptions: they become the `Attributes:` of its docstring.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Append the section `Attributes:` to a subclass's docstring.

        `@dataclass` follows this call, so the fields still stand in the body of the class.
        """
        super().__init_subclass__(**options)
        if cls.__doc__:  # `python -OO` strips it
            declared = {name: item for base in cls.__bases__ for name, item in _inherited(base)}
            declared |= {
                name: item
                for name, item in vars(cls).items()
                if isinstance(item, Settings | dataclasses.Field)
            }
            entries = (_entry(name, item) for name, item in declared.items())
            cls.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__), "\nAttributes:", *entries])

    def __post_init__(self) -> None:
        given = {}
        for item in dataclasses.fields(self):
            if item.metadata:
                value, auto = getattr(self, item.name), item.metadata["auto"]
                given[item.name] = auto if auto is not None and value == "auto" else plain(value)
        kind: Any = type(self)  # hashable, even if its instances are not
        checked = convert(given, _document(kind), strict=False)
        for name in given:
            object.__setattr__(self, name, getattr(checked, name))

    @classmethod
    def flat(cls, prefix: str = "") -> dict[str, dataclasses.Field[Any]]:
        """All fields by dotted name, including those of nested settings; `prefix` precedes each."""
        names: dict[str, dataclasses.Field[Any]] = {}
        hints = _hints(cls)
        for item in dataclasses.fields(cls):
            if item.metadata:
                names[prefix + item.name] = item
            else:
                names |= hints[item.name].flat(f"{prefix}{item.name}.")
        return names

    @classmethod
    def from_flat(cls: type[S], values: dict[str, Any], where: str, prefix: str = "") -> S:
        """Build the settings from values by dotted name; other fields keep their defaults.

        Args:
            values: Values by dotted name, in the fields' units.
            where: The source of the values, with which errors begin, such as a file and a node.
            prefix: Dotted prefix of the names, for nested settings; empty otherwise.

        Raises:
            ConfigurationError: If a name is unknown, or a value has the wrong type or range.
        """
        if not prefix:
            kept = [n for n in values if not (values[n] is False and n.endswith(_RETIRED))]
            kept = [name for name in kept if not name.endswith(_UNREAD)]
            refuse_unknown(kept, cls.flat(), where)
        hints = _hints(cls)
        arguments: dict[str, Any] = {}
        for item in dataclasses.fields(cls):
            if not item.metadata:
                below = f"{prefix}{item.name}."
                arguments[item.name] = hints[item.name].from_flat(values, where, below)
            elif prefix + item.name in values:
                arguments[item.name] = values[prefix + item.name]
        try:
            return cls(**arguments)
        except ConfigurationError as error:
            raise ConfigurationError(f"{where}: {prefix}{error.fact}", error.hint) from None

    def to_flat(self, prefix: str = "") -> dict[str, Any]:
        """All values by dotted name, after `prefix`, in the fields' units; tuples become lists."""
        values = {name: attrgetter(name)(self) for name in self.flat()}
        return {prefix + n: list(v) if isinstance(v, tuple) else v for n, v in values.items()}


def parameter_values(settings: Settings) -> dict[str, Any]:
    """Values by dotted name, in a form valid for ROS parameters.

    An empty list has no type in ROS, so it becomes a list of one empty text.
    """
    return {name: [""] if v == [] else v for name, v in settings.to_flat().items()}
