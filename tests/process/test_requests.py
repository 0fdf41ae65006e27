# SPDX-License-Identifier: Apache-2.0
"""The requests, asked by a client made from PROTOCOL.md and read by a reader made from LAYOUT.md."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.message_pack import pack
from tests.support.raw_client import DaemonError, RawClient, circle
from tests.support.segment_reader import assert_same_points, names

Connect = Callable[..., RawClient]


def test_welcome(served: DaemonProcess, connect: Connect) -> None:
    client = connect(served, name="visitor")
    assert (client.major, client.instance, client.frame_id) == (3, served.instance, "map")
    assert client.shm_dir == served.shm_dir
    assert client.pid == served.pid
    assert client.cells == 36
    assert client.bounds == [-60.0, -60.0, 60.0, 60.0]
    assert client.layers[:3] == ["points", "voxel(leaf,leaf_x,leaf_y,leaf_z)", "ndt(leaf,min_points=6)"]
    assert 0 < client.session < 2**62
    assert client.budget_bytes > 0


def test_heights_leave_out_cells_once_they_are_known(client: RawClient, divided_map: DividedMap) -> None:
    assert client.area(circle(0, 0, 25, (100.0, 200.0))).cells == []  # all are loaded to find that out
    everything = names(client.area(circle(0, 0, 25)).cells)
    assert everything == divided_map.in_circle(0, 0, 25)
    assert client.area(circle(0, 0, 25, (100.0, 200.0)), wait=None).cells == []
    assert names(client.area(circle(0, 0, 25, (4.0, 4.5)), wait=None).cells) == everything


def test_differential_is_the_set_difference_at_every_step(
    standing: DaemonProcess, connect: Connect, standing_map: DividedMap
) -> None:
    """A drive across the map, with what is held named in three forms."""
    client = connect(standing)
    held: dict[str, int] = {}
    rows: list[list[Any]]
    for step in range(24):
        x, y, radius = -70.0 + 6 * step, 20.0 * np.sin(step / 3), 30.0
        wanted = set(standing_map.in_circle(x, y, radius))
        kept = list(held)
        if step % 3 == 0:
            reply = client.differential(circle(x, y, radius), packed=list(held.values()))
            by_version = {version: name for name, version in held.items()}
            removed = sorted((by_version[v] for v in reply.removed_versions), key=kept.index)
            assert reply.removed == []
        else:
            rows = [[standing_map.id(n), v] if step % 3 == 1 else [n] for n, v in held.items()]
            reply = client.differential(circle(x, y, radius), rows)
            removed = [r.rsplit("/", 1)[-1] for r in reply.removed]
            assert reply.removed == [row[0] for row in rows if row[0].rsplit("/", 1)[-1] not in wanted]
        assert removed == [name for name in kept if name not in wanted]
        assert names(reply.cells) == sorted(wanted - set(kept), key=standing_map.id)
        assert (reply.pending, reply.failed) == ([], [])
        for name in removed:
            del held[name]
        for handle in reply.cells:
            assert_same_points(client, handle, standing_map)
            held[handle.id.rsplit("/", 1)[1]] = handle.version
        assert set(held) == wanted


def test_versions_that_are_not_known_are_removed(standing: DaemonProcess, connect: Connect) -> None:
    """Also where all of the area is in memory, which is answered another way."""
    client = connect(standing)
    versions = [handle.version for handle in client.area(circle(0, 0, 5)).cells]
    reply = client.differential(circle(0, 0, 5), packed=[5, *versions, versions[0], 6, 5])
    assert (reply.cells, reply.removed_versions) == ([], [5, 6])


NONSENSE: list[list[Any]] = [
    ["area", 1, ["circle", float("nan"), 0, 1]],
    ["area", 1, ["circle", 0, 0, -1]],
    ["area", 1, ["circle", 0, 0, 1], ["no such layer"]],
    ["area", 1, ["circle", 0, 0, 1], []],
    ["area", 1, ["circle", 0, 0, 1], ["points"], -1.0],
    ["area", 1, ["circle", 0, 0, 1], ["points"], float("nan")],
    ["area", 1, ["circle", 0, 0, 1], ["points"], 30.0, [float("nan"), 0.0]],
    ["area", 1, ["circle", 0, 0, 1], ["points"], 30.0, [0.0, float("inf")]],
    ["area", 1, ["circle", 0, 0, 1], ["points"], 30.0, [0.0, 0.0, float("nan")]],
    ["area", 1, ["circle", 0, 0, 1], ["points"], 30.0, [0.0, 0.0, 0.0, 0.0, float("inf")]],
    ["area", 1, ["circle", 0, 0, 1], ["points"], 30.0, [0.0, 0.0, 0.0, 0.0, None, [[0.0, float("nan")]]]],
    ["differential", 1, ["circle", 0, 0, 1], ["points"], [], b"1234567"],
    ["selected", 1, [5]],
    ["nonsense", 1],
]


def test_nonsense_is_refused_and_harms_no_client(standing: DaemonProcess, connect: Connect) -> None:
    client = connect(standing)
    for request in NONSENSE:
        client.send_bytes(pack(request))
        reply = client.receive()
        assert reply[:3] == ["error", 1, "bad_request"], request
        assert len(client.area(circle(0, 0, 5)).cells) == 4


def test_no_session_and_a_later_version(standing: DaemonProcess, connect: Connect) -> None:
    client = connect(standing, hello=False)
    with pytest.raises(DaemonError) as failure:
        client.area(circle(0, 0, 5))
    assert failure.value.code == "no_session"
    with pytest.raises(DaemonError) as failure:
        client.ask("hello", 4, 0, "from the future")
    assert (failure.value.code, failure.value.hint) == (
        "protocol_mismatch",
        "update the daemon, and restart it",
    )
    client.hello()
    assert len(client.area(circle(0, 0, 5)).cells) == 4


def test_requests_in_flight_are_distinguished(
    standing: DaemonProcess, connect: Connect, standing_map: DividedMap
) -> None:
    """Many questions before the first answer; each answer says which it is for."""
    client = connect(standing)
    asked = {
        client.send("area", circle(20.0 * i - 50, 0, 1), ["points"], 30.0): 20.0 * i - 50 for i in range(6)
    }
    for _ in range(6):
        reply = client.receive()
        x = asked.pop(reply[1])
        assert names(client.cells_reply(reply).cells) == standing_map.in_circle(x, 0, 1)


def test_a_cancelled_wait_leaves_its_place(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.selected(["-60_-60.pcd"])  # starts the loader
    stopped = one.stop_loaders()
    ask = partial(client.send, "area", circle(0, 0, 5), ["points"], 60.0)
    waiting = [ask() for _ in range(64)]
    assert client.cells_reply(client.wait_for(ask())).pending, "the 65th does not wait"
    client.send_bytes(pack(["cancel", waiting.pop(7)]))
    client.send_bytes(pack(["cancel", 2**64 - 1]))
    waiting.append(ask())
    client.ask("stats")
    assert not client.readable()
    for pid in stopped:
        os.kill(pid, signal.SIGCONT)
    for _ in range(64):
        reply = client.receive()
        waiting.remove(reply[1])
        assert names(client.cells_reply(reply).cells) == divided_map.in_circle(0, 0, 5)
    client.ask("stats")
    assert not client.readable()


def test_a_warm_handle_costs_under_200_bytes(standing: DaemonProcess, connect: Connect) -> None:
    client = connect(standing)
    reply = client.area(circle(0, 0, 500))
    assert len(reply.cells) == 36
    assert reply.wire_bytes / 36 < 200


def test_plain_posix_shared_memory(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """In /dev/shm itself every segment is a POSIX shared-memory object."""
    import posix_ipc

    one: DaemonProcess = daemon(divided_map.root, shm_dir="/dev/shm")
    client = connect(one)
    handle = client.selected(["0_0.pcd"]).cells[0]
    memory = posix_ipc.SharedMemory(handle.segment, read_only=True)
    try:
        assert memory.size >= handle.offset + handle.bytes
    finally:
        memory.close_fd()
    assert_same_points(client, handle, divided_map)
