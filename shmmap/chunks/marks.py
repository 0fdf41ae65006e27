# SPDX-License-Identifier: Apache-2.0
"""Marks of one scan, as bytes: for each chunk the words with hits, then those with misses.

``CHUNKS.md`` is the byte-exact specification.  Decoding does not trust the bytes.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from shmmap.chunks.voxels import CHUNK_SHIFT, FURTHEST_INDEX, WORDS, ChunkKey
from shmmap.errors import BadRequest

if TYPE_CHECKING:
    from numpy.typing import NDArray

MARKS_VERSION: Final = (1, 0)
MAX_CHUNKS: Final = 4096
"""Most chunks that one scan may touch."""

_MAGIC: Final = b"SHMMARKS"
_ORDER: Final = 0x01020304
_HEADER: Final = struct.Struct("<8sHHI16sIIQQ8x")
_ROW: Final = np.dtype([("key", "<i4", (3,)), ("hits", "<u4"), ("misses", "<u4"), ("reserved", "<u4")])
_WORD_BYTES: Final = 10


class Marks(msgspec.Struct, frozen=True, eq=False):
    """The voxels that a scan hits, and those that it passes through; no voxel is in both sets.

    Attributes
    ----------
    keys
        (C, 3) int32: the chunks touched, each once.
    hits, misses
        (C,) uint32: number of words in each chunk with hit voxels, and with voxels passed through.
    bits, words
        (W,) uint64 and uint16: the 64 voxels of each word, x fastest, lowest bit first; and the word's number
        in its chunk, of 4096.  Ordered by chunk as in ``keys``, hits before misses, then by number.
    """

    keys: NDArray[np.int32]
    hits: NDArray[np.uint32]
    misses: NDArray[np.uint32]
    bits: NDArray[np.uint64]
    words: NDArray[np.uint16]

    @property
    def chunks(self) -> list[ChunkKey]:
        """The chunks touched."""
        return [ChunkKey(*key) for key in self.keys.tolist()]

    @property
    def starts(self) -> NDArray[np.int64]:
        """Index of each chunk's first word, and the total, (C + 1,)."""
        ends = np.cumsum(self.hits.astype(np.int64) + self.misses.astype(np.int64))
        return np.concatenate(([0], ends))


def marks_bytes(chunks: int, words: int) -> int:
    """Return the length of marks with this many chunks and words, bytes."""
    return _HEADER.size + chunks * _ROW.itemsize + words * _WORD_BYTES


def encode_marks(marks: Marks, map_id: bytes, mapper: int, scan: int) -> bytes:
    """Return marks as bytes.

    Parameters
    ----------
    map_id
        Id of the map, 16 bytes.
    mapper, scan
        The mapper's number from the daemon, and the scan's number.
    """
    rows = np.zeros(len(marks.keys), _ROW)
    rows["key"], rows["hits"], rows["misses"] = marks.keys, marks.hits, marks.misses
    header = _HEADER.pack(_MAGIC, *MARKS_VERSION, _ORDER, map_id, mapper, len(rows), scan, len(marks.words))
    bits, words = marks.bits.astype("<u8", copy=False), marks.words.astype("<u2", copy=False)
    return b"".join((header, rows.tobytes(), bits.tobytes(), words.tobytes()))


def decode_marks(data: bytes | memoryview, map_id: bytes, mapper: int, scan: int) -> Marks:
    """Read marks, and check all of them.

    Parameters
    ----------
    data
        Memory that no other process writes to.
    map_id, mapper, scan
        Expected map, mapper and scan.

    Raises
    ------
    BadRequest
        The marks are for another map, mapper or scan, or are invalid; the message contains the reason.
    """
    if len(data) < _HEADER.size:
        raise BadRequest(f"marks: {len(data)} bytes are too few for their header")
    magic, major, minor, order, for_map, of, chunks, number, count = _HEADER.unpack_from(data)
    if magic != _MAGIC or order != _ORDER:
        raise BadRequest("marks: these bytes are something else")
    if major != MARKS_VERSION[0]:
        raise BadRequest(f"marks: version {major}.{minor}; this daemon reads {MARKS_VERSION[0]}")
    if (for_map, of, number) != (map_id, mapper, scan):
        raise BadRequest(f"marks: they are scan {number} of mapper {of}, not scan {scan} of mapper {mapper}")
    if chunks > MAX_CHUNKS:
        raise BadRequest(f"marks: {chunks} chunks; {MAX_CHUNKS} is the most one scan may touch")
    if count > 2 * chunks * WORDS or len(data) != marks_bytes(chunks, count):
        raise BadRequest(f"marks: {len(data)} bytes, not those of {chunks} chunks and {count} words")
    at = _HEADER.size
    rows = np.frombuffer(data, _ROW, chunks, at)
    at += rows.nbytes
    bits = np.frombuffer(data, "<u8", count, at)
    words = np.frombuffer(data, "<u2", count, at + bits.nbytes)
    marks = Marks(rows["key"].copy(), rows["hits"].copy(), rows["misses"].copy(), bits, words)
    _check(marks)
    return marks


def _check(marks: Marks) -> None:
    keys, words = marks.keys, marks.words
    most = FURTHEST_INDEX >> CHUNK_SHIFT
    if ((keys < -most) | (keys >= most)).any():
        raise BadRequest("marks: a chunk lies further away than voxels do")
    if len(np.unique(keys, axis=0)) != len(keys):
        raise BadRequest("marks: a chunk is named twice")
    counts = np.stack([marks.hits, marks.misses], axis=1).astype(np.int64).reshape(-1)
    if (counts > WORDS).any() or counts.sum() != len(words):
        raise BadRequest("marks: the chunks' words are more or fewer than there are")
    if (words >= WORDS).any() or (marks.bits == 0).any():
        raise BadRequest("marks: a word has no place in a chunk, or no voxels")
    rises = np.diff(words.astype(np.int32)) > 0
    begins = np.cumsum(counts)[:-1]
    rises[begins[(begins > 0) & (begins < len(words))] - 1] = True
    if not rises.all():
        raise BadRequest("marks: the words of a chunk are not in rising order")
