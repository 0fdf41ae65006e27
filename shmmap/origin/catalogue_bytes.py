# SPDX-License-Identifier: Apache-2.0
"""Writes and reads a catalogue as bytes, for a cache file or a pipe (`shmmap.origin.reading_apart`).

Layout, little-endian::

    0   8 bytes   magic "SHMMAPCT"
    8   uint32    version of this layout, 2
    12  uint32    bytes of the header
    16  uint64    XXH3 (64 bit) of everything after this field
    24  header    JSON, see `Header`
    ..  names     cells x name_bytes, zero padded
    ..  boxes     float64: all min_x, all min_y, all max_x, all max_y
    ..  stamps    int64: size, mtime_ns, ctime_ns of each cell
    ..  by_base   int32, as many as the header says: `shmmap.origin.cell_names.order_by_base`
    ..  grids     for each grid of the header: keys, int64; cells, int32 (`shmmap.origin.spatial_index.Grid`)

Zero bytes pad the header and each column to a multiple of 8.  The last two columns follow from names and
boxes.  They are stored because computing them takes longer than reading everything.

A reader takes one column after the other.  Names and boxes that equal those of the map's previous state are
shared with it: when the files of a million cells have changed, a new state takes 24 bytes a cell.  A reader
may pass the digest of its names and boxes: if they are the same, it receives only the stamps.

The file in the cache directory, the *sidecar*, is only a copy: if it is missing, old or damaged, this costs
time, nothing else.  It lists its sources (the metadata file and every directory that was listed, each with
size, mtime, ctime and inode) and is valid only while all of them are unchanged.  A file rewritten in place
changes no directory, so its stamp here may be old: the loader of the cell compares it, and
`MapDirectory.load(fresh=True)` reads the stamp of every file.
"""

from __future__ import annotations

import math
import os
import stat
import struct
import tempfile
from collections.abc import Callable, Sequence
from typing import IO, Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64, xxh3_64_hexdigest

from shmmap.errors import MapDataError
from shmmap.logfmt import log
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.spatial_index import Grid, GridFrame, MadeOfBoxes
from shmmap.private_directory import refuse_planted_above, why_not_own

_MAGIC: Final = b"SHMMAPCT"
_VERSION: Final = 2
_START: Final = struct.Struct("<8sIIQ")
_BLOCK_BYTES: Final = 1 << 18
_MAX_NAME_BYTES: Final = 1 << 16
"""Limit of a name's length in bytes, far above that of any path."""
_FLOAT64, _INT64, _INT32 = np.dtype("<f8"), np.dtype("<i8"), np.dtype("<i4")


class Source(msgspec.Struct, frozen=True, array_like=True):
    """State of a file or directory that a catalogue was made from."""

    path: str
    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: str, status: os.stat_result) -> Source:
        """Return the state of ``path`` from its `os.stat` result; a directory's size is set to 0."""
        size = 0 if stat.S_ISDIR(status.st_mode) else status.st_size
        return cls(path, size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)


class Header(msgspec.Struct, forbid_unknown_fields=True):
    """The JSON header in front of the columns.

    Attributes
    ----------
    key
        Parameters of the request that the catalogue answers.
    sources
        Files and directories that the catalogue was made from.
    prefix, problems
        As in `Catalogue`.
    cells, name_bytes
        Number of cells; length of the longest name in bytes.
    by_base
        Number of entries in column ``by_base``: 0, or one per cell.
    bounds, mean_size
        As in `Catalogue`.
    grids
        Position of each grid, and its number of cells; empty for a map of few cells.
    fixed_digest
        As in `Catalogue`.
    stamps_only
        Only the stamps follow, because the reader already has names and boxes.
    """

    key: str
    sources: list[Source]
    prefix: str
    cells: int
    name_bytes: int
    problems: list[str]
    by_base: int
    bounds: tuple[float, float, float, float] | None
    mean_size: tuple[float, float]
    grids: list[tuple[GridFrame, int]]
    fixed_digest: int
    stamps_only: bool

    def columns(self) -> list[tuple[np.dtype[Any], tuple[int, ...]]]:
        """Return dtype and shape of each column that follows."""
        if self.stamps_only:
            return [(_INT64, (self.cells, 3))]
        names = np.dtype(f"S{self.name_bytes}"), (self.cells,)
        found: list[tuple[np.dtype[Any], tuple[int, ...]]] = [
            names,
            (_FLOAT64, (4, self.cells)),
            (_INT64, (self.cells, 3)),
            (_INT32, (self.by_base,)),
        ]
        for _, cells in self.grids:
            found += [(_INT64, (cells,)), (_INT32, (cells,))]
        return found

    def check(self) -> None:
        """Check that the header can describe a catalogue.

        Raises
        ------
        ValueError
            The header is inconsistent.
        """
        in_grids = [cells for _, cells in self.grids]
        if (
            min(self.cells, self.by_base, *in_grids) < 0
            or not 0 < self.name_bytes <= _MAX_NAME_BYTES
            or self.by_base not in (0, self.cells)
            or sum(in_grids) not in (0, self.cells)
        ):
            raise ValueError("its header makes no sense")


# created at import: msgspec crashes the process if two threads decode a type for the first time at once
_HEADER: Final = msgspec.json.Decoder(Header)


def write_catalogue(
    file: IO[bytes],
    key: str,
    sources: Sequence[Source],
    catalogue: Catalogue,
    known_digest: int | None = None,
) -> None:
    """Write a catalogue and its sources.

    ``known_digest`` is `Catalogue.fixed_digest` of the catalogue that the reader already has.
    """
    made, stamps_only = catalogue.made_of_boxes, catalogue.fixed_digest == known_digest
    header = msgspec.json.encode(
        Header(
            key=key,
            sources=list(sources),
            prefix=catalogue.id_prefix,
            cells=len(catalogue),
            name_bytes=catalogue.names.dtype.itemsize,
            problems=list(catalogue.problems),
            by_base=len(catalogue.by_base),
            bounds=made.bounds,
            mean_size=made.mean_size,
            grids=[(grid.frame, len(grid.cells)) for grid in made.grids],
            fixed_digest=catalogue.fixed_digest,
            stamps_only=stamps_only,
        )
    )
    columns: list[NDArray[Any]] = [catalogue.stamps]
    if not stamps_only:
        columns = [catalogue.names, catalogue.boxes.T, catalogue.stamps, catalogue.by_base]
        columns += [column for grid in made.grids for column in (grid.keys, grid.cells)]
    parts: list[bytes | memoryview] = [header, bytes(_padding(len(header)))]
    for column in columns:
        parts.append(np.ascontiguousarray(column).reshape(-1).view(np.uint8).data)
        parts.append(bytes(_padding(column.nbytes)))
    digest = xxh3_64()
    for part in parts:
        digest.update(part)
    file.write(_START.pack(_MAGIC, _VERSION, len(header), digest.intdigest()))
    for part in parts:
        file.write(part)


def read_catalogue(
    file: IO[bytes], size_bytes: int | None = None, before: Catalogue | None = None
) -> tuple[Header, Catalogue]:
    """Read a catalogue up to the end of a file or pipe.

    Parameters
    ----------
    size_bytes
        Size of the file; None for a pipe, whose writer is trusted.
    before
        An earlier state: columns that have not changed are shared with it.

    Raises
    ------
    ValueError, msgspec.MsgspecError, MapDataError
        The data is damaged or truncated.
    """
    columns = _Columns(file)
    start = bytearray(_START.size)
    columns.fill(memoryview(start))
    magic, version, header_bytes, digest = _START.unpack(start)
    if magic != _MAGIC or version != _VERSION:
        raise ValueError("its magic or version is another")
    columns.digest.reset()
    after_header = _START.size + header_bytes + _padding(header_bytes)
    if size_bytes is not None and size_bytes < after_header:
        raise ValueError("it is truncated")
    written = memoryview(bytearray(after_header - _START.size))
    columns.fill(written)
    header = _HEADER.decode(written[:header_bytes])
    header.check()
    shapes = header.columns()
    sizes = [dtype.itemsize * math.prod(shape) for dtype, shape in shapes]
    if size_bytes is not None and size_bytes != after_header + sum(size + _padding(size) for size in sizes):
        raise ValueError("its size contradicts its header")
    if header.stamps_only:
        if before is None or before.fixed_digest != header.fixed_digest:
            raise ValueError("it has stamps alone, of other cells")
        made, by_base, names, boxes = before.made_of_boxes, before.by_base, before.names, before.boxes
        stamps = columns.take(*shapes[0], None)
    else:
        # stamps are not shared: they are corrected in place
        names = columns.take(*shapes[0], before.names if before is not None else None)
        sides = columns.take(*shapes[1], there := before.boxes.T if before is not None else None)
        stamps = columns.take(*shapes[2], None)
        by_base, *grids = (columns.take(*shape, None) for shape in shapes[3:])
        boxes = before.boxes if before is not None and sides is there else sides.T
        frames = [frame for frame, _ in header.grids]
        made = MadeOfBoxes(tuple(map(Grid, frames, grids[::2], grids[1::2])), header.bounds, header.mean_size)
    if columns.digest.intdigest() != digest:
        raise ValueError("its checksum is wrong")
    return header, Catalogue(
        id_prefix=header.prefix,
        names=names,
        boxes=boxes,
        stamps=stamps,
        problems=header.problems,
        before=before,
        by_base=by_base,
        made=made,
        fixed_digest=header.fixed_digest,
    )


class _Columns:
    """Reads columns from a file or pipe, one after the other, and hashes them."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.digest = xxh3_64()

    def fill(self, buffer: memoryview) -> None:
        """Read bytes until ``buffer`` is full."""
        for begin in range(0, len(buffer), _BLOCK_BYTES):
            block = buffer[begin : begin + _BLOCK_BYTES]
            if self._file.readinto(block) != len(block):  # type: ignore[attr-defined]
                raise ValueError("it is truncated")
            self.digest.update(block)

    def take(self, dtype: np.dtype[Any], shape: tuple[int, ...], before: NDArray[Any] | None) -> NDArray[Any]:
        """Read one column; return ``before`` itself if it has the same bytes."""
        size = dtype.itemsize * math.prod(shape)
        column: NDArray[np.uint8] | None = None
        done = 0
        if before is not None and before.dtype == dtype and before.shape == shape:
            old = before.reshape(-1).view(np.uint8)
            block = np.empty(min(size, _BLOCK_BYTES), np.uint8)
            while column is None and done < size:
                part, there = block[: size - done], old[done : done + _BLOCK_BYTES]
                self.fill(part.data)
                if not np.array_equal(part, there):
                    column = np.empty(size, np.uint8)
                    column[:done], column[done : done + len(part)] = old[:done], part
                done += len(part)
            if column is None:
                self._pass_padding(size)
                return before
        else:
            column = np.empty(size, np.uint8)
        self.fill(column[done:].data)
        self._pass_padding(size)
        return column.view(dtype).reshape(shape)

    def _pass_padding(self, size: int) -> None:
        self.fill(memoryview(bytearray(_padding(size))))


def _padding(size: int) -> int:
    """Return the zero bytes that pad ``size`` bytes to a multiple of 8."""
    return -size % 8


# File systems stamp files by the kernel's coarse clock, which ticks every 1 to 10 ms: a change right
# after a scan can leave a directory's stamp unchanged.  A catalogue of younger sources is not cached.
_SETTLED_NS = 20_000_000


def default_cache_directory() -> str:
    """Return ``$CACHE_DIRECTORY`` (of systemd), ``$XDG_CACHE_HOME/shmmap`` or ``~/.cache/shmmap``."""
    given = os.environ.get("CACHE_DIRECTORY", "").split(":")[0]
    if given:
        return given
    home = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(home):
        home = os.path.expanduser("~/.cache")
    return os.path.join(home, "shmmap")


def sidecar_file(cache_dir: str, key: str) -> str:
    """Return the path of the sidecar for the map that ``key`` describes."""
    return os.path.join(cache_dir, xxh3_64_hexdigest(os.fsencode(key)) + ".catalogue")


def load_sidecar(path: str, key: str, at: Callable[[str], str] = str) -> Catalogue | None:
    """Return the catalogue of a sidecar; None if it is missing or damaged, or its sources have changed.

    ``at`` translates a source's path into the path under which this process can open it.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        with open(fd, "rb") as file:
            status = os.fstat(fd)
            if why := why_not_own(status, os.geteuid(), or_root=True):
                raise ValueError(f"it {why}")
            header, catalogue = read_catalogue(file, status.st_size)
        return catalogue if header.key == key and _unchanged(header.sources, at) else None
    except FileNotFoundError:
        return None
    except OSError as error:
        log.warning("catalogue cache cannot be read", path=path, error=error.strerror)
        return None
    except (ValueError, MapDataError, msgspec.MsgspecError) as error:
        log.warning("damaged catalogue cache ignored", path=path, error=error)
        return None


def _unchanged(sources: Sequence[Source], at: Callable[[str], str]) -> bool:
    try:
        return all(Source.of(source.path, os.stat(at(source.path))) == source for source in sources)
    except OSError:
        return False


def save_sidecar(
    path: str, key: str, sources: Sequence[Source], catalogue: Catalogue, scanned_ns: int
) -> bool:
    """Write the sidecar atomically; return False if a source is too young, or (logged) if writing fails.

    The state of ``sources`` was read before the scan, which began at ``scanned_ns`` (`time.time_ns`).
    """
    newest = max(max(source.mtime_ns, source.ctime_ns) for source in sources)
    if newest > scanned_ns - _SETTLED_NS:
        return False
    try:
        refuse_planted_above(path)
        os.makedirs(os.path.dirname(path), mode=0o700, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=os.path.dirname(path), prefix=".catalogue-", delete=False
        ) as file:
            try:
                write_catalogue(file, key, sources, catalogue)
                file.flush()
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
    except OSError as error:
        log.warning("catalogue not cached", path=path, error=error.strerror)
        return False
    return True
