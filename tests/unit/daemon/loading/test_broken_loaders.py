# SPDX-License-Identifier: Apache-2.0
"""Loads that fail, loaders that lose their mind, descriptors that run out."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.loading import lost_workers, worker_messages
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.loading.worker_pool import Worker
from shmmap.daemon.records import Failure, Key
from shmmap.layers.sources import CellJob, Neighbour
from shmmap.layers.spec import layer_spec
from shmmap.layers.versions import MAX_NEIGHBOURS
from shmmap.processes.start_child import MAX_PACKET_BYTES, channel
from shmmap.protocol.messages import Area, CircleMessage, Selected
from shmmap.segment.layout import SourceStamp
from shmmap.segment.version import Source
from tests.support.daemon_process import wait_readable
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner, InnerDaemon


def test_a_bad_file_is_tried_again_later_and_later(inner: Inner, small_map: DividedMap) -> None:
    """After 1, 2, 4, ... and at most 30 seconds, however often somebody asks; at once when it changed."""
    path = small_map.pcd_dir / "0_0.pcd"
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    one = inner(small_map.root)
    session, request = one.session(), 0
    one.stop_clock()

    def tries() -> int:
        nonlocal request
        before = one.statistics.values["loads_started"]
        for _ in range(3):
            request += 1
            one.ask(session, Selected(request, ("0_0.pcd",), wait=30.0))
            assert [failure.code for failure in one.cells_of(request).failed] == ["load_failed"]
        return one.statistics.values["loads_started"] - before

    assert tries() == 1
    for delay_s in (1, 2, 4, 8, 16, 30, 30):
        one.offset_s += delay_s - 0.01
        assert tries() == 0
        one.offset_s += 0.02
        assert tries() == 1
    path.write_bytes(whole)
    one.ask(session, Selected(999, ("0_0.pcd",), wait=30.0))
    assert len(one.cells_of(999).cells) == 1


def test_a_file_that_kills_its_loader_is_tried_again_later_and_later(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each try costs a loader: that somebody asks again is no reason for another one."""
    monkeypatch.setenv("SHMMAP_TEST_WORKER", "crash:0_0.pcd")
    one = inner(small_map.root)
    session = one.session()
    one.stop_clock()
    for request, (passed_s, crashes) in enumerate([(0.0, 1), (0.99, 1), (0.02, 2), (1.98, 2), (0.03, 3)]):
        one.offset_s += passed_s
        one.ask(session, Selected(request, ("0_0.pcd",), wait=30.0))
        assert [failure.code for failure in one.cells_of(request).failed] == ["load_failed"]
        assert one.statistics.values["worker_crashes"] == crashes
    path = small_map.pcd_dir / "0_0.pcd"
    path.write_bytes(path.read_bytes())
    one.ask(session, Selected(99, ("0_0.pcd",), wait=30.0))
    one.cells_of(99)
    assert one.statistics.values["worker_crashes"] == 4, "another state of the file is tried at once"


def test_failures_are_remembered_up_to_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last ones of each kind; of those forgotten nothing stays."""
    monkeypatch.setattr("shmmap.daemon.loading.loads.MAX_FAILURES", 3)
    loads = Loads(Ledger(1 << 20))

    def fail(number: int, code: str) -> Key:
        key = Key(f"/{number}.pcd", "points")
        load = loads.want(key, 0, 1.0)
        assert loads.start(load, 0.0)
        loads.finish(load, Failure(code, "", None, 0.0, 0.0))
        return key

    broken = [fail(number, "load_failed") for number in (0, 1, 2, 0, 3, 4)]
    full = [fail(number, "no_space") for number in (5, 6)]
    assert set(loads.failures) == {broken[0], broken[4], broken[5], *full}
    loads.forget_refusals()
    assert set(loads.failures) == {broken[0], broken[4], broken[5]}
    assert not loads.by_key


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

    def told(self) -> object:
        """The next message but those that name the directory that the map is read through."""
        while True:
            message = worker_messages.decode_to_worker(self.channel.recv(65536))
            if not isinstance(message, worker_messages.Root):
                return message

    def say(self, message: object) -> None:
        self.channel.send(worker_messages.encode(message))

    def done(self, job: worker_messages.Job) -> worker_messages.Done:
        """What to say of a job, whose file is filled."""
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
    """A file may have had its way with the loader's memory: it costs the cell it was at."""
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
    puppet.channel.close()


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
    session = one.session()
    one.ask(session, Area(2, CircleMessage(0, 0, 5), wait=30.0))
    assert (len(one.cells_of(2).cells), one.cells_of(2).failed) == (4, ())
    puppet.channel.close()


def test_a_load_that_took_too_long_is_not_tried_again_at_once(puppet: Puppet) -> None:
    """Nor does a loader look at its file: the file system may be what hangs."""
    one = puppet.one
    one.stop_clock()
    session = one.session()
    one.ask(session, Selected(1, ("0_0.pcd",), wait=900.0))
    puppet.queue(1)
    one.offset_s += 301.0
    for request in (1, 2):
        one.ask(session, Selected(request, ("0_0.pcd",), wait=900.0))
        assert [failure.code for failure in one.cells_of(request).failed] == ["load_timeout"]
        assert not one.loads.by_key
    one.offset_s += 1.01
    one.ask(session, Selected(3, ("0_0.pcd",), wait=900.0))
    assert len(one.cells_of(3).cells) == 1
    puppet.channel.close()


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
    one.ask(session, Selected(2, ("20_20.pcd",), wait=900.0))
    assert len(one.cells_of(2).cells) == 1
    puppet.process.wait()
    puppet.channel.close()


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
    puppet.channel.close()


def test_a_signal_without_a_name(puppet: Puppet) -> None:
    one = puppet.one
    ask(one, 1)
    puppet.queue(4)
    puppet.say(worker_messages.Ended(-39))
    puppet.channel.close()
    assert ["signal 39" in failure.message for failure in one.cells_of(1).failed] == [True]


@pytest.mark.parametrize("kills", [0, 1])
def test_a_loader_that_is_killed(puppet: Puppet, monkeypatch: pytest.MonkeyPatch, kills: int) -> None:
    """If the kernel has killed for lack of memory, the file is not to blame: it need not change."""
    one = puppet.one
    monkeypatch.setattr(lost_workers, "out_of_memory_kills", lambda: one.scheduler.lost.oom_kills + kills)
    monkeypatch.setattr(lost_workers, "memory_limit_bytes", lambda: 300 << 20)
    ask(one, 1)
    job = puppet.queue(4)[0]
    puppet.say(worker_messages.Ended(-signal.SIGKILL))
    (failed,) = one.cells_of(1).failed
    assert failed.code == "load_failed"
    allowed = "out of memory: the kernel killed the loader (the control group allows 300 MiB)"
    told = allowed if kills else "the loader was killed (signal SIGKILL): by a person or a program"
    assert failed.message == f"{job.source.name}: {told}"
    (failure,) = one.scheduler.loads.failures.values()
    assert (failure.stamp is None) is bool(kills)
    puppet.channel.close()


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
    puppet.channel.close()


def test_answers_to_nobody_s_question(puppet: Puppet) -> None:
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
    *jobs, decision = (puppet.told() for _ in range(5))
    assert jobs == queue
    assert decision == worker_messages.Decision(True), "and none of a job that nobody has"
    assert not wait_readable([puppet.channel.fileno()], 0.0)
    assert (one.ledger.reserved_bytes, one.scheduler.room.awaiting_grant) == (0, {})
    puppet.channel.close()


def test_more_needed_than_there_will_ever_be(puppet: Puppet) -> None:
    one = puppet.one
    one.ask(one.session(), Selected(1, ("0_0.pcd",), wait=30.0))
    (job,) = puppet.queue(1)
    assert puppet.told() == job
    puppet.say(worker_messages.Need(job.number, one.ledger.budget_bytes))
    one.run_until(lambda: wait_readable([puppet.channel.fileno()], 0.0))
    assert puppet.told() == worker_messages.Decision(False)
    puppet.say(worker_messages.Failed(job.number, "over_budget", "it does not fit"))
    assert [failure.code for failure in one.cells_of(1).failed] == ["over_budget"]
    puppet.channel.close()


def test_no_descriptors_left(inner: Inner, small_map: DividedMap) -> None:
    """What cannot be looked at is taken for pinned."""
    one = inner(small_map.root)
    one.ask(one.session(), Area(1, EVERYWHERE, wait=30.0))
    assert len(one.cells_of(1).cells) == 16
    for resident in list(one.ledger.residents()):
        one.reclaimer.retire(resident, one.now_s())
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.dup(0)
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, limits[1]))
    try:
        one.offset_s += 5.0
        one.turn()
        assert len(one.ledger.retired) == 16, "freed without a look"
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    one.offset_s += 5.0
    one.run_until(lambda: not one.ledger.retired)
