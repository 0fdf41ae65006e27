# SPDX-License-Identifier: Apache-2.0
"""Check shared memory (size, limits, page size) and the disk cache."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from pathlib import Path
from typing import Final

from shmmap.daemon.host.memory import memory_limit_bytes, room_in_group
from shmmap.daemon.prerequisites import account_name
from shmmap.disk_budget import LAYERS, OBJECTS, DiskBudget
from shmmap.doctor.diagnosis import Diagnosis
from shmmap.doctor.verdicts import Finding, fail, ok, skip, warn
from shmmap.mounts import control_groups
from shmmap.origin.catalogue_bytes import default_cache_directory
from shmmap.private_directory import why_not_private
from shmmap.quantities import format_bytes
from shmmap.service.huge_pages import kernel_version, of_all_sizes

CONTAINER_DEFAULT_BYTES: Final = 64 << 20  # size that Docker and Podman give /dev/shm


def check_shared_memory(diagnosis: Diagnosis) -> Finding:
    """Check that the file system is large enough for the budget."""
    path = diagnosis.shm_dir
    try:
        state = os.statvfs(diagnosis.machine.path(path))
    except OSError as error:
        return fail(f"{path}: {error.strerror}", "name a directory on a tmpfs with shm_dir")
    mount = diagnosis.machine.mount_of(path)
    if mount.kind not in ("tmpfs", "ramfs", "unknown"):
        return fail(
            f"{path} is on {mount.kind}: every segment would go to a disk",
            "name a directory on a tmpfs",
        )
    if not state.f_blocks:
        return ok(f"{path}: {mount.kind} without a limit")
    size, free = state.f_blocks * state.f_frsize, state.f_bavail * state.f_frsize
    used = sum(diagnosis.counters.get(f"bytes_{kind}", 0) for kind in ("resident", "zombie", "statistics"))
    budget = diagnosis.budget_bytes
    fact = f"{path}: {format_bytes(size)}, {format_bytes(free)} free"
    if not budget:
        return ok(f"{fact}; the budget is chosen at start")
    fact += f"; budget {format_bytes(budget)}, of which {format_bytes(used)} taken"
    enough_gib = -(-(budget * 5 // 4) // (1 << 30))
    enlarge = f"lower the budget, or enlarge it: `mount -o remount,size={enough_gib}G {mount.point}`"
    if budget > free + used:
        return fail(fact, enlarge)
    if budget > 0.95 * size:
        return warn(fact, f"nothing is left for others: {enlarge}")
    return ok(fact)


def check_container(diagnosis: Diagnosis) -> Finding:
    """Check that a container has enough shared memory."""
    machine = diagnosis.machine
    marks = ("/.dockerenv", "/run/.containerenv")
    contained = any(machine.path(mark).exists() for mark in marks) or bool(
        machine.text("/run/systemd/container")
    )
    if not contained:
        return ok("not in a container")
    try:
        state = os.statvfs(machine.path(diagnosis.shm_dir))
    except OSError as error:
        return fail(f"{diagnosis.shm_dir}: {error.strerror}", "mount the host's with --ipc=host")
    size = state.f_blocks * state.f_frsize
    if 0 < size <= CONTAINER_DEFAULT_BYTES:
        return warn(
            f"in a container whose {diagnosis.shm_dir} has {format_bytes(size)}, the default",
            "a daemon inside needs --shm-size=8g; clients of a daemon outside need --ipc=host",
        )
    return ok(f"in a container with {format_bytes(size)} of shared memory")


def check_memory_limit(diagnosis: Diagnosis) -> Finding:
    """Check whether the cgroup's limit would kill the daemon before its budget is full.

    Segments are charged to the cgroup, as the daemon assumes when it chooses its budget.  Other memory of its
    processes is measured while the daemon runs.
    """
    process, root = diagnosis.pid or "self", str(diagnosis.machine.root)
    limit, budget = memory_limit_bytes(process, root), diagnosis.budget_bytes
    if limit is None:
        return ok("the control group sets no limit")
    chosen = format_bytes(budget) if budget else "chosen at start"
    fact = f"the control group allows {format_bytes(limit)}; budget {chosen}"
    room = room_in_group(limit)
    kills = "crossing it kills the daemon (segments are charged to it): lower the budget to"
    if budget > room:
        return fail(fact, f"{kills} {format_bytes(room)}, or raise MemoryMax=")
    if diagnosis.alive:
        groups = control_groups("memory", process, root)
        private = max((_private_bytes(f"{one[0]}/memory.stat") for one in groups), default=0)
        fact += f", and its processes use {format_bytes(private)}"
        if budget + private > limit:
            left = format_bytes(max(limit - private, 1 << 20))
            return warn(fact, f"{kills} {left}, or raise MemoryMax=")
    return ok(fact)


def _private_bytes(stat_file: str) -> int:
    """Return the bytes outside tmpfs in a ``memory.stat`` of either version of control groups."""
    try:
        used = dict(line.split()[:2] for line in Path(stat_file).read_text(encoding="ascii").splitlines())
    except OSError:
        return 0
    return sum(int(used.get(name, 0)) for name in ("anon", "rss", "kernel"))


def check_huge_pages(diagnosis: Diagnosis) -> Finding:
    """Check whether segments use huge pages, and whether they help on this kernel."""
    machine = diagnosis.machine
    mount = machine.mount_of(diagnosis.shm_dir)
    chosen = next((option for option in mount.options if option.startswith("huge=")), "huge=never")
    switch = re.search(r"\[(\w+)\]", machine.text("/sys/kernel/mm/transparent_hugepage/shmem_enabled"))
    release = machine.text("/proc/sys/kernel/osrelease")
    linux = f"Linux {kernel_version(release)}"
    better = f"mount -o remount,huge=within_size {mount.point}"
    if switch is None or switch[1] == "deny":
        return ok("off: the kernel has none for shared memory")
    if switch[1] == "force":
        return ok("on: the kernel forces them on all shared memory (shmem_enabled)")
    if chosen == "huge=always":
        return warn(f"{mount.point} has {chosen}, with which some loads take longer", better)
    if chosen == "huge=advise":
        return ok(f"off: {mount.point} has {chosen}, and what is written is never advised", better)
    if chosen == "huge=within_size" and of_all_sizes(release):
        return ok(f"on: {mount.point} has {chosen}; {linux} has them for cells of all sizes")
    if chosen == "huge=within_size":
        return ok(f"on: {mount.point} has {chosen}; {linux} has them for cells well above 2 MiB alone")
    if of_all_sizes(release):
        return ok(
            f"off for {mount.point}",
            f"on {linux} cells load in 0.6 of the time with them: `sudo shmmap unit install --huge-pages`, or"
            f" `{better}`",
        )
    return ok(f"off for {mount.point}; {linux} would have them for cells well above 2 MiB alone")


_SERVICE_CACHE: Final = "/var/cache/shmmap"


def check_disk_cache(diagnosis: Diagnosis) -> Finding:
    """Check that the daemon owns the cache directory, and that its disk has space."""
    uid = diagnosis.runs_as
    if not diagnosis.config.cache_bytes:
        return skip("nothing is kept: cache_bytes is 0")
    place = diagnosis.config.cache_dir or (
        _SERVICE_CACHE if diagnosis.is_service else default_cache_directory()
    )
    place = os.path.abspath(place)
    directory = diagnosis.machine.path(place)
    try:
        status = os.stat(directory)
    except FileNotFoundError:
        return skip(f"{place} is not there yet")
    except OSError as error:
        return warn(f"{place}: {error.strerror}", "run it with sudo, or name another cache_dir")
    if not stat.S_ISDIR(status.st_mode):
        return warn(f"{place} is no directory", "remove it, or name another cache_dir")
    account = account_name(uid)
    if why := _why_not_used(diagnosis, place, status.st_uid):
        return warn(
            f"{why}: objects of published maps, or layers, are not kept there: without a connection there is"
            " no map",
            f"chown -R {account} {place} && chmod go-w {place}/{OBJECTS} {place}/{LAYERS}, or name another"
            " cache_dir",
        )
    budget = DiskBudget(str(directory), diagnosis.config.cache_bytes, owner=uid)
    space = os.statvfs(directory)
    free = f"{format_bytes(space.f_bavail * space.f_frsize)} free"
    used, limit = budget.used_bytes(), format_bytes(budget.limit_bytes)
    if diagnosis.uid not in (0, uid):
        fact = f"{place} of {account}: up to {limit}, {free}"
    else:
        fact = f"{place}: {format_bytes(used)} of {limit} used, {free}"
    if used < budget.limit_bytes and not budget.has_room(1):
        return warn(
            f"{fact}: nothing more is kept, because 5 % of the disk stay free",
            "free some space, or name a cache_dir on another disk",
        )
    return ok(fact)


def _why_not_used(diagnosis: Diagnosis, place: str, owner: int) -> str:
    uid = diagnosis.runs_as
    if owner not in (0, uid):
        return f"{place} belongs to {account_name(owner)}, the daemon runs as {account_name(uid)}"
    for kept in (OBJECTS, LAYERS):
        with contextlib.suppress(OSError):  # missing yet, or not accessible
            found = os.lstat(diagnosis.machine.path(f"{place}/{kept}"))
            if why := why_not_private(found, uid, or_root=kept == LAYERS):
                return f"{place}/{kept} {why}"
    return ""
