# SPDX-License-Identifier: Apache-2.0
"""The event stream: everything that happens is published, in order, and nothing is missed unnoticed."""

from __future__ import annotations

import os
import stat
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from shmmap import BadRequest
from shmmap.client import event_stream
from shmmap.events import EventStream, MissedEvents
from shmmap.protocol import events as e
from tests.process.conftest import DaemonFactory
from tests.support.cpp_client import CppEventStream
from tests.support.daemon_process import DaemonProcess, LineProcess, stop
from tests.support.divided_map import DividedMap
from tests.support.message_pack import unpack
from tests.support.raw_client import RawClient

Connect = Callable[..., RawClient]
Listen = Callable[..., Any]


@pytest.fixture(params=["python", pytest.param("c++", marks=pytest.mark.slow)])
def listen(daemon: DaemonFactory, request: pytest.FixtureRequest) -> Iterator[Listen]:
    """Open event streams, in Python and in C++, closed before the daemon is judged."""
    opened: list[Any] = []
    make: Callable[..., Any] = EventStream
    if request.param == "c++":
        make = partial(CppEventStream, request.getfixturevalue("cpp_program"))

    def factory(to: DaemonProcess, **options: Any) -> Any:
        stream = make(to.endpoint, timeout=30.0, **options)
        opened.append(stream)
        return stream

    yield factory
    for stream in opened:
        stream.close()


def until(stream: Any, last: Callable[[Any], bool]) -> list[Any]:
    """Take events up to the one that ``last`` says yes to."""
    found: list[Any] = []
    while not found or not last(found[-1]):
        happening = stream.next(60.0)
        assert happening is not None, f"nothing after {found}"
        found.append(happening)
    return found


def kinds(found: list[Any]) -> list[str]:
    return [type(happening).__name__.lower() for happening in found]


def test_events_come_in_order(
    served: DaemonProcess, connect: Connect, listen: Listen, divided_map: DividedMap
) -> None:
    stream = listen(served, since=60)
    client = connect(served, name="driver")
    loaded = client.selected(["0_0.pcd"]).cells[0]
    divided_map.change("0_0.pcd", 5)
    divided_map.remove_cell("20_20.pcd")
    divided_map.write_metadata()
    client.ask("reload")
    (divided_map.pcd_dir / "0_-20.pcd").write_bytes(b"this is no point cloud")
    client.selected(["0_-20.pcd"])
    newer = client.selected(["0_0.pcd"]).cells[0]
    client.ask("evict", ["0_0.pcd"])
    client.socket.send(bytes.fromhex("92a36279650b"))  # bye
    everything = until(stream, lambda h: isinstance(h, e.Left))
    assert [h.seq for h in everything] == list(range(1, len(everything) + 1))
    found = [h for h in everything if not isinstance(h, e.LongTurn)]  # a busy machine's
    assert kinds(found) == [
        "epoch", "joined", "joined", "loaded", "reloaded", "changed", "changed", "failed",
        "loaded", "evicted", "left",
    ]  # fmt: skip
    started, _, joined, first, reloaded, changed, removed, failed, second, evicted, left = found
    assert (started.what, started.cells, started.adopted) == ("started", 36, 0)
    assert (joined.pid, joined.client, left.client) == (os.getpid(), "driver", "driver")
    assert (first.id, first.version, first.points) == ("0_0.pcd", loaded.version, 500)
    assert (reloaded.changed, reloaded.removed, reloaded.listed, reloaded.error) == (1, 1, 2, "")
    assert (changed.id, changed.version, changed.how) == ("0_0.pcd", newer.version, "changed")
    assert (removed.id, removed.version, removed.how) == ("20_20.pcd", 0, "removed")
    assert (failed.id, failed.code) == ("0_-20.pcd", "load_failed")
    assert (second.version, second.replaces, second.again) == (newer.version, loaded.version, False)
    assert (evicted.version, evicted.why) == (newer.version, "request")
    assert {h.epoch for h in found} == {client.epoch} == {stream.epoch}


def test_what_happened_before_is_left_out(
    served: DaemonProcess, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock is put in place of this process's, by which ten seconds ago was just before the cell came."""
    with EventStream(served.endpoint, timeout=30.0, since=60.0) as all_of_it:
        connect(served, name="driver").selected(["0_0.pcd"])
        *_, joined, loaded = until(all_of_it, lambda h: isinstance(h, e.Loaded))
    between_s = (joined.unix_ns + loaded.unix_ns) * 0.5e-9
    clock = SimpleNamespace(time=lambda: between_s + 10.0, monotonic=time.monotonic)
    monkeypatch.setattr(event_stream, "time", clock)
    with EventStream(served.endpoint, timeout=30.0, since=10.0) as stream:
        assert stream.next(30.0) == loaded


@pytest.mark.parametrize(("quota", "code"), [("0.9", "quota"), ("4M", "over_budget")])
def test_retries_and_pressure(
    daemon: DaemonFactory, connect: Connect, listen: Listen, divided_map: DividedMap, quota: str, code: str
) -> None:
    one = daemon(divided_map.root, "--budget", "1M", environment={"SHMMAP_SESSION_QUOTA": quota})
    client, stream = connect(one), listen(one)
    (divided_map.pcd_dir / "0_0.pcd").write_bytes(b"this is no point cloud")
    client.selected(["0_0.pcd"])
    divided_map.change("0_0.pcd", 5)
    client.selected(["0_0.pcd"])
    found = until(stream, lambda h: isinstance(h, e.Loaded))
    assert kinds(found)[-4:] == ["failed", "retried", "changed", "loaded"]
    divided_map.change("0_0.pcd", 6, 80_000)  # larger than the budget
    client.ask("reload")
    client.selected(["0_0.pcd"])
    pressure = until(stream, lambda h: isinstance(h, e.Pressure))[-1]
    assert (pressure.id, pressure.code, pressure.budget_bytes) == ("0_0.pcd", code, 1 << 20)
    assert pressure.refused >= 1


def test_the_stream_goes_on_in_the_next_run(served: DaemonProcess, connect: Connect, listen: Listen) -> None:
    stream = listen(served)
    connect(served, name="first").selected(["0_0.pcd"])
    until(stream, lambda h: isinstance(h, e.Loaded))
    before = stream.epoch
    served.kill()
    served.start()
    connect(served, name="second").selected(["0_-20.pcd"])
    found = until(stream, lambda h: isinstance(h, e.Loaded) and h.id == "0_-20.pcd")
    after = [h for h in found if h.epoch != before]
    assert [h.seq for h in after] == list(range(1, len(after) + 1))
    assert isinstance(after[0], e.Epoch)
    assert stream.epoch == after[0].epoch
    assert served.stop() == 0
    assert until(stream, lambda h: isinstance(h, e.Epoch))[-1].what == "stopping"


@pytest.mark.parametrize("since", [-1.0, float("nan")])
def test_a_beginning_that_makes_no_sense(since: float) -> None:
    with pytest.raises(BadRequest, match="since"):
        EventStream("/nowhere.sock", since=since)


@pytest.mark.slow
def test_a_gap_is_noticed_and_closed(served: DaemonProcess, connect: Connect, listen: Listen) -> None:
    """More happens than any queue holds while the listener does not read: the oldest are `MissedEvents`."""
    client, stream = connect(served), listen(served)
    client.selected(["0_0.pcd"])
    for _ in range(2200):  # two events each: the daemon remembers 4096
        client.ask("evict", ["0_0.pcd"])
        client.selected(["0_0.pcd"])
    client.ask("evict", None)
    client.selected(["20_20.pcd"])
    found = until(stream, lambda h: isinstance(h, e.Loaded) and h.id == "20_20.pcd")
    expected = None
    missed = 0
    for happening in found:
        first = happening.first if isinstance(happening, MissedEvents) else happening.seq
        assert expected is None or first == expected
        expected = (happening.last if isinstance(happening, MissedEvents) else happening.seq) + 1
        missed += isinstance(happening, MissedEvents)
    assert missed <= 1
    assert len(found) >= 4096


_STOPPED = """
import sys, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.setsockopt(zmq.RCVHWM, 1)
socket.connect("ipc://" + sys.argv[1])
socket.subscribe(b"")
socket.recv()
print("up", flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
def test_a_stopped_listener_delays_no_other(served: DaemonProcess, connect: Connect, listen: Listen) -> None:
    client, stream = connect(served), listen(served)
    path = f"{served.runtime_dir}/{served.instance}.events.sock"
    with LineProcess(sys.executable, "-c", _STOPPED, path) as listener:
        assert listener.read() == "up"
        stop(listener.pid)
        for _ in range(1500):  # far more than its queue
            client.ask("evict", ["0_0.pcd"])
            client.selected(["0_0.pcd"])
        client.selected(["20_20.pcd"])
        found = until(stream, lambda h: isinstance(h, e.Loaded) and h.id == "20_20.pcd")
        assert not [h for h in found if isinstance(h, MissedEvents)]


def test_a_client_written_from_the_document(served: DaemonProcess, client: RawClient) -> None:
    """Subscribe first, then ask what there was: no event comes twice or is missed."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with context, context.socket(zmq.SUB) as socket:
        socket.connect(f"ipc://{client.hello()[19]}")
        socket.subscribe(b"")
        beat: Any = unpack(socket.recv())
        assert beat[0] == "beat"
        page = client.ask("recent")
        assert (page[2], page[3], page[4]) == (client.epoch, 1, beat[1] + 1)
        assert [event[0] for event in page[5]] == ["epoch", "joined"]
        assert client.ask("recent", 1)[5] == page[5][1:]
        assert client.ask("recent", 0, 2**62)[5] == []
        assert client.ask("recent", 0, 0, 1)[5] == page[5][:1]
        client.selected(["0_0.pcd"])
        event: Any = unpack(socket.recv())
        while event[0] == "beat":
            event = unpack(socket.recv())
        assert event[:2] == ["loaded", page[4]]


def test_permissions_are_those_of_requests(served: DaemonProcess) -> None:
    paths = [served.endpoint, f"{served.runtime_dir}/{served.instance}.events.sock"]
    modes = [os.stat(path) for path in paths]
    assert len({(stat.S_IMODE(m.st_mode), m.st_uid, m.st_gid) for m in modes}) == 1
    assert served.stop() == 0
    assert not [path for path in paths if os.path.exists(path)]


def test_only_everything_can_be_subscribed_to(
    served: DaemonProcess, connect: Connect, listen: Listen
) -> None:
    """Subscriptions to very many prefixes, which would be kept, end the connection; others go on."""
    client, stream = connect(served), listen(served)
    context: zmq.Context[Any] = zmq.Context()
    greedy = context.socket(zmq.SUB)
    try:
        greedy.linger = 0
        greedy.reconnect_ivl = -1
        monitor = greedy.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        for number in range(1000):
            greedy.subscribe(b"prefix %d" % number)
        greedy.connect("ipc://" + served.endpoint.removesuffix(".sock") + ".events.sock")
        assert monitor.poll(30_000), "the connection stays"
    finally:
        greedy.disable_monitor()
        context.destroy(linger=0)
    assert f"connections ended pid={os.getpid()} count=1" in served.log
    client.selected(["0_0.pcd"])
    until(stream, lambda h: isinstance(h, e.Loaded))
