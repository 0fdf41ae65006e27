# SPDX-License-Identifier: Apache-2.0
"""Those who have nothing to do with an attack: a client, a bare echo and its client, and newcomers."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import zmq

from tests.benchmarks.hostile.actors import Orders
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient

__all__ = ["PERIOD_S", "Seen", "asks_the_daemon", "asks_the_echo", "echoes", "newcomers", "works"]

PERIOD_S: Final = 0.005
LOST_S: Final = 120.0
NEWCOMER_S: Final = 0.5


@dataclass
class Seen:
    """What a paced client saw.

    Attributes
    ----------
    times_ms
        Of each round trip.  Somebody who would have asked in every period of a stall would have waited for
        its rest: those are in the list, too.
    longest_s
        When the longest one began and ended, by the monotonic clock.
    odd
        Answers that had another length than expected.
    """

    times_ms: list[float] = field(default_factory=list)
    longest_s: tuple[float, float] = (0.0, 0.0)
    odd: int = 0


def paced(orders: Orders, socket: zmq.Socket[bytes], request: bytes, expected: int) -> Seen:
    """Ask once a period until told to end."""
    seen = Seen()
    next_s = time.perf_counter()
    while orders.go_on(max(0.0, next_s - time.perf_counter())):
        begin_s = time.perf_counter()
        socket.send(request)
        lost = not socket.poll(int(LOST_S * 1e3))
        seen.odd += lost or len(socket.recv()) != expected
        now_s = time.perf_counter()
        took_s = now_s - begin_s
        if took_s > seen.longest_s[1] - seen.longest_s[0]:
            seen.longest_s = begin_s, now_s
        while took_s > 0:
            seen.times_ms.append(took_s * 1e3)
            took_s -= PERIOD_S
        if lost:
            break
        next_s = max(next_s + PERIOD_S, now_s)
    return seen


def asks_the_daemon(orders: Orders, endpoint: str, area: list[Any]) -> Seen:
    """A client that asks for the warm cells of an area; says first how long request and reply are."""
    with RawClient(endpoint, name="probe", timeout=LOST_S) as client:
        request = pack(["area", 1, area, ["points"], None])
        client.send_bytes(request)
        reply = client.receive_bytes()
        orders.say((len(request), len(reply)))
        return paced(orders, client.socket, request, len(reply))


def echoes(orders: Orders, path: str) -> None:
    """A server that does nothing but answer: a frame as long as the request's first four bytes say."""
    context = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.linger = 0
    socket.bind(f"ipc://{path}")
    orders.say("up")
    while True:  # killed at the end
        identity, request = socket.recv_multipart()
        socket.send_multipart([identity, bytes(int.from_bytes(request[:4], "little"))])


def asks_the_echo(orders: Orders, path: str, asked: int, answered: int) -> Seen:
    """The same as `asks_the_daemon`, of the echo."""
    with RawClient(path, hello=False) as client:
        request = answered.to_bytes(4, "little") + bytes(asked - 4)
        client.send_bytes(request)
        client.receive_bytes()
        orders.say("up")
        return paced(orders, client.socket, request, answered)


def newcomers(orders: Orders, endpoint: str, radius_m: float) -> tuple[list[float], Counter[str]]:
    """One new client after another connects with the library's defaults, maps cells and reads from them.

    Returns
    -------
    list of float
        Seconds of those that got what they wanted.
    Counter of str
        What the others were told.
    """
    import shmmap

    times: list[float] = []
    told: Counter[str] = Counter()
    orders.say("up")
    while orders.go_on(NEWCOMER_S):
        begin_s = time.perf_counter()
        try:
            with shmmap.connect(endpoint, name="newcomer") as client:
                cells = client.around(0.0, 0.0, radius_m)
                read = sum(float(cell.xyz[0, 0]) for cell in cells)
                assert cells
                assert read == read
                del cells
        except Exception as error:
            told[f"{type(error).__name__}: {error}".split("\n")[0][:150]] += 1
        else:
            times.append(time.perf_counter() - begin_s)
    return times, told


def works(orders: Orders) -> tuple[float, float]:
    """Do the same 0.4 ms of work every 5 ms: how slow the machine itself is.

    Returns
    -------
    The processor time that 99.9 % of them do not exceed, and that of the longest, milliseconds.
    """
    took_ms: list[float] = []
    while orders.go_on(PERIOD_S):
        begin_s = time.thread_time()
        sum(range(20_000))
        took_ms.append((time.thread_time() - begin_s) * 1e3)
    return float(np.quantile(took_ms, 0.999)), max(took_ms)
