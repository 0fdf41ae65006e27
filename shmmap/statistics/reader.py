# SPDX-License-Identifier: Apache-2.0
"""Read the statistics segment, also while the daemon is busy, stopped, hung or dead.

Nothing is mapped or locked, so a reader can neither delay nor harm the daemon.
"""

from __future__ import annotations

import os
import stat
import time
from types import TracebackType

from shmmap.errors import NotPermitted, SegmentCorrupt
from shmmap.segment.names import DEFAULT_SHM_DIR, statistics_name
from shmmap.statistics.identity import DaemonIdentity, WriterProcess
from shmmap.statistics.layout import (
    IDENTITY,
    TABLE,
    Header,
    State,
    unpack_header,
    unpack_identity,
    unpack_state,
)
from shmmap.statistics.snapshot import Snapshot

__all__ = ["StatisticsReader", "read_statistics"]

_ATTEMPTS = 100
_TABLE_ATTEMPTS = 16
_HEADER_BYTES = 16384


class StatisticsReader:
    """Keeps an instance's statistics open, for repeated reads.

    Parameters
    ----------
    instance, shm_dir
        Name of the daemon's instance, and directory of its segments.  The daemon need not run yet: the
        segment is opened when it exists, and again when another daemon has replaced it.
    """

    def __init__(self, instance: str = "default", shm_dir: str = DEFAULT_SHM_DIR) -> None:
        self._path = f"{shm_dir.rstrip('/')}{statistics_name(instance)}"
        self._fd = -1
        self._header: Header | None = None
        self._identity_heads: list[bytes] = []
        self._identity: DaemonIdentity | None = None
        self._process: WriterProcess | None = None

    def __enter__(self) -> StatisticsReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the descriptors."""
        if self._process is not None:
            self._process.close()
            self._process = None
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        self._header = None
        self._identity_heads = []

    def snapshot(self, *, tables: bool = True, cells: bool = True) -> Snapshot:
        """Read the statistics as they are now.

        Parameters
        ----------
        tables
            Copy the rows of cells and clients, too; without them a snapshot takes some microseconds.
        cells
            Copy the rows of cells, 256 bytes each.

        Raises
        ------
        NotPermitted
            This user may not read the segment.
        SegmentCorrupt
            The segment is damaged or of another major layout version.
        """
        status = os.fstat(self._fd) if self._fd >= 0 else None
        if status is not None and not status.st_nlink:  # its daemon ended, or another one has replaced it
            self.close()
            status = None
        if status is None:
            try:
                # a pipe of that name would block the opener
                self._fd = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
            except FileNotFoundError:
                return Snapshot("absent", None)
            except PermissionError as error:
                raise NotPermitted(
                    f"statistics {self._path}: this user may not read them", hint="join the daemon's group"
                ) from error
            except OSError as error:
                raise SegmentCorrupt(f"statistics {self._path}: {error.strerror}") from error
            status = os.fstat(self._fd)
            if not stat.S_ISREG(status.st_mode):
                self.close()
                raise SegmentCorrupt(f"statistics {self._path}: no regular file: no daemon made it")
        header = self._header
        if header is None:
            header = self._header = _read_header(self._fd, status.st_size)
        identity, process = self._who(header)
        state = _newest_state(self._fd, header)
        age_s = (time.monotonic_ns() - state.beat_monotonic_ns) * 1e-9
        return Snapshot(
            process.state(age_s),
            identity,
            header,
            state,
            beat_age_s=max(age_s, 0.0),
            size_bytes=status.st_blocks * 512,
            rows=_rows(self._fd, header, state.rows_used) if tables and cells else b"",
            clients=_clients(self._fd, header, state.clients_used) if tables else b"",
            live=_live(self._fd, header) if tables else b"",
        )

    def _who(self, header: Header) -> tuple[DaemonIdentity, WriterProcess]:
        places = header.identity_offset, header.identity_offset + header.identity_bytes
        heads = [os.pread(self._fd, IDENTITY.size, place) for place in places]
        if self._identity is None or self._process is None or heads != self._identity_heads:
            identity = DaemonIdentity.from_bytes(_newest_identity(self._fd, header))
            if self._process is not None:
                self._process.close()
            self._identity, self._process = identity, WriterProcess(identity)
            self._identity_heads = heads
        return self._identity, self._process


def read_statistics(instance: str = "default", shm_dir: str = DEFAULT_SHM_DIR) -> Snapshot:
    """Read the instance's statistics once.

    Parameters
    ----------
    instance, shm_dir
        Name of the daemon's instance, and directory of its segments.

    Raises
    ------
    NotPermitted
        This user may not read the segment.
    SegmentCorrupt
        The segment is damaged or of another major layout version.
    """
    with StatisticsReader(instance, shm_dir) as reader:
        return reader.snapshot()


_last_header: tuple[bytes, Header] | None = None
"""Bytes and content of the last header, which is the same for all daemons of one version."""


def _read_header(fd: int, size: int) -> Header:
    global _last_header
    data = os.pread(fd, _HEADER_BYTES, 0)
    if _last_header is not None and data.startswith(_last_header[0]):
        header = _last_header[1]
    else:
        data += os.pread(fd, 65536, len(data))
        header = unpack_header(data)
        _last_header = data[: header.descriptions_end], header
    end = max(
        header.identity_offset + 2 * header.identity_bytes, header.state_offset + 2 * header.state_bytes,
        header.table_offset + TABLE.size, header.rows_offset, header.clients_offset,
    )  # fmt: skip
    if end > size or header.row_bytes < 256:
        raise SegmentCorrupt(f"the statistics claim {end} bytes and more, there are {size}")
    return header


def _newest_identity(fd: int, header: Header) -> bytes:
    # the writer fills the older of the two blocks, so one of them is whole at any instant; both
    # look torn only if the writer came round twice while we read
    for _ in range(_ATTEMPTS):
        found = []
        for place in (header.identity_offset, header.identity_offset + header.identity_bytes):
            data = os.pread(fd, 2048, place)  # enough for ordinary paths
            length = IDENTITY.unpack_from(data)[1] if len(data) >= IDENTITY.size else 0
            if IDENTITY.size + length > len(data):
                data = os.pread(fd, min(IDENTITY.size + length, header.identity_bytes), place)
            block = unpack_identity(data) if len(data) >= IDENTITY.size else None
            if block is not None:
                found.append(block)
        if found:
            return max(found)[1]
    raise SegmentCorrupt("the statistics' identity is damaged")


def _newest_state(fd: int, header: Header) -> State:
    size = header.state_bytes
    for _ in range(_ATTEMPTS):
        both = os.pread(fd, 2 * size, header.state_offset)
        halves = both[:size], both[size:]
        # the newer block is complete unless the writer is changing it: read the other one only then
        if halves[0][:8][::-1] < halves[1][:8][::-1]:
            halves = halves[::-1]
        for half in halves:
            state = unpack_state(half)
            if state is not None:
                return state
    raise SegmentCorrupt("the statistics' counters are damaged")


def _rows(fd: int, header: Header, used: int) -> bytes:
    """Copy the table consistently if the writer pauses, else row by row (each row has a checksum)."""
    nbytes = _within(fd, header.rows_offset, min(used, header.max_rows) * header.row_bytes)
    rows = b""
    for _ in range(_TABLE_ATTEMPTS):
        before = os.pread(fd, TABLE.size, header.table_offset)
        rows = os.pread(fd, nbytes, header.rows_offset)
        if before == os.pread(fd, TABLE.size, header.table_offset) and not TABLE.unpack(before)[0] % 2:
            break
    return rows


def _clients(fd: int, header: Header, used: int) -> bytes:
    nbytes = min(used, header.max_clients) * header.client_row_bytes
    return os.pread(fd, _within(fd, header.clients_offset, nbytes), header.clients_offset)


def _live(fd: int, header: Header) -> bytes:
    nbytes = _within(fd, header.live_offset, header.max_live * header.live_row_bytes)
    return os.pread(fd, nbytes, header.live_offset)


def _within(fd: int, offset: int, nbytes: int) -> int:
    """Return how many of these bytes exist, since pread allocates the whole requested length."""
    return max(0, min(nbytes, os.fstat(fd).st_size - offset))
