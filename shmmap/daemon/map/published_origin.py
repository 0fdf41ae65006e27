# SPDX-License-Identifier: Apache-2.0
"""A published map as the daemon's origin: which version is taken, its root, and what fetches the rest."""

from __future__ import annotations

import contextlib
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from shmmap.daemon.map.object_keeper import ObjectKeeper
from shmmap.daemon.map.origin_link import OriginLink
from shmmap.daemon.map.published_view import PublishedView
from shmmap.daemon.map.shard_fetcher import THREADS, ShardFetcher
from shmmap.daemon.map.shard_pages import FEW_SHARDS, ShardPages
from shmmap.errors import CannotWrite, MapDataError, MapMissing, ShmmapError
from shmmap.logfmt import log
from shmmap.origin.remote.map_versions import (
    Current,
    CurrentState,
    read_current,
    read_current_again,
    read_root_object,
    read_shard_object,
    root_path,
)
from shmmap.origin.remote.object_tier import KeptObjects, ObjectCounts, ObjectTier
from shmmap.origin.remote.published_index import Root, Shard, unpack_root, unpack_shard
from shmmap.origin.remote.serving_store import ServedFrom, kept_objects, open_for_serving
from shmmap.origin.remote.store import PROBE, ObjectReader
from shmmap.origin.remote.taken_version import TakenVersion, TakenVersionFile, judge_offer

__all__ = ["PublishedOrigin"]

NOTHING: Final = CurrentState(None, None)


class PublishedOrigin:
    """What views of a published map come from; see `shmmap.daemon.map.catalogue_view.ViewOrigin`.

    The first view is of the version that was taken last, whatever the origin says then, if anything.

    Parameters
    ----------
    instance, state_dir
        Of the daemon; what was taken is remembered in its state directory, if it has one.
    cache_dir, cache_bytes
        Where objects are kept on the disk, and how much; 0: none.
    catalogue_bytes
        What the decoded list of cells of a large map may take of memory.
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
    keeper
        Keeps objects of cells on the disk ahead; None where nothing is kept.
    """

    def __init__(
        self,
        served: ServedFrom,
        *,
        instance: str,
        state_dir: str,
        cache_dir: str,
        cache_bytes: int,
        catalogue_bytes: int,
        poll_s: float,
        accept_version: int = 0,
    ) -> None:
        self._store = open_for_serving(served)
        self._probe = open_for_serving(served, PROBE)
        self._index = kept_objects(self._store, cache_dir, cache_bytes, is_index=True)
        self._tier = ObjectTier(cache_dir, limit_bytes=cache_bytes, quiet=True) if cache_bytes else None
        self.path = self._store.url
        self.served = served._replace(url=self.path)
        self._instance = instance
        self._state = TakenVersionFile(state_dir, instance, self.path) if state_dir else None
        self._catalogue_bytes = catalogue_bytes
        self._poll_s = poll_s
        self._accept_version = accept_version
        self._taken: TakenVersion | None = None
        self._refused: Current | None = None
        self._seen = NOTHING
        self._is_loading = False
        self._saved: TakenVersion | None = None
        self._in_service: TakenVersion | None = None
        self.link = OriginLink(self._has_another, poll_s)
        self._fetcher = ShardFetcher(self._index, self.link.doubt)
        self._pages: weakref.WeakSet[ShardPages] = weakref.WeakSet()
        self.keeper: ObjectKeeper | None = None
        if self._tier is not None:
            cells = kept_objects(self._store, cache_dir, cache_bytes, quiet=True)
            self.keeper = ObjectKeeper(cells, self._tier, self.link.doubt)

    # --- taking a version -------------------------------------------------------------------------

    def load(self, *, fresh: bool = False, before: object | None = None) -> PublishedView:
        """Take the version that is current; at the start the one that was taken last.

        Raises
        ------
        MapMissing
            Nothing is published there.
        MapDataError
            Its index is damaged, or the version is lower than one that was taken before.
        Offline
            It is out of reach.
        """
        view = before if isinstance(before, PublishedView) else None
        self._is_loading = True
        try:
            if view is None and not fresh and (taken := self._remembered()) is not None:
                if self._accept_version:
                    with contextlib.suppress(ShmmapError):
                        return self._offered(None)
                return self._restored(*taken)
            return self._offered(view)
        finally:
            self._is_loading = False

    def _offered(self, view: PublishedView | None) -> PublishedView:
        """Take the version that is current."""
        self._seen = seen = read_current(self._store)
        current = seen.current
        if current is None:
            raise MapMissing(
                f"no map is published at {self.path}", hint="shmmap publish MAP URL publishes one"
            )
        judged = judge_offer(self._taken, current, accept=self._accept_version)
        if judged.problem:
            self._refused = current
            raise MapDataError(judged.problem, cause="older_version", hint=judged.hint)
        if view is not None and view.number == current.version:
            return view
        frame = read_root_object(self._index, current)
        root = unpack_root(frame, name=f"{self.path}/{root_path(current)}")
        taken = TakenVersion(self._instance, self.path, "", current.version, frame, time.time())
        known = {} if view is None else _same_shards(view, root)
        if len(root.keys) <= FEW_SHARDS:
            self._fetch_all(root, known, self._index)
        return self._take(taken, root, known)

    def _remembered(self) -> tuple[TakenVersion, Root] | None:
        """Return the version that was taken before the start, if that is known."""
        if self._state is None:
            return None
        taken = self._state.load()
        if self._state.problem:
            log.warning("the version taken last cannot be read", problem=self._state.problem)
        if taken is None:
            return None
        try:
            root = unpack_root(taken.root, name=self._state.path)
        except MapDataError as error:  # of a later version of shmmap, say
            log.warning("the version taken last cannot be served", reason=error)
            return None
        self._taken = self._saved = taken
        return taken, root

    def _restored(self, taken: TakenVersion, root: Root) -> PublishedView:
        """Serve what was taken before the start, as far as it is on the disk."""
        known: dict[int, Shard] = {}
        if self._tier is not None and len(root.keys) <= FEW_SHARDS:
            self._fetch_all(root, known, _OnDisk(self._index))
        if self._poll_s:
            self.link.ask_now()
        return self._take(taken, root, known)

    def _take(self, taken: TakenVersion, root: Root, known: dict[int, Shard]) -> PublishedView:
        self._taken = taken
        if self._tier is not None:
            digests = [root.shard_sha256(number) for number in range(len(root.keys))]
            self._tier.mark_index_used([bytes.fromhex(taken.current.root), *digests])
        log.info("version of the map", number=taken.version, map_version=f"{root.map_version:016x}")
        view = PublishedView(root, taken.version, self._fetcher, known, most_bytes=self._catalogue_bytes)
        self._pages.add(view.pages)
        return view

    def _fetch_all(self, root: Root, known: dict[int, Shard], objects: ObjectReader) -> None:
        """Read what is lacking of few shards, as far as that can be had."""

        def fetch(number: int) -> Shard | None:
            try:
                return unpack_shard(read_shard_object(objects, root, number), root, number)
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
        return self._seen.current not in (self._taken.current, self._refused, None)

    # --- while it is served -----------------------------------------------------------------------

    def note_served(self, view: object) -> None:
        """Remember which version is served now."""
        taken = self._taken
        if taken is None or not isinstance(view, PublishedView) or view.number != taken.version:
            return  # another one was taken, and waits for its pages
        self._in_service = taken
        if taken is self._saved or self._state is None:
            return
        self._saved = taken
        with contextlib.suppress(RuntimeError):  # as many threads as there may be: then with the next one
            threading.Thread(target=_save, args=(self._state, taken), name="taken").start()

    @property
    def in_service(self) -> TakenVersion | None:
        """The version that is served, as of the last `note_served`."""
        return self._in_service

    @property
    def refused_version(self) -> int:
        """Number of the version that is offered and was refused; 0: none."""
        refused = self._refused
        return refused.version if refused is not None and self._seen.current == refused else 0

    @property
    def expires_s(self) -> float | None:
        """When what signs the version runs out, Unix time; None where nothing signs it."""
        return None

    @property
    def counts(self) -> ObjectCounts:
        """What the daemon itself has read so far: of the index, and of what is kept on the disk ahead."""
        index = self._index.counts
        if self.keeper is None:
            return index
        return ObjectCounts(*map(sum, zip(index, self.keeper.counts, strict=True)))

    def try_again(self) -> None:
        """Have fetched again what of the list of cells could not be had; called in the serving loop."""
        for pages in list(self._pages):
            pages.try_again()

    def close(self) -> bool:
        """End all threads; False if one still waits for the origin."""
        ended = [self.link.close(), self._fetcher.close()]
        if self.keeper is not None:
            ended.append(self.keeper.close())
        return all(ended) and not self._is_loading


class _OnDisk:
    """Reads index pages that are on the disk, and no others."""

    def __init__(self, index: KeptObjects) -> None:
        self._index = index
        self.url = index.url

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        data = self._index.read_kept(bytes.fromhex(path.rpartition("/")[2]), nbytes)
        if data is None:
            raise MapMissing(f"{path} is not on the disk")
        return data


def _save(state: TakenVersionFile, taken: TakenVersion) -> None:
    try:
        state.save(taken)
    except CannotWrite as error:
        log.warning("the version taken cannot be remembered for the next start", reason=error)


def _same_shards(view: PublishedView, root: Root) -> dict[int, Shard]:
    """Shards of another root that are here already."""
    here = {view.root.shard_sha256(number): shard for number, shard in view.pages.shards().items()}
    known = {}
    for number in range(len(root.keys)):
        with contextlib.suppress(KeyError):
            known[number] = here[root.shard_sha256(number)]
    return known
