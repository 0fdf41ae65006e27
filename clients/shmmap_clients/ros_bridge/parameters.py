# SPDX-License-Identifier: Apache-2.0
"""The node's read-only parameters: services of ``rcl_interfaces`` as IDL, with answers as from rclcpp.

Autoware's ``map_height_fitter`` waits until all parameter services of the map loader are present.  Then it
reads ``enable_partial_load`` to choose between the service and the topic.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from cyclonedds.idl.types import float64, int64, sequence, uint8, uint64

from shmmap_clients.ros_bridge.messages import ServiceKind, message, service

Value = bool | float | str | list[str]
_BOOL, _DOUBLE, _STRING, _STRING_ARRAY = 1, 3, 4, 9  # rcl_interfaces/msg/ParameterType
_TYPES: Final[Mapping[type, int]] = {bool: _BOOL, float: _DOUBLE, str: _STRING, list: _STRING_ARRAY}
_NOT_DECLARED: Final = "parameter '{}' cannot be set because it was not declared"
_READ_ONLY: Final = "parameter '{}' cannot be set because it is read-only"
_SOME_NOT_DECLARED: Final = "One or more parameters were not declared before setting"

ParameterValue: Final = message(
    "rcl_interfaces/msg/ParameterValue",
    type=uint8,
    bool_value=bool,
    integer_value=int64,
    double_value=float64,
    string_value=str,
    byte_array_value=sequence[uint8],
    bool_array_value=sequence[bool],
    integer_array_value=sequence[int64],
    double_array_value=sequence[float64],
    string_array_value=sequence[str],
)
"""A value of one type: 0 not set, 1 bool, 2 integer, 3 double, 4 string, 5 to 9 arrays (5: of bytes)."""

Parameter: Final = message(
    "rcl_interfaces/msg/Parameter",
    name=str,
    value=ParameterValue,
)
"""A parameter."""

FloatingPointRange: Final = message(
    "rcl_interfaces/msg/FloatingPointRange",
    from_value=float64,
    to_value=float64,
    step=float64,
)
"""Range of allowed numbers."""

IntegerRange: Final = message(
    "rcl_interfaces/msg/IntegerRange",
    from_value=int64,
    to_value=int64,
    step=uint64,
)
"""Range of allowed whole numbers."""

ParameterDescriptor: Final = message(
    "rcl_interfaces/msg/ParameterDescriptor",
    name=str,
    type=uint8,
    description=str,
    additional_constraints=str,
    read_only=bool,
    dynamic_typing=bool,
    floating_point_range=sequence[FloatingPointRange, 1],
    integer_range=sequence[IntegerRange, 1],
)
"""Description of a parameter."""

SetParametersResult: Final = message(
    "rcl_interfaces/msg/SetParametersResult",
    successful=bool,
    reason=str,
)
"""Whether a parameter was set, and if not, the reason."""

ListParametersResult: Final = message(
    "rcl_interfaces/msg/ListParametersResult",
    names=sequence[str],
    prefixes=sequence[str],
)
"""Names of parameters, and their prefixes."""


_NAMES: Final = {"names": sequence[str]}
_VALUES: Final = {"parameters": sequence[Parameter]}
PARAMETER_SERVICES: Final[Mapping[str, ServiceKind]] = {
    "get_parameters": service(
        "rcl_interfaces/srv/GetParameters",
        request=_NAMES,
        reply={"values": sequence[ParameterValue]},
    ),
    "get_parameter_types": service(
        "rcl_interfaces/srv/GetParameterTypes",
        request=_NAMES,
        reply={"types": sequence[uint8]},
    ),
    "set_parameters": service(
        "rcl_interfaces/srv/SetParameters",
        request=_VALUES,
        reply={"results": sequence[SetParametersResult]},
    ),
    "set_parameters_atomically": service(
        "rcl_interfaces/srv/SetParametersAtomically",
        request=_VALUES,
        reply={"result": SetParametersResult},
    ),
    "list_parameters": service(
        "rcl_interfaces/srv/ListParameters",
        request={"prefixes": sequence[str], "depth": uint64},
        reply={"result": ListParametersResult},
    ),
    "describe_parameters": service(
        "rcl_interfaces/srv/DescribeParameters",
        request=_NAMES,
        reply={"descriptors": sequence[ParameterDescriptor]},
    ),
}
"""Types of the parameter services, by the last part of their names.

Lists of a reply are in the order of the request.  ``depth`` is the number of levels of names below the
prefixes; 0: all.
"""


class Parameters:
    """The parameters, and the replies of the six parameter services.

    Parameters
    ----------
    values
        Values of the parameters, by name.
    descriptions
        Descriptions of some parameters, by name.
    """

    def __init__(self, values: Mapping[str, Value], descriptions: Mapping[str, str] | None = None) -> None:
        self._values = dict(sorted(values.items()))
        self._descriptions = dict(descriptions or {})

    def reply(self, service: str, message: Any) -> dict[str, Any]:
        """Return the fields of a reply, except those of its head.

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
        """Return the names, or none if one is unknown, for which rclcpp returns an empty answer."""
        return names if all(name in self._values for name in names) else ()

    def _value(self, name: str) -> Any:
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

    def _descriptor(self, name: str) -> Any:
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

    def _listed(self, prefixes: Sequence[str], depth: int) -> Any:
        """Return the names below prefixes, at most ``depth`` parts down (0: all), as rclcpp lists them."""

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
