# SPDX-License-Identifier: Apache-2.0
"""What operators alone may ask: read the map again, evict, pin, stop."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.pace import Pace
from shmmap.daemon.requests.operators.operator_pins import OperatorPins, cells_named
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import Offline, ShmmapError
from shmmap.logfmt import log
from shmmap.protocol import messages
from shmmap.protocol.codec import encode

__all__ = ["OPERATOR_REQUESTS", "OperatorRequests"]

OPERATOR_REQUESTS: Final = (messages.Reload, messages.Evict, messages.Pin, messages.Unpin, messages.Shutdown)
RELOAD_S: Final = 4.0
"""How long a reload of a map that is elsewhere may take before its answer is that it cannot be reached."""
FAREWELL_S: Final = 1.0
"""How long a stop waits for the client that asked for it: its libzmq drops a reply that was not read when the
connection ends (ZMQ_IMMEDIATE)."""


@dataclass(eq=False, slots=True)
class OperatorRequests:
    """Does what an operator asks; the permission was checked before.

    Attributes
    ----------
    stop_by_s
        When the daemon stops; infinity if no operator asked for that.
    """

    cache: CellCache
    pins: OperatorPins
    reloader: Reloader
    stop_by_s: float = math.inf
    _asked_to_stop: Session | None = None
    _reloading: dict[tuple[int, int], tuple[Session, float]] = field(default_factory=dict)

    def handle(self, session: Session, message: messages.Request, now_s: float) -> Iterator[None]:
        """Carry out one request and answer it, a reload when it is over."""
        if isinstance(message, messages.Reload):
            self._reload(session, message, now_s)
        elif isinstance(message, messages.Evict):
            evicted = yield from self._evict(message, now_s)
            session.connection.reply(encode(evicted))
        elif isinstance(message, messages.Pin):
            pinned = yield from self.pins.pin(message, now_s)
            session.connection.reply(encode(pinned))
        elif isinstance(message, messages.Unpin):
            pinned = yield from self.pins.unpin(message)
            session.connection.reply(encode(pinned))
        elif isinstance(message, messages.Shutdown):
            log.info("stopping", requested_by_pid=session.peer.pid, uid=session.peer.uid)
            session.connection.reply(encode(messages.Stopping(message.request)))
            self._asked_to_stop, self.stop_by_s = session, now_s + FAREWELL_S

    def on_session_end(self, session: Session) -> None:
        """Stop now, if this is the session that the daemon stops for: it has read its answer."""
        if session is self._asked_to_stop:
            self.stop_by_s = -math.inf

    def answer_overdue(self, now_s: float) -> None:
        """Refuse reloads that take too long; they go on."""
        for asked, (session, until_s) in list(self._reloading.items()):
            if now_s >= until_s:
                del self._reloading[asked]
                why = f"{self.reloader.map_path}: not read within {RELOAD_S:g} s; the reload goes on"
                session.connection.refuse(asked[1], Offline(why))

    def _reload(self, session: Session, message: messages.Reload, now_s: float) -> None:
        asked = session.slot, message.request
        if asked in self._reloading:
            return  # the client repeats what it has no answer to yet
        until_s = math.inf if self.cache.pages is None else now_s + RELOAD_S
        self._reloading[asked] = session, until_s

        def answer(result: Reread | ShmmapError) -> None:
            if self._reloading.pop(asked, None) is None:
                return  # it was refused
            if isinstance(result, ShmmapError):
                session.connection.refuse(message.request, result)
                return
            catalogue, change = result.catalogue, result.change
            counts = len(change.changed), len(change.added), len(change.removed)
            problems = tuple(catalogue.problems)
            reloaded = messages.Reloaded(message.request, catalogue.map_version, *counts, problems)
            session.connection.reply(encode(reloaded))

        self.reloader.ask(answer)

    def _evict(self, message: messages.Evict, now_s: float) -> Generator[None, None, messages.Evicted]:
        ledger, reclaimer = self.cache.ledger, self.cache.reclaimer
        unknown: tuple[str, ...] = ()
        if message.ids is None:
            chosen = list(ledger.residents())
        else:
            cells, unknown = yield from cells_named(self.cache, message.ids)
            chosen = []
            for cell in cells:
                chosen += ledger.of_cell(cell)
                yield
        freed = kept = 0
        pace = Pace()
        for resident in chosen:
            yield from pace.pause()
            if ledger.resident_named(resident.name) is not resident:
                continue  # it was evicted meanwhile
            if resident.key in self.pins:
                kept += 1
            else:
                freed += reclaimer.retire(resident, now_s)
        return messages.Evicted(message.request, freed, len(chosen) - kept - freed, unknown, kept)
