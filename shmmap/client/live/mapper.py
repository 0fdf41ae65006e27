# SPDX-License-Identifier: Apache-2.0
"""`LiveMapper`: turn scans into marks, which the daemon's live worker applies to the map exactly once.

The thread that calls `LiveMapper.add` computes the marks.  A second thread, with its own session, sends them
and waits for the answers.  Marks without an answer are sent again after a restart of the daemon or its
worker.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import threading
import time
import weakref
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from shmmap.chunks.marking import Marker
from shmmap.chunks.marks import encode_marks
from shmmap.chunks.occupancy import ScanCounts, ScanFilter
from shmmap.client.arguments import checked_seconds
from shmmap.client.connection import SERVED_PAUSE_S, Connection, until_served
from shmmap.client.live.problems import PROBLEM_S, with_problem
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
    from numpy.typing import ArrayLike

PASSING: Final = (LiveInterrupted, Busy, DaemonUnreachable)
"""Temporary errors: sending is retried."""
MAX_UNANSWERED: Final = 3
"""Most scans without an answer; `LiveMapper.add` waits while there are this many."""
LAST_S: Final = 1.0
"""Time for unanswered scans at the end of a program that has not closed the mapper."""


@dataclass(frozen=True, slots=True)
class _Marked:
    """A scan to send: its marks of voxels, and the sensor's position."""

    number: int
    data: bytes
    sensor: tuple[float, float, float]


class _Sender:
    """Sends marks in order, each until it is answered, in a thread of its own.

    Attributes
    ----------
    opened
        The daemon's description of the map.
    applied, durable
        Numbers of the last applied and the last durable scan, as of the last answer.
    error
        Error because of which a scan, and all scans after it, were not applied.
    trouble
        Why the next scan is not applied yet; sending is retried.
    changed
        Notified when one of these attributes changes.
    """

    def __init__(
        self, path: str, live_map: str, name: str, frame_id: str, connect_s: float, timeout_s: float,
        *, resume: bool,
    ) -> None:  # fmt: skip
        self._map, self._name, self._frame_id, self._timeout_s = live_map, name, frame_id, timeout_s
        self.changed = threading.Condition()
        self.error: ShmmapError | None = None
        self.trouble: ShmmapError | None = None
        self._waiting: deque[_Marked] = deque()
        self._ending = False
        self._connection = Connection((path,), name=f"mapper {name}"[:64], timeout_s=connect_s)
        try:
            self.opened = self._open()
        except BaseException:
            self._connection.close()
            raise
        self.applied = self.durable = self.opened.applied if resume else self.opened.next_scan - 1
        self._thread = threading.Thread(target=self._run, name=f"mapper {name}", daemon=True)
        self._thread.start()

    def put(self, scan: _Marked) -> None:
        """Queue a scan for sending; wait while too many scans are unanswered.

        Raises
        ------
        ShmmapError
            The stored `error`; or the scan was not accepted in time, and may be added again.
        """
        with self.changed:
            taken = self.changed.wait_for(
                lambda: len(self._waiting) < MAX_UNANSWERED or self.error is not None, self._timeout_s
            )
            if self.error is not None:
                raise self.error
            if not taken:
                raise self.trouble or NoAnswer(
                    f"earlier scans were not applied within {self._timeout_s:.3g} s",
                    hint="they are still being sent: add this one again",
                )
            self._waiting.append(scan)
            self.changed.notify_all()

    def end(self, *, timeout_s: float | None = None) -> None:
        """Send the unanswered scans, then end the session; wait at most ``timeout_s`` seconds for that."""
        with self.changed:
            self._ending = True
            self.changed.notify_all()
        self._thread.join(timeout_s)

    def save(self, timeout_s: float) -> int:
        """Wait until all scans are applied, and save them; return the number of the last durable scan."""
        try:
            reply = until_served(
                lambda: self._connection.ask(
                    messages.LiveSave(self._connection.new_request(), self._map), messages.LiveDurable,
                    timeout_s=timeout_s, quiet_s=timeout_s,
                ),
                timeout_s,
            )  # fmt: skip
        except NoAnswer as error:
            raise self._explained(error) from error
        # a restarted worker does not know earlier scans, which are saved all the same
        self.durable = max(reply.scan, self.applied)
        return self.durable

    def _run(self) -> None:
        while True:
            with self.changed:
                self.changed.wait_for(lambda: bool(self._waiting) or self._ending)
                if not self._waiting or self.error is not None:
                    break
                scan = self._waiting[0]
            try:
                durable = self._send(scan)
            except ShmmapError as error:
                with self.changed:
                    if isinstance(error, PASSING) and not self._ending:
                        continue
                    self.error = error
                    self._waiting.clear()  # later scans cannot be applied before it
                    self.changed.notify_all()
            else:
                with self.changed:
                    self.applied, self.durable = scan.number, max(self.durable, durable)
                    self.trouble = None
                    self._waiting.popleft()
                    self.changed.notify_all()
        self._connection.close()

    def _open(self) -> messages.LiveOpened:
        return until_served(
            lambda: self._connection.ask(
                messages.LiveOpen(self._connection.new_request(), self._map, self._name, self._frame_id),
                messages.LiveOpened,
                timeout_s=self._timeout_s,
            ),
            self._timeout_s,
        )

    def _send(self, scan: _Marked) -> int:
        """Send a scan until it is answered; return the number of the last durable scan."""
        end_s = time.monotonic() + self._timeout_s
        while True:
            try:
                return self._try(scan, max(0.1, end_s - time.monotonic()))
            except PASSING as error:  # noqa: PERF203  until it is available again
                self.trouble = self._explained(error) if isinstance(error, NoAnswer) else error
                if time.monotonic() >= end_s:
                    raise self.trouble from error
                time.sleep(SERVED_PAUSE_S)
                with contextlib.suppress(*PASSING):
                    if not isinstance(error, Busy):
                        self.opened = self._open()

    def _explained(self, error: NoAnswer) -> NoAnswer:
        return with_problem(
            error,
            self._map,
            lambda: self._connection.ask(
                messages.LiveList(self._connection.new_request()), messages.LiveListed, timeout_s=PROBLEM_S
            ),
        )

    def _try(self, scan: _Marked, timeout_s: float) -> int:
        name = f"{self._connection.welcome.session:x}.{secrets.randbits(63)}"  # no other user can guess it
        path = os.path.join(self.opened.marks_dir, name)
        try:
            _write(path, scan.data)
            reply = self._connection.ask(
                messages.LiveScan(
                    self._connection.new_request(), self._map, self.opened.mapper, scan.number, name,
                    len(scan.data), scan.sensor,
                ),
                messages.LiveApplied, timeout_s=timeout_s, quiet_s=timeout_s,
            )  # fmt: skip
        finally:
            with contextlib.suppress(OSError):  # the daemon removes it when the session has ended
                os.unlink(path)
        return reply.durable


class LiveMapper:
    """Sends scans to a live map; get one from `LiveMap.mapper`.  Use it from one thread at a time.

    Attributes
    ----------
    name
        Name under which this mapper sends scans.
    counts : ScanCounts
        How many points of the last scan were used, and how many were left out and why.
    """

    def __init__(
        self, session: Session, live_map: str, name: str, frame_id: str, scan_filter: ScanFilter | None,
        timeout_s: float, *, resume: bool,
    ) -> None:  # fmt: skip
        if not name:
            raise BadRequest("a mapper needs a name", hint="one that the program keeps: 'front_lidar'")
        self.name = name
        self.counts = ScanCounts(0, 0, 0, 0, 0)
        timeout_s = self._timeout_s = checked_seconds(timeout_s)
        sender = self._sender = _Sender(
            session.path, live_map, name, frame_id, session.timeout_s, timeout_s, resume=resume
        )
        # runs also without close(), and at interpreter exit
        self._end = weakref.finalize(self, sender.end, timeout_s=LAST_S)
        self._marker = Marker(sender.opened.resolution, scan_filter)
        self._last = sender.applied

    def __enter__(self) -> LiveMapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Send the unanswered scans, wait until they are applied, and end the session; raise no error."""
        if self._end.detach() is not None:
            self._sender.end()

    def add(self, points: ArrayLike, pose: ArrayLike) -> int:
        """Add a scan; wait while too many are unanswered.

        Parameters
        ----------
        points
            (N, 3) float32 or float64, metres in the sensor's frame; masked and non-finite points are left
            out.
        pose
            (3, 4) or (4, 4): rotation and position of the sensor in the map's frame, metres.

        Returns
        -------
        The scan's number.

        Raises
        ------
        BadRequest
            A shape is wrong, the pose is not a rotation with a finite position within the map's range, the
            scan touches too many voxels, or the mapper is closed.
        LiveInterrupted, Busy, DaemonUnreachable
            Earlier scans could not be sent within the mapper's timeout, and are still being sent.  This scan
            was not accepted and may be added again.
        ShmmapError
            The error because of which an earlier scan, and all scans after it, were not applied.
        """
        if not self._end.alive:
            raise BadRequest("this mapper is closed", hint="open another one")
        marks, self.counts = self._marker.mark(points, pose)
        number, opened = self._last + 1, self._sender.opened
        data = encode_marks(marks, opened.map_id, opened.mapper, number)
        if len(data) > opened.max_marks_bytes:
            raise BadRequest(
                f"the scan's marks have {len(data)} bytes; {opened.max_marks_bytes} are the most",
                hint="lower max_range, make the map with larger voxels, or raise --live-budget",
            )
        x, y, z = (float(value) for value in np.asarray(pose, np.float64)[:3, 3])
        self._sender.put(_Marked(number, data, (x, y, z)))
        self._last = number
        return number

    @property
    def applied(self) -> int:
        """Number of the last applied scan; applied scans survive the death of any process."""
        return self._sender.applied

    @property
    def durable(self) -> int:
        """Number of the last scan on disk, as of the last answer."""
        return self._sender.durable

    def wait_applied(self, timeout_s: float | None = None) -> int:
        """Wait until every added scan is applied; return the number of the last scan.

        Raises
        ------
        NoAnswer
            That took longer than ``timeout_s`` seconds (None: the mapper's own timeout).
        ShmmapError
            The error because of which a scan could not be applied.
        """
        timeout_s = self._timeout_s if timeout_s is None else checked_seconds(timeout_s)
        sender = self._sender
        with sender.changed:
            sender.changed.wait_for(
                lambda: sender.applied >= self._last or sender.error is not None, timeout_s
            )
        if sender.error is not None:
            raise sender.error
        if sender.applied < self._last:
            raise sender.trouble or NoAnswer(f"scan {self._last} was not applied within {timeout_s:.3g} s")
        return sender.applied

    def wait_durable(self, timeout_s: float = 300.0) -> int:
        """Save all scans; return the number of the last scan on disk.

        Raises as `wait_applied`.
        """
        timeout_s = checked_seconds(timeout_s)
        self.wait_applied()
        return self._sender.save(timeout_s)


def _write(path: str, data: bytes) -> None:
    """Create a file of marks.

    Raises
    ------
    LiveInterrupted
        The directory does not exist at present, or there is no memory.
    CannotWrite
        This user may not create the file.
    """
    try:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        with open(fd, "wb") as file:
            os.fchmod(fd, 0o644)  # despite the umask: the daemon may run as another user
            file.write(data)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOSPC, errno.EDQUOT, errno.ENOMEM):
            raise LiveInterrupted(f"{path}: {error.strerror}") from error
        raise CannotWrite(f"{path}: {error.strerror}", hint="may this user map? see `live_group`") from error
