# SPDX-License-Identifier: Apache-2.0
"""Takes over, watches or removes the segments that a previous run left in the shared-memory directory.

Each file name of the instance is examined once, before anything is served:

- a published segment of this user, with a valid header and the version that its cell has in the map now,
  is *adopted*: it is served again as soon as a worker has compared its bytes with their checksums;
- a segment whose version is not known yet, because the page of the map with its box is missing, is
  *deferred*: it keeps its name, its bytes count, and it is judged when the page arrives;
- any other segment that a process still maps is kept as a retired one, by name and cell, and is freed when
  its last reader unmaps it;
- all others are removed.  Files that this user may not remove (another account's file under a name of
  this instance) are ignored and never served.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.eviction_plan import HAND_OUT_GRACE_S
from shmmap.daemon.loading.loads import BACKGROUND, Loads
from shmmap.daemon.loading.scheduler import MisplacedCells
from shmmap.daemon.records import Key, Resident
from shmmap.errors import BadRequest, SegmentCorrupt
from shmmap.failpoints import step
from shmmap.geometry import Box
from shmmap.layers.spec import layer_spec
from shmmap.logfmt import log
from shmmap.segment.directory import measured_bytes
from shmmap.segment.header import read_header
from shmmap.segment.layout import SegmentHeader
from shmmap.segment.names import is_retired, retired_name, segment_prefix, statistics_name

NOT_IN_MAP: Final = "its cell is not in the map"
CHANGED: Final = "its cell, or one around it, has changed"
UNDECIDED: Final = (NOT_IN_MAP, CHANGED)
"""Reasons for rejection that may disappear when more of the map is known."""
ADOPTED: Final = 0.5 * BACKGROUND
"""Priority of pages needed to judge an earlier run's segments: after everything that a client waits for."""


@dataclass(eq=False, slots=True)
class Adoption:
    """Takes over the files in the directory that have the instance's name."""

    cache: CellCache
    loads: Loads
    misplaced: MisplacedCells
    _deferred: dict[str, tuple[Box, int]] = field(default_factory=dict)  # area to look in, and bytes, by name
    _by_page: dict[int, list[str]] = field(default_factory=dict)  # names by the page that they wait for

    def take_over(self, now_s: float) -> None:
        """Examine every name once."""
        counts = dict.fromkeys(("taken_over", "set_aside", "still_in_use", "dropped"), 0)
        directory, instance = self.cache.directory, self.cache.instance
        for name in directory.names(segment_prefix(instance)):
            if name != statistics_name(instance):
                counts[self._take(name, now_s)] += 1
        step("daemon.adopted")
        if any(counts.values()):
            log.info("leftover segments", **counts)

    def pages_came(self, pages: Iterable[int], now_s: float) -> None:
        """Judge the segments deferred for pages that have arrived."""
        for page in pages:
            self._judge(self._by_page.pop(page, ()), now_s)

    def map_changed(self, now_s: float) -> None:
        """Judge deferred segments by the pages of another state of the map."""
        self._by_page.clear()
        self._judge(list(self._deferred), now_s)

    def _judge(self, names: Iterable[str], now_s: float) -> None:
        """Decide about deferred segments; each waits on while a page of its area is missing."""
        ledger = self.cache.ledger
        for name in names:
            area, nbytes = self._deferred[name]
            page = self._absent_page(area)
            if page is not None:
                self._by_page.setdefault(page, []).append(name)
            else:
                del self._deferred[name]
                ledger.set_aside_bytes -= nbytes
                self._take(name, now_s)

    def close(self, *, keep: bool) -> None:
        """Remove the names of segments still deferred, or leave them to the next run."""
        if not keep:
            for name in self._deferred:
                self._remove(name, "the daemon ends")

    def _absent_page(self, area: Box) -> int | None:
        """Return a page of an area that is not in memory; None if all are."""
        pages = self.cache.pages
        if pages is None:
            return None
        return next((page for page in pages.of_area(area) if not pages.is_here(page)), None)

    def _may_become_known(self, resident: Resident) -> Box | None:
        """Return the area by which a segment is judged if pages of it are missing; else None."""
        catalogue, layers = self.cache.catalogue, self.cache.layers
        if catalogue.complete or is_retired(resident.name):
            return None
        min_x, min_y, max_x, max_y = resident.box
        halo_m = layers.halo_m((resident.key.layer,))
        area = Box(min_x - halo_m, min_y - halo_m, max_x + halo_m, max_y + halo_m)
        return area if self._absent_page(area) is not None else None

    def _defer(self, name: str, area: Box, nbytes: int, now_s: float) -> None:
        self._deferred[name] = area, nbytes
        self.cache.ledger.set_aside_bytes += nbytes
        self._judge((name,), now_s)
        pages = self.cache.pages
        if pages is not None:
            pages.want(pages.of_area(area), ADOPTED)

    def _take(self, name: str, now_s: float) -> str:
        """Decide about a name; return what was done with it."""
        directory = self.cache.directory
        try:
            fd = directory.open(name)
        except OSError as error:
            self._remove(name, str(error.strerror))
            return "dropped"
        try:
            resident, outside, why_not = self._look(fd, name, now_s)
            if not why_not:
                self._adopt(fd, resident, outside)
                return "taken_over"
            if why_not in UNDECIDED and (area := self._may_become_known(resident)) is not None:
                self._defer(name, area, resident.nbytes, now_s)
                return "set_aside"
            if self._is_used(fd):
                reclaimer = self.cache.reclaimer
                reclaimer.adopt(resident, now_s, hidden=is_retired(name))
                return "still_in_use"
            self._remove(name, why_not)
            return "dropped"
        finally:
            os.close(fd)

    # --- judging ------------------------------------------------------------------------------

    def _look(self, fd: int, name: str, now_s: float) -> tuple[Resident, int, str]:
        """Return a segment as its header describes it, its points outside, and why it cannot be served."""
        live_name, nbytes = name.removesuffix(retired_name("")), measured_bytes(fd)
        unknown = Resident(live_name, Key("", ""), 0, nbytes, 0, (0.0,) * 4, 0.0, 0.0, checked=False)
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            return unknown, 0, "it is no regular file"
        if status.st_uid != os.geteuid():
            return unknown, 0, f"it belongs to user {status.st_uid}"
        try:
            header, block = read_header(fd)
        except (SegmentCorrupt, OSError, UnicodeDecodeError) as error:
            return unknown, 0, str(error)
        resident = Resident(
            live_name,
            Key(header.cell_id, header.layer),
            block.version,
            nbytes,
            header.rows,
            header.box,
            header.z_min,
            header.z_max,
            last_use_s=now_s - HAND_OUT_GRACE_S,
            checked=False,
        )
        return resident, header.outside_points, self._why_not(name, status, header, resident)

    def _why_not(self, name: str, status: os.stat_result, header: SegmentHeader, resident: Resident) -> str:
        """Return why a complete segment cannot be served; empty if it can."""
        catalogue, ledger, layers = self.cache.catalogue, self.cache.ledger, self.cache.layers
        if is_retired(name):
            return "it was retired"
        if status.st_mode & 0o222 or status.st_nlink != 1:
            return "others may have changed it"
        try:
            spec = layer_spec(header.layer)
        except BadRequest:
            return f"there is no layer {header.layer} any more"
        if str(spec) != header.layer or spec.builder_version != header.builder_version:
            return f"layer {header.layer} is built otherwise now"
        index = catalogue.find(header.cell_id)
        if index is None:
            return NOT_IN_MAP
        if resident.key in ledger.by_key:
            return "there is another one"
        if resident.version != layers.version(index, header.layer):
            return CHANGED
        if header.frame_id != catalogue.frame_id:
            return "it is in another frame"
        if ledger.shortage(status.st_blocks * 512) > 0:
            return "it does not fit in the budget"
        return ""

    # --- acting -------------------------------------------------------------------------------

    def _adopt(self, fd: int, resident: Resident, outside: int) -> None:
        step("daemon.adopt")
        if self.cache.gid >= 0:
            os.fchown(fd, -1, self.cache.gid)
        os.fchmod(fd, self.cache.mode)
        index = self.cache.index_of(resident.key.cell_id)
        assert index is not None  # noqa: S101  checked in _why_not
        self.cache.adopt(resident, index)
        if outside:
            self.misplaced.note(resident.key.cell_id, index, outside)
        self.loads.check_leftover(resident)

    def _is_used(self, fd: int) -> bool:
        reclaimer = self.cache.reclaimer
        try:
            return os.fstat(fd).st_uid == os.geteuid() and reclaimer.pins.is_used_elsewhere(fd)
        except OSError:  # a file system without leases
            return False

    def _remove(self, name: str, why: str) -> None:
        directory = self.cache.directory
        try:
            directory.unlink(name)
        except OSError as error:
            # in a sticky directory only the owner may remove a file; a directory is not a segment
            report = log.info if error.errno == errno.EISDIR else log.warning
            report("leftover not removed", name=name, unusable=why, error=error.strerror)
