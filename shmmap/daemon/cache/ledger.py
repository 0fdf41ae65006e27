# SPDX-License-Identifier: Apache-2.0
"""Accounting of memory: which segments exist, what they take, and whether more fits; without any I/O.

Every byte is in exactly one state: *resident* (a named segment that can be handed out), *retired* (out of
service, perhaps still mapped), or *reserved* (promised to a load).  The sum never exceeds the budget: a load
starts only when its reservation fits.

Times are seconds on any one clock, injected by the caller.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Final

from shmmap.daemon.records import Key, Resident, Retired
from shmmap.daemon.travel.places import SQUARE_M
from shmmap.large_tables import ShardedDict

_PLACES: Final = 1 << 32
MAX_NEW: Final = 32
"""Segments that are known to have come into question; of more, only that there are more."""
DUE_PER_CALL: Final = 16
IN_USE_S: Final = 0.2
"""How long, at least, a segment found in use is left alone.  The time doubles with each look if the kernel
reports when a process closes the segment."""
MAX_IN_USE_S: Final = 5.0
"""... and how long at most: a precaution."""
SHARE_S: Final = 0.0005
"""Minimum time between two looks when very many segments are mapped (a look takes 15 us)."""
_NEVER: Final = (0.0, 0.0, 0)


class Segments:
    """All segments in memory, for walks that take several turns while segments are added and removed."""

    def __init__(self) -> None:
        self._by_size: list[list[Resident]] = [[] for _ in range(64)]
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, resident: Resident) -> None:
        """Add a segment."""
        alike = self._by_size[resident.nbytes.bit_length()]
        resident.place = len(alike)
        alike.append(resident)
        self._count += 1

    def remove(self, resident: Resident) -> None:
        """Remove a segment."""
        alike = self._by_size[resident.nbytes.bit_length()]
        last = alike.pop()
        if last is not resident:  # the last segment moves to the freed place
            alike[resident.place], last.place = last, resident.place
        self._count -= 1

    def walk(self) -> Iterator[Resident]:
        """Yield all segments that exist now and stay, larger ones first (to a factor of two).

        Segments added during the walk may be left out; segments that stay may be yielded twice.
        """
        for alike in reversed(self._by_size):
            at = len(alike)
            while (at := min(at, len(alike)) - 1) >= 0:  # from the end: what fills a gap was yielded
                yield alike[at]

    def page(self, start: int, most: int) -> tuple[list[Resident], int | None]:
        """Return the next ``most`` segments in the order of `walk`, and where the next page starts.

        Parameters
        ----------
        start
            0, or what the last page gave: a size, shifted by 32 bits, and how many of that size are left.
        """
        size, left = divmod(start, _PLACES) if start > 0 else (len(self._by_size), 0)
        found: list[Resident] = []
        for at in range(min(size, len(self._by_size) - 1), -1, -1):
            alike = self._by_size[at]
            end = min(left, len(alike)) if at == size else len(alike)
            begin = max(end - most + len(found), 0)
            found += alike[begin:end][::-1]  # as in a walk, what fills a gap was given
            if len(found) == most:
                return found, at * _PLACES + begin
        return found, None


class Square:
    """The segments in service whose middle lies in one square of the map.

    Attributes
    ----------
    middle : (float, float)
        Of the square, metres, map frame.
    largest : int
        Bytes of the largest segment, or more.
    oldest_s : float
        When the one unused for longest was last used, or before.
    may_be_spare : bool
        Whether one may have been loaded into spare memory.
    """

    __slots__ = ("largest", "may_be_spare", "middle", "oldest_s", "segments")

    def __init__(self, x: float, y: float) -> None:
        self.middle = (x + 0.5) * SQUARE_M, (y + 0.5) * SQUARE_M
        self.segments: dict[Resident, None] = {}
        self.forget()

    def forget(self) -> None:
        """Forget what is known of its segments."""
        self.largest, self.oldest_s, self.may_be_spare = 0, math.inf, False

    def learn(self, some: Iterable[Resident]) -> None:
        """Note what is known of segments that are in it."""
        for one in some:
            self.largest = max(self.largest, one.nbytes)
            self.oldest_s = min(self.oldest_s, one.last_use_s)
            self.may_be_spare |= one.spare


class Evictable:
    """The segments in service, and what has changed about which of them can be evicted.

    Attributes
    ----------
    new : dict
        Segments that entered service or were released since the last plan was begun, up to `MAX_NEW`.
    has_more : bool
        Whether there are more of them.
    changes : int
        How often that happened.
    """

    def __init__(self) -> None:
        self.changes = 0
        self.new: dict[Resident, None] = {}
        self.has_more = False
        self._squares: ShardedDict[tuple[float, float], Square] = ShardedDict()
        self._in_use: ShardedDict[Resident, tuple[float, float, int]] = ShardedDict()
        self._heap: list[tuple[float, int, Resident]] = []
        self._number = self._released_at = 0

    def enter(self, resident: Resident) -> None:
        """Note that a segment entered service."""
        x0, y0, x1, y1 = resident.box
        resident.square = key = (x0 + x1) // (2.0 * SQUARE_M), (y0 + y1) // (2.0 * SQUARE_M)
        square = self._squares.get(key)
        if square is None:
            square = self._squares[key] = Square(*key)
        square.segments[resident] = None
        square.learn((resident,))
        self.add(resident)

    def add(self, resident: Resident) -> None:
        """Note that a segment has come into question: it is new, or something needs it no more."""
        self._list(resident)
        self.changes += 1

    def _list(self, resident: Resident) -> None:
        if len(self.new) < MAX_NEW:
            self.new[resident] = None
        else:
            self.has_more = True

    def leave(self, resident: Resident) -> None:
        """Forget a segment that left service."""
        segments = self._squares[resident.square].segments
        del segments[resident]
        if not segments:
            del self._squares[resident.square]
        self.new.pop(resident, None)
        self._in_use.pop(resident, None)

    def take_new(self) -> list[Resident]:
        """Return the segments that have come into question, as far as known; they are not new then."""
        some, self.has_more = list(self.new), False
        self.new.clear()
        return some

    def squares(self) -> Iterator[Square]:
        """Yield the squares with segments that are there now and stay."""
        for key in self._squares.walk():
            square = self._squares.get(key)
            if square is not None:
                yield square

    # --- what was found in use ----------------------------------------------------------------------

    def _found(self, resident: Resident) -> tuple[float, float]:
        """Return until when a segment is left alone that was found in use, and how long that is; else 0."""
        until_s, for_s, number = self._in_use.get(resident, _NEVER)
        return (until_s, for_s) if number > self._released_at else _NEVER[:2]

    def release(self, resident: Resident) -> bool:
        """Note that a user has released a segment; return whether it had been found in use."""
        was_in_use = self._found(resident)[1] > 0.0
        self._in_use.pop(resident, None)
        self.add(resident)
        return was_in_use

    def release_all(self) -> None:
        """Note that any segment that was found in use may have been released."""
        self._released_at, self.has_more = self._number, True
        self.changes += 1

    def found_in_use(self, resident: Resident, now_s: float, *, is_watched: bool) -> None:
        """Leave a segment alone for a while; ``is_watched``: the kernel reports its next close."""
        for_s = min(max(IN_USE_S, 2.0 * self._found(resident)[1] * is_watched), MAX_IN_USE_S)
        until_s = now_s + max(for_s, SHARE_S * len(self._in_use))
        self._number += 1
        self._in_use[resident] = until_s, for_s, self._number
        heapq.heappush(self._heap, (until_s, self._number, resident))

    def is_left_alone(self, resident: Resident, now_s: float) -> bool:
        """Whether a segment was found in use a moment ago."""
        return now_s < self._found(resident)[0]

    def next_look_s(self) -> float:
        """Return when the first of the segments found in use is looked at again, at the earliest."""
        return self._heap[0][0] if self._heap else math.inf

    def look_again(self, now_s: float) -> None:
        """Consider some of the segments again that have been left alone for long enough."""
        for _ in range(DUE_PER_CALL):
            if self.next_look_s() > now_s:
                break
            _, number, resident = heapq.heappop(self._heap)
            if self._in_use.get(resident, _NEVER)[2] != number:
                continue  # it left, was released, or was found in use again
            if number > self._released_at:
                self._list(resident)
            else:
                del self._in_use[resident]


class Ledger:
    """Memory accounting of one daemon.

    Parameters
    ----------
    budget_bytes
        Limit of resident, retired and reserved bytes together.

    Attributes
    ----------
    by_key
        Segments that can be handed out.
    retired : dict
        Segments out of service, by their original name.
    segments
        All segments in memory, retired ones included.
    evictable
        The segments in service, and what has changed about which of them can be evicted.
    retired_bytes, freeing_bytes
        Memory of retired segments, and the part of it that the kernel is taking back now.
    unopened_bytes
        Bytes of retired segments that no process had open when last checked.
    overhead_bytes
        Shared memory of the daemon itself (its statistics); counts as used.
    set_aside_bytes
        Segments of a previous run that can only be judged when more of the map is known; count as used.
    prefetched, prefetched_bytes
        Prefetched segments that no client has asked for yet, and their memory.
    unchecked_count
        Number of residents of a previous run that have not been checked yet.
    """

    def __init__(self, budget_bytes: int) -> None:
        self.budget_bytes = budget_bytes
        self.by_key: ShardedDict[Key, Resident] = ShardedDict()
        self.retired: dict[str, Retired] = {}
        self.resident_bytes = 0
        self.segments = Segments()
        self.evictable = Evictable()
        self.retired_bytes = 0
        self.freeing_bytes = 0
        self.unopened_bytes = 0
        self.reserved_bytes = 0
        self.overhead_bytes = 0
        self.set_aside_bytes = 0
        self.prefetched_bytes = 0
        self.prefetched: dict[Resident, None] = {}
        self.unchecked_count = 0
        self._by_name: ShardedDict[str, Resident] = ShardedDict()
        self._needed: dict[Key, int] = {}
        self._layers: Counter[str] = Counter()

    # --- sums ---------------------------------------------------------------------------------

    @property
    def used_bytes(self) -> int:
        """Resident, retired, reserved and set-aside bytes, plus the daemon's own overhead."""
        in_memory = self.resident_bytes + self.retired_bytes + self.set_aside_bytes
        return in_memory + self.reserved_bytes + self.overhead_bytes

    def shortage(self, nbytes: int) -> int:
        """Return how many bytes must be freed before ``nbytes`` more fit; 0 or less if they fit."""
        return self.used_bytes + nbytes - self.budget_bytes

    def reserve(self, nbytes: int) -> bool:
        """Promise bytes to a load; return False if they do not fit."""
        fits = nbytes <= 0 or self.shortage(nbytes) <= 0
        self.reserved_bytes += nbytes if fits else 0
        return fits

    def fits_at_all(self, nbytes: int) -> bool:
        """Whether ``nbytes`` fit beside the daemon's own overhead once everything else is evicted."""
        return nbytes + self.overhead_bytes <= self.budget_bytes

    @property
    def resident_count(self) -> int:
        """Number of segments that can be handed out."""
        return len(self._by_name)

    def residents(self) -> Iterator[Resident]:
        """Return all segments that can be handed out."""
        return iter(self._by_name.values())

    def resident_named(self, name: str) -> Resident | None:
        """Return the segment of that name, if it can be handed out."""
        return self._by_name.get(name)

    def of_cell(self, cell_id: str) -> list[Resident]:
        """Return the segments of one cell, in all layers, that can be handed out."""
        found = (self.by_key.get(Key(cell_id, layer)) for layer in self._layers)
        return [resident for resident in found if resident is not None]

    def layers(self) -> Iterable[str]:
        """Return the layers that have segments to hand out."""
        return self._layers.keys()

    @property
    def cell_count(self) -> int:
        """Number of cells with a segment to hand out, in the layer that has most."""
        return max(self._layers.values(), default=0)

    @property
    def coming_bytes(self) -> int:
        """Memory that is about to be free."""
        return self.unopened_bytes + self.freeing_bytes

    # --- being needed ---------------------------------------------------------------------------

    def need(self, key: Key) -> None:
        """Protect a key from eviction: a waiting request or an operator's pin needs it."""
        self._needed[key] = self._needed.get(key, 0) + 1

    def need_no_more(self, key: Key) -> None:
        """Undo one `need`."""
        count = self._needed.pop(key) - 1
        if count:
            self._needed[key] = count
        elif key in self.by_key:
            self.evictable.add(self.by_key[key])

    def needed(self) -> Iterable[Key]:
        """Return the keys that requests or pins need."""
        return self._needed.keys()

    def is_needed(self, key: Key) -> bool:
        """Whether a request or pin needs a key."""
        return key in self._needed

    # --- coming ---------------------------------------------------------------------------------

    def enter(self, resident: Resident) -> Resident | None:
        """Put a segment into service; return the version that it supersedes, to be retired by name."""
        old = self.by_key.get(resident.key)
        self.by_key[resident.key] = self._by_name[resident.name] = resident
        self._layers[resident.key.layer] += 1
        self.resident_bytes += resident.nbytes
        self.unchecked_count += not resident.checked
        if resident.prefetched:
            self.prefetched[resident] = None
            self.prefetched_bytes += resident.nbytes
        self.segments.add(resident)
        self.evictable.enter(resident)
        if old is not None:
            self._leave_service(old)
        return old

    def checked(self, resident: Resident) -> None:
        """Note that a segment of a previous run passed its check: it can be handed out."""
        resident.checked = True
        self.unchecked_count -= 1

    def asked_for(self, resident: Resident) -> None:
        """Note that a client asked for a prefetched segment."""
        self._not_ahead(resident)
        resident.prefetched = False

    def _not_ahead(self, resident: Resident) -> None:
        if resident in self.prefetched:
            del self.prefetched[resident]
            self.prefetched_bytes -= resident.nbytes

    # --- leaving --------------------------------------------------------------------------------

    def _leave_service(self, resident: Resident) -> None:
        del self._by_name[resident.name]
        self._layers[resident.key.layer] -= 1
        if not self._layers[resident.key.layer]:
            del self._layers[resident.key.layer]
        self.unchecked_count -= not resident.checked
        self._not_ahead(resident)
        self.resident_bytes -= resident.nbytes
        self.evictable.leave(resident)
        self.retired_bytes += resident.nbytes
        self.retired[resident.name] = Retired(resident)

    def add_retired(self, resident: Resident) -> Retired:
        """Count a segment that a previous run of the daemon took out of service."""
        self.segments.add(resident)
        self.retired_bytes += resident.nbytes
        retired = self.retired[resident.name] = Retired(resident)
        return retired

    def rename(self, resident: Resident, name: str) -> None:
        """Change the name of a segment."""
        if resident.name in self._by_name:
            self._by_name[name] = self._by_name.pop(resident.name)
        else:
            self.retired[name] = self.retired.pop(resident.name)
        resident.name = name

    def retire(self, resident: Resident) -> None:
        """Take a segment out of service; its bytes count until `freed`."""
        if self.by_key.get(resident.key) is resident:
            del self.by_key[resident.key]
        self._leave_service(resident)

    def revive(self, retired: Retired) -> Resident | None:
        """Put a retired segment back into service.

        Return the version that it supersedes, to be retired by name (the map went back to an
        earlier state).
        """
        self._gone(retired.resident.name)
        self.retired_bytes -= retired.resident.nbytes
        return self.enter(retired.resident)

    def mark_unopened(self, retired: Retired, unopened: bool) -> None:
        """Note whether no process had a retired segment open when last checked."""
        self.unopened_bytes += retired.resident.nbytes * (unopened - retired.unopened)
        retired.unopened = unopened

    def freed(self, name: str) -> int:
        """Stop counting a retired segment whose memory the kernel has taken back; return its bytes."""
        nbytes = self._gone(name)
        self.retired_bytes -= nbytes
        return nbytes

    def freeing(self, name: str) -> int:
        """Note that the kernel is taking back a retired segment's memory; it counts until `closed`."""
        nbytes = self._gone(name)
        self.freeing_bytes += nbytes
        return nbytes

    def closed(self, nbytes: int) -> None:
        """Stop counting bytes that the kernel has finished taking back."""
        self.freeing_bytes -= nbytes
        self.retired_bytes -= nbytes

    def _gone(self, name: str) -> int:
        retired = self.retired[name]
        self.mark_unopened(retired, False)
        del self.retired[name]
        self.segments.remove(retired.resident)
        return retired.resident.nbytes
