"""Node parameters from the settings classes: names, types, ranges and descriptions."""

from __future__ import annotations

import math
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from socket_testbed.errors import ConfigurationError
from socket_testbed.settings.fields import Settings, parameter_values

S = TypeVar("S", bound=Settings)


class Parameters(Generic[S]):
    """The settings of a node, kept in step with its parameters.

    A change that the settings refuse is refused by the node, with the reason.

    Args:
        node: The node.
        kind: The class of its settings.

    Attributes:
        settings: The settings as they are now.

    Raises:
        ConfigurationError: If a parameter given at the start is wrong.
    """

    def __init__(self, node: Node, kind: type[S]) -> None:
        self._node = node
        self._kind = kind
        self._names = kind.flat()
        for name, value in parameter_values(kind()).items():
            node.declare_parameter(name, value, self._descriptor(name))
        self.settings = self._build({})
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def _descriptor(self, name: str) -> ParameterDescriptor:
        item = self._names[name]
        limits = item.metadata
        text = limits["description"]
        if limits["choices"]:
            text += "; one of " + ", ".join(limits["choices"])
        # Dynamic typing lets a whole number stand for a double; the settings check the rest.
        descriptor = ParameterDescriptor(
            name=name, description=text, dynamic_typing=True, read_only=limits["fixed"]
        )
        low, high = limits["low"], limits["high"]
        if isinstance(item.default, bool) or not isinstance(item.default, int | float):
            return descriptor
        if math.isfinite(low) and math.isfinite(high):
            if isinstance(item.default, int):
                span = IntegerRange(from_value=int(low), to_value=int(high), step=1)
                descriptor.integer_range = [span]
            else:
                wide = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
                descriptor.floating_point_range = [wide]
        return descriptor

    def _build(self, changes: dict[str, Any]) -> S:
        values = {name: self._node.get_parameter(name).value for name in self._names}
        values |= {name: value for name, value in changes.items() if name in values}
        cleaned = {name: _from_ros(value) for name, value in values.items()}
        return self._kind.from_flat(cleaned, self._node.get_name())

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._build({parameter.name: parameter.value for parameter in parameters})
        except ConfigurationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        del parameters
        self.settings = self._build({})


def _from_ros(value: Any) -> Any:
    if isinstance(value, str | bool | int | float):
        return value
    return [entry for entry in (value or ()) if entry != ""]
