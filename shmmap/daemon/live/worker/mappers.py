# SPDX-License-Identifier: Apache-2.0
"""Who maps, and which of their scans are where: applied once each, whatever is sent again.

A mapper is a user and a name that a program of theirs chose; its scans have numbers that rise, also when the
program starts anew.  A scan that was sent twice is applied once: while it is on its way, both are answered
by it; afterwards every chunk knows that it has it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Final

from shmmap.chunks.layout import MAPPERS
from shmmap.daemon.live.map_files import MapFiles, Mapper
from shmmap.daemon.live.worker.applied_scans import AppliedScans
from shmmap.errors import BadRequest, Busy, LiveInterrupted

__all__ = ["ActiveMapper", "Mappers"]

MOST_SCANS: Final = 1 << 61
"""Numbers of scans are less: what ``map.json`` expects beyond them has to be a number, too."""


@dataclass(eq=False, slots=True)
class ActiveMapper:
    """A mapper in this life of the worker.

    Attributes
    ----------
    first
        The least number that no scan had before this life.
    session
        Who maps under it now; 0: nobody.
    last
        Highest number of a scan that was taken in; in an earlier life, that is known to be in the map.
    used
        Order of use: the greatest was used last.
    unapplied, unsaved
        Scans that were taken in and are not applied, and not durable.
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
        """All scans up to this one are in the map."""
        return min(self.unapplied) - 1 if self.unapplied else self.last

    @property
    def durable(self) -> int:
        """All scans up to this one are on the disk."""
        return min(self.unsaved) - 1 if self.unsaved else self.last


class Mappers:
    """The mappers of one map."""

    def __init__(self, files: MapFiles, record: AppliedScans) -> None:
        self._files = files
        self._record = record
        self._uses = 0
        self._opening = threading.Lock()
        self.by_number: dict[int, ActiveMapper] = {}
        for one in files.mappers:
            last = max(record.of(one.number), files.applied.get(one.number, 0))
            self.by_number[one.number] = ActiveMapper(one, one.scans + 1, last=last)

    def open(self, uid: int, name: str, session: int) -> ActiveMapper:
        """Let a session map under a name; one that did before does not any more.  From any thread.

        Raises
        ------
        Busy
            There are as many mappers as a chunk remembers, and none of them can be forgotten.
        OSError
            The disk does not take a new one.
        """
        with self._opening:
            for active in self.by_number.values():
                if (active.mapper.uid, active.mapper.name) == (uid, name):
                    break
            else:
                if len(self.by_number) >= MAPPERS:
                    self._forget_one()
                mapper = self._files.add_mapper(uid, name)
                active = ActiveMapper(mapper)
                self.by_number = {**self.by_number, mapper.number: active}  # others go through it meanwhile
            # now, and not with the first scan: once it may map, it does, also on a disk that is full
            self._files.expect_scan(active.mapper, self.next_scan(active))
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
        self._files.forget_mapper(oldest.mapper)
        self.by_number = {number: one for number, one in self.by_number.items() if one is not oldest}

    def taken(self, active: ActiveMapper, scan: int) -> None:
        """A scan is on its way into the map; it may have come before."""
        active.unapplied.add(scan)
        active.unsaved.add(scan)
        active.last = max(active.last, scan)

    def applied(self, active: ActiveMapper, scan: int) -> None:
        """A scan is in the map."""
        active.unapplied.discard(scan)
        self._record.note(active.mapper.number, active.applied, self.by_number)

    def next_scan(self, active: ActiveMapper) -> int:
        """The least number that a new scan may have: no earlier one, of any life, had it."""
        return max(active.last + 1, active.first)

    def is_far(self, number: int, scan: int) -> bool:
        """Whether the disk has to learn of a scan's number first."""
        active = self.by_number.get(number)
        return active is not None and active.mapper.scans <= scan < MOST_SCANS

    def expect(self, number: int, scan: int, session: int) -> ActiveMapper:
        """Return whose scan this is, which is about to be taken in; waits for the disk if `is_far` says so.

        Raises
        ------
        BadRequest
            The session does not map under this number.
        LiveInterrupted
            No session does, since the worker began anew.
        OSError
            The disk does not take what has to be there first.
        """
        active = self.by_number.get(number)
        if active is None:
            raise BadRequest(
                f"this map does not know mapper {number}",
                hint="it has not mapped for long: open the map again",
            )
        if not active.session:
            raise LiveInterrupted(
                f"nobody maps as {active.mapper.name!r} just now", hint="open the map again"
            )
        if active.session != session:
            raise BadRequest(
                f"another program maps as {active.mapper.name!r} now", hint="give each program its own name"
            )
        if not 0 < scan < MOST_SCANS:
            raise BadRequest(f"scan {scan}: numbers begin at 1 and rise")
        if scan >= active.mapper.scans:
            with self._opening:
                self._files.expect_scan(active.mapper, scan)
        return active

    def left(self, session: int) -> None:
        """A session has ended."""
        for active in self.by_number.values():
            if active.session == session:
                active.session = 0
