# SPDX-License-Identifier: Apache-2.0
"""Which cell is fetched next before anybody asks: of all clients' ways, what is needed first.

Nothing here loads or waits: `Prefetcher` asks for a wish when no demand waits for a loader (`Prefetch.next`),
and tells how loads ended.  How far ahead is looked, in seconds of travel, is the longest
outage of the origin that is to be bridged, and what a load takes, slow ones included.  Where nobody
knows the way, an outage is prepared for only after there was one, or on a long straight: much of that is
fetched in vain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Final, NamedTuple

from shmmap.daemon.loading.prefetch.origin_health import OriginHealth
from shmmap.daemon.loading.prefetch.way_ahead import PASS_S, LookAhead, WayAhead
from shmmap.daemon.map.catalogue_view import CatalogueView

__all__ = ["URGENT_S", "Prefetch", "Wish"]

COMPARED_AT_ONCE: Final = 64
"""Ways, and cells on them, that are compared at a time: for a wish of more clients it takes some turns."""
LOOKS_AT_ONCE: Final = 2
"""Steps along clients' ways that are looked at for one wish: a fifth of a millisecond."""
SLOW_LOADS: Final = 1.6
"""So many, one after the other, a cell may have to wait for."""
SLACK_S: Final = 3.0
"""Beside all that is measured: requests come a step of the window apart, and so do looks along the way."""
SPARE: Final = 1.25
"""What was used up in an outage comes back slowly; until it has, cells come just in time or a little late."""
AFTER_S: Final = 2.0
"""Until loads are known to succeed again after they did not, and the first ones have come."""
GUESSED_S: Final = 10.0
"""Nobody goes straight on for longer than this."""
URGENT_S: Final = 2.0
"""What is needed sooner is a demand in all but name: it takes the loader, too, that is kept for those."""
SHORTEST_STEP_M: Final = 5.0


class Wish(NamedTuple):
    """One layer of a cell that somebody will ask for."""

    cell: int
    layer: str
    needed_in_s: float


class Prefetch:
    """Chooses what is fetched ahead.

    Parameters
    ----------
    is_absent
        Whether a layer of a cell, by index, is neither in memory nor being loaded, and may be tried.
    outage_tolerance_s
        For so long the origin may be away without anybody's noticing.

    Attributes
    ----------
    ways : dict
        Clients' ways, by whom.
    health
        What loads tell of the origin.
    more : bool
        Whether asking again at once may bring a wish, though the last time brought none.
    """

    def __init__(self, is_absent: Callable[[int, str], bool], outage_tolerance_s: float) -> None:
        self._is_absent = is_absent
        self._outage_tolerance_s = outage_tolerance_s
        self._catalogue: CatalogueView | None = None
        self.ways: dict[Hashable, WayAhead] = {}
        self.health = OriginHealth()
        self.more = False
        self._out_since_s = math.inf
        self._away_s = 0.0
        self._left: list[WayAhead] = []  # not compared yet for the next wish
        self._behind: WayAhead | None = None  # of those compared: known least far
        self._chosen: WayAhead | None = None  # ... and what is needed first, and whose it is
        self._best: Wish | None = None

    @property
    def look_ahead(self) -> LookAhead:
        """How far ahead is looked: what comes into reach later is not wished for yet."""
        load_s = SLOW_LOADS * self.health.slow_s + SLACK_S
        way_s = load_s + SPARE * self._outage_tolerance_s + PASS_S + AFTER_S
        straight_s = load_s + min(self._outage_tolerance_s, self._away_s, GUESSED_S)
        return LookAhead(way_s, straight_s, load_s)

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return what is needed first of what is absent; None if nothing is, or not known yet (`more`)."""
        self.more = False
        is_back = self._is_back(now_s)
        if is_back or catalogue is not self._catalogue:
            self._left = []
            # indices mean other cells now, or what was passed over because it had failed may be tried
            self._catalogue = catalogue
            for way in self.ways.values():
                way.begin(now_s)
        if now_s < self.health.next_try_s():
            return None
        step_m = max(SHORTEST_STEP_M, 0.5 * min(catalogue.mean_size))
        for _ in range(LOOKS_AT_ONCE):
            if not self._compare_some(now_s):
                self.more = True
                return None
            behind, chosen, wish = self._behind, self._chosen, self._best
            if wish is not None and (behind is None or behind is chosen or not _is_before(behind, wish)):
                if self._is_absent(wish.cell, wish.layer):
                    self.health.tried(now_s)
                    return wish
            elif behind is None:
                return None
            else:
                behind.look(catalogue, self.look_ahead, step_m)
        self.more = True
        return None

    def restart(self) -> None:
        """Begin all paths from the start: more of the map on them is known now."""
        self._catalogue = None

    def _compare_some(self, now_s: float) -> bool:
        """Look at some ways: which is known least far, which has the first wish; True after the last."""
        if not self._left:
            self._left = list(self.ways.values())
            self._behind = self._chosen = self._best = None
        for _ in range(COMPARED_AT_ONCE):
            if not self._left:
                return True
            way = self._left[-1]
            self._begin_if_due(way, now_s)
            if (first := way.first()) is not None:
                needed_in_s, index = first
                absent = [layer for layer in way.layers if self._is_absent(index, layer)]
                if not absent:
                    way.take()
                    continue
                if self._best is None or needed_in_s < self._best.needed_in_s:
                    self._chosen, self._best = way, Wish(index, absent[0], needed_in_s)
            least = self._behind
            if not way.over and (least is None or way.ahead_m * way.pace_s < least.ahead_m * least.pace_s):
                self._behind = way
            self._left.pop()
        return not self._left

    def _is_back(self, now_s: float) -> bool:
        """Whether loads succeed again; and for how long they did not."""
        if self.health.is_out:
            # a silent server is noticed late: it was already away when the failed loads began
            self._out_since_s = min(self._out_since_s, now_s - self.health.waited_s)
            return False
        if self._out_since_s == math.inf:
            return False
        away_s, self._out_since_s = now_s - self._out_since_s, math.inf
        if away_s > SLACK_S:  # a single lost answer does not show how long outages are
            self._away_s = max(away_s, 0.5 * self._away_s)
        return True

    def _begin_if_due(self, way: WayAhead, now_s: float) -> None:
        """Have a way looked over again, if it is time."""
        due = now_s - way.began_s >= PASS_S and (way.over or way.first() is not None)
        if way.moves and (due or way.has_jumped):
            way.begin(now_s)

    def next_s(self, now_s: float) -> float:
        """When to ask again though nothing happens."""
        if not any(way.moves for way in self.ways.values()):
            return math.inf
        if self.health.is_out:
            return self.health.next_try_s()
        return min(way.began_s + PASS_S if way.over else now_s for way in self.ways.values() if way.moves)


def _is_before(way: WayAhead, wish: Wish) -> bool:
    """Whether a way that is still looked over may have a wish before this one."""
    return way.ahead_m * way.pace_s < wish.needed_in_s
