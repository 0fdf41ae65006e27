# SPDX-License-Identifier: Apache-2.0
"""Definitions of messages and services that the tests need, of Autoware's map loader and others."""

from __future__ import annotations

from typing import Final

BUILT: Final = {
    "autoware_map_msgs": ("sensor_msgs", "std_msgs"),
    "tf2_msgs": ("geometry_msgs",),
    "bonxai_msgs": ("std_msgs",),
}
"""Packages whose type support is built, and what they depend on; the others have wheels."""

_VOXELS: Final = "uint64 total_active_cells\nfloat32 occupancy_ratio\nfloat32 memory_mb\nbool success\n"
_CELLS: Final = "std_msgs/Header header\nPointCloudMapCellWithID[] new_pointcloud_with_ids\n"

DEFINITIONS: Final = {
    "builtin_interfaces/msg/Time.msg": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header.msg": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/PointField.msg": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n"
        "uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "sensor_msgs/msg/PointCloud2.msg": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "autoware_map_msgs/msg/AreaInfo.msg": "float32 center_x\nfloat32 center_y\nfloat32 radius\n",
    "autoware_map_msgs/msg/PointCloudMapCellMetaData.msg": (
        "float32 min_x\nfloat32 min_y\nfloat32 max_x\nfloat32 max_y\n"
    ),
    "autoware_map_msgs/msg/PointCloudMapCellMetaDataWithID.msg": (
        "string cell_id\nPointCloudMapCellMetaData metadata\n"
    ),
    "autoware_map_msgs/msg/PointCloudMapMetaData.msg": (
        "std_msgs/Header header\nPointCloudMapCellMetaDataWithID[] metadata_list\n"
    ),
    "autoware_map_msgs/msg/PointCloudMapCellWithID.msg": (
        "string cell_id\nsensor_msgs/PointCloud2 pointcloud\nPointCloudMapCellMetaData metadata\n"
    ),
    "autoware_map_msgs/srv/GetPartialPointCloudMap.srv": f"AreaInfo area\n---\n{_CELLS}",
    "autoware_map_msgs/srv/GetDifferentialPointCloudMap.srv": (
        f"AreaInfo area\nstring[] cached_ids\n---\n{_CELLS}string[] ids_to_remove\n"
    ),
    "autoware_map_msgs/srv/GetSelectedPointCloudMap.srv": f"string[] cell_ids\n---\n{_CELLS}",
    "tf2_msgs/msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
    "bonxai_msgs/msg/VoxelGrid.msg": (
        "std_msgs/Header header\nfloat64 resolution\nint32[] x\nint32[] y\nint32[] z\nuint32 num_voxels\n"
        "int32 min_x\nint32 min_y\nint32 min_z\nint32 max_x\nint32 max_y\nint32 max_z\n"
    ),
    "bonxai_msgs/srv/GetOccupiedVoxels.srv": (f"---\nVoxelGrid voxel_grid\nuint64 occupied_count\n{_VOXELS}"),
    "bonxai_msgs/srv/GetFreeVoxels.srv": f"---\nVoxelGrid voxel_grid\nuint64 free_count\n{_VOXELS}",
}
"""By path, as it is below a workspace's ``src``."""
