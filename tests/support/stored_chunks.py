# SPDX-License-Identifier: Apache-2.0
"""What is in a live map's database, and damage to it, by connections and reads of the test's own."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

from shmmap.chunks.voxels import ChunkKey

PAGE = 4096


def database(directory: Path) -> contextlib.closing[sqlite3.Connection]:
    """Open the database of a live map; each statement is a transaction."""
    return contextlib.closing(sqlite3.connect(directory / "map.db", isolation_level=None))


def chunk_sizes(directory: Path) -> dict[ChunkKey, int]:
    """Bytes of each saved chunk, the largest last."""
    with database(directory) as opened:
        rows = opened.execute("select key, length(data) from chunks order by length(data)").fetchall()
    return {ChunkKey.from_text(text): size for text, size in rows}


def saved_bytes(directory: Path, key: ChunkKey) -> bytes:
    """The bytes of a saved chunk, the newest."""
    with database(directory) as opened:
        query = "select data from chunks where key = ? order by id desc"
        data: bytes = opened.execute(query, (key.text,)).fetchone()[0]
    return data


def change_chunk(directory: Path, key: ChunkKey, change: Callable[[bytes], bytes]) -> None:
    """Have other bytes in the place of a saved chunk, which the tables do not show."""
    data = change(saved_bytes(directory, key))
    with database(directory) as opened:
        opened.execute("update chunks set data = ? where key = ?", (data, key.text))


def largest(directory: Path) -> ChunkKey:
    """The chunk that takes most."""
    return list(chunk_sizes(directory))[-1]


def damage_page(directory: Path, number: int, data: bytes) -> None:
    """Have other bytes in the place of a page, the first of which has number 1."""
    with (directory / "map.db").open("r+b") as file:
        file.seek((number - 1) * PAGE)
        file.write(data)


def page_kinds(directory: Path) -> dict[int, str]:
    """Whether each page is a leaf or an inner page of a tree, or of other use, by its first byte."""
    data = (directory / "map.db").read_bytes()
    kinds = {13: "leaf", 5: "tree", 10: "tree", 2: "tree"}
    return {
        number: "tree" if number == 1 else kinds.get(data[(number - 1) * PAGE], "other")
        for number in range(1, len(data) // PAGE + 1)
    }


def files_of(directory: Path) -> set[str]:
    """Names in the directory of a live map."""
    return set(os.listdir(directory))
