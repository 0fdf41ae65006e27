# SPDX-License-Identifier: Apache-2.0
"""Loading the cells of a map: ours beside plain copying, bare LZF, PCL, pypcd4 and Open3D, in one run.

Ours is everything a load is: the header's checks, column split, finite check, bounds, digest of the
file, checksum of every column, and a finished segment in shared memory; the peers only fill their own
memory.  Rounds are interleaved, and ratios are medians over rounds of the times within one round.

    python -m tests.benchmarks.load_pcd [--repeats 9] [--huge DIR]

Where SHMMAP_TEST_DATA names a street, its map is loaded; else a cloud of the same kind is generated.
DIR is a tmpfs with ``huge=within_size``: cells are loaded there, too, and compared with /dev/shm.  As root:

    unshare -m sh -c 'mount -t tmpfs -o huge=within_size tmpfs /mnt &&
        python -m tests.benchmarks.load_pcd --huge /mnt'

Measured beside those of BENCHMARKS.md: binary_compressed 104 ms (LZF alone 58; PCL PointXYZI 139,
PCLPointCloud2 111, pypcd4 82, Open3D 249 ms); with --huge on Linux 6.18 25 and 81 ms (on 4 KiB 44 and 99
ms).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lzf
import numpy as np
from numpy.typing import NDArray

from shmmap.formats.cloud import read_pcd
from shmmap.formats.pcd.writer import write_pcd
from shmmap.layers.points import build_points
from tests.benchmarks.street_data import street
from tests.support.daemon_process import LineProcess

SHM = "/dev/shm"
HUGE = "shmmap, huge pages"
CELL_M = 20.0
ENCODINGS = ("binary", "binary_compressed")
Round = Callable[[list[str]], float]


def cloud() -> dict[str, NDArray[Any]]:
    """The street's map, or a rough ground of the recorded map's size and point order."""
    if os.environ.get("SHMMAP_TEST_DATA"):
        return read_pcd(street().map_file).columns
    rng = np.random.default_rng(5)
    xy = rng.uniform(-80, 80, (3_000_000, 2))
    xy = np.round(xy[np.lexsort((xy[:, 1], np.floor(xy[:, 0])))], 2)
    z = np.round(0.02 * xy[:, 0] + 0.3 * np.sin(xy[:, 1]) + rng.normal(0, 0.02, len(xy)), 3)
    xyz = np.column_stack((xy, z)).astype(np.float32)
    return {"xyz": xyz, "intensity": np.round(rng.uniform(0, 1, len(xy)), 2).astype(np.float32)}


def cut(columns: dict[str, NDArray[Any]], folder: Path) -> dict[str, list[str]]:
    """Write the cells of floor(x / 20), floor(y / 20) in both encodings; returns the paths."""
    keys = np.floor(columns["xyz"][:, :2].astype(np.float64) / CELL_M).astype(np.int64)
    cells, inverse = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(inverse.ravel()))
    paths: dict[str, list[str]] = {}
    for encoding in ENCODINGS:
        (folder / encoding).mkdir()
        paths[encoding] = []
        for cell, rows in zip(cells.tolist(), np.split(order, ends[:-1]), strict=True):
            path = folder / encoding / f"{cell[0] * 20}_{cell[1] * 20}.pcd"
            write_pcd(path, {name: values[rows] for name, values in columns.items()}, encoding=encoding)
            paths[encoding].append(str(path))
    return paths


def timed(load: Callable[[str], object]) -> Round:
    """Return a round: load every file once, and the seconds it took."""

    def run(paths: list[str]) -> float:
        start = time.perf_counter()
        for path in paths:
            load(path)
        return time.perf_counter() - start

    return run


def kept(load: Callable[[str, int], object], directory: str = SHM) -> Round:
    """Return a round of loads into shared memory that all stay there, as the cells of a map do."""

    def run(paths: list[str]) -> float:
        files: list[int] = []

        def one(path: str) -> None:
            files.append(os.open(directory, os.O_TMPFILE | os.O_RDWR))
            load(path, files[-1])

        took = timed(one)(paths)
        for file in files:
            os.close(file)
        return took

    return run


def ours(path: str, out: int) -> None:
    build_points(path, out, cell_id=path, box=(-1e5, -1e5, 1e5, 1e5))


def copy(path: str, out: int) -> None:
    """Plain pread and pwrite of the same bytes into shared memory."""
    source = os.open(path, os.O_RDONLY)
    os.pwrite(out, os.pread(source, os.fstat(source).st_size, 0), 0)
    os.close(source)


def bare_lzf(paths: list[str]) -> float:
    """Only the decompress call, not even the reading of the file."""
    took = 0.0
    for path in paths:
        data = Path(path).read_bytes()
        at = data.index(b"DATA binary_compressed\n") + 23
        packed, plain = (int(size) for size in np.frombuffer(data, "<u4", 2, at))
        body = data[at + 8 : at + 8 + packed]
        start = time.perf_counter()
        lzf.decompress(body, plain)
        took += time.perf_counter() - start
    return took


class Pcl:
    """pcl::io::loadPCDFile in a process of its own, driven round by round."""

    def __init__(self, folder: Path) -> None:
        binary = folder / "pcl_load"
        source = Path(__file__).with_name("pcl_load.cpp")
        includes = [f"-I{path}" for path in (*Path("/usr/include").glob("pcl-*"), "/usr/include/eigen3")]
        libraries = ["-lpcl_io", "-lpcl_common", "-lboost_system"]
        command = [
            "g++",
            "-O3",
            "-march=native",
            "-std=c++17",
            *includes,
            str(source),
            "-o",
            str(binary),
            *libraries,
        ]
        subprocess.run(command, check=True, capture_output=True, text=True)
        self._program = LineProcess(binary)
        self._folder = folder

    def round(self, kind: str) -> Round:
        """``xyzi`` loads into PointXYZI, as programs do; ``blob`` into PCLPointCloud2, without conversion."""

        def run(paths: list[str]) -> float:
            listing = self._folder / "paths.txt"
            listing.write_text("".join(path + "\n" for path in paths))
            self._program.write(f"{kind} {listing}")
            seconds, _ = self._program.read().split()
            return float(seconds)

        return run

    def close(self) -> None:
        self._program.end()


def peers(folder: Path) -> tuple[dict[str, Round], Pcl | None]:
    """What is there to compare with; says what is missing."""
    found: dict[str, Round] = {}
    pcl = None
    try:
        pcl = Pcl(folder)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = getattr(error, "stderr", None) or str(error)
        print(f"PCL left out (needs g++ and libpcl-dev): {reason.strip().splitlines()[-1]}")
    else:
        found["PCL PointXYZI"] = pcl.round("xyzi")
        found["PCL PCLPointCloud2"] = pcl.round("blob")
    try:
        import pypcd4
    except ImportError as error:
        print(f"pypcd4 left out: {error}")
    else:
        found["pypcd4 .numpy()"] = timed(lambda path: pypcd4.PointCloud.from_path(path).numpy())  # type: ignore[attr-defined]
        found["pypcd4 records"] = timed(lambda path: pypcd4.PointCloud.from_path(path))  # type: ignore[attr-defined]
    try:
        import open3d
    except ImportError as error:
        print(f"Open3D left out: {error}")
    else:
        found["Open3D tensor"] = timed(lambda path: open3d.t.io.read_point_cloud(Path(path)))
        found["Open3D legacy"] = timed(lambda path: open3d.io.read_point_cloud(Path(path)))
    return found, pcl


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--repeats", type=int, default=7, help="interleaved rounds (default 7)")
    parser.add_argument("--huge", metavar="DIR", help="a tmpfs with huge pages")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="load_pcd."))
    pcl = None
    try:
        paths = cut(cloud(), folder)
        others, pcl = peers(folder)
        for encoding in ENCODINGS:
            rounds: dict[str, Round] = {"shmmap": kept(ours)}
            if encoding == "binary":
                rounds["pread + pwrite"] = kept(copy)
            else:
                rounds["bare lzf.decompress"] = bare_lzf
            if options.huge:
                rounds[HUGE] = kept(ours, options.huge)
            rounds |= others
            times: dict[str, list[float]] = {name: [] for name in rounds}
            for turn in range(options.repeats + 1):
                for name, run in rounds.items():
                    took = run(paths[encoding])
                    if turn:  # the first round warms caches and allocators
                        times[name].append(took)
            report(encoding, paths[encoding], times)
    finally:
        if pcl is not None:
            pcl.close()
        shutil.rmtree(folder)
    return 0


def report(encoding: str, paths: list[str], times: dict[str, list[float]]) -> None:
    size = sum(os.path.getsize(path) for path in paths)
    print(f"\n{encoding}: {len(paths)} cells, {size / 1e6:.1f} MB, medians of {len(times['shmmap'])} rounds")
    limits = {"pread + pwrite": 2.0, "bare lzf.decompress": 1.75}
    for name, values in times.items():
        ratios = [mine / other for mine, other in zip(times["shmmap"], values, strict=True)]
        ratio = float(np.median(ratios))
        limit = limits.get(name, 1.0)
        verdict = (
            ""
            if name in ("shmmap", HUGE)
            else f"   limit {limit:.2f}: {'met' if ratio <= limit else 'MISSED'}"
        )
        print(f"  {name:22s} {np.median(values) * 1e3:8.1f} ms   shmmap takes {ratio:5.2f} of it{verdict}")
    if HUGE in times:
        compare_huge(times)


def compare_huge(times: dict[str, list[float]]) -> None:
    """Loads on huge pages against 4 KiB pages; compressed ones, which mostly compute, against the least."""
    other, limit = ("bare lzf.decompress", 1.5) if "bare lzf.decompress" in times else ("shmmap", 0.6)
    ratio = float(np.median(np.divide(times[HUGE], times[other])))
    print(
        f"  {HUGE} takes {ratio:5.2f} of {other}   limit {limit:.2f}: {'met' if ratio <= limit else 'MISSED'}"
    )


if __name__ == "__main__":
    sys.exit(main())
