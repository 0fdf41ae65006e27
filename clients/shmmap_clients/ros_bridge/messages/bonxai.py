# SPDX-License-Identifier: Apache-2.0
"""``bonxai_msgs``, as Rolling-Bonxai's own packages have it since version 2: services for voxels."""

from dataclasses import dataclass
from typing import Final

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, int64, sequence, uint8, uint32, uint64

from shmmap_clients.ros_bridge.messages.standard import Header
from shmmap_clients.ros_bridge.messages.wire import ServiceKind, sample

__all__ = [
    "FREE",
    "OCCUPIED",
    "GetFreeRequest",
    "GetFreeResponse",
    "GetOccupiedRequest",
    "GetOccupiedResponse",
    "VoxelGrid",
]


@dataclass
@sample
class VoxelGrid(IdlStruct, typename="bonxai_msgs::msg::dds_::VoxelGrid_"):
    """Voxels by their indices, ``floor(position / resolution)`` along each axis, and the box around them."""

    header: Header
    resolution: float64
    x: sequence[int32]
    y: sequence[int32]
    z: sequence[int32]
    num_voxels: uint32
    min_x: int32
    min_y: int32
    min_z: int32
    max_x: int32
    max_y: int32
    max_z: int32


@dataclass
@sample
class GetOccupiedRequest(IdlStruct, typename="bonxai_msgs::srv::dds_::GetOccupiedVoxels_Request_"):
    """All occupied voxels; ROS gives messages without fields one byte."""

    client: uint64
    number: int64
    structure_needs_at_least_one_member: uint8


@dataclass
@sample
class GetOccupiedResponse(IdlStruct, typename="bonxai_msgs::srv::dds_::GetOccupiedVoxels_Response_"):
    """They; the map's counts; ``occupancy_ratio`` is occupied / (occupied + free)."""

    client: uint64
    number: int64
    voxel_grid: VoxelGrid
    occupied_count: uint64
    total_active_cells: uint64
    occupancy_ratio: float32
    memory_mb: float32
    success: bool


@dataclass
@sample
class GetFreeRequest(IdlStruct, typename="bonxai_msgs::srv::dds_::GetFreeVoxels_Request_"):
    """All free voxels."""

    client: uint64
    number: int64
    structure_needs_at_least_one_member: uint8


@dataclass
@sample
class GetFreeResponse(IdlStruct, typename="bonxai_msgs::srv::dds_::GetFreeVoxels_Response_"):
    """They, as in `GetOccupiedResponse`."""

    client: uint64
    number: int64
    voxel_grid: VoxelGrid
    free_count: uint64
    total_active_cells: uint64
    occupancy_ratio: float32
    memory_mb: float32
    success: bool


OCCUPIED: Final = ServiceKind("bonxai_msgs/srv/GetOccupiedVoxels", GetOccupiedRequest, GetOccupiedResponse)
FREE: Final = ServiceKind("bonxai_msgs/srv/GetFreeVoxels", GetFreeRequest, GetFreeResponse)
