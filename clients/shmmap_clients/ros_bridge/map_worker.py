# SPDX-License-Identifier: Apache-2.0
"""Autoware's map services and topics: the thread that asks the daemon for cells."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from typing import Any, Final

from cyclonedds.pub import DataWriter

from shmmap import BadRequest, Client
from shmmap_clients.ros_bridge.catalogue import Catalogue
from shmmap_clients.ros_bridge.cdr import Content
from shmmap_clients.ros_bridge.listening import Listening
from shmmap_clients.ros_bridge.map_answers import MapAnswers
from shmmap_clients.ros_bridge.messages.autoware import MapMetaData
from shmmap_clients.ros_bridge.messages.standard import PointCloud2
from shmmap_clients.ros_bridge.messages.wire import ready_made
from shmmap_clients.ros_bridge.requesters import Requesters
from shmmap_clients.ros_bridge.service_server import Request
from shmmap_clients.ros_bridge.whole_map import whole_map
from shmmap_clients.ros_bridge.worker import Answer, Worker

__all__ = ["MapWorker"]

_EVERY_S: Final = 1.0


class MapWorker(Worker):
    """Answers with cells, and publishes the list of cells and the whole map, again when the map changes.

    Parameters
    ----------
    client
        Of the daemon, used by nobody else.
    metadata, whole
        Writers of the two topics; ``whole`` is None where the whole map is not published.
    listening
        Where requests come.
    wait_s
        How long cells may take to load.
    whole_bytes
        The whole map may take so many.

    Attributes
    ----------
    alive
        Names of the clients there are; the others are forgotten.
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
        self._published: int | None = None  # which state of the map
        self.alive: Collection[str] | None = None

    @property
    def requesters(self) -> int:
        """How many clients are remembered."""
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
            # a request for cells has longer than this to find out that the daemon is away
            self._catalogue.refresh(self._client)
        return self._answers.answer(message, request.requester.name, request.tries.begun_s)

    def empty(self, message: Any) -> Content:
        """Return a reply without cells."""
        return self._answers.empty(message)

    def tick(self) -> None:
        """Publish again if the map has changed; forget clients that have gone."""
        if self.alive is not None:
            self._requesters.keep_only(self.alive)
        self._answers.let_go()
        self._catalogue.refresh(self._client)
        if self._published == self._catalogue.map_version:
            return
        try:
            self._publish()
        except BadRequest as error:  # it has grown: what was published stays
            self._log(str(error))
            self._published = self._catalogue.map_version

    def _publish(self) -> None:
        now_ns = time.time_ns()
        content = self._catalogue.message(self._client.welcome.frame_id, now_ns)
        self._metadata.write(ready_made(MapMetaData, content))
        if self._whole is not None:
            cloud = whole_map(
                self._client,
                self._catalogue.cells.values(),
                now_ns,
                most_bytes=self._whole_bytes,
                wait_s=self._wait_s,
            )
            self._whole.write(ready_made(PointCloud2, cloud))
        self._published = self._catalogue.map_version
