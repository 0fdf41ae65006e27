# SPDX-License-Identifier: Apache-2.0
"""A process that holds an area's cells with the client library and tells exactly what it holds.

As a program: ``python -m tests.support.holding_client ENDPOINT`` prints ``connected``.  For each line of
JSON it reads, one of [x, y, radius] (hold that area, drop the rest), [] (drop everything) and null
(change nothing), it prints what it holds now: rows [id, version, segment, stale, CRC-32 of xyz], and
the codes of what failed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import zlib
from dataclasses import dataclass
from typing import Any

from tests.support.daemon_process import ROOT


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


class HoldingClient:
    """Runs this module as a program."""

    def __init__(self, endpoint: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.holding_client", endpoint],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            cwd=ROOT,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == "connected"

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def tell(self, what: list[float] | None) -> Holding:
        """Send a line and return what it holds then."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        line = self.process.stdout.readline()
        assert line, "the client ended"
        seen: dict[str, Any] = json.loads(line)
        return Holding(
            tuple(HeldRow(*row) for row in seen["held"]),
            tuple((cell, code) for cell, code in seen["failed"]),
            tuple(seen["pending"]),
        )

    def kill(self) -> None:
        """End it now, whatever it does, and wait for its end."""
        self.process.kill()
        self.process.communicate()


def main() -> None:
    """Hold what the lines that come in say."""
    import shmmap

    with shmmap.connect(sys.argv[1], name="holder", timeout=60.0, connect_timeout=60.0) as client:
        print("connected", flush=True)
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


if __name__ == "__main__":
    main()
