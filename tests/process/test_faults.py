# SPDX-License-Identifier: Apache-2.0
"""Files and loaders that crash, hang or lie cost their own cell and nothing else."""

from __future__ import annotations

import os
import resource
import signal
import struct
from collections.abc import Callable

import pytest

from shmmap.statistics.reader import read_statistics
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import Deadline, wait_ended
from tests.support.divided_map import DividedMap
from tests.support.process_costs import peak_bytes
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]


def test_one_load_for_many_who_ask(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    clients = [connect(one) for _ in range(8)]
    requests = [client.send("area", circle(0, 0, 60), ["points"], 30.0) for client in clients]
    wanted = divided_map.in_circle(0, 0, 60)
    replies = [c.cells_reply(c.wait_for(r)) for c, r in zip(clients, requests, strict=True)]
    segments = [handle.segment for handle in replies[0].cells]
    assert [handle.id for handle in replies[0].cells] == [divided_map.id(name) for name in wanted]
    assert all([h.segment for h in reply.cells] == segments for reply in replies)
    counters = clients[0].ask("stats")[4]
    assert counters["loads_started"] == counters["loads_finished"] == len(wanted)


def test_a_cold_request_delays_nobody_s_warm_one(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """The loaders stand still, so the cold request cannot be answered: warm ones are."""
    one = daemon(divided_map.root, "--workers", "1")
    warm, cold = connect(one), connect(one)
    warm.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    request = cold.send("area", circle(40, 40, 5), ["points"], 60.0)
    partly = cold.area(circle(20, 20, 5), wait=None)  # the same session is not held up either
    assert len(partly.cells) + len(partly.pending) == 4
    assert partly.pending
    for _ in range(50):
        assert len(warm.area(circle(0, 0, 5)).cells) == 4
    os.kill(loader, signal.SIGCONT)
    assert len(cold.cells_reply(cold.wait_for(request)).cells) == 4


def test_patience_ends(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """Who waits for a while gets what there is by then."""
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    reply = client.area(circle(10, 0, 15), wait=0.2)
    assert len(reply.cells) == 4
    assert len(reply.pending) == len(divided_map.in_circle(10, 0, 15)) - 4
    os.kill(loader, signal.SIGCONT)
    assert len(client.area(circle(10, 0, 15)).cells) == len(divided_map.in_circle(10, 0, 15))


def test_a_loader_that_hangs_ends_at_its_deadline(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1", "--load-timeout", "4")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    reply = client.area(circle(40, 40, 5))
    assert wait_ended(loader)
    assert [failure.code for failure in reply.failed] == ["load_timeout"]  # the one it stood still at
    assert len(reply.cells) == 3  # the others were given to the next loader
    assert client.ask("stats")[4]["loads_timed_out"] == 1


def ask_for_four(client: RawClient) -> int:
    """Ask for four cells, and wait until a loader, which stands still, has been given them."""
    started = client.ask("stats")[4]["loads_started"]
    request = client.send("area", circle(40, 40, 5), ["points"], 30.0)
    waiting = Deadline()
    while waiting(client.ask("stats")[4]["loads_started"] < started + 4):
        pass
    return request


def test_a_loader_that_is_killed_costs_one_cell(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    request = ask_for_four(client)
    os.kill(loader, signal.SIGKILL)
    reply = client.cells_reply(client.wait_for(request))
    assert len(reply.cells) == 3
    (failure,) = reply.failed
    assert (failure.code, "SIGKILL" in failure.message) == ("load_failed", True)
    assert client.ask("stats")[4]["worker_crashes"] == 1
    reply = client.area(circle(40, 40, 5))  # not tried again at once
    waiting = Deadline()
    while waiting(bool(reply.failed)):
        reply = client.area(circle(40, 40, 5))
    assert len(reply.cells) == 4


def test_idle_loaders_that_are_killed_are_replaced(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(circle(0, 0, 25))
    for pid in one.loaders():
        os.kill(pid, signal.SIGKILL)
        assert wait_ended(pid)
    reply = client.area(circle(0, 0, 200))
    assert (len(reply.cells), reply.failed) == (36, [])


def test_the_loaders_parent_is_killed(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Its loaders die with it; that is no cell's fault, and another parent makes others."""
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,), parent = one.stop_loaders(), one.loaders_parent()
    request = ask_for_four(client)
    os.kill(parent, signal.SIGKILL)
    reply = client.cells_reply(client.wait_for(request))
    assert (len(reply.cells), reply.failed) == (4, [])
    assert wait_ended(loader)
    assert client.ask("stats")[4]["worker_crashes"] == 1
    assert one.loaders_parent() != parent


def test_a_pipe_instead_of_a_file(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """Opening it would wait for ever."""
    one = daemon(divided_map.root, "--load-timeout", "4")
    path = divided_map.pcd_dir / "0_0.pcd"
    path.unlink()
    os.mkfifo(path)
    client = connect(one)
    reply = client.area(circle(0, 0, 5))
    assert [(f.id.rsplit("/", 1)[-1], f.code) for f in reply.failed] in (
        [("0_0.pcd", "load_failed")],
        [("0_0.pcd", "load_timeout")],
    )
    assert len(reply.cells) == 3


@pytest.mark.parametrize("kind", ["missing", "directory", "empty", "truncated", "loop", "unreadable length"])
def test_a_bad_file_is_reported_and_retried_when_it_is_whole(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, kind: str
) -> None:
    one = daemon(divided_map.root)
    path = divided_map.pcd_dir / "0_0.pcd"
    whole = path.read_bytes()
    path.unlink()
    if kind == "directory":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    elif kind != "missing":
        content = {
            "empty": b"",
            "truncated": whole[:-1],
            "unreadable length": whole.replace(b"POINTS 500", b"POINTS 4000000000"),
        }
        path.write_bytes(content[kind])
    client = connect(one)
    reply = client.area(circle(0, 0, 5))
    (failure,) = reply.failed
    assert (failure.id.rsplit("/", 1)[-1], failure.code) == ("0_0.pcd", "load_failed")
    assert str(path) in failure.message
    assert len(reply.cells) == 3
    if kind == "directory":
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
    interim = path.with_suffix(".new")
    interim.write_bytes(whole)
    interim.rename(path)
    reply = client.area(circle(0, 0, 5))
    waiting = Deadline()
    while waiting(bool(reply.failed)):  # a file that could not even be looked at is tried again after a while
        reply = client.area(circle(0, 0, 5))
    assert len(reply.cells) == 4


def test_a_header_that_promises_the_moon_costs_no_memory(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.loaders()
    idle = peak_bytes(loader)
    header = (
        b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300000000\nHEIGHT 1\n"
        b"POINTS 300000000\nDATA "
    )
    for name, tail in (
        ("20_20.pcd", b"binary\n" + bytes(100)),
        ("20_0.pcd", b"ascii\n1 2 3\n"),
        ("40_20.pcd", b"binary_compressed\n" + struct.pack("<II", 40, 3_600_000_000) + bytes(40)),
    ):
        (divided_map.pcd_dir / name).write_bytes(header + tail)
        reply = client.selected([name])
        (failure,) = reply.failed
        assert failure.code in ("load_failed", "over_budget"), "the latter with little shared memory"
    assert one.loaders() == [loader]
    assert peak_bytes(loader) - idle < 100 << 20


def test_statistics_that_cannot_be_written_end_nobody(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """The limit lies before the counters and behind all that the log gets."""
    one = daemon(divided_map.root)
    client = connect(one)
    warm = [handle.segment for handle in client.area(circle(0, 0, 5)).cells]
    soft, hard = resource.prlimit(one.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(one.pid, resource.RLIMIT_FSIZE, (16384, hard))
    told = 'statistics not written error="File too large"'
    waiting = Deadline()
    while waiting(told not in one.log):
        os.sched_yield()
    asked = client.ask("stats")[4]["requests"]
    assert [handle.segment for handle in client.area(circle(0, 0, 5)).cells] == warm
    resource.prlimit(one.pid, resource.RLIMIT_FSIZE, (soft, hard))
    waiting = Deadline()
    while waiting(read_statistics(one.instance, one.shm_dir).counters["requests"] <= asked):
        os.sched_yield()
    assert one.log.count(told) == 1


def test_a_limit_that_keeps_the_daemon_from_starting_is_named(
    daemon: DaemonFactory, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, command=["prlimit", "--fsize=16384"], start=False)
    assert one.run_to_end() == 71
    assert "RLIMIT_FSIZE is 16,384 bytes" in one.log
    assert "LimitFSIZE=" in one.log
