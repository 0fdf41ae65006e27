# SPDX-License-Identifier: Apache-2.0
"""A client written from ``shmmap/protocol/PROTOCOL.md`` alone: a DEALER socket and MessagePack."""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass, replace
from typing import Any

import zmq

from tests.support.message_pack import pack, unpack

HANDLE = (
    "id",
    "version",
    "layer",
    "segment",
    "offset",
    "bytes",
    "points",
    "min_x",
    "min_y",
    "max_x",
    "max_y",
)


SELECTED = 128
"""As many cells as one request names."""


@dataclass
class RawHandle:
    """A handle, with id and segment made whole."""

    id: str
    version: int
    layer: str
    segment: str
    offset: int
    bytes: int
    points: int
    box: tuple[float, float, float, float]
    stale: bool


@dataclass
class RawFailure:
    """A cell that could not be had; holders as (session, pid, uid, client, bytes, cells)."""

    id: str
    layer: str
    code: str
    message: str
    holders: list[tuple[Any, ...]]


@dataclass
class RawCells:
    """A ``cells`` reply."""

    epoch: int
    map_version: int
    cells: list[RawHandle]
    removed: list[str]
    removed_versions: list[int]
    pending: list[tuple[str, str]]
    failed: list[RawFailure]
    wire_bytes: int


class DaemonError(Exception):
    """An ``error`` reply."""

    def __init__(self, code: str, message: str, hint: str) -> None:
        super().__init__(f"{code}: {message} ({hint})")
        self.code, self.message, self.hint = code, message, hint


def pack_versions(versions: list[int]) -> bytes:
    """Versions as the protocol packs them: 8 bytes little-endian each."""
    return struct.pack(f"<{len(versions)}Q", *versions)


def unpack_versions(packed: bytes) -> list[int]:
    """The inverse of `pack_versions`."""
    return list(struct.unpack(f"<{len(packed) // 8}Q", packed))


def circle(x: float, y: float, radius: float, z: tuple[float, float] | None = None) -> list[Any]:
    """A true circle on the wire."""
    return ["circle", x, y, radius, *(z or (None, None))]


def square(x: float, y: float, radius: float) -> list[Any]:
    """Autoware's square on the wire."""
    return ["square", x, y, radius]


def joined(parts: list[RawCells]) -> RawCells:
    """The replies to the parts of one request, as one."""
    *_, last = parts
    return replace(
        last,
        map_version=parts[0].map_version,
        cells=[cell for part in parts for cell in part.cells],
        pending=[cell for part in parts for cell in part.pending],
        failed=[cell for part in parts for cell in part.failed],
        wire_bytes=sum(part.wire_bytes for part in parts),
    )


class RawClient:
    """One session; every call waits for its reply at most ``timeout`` seconds (`TimeoutError`)."""

    def __init__(
        self, endpoint: str, *, timeout: float = 30.0, name: str = "raw", hello: bool = True
    ) -> None:
        self._context = zmq.Context()
        self.socket = self._context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"ipc://{endpoint}")
        self.timeout = timeout
        self._request = 0
        self.name = name
        self.id_prefix = self.segment_prefix = ""
        self.last_bytes = 0
        if hello:
            self.hello()

    def __enter__(self) -> RawClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the session."""
        self.socket.close(linger=0)
        self._context.term()

    def send_bytes(self, data: bytes) -> None:
        """Send any frame."""
        self.socket.send(data)

    def receive_bytes(self) -> bytes:
        """Wait for the next frame."""
        return self.socket.recv()

    def readable(self) -> bool:
        """Whether a frame is there."""
        return bool(self.socket.poll(0))

    def receive(self, timeout: float | None = None) -> list[Any]:
        """Return the next reply, whichever it is."""
        if not self.socket.poll(int((self.timeout if timeout is None else timeout) * 1000)):
            raise TimeoutError("no reply")
        data = self.socket.recv()
        self.last_bytes = len(data)
        reply = unpack(data)
        assert isinstance(reply, list)
        return reply

    def send(self, tag: str, *elements: Any) -> int:
        """Send a request; returns its id."""
        self._request += 1
        self.socket.send(pack([tag, self._request, *elements]))
        return self._request

    def wait_for_any(self, request: int, timeout: float | None = None) -> list[Any]:
        """Return the reply to a request, also if it is an error."""
        while True:
            reply = self.receive(timeout)
            if reply[1] == request:
                return reply

    def wait_for(self, request: int, timeout: float | None = None) -> list[Any]:
        """Return the reply to a request; `DaemonError` if it is an error."""
        reply = self.wait_for_any(request, timeout)
        if reply[0] == "error":
            raise DaemonError(*reply[2:5])
        return reply

    def ask(self, tag: str, *elements: Any) -> list[Any]:
        """Send a request and return its reply."""
        return self.wait_for(self.send(tag, *elements))

    def hello(self) -> list[Any]:
        """Open the session."""
        welcome = self.ask("hello", 3, 0, self.name)
        assert welcome[0] == "welcome"
        (
            _,
            _,
            self.major,
            self.minor,
            self.daemon,
            self.instance,
            self.epoch,
            self.session,
            self.map_version,
            self.map_path,
            self.frame_id,
            self.shm_dir,
            self.id_prefix,
            self.segment_prefix,
            self.cells,
            self.bounds,
            self.layers,
            self.budget_bytes,
            self.pid,
        ) = welcome[:19]
        return welcome

    def cells_reply(self, reply: list[Any]) -> RawCells:
        """Give the elements of a ``cells`` reply their names and full ids."""
        assert reply[0] == "cells"
        _, _, epoch, map_version, cells, removed, removed_packed, pending, failed = reply[:9]
        handles = [
            RawHandle(
                self.id_prefix + h[0],
                h[1],
                h[2],
                self.segment_prefix + h[3],
                h[4],
                h[5],
                h[6],
                (h[7], h[8], h[9], h[10]),
                h[11],
            )
            for h in cells
        ]
        failures = [RawFailure(f[0], f[1], f[2], f[3], [tuple(h) for h in f[4]]) for f in failed]
        return RawCells(
            epoch,
            map_version,
            handles,
            list(removed),
            unpack_versions(removed_packed),
            [(self.id_prefix + p[0], p[1]) for p in pending],
            failures,
            self.last_bytes,
        )

    def all_cells(self, wait: float | None, tag: str, *elements: Any) -> RawCells:
        """Ask reply after reply, and from the beginning while something is pending and ``wait`` lasts."""
        end_s = time.monotonic() + (wait or 0.0)
        while True:
            parts: list[RawCells] = []
            start = ""
            while start or not parts:
                reply = self.ask(tag, *elements, start)
                parts.append(self.cells_reply(reply))
                start = reply[12]
            whole = joined(parts)
            if len(parts) == 1 or not whole.pending or time.monotonic() >= end_s:
                return whole

    def area(self, area: list[Any], *, wait: float | None = 30.0, intent: Any = None) -> RawCells:
        """Ask for an area."""
        return self.all_cells(wait, "area", area, ["points"], wait, intent)

    def differential(
        self,
        area: list[Any],
        held: list[Any] | None = None,
        *,
        packed: list[int] | None = None,
        wait: float | None = 30.0,
        intent: Any = None,
    ) -> RawCells:
        """Ask for an area less what is held; ``held`` rows are [id], [id, version], ..."""
        versions = pack_versions(packed or [])
        return self.all_cells(wait, "differential", area, ["points"], held or [], versions, wait, intent)

    def selected(self, ids: list[str], *, wait: float | None = 30.0) -> RawCells:
        """Ask for cells by id, some at a time."""
        parts = [ids[at : at + SELECTED] for at in range(0, len(ids), SELECTED)] or [[]]
        return joined([self.cells_reply(self.ask("selected", part, ["points"], wait)) for part in parts])

    def release(self, versions: list[int] | None = None) -> None:
        """Report to the daemon what was unmapped."""
        self.ask("release", None if versions is None else pack_versions(versions))

    def path(self, handle: RawHandle) -> str:
        """File of a handle's segment."""
        return f"{self.shm_dir}/{handle.segment.lstrip('/')}"
