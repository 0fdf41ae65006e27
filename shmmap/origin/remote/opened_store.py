# SPDX-License-Identifier: Apache-2.0
"""Opens the store at a URL: a directory of this machine (`DirectoryStore`), a bucket or a web server."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from typing import Final, NamedTuple

from shmmap.errors import MapDataError, MapMissing, Offline
from shmmap.formats.durable_file import appearing_file, locked_file, writing_errors
from shmmap.origin.remote.store import LONG_RUN, SERVING, WEB_SCHEMES, Listed, Store, Tag, Timeouts, read_url
from shmmap.origin.remote.zstd_frame import DAMAGED
from shmmap.private_directory import NotPrivate, open_followed, refuse_planted, within


def open_store(
    url: str,
    *,
    timeouts: Timeouts = LONG_RUN,
    insecure_http: bool = False,
    instance_credentials: bool = False,
    sole_publisher: bool = False,
) -> Store:
    """Return the store at a URL or in a directory, without a first request.

    Parameters
    ----------
    insecure_http
        Allow plain ``http://`` to other machines.
    instance_credentials
        Ask the cloud's metadata address for credentials if none are given.
    sole_publisher
        Write to a bucket without conditions: no other program publishes there meanwhile.

    Raises
    ------
    BadRequest
        See `read_url`; also for plain ``http://`` to another machine that was not allowed.
    ConfigError
        The credentials cannot be used.
    PackageMissing
        The package obstore is missing.
    """
    where = read_url(url)
    if where.scheme == "file":
        return DirectoryStore(where.path)
    if where.scheme in WEB_SCHEMES:
        from shmmap.origin.remote.web_server import WebServer

        return WebServer(where, timeouts=timeouts, insecure_http=insecure_http)
    from shmmap.origin.remote.bucket_store import BucketStore, SolePublisherStore

    kind = SolePublisherStore if sole_publisher else BucketStore
    return kind(
        where, timeouts=timeouts, insecure_http=insecure_http, instance_credentials=instance_credentials
    )


class ServedFrom(NamedTuple):
    """Store of a published map, as the daemon passes it to its loaders; see `open_store`."""

    url: str
    insecure_http: bool = False
    instance_credentials: bool = False

    def words(self) -> tuple[str, ...]:
        """Return the fields as texts, for a command line."""
        return self.url, *("yes" if one else "" for one in self[1:])

    @classmethod
    def from_words(cls, url: str, *flags: str) -> ServedFrom:
        """Return the fields from the result of `words`."""
        return cls(url, *map(bool, flags))


def open_for_serving(served: ServedFrom, timeouts: Timeouts = SERVING) -> Store:
    """Return the store, with time limits for requests that clients wait for; errors as `open_store`."""
    return open_store(
        served.url,
        timeouts=timeouts,
        insecure_http=served.insecure_http,
        instance_credentials=served.instance_credentials,
    )


_LOCK: Final = ".lock"
_ABSENT: Final = (errno.ENOENT, errno.ENOTDIR)


class DirectoryStore:
    """A `shmmap.origin.remote.store.Store` of files below ``root``, an absolute path.

    A file appears complete and flushed to the disk.  Conditional replacements hold a lock.  Nothing is
    written, listed or deleted through a link below ``root`` that another account than this or root has made.
    """

    read_only = ""

    def __init__(self, root: str) -> None:
        self._root = root
        self.url = root

    def _path(self, path: str) -> str:
        return os.path.join(self._root, path)

    def _read(self, path: str, max_bytes: int, *, exact: bool = False) -> memoryview:
        full = self._path(path)
        try:
            # non-blocking, as opening a FIFO would block
            fd = os.open(full, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
            with open(fd, "rb") as file:
                size = os.fstat(fd).st_size
                data = file.read(max_bytes + 1) if size <= max_bytes else b""
        except OSError as error:
            if error.errno in _ABSENT:
                raise MapMissing(f"{full} is not there") from None
            if error.errno == errno.EISDIR:
                raise MapDataError("it is a directory", path=full, cause=DAMAGED) from None
            raise Offline(f"{full}: {error.strerror}", hint="may this user read it?") from None
        size = max(size, len(data))
        if size > max_bytes or (exact and size != max_bytes):
            limit = f"not {max_bytes:,}" if exact else f"at most {max_bytes:,} are read"
            raise MapDataError(f"it has {size:,} bytes, {limit}", path=full, cause=DAMAGED)
        return memoryview(data)

    def get(self, path: str, max_bytes: int) -> memoryview:
        """Return a whole file."""
        return self._read(path, max_bytes)

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        """Return a file of exactly ``nbytes`` bytes."""
        return self._read(path, nbytes, exact=True)

    def get_tagged(self, path: str, max_bytes: int) -> tuple[memoryview, Tag]:
        """Return a whole file and its hash."""
        data = self._read(path, max_bytes)
        return data, {"sha256": sha256(data).digest(), "size": len(data)}

    def get_if_changed(self, path: str, max_bytes: int, tag: Tag) -> tuple[memoryview, Tag] | None:
        """Return a whole file and its hash; None if the hash is still that of ``tag``."""
        found = self.get_tagged(path, max_bytes)
        return None if found[1] == tag else found

    def head(self, path: str) -> Listed | None:
        """Return a file's size and time of writing; None if it does not exist."""
        try:
            status = os.stat(self._path(path))
        except OSError as error:
            if error.errno in _ABSENT:
                return None
            raise Offline(f"{self._path(path)}: {error.strerror}") from None
        return Listed(path, status.st_size, status.st_mtime)

    def list(self, prefix: str) -> Iterator[Listed]:
        """Yield all files below a folder, including half-written ones, whose names begin with a dot."""
        if not self._is_own(prefix):
            return
        for folder, _, names in os.walk(self._path(prefix)):
            below = os.path.relpath(folder, self._root)
            for name in names:
                path = f"{below}/{name}"
                with suppress(Offline):
                    if (found := self.head(path)) is not None:
                        yield found

    def require_conditions(self, tag: Tag | None = None) -> None:
        """Do nothing: a directory compares and replaces under a lock."""

    def put(self, path: str, data: bytes) -> None:
        """Write a file."""
        self._write(path, data, replace=True)

    def put_new(self, path: str, data: bytes) -> bool:
        """Write a file if none exists at this path."""
        return self._write(path, data, replace=False)

    def put_if(self, path: str, data: bytes, tag: Tag) -> bool:
        """Replace a file if its hash is still that of ``tag``."""
        lock = self._path(_LOCK)
        with writing_errors(lock), locked_file(lock, mode=0o666):
            try:
                _, now = self.get_tagged(path, tag["size"])
            except (MapMissing, MapDataError):
                return False
            if now != tag:
                return False
            self._write(path, data, replace=True)
        return True

    def delete(self, path: str) -> None:
        """Remove a file."""
        full = self._path(path)
        with writing_errors(full), suppress(FileNotFoundError), self._folder(path) as folder:
            os.unlink(within(folder, os.path.basename(path)))

    def _write(self, path: str, data: bytes, *, replace: bool) -> bool:
        full = self._path(path)
        with writing_errors(full):
            os.makedirs(self._root, exist_ok=True)
            try:
                with (
                    self._folder(path, make=True) as folder,
                    appearing_file(within(folder, os.path.basename(path)), replace=replace) as file,
                ):
                    file.write(data)
            except FileExistsError:
                return False
            except NotPrivate:
                raise
            except OSError as error:
                error.filename = full  # not that of the descriptor
                raise
        return True

    @contextmanager
    def _folder(self, path: str, *, make: bool = False) -> Iterator[int]:
        """Open the folder of a file, whatever has its name afterwards; make what is missing of it."""
        refuse_planted(self._root)
        fd = os.open(self._root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            *parts, _ = filter(None, path.split("/"))
            for depth, part in enumerate(parts):
                if make:
                    with suppress(FileExistsError):
                        os.mkdir(part, dir_fd=fd)
                try:
                    below = open_followed(within(fd, part))
                except NotADirectoryError:
                    place = os.path.join(self._root, *parts[: depth + 1])
                    raise NotPrivate(place, "is no directory, or another account's link") from None
                os.close(fd)
                fd = below
            yield fd
        finally:
            os.close(fd)

    def _is_own(self, folder: str) -> bool:
        """Whether a folder is there, and no link of another account leads there."""
        try:
            with self._folder(f"{folder}/x"):
                return True
        except OSError:
            return False
