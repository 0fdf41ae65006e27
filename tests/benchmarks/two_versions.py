# SPDX-License-Identifier: Apache-2.0
"""Whether this version is slower than another one: both take turns, and the ratios of the pairs count.

    git worktree add ../other COMMIT
    (cd ../other && python3 -m venv .venv && .venv/bin/pip install -q -e '.[test]')
    python -m tests.benchmarks.two_versions ../other [warm attach load import status] [--pairs 40]
    python -m tests.benchmarks.two_versions ../other ndt device pose
    python -m tests.benchmarks.two_versions ../other many --pairs 8

The other checkout has its environment in ``.venv``, as this one has.  Printed are the medians of both, the
median of the paired ratios (this version to the other), and the ratio that it is below with 95 %
confidence (bootstrap).  Less than 1: this version is faster.

- ``warm``: a warm differential with 40 new cells of 256 held, named and packed, 10th percentile of 300
- ``attach``: request and attach the cells around a place, a cell's share, 10th percentile of 20
- ``many``: 19 881 cells, warm: by area and by a differential with nothing held, all attached already; by a
  client that attaches them all, of one that ends then; and what a differential with all of them held takes of
  the daemon's processor
- ``load``: the cells of `load_pcd` into segments, one after the other
- ``import``: CPU time of importing the client
- ``status``: CPU time of `shmmap status`, where no daemon is, and of its help
- ``ndt``: CPU time of alignments by numba on one thread: two scans by DIRECT7 and DIRECT1, and Autoware's
  working point (1500 points, 2 m voxels), its data in the caches, and cold: 64 MiB of other data have been
  written since the last alignment, twice the largest cache.  And what being cold costs: a cold alignment
  less the second one after it, each pair in one go, so that the machine's load is in both
- ``device``: CPU time, of all threads, of the reference alignments in ``SHMMAP_TEST_DATA``, on the first
  OpenCL device; of a version that knows none, by numba
- ``pose``: wall and CPU time of a first pose among 200 candidates: one thread without batches, two with

Measured, 0.2.0 in turns: ``ndt`` 10.1, 4.5, 1.6, 2.0 ms against 13.2, 5.2, 2.7, 2.8 ms; what being cold
costs 0.25 ms beside 5 running processes, 0.55 to 0.58 ms beside 10 to 18 (limit 0.4; 0.2.0: 0.26 and 0.61
to 0.68); ``pose`` 327 ms wall, 164 ms CPU against 657 and 259; ``device`` 2.47 s on PoCL against 1.79 s by
numba.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from shmmap_clients.ndt_scan_matcher import pose_from_matrix

from tests.benchmarks.load_pcd import cloud, cut
from tests.benchmarks.ndt_clouds import city, scan_pair
from tests.benchmarks.street_data import data_dir

_SERVED = """
import shutil, sys, tempfile, time
from pathlib import Path
import numpy as np
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map
scratch = tempfile.mkdtemp()
made = make_map(Path(scratch) / "map", columns={side}, rows={side}, points={points})
one = DaemonProcess(made.root, "--budget", "2G").start()
clocks = {{}}
{begin}
print("up", flush=True)
for line in sys.stdin:
    times, clock = [], clocks.get(line.strip(), time.perf_counter)
    for _ in range({rounds}):
        before = clock()
        count = {work}
        times.append((clock() - before) / count)
    print(float(np.percentile(times, 10)) * 1e6, flush=True)
client.close()
one.stop()
one.dispose()
shutil.rmtree(scratch)
"""
_WARM = """
from tests.support.message_pack import pack
from tests.support.raw_client import RawClient, pack_versions
client = RawClient(one.endpoint)
area = ["box", -159.0, -159.0, 159.0, 159.0]
inside, everything = client.area(area).cells, client.area(["box", -300.0, -300.0, 300.0, 300.0]).cells
outside = [h for h in everything if h.id not in {i.id for i in inside}]
left = inside[::6][:40]
held = [h for h in inside if h not in left] + outside[:40]
named = [[h.id.removeprefix(client.id_prefix), h.version] for h in held]
packed = pack_versions([h.version for h in held])
requests = {
    "named": pack(["differential", 1, area, ["points"], named, b"", 10.0]),
    "packed": pack(["differential", 1, area, ["points"], [], packed, 10.0]),
}
def ask(request):
    client.socket.send(request)
    client.socket.recv()
    return 1
"""
_ATTACH = """
import shmmap
client = shmmap.connect(one.endpoint)
client.around(0, 0, radius=500)
"""
_MANY = """
import shmmap
client = shmmap.connect(one.endpoint, timeout=120.0)
area = shmmap.Box(-1e4, -1e4, 1e4, 1e4)
while not (kept := client.area(area, wait=60.0, strict=None)).complete:
    pass
assert len(kept) == 141 * 141
def fresh():
    with shmmap.connect(one.endpoint) as other:
        return other.area(area)
asks = {
    "attached": lambda: client.area(area),
    "nothing held": lambda: client.differential(area, []),
    "fresh": fresh,
    "held": lambda: client.differential(area, kept),
}
clocks["held"] = lambda: int(Path(f"/proc/{one.pid}/schedstat").read_text().split()[0]) / 1e9
def ask(what):
    assert len(asks[what]()) == (0 if what == "held" else len(kept))
    return 1
"""
_LOAD = """
import os, sys, tempfile, time
from shmmap.layers.points import build_points
from shmmap.segment.directory import ShmDirectory
files = sys.argv[1:]
path = tempfile.mkdtemp(dir="/dev/shm")
directory = ShmDirectory(path)
print("up", flush=True)
for line in sys.stdin:
    took = 0.0
    for file in files:
        fd = directory.create()
        before = time.perf_counter()
        build_points(file, fd, cell_id=file, box=(-1e5, -1e5, 1e5, 1e5))
        took += time.perf_counter() - before
        os.close(fd)
    print(took * 1e6, flush=True)
os.rmdir(path)
"""
_NDT = """
import sys, time
import numpy as np
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, voxel_cell
clouds = np.load(sys.argv[1])
other = np.ones(8 << 20)
made = {}
for name, at, leaf, settings in (
    ("direct7", "pair", 1.0, Settings("pclomp", "direct7", epsilon=0.1)),
    ("direct1", "pair", 1.0, Settings("pclomp", "direct1", epsilon=0.1)),
    ("working", "city", 2.0, Settings()),
):
    matcher = NdtMatcher(settings)
    matcher.set_map(VoxelMap({"map": voxel_cell(clouds[at + "_target"], leaf)}))
    made[name] = matcher, clouds[at + "_source"], clouds[at + "_guess"]
print("up", flush=True)
for line in sys.stdin:
    name, _, how = line.strip().partition(" ")
    matcher, source, guess = made[name]
    def align():
        begin = time.thread_time()
        matcher.align(source, guess)
        return time.thread_time() - begin
    times = []
    for _ in range(10):
        if how:
            other += 1.0
        took = align()
        if how == "penalty":
            align()
            took -= align()
        times.append(took)
    print((float(np.median(times)) if how == "penalty" else min(times)) * 1e6, flush=True)
"""
_DEVICE = """
import json, sys, time
import numpy as np
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, matrix_from_pose, voxel_cell
cases = json.load(open(sys.argv[1]))
clouds = np.load(sys.argv[2])
options = {"backend": "opencl"} if hasattr(NdtMatcher, "align_many") else {}
maps, matchers = {}, []
for case in cases:
    key = case["dataset"], case["leaf"]
    if key not in maps:
        maps[key] = VoxelMap({"map": voxel_cell(clouds[case["dataset"] + " target"], case["leaf"])})
    variant, neighbors, *how = case["settings"]  # by place: names have changed
    matcher = NdtMatcher(Settings(variant, neighbors, *how, **options))
    matcher.set_map(matcher.prepare(maps[key]))
    matchers.append((matcher, clouds[case["dataset"] + " source"], matrix_from_pose(np.array(case["guess"]))))
print("up", flush=True)
for line in sys.stdin:
    least = np.full(len(matchers), np.inf)
    for _ in range(3):
        for number, (matcher, source, guess) in enumerate(matchers):
            begin = time.process_time()
            matcher.align(source, guess)
            least[number] = min(least[number], time.process_time() - begin)
    print(float(least.sum()) * 1e6, flush=True)
"""
_POSE = """
import shutil, sys, tempfile, time
from pathlib import Path
import numpy as np
from shmmap_clients.ndt_scan_matcher import NdtMatcher
from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, RoughPose
from shmmap_clients.scans.scan_file import read_scan
from tests.support.daemon_process import DaemonProcess
from tests.support.ndt_programs import make_town_drive
scratch = tempfile.mkdtemp()
drive = make_town_drive(Path(scratch), blocks=(3, 3), density=5.0, frames=4, step=15.0)
one = DaemonProcess(drive.map_dir).start()
threads = 2 if hasattr(NdtMatcher, "align_many") else 1
initializer = PoseInitializer(one.endpoint, InitializerRules(height=1.8), threads=threads)
scans = [read_scan(path) for path in sorted(drive.scans.iterdir())]
print("up", flush=True)
for line in sys.stdin:
    times = []
    for number, scan in enumerate(scans):
        x, y, _, _, _, yaw = drive.poses[number]
        clock = time.process_time if line.strip() == "cpu" else time.perf_counter
        begin = clock()
        found = initializer.initialize(scan, RoughPose(x + 1.2, y - 0.9, z=0.0, yaw=yaw + 0.1))
        times.append(clock() - begin)
        assert found.reliable and abs(found.T_map_base[0, 3] - x) < 0.3, found.T_map_base
    print(sum(times) / len(times) * 1e6, flush=True)
initializer.close()
one.stop()
one.dispose()
shutil.rmtree(scratch)
"""
_CLIENT = "import shmmap; shmmap.connect; shmmap.MapWindow"


def python(checkout: Path) -> str:
    """Return the interpreter of a checkout's environment."""
    return str(checkout / ".venv" / "bin" / "python")


class Measuring:
    """A process of one checkout that measures on request."""

    def __init__(self, checkout: Path, program: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [python(checkout), "-c", program, *arguments],
            cwd=checkout, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": str(checkout), "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        assert self._say() == "up"

    def _say(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def measure(self, what: str = "") -> str:
        """Return what it found."""
        assert self._process.stdin is not None
        print(what, file=self._process.stdin, flush=True)
        return self._say()

    def close(self) -> None:
        """End it."""
        self._process.communicate()


def measured_us(program: Measuring, ask: str) -> float:
    """Return what a program measured, microseconds."""
    return float(program.measure(ask))


def cpu_us(checkout: Path, *arguments: str) -> float:
    """CPU time of a Python program of a checkout, microseconds."""
    # numpy's threads, just started, spin as long as the process runs
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    pid = os.posix_spawn(
        python(checkout),
        [python(checkout), *arguments],
        environment,
        file_actions=[(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_WRONLY, 0) for fd in (1, 2)],
    )
    _, _, usage = os.wait4(pid, 0)
    return (usage.ru_utime + usage.ru_stime) * 1e6


def turns(this: Callable[[], float], other: Callable[[], float], pairs: int) -> list[tuple[float, float]]:
    """Return what both measured, each first in half of the pairs."""
    this()  # warms up
    other()
    found = []
    for number in range(pairs):
        if number % 2:
            found.append((this(), other()))
        else:
            theirs = other()
            found.append((this(), theirs))
    return found


def most(values: list[float]) -> float:
    """Return what the median is below with 95 % confidence."""
    draw = random.Random(1)
    return sorted(statistics.median(draw.choices(values, k=len(values))) for _ in range(4000))[3800]


def compare(name: str, this: Callable[[], float], other: Callable[[], float], pairs: int) -> None:
    """Take turns, and print what comes of it."""
    found = turns(this, other, pairs)
    ratios = [mine / theirs for mine, theirs in found]
    mine, theirs = (statistics.median(values) for values in zip(*found, strict=True))
    print(
        f"{name:14} this {mine / 1e3:9.3f} ms, other {theirs / 1e3:9.3f} ms,"
        f" ratio {statistics.median(ratios):.3f}, below {most(ratios):.3f} with 95 % confidence",
        flush=True,
    )


def compare_differences(name: str, this: Callable[[], float], other: Callable[[], float], pairs: int) -> None:
    """Take turns with what may be nothing at all, so that a ratio says little."""
    here, there = ([value / 1e3 for value in one] for one in zip(*turns(this, other, pairs), strict=True))
    print(
        f"{name:14} this {statistics.median(here):9.3f} ms, below {most(here):.3f} with 95 % confidence;"
        f" other {statistics.median(there):9.3f} ms, below {most(there):.3f}",
        flush=True,
    )


def write_clouds(path: str) -> None:
    """Write what is aligned, for versions of any age."""
    arrays: dict[str, Any] = {}
    for pair in (scan_pair(), city()):
        arrays |= {f"{pair.name}_target": pair.target, f"{pair.name}_source": pair.source}
        arrays[f"{pair.name}_guess"] = pair.T_guess
    np.savez(path, **arrays)


def write_references(folder: Path) -> tuple[str, str]:
    """Write all reference alignments, and their clouds, for versions of any age; returns the files."""
    from tests.clients.ndt_scan_matcher.references import clouds, reference_rows, settings_of

    data = data_dir() / "ndt"
    cases, arrays = [], dict[str, Any]()
    for row in reference_rows(data):
        settings, T_guess, *_ = settings_of(row)
        arrays[f"{row['dataset']} target"], arrays[f"{row['dataset']} source"] = clouds(data, row["dataset"])
        names = ("variant", "neighbors", "epsilon", "max_iterations", "step_size")
        cases.append({
            "dataset": row["dataset"],
            "leaf": row["leaf"],
            "guess": pose_from_matrix(T_guess).tolist(),
            "settings": [getattr(settings, name) for name in names],
        })  # fmt: skip
    (folder / "cases.json").write_text(json.dumps(cases), encoding="utf-8")
    np.savez(folder / "clouds.npz", **arrays)
    return str(folder / "cases.json"), str(folder / "clouds.npz")


def served(points: int, begin: str, rounds: int, work: str, *, side: int = 20) -> str:
    """Return a program that measures ``work`` on a daemon of its checkout, over ``side`` x ``side`` cells."""
    return _SERVED.format(points=points, begin=begin.strip(), rounds=rounds, work=work, side=side)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", type=Path, help="checkout of the other version")
    parser.add_argument("what", nargs="*", default=["warm", "attach", "load", "import", "status"])
    parser.add_argument("--pairs", type=int, default=40)
    options = parser.parse_args()
    checkouts = (Path(__file__).resolve().parents[2], options.other.resolve())

    def both(program: str, asks: dict[str, str], *arguments: str) -> None:
        this, other = (Measuring(checkout, program, *arguments) for checkout in checkouts)
        for name, ask in asks.items():
            how = compare_differences if ask.endswith("penalty") else compare
            how(name, partial(measured_us, this, ask), partial(measured_us, other, ask), options.pairs)
        this.close()
        other.close()

    def started(name: str, *arguments: str) -> None:
        this, other = checkouts
        compare(name, lambda: cpu_us(this, *arguments), lambda: cpu_us(other, *arguments), options.pairs)

    for what in options.what:
        if what == "warm":
            asks = {"warm, packed": "packed", "warm, named": "named"}
            both(served(30, _WARM, 300, "ask(requests[line.strip()])"), asks)
        elif what == "many":
            asks = {"many, held, CPU": "held", "many, attached": "attached"}
            asks |= {"many, none held": "nothing held", "many, fresh": "fresh"}
            both(served(1, _MANY, 3, "ask(line.strip())", side=141), asks)
        elif what == "attach":
            both(served(2000, _ATTACH, 20, "len(client.around(0, 0, radius=45))"), {"attach": ""})
        elif what == "load":
            with tempfile.TemporaryDirectory() as folder:
                paths = cut(cloud(), Path(folder))["binary"]
                both(_LOAD, {"load": ""}, *paths)
        elif what == "ndt":
            asks = {name: name for name in ("direct7", "direct1", "working")}
            with tempfile.NamedTemporaryFile(suffix=".npz") as file:
                write_clouds(file.name)
                cold = {"working, cold": "working cold", "cold, penalty": "working penalty"}
                both(_NDT, {**asks, **cold}, file.name)
        elif what == "device":
            with tempfile.TemporaryDirectory() as folder:
                both(_DEVICE, {"references on a device": ""}, *write_references(Path(folder)))
        elif what == "pose":
            both(_POSE, {"pose, wall": "wall", "pose, CPU": "cpu"})
        elif what == "import":
            started("import", "-c", _CLIENT)
        elif what == "status":
            started("status", "-m", "shmmap.cli", "status", "--endpoint", "/nowhere/x.sock")
            started("status --help", "-m", "shmmap.cli", "status", "--help")
        else:
            parser.error(f"there is no {what}")


if __name__ == "__main__":
    main()
