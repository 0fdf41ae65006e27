# SPDX-License-Identifier: Apache-2.0
"""Limits of processes: what a daemon or a client may not have is named, and what they take is little."""

from __future__ import annotations

import grp
import json
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.prerequisites import access_of_segments
from shmmap.errors import ConfigError
from shmmap.segment.process_limits import check_files, check_threads
from shmmap.statistics.reader import read_statistics
from shmmap.testing.daemon_process import without_settings
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess, LineProcess, first_answer, until
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.raw_client import RawClient, circle

Factory = Callable[..., DaemonProcess]
KIB = 1024


def started_under(limit: int, value: int, arguments: list[str]) -> tuple[int, str]:
    """Start a daemon that cannot; returns its exit code and what it says."""
    done = subprocess.run(
        [sys.executable, "-m", "shmmap.daemon", *arguments],
        preexec_fn=lambda: resource.setrlimit(limit, (value, value)),
        capture_output=True,
        text=True,
        check=False,
        env=without_settings(),
    )
    return done.returncode, done.stderr


Connect = Callable[..., RawClient]


@pytest.mark.parametrize(
    ("limit", "value", "name"),
    [
        (resource.RLIMIT_FSIZE, 50 * KIB, "RLIMIT_FSIZE is 51,200 bytes"),
        (resource.RLIMIT_NOFILE, 12, "12 (RLIMIT_NOFILE)"),
        (resource.RLIMIT_DATA, 60_000 * KIB, "RLIMIT_DATA"),
    ],
)
def test_a_start_that_a_limit_forbids(
    divided_map: DividedMap, tmp_path: Path, limit: int, value: int, name: str
) -> None:
    (tmp_path / "shm").mkdir()
    arguments = [str(divided_map.root), "--instance", "limited", "--runtime-dir", str(tmp_path / "run")]
    code, said = started_under(limit, value, [*arguments, "--shm-dir", str(tmp_path / "shm")])
    assert code == 71, said
    assert name in said
    assert "raise the limit" in said or "raise it" in said
    assert "internal error" not in said
    assert os.listdir(tmp_path / "shm") == []


def test_a_segment_that_the_limit_on_files_forbids(daemon: Factory, divided_map: DividedMap) -> None:
    """The cell's file is blameless; the others are served, and this one as soon as the limit is gone."""
    large = random_points(np.random.default_rng(1), (0, 0), 200_000)
    divided_map.write_cell("0_0.pcd", (0, 0), large)
    one = daemon(divided_map.root)
    for pid in (one.pid, *one.children()):
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1 << 20, resource.RLIM_INFINITY))
    with shmmap.connect(one.endpoint) as client:
        cells = client.around(0, 0, 15, wait=60)
        assert len(cells) == 3
        (failed,) = cells.failed
        assert failed.cell_id.endswith("/0_0.pcd")
        assert "RLIMIT_FSIZE is 1,048,576 bytes" in failed.message
        assert "ulimit -f" in failed.message
        assert len(client.around(-40, -40, 5, wait=60)) == 4
        for pid in (one.pid, *one.children()):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        cells = first_answer(lambda: client.around(0, 0, 15, wait=60), lambda found: not found.failed)
        assert len(cells) == 4


def test_statistics_that_cannot_be_written_end_no_process(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """The limit lies before the counters and behind all that the log gets."""
    one = daemon(divided_map.root)
    client = connect(one)
    warm = [handle.segment for handle in client.area(circle(0, 0, 5)).cells]
    soft, hard = resource.prlimit(one.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(one.pid, resource.RLIMIT_FSIZE, (16384, hard))
    said = 'statistics not written error="File too large"'
    until(lambda: said in one.log)
    asked = client.ask("stats")[4]["requests"]
    assert [handle.segment for handle in client.area(circle(0, 0, 5)).cells] == warm
    resource.prlimit(one.pid, resource.RLIMIT_FSIZE, (soft, hard))
    until(lambda: read_statistics(one.instance, one.shm_dir).counters["requests"] > asked)
    assert one.log.count(said) == 1


def test_a_daemon_with_limited_files_says_so_at_its_start(daemon: Factory, divided_map: DividedMap) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16 << 20, hard))
    try:
        one = daemon(divided_map.root, "--budget", "32M", forked=False)  # a fork has its parent's limits
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert re.search(
        r"WARNING files are limited in size RLIMIT_FSIZE=16777216 budget_bytes=33554432", one.log
    )


def test_a_group_that_the_daemon_s_user_is_not_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Said before anything is made, with the command that mends it."""
    group = grp.getgrgid(0).gr_name
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    monkeypatch.setattr(os, "getegid", lambda: 12345)
    monkeypatch.setattr(os, "getgroups", lambda: [12345, 7])
    with pytest.raises(ConfigError, match=f"no member of the group {group}") as refused:
        access_of_segments(DaemonConfig(group=group))
    assert f"usermod -aG {group} 12345" in refused.value.hint
    monkeypatch.setattr(os, "getgroups", lambda: [12345, 0])
    assert access_of_segments(DaemonConfig(group=group)) == (0, 0o440)


# --- clients in processes that may have no more descriptors or threads: refused by the limit's name --


PROGRAM = """
import os, resource, sys
import shmmap
endpoint = sys.argv[1]
fds = []
def leave_files(left):
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    try:
        while True:
            fds.append(os.dup(0))
    except OSError:
        for _ in range(left):
            os.close(fds.pop())
def free_files():
    while fds:
        os.close(fds.pop())
def leave_threads(left):
    import socket
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_STACK, (8 << 20, 8 << 20))
    most = now + left * (8 << 20) + (left + 1) * (1 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
def tried(act):
    try:
        return act() or "works"
    except shmmap.ShmmapError as error:
        return f"{type(error).__name__}: {error}"
"""


def outcomes(code: str, one: DaemonProcess) -> list[str]:
    """Run a program that must end by itself and say nothing on stderr; returns its lines."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM + code, one.endpoint],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=ROOT,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_few_descriptors(standing: DaemonProcess) -> None:
    """With 0 to 12 of them left, for a client and for a window."""
    lines = outcomes(
        """
shmmap.connect, shmmap.MapWindow
def window():
    with shmmap.MapWindow(endpoint, 50.0) as made:
        made.move_to(0.0, 0.0)
        return None if made.wait_until_current(60) else f"{made.error}"
def client():
    with shmmap.connect(endpoint) as made:
        return None if made.around(0, 0, 50).complete else "incomplete"
for act in client, window:
    for left in range(13):
        leave_files(left)
        result = tried(act)
        free_files()
        print(left, result)
""",
        standing,
    )
    assert len(lines) == 26
    for line in lines:
        left, _, result = line.partition(" ")
        if int(left) >= 11:
            assert result == "works", line
        else:
            assert result.startswith(
                f"LimitReached: a connection to the daemon needs 11 more descriptors, {left} are left: "
                "this process has as many files open as it may, 64 (RLIMIT_NOFILE)"
            ), line


def test_none_to_load_the_library_with(standing: DaemonProcess) -> None:
    (line,) = outcomes("leave_files(0); print(tried(lambda: shmmap.connect(endpoint)))", standing)
    assert line.startswith("LimitReached: shmmap.connect cannot be loaded: this process has as many files")


def test_none_for_a_segment_and_for_a_window_of_a_client_that_is_there(standing: DaemonProcess) -> None:
    lines = outcomes(
        """
shmmap.MapWindow
client = shmmap.connect(endpoint)
leave_files(0)
print(tried(lambda: client.around(0, 0, 50)))
window = shmmap.MapWindow(client, 50.0)
window.move_to(0.0, 0.0)
while window.error is None:
    pass
print(tried(lambda: f"{type(window.error).__name__}: {window.error}"))
free_files()
print(window.wait_until_current(60), tried(lambda: None if client.around(0, 0, 50).complete else "no"))
""",
        standing,
    )
    for line in lines[:2]:
        assert line.startswith(
            "LimitReached: this process has as many files open as it may, 64 (RLIMIT_NOFILE)"
        )
    assert lines[2:] == ["True works"]


def test_none_to_connect_again_with(daemon: Factory, divided_map: DividedMap) -> None:
    """The daemon is back, and this process may not open a socket: the error does not blame the daemon."""
    one = daemon(divided_map.root)
    code = """
client = shmmap.connect(endpoint, timeout=1)
print("connected", flush=True)
while client.disconnected_since is None:
    pass
leave_files(0)
print("lost", flush=True)
input()
print(tried(lambda: client.around(0, 0, 50)), flush=True)
free_files()
client.close()
print(tried(lambda: None if shmmap.connect(endpoint).around(0, 0, 50).complete else "no"), flush=True)
"""
    with LineProcess(sys.executable, "-c", PROGRAM + code, one.endpoint) as program:
        assert program.read() == "connected"
        one.stop()
        assert program.read() == "lost"
        one.start()
        program.write()
        assert program.read().startswith(
            "LimitReached: a connection to the daemon needs 1 more descriptors, 0 are left"
        )
        assert program.read() == "works"
        assert program.process.wait(120) == 0


@pytest.mark.parametrize("left", range(5))
def test_few_threads(standing: DaemonProcess, left: int) -> None:
    """Stacks of threads need address space, which an ordinary user can limit, too."""
    client, window = outcomes(
        f"""
shmmap.connect, shmmap.MapWindow
leave_threads({left})
def client():
    shmmap.connect(endpoint).close()
def window():
    shmmap.MapWindow(endpoint, 50.0).close()
print(tried(client))
print(tried(window))
""",
        standing,
    )
    assert client == "works" if left >= 3 else client.startswith("LimitReached: ")
    assert window == "works" if left >= 4 else window.startswith("LimitReached: ")
    if left < 3:
        assert "RLIMIT_NPROC" in client
        assert "of address space (RLIMIT_AS)" in client


@pytest.mark.root
@pytest.mark.parametrize("left", range(4))
def test_few_threads_of_a_user(standing: DaemonProcess, left: int) -> None:
    """Root is not limited: the program becomes a user that has no other processes."""
    for path in (standing.endpoint, str(Path(standing.endpoint).parent)):
        os.chmod(path, 0o777)
    (line,) = outcomes(
        f"""
import socket
shmmap.connect
uid = 1_500_000_000 + os.getpid()
threads = len(os.listdir("/proc/self/task"))
resource.setrlimit(resource.RLIMIT_NPROC, (threads + {left}, threads + {left}))
os.setresuid(uid, uid, uid)
print(tried(lambda: shmmap.connect(endpoint).close()))
""",
        standing,
    )
    if left == 3:
        assert line == "works"
    else:
        assert line.startswith("LimitReached: ")
        assert " processes and threads of this user (RLIMIT_NPROC)" in line


def test_checking_leaves_nothing() -> None:
    files, threads = len(os.listdir("/proc/self/fd")), set(os.listdir("/proc/self/task"))
    check_files(8, "this")
    check_threads(4, "this")
    assert len(os.listdir("/proc/self/fd")) == files
    assert set(os.listdir("/proc/self/task")) <= threads, "those of earlier tests may be ending"


# --- what a client costs its process: descriptors, modules, memory -----------------------------------


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
found = {
    "complete": cells.complete,
    "cells": len(cells),
    "points": int(sum(len(cell.xyz) for cell in cells)),
    "finite": all(bool(np.isfinite(cell.xyz).all()) for cell in cells),
    "more_files": len(os.listdir("/proc/self/fd")) - before,
    "mapped": mapped(client.welcome.shm_dir),
}
print(json.dumps(found), flush=True)
sys.stdin.readline()
del cells
gc.collect()
print(json.dumps([mapped(client.welcome.shm_dir), client.release()]), flush=True)
sys.stdin.readline()
"""


def test_three_thousand_cells_with_a_thousand_descriptors(
    daemon: Factory, connect: Connect, tmp_path: Path
) -> None:
    """Descriptors stay few on both sides; statistics and accounts stay right."""
    made = make_map(tmp_path / "map", columns=60, rows=50, points=3)
    one = daemon(made.root, "--session-quota", "1")
    raw = connect(one)
    with LineProcess(sys.executable, "-c", MANY, one.endpoint) as holder:
        assert json.loads(holder.read()) == {
            "complete": True,
            "cells": 3000,
            "points": 9000,
            "finite": True,
            "more_files": 0,
            "mapped": 3000,
        }
        assert len(os.listdir(f"/proc/{one.pid}/fd")) < 64
        with shmmap.connect(one.endpoint) as client:
            listed = client.list_cells()
        assert [cell.id for cell in listed] == sorted(made.corners)
        assert sum(cell.bytes for cell in listed) == one.segment_bytes()
        assert raw.ask("evict")[2:4] == [0, 3000]
        holder.write()
        assert json.loads(holder.read()) == [0, 3000]
        one.until_segments(0, lambda: raw.ask("stats"))
        with shmmap.connect(one.endpoint) as client:
            assert client.list_cells() == []


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
    said = json.loads(outcomes(COST, one)[0])
    heavy = {"open3d", "numba", "scipy", "yaml", "xxhash", "lzf", "asyncio"}
    assert not heavy & set(said["modules"])
    assert said["megabytes"] < 40
