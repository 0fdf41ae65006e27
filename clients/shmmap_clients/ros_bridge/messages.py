# SPDX-License-Identifier: Apache-2.0
"""ROS 2 messages and services as IDL, and their conversion to and from samples of DDS.

The packages are ``builtin_interfaces``, ``std_msgs``, ``sensor_msgs``; ``autoware_map_msgs``, read at version
1.12; and ``bonxai_msgs``, as Rolling-Bonxai's own packages have it since version 2.

A request and a reply begin with 16 bytes that rmw_cyclonedds_cpp puts in front of the message (its
``serdata.hpp``): the id of the client, and the client's number of the request.  The server returns both, and
a client accepts only replies with its own.  The types here with these two fields are requests and replies.

Replies with points are written by hand (`shmmap_clients.ros_bridge.cdr`): the serializer of `cyclonedds`
handles each byte of a sequence in Python.
"""

import struct
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float32, float64, int32, int64, sequence, uint8, uint32, uint64

_Sample = TypeVar("_Sample")


@dataclass
class Damaged:
    """Stand-in for a received message whose bytes are invalid for its type.

    Attributes
    ----------
    reason
        Why the bytes are invalid.
    """

    reason: str


def message(name: str, /, **fields: Any) -> type[Any]:
    """Return the class of a message, that may be sent as prepared bytes and tolerates invalid ones received.

    The layout is that of all ROS types: fields one after another, without extensions (``final``).

    Parameters
    ----------
    name
        Name in ROS notation, ``sensor_msgs/msg/PointCloud2``.
    fields
        Types of the fields, in order.
    """
    package, folder, kind = name.split("/")
    made: type[Any] = make_idl_struct(kind, f"{package}::{folder}::dds_::{kind}_", fields, dataclassify=False)
    made.serialize = _serialize
    made.deserialize = classmethod(_deserialize)
    made.ready = None  # no annotation, so that it is no field of the message
    return dataclass(final(made))  # type: ignore[no-any-return]


def _serialize(
    self: Any, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None
) -> bytes | bytearray:
    """Return the prepared bytes, or else the serialized fields."""
    made: bytes | bytearray = (
        self.__idl__.serialize(self, buffer=buffer, endianness=endianness, use_version_2=use_version_2)
        if self.ready is None
        else self.ready
    )
    return made


def _deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
    """Return the message, or `Damaged`.

    CycloneDDS already drops bytes that do not fit the type; texts that are not UTF-8 remain, for example.
    """
    try:
        return cls.__idl__.deserialize(data, has_header=has_header, use_version_2=use_version_2)
    except (ValueError, struct.error, IndexError, OverflowError, MemoryError) as error:
        return Damaged(f"{type(error).__name__}: {error}")


def ready_made(kind: type[_Sample], content: bytearray) -> _Sample:
    """Return a message that is sent as these bytes, encapsulation included; its fields are not set."""
    one = kind.__new__(kind)
    one.ready = content  # type: ignore[attr-defined]
    return one


@dataclass(frozen=True, slots=True)
class ServiceKind:
    """Types of a service: the classes of its messages."""

    request: type[Any]
    reply: type[Any]


def service(name: str, request: dict[str, Any], reply: dict[str, Any]) -> ServiceKind:
    """Return the types of a service; both messages begin with ``client`` and ``number``.

    Parameters
    ----------
    name
        Name in ROS notation, ``autoware_map_msgs/srv/GetPartialPointCloudMap``.
    request, reply
        Types of the messages' further fields, by name.
    """
    head = {"client": uint64, "number": int64}
    return ServiceKind(
        message(f"{name}_Request", **head, **request), message(f"{name}_Response", **head, **reply)
    )


Time: Final = message("builtin_interfaces/msg/Time", sec=int32, nanosec=uint32)
"""A point in time: seconds and nanoseconds since 1970."""

Header: Final = message("std_msgs/msg/Header", stamp=Time, frame_id=str)
"""Time and frame of a message."""

PointField: Final = message(
    "sensor_msgs/msg/PointField", name=str, offset=uint32, datatype=uint8, count=uint32
)
"""One field of each point: offset in bytes, type (1 int8 to 8 float64), number of values."""

PointCloud2: Final = message(
    "sensor_msgs/msg/PointCloud2",
    header=Header,
    height=uint32,
    width=uint32,
    fields=sequence[PointField],
    is_bigendian=bool,
    point_step=uint32,
    row_step=uint32,
    data=sequence[uint8],
    is_dense=bool,
)
"""Points as bytes: ``width`` x ``height`` of ``point_step`` bytes each."""

AreaInfo: Final = message(
    "autoware_map_msgs/msg/AreaInfo", center_x=float32, center_y=float32, radius=float32
)
"""An area around a position, metres, map frame."""

CellMetaData: Final = message(
    "autoware_map_msgs/msg/PointCloudMapCellMetaData",
    min_x=float32,
    min_y=float32,
    max_x=float32,
    max_y=float32,
)
"""A cell's box, metres in the map frame."""

CellMetaDataWithID: Final = message(
    "autoware_map_msgs/msg/PointCloudMapCellMetaDataWithID", cell_id=str, metadata=CellMetaData
)
"""A cell without its points."""

CellWithID: Final = message(
    "autoware_map_msgs/msg/PointCloudMapCellWithID",
    cell_id=str,
    pointcloud=PointCloud2,
    metadata=CellMetaData,
)
"""A cell with its points."""

MapMetaData: Final = message(
    "autoware_map_msgs/msg/PointCloudMapMetaData", header=Header, metadata_list=sequence[CellMetaDataWithID]
)
"""All cells of the map, without their points."""

_CELLS: Final = {"header": Header, "new_pointcloud_with_ids": sequence[CellWithID]}

PARTIAL: Final = service(
    "autoware_map_msgs/srv/GetPartialPointCloudMap", request={"area": AreaInfo}, reply=_CELLS
)
"""Cells that touch an area, in the order of their ids."""

DIFFERENTIAL: Final = service(
    "autoware_map_msgs/srv/GetDifferentialPointCloudMap",
    request={"area": AreaInfo, "cached_ids": sequence[str]},
    reply={**_CELLS, "ids_to_remove": sequence[str]},
)
"""Cells that touch an area and are new to the client, and the ids that it may drop."""

SELECTED: Final = service(
    "autoware_map_msgs/srv/GetSelectedPointCloudMap", request={"cell_ids": sequence[str]}, reply=_CELLS
)
"""Cells with these ids, in the order of the request."""


VoxelGrid: Final = message(
    "bonxai_msgs/msg/VoxelGrid",
    header=Header,
    resolution=float64,
    x=sequence[int32],
    y=sequence[int32],
    z=sequence[int32],
    num_voxels=uint32,
    min_x=int32,
    min_y=int32,
    min_z=int32,
    max_x=int32,
    max_y=int32,
    max_z=int32,
)
"""Voxels by their indices, ``floor(position / resolution)`` along each axis, and the box around them."""


def _voxel_service(name: str, count: str) -> ServiceKind:
    """Return the types of a service of all voxels of a kind.

    ``occupancy_ratio`` of the reply is occupied / (occupied + free).

    Parameters
    ----------
    name
        Name in ROS notation.
    count
        Name of the reply's count of these voxels.
    """
    return service(
        name,
        request={"structure_needs_at_least_one_member": uint8},  # a ROS message without fields has one byte
        reply={
            "voxel_grid": VoxelGrid,
            count: uint64,
            "total_active_cells": uint64,
            "occupancy_ratio": float32,
            "memory_mb": float32,
            "success": bool,
        },
    )


OCCUPIED: Final = _voxel_service("bonxai_msgs/srv/GetOccupiedVoxels", "occupied_count")
FREE: Final = _voxel_service("bonxai_msgs/srv/GetFreeVoxels", "free_count")
