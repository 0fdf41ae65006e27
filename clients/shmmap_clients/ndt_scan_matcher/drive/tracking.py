# SPDX-License-Identifier: Apache-2.0
"""Whether a vehicle is still followed, or lost.

::

    uncertain --trusted--> tracking --not trusted--> uncertain --not trusted, again and again--> lost
    tracking, uncertain --no map--> lost
    lost --trusted, or relocalized--> tracking

A drive begins ``uncertain``, or ``lost`` where its first pose is only roughly known.
"""

from __future__ import annotations

from typing import Final, Literal

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.matching.result import Result

__all__ = ["LOST_AFTER", "State", "Tracking"]

State = Literal["tracking", "uncertain", "lost"]

LOST_AFTER: Final = 5  # as many rejected poses make Autoware's ndt_scan_matcher report an error


class Tracking:
    """The state after each result.

    Parameters
    ----------
    lost_after
        So many results in a row that are not trusted, and the vehicle is lost; one without a map suffices.
    lost
        Whether it is lost at the beginning.
    """

    def __init__(self, lost_after: int = LOST_AFTER, *, lost: bool = False) -> None:
        if lost_after < 1:
            raise BadRequest(f"lost_after must be positive, it is {lost_after}")
        self._lost_after = lost_after
        self._untrusted = 0
        self.state: State = "lost" if lost else "uncertain"

    def update(self, result: Result) -> State:
        """Take in the next result; returns the state."""
        if result.trustworthy:
            self._untrusted = 0
            self.state = "tracking"
            return self.state
        self._untrusted += 1
        if self.state != "lost":
            lost = result.no_map or self._untrusted >= self._lost_after
            self.state = "lost" if lost else "uncertain"
        return self.state
