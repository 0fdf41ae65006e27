# SPDX-License-Identifier: Apache-2.0
"""Who gets in: the group, the socket, and the daemon itself into the map's directory."""

from __future__ import annotations

import grp
import os
import pwd
import stat
import time
from itertools import islice
from typing import Final

from shmmap.daemon.prerequisites import account_name
from shmmap.doctor.finding import Finding, fail, ok, warn
from shmmap.doctor.patient import Patient
from shmmap.doctor.verdicts import outage_so_far
from shmmap.errors import (
    DaemonUnreachable,
    NoAnswer,
    NoSocket,
    ProtocolMismatch,
    ShmmapError,
    SocketPermission,
)
from shmmap.origin.remote.store import is_url
from shmmap.protocol.endpoint import fallback_runtime_dir, why_not_private
from shmmap.quantities import counted

__all__ = ["check_group", "check_map_access", "check_socket", "drop_ins", "group_name", "groups_of"]

ANSWER_S: Final = 2.0
LOOKED_AT: Final = 256
"""Files of a map whose permissions are looked at: those of one map are rarely different."""
_UNITS: Final = "/etc/systemd/system"


def group_name(gid: int) -> str:
    """Return what a group is called."""
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def groups_of(uid: int) -> set[int]:
    """Return the groups of an account as its next login has them."""
    try:
        entry = pwd.getpwuid(uid)
    except KeyError:
        return set()
    return set(os.getgrouplist(entry.pw_name, entry.pw_gid))


def check_group(patient: Patient) -> Finding:
    """Check that the user is in the group that may connect."""
    name = "group"
    gid = -1
    if patient.config.group.isdigit():
        gid = int(patient.config.group)
    elif patient.config.group:
        try:
            gid = grp.getgrnam(patient.config.group).gr_gid
        except KeyError:
            return fail(
                name,
                f"there is no group {patient.config.group!r}",
                f"groupadd --system {patient.config.group}",
            )
    else:
        try:
            status = os.stat(patient.socket)
            gid = status.st_gid if status.st_mode & stat.S_IWGRP else -1
        except OSError:
            pass
    if gid < 0:
        return ok(name, "none is set: only the daemon's own user may connect")
    group, account = group_name(gid), account_name(patient.uid)
    if patient.uid in (0, patient.runs_as):
        return ok(name, f"members of {group} may connect; {account} may anyway")
    if gid in (os.getegid(), *os.getgroups()):
        return ok(name, f"{account} is a member of {group}")
    if gid in groups_of(patient.uid):
        return warn(
            name,
            f"{account} joined {group}, this session is older",
            "log in again, or `newgrp " + group + "`",
        )
    return fail(
        name,
        f"{account} is not a member of {group}",
        f"sudo usermod -aG {group} {account}, then log in again",
    )


def check_socket(patient: Patient) -> Finding:
    """Check that the daemon answers, and who may connect."""
    from shmmap.client.discovery import check_socket as connect

    name, path = "socket", patient.socket
    if patient.awaits_first_client:
        return ok(name, f"{path} waits for the first client: {_access(path)}")
    try:
        connect(path, time.monotonic() + ANSWER_S)
    except NoSocket as error:
        if why := _closed_place(patient):
            return fail(name, why, "see whose it is and remove it, or set XDG_RUNTIME_DIR, or runtime_dir")
        return warn(name, error.message, "start it: `systemctl start shmmapd` or `shmmap serve MAP`")
    except SocketPermission as error:
        return fail(name, f"{error.message}: {_access(path)}", error.hint)
    except (NoAnswer, DaemonUnreachable, ProtocolMismatch) as error:
        return fail(name, error.message, error.hint)
    try:
        open_to_all = os.stat(path).st_mode & stat.S_IWOTH
        above = os.stat(os.path.dirname(path)).st_mode & stat.S_IXOTH
    except OSError as error:
        return warn(name, f"{path}: {error.strerror}", "is it being restarted?")
    fact = f"{path} answers: {_access(path)}"
    if open_to_all and above:
        return warn(name, fact, f"every account may connect: chmod o-rwx {path}")
    return ok(name, fact)


def _closed_place(patient: Patient) -> str:
    """Why a daemon could not have its socket in the directory in /tmp; empty where it can, or needs none."""
    place = fallback_runtime_dir()
    try:
        chosen = os.path.dirname(patient.config.socket())
    except ShmmapError:
        return ""
    why = why_not_private(place) if chosen == place and os.path.lexists(place) else ""
    return f"the daemon would refuse its runtime directory {place}: {why}" if why else ""


def _access(path: str) -> str:
    try:
        status = os.stat(path)
    except OSError:
        return "its directory is closed to this user"
    return f"{stat.filemode(status.st_mode)} {account_name(status.st_uid)}:{group_name(status.st_gid)}"


def check_map_access(patient: Patient) -> Finding:
    """Check that the daemon can read the map, wherever it lies."""
    name, path = "map", patient.map_path
    if not path and (patient.config.live or (patient.seen is not None and patient.seen.live)):
        return ok(name, "none is served: the daemon keeps live maps alone")
    if not path:
        return warn(name, "no map is named", "set map_path, or give `shmmap serve MAP`")
    if patient.alive:
        if patient.seen is not None and patient.seen.counters.get("origin_out", 0):
            since = outage_so_far(patient.seen.counters)
            return warn(
                name,
                f"{path} is being served from memory: where it comes from has not answered for {since}",
                "`shmmap tail` says why loads fail",
            )
        problems = patient.seen.counters.get("map_problems", 0) if patient.seen is not None else 0
        if problems:
            return warn(
                name,
                f"{path} is being served, but reading it found {counted(problems, 'problem')}",
                "the daemon's log names them, and so does `shmmap reload`",
            )
        outside = patient.seen.counters.get("cells_outside_box", 0) if patient.seen is not None else 0
        if outside:
            return warn(
                name,
                f"{path} is being served, but points of {counted(outside, 'cell')} lie outside its box",
                "moved without the metadata? the daemon's log names them, and so does `shmmap inspect`",
            )
        return ok(name, f"{path} is being served")
    if is_url(path):
        return ok(name, f"{path} is looked for when the daemon starts")
    if not os.path.exists(path):
        try:
            os.stat(path)
        except PermissionError:
            return warn(name, f"{path}: this user may not look there", "run it with sudo")
        except OSError:
            return fail(name, f"there is no map at {path}", "set map_path")
    uid = patient.runs_as
    if uid != patient.uid and _hidden_from_service(patient, path):
        return fail(
            name,
            f"{path} lies where the service sees nothing (ProtectHome=, PrivateTmp=)",
            f"sudo shmmap unit install --map {path}, or see `shmmap unit print drop-ins/maps-in-home.conf`",
        )
    shown = uid != patient.uid and _shown_to_service(patient, path)
    closed = _closed_to(uid, path, parents=not shown)
    if closed:
        return fail(
            name,
            f"{account_name(uid)} may not read {closed}",
            f"chmod -R a+rX {path}, and a+x on what is above it",
        )
    return ok(name, f"{path} can be read by {account_name(uid)}")


def drop_ins(patient: Patient) -> str:
    """Return what was added to the service's unit."""
    directory = patient.machine.path(f"{_UNITS}/shmmapd.service.d")
    try:
        return "\n".join(one.read_text(errors="replace") for one in sorted(directory.glob("*.conf")))
    except OSError:
        return ""


def _shown_to_service(patient: Patient, path: str) -> bool:
    shown = [
        word.split(":")[0].strip('"')
        for line in drop_ins(patient).splitlines()
        if line.startswith(("BindReadOnlyPaths=", "BindPaths="))
        for word in line.split("=", 1)[1].split()
    ]
    return any(path == place or path.startswith(place.rstrip("/") + "/") for place in shown)


def _hidden_from_service(patient: Patient, path: str) -> bool:
    from shmmap.service.program import is_hidden

    if not patient.machine.path(f"{_UNITS}/shmmapd.service").exists():
        return False
    return is_hidden(os.path.realpath(path)) and not _shown_to_service(patient, path)


def _closed_to(uid: int, path: str, *, parents: bool) -> str:
    """First directory or file on the way to ``path`` that an account may not pass or read; or empty."""
    if uid == 0:
        return ""
    groups = groups_of(uid)
    real = os.path.realpath(path)
    above = [os.path.dirname(real)]
    while above[-1] != "/":
        above.append(os.path.dirname(above[-1]))
    wanted = [(place, 1) for place in reversed(above)] if parents else []
    try:
        wanted.append((real, 5 if os.path.isdir(real) else 4))
        if os.path.isdir(real):
            with os.scandir(real) as entries:
                wanted += [(entry.path, 5 if entry.is_dir() else 4) for entry in islice(entries, LOOKED_AT)]
        for place, bits in wanted:
            status = os.stat(place)
            shift = 6 if status.st_uid == uid else 3 if status.st_gid in groups else 0
            if (status.st_mode >> shift) & bits != bits:
                return place
    except OSError as error:
        return str(error.filename or path)
    return ""
