# SPDX-License-Identifier: Apache-2.0
"""A published map as the daemon's origin: choice of the version, its root, and fetching of its pages."""

from __future__ import annotations

import contextlib
import threading
import time
import weakref
from hashlib import sha256
from typing import Final, NamedTuple

import msgspec

from shmmap.daemon.map.arrivals import Arrivals
from shmmap.daemon.map.object_keeper import ObjectKeeper
from shmmap.daemon.map.origin_link import OriginLink
from shmmap.daemon.map.published_view import PublishedView
from shmmap.daemon.map.shard_pages import FEW_SHARDS, THREADS, ShardFetcher, ShardPages
from shmmap.errors import (
    CannotStart,
    CannotWrite,
    ConfigError,
    MapDataError,
    MapMissing,
    Offline,
    ShmmapError,
)
from shmmap.logfmt import log
from shmmap.origin.remote.map_versions import (
    CURRENT,
    MAX_METADATA_BYTES,
    TIMESTAMP,
    Current,
    CurrentState,
    read_current,
    read_root_object,
    read_shard_object,
    root_path,
)
from shmmap.origin.remote.object_tier import KeptObjects, ObjectCounts, ObjectTier, kept_objects
from shmmap.origin.remote.opened_store import ServedFrom, open_for_serving
from shmmap.origin.remote.published_index import Root, Shard, unpack_root, unpack_shard
from shmmap.origin.remote.store import PROBE, NoBucket, ObjectReader, Store
from shmmap.origin.remote.taken_version import TakenVersion, TakenVersionFile, refusal_of
from shmmap.origin.remote.verify_apart import Verified, VerifySettings, read_trusted_root, verify_apart
from shmmap.processes.request_threads import RequestThreads, have_ended
from shmmap.statistics.counters import REFUSALS

NOTHING: Final = CurrentState(None, None)
VERIFY_S: Final = 30.0
"""Time limit for verification, seconds; requests to a silent server time out long before."""


class _Problem(NamedTuple):
    """Why an offered version is refused, as the error's fields."""

    code: str
    cause: str

    @classmethod
    def of(cls, error: ShmmapError) -> _Problem:
        return cls(error.code, error.cause if isinstance(error, MapDataError) else "")


class PublishedOrigin:
    """Source of the views of a published map; see `shmmap.daemon.map.catalogue_view.ViewOrigin`.

    The first view is of the version taken last, whatever the origin offers then.  A reload reports an
    unacceptable offer once, not with each poll; the next reload follows when the problem changes or ends.

    Parameters
    ----------
    instance, state_dir
        The daemon's instance and its state directory, if it has one, where the version taken is recorded.
    cache_dir, cache_bytes
        Disk cache of objects, and its size; 0: no cache.
    catalogue_bytes
        Memory limit of a large map's decoded list of cells.
    poll_s
        Interval of checking for another version, seconds; 0: never.
    accept_version
        A version that is taken although a later one was taken before; 0: none.
    trust
        Path of the root of trust.  The current version is then the one signed under it, as a separate process
        verifies, and at the start only a version taken under it is served.  Empty: the version in
        ``CURRENT``.

    Raises
    ------
    ConfigError
        The root of trust is unreadable or invalid, or no state directory exists to record verified versions.

    Attributes
    ----------
    served
        Where loaders fetch objects.
    link
        Reports whether the origin is reachable, and whether it has another version.
    arrivals
        Bytes of pages, and of objects kept on the disk, that have come from the origin.
    keeper
        Keeps objects of cells on the disk ahead of use; None without a disk cache.
    taken
        The version taken last, with the times of its signature; it may still wait for its pages.
    in_service
        The version that is served, as of the last `note_served`.
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
        trust: str = "",
    ) -> None:
        self._trust = trust
        self._trusted = sha256(read_trusted_root(trust)).hexdigest() if trust else ""
        if trust and not state_dir:
            raise ConfigError(
                "there is no directory to keep what was verified", key="trust", hint="set XDG_STATE_HOME"
            )
        self._store = open_for_serving(served)
        self._probe = open_for_serving(served, PROBE)
        self._index = kept_objects(self._store, cache_dir, cache_bytes, is_index=True)
        self._tier = ObjectTier(cache_dir, limit_bytes=cache_bytes, quiet=True) if cache_bytes else None
        self.path = self._store.url
        self.served = served._replace(url=self.path)
        self._instance = instance
        self._state_dir = state_dir
        self._state = TakenVersionFile(state_dir, instance, self.path, self._trusted) if state_dir else None
        self._catalogue_bytes = catalogue_bytes
        self._poll_s = poll_s
        self._accept_version = accept_version
        self.taken: TakenVersion | None = None
        self._lock = threading.Lock()  # of `taken`: reloads change it, and the polling thread reads it
        self._saving = threading.Lock()
        self._problem: _Problem | None = None
        self._refused = 0
        self._seen = NOTHING
        self._is_loading = False
        self._saved: TakenVersion | None = None
        self.in_service: TakenVersion | None = None
        self.link = OriginLink(self._has_another, poll_s)
        self.arrivals = Arrivals()
        self._fetcher = ShardFetcher(self._index, self.link.doubt, self.arrivals)
        self._pages: weakref.WeakSet[ShardPages] = weakref.WeakSet()
        self.keeper: ObjectKeeper | None = None
        if self._tier is not None:
            self.keeper = ObjectKeeper(
                KeptObjects(self._store, self._tier),
                self._tier,
                self.link.doubt,
                self.arrivals.add_ahead,
            )

    # --- taking a version -------------------------------------------------------------------------

    def load(self, *, fresh: bool = False, before: object | None = None) -> PublishedView:
        """Take the current version; at the start the version taken last.

        Raises
        ------
        MapMissing
            Nothing is published at the origin.
        MapDataError
            The version's index is damaged, the version is lower than one taken before, or the root of trust
            refuses it: see `verify_apart`, whose other errors are raised, too.
        Offline
            The origin is unreachable.
        CannotStart
            The origin is unreachable at the start, and no version was taken before.
        """
        view = before if isinstance(before, PublishedView) else None
        self._is_loading = True
        try:
            if view is None and not fresh and (taken := self._remembered()) is not None:
                if self._accept_version:
                    try:
                        return self._offered(None)
                    except ShmmapError:
                        self._problem = None  # the next poll reports it
                return self._restored(*taken)
            return self._offered(view)
        except Offline as error:
            if fresh or isinstance(error, NoBucket):
                raise
            # by the exit code, the service manager knows that a later start may succeed
            raise CannotStart(error.message, hint=error.hint) from None
        finally:
            self._is_loading = False

    def _offered(self, view: PublishedView | None) -> PublishedView:
        """Take the current version."""
        try:
            offer = self._read_offer()
            self._judge(offer)
            current = offer.current
            if view is not None and view.number == current.version:
                self._problem = None
                return view
            frame, root = self._read_root(current)
        except ShmmapError as error:
            self._problem = _Problem.of(error)
            raise
        self._problem = None
        taken = TakenVersion(
            self._instance,
            self.path,
            self._trusted,
            current.version,
            frame,
            time.time(),
            offer.signed_s,
            offer.expires_s,
        )
        known = {} if view is None else _same_shards(view, root)
        if len(root.keys) <= FEW_SHARDS:
            self._fetch_all(root, known, self._index)
        return self._take(taken, root, known)

    def _read_offer(self) -> Verified:
        """Ask for the current version: the signed one, or without a root of trust the one in ``CURRENT``."""
        self._refused = 0
        if self._trust:
            return self._verify()
        self._seen = read_current(self._store)
        if self._seen.current is None:
            raise MapMissing(
                f"no map is published at {self.path}", hint="shmmap publish MAP URL publishes one"
            )
        return Verified(self._seen.current, trust="", signed_s=0.0, expires_s=0.0)

    def _verify(self) -> Verified:
        """Verify in a separate process which version is signed."""
        tag = None
        with contextlib.suppress(MapMissing, MapDataError):  # verification reports what is wrong
            _, tag = self._store.get_tagged(TIMESTAMP, MAX_METADATA_BYTES)
        settings = VerifySettings(
            self.path,
            self._trust,
            self._state_dir,
            self.served.insecure_http,
            self.served.instance_credentials,
            is_serving=True,
        )
        verified = verify_apart(settings, timeout_s=VERIFY_S)
        if verified.trust != self._trusted:
            raise ConfigError(
                f"{self._trust} is another root of trust than when this daemon was started",
                key="trust",
                hint="restart it: what is signed under this one is verified then",
            )
        self._seen = CurrentState(verified.current, tag)
        return verified

    def _judge(self, offer: Verified) -> None:
        """Refuse an unacceptable version; the version taken may have been signed again."""
        with self._lock:
            taken = self.taken
            refused = refusal_of(taken, offer.current, accept=self._accept_version)
            if refused is not None:
                self._refused = offer.current.version
                raise refused
            if taken is not None and taken.current == offer.current:
                again = msgspec.structs.replace(taken, signed_s=offer.signed_s, expires_s=offer.expires_s)
                self.taken = taken if taken == again else again

    def _read_root(self, current: Current) -> tuple[bytes, Root]:
        frame = read_root_object(self._index, current)
        return frame, unpack_root(frame, name=f"{self.path}/{root_path(current)}")

    def _remembered(self) -> tuple[TakenVersion, Root] | None:
        """Return the version taken before the start, if known."""
        if self._state is None:
            return None
        taken = self._state.load()
        if self._state.problem:
            log.warning("the version taken last cannot be read", problem=self._state.problem)
        if taken is None:
            return None
        try:
            root = unpack_root(taken.root, name=self._state.path)
        except MapDataError as error:  # for example, written by a later version of shmmap
            log.warning("the version taken last cannot be served", reason=error)
            return None
        self.taken = self._saved = taken
        return taken, root

    def _restored(self, taken: TakenVersion, root: Root) -> PublishedView:
        """Return a view of the version taken before the start, with the pages that are on the disk."""
        known: dict[int, Shard] = {}
        if self._tier is not None and len(root.keys) <= FEW_SHARDS:
            self._fetch_all(root, known, _OnDisk(self._index))
        if self._poll_s:
            self.link.ask_now()
        return self._take(taken, root, known)

    def _take(self, taken: TakenVersion, root: Root, known: dict[int, Shard]) -> PublishedView:
        view = PublishedView(root, taken.version, self._fetcher, known, max_bytes=self._catalogue_bytes)
        with self._lock:
            self.taken = taken
        if self._tier is not None:
            digests = [root.shard_sha256(number) for number in range(len(root.keys))]
            self._tier.mark_index_used([bytes.fromhex(taken.current.root), *digests])
        log.info("version of the map", number=taken.version, map_version=f"{root.map_version:016x}")
        self._pages.add(view.pages)
        return view

    def _fetch_all(self, root: Root, known: dict[int, Shard], objects: ObjectReader) -> None:
        """Read the missing shards of a map with few shards, as far as they can be fetched."""

        def fetch(number: int) -> Shard | None:
            try:
                return unpack_shard(read_shard_object(objects, root, number), root, number)
            except ShmmapError:
                return None  # fetched again in the background, which reports the error

        lacking = [number for number in range(len(root.keys)) if number not in known]
        with RequestThreads(THREADS, "shards") as pool:
            fetched = zip(lacking, pool.map(fetch, lacking), strict=True)
            known.update((number, shard) for number, shard in fetched if shard is not None)

    def _has_another(self) -> bool:
        """Whether a reload would find something new; called in a thread.

        That is another version than the one taken, a new problem with the offer, or the end of a problem.
        """
        if self.taken is None:
            return False
        is_same = self._is_same(self._probe if self.link.is_out else self._store)
        before = self._problem
        if self._is_loading or (is_same and before is None):  # a running reload reports what it finds
            return False
        try:
            offer = self._read_offer()
            self._judge(offer)
            if offer.current != self.taken.current:
                self._read_root(offer.current)
                return True
        except ShmmapError as error:  # also if unreachable, although the origin has just answered
            return not self._is_loading and _Problem.of(error) != self._problem
        return before is not None

    def _is_same(self, store: Store) -> bool:
        """Whether the origin still offers what it offered at the last read."""
        path, tag = TIMESTAMP if self._trust else CURRENT, self._seen.tag
        with contextlib.suppress(MapMissing, MapDataError):  # reading the offer reports what is wrong
            if tag is not None:
                return store.get_if_changed(path, MAX_METADATA_BYTES, tag) is None
            store.get_tagged(path, MAX_METADATA_BYTES)
        return False

    # --- while it is served -----------------------------------------------------------------------

    def note_served(self, view: object) -> None:
        """Record which version is served now."""
        taken = self.taken
        if taken is None or not isinstance(view, PublishedView) or view.number != taken.version:
            return  # another version was taken, and waits for its pages
        self.in_service = taken
        if taken is self._saved or self._state is None:
            return
        self._saved = taken
        with contextlib.suppress(RuntimeError):  # limit of threads reached: saved with the next version
            threading.Thread(target=self._save, args=(self._state, taken), name="taken").start()

    def _save(self, state: TakenVersionFile, taken: TakenVersion) -> None:
        with self._saving:
            if taken is not self._saved:
                return  # a later version is saved, or will be
            try:
                state.save(taken)
            except CannotWrite as error:
                log.warning("the version taken cannot be remembered for the next start", reason=error)

    @property
    def refusal(self) -> str:
        """Why the offer is refused, one of `REFUSALS`; empty if it is accepted, or unreachable."""
        problem = self._problem
        if problem is None or problem.code == Offline.code:
            return ""
        return problem.cause if problem.cause in REFUSALS[1:] else REFUSALS[-1]

    @property
    def refused_version(self) -> int:
        """Number of the offered version that was refused; 0: none, or it is not known."""
        return self._refused if self.refusal else 0

    @property
    def counts(self) -> ObjectCounts:
        """Counts of the daemon's own reads: of the index, and of objects kept on the disk ahead of use."""
        index = self._index.counts
        if self.keeper is None:
            return index
        return ObjectCounts(*map(sum, zip(index, self.keeper.counts, strict=True)))

    def try_again(self) -> None:
        """Fetch the missing pages of the list of cells again; called in the serving loop."""
        for pages in list(self._pages):
            pages.try_again()

    def close(self) -> bool:
        """End all threads; return False if one still waits for the origin."""
        threads = self.link.close() + self._fetcher.close()
        if self.keeper is not None:
            threads += self.keeper.close()
        return have_ended(threads) and not self._is_loading


class _OnDisk:
    """Reads only index pages that are on the disk."""

    def __init__(self, index: KeptObjects) -> None:
        self._index = index
        self.url = index.url

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        data = self._index.read_kept(bytes.fromhex(path.rpartition("/")[2]), nbytes)
        if data is None:
            raise MapMissing(f"{path} is not on the disk")
        return data


def _same_shards(view: PublishedView, root: Root) -> dict[int, Shard]:
    """Return the shards of another root that are in memory already."""
    here = {view.root.shard_sha256(number): shard for number, shard in view.pages.shards().items()}
    known = {}
    for number in range(len(root.keys)):
        with contextlib.suppress(KeyError):
            known[number] = here[root.shard_sha256(number)]
    return known
