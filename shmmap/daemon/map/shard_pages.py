# SPDX-License-Identifier: Apache-2.0
"""The shards of a published map: fetched by threads, and served as pages of its list of cells."""

from __future__ import annotations

import bisect
import contextlib
import heapq
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.map.arrivals import Arrivals
from shmmap.daemon.map.catalogue_view import PageNews, Pages
from shmmap.errors import BadRequest, MapDataError, Offline, ShmmapError
from shmmap.geometry import Area, distance_to_boxes
from shmmap.large_tables import ShardedDict
from shmmap.logfmt import log
from shmmap.origin.remote.map_versions import read_shard_object
from shmmap.origin.remote.published_index import Root, Shard, unpack_shard
from shmmap.origin.remote.store import ObjectReader
from shmmap.origin.remote.transport import reporting_bytes
from shmmap.origin.remote.zstd_frame import DAMAGED

THREADS: Final = 8
BACKGROUND_FETCHES: Final = 2
"""Limit of concurrent fetches of pages that nothing needs yet."""
FEW_SHARDS: Final = 16
"""Up to this number of shards, all are fetched at the start, and kept."""
NAME_BYTES: Final = 150
"""Memory of a cell's name with its entry in the table of names."""
NAME_TABLES: Final = 64
"""Names are distributed over many dicts: a single one would stop the loop whenever it grows."""
BACKGROUND: Final = 1e15
"""Priority of pages that nothing needs yet: after all needed ones."""
NAMED: Final = 3
"""Cells with the same base name that an error lists."""


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """A shard in memory; ``first`` is the index of its first cell, ``versions`` are 0 until computed."""

    number: int
    shard: Shard
    first: int
    versions: NDArray[np.uint64]
    nbytes: int
    has_folders: bool

    @classmethod
    def of(cls, number: int, shard: Shard, first: int) -> Page:
        """Return the page of a shard."""
        arrays: list[NDArray[Any]] = [shard.boxes, shard.z, shard.points]
        for layer in shard.layers.values():
            arrays += [layer.sizes, layer.raws, layer.hashes, layer.contents]
        nbytes = sum(int(array.nbytes) for array in arrays) + (8 + NAME_BYTES) * len(shard)
        has_folders = any(b"/" in name for name in shard.names)
        return cls(number, shard, first, np.zeros(len(shard), np.uint64), nbytes, has_folders)


def _shared_out(page: Page) -> list[dict[bytes, int]]:
    """Return the indices of a page's cells by name, for each table of names."""
    tables: list[dict[bytes, int]] = [{} for _ in range(NAME_TABLES)]
    for index, name in enumerate(page.shard.names, page.first):
        tables[hash(name) % NAME_TABLES][name] = index
    return tables


class ShardFetcher:
    """Fetches shards of published maps in a few threads, most urgent first; verifies and decodes them.

    Parameters
    ----------
    failed
        Called, in a thread, when a fetch has failed.
    arrivals
        Counts what is being fetched and what has come.
    """

    def __init__(self, objects: ObjectReader, failed: Callable[[], None], arrivals: Arrivals) -> None:
        self._objects, self._arrivals = objects, arrivals
        self._failed = failed
        self._condition = threading.Condition()
        self._wanted: list[tuple[float, int, weakref.ref[ShardPages], int]] = []
        self._under_way: set[tuple[int, int]] = set()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._count = 0
        self._closed = False

    def want(self, pages: ShardPages, number: int, priority: float) -> None:
        """Request a shard unless it is being fetched; shards with the lowest priority come first.

        A shard that is requested again with a lower priority may be delivered twice.
        """
        with self._condition:
            if (id(pages), number) in self._under_way:
                return
            self._count += 1
            heapq.heappush(self._wanted, (priority, self._count, weakref.ref(pages), number))
            self._condition.notify()
            if self._idle < len(self._wanted) and len(self._threads) < THREADS:
                thread = threading.Thread(target=self._run, name="shards", daemon=True)
                try:
                    thread.start()
                except RuntimeError:  # the limit of threads is reached
                    return
                self._threads.append(thread)

    def _run(self) -> None:
        while (taken := self._take()) is not None:
            reference, number = taken
            pages = reference()
            if pages is None:  # its version is no longer served
                continue
            key = id(pages), number
            with self._condition:
                if key in self._under_way:
                    continue
                self._under_way.add(key)
            shard = self._fetch(pages.root, number)
            with self._condition:
                self._under_way.discard(key)
            pages.deliver(number, shard)
            del pages
            if shard is None:
                self._failed()

    def _take(self) -> tuple[weakref.ref[ShardPages], int] | None:
        with self._condition:
            self._idle += 1
            while not self._wanted and not self._closed:
                self._condition.wait()
            self._idle -= 1
            return None if self._closed else heapq.heappop(self._wanted)[2:]

    def _fetch(self, root: Root, number: int) -> Shard | None:
        name, nbytes = f"shard {root.keys[number].tolist()}", int(root.sizes[number])
        self._arrivals.add_pages(nbytes)
        try:
            with reporting_bytes(self._arrivals.add_index):
                frame = read_shard_object(self._objects, root, number)
            return unpack_shard(frame, root, number)
        except Offline:
            pass  # `OriginLink` reports it, once
        except ShmmapError as error:
            log.error("part of the list of cells cannot be used", part=name, reason=error)
        except BaseException:  # noqa: BLE001  also panics: else the shard would never be fetched again
            log.exception("part of the list of cells cannot be used", part=name, cause="a defect in shmmap")
        finally:
            self._arrivals.add_pages(-nbytes)
        return None

    def close(self) -> list[threading.Thread]:
        """Have the threads end, and return them; some may still wait for the origin."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        return self._threads


class ShardPages:
    """Pages of one version of a map; see `shmmap.daemon.map.catalogue_view.Pages`.

    All methods except `deliver` are called in the serving loop.

    Parameters
    ----------
    known
        Shards that are in memory from the beginning, by number.
    max_bytes
        Memory limit of pages; if the map has few shards, all are kept.

    Attributes
    ----------
    fd
        Readable when there are results.

    Raises
    ------
    MapDataError
        Two of the known shards have one cell (cause ``damaged``).
    """

    def __init__(
        self, root: Root, fetcher: ShardFetcher, known: Mapping[int, Shard], *, max_bytes: int
    ) -> None:
        self.root = root
        self._fetcher = fetcher
        self._first: list[int] = root.first_indices.tolist()
        self._max_bytes = max_bytes
        self._bytes = 0
        self._here: dict[int, Page] = {}  # least recently needed first
        self._wanted: dict[int, float] = {}
        self._lost: set[int] = set()
        self._by_name: list[dict[bytes, int]] = [{} for _ in range(NAME_TABLES)]
        self._by_base: ShardedDict[bytes, tuple[int, ...]] = ShardedDict()
        self._arrived: deque[tuple[int, Page | None, list[dict[bytes, int]]]] = deque()
        self.known_cells = 0
        low = root.keys[:, ::-1] * root.shard_m
        self._boxes = np.hstack([low, low + root.shard_m + np.array(root.largest_m)])
        self._middle = (
            0.5 * (root.bounds[0] + root.bounds[2]),
            0.5 * (root.bounds[1] + root.bounds[3]),
        )
        self._absent = np.ones(len(root.keys), bool)
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        weakref.finalize(self, os.close, self.fd)  # when no weak reference reaches these pages any more
        for number, shard in known.items():
            page = Page.of(number, shard, self._first[number])
            names = _shared_out(page)
            if (twice := self._known_name(names)) is not None:
                raise MapDataError(f"two cells are called {root.id_prefix}{twice}", cause=DAMAGED)
            self._take(page, names)

    def __len__(self) -> int:
        return len(self.root.keys)

    # --- which there are --------------------------------------------------------------------------

    def of_area(self, area: Area) -> Sequence[int]:
        """Return pages that may have cells which intersect an area."""
        found: list[int] = self.root.shards_near(area.bounds).tolist()
        return found

    def of_cell(self, index: int) -> int:
        """Return the page of a cell."""
        return bisect.bisect_right(self._first, index) - 1

    def cells(self, page: int) -> range:
        """Return the indices of a page's cells."""
        return range(self._first[page], self._first[page + 1])

    def cells_surely_in(self, area: Area) -> int:
        """Return how many cells are on pages that lie wholly in an area."""
        min_x, min_y, max_x, max_y = area.bounds
        boxes = self._boxes
        inside = (boxes[:, 0] >= min_x) & (boxes[:, 1] >= min_y)
        inside &= (boxes[:, 2] <= max_x) & (boxes[:, 3] <= max_y)
        if inside.any():  # a circle has no corners
            numbers = np.flatnonzero(inside)
            low, high = boxes[numbers, :2], boxes[numbers, 2:]
            for x, y in ((low, low), (low, high), (high, low), (high, high)):
                corner = np.column_stack([x[:, 0], y[:, 1], x[:, 0], y[:, 1]])
                inside[numbers] &= area.overlaps(corner)
        return int(self.root.counts[inside].sum(dtype=np.int64))

    # --- what is here -----------------------------------------------------------------------------

    @property
    def complete(self) -> bool:
        """Whether all pages are in memory."""
        return len(self._here) == len(self)

    @property
    def known_pages(self) -> int:
        """Number of pages in memory."""
        return len(self._here)

    def is_here(self, page: int) -> bool:
        """Whether a page is in memory."""
        return page in self._here

    def is_out_of_reach(self, page: int) -> bool:
        """Whether the last attempt to fetch a page failed."""
        return page in self._lost

    def shards(self) -> dict[int, Shard]:
        """Return the shards in memory, by number; may be called in another thread."""
        return {number: page.shard for number, page in self._here.copy().items()}

    def page(self, number: int) -> Page | None:
        """Return a page if it is in memory."""
        return self._here.get(number)

    def row(self, index: int) -> tuple[Page, int]:
        """Return page and row of a cell; raise `KeyError` if its page is not in memory."""
        page = self._here[self.of_cell(index)]
        return page, index - page.first

    def boxes_of(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the boxes of these cells, (K, 4) float64; raise `KeyError` if a page is not in memory."""
        boxes = np.empty((len(indices), 4))
        numbers = np.searchsorted(self.root.first_indices, indices, side="right") - 1
        for number in np.unique(numbers).tolist():
            page, inside = self._here[number], numbers == number
            boxes[inside] = page.shard.boxes[indices[inside] - page.first]
        return boxes

    def find(self, name: bytes) -> int | None:
        """Return the index of a known cell by its id without the map's prefix."""
        return self._by_name[hash(name) % NAME_TABLES].get(name)

    def find_base(self, base: bytes) -> int | None:
        """Return the index of a known cell by its base name.

        Raises
        ------
        BadRequest
            Several cells have it.
        """
        found = self._by_base.get(base, ())
        if len(found) > 1:
            pages = [self.row(index) for index in found[:NAMED]]
            some = ", ".join(page.shard.names[row].decode() for page, row in pages)
            more = ", ..." if len(found) > NAMED else ""
            raise BadRequest(
                f"{len(found)} cells are called {base.decode()}: {some}{more}",
                hint="give the full path of one",
            )
        return found[0] if found else None

    # --- coming and going -------------------------------------------------------------------------

    def want(self, pages: Iterable[int], priority: float) -> None:
        """Fetch those of some pages that are missing, the ones with the lowest priority first."""
        for number in pages:
            page = self._here.pop(number, None)
            if page is not None:
                self._here[number] = page
                continue
            if number not in self._lost and priority < self._wanted.get(number, np.inf):
                self._wanted[number] = priority
                self._fetcher.want(self, number, priority)

    def deliver(self, number: int, shard: Shard | None) -> None:
        """Queue an arrived shard; None: it cannot be fetched at present.  Called in a thread."""
        page = Page.of(number, shard, self._first[number]) if shard is not None else None
        self._arrived.append((number, page, _shared_out(page) if page is not None else []))
        os.eventfd_write(self.fd, 1)

    def collect(self) -> PageNews:
        """Merge one arrived page, a tenth of a millisecond; further pages wait for later calls."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        come: list[int] = []
        lost: list[int] = []
        while self._arrived and not come:
            number, page, names = self._arrived.popleft()
            self._wanted.pop(number, None)
            if number in self._here:
                continue
            if page is not None and (twice := self._known_name(names)) is not None:
                log.error(
                    "part of the list of cells cannot be used",
                    part=f"shard {self.root.keys[number].tolist()}",
                    reason=f"its cell {self.root.id_prefix}{twice} is in another shard, too",
                )
                page = None
            if page is None:
                self._lost.add(number)
                lost.append(number)
            else:
                self._lost.discard(number)
                self._take(page, names)
                come.append(number)
        if self._arrived:
            os.eventfd_write(self.fd, 1)
        return PageNews(come, lost)

    def try_again(self) -> None:
        """Fetch the pages again that could not be fetched before."""
        lost, self._lost = self._lost, set()
        self.want(lost, 0.0)
        self._lost |= lost  # until they arrive

    def lacking(self, before: Pages) -> Sequence[int]:
        """Return the missing pages in the places where another version has pages in memory."""
        if not isinstance(before, ShardPages):
            return [] if self.complete else list(range(len(self)))
        keys = {key for number, key in enumerate(before.keys()) if before.is_here(number)}
        return [n for n, key in enumerate(self.keys()) if key in keys and n not in self._here]

    def keys(self) -> list[tuple[int, int]]:
        """Return row and column of each page, in metres: versions may differ in shard size."""
        rows = (self.root.keys * self.root.shard_m).tolist()
        return [(row, column) for row, column in rows]

    def spare(self) -> int | None:
        """Return the page that was needed least recently if pages exceed their memory limit."""
        if self._bytes <= self._max_bytes or len(self) <= FEW_SHARDS:
            return None
        return next(iter(self._here), None)

    def drop(self, page: int) -> None:
        """Forget a page's cells."""
        dropped = self._here.pop(page)
        self._absent[page] = True
        self._bytes -= dropped.nbytes
        self.known_cells -= len(dropped.shard)
        for index, name in enumerate(dropped.shard.names, dropped.first):
            del self._by_name[hash(name) % NAME_TABLES][name]
            if dropped.has_folders and b"/" in name:
                base = name.rpartition(b"/")[2]
                left = tuple(one for one in self._by_base[base] if one != index)
                if left:
                    self._by_base[base] = left
                else:
                    del self._by_base[base]

    def _known_name(self, names: list[dict[bytes, int]]) -> str | None:
        """Return one of these names that a page in memory has."""
        for table, some in zip(self._by_name, names, strict=True):
            if not table.keys().isdisjoint(some):
                return next(iter(table.keys() & some.keys())).decode()
        return None

    def _take(self, page: Page, names: list[dict[bytes, int]]) -> None:
        self._here[page.number] = page
        self._absent[page.number] = False
        self._bytes += page.nbytes
        self.known_cells += len(page.shard)
        for table, some in zip(self._by_name, names, strict=True):
            table.update(some)
        if page.has_folders:
            for index, name in enumerate(page.shard.names, page.first):
                if b"/" in name:
                    base = name.rpartition(b"/")[2]
                    self._by_base[base] = (*self._by_base.get(base, ()), index)

    def want_nearest(self, place: tuple[float, float] | None) -> bool:
        """Fetch the missing page that is nearest to a place, or to the map's middle.

        Returns whether one is begun: none is while others are needed, while some are out of reach, or if
        memory has no room for it.
        """
        is_needed = any(priority < BACKGROUND for priority in self._wanted.values())
        if self._lost or is_needed or len(self._wanted) >= BACKGROUND_FETCHES or self.complete:
            return False
        absent = self._absent.copy()
        absent[list(self._wanted)] = False
        numbers = np.flatnonzero(absent)
        if not len(numbers):
            return False
        x, y = place or self._middle
        number = int(numbers[np.argmin(distance_to_boxes(x, y, self._boxes[numbers]))])
        counts = self.root.counts
        cell_bytes = self._bytes / self.known_cells if self.known_cells else 2.0 * NAME_BYTES
        more = cell_bytes * sum(int(counts[one]) for one in (number, *self._wanted))
        if len(self) > FEW_SHARDS and self._bytes + more > self._max_bytes:
            return False
        self.want((number,), BACKGROUND)
        return True
