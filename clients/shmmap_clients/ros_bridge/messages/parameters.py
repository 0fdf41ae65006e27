# SPDX-License-Identifier: Apache-2.0
"""``rcl_interfaces``: the services by which other nodes read a node's parameters."""

from dataclasses import dataclass
from typing import Final

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int64, sequence, uint8, uint64

from shmmap_clients.ros_bridge.messages.wire import ServiceKind, sample

__all__ = [
    "PARAMETER_SERVICES",
    "FloatingPointRange",
    "IntegerRange",
    "ListParametersResult",
    "Parameter",
    "ParameterDescriptor",
    "ParameterValue",
    "SetParametersResult",
]


@dataclass
@sample
class ParameterValue(IdlStruct, typename="rcl_interfaces::msg::dds_::ParameterValue_"):
    """A value of one type: 0 not set, 1 bool, 2 integer, 3 double, 4 string, 5 to 9 arrays (5: of bytes)."""

    type: uint8
    bool_value: bool
    integer_value: int64
    double_value: float64
    string_value: str
    byte_array_value: sequence[uint8]
    bool_array_value: sequence[bool]
    integer_array_value: sequence[int64]
    double_array_value: sequence[float64]
    string_array_value: sequence[str]


@dataclass
@sample
class Parameter(IdlStruct, typename="rcl_interfaces::msg::dds_::Parameter_"):
    """A parameter."""

    name: str
    value: ParameterValue


@dataclass
@sample
class FloatingPointRange(IdlStruct, typename="rcl_interfaces::msg::dds_::FloatingPointRange_"):
    """Which numbers are allowed."""

    from_value: float64
    to_value: float64
    step: float64


@dataclass
@sample
class IntegerRange(IdlStruct, typename="rcl_interfaces::msg::dds_::IntegerRange_"):
    """Which whole numbers are allowed."""

    from_value: int64
    to_value: int64
    step: uint64


@dataclass
@sample
class ParameterDescriptor(IdlStruct, typename="rcl_interfaces::msg::dds_::ParameterDescriptor_"):
    """What a parameter is."""

    name: str
    type: uint8
    description: str
    additional_constraints: str
    read_only: bool
    dynamic_typing: bool
    floating_point_range: sequence[FloatingPointRange, 1]
    integer_range: sequence[IntegerRange, 1]


@dataclass
@sample
class SetParametersResult(IdlStruct, typename="rcl_interfaces::msg::dds_::SetParametersResult_"):
    """Whether a parameter is set, and why not."""

    successful: bool
    reason: str


@dataclass
@sample
class ListParametersResult(IdlStruct, typename="rcl_interfaces::msg::dds_::ListParametersResult_"):
    """Names of parameters, and the prefixes that they have."""

    names: sequence[str]
    prefixes: sequence[str]


@dataclass
@sample
class GetParametersRequest(IdlStruct, typename="rcl_interfaces::srv::dds_::GetParameters_Request_"):
    """Values of these parameters?"""

    client: uint64
    number: int64
    names: sequence[str]


@dataclass
@sample
class GetParametersResponse(IdlStruct, typename="rcl_interfaces::srv::dds_::GetParameters_Response_"):
    """They, in the order asked for."""

    client: uint64
    number: int64
    values: sequence[ParameterValue]


@dataclass
@sample
class GetParameterTypesRequest(IdlStruct, typename="rcl_interfaces::srv::dds_::GetParameterTypes_Request_"):
    """Types of these parameters?"""

    client: uint64
    number: int64
    names: sequence[str]


@dataclass
@sample
class GetParameterTypesResponse(IdlStruct, typename="rcl_interfaces::srv::dds_::GetParameterTypes_Response_"):
    """They, in the order asked for."""

    client: uint64
    number: int64
    types: sequence[uint8]


@dataclass
@sample
class SetParametersRequest(IdlStruct, typename="rcl_interfaces::srv::dds_::SetParameters_Request_"):
    """Set each of these."""

    client: uint64
    number: int64
    parameters: sequence[Parameter]


@dataclass
@sample
class SetParametersResponse(IdlStruct, typename="rcl_interfaces::srv::dds_::SetParameters_Response_"):
    """What became of each."""

    client: uint64
    number: int64
    results: sequence[SetParametersResult]


@dataclass
@sample
class SetParametersAtomicallyRequest(
    IdlStruct, typename="rcl_interfaces::srv::dds_::SetParametersAtomically_Request_"
):
    """Set all of these or none."""

    client: uint64
    number: int64
    parameters: sequence[Parameter]


@dataclass
@sample
class SetParametersAtomicallyResponse(
    IdlStruct, typename="rcl_interfaces::srv::dds_::SetParametersAtomically_Response_"
):
    """Whether they are set."""

    client: uint64
    number: int64
    result: SetParametersResult


@dataclass
@sample
class ListParametersRequest(IdlStruct, typename="rcl_interfaces::srv::dds_::ListParameters_Request_"):
    """Which parameters are there below these prefixes, so many levels down (0: all)?"""

    client: uint64
    number: int64
    prefixes: sequence[str]
    depth: uint64


@dataclass
@sample
class ListParametersResponse(IdlStruct, typename="rcl_interfaces::srv::dds_::ListParameters_Response_"):
    """They."""

    client: uint64
    number: int64
    result: ListParametersResult


@dataclass
@sample
class DescribeParametersRequest(IdlStruct, typename="rcl_interfaces::srv::dds_::DescribeParameters_Request_"):
    """What are these parameters?"""

    client: uint64
    number: int64
    names: sequence[str]


@dataclass
@sample
class DescribeParametersResponse(
    IdlStruct, typename="rcl_interfaces::srv::dds_::DescribeParameters_Response_"
):
    """They, in the order asked for."""

    client: uint64
    number: int64
    descriptors: sequence[ParameterDescriptor]


PARAMETER_SERVICES: Final = {
    "get_parameters": ServiceKind(
        "rcl_interfaces/srv/GetParameters", GetParametersRequest, GetParametersResponse
    ),
    "get_parameter_types": ServiceKind(
        "rcl_interfaces/srv/GetParameterTypes", GetParameterTypesRequest, GetParameterTypesResponse
    ),
    "set_parameters": ServiceKind(
        "rcl_interfaces/srv/SetParameters", SetParametersRequest, SetParametersResponse
    ),
    "set_parameters_atomically": ServiceKind(
        "rcl_interfaces/srv/SetParametersAtomically",
        SetParametersAtomicallyRequest,
        SetParametersAtomicallyResponse,
    ),
    "list_parameters": ServiceKind(
        "rcl_interfaces/srv/ListParameters", ListParametersRequest, ListParametersResponse
    ),
    "describe_parameters": ServiceKind(
        "rcl_interfaces/srv/DescribeParameters", DescribeParametersRequest, DescribeParametersResponse
    ),
}
"""Types by the last part of the service's name."""
