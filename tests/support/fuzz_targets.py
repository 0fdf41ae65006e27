# SPDX-License-Identifier: Apache-2.0
"""What reads bytes that others wrote, and what may come out of it for any bytes at all."""

from __future__ import annotations

import os
import random
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

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
from tests.support.mutations import mutate_bytes, mutate_message

CORPUS: Final = Path(__file__).resolve().parents[1] / "corpus"


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
        heard: list[tuple[bytes, bool]] = []
        outcome = "silence"
        try:
            for at in range(0, len(data), piece):
                incoming.add(data[at : at + piece])
                heard += incoming.messages(at_once, lambda _said: None)
                while incoming.more:
                    heard += incoming.messages(at_once, lambda _said: None)
            outcome = "messages" if heard else outcome
        except (ProtocolMismatch, BadRequest) as error:
            outcome = type(error).__name__
        outcomes.append(outcome)
        if sum(len(body) for body, _ in heard) + len(incoming) > len(data):
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
