# SPDX-License-Identifier: Apache-2.0
"""Loads that fail, loaders that lose their mind, descriptors that run out."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from shmmap.daemon import turns
from shmmap.daemon.loading import lost_workers, worker_messages
from shmmap.daemon.loading.worker_pool import Worker
from shmmap.daemon.records import Key
from shmmap.layers.sources import CellJob, Neighbour
from shmmap.layers.spec import layer_spec
from shmmap.layers.versions import MAX_NEIGHBOURS
from shmmap.processes.start_child import MAX_PACKET_BYTES, channel
from shmmap.protocol.messages import Area, CircleMessage, Selected
from shmmap.segment.layout import SourceStamp
from shmmap.segment.version import Source
from tests.support.daemon_process import wait_readable
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon


class Puppet:
    """A loader whose part the test plays: a process that only sleeps, and the other end of its channel."""

    def __init__(self, one: InnerDaemon) -> None:
        self.one = one
        ours, self.channel = channel()
        ours.setblocking(False)
        self.process = subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"])
        pid = self.process.pid
        self.worker = Worker(ours, pid=pid, pidfd=os.pidfd_open(pid))
        one.pool._workers[self.worker.fd] = self.worker
        one.pool.watched.watch(self.worker.fd, lambda: one.pool.on_message(self.worker))

    def queue(self, count: int) -> list[worker_messages.Job]:
        """Run the daemon until it has handed out this many jobs."""
        self.one.run_until(lambda: len(self.worker.queue) == count)
        return [job for job in self.worker.queue.values() if isinstance(job, worker_messages.Job)]

    def received(self) -> object:
        """The next message but those that name the directory that the map is read through."""
        while True:
            message = worker_messages.decode_to_worker(self.channel.recv(65536))
            if not isinstance(message, worker_messages.Root):
                return message

    def say(self, message: object) -> None:
        self.channel.send(worker_messages.encode(message))

    def done(self, job: worker_messages.Job) -> worker_messages.Done:
        """Return the loader's reply to a job, whose file is filled."""
        if job.number in self.worker.segments:
            os.posix_fallocate(self.worker.segments[job.number], 0, 4096)
        state = SourceStamp.of(os.stat(job.source.name))
        version = CellJob(job.cell_id, job.source, job.box).version(layer_spec(job.layer), state, ())
        return worker_messages.Done(job.number, 4096, 1, 0, 0.0, 1.0, version, state.token, 1)


@pytest.fixture
def puppet(inner: Inner, small_map: DividedMap) -> Iterator[Puppet]:
    one = Puppet(inner(small_map.root))
    yield one
    one.process.kill()
    one.process.wait()
    one.channel.close()


def ask(one: InnerDaemon, request: int) -> None:
    one.ask(one.session(), Area(request, CircleMessage(0, 0, 5), wait=30.0))


@pytest.mark.parametrize(
    "nonsense", [b"\xc1", b"\x91\xa4what", b"\x90", b"\xff" * 1000, b"\x92\xa4done\xc0", b"\x91\xc4\x01x"]
)
def test_a_loader_that_sends_nonsense_is_ended(puppet: Puppet, nonsense: bytes) -> None:
    """A file may have corrupted the loader's memory: it costs the cell it was at."""
    one = puppet.one
    ask(one, 1)
    first = puppet.queue(4)[0]
    puppet.channel.send(nonsense)
    reply = one.cells_of(1)
    assert puppet.process.wait() == -signal.SIGKILL
    assert [failure.code for failure in reply.failed] == ["load_failed"]
    assert first.source.name in reply.failed[0].message
    assert len(reply.cells) == 3
    assert one.ledger.reserved_bytes == 0


def test_what_a_dead_loader_had_finished_counts(puppet: Puppet) -> None:
    """It dies with jobs unread: the kernel reports that before what it said last."""
    one = puppet.one
    ask(one, 1)
    first, second = puppet.queue(4)[:2]
    puppet.say(puppet.done(first))
    puppet.process.kill()
    puppet.say(worker_messages.Ended(-9))
    puppet.channel.close()
    reply = one.cells_of(1)
    (failure,) = reply.failed
    assert second.source.name in failure.message, "the second is what it died of"
    assert one.cache.wire_id(first.cell_id) in [cell.id for cell in reply.cells]
    assert len(reply.cells) == 3


def test_what_a_loader_has_said_is_handled_in_order_in_one_step(
    puppet: Puppet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its death, the last of it, is blamed on the job that it began last."""
    monkeypatch.setattr(turns, "STEP_S", 60.0)
    one = puppet.one
    puppet.worker.fetches = True
    ask(one, 1)
    first, second = puppet.queue(4)[:2]
    puppet.process.kill()
    for message in (
        worker_messages.Begun(first.number),
        puppet.done(first),
        worker_messages.Begun(second.number),
    ):
        puppet.say(message)
    puppet.say(worker_messages.Ended(-11))
    one.pool.on_message(puppet.worker)
    assert puppet.worker not in list(one.pool)
    assert [resident.key.cell_id for resident in one.ledger.segments.walk()] == [first.cell_id]
    reply = one.cells_of(1)
    (failure,) = reply.failed
    assert second.source.name in failure.message
    assert len(reply.cells) == 3


@pytest.mark.parametrize("begun", [False, True])
def test_of_a_loader_that_fetches_only_the_job_that_it_works_on_is_to_blame(
    puppet: Puppet, begun: bool
) -> None:
    one = puppet.one
    puppet.worker.fetches = True
    ask(one, 1)
    jobs = puppet.queue(4)
    if begun:
        puppet.say(worker_messages.Begun(jobs[2].number))
    puppet.process.kill()
    puppet.say(worker_messages.Ended(-11))
    puppet.channel.close()
    reply = one.cells_of(1)  # the others are loaded by another one
    assert len(reply.cells) == 4 - begun
    assert [jobs[2].source.name in failure.message for failure in reply.failed] == [True] * begun
    assert one.ledger.reserved_bytes == 0


def test_a_loader_that_fetches_and_says_nothing_is_replaced(puppet: Puppet) -> None:
    """No cell is to blame: all are loaded by another one."""
    one = puppet.one
    one.stop_clock()
    puppet.worker.fetches = True
    ask(one, 1)
    first = puppet.queue(4)[0]
    one.offset_s += 29.0
    puppet.say(worker_messages.Begun(first.number))
    one.run_until(lambda: puppet.worker.at_work == first.number)
    puppet.say(puppet.done(first))
    one.run_until(lambda: not puppet.worker.at_work)
    one.pool.deadline_s = 10.0
    one.offset_s += 11.0
    one.run_until(lambda: puppet.worker not in list(one.pool))
    one.pool.deadline_s = 300.0
    assert puppet.process.wait() == -signal.SIGKILL
    one.ask(one.session(), Area(2, CircleMessage(0, 0, 5), wait=30.0))
    assert (len(one.cells_of(2).cells), one.cells_of(2).failed) == (4, ())


def test_a_load_that_took_too_long_is_not_tried_again_at_once(puppet: Puppet) -> None:
    """Nor does a loader look at its file: the file system may be what hangs."""
    one = puppet.one
    one.stop_clock()
    session = one.session()
    one.ask(session, Selected(1, ("0_0.pcd",), wait=900.0))
    puppet.queue(1)
    one.offset_s += 301.0
    for request in (1, 2):
        assert [
            failure.code
            for failure in one.cells_for(Selected(request, ("0_0.pcd",), wait=900.0), session).failed
        ] == ["load_timeout"]
        assert not one.loads.by_key
    one.offset_s += 1.01
    assert len(one.cells_for(Selected(3, ("0_0.pcd",), wait=900.0), session).cells) == 1


def test_a_loader_that_cannot_be_killed(puppet: Puppet, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop goes on without it, and starts no other in its place until it has ended.

    It waits in the kernel for a disk that never answers.
    """
    one = puppet.one
    sent: list[tuple[int, int]] = []
    monkeypatch.setattr(signal, "pidfd_send_signal", lambda *what: sent.append(what))
    session = one.session()
    one.ask(session, Selected(1, ("0_0.pcd",), wait=900.0))
    puppet.queue(1)
    one.offset_s += 301.0
    assert [failure.code for failure in one.cells_of(1).failed] == ["load_timeout"]
    assert [number for _, number in sent] == [signal.SIGKILL]
    assert not one.pool.has_room(computed=False)
    puppet.process.kill()
    assert len(one.cells_for(Selected(2, ("20_20.pcd",), wait=900.0), session).cells) == 1
    puppet.process.wait()


def test_the_longest_job_there_is(puppet: Puppet) -> None:
    """All neighbours that a layer may look at, on the longest paths that a file system has."""
    path = "/" + "p" * 4094
    job = worker_messages.Job(
        1,
        path,
        Source(path),
        "denoise",
        (0.0,) * 4,
        "map",
        1 << 20,
        "",
        (Neighbour(Source(path), (0.1,) * 4),) * (MAX_NEIGHBOURS + 1),
    )
    assert puppet.one.pool.submit(job, 0.0)
    assert worker_messages.decode_to_worker(puppet.channel.recv(MAX_PACKET_BYTES)) == job


@pytest.mark.parametrize(
    ("number", "kills", "said"),
    [
        (signal.SIGKILL, 0, "the loader was killed (signal SIGKILL): by a person or a program"),
        (
            signal.SIGKILL,
            1,
            "out of memory: the kernel killed the loader (the control group allows 300 MiB)",
        ),
        (39, 0, "signal 39"),
    ],
)
def test_a_loader_that_is_killed(
    puppet: Puppet, monkeypatch: pytest.MonkeyPatch, number: int, kills: int, said: str
) -> None:
    """If the kernel has killed for lack of memory, the file is not to blame: it need not change."""
    one = puppet.one
    monkeypatch.setattr(lost_workers, "out_of_memory_kills", lambda: one.scheduler.lost.oom_kills + kills)
    monkeypatch.setattr(lost_workers, "memory_limit_bytes", lambda: 300 << 20)
    ask(one, 1)
    job = puppet.queue(4)[0]
    puppet.say(worker_messages.Ended(-number))
    (failed,) = one.cells_of(1).failed
    assert failed.code == "load_failed"
    assert failed.message.startswith(f"{job.source.name}: ")
    assert said in failed.message
    (failure,) = one.scheduler.loads.failures.values()
    assert (failure.stamp is None) is bool(kills)


def test_done_without_a_segment(puppet: Puppet) -> None:
    """The job had no file to fill: the load fails, nothing stays reserved for it."""
    one = puppet.one
    one.ask(one.session(), Selected(1, ("0_0.pcd",), wait=30.0))
    (job,) = puppet.queue(1)
    os.close(puppet.worker.segments.pop(job.number))
    puppet.say(puppet.done(job))
    assert [failure.code for failure in one.cells_of(1).failed] == ["load_failed"]
    assert one.ledger.reserved_bytes == 0
    assert Key(job.cell_id, "points") not in one.loads.by_key


def test_answers_that_no_question_asked_for(puppet: Puppet) -> None:
    """Numbers that were never given, needs of nothing: no harm."""
    one = puppet.one
    ask(one, 1)
    queue = puppet.queue(4)
    puppet.say(worker_messages.Failed(12345, "load_failed", "no such job"))
    puppet.say(worker_messages.Need(12346, 1 << 20))
    puppet.say(worker_messages.Need(queue[0].number, -5))
    for job in queue:
        puppet.say(puppet.done(job))
    assert len(one.cells_of(1).cells) == 4
    *jobs, decision = (puppet.received() for _ in range(5))
    assert jobs == queue
    assert decision == worker_messages.Decision(True), "and none of a job that does not exist"
    assert not wait_readable([puppet.channel.fileno()], 0.0)
    assert (one.ledger.reserved_bytes, one.scheduler.room.awaiting_grant) == (0, {})


def test_more_needed_than_there_will_ever_be(puppet: Puppet) -> None:
    one = puppet.one
    one.ask(one.session(), Selected(1, ("0_0.pcd",), wait=30.0))
    (job,) = puppet.queue(1)
    assert puppet.received() == job
    puppet.say(worker_messages.Need(job.number, one.ledger.budget_bytes))
    one.run_until(lambda: wait_readable([puppet.channel.fileno()], 0.0))
    assert puppet.received() == worker_messages.Decision(False)
    puppet.say(worker_messages.Failed(job.number, "over_budget", "it does not fit"))
    assert [failure.code for failure in one.cells_of(1).failed] == ["over_budget"]
