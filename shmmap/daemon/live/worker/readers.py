# SPDX-License-Identifier: Apache-2.0
"""What readers of a live map ask: which chunks there are, and which voxels lie in an area."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from shmmap.chunks.reading import KINDS
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.live_map import LiveMap
from shmmap.daemon.live.map_files import Row
from shmmap.daemon.live.messages import Ask
from shmmap.daemon.live.paging.records import State
from shmmap.daemon.live.worker.changes import Changes
from shmmap.daemon.live.worker.voxel_lists import VoxelLists, check_area, touches
from shmmap.errors import BadRequest, CannotWrite, ShmmapError
from shmmap.protocol import live as messages
from shmmap.protocol.messages import ErrorReply

__all__ = ["Readers"]

NOTHING: Final = Row(0, 0, 0, 0, 0, 0)
"""Of a chunk that has no file."""


@dataclass(eq=False, slots=True)
class Readers:
    """Answers those who read one map.

    Parameters
    ----------
    live, changes, lists
        The map, what changed in it, and lists of its voxels.
    answer
        Takes a ticket and the reply to it.
    """

    live: LiveMap
    changes: Changes
    lists: VoxelLists
    answer: Callable[[int, Any], None]
    _begun: deque[tuple[Ask, int, Iterator[messages.LiveVoxelsReply | None]]] = field(default_factory=deque)

    @property
    def are_waiting(self) -> bool:
        """Whether a list of voxels is being made."""
        return bool(self._begun)

    def left(self, session: int) -> None:
        """A session has ended."""
        self.lists.left(session)
        self._begun = deque(row for row in self._begun if row[0].session != session)

    def page(self, message: messages.LiveChunks) -> messages.LiveChunkPage:
        """Which chunks there are."""
        live, resolution = self.live, self.live.files.settings.resolution
        if message.area is not None:
            check_area(message.area)
        known = not message.since or self.changes.known(message.since)
        since = message.since if known else 0
        keys = (key for key in live.chunks if not since or self.changes.is_newer(key, since))
        wanted: list[ChunkKey] = [key for key in keys if touches(message.area, key, resolution)]
        others = set(list(live.files.rows) if message.saved else ())  # a copy: other threads save
        if not since:
            others |= self._given_up.keys()
            others |= {key for key, one in live.residency.chunks.items() if one.state is State.LOADING}
        wanted += [key for key in others if key not in live.chunks and touches(message.area, key, resolution)]
        if message.after is not None:
            wanted = [key for key in wanted if key > message.after]
        page = heapq.nsmallest(messages.MOST_CHUNK_ROWS, wanted)
        first = since and message.after is None
        gone = (
            [key for key in self.changes.left(since) if touches(message.area, key, resolution)]
            if first
            else []
        )
        return messages.LiveChunkPage(
            message.request, self.changes.number, tuple(self._row(key) for key in page),
            len(wanted) > len(page), tuple(gone), known,
        )  # fmt: skip

    def _row(self, key: ChunkKey) -> messages.LiveChunkRow:
        there = self.live.chunks.get(key)
        known = self.live.residency.chunks.get(key)
        if there is None or known is None:
            row = self.live.files.rows.get(key, NOTHING)
            state_now, nbytes = "saved", row.bytes
            if known is not None and known.state is State.LOADING:
                state_now, nbytes = known.state.value, known.nbytes
            elif (given_up := self._given_up.get(key)) is not None:
                state_now, nbytes = "evicting", given_up
            return messages.LiveChunkRow(
                key, 0, row.version, state_now, row.active, row.occupied, row.free, nbytes
            )
        state = there.view.state
        return messages.LiveChunkRow(
            key, there.view.identity.generation, int(state["version"]), known.state.value,
            int(state["active"]), int(state["occupied"]), int(state["free"]), known.nbytes,
        )  # fmt: skip

    @property
    def _given_up(self) -> dict[ChunkKey, int]:
        """Bytes of chunks that are out of service, and that somebody still maps."""
        found: dict[ChunkKey, int] = {}
        for lease in self.live.residency.leases.by_number.values():
            found[lease.key] = found.get(lease.key, 0) + lease.nbytes
        return found

    def begin_list(self, ask: Ask, message: messages.LiveVoxels) -> None:
        """Begin a list of voxels; `go_on` answers it."""
        if message.scope not in ("memory", "disk", "all"):
            raise BadRequest(f"scope {message.scope!r}", hint="ask for memory, disk or all")
        if message.area is not None:
            check_area(message.area)
        if message.kind not in KINDS:
            raise BadRequest(f"voxels are not {message.kind!r}", hint=f"ask for one of {', '.join(KINDS)}")
        resolution, since = self.live.files.settings.resolution, message.since
        since = since if self.changes.known(since) else 0
        keys = set() if message.scope == "disk" else {
            key for key in self.live.chunks if not since or self.changes.is_newer(key, since)
        }  # fmt: skip
        if message.scope != "memory" and not since:
            keys |= set(self.live.files.rows)
        chosen = sorted(key for key in keys if touches(message.area, key, resolution))
        work = self.lists.collect(message, chosen, ask.session, self.changes.number)
        self._begun.append((ask, message.request, work))

    def go_on(self) -> None:
        """Make another part of a list."""
        ask, request, work = self._begun[0]
        try:
            reply = next(work)
        except ShmmapError as error:
            self._refuse(ask, request, error)
        except OSError as error:
            self._refuse(ask, request, CannotWrite(f"the list of voxels: {error.strerror}"))
        else:
            if reply is None:
                self._begun.rotate(-1)
                return
            self.answer(ask.ticket, reply)
        self._begun.popleft()

    def _refuse(self, ask: Ask, request: int, error: ShmmapError) -> None:
        self.answer(ask.ticket, ErrorReply(request, error.code, error.message, error.hint))
