# SPDX-License-Identifier: Apache-2.0
"""Huge pages for the segments: which kernels gain by them, and the files that give them to the service.

A tmpfs with ``huge=within_size`` takes the largest pages that a file fills.  Up to Linux 6.13 these are of
2 MiB; since then (large folios for tmpfs) of every power of two, so that cells of all sizes gain.
"""

from __future__ import annotations

import re
from typing import Final

from shmmap.errors import BadRequest, ConfigError

__all__ = ["DROP_IN", "MOUNT", "check_possible", "kernel_version", "of_all_sizes"]

MOUNT: Final = "system/run-shmmap_huge.mount"
DROP_IN: Final = "drop-ins/huge-pages.conf"

_ALL_SIZES: Final = (6, 14)
_SWITCH: Final = "/sys/kernel/mm/transparent_hugepage/shmem_enabled"


def kernel_version(release: str) -> str:
    """Return "6.18" of ``uname -r``; empty where there is none in it."""
    found = re.match(r"\d+\.\d+", release)
    return found[0] if found else ""


def of_all_sizes(release: str) -> bool:
    """Whether a kernel has large pages of all sizes for a tmpfs, by what ``uname -r`` says."""
    version = kernel_version(release)
    return bool(version) and tuple(map(int, version.split("."))) >= _ALL_SIZES


def check_possible(*, user: bool, switch: str = _SWITCH) -> None:
    """Refuse what cannot work here.

    Parameters
    ----------
    user
        The service is that of a user, and may mount nothing.
    switch
        The kernel's own setting; there is none where it has no huge pages for a tmpfs.

    Raises
    ------
    BadRequest
        For a user's service.
    ConfigError
        The kernel has none.
    """
    if user:
        raise BadRequest(
            "a user's service cannot have huge pages: only root may mount a file system",
            hint="sudo mount -o remount,huge=within_size /dev/shm",
        )
    try:
        with open(switch, encoding="ascii") as file:
            denied = "[deny]" in file.read()
    except OSError:
        denied = True
    if denied:
        raise ConfigError(
            "this kernel has no huge pages for shared memory", hint="install without --huge-pages"
        )
