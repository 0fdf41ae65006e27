# SPDX-License-Identifier: Apache-2.0
"""Pass cells between processes: pickle transfers the handle, and the receiver attaches it.

So a process pool, a DataLoader, dask or ray send a few hundred bytes for a cell of megabytes.  Only a mapping
keeps a segment in memory: the sender has to keep its cell until the receiver has attached it.

A cell that cannot be attached raises `StaleHandle` when it is unpickled.  `multiprocessing` is an exception:
its pools and queues would wait without bound for a message that failed to unpickle.  There the cell arrives
without its data, and raises the error at its first use.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from functools import cache
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, NoReturn

from shmmap.client.attaching import Attacher, owner_of_segments
from shmmap.client.cell import Access, Cell
from shmmap.errors import SegmentCorrupt, ShmmapError, StaleHandle
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import AttachedSegment
from shmmap.segment.layout import ColumnRow
from shmmap.segment.names import retired_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_COPY_HINT: Final = (
    "keep the cell until the other process has it, or hand over cell.copy(), which has the points"
)
_PLUMBING: Final = frozenset(
    f"multiprocessing.{name}" for name in ("connection", "forkserver", "queues", "reduction", "spawn")
)
"""Modules that unpickle in a thread, and leave their caller waiting if that fails."""


class _Gone:
    """Placeholder for the data of a cell that could not be attached."""

    def __init__(self, error: ShmmapError) -> None:
        self._error = error

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise type(self._error)(self._error.message, hint=self._error.hint)


@cache
def _boot() -> str:
    """Return the kernel's boot id, which containers share; empty if the kernel does not report it."""
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return file.read().strip()
    except OSError:
        return ""


def hand_over(cell: Cell) -> tuple[Callable[..., Cell], tuple[Any, ...]]:
    """Return the function and arguments with which pickle restores a cell."""
    attached, access = cell._attached, cell._access
    if access is None:  # a copy
        return _private, (cell.id, cell.handle(), attached.columns, attached.raw)
    published = attached.published
    epoch = published.epoch if published is not None else 0
    return _take, (_boot(), access.shm_dir, access.slot, epoch, cell.id, cell.handle())


def _private(cell_id: str, handle: Handle, columns: list[ColumnRow], raw: NDArray[np.uint8]) -> Cell:
    return Cell(cell_id, "", handle, AttachedSegment(columns, raw), None)


def _take(boot: str, shm_dir: str, slot: int | None, epoch: int, cell_id: str, handle: Handle) -> Cell:
    """Attach a cell that another process has handed over."""
    access = Access(os.environ.get("SHMMAP_SHM_DIR") or shm_dir, slot, None)
    named = f"{cell_id} ({handle.layer})"
    try:
        if boot and _boot() and boot != _boot():
            raise StaleHandle(
                f"{named}: it was pickled on another machine, or before this one was restarted: a pickled"
                " cell names shared memory of its machine",
                hint="pickle cell.copy(), which has the points, or ask for the cell where it is needed",
            )
        return _attached(access, epoch, cell_id, handle, named)
    except ShmmapError as error:
        if not _loses_errors(sys._getframe(1)):
            raise
        return Cell(cell_id, handle.segment, handle, _Gone(error), access)  # type: ignore[arg-type]


def _attached(access: Access, epoch: int, cell_id: str, handle: Handle, named: str) -> Cell:
    owner = owner_of_segments(access.shm_dir, f"{handle.segment.rpartition('.')[0]}.")
    access = access._replace(owner=owner)
    for name in (handle.segment, retired_name(handle.segment)):
        try:
            with _lock:
                cell = _attacher.attached(handle) or _attacher.attach(handle, cell_id, name, access)
            published = cell._attached.published
        except (StaleHandle, SegmentCorrupt):
            continue
        if published is None or (published.epoch, published.version) == (epoch, handle.version):
            cell.segment = handle.segment
            return cell
    where = (
        ""
        if owner is not None
        else f" (no daemon's segments are in {access.shm_dir}, as this process sees it)"
    )
    raise StaleHandle(
        f"{named}: the segment {handle.segment} is gone since it was pickled: evicted, replaced, or its"
        f" daemon stopped{where}",
        hint=_COPY_HINT,
    )


def _loses_errors(frame: FrameType | None) -> bool:
    """Return whether `multiprocessing` itself is unpickling, and not the program that it runs."""
    while frame is not None:
        module: str = frame.f_globals.get("__name__", "")
        if module.startswith("multiprocessing."):
            return module in _PLUMBING
        frame = frame.f_back
    return False


_attacher: Final = Attacher()
_lock = threading.Lock()


def _after_fork_in_child() -> None:
    global _lock
    _lock = threading.Lock()
    _attacher.restart_in_child()


os.register_at_fork(after_in_child=_after_fork_in_child)
