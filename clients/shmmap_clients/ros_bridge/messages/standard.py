# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2 itself: ``builtin_interfaces``, ``std_msgs``, ``sensor_msgs``."""

from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int32, sequence, uint8, uint32

from shmmap_clients.ros_bridge.messages.wire import sample

__all__ = ["Header", "PointCloud2", "PointField", "Time"]


@dataclass
@sample
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """A moment: seconds and nanoseconds since 1970."""

    sec: int32
    nanosec: uint32


@dataclass
@sample
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """When, and in which frame."""

    stamp: Time
    frame_id: str


@dataclass
@sample
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    """One value of each point: where in the point, of which type (1 int8 to 8 float64), how many."""

    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
@sample
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    """Points as bytes: ``width`` x ``height`` of ``point_step`` bytes each."""

    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool
