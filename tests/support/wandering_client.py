# SPDX-License-Identifier: Apache-2.0
"""A process that wanders over a map for ever, holding what is around it, and ends if a byte ever changes.

As a program: ``python -m tests.support.wandering_client ENDPOINT SEED HALF_SIZE PAUSE_S``.
"""

from __future__ import annotations

import random
import sys
import time
import zlib

__all__ = ["main"]


def main() -> None:
    """Wander until killed."""
    import shmmap

    rng = random.Random(int(sys.argv[2]))
    half, pause_s = float(sys.argv[3]), float(sys.argv[4])
    while True:
        x, y = rng.uniform(-half, half), rng.uniform(-half, half)
        radius = rng.uniform(5.0, half / 3)
        with shmmap.connect(
            sys.argv[1], name=f"wanderer {sys.argv[2]}", timeout=600.0, connect_timeout=600.0
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


def _check(cell: object, checksum: int) -> None:
    import shmmap

    assert isinstance(cell, shmmap.Cell)
    if zlib.crc32(cell.xyz.data) != checksum:
        print(f"the bytes of {cell.id} changed under its reader", file=sys.stderr, flush=True)
        sys.exit(3)


if __name__ == "__main__":
    main()
