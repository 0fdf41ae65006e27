# SPDX-License-Identifier: Apache-2.0
"""Changes to well-formed bytes that find defects in whoever reads them."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

from tests.support.message_pack import pack, unpack

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
