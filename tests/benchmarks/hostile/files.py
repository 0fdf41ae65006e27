# SPDX-License-Identifier: Apache-2.0
"""Files that hang, lie, are too long, have no room, or change: what the map and its cache are made of."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import shmmap
from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.stage import LeftOut, Report, Stage, scene
from tests.support.daemon_process import DaemonProcess
from tests.support.disks import HangingDirectory
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment


@contextlib.contextmanager
def hung_mount(path: Path) -> Iterator[Path]:
    """Mount a file system that never answers; at the end of the block all that wait in it get an error."""
    path.mkdir()
    try:
        hanging = HangingDirectory(path)
    except OSError as error:
        raise LeftOut(f"cannot mount with FUSE: {error.strerror}") from None
    try:
        yield path
    finally:
        hanging.end()


def asks_for_what_hangs(orders: Orders, endpoint: str, names: list[str]) -> int:
    """Keep asking for cells whose files cannot be looked at; returns how often."""
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
def hung_files(report: Report, stage: Stage) -> None:
    """Cells that failed, and cells that were never loaded, lie on a mount that hangs; for 15 s."""
    made = stage.new_map()
    names = [name for name, (x, _) in made.corners.items() if x in (-60, 40)]
    for name in names[::2]:
        (made.pcd_dir / name).write_bytes(b"no PCD")
    with stage.served(made.root) as one, hung_mount(made.root / "hung") as hung:
        with RawClient(one.endpoint) as client:
            failed = client.selected(names[::2]).failed
        report.note(
            f"{len(failed)} cells have failed, {len(names[1::2])} were never asked for; now they hang"
        )
        for name in names:
            (made.pcd_dir / name).unlink()
            (made.pcd_dir / name).symlink_to(hung / name)
        with Beside(report, one), Actor(asks_for_what_hangs, one.endpoint, names) as attacker:
            time.sleep(15.0)
            report.note(f"asked for them {attacker.end()} times")


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
def swapped_entries(report: Report, stage: Stage) -> None:
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
            report.must("there were entries to swap", len(entries) >= 36, str(len(entries)))
            report.limit(f"of {len(found)} cells have another's bytes", differing(right, found), 0)
            one.stop()
    finally:
        one.dispose()


def says(client: RawClient, tag: str, *elements: Any) -> list[Any]:
    """Ask, and return the reply also if it is an error."""
    return client.wait_for_any(client.send(tag, *elements), 120.0)


@scene("A17", "Metadata with endless numbers and names is refused in a few words")
def long_metadata(report: Report, stage: Stage) -> None:
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
    with (
        stage.served(made.root) as one,
        Beside(report, one),
        RawClient(one.endpoint, timeout=120.0) as client,
    ):
        for what, line in bad.items():
            metadata.write_text(good + line)
            logged = len(one.log)
            reply = says(client, "reload")
            report.note(f"{what}: {reply[0]} {str(reply[2:])[:120]}")
            report.must("it is no defect of ours", reply[0] != "error" or reply[2] != "internal")
            report.limit("reply", client.last_bytes, 4096, "bytes")
            report.limit("log", len(one.log) - logged, 8192, "bytes")
        report.limit("defects", client.ask("stats")[4].get("defects", 0), 0)


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
