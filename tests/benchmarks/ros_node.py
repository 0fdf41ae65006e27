# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node against a bare rclpy service over Fast DDS, and what it bears.

    python -m tests.support.ros                   # once: an environment with ROS 2
    python -m tests.benchmarks.ros_node [PART...]

``pairs``: a partial reply of 1 MB, and one of 38 MB, in pairs of calls that alternate; the bare service
answers with messages of the same cells that it has ready.  ``beside``: a request for cells in memory, alone
and beside 20 whose loaders stand still.  ``memory``: 300 requests.  ``stopped``: one client has stopped, and
another gets 10 MB a second.  ``ends``: time from SIGINT to the end, in pairs with a bare node.  ``around``:
processor time of the node while ``~/around`` follows a vehicle at 10 m/s whose ``/tf`` comes at 50 Hz.

Measured beside those of BENCHMARKS.md: 4 warm cells while 20 requests wait for loads take 1.2 to 1.5 times
as long as alone (18 ms); beside a client that has stopped, while another gets 10 MB a second, the node
grows by 162 MB in 20 s, until ROS gives that client up, and by nothing from there on; over the last 250 of
300 requests of 4 to 36 cells the node has 159 to 160 MB; from SIGINT to the end it takes 0 to 0.2 s more
than a bare rclpy node (0.25 to 0.5 s); ``~/around`` takes 4.5 to 4.8 % of a core, and 0.5 % without a
subscriber.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from tests.support.daemon_process import DaemonProcess
    from tests.support.ros.processes import RosDomain

SIZES: Final = {"1 MB": (5.0, 4), "38 MB": (119.0, 144)}
"""Half the side of the square that is asked for, and how many cells of 16 384 points are in it."""
SERVICES: Final = {"node": "/map/get_partial_pointcloud_map", "bare": "/bare/get_partial_pointcloud_map"}
TEN_MB: Final = 59.0
WITHIN_S: Final = 120.0


# --- what runs under the interpreter that has rclpy ------------------------------------------------------


def serve_bare(endpoint: str) -> None:
    """A service that answers with messages that it has ready."""
    import rclpy
    from autoware_map_msgs.msg import PointCloudMapCellMetaData, PointCloudMapCellWithID
    from autoware_map_msgs.srv import GetPartialPointCloudMap
    from shmmap_clients.ros_node import to_point_cloud2

    import shmmap

    rclpy.init()
    node, ready = rclpy.create_node("bare"), {}
    with shmmap.connect(endpoint) as client:
        for radius, _ in SIZES.values():
            ready[radius] = [
                PointCloudMapCellWithID(
                    cell_id=cell.id,
                    pointcloud=to_point_cloud2(cell),
                    metadata=PointCloudMapCellMetaData(
                        **dict(zip(("min_x", "min_y", "max_x", "max_y"), cell.box, strict=True))
                    ),
                )
                for cell in client.area(shmmap.AutowareSquare(0.0, 0.0, radius), wait=WITHIN_S)
            ]

    def answer(request: Any, reply: Any) -> Any:
        reply.new_pointcloud_with_ids = ready[request.area.radius]
        return reply

    node.create_service(GetPartialPointCloudMap, SERVICES["bare"], answer)
    print("up", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        rclpy.spin(node)


class Asking:
    """A client of the node and of the bare service."""

    def __init__(self) -> None:
        import rclpy
        from autoware_map_msgs.srv import GetPartialPointCloudMap
        from rclpy.qos import QoSProfile

        rclpy.init()
        self._rclpy, self._request = rclpy, GetPartialPointCloudMap.Request
        self._node = rclpy.create_node(f"asking_{os.getpid()}")
        self._clients = {
            what: self._node.create_client(GetPartialPointCloudMap, name, qos_profile=QoSProfile(depth=100))
            for what, name in SERVICES.items()
        }
        self._sent: list[Any] = []

    def _send(self, what: str, x: float, y: float, radius: float) -> Any:
        client = self._clients[what]
        assert client.wait_for_service(timeout_sec=WITHIN_S)
        request = self._request()
        request.area.center_x, request.area.center_y, request.area.radius = x, y, radius
        return client.call_async(request)

    def ask(self, what: str, radius: float, count: int = 1) -> list[float]:
        """Ask some times, one after another; returns milliseconds of each."""
        times = []
        for _ in range(count):
            begin = time.perf_counter()
            future = self._send(what, 0.0, 0.0, radius)
            self._rclpy.spin_until_future_complete(self._node, future, timeout_sec=WITHIN_S)
            times.append((time.perf_counter() - begin) * 1e3)
            assert future.result().new_pointcloud_with_ids
        return times

    def pairs(self, radius: float, count: int) -> dict[str, list[float]]:
        """Ask both in turn; the first pair does not count."""
        times: dict[str, list[float]] = {what: [] for what in SERVICES}
        for turn in range(count + 1):
            for what in list(SERVICES)[:: 1 if turn % 2 else -1]:
                times[what] += self.ask(what, radius)[:turn]
        return times

    def begin(self, places: list[tuple[float, float]]) -> None:
        """Ask for single cells, and do not wait for them."""
        self._sent += [self._send("node", x, y, 1.0) for x, y in places]

    def left(self) -> int:
        """How many of these have no answer."""
        return sum(not one.done() for one in self._sent)


def drive() -> None:
    """Drive to and fro at 10 m/s, for as long as the input is open; subscribe when it says so."""
    import rclpy
    from geometry_msgs.msg import TransformStamped
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import PointCloud2
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node, begin_s = rclpy.create_node("vehicle"), time.monotonic()
    seen: list[PointCloud2] = []
    publisher = node.create_publisher(TFMessage, "/tf", 100)

    def move() -> None:
        one = TransformStamped(child_frame_id="base_link")
        one.header.frame_id = "map"
        one.transform.translation.x = abs((time.monotonic() - begin_s) * 10.0 % 200.0 - 100.0) - 50.0
        one.transform.rotation.w = 1.0
        publisher.publish(TFMessage(transforms=[one]))

    node.create_timer(0.02, move)
    spinning = threading.Thread(target=rclpy.spin, args=(node,))
    spinning.start()
    for _ in sys.stdin:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(PointCloud2, "/map/pointcloud_map_loader/around", seen.append, latched)
    rclpy.shutdown()
    spinning.join()
    print(json.dumps(len(seen)), flush=True)


def answer_lines() -> None:
    """Do what each line of the input asks for."""
    asking = Asking()
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        print(json.dumps(getattr(asking, method)(*arguments)), flush=True)


# --- what measures -------------------------------------------------------------------------------------


class Client:
    """A process that asks."""

    def __init__(self, domain: RosDomain) -> None:
        pipe = subprocess.PIPE
        self.process = domain.start("-m", __spec__.name, "client", stdin=pipe, stdout=pipe, text=True)

    def __call__(self, *what: Any) -> Any:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(what), file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())


def started_bare(domain: RosDomain, daemon: DaemonProcess) -> subprocess.Popen[str]:
    """Start the bare service, and wait until it is up."""
    process = domain.start("-m", __spec__.name, "bare", daemon.endpoint, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


def rss_mb(pid: int) -> float:
    """Resident memory, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def cpu_s(pid: int) -> float:
    """Processor time of a process, s."""
    times = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return sum(map(int, times)) / os.sysconf("SC_CLK_TCK")


def pairs(domain: RosDomain, daemon: DaemonProcess) -> None:
    """Node and bare service in turn."""
    domain.node(daemon)
    started_bare(domain, daemon)
    client = Client(domain)
    for name, (radius, cells) in SIZES.items():
        times = client("pairs", radius, 20)
        middle = {what: statistics.median(some) for what, some in times.items()}
        low = {what: statistics.quantiles(some, n=10)[0] for what, some in times.items()}
        for what in times:
            print(f"{name}, {cells} cells: {what:4} p50 {middle[what]:7.1f} ms  p10 {low[what]:7.1f} ms")
        print(
            f"  p50 {middle['node'] / middle['bare']:.2f} x bare, p10 {low['node'] / low['bare']:.2f} x bare"
        )


def beside(domain: RosDomain, daemon: DaemonProcess) -> None:
    """A warm request beside 20 cold ones."""
    domain.node(daemon)
    client, other = Client(domain), Client(domain)
    radius = SIZES["1 MB"][0]
    alone = client("ask", "node", radius, 21)[1:]
    loaders = daemon.stop_loaders()
    other("begin", [(-130.0 + 20 * (k % 14), 110.0 + 20 * (k // 14)) for k in range(20)])
    time.sleep(1.0)
    with_them = client("ask", "node", radius, 20)
    left = other("left")
    for pid in loaders:
        os.kill(pid, signal.SIGCONT)
    one, two = statistics.median(alone), statistics.median(with_them)
    print(f"1 MB alone p50 {one:.1f} ms, beside {left} that wait {two:.1f} ms: {two / one:.2f} x")


def memory(domain: RosDomain, daemon: DaemonProcess) -> None:
    """300 requests of 4 to 36 cells."""
    node, client = domain.node(daemon), Client(domain)
    seen = []
    for turn in range(30):
        client("ask", "node", TEN_MB if turn % 3 == 0 else 29.0, 10)
        seen.append(rss_mb(node.pid))
    print("MB after each 10 of 300 requests: " + " ".join(f"{one:.0f}" for one in seen))
    print(f"  the last 250: {min(seen[5:]):.0f} to {max(seen[5:]):.0f} MB")


def stopped(domain: RosDomain, daemon: DaemonProcess) -> None:
    """A client has stopped, while 10 MB a second go to another."""
    node, client, other = domain.node(daemon), Client(domain), Client(domain)
    for one in (client, other):
        one("ask", "node", TEN_MB, 3)
    before = rss_mb(node.pid)
    other.process.send_signal(signal.SIGSTOP)
    seen = []
    for _ in range(45):
        begin = time.monotonic()
        client("ask", "node", TEN_MB)
        seen.append(rss_mb(node.pid) - before)
        time.sleep(max(0.0, 1.0 - (time.monotonic() - begin)))
    other.process.send_signal(signal.SIGCONT)
    print(f"MB more than {before:.0f}, each second: " + " ".join(f"{one:.0f}" for one in seen))


def ends(domain: RosDomain, daemon: DaemonProcess) -> None:
    """SIGINT to an idle node, and to one beside which 20 requests wait, against a bare node."""

    def seconds(process: subprocess.Popen[Any]) -> float:
        time.sleep(0.5)  # each of them is idle by then
        domain.note_files()
        begin = time.perf_counter()
        process.send_signal(signal.SIGINT)
        process.wait(WITHIN_S)
        return time.perf_counter() - begin

    more = []
    for _ in range(5):
        bare = seconds(started_bare(domain, daemon))
        took = []
        for places in ([], [(-130.0 + 20 * (k % 14), 110.0 + 20 * (k // 14)) for k in range(20)]):
            node, client = domain.node(daemon), Client(domain)
            client("ask", "node", SIZES["1 MB"][0])
            loaders = daemon.stop_loaders()
            client("begin", places)
            took.append(seconds(node.process))
            for pid in loaders:
                os.kill(pid, signal.SIGCONT)
            client.process.kill()
        more.append([one - bare for one in took])
        print(f"SIGINT: bare {bare:.2f} s, node {took[0]:.2f} s, with 20 that wait {took[1]:.2f} s")
    idle, full = (statistics.median(some) for some in zip(*more, strict=True))
    print(f"  medians: {idle:.2f} s over the bare one, {full:.2f} s with 20 that wait")


def around(domain: RosDomain, daemon: DaemonProcess) -> None:
    """A vehicle drives, at first without a subscriber of the topic."""
    node = domain.node(daemon)
    pipe = subprocess.PIPE
    vehicle = domain.start("-m", __spec__.name, "vehicle", stdin=pipe, stdout=pipe, text=True)
    assert vehicle.stdin is not None

    def share() -> float:
        """Share of a core over 20 s, after 5 in which it begins."""
        time.sleep(5.0)
        before, begin_s = cpu_s(node.pid), time.monotonic()
        time.sleep(20.0)
        return (cpu_s(node.pid) - before) / (time.monotonic() - begin_s)

    idle = share()
    print(file=vehicle.stdin, flush=True)
    driving = share()
    messages = vehicle.communicate()[0].strip()
    print(f"around: {driving:.1%} of a core with a subscriber, {idle:.1%} without; {messages} messages")


PARTS: Final[dict[str, Callable[[RosDomain, DaemonProcess], None]]] = {
    "pairs": pairs,
    "beside": beside,
    "memory": memory,
    "stopped": stopped,
    "ends": ends,
    "around": around,
}


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == ["bare"]:
        serve_bare(sys.argv[2])
    elif sys.argv[1:] == ["client"]:
        answer_lines()
    elif sys.argv[1:] == ["vehicle"]:
        drive()
    else:
        measure()


def measure() -> None:
    """Measure and print."""
    from tests.support.daemon_process import DaemonProcess
    from tests.support.divided_map import make_map
    from tests.support.ros.environment import ros_python
    from tests.support.ros.processes import ros_domain

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=", ".join(PARTS))
    parts = parser.parse_args().parts or PARTS
    python = ros_python()
    assert python is not None, "python -m tests.support.ros"
    for name in parts:
        with tempfile.TemporaryDirectory() as directory:
            town = make_map(Path(directory) / "map", columns=14, rows=14, points=16_384)
            folder = Path(directory)
            with (
                DaemonProcess(town.root, "--budget", "1G") as daemon,
                ros_domain(python, folder) as domain,
            ):
                PARTS[name](domain, daemon)


if __name__ == "__main__":
    main()
