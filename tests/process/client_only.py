# SPDX-License-Identifier: Apache-2.0
"""Attach to a daemon from another Python that has a client-only install.

``python tests/process/client_only.py /path/to/client/bin/python``; the daemon runs under the Python
that runs this.  Exit code 0 if the client saw every point, bit by bit, and has none of the daemon's
packages.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map

PROGRAM = """
import hashlib, importlib.metadata, json, sys
import shmmap

with shmmap.connect(sys.argv[1]) as client:
    cells = client.around(0, 0, 25)
    seen = {cell.id: cell.xyz.tobytes() + cell["intensity"].tobytes() for cell in cells}
digests = {cell_id: hashlib.sha256(data).hexdigest() for cell_id, data in seen.items()}
names = [distribution.metadata["Name"] for distribution in importlib.metadata.distributions()]
packages = sorted(name.lower().replace("-", "_") for name in names)
with shmmap.MapWindow(sys.argv[1], radius=25) as window:
    window.move_to(0, 0, wait=10)
    assert sorted(cell.id for cell in window.cells) == sorted(digests)
json.dump({"digests": digests, "packages": packages, "where": shmmap.__file__}, sys.stdout)
"""

DAEMON_ONLY = {"open3d", "open3d_cpu", "xxhash", "python_neo_lzf", "pyyaml"}


def check(python: str, *, separate_install: bool = True) -> None:
    """Run the client under ``python`` and compare what it saw with the files."""
    import numpy as np

    with tempfile.TemporaryDirectory() as scratch:
        source = make_map(Path(scratch, "map"))
        daemon = DaemonProcess(source.root).start()
        try:
            done = subprocess.run(
                [python, "-I", "-c", PROGRAM, daemon.endpoint],
                capture_output=True,
                text=True,
                cwd=scratch,
                check=False,
            )
            if done.returncode:
                raise SystemExit(done.stderr)
        finally:
            code = daemon.stop()
            daemon.dispose()
        wanted = {}
        for name in source.in_circle(0, 0, 25):
            columns = source.points(name)
            xyz = np.column_stack([columns[axis] for axis in "xyz"])
            wanted[source.id(name)] = hashlib.sha256(
                xyz.tobytes() + columns["intensity"].tobytes()
            ).hexdigest()
    seen = json.loads(done.stdout)
    if seen["digests"] != wanted or not wanted:
        raise SystemExit(f"the client saw other points than the files have: {seen['digests']} {wanted}")
    if separate_install and DAEMON_ONLY & set(seen["packages"]):
        raise SystemExit(f"this is no client-only install: {seen['packages']}")
    if code != 0:
        raise SystemExit(f"the daemon ended with {code}")
    print(f"{len(wanted)} cells seen by {seen['where']} with {', '.join(seen['packages'])}")


if __name__ == "__main__":
    check(sys.argv[1])
