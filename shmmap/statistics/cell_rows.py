# SPDX-License-Identifier: Apache-2.0
"""Rows about segments in the statistics segment: which cell, how large, how old, how much used."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final

from shmmap.errors import SegmentCorrupt

__all__ = ["CELL_ROW_BYTES", "MAX_CELLS", "CellRow", "pack_cell", "unpack_cell"]

CELL_ROW: Final = struct.Struct("<QQQ4dQqq16sBBHHH40s104sI")
CELL_ROW_BYTES: Final = CELL_ROW.size + 4
MAX_CELLS: Final = 1 << 17  # 32 MiB of rows; more cells than that are counted, not listed

CELL_STATES: Final = ("free", "resident", "stale", "zombie")
ID_BYTES: Final = 104
LAYER_BYTES: Final = 40
ID_CUT: Final = 1
LAYER_CUT: Final = 2
AHEAD: Final = 4


@dataclass(slots=True)
class CellRow:
    """One segment the daemon keeps.

    Attributes
    ----------
    id
        Cell id without the daemon's ``id_prefix``.  Of an id longer than 104 bytes of UTF-8 the
        table keeps only the end, and ``id_cut`` says so.
    layer
        Layer spec; of one that fits into the row neither by itself nor behind the id only the beginning is
        kept (``layer_cut``).
    version
        64-bit version, as in the handle.
    segment
        Segment name without the prefix ``/shmmap.<instance>.``, at most 16 bytes.
    state
        ``resident``, ``stale`` (its source has changed) or ``zombie`` (retired, but still in use).
    bytes
        Memory it occupies, as measured.
    points
        Rows of its columns.
    box
        (min_x, min_y, max_x, max_y), metres, map frame.
    hits
        How often it was handed out.
    last_use_monotonic_ns
        When it was last handed out, CLOCK_MONOTONIC.
    load_ns
        How long loading it took.
    ahead
        It was fetched ahead, and not asked for yet.
    """

    id: str
    layer: str
    version: int
    segment: str
    state: str
    bytes: int
    points: int
    box: tuple[float, float, float, float]
    hits: int = 0
    last_use_monotonic_ns: int = 0
    load_ns: int = 0
    id_cut: bool = False
    layer_cut: bool = False
    ahead: bool = False

    @property
    def whole_layer(self) -> str:
        """The layer, with a mark where its end is missing."""
        return f"{self.layer}…" if self.layer_cut else self.layer


def _fit(text: str, limit: int, *, keep_end: bool) -> tuple[bytes, bool]:
    data = text.encode("utf-8", "surrogateescape")
    if len(data) <= limit:
        return data, False
    if keep_end:
        data = data[-limit:]
        while data and data[0] & 0xC0 == 0x80:  # never begin inside a character
            data = data[1:]
        return data, True
    return data[:limit].decode("utf-8", "ignore").encode(), True


def pack_cell(row: CellRow) -> bytes:
    """Return the 256 bytes of one cell row; what a long layer's field lacks lies behind the id."""
    cell_id, id_cut = _fit(row.id, ID_BYTES, keep_end=True)
    whole = row.layer.encode("utf-8", "surrogateescape")
    layer_cut = len(whole) > LAYER_BYTES
    if len(cell_id) + len(whole) > ID_BYTES + LAYER_BYTES:
        whole, _ = _fit(row.layer, LAYER_BYTES, keep_end=False)
    layer, rest = whole[:LAYER_BYTES], whole[LAYER_BYTES:]
    flags = id_cut * ID_CUT + layer_cut * LAYER_CUT + row.ahead * AHEAD
    packed = CELL_ROW.pack(
        row.version, row.bytes, row.points, *row.box, row.hits, row.last_use_monotonic_ns, row.load_ns,
        row.segment.encode(), CELL_STATES.index(row.state), flags, len(cell_id), len(whole), 0,
        layer, cell_id + rest, 0,
    )  # fmt: skip
    return packed + struct.pack("<I", zlib.crc32(packed))


def unpack_cell(data: memoryview) -> CellRow | None:
    """Return one row; None if it is free.

    Raises
    ------
    SegmentCorrupt
        If it is torn: the writer was changing it.
    """
    if zlib.crc32(data[: CELL_ROW.size]) != int.from_bytes(data[CELL_ROW.size : CELL_ROW.size + 4], "little"):
        raise SegmentCorrupt("a row of the statistics is torn")
    (
        version, nbytes, points, min_x, min_y, max_x, max_y, hits, last_use, load_ns,
        segment, state, flags, id_length, layer_length, _, layer, cell_id, _,
    ) = CELL_ROW.unpack_from(data)  # fmt: skip
    if not state:
        return None
    rest = max(0, layer_length - LAYER_BYTES)
    if rest:
        layer += cell_id[id_length : id_length + rest]
    return CellRow(
        id=cell_id[:id_length].decode("utf-8", "surrogateescape"),
        layer=layer[:layer_length].decode("utf-8", "surrogateescape"),
        version=version,
        segment=segment.rstrip(b"\0").decode(),
        state=CELL_STATES[state] if state < len(CELL_STATES) else "unknown",
        bytes=nbytes,
        points=points,
        box=(min_x, min_y, max_x, max_y),
        hits=hits,
        last_use_monotonic_ns=last_use,
        load_ns=load_ns,
        id_cut=bool(flags & ID_CUT),
        layer_cut=bool(flags & LAYER_CUT) and not rest,
        ahead=bool(flags & AHEAD),
    )
