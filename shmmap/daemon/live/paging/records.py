# SPDX-License-Identifier: Apache-2.0
"""Chunks of a live map and the scans that they take in: plain data."""

from __future__ import annotations

import enum
import math
from collections import deque
from dataclasses import dataclass, field

from shmmap.chunks.voxels import ChunkKey

__all__ = ["Chunk", "Limits", "Scan", "State"]


class State(enum.Enum):
    """Of a chunk in memory, or on its way there."""

    LOADING = "loading"
    CLEAN = "clean"
    DIRTY = "dirty"
    SAVING = "saving"


@dataclass(frozen=True, slots=True)
class Limits:
    """What a map may take.

    Attributes
    ----------
    budget_bytes
        Memory of all chunks and of what is beside them: lists of voxels, marks of scans.
    reserve_bytes
        Memory that chunks may take whatever is beside them: it cannot keep a map from being written.
    most_chunks
        Chunks in memory; 0 for no limit.  Each takes a descriptor and a mapping.
    most_active
        Known voxels of all chunks in memory; 0 for no limit.
    waiting_bytes
        What scans say of chunks that are not in memory yet.
    radius
        Chunks around a client's that are kept, along each axis; 1 for its 26 neighbours.
    hysteresis
        How far a client has to be in another chunk until its window follows, as a part of a chunk.
    linger_s
        How long a chunk outside all windows counts as near after a scan changed it.
    checkpoint_s
        How long a change is in memory alone, at most.
    loads, saves
        Files that are being read and written, or wait for a thread that does.
    """

    budget_bytes: int
    reserve_bytes: int = 0
    most_chunks: int = 0
    most_active: int = 0
    waiting_bytes: int = 64 << 20
    radius: int = 1
    hysteresis: float = 0.2
    linger_s: float = 2.0
    checkpoint_s: float = 10.0
    loads: int = 16
    saves: int = 16


@dataclass(eq=False, slots=True)
class Scan:
    """One scan of a mapper on its way.

    Attributes
    ----------
    mapper, number
        Whose and which.
    nbytes
        What keeping it takes.
    to_apply
        Chunks that have not taken it in yet.
    to_save
        Chunks that have, with the version that they came to by that, and are not durable in it.
    """

    mapper: int
    number: int
    nbytes: int
    to_apply: set[ChunkKey]
    to_save: dict[ChunkKey, int] = field(default_factory=dict)

    @property
    def applied(self) -> bool:
        """Whether all of it is in memory that outlives any process."""
        return not self.to_apply

    @property
    def durable(self) -> bool:
        """Whether all of it is on the disk."""
        return not self.to_apply and not self.to_save


@dataclass(eq=False, slots=True)
class Chunk:
    """A chunk in memory, or about to be.

    Attributes
    ----------
    version, saved, durable
        What is in memory, what its file holds, and what no power cut takes away.
    under_way
        It is being loaded.
    leaving
        It is saved in order to be given up.
    retry_s
        Before that its file is not tried again.
    missing_bytes
        What it needs to take in the next scan, and did not get.
    waiting
        Scans that it has to take in, in that order.
    unsaved
        Scans that it has taken in and that are not durable, with the versions.
    """

    key: ChunkKey
    state: State = State.LOADING
    nbytes: int = 0
    active: int = 0
    version: int = 0
    saved: int = 0
    durable: int = 0
    under_way: bool = False
    leaving: bool = False
    retry_s: float = -math.inf
    dirty_since_s: float = 0.0
    changed_s: float = -math.inf
    missing_bytes: int = 0
    waiting: deque[Scan] = field(default_factory=deque)
    unsaved: deque[tuple[int, Scan]] = field(default_factory=deque)
