# SPDX-License-Identifier: Apache-2.0
"""Reading the statistics segment: works while the daemon is busy, stopped, hung or dead.

Nothing is mapped and nothing is locked, so a reader can neither delay nor hurt the daemon.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from shmmap.errors import NotPermitted, SegmentCorrupt
from shmmap.segment.names import statistics_name
from shmmap.statistics.counters import Counter
from shmmap.statistics.identity import DaemonIdentity, DaemonState, judge
from shmmap.statistics.layout import (
    TABLE,
    CellRow,
    Header,
    State,
    unpack_header,
    unpack_identity,
    unpack_row,
    unpack_state,
)

__all__ = ["Snapshot", "read_statistics"]

_ATTEMPTS = 100
_TABLE_ATTEMPTS = 16
_DEFAULT_SHM_DIR = "/dev/shm"  # noqa: S108  as shmmap.segment.directory, which would load numpy


@dataclass(frozen=True)
class Snapshot:
    """The statistics at one moment.

    Attributes
    ----------
    state
        ``healthy``; ``stopped`` (SIGSTOP, a debugger); ``hung`` (runs, but has not beaten for 5 s);
        ``dead`` (the process is gone and left its segment); ``absent`` (no segment: never started,
        or stopped cleanly).  All but ``absent`` come with an identity.
    identity
        Who wrote the statistics; None when absent.
    counters
        Values by name.
    descriptions
        What the counters mean, in the daemon's order.
    beat_age_s
        Seconds since the daemon last wrote; infinite when absent.
    rows_missing
        Cells the table had no room for.
    size_bytes
        Size of the segment.
    """

    state: DaemonState | Literal["absent"]
    identity: DaemonIdentity | None
    counters: dict[str, int]
    descriptions: tuple[Counter, ...]
    beat_age_s: float
    rows_missing: int
    size_bytes: int
    _rows: bytes
    _row_bytes: int

    @cached_property
    def cells(self) -> list[CellRow]:
        """The segments the daemon keeps, in id order, then layer and version.

        A row the daemon was changing at that very moment (it was stopped in mid-write) is left out.
        """
        found = []
        rows = memoryview(self._rows)
        for at in range(0, len(rows) - self._row_bytes + 1, self._row_bytes):
            try:
                row = unpack_row(rows[at : at + self._row_bytes])
            except SegmentCorrupt:
                continue
            if row is not None:
                found.append(row)
        return sorted(found, key=lambda row: (row.id, row.layer, row.version))


_ABSENT = Snapshot("absent", None, {}, (), float("inf"), 0, 0, b"", 256)


def read_statistics(instance: str = "default", shm_dir: str = _DEFAULT_SHM_DIR) -> Snapshot:
    """Read what the instance's daemon tells.

    Parameters
    ----------
    instance, shm_dir
        Which daemon, and the directory of its segments.

    Raises
    ------
    NotPermitted
        This user may not read the segment.
    SegmentCorrupt
        It is damaged or of another major layout version.
    """
    path = f"{shm_dir.rstrip('/')}{statistics_name(instance)}"
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return _ABSENT
    except PermissionError as error:
        raise NotPermitted(
            f"statistics {path}: this user may not read them", hint="join the daemon's group"
        ) from error
    try:
        return _read(fd)
    finally:
        os.close(fd)


def _read(fd: int) -> Snapshot:
    size = os.fstat(fd).st_size
    header = unpack_header(os.pread(fd, 65536, 0))
    if header.rows_offset > size or header.row_bytes < 256:
        raise SegmentCorrupt(f"the statistics claim {header.rows_offset} bytes and more, there are {size}")
    identity = DaemonIdentity.from_bytes(_newest_identity(fd, header))
    state = _newest_state(fd, header)
    age = (time.monotonic_ns() - state.beat_monotonic_ns) * 1e-9
    return Snapshot(
        state=judge(identity, age),
        identity=identity,
        counters={c.name: v for c, v in zip(header.counters, state.values, strict=False)},
        descriptions=header.counters,
        beat_age_s=max(age, 0.0),
        rows_missing=state.rows_missing,
        size_bytes=size,
        _rows=_rows(fd, header, state.rows_used),
        _row_bytes=header.row_bytes,
    )


def _newest_identity(fd: int, header: Header) -> bytes:
    # the writer fills the older of the two blocks, so one of them is whole at any instant; both
    # look torn only if the writer came round twice while we read
    for _ in range(_ATTEMPTS):
        both = os.pread(fd, 2 * header.identity_bytes, header.identity_offset)
        halves = both[: header.identity_bytes], both[header.identity_bytes :]
        found = [block for block in map(unpack_identity, halves) if block is not None]
        if found:
            return max(found)[1]
    raise SegmentCorrupt("the statistics' identity is damaged")


def _newest_state(fd: int, header: Header) -> State:
    for _ in range(_ATTEMPTS):
        both = os.pread(fd, 2 * header.state_bytes, header.state_offset)
        halves = both[: header.state_bytes], both[header.state_bytes :]
        found = [block for block in map(unpack_state, halves) if block is not None]
        if found:
            return max(found)
    raise SegmentCorrupt("the statistics' counters are damaged")


def _rows(fd: int, header: Header, used: int) -> bytes:
    """Copy the table as of one moment if the writer lets us, else row by row (each has a checksum)."""
    count = min(used, header.max_rows)
    rows = b""
    for _ in range(_TABLE_ATTEMPTS):
        before = os.pread(fd, TABLE.size, header.table_offset)
        rows = os.pread(fd, count * header.row_bytes, header.rows_offset)
        if before == os.pread(fd, TABLE.size, header.table_offset) and not TABLE.unpack(before)[0] % 2:
            break
    return rows
