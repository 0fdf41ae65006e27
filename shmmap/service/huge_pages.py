# SPDX-License-Identifier: Apache-2.0
"""Huge pages for the segments: which kernels benefit, and the files that enable them for the service.

A tmpfs with ``huge=within_size`` uses the largest pages that a file fills.  Up to Linux 6.13 these have 2
MiB; since then (large folios for tmpfs) any power of two, so that cells of all sizes benefit.
"""

from __future__ import annotations

import re
from typing import Final

from shmmap.errors import BadRequest, ConfigError

MOUNT: Final = "system/run-shmmap_huge.mount"
DROP_IN: Final = "drop-ins/huge-pages.conf"

_ALL_SIZES: Final = (6, 14)
_SWITCH: Final = "/sys/kernel/mm/transparent_hugepage/shmem_enabled"


def kernel_version(release: str) -> str:
    """Return the version, such as "6.18", from ``uname -r``; empty if there is none."""
    found = re.match(r"\d+\.\d+", release)
    return found[0] if found else ""


def of_all_sizes(release: str) -> bool:
    """Return whether the kernel ``release`` (``uname -r``) has large pages of all sizes for a tmpfs."""
    version = kernel_version(release)
    return bool(version) and tuple(map(int, version.split("."))) >= _ALL_SIZES


def check_possible(*, user: bool, switch: str = _SWITCH) -> None:
    """Raise an error if huge pages cannot work here.

    Parameters
    ----------
    user
        Whether the service is a user's, which cannot mount.
    switch
        File of the kernel's setting; missing if the kernel has no huge pages for a tmpfs.

    Raises
    ------
    BadRequest
        The service is a user's.
    ConfigError
        The kernel has no huge pages for a tmpfs.
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
