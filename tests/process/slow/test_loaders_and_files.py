# SPDX-License-Identifier: Apache-2.0
"""Files and loaders that crash, hang or lie cost their own cell and nothing else; and exceptions of ours."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import DaemonProcess, counters, first_answer, until, wait_ended
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.process_costs import peak_bytes
from tests.support.raw_client import RawCells, RawClient, circle
from tests.support.segment_reader import assert_same_points, read_segment

Connect = Callable[..., RawClient]


def until_loaded(client: RawClient, x: float, y: float) -> RawCells:
    """Ask for the four cells around a place until none fails: they are not tried again at once."""
    return first_answer(lambda: client.area(circle(x, y, 5)), lambda reply: not reply.failed)


def test_one_load_for_many_clients(served: DaemonProcess, connect: Connect, divided_map: DividedMap) -> None:
    clients = [connect(served) for _ in range(8)]
    requests = [client.send("area", circle(0, 0, 60), ["points"], 30.0) for client in clients]
    wanted = divided_map.in_circle(0, 0, 60)
    replies = [c.cells_reply(c.wait_for(r)) for c, r in zip(clients, requests, strict=True)]
    segments = [handle.segment for handle in replies[0].cells]
    assert [handle.id for handle in replies[0].cells] == [divided_map.id(name) for name in wanted]
    assert all([h.segment for h in reply.cells] == segments for reply in replies)
    counters = clients[0].ask("stats")[4]
    assert counters["loads_started"] == counters["loads_finished"] == len(wanted)


def test_a_cold_request_delays_no_warm_one(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """The loaders stand still, so the cold request cannot be answered: warm ones are."""
    one = daemon(divided_map.root, "--workers", "1")
    warm, cold = connect(one), connect(one)
    warm.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    request = cold.send("area", circle(40, 40, 5), ["points"], 60.0)
    partly = cold.area(circle(20, 20, 5), wait=None)  # the same session is not held up either
    assert len(partly.cells) + len(partly.pending) == 4
    assert partly.pending
    for _ in range(50):
        assert len(warm.area(circle(0, 0, 5)).cells) == 4
    os.kill(loader, signal.SIGCONT)
    assert len(cold.cells_reply(cold.wait_for(request)).cells) == 4


def test_a_wait_ends_at_its_timeout(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """A client that waits for a while gets what is loaded by then."""
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    reply = client.area(circle(10, 0, 15), wait=0.2)
    assert len(reply.cells) == 4
    assert len(reply.pending) == len(divided_map.in_circle(10, 0, 15)) - 4
    os.kill(loader, signal.SIGCONT)
    assert len(client.area(circle(10, 0, 15)).cells) == len(divided_map.in_circle(10, 0, 15))


def test_a_loader_that_hangs_ends_at_its_deadline(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1", "--load-timeout", "4")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    reply = client.area(circle(40, 40, 5))
    assert wait_ended(loader)
    assert [failure.code for failure in reply.failed] == ["load_timeout"]  # the one it stood still at
    assert len(reply.cells) == 3  # the others were given to the next loader
    assert client.ask("stats")[4]["loads_timed_out"] == 1


def ask_for_four(client: RawClient) -> int:
    """Ask for four cells, and wait until a loader, which stands still, has been given them."""
    started = client.ask("stats")[4]["loads_started"]
    request = client.send("area", circle(40, 40, 5), ["points"], 30.0)
    until(lambda: client.ask("stats")[4]["loads_started"] >= started + 4)
    return request


def test_a_loader_that_is_killed_costs_one_cell(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,) = one.stop_loaders()
    request = ask_for_four(client)
    os.kill(loader, signal.SIGKILL)
    reply = client.cells_reply(client.wait_for(request))
    assert len(reply.cells) == 3
    (failure,) = reply.failed
    assert (failure.code, "SIGKILL" in failure.message) == ("load_failed", True)
    assert client.ask("stats")[4]["worker_crashes"] == 1
    reply = until_loaded(client, 40, 40)
    assert len(reply.cells) == 4


def test_idle_loaders_that_are_killed_are_replaced(served: DaemonProcess, client: RawClient) -> None:
    client.area(circle(0, 0, 25))
    for pid in served.loaders():
        os.kill(pid, signal.SIGKILL)
        assert wait_ended(pid)
    reply = client.area(circle(0, 0, 200))
    assert (len(reply.cells), reply.failed) == (36, [])


def test_the_loaders_parent_is_killed(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Its loaders die with it; that is no cell's fault, and another parent makes others."""
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    (loader,), parent = one.stop_loaders(), one.loaders_parent()
    request = ask_for_four(client)
    os.kill(parent, signal.SIGKILL)
    reply = client.cells_reply(client.wait_for(request))
    assert (len(reply.cells), reply.failed) == (4, [])
    assert wait_ended(loader)
    assert client.ask("stats")[4]["worker_crashes"] == 1
    assert one.loaders_parent() != parent


def test_a_pipe_instead_of_a_file(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """Opening it would wait without bound."""
    one = daemon(divided_map.root, "--load-timeout", "4")
    path = divided_map.pcd_dir / "0_0.pcd"
    path.unlink()
    os.mkfifo(path)
    client = connect(one)
    reply = client.area(circle(0, 0, 5))
    assert [(f.id.rsplit("/", 1)[-1], f.code) for f in reply.failed] in (
        [("0_0.pcd", "load_failed")],
        [("0_0.pcd", "load_timeout")],
    )
    assert len(reply.cells) == 3


def test_a_file_that_is_cut_under_its_loader(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Then all loaders and their parent are killed, as when memory runs out."""
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    path = divided_map.pcd_dir / "40_40.pcd"
    good = path.read_bytes()
    (loader,) = one.stop_loaders()
    request = ask_for_four(client)
    os.truncate(path, len(good) // 2)
    os.kill(loader, signal.SIGCONT)
    reply = client.cells_reply(client.wait_for(request))
    assert [failure.id.rsplit("/", 1)[-1] for failure in reply.failed] == ["40_40.pcd"]
    assert len(reply.cells) == 3
    path.write_bytes(good)
    for pid in one.children():
        with contextlib.suppress(ProcessLookupError):  # it may have ended with its parent
            os.kill(pid, signal.SIGKILL)
    reply = until_loaded(client, 40, 40)
    for handle in reply.cells:
        assert_same_points(client, handle, divided_map)


def test_no_descriptor_is_left_for_a_finished_segment(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    client = connect(one)
    client.area(circle(0, 0, 5))
    _soft, hard = resource.prlimit(one.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(one.pid, resource.RLIMIT_NOFILE, (len(os.listdir(f"/proc/{one.pid}/fd")), hard))
    for _ in range(20):
        assert len(client.area(circle(0, 0, 5)).cells) == 4
    reply = client.area(circle(-40, -40, 5))
    assert len(reply.failed) + len(reply.cells) == 4
    resource.prlimit(one.pid, resource.RLIMIT_NOFILE, (hard, hard))
    reply = until_loaded(client, -40, -40)
    for handle in reply.cells:
        assert_same_points(client, handle, divided_map)


@pytest.mark.parametrize("kind", ["missing", "directory", "empty", "truncated", "loop", "unreadable length"])
def test_a_bad_file_is_reported_and_retried_when_it_is_whole(
    served: DaemonProcess, connect: Connect, divided_map: DividedMap, kind: str
) -> None:
    path = divided_map.pcd_dir / "0_0.pcd"
    whole = path.read_bytes()
    path.unlink()
    if kind == "directory":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    elif kind != "missing":
        content = {
            "empty": b"",
            "truncated": whole[:-1],
            "unreadable length": whole.replace(b"POINTS 500", b"POINTS 4000000000"),
        }
        path.write_bytes(content[kind])
    client = connect(served)
    reply = client.area(circle(0, 0, 5))
    (failure,) = reply.failed
    assert (failure.id.rsplit("/", 1)[-1], failure.code) == ("0_0.pcd", "load_failed")
    assert str(path) in failure.message
    assert len(reply.cells) == 3
    if kind == "directory":
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
    interim = path.with_suffix(".new")
    interim.write_bytes(whole)
    interim.rename(path)
    reply = until_loaded(client, 0, 0)
    assert len(reply.cells) == 4


# --- every odd or bad file as a cell of a served map: its own outcome, and no harm to other cells ----


def serve(
    daemon: DaemonFactory, connect: Connect, made: DividedMap, files: dict[str, bytes]
) -> tuple[DaemonProcess, RawClient]:
    """Serve a map whose cells beyond x = 1000 m are these files."""
    for number, (name, content) in enumerate(files.items()):
        (made.pcd_dir / name).write_bytes(content)
        made.corners[name] = (1000 + 20 * number, 0)
    made.write_metadata()
    one = daemon(made.root, "--workers", "1")
    return one, connect(one)


def assert_outcomes(
    one: DaemonProcess, client: RawClient, made: DividedMap, expected: dict[str, int | None], largest: int
) -> None:
    """Ask for each cell alone, then all at once; None stands for a refusal, else points in the file."""
    client.area(circle(0, 0, 5))
    (loader,) = one.loaders()
    idle = peak_bytes(loader)
    for name, points in expected.items():
        reply = client.selected([name])
        if points is None:
            assert [(f.id, f.code) for f in reply.failed] == [(name, "load_failed")], name
            assert made.id(name) in reply.failed[0].message
            assert reply.cells == []
        else:
            assert reply.failed == [], name
            (handle,) = reply.cells
            segment = read_segment(client.path(handle))
            assert segment.fields["source_points"] == points, name
            assert handle.points == points - segment.fields["dropped_points"]
            assert np.isfinite(segment.columns["xyz"]).all()
    assert one.loaders() == [loader]  # none of them cost a loader its life
    assert peak_bytes(loader) - idle < (100 << 20) + largest
    everything = client.area(circle(0, 0, 1e5))
    assert {f.id.rsplit("/", 1)[-1] for f in everything.failed} == {
        n for n, p in expected.items() if p is None
    }
    assert len(everything.cells) + len(everything.failed) == len(made.corners)
    assert len(client.area(circle(0, 0, 5)).cells) == 4


def test_the_collected_files(daemon: DaemonFactory, connect: Connect, tmp_path: Path, data_dir: Path) -> None:
    made = make_map(tmp_path / "map", columns=2, rows=2)
    outcomes = json.loads((data_dir / "pcd_edge" / "expected.json").read_text())
    files = {f"{name}.pcd": (data_dir / "pcd_edge" / f"{name}.pcd").read_bytes() for name in outcomes}
    one, client = serve(daemon, connect, made, files)
    expected = {
        f"{name}.pcd": None if outcome["expect"] == "error" else outcome["points"]
        for name, outcome in outcomes.items()
    }
    assert len(expected) == 65
    assert_outcomes(one, client, made, expected, max(map(len, files.values())))


def header(
    encoding: str, points: object = 3, *, fields: str = "x y z", size: str = "4 4 4", type_: str = "F F F"
) -> bytes:
    return (
        f"VERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {type_}\nCOUNT {'1 ' * len(fields.split())}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {encoding}\n"
    ).encode()


def compressed(packed: bytes, plain: int, size: int | None = None) -> bytes:
    return struct.pack("<II", len(packed) if size is None else size, plain) + packed


def test_files_made_here(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    """The kinds of damage there are, without any collection of files."""
    made = make_map(tmp_path / "map", columns=2, rows=2)
    body = np.arange(9, dtype="<f4").tobytes()
    literal = bytes([31]) + bytes(32) + bytes([3]) + bytes(4)  # 36 zero bytes as LZF literals
    odd = np.array([[1, 2, 3], [np.nan, 0, 0], [4, np.inf, 6]], "<f4").tobytes()
    cases: dict[str, tuple[bytes, int | None]] = {
        "good": (header("binary") + body, 3),
        "good ascii": (header("ascii") + b"1 2 3\n4 5 6\n7 8 9\n", 3),
        "good compressed": (header("binary_compressed") + compressed(literal, 36), 3),
        "not finite": (header("binary") + odd, 3),
        "no points": (header("binary", 0), 0),
        "carriage returns": ((header("ascii") + b"1 2 3\n4 5 6\n7 8 9\n").replace(b"\n", b"\r\n"), 3),
        "empty": (b"", None),
        "zeros": (bytes(8192), None),
        "noise": (np.random.default_rng(3).bytes(5000), None),
        "pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n", None),
        "header only": (header("binary"), None),
        "header cut": (header("binary")[:60], None),
        "body cut": (header("binary") + body[:-1], None),
        "rows missing": (header("ascii") + b"1 2 3\n4 5 6\n", None),
        "rows promised": (header("ascii", 300_000_000) + b"1 2 3\n", None),
        "row short": (header("ascii") + b"1 2 3\n4 5\n7 8 9\n", None),
        "no number": (header("ascii") + b"1 2 3\n4 five 6\n7 8 9\n", None),
        "encoding": (header("quantum") + body, None),
        "negative": (header("binary", -3) + body, None),
        "huge": (header("binary", 2**40) + body, None),
        "larger than 64 bits": (header("binary", 2**70) + body, None),
        "no number of points": (header("binary", "many") + body, None),
        "no z": (header("binary", 3, fields="x y w") + body, None),
        "size": (header("binary", 3, size="4 4 3") + body, None),
        "type": (header("binary", 3, type_="F F Q") + body, None),
        "compressed sizes cut": (header("binary_compressed") + b"\1\0\0", None),
        "compressed too long": (header("binary_compressed") + compressed(literal, 36, 4000), None),
        "compressed huge": (header("binary_compressed") + compressed(literal, 2**32 - 1), None),
        "compressed bomb": (header("binary_compressed", 10**8) + compressed(literal, 1_200_000_000), None),
        "compressed reference": (
            header("binary_compressed") + compressed(b"\xe0\xff\xff" + literal, 36),
            None,
        ),
    }
    files = {f"{name}.pcd": content for name, (content, _) in cases.items()}
    one, client = serve(daemon, connect, made, files)
    expected = {f"{name}.pcd": points for name, (_, points) in cases.items()}
    assert_outcomes(one, client, made, expected, max(map(len, files.values())))


def test_mutated_files(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    """Bytes changed, cut, repeated at random: a cell or a refusal, the daemon and its loader go on."""
    made = make_map(tmp_path / "map", columns=2, rows=2)
    rng = np.random.default_rng(1)
    shutil.copy(made.pcd_dir / "0_0.pcd", tmp_path / "seed.pcd")
    whole = (tmp_path / "seed.pcd").read_bytes()
    files = {}
    for number in range(30):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 6))):
            at = int(rng.integers(0, 260 if rng.random() < 0.8 else len(data)))
            kind = rng.integers(0, 3)
            if kind == 0:
                data[at : at + 1] = rng.bytes(1)
            elif kind == 1:
                del data[at : at + int(rng.integers(1, 40))]
            else:
                data[at:at] = data[at : at + int(rng.integers(1, 40))]
        files[f"mutated {number}.pcd"] = bytes(data)
    one, client = serve(daemon, connect, made, files)
    reply = client.area(circle(0, 0, 1e5))
    assert len(reply.cells) + len(reply.failed) == len(made.corners)
    assert {f.code for f in reply.failed} <= {"load_failed"}
    assert "loader replaced" not in one.log
    for handle in reply.cells:
        assert handle.points == len(read_segment(client.path(handle)).columns["xyz"])
    corner = (0, 0)
    made.write_cell("0_0.pcd", corner, random_points(rng, corner, 10))
    client.ask("reload")
    assert client.selected(["0_0.pcd"]).cells[0].points == 10


def test_names_that_no_client_could_say(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    """Neither the stray file that a reload reports nor the cell in an odd directory ends the daemon."""
    made = make_map(tmp_path / "map", columns=2, rows=2)
    cells = os.fsencode(made.pcd_dir)
    os.mkdir(cells + b"/\xff")
    os.rename(cells + b"/0_0.pcd", cells + b"/\xff/0_0.pcd")
    client = connect(daemon(made.root))
    assert len(client.area(circle(0, 0, 50)).cells) == 3
    with open(cells + b"/Stra\xdfe.pcd", "wb"):
        pass
    reloaded = client.ask("reload")
    assert reloaded[3:6] == [0, 0, 0]
    assert "Stra\\xdfe.pcd" in "\n".join(reloaded[6])


# --- unexpected exceptions: the daemon goes on; if one comes repeatedly, its next run does


def test_the_daemon_goes_on(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, tmp_path: Path
) -> None:
    """A defect outside of requests, in freeing memory: logged with its traceback, counted, and survived."""
    from_now_on = tmp_path / "defect"
    one = daemon(divided_map.root, environment={"SHMMAP_TEST_DEFECT": f"daemon.unlink:3:{from_now_on}"})
    client = connect(one)
    loaded = client.area(circle(0, 0, 30)).cells
    client.ask("release", None)
    from_now_on.touch()
    client.ask("evict", None)
    until(lambda: client.ask("stats")[4]["zombies"] <= 0)
    assert len(client.area(circle(0, 0, 30)).cells) == len(loaded)
    assert client.ask("stats")[4]["defects"] == 3
    assert one.log.count(" ERROR   defect place=") == 1, "once in a while, not each time"
    assert "RuntimeError: a defect at daemon.unlink" in one.log
    until(lambda: counters(one)["defects"] == 3)  # the statistics segment follows
    shmmap = Shmmap(one, tmp_path)
    assert shmmap("health").rstrip().endswith("; it survived 3 exceptions, see its log")
    assert shmmap.json("health")["defects"] == 3
    assert "it survived 3 exceptions" in shmmap("doctor")


def test_again_and_again_is_too_much(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, tmp_path: Path
) -> None:
    from_now_on = tmp_path / "defect"
    one = daemon(divided_map.root, environment={"SHMMAP_TEST_DEFECT": f"daemon.unlink:1000:{from_now_on}"})
    client = connect(one)
    loaded = client.area(circle(0, 0, 30)).cells
    client.ask("release", None)
    from_now_on.touch()
    client.send("evict", [loaded[0].id])
    assert one.process is not None
    assert one.process.wait(60) not in (0, -9)
    one.killed = True
    one.environment.pop("SHMMAP_TEST_DEFECT")
    one.start()
    again = connect(one)
    assert again.ask("stats")[4]["adopted"] >= len(loaded) - 1, "what is in memory is kept"
