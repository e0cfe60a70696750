"""Settings as frozen records: every field is checked for type and range on construction."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_number, closest

S = TypeVar("S", bound="Settings")

_resolve = cache(get_type_hints)  # a front makes hundreds of settings


def _type_hints(kind: Any) -> dict[str, Any]:
    return _resolve(kind)


def setting(
    default: Any,
    description: str,
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    fixed: bool = False,
) -> Any:
    """A field of a settings class.

    Args:
        default: Default value.
        description: What it is, with its unit in brackets.
        low: Smallest value allowed.
        high: Largest value allowed.
        choices: The values allowed, for a text.
        fixed: Whether a node takes it at its start only.
    """
    metadata = {
        "description": description,
        "low": low,
        "high": high,
        "choices": choices,
        "fixed": fixed,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Base of the settings: every field is checked for type and range on construction."""

    def __post_init__(self) -> None:
        hints = _type_hints(type(self))
        for item in dataclasses.fields(self):
            if item.metadata:
                checked = _check(getattr(self, item.name), hints[item.name], item)
                object.__setattr__(self, item.name, checked)

    @classmethod
    def flat(cls, prefix: str = "") -> dict[str, dataclasses.Field[Any]]:
        """All fields by their dotted names, those of the settings below included."""
        names: dict[str, dataclasses.Field[Any]] = {}
        hints = _type_hints(cls)
        for item in dataclasses.fields(cls):
            kind = hints[item.name]
            if issubclass(get_origin(kind) or kind, Settings):
                names |= kind.flat(f"{prefix}{item.name}.")
            else:
                names[prefix + item.name] = item
        return names

    @classmethod
    def from_flat(cls: type[S], values: dict[str, Any], where: str, prefix: str = "") -> S:
        """Build the settings from dotted names.

        Args:
            values: Values by their dotted names; what is not named keeps its default.
            where: What names the source in an error.
            prefix: Prefix of the names, for settings below others.

        Raises:
            ConfigurationError: For an unknown name, or a wrong type or range.
        """
        if not prefix:
            known = cls.flat()
            for name in values:
                if name not in known:
                    raise ConfigurationError(f"{where}: unknown key '{name}'", closest(name, known))
        hints = _type_hints(cls)
        arguments: dict[str, Any] = {}
        for item in dataclasses.fields(cls):
            kind = hints[item.name]
            if issubclass(get_origin(kind) or kind, Settings):
                arguments[item.name] = kind.from_flat(values, where, f"{prefix}{item.name}.")
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


def _check(value: Any, kind: Any, item: dataclasses.Field[Any]) -> Any:
    limits = item.metadata
    if get_origin(kind) is tuple:
        element = get_args(kind)[0]
        if not isinstance(value, list | tuple):
            raise ConfigurationError(f"{item.name} is '{value}'", "give a list instead")
        return tuple(_check_scalar(entry, element, item.name, limits) for entry in value)
    return _check_scalar(value, kind, item.name, limits)


def _check_scalar(value: Any, kind: Any, name: str, limits: Any) -> Any:
    if kind is float:
        return check_number(value, name, limits["low"], limits["high"])
    if kind is int:
        number = check_number(value, name, limits["low"], limits["high"])
        if number != int(number):
            raise ConfigurationError(f"{name} is {value}", "give a whole number instead")
        return int(number)
    if not isinstance(value, kind):
        raise ConfigurationError(f"{name} is '{value}'", f"give a {kind.__name__} instead")
    if limits["choices"] and value not in limits["choices"]:
        raise ConfigurationError(f"{name} is '{value}'", closest(value, limits["choices"]))
    return value
