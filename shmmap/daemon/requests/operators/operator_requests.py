# SPDX-License-Identifier: Apache-2.0
"""What operators alone may ask: read the map again, evict, pin, stop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

from shmmap.daemon.cache.cell_cache import Store
from shmmap.daemon.cache.ledger import Resident
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import ShmmapError
from shmmap.origin.catalogue import Catalogue, compare
from shmmap.protocol import messages
from shmmap.protocol.codec import encode

__all__ = ["OPERATOR_REQUESTS", "OperatorRequests"]

_log = logging.getLogger(__name__)

OPERATOR_REQUESTS: Final = (
    messages.Reload,
    messages.Evict,
    messages.Pin,
    messages.Unpin,
    messages.Shutdown,
)


class OperatorRequests:
    """Does what an operator asks; whether one may ask was found out before.

    Parameters
    ----------
    send
        Called with a session and an encoded reply.
    refuse
        Called with a routing identity, the request's number and an error.
    stop_for
        Called with the session that wants the daemon to stop, once it has been answered.
    """

    def __init__(
        self,
        store: Store,
        pins: OperatorPins,
        reloader: Reloader,
        *,
        send: Callable[[Session, bytes], None],
        refuse: Callable[[bytes, int, ShmmapError], None],
        stop_for: Callable[[Session], None],
    ) -> None:
        self._store = store
        self._pins = pins
        self._reloader = reloader
        self._send = send
        self._refuse = refuse
        self._stop_for = stop_for

    def handle(self, session: Session, message: messages.Request, now_s: float) -> None:
        """Carry out one request and answer it, a reload when it is over."""
        if isinstance(message, messages.Reload):
            self._reload(session, message)
        elif isinstance(message, messages.Evict):
            self._send(session, encode(self._evict(message, now_s)))
        elif isinstance(message, messages.Pin):
            self._send(session, encode(self._pins.pin(message, now_s)))
        elif isinstance(message, messages.Unpin):
            self._send(session, encode(self._pins.unpin(message)))
        elif isinstance(message, messages.Shutdown):
            _log.info("stopping at the request of pid %d, uid %d", session.peer.pid, session.peer.uid)
            self._send(session, encode(messages.Stopping(message.request)))
            self._stop_for(session)

    def _reload(self, session: Session, message: messages.Reload) -> None:
        before = self._store.catalogue

        def answer(result: Catalogue | ShmmapError) -> None:
            if isinstance(result, ShmmapError):
                self._refuse(session.identity, message.request, result)
                return
            change = compare(before, result)
            reloaded = messages.Reloaded(
                message.request,
                result.map_version,
                len(change.changed),
                len(change.added),
                len(change.removed),
                result.problems,
            )
            self._send(session, encode(reloaded))

        self._reloader.ask(answer)

    def _evict(self, message: messages.Evict, now_s: float) -> messages.Evicted:
        store = self._store
        unknown: list[str] = []
        chosen: list[Resident] = []
        if message.ids is None:
            chosen = list(store.books.residents())
        else:
            asked: set[str] = set()
            for cell in message.ids:
                index = store.index_of(cell)
                if index is None:
                    unknown.append(cell)
                else:
                    asked.add(store.catalogue.id(index))
            chosen = [r for r in store.books.residents() if r.key.cell_id in asked]
        loose = [resident for resident in chosen if resident.key not in self._pins]
        freed = sum(store.evict(resident, now_s) for resident in loose)
        kept = len(chosen) - len(loose)
        return messages.Evicted(message.request, freed, len(loose) - freed, tuple(unknown), kept)
