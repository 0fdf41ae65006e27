# SPDX-License-Identifier: Apache-2.0
"""A catalogue on disk, so that the daemon of a large map need not read it anew at every start.

The file lies in the cache directory and is only ever a copy: a missing, old or damaged one costs
time, nothing else.  It names what it was made from (the metadata file and every directory that was
listed, each with size, mtime, ctime and inode) and counts only while all of that is unchanged.  A
file rewritten in place changes no directory, so its stamp here may be old: whoever loads the cell
compares, and `load(fresh=True)` looks at every file.

Layout, little-endian::

    0   8 bytes   magic "SHMMAPCT"
    8   uint32    version of this layout, 1
    12  uint32    bytes of the header
    16  uint64    XXH3 (64 bit) of everything after this field
    24  header    JSON: key, sources, prefix, cells, name_bytes, problems; then zero bytes to a multiple of 8
    ..  names     cells x name_bytes, zero padded; then zero bytes to a multiple of 8
    ..  boxes     float64: all min_x, all min_y, all max_x, all max_y
    ..  stamps    int64: size, mtime_ns, ctime_ns of each cell
"""

from __future__ import annotations

import os
import stat
import struct
import tempfile
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64, xxh3_64_hexdigest, xxh3_64_intdigest

from shmmap.errors import MapDataError
from shmmap.logfmt import log
from shmmap.origin.catalogue import Catalogue

__all__ = ["Source", "default_cache_directory", "load_sidecar", "save_sidecar", "sidecar_file"]

_MAGIC = b"SHMMAPCT"
_VERSION = 1
_START = struct.Struct("<8sIIQ")

# File systems stamp files by the kernel's coarse clock, which ticks every 1 to 10 ms: a change right
# after a scan can leave a directory's stamp as it was.  Younger sources are not trusted to be done.
_SETTLED_NS = 20_000_000


class Source(msgspec.Struct, frozen=True, array_like=True):
    """State of a file or directory that a catalogue was made from."""

    path: str
    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: str, status: os.stat_result) -> Source:
        """State of ``path`` as `os.stat` gave it.  A directory's size says nothing and counts as 0."""
        size = 0 if stat.S_ISDIR(status.st_mode) else status.st_size
        return cls(path, size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    key: str
    sources: list[Source]
    prefix: str
    cells: int
    name_bytes: int
    problems: list[str]


def default_cache_directory() -> str:
    """``$CACHE_DIRECTORY`` (set by systemd), else ``$XDG_CACHE_HOME/shmmap``, else ``~/.cache/shmmap``."""
    given = os.environ.get("CACHE_DIRECTORY", "").split(":")[0]
    if given:
        return given
    home = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(home):
        home = os.path.expanduser("~/.cache")
    return os.path.join(home, "shmmap")


def sidecar_file(cache_dir: str, key: str) -> str:
    """Where the catalogue of the map that ``key`` describes is kept."""
    return os.path.join(cache_dir, xxh3_64_hexdigest(os.fsencode(key)) + ".catalogue")


def load_sidecar(path: str, key: str) -> Catalogue | None:
    """Catalogue from the sidecar, or None when there is none, its sources changed, or it is damaged."""
    try:
        with open(path, "rb") as file:
            data = np.empty(os.fstat(file.fileno()).st_size, dtype=np.uint8)
            if file.readinto(data.data) != len(data):
                raise ValueError("it changed while it was read")
        header, rest = _check(data)
        if header.key != key or not _unchanged(header.sources):
            return None
        return _catalogue(header, rest)
    except FileNotFoundError:
        return None
    except OSError as error:
        log.warning("catalogue cache cannot be read", path=path, error=error.strerror)
        return None
    except (ValueError, MapDataError, msgspec.MsgspecError) as error:
        log.warning("damaged catalogue cache ignored", path=path, error=error)
        return None


def _check(data: NDArray[np.uint8]) -> tuple[_Header, NDArray[np.uint8]]:
    if len(data) < _START.size:
        raise ValueError("it is truncated")
    magic, version, header_bytes, digest = _START.unpack(data[: _START.size].tobytes())
    if magic != _MAGIC or version != _VERSION:
        raise ValueError("its magic or version is another")
    body = data[_START.size :]
    if xxh3_64_intdigest(body.data) != digest:
        raise ValueError("its checksum is wrong")
    header = msgspec.json.decode(body[:header_bytes].tobytes(), type=_Header)
    return header, body[_padded(header_bytes) :]


def _unchanged(sources: Sequence[Source]) -> bool:
    try:
        return all(Source.of(source.path, os.stat(source.path)) == source for source in sources)
    except OSError:
        return False


def _catalogue(header: _Header, body: NDArray[np.uint8]) -> Catalogue:
    names_bytes = header.cells * header.name_bytes
    boxes_start = _padded(names_bytes)
    stamps_start = boxes_start + header.cells * 32
    if len(body) != stamps_start + header.cells * 24:
        raise ValueError("its size contradicts its header")
    boxes = body[boxes_start:stamps_start].view(np.float64).reshape(4, -1).T
    return Catalogue(
        id_prefix=header.prefix,
        names=body[:names_bytes].view(f"S{header.name_bytes}"),
        boxes=boxes,
        stamps=body[stamps_start:].view(np.int64).reshape(-1, 3),
        problems=header.problems,
    )


def save_sidecar(
    path: str, key: str, sources: Sequence[Source], catalogue: Catalogue, scanned_ns: int
) -> bool:
    """Write the sidecar in one step; False (and a line in the log) if that was not possible.

    ``sources`` were looked at before the scan, which began at ``scanned_ns`` (`time.time_ns`).
    """
    newest = max(max(source.mtime_ns, source.ctime_ns) for source in sources)
    if newest > scanned_ns - _SETTLED_NS:
        return False
    names = np.ascontiguousarray(catalogue.names)
    header = msgspec.json.encode(
        _Header(
            key=key,
            sources=list(sources),
            prefix=catalogue.id_prefix,
            cells=len(catalogue),
            name_bytes=names.dtype.itemsize,
            problems=list(catalogue.problems),
        )
    )
    parts: list[bytes | memoryview] = [
        header.ljust(_padded(len(header)), b"\0"),
        names.tobytes().ljust(_padded(names.nbytes), b"\0"),
        np.ascontiguousarray(catalogue.boxes.T).data,
        np.ascontiguousarray(catalogue.stamps).data,
    ]
    digest = xxh3_64()
    for part in parts:
        digest.update(part)
    try:
        os.makedirs(os.path.dirname(path), mode=0o700, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=os.path.dirname(path), prefix=".catalogue-", delete=False
        ) as file:
            try:
                file.write(_START.pack(_MAGIC, _VERSION, len(header), digest.intdigest()))
                for part in parts:
                    file.write(part)
                file.flush()
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
    except OSError as error:
        log.warning("catalogue not cached", path=path, error=error.strerror)
        return False
    return True


def _padded(size: int) -> int:
    return -(-size // 8) * 8
