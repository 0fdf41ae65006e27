# SPDX-License-Identifier: Apache-2.0
"""All checks, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmmap.doctor.access import check_group, check_map_access, check_socket
from shmmap.doctor.cells import check_cache, check_cells, check_prefetching
from shmmap.doctor.daemon import (
    check_daemon,
    check_descriptors,
    check_leftovers,
    check_logind,
    check_pins,
    check_reload,
)
from shmmap.doctor.finding import Finding
from shmmap.doctor.live import check_live_disk, check_live_maps, check_live_memory
from shmmap.doctor.memory import (
    check_container,
    check_disk_cache,
    check_huge_pages,
    check_memory_limit,
    check_shared_memory,
)
from shmmap.doctor.patient import Patient
from shmmap.doctor.published import check_clock, check_credentials, check_link, check_versions
from shmmap.doctor.ros_bridge import check_ros_bridge
from shmmap.doctor.signed_map import check_signature

__all__ = ["CHECKS", "diagnose"]

CHECKS: Final[tuple[Callable[[Patient], Finding], ...]] = (
    check_daemon,
    check_socket,
    check_group,
    check_map_access,
    check_link,
    check_credentials,
    check_clock,
    check_versions,
    check_reload,
    check_signature,
    check_cells,
    check_shared_memory,
    check_cache,
    check_prefetching,
    check_memory_limit,
    check_container,
    check_huge_pages,
    check_disk_cache,
    check_live_maps,
    check_live_disk,
    check_live_memory,
    check_ros_bridge,
    check_pins,
    check_descriptors,
    check_leftovers,
    check_logind,
)


def diagnose(patient: Patient) -> list[Finding]:
    """Carry out every check."""
    return [check(patient) for check in CHECKS]
