# SPDX-License-Identifier: Apache-2.0
"""Ten ways in which things go wrong, one test each: bystanders notice nothing, and nothing is left.

Other tests go deeper into most of them; here each has the same witnesses.  A reader that maps a few
segments from before has the same bytes afterwards; another client gets right answers before, during and
after; in the end every segment is freed, and the daemon leaves no name, process, file or socket.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.client_programs import HoldingClient
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.divided_map import DividedMap
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import DaemonError, RawClient
from tests.support.segment_reader import assert_right, whole
from tests.support.segments import damage_header, damage_payload, other_layout


class Bystanders:
    """A daemon, a reader of three of its segments, and another client; nothing may disturb them."""

    def __init__(self, one: DaemonProcess, made: DividedMap) -> None:
        self.one = one
        self.made = made
        self.client = shmmap.connect(one.endpoint, name="bystander", timeout=60.0, connect_timeout=60.0)
        near = whole(self.client, 0, 0, 5)
        self.paths = [f"{one.shm_dir}{cell.segment}" for cell in near][:3]
        del near
        self.reader = MappingProcess(self.paths)
        self.before = self.reader.checksums()

    def check(self) -> None:
        """The reader has the same bytes, the client gets right ones."""
        assert self.reader.checksums() == self.before
        assert_right(whole(self.client, 0, 0, 5), self.made, self.made.in_circle(0, 0, 5))

    def freed(self, keep: int) -> None:
        """Wait until only this many segments are left."""
        self.one.until_segments(keep, self.client.evict)

    def end(self) -> None:
        """Check for the last time; then everything is freed."""
        self.check()
        self.reader.end()
        self.freed(0)
        self.client.close()


@pytest.fixture
def bystanders(daemon: DaemonFactory, divided_map: DividedMap) -> Iterator[Bystanders]:
    """Return witnesses of a daemon with one loader; the daemon itself is judged by its own fixture."""
    made = Bystanders(daemon(divided_map.root, "--workers", "1"), divided_map)
    try:
        yield made
        made.end()
    finally:
        made.reader.end()
        made.client.close()


def test_1_a_client_is_killed(bystanders: Bystanders) -> None:
    holder = HoldingClient(bystanders.one.endpoint)
    assert len(holder.hold([0, 0, 500]).cells) == 36
    bystanders.client.evict()
    assert len(bystanders.one.segments()) == 36
    bystanders.check()
    holder.kill()
    bystanders.freed(3)


def test_2_a_client_stands_still(bystanders: Bystanders) -> None:
    holder = HoldingClient(bystanders.one.endpoint)
    held = holder.hold([40, 40, 15])
    os.kill(holder.pid, signal.SIGSTOP)
    for _ in range(5):
        bystanders.client.evict()
        bystanders.check()
    for row in held.cells:
        (segment,) = bystanders.client.show(row.id).segments
        assert [known.pid for known in segment.holders] == [holder.pid]
    os.kill(holder.pid, signal.SIGCONT)
    assert holder.hold(None).cells == held.cells
    holder.kill()


def test_3_a_handle_is_overtaken_by_eviction(bystanders: Bystanders, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between answer and attach the segment goes and the cell is loaded anew: it is asked for again."""
    seen: list[str] = []

    def overtake(label: str) -> None:
        if label == "client.answer" and not seen:
            seen.append("")
            bystanders.freed(3)
            again = whole(bystanders.client, 40, 40, 5)
            seen.extend(cell.segment for cell in again)

    with shmmap.connect(bystanders.one.endpoint, timeout=60.0) as slow:
        first = {cell.segment for cell in whole(slow, 40, 40, 5)}
        monkeypatch.setattr("shmmap.client.session.step", overtake)
        found = slow.around(40, 40, 5, wait=30.0).raise_for_failures()
        assert_right(found, bystanders.made, bystanders.made.in_circle(40, 40, 5))
        assert {cell.segment for cell in found} == set(seen[1:])
        assert first.isdisjoint(seen)
        del found


def test_4_the_daemon_is_killed_at_work(bystanders: Bystanders) -> None:
    """Every step has its own test (`test_crash_sweep`); here in the middle of a load."""
    one = bystanders.one
    one.stop_loaders()
    found: list[shmmap.CellSet] = []
    with shmmap.connect(one.endpoint, timeout=60.0) as asking:
        before = bystanders.client.stats().counters["loads_started"]
        thread = threading.Thread(target=lambda: found.append(whole(asking, 40, 40, 5)))
        thread.start()
        waiting = Deadline()
        while waiting(bystanders.client.stats().counters["loads_started"] == before):
            pass
        one.kill()
        assert bystanders.reader.checksums() == bystanders.before
        one.start()
        thread.join(60)
        assert_right(found.pop(), bystanders.made, bystanders.made.in_circle(40, 40, 5))


def test_5_leftovers_of_every_bad_kind(bystanders: Bystanders) -> None:
    one = bystanders.one
    far = whole(bystanders.client, 40, 40, 5)
    paths = [f"{one.shm_dir}{cell.segment}" for cell in far]
    names = {cell.segment for cell in far}
    del far
    one.kill()
    for path, damage in zip(paths, (damage_header, damage_payload, other_layout), strict=False):
        damage(path)
    Path(one.shm_dir, f"shmmap.{one.instance}.{'0' * 16}").write_bytes(b"SHMMAP\0\1 torn")
    one.start()
    again = whole(bystanders.client, 40, 40, 5)
    assert_right(again, bystanders.made, bystanders.made.in_circle(40, 40, 5))
    assert len(names & {cell.segment for cell in again}) == len(paths) - 3
    del again


def test_6_no_memory_is_left(bystanders: Bystanders) -> None:
    """Files may not grow (as on a full file system): cells fail one by one, and load once they may."""
    one = bystanders.one
    whole(bystanders.client, -40, -40, 5)
    unlimited = resource.RLIM_INFINITY
    for pid in one.children():
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (8192, unlimited))
    with shmmap.connect(one.endpoint, timeout=60.0) as asking:
        reply = asking.around(40, 40, 5, wait=30.0)
        assert len(reply.failed) == 4
        assert len(asking.around(-40, -40, 5, wait=30.0)) == 4
        bystanders.check()
        for pid in one.children():
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (unlimited, unlimited))
        assert_right(whole(asking, 40, 40, 5), bystanders.made, bystanders.made.in_circle(40, 40, 5))


def test_7_a_file_changes_under_its_loader_and_the_loader_is_killed(bystanders: Bystanders) -> None:
    one, made = bystanders.one, bystanders.made
    path = made.pcd_dir / "40_40.pcd"
    good = path.read_bytes()
    (loader,) = one.stop_loaders()
    found: list[shmmap.CellSet] = []

    def ask() -> None:
        found.append(asking.around(40, 40, 5, wait=30.0))

    with shmmap.connect(one.endpoint, timeout=60.0) as asking:
        started = bystanders.client.stats().counters["loads_started"]
        thread = threading.Thread(target=ask)
        thread.start()
        waiting = Deadline()
        while waiting(bystanders.client.stats().counters["loads_started"] < started + 4):
            pass
        os.truncate(path, len(good) // 2)
        os.kill(loader, signal.SIGCONT)
        thread.join(60)
        reply = found.pop()
        assert [failure.cell_id for failure in reply.failed] == [made.id("40_40.pcd")]
        assert len(reply) == 3
        bystanders.check()
        path.write_bytes(good)
        for pid in one.children():
            with contextlib.suppress(ProcessLookupError):  # it may have ended with its parent
                os.kill(pid, signal.SIGKILL)  # as when memory runs out
        assert_right(whole(asking, 40, 40, 5), made, made.in_circle(40, 40, 5))
        del reply


def test_8_a_second_daemon_and_what_a_killed_one_leaves(bystanders: Bystanders) -> None:
    one = bystanders.one
    assert one.run_to_end() == 75
    bystanders.check()
    one.kill()
    assert Path(one.endpoint).is_socket()  # stale, and so is the lock
    assert any(name.endswith(".lock") for name in os.listdir(one.runtime_dir))
    one.start()


def test_9_names_are_removed_and_descriptors_run_out(bystanders: Bystanders) -> None:
    one = bystanders.one
    whole(bystanders.client, 40, 40, 5)
    for name in one.segments():
        os.unlink(f"{one.shm_dir}/{name}")
    assert bystanders.reader.checksums() == bystanders.before
    waiting = Deadline()
    while waiting(not all(_there(one, cell) for cell in whole(bystanders.client, 0, 0, 5))):
        pass
    _soft, hard = resource.prlimit(one.pid, resource.RLIMIT_NOFILE)
    taken = len(os.listdir(f"/proc/{one.pid}/fd"))
    resource.prlimit(one.pid, resource.RLIMIT_NOFILE, (taken, hard))
    for _ in range(20):
        bystanders.check()
    reply = bystanders.client.around(-40, -40, 5, wait=30.0)  # no descriptor for a finished segment
    assert len(reply.failed) + len(reply) == 4
    del reply
    resource.prlimit(one.pid, resource.RLIMIT_NOFILE, (hard, hard))
    assert_right(
        whole(bystanders.client, -40, -40, 5), bystanders.made, bystanders.made.in_circle(-40, -40, 5)
    )


def _there(one: DaemonProcess, cell: shmmap.Cell) -> bool:
    return os.path.exists(f"{one.shm_dir}{cell.segment}")


def test_10_a_client_that_means_harm(bystanders: Bystanders, connect: Callable[..., RawClient]) -> None:
    """Nonsense on the wire, locks on segments, handles that it never gives back."""
    one = bystanders.one
    evil = connect(one, name="evil")
    for data in (b"", b"\x00", b"\xff" * 1000, b"\x91\xa4area", os.urandom(4096)):
        evil.send_bytes(data)
    bystanders.check()
    with pytest.raises(DaemonError, match="bad_request"):
        evil.ask("area", ["circle", 0, 0, float("nan")], ["points"], 1.0)
    held = evil.selected(["40_40.pcd"]).cells
    with contextlib.ExitStack() as stack:
        fd = os.open(evil.path(held[0]), os.O_RDONLY)
        stack.callback(os.close, fd)
        fcntl.flock(fd, fcntl.LOCK_EX)
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.write(fd, b"x")
        with pytest.raises(OSError, match="Invalid argument"):
            os.ftruncate(fd, 0)
        if os.geteuid() != 0:  # a segment's mode stops nobody who is root
            with pytest.raises(PermissionError):
                os.open(evil.path(held[0]), os.O_RDWR)
        for _ in range(50):
            evil.send("area", ["circle", 0, 0, 500], ["points"], 30.0)  # and never reads a reply
        bystanders.check()
        bystanders.client.evict()
        shown = bystanders.client.show("40_40.pcd").segments
        assert len(shown) >= 1
