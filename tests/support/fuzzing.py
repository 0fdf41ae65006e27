# SPDX-License-Identifier: Apache-2.0
"""Readers of foreign bytes, changes that find defects in them, and children that may crash."""

from __future__ import annotations

import argparse
import math
import os
import random
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from shmmap.chunks.chunk_file import decode_chunk, read_file_header
from shmmap.chunks.layout import ChunkIdentity, ChunkView, check_consistent
from shmmap.chunks.marks import decode_marks, encode_marks
from shmmap.daemon.transport.zmtp import Incoming
from shmmap.errors import BadRequest, MapDataError, ProtocolMismatch, SegmentError
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import CAUSES
from shmmap.protocol.codec import decode_reply, decode_request, encode, request_number, unpack_versions
from shmmap.segment.attach import attach
from shmmap.segment.layout import PAGE_BYTES, TAIL_BYTES
from tests.support.message_pack import pack, unpack

CORPUS: Final = Path(__file__).resolve().parents[1] / "corpus"


# --- changes to well-formed bytes ---------------------------------------------------------------


LENGTHS = (0, 1, 15, 16, 31, 32, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1, 2**31, 2**63 - 1, 2**63, 2**64 - 1, -(2**63), 0.0, -0.0, 1e308, 5e-324),
    *(math.nan, math.inf, -math.inf, "", "points", "0_0.pcd", "/", "x" * 70, "\x00", "\N{SNOWMAN}"),
    *(
        b"",
        bytes(8),
        bytes(9),
        [],
        [[]],
        ["points"],
        ["circle", 0, 0, 5],
        ["box", 0, 0, -1, -1],
        {},
        {"a": 1},
    ),
)


def mutate_bytes(data: bytes, rng: random.Random, pool: list[bytes]) -> bytes:
    """Flip, overwrite, cut, repeat, insert, splice; one to a few times."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(max(1, len(out)))
        match rng.randrange(8):
            case 0 if out:
                out[at % len(out)] ^= 1 << rng.randrange(8)
            case 1 if out:
                out[at % len(out)] = rng.choice(
                    (0, 0x7F, 0x80, 0xC0, 0xC1, 0xDD, 0xDF, 0xFF, rng.randrange(256))
                )
            case 2:
                del out[at : at + rng.choice((1, 2, 8, 64))]
            case 3:
                out[at:at] = rng.randbytes(rng.choice((1, 2, 8, 100)))
            case 4:
                out[at:at] = out[at : at + rng.choice((1, 8, 64))] * rng.choice((1, 2, 50))
            case 5:
                other = rng.choice(pool)
                out[at:] = other[rng.randrange(len(other) + 1) :]
            case 6:
                kind = rng.choice(("<H", ">H", "<I", ">I", "<Q", ">Q"))
                size = struct.calcsize(kind)
                out[at : at + size] = struct.pack(kind, rng.choice(LENGTHS) % (1 << 8 * size))
            case _:
                del out[at:]
    return bytes(out)


def mutate_message(data: bytes, rng: random.Random, pool: list[bytes]) -> bytes:
    """Change a MessagePack array by its elements, so that what results is well-formed."""
    try:
        tree = unpack(data)
    except Exception:  # noqa: BLE001  what is not MessagePack is mutated as bytes
        return mutate_bytes(data, rng, pool)
    for _ in range(rng.choice((1, 1, 2, 4))):
        tree = _mutate_tree(tree, rng)
    try:
        return pack(tree)
    except (ValueError, OverflowError, RecursionError, struct.error, TypeError):
        return data


def _mutate_tree(tree: Any, rng: random.Random) -> Any:
    if not isinstance(tree, list) or rng.random() < 0.2:
        return rng.choice(VALUES)
    out = list(tree)
    at = rng.randrange(len(out) + 1)
    match rng.randrange(5):
        case 0 if out:
            del out[at % len(out)]
        case 1:
            out.insert(at, rng.choice(VALUES))
        case 2 if out:
            out[at % len(out) :] = [out[at % len(out)]] * rng.choice((2, 20, 300))
        case _ if out:
            out[at % len(out)] = _mutate_tree(out[at % len(out)], rng)
    return out


# --- readers ------------------------------------------------------------------------------------


class Target(NamedTuple):
    """One reader: how its inputs are changed, and the check that gives an outcome or raises."""

    mutate: Callable[[bytes, random.Random, list[bytes]], bytes]
    check: Callable[[bytes], str]


def corpus(name: str) -> dict[str, bytes]:
    """Kept inputs of a target by name: well-formed ones, and those that once found a defect."""
    return {path.name: path.read_bytes() for path in sorted((CORPUS / name).iterdir())}


# --- protocol -----------------------------------------------------------------------------------


def check_protocol(data: bytes) -> str:
    """Both directions of the codec: a message, or the one error there is; what decodes encodes again."""
    outcome = []
    number = request_number(data)
    if not 0 <= number < 1 << 64:
        raise AssertionError(f"request number {number}")
    try:
        message = decode_request(data)
        again = encode(message)
        if encode(decode_request(again)) != again:
            raise AssertionError("a request changes when it is sent on")
        packed = getattr(message, "packed", None)
        if packed is not None and len(packed) % 8 == 0:
            unpack_versions(packed)
        outcome.append(type(message).__name__)
    except BadRequest:
        outcome.append("refused")
    try:
        reply = decode_reply(data)
        again = encode(reply)
        if encode(decode_reply(again)) != again:
            raise AssertionError("a reply changes when it is sent on")
        outcome.append(type(reply).__name__)
    except ProtocolMismatch:
        outcome.append("refused")
    return "/".join(outcome)


# --- zmtp ---------------------------------------------------------------------------------------


def check_zmtp(data: bytes) -> str:
    """What comes on a connection: messages or one of two errors, the same however it is cut into pieces."""
    outcomes = []
    for piece, at_once in ((len(data) or 1, 10_000), (7, 10_000), (64, 3)):
        incoming = Incoming(b"ROUTER", b"DEALER", 4096)
        messages: list[tuple[bytes, bool]] = []
        outcome = "silence"
        try:
            for at in range(0, len(data), piece):
                incoming.add(data[at : at + piece])
                messages += incoming.messages(at_once, lambda _said: None)
                while incoming.more:
                    messages += incoming.messages(at_once, lambda _said: None)
            outcome = "messages" if messages else outcome
        except (ProtocolMismatch, BadRequest) as error:
            outcome = type(error).__name__
        outcomes.append(outcome)
        if sum(len(body) for body, _ in messages) + len(incoming) > len(data):
            raise AssertionError("more is kept than came")
    if len(set(outcomes)) > 1:
        raise AssertionError(f"it depends on the pieces: {outcomes}")
    return outcomes[0]


# --- segment ------------------------------------------------------------------------------------


def check_segment(data: bytes) -> str:
    """Attach and look at everything: an error of the tree, or arrays that lie inside the bytes."""
    with tempfile.TemporaryDirectory(prefix="shmmap-fuzz-", dir="/dev/shm") as directory:
        path = f"{directory}/segment"
        Path(path).write_bytes(data)
        try:
            segment = attach("/segment", shm_dir=directory)
            for index in range(len(segment.columns)):
                view = segment.column(index)
                start = view.__array_interface__["data"][0] - segment.raw.__array_interface__["data"][0]
                if view.size and not 0 <= start <= start + view.nbytes <= len(segment.raw):
                    raise AssertionError("a column reaches outside of the segment")
                if view.flags.writeable:
                    raise AssertionError("a column can be written")
                view.tobytes()
            header = segment.header
            if header.total_bytes > len(data):
                raise AssertionError("the header promises more than there is")
            segment.published  # noqa: B018  it raises where the block is damaged
            segment.verify()
        except SegmentError as error:
            return type(error).__name__
        finally:
            os.unlink(path)
    return "attached"


def repair(data: bytearray) -> bytes:
    """Give a changed header the checksum that fits it."""
    out = bytearray(data)
    if len(out) >= PAGE_BYTES:
        header_bytes = int.from_bytes(out[16:24], "little")
        end = (header_bytes if PAGE_BYTES <= header_bytes <= len(out) else PAGE_BYTES) - TAIL_BYTES
        out[end : end + 4] = zlib.crc32(out[:end]).to_bytes(4, "little")
    return bytes(out)


def mutate_segment(data: bytes, rng: random.Random, pool: list[bytes]) -> bytes:
    """Mutate the header most of the time, and repair its checksum as a liar would."""
    if rng.random() < 0.2:
        return mutate_bytes(data, rng, pool)
    out = bytearray(data)
    used = [*range(16, 256), *range(512, 512 + 3 * 144)]
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.choice(used) if rng.random() < 0.9 else rng.randrange(PAGE_BYTES)
        kind = rng.choice(("<B", "<I", "<Q", "<d"))
        size = struct.calcsize(kind)
        if kind == "<d":
            out[at : at + size] = struct.pack(kind, rng.choice((0.0, -1.0, float("nan"), 1e308)))
        else:
            value = rng.choice((0, 1, 4, 64, 4096, len(data), 2**31, 2**63, 2**64 - 1, rng.randrange(2**64)))
            out[at : at + size] = struct.pack(kind, value % (1 << 8 * size))
    return repair(out) if rng.random() < 0.9 else bytes(out)


# --- PCD ----------------------------------------------------------------------------------------


def check_pcd(data: bytes) -> str:
    """Read a file to its end: points that add up, or `MapDataError` with a listed cause."""
    with tempfile.NamedTemporaryFile(suffix=".pcd") as file:
        file.write(data)
        file.flush()
        try:
            with PcdReader(Path(file.name)) as reader:
                rows = 0
                for block in reader.blocks():
                    if not np.isfinite(block[0]).all():
                        raise AssertionError("a point that is not finite was kept")
                    rows += len(block[0])
                if rows + reader.dropped != reader.header.points:
                    raise AssertionError("points do not add up")
        except MapDataError as error:
            if error.cause not in CAUSES:
                raise AssertionError(f"cause {error.cause} is not listed") from error
            return error.cause
    return "read"


# --- live maps ----------------------------------------------------------------------------------

MARKS_OF: Final = (bytes(range(16)), 1, 2)
"""Map, mapper and scan that the marks of the corpus are for."""


def check_marks(data: bytes) -> str:
    """What a mapper sends: refused, or marks that encode to the same bytes."""
    try:
        marks = decode_marks(data, *MARKS_OF)
    except BadRequest:
        return "refused"
    if len(encode_marks(marks, *MARKS_OF)) != len(data):
        raise AssertionError("marks change when they are sent on")
    if int(marks.starts[-1]) != len(marks.words) or len(marks.words) != len(marks.bits):
        raise AssertionError("words are left over")
    return f"{len(marks.keys)} chunks"


def check_chunk(data: bytes) -> str:
    """A chunk's file: refused, or a chunk that is consistent in itself."""
    try:
        header = read_file_header(data)
        identity = ChunkIdentity(header.map_id, header.key, header.resolution, -1992, 3476, 0, 0, 1, "map")
        view = ChunkView(decode_chunk(data, identity))
        check_consistent(view)
    except MapDataError:
        return "refused"
    return "read"


def mutate_protocol(data: bytes, rng: random.Random, pool: list[bytes]) -> bytes:
    """As a tree half of the time, as bytes otherwise."""
    return (mutate_message if rng.random() < 0.5 else mutate_bytes)(data, rng, pool)


TARGETS: Final = {
    "protocol": Target(mutate_protocol, check_protocol),
    "zmtp": Target(mutate_bytes, check_zmtp),
    "segment": Target(mutate_segment, check_segment),
    "pcd": Target(mutate_bytes, check_pcd),
    "marks": Target(mutate_bytes, check_marks),
    "chunk": Target(mutate_bytes, check_chunk),
}


# --- child processes of thirty seconds each: a crash is a finding, and its input stays ----------


_CHILD_S: Final = 30.0


def limit_memory(more_bytes: int) -> None:
    """Let this process have that many bytes of address space more than it has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + more_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def repeat(step: Callable[[], str], seed: int, seconds: float) -> int:
    """Take a step that returns its outcome until the time is over, and print what came of it; returns 0."""
    outcomes: Counter[str] = Counter()
    slowest_s, started = 0.0, time.monotonic()
    end_s = started + seconds
    while started < end_s:
        outcomes[step()] += 1
        before, started = started, time.monotonic()
        slowest_s = max(slowest_s, started - before)
    table = " ".join(f"{name}={number}" for name, number in sorted(outcomes.items()))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    inputs = f"{outcomes.total()} inputs, slowest {slowest_s * 1e3:.0f} ms"
    print(f"seed {seed}: {inputs}, peak {peak:.0f} MB: {table}")
    return 0


def fuzz_in_children(name: str, docstring: str | None, child: Callable[[Path, int, float], int]) -> int:
    """Be the program ``tests.benchmarks.NAME``; returns its exit code, 1 for a finding.

    Parameters
    ----------
    name, docstring
        The benchmark's.
    child
        Fuzzes in a directory, from a seed, for some seconds; what it leaves there led to the finding.
    """
    parser = argparse.ArgumentParser(description=docstring.splitlines()[0] if docstring else "")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to fuzz (default 60)")
    parser.add_argument("--seed", type=int, default=None, help="first seed (default: from the clock)")
    parser.add_argument("--child", type=Path, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        try:
            return child(options.child, options.seed, options.seconds)
        except Exception:  # noqa: BLE001  whatever it is, it is a finding
            traceback.print_exc()
            return 1
    seed = time.time_ns() % 10**9 if options.seed is None else options.seed
    deadline = time.monotonic() + options.seconds
    while (left := deadline - time.monotonic()) > 0:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}."))
        command = [sys.executable, "-X", "faulthandler", "-W", "error", "-m", f"tests.benchmarks.{name}"]
        command += ["--child", str(folder), "--seed", str(seed), "--seconds", f"{min(left, _CHILD_S):.3f}"]
        done = subprocess.run(command, check=False, env=os.environ)
        if done.returncode:
            kept = next(folder.iterdir(), folder)
            print(f"FOUND with seed {seed} (exit {done.returncode}): {kept}", flush=True)
            return 1
        shutil.rmtree(folder)
        seed += 1
    return 0
