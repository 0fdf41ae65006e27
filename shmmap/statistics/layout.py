# SPDX-License-Identifier: Apache-2.0
"""The bytes of the statistics segment; ``STATISTICS.md`` is the byte-exact specification.

Only the standard library is imported here: a program that shows the statistics starts fast.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

from shmmap.errors import SegmentCorrupt
from shmmap.statistics.counters import BUCKETS, Counter

__all__ = [
    "CELL_ROW_BYTES",
    "CLIENT_ROW_BYTES",
    "LAYOUT_VERSION",
    "LIVE_ROW_BYTES",
    "MAX_CELLS",
    "MAX_CLIENTS",
    "MAX_LIVE",
    "Header",
    "State",
    "pack_header",
    "pack_identity",
    "pack_state",
    "plan",
    "unpack_header",
    "unpack_identity",
    "unpack_state",
]

MAGIC: Final = b"SHMSTAT\x01"
LAYOUT_VERSION: Final = (2, 0)
BYTE_ORDER: Final = 0x01020304
PAGE_BYTES: Final = 4096

CELL_ROW_BYTES: Final = 256
CLIENT_ROW_BYTES: Final = 256
LIVE_ROW_BYTES: Final = 1024
MAX_CELLS: Final = 1 << 17  # 32 MiB of rows; further cells are counted, not listed
MAX_CLIENTS: Final = 256  # further ones are counted, not listed
MAX_LIVE: Final = 64  # further ones are not shown

START: Final = struct.Struct("<8sHHI12I")
EXTENSION: Final = struct.Struct("<9I24xI")
DESCRIPTIONS_OFFSET: Final = START.size + EXTENSION.size
DESCRIPTION: Final = struct.Struct("<32s16sB111s")
IDENTITY: Final = struct.Struct("<QII")
IDENTITY_BYTES: Final = 16384
STATE: Final = struct.Struct("<QqqIIII")
CRC_BYTES: Final = 4
CRC: Final = struct.Struct("<I4x")
TAIL: Final = struct.Struct("<II")
TABLE: Final = struct.Struct("<Q")
CHANGES: Final = struct.Struct("<QQ")

KINDS: Final[tuple[Literal["counter", "gauge", "histogram"], ...]] = ("counter", "gauge", "histogram")


class Header(NamedTuple):
    """Positions in the segment, and descriptions of the counters."""

    counters: tuple[Counter, ...]
    identity_offset: int
    identity_bytes: int
    state_offset: int
    state_bytes: int
    table_offset: int
    rows_offset: int
    row_bytes: int
    max_rows: int
    histograms: tuple[Counter, ...]
    bucket_count: int
    clients_offset: int
    client_row_bytes: int
    max_clients: int
    changes_offset: int
    live_offset: int
    live_row_bytes: int
    max_live: int

    @property
    def descriptions_end(self) -> int:
        """End of the constant part, in a segment of this version."""
        return DESCRIPTIONS_OFFSET + (len(self.counters) + len(self.histograms)) * DESCRIPTION.size


class State(NamedTuple):
    """Data of one beat; ``histograms`` has the sum and counts of each, one after the other."""

    sequence: int
    beat_monotonic_ns: int
    beat_unix_ns: int
    rows_used: int
    rows_missing: int
    values: tuple[int, ...]
    clients_used: int = 0
    histograms: Sequence[int] = ()


def _up(value: int, step: int) -> int:
    return -(-value // step) * step


def plan(counters: Sequence[Counter], histograms: Sequence[Counter] = ()) -> Header:
    """Lay out a segment for these counters and histograms."""
    described = DESCRIPTIONS_OFFSET + (len(counters) + len(histograms)) * DESCRIPTION.size
    identity_offset = _up(described, 64)
    state_offset = identity_offset + 2 * IDENTITY_BYTES
    counters_end = STATE.size + 8 * len(counters) + CRC.size
    state_bytes = _up(counters_end + TAIL.size + 8 * len(histograms) * (1 + BUCKETS) + CRC.size, 64)
    table_offset = state_offset + 2 * state_bytes
    changes_offset = table_offset + 64
    clients_offset = _up(changes_offset + 64, PAGE_BYTES)
    live_offset = _up(clients_offset + MAX_CLIENTS * CLIENT_ROW_BYTES, PAGE_BYTES)
    return Header(
        counters=tuple(counters),
        identity_offset=identity_offset,
        identity_bytes=IDENTITY_BYTES,
        state_offset=state_offset,
        state_bytes=state_bytes,
        table_offset=table_offset,
        rows_offset=_up(live_offset + MAX_LIVE * LIVE_ROW_BYTES, PAGE_BYTES),
        row_bytes=CELL_ROW_BYTES,
        max_rows=MAX_CELLS,
        histograms=tuple(histograms),
        bucket_count=BUCKETS,
        clients_offset=clients_offset,
        client_row_bytes=CLIENT_ROW_BYTES,
        max_clients=MAX_CLIENTS,
        changes_offset=changes_offset,
        live_offset=live_offset,
        live_row_bytes=LIVE_ROW_BYTES,
        max_live=MAX_LIVE,
    )


def _pack_descriptions(counters: Sequence[Counter]) -> bytes:
    return b"".join(
        DESCRIPTION.pack(c.name.encode(), c.unit.encode(), KINDS.index(c.kind), c.help.encode())
        for c in counters
    )


def pack_header(header: Header) -> bytes:
    """Return the constant bytes: offsets, and descriptions of counters and histograms."""
    counters, histograms = _pack_descriptions(header.counters), _pack_descriptions(header.histograms)
    start = START.pack(
        MAGIC, *LAYOUT_VERSION, BYTE_ORDER, DESCRIPTIONS_OFFSET, len(header.counters), DESCRIPTION.size,
        *header[1:9], 0,
    )[:-4]  # fmt: skip
    extension = EXTENSION.pack(len(header.histograms), *header[10:], 0)[:-4]
    return b"".join(
        (
            start,
            struct.pack("<I", zlib.crc32(counters, zlib.crc32(start))),
            extension,
            struct.pack("<I", zlib.crc32(histograms, zlib.crc32(extension))),
            counters,
            histograms,
        )
    )


def unpack_header(data: bytes) -> Header:
    """Read the start of a statistics segment.

    Raises
    ------
    SegmentCorrupt
        It is not a statistics segment, has another major layout version, or is inconsistent.
    """
    if len(data) < START.size:
        raise SegmentCorrupt(f"a statistics segment of {len(data)} bytes is shorter than its header")
    magic, major, minor, order, at, count, row, *places, crc = START.unpack_from(data)
    if magic != MAGIC:
        raise SegmentCorrupt(f"not a statistics segment: it starts with {magic!r}")
    if major != LAYOUT_VERSION[0]:
        age, update = ("an older", "daemon") if major < LAYOUT_VERSION[0] else ("a newer", "program")
        raise SegmentCorrupt(
            f"statistics {major}.{minor} of {age} daemon: this program reads {LAYOUT_VERSION[0]}.x",
            hint=f"update the {update}, and restart it",
        )
    if order != BYTE_ORDER:
        raise SegmentCorrupt("the statistics were written on a machine of other byte order")
    end = at + count * row
    if at < DESCRIPTIONS_OFFSET or row < DESCRIPTION.size or end > len(data):
        raise SegmentCorrupt("the statistics' counter table lies outside the segment")
    if crc != zlib.crc32(data[at:end], zlib.crc32(data[: START.size - 4])):
        raise SegmentCorrupt("the statistics' header checksum does not match")
    counters = _unpack_descriptions(data, at, count, row)
    histogram_count, buckets, *tables, crc = EXTENSION.unpack_from(data, START.size)
    last = end + histogram_count * row
    if last > len(data):
        raise SegmentCorrupt("the statistics' histogram table lies outside the segment")
    if crc != zlib.crc32(
        data[end:last], zlib.crc32(data[START.size : START.size + EXTENSION.size - CRC_BYTES])
    ):
        raise SegmentCorrupt("the checksum of the statistics' second header does not match")
    described = _unpack_descriptions(data, end, histogram_count, row)
    return Header._make((counters, *places, described, buckets, *tables))


def _unpack_descriptions(data: bytes, at: int, count: int, step: int) -> tuple[Counter, ...]:
    found = []
    for index in range(count):
        name, unit, kind, text = DESCRIPTION.unpack_from(data, at + index * step)
        found.append(
            Counter(
                name.rstrip(b"\0").decode(),
                KINDS[kind] if kind < len(KINDS) else "gauge",
                unit.rstrip(b"\0").decode(),
                text.rstrip(b"\0").decode(),
            )
        )
    return tuple(found)


def pack_identity(sequence: int, payload: bytes, size: int) -> bytes:
    """Return one of the two identity blocks.

    Raises
    ------
    ValueError
        If the payload does not fit ``size`` bytes.
    """
    if IDENTITY.size + len(payload) > size:
        raise ValueError(f"an identity of {len(payload)} bytes does not fit {size}")
    crc = zlib.crc32(payload, zlib.crc32(struct.pack("<QI", sequence, len(payload))))
    return IDENTITY.pack(sequence, len(payload), crc) + payload


def unpack_identity(data: bytes) -> tuple[int, bytes] | None:
    """Return sequence and payload of an identity block; None if it was never written or is torn."""
    sequence, length, crc = IDENTITY.unpack_from(data)
    payload = data[IDENTITY.size : IDENTITY.size + length]
    if not sequence or len(payload) != length:
        return None
    if crc != zlib.crc32(payload, zlib.crc32(struct.pack("<QI", sequence, length))):
        return None
    return sequence, payload


def pack_state(state: State, packer: struct.Struct) -> bytes:
    """Return one of the two state blocks; ``packer`` packs the counters' values."""
    body = STATE.pack(
        state.sequence, state.beat_monotonic_ns, state.beat_unix_ns,
        state.rows_used, state.rows_missing, len(state.values), 0,
    ) + packer.pack(*state.values)  # fmt: skip
    tail = TAIL.pack(state.clients_used, len(state.histograms)) + struct.pack(
        f"<{len(state.histograms)}q", *state.histograms
    )
    whole = b"".join((body, CRC.pack(zlib.crc32(body)), tail))
    return whole + CRC.pack(zlib.crc32(whole))


def unpack_state(data: bytes) -> State | None:
    """Return a state block; None if it was never written or is torn."""
    sequence, beat, unix, used, missing, count, _ = STATE.unpack_from(data)
    end = STATE.size + 8 * count
    tail = end + CRC.size
    if not sequence or tail > len(data):
        return None
    if CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        return None
    values = struct.unpack_from(f"<{count}q", data, STATE.size)
    if tail + TAIL.size > len(data):
        return None
    clients, many = TAIL.unpack_from(data, tail)
    end = tail + TAIL.size + 8 * many
    if end + CRC.size > len(data) or CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        return None
    histograms = memoryview(data)[tail + TAIL.size : end].cast("q")  # hundreds; most readers need none
    return State(sequence, beat, unix, used, missing, values, clients, histograms)
