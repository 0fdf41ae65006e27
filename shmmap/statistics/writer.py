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
from collections.abc import Sequence
from itertools import chain
from typing import Final

from shmmap.errors import ShmmapError
from shmmap.logfmt import log
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
from shmmap.statistics.layout import CHANGES, State, pack_header, pack_identity, pack_state, plan

_RESTORE_AGAIN_S = 5.0
_LONGEST: Final = {kind: f"longest_turn_{kind}_ns" for kind in TURN_KINDS}


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
    ) -> None:
        self.values: dict[str, int] = dict.fromkeys(COUNTER_NAMES, 0)
        self.values["starting"] = int(starting)
        self.name = statistics_name(instance)
        self._instance = instance
        self._directory = directory
        self._restore_s = 0.0
        self._durations = {h.name: [0] * (1 + BUCKETS) for h in HISTOGRAMS}
        self._layout = plan(COUNTERS, HISTOGRAMS)
        self._packer = struct.Struct(f"<{len(COUNTERS) + len(HISTOGRAMS) * (1 + BUCKETS)}q")
        self._sequence = 0
        self._identity_sequence = 0
        self._identity_due: tuple[bytes, int] | None = None
        self._changes = CHANGES.pack(identity.epoch, 0)
        self._changes_due = True
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
        os.posix_fallocate(self._fd, 0, self._layout.end)
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

    def beat(self) -> None:
        """Write the time and all counters."""
        self._write_identity()
        if self._changes_due:
            self._changes_due = not self._write(self._changes, self._layout.changes_offset)
        sequence = self._sequence + 1
        state = State(
            sequence,
            time.monotonic_ns(),
            time.time_ns(),
            tuple(self.values.values()),
            tuple(chain.from_iterable(self._durations.values())),
        )
        block = self._layout.state_offset + sequence % 2 * self._layout.state_bytes
        if self._write(pack_state(state, self._packer), block):
            self._sequence = sequence

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
        return True

    def restore(self, now_s: float) -> None:
        """Create the segment again if its file was removed.

        A file without a name cannot get one again, so its bytes are copied.
        """
        if now_s < self._restore_s or self._is_named():
            return
        path = self._directory.path + self.name
        log.warning("statistics removed by another program", file=path)
        successor = -1
        try:
            successor = self._directory.create()
            self._copy_to(successor)
            take_name(self._directory, self._instance, successor)
        except (OSError, ShmmapError) as error:
            log.warning("statistics cannot be made again", error=error)
            self._restore_s = now_s + _RESTORE_AGAIN_S
            if successor >= 0:
                os.close(successor)
        else:
            os.close(self._fd)
            self._fd = successor
            log.warning("statistics made again", file=path)

    def _copy_to(self, fd: int) -> None:
        status = os.fstat(self._fd)
        os.posix_fallocate(fd, 0, status.st_size)
        _write_whole(fd, os.pread(self._fd, status.st_size, 0), 0)
        if status.st_gid != os.fstat(fd).st_gid:
            os.fchown(fd, -1, status.st_gid)
        os.fchmod(fd, status.st_mode & 0o777)
        hold(fd)

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
        return measured_bytes(self._fd)

    def close(self) -> None:
        """Remove the segment; another file that has its name stays."""
        if self._is_named():
            self._directory.unlink(self.name)
        os.close(self._fd)


def _write_whole(fd: int, data: bytes, place: int) -> None:
    left = memoryview(data)
    while left:
        written = os.pwrite(fd, left, place)
        left, place = left[written:], place + written
