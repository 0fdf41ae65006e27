# SPDX-License-Identifier: Apache-2.0
"""Requests that ask for very much: many that wait, costly layers, and a client at its quota."""

from __future__ import annotations

import time
from typing import Any, Final

from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.report import Report
from tests.benchmarks.hostile.stage import Stage, scene
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient

SIDE: Final = 141
"""19 881 cells, as many as one request may ask for."""
EVERYTHING: Final = ["box", -1.0, -1.0, 1e6, 1e6, None, None]
REPLY_S: Final = 120.0


def waits_with_many_requests(
    orders: Orders, endpoint: str, counts: list[int], wait_s: float
) -> dict[str, int]:
    """In waves: some sessions send requests that wait for the whole map, and all fall due at once."""
    sessions = [RawClient(endpoint, name="waits") for _ in counts]
    found = {"waves": 0, "answers": 0, "refused": 0, "most_bytes": 0}
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
                found["most_bytes"] = max(found["most_bytes"], len(reply))
        orders.say(dict(found))
    return found


@scene("A2", "A process's waiting requests are not answered all in one turn")
def waiting_requests(told: Report, stage: Stage) -> None:
    """One session with 64 requests for 20 000 cells each, then four sessions with 229."""
    with stage.served(stage.many_cells(SIDE), "--budget", "1G") as one, Beside(told, one):
        for counts in ([64], [58, 57, 57, 57]):
            with Actor(waits_with_many_requests, one.endpoint, counts, 3.0) as attacker:
                found = attacker.said(600.0)
            told.tell(f"{len(counts)} sessions, {sum(counts)} waiting requests of {SIDE**2} cells: {found}")


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
def halo_layers(told: Report, stage: Stage) -> None:
    """Differentials with normals(radius=50) over 20 000 cells, for 20 s."""
    with (
        stage.served(stage.many_cells(SIDE), "--budget", "1G", "--cache-size", "0") as one,
        Beside(told, one),
        Actor(asks_for_normals, one.endpoint) as attacker,
    ):
        time.sleep(20.0)
        told.tell(
            f"normals(radius=50) of {SIDE**2} cells, every other request also of radius 49: {attacker.end()}"
        )
