# SPDX-License-Identifier: Apache-2.0
"""Files that hang, lie, are too long, have no room, or change: what the map and its cache are made of."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.segment.names import segment_prefix, statistics_name
from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.hung_mount import hung_mount
from tests.benchmarks.hostile.report import Report
from tests.benchmarks.hostile.stage import Stage, scene
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment

EX_CONFIG: Final = 78
"""Exit code of what stays wrong until somebody changes it: systemd does not try again."""


def asks_for_what_hangs(orders: Orders, endpoint: str, names: list[str]) -> int:
    """Ask again and again for cells whose files cannot be looked at; returns how often."""
    count = 0
    with RawClient(endpoint, name="hangs") as client:
        while orders.go_on(0.02):
            client.send("selected", names, ["points"], 0.5)
            client.send("selected", names, ["points"], None)
            client.receive()
            client.receive()
            count += 2
    return count


@scene("A13", "A file system that hangs stops no request for what is in memory")
def hung_files(told: Report, stage: Stage) -> None:
    """Cells that failed, and cells that were never loaded, lie on a mount that hangs; for 15 s."""
    made = stage.new_map()
    names = [name for name, (x, _) in made.corners.items() if x in (-60, 40)]
    for name in names[::2]:
        (made.pcd_dir / name).write_bytes(b"no PCD")
    with stage.served(made.root) as one, hung_mount(made.root / "hung") as hung:
        with RawClient(one.endpoint) as client:
            failed = client.selected(names[::2]).failed
        told.tell(f"{len(failed)} cells have failed, {len(names[1::2])} were never asked for; now they hang")
        for name in names:
            (made.pcd_dir / name).unlink()
            (made.pcd_dir / name).symlink_to(hung / name)
        with Beside(told, one), Actor(asks_for_what_hangs, one.endpoint, names) as attacker:
            time.sleep(15.0)
            told.tell(f"asked for them {attacker.end()} times")


def exit_code(one: DaemonProcess) -> int:
    """Start a daemon that is expected to end; 0 if it gets ready instead."""
    try:
        one.start()
    except shmmap.ShmmapError:
        pass
    else:
        one.stop()
        return 0
    assert one.process is not None
    code = one.process.wait(10)
    one.process = None
    return code


@scene("A14", "What can pass by itself does not keep the service from being started again")
def full_at_the_start(told: Report, stage: Stage) -> None:
    """A full tmpfs; names and a lock that somebody else took.  Exit code 78 would be final."""
    made = stage.new_map()

    def full(one: DaemonProcess) -> Path:
        filler = Path(one.shm_dir, "filler")
        fd = os.open(filler, os.O_WRONLY | os.O_CREAT)
        with contextlib.suppress(OSError):  # it is full
            while os.write(fd, bytes(4096)):
                pass
        os.close(fd)
        return filler

    def squatted(name: Callable[[str], str]) -> Callable[[DaemonProcess], Path]:
        def take(one: DaemonProcess) -> Path:
            path = Path(one.shm_dir + name(one.instance))
            path.mkdir()  # as a stranger's file in a sticky directory, it cannot be replaced
            return path

        return take

    cases: dict[str, Callable[[DaemonProcess], Path]] = {
        "a full tmpfs": full,
        "its statistics' name is taken": squatted(statistics_name),
        "its lock's name is taken": squatted(lambda instance: segment_prefix(instance) + "lock"),
    }
    for what, prepare in cases.items():
        with stage.tmpfs("64m") as tmpfs:
            one = DaemonProcess(made.root, shm_dir=tmpfs)
            try:
                obstacle = prepare(one)
                code = exit_code(one)
                last = [line for line in one.log.splitlines() if line.strip()][-2:]
                told.must(f"{what}: exit code {code} is not final", code != EX_CONFIG)
                if code:
                    told.tell(f"it said: {' | '.join(last)[:300]}")
                shutil.rmtree(obstacle) if obstacle.is_dir() else obstacle.unlink()
                told.must("once that is over it starts", exit_code(one) == 0)
            finally:
                one.dispose()
    with stage.tmpfs("64m") as tmpfs:
        one = DaemonProcess(made.root, shm_dir=tmpfs)
        try:
            path = Path(tmpfs + segment_prefix(one.instance) + "lock")
            with path.open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                code = exit_code(one)
                told.must(
                    "beside somebody's flock in the shm directory it starts", code == 0, f"exit code {code}"
                )
                if code:
                    told.tell(f"it said: {one.log.splitlines()[-1][:300]}")
        finally:
            one.dispose()


def columns_of(client: RawClient, layer: str) -> dict[str, dict[str, NDArray[Any]]]:
    """What every cell of a layer holds, by cell."""
    reply = client.cells_reply(client.ask("area", circle(0, 0, 100), [layer], 120.0, None))
    assert not reply.failed, reply.failed
    return {cell.id: read_segment(client.path(cell)).columns for cell in reply.cells}


def differing(one: dict[str, dict[str, NDArray[Any]]], other: dict[str, dict[str, NDArray[Any]]]) -> int:
    """How many cells differ."""
    return sum(
        any(not np.array_equal(values, other[cell][name]) for name, values in columns.items())
        for cell, columns in one.items()
    )


@scene("A16", "An entry of the disk cache that belongs to another cell is not served")
def swapped_entries(told: Report, stage: Stage) -> None:
    """Every entry of one layer is replaced by its neighbour's."""
    layer = "voxel(leaf=0.5)"
    one = DaemonProcess(stage.new_map().root)
    try:
        with RawClient(one.start().endpoint) as client:
            right = columns_of(client, layer)
            one.stop()
            entries = sorted(path for path in one.cache_dir.rglob("*.layer") if path.is_file())
            held = [path.read_bytes() for path in entries]
            for path, other in zip(entries, [*held[1:], *held[:1]], strict=True):
                with path.open("r+b") as file:
                    file.truncate(0)
                    file.write(other)
            one.start()
            client.hello()
            found = columns_of(client, layer)
            told.must("there were entries to swap", len(entries) >= 36, str(len(entries)))
            told.limit(f"of {len(found)} cells have another's bytes", differing(right, found), 0)
            one.stop()
    finally:
        one.dispose()


def says(client: RawClient, tag: str, *elements: Any) -> list[Any]:
    """Ask, and return the reply also if it is an error."""
    return client.wait_for_any(client.send(tag, *elements), 120.0)


@scene("A17", "Metadata with endless numbers and names is refused in a few words")
def long_metadata(told: Report, stage: Stage) -> None:
    """A corner of ten million digits, a name of ten million letters, and their like; all reloaded."""
    made = stage.new_map()
    metadata = made.root / "pointcloud_map_metadata.yaml"
    good = metadata.read_text()
    bad = {
        "a number of 10 million digits": f"a.pcd: [{'7' * 10_000_000}, 0]\n",
        "a name of 10 MB": f"{'n' * 10_000_000}.pcd: [0, 0]\n",
        "a resolution of 10 million digits": f"x_resolution: {'7' * 10_000_000}\n",
        "a line of 10 MB": "n" * 10_000_000,
        "a key of 10 MB": f"? {'n' * 10_000_000}\n: [0, 0]\n",
        "10 million brackets": f"a.pcd: {'[' * 10_000_000}",
        "a million anchors": "".join(f"a{i}: &a{i} [1, 2]\n" for i in range(1_000_000)),
        "aliases": "a: &a [1, 2]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(500_000)),
    }
    with stage.served(made.root) as one, Beside(told, one), RawClient(one.endpoint, timeout=120.0) as client:
        for what, line in bad.items():
            metadata.write_text(good + line)
            logged = len(one.log)
            reply = says(client, "reload")
            told.tell(f"{what}: {reply[0]} {str(reply[2:])[:120]}")
            told.must("it is no defect of ours", reply[0] != "error" or reply[2] != "internal")
            told.limit("reply", client.last_bytes, 4096, "bytes")
            told.limit("log", len(one.log) - logged, 8192, "bytes")
        told.limit("defects", client.ask("stats")[4].get("defects", 0), 0)


def reloads(orders: Orders, endpoint: str) -> tuple[float, str]:
    """Have the map read again, with the library's defaults; seconds, and what went wrong."""
    begin_s = time.monotonic()
    try:
        with shmmap.connect(endpoint, name="operator", connect_timeout=10.0) as client:
            client.reload()
    except shmmap.ShmmapError as error:
        return time.monotonic() - begin_s, str(error)
    return time.monotonic() - begin_s, ""


def touch_the_last(map_directory: Path, side: int) -> None:
    """Change the state of the last cell's file, and so of all that are links to it."""
    last = 20 * (side - 1)
    os.utime(map_directory / "pointcloud_map.pcd" / f"city_{last}_{last}.pcd")


@scene("A19", "A reload of a million cells is asked for once, is waited for, and stops nobody")
def long_reload(told: Report, stage: Stage) -> None:
    """A million cells, 40 000 of which have changed, are read again by the library, twice."""
    side = 1000
    path = stage.many_cells(side)
    with stage.served(path, "--budget", "1G") as one, Beside(told, one):
        for number in (1, 2):
            touch_the_last(path, side)
            with Actor(reloads, one.endpoint) as operator:
                took_s, failure = operator.said(600.0)
            with RawClient(one.endpoint, timeout=120.0) as client:
                counters = client.ask("stats")[4]
            told.tell(f"reload {number} took {took_s:.1f} s; the daemon counts {counters['reloads']} of them")
            told.must("its client got its answer", not failure, failure)
            told.must("there was one", counters["reloads"] == number)


def version_of(client: RawClient, made: DividedMap, name: str, layer: str) -> int:
    """Version of one cell's layer."""
    (cell,) = client.cells_reply(client.ask("selected", [made.id(name)], [layer], 60.0)).cells
    return cell.version


@scene("A20", "A version names bytes: whatever else they would be has another one")
def versions(told: Report, stage: Stage) -> None:
    """A cell's box is edited, its file is not; and layers of a cell are compared."""
    made = stage.new_map()
    with stage.served(made.root) as one, RawClient(one.endpoint) as client:
        layers = ("points", "voxel(leaf=0.5)", "normals(radius=2)")
        before = [version_of(client, made, "20_20.pcd", layer) for layer in layers]
        told.must("three layers of a cell have three versions", len(set(before)) == 3)
        made.corners["20_20.pcd"] = (20, 21)
        made.write_metadata()
        client.ask("reload")
        after = [version_of(client, made, "20_20.pcd", layer) for layer in layers]
        for layer, old, new in zip(layers, before, after, strict=True):
            told.must(f"with another box {layer} has another version", old != new)
        neighbour = version_of(client, made, "0_20.pcd", "normals(radius=2)")
        made.change("20_20.pcd", 5)
        client.ask("reload")
        now = version_of(client, made, "0_20.pcd", "normals(radius=2)")
        told.must("with another neighbour a layer that looks at it has another version", neighbour != now)
