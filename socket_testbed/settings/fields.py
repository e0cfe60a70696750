"""Settings as frozen dataclasses; construction checks the type and range of every field."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
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

_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)  # cached: a front makes hundreds


def setting(
    default: Any,
    description: str,
    low: float = -FINITE,  # minimum
    high: float = FINITE,  # maximum
    choices: tuple[str, ...] = (),  # allowed texts
    fixed: bool = False,  # whether a node reads it only at startup
    auto: float | None = None,  # value of the text `auto`, if allowed
) -> Any:
    """A field of a settings class; its description ends with the unit in brackets."""
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


def _checked(kind: Any, limits: Mapping[str, Any]) -> Any:
    """A type annotated with the limits of its field."""
    if get_origin(kind) is tuple:
        return tuple[_checked(get_args(kind)[0], limits), ...]  # type: ignore[misc]
    if limits["choices"]:
        return Literal[limits["choices"]]
    span = {"ge": limits["low"], "le": limits["high"]} if kind in (int, float) else {}
    return Annotated[kind, Meta(description=limits["description"], **span)]


@dataclass(frozen=True)
class Settings:
    """Base class of all settings; construction checks the type and range of every field.

    Texts such as `1e-08` are accepted as numbers, since ROS may pass them.
    """

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
        """All fields by dotted name, including those of nested settings."""
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

        Errors start with `where`. `prefix` is the dotted prefix of nested settings.
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
        """All values by dotted name; tuples become lists."""
        values = {name: attrgetter(name)(self) for name in self.flat()}
        return {prefix + n: list(v) if isinstance(v, tuple) else v for n, v in values.items()}


def parameter_values(settings: Settings) -> dict[str, Any]:
    """Values by dotted name, in a form valid for ROS parameters.

    An empty list has no type in ROS, so it becomes a list of one empty text.
    """
    return {name: [""] if v == [] else v for name, v in settings.to_flat().items()}
