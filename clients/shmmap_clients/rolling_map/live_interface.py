# SPDX-License-Identifier: Apache-2.0
"""What the program uses of a live map of the daemon, for type checkers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap import Counts, ScanFilter

__all__ = ["ChunkRow", "Live", "Mapper", "Usage"]


class ChunkRow(Protocol):
    """A chunk of the map: where it is, and what is in it."""

    @property
    def key(self) -> tuple[int, int, int]:
        """Its voxels' indices, shifted right by 6 bits."""

    @property
    def state(self) -> str:
        """``loading``, ``clean``, ``dirty``, ``saving``, ``evicting``; ``saved``: on disk only."""


class Usage(Protocol):
    """What the map takes."""

    @property
    def active(self) -> int:
        """Voxels in memory that are known."""

    @property
    def bytes(self) -> int:
        """Of memory."""

    @property
    def chunks(self) -> int:
        """In memory."""

    @property
    def waiting_bytes(self) -> int:
        """What scans say of chunks that are not in memory yet."""


class Mapper(Protocol):
    """Sends scans."""

    @property
    def counts(self) -> Counts:
        """What became of the points of the last scan."""

    @property
    def applied(self) -> int:
        """Number of the newest scan in memory, all before it included."""

    @property
    def durable(self) -> int:
        """Number of the newest scan on the disk, all before it included."""

    def add(self, points: NDArray[np.floating], pose: NDArray[np.floating]) -> int:
        """Send a scan; waits while the daemon has no room.  Returns its number."""

    def wait_applied(self, timeout_s: float) -> Any:
        """Wait until all scans are in memory."""

    def wait_durable(self, timeout_s: float) -> Any:
        """Wait until all scans are on the disk."""


class Live(Protocol):
    """A live map."""

    @property
    def name(self) -> str:
        """Of the map."""

    @property
    def resolution(self) -> float:
        """Edge of a voxel, metres."""

    @property
    def frame_id(self) -> str:
        """Frame of the map."""

    @property
    def occupancy(self) -> Any:
        """What a hit and a miss are worth, as `shmmap.Occupancy` has it."""

    def mapper(self, name: str, *, scan_filter: ScanFilter, frame_id: str) -> Mapper:
        """Begin to map, under a name that no other program uses at the same time."""

    def move_to(self, x: float, y: float, z: float) -> Any:
        """Say where the window is, metres."""

    def chunks(self) -> Sequence[ChunkRow]:
        """Return the chunks in memory and on disk."""

    def occupied(self) -> NDArray[np.float64]:
        """Return the middles of occupied voxels, (N, 3), metres, map frame."""

    def free(self) -> NDArray[np.float64]:
        """Return the middles of free voxels, (N, 3), metres, map frame."""

    def usage(self) -> Usage:
        """Return what the map takes."""
