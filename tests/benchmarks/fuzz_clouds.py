# SPDX-License-Identifier: Apache-2.0
"""Mutated PLY, text and LAS files against their readers: only success or `MapDataError` may come out.

Each child process reads thousands of mutated files under a limit of address space (the file's size plus
200 MB above what the process has when it starts), so that an allocation that the file does not justify is a
`MemoryError`, hence a finding; so is any other exception, a crash, a read of ten seconds, or a success whose
columns have not as many rows as there are points.  PLY that is read whole is compared with `plyfile` where
that reads it, too.  The input of a finding is kept and its path printed.

    python -m tests.benchmarks.fuzz_clouds [--seconds 60] [--seed N]
"""

from __future__ import annotations

import io
import random
import signal
import struct
import sys
import warnings
from pathlib import Path

import laspy
import numpy as np
import plyfile

from shmmap.errors import MapDataError
from shmmap.formats.cloud import open_blocks, read_cloud
from shmmap.formats.source_file import CAUSES
from tests.support.cloud_bytes import random_ply
from tests.support.fuzzing import fuzz_in_children, limit_memory, repeat

ALLOWED_BYTES = 200 << 20
MAX_S = 10
WORDS = [
    *(b"0", b"1", b"-1", b"255", b"4294967295", b"18446744073709551616", b"1e9", b"nan", b"inf", b"9" * 400),
    *(b"ply", b"format", b"element", b"vertex", b"property", b"list", b"comment", b"obj_info", b"end_header"),
    *(
        b"ascii",
        b"binary_little_endian",
        b"binary_big_endian",
        b"char",
        b"uint8",
        b"short",
        b"ushort",
        b"int",
    ),
    *(b"uint", b"float", b"double", b"x", b"y", b"z", b"X", b"\xff", b"\x00", b"\n", b"\r", b",", b";", b"#"),
    *(b"//X Y Z", b"x,y,z", b"1,5", b"\t", b" "),
]
Seed = tuple[str, bytes]


def seeds(folder: Path) -> list[Seed]:
    """Well-formed files of every kind."""
    rng = random.Random(7)
    files: list[Seed] = [(".ply", random_ply(rng)) for _ in range(60)]
    files.append((".ply", random_ply(rng, rows=3000)))
    rows = [" ".join(f"{rng.uniform(-50, 50):.3f}" for _ in range(7)) for _ in range(40)]
    text = "\n".join(rows).encode() + b"\n"
    for suffix, head in (
        (".xyz", b""),
        (".pts", b"40\n"),
        (".txt", b"//X Y Z I R G B\n"),
        (".asc", b"# x\n\n"),
    ):
        files.append((suffix, head + text))
    files.append((".csv", b"x,y,z,i,r,g,b\r\n" + text.replace(b" ", b",").replace(b"\n", b"\r\n")))
    files.append((".csv", b"z;y;x;i;r;g;b\n" + text.replace(b" ", b"; ")))
    for form, suffix in ((0, ".las"), (3, ".laz"), (6, ".las"), (7, ".laz")):
        header = laspy.LasHeader(point_format=form, version="1.4")
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr('PROJCS["a",UNIT["foot",0.3048]]'))
        las = laspy.LasData(header)
        las.x = las.y = las.z = np.arange(50.0)
        las.write(str(folder / f"seed{suffix}"))
        files.append((suffix, (folder / f"seed{suffix}").read_bytes()))
    return files


def mutate(data: bytes, rng: random.Random, pool: list[bytes]) -> bytes:
    """Make one to a few changes in a file, more often in its header than in the rest."""
    out = bytearray(data)
    end = max(out.find(b"end_header") + 12, 60)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(max(1, min(len(out), end if rng.random() < 0.6 else len(out))))
        match rng.randrange(8):
            case 0 if out:
                out[at % len(out)] ^= 1 << rng.randrange(8)
            case 1:
                del out[at : at + rng.choice((1, 2, 7, 64, 4096))]
            case 2:
                out[at:at] = rng.randbytes(rng.choice((1, 2, 8, 100)))
            case 3:
                out[at:at] = bytes(out[at : at + rng.choice((1, 8, 64))]) * rng.choice((1, 2, 50))
            case 4:  # another word at a word's place
                words = bytes(out[:end]).split(b" ")
                words[rng.randrange(len(words))] = rng.choice(WORDS)
                out[:end] = b" ".join(words)
            case 5:
                other = rng.choice(pool)
                out[at:] = other[rng.randrange(len(other) + 1) :]
            case 6:
                form, values = rng.choice(
                    (("<I", (0, 1, 2**31, 2**32 - 1)), ("<d", (0.0, 1e300, float("nan"))))
                )
                piece = struct.pack(form, rng.choice(values))
                out[at : at + len(piece)] = piece
            case _:
                lines = bytes(out[:end]).split(b"\n")
                rng.shuffle(lines)
                out[:end] = b"\n".join(lines)
    return bytes(out)


def check(path: Path, data: bytes, rng: random.Random) -> str:
    """Read one file; returns the outcome's name, raises whatever must not happen."""
    path.write_bytes(data)
    try:
        cloud = read_cloud(path, keep_non_finite=True)
        with open_blocks(str(path), path.suffix) as reader:
            start = rng.randrange(cloud.points + 1)
            rows = 0
            for block in reader.blocks(rng.choice((7, 512, 65536)), start):
                if {len(values) for values in block.values()} != {len(block["xyz"])}:
                    raise AssertionError("columns of different lengths")
                rows += len(block["xyz"])
            if rows != cloud.points - start:
                raise AssertionError(f"{rows} rows from {start} on of {cloud.points}")
    except MapDataError as error:
        if error.cause not in CAUSES:
            raise AssertionError(f"cause {error.cause} is not listed") from error
        return error.cause
    if {len(values) for values in cloud.columns.values()} != {cloud.points}:
        raise AssertionError("columns of different lengths")
    return compare(data, cloud.columns) if path.suffix == ".ply" else "read"


def compare(data: bytes, columns: dict[str, np.ndarray]) -> str:
    """Compare with `plyfile`, which refuses more.

    Not where the header's line ends differ: `plyfile` ends a line only as the first one
    ends, so that a comment that ends otherwise hides the property after it.  PCL and rply end a line at
    each newline, as we do.
    """
    header = data[: data.find(b"end_header") + 12]
    if 0 < header.count(b"\r\n") < max(header.count(b"\n"), header.count(b"\r")):
        return "read"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            vertex = plyfile.PlyData.read(io.BytesIO(data))["vertex"]
            theirs = {one.name: np.asarray(vertex[one.name]) for one in vertex.properties}
    except Exception:  # whatever it refuses, and how
        return "read"
    for name, values in theirs.items():
        if name in columns and values.dtype != object:
            ours = columns[name].astype(values.dtype)
            if not np.array_equal(ours, values, equal_nan=values.dtype.kind == "f"):
                raise AssertionError(f"plyfile reads {name} otherwise")
    return "compared"


def child(folder: Path, seed: int, seconds: float) -> int:
    """Fuzz for ``seconds``; the input of a finding stays in ``folder``."""
    rng = random.Random(seed)
    pool = seeds(folder)
    for suffix, data in pool:
        if check(folder / f"input{suffix}", data, rng) not in ("read", "compared"):
            raise AssertionError("a seed is refused")
    for old in folder.iterdir():
        old.unlink()
    limit_memory(ALLOWED_BYTES)

    def step() -> str:
        suffix, data = rng.choice(pool)
        path = folder / f"input{suffix}"
        signal.alarm(MAX_S)
        outcome = check(path, mutate(data, rng, [one for kind, one in pool if kind == suffix]), rng)
        signal.alarm(0)
        path.unlink()
        return outcome

    return repeat(step, seed, seconds)


def main() -> int:
    """Fuzz until the time is over."""
    return fuzz_in_children("fuzz_clouds", __doc__, child)


if __name__ == "__main__":
    sys.exit(main())
