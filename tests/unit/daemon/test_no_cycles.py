# SPDX-License-Identifier: Apache-2.0
"""What the daemon drops does not refer to itself: its memory is freed by counting references alone."""

from __future__ import annotations

import gc
import os
import signal
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

import shmmap.daemon
from shmmap.daemon.loading.loads import Load
from shmmap.daemon.records import Key
from shmmap.protocol import messages as m
from shmmap.protocol.codec import encode, pack_versions
from tests.support.divided_map import DividedMap, random_points
from tests.unit.daemon.whole_daemon import HELLO, WholeDaemon

DAEMON = str(Path(shmmap.daemon.__file__).parent)
EVERYWHERE = m.BoxMessage(-1e4, -1e4, 1e4, 1e4)


@pytest.fixture(autouse=True)
def _only_by_references() -> Iterator[None]:
    gc.collect()
    gc.freeze()  # what earlier tests left is not looked at
    gc.disable()
    try:
        yield
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
        gc.unfreeze()


def left_behind() -> list[str]:
    """What is no longer reachable, and was not freed, of the daemon's own."""
    gc.set_debug(gc.DEBUG_SAVEALL)
    gc.collect()
    gc.set_debug(0)
    found = [name for one in gc.garbage if (name := _of_the_daemon(one))]
    gc.garbage.clear()
    return found


def _of_the_daemon(one: Any) -> str:
    if isinstance(one, types.FunctionType):
        code = one.__code__
    elif isinstance(one, types.FrameType):
        code = one.f_code
    elif isinstance(one, types.GeneratorType):
        code = one.gi_code
    else:
        kind = type(one)
        return kind.__qualname__ if kind.__module__.startswith("shmmap.") else ""
    return code.co_name if code.co_filename.startswith(DAEMON) else ""


def connected(one: WholeDaemon, context: zmq.Context[Any]) -> zmq.Socket[Any]:
    client: zmq.Socket[Any] = context.socket(zmq.DEALER)
    client.linger = 0
    client.connect(f"ipc://{one.endpoint}")
    return client


def test_what_refers_to_itself_is_found() -> None:
    load = Load(Key("0_0.pcd", "points"), 100, 0.0, 1)
    load.asker = (load,)
    del load
    assert left_behind() == ["Key", "Load"]


def test_requests_loads_and_evictions(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> None:
    """Cold, warm, packed, named, failed, refused, pending, in vain; and what comes of an eviction."""
    one = whole(small_map.root)
    (small_map.pcd_dir / "20_20.pcd").write_bytes(b"no PCD")
    one.ask(m.Selected(2, ("20_0.pcd", "20_20.pcd", "nowhere"), layers=("points", "voxel"), wait=30.0))
    for number, name in enumerate(("0_0.pcd", "20_20.pcd")):
        one.ask(m.Selected(10 + number, (name,)))
    cells = one.ask(m.Area(20, EVERYWHERE, wait=30.0)).cells
    for turn in range(3):
        held = tuple(m.HeldCell(cell.id, cell.version) for cell in cells[:4])
        all_of_it = pack_versions([cell.version for cell in cells])
        one.ask(m.Differential(30 + turn, EVERYWHERE, held=held, packed=pack_versions([5, cells[5].version])))
        one.ask(m.Differential(40 + turn, EVERYWHERE, packed=all_of_it, wait=0.1))
    one.ask(m.Area(50, EVERYWHERE, layers=("no_such_layer",)))
    one.ask(m.Area(51, m.BoxMessage(5.0, 0.0, -5.0, 0.0)))
    one.ask(m.Metadata(52))
    one.ask(m.Stats(53))
    one.ask(m.Release(54))
    one.ask(m.Evict(55, None))
    one.turn_until(lambda: not one.memory.cache.ledger.retired)
    assert left_behind() == []


def test_clients_that_come_and_go(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> None:
    one = whole(small_map.root)
    sessions, connections = one.memory.sessions, one.service._connections
    with zmq.Context() as context:
        for talk in ((), (encode(HELLO),), (encode(HELLO), b"nonsense", b""), (b"\0" * 9,)):
            client = connected(one, context)
            for body in talk:
                client.send(body)
                one.turn_until(lambda client=client: client.poll(0))  # type: ignore[misc]
                client.recv()
            one.turn()
            client.close()
    one.turn_until(lambda: len(list(connections)) == 1 and len(sessions) == 1)
    assert left_behind() == []


def test_loaders_that_die_and_a_map_that_changes(
    whole: Callable[..., WholeDaemon], small_map: DividedMap
) -> None:
    one = whole(small_map.root)
    one.ask(m.Area(2, EVERYWHERE, wait=30.0))
    pool = one.memory.scheduler.pool
    for worker in pool:
        os.kill(worker.pid, signal.SIGKILL)
    one.turn_until(lambda: not len(pool))
    one.ask(m.Evict(3, None))
    one.ask(m.Area(4, EVERYWHERE, wait=30.0))
    small_map.write_cell("40_40.pcd", (40, 40), random_points(np.random.default_rng(1), (40, 40), 30))
    small_map.write_metadata()
    one.ask(m.Reload(5))
    assert one.ask(m.Area(6, EVERYWHERE, wait=30.0)).cells
    assert left_behind() == []
