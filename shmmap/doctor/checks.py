# SPDX-License-Identifier: Apache-2.0
"""Examine a machine and an instance of the daemon on it, and run all checks."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from contextlib import closing
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
from shmmap.doctor.daemon_lists import DaemonLists
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
from shmmap.doctor.verdicts import Finding, skip
from shmmap.errors import NotPermitted, ShmmapError
from shmmap.segment.names import DEFAULT_SHM_DIR, usual_directory
from shmmap.statistics.reader import read_statistics

CHECKS: Final[dict[str, Callable[[Diagnosis], Finding]]] = {  # in the order of the output
    "daemon": check_daemon,
    "socket": check_socket,
    "group": check_group,
    "map": check_map_access,
    "link": check_link,
    "credentials": check_credentials,
    "clock": check_clock,
    "versions": check_versions,
    "reload": check_reload,
    "signature": check_signature,
    "cells": check_cells,
    "shared memory": check_shared_memory,
    "cache size": check_cache,
    "prefetching": check_prefetching,
    "memory limit": check_memory_limit,
    "container": check_container,
    "huge pages": check_huge_pages,
    "disk cache": check_disk_cache,
    "live maps": check_live_maps,
    "live disk": check_live_disk,
    "live memory": check_live_memory,
    "ROS bridge": check_ros_bridge,
    "leases": check_pins,
    "open files": check_descriptors,
    "leftovers": check_leftovers,
    "logout": check_logind,
}
_OF_A_DAEMON: Final = frozenset({"reload", "signature", "cells", "cache size", "prefetching"})
_OF_A_PUBLISHED_MAP: Final = frozenset({"link", "credentials", "clock", "versions"})


def examine(config: DaemonConfig, file: str) -> Diagnosis:
    """Collect facts about the machine and the instance's daemon."""
    if config.shm_dir == DEFAULT_SHM_DIR:
        config = dataclasses.replace(config, shm_dir=usual_directory(config.instance))
    try:
        seen, unreadable = read_statistics(config.instance, config.shm_dir), ("", "")
    except NotPermitted as error:
        seen, unreadable = None, (error.message, "join its group, or run it with sudo")
    except ShmmapError as error:
        seen, unreadable = None, (error.message, error.hint or "restart the daemon")
    except OSError as error:
        seen, unreadable = None, (f"{config.shm_dir}: {error.strerror}", "see to that directory")
    if seen is not None and seen.identity is not None:
        with closing(DaemonLists("shmmap doctor")) as lists:
            lists.add_to(seen, clients=bool(seen.identity.live))
    if seen is not None and seen.identity is not None and not (config.endpoint or config.runtime_dir):
        path = seen.identity.endpoint
    else:
        path = _socket(config)
    diagnosis = Diagnosis(Machine(), config, file, path, seen, unreadable)
    if diagnosis.alive:
        return diagnosis
    return dataclasses.replace(diagnosis, answering=answering_at(path).get(config.instance, 0))


def diagnose(diagnosis: Diagnosis) -> list[Finding]:
    """Run all checks that apply."""
    findings = []
    for name, check in CHECKS.items():
        if name in _OF_A_DAEMON and not diagnosis.alive:
            found = skip("no daemon runs")
        elif name in _OF_A_PUBLISHED_MAP and not diagnosis.is_published:
            found = skip("the map is files")
        else:
            found = check(diagnosis)
        findings.append(dataclasses.replace(found, name=name))
    return findings


def _socket(config: DaemonConfig) -> str:
    from shmmap.protocol.endpoint import runtime_dirs, socket_path

    if config.endpoint or config.runtime_dir:
        return config.socket()
    places = [socket_path(place, config.instance) for place in runtime_dirs()]
    return next((place for place in places if os.path.exists(place)), places[-1])
