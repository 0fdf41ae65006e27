# SPDX-License-Identifier: Apache-2.0
"""Computes the layers that the setting ``prepare`` names, for every cell of the map, into the disk cache.

It has one loader of its own, of the lowest priority, and gives it one layer of one cell at a time, and none
while any load is queued or running or prefetching has something to do: so no client waits for it.  No memory
is reserved and no segment made: a load finds the layer in the cache.  A layer that is there already costs a
look at it, so a restart or another state of the map begins again from the first cell.  A layer that could not
be made is logged once, and left out until its cell changes; one whose loader was killed, which may have been
for another's use of memory, is tried again when all others are done.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Final, NamedTuple

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.scheduler import Scheduler, job_of, opened_of
from shmmap.daemon.loading.worker_messages import Failed, Prepare, Prepared
from shmmap.daemon.loading.worker_pool import Worker, WorkerPool
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import SPACE_CODES, Key
from shmmap.errors import BadRequest, CannotWrite, ConfigError, Replaced
from shmmap.layers.versions import LayerVersions
from shmmap.logfmt import log

DEADLINE: Final = 10
"""How many times as long as a load a layer may take: long ones are what preparing is for."""
LOOKS_PER_STEP: Final = 256
"""Layers left out in one step, at most."""
BUSY_S: Final = 0.02
"""When to look again while prefetching has something to do."""
RETRY_S: Final = 30.0
"""When to try again after nothing could be read or written, or no loader started."""
ENDING_S: Final = 0.5
"""When to try again while a loader that was killed has not exited."""
AGAIN_S: Final = 60.0
"""When to try again what a loader was killed at, after all else is done."""
MAX_TRIES: Final = 3
"""Loaders that may be killed at a layer until it is left out."""
MAX_NAMED: Final = 100
"""Failed layers that are logged by name; a cause that all cells share need not fill the log."""
FULL_SHARE: Final = 15 / 16
"""Part of the cache's size beyond which it removes what was used least recently."""


def refuse_far_reaching(layers: Sequence[str], catalogue: CatalogueView) -> None:
    """Refuse layers to prepare that would use too many neighbouring cells of this map.

    Raises
    ------
    ConfigError
        There is such a layer.
    """
    versions = LayerVersions(lambda: catalogue)
    try:
        for layer in layers:
            versions.check_reach(layer)
    except BadRequest as error:
        raise ConfigError(f"prepare: {error.message}", key="prepare", hint=error.hint) from None


class _Current(NamedTuple):
    """What the loader works on: a cell by index, and a layer in the version that the catalogue knows."""

    cell: int
    layer: str
    version: int


class _LeftOut(NamedTuple):
    """A layer of a cell that could not be made in a version, and how many loaders were killed at it.

    Version 0: its source could not be read, so it is left out of this pass alone.
    """

    version: int
    kills: int = 0

    @property
    def is_tried_again(self) -> bool:
        """Whether it is tried again when all others are done: others' use of memory may be to blame."""
        return 0 < self.kills < MAX_TRIES


class Preparer:
    """Prepares layers, as a background task of the serving loop.

    Parameters
    ----------
    layers
        Canonical specs.
    cache_bytes
        Size limit of the disk cache.
    make_pool
        Makes the pool of its loader, given the function to call with a worker that has sent a message.
    clock
        The serving loop's clock, seconds.
    """

    def __init__(
        self,
        cache: CellCache,
        scheduler: Scheduler,
        layers: Sequence[str],
        cache_bytes: int,
        make_pool: Callable[[Callable[[Worker], None]], WorkerPool],
        *,
        clock: Callable[[], float],
    ) -> None:
        self._cache, self._scheduler, self._statistics = cache, scheduler, cache.statistics
        self._layers, self._cache_bytes = tuple(layers), cache_bytes
        self._pool = make_pool(lambda worker: self._on_worker(worker, clock()))
        self._catalogue: CatalogueView | None = None
        self._todo: Iterator[tuple[str, int]] = iter(())
        self._again: tuple[str, int] | None = None
        self._current: _Current | None = None
        self._number, self._next_s = 0, -math.inf
        self._done = self._failed = self._bytes = 0
        self._left_out: dict[Key, _LeftOut] = {}
        self._retries: dict[Key, tuple[str, int]] = {}
        self._is_retry = False
        self._begin()

    def close(self) -> None:
        """End its loader."""
        self._pool.end_workers()

    # --- a background task of the serving loop ----------------------------------------------------

    @property
    def next_s(self) -> float:
        """When there is something to do: at once if nothing else loads."""
        if self._current is not None:
            return self._pool.next_deadline_s()
        if self._catalogue is not self._cache.catalogue:
            return -math.inf
        return math.inf if self._scheduler.loads.by_key else self._next_s

    def run_step(self, now_s: float) -> None:
        """Give the loader the next layer, or end one that takes too long."""
        if self._current is not None:
            for worker in self._pool.overdue(now_s):
                self._lost(worker, "it took longer than allowed", now_s)
            return
        if self._catalogue is not self._cache.catalogue:
            self._begin()
        prefetcher = self._scheduler.prefetcher
        if prefetcher.next_s <= now_s or prefetcher.health.is_out:
            self._next_s = now_s + (RETRY_S if prefetcher.health.is_out else BUSY_S)
            return
        for _ in range(LOOKS_PER_STEP):
            one = self._again or next(self._todo, None)
            if one is None:
                self._end(now_s=now_s)
                return
            layer, index = one
            version = self._cache.layers.version(index, layer)
            key = self._cache.key(index, layer)
            left_out = self._left_out.get(key)
            if self._is_retry or left_out is None or left_out.version != version:
                self._again = one
                self._hand_out(_Current(index, layer, version), now_s)
                return
            self._failed += 1
            if left_out.is_tried_again:
                self._retries[key] = one
        self._show()

    def _begin(self) -> None:
        """Begin with the first cell of the map's present state."""
        catalogue = self._catalogue = self._cache.catalogue
        self._pool.read_through(opened_of(catalogue))
        self._todo, self._again = product(self._layers, range(len(catalogue))), None
        self._done = self._failed = self._bytes = 0
        self._next_s, self._is_retry = -math.inf, False
        self._retries.clear()
        self._show(short=0)

    def _end(self, short: int = 0, *, now_s: float = math.inf) -> None:
        """End the loader until the map changes, or for ``AGAIN_S`` before retries; ``short`` as the gauge."""
        self._is_retry = bool(self._retries) and not short
        self._todo = iter(list(self._retries.values()))
        self._next_s = now_s + AGAIN_S if self._is_retry else math.inf
        self._pool.end_workers()
        self._show(short)
        if not short and not self._is_retry:
            log.info("layers prepared", layers=" ".join(self._layers), cells=self._done, failed=self._failed)

    def _show(self, short: int | None = None) -> None:
        """Write the progress into the statistics."""
        set_value = self._statistics.set
        set_value("prepare_cells", len(self._layers) * len(self._cache.catalogue))
        set_value("prepare_done", self._done)
        set_value("prepare_failed", self._failed)
        set_value("prepare_retries", len(self._retries))
        if short is not None:
            set_value("prepare_short", short)

    def _hand_out(self, current: _Current, now_s: float) -> None:
        self._number += 1
        job = Prepare(job_of(self._cache, self._number, current.cell, current.layer, 0))
        try:
            taken = self._pool.submit(job, now_s, opened=opened_of(self._cache.catalogue))
        except (OSError, Replaced):
            taken = False
        if taken:
            self._current = current
        else:
            self._next_s = now_s + (ENDING_S if self._pool.is_ending else RETRY_S)

    # --- messages of its loader ---------------------------------------------------------------------

    def _on_worker(self, worker: Worker, now_s: float) -> None:
        try:
            message = self._pool.next_message(worker, now_s)
        except EOFError as error:
            self._lost(worker, str(error), now_s)
            return
        if isinstance(message, Prepared | Failed):
            self._pool.finished(worker, message.number, now_s)
            self._on_end(message, now_s)

    def _on_end(self, message: Prepared | Failed, now_s: float) -> None:
        current, self._current = self._current, None
        if current is None or message.number != self._number:
            return
        is_of_this_map = self._catalogue is self._cache.catalogue
        if isinstance(message, Failed):
            if message.code == CannotWrite.code or message.code in SPACE_CODES:
                self._cannot_write(message.message, now_s)
                return
            if is_of_this_map:
                left_out = _LeftOut(0 if message.unread else current.version)
                self._leave_out(current, message.message, left_out)
        else:
            self._statistics.add("layers_prepared", message.computed)
            if is_of_this_map:
                self._again = None
                if self._is_retry:
                    key = self._cache.key(current.cell, current.layer)
                    self._failed -= 1
                    del self._left_out[key], self._retries[key]
                self._done, self._bytes = self._done + 1, self._bytes + message.bytes
        self._show(short=0)
        if self._bytes > FULL_SHARE * self._cache_bytes:
            log.warning(
                "layers not prepared: the disk cache is too small for them",
                prepared=self._done,
                of=len(self._layers) * len(self._cache.catalogue),
                bytes=self._bytes,
                hint="raise cache_size, or prepare fewer layers",
            )
            self._end(short=1)

    def _cannot_write(self, why: str, now_s: float) -> None:
        """Try the same layer again later, since nothing can be written; say so once."""
        if self._statistics.values["prepare_short"] != 2:
            log.warning("layers not prepared: they cannot be kept", reason=why, hint="free some disk space")
        self._show(short=2)
        self._next_s = now_s + RETRY_S

    def _leave_out(self, current: _Current, why: str, left_out: _LeftOut) -> None:
        """Leave out a layer that could not be made, and log it once."""
        self._again = None
        self._failed += not self._is_retry
        key = self._cache.key(current.cell, current.layer)
        self._retries.pop(key, None)
        if key not in self._left_out and len(self._left_out) <= MAX_NAMED:
            more = len(self._left_out) == MAX_NAMED
            log.warning("layer not prepared", cell=key.cell_id, layer=key.layer, message=why)
            if more:
                log.warning("more layers cannot be prepared: they are not named")
        self._left_out[key] = left_out
        if left_out.is_tried_again:
            self._retries[key] = current.layer, current.cell

    def _lost(self, worker: Worker, how: str, now_s: float) -> None:
        """Replace a loader that died or took too long: what it worked on is left out."""
        ready = worker.ready
        self._pool.remove(worker)
        self._statistics.add("worker_crashes")
        current, self._current = self._current, None
        if current is None:
            return
        if not ready or not how:  # its parent ended, or it could not start
            self._next_s = now_s + RETRY_S
        elif self._catalogue is self._cache.catalogue:
            before = self._left_out.get(self._cache.key(current.cell, current.layer))
            kills = before.kills + 1 if before is not None and before.version == current.version else 1
            source = self._cache.catalogue.source(current.cell).name
            why = f"{source}: the loader died of it ({how})"
            self._leave_out(current, why, _LeftOut(current.version, kills))
            self._show()
