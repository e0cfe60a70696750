"""Parameter files as ROS reads and writes them: sections of nodes, in namespaces or for any node.

A section is named after its node (`trigger_node`, `/left/trigger_node`), after a pattern (`/**`,
`/*/trigger_node`), or is nested in its namespace. `ros2 param dump` writes such files.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from socket_testbed.documents import read_document, refuse_unknown
from socket_testbed.errors import ConfigurationError

_CONTENT = "ros__parameters"
_ANY = ("*", "**")  # one name, or any number of names
# Every node has these; they belong to ROS and not to the settings.
_OF_ROS = re.compile(r"use_sim_time|start_type_description_service|qos_overrides(\..*)?")


@dataclass(frozen=True)
class Section:
    """A section of a parameter file.

    Attributes:
        key: Its name in the file, such as `/left/trigger_node`.
        namespace: Its namespace, such as `/left`, or a pattern of namespaces such as `/**`; `/**`
            for a name without any.
        node: The node's name; `*` or `**` for every node.
        values: Values by dotted name.
    """

    key: str
    namespace: str
    node: str
    values: dict[str, Any]

    @property
    def is_for_any_node(self) -> bool:
        """Whether it gives the parameters of every node that has them."""
        return self.node in _ANY

    @property
    def place(self) -> str | None:
        """The one namespace that it is for; None for a pattern."""
        anywhere = (self.namespace, self.node) == ("/", "**")
        return None if anywhere or "*" in self.namespace else self.namespace

    def fits(self, namespace: str, node: str) -> bool:
        """Whether it is for a node.

        Args:
            namespace: The node's absolute namespace.
            node: Its name.
        """
        wanted = _expression(f"{self.namespace.rstrip('/')}/{self.node}")
        return re.fullmatch(wanted, f"{namespace.rstrip('/')}/{node}") is not None


def _expression(pattern: str) -> str:
    """A regular expression of full names, as ROS matches them."""
    one, many = "/[A-Za-z0-9_]+", "(/[A-Za-z0-9_]+)*"
    parts = pattern.strip("/").split("/")
    return "".join({"*": one, "**": many}.get(part, f"/{re.escape(part)}") for part in parts)


def read_parameters(
    path: Path, known: Mapping[str, Collection[str]], namespace: str = "/"
) -> dict[str, tuple[dict[str, Any], bool]]:
    """Parameters by node from a file in the ROS format; later sections replace earlier ones.

    A file of one other namespace serves a graph without any. What every node of ROS has, such as
    `use_sim_time`, is left out.

    Args:
        path: The file; an empty one has no parameters.
        known: Names of the parameters by node.
        namespace: Absolute namespace of the nodes.

    Returns:
        By node its values by dotted name, and whether a section names the node; otherwise it has
        them from sections for any node.

    Raises:
        ConfigurationError: If the file cannot be read, is not in the ROS format, holds an unknown
            node or parameter, or only nodes of other namespaces.
    """
    sections = list(_sections(read_document(path, dict[str, Any]), str(path)))
    for section in sections:
        where = f"{path}: {section.key}"
        if section.is_for_any_node:
            refuse_unknown(section.values, {name for own in known.values() for name in own}, where)
        else:
            refuse_unknown([section.node], known, str(path))
    place = _place(sections, namespace, path)
    found: dict[str, tuple[dict[str, Any], bool]] = {}
    for section in sections:
        for node, names in known.items():
            if not section.fits(place, node):
                continue
            values, named = found.get(node, ({}, False))
            own = section.values
            if section.is_for_any_node:
                own = {name: value for name, value in own.items() if name in names}
            if own or not section.is_for_any_node:
                found[node] = values | own, named or not section.is_for_any_node
    return found


def _place(sections: Collection[Section], namespace: str, path: Path) -> str:
    """The namespace whose sections a graph in another namespace uses."""
    places = sorted({section.place for section in sections if section.place is not None})
    if not places or namespace in places:
        return namespace
    if len(places) == 1 and "/" in (namespace, places[0]):
        return places[0]
    hint = "give that namespace, or a file without namespaces"
    raise ConfigurationError(f"{path}: holds nodes in {', '.join(places)}, not {namespace}", hint)


def _sections(content: Mapping[str, Any], where: str, above: str = "") -> Iterator[Section]:
    """The sections of a document, in its order, with `above` before their names."""
    for key, value in content.items():
        name = f"{above.rstrip('/')}/{key.strip('/')}" if above else key
        named = f"{where}: {name}"
        if not isinstance(value, dict):
            hint = f"write '{_CONTENT}:' below the name of a node, then its parameters"
            raise ConfigurationError(f"{named} is not a mapping", hint)
        if _CONTENT not in value:
            if not value:
                raise ConfigurationError(f"{named}: '{_CONTENT}' is missing", "add it")
            yield from _sections(value, where, name)
            continue
        refuse_unknown(value, [_CONTENT], named)
        given = value[_CONTENT] or {}
        if not isinstance(given, dict):
            raise ConfigurationError(f"{named}: {_CONTENT} is not a mapping", "give 'name: value'")
        namespace, _, node = name.rpartition("/")
        if "/" not in name and node not in _ANY:
            namespace = "/**"
        elif not namespace.startswith("/"):
            namespace = f"/{namespace}"
        values = {n: v for n, v in _flat(given).items() if not _OF_ROS.fullmatch(n)}
        yield Section(name, namespace, node, values)


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by dotted name; ROS has no empty list, so it stands as one empty text."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{name}": entry for name, entry in _flat(value).items()}
        else:
            flat[key] = [] if value == [""] else value
    return flat
