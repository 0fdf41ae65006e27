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

MAGIC: Final = b"SHMSTAT\x01"
LAYOUT_VERSION: Final = (3, 0)
BYTE_ORDER: Final = 0x01020304

START: Final = struct.Struct("<8sHH12I")
CRC: Final = struct.Struct("<I")
DESCRIPTIONS_OFFSET: Final = START.size + CRC.size
DESCRIPTION: Final = struct.Struct("<32s16sB111s")
IDENTITY: Final = struct.Struct("<QII")
IDENTITY_BYTES: Final = 16384
STATE: Final = struct.Struct("<QqqII")
CHANGES: Final = struct.Struct("<QQ")

KINDS: Final[tuple[Literal["counter", "gauge", "histogram"], ...]] = ("counter", "gauge", "histogram")


class Header(NamedTuple):
    """Positions in the segment, and descriptions of the counters and histograms."""

    counters: tuple[Counter, ...]
    histograms: tuple[Counter, ...]
    identity_offset: int
    identity_bytes: int
    state_offset: int
    state_bytes: int
    changes_offset: int
    bucket_count: int

    @property
    def end(self) -> int:
        """Number of bytes of the segment."""
        return max(
            self.identity_offset + 2 * self.identity_bytes,
            self.state_offset + 2 * self.state_bytes,
            self.changes_offset + CHANGES.size,
        )


class State(NamedTuple):
    """Data of one beat; ``histograms`` has the sum and counts of each, one after the other."""

    sequence: int
    beat_monotonic_ns: int
    beat_unix_ns: int
    values: tuple[int, ...]
    histograms: Sequence[int] = ()


def _up(value: int, step: int) -> int:
    return -(-value // step) * step


def plan(counters: Sequence[Counter], histograms: Sequence[Counter] = ()) -> Header:
    """Lay out a segment for these counters and histograms."""
    described = DESCRIPTIONS_OFFSET + (len(counters) + len(histograms)) * DESCRIPTION.size
    identity_offset = _up(described, 64)
    state_offset = identity_offset + 2 * IDENTITY_BYTES
    values = len(counters) + len(histograms) * (1 + BUCKETS)
    state_bytes = _up(STATE.size + 8 * values + CRC.size, 64)
    return Header(
        tuple(counters),
        tuple(histograms),
        identity_offset,
        IDENTITY_BYTES,
        state_offset,
        state_bytes,
        changes_offset=state_offset + 2 * state_bytes,
        bucket_count=BUCKETS,
    )


def pack_header(header: Header) -> bytes:
    """Return the constant bytes: offsets, and descriptions of counters and histograms."""
    described = b"".join(
        DESCRIPTION.pack(c.name.encode(), c.unit.encode(), KINDS.index(c.kind), c.help.encode())
        for c in (*header.counters, *header.histograms)
    )
    start = START.pack(
        MAGIC,
        *LAYOUT_VERSION,
        BYTE_ORDER,
        DESCRIPTIONS_OFFSET,
        DESCRIPTION.size,
        len(header.counters),
        len(header.histograms),
        *header[2:],
        0,
    )
    return start + CRC.pack(zlib.crc32(described, zlib.crc32(start))) + described


def unpack_header(data: bytes) -> Header:
    """Read the start of a statistics segment.

    Raises
    ------
    SegmentCorrupt
        It is not a statistics segment, has another major layout version, or is inconsistent.
    """
    if len(data) < DESCRIPTIONS_OFFSET:
        raise SegmentCorrupt(f"a statistics segment of {len(data)} bytes is shorter than its header")
    magic, major, minor, order, at, step, counters, histograms, *places, _ = START.unpack_from(data)
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
    end = at + (counters + histograms) * step
    if at < DESCRIPTIONS_OFFSET or step < DESCRIPTION.size or end > len(data):
        raise SegmentCorrupt("the statistics' descriptions lie outside the segment")
    if CRC.unpack_from(data, START.size)[0] != zlib.crc32(data[at:end], zlib.crc32(data[: START.size])):
        raise SegmentCorrupt("the statistics' header checksum does not match")
    described = _unpack_descriptions(data, at, counters + histograms, step)
    return Header(described[:counters], described[counters:], *places)


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
    if len(data) < IDENTITY.size:
        return None
    sequence, length, crc = IDENTITY.unpack_from(data)
    payload = data[IDENTITY.size : IDENTITY.size + length]
    if not sequence or len(payload) != length:
        return None
    if crc != zlib.crc32(payload, zlib.crc32(struct.pack("<QI", sequence, length))):
        return None
    return sequence, payload


def pack_state(state: State, packer: struct.Struct) -> bytes:
    """Return one of the two state blocks; ``packer`` packs all values."""
    body = STATE.pack(
        state.sequence,
        state.beat_monotonic_ns,
        state.beat_unix_ns,
        len(state.values),
        len(state.histograms),
    ) + packer.pack(*state.values, *state.histograms)
    return body + CRC.pack(zlib.crc32(body))


def unpack_state(data: bytes) -> State | None:
    """Return a state block; None if it was never written or is torn."""
    if len(data) < STATE.size:
        return None
    sequence, beat, unix, counters, histograms = STATE.unpack_from(data)
    middle = STATE.size + 8 * counters
    end = middle + 8 * histograms
    if not sequence or end + CRC.size > len(data):
        return None
    if CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        return None
    values = struct.unpack_from(f"<{counters}q", data, STATE.size)
    # hundreds; most readers need none
    return State(sequence, beat, unix, values, memoryview(data)[middle:end].cast("q"))
