# SPDX-License-Identifier: Apache-2.0
"""What an earlier life of the daemon left in the shared-memory directory: taken over, watched or removed.

Every name of the instance is looked at once, before anything is served:

- a segment that is published, ours, whole by its header, and of the version its cell has in the map
  now is *adopted*: it serves again as soon as a worker has compared its bytes with their checksums;
- any other segment that somebody still maps is kept as a retired one, known by name and cell, and is
  freed when its last reader lets go;
- the rest is removed.  What this user may not remove (a stranger's file that squats one of our
  names) is left alone and never served.
"""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import dataclass
from typing import NamedTuple

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.reclaimer import HAND_OUT_GRACE_S
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.records import Key, Resident
from shmmap.errors import BadRequest, SegmentCorrupt
from shmmap.failpoints import step
from shmmap.layers.spec import layer_spec
from shmmap.logfmt import log
from shmmap.segment.directory import ShmDirectory, measured_bytes
from shmmap.segment.layout import SegmentHeader
from shmmap.segment.names import another_name, is_retired, retired_name, segment_prefix, statistics_name
from shmmap.segment.publish_block import PublishBlock
from shmmap.segment.verify import read_header

__all__ = ["Adoption"]


class _Found(NamedTuple):
    """A leftover as its header describes it, and why it cannot serve (empty: it can)."""

    header: SegmentHeader | None
    block: PublishBlock | None
    why_not: str


@dataclass(eq=False, slots=True)
class Adoption:
    """Takes over what is in the directory under an instance's name.

    Parameters
    ----------
    mode, gid
        Access that published segments are to have from now on; ``gid`` -1 leaves the group alone.
    """

    directory: ShmDirectory
    instance: str
    cache: CellCache
    loads: Loads
    mode: int
    gid: int

    def take_over(self, now_s: float) -> None:
        """Look at every name once."""
        counts = dict.fromkeys(("taken_over", "still_in_use", "dropped"), 0)
        prefix = segment_prefix(self.instance)
        not_segments = (statistics_name(self.instance), prefix + "lock")
        for name in self.directory.names(prefix):
            if not name.startswith(not_segments):
                counts[self._take(name, now_s)] += 1
        step("daemon.adopted")
        if any(counts.values()):
            log.info("segments of an earlier daemon", **counts)

    def _take(self, name: str, now_s: float) -> str:
        """What becomes of a name."""
        try:
            fd = self.directory.open(name)
        except OSError as error:
            self._remove(name, str(error.strerror))
            return "dropped"
        try:
            found = self._look(fd, name)
            if not found.why_not:
                self._adopt(fd, name, found, now_s)
                return "taken_over"
            return "still_in_use" if self._keep_for_readers(fd, name, found, now_s) else "dropped"
        finally:
            os.close(fd)

    # --- judging ------------------------------------------------------------------------------

    def _look(self, fd: int, name: str) -> _Found:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            return _Found(None, None, "it is no regular file")
        if status.st_uid != os.geteuid():
            return _Found(None, None, f"it belongs to user {status.st_uid}")
        try:
            header, block = read_header(fd)
        except (SegmentCorrupt, OSError, UnicodeDecodeError) as error:
            return _Found(None, None, str(error))
        return _Found(header, block, self._why_not(name, status, header, block))

    def _why_not(self, name: str, status: os.stat_result, header: SegmentHeader, block: PublishBlock) -> str:
        """Why a whole segment cannot serve; empty if it can."""
        cache, catalogue = self.cache, self.cache.catalogue
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
            return "its cell is not in the map"
        if Key(header.cell_id, header.layer) in cache.ledger.by_key:
            return "there is another one"
        known = cache.layers.version(index, header.layer), catalogue.stamp(index)
        if (block.version, header.source) != known:
            return "its source has changed"
        if header.box != catalogue.box(index) or header.frame_id != catalogue.frame_id:
            return "its cell has moved"
        if cache.ledger.shortage(status.st_blocks * 512) > 0:
            return "it does not fit in the budget"
        return ""

    # --- acting -------------------------------------------------------------------------------

    def _adopt(self, fd: int, name: str, found: _Found, now_s: float) -> None:
        step("daemon.adopt")
        assert found.header is not None  # noqa: S101  _look gives a reason where there is none
        if self.gid >= 0:
            os.fchown(fd, -1, self.gid)
        os.fchmod(fd, self.mode)
        index = self.cache.catalogue.find(found.header.cell_id)
        assert index is not None  # noqa: S101
        resident = self._resident(fd, name, found, now_s)
        self.cache.adopt(resident, index)
        self.loads.check(resident)

    def _keep_for_readers(self, fd: int, name: str, found: _Found, now_s: float) -> bool:
        """Watch it as a retired one if somebody uses it, else remove it; True if it is used."""
        try:
            used = os.fstat(fd).st_uid == os.geteuid() and self.cache.reclaimer.pins.told(fd)
        except OSError:  # nothing that has leases
            used = False
        if not used:
            self._remove(name, found.why_not)
            return False
        if not is_retired(name):
            hidden = retired_name(name)
            try:
                self.directory.rename(name, hidden)
            except OSError:  # somebody else has taken that name
                hidden = retired_name(another_name(name))
                self.directory.rename(name, hidden)
            name = hidden
        self.cache.reclaimer.adopt(self._resident(fd, name, found, now_s), now_s)
        return True

    def _resident(self, fd: int, name: str, found: _Found, now_s: float) -> Resident:
        live_name = name.removesuffix(retired_name(""))
        nbytes, used_s = measured_bytes(fd), now_s - HAND_OUT_GRACE_S
        header, block = found.header, found.block
        if header is None or block is None:
            return Resident(live_name, Key("", ""), 0, nbytes, 0, (0.0,) * 4, 0.0, 0.0, checked=False)
        return Resident(
            live_name, Key(header.cell_id, header.layer), block.version, nbytes, header.rows, header.box,
            header.z_min, header.z_max, last_use_s=used_s, checked=False,
        )  # fmt: skip

    def _remove(self, name: str, why: str) -> None:
        try:
            self.directory.unlink(name)
        except OSError as error:
            # sticky directories let only a file's owner remove it; a directory is nobody's segment
            tell = log.info if error.errno == errno.EISDIR else log.warning
            tell("leftover not removed", name=name, unusable=why, error=error.strerror)
