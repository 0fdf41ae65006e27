# SPDX-License-Identifier: Apache-2.0
"""Disk cache of published maps' objects: none is fetched twice, and cached areas need no network.

An object is named by its SHA-256, here as in the store.  Its file is read into memory once and hashed there:
so neither the writer nor later changes of the file matter.  A file that does not match its name is removed,
and the object fetched again.  Nothing else depends on the disk: it may be full, read-only, or emptied at any
moment.

All processes of one account share the tier without a coordinator: a file gets its name once it is complete.
Only index pages are flushed to the disk; other files that a power cut damages are detected by their hash.
The size limit and the eviction order are in `shmmap.disk_budget`.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import secrets
import stat
import threading
import time
from collections.abc import Iterable, Iterator
from hashlib import sha256
from typing import Final, NamedTuple

from shmmap.disk_budget import CELLS, INDEX, INTERIM, OBJECTS, DiskBudget, mark_used
from shmmap.errors import MapDataError, ShmmapError
from shmmap.failpoints import step
from shmmap.logfmt import log
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.store import ObjectReader
from shmmap.origin.remote.zstd_frame import DAMAGED
from shmmap.private_directory import (
    DIRECTORY_FLAGS,
    PRIVATE,
    NotPrivate,
    opened_private,
    refuse_planted_above,
)
from shmmap.segment.writer import write_all

_BLOB: Final = re.compile("blobs/sha256/([0-9a-f]{64})")
_ABSENT: Final = (errno.ENOENT, errno.ESTALE)
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_SAID_AGAIN_S: Final = 3600.0
_NEVER_RIGHT: Final = (errno.ELOOP, errno.ENXIO, errno.EIO)  # symbolic link, socket, bad block


class ObjectTier:
    """The objects kept in one cache directory; thread-safe.

    No method raises for disk errors: the object then counts as missing, or is not kept, and the reason is
    logged, each at most once an hour.

    Parameters
    ----------
    cache_dir
        The cache directory, created when the first object is kept.
    limit_bytes
        Size limit of all files in it, computed layers included; 0: no object is kept.
    quiet
        Log only that the disk is full, which other processes of the same daemon may not notice; they log the
        rest.

    Attributes
    ----------
    damaged_objects : int
        Number of objects that were damaged and therefore removed.
    """

    def __init__(self, cache_dir: str, *, limit_bytes: int, quiet: bool = False) -> None:
        self.directory = os.path.join(cache_dir, OBJECTS)
        self._cache_dir = cache_dir
        self._budget = DiskBudget(cache_dir, limit_bytes)
        self._quiet = quiet
        self._lock = threading.Lock()
        self._trimmer: threading.Thread | None = None
        self._trim_again = False
        self._said_s: dict[str, float] = {}
        self.damaged_objects = 0

    @property
    def problem(self) -> str:
        """Why the directory is not used, e.g. because of its owner; empty if usable or not yet created."""
        try:
            with self._opened():
                return ""
        except OSError as error:
            return "" if error.errno in _ABSENT else self._reason(error)

    def get(self, digest: bytes, nbytes: int, *, is_index: bool = False) -> bytes | None:
        """Return an object, its size and hash verified; None if it is missing or was damaged.

        Parameters
        ----------
        digest
            SHA-256 of the object.
        """
        path = _path(digest, is_index)
        try:
            with self._opened() as place:
                try:
                    data = _read(place, path, nbytes)
                except OSError as error:
                    if error.errno not in _NEVER_RIGHT:
                        raise
                    data = b""
                if len(data) == nbytes and sha256(data).digest() == digest:
                    return data
                with self._lock:
                    self.damaged_objects += 1
                os.unlink(path, dir_fd=place)
        except OSError as error:
            self._say(error)
        return None

    def has(self, digest: bytes, nbytes: int) -> bool:
        """Whether a cell's object has a file of the right size; its content is verified when it is read."""
        try:
            with self._opened() as place:
                status = os.stat(_path(digest, False), dir_fd=place, follow_symlinks=False)
        except OSError as error:
            self._say(error)
            return False
        return stat.S_ISREG(status.st_mode) and status.st_size == nbytes

    def put(self, digest: bytes, data: bytes | memoryview, *, is_index: bool = False) -> bool:
        """Keep an object whose hash was verified; return False if it cannot be kept.

        Index pages are flushed to the disk when this returns.
        """
        nbytes = len(data)
        if nbytes > self._budget.limit_bytes:
            return False
        try:
            refuse_planted_above(self.directory)
            os.makedirs(self._cache_dir, mode=0o755, exist_ok=True)
            if not self._budget.has_room(nbytes):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            with self._opened(make=PRIVATE) as place:
                _write(place, _path(digest, is_index), memoryview(data), durable=is_index)
        except OSError as error:
            self._say(error)
            return False
        if self._budget.added(nbytes):
            self._begin_to_trim()
        return True

    def _begin_to_trim(self) -> None:
        """Trim the directory in a thread, so that fetching does not wait."""
        with self._lock:
            self._trim_again = True
            if self._trimmer is None or not self._trimmer.is_alive():
                trimmer = threading.Thread(target=self._trim, name="trim", daemon=True)
                with contextlib.suppress(RuntimeError):  # the limit of threads is reached
                    trimmer.start()
                    self._trimmer = trimmer

    def _trim(self) -> None:
        """Trim until no object was added during a pass: a pass may miss objects added while it runs."""
        while True:
            with self._lock:
                if not self._trim_again:
                    self._trimmer = None
                    return
                self._trim_again = False
            self._budget.trim()

    def mark_index_used(self, digests: Iterable[bytes]) -> None:
        """Mark the index pages of the version in use as recently used, so that they are evicted later."""
        with contextlib.suppress(OSError), self._opened() as place:
            for digest in digests:
                with contextlib.suppress(OSError):
                    os.utime(_path(digest, True), dir_fd=place, follow_symlinks=False)

    @contextlib.contextmanager
    def _opened(self, *, make: int = 0) -> Iterator[int]:
        """Open the directory for one operation.

        Raises
        ------
        OSError
            The directory does not exist, or is not private to this account (`NotPrivate`).
        """
        # in another user's cache, the owner's service could not use files that root created
        uid, owner = os.geteuid(), os.stat(self._cache_dir).st_uid
        if owner not in (0, uid):
            raise NotPrivate(self._cache_dir, f"belongs to user {owner}, not to user {uid}")
        with opened_private(self.directory, make=make) as place:
            yield place

    def _reason(self, error: OSError) -> str:
        if isinstance(error, NotPrivate):
            return f"{error.filename} {error.why}"
        return f"{self.directory}: {error.strerror}"

    def _say(self, error: OSError) -> None:
        if error.errno in _ABSENT or (self._quiet and error.errno not in _FULL):
            return
        reason = self._reason(error)
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._said_s.get(reason, -math.inf) < _SAID_AGAIN_S:
                return
            self._said_s[reason] = now_s
        log.warning("objects not kept on disk", reason=reason)


def _path(digest: bytes, is_index: bool) -> str:
    name = digest.hex()
    return f"{INDEX if is_index else CELLS}/{name[:2]}/{name}"


def _read(place: int, path: str, nbytes: int) -> bytes:
    """Read a regular file of ``nbytes`` bytes without blocking; any other file gives empty bytes."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=place)
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode) or status.st_size != nbytes:
            return b""
        mark_used(fd, status)
        data = os.read(fd, nbytes)
        while len(data) < nbytes and (more := os.read(fd, nbytes - len(data))):
            data += more
        return data
    finally:
        os.close(fd)


def _write(place: int, path: str, data: memoryview, *, durable: bool) -> None:
    folder, name = os.path.split(path)
    for made in (os.path.dirname(folder), folder):
        with contextlib.suppress(FileExistsError):
            os.mkdir(made, 0o700, dir_fd=place)
    within = os.open(folder, DIRECTORY_FLAGS, dir_fd=place)
    try:
        interim = INTERIM + secrets.token_hex(8)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        fd = os.open(interim, flags, 0o600, dir_fd=within)
        try:
            try:
                step("tier.made")
                write_all(fd, data, 0)
                step("tier.written")
                if durable:
                    os.fsync(fd)
            finally:
                os.close(fd)
            os.rename(interim, name, src_dir_fd=within, dst_dir_fd=within)
            step("tier.named")
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(interim, dir_fd=within)
            raise
        if durable:
            os.fsync(within)
    finally:
        os.close(within)


class ObjectCounts(NamedTuple):
    """Counts of reads from the tier and from the store, in the order of `counters.OBJECTS_READ`.

    Bytes are sizes of objects; ``failed`` counts fetches that failed for any reason.
    """

    disk_objects: int = 0
    disk_bytes: int = 0
    fetched_objects: int = 0
    fetched_bytes: int = 0
    damaged_on_disk: int = 0
    damaged_in_store: int = 0
    failed: int = 0

    def since(self, before: ObjectCounts) -> ObjectCounts:
        """Return the difference to earlier counts."""
        return ObjectCounts(*(now - then for now, then in zip(self, before, strict=True)))


class KeptObjects:
    """Reads objects of a store from the tier, or else fetches and keeps them.

    It has the interface of an `ObjectReader`, so callers need not know where an object is read.  Thread-safe.

    Parameters
    ----------
    store
        Store from which missing objects are fetched.
    tier
        Disk cache; None: nothing is kept.
    is_index
        The objects are index pages.
    keep
        Whether fetched objects are kept in the tier.
    """

    def __init__(
        self, store: ObjectReader, tier: ObjectTier | None, *, is_index: bool = False, keep: bool = True
    ) -> None:
        self._store, self.url = store, store.url
        self._tier = tier
        self._is_index = is_index
        self._keep = keep
        self._lock = threading.Lock()
        self._counts = ObjectCounts()

    @property
    def counts(self) -> ObjectCounts:
        """Counts of all reads so far."""
        damaged = self._tier.damaged_objects if self._tier is not None else 0
        return self._counts._replace(damaged_on_disk=damaged)

    def read(self, digest: bytes, nbytes: int) -> memoryview:
        """Return the object of a SHA-256 and a size, both verified.

        Raises
        ------
        Offline, MapMissing
            The object is not in the tier, and the store does not answer, or does not have it.
        MapDataError
            The store's object does not match its name (cause ``damaged``); it is not kept.
        """
        kept = self.read_kept(digest, nbytes)
        if kept is not None:
            return kept
        path = blob_path(digest)
        try:
            data = self._store.get_exactly(path, nbytes)
            if sha256(data).digest() != digest:
                raise MapDataError("its SHA-256 is not its name", path=f"{self.url}/{path}", cause=DAMAGED)
        except MapDataError:
            self._count(ObjectCounts(damaged_in_store=1, failed=1))
            raise
        except ShmmapError:
            self._count(ObjectCounts(failed=1))
            raise
        self._count(ObjectCounts(fetched_objects=1, fetched_bytes=nbytes))
        if self._tier is not None and self._keep:
            self._tier.put(digest, data, is_index=self._is_index)
        return data

    def read_kept(self, digest: bytes, nbytes: int) -> memoryview | None:
        """Return the object if it is in the tier, else None; nothing is fetched."""
        kept = self._tier.get(digest, nbytes, is_index=self._is_index) if self._tier is not None else None
        if kept is None:
            return None
        self._count(ObjectCounts(disk_objects=1, disk_bytes=nbytes))
        return memoryview(kept)

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        """Return an object by its path in the store; an object not named by its hash is always fetched."""
        blob = _BLOB.fullmatch(path)
        if blob is None:
            return self._store.get_exactly(path, nbytes)
        return self.read(bytes.fromhex(blob[1]), nbytes)

    def _count(self, more: ObjectCounts) -> None:
        with self._lock:
            self._counts = ObjectCounts(*map(sum, zip(self._counts, more, strict=True)))


def kept_objects(
    store: ObjectReader, cache_dir: str, cache_bytes: int, *, is_index: bool = False, quiet: bool = False
) -> KeptObjects:
    """Return a reader of objects that tries the disk cache first, then the store.

    Parameters
    ----------
    cache_dir, cache_bytes
        Directory of the cache, and its size limit, computed layers included; 0: nothing is kept.
    is_index, quiet
        As in `KeptObjects` and `ObjectTier`.
    """
    tier = ObjectTier(cache_dir, limit_bytes=cache_bytes, quiet=quiet) if cache_dir and cache_bytes else None
    return KeptObjects(store, tier, is_index=is_index)
