# SPDX-License-Identifier: Apache-2.0
"""Names in the shared-memory directory.

``/shmmap.<instance>.<unique>`` is a published segment; ``<unique>`` is 64 random bits, handed out
by the daemon and never used again.  ``/shmmap.<instance>.<unique>.zombie`` is the same segment once
retired: new readers cannot find it, old ones keep it.  ``/shmmap.<instance>.statistics`` is the one
name that can be derived.
"""

from __future__ import annotations

import os
import re
from typing import Final

from shmmap.errors import ConfigError

__all__ = [
    "DEFAULT_SHM_DIR",
    "HUGE_PAGES_DIR",
    "another_name",
    "check_instance",
    "is_retired",
    "new_segment_name",
    "retired_name",
    "segment_prefix",
    "statistics_name",
    "usual_directory",
]

DEFAULT_SHM_DIR: Final = "/dev/shm"  # noqa: S108
"""Where ``shm_open`` puts segments on Linux."""
HUGE_PAGES_DIR: Final = "/run/shmmap_huge"
"""Where ``shmmap unit install --huge-pages`` mounts a tmpfs."""

_INSTANCE: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_RETIRED: Final = ".zombie"


def check_instance(instance: str) -> str:
    """Return ``instance``, or raise `ConfigError` if it cannot be part of a name."""
    if not _INSTANCE.fullmatch(instance):
        raise ConfigError(
            f"instance name {instance!r} is not usable",
            key="instance",
            hint="use 1 to 64 letters, digits, '-' or '_'",
        )
    return instance


def segment_prefix(instance: str) -> str:
    """Return what every name of this instance starts with, slash included."""
    return f"/shmmap.{instance}."


def statistics_name(instance: str) -> str:
    """Return the name of the instance's statistics segment."""
    return f"/shmmap.{instance}.statistics"


def usual_directory(instance: str, places: tuple[str, str] = (DEFAULT_SHM_DIR, HUGE_PAGES_DIR)) -> str:
    """Return where the instance's names are, for those who were not told: /dev/shm, or on huge pages."""
    plain, huge = places
    if os.path.exists(plain + statistics_name(instance)) or not os.path.ismount(huge):
        return plain
    return huge


def new_segment_name(instance: str) -> str:
    """Return a name that was never used before."""
    return f"/shmmap.{instance}.{os.urandom(8).hex()}"


def another_name(name: str) -> str:
    """Return a name of the same instance as ``name`` that was never used before."""
    return f"{name.rpartition('.')[0]}.{os.urandom(8).hex()}"


def retired_name(name: str) -> str:
    """Return the name a segment gets when it is retired."""
    return name + _RETIRED


def is_retired(name: str) -> bool:
    """Whether ``name`` is that of a retired segment."""
    return name.endswith(_RETIRED)
