# SPDX-License-Identifier: Apache-2.0
"""A narrow, slow or lossy network link on loopback: a TCP proxy in a process of its own.

``python -m tests.support.slow_link PLAN`` takes a `Plan` as JSON and prints its port.  All connections share
the bandwidth, each direction for itself; TCP's slow start and the bytes of its headers are not imitated.
While the link is out nothing passes in either direction, without an error: bytes from and to a client wait
until the link is back or the client has gone.

A line of stdin that is a JSON list of pairs says from when to when the link is out, in seconds of
`time.monotonic`; any other line is answered with how many bytes the server's side has sent so far.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import random
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NamedTuple, TypeAlias

from tests.support.daemon_process import LineProcess

SIGMA: Final = 0.8
"""Standard deviation of the logarithm of an answer's time."""
CHUNK_BYTES: Final = 16 << 10
AHEAD_S: Final = 0.01
"""Bytes are read this long before the link is free for them: it would idle while the proxy wakes up."""

_Queue: TypeAlias = "asyncio.Queue[tuple[float, bytes]]"
"""Chunks, each with the time at which it arrives."""


class Plan(NamedTuple):
    """Properties of a link.

    Attributes
    ----------
    port
        Of the server behind it, on loopback.
    mbit_s
        Bandwidth of each direction, 10^6 bits a second; 0: any.
    delay_s
        How long a byte takes; a new connection takes two of these more.
    mean_s
        Mean of a log-normal delay of each answer, seconds; 0: none.
    seed
        Seed of these delays.
    """

    port: int
    mbit_s: float = 0.0
    delay_s: float = 0.0
    mean_s: float = 0.0
    seed: int = 0


class SlowLink:
    """A running link."""

    def __init__(self, process: LineProcess) -> None:
        self._process = process
        self.port = int(process.read())
        self.endpoint = f"http://127.0.0.1:{self.port}"

    def go_out(self, periods: Sequence[tuple[float, float]]) -> None:
        """Let nothing pass in these periods, ascending, in seconds of `time.monotonic`."""
        self._process.write(json.dumps(list(periods)))

    def received_bytes(self) -> int:
        """Bytes that the server has sent so far."""
        self._process.write("count")
        return int(self._process.read())


@contextmanager
def slow_link(plan: Plan) -> Iterator[SlowLink]:
    """Run a link until the end of the block."""
    with LineProcess(sys.executable, "-m", "tests.support.slow_link", json.dumps(plan)) as process:
        yield SlowLink(process)


class _Outages:
    """When nothing passes."""

    def __init__(self) -> None:
        self._periods: list[tuple[float, float]] = []

    def set(self, periods: list[tuple[float, float]]) -> None:
        self._periods = sorted(periods)

    def end_of(self, now_s: float) -> float:
        """When bytes that would pass now do pass."""
        for from_s, to_s in self._periods:
            if from_s <= now_s < to_s:
                now_s = to_s
        return now_s


class _Direction:
    """One direction of the link, which all connections share."""

    def __init__(self, mbit_s: float, outages: _Outages) -> None:
        self._s_per_byte = 8e-6 / mbit_s if mbit_s else 0.0
        self._outages = outages
        self.free_s = 0.0
        self.passed_bytes = 0

    def pass_through(self, nbytes: int, now_s: float) -> float:
        """Take the link for these bytes; when the last of them has entered it."""
        self.passed_bytes += nbytes
        began_s = self._outages.end_of(max(self.free_s, now_s))
        self.free_s = began_s + nbytes * self._s_per_byte
        return self._outages.end_of(self.free_s)


class _Connection:
    """A client's connection through the link."""

    def __init__(self, plan: Plan, up: _Direction, down: _Direction, took: random.Random) -> None:
        self._plan, self._up, self._down, self._took = plan, up, down, took
        self._up_from_s = time.monotonic() + 2.0 * plan.delay_s
        self._is_asked = False

    async def run(self, client: tuple[asyncio.StreamReader, asyncio.StreamWriter]) -> None:
        """Pass on until one side ends."""
        server = await asyncio.open_connection("127.0.0.1", self._plan.port)
        queues: list[_Queue] = [asyncio.Queue(), asyncio.Queue()]
        tasks = [
            asyncio.create_task(each)
            for each in (
                self._take_up(client[0], queues[0]),
                _send(queues[0], server[1]),
                self._take_down(server[0], queues[1]),
                _send(queues[1], client[1]),
            )
        ]
        try:
            await asyncio.wait((tasks[0], tasks[3]), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            server[1].close()

    async def _take_up(self, client: asyncio.StreamReader, queue: _Queue) -> None:
        """Read requests until the client closes; answers still in transit are then lost."""
        while data := await client.read(CHUNK_BYTES):
            entered_s = self._up.pass_through(len(data), time.monotonic())
            if not self._is_asked:  # the first bytes of a request: no client here sends the next one before
                self._is_asked = True
                self._up_from_s = max(self._up_from_s, entered_s) + self._longer_s()
            queue.put_nowait((max(entered_s, self._up_from_s) + self._plan.delay_s, data))

    async def _take_down(self, server: asyncio.StreamReader, queue: _Queue) -> None:
        """Read answers, no faster than the link is."""
        while data := await server.read(CHUNK_BYTES):
            self._is_asked = False
            now_s = time.monotonic()
            entered_s = self._down.pass_through(len(data), now_s)
            queue.put_nowait((entered_s + self._plan.delay_s, data))
            await asyncio.sleep(entered_s - now_s - AHEAD_S)
        queue.put_nowait((0.0, b""))

    def _longer_s(self) -> float:
        """Delay of an answer, seconds."""
        mean_s = self._plan.mean_s
        # the mean of a log-normal distribution is exp(mu + sigma^2 / 2)
        return self._took.lognormvariate(math.log(mean_s) - SIGMA**2 / 2, SIGMA) if mean_s else 0.0


async def _send(queue: _Queue, out: asyncio.StreamWriter) -> None:
    """Pass chunks on when they have arrived; an empty one is the end."""
    while (chunk := await queue.get())[1]:
        await asyncio.sleep(chunk[0] - time.monotonic())
        out.write(chunk[1])
        await out.drain()


async def _serve(plan: Plan) -> None:
    outages = _Outages()
    up, down = _Direction(plan.mbit_s, outages), _Direction(plan.mbit_s, outages)
    took = random.Random(plan.seed)
    loop = asyncio.get_running_loop()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError), contextlib.closing(writer):
            await _Connection(plan, up, down, took).run((reader, writer))

    def commands() -> None:
        data = os.read(sys.stdin.fileno(), 1 << 20)  # bytes that a text file buffers would be lost
        if not data:
            loop.remove_reader(sys.stdin)
        for line in data.decode().splitlines():
            if line.startswith("["):
                outages.set([(begin, end) for begin, end in json.loads(line)])
                up.free_s = down.free_s = 0.0
            else:
                print(down.passed_bytes, flush=True)

    server = await asyncio.start_server(accept, "127.0.0.1", 0, limit=CHUNK_BYTES, backlog=1024)
    loop.add_reader(sys.stdin, commands)
    print(server.sockets[0].getsockname()[1], flush=True)
    async with server:
        await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(_serve(Plan(*json.loads(sys.argv[1]))))
