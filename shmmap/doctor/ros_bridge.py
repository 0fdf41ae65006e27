# SPDX-License-Identifier: Apache-2.0
"""Bridges to ROS 2: whether they run, and which nodes wait for them that they cannot answer.

A bridge tells it by a file beside the daemon's socket, ``INSTANCE.ros-bridge-DOMAIN.json``, and holds a lock
on that file while it runs.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import stat
from collections import Counter
from typing import Any, Final

from shmmap.doctor.finding import Finding, ok, skip, warn
from shmmap.doctor.patient import Patient
from shmmap.protocol.endpoint import runtime_dirs
from shmmap.quantities import counted
from shmmap.segment.pins import has_slot

__all__ = ["check_ros_bridge"]

ADVICE: Final = "start these nodes with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp"
_MOST_BYTES: Final = 1 << 16
_NAMED: Final = 3
_LOCKED: Final = 0
"""A byte of the file that the bridge has locked: all of it."""


def check_ros_bridge(patient: Patient) -> Finding:
    """Check that every ROS node that asks a bridge can be answered."""
    name = "ROS bridge"
    told = [one for path in _files(patient) if (one := _told(patient, path)) is not None]
    if not told:
        return skip(name, "none runs")
    places = ", ".join(sorted(f"domain {one['domain']}: {counted(one['clients'], 'client')}" for one in told))
    strangers = Counter(
        (str(one.get("service")), str(one.get("vendor", ""))) for each in told for one in each["strangers"]
    )
    if not strangers:
        return ok(name, places)
    named = "; ".join(
        f"{counted(count, 'client')} of {service}{f', of {vendor}' if vendor else ''}"
        for (service, vendor), count in strangers.most_common(_NAMED)
    )
    more = "; …" if len(strangers) > _NAMED else ""
    return warn(
        name, f"{places}; not nodes of rmw_cyclonedds_cpp, so that they wait for ever: {named}{more}", ADVICE
    )


def _files(patient: Patient) -> list[str]:
    """Files of bridges of this instance, where a bridge looks for a place."""
    places = dict.fromkeys((os.path.dirname(patient.socket), *runtime_dirs()))
    pattern = f"{glob.escape(patient.config.instance)}.ros-bridge-*.json"
    root = len(str(patient.machine.path("/")).rstrip("/"))
    return [
        found[root:]
        for place in places
        for found in sorted(glob.glob(f"{glob.escape(str(patient.machine.path(place)))}/{pattern}"))
    ]


def _told(patient: Patient, path: str) -> dict[str, Any] | None:
    """Read a bridge's file; None if the bridge does not run, or the file is not a bridge's."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        fd = os.open(patient.machine.path(path), flags)
        try:
            if not stat.S_ISREG(os.fstat(fd).st_mode) or not has_slot(fd, _LOCKED):
                return None
            told = json.loads(os.pread(fd, _MOST_BYTES, 0))
        finally:
            os.close(fd)
        strangers = [one for one in told["strangers"] if isinstance(one, dict)]
        return {"domain": int(told["domain"]), "clients": int(told["clients"]), "strangers": strangers}
    return None
