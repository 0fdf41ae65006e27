# SPDX-License-Identifier: Apache-2.0
"""Objects of a published map against zstd of the same PCD files, and bytes of the index.

    python -m tests.benchmarks.published_map [--map DIR] [--repeats 5] [--cells 100000]

The cells are those of `load_pcd`: of the street's map where SHMMAP_TEST_DATA names it, else generated.  Times
are of this process's processor, the least of the rounds for each cell, in turns.  Limits: 63 % of the points'
bytes, in millimetres 36 %, of the recorded map.

Measured beside those of BENCHMARKS.md: in millimetres 34.8 % (a generated town 40.0 %), 91 and 403 MB/s;
the index has 89 bytes a cell with one published layer and 159 with two, of which 64 and 128 are hashes.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import zstandard

from shmmap.layers.points import build_points
from shmmap.origin.remote.published_index import LayerObjects, Shard, pack_shard
from shmmap.origin.remote.published_object import (
    CellIdentity,
    ObjectName,
    bare_object,
    pack_object,
    write_segment,
)
from shmmap.origin.remote.zstd_frame import pack_frame, unpack_frame
from tests.benchmarks.load_pcd import cloud, cut

LIMIT, LIMIT_MM = 0.63, 0.36
BOX = (0.0, 0.0, 20.0, 20.0)


def least(repeats: int, *functions: Callable[[], object]) -> list[float]:
    """Seconds of the processor of each function, run in turns: the least."""
    found = [float("inf")] * len(functions)
    for _ in range(repeats):
        for number, function in enumerate(functions):
            began = time.process_time()
            function()
            found[number] = min(found[number], time.process_time() - began)
    return found


def objects(paths: list[Path], repeats: int) -> bool:
    """Print bytes and times of the points' objects; whether the limit holds."""
    names = ("raw", "object", "mm", "pcd", "pcd.zst")
    sizes = dict.fromkeys(names, 0)
    seconds = dict.fromkeys(("encode", "decode", "encode_mm", "decode_mm", "zstd", "unzstd"), 0.0)
    for path in paths:
        fd = os.memfd_create("segment")
        header = build_points(str(path), fd, cell_id=f"/map/{path.name}", box=BOX)
        segment = memoryview(os.pread(fd, header.total_bytes, 0))
        os.close(fd)
        exact, rounded = (
            pack_object(unpacked, sha256(unpacked).digest())
            for unpacked in (bare_object(segment), bare_object(segment, millimetres=True))
        )
        identity = CellIdentity(header.cell_id, BOX, "map", bytes(24))
        pcd = path.read_bytes()
        packed = zstandard.ZstdCompressor(level=3).compress(pcd)

        def encode(millimetres: bool, segment: memoryview = segment) -> None:
            unpacked = bare_object(segment, millimetres=millimetres)
            pack_object(unpacked, sha256(unpacked).digest())

        def decode(made: tuple[ObjectName, bytes], identity: CellIdentity = identity) -> None:
            target, (name, frame) = os.memfd_create("loaded"), made
            assert sha256(frame).digest() == name.sha256
            unpacked = unpack_frame(frame, name.raw, name=name.path, exact=True)
            write_segment(unpacked, target, identity, "points")
            os.close(target)

        def compress(pcd: bytes = pcd) -> None:
            sha256(zstandard.ZstdCompressor(level=3).compress(pcd)).digest()

        def decompress(packed: bytes = packed) -> None:
            target = os.memfd_create("loaded")
            sha256(packed).digest()
            os.write(target, zstandard.ZstdDecompressor().decompress(packed))
            os.close(target)

        timed = least(
            repeats,
            partial(encode, False),
            partial(decode, exact),
            partial(encode, True),
            partial(decode, rounded),
            compress,
            decompress,
        )
        for key, found in zip(seconds, timed, strict=True):
            seconds[key] += found
        both = exact[0].raw, exact[0].size, rounded[0].size, len(pcd), len(packed)
        for key, size in zip(names, both, strict=True):
            sizes[key] += size
    share, share_mm = sizes["object"] / sizes["raw"], sizes["mm"] / sizes["raw"]
    mb = sizes["raw"] / 1e6
    print(f"{len(paths)} cells, {mb:.1f} MB of points in memory")
    print(
        f"object        {share:6.1%} of raw  encode {mb / seconds['encode']:5.0f} MB/s"
        f"  verify, decode and write {mb / seconds['decode']:5.0f} MB/s"
    )
    print(
        f"millimetres   {share_mm:6.1%} of raw  encode {mb / seconds['encode_mm']:5.0f} MB/s"
        f"  verify, decode and write {mb / seconds['decode_mm']:5.0f} MB/s"
    )
    peer = sizes["pcd.zst"] / sizes["pcd"]
    print(
        f"zstd of PCD   {peer:6.1%} of PCD  encode {mb / seconds['zstd']:5.0f} MB/s"
        f"  verify, decode and write {mb / seconds['unzstd']:5.0f} MB/s, a PCD file"
    )
    held = share <= LIMIT and share_mm <= LIMIT_MM
    print(f"limits {LIMIT:.0%}, {LIMIT_MM:.0%}: {'held' if held else 'NOT HELD'}")
    return held


def index(cells: int) -> None:
    """Print bytes a cell of the index, for one published layer and for two."""
    side = max(32, int(cells**0.5) // 32 * 32)
    rng = np.random.default_rng(1)
    for layers in (("points",), ("points", "ndt(leaf=2.0)")):
        packed = count = 0
        for begin in range(0, side, 32):
            ix, iy = np.meshgrid(np.arange(begin, begin + 32), np.arange(32))
            low = np.column_stack([ix.ravel(), iy.ravel()]) * 20.0
            named = sorted((f"{int(x)}_{int(y)}.pcd".encode(), x, y) for x, y in low.tolist())
            low = np.array([[x, y] for _, x, y in named])
            ground = rng.normal(30, 3, len(low))
            points = rng.integers(40_000, 200_000, len(low)).astype(np.uint32)
            shard = Shard(
                tuple(name for name, _, _ in named),
                np.hstack([low, low + 20.0]),
                np.column_stack([ground, ground + rng.uniform(5, 30, len(low))]).astype("f4").astype("f8"),
                points,
                {
                    layer: LayerObjects(
                        (points * (10 if layer == "points" else 0.2)).astype(np.uint32),
                        points * 16 + 4096 if layer == "points" else points // 3,
                        rng.integers(0, 256, (len(low), 32)).astype(np.uint8),
                        rng.integers(0, 256, (len(low), 32)).astype(np.uint8),
                    )
                    for layer in layers
                },
            )
            packed += len(pack_frame(pack_shard(shard)))
            count += len(low)
        floor = 64 * len(layers)
        print(f"index, {len(layers)} layers: {packed / count:.1f} bytes a cell, {floor} of them hashes")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--map", type=Path, help="directory of PCD files (default: the cells of load_pcd)")
    parser.add_argument("--repeats", type=int, default=5, help="rounds for each cell (default 5)")
    parser.add_argument("--cells", type=int, default=100_000, help="of the index (default 100000)")
    options = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        paths = (
            sorted(options.map.rglob("*.pcd"))
            if options.map
            else map(Path, cut(cloud(), Path(folder))["binary"])
        )
        held = objects(list(paths), options.repeats)
    index(options.cells)
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
