# SPDX-License-Identifier: Apache-2.0
"""What a warm start costs: taking over the segments of an earlier life, and proving their bytes.

Limit: header and stamp check of 1000 segments under 40 ms.  Beside it, as the least that any check
could cost, the same files opened, read up to their header's end and closed; and for the proof of the
bytes, done later in a worker, reading the same bytes without looking at them.

    python -m tests.benchmarks.adopt [--segments 1000] [--rounds 15] [--points 2000]
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from shmmap.daemon.loading.adoption import Adoption
from shmmap.daemon.loading.scheduler import MisplacedCells
from shmmap.layers.points import build_points
from shmmap.segment.header import PublishBlock, verify_file
from shmmap.segment.names import new_segment_name
from tests.support.divided_map import make_map
from tests.unit.daemon.inner_daemon import InnerDaemon

__all__ = ["main"]


def publish_all(one: InnerDaemon, count: int) -> list[str]:
    """Publish the segments of the first ``count`` cells, as an earlier life would have."""
    catalogue, names = one.cache.catalogue, []
    for index in range(count):
        fd = one.directory.create()
        cell = catalogue.id(index)
        header = build_points(catalogue.source(index).name, fd, cell_id=cell, box=catalogue.box(index))
        name = new_segment_name("inner")
        block = PublishBlock(1, catalogue.version(index))
        one.directory.publish(fd, name, block=block, header_bytes=header.header_bytes, mode=0o400, gid=-1)
        os.close(fd)
        names.append(name)
    return names


def milliseconds(action: Callable[[], object]) -> float:
    """CPU time of one call."""
    began = time.process_time()
    action()
    return (time.process_time() - began) * 1e3


def main() -> None:
    """Print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--segments", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--points", type=int, default=2000)
    options = parser.parse_args()
    side = int(options.segments**0.5) + 1
    with tempfile.TemporaryDirectory() as scratch:
        made = make_map(Path(scratch, "map"), columns=side, rows=side, points=options.points)
        first = InnerDaemon(str(made.root), budget_bytes=4 << 30, cache_dir=scratch)
        names = publish_all(first, options.segments)

        def floor() -> None:
            for name in first.directory.names("/shmmap.inner."):
                fd = first.directory.open(name)
                os.fstat(fd)
                os.pread(fd, 4096, 0)
                os.close(fd)

        def one_life() -> float:
            life = InnerDaemon(
                str(made.root), budget_bytes=4 << 30, cache_dir=scratch, shm_dir=first.shm_dir, name="next"
            )
            adoption = Adoption(life.cache, life.loads, MisplacedCells(life.cache))
            spent = milliseconds(lambda: adoption.take_over(life.now_s()))
            assert life.ledger.resident_count == options.segments
            life.leave()
            return spent

        def each(look: Callable[[int], object]) -> None:
            for name in names:
                fd = first.directory.open(name)
                look(fd)
                os.close(fd)

        nbytes = sum(os.stat(first.shm_dir + name).st_size for name in names)
        buffer = bytearray(1 << 20)
        ours = [one_life() for _ in range(options.rounds)]
        bare = [milliseconds(floor) for _ in range(options.rounds)]
        proof = [milliseconds(lambda: each(verify_file)) for _ in range(3)]
        read = [milliseconds(lambda: each(lambda fd: os.preadv(fd, [buffer], 0))) for _ in range(3)]
        first.close()
    print(f"{options.segments} segments, {nbytes / 1e6:.1f} MB; load {os.getloadavg()[0]:.1f}; medians")
    rows = [
        ("take over", ours, "open, read 4 KiB, close", bare),
        ("prove all bytes", proof, "read them", read),
    ]
    for name, times, peer, peer_times in rows:
        mine, theirs = statistics.median(times), statistics.median(peer_times)
        print(f"{name:16}{mine:7.1f} ms   {peer:24}{theirs:7.1f} ms   ratio {mine / theirs:.2f}")
    held = statistics.median(ours) * 1000 / options.segments <= 40.0
    print(f"take over 1000 segments within 40 ms: {'holds' if held else 'MISSED'}")


if __name__ == "__main__":
    main()
