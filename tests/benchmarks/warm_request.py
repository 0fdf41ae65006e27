# SPDX-License-Identifier: Apache-2.0
"""A warm differential request against a bare ZeroMQ echo of equal sizes.

    python -m tests.benchmarks.warm_request [--rounds 40] [--pin]

The client holds 256 cells and asks for an area that brings it 40 new ones and takes 40 away; all are
in memory.  The echo is a ROUTER in another process that answers a frame as long as our request
with a frame as long as our reply.  Rounds of both alternate in one run; compare the ratios.
``--pin`` gives the client one processor and both servers another: without it the scheduler may
place the two differently, which alone is worth a factor of two.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from shmmap.protocol.codec import decode_reply
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient, pack_versions

HELD, NEW = 256, 40
BLOCK = 100

_ECHO = """
import sys, zmq
socket = zmq.Context().socket(zmq.ROUTER)
socket.bind("ipc://" + sys.argv[1])
print("up", flush=True)
while True:
    identity = socket.recv()
    request = socket.recv(copy=False)
    size = int.from_bytes(request.buffer[:4], "little")
    socket.send(identity, zmq.SNDMORE)
    socket.send(bytes(size))
"""


class Echo:
    """The bare round trip."""

    def __init__(self, path: str, request_bytes: int, reply_bytes: int) -> None:
        self.process = subprocess.Popen([sys.executable, "-c", _ECHO, path], stdout=subprocess.PIPE, cwd=ROOT)
        assert self.process.stdout is not None
        self.process.stdout.readline()
        self.context: zmq.Context[Any] = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.connect(f"ipc://{path}")
        self.request = reply_bytes.to_bytes(4, "little") + bytes(request_bytes - 4)

    def close(self) -> None:
        """End both sides."""
        self.socket.close(linger=0)
        self.context.term()
        self.process.kill()
        self.process.communicate()


def time_block(socket: zmq.Socket[bytes], request: bytes, *, decode: bool = False) -> list[float]:
    """Microseconds of each of a block of round trips."""
    times = []
    for _ in range(BLOCK):
        start = time.perf_counter()
        socket.send(request)
        reply = socket.recv()
        if decode:
            decode_reply(reply)
        times.append((time.perf_counter() - start) * 1e6)
    return times


def pin(pid: int, processors: set[int]) -> None:
    """Keep every thread of a process on these processors."""
    for thread in os.listdir(f"/proc/{pid}/task"):
        os.sched_setaffinity(int(thread), processors)


class Warm:
    """A client that holds 256 cells, and its requests that bring 40 new ones and take 40 away.

    Parameters
    ----------
    one
        The daemon; has all cells around the place in memory afterwards.
    x, y
        Corner of a cell in the middle of at least 18 x 18 cells of 20 m.
    """

    def __init__(self, one: DaemonProcess, x: float = 0.0, y: float = 0.0) -> None:
        self.client = RawClient(one.endpoint, timeout=120.0)
        area = ["box", x - 159.0, y - 159.0, x + 159.0, y + 159.0]  # 16 x 16 cells
        inside = self.client.area(area).cells
        around = self.client.area(["box", x - 179.0, y - 179.0, x + 179.0, y + 179.0]).cells
        assert len(inside) == HELD
        outside = [h for h in around if h.id not in {i.id for i in inside}]
        self._open = [
            os.open(self.client.path(handle), os.O_RDONLY) for handle in around
        ]  # as a client that maps them
        held = inside[:: HELD // NEW][:NEW]
        held = [h for h in inside if h not in held] + outside[:NEW]
        assert len(held) == HELD
        rows = [[h.id.removeprefix(self.client.id_prefix), h.version] for h in held]
        self.held = [h.version for h in held]
        versions = pack_versions(self.held)
        self.requests = {
            "named": pack(["differential", 1, area, ["points"], rows, b"", 10.0]),
            "packed": pack(["differential", 1, area, ["points"], [], versions, 10.0]),
        }
        self.sizes = {}
        for name, request in self.requests.items():
            self.client.send_bytes(request)
            reply = self.client.cells_reply(self.client.receive())
            assert len(reply.cells) == NEW, reply.pending
            assert len(reply.removed or reply.removed_versions) == NEW
            self.sizes[name] = (len(request), reply.wire_bytes)

    def close(self) -> None:
        """Release everything."""
        self.client.close()
        for fd in self._open:
            os.close(fd)

    def echo(self, one: DaemonProcess, name: str) -> Echo:
        """Return an echo of messages as long as those of a kind of request."""
        return Echo(f"{one.runtime_dir}/echo-{name}.sock", *self.sizes[name])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--pin", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        made = make_map(Path(directory) / "map", columns=20, rows=20, points=30)
        one = DaemonProcess(made.root, "--budget", "2G").start()
        warm = Warm(one)
        sizes = warm.sizes
        echoes = {name: warm.echo(one, name) for name in sizes}
        if arguments.pin:
            first, *others = sorted(os.sched_getaffinity(0))
            pin(os.getpid(), {first})
            for pid in (one.pid, *(echo.process.pid for echo in echoes.values())):
                pin(pid, set(others[:1]) or {first})
        times: dict[str, list[float]] = {}
        try:
            for _ in range(arguments.rounds):
                for name, request in warm.requests.items():
                    times.setdefault(f"echo {name}", []).extend(
                        time_block(echoes[name].socket, echoes[name].request)
                    )
                    times.setdefault(f"shmmap {name}", []).extend(time_block(warm.client.socket, request))
                    times.setdefault(f"shmmap {name}, decoded", []).extend(
                        time_block(warm.client.socket, request, decode=True)
                    )
        finally:
            for echo in echoes.values():
                echo.close()
            warm.close()
            one.stop()
            one.dispose()
    print(f"named: {sizes['named'][0]} bytes asked, {sizes['named'][1]} answered;", end=" ")
    print(f"packed: {sizes['packed'][0]} asked, {sizes['packed'][1]} answered;", end=" ")
    print(f"{sizes['packed'][1] / NEW:.0f} bytes a handle with everything")
    for name, values in times.items():
        kind = "packed" if "packed" in name else "named"
        p50, p99 = np.percentile(values, [50, 99])
        # blocks that were timed next to each other: what disturbs one disturbs the other
        blocks = [np.median(np.reshape(times[n], (-1, BLOCK)), axis=1) for n in (name, f"echo {kind}")]
        ratio = np.median(blocks[0] / blocks[1])
        print(
            f"{name:34} p50 {p50:7.1f} us  p99 {p99:8.1f} us  n={len(values):6}"
            f"  p50 is {ratio:.2f} x echo (median of paired blocks)"
        )


if __name__ == "__main__":
    main()
