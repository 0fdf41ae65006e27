# SPDX-License-Identifier: Apache-2.0
"""What the map around a vehicle cost: requests, making the next map, and what went to a device."""

from __future__ import annotations

from shmmap_clients.ndt_scan_matcher.backends.backend import UploadStatistics
from shmmap_clients.spread import RunningSpread

__all__ = ["UpdateStatistics"]


class UpdateStatistics:
    """What the changes of the map in use were like.

    Attributes
    ----------
    updates
        How many there were.
    added, removed
        Cells, over all of them.
    request_ms
        From asking until the daemon's cells were attached, milliseconds.
    build_ms
        For the map beside the one in use, milliseconds.
    prepare_ms
        The part of it in which the backend got ready: covariances, tables, writing to a device.
    private_bytes
        This process's own memory for a map, at most.
    uploads
        What was written to a device, also for a map that had to be written again.

    Parameters
    ----------
    uploads
        Where that is counted.
    """

    def __init__(self, uploads: UploadStatistics | None = None) -> None:
        self.updates = 0
        self.added = 0
        self.removed = 0
        self.request_ms = RunningSpread()
        self.build_ms = RunningSpread()
        self.prepare_ms = RunningSpread()
        self.private_bytes = 0
        self.uploads = uploads if uploads is not None else UploadStatistics()

    def add(
        self,
        *,
        added: int,
        removed: int,
        request_s: float,
        build_s: float,
        prepare_s: float,
        private_bytes: int,
    ) -> None:
        """Count one change."""
        self.updates += 1
        self.added += added
        self.removed += removed
        self.request_ms.add(request_s * 1e3)
        self.build_ms.add(build_s * 1e3)
        self.prepare_ms.add(prepare_s * 1e3)
        self.private_bytes = max(self.private_bytes, private_bytes)
