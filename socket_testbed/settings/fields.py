"""Settings as frozen records: every field is checked for type and range on construction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from socket_testbed.documents import FINITE, Document, convert, plain, refuse_unknown
from socket_testbed.errors import ConfigurationError

S = TypeVar("S", bound="Settings")

# Switches of older files that the package no longer has; switched off, they change nothing.
_RETIRED = ("noise_correction",)

_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)  # a front makes hundreds


def setting(
    default: Any,
    description: str,
    low: float = -FINITE,  # the smallest value allowed
    high: float = FINITE,  # the largest one
    choices: tuple[str, ...] = (),  # the values allowed, for a text
    fixed: bool = False,  # whether a node takes it at its start only
    auto: float | None = None,  # the number that the text `auto` stands for, if any
) -> Any:
    """A field of a settings class; the description has the unit in brackets."""
    metadata = {"description": description, "low": low, "high": high}
    metadata |= {"choices": choices, "fixed": fixed, "auto": auto}
    return field(default=default, metadata=metadata)


fixed = partial(setting, fixed=True)


@cache
def _document(kind: Any) -> type[msgspec.Struct]:
    """The fields of settings as those of a document, without the settings below."""
    items = (item for item in dataclasses.fields(kind) if item.metadata)
    declared = [(item.name, _checked(_hints(kind)[item.name], item.metadata)) for item in items]
    return msgspec.defstruct(kind.__name__, declared, bases=(Document,))


def _checked(kind: Any, limits: Mapping[str, Any]) -> Any:
    """A type with the limits of its field."""
    if get_origin(kind) is tuple:
        return tuple[_checked(get_args(kind)[0], limits), ...]  # type: ignore[misc]
    if limits["choices"]:
        return Literal[limits["choices"]]
    span = {"ge": limits["low"], "le": limits["high"]} if kind in (int, float) else {}
    return Annotated[kind, Meta(description=limits["description"], **span)]


@dataclass(frozen=True)
class Settings:
    """Base of the settings: every field is checked for type and range on construction.

    A text such as `1e-08` stands for the number: ROS may hand over one for the other.
    """

    def __post_init__(self) -> None:
        given = {}
        for item in dataclasses.fields(self):
            if item.metadata:
                value, auto = getattr(self, item.name), item.metadata["auto"]
                given[item.name] = auto if auto is not None and value == "auto" else plain(value)
        kind: Any = type(self)  # a type is hashable, whatever its objects are
        checked = convert(given, _document(kind), strict=False)
        for name in given:
            object.__setattr__(self, name, getattr(checked, name))

    @classmethod
    def flat(cls, prefix: str = "") -> dict[str, dataclasses.Field[Any]]:
        """All fields by their dotted names, those of the settings below included."""
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
        """Build the settings from values by their dotted names; the others keep their defaults.

        An error names the source as `where`. The prefix is that of settings below others.
        """
        if not prefix:
            kept = [n for n in values if not (values[n] is False and n.endswith(_RETIRED))]
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
        """All values by their dotted names; a tuple becomes a list."""
        values: dict[str, Any] = {}
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if isinstance(value, Settings):
                values |= value.to_flat(f"{prefix}{item.name}.")
            else:
                values[prefix + item.name] = list(value) if isinstance(value, tuple) else value
        return values


def parameter_values(settings: Settings) -> dict[str, Any]:
    """Values by their dotted names, as ROS parameters can hold them.

    An empty list has no type in ROS: a list of one empty text stands for it.
    """
    return {name: [""] if v == [] else v for name, v in settings.to_flat().items()}
