# SPDX-License-Identifier: Apache-2.0
"""Thousands of cells at once: descriptors stay few on both sides, statistics and books stay right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from shmmap.statistics.reader import read_statistics
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import make_map
from tests.support.raw_client import RawClient

Connect = Callable[..., RawClient]

_HOLDER = """
import json, os, resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))
import shmmap
client = shmmap.connect(sys.argv[1], timeout=120.0)
cells = client.area(shmmap.Circle(0.0, 0.0, 1e5), wait=120.0).raise_for_failures()
points = sum(len(cell.xyz) for cell in cells)
print(json.dumps([len(cells), points, len(os.listdir("/proc/self/fd"))]), flush=True)
sys.stdin.readline()
cells = None
client.release()
print("released", flush=True)
sys.stdin.readline()
"""


def test_three_thousand_cells_with_a_thousand_descriptors(
    daemon: DaemonFactory, connect: Connect, tmp_path: Path
) -> None:
    made = make_map(tmp_path / "map", columns=60, rows=50, points=5)
    one = daemon(made.root, "--session-quota", "1")
    raw = connect(one)
    holder = subprocess.Popen(
        [sys.executable, "-c", _HOLDER, one.endpoint],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
        cwd=ROOT,
    )
    assert holder.stdin is not None
    assert holder.stdout is not None
    try:
        cells, points, descriptors = json.loads(holder.stdout.readline())
        assert (cells, points) == (3000, 15_000)
        assert descriptors < 64
        assert len(os.listdir(f"/proc/{one.pid}/fd")) < 64
        waiting = Deadline()
        while waiting(len(read_statistics(one.instance, one.shm_dir).cells) < 3000):
            raw.ask("stats")
        seen = read_statistics(one.instance, one.shm_dir)
        assert sorted(cell.id for cell in seen.cells) == sorted(made.corners)
        assert sum(cell.bytes for cell in seen.cells) == one.segment_bytes()
        evicted = raw.ask("evict")
        assert (evicted[2], evicted[3]) == (0, 3000)
        holder.stdin.write("\n")
        assert holder.stdout.readline() == "released\n"
        one.until_segments(0, lambda: raw.ask("stats"))
        waiting = Deadline()
        while waiting(bool(read_statistics(one.instance, one.shm_dir).cells)):
            raw.ask("stats")
    finally:
        holder.kill()
        holder.communicate()
