# SPDX-License-Identifier: Apache-2.0
"""The bridge to ROS 2: a reply against a bare DDS echo of its size, and against handles.

    python -m tests.benchmarks.ros_bridge [--rounds 30] [--clients 1000]

A partial reply of 1 MB, and one of 38 MB, over CycloneDDS on the loopback interface. The echo is another
process that answers each request of the same service type with bytes that it has ready, as many as are in
the bridge's reply. The client of both does not look into the replies. Rounds of both alternate in one run;
compare the ratios. Then the same cells as handles, by the Python client of shmmap, which attaches them each
time. With ``--clients`` that many participants come, ask once and leave: what the bridge has more afterwards.

Measured beside those of BENCHMARKS.md: the same cells as handles, attached in Python, 0.35 to 0.7 ms and 9
to 10 ms; after 1000 clients, one after another, 2.9 MiB more, no thread and no descriptor.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import shmmap
from tests.support.bridge_process import BridgeProcess, bridge_environment, dds_domain
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map

SIZES = {"1 MB": (5.0, 4), "38 MB": (119.0, 144)}
"""Half the side of the square that is asked for, and how many cells of 16 384 points are in it."""
SERVICE = "/map/get_partial_pointcloud_map"
ECHO = "/echo"

_ECHO = """
import struct, sys
from cyclonedds.core import WaitSet
from cyclonedds.util import duration
from shmmap_clients.ros_bridge.cdr import CdrWriter
from shmmap_clients.ros_bridge.messages import PARTIAL, ready_made
from shmmap_clients.ros_bridge.participant import open_participant
from shmmap_clients.ros_bridge.service_server import ServiceServer

def of_size(size):
    "A reply of one cell with about this many bytes."
    writer = CdrWriter()
    writer.numbers("QQii", 0, 0, 0, 0)
    writer.text("map")
    writer.numbers("I", 1)
    writer.text("cell")
    writer.numbers("ii", 0, 0)
    writer.text("")
    writer.numbers("III?", 1, 1, 0, False)
    count = size - writer.size - 40
    writer.numbers("III", count, count, count)
    writer.blob(count, lambda place: None)
    writer.numbers("?", True)
    writer.numbers("ffff", 0, 0, 0, 0)
    return writer.content()


domain, participant = open_participant(int(sys.argv[1]))
server = ServiceServer(participant, "/echo", PARTIAL, "1")
waitset = WaitSet(participant)
waitset.attach(server.condition)
replies = {}
print("up", flush=True)
while True:
    waitset.wait(duration(seconds=10))
    for request in server.take():
        message = request.message
        size = int(message.area.radius) * 4
        reply = replies.get(size)
        if reply is None:
            reply = of_size(size)
            replies[size] = reply
        reply[4:20] = struct.pack("<Qq", message.client, message.number)
        why = server.reply(ready_made(PARTIAL.reply, reply))
        assert not why, why
"""


def raw(kind: type[Any]) -> None:
    """Have replies of a type delivered as bytes."""

    def keep(data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
        return _Raw(data)

    kind.deserialize = keep


class _Raw:
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.sample_info: Any = None
        self.client = int.from_bytes(data[4:12], "little")
        self.number = int.from_bytes(data[12:20], "little")


def timed(work: Callable[[], object], count: int) -> list[float]:
    """Milliseconds of each of some calls."""
    times = []
    for _ in range(count):
        start = time.perf_counter()
        work()
        times.append((time.perf_counter() - start) * 1e3)
    return times


def resources(pid: int) -> str:
    """What a process has."""
    status = Path(f"/proc/{pid}/status").read_text()
    memory = next(line.split()[1] for line in status.splitlines() if line.startswith("VmRSS"))
    counts = [len(os.listdir(f"/proc/{pid}/{what}")) for what in ("task", "fd")]
    return f"{counts[0]} threads, {counts[1]} descriptors, {int(memory) / 1024:.1f} MiB"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--clients", type=int, default=0)
    arguments = parser.parse_args()
    os.environ.update(bridge_environment())
    with tempfile.TemporaryDirectory() as directory, dds_domain() as domain:
        town = make_map(Path(directory) / "map", columns=14, rows=14, points=16_384)
        with DaemonProcess(town.root, "--budget", "1G") as daemon, BridgeProcess(daemon, domain) as bridge:
            measure(arguments, daemon, bridge, domain)


def measure(arguments: argparse.Namespace, daemon: DaemonProcess, bridge: BridgeProcess, domain: int) -> None:
    """Measure and print."""
    from shmmap_clients.ros_bridge.messages import PARTIAL, AreaInfo

    from tests.support.ros_peer import ros_peer

    raw(PARTIAL.reply)
    echo = subprocess.Popen([sys.executable, "-c", _ECHO, str(domain)], stdout=subprocess.PIPE, cwd=ROOT)
    try:
        assert echo.stdout is not None
        assert echo.stdout.readline() == b"up\n", "the echo did not start"
        with ros_peer(domain) as peer, shmmap.connect(daemon.endpoint) as client:
            asking, echoing = peer.client(SERVICE, PARTIAL), peer.client(ECHO, PARTIAL)
            for name, (radius, cells) in SIZES.items():
                area = AreaInfo(0.0, 0.0, radius)
                size = len(asking.call(area=area).data)
                quarter = AreaInfo(0.0, 0.0, float(size // 4))
                assert abs(len(echoing.call(area=quarter).data) - size) < 64
                square = shmmap.AutowareSquare(0.0, 0.0, radius)
                assert len(client.area(square)) == cells
                works: dict[str, Callable[[], object]] = {
                    "echo": lambda quarter=quarter: echoing.call(area=quarter),  # type: ignore[misc]
                    "bridge": lambda area=area: asking.call(area=area),  # type: ignore[misc]
                    "handles": lambda square=square: client.area(square),  # type: ignore[misc]
                }
                count, rounds = (20, arguments.rounds) if size < 2e6 else (2, max(arguments.rounds // 4, 3))
                times: dict[str, list[list[float]]] = {}
                for _ in range(rounds):
                    for what, work in works.items():
                        times.setdefault(what, []).append(timed(work, count))
                middle = {what: np.median(blocks, axis=1) for what, blocks in times.items()}
                print(f"{name}: {len(client.area(square))} cells, {size:,} bytes in a reply")
                for what, blocks in times.items():
                    p10, p50, p99 = np.percentile(blocks, [10, 50, 99])
                    print(f"  {what:8} p10 {p10:8.2f} ms  p50 {p50:8.2f} ms  p99 {p99:8.2f} ms", end="")
                    print(
                        f"  {np.median(middle[what] / middle['echo']):.3f} x echo (median of paired blocks)"
                    )
            if arguments.clients:
                bridge.wait_status(clients=0)
                before = resources(bridge.pid)
                started = time.perf_counter()
                for _ in range(arguments.clients):
                    with peer.another() as one:
                        one.client(SERVICE, PARTIAL).call(area=AreaInfo(10.0, 10.0, 1.0))
                took = time.perf_counter() - started
                bridge.wait_status(clients=1)
                print(
                    f"{arguments.clients} clients one after another in {took:.0f} s; the bridge had {before}"
                )
                print(f"  and has {resources(bridge.pid)}")
    finally:
        echo.kill()
        echo.communicate()


if __name__ == "__main__":
    main()
