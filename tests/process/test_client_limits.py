# SPDX-License-Identifier: Apache-2.0
"""What a client costs its process: descriptors, modules, memory."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map

Factory = Callable[..., DaemonProcess]

MANY = """
import gc, json, os, resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))
import numpy as np
import shmmap
def mapped(shm_dir):
    with open("/proc/self/maps") as maps:
        return sum(shm_dir in line for line in maps)
client = shmmap.connect(sys.argv[1], timeout=60)
before = len(os.listdir("/proc/self/fd"))
cells = client.area(shmmap.Box(-1e4, -1e4, 1e4, 1e4), wait=300)
told = {
    "complete": cells.complete,
    "cells": len(cells),
    "points": int(sum(len(cell.xyz) for cell in cells)),
    "finite": all(bool(np.isfinite(cell.xyz).all()) for cell in cells),
    "more_files": len(os.listdir("/proc/self/fd")) - before,
    "mapped": mapped(client.welcome.shm_dir),
}
del cells
gc.collect()
told["mapped_after"] = mapped(client.welcome.shm_dir)
told["released"] = client.release()
client.close()
json.dump(told, sys.stdout)
"""


def run(program: str, *arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True, text=True, timeout=400, check=False, cwd=ROOT,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def test_three_thousand_cells_with_a_thousand_descriptors(daemon: Factory, tmp_path: Path) -> None:
    made = make_map(tmp_path / "map", columns=60, rows=50, points=3)
    one = daemon(made.root)
    assert run(MANY, one.endpoint) == {
        "complete": True,
        "cells": 3000,
        "points": 9000,
        "finite": True,
        "more_files": 0,
        "mapped": 3000,
        "mapped_after": 0,
        "released": 3000,
    }


COST = """
import json, re, sys
import shmmap
with shmmap.connect(sys.argv[1]) as client, shmmap.MapWindow(client, 30) as window:
    window.move_to(0.0, 0.0, wait=60.0)
    assert window.points_around(0.0, 0.0, 10.0).count()
    with open("/proc/self/status") as status:
        peak = int(re.search(r"VmHWM:\\s+(\\d+) kB", status.read())[1])
    json.dump({
        "modules": sorted({name.split(".")[0] for name in sys.modules}),
        "megabytes": peak / 1024,
    }, sys.stdout)
"""


def test_a_client_loads_nothing_heavy_and_fits_40_megabytes(daemon: Factory, tmp_path: Path) -> None:
    one = daemon(make_map(tmp_path / "map", columns=2, rows=2).root)
    told = run(COST, one.endpoint)
    heavy = {"open3d", "numba", "scipy", "rich", "yaml", "xxhash", "lzf", "asyncio"}
    assert not heavy & set(told["modules"])
    assert told["megabytes"] < 40
