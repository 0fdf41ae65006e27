# SPDX-License-Identifier: Apache-2.0
"""The whole map as one cloud, for whoever subscribes to ``/map/pointcloud_map``: put together cell by cell.

Each cell is let go before the next one is asked for, so the daemon's budget need not hold the map. The bytes
themselves are held twice for a moment, and once by DDS as long as the bridge runs: it is for small maps.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from shmmap import BadRequest, CellInfo, Client, LoadFailed
from shmmap_clients.ros_bridge.cdr import MOST_BYTES, CdrWriter, Content
from shmmap_clients.ros_bridge.point_cloud import CloudLayout, cloud_layout, fill_rows, write_cloud_head

__all__ = ["whole_map"]

_HEAD_BYTES: Final = 4096


def whole_map(
    client: Client, cells: Collection[CellInfo], stamp_ns: int, *, most_bytes: int = MOST_BYTES, wait_s: float
) -> Content:
    """Return all points of the map as a ``PointCloud2`` in the map's frame.

    The fields are those of the first cell that has points. Another cell's that it does not have are left out,
    and are zero where it lacks one; Autoware puts the bytes one after another, whatever they mean.

    Parameters
    ----------
    client
        Of the daemon.
    cells
        All of the map, in the order in which their points come.
    stamp_ns
        Time in the header.
    most_bytes
        The message may have so many.
    wait_s
        How long a cell may take to load.

    Raises
    ------
    BadRequest
        The map has more points than that; the message says how many bytes it takes, about.
    LoadFailed
        A cell cannot be loaded: a map with a hole would not be the whole one.
    """
    layout: CloudLayout | None = None
    points, data = 0, bytearray()
    most = min(most_bytes, MOST_BYTES) - _HEAD_BYTES
    read_bytes = 0
    for info in cells:
        found = client.selected([info.id], wait=wait_s, strict=None).raise_for_failures()
        if not found.complete or not found:
            raise LoadFailed(f"{info.id}: not loaded after {wait_s:g} s", cell_id=info.id, layer="points")
        read_bytes += info.source_bytes
        cell = found[0]
        if not cell.points:
            continue
        layout = layout or cloud_layout(cell.columns)
        nbytes = cell.points * layout.point_step
        place = len(data)
        if place + nbytes > most:
            whole_bytes = (place + nbytes) / max(read_bytes, 1) * sum(one.source_bytes for one in cells)
            raise BadRequest(
                f"the whole map takes about {whole_bytes / 1e9:.3g} GB as a PointCloud2, and"
                f" {most_bytes / 1e9:.3g} GB is the most",
                hint="leave out --whole-map: clients get the cells that they need from the services",
            )
        data.extend(bytes(nbytes))
        with memoryview(data) as whole, whole[place:] as rows:
            fill_rows(rows, cell.columns, cell.origin, layout)
        points += cell.points
    layout = layout or cloud_layout({})
    writer = CdrWriter()
    write_cloud_head(writer, layout, points, client.welcome.frame_id, stamp_ns)
    writer.uint32(len(data))
    if data:
        writer.blob(len(data), lambda to: _copy(to, data))
    writer.boolean(True)
    return writer.content()


def _copy(place: memoryview, data: bytearray) -> None:
    place[:] = data
