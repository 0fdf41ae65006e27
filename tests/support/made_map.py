# SPDX-License-Identifier: Apache-2.0
"""A published map of any number of cells, whose objects are generated on request.

``python -m tests.support.made_map CELLS POINTS`` serves one until stdin is closed.  It prints its port and
other attributes of `ServedMadeMap`, and answers each line of stdin with the numbers of cells' objects and of
other objects that it has sent whole.

An object is a pure function of its cell's number.  The points are those of one of a few patterns, in the box
of the first cell wherever the cell lies; the last bytes of the object, which only fill it up to a multiple of
64, hold the number.  So no two objects are equal, and what is hashed of a pattern is hashed once: name and
content digest of a cell take microseconds, and a root of ten million cells half a minute.
"""

from __future__ import annotations

import json
import math
import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zstandard

from shmmap.formats.pcd.writer import write_pcd
from shmmap.layers.points import build_points
from shmmap.layers.spec import layer_spec
from shmmap.origin.remote.map_versions import CURRENT, Current, pack_json
from shmmap.origin.remote.published_index import EXACT, LayerObjects, Root, Shard, pack_root, pack_shard
from shmmap.origin.remote.published_object import POINTS, bare_object, blob_path
from shmmap.origin.remote.zstd_frame import LEVEL, pack_frame
from tests.support.daemon_process import LineProcess
from tests.support.web_servers import faulty_web

if TYPE_CHECKING:
    from hashlib import _Hash

CELL_M: Final = 20.0
SHARD_CELLS: Final = 32
SHARD_M: Final = SHARD_CELLS * CELL_M
PATTERNS: Final = 16
NAME_BYTES: Final = 12
"""Bytes of the hash in a cell's name: so the index has as many bytes per cell as a recorded map's (89),
although here sizes and heights of cells repeat."""
_NUMBER: Final = struct.Struct("<Q")
_RAW_BLOCK: Final = (1 | _NUMBER.size << 3).to_bytes(3, "little")
"""Header of the last block of a zstd frame, which is not compressed (RFC 8878, 3.1.1.2)."""
_SPREAD: Final = 2654435761
"""Knuth's: neighbouring cells have different patterns."""


@dataclass(frozen=True, eq=False)
class _Pattern:
    """The common beginning of some cells' objects, packed and unpacked, and its hashes."""

    begin: bytes
    begin_sha256: _Hash
    content_sha256: _Hash
    size: int
    raw: int
    points: int
    z: tuple[float, float]

    def frame(self, number: int) -> bytes:
        """Return the object of a cell."""
        return self.begin + _RAW_BLOCK + _NUMBER.pack(number)

    def digests(self, number: int) -> tuple[bytes, bytes]:
        """Return the SHA-256 of an object and of its unpacked content."""
        end = _NUMBER.pack(number)
        name, content = self.begin_sha256.copy(), self.content_sha256.copy()
        name.update(_RAW_BLOCK + end)
        content.update(end)
        return name.digest(), content.digest()


def _rough_ground(rng: np.random.Generator, points: int) -> dict[str, Any]:
    """Points of one cell: in order of their columns, to the centimetre, as a recorded map has them."""
    xy = rng.uniform(0.01, CELL_M - 0.01, (points, 2))
    xy = np.round(xy[np.lexsort((xy[:, 1], np.floor(xy[:, 0])))], 2)
    z = np.round(0.3 * np.sin(xy[:, 1]) + rng.normal(0, 0.02, points), 3) + rng.uniform(20, 40)
    xyz = np.column_stack((xy, z)).astype(np.float32)
    return {"xyz": xyz, "intensity": np.round(rng.uniform(0, 1, points), 2).astype(np.float32)}


def _make_pattern(seed: int, points: int) -> _Pattern:
    rng = np.random.default_rng(seed)
    # the last column ends in the middle between multiples of 64: there is room for a number behind it
    points = round(points * rng.uniform(0.5, 1.5)) // 16 * 16 + 8
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cell.pcd")
        write_pcd(path, _rough_ground(rng, points))
        fd = os.memfd_create("segment")
        header = build_points(str(path), fd, cell_id="/cell", box=(0.0, 0.0, CELL_M, CELL_M))
        segment = os.pread(fd, header.total_bytes, 0)
        os.close(fd)
    unpacked = bytes(bare_object(memoryview(segment)))
    begin = unpacked[: -_NUMBER.size]
    assert not any(unpacked[len(begin) :]), "they are padding"
    packer = zstandard.ZstdCompressor(level=LEVEL, write_content_size=True).compressobj(size=len(unpacked))
    packed = packer.compress(begin) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    z = header.z_min, header.z_max
    size = len(packed) + len(_RAW_BLOCK) + _NUMBER.size
    return _Pattern(packed, sha256(packed), sha256(begin), size, len(unpacked), header.rows, z)


class MadeMap:
    """A square of cells of 20 m from (0, 0); about ``points`` points in each.

    Attributes
    ----------
    side
        Cells along each side.
    """

    def __init__(self, cells: int, points: int) -> None:
        self.side = max(1, math.isqrt(cells))
        self._patterns = [_make_pattern(seed, points) for seed in range(PATTERNS)]
        self._cells: dict[bytes, int] = {}

    @property
    def mean_object_bytes(self) -> float:
        """Mean size of an object."""
        return sum(pattern.size for pattern in self._patterns) / PATTERNS

    @property
    def _shards_along(self) -> int:
        return -(-self.side // SHARD_CELLS)

    def _pattern(self, number: int) -> _Pattern:
        return self._patterns[(number * _SPREAD >> 12) % PATTERNS]

    def shard(self, row: int, column: int) -> Shard:
        """Make a shard."""
        spans = [
            range(begin, min(begin + SHARD_CELLS, self.side))
            for begin in (row * SHARD_CELLS, column * SHARD_CELLS)
        ]
        rows = []
        for y in spans[0]:
            for x in spans[1]:
                number = y * self.side + x
                pattern = self._pattern(number)
                name, content = pattern.digests(number)
                rows.append(
                    (f"{x}_{y}_{content[:NAME_BYTES].hex()}.pcd".encode(), x, y, pattern, name, content)
                )
        rows.sort(key=itemgetter(0))
        names, xs, ys, patterns, hashes, contents = zip(*rows, strict=True)
        low = np.array([xs, ys], dtype=np.float64).T * CELL_M
        objects = LayerObjects(
            np.array([pattern.size for pattern in patterns], np.uint32),
            np.array([pattern.raw for pattern in patterns], np.uint32),
            np.frombuffer(b"".join(hashes), np.uint8).reshape(-1, 32),
            np.frombuffer(b"".join(contents), np.uint8).reshape(-1, 32),
        )
        return Shard(
            names,
            np.hstack([low, low + CELL_M]),
            np.array([pattern.z for pattern in patterns]),
            np.array([pattern.points for pattern in patterns], np.uint32),
            {POINTS: objects},
        )

    def _shard_row(self, number: int) -> tuple[int, int, bytes]:
        """Cells of a shard by its number, bytes of its object, and their SHA-256."""
        shard = self.shard(*divmod(number, self._shards_along))
        frame = pack_frame(pack_shard(shard))
        return len(shard), len(frame), sha256(frame).digest()

    @cached_property
    def root(self) -> Root:
        """The map's root; all shards are made for it once."""
        numbers = range(self._shards_along**2)
        rows = [self._shard_row(number) for number in numbers]
        extent = self.side * CELL_M
        return Root(
            id_prefix="/made/",
            frame_id="map",
            crs="",
            origin=(0.0, 0.0, 0.0),
            unit_m=(1.0, 1.0),
            encoding=EXACT,
            cells=self.side**2,
            bounds=(0.0, 0.0, extent, extent),
            shard_m=SHARD_M,
            largest_m=(CELL_M, CELL_M),
            mean_m=(CELL_M, CELL_M),
            layers={POINTS: layer_spec(POINTS).builder_version},
            keys=np.array([divmod(number, self._shards_along) for number in numbers], np.int32),
            counts=np.array([cells for cells, _, _ in rows], np.uint32),
            sizes=np.array([size for _, size, _ in rows], np.uint32),
            hashes=np.frombuffer(b"".join(digest for _, _, digest in rows), np.uint8).reshape(-1, 32),
        )

    @cached_property
    def _root_frame(self) -> bytes:
        return pack_frame(pack_root(self.root))

    @cached_property
    def _index(self) -> dict[str, int]:
        """Numbers of shards by their path; of the root -1."""
        paths = {blob_path(self.root.shard_sha256(number)): number for number in range(len(self.root.keys))}
        return paths | {blob_path(sha256(self._root_frame).digest()): -1}

    def read(self, path: str) -> bytes:
        """Make the object at a path; FileNotFoundError where there is none.

        A cell's is known once its shard was read: nothing else says its name.
        """
        if path == CURRENT:
            frame = self._root_frame
            return pack_json(Current(1, sha256(frame).hexdigest(), len(frame)))
        number = self._index.get(path)
        if number is not None:
            return self._root_frame if number < 0 else self._shard_frame(number)
        try:
            cell = self._cells[bytes.fromhex(path.rpartition("/")[2])]
        except (KeyError, ValueError):
            raise FileNotFoundError(path) from None
        return self._pattern(cell).frame(cell)

    def cells(self) -> Iterator[bytes]:
        """SHA-256 of the objects of all cells whose shards were read."""
        yield from list(self._cells)

    def is_cell(self, path: str) -> bool:
        """Whether it is the path of a cell's object."""
        return path.startswith("blobs/") and path not in self._index

    def _shard_frame(self, number: int) -> bytes:
        shard = self.shard(*divmod(number, self._shards_along))
        places = (shard.boxes[:, :2] / CELL_M).astype(int).tolist()
        for digest, (x, y) in zip(shard.layers[POINTS].hashes, places, strict=True):
            self._cells[digest.tobytes()] = y * self.side + x
        return pack_frame(pack_shard(shard))


class ServedMadeMap:
    """A map that is served on loopback.

    Attributes
    ----------
    port
        Of its server.
    side
        Cells along each side.
    mean_object_bytes, index_bytes_per_cell
        Mean size of a cell's object, and bytes of the shards per cell.
    """

    def __init__(self, process: LineProcess) -> None:
        self._process = process
        first = json.loads(process.read())
        self.port, self.side, self.mean_object_bytes, self.index_bytes_per_cell = first

    def sent(self) -> tuple[int, int]:
        """Numbers of cells' objects, and of other objects, sent whole so far."""
        self._process.write()
        cells, others = map(int, self._process.read().split())
        return cells, others

    def cells_sent(self) -> int:
        """Number of cells' objects sent whole so far."""
        return self.sent()[0]

    @property
    def url(self) -> str:
        """Where it is."""
        return f"http://127.0.0.1:{self.port}"


@contextmanager
def serve_made_map(cells: int, points: int) -> Iterator[ServedMadeMap]:
    """Serve a map by a process of its own until the end of the block."""
    with LineProcess(sys.executable, "-m", "tests.support.made_map", str(cells), str(points)) as process:
        yield ServedMadeMap(process)


def main() -> None:
    """Serve until stdin is closed."""
    made = MadeMap(int(sys.argv[1]), int(sys.argv[2]))
    index_bytes = int(made.root.sizes.sum(dtype=np.uint64)) / made.root.cells
    with faulty_web(made.read) as web:
        port = int(web.url.rpartition(":")[2])
        print(json.dumps([port, made.side, made.mean_object_bytes, index_bytes]), flush=True)
        cells = others = 0
        for _ in sys.stdin:
            whole = [made.is_cell(path) for path, status in web.requests() if status == 200]
            cells += sum(whole)
            others += len(whole) - sum(whole)
            print(cells, others, flush=True)


if __name__ == "__main__":
    main()
