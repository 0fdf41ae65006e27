# SPDX-License-Identifier: Apache-2.0
"""Pinned cells stay, whatever else is asked for; and only administrators pin, evict, reload, stop."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.accounts import ADMINS, GROUP, MEMBER
from tests.support.daemon_process import ROOT, DaemonProcess, Deadline, wait_ended
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.raw_client import DaemonError, RawClient, circle

Connect = Callable[..., RawClient]


def pins(client: RawClient) -> dict[str, str]:
    """State of each pinned cell, by base name."""
    return {row[0]: row[2] for row in client.ask("pin")[2]}


def wait_for_pins(client: RawClient, expected: dict[str, str]) -> None:
    waiting = Deadline()
    while waiting(pins(client) != expected):
        client.ask("stats")


def assert_stopped(one: DaemonProcess, pid: int) -> None:
    """The daemon has ended by itself and left nothing."""
    assert wait_ended(pid)
    assert one.process is not None
    process, one.process = one.process, None
    assert process.wait() == 0
    assert one.leftovers() == []


def test_a_pinned_cell_is_loaded_and_stays(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    answer = client.ask("pin", ["0_0.pcd", "nowhere.pcd"])
    assert [row[0] for row in answer[2]] == ["0_0.pcd"]
    assert answer[3] == ["nowhere.pcd"]
    wait_for_pins(client, {"0_0.pcd": "resident"})
    assert client.ask("show", "0_0.pcd")[14] == ["points"]
    client.area(circle(0, 0, 60))
    freed = client.ask("evict")
    assert freed[5] == 1
    assert len(one.segments()) >= 1
    assert pins(client) == {"0_0.pcd": "resident"}
    assert client.ask("unpin", ["0_0.pcd"])[2] == []
    assert client.ask("evict", ["0_0.pcd"])[2] == 1


def test_pins_survive_pressure_that_evicts_everything_else(
    daemon: DaemonFactory, connect: Connect, tmp_path: Path
) -> None:
    heavy_map = make_map(tmp_path / "heavy", points=4000)
    one = daemon(heavy_map.root, "--budget", "1M")
    client = connect(one)
    client.ask("pin", ["0_0.pcd"])
    wait_for_pins(client, {"0_0.pcd": "resident"})
    (segment,) = one.segments()
    names = [f"{x}_{y}.pcd" for x in (-60, -40, -20, 20, 40) for y in (-60, -40, 20, 40)]
    for name in names:
        client.selected([name])
        client.release()
    evicted = client.ask("stats")[4]["evictions"]
    assert evicted > 0
    assert segment in one.segments()
    with pytest.raises(DaemonError, match="over_budget"):
        client.ask("pin", names)
    assert pins(client) == {"0_0.pcd": "resident"}


def test_a_pinned_cell_that_changes_is_loaded_again(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    client.ask("pin", ["0_0.pcd"])
    wait_for_pins(client, {"0_0.pcd": "resident"})
    before = one.segments()
    divided_map.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(99), (0, 0), 700))
    assert client.ask("reload")[3] == 1
    waiting = Deadline()
    while waiting(one.segments() == before or pins(client) != {"0_0.pcd": "resident"}):
        client.ask("stats")


def test_stop(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(circle(0, 0, 60))
    pid = one.pid
    assert client.ask("shutdown")[0] == "stopping"
    assert_stopped(one, pid)


_AS_MEMBER = """
import json, os, sys
from tests.support.raw_client import DaemonError, RawClient
import zmq
path, gid, uid = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
os.setgroups([int(sys.argv[4])])
os.setgid(gid)
os.setuid(uid)
found = {}
with RawClient(path) as client:
    for request in (["reload"], ["evict"], ["pin", ["0_0.pcd"]], ["unpin"], ["stats"], ["shutdown"]):
        try:
            client.ask(*request)
            found[request[0]] = "done"
        except DaemonError as error:
            found[request[0]] = error.code
print(json.dumps(found))
"""


def as_member(one: DaemonProcess, gid: int) -> dict[str, str]:
    """What another user may ask for; connecting needs the daemon's group."""
    done = subprocess.run(
        [sys.executable, "-c", _AS_MEMBER, one.endpoint, str(gid), str(MEMBER), str(GROUP)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout)
    return found


@pytest.mark.root
def test_only_administrators_change_anything(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one: DaemonProcess = daemon(
        divided_map.root, "--group", str(GROUP), "--admin-group", str(ADMINS), start=False
    )
    os.chmod(one.runtime_dir, 0o755)
    os.chmod(one.shm_dir, 0o1777)
    one.start()
    refused = dict.fromkeys(("reload", "evict", "pin", "unpin", "shutdown"), "not_permitted")
    assert as_member(one, GROUP) == {**refused, "stats": "done"}
    pid = one.pid
    assert set(as_member(one, ADMINS).values()) == {"done"}
    assert_stopped(one, pid)
