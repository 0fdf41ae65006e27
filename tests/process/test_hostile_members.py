# SPDX-License-Identifier: Apache-2.0
"""A member of the group takes every lock there is on everything it can open: nobody else notices."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.accounts import GROUP, MEMBER, python_for_others
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, circle

pytestmark = pytest.mark.root
Connect = Callable[..., RawClient]

_LOCKS = """
import fcntl, json, os, struct, sys
found = {"locked": 0, "refused": []}
held = []

def attempt(what, action):
    try:
        return action()
    except OSError:
        found["refused"].append(what)

for directory in sys.argv[1:]:
    for name in sorted(os.listdir(directory)):
        path = directory + "/" + name
        if name.endswith((".sock", ".txt")) or os.path.isdir(path):
            continue
        fd = attempt("open " + name.rpartition(".")[2], lambda: os.open(path, os.O_RDONLY))
        if fd is None:
            continue
        held.append(fd)
        fcntl.flock(fd, fcntl.LOCK_EX)
        attempt("lease", lambda: fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_RDLCK))
        attempt("write lock", lambda: fcntl.fcntl(fd, 37, struct.pack("@hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0)))
        for at in range(0, 3000, 3):  # two bytes each and a gap, or the kernel joins them
            lock = struct.pack("@hhqqi4x", fcntl.F_RDLCK, 0, at, 2, 0)
            attempt("read lock of " + name.rpartition(".")[2], lambda: fcntl.fcntl(fd, 37, lock))
        found["locked"] += 1
found["refused"] = sorted(set(found["refused"]))
print(json.dumps(found), flush=True)
sys.stdin.read()
"""


@contextmanager
def member_with_locks(one: DaemonProcess) -> Iterator[dict[str, Any]]:
    """Run the member; gives what it got."""
    process = subprocess.Popen(
        [
            "setpriv", f"--reuid={MEMBER}", f"--regid={GROUP}", "--clear-groups", "--inh-caps=-all",
            python_for_others(), "-I", "-c", _LOCKS, one.shm_dir, one.runtime_dir,
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd="/",
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def test_locks_hold_nobody_up(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one: DaemonProcess = daemon(divided_map.root, "--group", str(GROUP), start=False)
    os.chmod(one.runtime_dir, 0o755)
    os.chmod(one.shm_dir, 0o1777)
    one.start()
    client = connect(one)
    assert len(client.area(circle(0, 0, 500)).cells) == 36
    with member_with_locks(one) as found:
        assert found["locked"] == 36 + 1  # the segments and the statistics; no lock file of the daemon's
        # of the statistics the daemon has a lock itself
        assert found["refused"] == ["lease", "open lock", "read lock of statistics", "write lock"]
        stats = client.ask("stats")
        assert stats[6] == 36  # mapped by nobody known
        assert client.ask("show", "0_0.pcd")[9][0][12][0][:2] == [0, 0]
        evicted = client.ask("evict")
        assert (evicted[2], evicted[3]) == (0, 36)
        assert len(client.area(circle(0, 0, 500)).cells) == 36  # revived: it is all there still
        one.kill()
        one.start()
        again = connect(one)
        assert len(again.area(circle(0, 0, 500)).cells) == 36
        assert again.ask("evict")[2:4] == [0, 36]
    one.until_segments(0, lambda: again.ask("stats"))
