# SPDX-License-Identifier: Apache-2.0
"""Four walks a reader can take, and how many files each enters on the loop's thread.

Start-up, what has its own time (asked for by `ServingLoop._poll_timeout_s`, done by `_do_what_is_due`) and
loader processes do not count, nor do failpoints and the writing of statistics.
``shmmap/ARCHITECTURE.md`` lists the daemon's files of each walk; the lists there are these sets.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, cast

import pytest

import shmmap
from shmmap import live_messages as live
from shmmap.chunks.marks import encode_marks
from shmmap.daemon import turns
from shmmap.live_settings import LiveSettings
from shmmap.live_worker.main import _Worker
from shmmap.processes.start_child import channel, packet_buffer, receive_packet
from shmmap.protocol import live as messages
from shmmap.protocol import messages as m
from shmmap.protocol.codec import decode_reply, encode, pack_versions
from tests.support.daemon_process import Deadline
from tests.support.divided_map import DividedMap, make_map
from tests.support.live_drive import RESOLUTION, marked
from tests.unit.daemon.whole_daemon import WholeDaemon

PACKAGE = str(Path(shmmap.__file__).parent)
ARCHITECTURE = Path(PACKAGE, "ARCHITECTURE.md")
NOT_COUNTED = ("failpoints", "statistics/")
EVERYWHERE = m.BoxMessage(-1e4, -1e4, 1e4, 1e4)
LEFT_OUT = {"_poll", "_poll_timeout_s", "_do_what_is_due", "follow_moves"}
"""Functions that the loop calls by the clock: what they enter belongs to no walk."""


@pytest.fixture(autouse=True)
def long_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no turn end for what the profiler costs."""
    monkeypatch.setattr(turns, "STEP_S", 60.0)


class Walker:
    """Which files of the package are entered.

    Parameters
    ----------
    under
        Functions count that a function of this name calls, and what they call.
    since, until
        Names of the function with which it begins, and of the one with which it ends.
    """

    def __init__(self, *, under: str = "", since: str = "", until: str = "") -> None:
        self._under, self._since, self._until = under, since, until
        self._over = False
        self.files: set[str] = set()

    @property
    def of_server(self) -> set[str]:
        """Files of the daemon, or of its live worker."""
        return {file for file in self.files if file.startswith(("daemon/", "live_worker/"))}

    @property
    def count(self) -> int:
        """Number of files that count."""
        return sum(not file.startswith(NOT_COUNTED) for file in self.files)

    @contextlib.contextmanager
    def walking(self) -> Iterator[None]:
        sys.setprofile(self._on_event)
        try:
            yield
        finally:
            sys.setprofile(None)

    def _on_event(self, frame: FrameType, event: str, _argument: Any) -> None:
        if event == "return" and frame.f_code.co_name == self._until:
            self._over = True
        if event != "call" or self._over or not frame.f_code.co_filename.startswith(PACKAGE):
            return
        if self._since not in ("", frame.f_code.co_name):
            return
        callers, above = list[str](), cast("FrameType | None", frame)
        files = {frame.f_code.co_filename}
        while above is not None:
            callers.append(above.f_code.co_name)
            if self._since and above.f_code.co_filename.startswith(PACKAGE):
                files.add(above.f_code.co_filename)
            above = above.f_back
        if not LEFT_OUT.intersection(callers) and (not self._under or self._under in callers):
            self.files.update(str(Path(file).relative_to(PACKAGE)) for file in files)
            self._since = ""


def listed(number: int) -> set[str]:
    """Files that ARCHITECTURE.md lists for a walk, loader files (which run elsewhere) left out."""
    text = ARCHITECTURE.read_text(encoding="utf-8")
    sections = re.findall(rf"^### {number}\. .*?\n(.*?)(?=^##|\Z)", text, re.MULTILINE | re.DOTALL)
    (section,) = sections
    return set(re.findall(r"^\d+\. `((?:daemon|live_worker)/[a-z_/]+\.py)`", section, re.MULTILINE))


def test_warm_differential(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> None:
    one = whole(small_map.root)
    cells = one.ask(m.Area(2, EVERYWHERE, wait=30.0)).cells
    held = [cell.version for cell in cells[:8]]
    walker = Walker(since="_ready", until="reply")
    named = tuple(m.HeldCell(cell.id, cell.version) for cell in cells[8:10])
    reply = one.ask(m.Differential(3, EVERYWHERE, held=named, packed=pack_versions(held)), walker.walking())
    assert len(reply.cells) == 6
    assert walker.of_server == listed(1)
    assert walker.count <= 15


def test_cold_load(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> None:
    one = whole(small_map.root)
    held = one.ask(m.Selected(2, ("0_0.pcd",), wait=30.0)).cells  # a loader has started
    walker = Walker(until="reply")
    area = m.BoxMessage(21.0, 21.0, 22.0, 22.0)
    reply = one.ask(
        m.Differential(3, area, packed=pack_versions([held[0].version]), wait=30.0), walker.walking()
    )
    assert [Path(cell.id).name for cell in reply.cells] == ["20_20.pcd"]
    assert walker.of_server == listed(2)
    assert walker.count <= 36


def test_eviction(whole: Callable[..., WholeDaemon], tmp_path: Path) -> None:
    """From the scheduler asking for room until it is there, a tick after a segment was retired."""
    made = make_map(tmp_path / "large", columns=4, rows=4, points=20_000)
    one = whole(made.root, budget_bytes=4 << 20)
    everything = [cell.id for cell in one.ask(m.Metadata(2)).rows]
    held: list[str] = []
    asking, sweeping = Walker(under="why_not"), Walker(under="sweep")
    for number, cell in enumerate(everything):
        one.send(m.Selected(10 + number, (cell,), wait=30.0))
        with asking.walking():
            one.turn_until(lambda: one.answered() or one.memory.cache.ledger.retired)
        with sweeping.walking():
            one.turn_until(one.answered)
        held += [row.id for row in one.received().cells]
        one.ask(m.Release(100 + number))
    assert one.memory.cache.evictor.evicted_count > 0
    assert len(held) == len(everything)
    files = asking.of_server | sweeping.of_server | {"daemon/loading/scheduler.py"}
    assert files == listed(3)
    assert len(files) <= 11


def test_a_scan_into_a_live_map(tmp_path: Path) -> None:
    """In the live worker, from the request to the answer; its file threads do not count."""
    ours, theirs = channel()
    with tempfile.TemporaryDirectory(dir="/dev/shm") as shm, ours, theirs:
        ours.setblocking(False)
        settings = LiveSettings("lidar", str(tmp_path / "lidar"), resolution=RESOLUTION)
        worker = _Worker(theirs, live.Begin("walk", (settings,), shm, f"{shm}/marks", 1 << 24, -1, -1))
        worker.run_turn()

        def answer(message: messages.LiveRequest) -> Any:
            ours.send(live.encode(live.Ask(message.request, 1, os.geteuid(), True, encode(message))))
            body, waiting = b"", Deadline()
            while waiting(not body):
                worker.run_turn()
                with contextlib.suppress(BlockingIOError):
                    found = live.decode_from_live(receive_packet(ours, packet_buffer())[0])
                    if isinstance(found, live.Reply) and found.ticket == message.request:
                        body = found.body
            return decode_reply(body)

        def scan(number: int) -> messages.LiveScan:
            data = encode_marks(marked(1)[0], opened.map_id, opened.mapper, number)
            Path(opened.marks_dir, f"1.{number}").write_bytes(data)
            at = (0.0, 0.0, 0.0)
            return messages.LiveScan(number, "lidar", opened.mapper, number, f"1.{number}", len(data), at)

        waiting = Deadline()
        while waiting(not worker._maps):
            worker.run_turn()
        opened = answer(messages.LiveOpen(1, "lidar", "front"))
        assert answer(scan(2)).scan == 2
        one = worker._maps["lidar"]
        while waiting(len(one.paged.chunks) < 27 or one.status().loading > 0):
            worker.run_turn()
        walker = Walker()
        second = scan(3)
        with walker.walking():
            assert answer(second).scan == 3
        worker.end(live.End(keep=False))
    assert walker.of_server == listed(4)
    assert len(walker.of_server) <= 14
