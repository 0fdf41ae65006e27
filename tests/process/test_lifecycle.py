# SPDX-License-Identifier: Apache-2.0
"""Start, stop, crash and second start of the daemon."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shmmap
from shmmap.statistics.reader import read_statistics
from shmmap.version import build_version
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, Deadline, first_answer, until
from tests.support.divided_map import DividedMap, random_points
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(served: DaemonProcess, connect: Connect, number: signal.Signals) -> None:
    assert len(connect(served).area(circle(0, 0, 60)).cells) > 20
    assert len(served.segments()) > 20
    assert served.process is not None
    process, served.process = served.process, None
    process.send_signal(number)
    assert process.wait(30) == 0
    assert served.leftovers() == []


def test_a_signal_while_cells_load_and_clients_wait(served: DaemonProcess, client: RawClient) -> None:
    request = client.send("area", circle(0, 0, 500), ["points"], 60.0)
    client.ask("stats")  # the request before it was taken
    assert served.stop() == 0
    assert served.leftovers() == []
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
    for _ in range(3):
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


def test_a_burst_of_reload_signals(served: DaemonProcess, client: RawClient, divided_map: DividedMap) -> None:
    before = client.selected(["0_0.pcd"]).cells[0]
    corner = divided_map.corners["0_0.pcd"]
    divided_map.write_cell("0_0.pcd", corner, random_points(np.random.default_rng(4), corner, 40))
    for _ in range(200):
        served.send(signal.SIGHUP)
    reply = client.selected(["0_0.pcd"])
    while reply.cells[0].version == before.version:
        reply = client.selected(["0_0.pcd"])
    assert reply.cells[0].points == 40
    assert client.ask("reload")[3:6] == [0, 0, 0]
    assert 1 <= client.ask("stats")[4]["reloads"] <= 202


def test_a_second_instance_is_refused_and_the_first_one_goes_on(
    served: DaemonProcess, client: RawClient, connect: Connect
) -> None:
    assert served.run_to_end() == 75
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    assert len(connect(served).area(circle(0, 0, 5)).cells) == 4  # the socket was not stolen


def test_two_instances_side_by_side(
    served: DaemonProcess, daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    first = served.log.splitlines()[0]
    assert (
        f"INFO    starting version={build_version()} instance={served.instance} map={divided_map.root} "
        in first
    )
    two = daemon(divided_map.root, shm_dir=served.shm_dir)
    assert len(connect(served).area(circle(0, 0, 5)).cells) == 4
    assert len(connect(two).area(circle(0, 0, 25)).cells) == 12
    assert (len(served.segments()), len(two.segments())) == (4, 12)
    assert two.stop() == 0
    assert (len(served.segments()), len(two.segments())) == (4, 0)


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
    one: DaemonProcess = daemon(path, start=False)
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


def test_what_the_statistics_have(served: DaemonProcess, connect: Connect, divided_map: DividedMap) -> None:
    seen = read_statistics(served.instance, served.shm_dir)
    assert seen.state == "healthy"
    assert seen.identity is not None
    assert (seen.identity.pid, seen.identity.endpoint) == (served.pid, served.endpoint)
    assert seen.counters["map_cells"] in (0, 36)  # the first beat may still come
    client = connect(served)
    client.area(circle(0, 0, 25))
    served.send(signal.SIGSTOP)
    os.waitid(os.P_PID, served.pid, os.WSTOPPED | os.WNOWAIT)
    assert read_statistics(served.instance, served.shm_dir).state == "stopped"
    served.send(signal.SIGCONT)
    seen = first_answer(
        lambda: read_statistics(served.instance, served.shm_dir),
        lambda found: found.counters["cells_resident"] >= 12,
    )
    assert seen.counters["bytes_resident"] == served.segment_bytes()
    until(lambda: read_statistics(served.instance, served.shm_dir).counters["handles_sent"] >= 12)
    served.kill()
    assert read_statistics(served.instance, served.shm_dir).state == "dead"
    served.start()
    again = read_statistics(served.instance, served.shm_dir)
    assert again.identity is not None
    assert again.state == "healthy"
    assert seen.identity is not None
    assert again.identity.epoch != seen.identity.epoch
    assert served.stop() == 0
    assert read_statistics(served.instance, served.shm_dir).state == "absent"


def test_what_is_in_memory_is_listed(served: DaemonProcess, divided_map: DividedMap) -> None:
    with shmmap.connect(served.endpoint) as client:
        client.around(0, 0, 25, wait=60.0)
        before = {row.id: row for row in client.list_cells()}
        assert list(before) == sorted(divided_map.in_circle(0, 0, 25))
        assert {row.state for row in before.values()} == {"resident"}
        assert sum(row.bytes for row in before.values()) == served.segment_bytes()
        for _ in range(3):
            client.selected(["0_0.pcd"])
        after = {row.id: row for row in client.list_cells()}
        assert after["0_0.pcd"].hits == before["0_0.pcd"].hits + 3
        assert after["0_0.pcd"].last_use_monotonic_ns > before["0_0.pcd"].last_use_monotonic_ns
        assert {**after, "0_0.pcd": before["0_0.pcd"]} == before


def test_nothing_is_open_to_others_without_a_group(served: DaemonProcess, connect: Connect) -> None:
    connect(served).area(circle(0, 0, 5))
    for name in served.segments():
        assert stat.S_IMODE(os.stat(f"{served.shm_dir}/{name}").st_mode) == 0o400
    assert stat.S_IMODE(os.stat(f"{served.shm_dir}/shmmap.{served.instance}.statistics").st_mode) == 0o400
    assert stat.S_IMODE(os.stat(served.endpoint).st_mode) & 0o077 == 0


def test_the_daemon_keeps_no_segment_open(served: DaemonProcess, client: RawClient) -> None:
    """An open file of the daemon's own would look like a reader that never ends."""
    client.area(circle(0, 0, 60))
    client.ask("stats")
    own = [os.path.basename(t) for t in _open_paths(served.pid) if t.startswith(served.shm_dir + "/")]
    assert [name for name in own if name in served.segments()] == []
    maps = Path(f"/proc/{served.pid}/maps").read_text()
    assert not any(name in maps for name in served.segments())


def _open_paths(pid: int) -> list[str]:
    found = []
    for entry in os.listdir(f"/proc/{pid}/fd"):
        with contextlib.suppress(FileNotFoundError):
            found.append(os.readlink(f"/proc/{pid}/fd/{entry}"))
    return found


def test_a_stale_socket_is_no_hindrance(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one: DaemonProcess = daemon(divided_map.root, start=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(one.endpoint)
    one.start()
    assert len(connect(one).area(circle(0, 0, 5)).cells) == 4


def test_foreign_segments_are_left_alone(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Leftovers of this instance go, damaged ones included; other files stay."""
    one: DaemonProcess = daemon(divided_map.root, start=False)
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
def test_loaders_weigh_less_than_the_daemon(served: DaemonProcess) -> None:
    """Against all others on the machine: their nice value alone counts only within their session.

    With each job a loader asks for it again: the kernel takes ten such changes a second, of all processes.
    """

    def weights(*pids: int) -> list[str]:
        return [Path(f"/proc/{pid}/autogroup").read_text().split()[-1] for pid in pids]

    leaves = (1.0 + 0.01 * number for number in itertools.count())
    waiting = Deadline()
    with shmmap.connect(served.endpoint, shm_dir=served.shm_dir) as client:
        while waiting("5" not in weights(*served.loaders())):
            client.around(0, 0, 5, layers=f"voxel(leaf={next(leaves):.2f})", wait=60.0)
    assert weights(served.pid) == ["0"]
