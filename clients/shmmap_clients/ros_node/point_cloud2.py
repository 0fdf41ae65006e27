# SPDX-License-Identifier: Apache-2.0
"""Cells as messages of ``sensor_msgs``."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

from shmmap import BadRequest, Cell
from shmmap_clients.ros_cells.point_cloud import MAX_BYTES, CloudLayout, cloud_layout, fill_rows

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2


def to_point_cloud2(cell: Cell, *, frame_id: str = "") -> PointCloud2:
    """Return a cell as ``sensor_msgs/PointCloud2``, byte for byte as Autoware's map loader sends it.

    x, y, z as float32 in the map's frame, then every other column with a type in ROS (64-bit integers and
    16-bit floats have none), without gaps.  The points are copied once, from shared memory to the message;
    it does not keep the cell.

    ::

        from shmmap_clients.ros_node import to_point_cloud2

        for cell in client.around(x, y, radius=50):
            publisher.publish(to_point_cloud2(cell, frame_id=client.frame_id))

    Parameters
    ----------
    cell
        The cell, of any layer with ``xyz``.
    frame_id
        Frame of the header, whose time is zero.

    Raises
    ------
    NoColumn
        The layer's rows are not points.
    BadRequest
        The points exceed the size of a message.
    ImportError
        ROS 2 is not there: its setup has to be sourced first.
    """
    layout, points = cloud_layout({"xyz": cell.xyz, **cell.columns}), len(cell)
    if points * layout.point_step > MAX_BYTES:
        raise BadRequest(f"{cell.id}: {points:,} points are more than a message holds, {MAX_BYTES} bytes")
    data = array("B", b"\0") * (points * layout.point_step)
    if points:
        with memoryview(data) as rows:
            fill_rows(rows, cell.columns, cell.origin, layout)
    return cloud_message(layout, points, data, frame_id)


def cloud_message(layout: CloudLayout, points: int, data: array[int], frame_id: str) -> PointCloud2:
    """Return a message of rows of this layout; it keeps ``data``."""
    from sensor_msgs.msg import PointCloud2, PointField

    cloud = PointCloud2(
        height=1,
        width=points,
        fields=[
            PointField(name=name, offset=offset, datatype=datatype, count=count)
            for name, offset, datatype, count in layout.fields
        ],
        point_step=layout.point_step,
        row_step=points * layout.point_step,
        is_dense=True,
    )
    cloud.data = data  # which keeps it; the constructor would copy it
    cloud.header.frame_id = frame_id
    return cloud
