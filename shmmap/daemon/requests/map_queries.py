# SPDX-License-Identifier: Apache-2.0
"""What any client may ask about the map: where it is, which cells there are, one of them, who uses what."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from shmmap import __version__
from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.cache.survey import Share, Usage
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import Resident
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.errors import BadRequest, UnknownCell
from shmmap.layers.registry import kinds
from shmmap.protocol import messages
from shmmap.protocol.events import Recent
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["MapQueries"]

PAGE_ROWS: Final = 500
"""Longest metadata page: making one takes the serving loop about a millisecond."""


@dataclass(eq=False, slots=True)
class MapQueries:
    """Answers from the catalogue and from what is in memory.

    Parameters
    ----------
    pins
        The cells that operators pinned.
    events_path
        Where events are published; empty: nowhere.
    """

    config: DaemonConfig
    cache: CellCache
    sessions: Sessions
    statistics: StatisticsWriter
    pins: OperatorPins
    map_switch: MapSwitch
    loads: Loads
    epoch: int
    event_log: EventLog
    events_path: str = ""

    @property
    def _catalogue(self) -> CatalogueView:
        return self.cache.catalogue

    def welcome(self, session: Session, message: messages.Hello) -> messages.Welcome:
        """Tell a new client where everything is."""
        catalogue = self._catalogue
        return messages.Welcome(
            request=message.request,
            major=messages.PROTOCOL_VERSION[0],
            minor=messages.PROTOCOL_VERSION[1],
            daemon=__version__,
            instance=self.config.instance,
            epoch=self.epoch,
            session=session.slot,
            map_version=catalogue.map_version,
            map_path=self.config.map_path,
            frame_id=catalogue.frame_id,
            shm_dir=self.config.shm_dir,
            id_prefix=self.cache.id_prefix,
            segment_prefix=self.cache.segment_prefix,
            cells=len(catalogue),
            bounds=catalogue.bounds,
            layers=tuple(kind.describe() for kind in kinds()),
            budget_bytes=self.cache.ledger.budget_bytes,
            pid=os.getpid(),
            events=self.events_path,
        )

    def answer(self, message: messages.Request) -> messages.Reply:
        """Answer one request."""
        if isinstance(message, messages.Metadata):
            return self._metadata(message)
        if isinstance(message, Recent):
            return self.event_log.page(message)
        if isinstance(message, messages.Show):
            return self._show(message)
        raise BadRequest(f"a {type(message).__name__} cannot be answered here")

    def _metadata(self, message: messages.Metadata) -> messages.MetadataPage:
        cache, catalogue = self.cache, self._catalogue
        indices: Sequence[int]
        indices = (
            range(len(catalogue))
            if message.area is None
            else catalogue.query(messages.area_from_message(message.area)).tolist()
        )
        removed: tuple[str, ...] = ()
        known = True
        if message.since is not None:
            change = self.map_switch.changes_since(message.since)
            known = change is not None
            if change is not None:
                touched = {i for cell in change[0] if (i := cache.index_of(cell)) is not None}
                indices = [i for i in indices if i in touched] if message.area else sorted(touched)
                removed = tuple(cache.wire_id(cell) for cell in change[1]) if message.start == 0 else ()
        start = max(0, message.start)
        end = start + max(1, min(message.limit, PAGE_ROWS))
        return messages.MetadataPage(
            request=message.request,
            epoch=self.epoch,
            map_version=catalogue.map_version,
            rows=tuple(self._row(index) for index in indices[start:end]),
            next=end if end < len(indices) else None,
            since_known=known,
            removed=removed,
        )

    def _row(self, index: int) -> messages.MetadataRow:
        catalogue = self._catalogue
        heights = self.cache.heights.get(index, (None, None))
        return messages.MetadataRow(
            self.cache.wire_id(catalogue.id(index)),
            catalogue.version(index),
            *catalogue.box(index),
            catalogue.stamp(index).size,
            *heights,
        )

    def stats(self, message: messages.Stats, usage: Usage, now_s: float) -> messages.StatsReply:
        """Answer a request for statistics with what a survey found."""
        return messages.StatsReply(
            request=message.request,
            epoch=self.epoch,
            map_version=self._catalogue.map_version,
            counters=dict(self.statistics.values),
            sessions=tuple(
                self._session_row(session, usage.shares.get(session.slot, Share()), now_s)
                for session in self.sessions
            ),
            unknown_holders=usage.unknown,
            unknown_bytes=usage.unknown_bytes,
        )

    def _session_row(self, session: Session, share: Share, now_s: float) -> messages.SessionRow:
        intent = session.intent
        return messages.SessionRow(
            session.slot,
            session.peer.pid,
            session.peer.uid,
            session.peer.gid,
            session.client,
            session.command,
            len(session.held),
            session.held_bytes,
            session.requests,
            now_s - session.last_request_s,
            (intent.x, intent.y) if intent is not None else None,
            share.mapped_bytes,
            share.superseded,
            share.superseded_bytes,
        )

    def _show(self, message: messages.Show) -> messages.ShownCell:
        cache = self.cache
        index = cache.index_of(message.id)
        if index is None:
            return self._show_gone(message)
        cell_id = cache.catalogue.id(index)
        version = cache.catalogue.version(index)
        failures = [failure for key, failure in self.loads.failures.items() if key.cell_id == cell_id]
        shown = []
        for resident in cache.ledger.everything():
            if resident.key.cell_id == cell_id:
                state = (
                    "zombie"
                    if resident.name in cache.ledger.retired
                    else "resident" if cache.is_current(resident) else "stale"
                )  # fmt: skip
                shown.append(self._segment(resident, state))
        z_min, z_max = cache.heights.get(index, (None, None))
        return messages.ShownCell(
            message.request,
            cell_id,
            version,
            *cache.catalogue.box(index),
            cache.catalogue.stamp(index).size,
            tuple(shown),
            tuple(key.layer for key in self.loads.by_key if key.cell_id == cell_id),
            "; ".join(f"{failure.code}: {failure.message}" for failure in failures),
            z_min=z_min,
            z_max=z_max,
            pinned=self.pins.layers_of(cell_id),
        )

    def _show_gone(self, message: messages.Show) -> messages.ShownCell:
        """A cell that left the map while somebody maps it: version 0."""
        everything = self.cache.ledger.everything()
        names = (message.id, self.cache.id_prefix + message.id)
        left = [resident for resident in everything if resident.key.cell_id in names and message.id]
        if not left:
            raise UnknownCell(
                f"the map has no cell {message.id!r}", hint="`shmmap ls` lists what is resident"
            )
        shown = tuple(self._segment(resident, "zombie") for resident in left)
        return messages.ShownCell(message.request, left[0].key.cell_id, 0, *left[0].box, 0, shown)

    def _segment(self, resident: Resident, state: str) -> messages.ShownSegment:
        return messages.ShownSegment(
            resident.key.layer,
            resident.version,
            resident.name,
            state,
            resident.nbytes,
            resident.points,
            self.cache.holders.of([resident]),
        )
