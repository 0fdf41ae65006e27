# SPDX-License-Identifier: Apache-2.0
"""Processes that use the client library: one holds what it is asked to, one follows poses, one wanders.

``python -m tests.support.client_programs hold ENDPOINT``: for each line of JSON, one of [x, y, radius] (hold
that area, drop the rest), [] (drop everything) and null (change nothing), it prints what it holds now: rows
[id, version, segment, stale, CRC-32 of xyz], and the codes of what failed.

``... follow ENDPOINT (differential|window|idle|area)``: for each line [x, y, radius] it prints one: new cells
as [id, version, points, CRC-32 of xyz, CRC-32 of the intensity], removed ids, and all that it holds as
[id, version].

``... wander ENDPOINT SEED HALF_SIZE PAUSE_S`` holds what is around it until killed; ends if a byte changes.
"""

from __future__ import annotations

import json
import random
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import shmmap
from tests.support.daemon_process import LineProcess


@dataclass(frozen=True)
class HeldRow:
    """One cell as its holder sees it."""

    id: str
    version: int
    segment: str
    stale: bool
    checksum: int


@dataclass(frozen=True)
class Holding:
    """What a holder has, and why it lacks the rest of what it asked for: (id, code)."""

    cells: tuple[HeldRow, ...]
    failed: tuple[tuple[str, str], ...]
    pending: tuple[str, ...]


class _ClientProcess(LineProcess):
    """One of these programs, which answers each line of JSON by one."""

    def __init__(self, *words: str) -> None:
        super().__init__(sys.executable, "-m", "tests.support.client_programs", *words)

    def answer(self) -> Any:
        """Return its next answer."""
        return json.loads(self.read())


class HoldingClient(_ClientProcess):
    """A process that holds an area's cells and reports exactly what it holds."""

    def __init__(self, endpoint: str) -> None:
        super().__init__("hold", endpoint)
        assert self.answer() == "connected"

    def hold(self, what: list[float] | None) -> Holding:
        """Send a line and return what it holds then."""
        self.write(json.dumps(what))
        seen = self.answer()
        return Holding(
            tuple(HeldRow(*row) for row in seen["held"]),
            tuple((cell, code) for cell, code in seen["failed"]),
            tuple(seen["pending"]),
        )


class FollowingClient(_ClientProcess):
    """A process that follows poses and reports what it sees."""

    def __init__(self, endpoint: str, mode: str) -> None:
        super().__init__("follow", endpoint, mode)

    def ask(self, x: float, y: float, radius: float) -> None:
        """Send a pose."""
        self.write(json.dumps([x, y, radius]))


def _hold(endpoint: str) -> None:
    with shmmap.connect(endpoint, name="holder", timeout=60.0, connect_timeout=60.0) as client:
        print(json.dumps("connected"), flush=True)
        held: dict[str, shmmap.Cell] = {}
        for line in sys.stdin:
            where = json.loads(line)
            failed: list[tuple[str, str]] = []
            pending: list[str] = []
            if where:
                reply = client.differential(shmmap.Circle(*where), held.values(), wait=30.0, by_name=True)
                for cell_id in reply.removed:
                    held.pop(cell_id, None)
                held |= {cell.id: cell for cell in reply}
                failed = [(failure.cell_id, failure.code) for failure in reply.failed]
                pending = [layer.id for layer in reply.pending]
                del reply
            elif where is not None:
                held.clear()
                client.release()
            rows = [[c.id, c.version, c.segment, c.stale, zlib.crc32(c.xyz.data)] for c in held.values()]
            print(json.dumps({"held": rows, "failed": failed, "pending": pending}), flush=True)


def _follow(endpoint: str, mode: str) -> None:
    client = shmmap.connect(endpoint, name=f"follower {mode}", timeout=60.0)
    window: shmmap.MapWindow | None = None
    held: dict[str, shmmap.Cell] = {}
    for line in sys.stdin:
        x, y, radius = json.loads(line)
        removed: list[str] = []
        new: list[shmmap.Cell] = []
        if mode == "window":
            if window is None:
                window = shmmap.MapWindow(client, radius, update_distance=0.0, background=False)
            update = window.move_to(x, y, wait=60.0)
            new = [*update.added, *update.changed]
            removed = list(update.removed)
            held = {cell.id: cell for cell in window.cells}
        elif mode == "differential":
            reply = client.differential(shmmap.Circle(x, y, radius), held.values(), wait=60.0)
            assert reply.complete, reply
            removed, new = list(reply.removed), list(reply.cells)
            for cell_id in removed:
                del held[cell_id]
            held |= {cell.id: cell for cell in new}
        elif mode == "area":
            new = list(client.area(shmmap.Circle(x, y, radius), wait=60.0).raise_for_failures())
            held = {cell.id: cell for cell in new}
        rows = [
            [c.id, c.version, c.points, zlib.crc32(c.xyz.data), zlib.crc32(c["intensity"].data)] for c in new
        ]
        seen = {"new": rows, "removed": removed, "held": [[c.id, c.version] for c in held.values()]}
        del new
        print(json.dumps(seen), flush=True)
    if window is not None:
        window.close()
    client.close()


def _wander(endpoint: str, seed: str, half_size: str, pause: str) -> None:
    rng = random.Random(int(seed))
    half, pause_s = float(half_size), float(pause)
    while True:
        x, y = rng.uniform(-half, half), rng.uniform(-half, half)
        radius = rng.uniform(5.0, half / 3)
        with shmmap.connect(
            endpoint, name=f"wanderer {seed}", timeout=600.0, connect_timeout=600.0
        ) as client:
            held: dict[str, tuple[shmmap.Cell, int]] = {}
            for _ in range(rng.randrange(20, 400)):
                x = max(-half, min(half, x + rng.gauss(0, 5)))
                y = max(-half, min(half, y + rng.gauss(0, 5)))
                cells = [cell for cell, _ in held.values()]
                area = shmmap.Circle(x, y, radius)
                wait = rng.choice([None, 1.0])
                reply = client.differential(area, cells, wait=wait, pose=(x, y), strict=None)
                del cells
                for cell_id in reply.removed:
                    _check(*held.pop(cell_id))
                for cell in reply:
                    if cell.id in held:
                        _check(*held.pop(cell.id))
                    held[cell.id] = cell, zlib.crc32(cell.xyz.data)
                for failure in reply.failed:
                    assert failure.code in ("over_budget", "no_space", "load_failed"), failure
                del reply
                cell = None  # type: ignore[assignment]
                time.sleep(rng.expovariate(1 / pause_s))
            while held:
                _check(*held.popitem()[1])


def _check(cell: shmmap.Cell, checksum: int) -> None:
    if zlib.crc32(cell.xyz.data) != checksum:
        print(f"the bytes of {cell.id} changed under its reader", file=sys.stderr, flush=True)
        sys.exit(3)


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {"hold": _hold, "follow": _follow, "wander": _wander}
    programs[sys.argv[1]](*sys.argv[2:])
