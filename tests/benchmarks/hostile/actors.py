# SPDX-License-Identifier: Apache-2.0
"""Processes in a scene: what runs one, bystanders of an attack, and clients that only work."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Final

import numpy as np
import zmq

from shmmap.processes.end_with_parent import die_with
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient

_SPAWN: Final = multiprocessing.get_context("spawn")
TIMEOUT_S: Final = 300.0


class Orders:
    """What an actor's function is given first."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def say(self, what: Any) -> None:
        """Send a message to the scene."""
        self._pipe.send(("said", what))

    def go_on(self, pause_s: float = 0.0) -> bool:
        """Wait ``pause_s`` seconds; False as soon as the scene wants the end."""
        return not self._pipe.poll(pause_s)


def _play(
    parent: int,
    is_bystander: bool,
    pipe: Connection,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
) -> None:
    die_with(parent)
    if not is_bystander:
        os.setsid()  # the scheduler shares processors between sessions: not those of what is measured
    try:
        last = "returned", function(Orders(pipe), *arguments)
    except Exception:
        last = "raised", traceback.format_exc()
    with contextlib.suppress(OSError):  # the scene has ended
        pipe.send(last)


class Actor:
    """A process that runs ``function(orders, *arguments)``; killed where its ``with`` block ends.

    Parameters
    ----------
    is_bystander
        It belongs to those that measure; else it is in a session of its own.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any, is_bystander: bool = False) -> None:
        self.name = function.__name__
        self._pipe, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(
            target=_play, args=(os.getpid(), is_bystander, theirs, function, arguments), daemon=True
        )
        self._process.start()
        theirs.close()

    def __enter__(self) -> Actor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.join()

    @property
    def pid(self) -> int:
        """Its process id."""
        assert self._process.pid is not None
        return self._process.pid

    def said(self, timeout_s: float = TIMEOUT_S) -> Any:
        """Wait for what it says next, or for what its function returns.

        Raises
        ------
        RuntimeError
            It raised an exception, died, or says nothing for so long.
        """
        return self._next(timeout_s)[1]

    def end(self, timeout_s: float = TIMEOUT_S) -> Any:
        """Ask it to end, and return what its function returns; errors as of `said`."""
        with contextlib.suppress(OSError):  # it has ended by itself
            self._pipe.send("end")
        how = what = None
        while how != "returned":
            how, what = self._next(timeout_s)
        return what

    def _next(self, timeout_s: float) -> tuple[str, Any]:
        try:
            if not self._pipe.poll(timeout_s):
                raise RuntimeError(f"{self.name} says nothing for {timeout_s:g} s")
            how, what = self._pipe.recv()
        except (EOFError, ConnectionResetError):
            raise RuntimeError(f"{self.name} died") from None
        if how == "raised":
            raise RuntimeError(f"{self.name}: {what}")
        return how, what

    def kill(self) -> None:
        """End it now, whatever it does."""
        self._process.kill()
        self._process.join()


PERIOD_S: Final = 0.005
LOST_S: Final = 120.0
NEWCOMER_S: Final = 0.5


@dataclass
class Seen:
    """What a paced client saw.

    Attributes
    ----------
    times_ms
        Of each round trip, and of those that a stall left no time for: a request due in a stall counts
        with the rest of the stall.
    longest_s
        When the longest one began and ended, by the monotonic clock.
    odd
        Answers that had another length than expected.
    """

    times_ms: list[float] = field(default_factory=list)
    longest_s: tuple[float, float] = (0.0, 0.0)
    odd: int = 0


def paced(orders: Orders, socket: zmq.Socket[bytes], request: bytes, expected: int) -> Seen:
    """Ask once a period until the scene ends."""
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
        Errors of the others.
    """
    import shmmap

    times: list[float] = []
    refusals: Counter[str] = Counter()
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
            refusals[f"{type(error).__name__}: {error}".split("\n")[0][:150]] += 1
        else:
            times.append(time.perf_counter() - begin_s)
    return times, refusals


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


STEP_M: Final = 140.0
INSIDE_M: Final = STEP_M - 21.0
"""So wide a box touches 6 cells of 20 m, and the next one none of them."""
WALK_TIMEOUT_S: Final = 900.0


def places(x_m: tuple[float, float], y_m: tuple[float, float]) -> list[tuple[float, float]]:
    """Corners of the steps of a walk over a rectangle of the map, row by row."""
    xs, ys = (
        [low + 1.0 + STEP_M * number for number in range(max(1, int((high - low) // STEP_M)))]
        for low, high in (x_m, y_m)
    )
    return [(x, y) for y in ys for x in xs]


def walks_cold(
    orders: Orders,
    endpoint: str,
    seconds: float,
    x_m: tuple[float, float],
    y_m: tuple[float, float],
    once: bool = False,
) -> tuple[int, float]:
    """Walk over a rectangle, ask for 36 cells at each step, and release them.

    Parameters
    ----------
    once
        Do not begin again at its end, where cells may still be in memory.

    Returns
    -------
    int
        Cells that were loaded meanwhile: what is still in memory from the last time does not count.
    float
        Seconds it took, less than ``seconds`` if the scene ends it.
    """
    with RawClient(endpoint, name="walks", timeout=WALK_TIMEOUT_S) as client:
        before = client.ask("stats")[4]["loads_finished"]
        begin_s = time.monotonic()
        path = places(x_m, y_m)
        for x, y in path if once else itertools.cycle(path):
            if time.monotonic() - begin_s > seconds or not orders.go_on():
                break
            client.area(["box", x, y, x + INSIDE_M, y + INSIDE_M, None, None], wait=60.0)
            client.release()
        took_s = time.monotonic() - begin_s
        return client.ask("stats")[4]["loads_finished"] - before, took_s


def fills(orders: Orders, endpoint: str, side: int, most: int) -> int:
    """Have the cells of a map of ``side`` x ``side`` loaded, row by row, until ``most`` came."""
    came = 0
    with RawClient(endpoint, name="fills", timeout=WALK_TIMEOUT_S) as client:
        for row in range(side):
            columns = min(side, most - came)
            if columns <= 0:
                break
            y = 20.0 * row + 1.0
            reply = client.area(["box", 1.0, y, 20.0 * columns - 1.0, y + 1.0, None, None], wait=600.0)
            came += len(reply.cells)
            client.release()
    return came
