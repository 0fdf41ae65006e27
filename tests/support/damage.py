# SPDX-License-Identifier: Apache-2.0
"""Ways to spoil a segment that a killed daemon left."""

from __future__ import annotations

import os
import struct
import zlib


def _poke(path: str, at: int) -> None:
    os.chmod(path, 0o600)
    with open(path, "r+b") as file:
        file.seek(at)
        byte = file.read(1)
        file.seek(at)
        file.write(bytes([byte[0] ^ 0x10]))
    os.chmod(path, 0o400)


def damage_payload(path: str) -> None:
    _poke(path, 4096 + 64 * 3 + 1)


def damage_header(path: str) -> None:
    _poke(path, 96)


def other_layout(path: str) -> None:
    """Another major layout version, checksum and all."""
    os.chmod(path, 0o600)
    with open(path, "r+b") as file:
        page = bytearray(file.read(4096))
        struct.pack_into("<H", page, 8, 2)
        end = 4096 - 72
        struct.pack_into("<I", page, end, zlib.crc32(page[:end]))
        file.seek(0)
        file.write(page)
    os.chmod(path, 0o400)


def damage_publish_block(path: str) -> None:
    _poke(path, 4096 - 64 + 17)


def shorten(path: str) -> None:
    os.chmod(path, 0o600)
    os.truncate(path, 4096)
    os.chmod(path, 0o400)


def punch(path: str) -> None:
    os.chmod(path, 0o600)
    with open(path, "r+b") as file:
        file.seek(4096)
        file.write(bytes(4096))
    os.chmod(path, 0o400)
