# SPDX-License-Identifier: Apache-2.0
"""Whether this process sees the daemon's segments at all: in a container it may not."""

from __future__ import annotations

from pathlib import Path

from shmmap.errors import SegmentError

__all__ = ["check_visible"]


def check_visible(shm_dir: str, segment_prefix: str) -> None:
    """Refuse a directory that lacks the one segment which every daemon has, its statistics.

    Raises
    ------
    SegmentError
        The directory, as this process sees it, is not the daemon's.
    """
    if not Path(f"{shm_dir}/{segment_prefix.lstrip('/')}statistics").exists():
        raise SegmentError(
            f"the daemon's segments are not in {shm_dir}, as this process sees it",
            hint="in a container mount the daemon's directory of segments, and name it with shm_dir or"
            " SHMMAP_SHM_DIR where its path differs",
        )
