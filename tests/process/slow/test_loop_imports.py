# SPDX-License-Identifier: Apache-2.0
"""The serving loop imports nothing: `np.unique`, say, has numpy import for 12 ms when first called."""

from __future__ import annotations

from pathlib import Path

import pytest

import shmmap
from shmmap import MapWindow
from shmmap.errors import ShmmapError
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap, publish
from tests.support.daemon_process import ROOT, Deadline, until
from tests.support.divided_map import make_map

TIMEOUT_S = 60.0
WATCH_IMPORTS = """
import os, sys
fd = os.open(os.environ["IMPORTS_SEEN"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
def seen(event, arguments):
    if event == "import":
        os.write(fd, f"{os.getpid()} {arguments[0]}\\n".encode())
sys.addaudithook(seen)
"""


def test_nothing_is_imported_while_it_serves(daemon: DaemonFactory, tmp_path: Path) -> None:
    (tmp_path / "watch").mkdir()
    (tmp_path / "watch" / "sitecustomize.py").write_text(WATCH_IMPORTS)
    seen = tmp_path / "imports"
    made = make_map(tmp_path / "map", columns=12, rows=4, points=60)
    environment = {"PYTHONPATH": f"{tmp_path / 'watch'}:{ROOT}", "IMPORTS_SEEN": str(seen)}
    one = daemon(made.root, "--budget", "1M", environment=environment)
    before = len(seen.read_text().splitlines())
    assert before > 100

    operator = Shmmap(one, tmp_path)
    with MapWindow(one.endpoint, 30.0, name="driver") as window, shmmap.connect(one.endpoint) as client:
        route, waiting = [(-120.0, 0.0), (120.0, 0.0)], Deadline()
        x = -100.0
        while waiting(operator.json("status")["counters"]["prefetch_used"] == 0 or x < 100.0):
            window.move_to(x, 0, vx=10.0, route=route, wait=TIMEOUT_S)
            x = x + 10.0 if x < 100.0 else -100.0
        window.move_to(0, 0, vx=10.0, vy=1.0)
        assert client.around(0, 0, radius=500, wait=TIMEOUT_S).cells
        assert client.selected(["0_0.pcd", "none"], layers="voxel(leaf=1.0)", wait=TIMEOUT_S).failed
        with pytest.raises(ShmmapError):
            client.around(0, 0, radius=10, layers="no such layer")
        made.change("0_0.pcd", seed=7)
        for verb in ("ls", "map", "doctor", "reload", "evict --all", "metrics"):
            operator(*verb.split())
    imported = [line.split() for line in seen.read_text().splitlines()[before:]]
    assert [name for pid, name in imported if int(pid) == one.pid] == []


def test_python_tuf_is_never_imported_by_a_daemon(daemon: DaemonFactory, tmp_path: Path) -> None:
    """Nor anything else, while a separate process verifies the version that it then takes."""
    for package in ("tuf", "obstore", "zstandard"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    (tmp_path / "watch").mkdir()
    (tmp_path / "watch" / "sitecustomize.py").write_text(WATCH_IMPORTS)
    seen = tmp_path / "imports"
    made = make_map(tmp_path / "map", columns=2, rows=1, points=60)
    store, keys = tmp_path / "store", tmp_path / "keys"
    publish(made.root, store, "--sign", str(keys))
    environment = {"PYTHONPATH": f"{tmp_path / 'watch'}:{ROOT}", "IMPORTS_SEEN": str(seen)}
    one = daemon(store, "--trust", str(keys / "ROOT.json"), "--poll", "1", environment=environment)
    before = len(seen.read_text().splitlines())
    with shmmap.connect(one.endpoint) as client:
        first = client.around(0, 0, radius=500, wait=TIMEOUT_S).map_version
        made.change("0_0.pcd", seed=7)
        publish(made.root, store, "--sign", str(keys))
        until(lambda: client.around(0, 0, radius=500, wait=TIMEOUT_S).map_version != first)
        (store / "timestamp.json").unlink()
        with pytest.raises(ShmmapError):
            client.reload()
    imported = [line.split() for line in seen.read_text().splitlines()]
    assert [name for pid, name in imported[before:] if int(pid) == one.pid] == []
    importing_tuf = {int(pid) for pid, name in imported if name.partition(".")[0] == "tuf"}
    assert one.pid not in importing_tuf
    assert len(importing_tuf) >= 3, "each time in another process"
