# SPDX-License-Identifier: Apache-2.0
"""Reads the statistics segment, also while the daemon is busy, stopped, hung or dead.

Nothing is mapped or locked, so a reader can neither delay nor harm the daemon.
"""

from __future__ import annotations

import os
import stat
import time
from contextlib import closing
from functools import cached_property
from typing import TYPE_CHECKING, Literal

from shmmap.errors import NotPermitted, SegmentCorrupt
from shmmap.segment.names import DEFAULT_SHM_DIR, statistics_name
from shmmap.statistics.counters import Counter, Histogram
from shmmap.statistics.identity import DaemonIdentity, DaemonState, WriterProcess
from shmmap.statistics.layout import (
    IDENTITY,
    Header,
    State,
    unpack_header,
    unpack_identity,
    unpack_state,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shmmap.protocol.rows import ClientRow, LiveMapRow

_ATTEMPTS = 100
_MAX_HEADER_BYTES = 80 << 10


class Snapshot:
    """The statistics at one moment, and beside them what a daemon has answered.

    Attributes
    ----------
    state : str
        ``healthy``; ``starting`` (it beats, but does not listen yet); ``stopped`` (SIGSTOP, a debugger);
        ``hung`` (runs, but has not beaten for 5 s); ``dead`` (the process is gone and left its segment);
        ``absent`` (no segment: never started, or stopped cleanly).  All but ``absent`` come with an identity.
    identity : DaemonIdentity or None
        The daemon that wrote the statistics; None when absent.
    beat_age_s : float
        Seconds since the daemon last wrote; infinite when absent.
    beat_monotonic_ns : int
        Time of that write, CLOCK_MONOTONIC.
    clients, live
        Clients and live maps, which only the daemon lists; None and empty until it has.
    """

    def __init__(
        self,
        state: DaemonState | Literal["absent"],
        identity: DaemonIdentity | None,
        header: Header | None = None,
        values: State | None = None,
        *,
        beat_age_s: float = float("inf"),
    ) -> None:
        self.identity = identity
        self.beat_age_s = beat_age_s
        self.beat_monotonic_ns = values.beat_monotonic_ns if values is not None else 0
        self.clients: Sequence[ClientRow] | None = None
        self.live: Sequence[LiveMapRow] = ()
        self._header = header
        self._values = values
        self.state: DaemonState | Literal["absent"] = state
        if state == "healthy" and self.counters.get("starting"):
            self.state = "starting"

    @cached_property
    def counters(self) -> dict[str, int]:
        """Values of the counters by name."""
        if self._header is None or self._values is None:
            return {}
        names = (counter.name for counter in self._header.counters)
        return dict(zip(names, self._values.values, strict=False))

    @property
    def descriptions(self) -> tuple[Counter, ...]:
        """Descriptions of the counters, in the daemon's order."""
        return self._header.counters if self._header is not None else ()

    @property
    def histogram_descriptions(self) -> tuple[Counter, ...]:
        """Descriptions of the histograms, in the daemon's order."""
        return self._header.histograms if self._header is not None else ()

    @cached_property
    def histograms(self) -> dict[str, Histogram]:
        """Histograms by name."""
        if self._header is None or self._values is None:
            return {}
        step = 1 + self._header.bucket_count
        values = self._values.histograms
        return {
            description.name: Histogram.of(values[index * step : (index + 1) * step])
            for index, description in enumerate(self._header.histograms)
            if (index + 1) * step <= len(values)
        }


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

    def snapshot(self) -> Snapshot:
        """Read the statistics as they are now, which takes some microseconds.

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
    with closing(StatisticsReader(instance, shm_dir)) as reader:
        return reader.snapshot()


def _read_header(fd: int, size: int) -> Header:
    header = unpack_header(os.pread(fd, _MAX_HEADER_BYTES, 0))
    if header.end > size:
        raise SegmentCorrupt(f"the statistics claim {header.end} bytes, there are {size}")
    return header


def _newest_identity(fd: int, header: Header) -> bytes:
    # the writer fills the older of the two blocks, so one of them is whole at any instant; both
    # look torn only if the writer came round twice while we read
    for _ in range(_ATTEMPTS):
        places = header.identity_offset, header.identity_offset + header.identity_bytes
        blocks = [unpack_identity(os.pread(fd, header.identity_bytes, place)) for place in places]
        if found := [block for block in blocks if block is not None]:
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
