# SPDX-License-Identifier: Apache-2.0
"""What importing the client loads: its four packages, and little of the standard library beyond them.

How long that takes is measured by ``tests/benchmarks/import_client.py``; here nothing depends on time.
"""

from __future__ import annotations

import json
import subprocess
import sys

_PACKAGES = "import numpy, zmq, posix_ipc, msgspec"
_CLIENT = "import shmmap; shmmap.connect; shmmap.MapWindow"

EXPENSIVE = {
    "array",
    "asyncio",
    "ctypes.util",
    "dataclasses",
    "enum",
    "inspect",
    "json",
    "logging",
    "numpy.typing",
    "selectors",
    "signal",
    "socket",
    "subprocess",
    "typing_extensions",
    "zmq.utils.monitor",
}
"""A millisecond or more each where nothing else has loaded them."""

ALLOWED = {"_heapq", "_queue", "fcntl", "heapq", "queue", "select", "zlib"}
"""What the client itself uses of the standard library at import; `select` a connection loads in any case."""


def modules_after(code: str) -> set[str]:
    program = f"import sys, json\n{code}\njson.dump(sorted(sys.modules), sys.stdout)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


def test_the_client_loads_little_beyond_its_four_packages() -> None:
    ours = modules_after(_CLIENT) - modules_after(_PACKAGES)
    assert "shmmap.client.window.map_window" in ours
    beyond = {name for name in ours if name.split(".")[0] != "shmmap"}
    assert not beyond & EXPENSIVE
    assert beyond <= ALLOWED, "is it worth its time in every client?"


def test_asking_alone_loads_no_windows() -> None:
    ours = modules_after("import shmmap; shmmap.connect")
    assert "shmmap.client.client" in ours
    assert not {name for name in ours if name.startswith("shmmap.client.window")}
