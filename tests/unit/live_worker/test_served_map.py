# SPDX-License-Identifier: Apache-2.0
"""Requests and their answers: each scan once, *durable* not too early, and no turn when there is nothing."""

from __future__ import annotations

import errno
import os
import socket
import threading
import tracemalloc
from collections.abc import Callable
from itertools import count, islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap import live_messages as worker_messages
from shmmap.chunks.layout import OUT_OF_SERVICE
from shmmap.chunks.marks import Marks
from shmmap.errors import BadRequest, CannotWrite, NotPermitted
from shmmap.live_messages import MAX_PER_SESSION
from shmmap.live_worker import served_map
from shmmap.live_worker.chunk_memory import ChunkMemory
from shmmap.live_worker.main import MESSAGES_PER_TURN, _Worker
from shmmap.processes.start_child import channel, packet_buffer, receive_packet
from shmmap.protocol import live as messages
from shmmap.protocol.codec import decode_reply, encode
from shmmap.protocol.messages import ErrorReply
from tests.support.chunk_memory import ChunkMemory as Unbounded
from tests.support.daemon_process import Deadline
from tests.support.live_drive import RESOLUTION, Voxel, marked
from tests.support.odd_files import failing
from tests.support.served_map import Served
from tests.support.stored_chunks import change_chunk, database, saved_bytes

Serve = Callable[..., Served]
NOTHING = Marks(
    np.zeros((0, 3), np.int32), np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros(0, np.uint64),
    np.zeros(0, np.uint16),
)  # fmt: skip
LATER = {"linger_s": 1e9, "checkpoint_s": 1e9}
"""What is in memory stays there, and nowhere else."""


def reference(*scans: Marks) -> dict[Voxel, int]:
    unbounded = Unbounded(RESOLUTION)
    for number, marks in enumerate(scans, 1):
        unbounded.apply(marks, scan=number)
    return unbounded.voxels()


class Blocked:
    """A step that waits until it may go on; it ends by itself at the end of the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> None:
        self.may = threading.Event()
        self.calls = 0
        inner = getattr(owner, name)

        def wait(*arguments: Any) -> Any:
            self.calls += 1
            assert self.may.wait(60.0)
            return inner(*arguments)

        monkeypatch.setattr(owner, name, wait)


def fail(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, number: int) -> list[None]:
    """Have a step fail; returns a list that gets an entry each time."""
    calls: list[None] = []

    def raising(*_: object) -> None:
        calls.append(None)
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(owner, name, raising)
    return calls


@pytest.mark.parametrize("full", ["disk", "memory"])
def test_a_scan_that_waits_for_room_is_answered_why(
    serve: Serve, monkeypatch: pytest.MonkeyPatch, full: str
) -> None:
    """What was applied stays; what waited is applied once when there is room, however often it was sent."""
    scans = marked(12)
    one = serve(96 << 10, waiting_bytes=1, linger_s=0.0)
    mapper, number = one.open().mapper, 0
    owner, name = (one.paged.database, "save") if full == "disk" else (one.paged.memory, "create")
    with monkeypatch.context() as patch:
        fail(patch, owner, name, errno.ENOSPC)
        refused: dict[int, ErrorReply] = {}
        while not refused:  # the memory fills up
            number += 1
            ticket = one.send(scans[number - 1], mapper, number)
            if isinstance(one.answer(ticket), ErrorReply):
                refused[number] = one.answers[ticket]
        waits = one.send(scans[number], mapper, number + 1)  # not accepted
        for _ in range(3):
            refused[number + 1] = one.answer(waits)
            waits = one.send(scans[number], mapper, number + 1)
        for reply in refused.values():
            assert (reply.code, "No space left on device" in reply.message) == ("busy", True)
            assert "live map lidar: a scan waits: chunk" in reply.message
        assert "No space left on device" in one.map.status().problem
    for scan in (number, number + 1):
        while isinstance(one.answer(waits := one.send(scans[scan - 1], mapper, scan)), ErrorReply):
            pass
        assert one.answer(waits).scan == scan
    one.end()
    again = serve()
    for key in again.paged.database.rows:
        again.paged.move(key, tuple((index + 0.5) * 64 * RESOLUTION for index in key))  # type: ignore[arg-type]
    again.until(lambda: set(again.paged.chunks) >= set(again.paged.database.rows))
    assert again.voxels() == reference(*scans[: number + 1])


# --- each scan once -----------------------------------------------------------------------------


def test_a_scan_that_is_sent_again_counts_once(serve: Serve) -> None:
    one = serve(**LATER)
    opened = one.open()
    (marks,) = marked(1)
    tickets = [one.send(marks, opened.mapper, 1) for _ in range(3)]
    for ticket in tickets:
        assert one.answer(ticket).scan == 1
    late = one.send(marks, opened.mapper, 1)
    assert one.answer(late).scan == 1
    assert one.voxels() == reference(marks)


def test_a_running_scan_is_answered_to_the_session_that_sends_it_again(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its mapper lost the connection, and came back as another session."""
    one = serve(**LATER)
    blocked = Blocked(monkeypatch, one.paged.database, "load")
    (marks,) = marked(1)
    opened = one.open(session=1)
    first = one.send(marks, opened.mapper, 1, session=1)
    one.turn()
    one.map.on_disconnect(1)
    again = one.open(session=2)
    assert (again.mapper, again.next_scan) == (opened.mapper, 2)
    second = one.send(marks, opened.mapper, 1, session=2)
    one.turn()
    assert not {first, second} & set(one.answers)
    blocked.may.set()
    assert one.answer(second).scan == 1
    assert one.map.status().scans == 1
    assert one.voxels() == reference(marks)


def test_what_waits_when_a_session_ends_is_not_applied(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    one = serve(waiting_bytes=1, **LATER)
    blocked = Blocked(monkeypatch, one.paged.database, "load")
    first, second = marked(2)
    opened = one.open()
    one.send(first, opened.mapper, 1)
    one.turn()
    waits = one.send(second, opened.mapper, 2)
    one.turn()
    one.map.on_disconnect(1)
    blocked.may.set()
    one.until(lambda: one.map.status().scans == 1)
    one.turn()
    assert waits not in one.answers
    assert one.voxels() == reference(first)


def test_what_waits_when_another_session_takes_the_mapper_is_refused(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program of the same name: it numbers its scans from there on."""
    one = serve(waiting_bytes=1, **LATER)
    blocked = Blocked(monkeypatch, one.paged.database, "load")
    first, second = marked(2)
    mapper = one.open(session=1).mapper
    one.send(first, mapper, 1, session=1)
    one.turn()
    waits = one.send(second, mapper, 2, session=1)
    one.turn()
    assert one.open(session=2).mapper == mapper
    blocked.may.set()
    refused = one.answer(waits)
    assert isinstance(refused, ErrorReply)
    assert f"does not map as mapper {mapper}" in refused.message
    assert one.voxels() == reference(first)


def test_tickets_of_a_scan_do_not_pile_up(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions come, resend a scan that waits for its chunks, and go."""
    one = serve(**LATER)
    blocked = Blocked(monkeypatch, one.paged.database, "load")
    (marks,) = marked(1)
    mapper = one.open().mapper
    for session in range(1, 6):
        one.open(session=session)
        for _ in range(MAX_PER_SESSION):
            one.send(marks, mapper, 1, session=session)
            one.turn()
        one.map.on_disconnect(session)
    assert len(one.map._tickets[mapper, 1]) <= MAX_PER_SESSION
    blocked.may.set()
    one.until(lambda: one.map.status().scans)
    assert one.voxels() == reference(marks)


def test_unexpected_marks_end_nothing(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    one = serve(**LATER)
    (marks,) = marked(1)
    mapper = one.open().mapper
    with monkeypatch.context() as patch:

        def defect(*_: object) -> None:
            raise IndexError("a defect")

        patch.setattr(served_map, "decode_marks", defect)
        ticket = one.send(marks, mapper, 1)
        one.turn()
    refused = one.answers[ticket]
    assert isinstance(refused, ErrorReply)
    assert refused.code == "internal"
    assert one.answer(one.send(marks, mapper, 1)).scan == 1


def test_a_chunk_that_is_damaged_is_not_written_over(serve: Serve, tmp_path: Path) -> None:
    """Nothing is known of it from now on; its row stays, beside another."""
    (marks,) = marked(1)

    def map_it() -> None:
        one = serve(**LATER)
        opened = one.open()
        one.answer(one.send(marks, opened.mapper, opened.next_scan))
        one.end()

    map_it()
    change_chunk(tmp_path / "map", marks.chunks[0], lambda data: data[:-1] + bytes([data[-1] ^ 1]))
    damaged = saved_bytes(tmp_path / "map", marks.chunks[0])
    map_it()
    assert saved_bytes(tmp_path / "map", marks.chunks[0]) != damaged
    with database(tmp_path / "map") as opened:
        assert (damaged,) in opened.execute("select data from chunks").fetchall()


def test_what_was_all_but_given_up_comes_back_from_disk(
    serve: Serve, monkeypatch: pytest.MonkeyPatch, shm: Path
) -> None:
    """Out of service, its name still there: no reader may have it; and what cannot be opened stays."""
    one = serve(**LATER)
    (marks,) = marked(1)
    one.answer(one.send(marks, one.open().mapper, 1))
    one.until(lambda: one.paged.all_durable, save_all=True)
    key = marks.chunks[0]
    gone = shm / one.paged.chunks[key].name[1:]
    one.paged.chunks[key].view.state["state"] = OUT_OF_SERVICE
    one.end(keep=True)
    left = sorted(shm.glob("*_*"))
    with monkeypatch.context() as patch:
        patch.setattr(ChunkMemory, "open", failing(errno.EMFILE))
        with pytest.raises(OSError, match="Too many open files"):
            serve(**LATER)
    assert sorted(shm.glob("*_*")) == left
    one = serve(**LATER)
    assert key not in one.paged.chunks
    assert not gone.exists()
    one.answer(one.send(marks, one.open().mapper, 1))
    assert one.voxels() == reference(marks)


def test_scans_of_a_place_that_is_known_take_no_memory(serve: Serve) -> None:
    """Each is gone when it is in its chunks and on the disk."""
    one = serve()
    (marks,) = marked(1)
    mapper, numbers = one.open().mapper, count(1)

    def after(scans: int) -> int:
        for number in islice(numbers, scans):
            one.answer(one.send(marks, mapper, number))
        one.until(lambda: one.paged.all_durable, save_all=True)
        one.answers.clear()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    after(4)
    before = after(30)
    more = after(30) - before
    tracemalloc.stop()
    assert more < 10 * (marks.bits.nbytes + marks.words.nbytes)


def test_who_may_not_map(serve: Serve) -> None:
    one = serve()
    for make in (
        lambda n: messages.LiveOpen(n, "lidar", "front"),
        lambda n: messages.LiveSave(n, "lidar"),
        lambda n: messages.LiveScan(n, "lidar", 1, 1, "1.1", 10, (0.0, 0.0, 0.0)),
    ):
        with pytest.raises(NotPermitted, match="may not change live maps"):
            one.ask(make, maps=False)
    one.ask(lambda n: messages.LiveOpen(n, "lidar"), maps=False)
    with pytest.raises(BadRequest, match="frame 'map', not 'odom'"):
        one.ask(lambda n: messages.LiveOpen(n, "lidar", "", "odom"))


@pytest.mark.parametrize("place", [(float("nan"), 0.0, 0.0), (0.0, float("inf"), 0.0), (0.0, 0.0, 1e12)])
def test_places_that_are_nowhere(serve: Serve, place: tuple[float, float, float]) -> None:
    one = serve()
    with pytest.raises(BadRequest, match="not finite, or too far away"):
        one.ask(lambda n: messages.LiveMove(n, "lidar", place))


# --- durable ------------------------------------------------------------------------------------


def test_what_a_previous_run_did_not_save_is_not_durable(serve: Serve) -> None:
    """Which scans a chunk found in memory has is unknown; its mapper may send none again."""
    one = serve(**LATER)
    (marks,) = marked(1)
    opened = one.open()
    assert one.answer(one.send(marks, opened.mapper, 1)).durable == 0
    one.end(keep=True)
    one = serve(**LATER)
    opened = one.open()
    first = opened.next_scan
    assert one.answer(one.send(NOTHING, opened.mapper, first)).durable == 0
    one.until(lambda: one.paged.all_durable, save_all=True)
    assert one.answer(one.send(NOTHING, opened.mapper, first + 1)).durable >= first


def test_saved_means_that_what_was_given_up_is_on_the_disk_too(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file has its name, and a power cut may take that away, until the directory was flushed."""
    one = serve(linger_s=0.0, checkpoint_s=1e9, most_active=1)
    (marks,) = marked(1)
    mapper = one.open().mapper
    blocked = Blocked(monkeypatch, one.paged.database, "flush")
    one.answer(one.send(marks, mapper, 1))
    one.ask(lambda n: messages.LiveMove(n, "lidar", (5e4, 0.0, 0.0)))
    one.until(lambda: blocked.calls and not set(marks.chunks) & set(one.paged.chunks))
    ticket = one.ask(lambda n: messages.LiveSave(n, "lidar"))
    for _ in range(5):
        one.turn()
    assert ticket not in one.answers
    blocked.may.set()
    assert one.answer(ticket).scan == 1
    assert one.map.status().durable == 1


def test_a_save_is_answered_when_all_that_came_before_is_durable(serve: Serve) -> None:
    one = serve(**LATER)
    first, second = marked(2)
    opened = one.open()
    one.answer(one.send(first, opened.mapper, 1))
    one.answer(one.send(second, opened.mapper, 2))
    reply = one.answer(one.ask(lambda n: messages.LiveSave(n, "lidar")))
    assert (reply.scan, reply.files) == (2, len(set(first.chunks) | set(second.chunks)))
    one.until(lambda: one.paged.all_durable)


# --- a disk that is full ------------------------------------------------------------------------


def test_a_disk_that_is_full_stops_no_mapper(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """What changed stays in memory, is reported, and saved when there is room; few tries meanwhile."""
    one = serve(linger_s=0.0, checkpoint_s=0.1)
    scans = marked(5)  # the last one is far away from the others
    mapper = one.open().mapper
    with monkeypatch.context() as patch:
        calls = fail(patch, one.paged.database, "save", errno.ENOSPC)
        for number, marks in enumerate(scans, 1):
            one.answer(one.send(marks, mapper, number))
        start_s = one.now_s
        for _ in range(50):
            one.turn()
            one.paged._threads.wait(0.01)
        assert len(calls) <= one.paged.limits.saves * (one.now_s - start_s + 2.0), (
            "a bounded number each second"
        )
        status = one.map.status()
        assert "cannot be saved: No space left" in status.problem
        assert one.voxels() == reference(*scans)
        assert status.dirty
        assert {key for marks in scans for key in marks.chunks} <= set(one.paged.chunks)
    one.until(lambda: one.paged.all_durable, save_all=True)
    assert one.map.status().problem == ""


def test_a_new_mapper_needs_the_disk(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    one = serve()
    with monkeypatch.context() as patch:
        fail(patch, one.paged.database, "_write_map", errno.ENOSPC)
        refused = one.answer(one.ask(lambda n: messages.LiveOpen(n, "lidar", "front")))
        assert (refused.code, "cannot be written: No space left" in refused.message) == (
            CannotWrite.code,
            True,
        )
    assert one.open().mapper == 2, "a number is never given twice, whatever came of it"


def test_a_directory_that_cannot_be_flushed_is_tried_again_later(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = serve(**LATER)
    (marks,) = marked(1)
    mapper = one.open().mapper
    one.answer(one.send(marks, mapper, 1))
    with monkeypatch.context() as patch:
        calls = fail(patch, one.paged.database, "flush", errno.EIO)
        ticket = one.ask(lambda n: messages.LiveSave(n, "lidar"))
        one.until(lambda: calls)
        start_s = one.now_s
        for _ in range(30):
            one.turn()
            one.paged._threads.wait(0.01)
        assert len(calls) <= 2 + (one.now_s - start_s), "once a second"
        assert "not flushed: Input/output" in one.map.status().problem
        assert ticket not in one.answers
    assert one.answer(ticket).scan == 1
    assert one.map.status().problem == ""


def test_the_record_is_written_once_a_minute(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """However often chunks change."""
    one = serve(**LATER)
    mapper = one.open().mapper
    times_s: list[float] = []
    monkeypatch.setattr(one.paged, "write_record", lambda _: times_s.append(one.now_s))
    scans = marked(10)
    for number, marks in enumerate(scans, 1):
        one.answer(one.send(marks, mapper, number))
        one.now_s += 20.0
        one.turn()
    assert len(times_s) > 1
    assert min(b - a for a, b in pairwise(times_s)) >= served_map.RECORD_S


def test_a_record_that_cannot_be_written_is_tried_again_later(
    serve: Serve, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """By itself, and one line of the log says so."""
    one = serve(**LATER)
    one.open()
    database = one.paged.database
    with monkeypatch.context() as patch:
        calls = fail(patch, database, "flush", errno.ENOSPC)
        database.record_is_due = True
        one.until(lambda: one.map.status().problem)
        start_s, before = one.now_s, len(calls)
        for _ in range(50):
            one.turn()
            one.paged._threads.wait(0.01)
        assert 2 <= len(calls) - before <= 2 + (one.now_s - start_s), "once a second"
        assert one.map.next_turn_s(one.now_s) <= one.now_s + 1.0
        assert one.map.status().problem == "its record cannot be written: No space left on device"
    one.until(lambda: not one.map.status().problem)
    assert not database.record_is_due
    assert caplog.text.count("its record cannot be written") == 1


# --- sleeping -----------------------------------------------------------------------------------


def test_while_a_chunk_is_loaded_nothing_turns(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    one = serve(**LATER)
    blocked = Blocked(monkeypatch, one.paged.database, "load")
    (marks,) = marked(1)
    one.send(marks, one.open().mapper, 1)
    for _ in range(3):
        one.turn()
        assert one.map.next_turn_s(one.now_s) >= one.now_s + 0.05
    blocked.may.set()
    one.until(lambda: one.map.status().scans)


def test_while_files_are_written_nothing_turns(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although more of them are due."""
    one = serve(linger_s=1e9, checkpoint_s=0.1, saves=1)
    blocked = Blocked(monkeypatch, one.paged.database, "save")
    (marks,) = marked(1)
    assert len(marks.chunks) > 2
    one.answer(one.send(marks, one.open().mapper, 1))
    for _ in range(3):
        one.turn()
    waiting = Deadline()
    while waiting(not blocked.calls):
        pass
    assert blocked.calls == 1
    assert one.map.next_turn_s(one.now_s) >= one.now_s + 0.05
    blocked.may.set()


def test_answers_wait_for_a_daemon_that_is_busy() -> None:
    """It reads nothing for a while, and the channel is full: no answer is lost."""
    ours, theirs = channel()
    buffer = packet_buffer()
    with ours, theirs:
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 0)  # the least there is
        worker = _Worker(theirs, worker_messages.Begin("test", (), "", "", 1 << 22, -1, -1))
        for ticket in range(MESSAGES_PER_TURN):
            message = messages.LiveList(ticket) if ticket % 2 else messages.LiveOpen(ticket, "x" * 60)
            ours.send(worker_messages.encode(worker_messages.Ask(ticket, 1, 0, True, encode(message))))
        receiving = threading.Thread(target=worker._receive)
        receiving.start()
        receiving.join(0.2)  # until it can send no more
        for ticket in range(MESSAGES_PER_TURN):
            answer = worker_messages.decode_from_live(receive_packet(ours, buffer)[0])
            assert isinstance(answer, worker_messages.Reply)
            assert answer.ticket == ticket
            assert isinstance(decode_reply(answer.body), ErrorReply) != bool(ticket % 2)
        receiving.join()
        os.close(worker._done)
