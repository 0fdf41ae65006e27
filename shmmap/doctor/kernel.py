# SPDX-License-Identifier: Apache-2.0
"""What the daemon asks of the kernel: leases, open-file-description locks, descriptors."""

from __future__ import annotations

import re
import resource
from typing import Final

from shmmap.daemon.pins.probe import probe_pins
from shmmap.doctor.finding import Finding, fail, ok, warn
from shmmap.doctor.patient import Patient
from shmmap.errors import CannotStart
from shmmap.segment.directory import ShmDirectory

__all__ = ["check_descriptors", "check_pins"]

FEW_DESCRIPTORS: Final = 4096
_LIMIT: Final = re.compile(r"^Max open files\s+(\S+)\s+(\S+)", re.MULTILINE)


def check_pins(patient: Patient) -> Finding:
    """Can the kernel tell which processes map a segment?"""
    name = "leases"
    try:
        directory = ShmDirectory(patient.shm_dir)
    except CannotStart as error:
        if patient.alive:
            return ok(name, "tried by the daemon when it started: see `shmmap status`")
        return fail(name, error.message, error.hint)
    try:
        found = probe_pins(directory)
    finally:
        directory.close()
    if not found.leases:
        return warn(
            name,
            f"{patient.shm_dir} grants none: memory in use is known from {found.source.value} only",
            "name a directory on a tmpfs with shm_dir",
        )
    parts = {"locks": found.locks, "inotify": found.close_events}
    if lacking := ", ".join(f"no {part}" for part, works in parts.items() if not works):
        return warn(
            name,
            f"they work, but not all of what goes with them: {lacking}",
            "clients may stay unnamed, or memory be freed late: use a newer kernel",
        )
    return ok(name, "leases and locks work: the kernel tells which processes map a segment")


def check_descriptors(patient: Patient) -> Finding:
    """How many clients does the limit of open files allow?"""
    limits = _LIMIT.search(patient.machine.text(f"/proc/{patient.pid}/limits")) if patient.pid else None
    hard = limits[2] if limits else str(resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    whose = f"of the daemon (pid {patient.pid})" if limits else "here"
    if not hard.isdigit() or int(hard) < 0:
        return ok("open files", f"no limit {whose}")
    fact = f"limit {whose}: {hard}, enough for {int(hard) // 2} clients"
    if int(hard) < FEW_DESCRIPTORS:
        return warn("open files", fact, "raise it: LimitNOFILE=65536 in the unit, or `ulimit -Hn`")
    return ok("open files", fact)
