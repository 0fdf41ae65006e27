# SPDX-License-Identifier: Apache-2.0
"""Three walks a reader can take, and how many files of the daemon each enters on the loop's thread.

Start-up, what has its own time (asked for by `ServingLoop._patience_s`, done by `_look_after_the_rest`) and
loader processes do not count.
``shmmap/ARCHITECTURE.md`` lists the files of each walk; the lists there are these sets.
"""

from __future__ import annotations

import contextlib
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any, cast

import pytest
import zmq

import shmmap.daemon
from shmmap.daemon.assembly import Service
from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.host.scheduling import take_slices
from shmmap.daemon.host.signals import StartSignals
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.map_in_memory import MapInMemory
from shmmap.daemon.pins.watch import PinWatch
from shmmap.daemon.service_manager.status import ServiceManager
from shmmap.origin.map_directory import open_map
from shmmap.protocol import messages as m
from shmmap.protocol.codec import decode_reply, encode, pack_versions
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import prepare_process
from tests.support.divided_map import DividedMap, make_map

DAEMON = str(Path(shmmap.daemon.__file__).parent)
ARCHITECTURE = Path(DAEMON).with_name("ARCHITECTURE.md")
HELLO = m.Hello(1, *m.PROTOCOL_VERSION, "walker")
EVERYWHERE = m.BoxMessage(-1e4, -1e4, 1e4, 1e4)
PATIENCE_S = 60.0
LEFT_OUT = {"_poll", "_patience_s", "_look_after_the_rest"}


class Walker:
    """Which files of the daemon are entered."""

    def __init__(
        self, *, under: str = "", until: str = "", leaving_out: str = "_look_after_the_rest"
    ) -> None:
        self._under, self._until, self._leaving_out = under, until, leaving_out
        self._over = False
        self.files: set[str] = set()

    @contextlib.contextmanager
    def walking(self) -> Iterator[None]:
        sys.setprofile(self._hear)
        try:
            yield
        finally:
            sys.setprofile(None)

    def _hear(self, frame: FrameType, event: str, _argument: Any) -> None:
        if event == "return" and frame.f_code.co_name == self._until:
            self._over = True
        if event != "call" or self._over or not frame.f_code.co_filename.startswith(DAEMON):
            return
        callers, above = [], cast("FrameType | None", frame)
        while above is not None:
            callers.append(above.f_code.co_name)
            above = above.f_back
        if not LEFT_OUT.intersection(callers) and (not self._under or self._under in callers):
            self.files.add(str(Path(frame.f_code.co_filename).relative_to(DAEMON)))


class WholeDaemon:
    """The daemon as it is put together, turned by the test, and one client."""

    def __init__(self, made: DividedMap, scratch: str, **settings: Any) -> None:
        prepare_process()
        path = scratch + "/walk.sock"
        shm_dir = scratch + "/shm"
        Path(shm_dir).mkdir()
        config = DaemonConfig(
            map_path=str(made.root), instance="walk", shm_dir=shm_dir, workers=1, **settings
        )
        directory = ShmDirectory(shm_dir)
        origin = open_map(str(made.root), cache_dir=scratch)
        catalogue = origin.load()
        self.memory = MapInMemory(config, catalogue, directory, PinWatch(directory), path, 0o400, -1)
        signals = cast("StartSignals", SimpleNamespace(keep=False, reload_wanted=False))
        self.service = Service(
            config, self.memory, Reloader(origin), ServiceManager(), path, -1, signals, activated=None
        )
        self.service._listen()
        self._context: zmq.Context[Any] = zmq.Context()
        self._client = self._context.socket(zmq.DEALER)
        self._client.linger = 0
        self._client.connect(f"ipc://{path}")

    def turn(self) -> None:
        loop = self.service._loop
        loop._turn(loop._poll(loop._patience_s()))

    def turn_until(self, done: Callable[[], object]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not done():
            self.turn()
            assert time.monotonic() < end_s

    def ask(self, request: m.Request, walker: Walker | None = None) -> Any:
        """Send a request, turn until it is answered; a walker walks with it."""
        self._client.send(encode(request))
        with walker.walking() if walker is not None else contextlib.nullcontext():
            self.turn_until(self.answered)
        return decode_reply(self._client.recv())

    def answered(self) -> bool:
        """Whether a reply has come."""
        return bool(self._client.poll(0))

    def close(self) -> None:
        self._client.close()
        self._context.term()
        self.service._end()
        self.memory.close(keep=False)
        take_slices(0)  # the loop's short turns are not for the tests that follow


@pytest.fixture
def whole(tmp_path: Path) -> Iterator[Callable[..., WholeDaemon]]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as scratch:
        made: list[WholeDaemon] = []

        def factory(cells: DividedMap, **settings: Any) -> WholeDaemon:
            made.append(WholeDaemon(cells, scratch, **settings))
            made[-1].ask(HELLO)
            return made[-1]

        yield factory
        for one in made:
            one.close()


def listed(number: int) -> set[str]:
    """Files that ARCHITECTURE.md lists for a walk, loader files (which run elsewhere) left out."""
    text = ARCHITECTURE.read_text(encoding="utf-8")
    sections = re.findall(rf"^### {number}\. .*?\n(.*?)(?=^##|\Z)", text, re.MULTILINE | re.DOTALL)
    (section,) = sections
    return set(re.findall(r"^\d+\. `daemon/([a-z_/]+\.py)`", section, re.MULTILINE))


def test_warm_differential(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> None:
    one = whole(small_map)
    cells = one.ask(m.Area(2, EVERYWHERE, wait=30.0)).cells
    held = [cell.version for cell in cells[:8]]
    walker = Walker(until="reply")
    named = tuple(m.HeldCell(cell.id, cell.version) for cell in cells[8:10])
    reply = one.ask(m.Differential(3, EVERYWHERE, held=named, packed=pack_versions(held)), walker)
    assert len(reply.cells) == 6
    assert walker.files == listed(1)
    assert len(walker.files) <= 12


def test_cold_load(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> None:
    one = whole(small_map)
    held = one.ask(m.Selected(2, ("0_0.pcd",), wait=30.0)).cells  # a loader has started
    walker = Walker(until="reply")
    area = m.BoxMessage(21.0, 21.0, 22.0, 22.0)
    reply = one.ask(m.Differential(3, area, packed=pack_versions([held[0].version]), wait=30.0), walker)
    assert [Path(cell.id).name for cell in reply.cells] == ["20_20.pcd"]
    assert walker.files == listed(2)
    assert len(walker.files) <= 16


def test_eviction(whole: Callable[..., WholeDaemon], tmp_path: Path) -> None:
    """From the scheduler asking for room until it is there, a tick after a segment was retired."""
    made = make_map(tmp_path / "large", columns=4, rows=4, points=20_000)
    one = whole(made, budget_bytes=4 << 20)
    everything = [cell.id for cell in one.ask(m.Metadata(2)).rows]
    held: list[str] = []
    asking, sweeping = Walker(under="refusal"), Walker(under="sweep")
    for number, cell in enumerate(everything):
        one._client.send(encode(m.Selected(10 + number, (cell,), wait=30.0)))
        with asking.walking():
            one.turn_until(lambda: one.answered() or one.memory.cache.ledger.retired)
        with sweeping.walking():
            one.turn_until(one.answered)
        reply: Any = decode_reply(one._client.recv())
        held += [row.id for row in reply.cells]
        one.ask(m.Release(100 + number))
    assert one.memory.cache.reclaimer.evicted_count > 0
    assert len(held) == len(everything)
    files = asking.files | sweeping.files | {"loading/scheduler.py"}
    assert files == listed(3)
    assert len(files) <= 9
