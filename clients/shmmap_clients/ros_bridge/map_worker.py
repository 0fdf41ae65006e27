# SPDX-License-Identifier: Apache-2.0
"""Autoware's map services and topics: the thread that asks the daemon for cells."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, Final

from cyclonedds.pub import DataWriter

from shmmap import BadRequest, CellInfo, Client, LoadFailed
from shmmap_clients.ros_bridge.cdr import MAX_BYTES, CdrWriter, Content, copy_into
from shmmap_clients.ros_bridge.map_answers import Catalogue, MapAnswers, Requesters
from shmmap_clients.ros_bridge.messages import MapMetaData, PointCloud2, ready_made
from shmmap_clients.ros_bridge.point_cloud import CloudLayout, cloud_layout, fill_rows, write_cloud_head
from shmmap_clients.ros_bridge.service_server import Listening, Request
from shmmap_clients.ros_bridge.worker import Answer, Worker

__all__ = ["MapWorker"]

_HEAD_BYTES: Final = 4096
_EVERY_S: Final = 1.0


def _whole_map(
    client: Client, cells: Collection[CellInfo], stamp_ns: int, *, max_bytes: int = MAX_BYTES, wait_s: float
) -> Content:
    """Return all points of the map as a ``PointCloud2`` in the map's frame, for ``/map/pointcloud_map``.

    Each cell is released before the next one is requested, so the daemon's budget need not hold the map.  The
    message is briefly in memory twice, and DDS keeps one copy while the bridge runs: use it for small maps.

    The fields are those of the first cell with points. Additional fields of other cells are left out, and
    fields that a cell lacks are zero. Autoware instead joins the bytes of all cells, whatever their fields.

    Parameters
    ----------
    client
        Client of the daemon.
    cells
        All cells of the map, in the order of their points in the message.
    stamp_ns
        Time in the header.
    max_bytes
        Largest size of the message.
    wait_s
        Time for a cell to load, seconds.

    Raises
    ------
    BadRequest
        The map has more bytes than that; the error names its approximate size.
    LoadFailed
        A cell cannot be loaded, so that the map would have a hole.
    """
    layout: CloudLayout | None = None
    points, data = 0, bytearray()
    most = min(max_bytes, MAX_BYTES) - _HEAD_BYTES
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
                f" {max_bytes / 1e9:.3g} GB is the most",
                hint="leave out --whole-map: clients get the cells that they need from the services",
            )
        data.extend(bytes(nbytes))
        with memoryview(data) as whole, whole[place:] as rows:
            fill_rows(rows, cell.columns, cell.origin, layout)
        points += cell.points
    layout = layout or cloud_layout({})
    writer = CdrWriter()
    write_cloud_head(writer, layout, points, client.welcome.frame_id, stamp_ns)
    writer.numbers("I", len(data))
    if data:
        writer.blob(len(data), partial(copy_into, data=data))
    writer.numbers("?", True)
    return writer.content()


class MapWorker(Worker):
    """Worker that answers with cells, and publishes the list of cells and the whole map after each change.

    Parameters
    ----------
    client
        Client of the daemon, used only by this worker.
    metadata, whole
        Writers of the two topics; ``whole`` is None if the whole map is not published.
    listening
        Source of requests.
    wait_s
        Time for cells to load, seconds.
    whole_bytes
        Largest size of the whole map.

    Attributes
    ----------
    alive
        Names of the present clients; all others are forgotten.
    """

    def __init__(
        self,
        client: Client,
        metadata: DataWriter,
        whole: DataWriter | None,
        listening: Listening,
        *,
        wait_s: float,
        whole_bytes: int,
        stop: threading.Event,
        log: Callable[[str], None],
    ) -> None:
        super().__init__(listening, stop, _EVERY_S, log)
        self._client = client
        self._metadata = metadata
        self._whole = whole
        self._wait_s = wait_s
        self._whole_bytes = whole_bytes
        self._catalogue = Catalogue()
        self._requesters = Requesters()
        self._answers = MapAnswers(client, self._catalogue, self._requesters, wait_s, log)
        self._published: int | None = None  # version of the map
        self.alive: Collection[str] | None = None

    @property
    def requesters(self) -> int:
        """Number of remembered clients."""
        return len(self._requesters)

    def begin(self) -> None:
        """Publish for the first time.

        Raises
        ------
        ShmmapError
            The daemon does not answer, or the whole map is too large.
        """
        self._catalogue.refresh(self._client)
        self._publish()

    def answer(self, message: Any, request: Request) -> Answer:
        """Return a reply with cells."""
        if self._client.disconnected_since is not None:
            # requests for cells wait longer before they find that the daemon is away
            self._catalogue.refresh(self._client)
        return self._answers.answer(message, request.requester.name, request.begun_s)

    def empty(self, message: Any) -> Content:
        """Return a reply without cells."""
        return self._answers.empty(message)

    def tick(self) -> None:
        """Publish again if the map has changed; forget clients that have left."""
        if self.alive is not None:
            self._requesters.keep_only(self.alive)
        self._answers.release_idle()
        self._catalogue.refresh(self._client)
        if self._published == self._catalogue.map_version:
            return
        try:
            self._publish()
        except BadRequest as error:  # the map has grown too large: subscribers keep the last one
            self._log(str(error))
            self._published = self._catalogue.map_version

    def _publish(self) -> None:
        now_ns = time.time_ns()
        content = self._catalogue.message(self._client.welcome.frame_id, now_ns)
        self._metadata.write(ready_made(MapMetaData, content))
        if self._whole is not None:
            cloud = _whole_map(
                self._client,
                self._catalogue.cells.values(),
                now_ns,
                max_bytes=self._whole_bytes,
                wait_s=self._wait_s,
            )
            self._whole.write(ready_made(PointCloud2, cloud))
        self._published = self._catalogue.map_version
