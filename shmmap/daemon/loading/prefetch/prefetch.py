# SPDX-License-Identifier: Apache-2.0
"""Which cell is fetched next before anybody asks: of all clients' ways, what is needed first.

Nothing here loads or waits: `Prefetcher` asks for a wish when no demand waits for a loader (`Prefetch.next`),
and tells how loads ended.  How far ahead is looked, in seconds of travel, is the longest
time without the origin that is to be ridden out, and what a load takes, slow ones included.  Where nobody
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
    ride_out_s
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

    def __init__(self, is_absent: Callable[[int, str], bool], ride_out_s: float) -> None:
        self._is_absent = is_absent
        self._ride_out_s = ride_out_s
        self._catalogue: CatalogueView | None = None
        self.ways: dict[Hashable, WayAhead] = {}
        self.health = OriginHealth()
        self.more = False
        self._out_since_s = math.inf
        self._away_s = 0.0

    @property
    def look_ahead(self) -> LookAhead:
        """How far ahead is looked: what comes into reach later is not wished for yet."""
        load_s = SLOW_LOADS * self.health.slow_s + SLACK_S
        way_s = load_s + SPARE * self._ride_out_s + PASS_S + AFTER_S
        straight_s = load_s + min(self._ride_out_s, self._away_s, GUESSED_S)
        return LookAhead(way_s, straight_s, load_s)

    def next(self, catalogue: CatalogueView, now_s: float) -> Wish | None:
        """Return what is needed first of what is absent; None if nothing is, or not known yet (`more`)."""
        self.more = False
        is_back = self._is_back(now_s)
        if is_back or catalogue is not self._catalogue:
            # indices mean other cells now, or what was passed over because it had failed may be tried
            self._catalogue = catalogue
            for way in self.ways.values():
                way.begin(now_s)
        if now_s < self.health.next_try_s():
            return None
        step_m = max(SHORTEST_STEP_M, 0.5 * min(catalogue.mean_size))
        for _ in range(LOOKS_AT_ONCE):
            behind = self._least_far(now_s)
            wish = self._first(behind)
            if wish is not None:
                self.health.tried(now_s)
                return wish
            if behind is None:
                return None
            behind.look(catalogue, self.look_ahead, step_m)
        self.more = True
        return None

    def _is_back(self, now_s: float) -> bool:
        """Whether loads succeed again; and for how long they did not."""
        if self.health.is_out:
            self._out_since_s = min(self._out_since_s, now_s)
            return False
        if self._out_since_s == math.inf:
            return False
        self._away_s = max(now_s - self._out_since_s, 0.5 * self._away_s)
        self._out_since_s = math.inf
        return True

    def _least_far(self, now_s: float) -> WayAhead | None:
        """The way of which least is known ahead; None if all were looked over."""
        least: WayAhead | None = None
        for way in self.ways.values():
            due = now_s - way.began_s >= PASS_S and (way.over or way.first() is not None)
            if way.moves and (due or way.has_jumped):
                way.begin(now_s)
            if not way.over and (least is None or way.ahead_m * way.pace_s < least.ahead_m * least.pace_s):
                least = way
        return least

    def _first(self, behind: WayAhead | None) -> Wish | None:
        """The first wish, if no way that is still looked over can have an earlier one."""
        best: Wish | None = None
        chosen: WayAhead | None = None
        for way in self.ways.values():
            while (first := way.first()) is not None:
                absent = [layer for layer in way.layers if self._is_absent(first[1], layer)]
                if absent:
                    if best is None or first[0] < best.needed_in_s:
                        best, chosen = Wish(first[1], absent[0], first[0]), way
                    break
                way.take()
        if chosen is None or best is None:
            return None
        if behind is not None and behind is not chosen and behind.ahead_m * behind.pace_s < best.needed_in_s:
            return None
        return best

    def next_s(self, now_s: float) -> float:
        """When to ask again though nothing happens."""
        if not any(way.moves for way in self.ways.values()):
            return math.inf
        if self.health.is_out:
            return self.health.next_try_s()
        return min(way.began_s + PASS_S if way.over else now_s for way in self.ways.values() if way.moves)
