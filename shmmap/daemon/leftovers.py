# SPDX-License-Identifier: Apache-2.0
"""What an earlier life of the daemon left in the shared-memory directory."""

from __future__ import annotations

import logging
import os

from shmmap.daemon.reclaim import Reclaimer
from shmmap.daemon.residency import Key, Resident
from shmmap.segment.directory import ShmDirectory, measured_bytes
from shmmap.segment.names import is_zombie, segment_prefix, statistics_name, zombie_name
from shmmap.segment.pins import is_pinned

__all__ = ["retire_leftovers"]

_log = logging.getLogger(__name__)


def retire_leftovers(directory: ShmDirectory, instance: str, reclaimer: Reclaimer, now_s: float) -> int:
    """Remove segments nobody uses; keep the others in the books as zombies.  Returns their number.

    Nothing that was left is handed out again.
    """
    kept = 0
    for name in directory.names(segment_prefix(instance)):
        if name.startswith((statistics_name(instance), segment_prefix(instance) + "lock")):
            continue
        try:
            fd = directory.open(name)
        except OSError as error:
            _log.warning("leftover %s cannot be opened: %s", name, error.strerror)
            directory.unlink(name)
            continue
        try:
            pinned, nbytes = is_pinned(fd), measured_bytes(fd)
        finally:
            os.close(fd)
        if not pinned:
            directory.unlink(name)
            continue
        if not is_zombie(name):
            directory.rename(name, zombie_name(name))
        live_name = name.removesuffix(zombie_name(""))
        box = (0.0, 0.0, 0.0, 0.0)
        reclaimer.adopt(Resident(live_name, Key("", ""), 0, nbytes, 0, box, 0.0, 0.0), now_s)
        kept += 1
    if kept:
        _log.info("%d segments of an earlier daemon are still in use", kept)
    return kept
