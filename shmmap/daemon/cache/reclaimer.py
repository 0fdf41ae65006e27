# SPDX-License-Identifier: Apache-2.0
"""Freeing memory: a segment is retired by renaming it, and freed once the kernel reports no user.

Each turn of the serving loop checks a bounded number of segments.

After the renaming, no other process can open the segment; a second check on a later tick finds a process that
was just opening it.  A retired segment that is still mapped stays in the ledger.  It is checked again when
its reader reports a release, when the kernel reports a close, or when a client's session ends; a timer is
only a precaution.  The memory of a large segment is freed in another thread, and counts as used until then.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Protocol

from shmmap.daemon.cache.ledger import SHARE_S, Ledger
from shmmap.daemon.pins.probe import PinSource
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.records import Key, Resident, Retired
from shmmap.daemon.transport.sessions import Sessions
from shmmap.daemon.turns import Walk
from shmmap.logfmt import log
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import another_name, retired_name

SMALL_BYTES: Final = 1 << 16
MAX_WAITING: Final = 64
"""Descriptors that may wait to be closed: clients need descriptors more."""


class Closer:
    """Closes the last descriptors of removed segments in a thread, which is started when first needed.

    Freeing memory takes the kernel 0.2 ms per megabyte, in the thread that closes the last descriptor.  This
    thread does nothing else, and holds the interpreter lock only between two closes.

    Attributes
    ----------
    fd
        Readable when `closed` has something to count.
    small_bytes
        Segments up to this size are freed faster than another thread is woken.
    """

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.small_bytes = SMALL_BYTES
        self._to_close: queue.SimpleQueue[tuple[int, int] | None] = queue.SimpleQueue()
        self._closed: deque[int] = deque()
        self._waiting = 0
        self._thread: threading.Thread | None = None

    @property
    def full(self) -> bool:
        """Whether no more descriptors may be passed to the thread now."""
        return self._waiting >= MAX_WAITING

    def close(self, fd: int, nbytes: int) -> None:
        """Close the descriptor of a segment of ``nbytes`` in the thread."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="shmmap-freeing", daemon=True)
            before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
            try:
                self._thread.start()  # signals are for the serving loop
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._waiting += 1
        self._to_close.put((fd, nbytes))

    def closed(self) -> int:
        """Return the bytes of the segments closed since the last call."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        nbytes = 0
        for _ in range(len(self._closed)):
            nbytes += self._closed.popleft()
            self._waiting -= 1
        return nbytes

    def end(self) -> None:
        """Close the descriptors that wait, and end the thread."""
        if self._thread is not None:
            self._to_close.put(None)
            self._thread.join()
            self._thread = None
        os.close(self.fd)

    def _run(self) -> None:
        while (item := self._to_close.get()) is not None:
            fd, nbytes = item
            os.close(fd)
            self._closed.append(nbytes)
            os.eventfd_write(self.fd, 1)


TICK_S: Final = 0.002
"""Delay until a retired segment is checked again: an ``open`` in flight has finished by then."""
RETIRED_INTERVAL_S: Final = 0.1
"""How often a segment that is still mapped is checked where the kernel does not report closes."""
WATCHED_INTERVAL_S: Final = 5.0
"""Shortest interval of checks where the kernel reports the end of use: a precaution.

A report arrives a moment before the close takes effect, so the first checks after a report follow each other
quickly.
"""
LOOKS_PER_TURN: Final = 8
"""Segments checked, retired or freed per turn: a check takes 15 us, retiring one 50 us."""
DROPPED_PER_LOOK: Final = 64
"""Outdated checks dropped before one check: 0.1 ms."""


class RetirementObserver(Protocol):
    """Is notified of segments that leave service."""

    def segment_retired(self, resident: Resident, why: str) -> None:
        """Handle a segment that left service; ``why`` as in `Reclaimer.retire`."""


@dataclass(eq=False, slots=True)
class Reclaimer:
    """Retires segments, and frees their memory.

    Attributes
    ----------
    closer
        Closes descriptors whose closing takes long.
    due
        Heap of checks, by time; also of segments that are gone or were rescheduled, until their time comes.
    """

    ledger: Ledger
    directory: ShmDirectory
    sessions: Sessions
    pins: PinWatch
    observer: RetirementObserver
    closer: Closer = field(default_factory=Closer)
    due: list[tuple[float, int, Retired]] = field(default_factory=list)
    _by_key: dict[Key, Retired] = field(default_factory=dict)
    _number: int = 0
    _to_check: Walk[Resident] = field(default_factory=Walk)

    # --- retiring -----------------------------------------------------------------------------

    def name_on_disk(self, resident: Resident) -> str:
        """Return the name of a segment's file, which differs for a retired segment."""
        return retired_name(resident.name) if resident.name in self.ledger.retired else resident.name

    def is_pinned(self, resident: Resident) -> bool | None:
        """Whether a process uses a segment, according to the kernel; None if the segment's name is gone."""
        if self.pins.source is PinSource.SESSIONS:
            return bool(resident.sessions)
        return self.pins.is_used(self.name_on_disk(resident))

    def retire(self, resident: Resident, now_s: float, why: str = "request") -> bool:
        """Take a segment out of service; return True if no process has it mapped, so that it is freed soon.

        Parameters
        ----------
        why
            ``room``, ``request``, ``map``, ``superseded`` or ``damaged``.
        """
        found = self._hide(resident)
        self.ledger.retire(resident)
        return self._watch(resident, now_s, why, found=found)

    def superseded(self, old: Resident, now_s: float) -> None:
        """Retire by name an old version that the ledger took out of service."""
        self._watch(old, now_s, "superseded", found=self._hide(old))

    def _hide(self, resident: Resident) -> bool:
        """Rename a segment to its retired name; return False if the segment is gone.

        Where any user may create files, that name may be taken: then a name is used that cannot be guessed.
        """
        try:
            return self.directory.rename(resident.name, retired_name(resident.name))
        except OSError as error:
            old, new = resident.name, another_name(resident.name)
            log.warning("segment not renamed", old=old, new=retired_name(old), error=error.strerror)
            found = self.directory.rename(old, retired_name(new))
            self.ledger.rename(resident, new)
            return found

    def _watch(self, resident: Resident, now_s: float, why: str, *, found: bool) -> bool:
        """Watch a retired segment until it can be freed; return True if no process has it mapped."""
        retired = self.ledger.retired[resident.name]
        self.observer.segment_retired(resident, why)
        if not found:
            self._vanished(retired)
            return True
        if resident.checked:
            self._by_key[resident.key] = retired
        unopened = self.is_pinned(resident) is False
        if not unopened:
            self.pins.keep(retired_name(resident.name))
        self.ledger.mark_unopened(retired, unopened)
        self._begin_tick(retired, now_s)
        return unopened

    def adopt(self, resident: Resident, now_s: float, *, hidden: bool) -> None:
        """Watch a segment of a previous run that cannot serve; its file may be ``hidden`` already."""
        retired = self.ledger.add_retired(resident)
        if not hidden:
            self._hide(resident)
        self._begin_tick(retired, now_s)
        self.pins.keep(retired_name(resident.name))

    def _begin_tick(self, retired: Retired, now_s: float) -> None:
        """Schedule the check after which a segment may be freed: no process can be opening it by then."""
        retired.tick_over_s = now_s + TICK_S
        self._look_at(retired, retired.tick_over_s)

    def _look_at(self, retired: Retired, when_s: float) -> None:
        """Schedule a check of a retired segment."""
        retired.probe_after_s = when_s = max(when_s, retired.tick_over_s)
        self._number += 1
        heapq.heappush(self.due, (when_s, self._number, retired))

    def retired_of(self, key: Key) -> Resident | None:
        """Return the segment of a key that was retired last, while it exists; it may be revived."""
        retired = self._by_key.get(key)
        return retired.resident if retired is not None else None

    def revive(self, key: Key, version: int, now_s: float) -> Resident | None:
        """Put a retired segment of exactly this version back into service if it still exists."""
        retired = self._by_key.get(key)
        if retired is None or retired.resident.version != version:
            return None
        name = retired.resident.name
        try:
            found = self.directory.rename(retired_name(name), name)
        except OSError as error:  # another program has taken the name: the cell is loaded again
            log.warning("segment not renamed", old=retired_name(name), new=name, error=error.strerror)
            self.never_revive(key)
            return None
        if not found:
            self._vanished(retired)
            return None
        self.pins.release(retired_name(name))
        del self._by_key[key]
        old = self.ledger.revive(retired)
        if old is not None:
            self.superseded(old, now_s)
        return retired.resident

    def never_revive(self, key: Key) -> None:
        """Never hand out retired segments of this key again."""
        self._by_key.pop(key, None)

    def _vanished(self, retired: Retired) -> None:
        """Release the bytes of a segment whose name another program removed.

        Its readers keep the memory, and nothing shows until when.
        """
        self._forget(retired)
        self.ledger.freed(retired.resident.name)

    def _forget(self, retired: Retired) -> None:
        """Forget a segment that is gone, or whose name is gone."""
        resident = retired.resident
        self.pins.release(retired_name(resident.name))
        if self._by_key.get(resident.key) is retired:
            del self._by_key[resident.key]
        for slot in list(resident.sessions):
            session = self.sessions.slots.get(slot)
            if session is not None:
                session.drop_segment(resident)

    # --- freeing ------------------------------------------------------------------------------

    def sweep(self, now_s: float) -> int:
        """Check some retired segments that are due, free those without a user, and return the bytes freed.

        Memory that another thread is freeing does not count, see `collect`.
        """
        freed = 0
        for _ in range(LOOKS_PER_TURN):
            retired = self._next_due(now_s)
            if retired is None:
                break
            freed += self._probe(retired, now_s)  # if that fails, it is still due
            heapq.heappop(self.due)
        if not self._to_check.is_done:
            for resident in self._to_check.for_a_step():
                retired = self.ledger.retired.get(resident.name)
                if retired is not None:
                    self._look_at(retired, min(now_s, retired.probe_after_s))
        return freed

    def _next_due(self, now_s: float) -> Retired | None:
        """Return the retired segment that is checked next, if its time has come.

        Checks of segments that are gone or were rescheduled are dropped, a bounded number per call: very many
        segments may have been released at once.
        """
        for _ in range(DROPPED_PER_LOOK):
            if self.next_sweep_s() > now_s:
                break
            when_s, _, retired = self.due[0]
            known = self.ledger.retired.get(retired.resident.name)
            if known is retired and when_s == retired.probe_after_s:
                return retired
            heapq.heappop(self.due)
        return None

    def next_sweep_s(self) -> float:
        """Return when the next check of a segment is due at the earliest; infinity if there is none."""
        return self.due[0][0] if self.due else math.inf

    def release(self, residents: Iterable[Resident], now_s: float) -> None:
        """Schedule a check of segments that a client has dropped: those without other users are freed."""
        for resident in residents:
            retired = self.ledger.retired.get(resident.name)
            if retired is None:
                self.ledger.evictable.release(resident)
            elif retired.probe_after_s > now_s and not retired.unopened:
                self._look_at(retired, now_s)

    def _probe(self, retired: Retired, now_s: float) -> int:
        """Check a retired segment whose tick is over; return the bytes freed."""
        if self.is_pinned(retired.resident):
            self.ledger.mark_unopened(retired, False)
            name = retired_name(retired.resident.name)
            if not self.pins.keeps(name):
                self.pins.keep(name)
            self._look_at(retired, now_s + self._interval_s(retired))
            return 0
        if self.closer.full:
            self.ledger.mark_unopened(retired, True)
            self._look_at(retired, now_s + TICK_S)
            return 0
        return self._free(retired)

    def _free(self, retired: Retired) -> int:
        """Remove a segment that no process uses; the memory of a large one is freed in another thread."""
        resident = retired.resident
        name = retired_name(resident.name)
        fd = -1
        if resident.nbytes > self.closer.small_bytes:
            with contextlib.suppress(OSError):
                fd = self.directory.open_path(name)
        self.directory.unlink(name)
        self._forget(retired)
        if fd < 0:
            return self.ledger.freed(resident.name)
        self.closer.close(fd, self.ledger.freeing(resident.name))
        return 0

    def collect(self) -> int:
        """Count memory that the other thread has freed since the last call; return its bytes."""
        nbytes = self.closer.closed()
        self.ledger.closed(nbytes)
        return nbytes

    def _interval_s(self, retired: Retired) -> float:
        """Return the delay until the next check of a segment that was found in use."""
        if self.pins.keeps(retired_name(retired.resident.name)):
            retired.interval_s = min(max(TICK_S, 2 * retired.interval_s), WATCHED_INTERVAL_S)
            return retired.interval_s
        return max(RETIRED_INTERVAL_S, SHARE_S * len(self.ledger.retired))

    def on_closes(self, now_s: float) -> bool:
        """Schedule a check of segments that processes have closed; return whether more may fit now."""
        names = self.pins.closed()
        if names is None:
            self.ledger.evictable.release_all()
            self._to_check = Walk(self.ledger.segments.walk())
            return True
        changed = False
        for name in names:
            retired = self.ledger.retired.get(name.removesuffix(retired_name("")))
            resident = self.ledger.resident_named(name)
            if retired is not None:
                retired.interval_s = 0.0
                if not retired.unopened:
                    self._look_at(retired, now_s)
            elif resident is not None:
                changed |= self.ledger.evictable.release(resident)
        return changed

    # --- the end --------------------------------------------------------------------------------

    def close(self) -> None:
        """Close every descriptor."""
        self.closer.end()
        self.pins.close()

    def remove_all(self) -> None:
        """Remove every name; the memory is freed as soon as the last reader ends."""
        for resident in self.ledger.segments.walk():
            with contextlib.suppress(OSError):
                self.directory.unlink(self.name_on_disk(resident))
