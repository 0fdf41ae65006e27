# SPDX-License-Identifier: Apache-2.0
"""Requests of operators: read the map again, evict, pin, stop; and the check of who is an operator.

The check uses the kernel's credentials of the peer (`Peer`), never a client's claim.  Root and the daemon's
own user are always allowed, and so are members of the configured administrators' group.
"""

from __future__ import annotations

import math
import os
import pwd
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.prerequisites import group_id
from shmmap.daemon.requests.operators.operator_pins import OperatorPins, cells_named
from shmmap.daemon.transport.connection import Peer
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import NotPermitted, Offline, ShmmapError
from shmmap.logfmt import log
from shmmap.protocol import messages
from shmmap.protocol.codec import encode

MEMORY_S: Final = 10.0
"""How long a user's groups are cached: looking them up may involve a remote server."""


class Authorization:
    """Decides which users may administer the daemon.

    Parameters
    ----------
    group
        Group (name or number) whose members may, besides root and the daemon's user; empty: no group.
    setting
        Name of the setting that names the group.

    Attributes
    ----------
    gid
        Number of the group; -1 for none.

    Raises
    ------
    ConfigError
        The group does not exist.
    """

    def __init__(self, group: str = "", setting: str = "admin_group") -> None:
        self._name = group
        self.gid = group_id(group, setting) if group else -1
        self._groups: dict[int, tuple[float, frozenset[int]]] = {}

    def allow(self, peer: Peer, now_s: float) -> bool:
        """Whether a connected process may administer the daemon."""
        if peer.uid in (0, os.geteuid()):
            return True
        if self.gid < 0 or peer.uid < 0:
            return False
        return peer.gid == self.gid or self.gid in self._groups_of(peer.uid, now_s)

    def require(self, peer: Peer, now_s: float) -> None:
        """Refuse a process that may not administer the daemon.

        Raises
        ------
        NotPermitted
            The process may not.
        """
        if not self.allow(peer, now_s):
            members = f", and members of group {self._name}" if self._name else ""
            raise NotPermitted(
                f"only root and the daemon's own user{members} may do this", hint="run it with sudo"
            )

    def _groups_of(self, uid: int, now_s: float) -> frozenset[int]:
        known = self._groups.get(uid)
        if known is not None and now_s < known[0]:
            return known[1]
        try:
            account = pwd.getpwuid(uid)
            groups = frozenset(os.getgrouplist(account.pw_name, account.pw_gid))
        except (KeyError, OSError):
            groups = frozenset()  # a user without an account on this machine: only its own group counts
        if len(self._groups) >= 1024:
            self._groups.clear()
        self._groups[uid] = (now_s + MEMORY_S, groups)
        return groups


OPERATOR_REQUESTS: Final = (messages.Reload, messages.Evict, messages.Pin, messages.Unpin, messages.Shutdown)
RELOAD_S: Final = 4.0
"""How long a reload of a remote map may take before it is refused as unreachable."""
FAREWELL_S: Final = 1.0
"""How long a stop waits for the client that asked for it: that client's libzmq drops a reply that it has not
read when the connection ends (ZMQ_IMMEDIATE)."""


@dataclass(eq=False, slots=True)
class OperatorRequests:
    """Carries out operators' requests; permission has been checked before.

    Attributes
    ----------
    stop_by_s
        When the daemon stops; infinity while no operator has asked for a stop.
    """

    cache: CellCache
    pins: OperatorPins
    reloader: Reloader
    stop_by_s: float = math.inf
    _asked_to_stop: Session | None = None
    _reloading: dict[tuple[int, int], tuple[Session, float]] = field(default_factory=dict)

    def handle(self, session: Session, message: messages.Request, now_s: float) -> Iterator[None]:
        """Carry out and answer one request; a reload is answered when it has finished."""
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
        """Stop now if the ended session is the one that asked for the stop: it has read its answer."""
        if session is self._asked_to_stop:
            self.stop_by_s = -math.inf

    def answer_overdue(self, now_s: float) -> None:
        """Refuse reloads that take too long; the reloads themselves continue."""
        for asked, (session, until_s) in list(self._reloading.items()):
            if now_s >= until_s:
                del self._reloading[asked]
                why = f"{self.reloader.origin.path}: not read within {RELOAD_S:g} s; the reload goes on"
                session.connection.refuse(asked[1], Offline(why))

    def _reload(self, session: Session, message: messages.Reload, now_s: float) -> None:
        asked = session.slot, message.request
        if asked in self._reloading:
            return  # the client repeats a request without an answer
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
        for resident in chosen:
            yield
            if ledger.resident_named(resident.name) is not resident:
                continue  # evicted in the meantime
            if resident.key in self.pins:
                kept += 1
            else:
                freed += reclaimer.retire(resident, now_s)
        return messages.Evicted(message.request, freed, len(chosen) - kept - freed, unknown, kept)
