# SPDX-License-Identifier: Apache-2.0
"""A window without a thread: everything happens in the call that moves it."""

from __future__ import annotations

import time
from typing import Final

from shmmap.client.window.follower import PENDING_WAIT_S
from shmmap.client.window.refresh import WindowRefresher
from shmmap.client.window.state import EMPTY, WindowState, moved
from shmmap.errors import ShmmapError
from shmmap.protocol.messages import Intent

__all__ = ["BlockingFollower"]

_WAIT_S: Final = 5.0
_FIRST_PAUSE_S: Final = 0.005  # between requests for what does not fit; doubles
_STALLED_S: Final = 0.5  # a call gives up on what does not fit after this long without progress


class BlockingFollower:
    """Keeps a window current in the thread of whoever moves it; otherwise as `WindowFollower`."""

    def __init__(
        self, refresher: WindowRefresher, *, update_distance: float, refresh_interval_s: float
    ) -> None:
        self._refresher = refresher
        self._update_distance = update_distance
        self._refresh_interval_s = refresh_interval_s
        self._pose: Intent | None = None
        self._asked_s = 0.0
        self.state = EMPTY
        self.error: ShmmapError | None = None
        self.stale_since: float | None = None

    def answers(self, state: WindowState) -> bool:
        """Whether a state answers the latest pose."""
        return self._pose is not None and not moved(state, self._pose, self._update_distance)

    def move(self, pose: Intent, wait_s: float | None) -> WindowState:
        """Take a new pose, ask until nothing is missing, nothing more comes, or time is up.

        Raises
        ------
        ShmmapError
            The daemon cannot be asked; the state stays as it was.
        """
        self._pose = pose
        try:
            self._refresh(pose, _WAIT_S if wait_s is None else wait_s)
        except ShmmapError as error:
            self.error = error
            if self.stale_since is None:
                self.stale_since = time.monotonic()
            raise
        return self.state

    def wait_until_current(self, timeout_s: float) -> WindowState | None:  # noqa: ARG002
        """Return the state if it answers the latest pose and nothing is missing; waiting changes nothing."""
        state = self.state
        asked_in_vain = self.error is not None or self._refresher.lost
        return state if self.answers(state) and state.settled and not asked_in_vain else None

    def stop(self) -> None:
        """Do nothing: there is no thread."""

    def _refresh(self, pose: Intent, wait_s: float) -> None:
        now_s = time.monotonic()
        state = self.state
        due = now_s - self._asked_s >= self._refresh_interval_s or self.error is not None
        due = due or now_s >= self._refresher.tell_at_s(pose)
        if state.settled and not due and not moved(state, pose, self._update_distance):
            return
        deadline_s = now_s + wait_s
        progress_s = now_s
        pause_s = _FIRST_PAUSE_S
        del state  # the last reference to what is replaced may be this one
        patience_s: float | None = None
        while True:
            after, progress = self._refresher.refresh(self.state, pose, patience_s)
            self.state = after
            self.error = self.stale_since = None
            self._asked_s = now_s = time.monotonic()
            if after.settled or now_s >= deadline_s:
                return
            if progress or after.pending:
                progress_s, pause_s = now_s, _FIRST_PAUSE_S
            elif now_s - progress_s >= _STALLED_S:
                return  # what is missing waits for memory that others have
            else:
                time.sleep(min(pause_s, deadline_s - now_s))  # what was just dropped has to be freed
                pause_s *= 2
            del after
            patience_s = max(0.0, min(PENDING_WAIT_S, deadline_s - now_s))
