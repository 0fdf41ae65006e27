# SPDX-License-Identifier: Apache-2.0
"""What is kept on the disk, computed layers and objects of published maps: may it be used, has it room."""

from __future__ import annotations

import os
import stat
from typing import Final

from shmmap.disk_budget import OBJECTS, DiskBudget, why_not_private
from shmmap.doctor.access import account_name
from shmmap.doctor.finding import Finding, ok, skip, warn
from shmmap.doctor.patient import Patient
from shmmap.origin.sidecar import default_cache_directory
from shmmap.quantities import format_bytes

__all__ = ["check_disk_cache"]

_SERVICE_CACHE: Final = "/var/cache/shmmap"


def check_disk_cache(patient: Patient) -> Finding:
    """Is the cache directory the daemon's, and can more be kept in it?"""
    name, uid = "disk cache", patient.runs_as
    if not patient.config.cache_bytes:
        return skip(name, "nothing is kept: cache_bytes is 0")
    place = patient.config.cache_dir or (_SERVICE_CACHE if patient.is_service else default_cache_directory())
    place = os.path.abspath(place)
    directory = patient.machine.path(place)
    try:
        status = os.stat(directory)
    except FileNotFoundError:
        return skip(name, f"{place} is not there yet")
    except OSError as error:
        return warn(name, f"{place}: {error.strerror}", "run it with sudo, or name another cache_dir")
    if not stat.S_ISDIR(status.st_mode):
        return warn(name, f"{place} is no directory", "remove it, or name another cache_dir")
    account = account_name(uid)
    if why := _why_not_used(patient, place, status.st_uid):
        return warn(
            name,
            f"{why}: objects of published maps are not kept there: without a connection there is no map",
            f"chown -R {account} {place} && chmod go-w {place}/{OBJECTS}, or name another cache_dir",
        )
    budget = DiskBudget(str(directory), patient.config.cache_bytes, owner=uid)
    space = os.statvfs(directory)
    free = f"{format_bytes(space.f_bavail * space.f_frsize)} free"
    used, limit = budget.used_bytes(), format_bytes(budget.limit_bytes)
    if patient.uid not in (0, uid):
        fact = f"{place} of {account}: up to {limit}, {free}"
    else:
        fact = f"{place}: {format_bytes(used)} of {limit} used, {free}"
    if used < budget.limit_bytes and not budget.has_room(1):
        return warn(
            name,
            f"{fact}: nothing more is kept, because 5 % of the disk stay free",
            "free some space, or name a cache_dir on another disk",
        )
    return ok(name, fact)


def _why_not_used(patient: Patient, place: str, owner: int) -> str:
    uid = patient.runs_as
    if owner not in (0, uid):
        return f"{place} belongs to {account_name(owner)}, the daemon runs as {account_name(uid)}"
    objects = f"{place}/{OBJECTS}"
    try:
        why = why_not_private(os.lstat(patient.machine.path(objects)), uid)
    except OSError:
        return ""  # not there yet, or not to be looked at
    return f"{objects} {why}" if why else ""
