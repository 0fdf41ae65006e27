# SPDX-License-Identifier: Apache-2.0
"""Requests go to the worker and answers come back, whatever becomes of the worker and of the client."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import msgspec
import pytest

from shmmap import live_messages as messages
from shmmap.daemon import live_relay as relay
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.live_relay import (
    END_S,
    MAX_BYTES,
    MAX_UNSENT,
    PAUSES_S,
    REFUSED_PER_TURN,
    STABLE_S,
    START_END_S,
    LiveEvents,
    LiveRelay,
)
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.errors import BadRequest, Busy, ConfigError, LiveInterrupted
from shmmap.live_settings import LiveSettings
from shmmap.processes.start_child import channel, packet_buffer, receive_packet
from shmmap.protocol.codec import decode_reply
from shmmap.protocol.live import LiveList, LiveListed, LiveMove

if TYPE_CHECKING:
    from shmmap.statistics.writer import StatisticsWriter

BEGIN = messages.Begin("test", (LiveSettings("lidar"),), "/dev/shm", "/dev/shm/marks", 1 << 22, -1, -1)


class Asker:
    """A session, with what it was answered and refused."""

    def __init__(self, slot: int, asker: int = 0) -> None:
        self.slot = slot
        self.asker = asker or slot
        self.peer = SimpleNamespace(uid=1000, gid=1000, pid=slot)
        self.answered: list[bytes] = []
        self.refused: list[tuple[int, type[Exception]]] = []
        self.connection = self

    def reply(self, body: bytes) -> None:
        self.answered.append(body)

    def refuse(self, request: int, error: Exception) -> None:
        self.refused.append((request, type(error)))


class World:
    """A relay whose workers are sockets in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        self.workers: list[socket.socket] = []
        self.watched = WatchedDescriptors()
        self.buffer = packet_buffer()
        self.wait: Callable[[float], None] = self.pass_time
        monkeypatch.setattr(relay, "start_child", self._start)
        monkeypatch.setattr(relay, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        shown = SimpleNamespace(set=lambda *_: None, beat=lambda: None)
        events = LiveEvents(EventLog(1), cast("StatisticsWriter", shown))
        self.relay = LiveRelay(BEGIN, self.watched, lambda peer, _now_s: peer.pid != 2, events)
        monkeypatch.setattr(self.relay, "_wait", lambda seconds: self.wait(seconds))

    def pass_time(self, seconds: float) -> None:
        self.now_s += seconds

    def _start(self, *_: object, **__: object) -> tuple[Any, socket.socket]:
        ours, theirs = channel()
        theirs.setblocking(False)
        self.workers.append(theirs)
        return SimpleNamespace(kill=lambda: None, wait=lambda _seconds: 0), ours

    def started(self) -> None:
        """Another worker that has all maps in memory."""
        self.relay.start()
        assert isinstance(self.received()[0], messages.Begin)
        self.say(messages.Begun(1, 0))

    def received(self) -> list[Any]:
        """Messages that the worker received."""
        found: list[Any] = []
        while True:
            try:
                data, _ = receive_packet(self.workers[-1], self.buffer)
            except BlockingIOError:
                return found
            if not data:
                return found
            found.append(messages.decode_to_live(data))

    def say(self, message: messages.FromLive) -> None:
        self.workers[-1].send(messages.encode(message))
        self.relay.on_readable()

    def die(self) -> None:
        self.workers[-1].close()
        self.relay.on_readable()
        while self.relay.next_s <= self.now_s:
            self.relay.run_step(self.now_s)

    def ask(self, asker: Asker, request: int = 1) -> None:
        message = LiveMove(request, "lidar", (0.0, 0.0, 0.0))
        self.relay.ask(asker, message, b"%d" % request, self.now_s)  # type: ignore[arg-type]


@pytest.fixture
def starting(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """A relay that may have started workers, which have sent nothing yet."""
    one = World(monkeypatch)
    yield one
    one.relay._forget()
    for worker in one.workers:
        worker.close()
    one.watched.close()


@pytest.fixture
def world(starting: World) -> World:
    """A relay whose worker serves all maps."""
    starting.started()
    return starting


def test_each_gets_its_own_answer(world: World) -> None:
    a, b = Asker(1), Asker(2)
    world.ask(a, 11)
    world.ask(b, 22)
    first, second = world.received()
    assert (first.session, first.uid, first.maps, first.body) == (1, 1000, True, b"11")
    assert (second.session, second.maps) == (2, False), "that one may not map"
    world.say(messages.Reply(second.ticket, b"for b"))
    world.say(messages.Reply(first.ticket, b"for a"))
    world.say(messages.Reply(first.ticket, b"again"))
    world.say(messages.Reply(999, b"for no client"))
    assert (a.answered, b.answered) == ([b"for a"], [b"for b"])
    assert len(world.relay._tickets) == 0


def test_a_session_that_has_ended_is_answered_nothing(world: World) -> None:
    a, silent = Asker(1), Asker(3)
    world.ask(a)
    (asked,) = world.received()
    world.relay.on_disconnect(a)  # type: ignore[arg-type]
    world.relay.on_disconnect(silent)  # type: ignore[arg-type]
    assert world.received() == [messages.Disconnected(1)], (
        "of one that asked for nothing the worker knows nothing"
    )
    world.say(messages.Reply(asked.ticket, b"x"))
    assert a.answered == []
    assert (len(world.relay._tickets), world.relay._known_sessions) == (0, set())


def test_a_request_that_is_too_long(world: World) -> None:
    message, asker = LiveMove(1, "lidar", (0.0, 0.0, 0.0)), Asker(1)
    with pytest.raises(BadRequest, match="at most"):
        world.relay.ask(asker, message, bytes(MAX_BYTES + 1), 0.0)  # type: ignore[arg-type]
    assert world.received() == []


def test_a_worker_that_reads_nothing_costs_little(world: World) -> None:
    """Sessions come, ask as much as they may, and go: what is kept for the worker is bounded."""

    def come_ask_and_go() -> None:
        for slot in range(1, 10_000):
            asker = Asker(slot)
            for number in range(8):
                world.ask(asker, number)
            world.relay.on_disconnect(asker)  # type: ignore[arg-type]

    with pytest.raises(Busy, match="does not answer"):
        come_ask_and_go()
    assert len(world.relay._unsent) <= MAX_UNSENT + 1
    asked = 0
    while world.relay._unsent:
        asked += len(world.received())
        world.relay.on_readable()
    asked += len(world.received())
    assert asked > MAX_UNSENT, "what was taken is passed on when it reads again"
    world.ask(Asker(5))


def test_requests_are_refused_when_the_worker_dies(world: World) -> None:
    a, b = Asker(1), Asker(2)
    world.ask(a, 11)
    world.ask(b, 22)
    world.die()
    assert a.refused == [(11, LiveInterrupted)]
    assert b.refused == [(22, LiveInterrupted)]
    assert world.relay.restarts == 1
    with pytest.raises(LiveInterrupted):
        world.ask(a)
    world.relay.on_disconnect(a)  # type: ignore[arg-type]
    world.started()
    world.ask(b, 23)
    assert [message.body for message in world.received()] == [b"23"]


def test_one_that_dies_repeatedly_is_not_started_all_the_time(world: World) -> None:
    """The first time at once; then there are pauses, also where it dies just after it began."""
    world.now_s += STABLE_S
    for number, pause_s in enumerate([*PAUSES_S, PAUSES_S[-1]]):
        world.die()
        if pause_s:
            world.relay.beat(world.now_s + pause_s - 0.01)
            assert len(world.workers) == number + 1
        world.now_s += pause_s
        world.relay.beat(world.now_s)
        assert len(world.workers) == number + 2
        if number % 2:
            world.say(messages.Begun(1, 0))
    world.say(messages.Begun(1, 0))
    world.now_s += STABLE_S
    world.die()
    world.relay.beat(world.now_s)
    assert len(world.workers) == len(PAUSES_S) + 3, "it had been in order"


@pytest.mark.parametrize("alone", [True, False])
def test_settings_refuse_the_start_where_there_is_nothing_else_to_serve(
    starting: World, *, alone: bool
) -> None:
    starting.relay.start()
    starting.workers[-1].send(
        messages.encode(messages.Begun(0, 0, "bad_config", "resolution = 0.5", "leave it"))
    )
    if not alone:
        starting.relay.wait_until_serving(60.0, alone=False)
        return
    with pytest.raises(ConfigError, match=r"resolution = 0\.5"):
        starting.relay.wait_until_serving(60.0, alone=True)


def test_a_worker_that_says_nothing_keeps_no_client_waiting(starting: World) -> None:
    """Points are served; each map is shown with the problem, and clients are asked to come again."""
    starting.relay.start()
    starting.relay.wait_until_serving(2.0, alone=False)
    asker = Asker(1)
    with pytest.raises(LiveInterrupted, match="is being started"):
        starting.ask(asker)
    starting.relay.ask(asker, LiveList(7), b"", 0.0)  # type: ignore[arg-type]
    (listed,) = asker.answered
    reply = decode_reply(listed)
    assert isinstance(reply, LiveListed)
    assert [(row.name, "is being started" in row.problem) for row in reply.maps] == [("lidar", True)]
    starting.say(messages.Begun(1, 0))
    starting.ask(asker)


def test_workers_that_die_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not what points wait for."""
    world = World(monkeypatch)
    start = world._start

    def dead(*_: object, **__: object) -> tuple[Any, socket.socket]:
        found = start()
        world.workers[-1].close()
        return found

    monkeypatch.setattr(relay, "start_child", dead)
    world.relay.start()
    world.relay.wait_until_serving(60.0, alone=False)
    assert len(world.workers) == relay.STARTS + 1
    with pytest.raises(LiveInterrupted):
        world.ask(Asker(1))
    world.watched.close()


@pytest.mark.parametrize("unsaved", [0, 3])
def test_the_end(world: World, caplog: pytest.LogCaptureFixture, unsaved: int) -> None:
    left = (messages.Unsaved("lidar", 3, "not saved: No space left on device"),) if unsaved else ()
    world.workers[-1].send(messages.encode(messages.Ended(left)))
    world.workers[-1].shutdown(socket.SHUT_WR)
    world.relay.close(keep=False)
    assert world.received() == [messages.End(False)]
    assert ("stay in memory for the next start map=lidar chunks=3" in caplog.text) == (unsaved > 0)
    assert ("No space left" in caplog.text) == (unsaved > 0)
    assert world.relay.unsaved == ({"lidar": 3} if unsaved else {})
    world.relay.close(keep=False)


def test_a_worker_that_does_not_end(world: World) -> None:
    """It is ended; what it had not saved by its last word counts as not saved."""
    row = msgspec.structs.replace(messages.not_served(BEGIN.maps[0], 1, ""), dirty=4, saving=1)
    world.say(messages.Status((row,)))
    world.relay.close(keep=False)
    assert world.relay.unsaved == {"lidar": 5}


@pytest.mark.parametrize("dies", [False, True], ids=["hangs", "dies"])
def test_memory_stays_where_no_worker_starts_to_save_it(
    world: World, caplog: pytest.LogCaptureFixture, dies: bool
) -> None:
    world.die()

    def wait(seconds: float) -> None:
        if dies:
            world.workers[-1].close()
        world.pass_time(seconds)

    world.wait = wait
    begin_s = world.now_s
    world.relay.close(keep=False)
    assert len(world.workers) == 2
    assert world.now_s <= begin_s + END_S + START_END_S
    assert "does not start: what is in memory stays" in caplog.text


def test_memory_that_is_kept_needs_no_worker(world: World) -> None:
    world.die()
    world.relay.close(keep=True)
    assert len(world.workers) == 1


def test_a_turn_of_the_loop_takes_a_bounded_number_of_messages(world: World) -> None:
    """Whatever the worker has to say, clients are served in between."""
    askers = [Asker(slot) for slot in range(1, relay.MESSAGES_PER_TURN + 4)]
    for asker in askers:
        world.ask(asker)
    for asked in world.received():
        world.workers[0].send(messages.encode(messages.Reply(asked.ticket, b"x")))
    for most in (relay.MESSAGES_PER_TURN, len(askers)):
        world.relay.on_readable()
        assert sum(len(asker.answered) for asker in askers) == most


def test_very_many_that_wait_are_refused_some_at_a_time(world: World) -> None:
    askers = [Asker(slot) for slot in range(1, 11)]
    for asker in askers:
        for number in range(20):
            world.ask(asker, number)
    world.workers[-1].close()
    world.relay.on_readable()
    world.relay.on_disconnect(askers[0])  # type: ignore[arg-type]
    turns = 0
    while world.relay.next_s <= world.now_s:
        before = sum(len(asker.refused) for asker in askers)
        world.relay.run_step(world.now_s)
        assert sum(len(asker.refused) for asker in askers) - before <= REFUSED_PER_TURN
        turns += 1
    assert turns == 3
    assert [len(asker.refused) for asker in askers] == [0] + [20] * 9


def test_waiting_requests_are_bounded_by_session_by_process_and_in_all(world: World) -> None:
    asked: list[Any] = []

    def ask(*askers: Asker, most: int = messages.MAX_PER_SESSION) -> None:
        for asker in askers:
            for number in range(most):
                world.ask(asker, number)
                asked.extend(world.received())

    one = Asker(1)
    ask(one)
    with pytest.raises(Busy, match="64 requests of this session"):
        ask(one)
    world.say(messages.Reply(asked[0].ticket, b"x"))
    ask(one, most=1)
    with pytest.raises(Busy, match="64 requests of this session"):
        ask(one)
    with pytest.raises(Busy, match="256 requests of this process"):
        ask(*(Asker(slot, asker=7) for slot in range(2, 12)))
    ask(Asker(100, asker=8))
    with pytest.raises(Busy, match="4096 requests of all sessions"):
        ask(*(Asker(slot) for slot in range(200, 300)))
