# SPDX-License-Identifier: Apache-2.0
"""Scans into a live map beside OctoMap's ``insertPointCloud``, and the memory that the map takes.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.live_insertion [--rounds 3] [--setting 0.2/30] [--alone]

CPU time of mapper and worker together: a scan is marked, written as a file and read again as the worker does
it, checked, and applied to chunks in shared memory, under the undo record.  OctoMap gets the same points,
already in the map's frame; all three take turns scan by scan, each with a map of its own that begins empty
with each round.  Limit at 0.2 m, 30 m: 30 times as many points a second as OctoMap with the better of its two
settings.  OctoMap's part needs g++ and liboctomap-dev, and is left out with ``--alone`` or where they are
missing.  A setting is any voxel and range, in metres.

Memory is what the file system counts for all chunks, headers included, before and after a client has read
every byte that can be mapped.  Limits, bytes for each known voxel: 4.0 at 0.2 m, 30 m; 3.0 at 0.05 m, 5 m.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.applying import UNDO_BYTES, ChunkWriter, UndoRecord
from shmmap.chunks.layout import ChunkIdentity, new_header
from shmmap.chunks.marking import Marker
from shmmap.chunks.marks import decode_marks, encode_marks
from shmmap.chunks.occupancy import Occupancy, ScanFilter
from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.chunk_memory import ChunkFile, ChunkMemory, live_prefix
from tests.benchmarks.street_data import data_dir, street
from tests.support.daemon_process import LineProcess

SHM = "/dev/shm"
MAP_ID = bytes(16)
MAPPER = 1
SETTINGS = ("0.2/30", "0.2/80", "0.05/5")
TIMES_OCTOMAP = {"0.2/30": 30.0}
BYTES_A_VOXEL = {"0.2/30": 4.0, "0.05/5": 3.0}
HEIGHT_M = 1000.0  # OctoMap leaves out nothing for its height, so neither do we


@dataclass(frozen=True, eq=False)
class Scan:
    """Points in the sensor's frame, where it was, and a file of the points in the map's frame."""

    points: NDArray[np.float32]
    T_map_sensor: NDArray[np.float64]
    path: Path


def drive(folder: Path) -> list[Scan]:
    """All scans of the street."""
    there = street()
    scans = []
    for number, pose in enumerate(there.T_map_scans):
        points = np.ascontiguousarray(there.scan(number), np.float32)
        path = folder / f"{number}.xyz"
        in_map = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        path.write_bytes(in_map.astype(np.float32).tobytes())
        scans.append(Scan(points, pose, path))
    return scans


@dataclass(eq=False)
class Ours:
    """A live map that grows: its mapper, and what the worker does with a scan."""

    folder: Path
    resolution: float
    max_range: float
    chunks: dict[ChunkKey, ChunkFile] = field(default_factory=dict)

    def __post_init__(self) -> None:
        occupancy = Occupancy()
        _, _, low, high = occupancy.steps
        self._settings = (self.resolution, low, high, *occupancy.thresholds)
        self._marker = Marker(self.resolution, ScanFilter(0.0, self.max_range, -HEIGHT_M, HEIGHT_M))
        self._memory = ChunkMemory(str(self.folder), live_prefix("benchmark", "drive"))
        self._undo = np.memmap(self.folder / "undo", np.uint8, "w+", shape=(UNDO_BYTES,))
        self._writer = ChunkWriter(occupancy, UndoRecord(self._undo))
        self._scans = 0

    def _chunk(self, key: ChunkKey) -> ChunkFile:
        if key not in self.chunks:
            self.chunks[key] = self._memory.create(
                new_header(ChunkIdentity(MAP_ID, key, *self._settings, 1, "map"))
            )
        return self.chunks[key]

    def insert(self, scan: Scan) -> float:
        """Take a scan in; seconds of CPU time."""
        self._scans += 1
        began = time.thread_time()
        marks, _ = self._marker.mark(scan.points, scan.T_map_sensor)
        data = encode_marks(marks, MAP_ID, MAPPER, self._scans)
        fd = os.open(self.folder, os.O_TMPFILE | os.O_RDWR)
        os.pwrite(fd, data, 0)
        received = os.pread(fd, os.fstat(fd).st_size, 0)
        os.close(fd)
        marks = decode_marks(received, MAP_ID, MAPPER, self._scans)
        starts = marks.starts.tolist()
        for at, (key, hits) in enumerate(zip(marks.chunks, marks.hits.tolist(), strict=True)):
            part = slice(starts[at], starts[at + 1])
            chunk = self._chunk(key)
            self._writer.apply(
                chunk.view, marks.words[part], marks.bits[part], hits, mapper=MAPPER, scan=self._scans,
                now_ns=self._scans, grow=chunk.grow, known_mappers=(MAPPER,),
            )  # fmt: skip
        return time.thread_time() - began

    @property
    def active(self) -> int:
        """Voxels that are known."""
        return sum(int(chunk.view.state["active"]) for chunk in self.chunks.values())

    def bytes(self) -> int:
        """Memory of all chunks, as the file system counts it."""
        names = (chunk.name.lstrip("/") for chunk in self.chunks.values())
        return sum(os.stat(self.folder / name).st_blocks * 512 for name in names)

    def read(self) -> None:
        """Have every byte read that a reader can map."""
        for chunk in self.chunks.values():
            np.memmap(self.folder / chunk.name.lstrip("/"), np.uint8, "r").sum()

    def close(self) -> None:
        """Remove all of it."""
        for chunk in self.chunks.values():
            chunk.close()
            self._memory.remove(chunk.name)
        self._memory.close()
        (self.folder / "undo").unlink()


class OctoMap:
    """The C++ program."""

    def __init__(self, program: Path, *, discretize: bool) -> None:
        self._program = LineProcess(program, str(int(discretize)))

    def _ask(self, *words: object) -> float:
        self._program.write(" ".join(map(str, words)))
        return float(self._program.read())

    def begin(self, resolution: float) -> None:
        """A new map."""
        self._ask("new", resolution)

    def insert(self, scan: Scan, max_range: float) -> float:
        """Take a scan in; seconds of CPU time."""
        return self._ask("insert", max_range, *scan.T_map_sensor[:3, 3].tolist(), scan.path)

    def close(self) -> None:
        """End it."""
        self._program.end()


def built_octomap(folder: Path) -> Path | None:
    """Compile the program; None, and the reason printed, where it cannot be."""
    program, source = folder / "octomap", Path(__file__).with_name("live_insertion_octomap.cpp")
    if shutil.which("g++") is None:
        print("OctoMap: not measured, g++ is missing")
        return None
    command = ["g++", "-O3", "-march=native", "-std=c++17", str(source), "-o", str(program)]
    done = subprocess.run([*command, "-loctomap", "-loctomath"], check=False, capture_output=True, text=True)
    if done.returncode:
        print(f"OctoMap: not measured, is liboctomap-dev installed? {done.stderr.splitlines()[0]}")
        return None
    return program


def verdict(*, met: bool) -> str:
    return "met" if met else "MISSED"


def measure(setting: str, scans: Sequence[Scan], peers: dict[str, OctoMap], rounds: int) -> bool:
    """One setting, some rounds; prints what was found, and returns whether the limits hold."""
    resolution, max_range = map(float, setting.split("/"))
    points = sum(len(scan.points) for scan in scans)
    seconds: dict[str, list[float]] = {name: [] for name in ("shmmap", *peers)}
    good = True
    for turn in range(rounds):
        with tempfile.TemporaryDirectory(dir=SHM, prefix="live_insertion.") as path:
            ours = Ours(Path(path), resolution, max_range)
            took = dict.fromkeys(seconds, 0.0)
            for octomap in peers.values():
                octomap.begin(resolution)
            for scan in scans:
                took["shmmap"] += ours.insert(scan)
                for name, octomap in peers.items():
                    took[name] += octomap.insert(scan, max_range)
            for name, one in took.items():
                seconds[name].append(one)
            if turn == 0:
                good = print_memory(setting, ours)
            ours.close()
    milliseconds = np.median(seconds["shmmap"]) / len(scans) * 1e3
    print(f"  CPU time a scan of {points // len(scans):,} points, mapper and worker: {milliseconds:.1f} ms")
    print(f"  points a second, millions, median of {rounds} rounds:")
    for name, values in seconds.items():
        print(f"    {name:20} {points / np.median(values) / 1e6:6.2f}")
    if peers:
        better = np.min([seconds[name] for name in peers], axis=0)
        ratio = float(np.median(better / np.array(seconds["shmmap"])))
        line = f"  {ratio:.1f} times as many as OctoMap with the better setting"
        if setting in TIMES_OCTOMAP:
            good &= ratio >= TIMES_OCTOMAP[setting]
            line += f"   limit {TIMES_OCTOMAP[setting]:g}: {verdict(met=ratio >= TIMES_OCTOMAP[setting])}"
        print(line, flush=True)
    return good


def print_memory(setting: str, ours: Ours) -> bool:
    """Print the map's memory; returns whether it is within the limit."""
    active, before = ours.active, ours.bytes()
    ours.read()
    after = ours.bytes()
    line = f"  {active:,} known voxels in {len(ours.chunks)} chunks: {before / active:.2f} bytes each,"
    line += f" {after / active:.2f} after all of it was read"
    limit = BYTES_A_VOXEL.get(setting)
    met = limit is None or after / active <= limit
    print(line if limit is None else f"{line}   limit {limit}: {verdict(met=met)}")
    return met


def main() -> int:
    """Measure and print; 1 if a limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--setting", action="append", help="voxel and range, metres, such as 0.1/30")
    parser.add_argument("--alone", action="store_true", help="without OctoMap")
    args = parser.parse_args()
    data_dir()  # it says what is missing
    good = True
    with tempfile.TemporaryDirectory(prefix="live_insertion.") as path:
        folder = Path(path)
        scans = drive(folder)
        points = sum(len(scan.points) for scan in scans)
        print(f"load {os.getloadavg()[0]:.2f}; {len(scans)} scans, {points:,} points")
        peers: dict[str, OctoMap] = {}
        if not args.alone and (program := built_octomap(folder)) is not None:
            peers["OctoMap"] = OctoMap(program, discretize=False)
            peers["OctoMap, discretised"] = OctoMap(program, discretize=True)
        for setting in args.setting or SETTINGS:
            print("voxels of {} m, rays of at most {} m".format(*setting.split("/")))
            good &= measure(setting, scans, peers, args.rounds)
        for octomap in peers.values():
            octomap.close()
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
