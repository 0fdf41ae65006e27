# SPDX-License-Identifier: Apache-2.0
"""Requests that ask for very much, and layers that take long, are many, or grow when a file is read."""

from __future__ import annotations

import os
import struct
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside, private_bytes
from tests.benchmarks.hostile.stage import Report, Stage, scene
from tests.support.daemon_process import ROOT
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient, circle

SIDE: Final = 141
"""19 881 cells, as many as one request may ask for."""
EVERYTHING: Final = ["box", -1.0, -1.0, 1e6, 1e6, None, None]
REPLY_S: Final = 120.0


def waits_with_many_requests(
    orders: Orders, endpoint: str, counts: list[int], wait_s: float
) -> dict[str, int]:
    """In waves: some sessions send requests that wait for the whole map, and all fall due at once."""
    sessions = [RawClient(endpoint, name="waits") for _ in counts]
    found = {"waves": 0, "answers": 0, "refused": 0, "max_bytes": 0}
    while orders.go_on():
        found["waves"] += 1
        for session, count in zip(sessions, counts, strict=True):
            for _ in range(count):
                session.send("area", EVERYTHING, ["points"], wait_s, None)
        for session, count in zip(sessions, counts, strict=True):
            for _ in range(count):
                if not session.socket.poll(int(REPLY_S * 1e3)) or not orders.go_on():
                    return found
                reply = session.receive_bytes()
                found["refused" if len(reply) < 300 else "answers"] += 1
                found["max_bytes"] = max(found["max_bytes"], len(reply))
        orders.say(dict(found))
    return found


@scene("A2", "A process's waiting requests are not answered all in one turn")
def waiting_requests(report: Report, stage: Stage) -> None:
    """One session with 64 requests for 20 000 cells each, then four sessions with 229."""
    with stage.served(stage.many_cells(SIDE), "--budget", "1G") as one, Beside(report, one):
        for counts in ([64], [58, 57, 57, 57]):
            with Actor(waits_with_many_requests, one.endpoint, counts, 3.0) as attacker:
                found = attacker.said(600.0)
            report.note(f"{len(counts)} sessions, {sum(counts)} waiting requests of {SIDE**2} cells: {found}")


def asks_for_normals(orders: Orders, endpoint: str) -> dict[str, Any]:
    """Ask for a layer whose cells look at their neighbours, of the whole map; every other one is refused."""
    asks = (["normals(radius=50)"], ["normals(radius=50)", "normals(radius=49)"])
    found = {"requests": 0, "refused": 0}
    with RawClient(endpoint, name="normals", timeout=REPLY_S) as client:
        while orders.go_on():
            layers = asks[found["requests"] % 2]
            client.send_bytes(pack(["differential", 1, EVERYTHING, layers, [], b"", None, None]))
            try:
                reply = client.receive()
            except TimeoutError:
                break
            found["requests"] += 1
            found["refused"] += reply[0] == "error"
    return found


@scene("A6", "Layers that look at neighbours cost nothing before the limits are checked, and little after")
def halo_layers(report: Report, stage: Stage) -> None:
    """Differentials with normals(radius=50) over 20 000 cells, for 20 s."""
    with (
        stage.served(stage.many_cells(SIDE), "--budget", "1G", "--cache-size", "0") as one,
        Beside(report, one),
        Actor(asks_for_normals, one.endpoint) as attacker,
    ):
        time.sleep(20.0)
        report.note(
            f"normals(radius=50) of {SIDE**2} cells, every other request also of radius 49: {attacker.end()}"
        )


SLOW_S: Final = 5.0
SLOW_KIND: Final = """
import time
import numpy as np
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter


def build(points, parameters):
    time.sleep(parameters["seconds"])
    return LayerTable({"count": np.array([len(points)])}, rows=1, units={"count": ""})


SLOW = LayerKind(
    name="slow", builder_version=1, summary="takes long", borders="none",
    parameters=(Parameter("seconds", float, "how long", "s", default=5.0, minimum=0.0, maximum=50.0),),
    columns=(LayerColumn("count", np.dtype("<i8"), "", "", "points"),), build=build,
)
"""


def install_slow_kind(directory: Path) -> str:
    """Make a package that offers a layer kind that takes long; returns what to put on the module path."""
    information = directory / "slow_kind-1.0.dist-info"
    information.mkdir(parents=True, exist_ok=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: slow-kind\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[shmmap.layers]\nslow = slow_kind:SLOW\n")
    (directory / "slow_kind.py").write_text(SLOW_KIND)
    return str(directory)


def asks_for_slow_layers(orders: Orders, endpoint: str) -> str:
    """Ask for a layer that takes long, of many cells, and wait."""
    with RawClient(endpoint, name="slow") as client:
        client.send("area", circle(-120.0, -120.0, 70.0), [f"slow(seconds={SLOW_S})"], 600.0, None)
        client.ask("stats")
        orders.say("asked")
        while orders.go_on(60.0):
            pass
    return "ended"


def cold_cell_s(client: RawClient, names: list[str]) -> list[float]:
    """Seconds that each of some cold cells takes, one after the other."""
    times = []
    for name in names:
        begin_s = time.monotonic()
        (_,) = client.selected([name], wait=200.0).cells
        times.append(time.monotonic() - begin_s)
    return times


@scene("A7", "Layers that take long do not hold up another client's cold cell")
def slow_layers(report: Report, stage: Stage) -> None:
    """About 35 layers of 5 s each are wanted; a cold cell of another client, five times."""
    made = stage.new_map(columns=20, rows=20, points=2000)
    path = f"{ROOT}{os.pathsep}{install_slow_kind(stage.scratch / 'slow_kind')}"
    with (
        stage.served(made.root, "--cache-size", "0", environment={"PYTHONPATH": path}) as one,
        RawClient(one.endpoint, timeout=300.0) as client,
        Beside(report, one),
    ):
        (_,) = client.ask("area", circle(150, 150, 0.1), ["slow(seconds=0)"], 60.0, None)[4]
        alone = max(cold_cell_s(client, [f"100_{y}.pcd" for y in range(-200, -100, 20)]))
        with Actor(asks_for_slow_layers, one.endpoint) as attacker:
            attacker.said()
            beside = cold_cell_s(client, [f"120_{y}.pcd" for y in range(-200, -100, 20)])
        report.note(
            f"a cold cell took at most {alone:.3f} s alone; beside slow layers "
            + ", ".join(f"{took:.2f}" for took in beside)
        )
        report.limit("longest, over that alone", max(beside) - alone, 1.0, "s")


LAYERS: Final = 1491
"""As many as may be in memory at once, of a map of 22 500 cells."""


def uses_up_layers(orders: Orders, endpoint: str) -> dict[str, int]:
    """Ask for one cell in one layer after the other, and leave."""
    found = {"layers": 0, "refused": 0}
    with RawClient(endpoint, name="layers", timeout=120.0) as client:
        for first in range(0, LAYERS + 64, 16):
            specs = [f"voxel(leaf={1.0 + number / 1000:.3f})" for number in range(first, first + 16)]
            reply = client.wait_for_any(client.send("area", circle(10.0, 10.0, 0.1), specs, 60.0, None))
            found["refused" if reply[0] == "error" else "layers"] += 16
    return found


@scene("A8", "The number of different layers cannot be used up for good")
def layers_used_up(report: Report, stage: Stage) -> None:
    """One cell in 1491 different layers and more; then another client wants another one."""
    with stage.served(stage.many_cells(150), "--cache-size", "0") as one, Beside(report, one):
        with Actor(uses_up_layers, one.endpoint) as attacker:
            report.note(f"one client, one cell: {attacker.said(600.0)}")
        with RawClient(one.endpoint) as client:
            for layer in ("voxel(leaf=3.3)", "ndt(leaf=2.5)"):
                reply = client.wait_for_any(
                    client.send("area", circle(410.0, 410.0, 0.1), [layer], 60.0, None)
                )
                report.must(
                    f"another client gets {layer}", reply[0] == "cells" and len(reply[4]) == 1, reply[3]
                )


BOMB_BYTES: Final = 34 << 20
LOADER_MIB: Final = 1024.0


def write_bomb(path: Path) -> int:
    """Write a sound compressed PCD file whose points take 88 times its size; returns their bytes."""
    runs = BOMB_BYTES // 3
    size = 1 + 264 * runs
    points = size // 16
    body = b"\x00\x00" + b"\xe0\xff\x00" * ((points * 16 - 1) // 264)
    rest = points * 16 - 1 - 264 * ((points * 16 - 1) // 264)
    body += b"".join(b"\x00\x00" for _ in range(rest))
    header = (
        f"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {points}\n"
        f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary_compressed\n"
    )
    path.write_bytes(header.encode() + struct.pack("<II", len(body), points * 16) + body)
    return points * 16


@scene("A9", "A compressed file that grows to gigabytes takes neither the loader nor its neighbours with it")
def bomb(report: Report, stage: Stage) -> None:
    """34 MiB that become 3 GiB, wanted as a computed layer, and a neighbour's normals."""
    made = stage.new_map()
    nbytes = write_bomb(made.pcd_dir / "40_40.pcd")
    report.note(f"{BOMB_BYTES / 1e6:.0f} MB of LZF become {nbytes / 1e9:.2f} GB")
    with (
        stage.served(made.root, "--budget", "256M", "--cache-size", "0") as one,
        Beside(report, one),
        RawClient(one.endpoint, timeout=300.0) as client,
    ):
        for x, layer in ((50.0, "voxel(leaf=1.0)"), (30.0, "normals(radius=5)")):
            begin_s, peak = time.monotonic(), 0
            client.send("area", circle(x, 50.0, 0.1), [layer], 200.0, None)
            while not client.readable():
                peak = max([peak, *(private_bytes(pid) for pid in one.children())])
                time.sleep(0.02)
            reply = client.receive()
            failed = [(failure[2], failure[3][:100]) for failure in reply[8]]
            report.note(
                f"{layer} at x = {x:g}: {time.monotonic() - begin_s:.1f} s, {len(reply[4])} cells, {failed}"
            )
            report.limit("private memory of a loader", peak / (1 << 20), LOADER_MIB, "MiB")


HELD: Final = 20_000
"""As many as one request may name."""


def holds_very_many(orders: Orders, endpoint: str, known: bool) -> dict[str, int]:
    """Ask for what changed around a place, and name 20 000 held versions; ``known``: also the map's."""
    found = {"requests": 0, "reply_bytes": 0}
    with RawClient(endpoint, name="holds", timeout=REPLY_S) as client:
        versions = [cell.version for cell in client.area(EVERYTHING, wait=60.0).cells] if known else []
        packed = b"".join(struct.pack("<Q", version) for version in versions) + os.urandom(
            8 * (HELD - len(versions))
        )
        request = pack(["differential", 1, circle(0, 0, 30.0), ["points"], [], packed, None, None])
        orders.say("begins")
        while orders.go_on():
            client.send_bytes(request)
            reply = client.receive_bytes()
            found["requests"] += 1
            found["reply_bytes"] = len(reply)
    return found


@scene("A24", "Differentials that name very many versions delay no one")
def versions_held(report: Report, stage: Stage) -> None:
    """Four clients, one request after the other, with 20 000 packed versions each, for 20 s."""
    with stage.served(stage.many_cells(SIDE), "--budget", "1G") as one, ExitStack() as stack:
        attackers = [
            stack.enter_context(Actor(holds_very_many, one.endpoint, number % 2 == 1)) for number in range(4)
        ]
        for attacker in attackers:
            attacker.said(600.0)
        with Beside(report, one):
            time.sleep(20.0)
        for attacker in attackers:
            report.note(f"differentials of {HELD} versions: {attacker.end()}")
