# SPDX-License-Identifier: Apache-2.0
"""A client-only install reads live maps; what it lacks for mapping it says."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
for name in ("numba", "xxhash", "zstandard"):
    sys.modules[name] = None
import shmmap
assert shmmap.live.LiveMap and shmmap.live.Voxels and shmmap.live.ScanFilter
try:
    shmmap.live.LiveMap.mapper(None, "front")
except shmmap.errors.PackageMissing as error:
    print(error.message)
"""


def test_a_client_reads_without_a_compiler() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout == "mapping needs the package numba, which is not installed\n"
