# SPDX-License-Identifier: Apache-2.0
"""What an earlier writer of a live map left in memory is taken over: it may be nowhere else."""

from __future__ import annotations

import contextlib

from shmmap.chunks.layout import OUT_OF_SERVICE, check_consistent
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.chunk_memory import ChunkFile
from shmmap.daemon.live.live_map import LiveMap
from shmmap.errors import CannotStart, SegmentCorrupt
from shmmap.logfmt import log

__all__ = ["adopt"]


def adopt(live: LiveMap, now_s: float) -> int:
    """Take over what an earlier process left in memory; returns how many chunks.

    Raises
    ------
    CannotStart
        There are unsaved chunks of another map of that name.
    OSError
        One cannot be opened: it stays where it is, for the next try.
    """
    memory = live.memory
    newest: dict[ChunkKey, tuple[int, str]] = {}
    for name, key, generation in list(memory.names()):
        if key not in newest or newest[key][0] < generation:
            newest[key] = (generation, name)
    undone = live.undo.of
    for name, key, generation in list(memory.names()):
        chunk = _opened(live, name)
        if chunk is None:
            memory.remove(name)
            continue
        if newest[key] != (generation, name) or int(chunk.view.state["state"]) == OUT_OF_SERVICE:
            memory.give_up(chunk)  # it was saved, and all but given up
            continue
        try:
            if undone == (key, generation):
                live.undo.restore(chunk.view)
            check_consistent(chunk.view, name)
            if int(chunk.view.state["version"]) < live.files.version(key):
                raise SegmentCorrupt(f"{name}: older than its file")
        except SegmentCorrupt as error:
            log.warning("chunk not adopted", chunk=key.text, reason=error.message)
            memory.give_up(chunk)
            continue
        live.take_over(chunk, now_s)
    if undone is not None:
        live.undo.drop()
    if memory.foreign:
        log.warning("somebody else's files left alone", count=len(memory.foreign), first=min(memory.foreign))
    return len(live.chunks)


def _opened(live: LiveMap, name: str) -> ChunkFile | None:
    """What has this name, if it is a chunk of this map; raises OSError if it cannot be opened now."""
    if live.memory.is_given_up(name):
        return None
    try:
        chunk = live.memory.open(name)
    except SegmentCorrupt as error:
        log.warning("chunk not adopted", file=name, reason=error.message)
        return None
    identity, state = chunk.view.identity, chunk.view.state
    if identity == live.identity(identity.key, identity.generation):
        return chunk
    unsaved = int(state["version"]) > int(state["saved_version"])
    with contextlib.closing(chunk):
        if unsaved and int(state["state"]) != OUT_OF_SERVICE:
            raise CannotStart(
                f"{name} is a chunk of another map of this name, and has not been saved",
                hint="start once with the directory of that map, or remove the file if it is of no use",
            )
    log.warning("chunk not adopted", file=name, reason="of another map, or of other settings")
    return None
