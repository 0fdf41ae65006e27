# SPDX-License-Identifier: Apache-2.0
"""Start, stop, crash and second start of the daemon."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import stat
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.protocol.rows import CellRow
from shmmap.statistics.reader import read_statistics
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, Deadline, first_answer, until, wait_ended
from tests.support.divided_map import DividedMap, random_points
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import DaemonError, RawClient, circle

Connect = Callable[..., RawClient]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, number: signal.Signals
) -> None:
    one = daemon(divided_map.root)
    assert len(connect(one).area(circle(0, 0, 60)).cells) > 20
    assert len(one.segments()) > 20
    assert one.process is not None
    process, one.process = one.process, None
    process.send_signal(number)
    assert process.wait(30) == 0
    assert one.leftovers() == []


def test_a_signal_while_cells_load_and_clients_wait(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    request = client.send("area", circle(0, 0, 500), ["points"], 60.0)
    client.ask("stats")  # the request before it was taken
    assert one.stop() == 0
    assert one.leftovers() == []
    reply = client.cells_reply(client.wait_for(request))  # a waiting client gets what there is
    assert len(reply.cells) + len(reply.pending) == 36


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_the_daemon_starts(
    daemon: DaemonFactory, divided_map: DividedMap, number: signal.Signals
) -> None:
    """As soon as it has a name on disk, a signal must take it away again, wherever the start is by then."""
    one = daemon(divided_map.root, start=False)
    process = one.spawn()
    while not [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")]:
        assert process.poll() is None, one.log
    process.send_signal(number)
    assert process.wait(30) == 0, one.log
    assert one.leftovers() == []
    assert [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")] == []


def test_signals_one_after_the_other_end_it_at_once(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Whatever the first one's work has come to when the others arrive."""
    for _ in range(5):
        one = daemon(divided_map.root)
        client = connect(one)
        client.area(circle(0, 0, 60))
        assert one.process is not None
        process, one.process = one.process, None
        while process.poll() is None:
            process.send_signal(signal.SIGTERM)
        assert process.returncode == 0, one.log
        assert "Traceback" not in one.log
        assert one.leftovers() == []
        assert [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")] == []


def test_a_burst_of_reload_signals(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    before = client.selected(["0_0.pcd"]).cells[0]
    corner = divided_map.corners["0_0.pcd"]
    divided_map.write_cell("0_0.pcd", corner, random_points(np.random.default_rng(4), corner, 40))
    for _ in range(200):
        one.send(signal.SIGHUP)
    reply = client.selected(["0_0.pcd"])
    while reply.cells[0].version == before.version:
        reply = client.selected(["0_0.pcd"])
    assert reply.cells[0].points == 40
    assert client.ask("reload")[3:6] == [0, 0, 0]
    assert 1 <= client.ask("stats")[4]["reloads"] <= 202


def test_a_second_instance_is_refused_and_the_first_one_goes_on(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    assert one.run_to_end() == 75
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    assert len(connect(one).area(circle(0, 0, 5)).cells) == 4  # the socket was not stolen


def test_two_instances_side_by_side(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    first = one.log.splitlines()[0]
    assert (
        f"INFO    starting version={shmmap.__version__} instance={one.instance} map={divided_map.root} "
        in first
    )
    two = daemon(divided_map.root, shm_dir=one.shm_dir)
    assert len(connect(one).area(circle(0, 0, 5)).cells) == 4
    assert len(connect(two).area(circle(0, 0, 25)).cells) == 12
    assert (len(one.segments()), len(two.segments())) == (4, 12)
    assert two.stop() == 0
    assert (len(one.segments()), len(two.segments())) == (4, 0)


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda _: None, 66),
        (lambda path: path.mkdir(), 66),
        (lambda path: path.write_bytes(b"no point cloud"), 65),
    ],
)
def test_no_map(daemon: DaemonFactory, tmp_path: Path, make: Callable[[Path], None], code: int) -> None:
    path = tmp_path / "map.pcd"
    make(path)
    one: DaemonProcess = daemon(path, start=False, forked=False)
    assert one.run_to_end() == code
    assert str(path) in one.log
    assert one.leftovers() == []


@pytest.mark.parametrize(
    "flags", [("--budget", "much"), ("--budget", "1000T"), ("--workers", "65"), ("--group", "no such group")]
)
def test_bad_settings(daemon: DaemonFactory, divided_map: DividedMap, flags: tuple[str, ...]) -> None:
    one: DaemonProcess = daemon(divided_map.root, *flags, start=False, forked=False)
    assert one.run_to_end() in (2, 78)
    assert one.leftovers() == []


def test_killed_and_started_again(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """What was mapped stays readable; the session is new, the versions are the same."""
    one = daemon(divided_map.root)
    client = connect(one)
    first = client.area(circle(0, 0, 25))
    path = client.path(first.cells[0])
    expected = zlib.crc32(Path(path).read_bytes())
    with MappingProcess([path]) as reader:
        one.kill()
        assert [pid for pid in one.children() if not wait_ended(pid, 10.0)] == []  # workers do not outlive it
        assert reader.checksums() == [expected]
        one.start()
        with pytest.raises(DaemonError) as failure:
            client.area(circle(0, 0, 25))
        assert failure.value.code == "no_session"
        epoch = client.epoch
        client.hello()
        assert client.epoch != epoch
        second = client.area(circle(0, 0, 25))
        assert [(h.id, h.version) for h in second.cells] == [(h.id, h.version) for h in first.cells]
        held = client.differential(circle(0, 0, 25), packed=[h.version for h in first.cells])
        assert (held.cells, held.removed_versions) == ([], [])
        assert reader.checksums() == [expected]


def test_what_the_statistics_have(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    seen = read_statistics(one.instance, one.shm_dir)
    assert seen.state == "healthy"
    assert seen.identity is not None
    assert (seen.identity.pid, seen.identity.endpoint) == (one.pid, one.endpoint)
    assert seen.counters["map_cells"] in (0, 36)  # the first beat may still come
    client = connect(one)
    client.area(circle(0, 0, 25))
    one.send(signal.SIGSTOP)
    os.waitid(os.P_PID, one.pid, os.WSTOPPED | os.WNOWAIT)
    assert read_statistics(one.instance, one.shm_dir).state == "stopped"
    one.send(signal.SIGCONT)
    # their rows follow when clients have been answered
    seen = first_answer(
        lambda: read_statistics(one.instance, one.shm_dir), lambda found: len(found.cells) >= 12
    )
    assert [cell.id for cell in seen.cells] == sorted(divided_map.in_circle(0, 0, 25))
    assert {cell.state for cell in seen.cells} == {"resident"}
    assert sum(cell.bytes for cell in seen.cells) == seen.counters["bytes_resident"] == one.segment_bytes()
    before = {cell.id: cell for cell in seen.cells}
    for _ in range(3):
        client.selected(["0_0.pcd"])
    until(lambda: read_statistics(one.instance, one.shm_dir).counters["handles_sent"] >= 15)
    until(lambda: _row(one, "0_0.pcd").hits >= before["0_0.pcd"].hits + 3)
    assert _row(one, "0_0.pcd").last_use_monotonic_ns > before["0_0.pcd"].last_use_monotonic_ns
    one.kill()
    assert read_statistics(one.instance, one.shm_dir).state == "dead"
    one.start()
    again = read_statistics(one.instance, one.shm_dir)
    assert again.identity is not None
    assert again.state == "healthy"
    assert seen.identity is not None
    assert again.identity.epoch != seen.identity.epoch
    assert one.stop() == 0
    assert read_statistics(one.instance, one.shm_dir).state == "absent"


def _row(one: DaemonProcess, name: str) -> CellRow:
    """The row of a cell."""
    return next(c for c in read_statistics(one.instance, one.shm_dir).cells if c.id == name)


def test_nothing_is_open_to_others_without_a_group(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    connect(one).area(circle(0, 0, 5))
    for name in one.segments():
        assert stat.S_IMODE(os.stat(f"{one.shm_dir}/{name}").st_mode) == 0o400
    assert stat.S_IMODE(os.stat(f"{one.shm_dir}/shmmap.{one.instance}.statistics").st_mode) == 0o400
    assert stat.S_IMODE(os.stat(one.endpoint).st_mode) & 0o077 == 0


def test_the_daemon_keeps_no_segment_open(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """An open file of the daemon's own would look like a reader that never ends."""
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(circle(0, 0, 60))
    client.ask("stats")
    own = [os.path.basename(t) for t in _open_paths(one.pid) if t.startswith(one.shm_dir + "/")]
    assert [name for name in own if name in one.segments()] == []
    maps = Path(f"/proc/{one.pid}/maps").read_text()
    assert not any(name in maps for name in one.segments())


def _open_paths(pid: int) -> list[str]:
    found = []
    for entry in os.listdir(f"/proc/{pid}/fd"):
        with contextlib.suppress(FileNotFoundError):
            found.append(os.readlink(f"/proc/{pid}/fd/{entry}"))
    return found


def test_a_stale_socket_is_no_hindrance(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one: DaemonProcess = daemon(divided_map.root, start=False, forked=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(one.endpoint)
    one.start()
    assert len(connect(one).area(circle(0, 0, 5)).cells) == 4


def test_foreign_segments_are_left_alone(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Leftovers of this instance go, damaged ones included; other files stay."""
    one: DaemonProcess = daemon(divided_map.root, start=False, forked=False)
    other = Path(one.shm_dir, "shmmap.other.0011223344556677")
    longer = Path(one.shm_dir, f"shmmap.{one.instance}x.0011223344556677")
    for path in (other, longer):
        path.write_bytes(b"mine")
    for name, data in (("00" * 8, b""), ("11" * 8, os.urandom(5000)), ("22" * 8 + ".zombie", bytes(9000))):
        Path(one.shm_dir, f"shmmap.{one.instance}.{name}").write_bytes(data)
    one.start()
    client = connect(one)
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    one.until_segments(4, lambda: client.ask("stats"))
    assert (other.read_bytes(), longer.read_bytes()) == (b"mine", b"mine")
    other.unlink()
    longer.unlink()


def test_directories_are_named_from_where_the_daemon_was_started(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """Its loaders and its clients, in other directories, mean the same ones."""
    one = daemon(divided_map.root, start=False, forked=False)
    one.command = ["env", "-C", str(tmp_path)]
    one.arguments = ["--shm-dir", os.path.relpath(one.shm_dir, tmp_path), "--cache-dir", "cache"]
    one.start()
    with shmmap.connect(one.endpoint) as client:
        assert client.welcome.shm_dir == one.shm_dir
        assert len(client.around(0, 0, 5, layers="voxel(leaf=1.0)", wait=60.0)) == 4
    assert list((tmp_path / "cache" / "layers").iterdir())


@pytest.mark.skipif(not os.path.exists("/proc/self/autogroup"), reason="this kernel has no autogroups")
def test_loaders_weigh_less_than_the_daemon(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """Against all others on the machine: their nice value alone counts only within their session.

    With each job a loader asks for it again: the kernel takes ten such changes a second, of all processes.
    """
    one = daemon(divided_map.root)

    def weights(*pids: int) -> list[str]:
        return [Path(f"/proc/{pid}/autogroup").read_text().split()[-1] for pid in pids]

    leaves = (1.0 + 0.01 * number for number in itertools.count())
    waiting = Deadline()
    with shmmap.connect(one.endpoint, shm_dir=one.shm_dir) as client:
        while waiting("5" not in weights(*one.loaders())):
            client.around(0, 0, 5, layers=f"voxel(leaf={next(leaves):.2f})", wait=60.0)
    assert weights(one.pid) == ["0"]
