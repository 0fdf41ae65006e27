# SPDX-License-Identifier: Apache-2.0
"""Fetches shards of published maps in a few threads, the most urgent first; verified and decoded."""

from __future__ import annotations

import heapq
import threading
import time
import weakref
from collections.abc import Callable
from typing import Final, Protocol

from shmmap.errors import Offline, ShmmapError
from shmmap.logfmt import log
from shmmap.origin.remote.map_versions import read_shard_object
from shmmap.origin.remote.published_index import Root, Shard, unpack_shard
from shmmap.origin.remote.store import ObjectReader

__all__ = ["ShardFetcher", "ShardSink"]

THREADS: Final = 8
END_S: Final = 0.5
"""How long the end of the daemon waits for a thread that waits for the origin."""


class ShardSink(Protocol):
    """Takes shards of one root; called in threads."""

    def deliver(self, number: int, shard: Shard | None) -> None:
        """Take a shard; None: it cannot be had at present."""


class ShardFetcher:
    """Fetches shards for sinks.

    Parameters
    ----------
    failed
        Called, in a thread, when something could not be had.
    """

    def __init__(self, objects: ObjectReader, failed: Callable[[], None]) -> None:
        self._objects = objects
        self._failed = failed
        self._condition = threading.Condition()
        self._wanted: list[tuple[float, int, weakref.ref[ShardSink], Root, int]] = []
        self._under_way: set[tuple[int, int]] = set()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._count = 0
        self._closed = False

    def want(self, sink: ShardSink, root: Root, number: int, priority: float) -> None:
        """Have a shard delivered, unless it is being fetched; those with the lowest priority come first.

        One that is wanted again with a lower priority may be delivered twice.
        """
        with self._condition:
            if (id(sink), number) in self._under_way:
                return
            self._count += 1
            heapq.heappush(self._wanted, (priority, self._count, weakref.ref(sink), root, number))
            self._condition.notify()
            if self._idle < len(self._wanted) and len(self._threads) < THREADS:
                thread = threading.Thread(target=self._run, name="shards", daemon=True)
                try:
                    thread.start()
                except RuntimeError:  # there are as many threads as there may be
                    return
                self._threads.append(thread)

    def _run(self) -> None:
        while (taken := self._take()) is not None:
            reference, root, number = taken
            sink = reference()
            if sink is None:  # its version is served no more
                continue
            key = id(sink), number
            with self._condition:
                if key in self._under_way:
                    continue
                self._under_way.add(key)
            shard = self._fetch(root, number)
            with self._condition:
                self._under_way.discard(key)
            sink.deliver(number, shard)
            del sink
            if shard is None:
                self._failed()

    def _take(self) -> tuple[weakref.ref[ShardSink], Root, int] | None:
        with self._condition:
            self._idle += 1
            while not self._wanted and not self._closed:
                self._condition.wait()
            self._idle -= 1
            return None if self._closed else heapq.heappop(self._wanted)[2:]

    def _fetch(self, root: Root, number: int) -> Shard | None:
        name = f"shard {root.keys[number].tolist()}"
        try:
            return unpack_shard(read_shard_object(self._objects, root, number), root, number)
        except Offline:
            pass  # `OriginLink` says so, once
        except ShmmapError as error:
            log.error("part of the list of cells cannot be used", part=name, reason=error)
        except Exception:  # noqa: BLE001  else it would never be tried again
            log.exception("part of the list of cells cannot be used", part=name, cause="a defect in shmmap")
        return None

    def close(self) -> bool:
        """End the threads; False if one still waits for the origin."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        until_s = time.monotonic() + END_S
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)
