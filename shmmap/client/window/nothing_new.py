# SPDX-License-Identifier: Apache-2.0
"""Whether a request of a window would bring nothing: then it need not be sent."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from shmmap import geometry
from shmmap.client.window.state import WindowState
from shmmap.errors import ShmmapError
from shmmap.protocol.messages import Intent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shmmap.client.client import Client
    from shmmap.client.window.change_counter import ChangeCounter

__all__ = ["NothingNew", "says_more"]

TELL_S: Final = 1.0
TELL_M: Final = 5.0
"""The daemon is told the pose after so long or so far, whether anything is new or not."""
TELL_MPS: Final = 1.0
"""A velocity that differs by so much, or a pose by `TELL_M`, is worth telling for its own sake."""
AROUND_M: Final = 50.0
MOST_CELLS: Final = 4096


class _Answered(NamedTuple):
    """The last answer with which a window had all of its area: when it was asked for, and of what map."""

    versions: object
    changes: int
    pose: Intent
    asked_s: float


class _Neighbourhood(NamedTuple):
    """Where the cells of the map lie in a region; ``boxes`` is (N, 4), metres."""

    map_version: int
    region: geometry.Box
    boxes: NDArray[np.float64]


class NothingNew:
    """Knows for certain that an answer would be empty, or does not know.

    The answer to a differential request depends on the daemon's map, its cells and their versions, and on
    which of them the area touches.  The map is the same as long as the change counter is that of before the
    last request, and the connection the same: the daemon raises it before any reply tells of a change.  A
    window that got everything then (nothing pending, nothing failed, all of the area known) and asks for an
    area that touches the same cells would get nothing.  Which cells an area touches is computed here as the
    daemon does, from the boxes of all cells around, which are asked for once in 50 m and state of the map,
    and only by a window that moves in steps so small that it pays.

    Where the counter cannot be read, because this user may not or there is none, nothing is ever certain.

    Parameters
    ----------
    client
        Whose connection it is.
    timeout_s
        How long the daemon may take to tell where cells are; None: as long as the client lets it.
    """

    def __init__(self, client: Client, timeout_s: float | None) -> None:
        self._timeout_s = timeout_s
        self._session = client.session
        self._opened_for: tuple[int, int] | None = None
        self._counter: ChangeCounter | None = None
        self._answered: _Answered | None = None
        self._around: _Neighbourhood | None = None
        self._in_vain = 0  # state of the map of which there are too many cells around

    def changes(self) -> int | None:
        """Return the counter as it is now; None where it cannot be read.  To be called before a request."""
        self._answered = None  # until the request has brought everything
        session = self._session
        opened_for = session.welcome.epoch, session.handshakes
        if opened_for != self._opened_for:
            self._counter = None
            try:
                from shmmap.client.window.change_counter import ChangeCounter  # once a daemon, not at import

                counter = ChangeCounter(session.statistics_path)
            except (OSError, ShmmapError):
                pass
            else:
                self._counter = counter if counter.epoch == session.welcome.epoch else None
            self._opened_for = opened_for
        return self._counter.read() if self._counter is not None else None

    def answered(self, changes: int | None, state: WindowState, pose: Intent, now_s: float) -> None:
        """Note what a request that was sent after ``changes`` was read brought."""
        if (
            changes is not None
            and self._counter is not None
            and self._counter.epoch == state.epoch
            and state.covered
            and not state.pending
            and not state.failed
        ):
            self._answered = _Answered(state.versions, changes, pose, now_s)

    def certain(self, state: WindowState, pose: Intent, area: geometry.Area, now_s: float) -> bool:
        """Whether asking for an area now would bring nothing to a window in this state."""
        last, counter, session, at = self._answered, self._counter, self._session, state.asked
        return (
            last is not None
            and counter is not None
            and at is not None
            and last.versions is state.versions
            and last.changes == counter.read()
            and now_s - last.asked_s < TELL_S
            and math.hypot(pose.x - last.pose.x, pose.y - last.pose.y) < TELL_M
            and pose.route == last.pose.route
            and session.lost_since is None
            and (session.welcome.epoch, session.handshakes) == self._opened_for
            and ((pose.x == at.x and pose.y == at.y) or self._touches_the_same(state, area))
        )

    def _touches_the_same(self, state: WindowState, area: geometry.Area) -> bool:
        around = self._around
        if around is None or around.map_version != state.map_version or not _inside(area, around.region):
            around = self._look_around(state.map_version, area)
        if around is None or state.area is None or not _inside(state.area, around.region):
            return False
        return np.array_equal(state.area.overlaps(around.boxes), area.overlaps(around.boxes))

    def _look_around(self, map_version: int, area: geometry.Area) -> _Neighbourhood | None:
        if self._in_vain == map_version:
            return None
        from shmmap.client.map_listing import list_cells  # with `array`: not at import

        self._around = None
        min_x, min_y, max_x, max_y = area.bounds
        region = geometry.Box(min_x - AROUND_M, min_y - AROUND_M, max_x + AROUND_M, max_y + AROUND_M)
        try:
            listing = list_cells(self._session, region, None, self._timeout_s)
        except ShmmapError:
            return None
        if len(listing) > MOST_CELLS:
            self._in_vain = listing.map_version
        elif listing.map_version == map_version:
            self._around = _Neighbourhood(map_version, region, listing.boxes)
        return self._around


def says_more(pose: Intent, told: Intent) -> bool:
    """Whether a pose says more of where a client goes than what the daemon was told last."""
    return (
        pose.route != told.route
        or math.hypot(pose.vx - told.vx, pose.vy - told.vy) >= TELL_MPS
        or math.hypot(pose.x - told.x, pose.y - told.y) >= TELL_M
    )


def _inside(area: geometry.Area, region: geometry.Box) -> bool:
    bounds = area.bounds
    return (
        region.min_x <= bounds[0]
        and region.min_y <= bounds[1]
        and bounds[2] <= region.max_x
        and bounds[3] <= region.max_y
    )
