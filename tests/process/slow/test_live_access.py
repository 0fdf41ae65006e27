# SPDX-License-Identifier: Apache-2.0
"""Live maps and other accounts: who may map, who may read, and that only the daemon changes anything."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.chunks.voxels import ChunkKey
from shmmap.client.live.chunk_reader import ChunkInfo
from shmmap.client.live.live_map import LiveMap
from tests.process.conftest import DaemonFactory
from tests.support.accounts import (
    ADMINS,
    ATTEMPTS,
    DAEMON_UID,
    GROUP,
    MEMBER,
    OTHER_USER,
    as_user,
    python_for_others,
)
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.live_drive import FILTER, RESOLUTION, drive
from tests.support.live_reference import held, map_scans, mapped_around, reference
from tests.support.other_account import SCANS, as_client

pytestmark = pytest.mark.root
MAPPERS = ADMINS
"""The group that may map."""

LiveService = Callable[..., DaemonProcess]


@pytest.fixture
def open_directory() -> Iterator[Path]:
    """Return a directory that every account may read (pytest's own are closed)."""
    with tempfile.TemporaryDirectory(prefix="shmmap-open-", dir="/tmp") as path:
        os.chmod(path, 0o755)
        yield Path(path)


@pytest.fixture
def service(open_directory: Path, daemon: DaemonFactory) -> LiveService:  # it ends before its directory
    """Start a daemon with a group of readers and one of mappers; its directories are open to all."""

    def make(budget: str = "16M", uid: int = 0) -> DaemonProcess:
        file, state = open_directory / "shmmap.toml", open_directory / "state"
        file.write_text(f'[live.lidar]\nresolution = 0.2\nlinger_s = 0.05\npath = "{state}/lidar"\n')
        state.mkdir(exist_ok=True)
        command = (
            ["setpriv", f"--reuid={uid}", f"--regid={uid}", f"--groups={GROUP},{MAPPERS}"] if uid else []
        )
        one: DaemonProcess = daemon(
            "", "--config", str(file), "--live-budget", budget, "--group", str(GROUP), "--live-group",
            str(MAPPERS), start=False, command=command,
        )  # fmt: skip
        if uid:
            os.chown(state, uid, -1)
            one.give_to(uid)
            kernels = open_directory / "kernels"
            kernels.mkdir()
            os.chown(kernels, uid, -1)
            one.environment["NUMBA_CACHE_DIR"] = str(kernels)
        os.chmod(one.runtime_dir, 0o755)
        os.chmod(one.shm_dir, 0o1777)
        return one.start()

    return make


def chunks_of(one: DaemonProcess) -> list[str]:
    """Paths of the chunks in memory."""
    start = f"shmmap-live.{one.instance}.lidar."
    names = sorted(os.listdir(one.shm_dir))
    return [
        f"{one.shm_dir}/{name}" for name in names
        if name.startswith(start) and name[-1].isdigit() and "voxels" not in name
    ]  # fmt: skip


def marks_of(one: DaemonProcess) -> str:
    return f"{one.shm_dir}/shmmap-live.{one.instance}.marks"


def attempts(path: str, uid: int, gid: int) -> dict[str, object]:
    """What an account can do to a file: 0 worked, else the errno."""
    program = ATTEMPTS.replace('assert mapped[:6] == b"SHMMAP"', "mapped[:6]")
    done = as_user(uid, gid, python_for_others(), "-I", "-c", program, path)
    assert done.returncode == 0, done.stderr
    found: dict[str, object] = json.loads(done.stdout)
    return found


def settled(live: LiveMap, scan: int) -> ChunkInfo:
    """Have in memory only what is near the place of a scan, and nothing else come or go; the chunk there."""
    place = drive(scan + 1)[scan][1][:3, 3]
    here = ChunkKey(*np.floor(place / (64 * RESOLUTION)).astype(int).tolist())
    live.move_to(*place)
    waiting = Deadline()
    while waiting(len(near := mapped_around(live, here)) != 27):
        pass
    return next(one for one in near if one.key == here)


def test_members_of_the_mappers_group_map_and_readers_read(service: LiveService) -> None:
    """Whatever a mapper's umask is, and with no process but the daemon as root."""
    one = service()
    assert as_client(MEMBER, [MAPPERS, GROUP], one.endpoint, "map") == SCANS
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        assert held(live) == reference(drive(SCANS))
        assert f"{MEMBER}/front" in live.status().mappers
        assert as_client(OTHER_USER, [GROUP], one.endpoint, "map") == "not_permitted"
        settled(live, 0)
        near = held(live, "memory")
        assert near
        assert as_client(OTHER_USER, [GROUP], one.endpoint, "read") == [len(near), *[sum(near.values())] * 2]
        assert isinstance(as_client(OTHER_USER, [OTHER_USER], one.endpoint, "read"), str), "an error"
        assert held(live) == reference(drive(SCANS)), "no client has changed anything"


def test_no_other_account_changes_what_is_in_memory(service: LiveService) -> None:
    one = service()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        map_scans(live, drive(2), "root")
        here = settled(live, 1)
        before = held(live)
        path = f"{one.shm_dir}/shmmap-live.{one.instance}.lidar.{here.key.text}.{here.generation}"
        undo = f"{one.shm_dir}/shmmap-live.{one.instance}.lidar.undo"
        found = attempts(path, MEMBER, GROUP)
        assert found.pop("read") == 0
        assert 0 not in found.values(), found
        for target, uid, gid in (
            (path, OTHER_USER, OTHER_USER), (path, MEMBER, MAPPERS), (undo, MEMBER, GROUP),
            (undo, MEMBER, MAPPERS), (undo, OTHER_USER, OTHER_USER),
        ):  # fmt: skip
            found = attempts(target, uid, gid)
            assert 0 not in found.values(), (target, found)
        assert held(live) == before


def test_mappers_cannot_touch_each_other_s_marks(service: LiveService) -> None:
    one = service()
    marks = marks_of(one)
    assert os.stat(marks).st_mode & 0o7777 == 0o1770
    make = as_user(MEMBER, MAPPERS, "sh", "-c", f"echo mine > {marks}/1a.5")
    assert make.returncode == 0, make.stderr
    path = f"{marks}/1a.5"
    assert os.stat(path).st_uid == MEMBER
    found = attempts(path, OTHER_USER, MAPPERS)
    assert found.pop("read") == 0, "what they saw is no secret among mappers"
    assert 0 not in found.values(), found
    assert 0 not in attempts(path, OTHER_USER, GROUP).values()
    assert as_user(OTHER_USER, GROUP, "ls", marks).returncode != 0
    assert as_user(OTHER_USER, GROUP, "touch", f"{marks}/1b.1").returncode != 0
    assert as_user(MEMBER, MAPPERS, "rmdir", marks).returncode != 0
    assert Path(path).read_text() == "mine\n"


def test_names_that_others_took_do_not_keep_a_daemon_from_starting(service: LiveService) -> None:
    """Where all may make files they may make any, before the daemon comes: those are left alone."""
    one = service()
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        map_scans(live, drive(2))
        before = held(live)
    start = f"{one.shm_dir}/shmmap-live.{one.instance}.lidar"
    content = Path(chunks_of(one)[0]).read_bytes() if chunks_of(one) else b"x"
    one.kill()
    theirs = [f"{start}.0_0_0.99999999999", f"{start}.1_1_1.5", f"{start}.voxels.0123456789abcdef"]
    for path in theirs:
        Path(path).write_bytes(content)
        os.chown(path, OTHER_USER, -1)
    one.start()
    with shmmap.connect(one.endpoint) as client:
        assert held(client.live("lidar")) == before
    assert "foreign files ignored count=2" in one.log
    one.stop()
    for path in theirs[:2]:
        assert Path(path).read_bytes() == content
    for path in theirs:
        Path(path).unlink(missing_ok=True)
    undo = Path(f"{start}.undo")
    undo.write_bytes(bytes(1000))
    os.chown(undo, OTHER_USER, -1)
    one.start()
    with shmmap.connect(one.endpoint) as client:
        (row,) = client.live_maps()
        assert row.problem, "the undo record belongs to another account"
        assert f"{undo} is not a file of this user" in row.problem or "Permission denied" in row.problem
        undo.unlink(missing_ok=True)  # root removes it itself
        waiting = Deadline()
        while waiting(client.live_maps()[0].problem != ""):
            pass
        assert held(client.live("lidar")) == before


def test_a_reader_that_lets_no_chunk_go_has_no_memory_of_them(service: LiveService) -> None:
    """It has every chunk that there ever was open and mapped: all that it has is within the budget."""
    budget = 4 << 20
    one = service("4M")
    scans = drive()
    for number, (_, pose) in enumerate(scans):
        pose[0, 3] += 60.0 * number  # elsewhere each
    kept: dict[str, tuple[int, mmap.mmap]] = {}
    most = made = 0
    with shmmap.connect(one.endpoint) as client:
        live = client.live("lidar")
        with live.mapper("front", FILTER) as mapper:
            for points, pose in scans:
                mapper.add(points, pose)
                mapper.wait_applied()
                for path in chunks_of(one):
                    if path not in kept:
                        with contextlib.suppress(FileNotFoundError, ValueError):  # it was given up just then
                            fd = os.open(path, os.O_RDONLY)
                            kept[path] = fd, mmap.mmap(fd, 0, prot=mmap.PROT_READ)
                            made += os.fstat(fd).st_size
                most = max(most, sum(os.fstat(fd).st_blocks * 512 for fd, _ in kept.values()))
            mapper.wait_durable()
        assert live.status().bytes <= budget
        assert held(live) == reference(scans)
    assert most <= budget
    assert made > 1.2 * budget, "else nothing had to be given up"
    assert not any(name.endswith(".gone") for name in os.listdir(one.shm_dir))
    for fd, data in kept.values():
        data.close()
        os.close(fd)


def test_a_daemon_without_privileges_keeps_live_maps(service: LiveService) -> None:
    """As the service runs: marks of other accounts, leases and files need no capability."""
    check = (
        "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import shmmap, numba'], check=True)"
    )
    if as_user(DAEMON_UID, DAEMON_UID, sys.executable, "-c", check).returncode:
        pytest.skip("this Python and its packages cannot be read by other accounts")
    one = service(uid=DAEMON_UID)
    assert as_client(MEMBER, [MAPPERS, GROUP], one.endpoint, "map") == SCANS
    assert as_client(OTHER_USER, [GROUP], one.endpoint, "map") == "not_permitted"
    with shmmap.connect(one.endpoint) as client:
        assert held(client.live("lidar")) == reference(drive(SCANS))
