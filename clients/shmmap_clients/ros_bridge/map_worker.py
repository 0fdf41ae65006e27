# SPDX-License-Identifier: Apache-2.0
"""Autoware's map services and topics: the thread that asks the daemon for cells.

The header of a reply has the map's frame and time zero; the header of each cloud is empty.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from cyclonedds.pub import DataWriter

from shmmap import BadRequest, Client
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content, copy_into, write_cloud, write_cloud_head
from shmmap_clients.ros_bridge.messages import DIFFERENTIAL, PARTIAL, MapMetaData, PointCloud2, ready_made
from shmmap_clients.ros_bridge.service_server import Listening, Request
from shmmap_clients.ros_bridge.worker import Worker
from shmmap_clients.ros_cells import Answer, Catalogue, CellAnswers, RecentCells, joined_cells

_EVERY_S: Final = 1.0
_REUSED_BYTES: Final = 16 << 20


class MapWorker(Worker):
    """Worker that answers with cells, and publishes the list of cells and the whole map after each change.

    The whole map is briefly in memory twice, and DDS keeps one copy while the bridge runs.

    Parameters
    ----------
    client
        Client of the daemon, used only by this worker.
    metadata, whole
        Writers of the two topics; ``whole`` is None if the whole map is not published.
    listening
        Source of requests.
    wait_s
        Time for cells to load, seconds; what is missing then is left out.
    whole_bytes
        Largest size of the whole map.
    plain_ids
        Send ids without versions, as Autoware's map loader does.
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
        plain_ids: bool,
        stop: threading.Event,
        log: Callable[[str], None],
    ) -> None:
        super().__init__(listening, stop, _EVERY_S, log)
        self._client = client
        self._metadata = metadata
        self._whole = whole
        self._wait_s = wait_s
        self._whole_bytes = whole_bytes
        self._plain_ids = plain_ids
        self._catalogue, self._recent = Catalogue(), RecentCells()
        self._answers = CellAnswers(self._catalogue, self._recent, plain_ids=plain_ids)
        self._sent: Content | None = None  # the last reply, whose memory is reused
        self._published: int | None = None  # version of the map

    def begin(self) -> None:
        """Publish for the first time.

        Raises
        ------
        ShmmapError
            The daemon does not answer, or the whole map is too large.
        """
        self._catalogue.refresh(self._client)
        self._publish()

    def answer(self, message: Any, request: Request) -> Content:
        """Return a reply with cells."""
        last = time.monotonic() >= request.begun_s + self._wait_s
        if isinstance(message, PARTIAL.request):
            found = self._answers.partial(self._client, message.area, last)
        elif isinstance(message, DIFFERENTIAL.request):
            found = self._answers.differential(self._client, message.area, message.cached_ids, last)
        else:
            found = self._answers.selected(self._client, message.cell_ids, last)
        if found.problem:
            self._log(found.problem)
        return self._reply(message, found)

    def empty(self, message: Any) -> Content:
        """Return a reply without cells."""
        return self._reply(message, Answer())

    def tick(self) -> None:
        """Publish again if the map has changed; release cells that no client has requested lately."""
        if self._recent.release_idle():
            self._client.release()
        self._catalogue.refresh(self._client)
        if self._published == self._catalogue.map_version:
            return
        try:
            self._publish()
        except BadRequest as error:  # the map has grown too large: subscribers keep the last one
            self._log(str(error))
            self._published = self._catalogue.map_version

    def _reply(self, message: Any, answer: Answer) -> Content:
        writer = CdrWriter()
        writer.numbers("QqiI", message.client, message.number, 0, 0)
        writer.text(self._client.welcome.frame_id)
        writer.numbers("I", len(answer.cells))
        for cell, name in zip(answer.cells, answer.names, strict=True):
            writer.text(name)
            write_cloud(writer, cell.columns, cell.origin)
            writer.numbers("ffff", *cell.box)
        if isinstance(message, DIFFERENTIAL.request):
            writer.texts(answer.removed)
        content = writer.content(self._sent)
        self._sent = content if len(content) <= _REUSED_BYTES else None
        return content

    def _publish(self) -> None:
        now_ns = time.time_ns()
        names, cells = self._catalogue.names(plain_ids=self._plain_ids), self._catalogue.cells.values()
        writer = CdrWriter()
        writer.numbers("iI", now_ns // 10**9, now_ns % 10**9)
        writer.text(self._client.welcome.frame_id)
        writer.numbers("I", len(cells))
        for name, cell in zip(names, cells, strict=True):
            writer.text(name)
            writer.numbers("ffff", *cell.box)
        self._metadata.write(ready_made(MapMetaData, writer.content()))
        if self._whole is not None:
            layout, points, data = joined_cells(
                self._client, cells, max_bytes=self._whole_bytes, wait_s=self._wait_s
            )
            writer = CdrWriter()
            write_cloud_head(writer, layout, points, self._client.welcome.frame_id, now_ns)
            if points:
                writer.blob(len(data), partial(copy_into, data=memoryview(data)))
            writer.numbers("?", True)
            self._whole.write(ready_made(PointCloud2, writer.content()))
        self._published = self._catalogue.map_version
