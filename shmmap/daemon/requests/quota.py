# SPDX-License-Identifier: Apache-2.0
"""The quota of a session: how much it may keep in memory that nobody else keeps, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.records import Key
from shmmap.daemon.cache.reclaimer import HAND_OUT_GRACE_S
from shmmap.daemon.requests.pending_request import PendingRequest
from shmmap.daemon.transport.sessions import Session
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["SessionQuota"]


class SessionQuota:
    """Refuses what would exceed it, cell by cell.

    Parameters
    ----------
    nbytes
        Most bytes one session may keep that no other session also holds.
    clock
        The serving loop's clock, seconds.
    """

    def __init__(
        self, nbytes: int, cache: CellCache, statistics: StatisticsWriter, clock: Callable[[], float]
    ) -> None:
        self._nbytes = nbytes
        self._cache = cache
        self._statistics = statistics
        self._now_s = clock

    def is_out_of_reach(self, session: Session) -> bool:
        """Whether the session could have everything that is in memory."""
        return session.held_bytes + self._cache.ledger.resident_bytes <= self._nbytes

    def check(self, wanted: PendingRequest, cold: Sequence[tuple[int, str]]) -> None:
        """Note in ``wanted.refused`` what is too much, farthest cells first; ``cold`` is not in memory."""
        session, cache, warm = wanted.session, self._cache, self._cache.warm.layers
        if self.is_out_of_reach(session) and not cold:
            return
        chilled = set(cold)
        sizes = [
            cache.estimate(index, layer) if (index, layer) in chilled else warm[layer][index].nbytes
            for index, layer in wanted.cells
        ]
        if session.held_bytes + sum(sizes) <= self._nbytes:
            return
        cache.survey.drop_unused(session, self._now_s() - HAND_OUT_GRACE_S)
        left = self._nbytes - session.exclusive_bytes()
        # a new version takes the place of the old one that its holder is about to drop
        replaced = {r.key: r.nbytes for r in session.residents() if not cache.is_current(r)}
        boxes = cache.catalogue.boxes[np.array([index for index, _ in wanted.cells], dtype=np.intp)]
        counted: set[tuple[int, str]] = set()
        for position in np.argsort(wanted.distances_m(boxes), kind="stable").tolist():
            index, layer = wanted.cells[position]
            if (index, layer) in counted:
                continue
            counted.add((index, layer))
            key = Key(cache.catalogue.id(index), layer)
            resident = None if (index, layer) in chilled else warm[layer][index]
            if resident is not None and resident.sessions:
                continue  # somebody keeps it anyway, perhaps this session itself
            left -= sizes[position] - replaced.get(key, 0)
            if left < 0:
                message = (
                    f"this client would keep more than {self._nbytes} bytes (its quota) for itself alone"
                )
                wanted.refused[key] = ("over_budget", message)
                self._statistics.add("refused_quota")
                cache.events.pressure.refused(cache.wire_id(key.cell_id), layer, "quota", self._now_s())
