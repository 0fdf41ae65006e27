# SPDX-License-Identifier: Apache-2.0
"""Examine a machine and an instance of the daemon on it, and run all checks."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import Final

from shmmap.daemon.config import DaemonConfig
from shmmap.doctor.access import check_group, check_map_access, check_ros_bridge, check_socket
from shmmap.doctor.cells import check_cache, check_cells, check_prefetching
from shmmap.doctor.daemon import (
    check_daemon,
    check_descriptors,
    check_leftovers,
    check_logind,
    check_pins,
    check_reload,
)
from shmmap.doctor.diagnosis import Diagnosis, Machine, answering_at
from shmmap.doctor.live import check_live_disk, check_live_maps, check_live_memory
from shmmap.doctor.memory import (
    check_container,
    check_disk_cache,
    check_huge_pages,
    check_memory_limit,
    check_shared_memory,
)
from shmmap.doctor.published import (
    check_clock,
    check_credentials,
    check_link,
    check_signature,
    check_versions,
)
from shmmap.doctor.verdicts import Finding
from shmmap.errors import ShmmapError
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.segment.names import usual_directory
from shmmap.statistics.reader import read_statistics

__all__ = ["CHECKS", "diagnose", "examine"]

CHECKS: Final[tuple[Callable[[Diagnosis], Finding], ...]] = (  # in the order of the output
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


def examine(config: DaemonConfig, file: str, machine: Machine | None = None) -> Diagnosis:
    """Collect facts about the machine and the instance's daemon."""
    if config.shm_dir == DEFAULT_SHM_DIR:
        config = dataclasses.replace(config, shm_dir=usual_directory(config.instance))
    try:
        seen, unreadable = read_statistics(config.instance, config.shm_dir), ""
    except ShmmapError as error:
        seen, unreadable = None, error.message
    except OSError as error:
        seen, unreadable = None, f"{config.shm_dir}: {error.strerror}"
    if seen is not None and seen.identity is not None and not (config.endpoint or config.runtime_dir):
        path = seen.identity.endpoint
    else:
        path = _socket(config)
    diagnosis = Diagnosis(machine or Machine(), config, file, path, seen, unreadable)
    if diagnosis.alive:
        return diagnosis
    return dataclasses.replace(diagnosis, answering=answering_at(path).get(config.instance, 0))


def diagnose(diagnosis: Diagnosis) -> list[Finding]:
    """Run all checks."""
    return [check(diagnosis) for check in CHECKS]


def _socket(config: DaemonConfig) -> str:
    from shmmap.protocol.endpoint import runtime_dirs, socket_path

    if config.endpoint or config.runtime_dir:
        return config.socket()
    places = [socket_path(place, config.instance) for place in runtime_dirs()]
    return next((place for place in places if os.path.exists(place)), places[-1])
