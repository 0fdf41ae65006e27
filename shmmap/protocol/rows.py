# SPDX-License-Identifier: Apache-2.0
"""Rows about segments, clients and live maps in replies."""

from __future__ import annotations

from typing import Literal, TypeAlias

import msgspec

CellState: TypeAlias = Literal["resident", "stale", "zombie"]
Shape: TypeAlias = Literal["circle", "square", "box"]


class Holder(msgspec.Struct, array_like=True, frozen=True):
    """A user of the daemon's memory; its ``str`` is a readable line.

    ``session`` 0 means a process that maps segments without a session.  ``pid`` 0 and ``uid`` -1 mean that
    the kernel does not report them, ``cells`` 0 an unknown number of segments.  ``client`` is the client's
    own name, ``command`` the kernel's name of the process.
    """

    session: int
    pid: int
    uid: int
    client: str
    bytes: int
    cells: int = 0
    command: str = ""

    def __str__(self) -> str:
        what = f"{self.bytes} bytes" + (f" in {self.cells} cells" if self.cells else "")
        if self.session == 0:
            return f"unknown (not through the client library) holds {what}"
        name = f" ({self.client})" if self.client else ""
        return f"session {self.session:016x}, pid {self.pid}{name} holds {what}"


class CellRow(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """A segment that the daemon keeps: one layer of one cell.

    In `CellsPage` ``id`` and ``segment`` lack the prefixes that `Welcome` gives, and ``holders`` is empty; in
    `ShownCell` they are complete.  ``state`` is resident, stale (its source has changed) or "zombie"
    (`retired`, but still in use).  ``bytes`` is its memory as measured, ``box`` (min_x, min_y, max_x, max_y)
    in metres, map frame.  ``last_use_monotonic_ns`` is when it was last handed out (CLOCK_MONOTONIC), 0 for
    never; ``load_ns`` how long loading took; ``ahead`` marks a segment that was prefetched and not requested
    yet.
    """

    id: str
    layer: str
    version: int
    segment: str
    state: CellState
    bytes: int
    points: int
    box: tuple[float, float, float, float]
    hits: int = 0
    last_use_monotonic_ns: int = 0
    load_ns: int = 0
    ahead: bool = False
    holders: tuple[Holder, ...] = ()

    @property
    def retired(self) -> bool:
        """Whether it is out of service, freed when no process maps it; its ``state`` on the wire is older."""
        return self.state == "zombie"

    @property
    def shown_state(self) -> str:
        """Its state in the words of screens: resident, ahead (prefetched, not requested), stale, retired."""
        return "retired" if self.retired else "ahead" if self.ahead else self.state

    def idle_s(self, now_monotonic_ns: int) -> float | None:
        """Return the seconds since the segment was last handed out; None if it never was."""
        if not self.last_use_monotonic_ns:
            return None
        return max(now_monotonic_ns - self.last_use_monotonic_ns, 0) * 1e-9


class Window(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """The last area that a client requested: centre and half extents, metres, map frame.

    For a circle both half extents are its radius.
    """

    shape: Shape
    x: float
    y: float
    half_x: float
    half_y: float


class ClientRow(msgspec.Struct, array_like=True, frozen=True):
    """A client as the daemon sees it; ``pid`` is from the kernel, 0 if unknown (``uid`` is then -1).

    ``cells`` and ``bytes`` are the versions that it was handed and has not released, and their memory.
    ``last_request_monotonic_ns`` is the time of its last request, CLOCK_MONOTONIC; ``pose`` (x, y) in metres,
    map frame, and ``heading`` in radians are None while unknown.

    Only `StatsReply` has the last three: ``mapped_bytes`` is the memory that the client maps according to the
    kernel, ``superseded`` the number of mapped segments that have left service or have a successor.
    """

    session: int
    pid: int
    uid: int
    gid: int
    client: str
    command: str
    cells: int
    bytes: int
    requests: int
    last_request_monotonic_ns: int
    pose: tuple[float, float] | None = None
    heading: float | None = None
    window: Window | None = None
    mapped_bytes: int = 0
    superseded: int = 0
    superseded_bytes: int = 0

    def idle_s(self, now_monotonic_ns: int) -> float:
        """Return the seconds since the client's last request."""
        return max(now_monotonic_ns - self.last_request_monotonic_ns, 0) * 1e-9


class LiveMapRow(msgspec.Struct, array_like=True, frozen=True):
    """The state of a live map.

    Attributes
    ----------
    chunks, active, bytes
        Chunks in memory, voxels known in them, and their memory.
    loading, dirty, saving
        Numbers of chunks being read, changed but not saved, and being written.
    waiting_bytes
        Size of the scans that wait for chunks or for memory.
    files, file_bytes
        Chunks on disk.
    scans, durable
        Number of scans applied since the start, and how many of them are on disk.
    damaged, mappers
        Lost chunks and damaged databases, 64 at most; mappers as ``uid/name``.
        ``damaged_count`` and ``mapper_count`` count all.
    problem
        Reason why chunks cannot be saved or loaded at present; empty if they can.
    change
        Number of the map's last change, as in `LiveChunkPage`.
    beside_bytes
        Memory of voxel lists and marks, which counts towards the budget like the chunks.
    readers
        Sessions whose requests used most of the worker's time in the last seconds, in descending order, each
        with its share of one processor, thousandths.
    """

    name: str
    path: str
    resolution: float
    frame_id: str
    chunks: int
    active: int
    bytes: int
    loading: int
    dirty: int
    saving: int
    waiting_bytes: int
    files: int
    file_bytes: int
    scans: int
    durable: int
    budget_bytes: int
    damaged: tuple[str, ...] = ()
    mappers: tuple[str, ...] = ()
    problem: str = ""
    change: int = 0
    beside_bytes: int = 0
    readers: tuple[tuple[int, int], ...] = ()
    damaged_count: int = 0
    mapper_count: int = 0

    @property
    def unsaved(self) -> int:
        """Number of chunks that are newer in memory than on disk."""
        return self.dirty + self.saving

    @property
    def failing(self) -> bool:
        """Whether chunks cannot be loaded or saved at present."""
        return bool(self.problem)

    @property
    def states(self) -> dict[str, int]:
        """Number of chunks in memory by state."""
        clean = max(0, self.chunks - self.unsaved)
        return {"loading": self.loading, "clean": clean, "dirty": self.dirty, "saving": self.saving}
