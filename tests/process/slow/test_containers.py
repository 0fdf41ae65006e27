# SPDX-License-Identifier: Apache-2.0
"""Sharing across namespaces, as containers have them: `shmmap/CONTAINERS.md` says it, this does it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shmmap import Box
from shmmap import connect as connect_client
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess, LineProcess, until
from tests.support.divided_map import DividedMap
from tests.support.mapping_process import MappingProcess
from tests.support.namespaces import namespaces_or_skip
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]

# What a container runtime does, in a mount namespace of its own: private /dev/shm, the daemon's two
# directories bound at places of their own, the socket's read-only, nothing at their old places.
_BOX = """
set -e
mkdir -p "$BOX/run" "$BOX/segments"
mount --bind "$RUN" "$BOX/run"
mount -o remount,bind,ro "$BOX/run"
[ -z "$SEGMENTS" ] || mount --bind "$SEGMENTS" "$BOX/segments"
mount -t tmpfs tmpfs /dev/shm
mount -t tmpfs tmpfs "$RUN"
exec "$@"
"""

_CLIENT = """
import json, os, sys, zlib
import shmmap
try:
    client = shmmap.connect(os.environ["BOX"] + "/run/" + sys.argv[1], name="boxed")
    cells = client.area(shmmap.Box(-60.0, -60.0, 60.0, 60.0)).cells
    sums = {cell.id.rpartition("/")[2]: zlib.crc32(cell["xyz"].tobytes()) for cell in cells}
    print(json.dumps({"pid": os.getpid(), "sums": sums}), flush=True)
except shmmap.ShmmapError as error:
    print(json.dumps({"error": str(error)}), flush=True)
sys.stdin.read()
"""


@contextmanager
def boxed_client(
    one: DaemonProcess, box: Path, *, segments: bool = True
) -> Iterator[tuple[int, dict[str, object]]]:
    """Run a client in pid, ipc and mount namespaces of its own; gives its pid out here, and its word."""
    command = namespaces_or_skip("--mount", "--pid", "--ipc", "--mount-proc", "--propagation", "private")
    environment = {
        **os.environ,
        "BOX": str(box),
        "RUN": one.runtime_dir,
        "SEGMENTS": one.shm_dir if segments else "",
        "SHMMAP_SHM_DIR": f"{box}/segments",
        "PYTHONPATH": str(ROOT),
    }
    words = [*command, "sh", "-c", _BOX, "sh", sys.executable, "-c", _CLIENT, Path(one.endpoint).name]
    with LineProcess(*words, env=environment) as process:
        said = json.loads(process.read())
        (inner,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        yield int(inner), said


def test_a_client_in_a_container(served: DaemonProcess, client: RawClient, tmp_path: Path) -> None:
    """It reads the same bytes, is known by its pid outside, and pins as any other client does."""
    with connect_client(served.endpoint) as outside:
        cells = outside.area(Box(-60.0, -60.0, 60.0, 60.0)).cells
        expected = {cell.id.rpartition("/")[2]: zlib.crc32(cell["xyz"].tobytes()) for cell in cells}
        del cells
    with boxed_client(served, tmp_path / "box") as (pid, said):
        assert said == {"pid": 1, "sums": expected}
        rows = {row[4]: row for row in client.ask("stats")[5]}
        assert rows["boxed"][1] == pid
        (segment,) = client.ask("show", "0_0.pcd")[9]
        assert [(holder[1], holder[3]) for holder in segment[12]] == [(pid, "boxed")]
        freed = client.ask("evict")
        assert (freed[2], freed[3]) == (0, len(expected))
        os.kill(pid, signal.SIGKILL)
        until(lambda: not served.segments() and len(client.ask("stats")[5]) <= 1)


def test_a_container_that_lacks_the_segments_gets_an_error(served: DaemonProcess, tmp_path: Path) -> None:
    with boxed_client(served, tmp_path / "box", segments=False) as (_, said):
        assert f"segments are not in {tmp_path}/box/segments" in str(said["error"])
        assert "SHMMAP_SHM_DIR" in str(said["error"])


def test_a_daemon_that_does_not_see_its_clients_pids(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """In a pid namespace of its own: no client's pid is known, pins are the kernel's word all the same."""
    one = daemon(divided_map.root, command=namespaces_or_skip("--pid", "--mount", "--mount-proc"))
    client = connect(one)
    (row,) = client.ask("stats")[5]
    assert (row[1], row[2]) == (0, os.geteuid())
    paths = [client.path(handle) for handle in client.area(circle(0, 0, 5)).cells]
    with MappingProcess(paths) as reader:
        before = reader.checksums()
        evicted = client.ask("evict")
        assert (evicted[2], evicted[3]) == (0, len(paths))
        assert reader.checksums() == before
    one.until_segments(0, lambda: client.ask("stats"))
    assert client.ask("shutdown")[0] == "stopping"
    assert one.process is not None
    process, one.process = one.process, None
    assert process.wait(60) == 0
    assert one.leftovers() == []


_ROOT_OF_ITS_OWN = """
import ctypes, json, os, sys
import zmq
from pathlib import Path
from tests.support.raw_client import DaemonError, RawClient
path, uid, group = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
os.setgroups([])
os.setgid(group)
os.setuid(uid)
libc = ctypes.CDLL(None, use_errno=True)
libc.prctl(4, 1)  # PR_SET_DUMPABLE: setuid cleared it, and /proc/self would be root's
if libc.unshare(0x10000000):  # CLONE_NEWUSER
    print(json.dumps({"refused": os.strerror(ctypes.get_errno())}))
    sys.exit()
Path("/proc/self/uid_map").write_text(f"0 {uid} 1")
found = {"inside": os.getuid()}
with RawClient(path) as client:
    found["row"] = [row[2] for row in client.ask("stats")[5] if row[1] == os.getpid()]
    for request in ("reload", "evict", "pin", "shutdown"):
        try:
            client.ask(request)
            found[request] = "done"
        except DaemonError as error:
            found[request] = error.code
print(json.dumps(found))
"""


@pytest.mark.root
def test_root_of_a_user_namespace_is_no_operator(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    uid, group = 61003, 61002
    one: DaemonProcess = daemon(divided_map.root, "--group", str(group), start=False)
    os.chmod(one.runtime_dir, 0o755)
    os.chmod(one.shm_dir, 0o1777)
    one.start()
    done = subprocess.run(
        [sys.executable, "-c", _ROOT_OF_ITS_OWN, one.endpoint, str(uid), str(group)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    if "refused" in found:
        pytest.skip(f"user namespaces are refused: {found['refused']}")
    refused = dict.fromkeys(("reload", "evict", "pin", "shutdown"), "not_permitted")
    assert found == {"inside": 0, "row": [uid], **refused}
