# SPDX-License-Identifier: Apache-2.0
"""Check live maps: damage, space on the disk, and readers that use many resources."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Mapping
from typing import Final

from shmmap.daemon.prerequisites import account_name
from shmmap.doctor.access import group_name, groups_of, is_in, paths_of_service
from shmmap.doctor.diagnosis import Diagnosis
from shmmap.doctor.verdicts import Finding, fail, ok, skip, warn
from shmmap.errors import ConfigError
from shmmap.live_settings import SERVICE_STATE, live_directory
from shmmap.quantities import counted, format_bytes
from shmmap.segment.names import DEFAULT_SHM_DIR

NAMED: Final = 3
"""Problems and readers that are listed, at most."""
OPEN: Final = 8
"""Chunk files that a reader may have open: it opens one at a time, and maps none."""
BUSY: Final = 500
"""Share of a processor, in thousandths, above which one reader's requests are reported."""
ROOM_BYTES: Final = 64 << 20
"""Free disk space below this is reported, whatever the budget."""
_MARKS_MODE: Final = {True: 0o1770, False: 0o700}  # by whether mappers have a group


# --- damage --------------------------------------------------------------------------------------------


def check_live_maps(diagnosis: Diagnosis) -> Finding:
    """Check that every chunk can be loaded and saved, and that none is lost."""
    rows = diagnosis.live_rows
    if not rows and diagnosis.live_names:
        return skip(f"{', '.join(diagnosis.live_names)}: the daemon does not answer")
    if not rows:
        running = "this daemon keeps none" if diagnosis.alive else "no daemon runs"
        return skip(running if diagnosis.alive or diagnosis.config.live else "none are set up")
    unsaved = sum(row.unsaved for row in rows)
    fact = f"{', '.join(row.name for row in rows)}: {counted(unsaved, 'chunk')} not saved yet"
    if failing := [row for row in rows if row.problem]:
        what = "; ".join(f"{row.name}: {row.problem}" for row in failing)
        return fail(
            what,
            "see to its files and its disk: it is tried again, and what is in memory stays there meanwhile",
        )
    if damaged := sum(row.damaged_count for row in rows):
        texts = [f"{row.name}: {text}" for row in diagnosis.live_rows for text in row.damaged][:NAMED]
        named = f" ({'; '.join(texts)}{'; …' if damaged > NAMED else ''})" if texts else ""
        return warn(
            f"lost chunks, damaged databases: {damaged:,}{named}",
            "what is damaged is kept; stop the daemon, then `shmmap live fsck` says what is left",
        )
    if restarts := diagnosis.counters.get("live_restarts", 0):
        return warn(
            f"{fact}; the process that keeps them ended {counted(restarts, 'time')}",
            "please report what its log says: journalctl -u shmmapd -g live",
        )
    return ok(fact)


# --- the disk -----------------------------------------------------------------------------------------


def check_live_disk(diagnosis: Diagnosis) -> Finding:
    """Check that the daemon can write to the directories of live maps, and that their disks have space."""
    places = _places(diagnosis)
    if not places:
        return skip("no live map is set up")
    facts, kept = [], {*diagnosis.live_names, *(row.name for row in diagnosis.live_rows)}
    for which, path in places.items():
        if not path:
            return warn(f"{which}: there is no state directory", f"set path in [live.{which}]")
        try:
            place = _existing(diagnosis, path)
            space = os.statvfs(diagnosis.machine.path(place))
            closed = _not_writable(diagnosis, path, place, read_only=bool(space.f_flag & os.ST_RDONLY))
        except PermissionError:
            return warn(f"{which}: {path}: this user may not look there", "run it with sudo")
        if place != path and which in kept:
            return fail(
                f"{which}: {path} is gone",
                "put it back where it was; what is not saved is in memory alone, so do not stop the daemon",
            )
        if closed:
            return fail(f"{which}: {closed}", f"allow it, or set path in [live.{which}]")
        free = space.f_bavail * space.f_frsize
        budget = max((row.budget_bytes for row in diagnosis.live_rows if row.name == which), default=0)
        facts.append(f"{which}: {path}, {format_bytes(free)} free")
        if free < max(budget, ROOM_BYTES):
            return warn(
                f"{facts[-1]}; up to {format_bytes(max(budget, ROOM_BYTES))} may have to be saved",
                "free some space: chunks that cannot be saved stay in memory, then mappers have to wait",
            )
    return ok("; ".join(facts))


def _places(diagnosis: Diagnosis) -> dict[str, str]:
    """Return the directory of each map, from the daemon or else the settings; empty if there are none."""
    if reported := diagnosis.live_rows:
        return {row.name: row.path for row in reported}
    instance = diagnosis.config.instance
    environ: Mapping[str, str] = os.environ
    if diagnosis.is_service:
        environ = {"STATE_DIRECTORY": f"{SERVICE_STATE}/{instance}"}
    found = {}
    for one in diagnosis.config.live:
        found[one.name] = one.path
        with contextlib.suppress(ConfigError):
            found[one.name] = one.path or live_directory(instance, one.name, environ)
    return found


def _existing(diagnosis: Diagnosis, path: str) -> str:
    """Return the path, or its nearest existing parent, below which the daemon creates the rest."""
    while path != "/":
        try:
            os.stat(diagnosis.machine.path(path))
            break
        except (FileNotFoundError, NotADirectoryError):
            path = os.path.dirname(path)
    return path


def _not_writable(diagnosis: Diagnosis, path: str, place: str, *, read_only: bool) -> str:
    """Return why the daemon cannot write to ``path``, given the existing ``place``; empty if it can."""
    uid = diagnosis.runs_as
    if read_only:
        return f"the file system of {place} is read-only"
    if diagnosis.is_service and not diagnosis.alive:
        own = f"{SERVICE_STATE}/{diagnosis.config.instance}"
        if is_in(path, own) and not is_in(place, own):
            return ""  # systemd creates it
        writable = [own, *paths_of_service(diagnosis, "ReadWritePaths", "BindPaths")]
        if not any(is_in(place, one) for one in writable):
            return f"the service may not write to {place}: ProtectSystem=, no ReadWritePaths="
    if uid == 0:
        return ""
    status = os.stat(diagnosis.machine.path(place))
    shift = 6 if status.st_uid == uid else 3 if status.st_gid in groups_of(uid) else 0
    return "" if (status.st_mode >> shift) & 3 == 3 else f"{account_name(uid)} may not write to {place}"


# --- memory -------------------------------------------------------------------------------------------


def check_live_memory(diagnosis: Diagnosis) -> Finding:
    """Check the directory of chunks in memory, and that no reader uses many resources."""
    rows = diagnosis.live_rows
    if not rows and not diagnosis.config.live:
        return skip("no live map is set up")
    path = _live_shm_dir(diagnosis)
    if huge := diagnosis.machine.mount_of(path).huge_pages:
        return fail(
            f"{path} has huge pages ({huge}): a chunk of a few KiB takes 2 MiB there",
            "name a tmpfs without them with live_shm_dir, such as /dev/shm",
        )
    if wrong := _wrong_marks(diagnosis, path):
        return warn(wrong, "restart the daemon: it puts the directory right, or says why it cannot")
    if keeping := _keeping(diagnosis):
        return warn(
            f"chunks are kept open or mapped: {keeping}",
            "have it read them by pread, as CHUNKS.md says: it keeps no memory by that, and SIGBUS ends it"
            " where it looks at one that was given up",
        )
    if busy := _busy(diagnosis):
        return warn(
            f"requests take much of the time of the process that keeps live maps: {busy}",
            "have it ask less often, for smaller areas, or with `since`; mapping does not wait for it, other"
            " readers do",
        )
    taken, budget = sum(row.bytes for row in rows), sum(row.budget_bytes for row in rows)
    return ok(f"{path}: {format_bytes(taken)} of {format_bytes(budget)} taken" if rows else path)


def _live_shm_dir(diagnosis: Diagnosis) -> str:
    """Return the directory of chunks in memory: as set, else that of the cells unless on huge pages."""
    if diagnosis.config.live_shm_dir:
        return diagnosis.config.live_shm_dir
    return DEFAULT_SHM_DIR if diagnosis.machine.mount_of(diagnosis.shm_dir).huge_pages else diagnosis.shm_dir


def _wrong_marks(diagnosis: Diagnosis, path: str) -> str:
    """Return what is wrong with the directory in which mappers put their scans."""
    marks = f"{path}/shmmap-live.{diagnosis.config.instance}.marks"
    if not diagnosis.live_rows:
        return ""
    try:
        status = os.stat(diagnosis.machine.path(marks), follow_symlinks=False)
    except FileNotFoundError:
        return f"{marks} is gone: no process can map"
    except OSError as error:
        return f"{marks}: {error.strerror}"
    group = diagnosis.config.live_group
    mode = stat.S_IMODE(status.st_mode)
    if mode not in _MARKS_MODE.values() or (group and mode != _MARKS_MODE[True]):
        return f"{marks} has mode {mode:o}, not {_MARKS_MODE[bool(group)]:o}"
    if diagnosis.pid and status.st_uid != diagnosis.runs_as:
        return f"{marks} belongs to {account_name(status.st_uid)}, not to the daemon's user"
    if group and group not in (group_name(status.st_gid), str(status.st_gid)):
        return f"{marks} belongs to group {group_name(status.st_gid)}, not {group}"
    return ""


def _keeping(diagnosis: Diagnosis) -> str:
    """Return processes that map chunk files, or have many open, the largest users first; empty if none."""
    start = f"/shmmap-live.{diagnosis.config.instance}."
    chunk = re.compile(re.escape(start) + r"[A-Za-z0-9_-]{1,64}\.-?\d+_-?\d+_-?\d+\.\d+")
    found = []
    processes = diagnosis.machine.path("/proc")
    with contextlib.suppress(OSError):
        for entry in os.listdir(processes):
            if not entry.isdecimal() or diagnosis.pid in (0, int(entry), _parent(diagnosis, entry)):
                continue  # the daemon, and the process that writes chunks
            mapped = set(chunk.findall(diagnosis.machine.text(f"/proc/{entry}/maps")))
            names = list(mapped)
            with contextlib.suppress(OSError):  # it has ended, or belongs to another account
                for fd in os.listdir(processes / entry / "fd"):
                    with contextlib.suppress(OSError):
                        names += chunk.findall(os.readlink(processes / entry / "fd" / fd))
            if mapped or len(names) >= OPEN:
                found.append((len(set(names)), entry))
    texts = [
        f"{diagnosis.machine.text(f'/proc/{pid}/comm').strip() or '?'}, pid {pid}: {counted(count, 'chunk')}"
        for count, pid in sorted(found, key=lambda row: -row[0])
    ]
    more = f"; and {len(texts) - NAMED:,} more" if len(texts) > NAMED else ""
    return "; ".join(texts[:NAMED]) + more


def _parent(diagnosis: Diagnosis, pid: str) -> int:
    fields = diagnosis.machine.text(f"/proc/{pid}/stat").rpartition(")")[2].split()
    return int(fields[1]) if len(fields) > 1 else 0


def _busy(diagnosis: Diagnosis) -> str:
    """Return clients whose requests about live maps take much time; empty if none."""
    listed = diagnosis.seen.clients if diagnosis.seen is not None else None
    clients = {client.session: client for client in listed or ()}
    texts = []
    for row in diagnosis.live_rows:
        for session, thousandths in row.readers:
            if thousandths >= BUSY:
                client = clients.get(session)
                client_name = f"{client.client or client.command}, pid {client.pid or '?'}" if client else ""
                texts.append(
                    f"{client_name or f'session {session:x}'}: {thousandths / 10:.0f} % for {row.name}"
                )
    return "; ".join(texts[:NAMED])
