# SPDX-License-Identifier: Apache-2.0
"""The daemon's side of the statistics segment.

Counting costs a dictionary access; `StatisticsWriter.beat` writes the changes.  It writes with ``pwrite``
into memory allocated before: a full file system is an error here, never SIGBUS, and an untrusted reader
cannot stop or harm the writer.  Once the segment exists, a failed write (because of a limit on file sizes,
for example) is logged once and retried, and stops nothing: the daemon serves without statistics.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Hashable, Sequence
from itertools import chain, islice
from typing import Final, Generic, TypeVar

import msgspec

from shmmap.errors import ShmmapError
from shmmap.large_tables import ShardedDict
from shmmap.logfmt import log
from shmmap.protocol.rows import CellRow, ClientRow, LiveMapRow
from shmmap.segment.directory import ShmDirectory, measured_bytes
from shmmap.segment.names import statistics_name
from shmmap.statistics.counters import (
    BUCKETS,
    COUNTER_NAMES,
    COUNTERS,
    HISTOGRAMS,
    OBJECTS_READ,
    TURN_KINDS,
    bucket_of,
)
from shmmap.statistics.exclusive_name import hold, take_name
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.layout import (
    CELL_ROW_BYTES,
    CHANGES,
    CLIENT_ROW_BYTES,
    LIVE_ROW_BYTES,
    MAX_CLIENTS,
    MAX_LIVE,
    PAGE_BYTES,
    TABLE,
    State,
    pack_header,
    pack_identity,
    pack_state,
    plan,
)
from shmmap.statistics.rows import FREE_ROW, pack_row

__all__ = ["StatisticsWriter"]

_Row = TypeVar("_Row", bound=msgspec.Struct)

_GROWTH_ROWS = 256  # 64 KiB at a time
_CLIENTS_A_PAGE = 16
_RESTORE_AGAIN_S = 5.0
_COPIED_BYTES = 4 << 20  # per millisecond, of a segment that is created again


_LONGEST: Final = {kind: f"longest_turn_{kind}_ns" for kind in TURN_KINDS}


class _RowTable(Generic[_Row]):
    """A small table of the segment with rows of equal length; only changes are written.

    Memory for rows is allocated page by page, as needed.

    Parameters
    ----------
    place, row_bytes, most
        Position of the table, length of a row, and maximum number of rows.
    write
        Writes bytes at a position; returns False if that fails.
    allocate
        Allocates bytes at a position; returns False if there is no room.
    allocated
        Number of rows for which memory exists from the start.
    """

    def __init__(
        self,
        place: int,
        row_bytes: int,
        most: int,
        write: Callable[[bytes, int], bool],
        allocate: Callable[[int, int], bool],
        *,
        allocated: int = 0,
    ) -> None:
        self.used = 0  # rows to look at
        self._place = place
        self._row_bytes = row_bytes
        self._most = most
        self._write = write
        self._allocate = allocate
        self._allocated = allocated
        self._rows: list[_Row | None] = []

    def show(self, rows: Sequence[_Row]) -> None:
        """Write these rows to the table, only the first ones if there is no room for all."""
        count = min(len(rows), self._room_for(min(len(rows), self._most)))
        self._rows += [None] * (count - len(self._rows))
        self.used = 0
        for index, row in enumerate(rows[:count]):
            place = self._place + index * self._row_bytes
            if self._rows[index] != row and not self._write(pack_row(row, self._row_bytes), place):
                break
            self._rows[index] = row
            self.used += 1

    def _room_for(self, wanted: int) -> int:
        while self._allocated < wanted:
            start = self._place + self._allocated * self._row_bytes
            if not self._allocate(start, PAGE_BYTES):
                break
            self._allocated += PAGE_BYTES // self._row_bytes
        return self._allocated


class StatisticsWriter:
    """Creates, fills and at the end removes the instance's statistics segment.

    Parameters
    ----------
    directory, instance
        Directory and instance of the segment, which replaces one that a dead predecessor left.
    identity
        The daemon that writes.
    mode, gid
        Access of the segment; ``gid`` -1 leaves the group alone.
    starting
        The daemon does not listen yet: the gauge of that name is 1 until it is set to 0.
    reserve
        Called with a number of bytes before the segment grows (64 KiB at a time).  If it returns False, rows
        without room are counted in ``rows_missing`` and retried later.

    Attributes
    ----------
    values : dict of int
        Counters by name (`shmmap.statistics.counters`); may be changed in place.

    Raises
    ------
    OSError
        The directory is full.
    InstanceBusy, CannotStart
        Another daemon has the segment's name, or an existing file cannot be removed.
    """

    def __init__(
        self,
        directory: ShmDirectory,
        instance: str,
        identity: DaemonIdentity,
        *,
        mode: int = 0o400,
        gid: int = -1,
        starting: bool = False,
        reserve: Callable[[int], bool] = lambda _nbytes: True,
    ) -> None:
        self.values: dict[str, int] = dict.fromkeys(COUNTER_NAMES, 0)
        self.values["starting"] = int(starting)
        self._reserve = reserve
        self.name = statistics_name(instance)
        self._instance = instance
        self._directory = directory
        self._successor = -1  # replaces a file that others removed, once it has all its bytes
        self._restore_s = 0.0
        self._durations = {h.name: [0] * (1 + BUCKETS) for h in HISTOGRAMS}
        self._layout = plan(COUNTERS, HISTOGRAMS)
        self._packer = struct.Struct(f"<{len(COUNTERS)}q")
        self._sequence = 0
        self._identity_sequence = 0
        self._identity_due: tuple[bytes, int] | None = None
        self._table_sequence = 0  # odd while rows change
        self._changes = CHANGES.pack(identity.epoch, 0)
        self._changes_due = True
        self._slots: ShardedDict[Hashable, int] = ShardedDict()
        self._free: list[int] = []
        self._used = 0
        self._allocated = 0
        self._clients: _RowTable[ClientRow] = _RowTable(
            self._layout.clients_offset,
            CLIENT_ROW_BYTES,
            MAX_CLIENTS,
            self._write,
            self._allocate,
            allocated=_CLIENTS_A_PAGE,
        )
        self._live: _RowTable[LiveMapRow] = _RowTable(
            self._layout.live_offset, LIVE_ROW_BYTES, MAX_LIVE, self._write, self._allocate
        )
        self._changed: dict[Hashable, CellRow] = {}
        self._missing: dict[Hashable, CellRow] = {}  # no room for these, or writing failed
        self._removed: list[int] = []
        self._is_logged = False
        self._fd = directory.create()
        try:
            self._write_first(identity)
            if gid >= 0:
                os.fchown(self._fd, -1, gid)
            os.fchmod(self._fd, mode)
            hold(self._fd)
            take_name(directory, instance, self._fd)
        except BaseException:
            os.close(self._fd)
            raise

    def _write_first(self, identity: DaemonIdentity) -> None:
        """Write the new file, with memory for the first rows.

        So the segment of a small daemon does not grow after the budget was set.
        """
        start = self._layout.clients_offset + _CLIENTS_A_PAGE * CLIENT_ROW_BYTES
        os.posix_fallocate(self._fd, 0, start)
        os.posix_fallocate(self._fd, self._layout.rows_offset, _GROWTH_ROWS * CELL_ROW_BYTES)
        self._allocated = _GROWTH_ROWS
        os.pwrite(self._fd, pack_header(self._layout), 0)
        self.update_identity(identity)
        self.map_changed()
        self.beat()

    def set(self, name: str, value: int) -> None:
        """Set a gauge."""
        self.values[name] = value

    def add(self, name: str, n: int = 1) -> None:
        """Add to a counter."""
        self.values[name] += n

    def add_objects_read(self, more: Sequence[int]) -> None:
        """Add to the counters `OBJECTS_READ`, in their order; an empty ``more`` adds nothing."""
        for name, n in zip(OBJECTS_READ, more, strict=False):
            self.values[name] += n

    def add_duration(self, name: str, duration_ns: int) -> None:
        """Count a duration in a histogram."""
        values = self._durations[name]
        values[0] += duration_ns
        values[1 + bucket_of(duration_ns)] += 1

    def add_turn(self, kind: str, duration_ns: int) -> None:
        """Count a turn of the serving loop, under the work that took most of it (`TURN_KINDS`)."""
        self.add_duration("turn", duration_ns)
        name = _LONGEST[kind]
        if duration_ns > self.values[name]:
            self.values[name] = duration_ns

    def map_changed(self) -> None:
        """Show clients at once that cells of the map were added, removed or changed.

        Call it before any reply or event shows the change.
        """
        epoch, count = CHANGES.unpack(self._changes)
        self._changes = CHANGES.pack(epoch, count + 1)
        self._changes_due = not self._write(self._changes, self._layout.changes_offset)

    def show_clients(self, rows: Sequence[ClientRow]) -> None:
        """Show these clients, from the next beat on; at most 256, and as many as there is room for."""
        self._clients.show(rows)

    def show_live_maps(self, rows: Sequence[LiveMapRow]) -> None:
        """Show these live maps, always the same in the same order; at most 64."""
        self._live.show(rows)

    def cell_changed(self, key: Hashable, row: CellRow) -> None:
        """Show ``row`` under ``key`` from one of the next beats on; it is read only then."""
        (self._missing if key in self._missing else self._changed)[key] = row

    def cell_removed(self, key: Hashable) -> None:
        """Remove the row; unknown keys are ignored."""
        self._changed.pop(key, None)
        self._missing.pop(key, None)
        slot = self._slots.pop(key, None)
        if slot is not None:
            self._removed.append(slot)

    @property
    def outdated(self) -> bool:
        """Whether cells were added, removed or changed since the last beat."""
        return bool(self._changed or self._removed)

    def update_identity(self, identity: DaemonIdentity) -> None:
        """Replace the identity of the writer in the segment, as after a reload.

        Raises
        ------
        ValueError
            If its strings need more than 16 kB.
        """
        sequence, size = self._identity_sequence + 1, self._layout.identity_bytes
        packed = pack_identity(sequence, identity.to_bytes(), size)
        self._identity_due = packed, self._layout.identity_offset + sequence % 2 * size
        self._write_identity()

    def _write_identity(self) -> None:
        if self._identity_due is not None and self._write(*self._identity_due):
            self._identity_due = None
            self._identity_sequence += 1

    def beat(self, *, max_rows: int = 128) -> None:
        """Write the time, all counters and at most ``max_rows`` changed rows (the rest at later beats)."""
        self._write_identity()
        if self._changes_due:
            self._changes_due = not self._write(self._changes, self._layout.changes_offset)
        if max_rows:
            self.write_rows(max_rows)
        sequence = self._sequence + 1
        state = State(
            sequence,
            time.monotonic_ns(),
            time.time_ns(),
            self._used,
            len(self._missing),
            tuple(self.values.values()),
            self._clients.used,
            tuple(chain.from_iterable(self._durations.values())),
        )
        block = self._layout.state_offset + sequence % 2 * self._layout.state_bytes
        if self._write(pack_state(state, self._packer), block):
            self._sequence = sequence

    def write_rows(self, max_rows: int) -> None:
        """Write at most ``max_rows`` changed rows, between two beats."""
        if not (self._changed or self._removed or self._missing or self._table_sequence % 2):
            return
        if not self._mark_table(self._table_sequence + 1 | 1):  # already odd after a failed write
            return
        for _ in range(min(max_rows, len(self._removed))):
            if not self._write_row(self._removed[-1], FREE_ROW):
                break
            self._free.append(self._removed.pop())
        for key in list(islice(self._changed, max_rows)):
            row = self._changed.pop(key)
            if not self._place(key, row):
                self._missing[key] = row
        for key in list(islice(self._missing, max_rows)):
            if not self._place(key, self._missing[key]):
                break
            del self._missing[key]
        self._mark_table(self._table_sequence + 1)

    def _place(self, key: Hashable, row: CellRow) -> bool:
        slot = self._slot(key)
        return slot is not None and self._write_row(slot, pack_row(row, CELL_ROW_BYTES))

    def _mark_table(self, sequence: int) -> bool:
        if not self._write(TABLE.pack(sequence), self._layout.table_offset):
            return False
        self._table_sequence = sequence
        return True

    def _write_row(self, slot: int, packed: bytes) -> bool:
        return self._write(packed, self._layout.rows_offset + slot * CELL_ROW_BYTES)

    def _write(self, data: bytes, place: int) -> bool:
        """Write all the data; return False if that fails, and the caller retries at a later beat."""
        try:
            _write_whole(self._fd, data, place)
        except OSError as error:
            if not self._is_logged:
                self._is_logged = True
                log.warning(
                    "statistics not written",
                    error=error.strerror,
                    effect="cells are served as before, `shmmap top` and `health` show an older state",
                )
            return False
        if self._successor >= 0:
            try:
                _write_whole(self._successor, data, place)
            except OSError:
                self._give_up_successor()
        return True

    def _slot(self, key: Hashable) -> int | None:
        """Return the slot of ``key``, a new one if needed; None if there is no room."""
        slot = self._slots.get(key)
        if slot is None:
            if self._free:
                slot = self._free.pop()
            elif self._used < self._allocated or self._grow():
                slot = self._used
                self._used += 1
            else:
                return None
            self._slots[key] = slot
        return slot

    def _grow(self) -> bool:
        rows = min(self._allocated + _GROWTH_ROWS, self._layout.max_rows)
        if rows == self._allocated:
            return False
        start = self._layout.rows_offset + self._allocated * CELL_ROW_BYTES
        if not self._allocate(start, (rows - self._allocated) * CELL_ROW_BYTES):
            return False
        self._allocated = rows
        return True

    def _allocate(self, start: int, nbytes: int) -> bool:
        """Allocate missing memory, if the budget and the file system allow that; return whether it exists."""
        if not self._reserve(nbytes):
            return False
        try:
            os.posix_fallocate(self._fd, start, nbytes)
        except OSError:
            return False
        return True

    def restore(self, now_s: float) -> None:
        """Create the segment again if its file was removed, a part at each call.

        A file without a name cannot get one again, so its bytes are copied.
        """
        if self._successor < 0 and (now_s < self._restore_s or self._is_named()):
            return
        try:
            if self._successor < 0:
                self._begin_successor()
            if self._copy_some():
                take_name(self._directory, self._instance, self._successor)
                os.close(self._fd)
                self._fd, self._successor = self._successor, -1
                log.warning("statistics made again", file=self._directory.path + self.name)
        except (OSError, ShmmapError) as error:
            log.warning("statistics cannot be made again", error=error)
            self._give_up_successor()
            self._restore_s = now_s + _RESTORE_AGAIN_S

    def _begin_successor(self) -> None:
        log.warning("statistics removed by another program", file=self._directory.path + self.name)
        self._successor = self._directory.create()
        status = os.fstat(self._fd)
        if status.st_gid != os.fstat(self._successor).st_gid:
            os.fchown(self._successor, -1, status.st_gid)
        os.fchmod(self._successor, status.st_mode & 0o777)
        hold(self._successor)

    def _copy_some(self) -> bool:
        """Copy a part to the successor; return True once the copy is complete."""
        at, end = os.lseek(self._successor, 0, os.SEEK_CUR), os.fstat(self._fd).st_size
        return at + os.sendfile(self._successor, self._fd, at, min(end - at, _COPIED_BYTES)) >= end

    def _give_up_successor(self) -> None:
        if self._successor >= 0:
            os.close(self._successor)
            self._successor = -1

    def _is_named(self) -> bool:
        """Return whether the segment's name refers to this file."""
        try:
            named = os.stat(self._directory.path + self.name, follow_symlinks=False)
        except OSError:
            return False
        return os.path.samestat(named, os.fstat(self._fd))

    @property
    def size_bytes(self) -> int:
        """Memory the segment occupies, to be counted with the segments of cells."""
        return measured_bytes(self._fd) + (measured_bytes(self._successor) if self._successor >= 0 else 0)

    def close(self) -> None:
        """Remove the segment; another file that has its name stays."""
        if self._is_named():
            self._directory.unlink(self.name)
        self._give_up_successor()
        os.close(self._fd)


def _write_whole(fd: int, data: bytes, place: int) -> None:
    left = memoryview(data)
    while left:
        written = os.pwrite(fd, left, place)
        left, place = left[written:], place + written
