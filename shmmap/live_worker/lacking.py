# SPDX-License-Identifier: Apache-2.0
"""Chunks of which something that was saved is lost: what readers' answers say about them."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.areas import touches
from shmmap.live_worker.paged_map import PagedMap
from shmmap.protocol.areas import LiveArea
from shmmap.protocol.live import MAX_LACKING, LackingChunk

_KEYS_PER_STEP: Final = 64


def lacking_chunks(paged: PagedMap, area: LiveArea | None) -> Generator[None, None, dict[ChunkKey, str]]:
    """Return the chunks that touch an area and have lost something, and what; yield after each step."""
    found: dict[ChunkKey, str] = {}
    for number, (key, one) in enumerate(dict(paged.database.lost).items(), 1):
        if touches(area, key, paged.resolution):
            found[key] = one.text
        if number % _KEYS_PER_STEP == 0:
            yield None
    return found


def shown(lacking: Mapping[ChunkKey, str]) -> tuple[tuple[LackingChunk, ...], int]:
    """Return the first of these chunks, as many as an answer names, and the number of all."""
    rows = [LackingChunk(key, lacking[key]) for key in sorted(lacking)[:MAX_LACKING]]
    return tuple(rows), len(lacking)
