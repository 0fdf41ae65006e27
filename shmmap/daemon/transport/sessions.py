# SPDX-License-Identifier: Apache-2.0
"""Sessions of clients, and the segments that each of them holds."""

from __future__ import annotations

import contextlib
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

import msgspec

from shmmap.daemon.records import Resident
from shmmap.daemon.transport.connection import Connection, Peer
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import NOWHERE, Places, differ, merged_places, places_of
from shmmap.geometry import Area
from shmmap.logfmt import escaped
from shmmap.protocol.messages import Holder, Intent
from shmmap.quantities import format_bytes
from shmmap.segment.pins import MAX_SLOT

MOVES_PER_STEP: Final = 2
"""Sessions whose motion is updated per step."""


@dataclass(eq=False, slots=True)
class Session:
    """One client's session.

    ``held`` contains the segments that it was given or reports to hold, by version.  This is bookkeeping for
    quotas and for naming holders.  Safety never depends on it: the kernel knows which segments are in use.
    ``exclusive_bytes`` counts segments that no other session holds.  ``says_where`` is true if the client
    stated its ``intent`` (its position and route), false if that was guessed from ``area``, the area it last
    requested, in ``layers``.  ``motion`` is its estimated motion, ``new_intent`` an intent not yet included
    in it, and ``places`` its predicted positions.  Requests and loads of the session count for ``asker``: its
    process, else the session itself.
    """

    slot: int
    connection: Connection
    client: str
    command: str
    sessions: Sessions
    held: dict[int, list[Resident]] = field(default_factory=dict)
    held_bytes: int = 0
    exclusive_bytes: int = 0
    intent: Intent | None = None
    motion: Motion = field(default_factory=Motion)
    places: Places = field(default_factory=lambda: NOWHERE)
    says_where: bool = False
    area: Area | None = None
    layers: tuple[str, ...] = ()
    new_intent: Intent | None = None
    requests: int = 0
    last_request_s: float = 0.0
    asker: int = 0

    @property
    def peer(self) -> Peer:
        """The client's process."""
        return self.connection.peer

    def connect(self, connection: Connection) -> None:
        """Continue the session on this connection."""
        self.disconnect()
        self.connection, connection.slot = connection, self.slot

    def disconnect(self) -> None:
        """Separate the session from its connection, and forget its position."""
        self.connection.slot = 0
        self.intent = self.new_intent = self.area = None
        self.says_where = False
        self.motion = Motion()
        self.sessions.moved[self] = None

    def state_intent(self, intent: Intent) -> None:
        """Take over the position and route that the client states."""
        self.intent = self.new_intent = intent
        self.says_where = True
        self.sessions.moved[self] = None

    def hold(self, residents: Iterable[Resident]) -> None:
        """Count segments that the session was given."""
        held = self.held
        for resident in residents:
            known = held.get(resident.version)
            if known is None:
                held[resident.version] = [resident]
            elif resident in known:
                continue
            else:
                known.append(resident)
            self.held_bytes += resident.nbytes
            if self.slot not in resident.sessions:
                self._share(resident, 1)
                resident.sessions.add(self.slot)
            elif len(resident.sessions) == 1:  # the session that had this slot before still holds it
                self.exclusive_bytes += resident.nbytes

    def _share(self, resident: Resident, one: int) -> None:
        """Count a segment that this session has acquired (1) or lost (-1) in its share."""
        others = resident.sessions
        if not others:
            self.exclusive_bytes += one * resident.nbytes
        elif len(others) == 1:
            (slot,) = others
            other = self.sessions.slots.get(slot)
            if other is not None:
                other.exclusive_bytes -= one * resident.nbytes

    def _lose(self, resident: Resident) -> None:
        self.held_bytes -= resident.nbytes
        later = self.sessions.slots.get(self.slot)
        if later is None or later is self or resident not in later.held.get(resident.version, ()):
            resident.sessions.discard(self.slot)
            self._share(resident, -1)

    def drop(self, versions: Iterable[int]) -> list[Resident]:
        """Remove versions; return the segments that the session had of them."""
        dropped = [resident for version in versions for resident in self.held.pop(version, ())]
        for resident in dropped:
            self._lose(resident)
        return dropped

    def drop_segment(self, resident: Resident) -> None:
        """Remove one segment if the session holds it."""
        known = self.held.get(resident.version, [])
        if resident in known:
            known.remove(resident)
            self._lose(resident)
            if not known:
                del self.held[resident.version]

    def as_holder(self, nbytes: int, cells: int) -> Holder:
        """Return this session as a row of a reply."""
        return Holder(
            self.slot, self.peer.pid, self.peer.uid, self.client or self.command, nbytes, cells, self.command
        )


def command_of(pid: int) -> str:
    """Return the command name of a process; empty if it cannot be read."""
    if pid <= 0:
        return ""
    with contextlib.suppress(OSError):
        return escaped(Path(f"/proc/{pid}/comm").read_text(errors="replace").strip())
    return ""


class Sessions:
    """All sessions of this run of the daemon, by slot.

    Slots are random 62-bit numbers, so that a slot is only ever used by one client: the segments that it maps
    are locked under its slot, even when a later run of the daemon looks for their holder.

    Attributes
    ----------
    slots : dict
        Sessions by slot, the offset of their lock byte.
    departed : dict
        By slot, sessions whose connection has ended and whose process may still map segments it was given.
    moved : dict
        Sessions that have moved, or requested another area, since the last `follow_moves`.
    places_version : int
        Changes whenever `places` changes, but for the time.
    """

    LIMIT = 4096

    def __init__(self) -> None:
        self.slots: dict[int, Session] = {}
        self.departed: dict[int, Session] = {}
        self.moved: dict[Session, None] = {}
        self.places_version = 0

    def __len__(self) -> int:
        return len(self.slots)

    def __iter__(self) -> Iterator[Session]:
        return iter(self.slots.values())

    def largest_holder(self) -> str:
        """Return name, process and bytes of the client that was given most; empty if none was given any."""
        most = max(self, key=lambda session: session.held_bytes, default=None)
        if most is None or not most.held_bytes:
            return ""
        return f"{most.client or most.command} (pid {most.peer.pid}): {format_bytes(most.held_bytes)}"

    def spare(self) -> Session | None:
        """Return the session to end when there are too many; None if each process has just one.

        It belongs to the process with most sessions (processes that the kernel does not report count as one).
        Its next request is answered ``no_session``, and it may open another session.
        """
        sessions_of = Counter(session.peer.pid for session in self)
        owner, count = max(sessions_of.items(), key=lambda item: item[1], default=(0, 0))
        if owner and count < 2:
            return None
        mine = [session for session in self if session.peer.pid == owner]
        return min(mine, key=lambda session: session.last_request_s, default=None)

    def open(self, connection: Connection, client: str, now_s: float, *, slot: int = 0) -> Session:
        """Open a session.

        ``slot`` is the slot that the client had before, on another connection or in a previous run of the
        daemon, and keeps; 0 for none.
        """
        if not 0 < slot <= MAX_SLOT or slot in self.slots:
            slot = secrets.randbelow(MAX_SLOT) + 1
        pid = connection.peer.pid
        session = Session(
            slot,
            connection,
            escaped(client)[:64],
            command_of(pid),
            self,
            last_request_s=now_s,
            asker=pid or -slot,
        )
        connection.slot = slot
        self.slots[slot] = session
        return session

    def close(self, session: Session) -> None:
        """End a session; the caller drops the segments that it held."""
        session.disconnect()
        self._follow(session)
        self.slots.pop(session.slot, None)
        self.departed.pop(session.slot, None)

    def follow_moves(self) -> list[Session]:
        """Update the motions and `places` of some sessions that moved; return these sessions."""
        some = list(islice(self.moved, MOVES_PER_STEP))
        for session in some:
            self._follow(session)
        return some

    def places(self) -> Places:
        """Return present and predicted positions of the clients, as of the last `follow_moves`."""
        return merged_places(session.places for session in self if len(session.places))

    def _follow(self, session: Session) -> None:
        self.moved.pop(session, None)
        intent, session.new_intent = session.new_intent, None
        if intent is not None:
            session.motion.update(intent, session.last_request_s)
            if intent.route:  # the motion keeps what it needs of a route, which may be long
                session.intent = msgspec.structs.replace(intent, route=())
        before, session.places = session.places, NOWHERE
        if session.intent is not None:
            session.places = places_of(session.motion, 0.0 if session.area is None else session.area.reach)
        self.places_version += differ(before, session.places)
