# SPDX-License-Identifier: Apache-2.0
"""Cache of finished layers on disk, so that neither a restart nor another daemon computes them again.

An entry is the bytes of a segment whose publish block is empty.  It has two names, both hard links to one
file: one for the *content* it was computed from (digest of the source, layer, builder version, box),
one for the *version* of the cell's layer.  Loading looks up the version and reads no source.  If a
map was copied or touched, `LayerCache.recognise` finds the entry by content and links it under its new
version.  ::

    DIRECTORY/layers/content/ab/<digest><hash>.layer
    DIRECTORY/layers/version/cd/<version>.layer

Entries appear complete, by renaming.  They are not flushed to the disk: every column is compared with its
checksum when it is loaded, and an entry that does not match is removed and built again.  Entries that other
accounts could have written are not used.  The size limit and the eviction order are in `shmmap.disk_budget`.
"""

from __future__ import annotations

import contextlib
import os
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import msgspec
import xxhash

from shmmap.disk_budget import INTERIM, LAYERS, DiskBudget, mark_used
from shmmap.errors import CannotWrite, SegmentCorrupt
from shmmap.layers.sources import CellJob
from shmmap.layers.spec import LayerSpec
from shmmap.private_directory import opened_private, refuse_planted_above, why_not_own, within
from shmmap.segment.header import checked_blocks, pack_header, read_page, unpack_header
from shmmap.segment.layout import LAYOUT_VERSION, SegmentHeader, SourceStamp, header_size
from shmmap.segment.writer import write_all

_CONTENT: Final = "content"
_MODE: Final = 0o755  # other accounts may read what root has prepared
_BLOCK_BYTES: Final = 1 << 18  # a block stays in the L2 cache while it is hashed and written


@dataclass(frozen=True, slots=True)
class CacheKey:
    """Key of an entry: a layer of a cell, with the states of its sources.

    Attributes
    ----------
    source, neighbours
        State of the cell's file, and for a layer with a halo, of the neighbouring cells' files.
    """

    spec: LayerSpec
    job: CellJob
    source: SourceStamp
    neighbours: tuple[SourceStamp, ...] = ()

    @property
    def version(self) -> int:
        """Version of the layer."""
        return self.job.version(self.spec, self.source, self.neighbours)

    def version_name(self) -> str:
        """Return the name of the entry for this version, in the current layout of segments."""
        major, minor = LAYOUT_VERSION
        return f"{self.version:016x}-{major}.{minor}"

    def content_name(self, digest: bytes) -> str:
        """Return the name of the entry for a `shmmap.layers.build.combined_digest` of its inputs."""
        made = struct.pack("<IHH4d", self.spec.builder_version, *LAYOUT_VERSION, *self.job.box)
        name: str = digest.hex() + xxhash.xxh3_64_hexdigest(str(self.spec).encode() + b"\0" + made)
        return name


class LayerCache:
    """The cache in one directory.

    Parameters
    ----------
    directory
        Created when the first entry is stored.
    limit_bytes
        Size limit of all files in it, objects of published maps included.

    Attributes
    ----------
    writable
        Whether to try to store entries; set by the users of this cache.
    """

    def __init__(self, directory: str, *, limit_bytes: int) -> None:
        self.directory = os.path.join(directory, LAYERS)
        self.budget = DiskBudget(directory, limit_bytes)
        self.writable = True

    def _opened(self, *, make: bool = False) -> contextlib.AbstractContextManager[int]:
        """Open the directory for one operation; it must be this account's or root's, and closed to others."""
        if make:
            refuse_planted_above(self.directory)
            with contextlib.suppress(FileExistsError):  # no directory, as the next line says
                os.makedirs(os.path.dirname(self.directory), mode=_MODE, exist_ok=True)
        return opened_private(self.directory, make=_MODE if make else 0, or_root=True)

    # --- lookup ---------------------------------------------------------------------------------

    def has(self, key: CacheKey) -> bool:
        """Whether an entry exists for this version whose header and size are valid."""
        return self.size_of(key) > 0

    def size_of(self, key: CacheKey) -> int:
        """Return the bytes of the entry for this version; 0 if there is none."""
        opened = self._open(key)
        if opened is None:
            return 0
        os.close(opened[0])
        return opened[1].total_bytes

    def _open(self, key: CacheKey) -> tuple[int, SegmentHeader] | None:
        path = _version_path(key)
        try:
            with self._opened() as place:
                fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=place)
        except OSError:
            return None
        try:
            status = os.fstat(fd)
            if not why_not_own(status, os.geteuid(), or_root=True):
                header = unpack_header(memoryview(read_page(fd, status.st_size)), status.st_size)
                if _is_of(header, key):
                    mark_used(fd, status)
                    return fd, header
        except (OSError, SegmentCorrupt, UnicodeDecodeError):
            self._remove(path)
        os.close(fd)
        return None

    def load(
        self, key: CacheKey, fd: int, *, reserve: Callable[[int], None] | None = None
    ) -> SegmentHeader | None:
        """Copy an entry into an empty segment file, and verify its checksums.

        Parameters
        ----------
        fd
            Empty file, open for writing; empty again if no entry is loaded.
        reserve
            Called with the segment's size in bytes before anything is written; raises to refuse it.

        Returns
        -------
        The segment's header, publish block empty; None if there is no entry, or a damaged one, which is
        removed.

        Raises
        ------
        OSError
            ENOSPC if there is no room for the segment.
        """
        opened = self._open(key)
        if opened is None:
            return None
        entry, found = opened
        try:
            header = msgspec.structs.replace(
                found, cell_id=key.job.cell_id, frame_id=key.job.frame_id, source=key.source
            )
            needed = header_size(len(header.columns), header.cell_id, header.layer, header.frame_id)
            if needed != found.header_bytes:
                return None  # the header has another length, so the columns would have to move
            if reserve is not None:
                reserve(header.total_bytes)
            os.ftruncate(fd, header.total_bytes)
            try:
                for at, block in checked_blocks(entry, header, _BLOCK_BYTES):
                    write_all(fd, block, at)
            except SegmentCorrupt:
                self._remove(_version_path(key), _content_path(key, header.source_digest))
                os.ftruncate(fd, 0)
                return None
            write_all(fd, memoryview(pack_header(header)), 0)
            return header
        finally:
            os.close(entry)

    def recognise(self, key: CacheKey, digest: bytes) -> bool:
        """Link an entry computed from the same content, if there is one, under this version's name."""
        with contextlib.suppress(OSError), self._opened() as place:
            _link(_content_path(key, digest), _version_path(key), place)
        return self.has(key)

    @property
    def is_empty(self) -> bool:
        """Whether the cache has no entries that `recognise` could find."""
        try:
            with self._opened() as place:
                return not os.listdir(within(place, _CONTENT))
        except OSError:
            return True

    # --- storing --------------------------------------------------------------------------------

    def make(self) -> None:
        """Create the directory, and check that files can be created in it.

        Raises
        ------
        CannotWrite
            The directory or files in it cannot be created.
        """
        try:
            with self._opened(make=True) as place:
                tempfile.TemporaryFile(dir=within(place)).close()
        except OSError as error:
            raise CannotWrite(
                f"layers cannot be kept in {self.directory}: {error.strerror}",
                hint="; ".join(filter(None, (getattr(error, "hint", ""), "name another --cache-dir"))),
            ) from None

    def store(self, key: CacheKey, header: SegmentHeader, fd: int) -> bool:
        """Store a finished segment whose publish block is still empty; return False if there is no room.

        Raises
        ------
        OSError
            The entry cannot be written.
        """
        with self._opened(make=True) as place:
            if not self.budget.has_room(header.total_bytes):
                return False
            interim_fd, interim = tempfile.mkstemp(prefix=INTERIM, dir=within(place))
            try:
                try:
                    _copy_all(fd, interim_fd, header.total_bytes)
                    os.fchmod(interim_fd, 0o644)
                finally:
                    os.close(interim_fd)
                version, content = _version_path(key), _content_path(key, header.source_digest)
                with contextlib.suppress(OSError):  # without hard links, the entry is found only by version
                    with contextlib.suppress(FileNotFoundError):
                        os.unlink(content, dir_fd=place)
                    _link(interim, content, place)
                _make_folders(version, place)
                os.rename(interim, version, dst_dir_fd=place)
            except BaseException:
                with contextlib.suppress(OSError):
                    os.unlink(interim)
                raise
        if self.budget.added(header.total_bytes):
            self.budget.trim()
        return True

    def _remove(self, *paths: str) -> None:
        with contextlib.suppress(OSError), self._opened() as place:
            for path in paths:
                with contextlib.suppress(OSError):
                    os.unlink(path, dir_fd=place)


def _version_path(key: CacheKey) -> str:
    name = key.version_name()
    return f"version/{name[:2]}/{name}.layer"


def _content_path(key: CacheKey, digest: bytes) -> str:
    name = key.content_name(digest)
    return f"{_CONTENT}/{name[:2]}/{name}.layer"


def _make_folders(path: str, place: int) -> None:
    folder = os.path.dirname(path)
    for made in (os.path.dirname(folder), folder):
        with contextlib.suppress(FileExistsError):
            os.mkdir(made, _MODE, dir_fd=place)


def _link(old: str, new: str, place: int) -> None:
    _make_folders(new, place)
    with contextlib.suppress(FileExistsError):
        os.link(old, new, src_dir_fd=place, dst_dir_fd=place)


def _is_of(header: SegmentHeader, key: CacheKey) -> bool:
    """Whether an entry matches its key; the cell's id may differ, as entries of a copied map are used."""
    same_layer = header.layer == str(key.spec) and header.builder_version == key.spec.builder_version
    return same_layer and header.box == key.job.box


def _copy_all(source: int, target: int, nbytes: int) -> None:
    at = 0
    while at < nbytes:
        block = os.pread(source, min(_BLOCK_BYTES * 4, nbytes - at), at)
        if not block:
            raise OSError("the segment is shorter than its header says")
        write_all(target, memoryview(block), at)
        at += len(block)
