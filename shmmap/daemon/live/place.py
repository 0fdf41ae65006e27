# SPDX-License-Identifier: Apache-2.0
"""Where the chunks of live maps go, and how much memory they may take."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Final

from shmmap.daemon.config_live import LiveSettings, live_directory
from shmmap.daemon.host.memory import mounts
from shmmap.daemon.live.messages import Begin
from shmmap.errors import CannotStart, ConfigError
from shmmap.segment.directory import DEFAULT_SHM_DIR, ShmDirectory

__all__ = ["bytes_beside_cells", "place_live_maps"]

CEILING_BYTES: Final = 1 << 30
PART: Final = 8
"""By default live maps get this part of the free memory."""
LEAST_BYTES: Final = 4 << 20
"""Least budget of a map: some of the largest chunks, half a mebibyte each."""


def bytes_beside_cells(maps: int, *, cells: ShmDirectory, shm_dir: str, budget_bytes: int) -> int:
    """Return how many bytes this many live maps need in the file system of the cells, at least or as set."""
    if not maps:
        return 0
    path = shm_dir or (cells.path if _huge_pages(cells.path) is None else DEFAULT_SHM_DIR)
    try:
        same = os.stat(path).st_dev == os.stat(cells.path).st_dev
    except OSError:
        same = False  # `place_live_maps` raises the error
    return (budget_bytes or LEAST_BYTES * maps) if same else 0


def place_live_maps(
    live: Sequence[LiveSettings],
    *,
    instance: str,
    cells: ShmDirectory,
    cells_budget_bytes: int,
    shm_dir: str,
    budget_bytes: int,
    gid: int,
    marks_gid: int,
) -> Begin:
    """Decide where live maps are kept and how much memory they may take.

    Parameters
    ----------
    cells, cells_budget_bytes
        Where the cells are, and what they may take.
    shm_dir, budget_bytes
        As set; empty and 0 for the defaults.
    gid, marks_gid
        Groups that may read chunks, and that may map.

    Raises
    ------
    ConfigError
        The directory has huge pages, or both budgets do not fit in it; there is no state directory.
    CannotStart
        The directory cannot be used, or too little is free.
    """
    path = shm_dir or (cells.path if _huge_pages(cells.path) is None else DEFAULT_SHM_DIR)
    directory = ShmDirectory(path)
    try:
        size, free = directory.size_bytes(), directory.free_bytes()
        used = sum(directory.used_bytes(f"/shmmap-live.{instance}.{one.name}.") for one in live)
    finally:
        directory.close()
    if huge := _huge_pages(directory.path):
        raise ConfigError(
            f"{directory.path} has huge pages ({huge}): a chunk of a few KiB would take 2 MiB there",
            key="live_shm_dir",
            hint="name a tmpfs without them, such as /dev/shm",
        )
    same = os.stat(directory.path).st_dev == os.stat(cells.path).st_dev
    beside = cells_budget_bytes if same else 0
    least = LEAST_BYTES * len(live)
    budget = budget_bytes or max(least, min((free + used - beside) // PART, CEILING_BYTES))
    if budget < least:
        raise ConfigError(
            f"{len(live)} live maps share {budget >> 20:,} MiB; each needs {LEAST_BYTES >> 20} MiB",
            key="live_budget",
            hint=f"raise --live-budget to {least >> 20}M at least",
        )
    if budget + beside > size:
        raise ConfigError(
            f"live maps of {budget >> 20:,} MiB and cells of {beside >> 20:,} MiB do not fit in"
            f" {directory.path}, which has {size >> 20:,} MiB",
            key="live_budget",
            hint="lower --live-budget or --budget, or enlarge the tmpfs",
        )
    if budget_bytes and budget > free + used:
        raise CannotStart(
            f"live maps of {budget >> 20:,} MiB do not fit in {directory.path}, which has"
            f" {free + used >> 20:,} MiB free",
            hint="free some, or lower --live-budget",
        )
    maps = tuple(
        dataclasses.replace(one, path=one.path or live_directory(instance, one.name)) for one in live
    )
    marks = os.path.join(directory.path, f"shmmap-live.{instance}.marks")
    return Begin(instance, maps, directory.path, marks, budget, gid, marks_gid)


def _huge_pages(path: str) -> str | None:
    """Return the mount option that gives a directory huge pages; None where it has none."""
    below = os.path.realpath(path) + "/"
    around = [mount for mount in mounts() if below.startswith(mount.point.rstrip("/") + "/")]
    if not around:
        return None
    options = max(reversed(around), key=lambda mount: len(mount.point)).options
    huge = next((option for option in options if option.startswith("huge=")), "huge=never")
    return None if huge in ("huge=never", "huge=advise") else huge
