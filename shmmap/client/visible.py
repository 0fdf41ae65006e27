# SPDX-License-Identifier: Apache-2.0
"""What this process sees of the daemon's segments by the one that every daemon has, its statistics."""

from __future__ import annotations

import os

from shmmap.errors import SegmentError

__all__ = ["check_visible", "owner_of_segments"]


def statistics_path(shm_dir: str, segment_prefix: str) -> str:
    """Path of the statistics segment of the daemon whose segments' names begin so."""
    return f"{shm_dir}/{segment_prefix.lstrip('/')}statistics"


def owner_of_segments(shm_dir: str, segment_prefix: str) -> int | None:
    """User whose segments they are, as this process sees it; None where it sees none."""
    try:
        return os.lstat(statistics_path(shm_dir, segment_prefix)).st_uid
    except OSError:
        return None


def check_visible(shm_dir: str, segment_prefix: str) -> None:
    """Refuse a directory without the daemon's statistics: in a container it may be another one.

    Raises
    ------
    SegmentError
        The directory, as this process sees it, is not the daemon's.
    """
    if owner_of_segments(shm_dir, segment_prefix) is None:
        raise SegmentError(
            f"the daemon's segments are not in {shm_dir}, as this process sees it",
            hint="in a container mount the daemon's directory of segments, and name it with shm_dir or"
            " SHMMAP_SHM_DIR where its path differs",
        )
