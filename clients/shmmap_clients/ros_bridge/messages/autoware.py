# SPDX-License-Identifier: Apache-2.0
"""Autoware's messages and services for maps of points: ``autoware_map_msgs``, read at version 1.12."""

from dataclasses import dataclass
from typing import Final

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, int64, sequence, uint64

from shmmap_clients.ros_bridge.messages.standard import Header, PointCloud2
from shmmap_clients.ros_bridge.messages.wire import ServiceKind, sample

__all__ = [
    "DIFFERENTIAL",
    "PARTIAL",
    "SELECTED",
    "AreaInfo",
    "CellMetaData",
    "CellMetaDataWithID",
    "CellWithID",
    "GetDifferentialRequest",
    "GetDifferentialResponse",
    "GetPartialRequest",
    "GetPartialResponse",
    "GetSelectedRequest",
    "GetSelectedResponse",
    "MapMetaData",
]


@dataclass
@sample
class AreaInfo(IdlStruct, typename="autoware_map_msgs::msg::dds_::AreaInfo_"):
    """An area around a place, metres in the map frame."""

    center_x: float32
    center_y: float32
    radius: float32


@dataclass
@sample
class CellMetaData(IdlStruct, typename="autoware_map_msgs::msg::dds_::PointCloudMapCellMetaData_"):
    """A cell's box, metres in the map frame."""

    min_x: float32
    min_y: float32
    max_x: float32
    max_y: float32


@dataclass
@sample
class CellMetaDataWithID(
    IdlStruct, typename="autoware_map_msgs::msg::dds_::PointCloudMapCellMetaDataWithID_"
):
    """A cell without its points."""

    cell_id: str
    metadata: CellMetaData


@dataclass
@sample
class CellWithID(IdlStruct, typename="autoware_map_msgs::msg::dds_::PointCloudMapCellWithID_"):
    """A cell."""

    cell_id: str
    pointcloud: PointCloud2
    metadata: CellMetaData


@dataclass
@sample
class MapMetaData(IdlStruct, typename="autoware_map_msgs::msg::dds_::PointCloudMapMetaData_"):
    """All cells of the map, without their points."""

    header: Header
    metadata_list: sequence[CellMetaDataWithID]


@dataclass
@sample
class GetPartialRequest(IdlStruct, typename="autoware_map_msgs::srv::dds_::GetPartialPointCloudMap_Request_"):
    """Which cells touch an area?"""

    client: uint64
    number: int64
    area: AreaInfo


@dataclass
@sample
class GetPartialResponse(
    IdlStruct, typename="autoware_map_msgs::srv::dds_::GetPartialPointCloudMap_Response_"
):
    """They, in the order of their ids."""

    client: uint64
    number: int64
    header: Header
    new_pointcloud_with_ids: sequence[CellWithID]


@dataclass
@sample
class GetDifferentialRequest(
    IdlStruct, typename="autoware_map_msgs::srv::dds_::GetDifferentialPointCloudMap_Request_"
):
    """Which cells touch an area, beside those that the client has?"""

    client: uint64
    number: int64
    area: AreaInfo
    cached_ids: sequence[str]


@dataclass
@sample
class GetDifferentialResponse(
    IdlStruct, typename="autoware_map_msgs::srv::dds_::GetDifferentialPointCloudMap_Response_"
):
    """They, and which the client may drop."""

    client: uint64
    number: int64
    header: Header
    new_pointcloud_with_ids: sequence[CellWithID]
    ids_to_remove: sequence[str]


@dataclass
@sample
class GetSelectedRequest(
    IdlStruct, typename="autoware_map_msgs::srv::dds_::GetSelectedPointCloudMap_Request_"
):
    """These cells."""

    client: uint64
    number: int64
    cell_ids: sequence[str]


@dataclass
@sample
class GetSelectedResponse(
    IdlStruct, typename="autoware_map_msgs::srv::dds_::GetSelectedPointCloudMap_Response_"
):
    """They, in the order asked for."""

    client: uint64
    number: int64
    header: Header
    new_pointcloud_with_ids: sequence[CellWithID]


PARTIAL: Final = ServiceKind(
    "autoware_map_msgs/srv/GetPartialPointCloudMap", GetPartialRequest, GetPartialResponse
)
DIFFERENTIAL: Final = ServiceKind(
    "autoware_map_msgs/srv/GetDifferentialPointCloudMap", GetDifferentialRequest, GetDifferentialResponse
)
SELECTED: Final = ServiceKind(
    "autoware_map_msgs/srv/GetSelectedPointCloudMap", GetSelectedRequest, GetSelectedResponse
)
