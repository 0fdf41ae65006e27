# SPDX-License-Identifier: Apache-2.0
"""The node's parameters, as other nodes read them: with rclcpp's answers, and nobody can set them.

Autoware's ``map_height_fitter`` waits until all parameter services of the map loader are there, and then asks
``enable_partial_load`` whether to use the service or the topic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from shmmap_clients.ros_bridge.messages.parameters import (
    ListParametersResult,
    ParameterDescriptor,
    ParameterValue,
    SetParametersResult,
)

__all__ = ["Parameters", "Value"]

Value = bool | float | str | list[str]

_BOOL, _DOUBLE, _STRING, _STRING_ARRAY = 1, 3, 4, 9  # rcl_interfaces/msg/ParameterType
_TYPES: Final[Mapping[type, int]] = {bool: _BOOL, float: _DOUBLE, str: _STRING, list: _STRING_ARRAY}
_NOT_DECLARED: Final = "parameter '{}' cannot be set because it was not declared"
_READ_ONLY: Final = "parameter '{}' cannot be set because it is read-only"
_SOME_NOT_DECLARED: Final = "One or more parameters were not declared before setting"


class Parameters:
    """Values by name, and the fields of replies to the six parameter services.

    Parameters
    ----------
    values
        Parameters with their values.
    descriptions
        Texts for some of them.
    """

    def __init__(self, values: Mapping[str, Value], descriptions: Mapping[str, str] | None = None) -> None:
        self._values = dict(sorted(values.items()))
        self._descriptions = dict(descriptions or {})

    def reply(self, service: str, message: Any) -> dict[str, Any]:
        """Return the fields of a reply, those of its head left out.

        Parameters
        ----------
        service
            Last part of the service's name, such as ``get_parameters``.
        message
            The request.
        """
        if service == "get_parameters":
            return {"values": [self._value(name) for name in self._known(message.names)]}
        if service == "get_parameter_types":
            return {"types": [_TYPES[type(self._values[name])] for name in self._known(message.names)]}
        if service == "describe_parameters":
            return {"descriptors": [self._descriptor(name) for name in self._known(message.names)]}
        if service == "list_parameters":
            return {"result": self._listed(message.prefixes, message.depth)}
        names = [one.name for one in message.parameters]
        if service == "set_parameters":
            return {"results": [SetParametersResult(False, self._refusal(name)) for name in names]}
        undeclared = any(name not in self._values for name in names)
        reason = _SOME_NOT_DECLARED if undeclared else next(map(self._refusal, names), "")
        return {"result": SetParametersResult(not names, reason)}

    def _known(self, names: Sequence[str]) -> Sequence[str]:
        """The names; none of them where one is unknown, for which rclcpp gives an empty answer."""
        return names if all(name in self._values for name in names) else ()

    def _value(self, name: str) -> ParameterValue:
        value = self._values[name]
        return ParameterValue(
            type=_TYPES[type(value)],
            bool_value=value is True,
            integer_value=0,
            double_value=value if isinstance(value, float) else 0.0,
            string_value=value if isinstance(value, str) else "",
            byte_array_value=[],
            bool_array_value=[],
            integer_array_value=[],
            double_array_value=[],
            string_array_value=value if isinstance(value, list) else [],
        )

    def _descriptor(self, name: str) -> ParameterDescriptor:
        return ParameterDescriptor(
            name=name,
            type=_TYPES[type(self._values[name])],
            description=self._descriptions.get(name, ""),
            additional_constraints="",
            read_only=True,
            dynamic_typing=False,
            floating_point_range=[],
            integer_range=[],
        )

    def _refusal(self, name: str) -> str:
        return (_READ_ONLY if name in self._values else _NOT_DECLARED).format(name)

    def _listed(self, prefixes: Sequence[str], depth: int) -> ListParametersResult:
        """Names below prefixes, at most ``depth`` parts down (0: all), as rclcpp lists them."""

        def near(rest: str) -> bool:
            return depth == 0 or rest.count(".") < depth

        def wanted(name: str) -> bool:
            if not prefixes:
                return near(name)
            return any(
                name == one or (name.startswith(f"{one}.") and near(name[len(one) + 1 :])) for one in prefixes
            )

        names = [name for name in self._values if wanted(name)]
        above = [name.rpartition(".")[0] for name in names]
        return ListParametersResult(names, list(dict.fromkeys(one for one in above if one)))
