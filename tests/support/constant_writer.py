# SPDX-License-Identifier: Apache-2.0
"""A process that fills a chunk with one number after the other: a copy with two of them is torn.

    python -m tests.support.constant_writer FILE BRICKS

It says ``ready``, and goes on until it is killed.
"""

from __future__ import annotations

import os
import sys
import time

from shmmap.chunks.applying_kernels import begin_writing, end_writing
from shmmap.chunks.layout import chunk_bytes
from shmmap.daemon.live.chunk_memory import map_chunk, view_at

BETWEEN_S = 50e-6
"""About as long as from one scan to the next, seen from a chunk that is copied in 5 us."""


def main() -> None:
    """Write until the end."""
    path, bricks = sys.argv[1], int(sys.argv[2])
    fd = os.open(path, os.O_RDWR)
    view = view_at(map_chunk(fd, path), chunk_bytes(bricks))
    sequence = view.state["sequence"].reshape(1)
    number = 0
    begin_writing(sequence)
    end_writing(sequence)
    print("ready", flush=True)
    while True:
        number = number % 1000 + 1
        begin_writing(sequence)
        view.state["version"] += 1
        for brick in view.bricks:
            brick[:] = number
        end_writing(sequence)
        end_s = time.perf_counter() + BETWEEN_S
        while time.perf_counter() < end_s:
            pass


if __name__ == "__main__":
    main()
