# SPDX-License-Identifier: Apache-2.0
"""Mutated PCD files against the reader: only success or `MapDataError` may come out.

Each child process reads thousands of mutated files under a limit of address space (the file's size
plus 100 MB above what the process has when it starts), so that an allocation that the file does not
justify is a `MemoryError`, hence a finding; so is any other exception, a crash, or a success whose
counts or digest are wrong.  The input of a finding is kept and its path printed.

    python -m tests.benchmarks.fuzz_pcd [--seconds 60] [--seed N]
"""

from __future__ import annotations

import math
import random
import struct
import sys
from pathlib import Path

import numpy as np
import xxhash

from shmmap.errors import MapDataError
from shmmap.formats.pcd import lzf
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import CAUSES
from tests.support.cloud_bytes import CODES, Field, Number, column, lzf_decode, lzf_encode, pcd
from tests.support.fuzzing import fuzz_in_children, limit_memory, repeat

ENCODINGS = ("ascii", "binary", "binary_compressed")
ALLOWED_BYTES = 100 << 20
WORDS = [
    *(b"0", b"1", b"-1", b"5", b"255", b"65536", b"4294967295", b"4294967296", b"18446744073709551616"),
    *(b"1e9", b"nan", b"inf", b"-inf", b"0x10", b"1_0", b"9" * 400, b"\xff", b"\x00", b"_", b"x", b"xyz"),
    *(b"FIELDS", b"SIZE", b"TYPE", b"COUNT", b"WIDTH", b"HEIGHT", b"POINTS", b"VIEWPOINT", b"DATA", b"#"),
    *(b"ascii", b"binary", b"binary_compressed"),
    *(b"F", b"U", b"I", b"2", b"4", b"8", b"1000000", b"\n", b"\r"),
]


def seeds() -> list[bytes]:
    """Well-formed files of every encoding and many shapes; no file from elsewhere is needed."""
    rng = random.Random(1)
    files = []
    for rows in (0, 1, 5, 300):
        xyz = [column(n, "F4", [rng.uniform(-9, 9) for _ in range(rows)]) for n in "xyz"]
        wide = [column(n, "F8", [rng.choice([1.0, math.nan, 1e300]) for _ in range(rows)]) for n in "xyz"]
        whole = [column(n, "I8", [rng.randrange(-(2**40), 2**40) for _ in range(rows)]) for n in "xyz"]
        pad = Field("_", "U", 1, ((0, 1, 2, 3),) * rows, 4)
        histogram = Field("h", "I", 2, tuple((row, -row, 7) for row in range(rows)), 3)
        every: list[Field] = []
        for kind, size in CODES:
            values: list[Number] = [row % 100 for row in range(rows)]
            every.append(column(f"{kind}{size}", f"{kind}{size}", values))
        for fields in (xyz, wide, whole, [*xyz, pad, histogram], [*every, *xyz], [*xyz, xyz[0]]):
            files += [pcd(fields, encoding) for encoding in ENCODINGS]
            files.append(pcd(fields, "ascii", newline="\r\n"))
    zeros = [column(n, "F4", [0.0] * 20_000) for n in "xyz"]
    files.append(pcd(zeros, "binary_compressed"))
    return files


def mutate(data: bytes, rng: random.Random, pool: list[bytes]) -> bytes:
    """Make one to a few changes in a file."""
    out = bytearray(data)
    end = out.find(b"DATA ") + 24
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        limit = max(1, min(len(out), end if rng.random() < 0.6 else len(out)))
        at = rng.randrange(limit)
        match rng.randrange(9):
            case 0 if out:
                out[at % len(out)] ^= 1 << rng.randrange(8)
            case 1 if out:
                out[at % len(out)] = rng.randrange(256)
            case 2:
                del out[at : at + rng.choice((1, 2, 7, 64, 4096))]
            case 3:
                out[at:at] = rng.randbytes(rng.choice((1, 2, 8, 100)))
            case 4:
                piece = out[at : at + rng.choice((1, 8, 64))]
                out[at:at] = piece * rng.choice((1, 2, 50))
            case 5:  # another word at a word's place
                words = bytes(out[:end]).split(b" ")
                words[rng.randrange(len(words))] = rng.choice(WORDS)
                out[:end] = b" ".join(words)
            case 6:
                other = rng.choice(pool)
                cut = rng.randrange(len(other) + 1)
                out[at:] = other[cut:]
            case 7:
                out[at : at + 4] = struct.pack(
                    "<I", rng.choice((0, 1, 80, 2**16, 2**31, 2**32 - 1, len(out)))
                )
            case _:
                lines = bytes(out[:end]).split(b"\n")
                rng.shuffle(lines)
                out[:end] = b"\n".join(lines)
    return bytes(out)


def check_reader(path: Path, data: bytes, rng: random.Random) -> str:
    """Read one file; returns the outcome's name, raises whatever must not happen."""
    path.write_bytes(data)
    keep = rng.random() < 0.2
    try:
        with PcdReader(path, keep_non_finite=keep, block_points=rng.choice((1, 7, 512, 65536))) as reader:
            rows = 0
            for block in reader.blocks():
                if {len(part) for part in block} != {len(block[0])} or len(block) != len(reader.columns):
                    raise AssertionError("columns of different lengths")
                if not keep and not np.isfinite(block[0]).all():
                    raise AssertionError("a point that is not finite was kept")
                rows += len(block[0])
            if (rows, rows + reader.dropped) != (reader.kept, reader.header.points):
                raise AssertionError("points do not add up")
            if reader.digest != xxhash.xxh3_128(data).digest():
                raise AssertionError("wrong digest")
    except MapDataError as error:
        if error.cause not in CAUSES:
            raise AssertionError(f"cause {error.cause} is not listed") from error
        return error.cause
    return "read"


def check_decoder(rng: random.Random) -> str:
    """One LZF stream, sound or not, against the decoder of the test support."""
    plain = rng.choice((b"abc", b"\0" * 7, rng.randbytes(5))) * rng.randrange(1, 60)
    packed = bytearray(lzf_encode(plain))
    for _ in range(rng.randrange(3)):
        packed[rng.randrange(len(packed))] = rng.randrange(256)
    size = len(plain) + rng.choice((0, 0, 0, 1, -1))
    try:
        expected = lzf_decode(bytes(packed))
    except (ValueError, IndexError):
        expected = b""
    output = np.zeros(size, np.uint8)
    good = lzf.decompress(np.frombuffer(bytes(packed), np.uint8), output)
    if good != (len(expected) == size) or (good and output.tobytes() != expected):
        raise AssertionError("LZF decoder disagrees")
    if (lzf.first_error(bytes(packed), size) is None) != good and size:
        raise AssertionError("LZF walker disagrees")
    return "lzf"


def child(folder: Path, seed: int, seconds: float) -> int:
    """Fuzz for ``seconds``; the input of a finding stays in ``folder``."""
    rng = random.Random(seed)
    pool = seeds()
    path = folder / "input.pcd"
    for data in pool:
        if check_reader(path, data, rng) != "read":
            raise AssertionError("a seed is refused")
    limit_memory(ALLOWED_BYTES)

    def step() -> str:
        if rng.random() < 0.1:
            return check_decoder(rng)
        return check_reader(path, mutate(rng.choice(pool), rng, pool), rng)

    return repeat(step, seed, seconds)


def main() -> int:
    """Fuzz until the time is over."""
    return fuzz_in_children("fuzz_pcd", __doc__, child)


if __name__ == "__main__":
    sys.exit(main())
