# SPDX-License-Identifier: Apache-2.0
"""What the daemon asks of the kernel: leases, open-file-description locks, descriptors."""

from __future__ import annotations

import os
import re
import resource
from typing import Final

from shmmap.doctor.finding import Finding, fail, ok, warn
from shmmap.doctor.patient import Patient

__all__ = ["check_descriptors", "check_leases"]

FEW_DESCRIPTORS: Final = 4096
_LIMIT: Final = re.compile(r"^Max open files\s+(\S+)\s+(\S+)", re.MULTILINE)


def check_leases(patient: Patient) -> Finding:
    """Can the kernel tell who uses a segment, and name them?"""
    from shmmap.errors import ConfigError
    from shmmap.segment.directory import ShmDirectory
    from shmmap.segment.pins import holders, leases_work, lock_slot

    name = "pins"
    try:
        directory = ShmDirectory(patient.shm_dir)
    except ConfigError as error:
        if patient.alive:
            return ok(name, "the daemon runs, so it was granted leases")
        return fail(name, error.message, error.hint)
    try:
        fd = directory.create()
        try:
            if not leases_work(fd):
                return fail(
                    name,
                    f"{patient.shm_dir}: no leases, nobody could tell what is in use",
                    "name a directory on a tmpfs with shm_dir",
                )
            lock_slot(fd, 1)
            other = os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC)
            try:
                named = holders(other) == [1]
            finally:
                os.close(other)
        finally:
            os.close(fd)
    except OSError as error:
        return fail(name, f"{patient.shm_dir}: {error.strerror}", "name a directory on a tmpfs with shm_dir")
    finally:
        directory.close()
    if not named:
        return warn(
            name, "leases work, open-file locks do not: holders stay unnamed", "use another file system"
        )
    return ok(name, "leases and open-file locks work: the kernel tells who uses a segment")


def check_descriptors(patient: Patient) -> Finding:
    """How many clients does the limit of open files allow?"""
    limits = _LIMIT.search(patient.machine.text(f"/proc/{patient.pid}/limits")) if patient.pid else None
    hard = limits[2] if limits else str(resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    whose = f"of the daemon (pid {patient.pid})" if limits else "here"
    if not hard.isdigit() or int(hard) < 0:
        return ok("descriptors", f"no limit {whose}")
    fact = f"limit {whose}: {hard}, enough for {int(hard) // 2} clients"
    if int(hard) < FEW_DESCRIPTORS:
        return warn("descriptors", fact, "raise it: LimitNOFILE=65536 in the unit, or `ulimit -Hn`")
    return ok("descriptors", fact)
