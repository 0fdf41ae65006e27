# SPDX-License-Identifier: Apache-2.0
"""A session as a row of the statistics."""

from __future__ import annotations

from shmmap.daemon.transport.sessions import Session
from shmmap.geometry import Area, Box, Circle
from shmmap.statistics.client_rows import ClientRow, Window

__all__ = ["client_row"]


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
