# SPDX-License-Identifier: Apache-2.0
"""`shmmap doctor` beside real daemons: well, stopped, killed."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import doctor, health, verb
from tests.support.daemon_process import DaemonProcess, Deadline, until
from tests.support.divided_map import DividedMap


def test_from_health_to_death(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root, "--budget", "64M")  # less than others leave of the machine's memory
    code, found = doctor(one)
    assert code == 0, found
    well = (
        "daemon",
        "socket",
        "map",
        "shared memory",
        "cache size",
        "prefetching",
        "leases",
        "open files",
        "leftovers",
        "reload",
    )
    assert {name: found[name]["state"] for name in well} == dict.fromkeys(well, "ok")
    assert f"pid {one.pid}" in found["daemon"]["fact"]
    assert "answers" in found["socket"]["fact"]

    one.send(signal.SIGSTOP)
    os.waitid(os.P_PID, one.pid, os.WSTOPPED | os.WNOWAIT)
    code, found = doctor(one)
    assert (code, found["daemon"]["state"], found["socket"]["state"]) == (1, "fail", "fail")
    assert f"kill -CONT {one.pid}" in found["daemon"]["advice"]
    one.send(signal.SIGCONT)

    one.kill()
    code, found = doctor(one)
    assert (code, found["daemon"]["state"]) == (1, "fail")
    assert "gone" in found["socket"]["fact"]
    one.start()
    assert doctor(one)[0] == 0


def test_cells_that_cannot_be_loaded_are_named(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    path, other = (Path(divided_map.id(name)) for name in ("0_0.pcd", "0_20.pcd"))
    whole = path.read_bytes()
    path.write_bytes(b"no point cloud")
    other.write_bytes(b"no point cloud")
    one = daemon(divided_map.root)
    assert doctor(one)[1]["cells"]["fact"] == "no load has failed"
    assert health(one)[0] == 0
    with shmmap.connect(one.endpoint, shm_dir=one.shm_dir) as client:
        assert client.selected([str(path)], wait=20.0).failed, "the first to fail is the one that is named"
        assert client.selected([str(path), str(other)], layers=["points", "ground"], wait=20.0).failed
        assert _until(one, "cells", "fail")["advice"].startswith(f"`shmmap inspect {path}` reads")
        code, found = doctor(one)
        fact = found["cells"]["fact"]
        assert code == 1, "the exit code is that of a failure"
        assert fact.startswith("2 cells cannot be loaded: 0_0.pcd (points) and 3 more: ")
        assert fact.count("not a PCD file") == 1, "each cause once"
        code, text = health(one)
        assert (code, text.split(":")[0]) == (1, "unhealthy"), "the first word is that of the exit code"
        assert text.splitlines()[1] == f"  {fact}"
        assert verb(one, "health")[1].startswith("healthy: ")

        path.write_bytes(whole)
        client.reload()  # another state of the file: what failed before says nothing of it
        until(lambda: health(one)[1].splitlines()[1].startswith("  1 cell cannot be loaded: 0_20.pcd"))
        other.write_bytes(whole)
        assert client.selected([str(path), str(other)], layers=["points", "ground"], wait=20.0).complete
    until(lambda: health(one)[0] == 0)
    assert _until(one, "cells", "ok")["fact"].endswith("no cell is known to fail now")


def _until(one: DaemonProcess, about: str, state: str) -> dict[str, Any]:
    """What is found about something, once the statistics show it."""
    waiting = Deadline()
    found: dict[str, Any] = doctor(one)[1][about]
    while waiting(found["state"] != state):
        found = doctor(one)[1][about]
    return found


def test_entries_without_a_file_are_a_problem_of_the_map(
    daemon: DaemonFactory, divided_map: DividedMap
) -> None:
    Path(divided_map.id("0_0.pcd")).unlink()
    one = daemon(divided_map.root)
    found = _until(one, "map", "warn")
    assert "reading it found 1 problem" in found["fact"]
