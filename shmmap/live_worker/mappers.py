# SPDX-License-Identifier: Apache-2.0
"""Mappers of a live map and the progress of their scans: each scan is applied once, however often it is sent.

A mapper is a user and a name that one of the user's programs chose.  Its scans have increasing numbers, also
across restarts of the program.  A scan that is sent twice is applied once: until it is applied, both requests
wait for it; afterwards every chunk remembers it.
"""

from __future__ import annotations

import mmap
import threading
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from shmmap.chunks.layout import MAPPERS
from shmmap.errors import BadRequest, Busy, LiveInterrupted
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import Mapper

MAX_SCANS: Final = 1 << 61
"""Bound of scan numbers: numbers that the map's record reserves beyond them must be valid, too."""
_ROW: Final = np.dtype([("mapper", "<u8"), ("scan", "<u8")])
APPLIED_BYTES: Final = _ROW.itemsize * MAPPERS


class AppliedScans:
    """For each mapper, the last scan up to which all are in memory that outlives the worker.

    A program that replays scans from files continues after this scan.  The number is never greater than that
    of the scans in the map; a scan that is sent again does not count twice.

    Parameters
    ----------
    memory
        `APPLIED_BYTES` bytes, initially zeros.
    """

    def __init__(self, memory: bytearray | mmap.mmap) -> None:
        self._rows = np.frombuffer(memory, _ROW, MAPPERS)

    def of(self, mapper: int) -> int:
        """Return the scan up to which all are in the map; 0 if unknown."""
        found = np.flatnonzero(self._rows["mapper"] == mapper)
        return int(self._rows["scan"][found[0]]) if len(found) else 0

    def note(self, mapper: int, scan: int, known: Collection[int]) -> None:
        """Record that all scans of a mapper up to this one are in the map; replace mappers not ``known``."""
        found = np.flatnonzero(self._rows["mapper"] == mapper)
        if not len(found):
            numbers = self._rows["mapper"].tolist()
            at = next((at for at, number in enumerate(numbers) if number not in known), None)
            if at is None:
                return  # no scan is lost: only the scan to continue from is unknown
            self._rows["scan"][at] = 0  # a kill between these steps must not leave another mapper's number
            self._rows["mapper"][at] = mapper
            found = np.array([at])
        self._rows["scan"][found[0]] = scan


@dataclass(eq=False, slots=True)
class ActiveMapper:
    """A mapper in this run of the worker.

    Attributes
    ----------
    first
        The lowest number that no scan had in previous runs.
    session
        The session that uses the mapper now; 0 for none.
    last
        Highest number of an accepted scan; initially, of a scan known to be in the map.
    used
        Order of use: the mapper with the greatest value was used last.
    unapplied, unsaved
        Accepted scans that are not applied yet, and that are not durable yet.
    """

    mapper: Mapper
    first: int = 1
    session: int = 0
    last: int = 0
    used: int = 0
    unapplied: set[int] = field(default_factory=set)
    unsaved: set[int] = field(default_factory=set)

    @property
    def applied(self) -> int:
        """Number of the scan up to which all are in the map."""
        return min(self.unapplied) - 1 if self.unapplied else self.last

    @property
    def durable(self) -> int:
        """Number of the scan up to which all are on disk."""
        return min(self.unsaved) - 1 if self.unsaved else self.last


class Mappers:
    """All mappers of one map."""

    def __init__(self, database: MapDatabase, record: AppliedScans) -> None:
        self._database = database
        self._record = record
        self._uses = 0
        self._opening = threading.Lock()
        self.by_number: dict[int, ActiveMapper] = {}
        for one in database.record.mappers:
            last = max(record.of(one.number), database.record.applied.get(one.number, 0))
            self.by_number[one.number] = ActiveMapper(one, one.scans + 1, last=last)

    def open(self, uid: int, name: str, session: int) -> ActiveMapper:
        """Assign a mapper to a session, taking it from any other session.  Called from any thread.

        Raises
        ------
        Busy
            There are as many mappers as a chunk can remember, and none can be forgotten.
        OSError
            A new mapper cannot be written to disk.
        """
        with self._opening:
            for active in self.by_number.values():
                if (active.mapper.uid, active.mapper.name) == (uid, name):
                    break
            else:
                if len(self.by_number) >= MAPPERS:
                    self._forget_one()
                mapper = self._database.add_mapper(uid, name)
                active = ActiveMapper(mapper)
                self.by_number = {**self.by_number, mapper.number: active}  # another thread may iterate
            # now, not with the first scan: once opened, a mapper works even when the disk is full
            self._database.expect_scan(active.mapper, self.next_scan(active))
            active.session = session
            self._uses += 1
            active.used = self._uses
            return active

    def _forget_one(self) -> None:
        idle = [one for one in self.by_number.values() if not one.session and not one.unsaved]
        if not idle:
            raise Busy(
                f"{MAPPERS} mappers have this map open already",
                hint="end one of them, or let two programs' scans come through one",
            )
        oldest = min(idle, key=lambda one: one.used)
        self._database.forget_mapper(oldest.mapper)
        self.by_number = {number: one for number, one in self.by_number.items() if one is not oldest}

    def accepted(self, active: ActiveMapper, scan: int) -> None:
        """Record that a scan was accepted, possibly again."""
        active.unapplied.add(scan)
        active.unsaved.add(scan)
        active.last = max(active.last, scan)

    def applied(self, active: ActiveMapper, scan: int) -> None:
        """Record that a scan is in the map."""
        active.unapplied.discard(scan)
        self._record.note(active.mapper.number, active.applied, self.by_number)

    def next_scan(self, active: ActiveMapper) -> int:
        """Return the lowest number for a new scan, which no scan of any run had."""
        return max(active.last + 1, active.first)

    def is_far(self, number: int, scan: int) -> bool:
        """Return whether a scan's number has to be recorded on disk first."""
        active = self.by_number.get(number)
        return active is not None and active.mapper.scans <= scan < MAX_SCANS

    def expect(self, number: int, scan: int, session: int) -> ActiveMapper:
        """Return the mapper of a scan about to be accepted; wait for the disk if `is_far`.

        Raises
        ------
        BadRequest
            The session does not use this mapper.
        LiveInterrupted
            No session uses it, since the worker was restarted.
        OSError
            The number cannot be written to disk.
        """
        active = self.by_number.get(number)
        if active is None:
            raise BadRequest(
                f"this map does not know mapper {number}",
                hint="it has not mapped for long: open the map again",
            )
        if not active.session:
            raise LiveInterrupted(f"no mapper {active.mapper.name!r} is active", hint="open the map again")
        if active.session != session:
            raise BadRequest(
                f"another program maps as {active.mapper.name!r} now", hint="give each program its own name"
            )
        if not 0 < scan < MAX_SCANS:
            raise BadRequest(f"scan {scan}: numbers begin at 1 and rise")
        if scan >= active.mapper.scans:
            with self._opening:
                self._database.expect_scan(active.mapper, scan)
        return active

    def on_disconnect(self, session: int) -> None:
        """Note that a session has ended."""
        for active in self.by_number.values():
            if active.session == session:
                active.session = 0
