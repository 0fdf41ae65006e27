# SPDX-License-Identifier: Apache-2.0
"""Sessions as rows of the statistics."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import Final, NamedTuple

from shmmap.daemon.transport.sessions import Session
from shmmap.geometry import Area, Box, Circle
from shmmap.statistics.client_rows import MAX_CLIENTS, ClientRow, Window

__all__ = ["ROWS_AT_ONCE", "SessionRows"]

ROWS_AT_ONCE: Final = 64
"""Rows that are made anew at a time: half a millisecond."""


class _Shown(NamedTuple):
    state: tuple[object, ...]
    number: int
    row: ClientRow


class SessionRows:
    """Rows of sessions, of which a bounded number is brought up to date at a time."""

    def __init__(self) -> None:
        self._shown: dict[Session, _Shown] = {}
        self._number = 0

    def of(self, sessions: Iterable[Session]) -> list[ClientRow]:
        """Return the rows of the first `MAX_CLIENTS` sessions.

        Of those that changed, the ones are made anew whose rows are the oldest; a new session has none until
        it is its turn.
        """
        first = list(islice(sessions, MAX_CLIENTS))
        shown = {session: self._shown[session] for session in first if session in self._shown}
        outdated = [one for one in first if one not in shown or shown[one].state != _state(one)]
        outdated.sort(key=lambda session: shown[session].number if session in shown else 0)
        for session in outdated[:ROWS_AT_ONCE]:
            self._number += 1
            shown[session] = _Shown(_state(session), self._number, client_row(session))
        self._shown = shown
        return [shown[session].row for session in first if session in shown]


def _state(session: Session) -> tuple[object, ...]:
    """What is another one whenever the session's row would be."""
    return session.requests, session.connection, session.intent, len(session.held), session.held_bytes


def client_row(session: Session) -> ClientRow:
    """Return what operators see of a client."""
    intent, peer = session.intent, session.peer
    return ClientRow(
        session.slot, peer.pid, peer.uid, len(session.held), session.held_bytes, session.requests,
        int(session.last_request_s * 1e9), session.client, session.command,
        (float(intent.x), float(intent.y)) if intent is not None else None,
        None if intent is None or intent.heading is None else float(intent.heading),
        _window(session.area) if session.area is not None else None,
    )  # fmt: skip


def _window(area: Area) -> Window:
    if isinstance(area, Box):
        half = (0.5 * (area.max_x - area.min_x), 0.5 * (area.max_y - area.min_y))
        return Window("box", *area.center, *half)
    return Window("circle" if isinstance(area, Circle) else "square", *area.center, area.radius, area.radius)
