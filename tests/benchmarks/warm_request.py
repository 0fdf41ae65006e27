# SPDX-License-Identifier: Apache-2.0
"""A warm differential request against a bare ZeroMQ echo of equal sizes, and while cells load.

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
from tests.support.divided_map import DividedMap, make_map, random_points
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


def heavy_cells(made: DividedMap, count: int, points: int) -> list[str]:
    """Add cells far away whose loading is work."""
    rng = np.random.default_rng(9)
    names = []
    for number in range(count):
        corner = (10_000 + 20 * number, 0)
        name = f"heavy_{number}.pcd"
        made.write_cell(name, corner, random_points(rng, corner, points))
        names.append(name)
    made.write_metadata()
    return names


def while_loading(
    one: DaemonProcess, client: RawClient, request: bytes, loader: RawClient, heavy: list[str], passes: int
) -> list[float]:
    """Round trips of warm requests, timed only while cold cells are being loaded for somebody else."""
    times: list[float] = []
    for number in range(passes + 1):
        cold = loader.send("selected", heavy, ["points"], 60.0)
        while not loader.readable():
            start = time.perf_counter()
            client.send_bytes(request)
            client.receive_bytes()
            if number:  # the first pass also starts the loaders
                times.append((time.perf_counter() - start) * 1e6)
        reply = loader.cells_reply(loader.wait_for(cold))
        assert len(reply.cells) == len(heavy), reply.failed
        loader.release()
        loader.ask("evict", heavy)
        while any(name.endswith(".zombie") for name in one.segments()):
            loader.ask("stats")  # a cell asked for again before it is freed is only put back in service
    return times


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--passes", type=int, default=6)
    parser.add_argument("--pin", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        made = make_map(Path(directory) / "map", columns=20, rows=20, points=30)
        heavy = heavy_cells(made, 60, 60_000)
        one = DaemonProcess(made.root, "--budget", "2G").start()
        client, loader = RawClient(one.endpoint), RawClient(one.endpoint)
        area = ["box", -159.0, -159.0, 159.0, 159.0]  # 16 x 16 cells
        inside = client.area(area).cells
        everything = client.area(["box", -300.0, -300.0, 300.0, 300.0]).cells
        assert len(inside) == HELD
        assert len(everything) == 400
        outside = [h for h in everything if h.id not in {i.id for i in inside}]
        held = inside[:: HELD // NEW][:NEW]
        held = [h for h in inside if h not in held] + outside[:NEW]
        assert len(held) == HELD
        rows = [[h.id.removeprefix(client.id_prefix), h.version] for h in held]
        named = pack(["differential", 1, area, ["points"], rows, b"", 10.0])
        packed = pack(
            ["differential", 1, area, ["points"], [], pack_versions([h.version for h in held]), 10.0]
        )
        sizes = {}
        for name, request in (("named", named), ("packed", packed)):
            client.send_bytes(request)
            reply = client.cells_reply(client.receive())
            assert len(reply.cells) == NEW
            assert len(reply.removed or reply.removed_versions) == NEW
            sizes[name] = (len(request), reply.wire_bytes)
        echoes = {n: Echo(f"{one.runtime_dir}/echo-{n}.sock", *sizes[n]) for n in sizes}
        if arguments.pin:
            first, *others = sorted(os.sched_getaffinity(0))
            pin(os.getpid(), {first})
            for pid in (one.pid, *(echo.process.pid for echo in echoes.values())):
                pin(pid, set(others[:1]) or {first})
        times: dict[str, list[float]] = {}
        try:
            for _ in range(arguments.rounds):
                for name, request in (("named", named), ("packed", packed)):
                    times.setdefault(f"echo {name}", []).extend(
                        time_block(echoes[name].socket, echoes[name].request)
                    )
                    times.setdefault(f"shmmap {name}", []).extend(time_block(client.socket, request))
                    times.setdefault(f"shmmap {name}, decoded", []).extend(
                        time_block(client.socket, request, decode=True)
                    )
            times["shmmap packed, loading"] = while_loading(
                one, client, packed, loader, heavy, arguments.passes
            )
        finally:
            for echo in echoes.values():
                echo.close()
            client.close()
            loader.close()
            one.stop()
            one.dispose()
    print(f"named: {sizes['named'][0]} bytes asked, {sizes['named'][1]} answered;", end=" ")
    print(f"packed: {sizes['packed'][0]} asked, {sizes['packed'][1]} answered;", end=" ")
    print(f"{sizes['packed'][1] / NEW:.0f} bytes a handle with everything")
    for name, values in times.items():
        kind = "packed" if "packed" in name else "named"
        p50, p99 = np.percentile(values, [50, 99])
        line = f"{name:34} p50 {p50:7.1f} us  p99 {p99:8.1f} us  n={len(values):6}"
        if "loading" not in name:
            # blocks that were timed next to each other: what disturbs one disturbs the other
            blocks = [np.median(np.reshape(times[n], (-1, BLOCK)), axis=1) for n in (name, f"echo {kind}")]
            line += f"  p50 is {np.median(blocks[0] / blocks[1]):.2f} x echo (median of paired blocks)"
        print(line)
    idle, busy = (np.percentile(times[n], 99) for n in ("shmmap packed", "shmmap packed, loading"))
    print(f"p99 while cells load: {busy / idle:.2f} x idle")


if __name__ == "__main__":
    main()
