# SPDX-License-Identifier: Apache-2.0
"""A published map as the daemon's origin: which version is taken, its root, and what fetches the rest."""

from __future__ import annotations

import contextlib
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from shmmap.daemon.map.origin_link import OriginLink
from shmmap.daemon.map.published_view import PublishedView
from shmmap.daemon.map.shard_fetcher import THREADS, ShardFetcher
from shmmap.daemon.map.shard_pages import FEW_SHARDS, ShardPages
from shmmap.errors import MapDataError, MapMissing, ShmmapError
from shmmap.logfmt import log
from shmmap.origin.remote.map_versions import (
    Current,
    CurrentState,
    read_current,
    read_current_again,
    read_root,
    read_shard_object,
)
from shmmap.origin.remote.published_index import Root, Shard, unpack_shard
from shmmap.origin.remote.serving_store import ServedFrom, open_for_serving
from shmmap.origin.remote.store import PROBE

__all__ = ["PublishedOrigin"]

NOTHING: Final = CurrentState(None, None)


class PublishedOrigin:
    """What views of a published map come from; see `shmmap.daemon.map.catalogue_view.ViewOrigin`.

    Parameters
    ----------
    catalogue_bytes
        What the decoded list of cells of a large map may take.
    poll_s
        How often it is asked whether there is another version; 0: never.
    accept_version
        A version that is taken although a later one was taken before; 0: none.

    Attributes
    ----------
    served
        For loaders.
    link
        Says whether it is in reach, and has another version.
    """

    def __init__(
        self, served: ServedFrom, *, catalogue_bytes: int, poll_s: float, accept_version: int = 0
    ) -> None:
        self._store = open_for_serving(served)
        self._probe = open_for_serving(served, PROBE)
        self.served = served._replace(url=self._store.url)
        self.path = self._store.url
        self._catalogue_bytes = catalogue_bytes
        self._accept_version = accept_version
        self._taken: Current | None = None
        self._refused: Current | None = None
        self._seen = NOTHING
        self.link = OriginLink(self._has_another, poll_s)
        self._fetcher = ShardFetcher(self._store, self.link.doubt)
        self._pages: weakref.WeakSet[ShardPages] = weakref.WeakSet()

    def load(self, *, fresh: bool = False, before: object | None = None) -> PublishedView:
        """Find out which version is current, and take it.

        Raises
        ------
        MapMissing
            Nothing is published there.
        MapDataError
            Its index is damaged, or the version is lower than one that was taken before.
        Offline
            It is out of reach.
        """
        del fresh
        seen = read_current(self._store)
        current = seen.current
        if current is None:
            raise MapMissing(
                f"no map is published at {self.path}", hint="shmmap publish MAP URL publishes one"
            )
        self._seen = seen
        view = before if isinstance(before, PublishedView) else None
        try:
            self._check(current)
            if view is not None and current == self._taken and view.number == current.version:
                return view
            root = read_root(self._store, current)
        except MapDataError:
            self._refused = current
            raise
        known = {} if view is None else _same_shards(view, root)
        if len(root.keys) <= FEW_SHARDS:
            self._fetch_all(root, known)
        self._taken = current
        log.info("version of the map", number=current.version, map_version=f"{root.map_version:016x}")
        taken = PublishedView(root, current.version, self._fetcher, known, most_bytes=self._catalogue_bytes)
        self._pages.add(taken.pages)
        return taken

    def try_again(self) -> None:
        """Have fetched again what of the list of cells could not be had; called in the serving loop."""
        for pages in list(self._pages):
            pages.try_again()

    def _check(self, current: Current) -> None:
        """Refuse what is older than what was taken, unless that is wanted."""
        taken = self._taken
        if taken is None or current.version > taken.version or current == taken:
            return
        if current.version == self._accept_version:
            return
        what = "another map under that number" if current.version == taken.version else "an older one"
        raise MapDataError(
            f"version {current.version} is offered, {what}: version {taken.version} was taken",
            path=self.path,
            cause="older_version",
            hint=f"if that is meant, restart with --accept-version {current.version}",
        )

    def _fetch_all(self, root: Root, known: dict[int, Shard]) -> None:
        """Fetch what is lacking of few shards, as far as that can be had."""

        def fetch(number: int) -> Shard | None:
            try:
                return unpack_shard(read_shard_object(self._store, root, number), root, number)
            except ShmmapError:
                return None  # tried again, and its error said, in the background

        lacking = [number for number in range(len(root.keys)) if number not in known]
        with ThreadPoolExecutor(THREADS, "shards") as pool:
            fetched = zip(lacking, pool.map(fetch, lacking), strict=True)
            known.update((number, shard) for number, shard in fetched if shard is not None)

    def _has_another(self) -> bool:
        """Whether there is another version than the one that was taken; asked in a thread."""
        if self._taken is None:
            return False
        store = self._probe if self.link.is_out else self._store
        self._seen = read_current_again(store, self._seen)
        return self._seen.current not in (self._taken, self._refused, None)

    def close(self) -> bool:
        """End all threads; False if one still waits for the origin."""
        link, fetcher = self.link.close(), self._fetcher.close()
        return link and fetcher


def _same_shards(view: PublishedView, root: Root) -> dict[int, Shard]:
    """Shards of another root that are here already."""
    here = {view.root.shard_sha256(number): shard for number, shard in view.pages.shards().items()}
    known = {}
    for number in range(len(root.keys)):
        with contextlib.suppress(KeyError):
            known[number] = here[root.shard_sha256(number)]
    return known
