# SPDX-License-Identifier: Apache-2.0
"""Who has said hello, and what each of them holds."""

from __future__ import annotations

import contextlib
import math
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from shmmap.daemon.records import Resident
from shmmap.daemon.transport.connection import Connection, Peer
from shmmap.geometry import Area
from shmmap.logfmt import escaped
from shmmap.protocol.messages import Holder, Intent
from shmmap.segment.pins import MAX_SLOT

__all__ = ["Places", "Session", "Sessions", "predicted_path", "squares_of"]

LOOK_AHEAD_S: Final = 5
ROUTE_VERTICES: Final = 64
SQUARE_M: Final = 16.0
"""Where clients are and will be counts to the square of this grid."""
SQUARES_ORIGIN: Final = 1 << 22
"""Column and row of the square at the map's origin; what is farther away counts at the grid's edge."""
GRID_M: Final = (SQUARES_ORIGIN - 1) * SQUARE_M
MOVES_AT_ONCE: Final = 16
"""Sessions whose paths are looked at at a time: less than a millisecond."""
FIRST_STEP_M: Final = 32.0
"""Along its path a client's places are so far apart at first, then each twice as far away as the last."""


@dataclass(eq=False, slots=True)
class Session:
    """One client.

    ``held`` is what it was handed or says it has, by version: bookkeeping for quotas and for
    naming holders.  Safety never depends on it: what is in use, the kernel tells.  ``exclusive_bytes`` are
    those that no other session holds.  ``says_where`` tells
    an ``intent`` (where the client is and is going to be) that it stated from one that was guessed from
    ``area``, the last one it asked for; whoever sets it notes the session in `Sessions.moved`.  ``squares``
    are those of `Places` that it counts to.  ``asker`` is whose turn its requests and loads count for: the
    process's, else the session's own.
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
    squares: frozenset[int] = frozenset()
    says_where: bool = False
    area: Area | None = None
    requests: int = 0
    last_request_s: float = 0.0
    asker: int = 0

    @property
    def peer(self) -> Peer:
        """The client's process."""
        return self.connection.peer

    def connect(self, connection: Connection) -> None:
        """The session goes on on this connection."""
        self.disconnect()
        self.connection, connection.session = connection, self

    def disconnect(self) -> None:
        """The session has no connection; what it said of where it is does not count any more."""
        self.connection.session = self.intent = self.area = None
        self.says_where = False
        self.sessions.moved[self] = None

    def hold(self, residents: Iterable[Resident]) -> None:
        """The session was handed these segments."""
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
            elif len(resident.sessions) == 1:  # an earlier session of this slot has it still
                self.exclusive_bytes += resident.nbytes

    def _share(self, resident: Resident, one: int) -> None:
        """One more of the segment's holders is this session, or (-1) one less."""
        others = resident.sessions
        if not others:
            self.exclusive_bytes += one * resident.nbytes
        elif len(others) == 1:
            (slot,) = others
            other = self.sessions.by_slot(slot)
            if other is not None:
                other.exclusive_bytes -= one * resident.nbytes

    def _lose(self, resident: Resident) -> None:
        self.held_bytes -= resident.nbytes
        later = self.sessions.by_slot(self.slot)
        if later is None or later is self or resident not in later.held.get(resident.version, ()):
            resident.sessions.discard(self.slot)
            self._share(resident, -1)

    def drop(self, versions: Iterable[int]) -> list[Resident]:
        """The session does not have these versions any more; returns what it had of them."""
        dropped = [resident for version in versions for resident in self.held.pop(version, ())]
        for resident in dropped:
            self._lose(resident)
        return dropped

    def drop_segment(self, resident: Resident) -> None:
        """The session cannot have this one segment any more."""
        known = self.held.get(resident.version, [])
        if resident in known:
            known.remove(resident)
            self._lose(resident)
            if not known:
                del self.held[resident.version]

    def residents(self) -> list[Resident]:
        """Everything the session holds."""
        return [resident for known in self.held.values() for resident in known]

    def as_holder(self, nbytes: int, cells: int) -> Holder:
        """This session as a line in a reply."""
        return Holder(
            self.slot, self.peer.pid, self.peer.uid, self.client or self.command, nbytes, cells, self.command
        )


def predicted_path(intent: Intent) -> list[tuple[float, float]]:
    """Where a client is, and where it says it will be: along its route, else straight on.

    Positions every second of the next five; of a route its first vertices, as long as it may be.
    """
    path = [(intent.x, intent.y)]
    if intent.route:
        path += intent.route[:ROUTE_VERTICES]
    elif intent.vx or intent.vy:
        path += [(intent.x + s * intent.vx, intent.y + s * intent.vy) for s in range(1, LOOK_AHEAD_S + 1)]
    return path


def squares_of(path: Sequence[tuple[float, float]]) -> frozenset[int]:
    """Squares in which a client is at the begin of its path, along it and at its end.

    The farther ahead the farther apart: what is needed soon counts exactly, and a path of any length gives
    a few squares.  A square is ``column << 32 | row``.
    """
    (x, y), *ahead = [(_within_grid(x), _within_grid(y)) for x, y in path]
    if not ahead:
        return frozenset((_square(x, y),))
    squares = {_square(x, y)}
    come_m, next_m = 0.0, FIRST_STEP_M
    for to_x, to_y in ahead:
        step_m = math.hypot(to_x - x, to_y - y)
        while come_m + step_m >= next_m:
            share = (next_m - come_m) / step_m
            squares.add(_square(x + share * (to_x - x), y + share * (to_y - y)))
            next_m *= 2.0
        come_m, x, y = come_m + step_m, to_x, to_y
    squares.add(_square(x, y))
    return frozenset(squares)


def _within_grid(metres: float) -> float:
    return metres if -GRID_M < metres < GRID_M else math.copysign(GRID_M, metres)


def _square(x: float, y: float) -> int:
    return int(x // SQUARE_M) + SQUARES_ORIGIN << 32 | int(y // SQUARE_M) + SQUARES_ORIGIN


class Places:
    """Squares in which any client is or will be.

    Attributes
    ----------
    squares : dict
        To how many clients' paths each belongs.
    version : int
        Another one after each change.
    """

    def __init__(self) -> None:
        self.squares: dict[int, int] = {}
        self.version = 0

    def move(self, old: frozenset[int], new: frozenset[int]) -> None:
        """One client is and will be elsewhere."""
        for square in new - old:
            self.squares[square] = self.squares.get(square, 0) + 1
        for square in old - new:
            count = self.squares.pop(square) - 1
            if count:
                self.squares[square] = count
        self.version += 1


def command_of(pid: int) -> str:
    """Command name of a process, empty where it cannot be read."""
    if pid <= 0:
        return ""
    with contextlib.suppress(OSError):
        return escaped(Path(f"/proc/{pid}/comm").read_text(errors="replace").strip())
    return ""


class Sessions:
    """All sessions of this epoch, by slot.

    Slots are random 62-bit numbers, so that one is never used again but by the client that had it: what
    it maps is locked under its slot, also when a later life of the daemon asks whose that is.

    Attributes
    ----------
    departed : dict
        By slot, those whose connection has ended and who may still map what they were handed.
    places
        Where the clients are and are going to be, as of the last `follow_moves`.
    moved : dict
        Whose intent is another one since then.
    """

    LIMIT = 4096

    def __init__(self) -> None:
        self._by_slot: dict[int, Session] = {}
        self.departed: dict[int, Session] = {}
        self.places = Places()
        self.moved: dict[Session, None] = {}

    def __len__(self) -> int:
        return len(self._by_slot)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._by_slot.values())

    def by_slot(self, slot: int) -> Session | None:
        """The session whose lock byte is ``slot``."""
        return self._by_slot.get(slot)

    def spare(self) -> Session | None:
        """The session to give up when there are too many; None when everybody has just one.

        It belongs to the process that has most (those whom the kernel does not name are one).  It is told
        ``no_session`` and may open another.
        """
        sessions_of = Counter(session.peer.pid for session in self)
        owner, count = max(sessions_of.items(), key=lambda item: item[1], default=(0, 0))
        if owner and count < 2:
            return None
        mine = [session for session in self if session.peer.pid == owner]
        return min(mine, key=lambda session: session.last_request_s, default=None)

    def open(self, connection: Connection, client: str, now_s: float, *, slot: int = 0) -> Session:
        """Begin a session.

        ``slot`` is the one that the client had before, on another connection or in an earlier life of the
        daemon, and keeps; 0 for none.
        """
        if not 0 < slot <= MAX_SLOT or slot in self._by_slot:
            slot = secrets.randbelow(MAX_SLOT) + 1
        pid = connection.peer.pid
        session = Session(
            slot, connection, escaped(client)[:64], command_of(pid), self, last_request_s=now_s,
            asker=pid or -slot,
        )  # fmt: skip
        connection.session = session
        self._by_slot[slot] = session
        return session

    def close(self, session: Session) -> None:
        """End a session; what it held is for the caller to drop."""
        session.disconnect()
        self._follow(session)
        self._by_slot.pop(session.slot, None)
        self.departed.pop(session.slot, None)

    def follow_moves(self) -> None:
        """Bring `places` up to date, for a bounded number of sessions that moved."""
        for session in list(islice(self.moved, MOVES_AT_ONCE)):
            self._follow(session)

    def _follow(self, session: Session) -> None:
        self.moved.pop(session, None)
        intent = session.intent
        squares = squares_of(predicted_path(intent)) if intent is not None else frozenset()
        if squares != session.squares:
            self.places.move(session.squares, squares)
            session.squares = squares
