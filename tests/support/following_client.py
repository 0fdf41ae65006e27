# SPDX-License-Identifier: Apache-2.0
"""A process that follows poses with the client library and tells what it sees.

As a program: ``python -m tests.support.following_client ENDPOINT (differential|window|idle|area)``.
For each line of JSON it reads (x, y, radius) it prints one: new cells as [id, version, points, CRC-32
of xyz, CRC-32 of the intensity], removed ids, and everything it holds as [id, version].
"""

from __future__ import annotations

import json
import subprocess
import sys
import zlib
from typing import Any

from tests.support.daemon_process import ROOT


class FollowingClient:
    """Runs this module as a program."""

    def __init__(self, endpoint: str, mode: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.following_client", endpoint, mode],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            cwd=ROOT,
        )

    def ask(self, x: float, y: float, radius: float) -> None:
        """Send a pose."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([x, y, radius]) + "\n")

    def answer(self) -> dict[str, Any]:
        """Return what it saw there."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the client ended"
        seen: dict[str, Any] = json.loads(line)
        return seen

    def end(self) -> None:
        """Let it end."""
        self.process.communicate(timeout=30)

    def kill(self) -> None:
        """End it now, whatever it does."""
        self.process.kill()
        self.process.communicate()


def main() -> None:
    """Follow the poses that come in."""
    import shmmap

    endpoint, mode = sys.argv[1:]
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


if __name__ == "__main__":
    main()
