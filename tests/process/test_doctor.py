# SPDX-License-Identifier: Apache-2.0
"""`shmmap doctor` beside real daemons: well, stopped, killed."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import doctor
from tests.support.daemon_process import DaemonProcess, Deadline
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
    path = Path(divided_map.id("0_0.pcd"))
    whole = path.read_bytes()
    path.write_bytes(b"no point cloud")
    one = daemon(divided_map.root)
    assert doctor(one)[1]["cells"]["fact"] == "no load has failed"
    with shmmap.connect(one.endpoint, shm_dir=one.shm_dir) as client:
        assert client.selected([str(path)], wait=20.0).failed
        found = _until(one, "cells", "warn")
        assert found["fact"].startswith("1 cell cannot be loaded: 0_0.pcd (points): ")
        assert "shmmap inspect" in found["advice"]

        path.write_bytes(whole)
        client.reload()
        assert client.selected([str(path)], wait=20.0).complete
    found = _until(one, "cells", "ok")
    assert found["fact"].endswith("no cell is known to fail now")


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
