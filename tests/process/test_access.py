# SPDX-License-Identifier: Apache-2.0
"""Other user accounts: the group may read, only the daemon may change anything."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.accounts import ATTEMPTS, DAEMON_UID, GROUP, MEMBER, OTHER_USER, as_user, python_for_others
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import RawClient, circle

pytestmark = pytest.mark.root
Connect = Callable[..., RawClient]


def attempts(path: str, uid: int, gid: int) -> dict[str, Any]:
    """What an account can do to a segment: 0 worked, else the errno."""
    python = python_for_others()
    done = as_user(uid, gid, python, "-I", "-c", ATTEMPTS, path)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.fixture
def service(daemon: DaemonFactory, divided_map: DividedMap) -> DaemonProcess:
    """Return a daemon with a group, as the service unit starts it; its directories are open to all."""
    one: DaemonProcess = daemon(divided_map.root, "--group", str(GROUP), start=False)
    os.chmod(one.runtime_dir, 0o755)
    os.chmod(one.shm_dir, 0o1777)
    return one.start()


def test_members_of_the_group_read_and_change_nothing(service: DaemonProcess, connect: Connect) -> None:
    client = connect(service)
    path = client.path(client.selected(["0_0.pcd"]).cells[0])
    before = os.stat(path)
    found = attempts(path, MEMBER, GROUP)
    assert found.pop("read") == 0
    assert 0 not in found.values(), found
    after = os.stat(path)
    assert (before.st_size, before.st_mtime_ns, before.st_mode) == (
        after.st_size,
        after.st_mtime_ns,
        after.st_mode,
    )


def test_others_are_refused_everything(service: DaemonProcess, connect: Connect) -> None:
    client = connect(service)
    path = client.path(client.selected(["0_0.pcd"]).cells[0])
    found = attempts(path, OTHER_USER, OTHER_USER)
    assert 0 not in found.values(), found


CONNECT = "import socket, sys; socket.socket(socket.AF_UNIX).connect(sys.argv[1])"


@pytest.mark.parametrize(("uid", "gid", "works"), [(MEMBER, GROUP, True), (OTHER_USER, OTHER_USER, False)])
def test_the_socket_and_the_statistics(service: DaemonProcess, uid: int, gid: int, works: bool) -> None:
    python = python_for_others()
    assert (as_user(uid, gid, python, "-I", "-c", CONNECT, service.endpoint).returncode == 0) == works
    statistics = f"{service.shm_dir}/shmmap.{service.instance}.statistics"
    assert (as_user(uid, gid, "cksum", statistics).returncode == 0) == works


def test_without_a_group_no_other_account_reads(served: DaemonProcess, connect: Connect) -> None:
    os.chmod(served.runtime_dir, 0o755)
    os.chmod(served.shm_dir, 0o1777)
    client = connect(served)
    path = client.path(client.area(circle(10, 10, 1)).cells[0])
    found = attempts(path, OTHER_USER, OTHER_USER)
    assert 0 not in found.values(), found
    python = python_for_others()
    assert as_user(OTHER_USER, OTHER_USER, python, "-I", "-c", CONNECT, served.endpoint).returncode != 0


@pytest.fixture
def open_directory() -> Iterator[Path]:
    """Return a directory that every account may read (pytest's own are closed)."""
    with tempfile.TemporaryDirectory(prefix="shmmap-open-", dir="/tmp") as path:
        os.chmod(path, 0o755)
        yield Path(path)


def test_a_daemon_without_privileges_serves_the_group(
    daemon: DaemonFactory, connect: Connect, open_directory: Path
) -> None:
    """As the service runs: leases, eviction and reload need no capability, only ownership."""
    check = (
        "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import shmmap, numpy'], check=True)"
    )
    if as_user(DAEMON_UID, DAEMON_UID, sys.executable, "-c", check).returncode:
        pytest.skip("this Python and its packages cannot be read by other accounts")
    one: DaemonProcess = daemon(
        make_map(open_directory / "map").root,
        "--group",
        str(GROUP),
        start=False,
        command=["setpriv", f"--reuid={DAEMON_UID}", f"--regid={DAEMON_UID}", f"--groups={GROUP}"],
    )
    one.give_to(DAEMON_UID)
    os.chmod(one.runtime_dir, 0o755)
    os.chmod(one.shm_dir, 0o1777)
    one.start()
    client = connect(one)
    handles = client.area(circle(0, 0, 25)).cells
    path = client.path(handles[0])
    status = os.stat(path)
    assert (status.st_uid, status.st_gid, status.st_mode & 0o777) == (DAEMON_UID, GROUP, 0o440)
    found = attempts(path, MEMBER, GROUP)
    assert found.pop("read") == 0
    assert 0 not in found.values(), found
    owner = attempts(path, DAEMON_UID, DAEMON_UID)  # even its own user does not write by mistake
    assert owner["open for writing"] == 13
    with MappingProcess(
        [client.path(handles[1])],
        command=["setpriv", f"--reuid={MEMBER}", f"--regid={GROUP}", "--clear-groups"],
    ) as reader:
        before = reader.checksums()
        evicted = client.ask("evict")
        # the one that its own user has removed above is counted until the daemon has noticed
        assert evicted[2] in (len(handles) - 2, len(handles) - 1)
        assert evicted[3] == 1
        assert reader.checksums() == before
    one.until_segments(0, lambda: client.ask("stats"))
    assert client.ask("reload")[3:6] == [0, 0, 0]
