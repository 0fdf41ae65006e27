# SPDX-License-Identifier: Apache-2.0
"""`LiveMapper`: scans become marks here, and the daemon's live worker puts them into the map, each once.

Marking is done by whoever calls `LiveMapper.add`; sending, and waiting for the answer, by a thread with a
session of its own.  What the daemon has not answered is sent again when it, or its worker, has come back.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
import time
from dataclasses import dataclass
from queue import Queue
from typing import TYPE_CHECKING, Final

from shmmap.chunks.marking import Counts, Marker, ScanFilter
from shmmap.chunks.marks import encode_marks
from shmmap.client.connection import Connection
from shmmap.client.session import Session
from shmmap.errors import (
    BadRequest,
    Busy,
    CannotWrite,
    DaemonUnreachable,
    LiveInterrupted,
    NoAnswer,
    ShmmapError,
)
from shmmap.protocol import live as messages

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["LiveMapper"]

ON_THE_WAY: Final = 3
"""Scans that are marked and not answered; `LiveMapper.add` waits when there are more."""
PAUSE_S: Final = 0.05
"""Between two tries while the worker is started anew."""


@dataclass(frozen=True, slots=True)
class _Marked:
    """A scan to send: what it says of voxels, and where the sensor was."""

    number: int
    data: bytes
    sensor: tuple[float, float, float]


class LiveMapper:
    """Sends scans to a live map; get one from `LiveMap.mapper`.  Use it from one thread at a time.

    Attributes
    ----------
    name
        Under which it maps.
    counts : Counts or None
        What became of the points of the last scan.
    """

    def __init__(
        self, session: Session, live_map: str, name: str, frame_id: str, scan_filter: ScanFilter | None,
        timeout_s: float,
    ) -> None:  # fmt: skip
        if not name:
            raise BadRequest("a mapper needs a name", hint="one that the program keeps: 'front_lidar'")
        self.name = name
        self.counts: Counts | None = None
        self._map, self._frame_id, self._timeout_s = live_map, frame_id, timeout_s
        self._shm_dir = os.environ.get("SHMMAP_LIVE_SHM_DIR", "")
        self._connection = Connection(
            (session.path,), name=f"mapper {name}"[:64], timeout_s=session.timeout_s
        )
        self._changed = threading.Condition()
        self._error: ShmmapError | None = None
        self._applied = self._durable = 0
        self._files = 0
        try:
            self._opened = self._open()
        except BaseException:
            self._connection.close()
            raise
        self._marker = Marker(self._opened.resolution, scan_filter)
        self._next = self._opened.next_scan
        self._applied = self._durable = self._last = self._next - 1
        self._queue: Queue[_Marked | None] = Queue(ON_THE_WAY)
        self._thread = threading.Thread(target=self._send_all, name=f"mapper {name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> LiveMapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Send what is on the way, wait until it is applied, and end the session; raises no error."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
            self._connection.close()

    # --- scans ----------------------------------------------------------------------------------

    def add(self, points: NDArray[np.floating], pose: NDArray[np.floating]) -> int:
        """Add a scan; waits while earlier ones are still on the way.

        Parameters
        ----------
        points
            (N, 3) float32 or float64, metres in the sensor's frame; those that are not finite are left out.
        pose
            (3, 4) or (4, 4): rotation and position of the sensor in the map's frame, metres.

        Returns
        -------
        The scan's number.

        Raises
        ------
        BadRequest
            A shape is wrong, the pose is no rotation and finite position, or the scan touches too much.
        ShmmapError
            Why an earlier scan, and all after it, did not get into the map.
        """
        self._check()
        marks, self.counts = self._marker.mark(points, pose)
        number, self._next = self._next, self._next + 1
        data = encode_marks(marks, self._opened.map_id, self._opened.mapper, number)
        if len(data) > self._opened.most_marks_bytes:
            raise BadRequest(
                f"the scan's marks have {len(data)} bytes; {self._opened.most_marks_bytes} are the most",
                hint="lower max_range, or make the map with larger voxels",
            )
        x, y, z = (float(pose[axis][3]) for axis in range(3))
        self._last = number
        self._queue.put(_Marked(number, data, (x, y, z)))
        return number

    @property
    def applied(self) -> int:
        """Highest number of a scan that is in the map: no death of a process takes it out."""
        return self._applied

    @property
    def durable(self) -> int:
        """All scans up to this one are on the disk, as of the last answer."""
        return self._durable

    def wait_applied(self, timeout_s: float | None = None) -> int:
        """Wait until every scan that was added is applied; returns the last one's number.

        Raises
        ------
        NoAnswer
            It took longer than ``timeout_s`` seconds (None: than the mapper's own).
        ShmmapError
            Why one could not be applied.
        """
        patience_s = self._timeout_s if timeout_s is None else timeout_s
        with self._changed:
            self._changed.wait_for(lambda: self._applied >= self._last or self._error is not None, patience_s)
        self._check()
        if self._applied < self._last:
            raise NoAnswer(f"scan {self._last} was not applied within {patience_s:.3g} s")
        return self._applied

    def wait_durable(self, timeout_s: float = 300.0) -> int:
        """Have everything saved; returns the number up to which all scans are on the disk.

        Raises as `wait_applied`.
        """
        self.wait_applied()
        reply = self._connection.ask(
            messages.LiveSave(self._connection.new_request(), self._map), messages.LiveDurable,
            timeout_s=timeout_s, quiet_s=timeout_s,
        )  # fmt: skip
        self._durable = reply.scan
        return reply.scan

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    # --- sending --------------------------------------------------------------------------------

    def _open(self) -> messages.LiveOpened:
        return self._connection.ask(
            messages.LiveOpen(self._connection.new_request(), self._map, self.name, self._frame_id),
            messages.LiveOpened,
            timeout_s=self._timeout_s,
        )

    def _send_all(self) -> None:
        while (scan := self._queue.get()) is not None:
            if self._error is not None:
                continue  # what comes later cannot go in before it
            try:
                durable = self._send(scan)
            except ShmmapError as error:
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
            else:
                with self._changed:
                    self._applied, self._durable = scan.number, max(self._durable, durable)
                    self._changed.notify_all()

    def _send(self, scan: _Marked) -> int:
        """Send a scan until it is answered; returns what is durable."""
        end_s = time.monotonic() + self._timeout_s
        while True:
            try:
                return self._try(scan, max(0.1, end_s - time.monotonic()))
            except (LiveInterrupted, Busy, DaemonUnreachable) as error:  # noqa: PERF203  until it is there again
                if time.monotonic() >= end_s:
                    raise
                time.sleep(PAUSE_S)  # nothing tells when the worker is there again
                with contextlib.suppress(LiveInterrupted, Busy, DaemonUnreachable):
                    if not isinstance(error, Busy):
                        self._opened = self._open()

    def _try(self, scan: _Marked, timeout_s: float) -> int:
        self._files += 1
        name = f"{self._connection.welcome.session:x}.{self._files}"
        path = os.path.join(self._opened.marks_dir, name)
        try:
            _write(path, scan.data)
            reply = self._connection.ask(
                messages.LiveScan(
                    self._connection.new_request(), self._map, self._opened.mapper, scan.number, name,
                    len(scan.data), scan.sensor,
                ),
                messages.LiveApplied, timeout_s=timeout_s, quiet_s=timeout_s,
            )  # fmt: skip
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(path)
        return reply.durable


def _write(path: str, data: bytes) -> None:
    """Make a file of marks.

    Raises
    ------
    LiveInterrupted
        There is no directory for it just now, or no memory.
    CannotWrite
        This user may not.
    """
    try:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        with open(fd, "wb") as file:
            file.write(data)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOSPC):
            raise LiveInterrupted(f"{path}: {error.strerror}") from error
        raise CannotWrite(f"{path}: {error.strerror}", hint="may this user map? see `live_group`") from error
