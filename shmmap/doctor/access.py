# SPDX-License-Identifier: Apache-2.0
"""Check access: the group, the socket, bridges to ROS 2, and the daemon's access to the map's directory."""

from __future__ import annotations

import contextlib
import glob
import grp
import json
import os
import pwd
import re
import stat
import time
from collections import Counter
from itertools import islice
from typing import Any, Final

from shmmap.daemon.prerequisites import account_name, group_id
from shmmap.doctor.daemon_lists import ANSWER_S
from shmmap.doctor.diagnosis import Diagnosis
from shmmap.doctor.verdicts import Finding, fail, ok, outage_so_far, skip, warn
from shmmap.errors import (
    ConfigError,
    DaemonUnreachable,
    NoAnswer,
    NoSocket,
    ProtocolMismatch,
    ShmmapError,
    SocketPermission,
)
from shmmap.origin.remote.store import is_url
from shmmap.protocol.endpoint import fallback_runtime_dir, runtime_dirs, why_not_used
from shmmap.quantities import counted
from shmmap.segment.pins import has_slot

LOOKED_AT: Final = 256
"""Files of a map whose permissions are checked; those of one map rarely differ."""
_UNITS: Final = "/etc/systemd/system"


def group_name(gid: int) -> str:
    """Return the name of a group."""
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def groups_of(uid: int) -> set[int]:
    """Return the groups that an account will have at its next login."""
    try:
        entry = pwd.getpwuid(uid)
    except KeyError:
        return set()
    return set(os.getgrouplist(entry.pw_name, entry.pw_gid))


def check_group(diagnosis: Diagnosis) -> Finding:
    """Check that this account is a member of the group that may connect."""
    gid = -1
    if diagnosis.config.group:
        try:
            gid = group_id(diagnosis.config.group, "group")
        except ConfigError as error:
            return fail(error.message, error.hint)
    else:
        try:
            status = os.stat(diagnosis.socket)
            gid = status.st_gid if status.st_mode & stat.S_IWGRP else -1
        except OSError:
            pass
    if gid < 0:
        return ok("none is set: only the daemon's own user may connect")
    group, account = group_name(gid), account_name(diagnosis.uid)
    if diagnosis.uid in (0, diagnosis.runs_as):
        return ok(f"members of {group} may connect; {account} may anyway")
    if gid in (os.getegid(), *os.getgroups()):
        return ok(f"{account} is a member of {group}")
    if gid in groups_of(diagnosis.uid):
        return warn(
            f"{account} joined {group}, this session is older",
            "log in again, or `newgrp " + group + "`",
        )
    return fail(
        f"{account} is not a member of {group}",
        f"sudo usermod -aG {group} {account}, then log in again",
    )


def check_socket(diagnosis: Diagnosis) -> Finding:
    """Check that the daemon answers, and report which accounts may connect."""
    from shmmap.client.discovery import check_socket as connect

    path = diagnosis.socket
    if diagnosis.awaits_first_client:
        return ok(f"{path} waits for the first client: {_access(path)}")
    try:
        connect(path, time.monotonic() + ANSWER_S)
    except NoSocket as error:
        if why := _closed_place(diagnosis):
            return fail(why, "see whose it is and remove it, or set XDG_RUNTIME_DIR, or runtime_dir")
        return warn(error.message, "start it: `systemctl start shmmapd` or `shmmap serve MAP`")
    except SocketPermission as error:
        return fail(f"{error.message}: {_access(path)}", error.hint)
    except (NoAnswer, DaemonUnreachable, ProtocolMismatch) as error:
        return fail(error.message, error.hint)
    try:
        open_to_all = os.stat(path).st_mode & stat.S_IWOTH
        above = os.stat(os.path.dirname(path)).st_mode & stat.S_IXOTH
    except OSError as error:
        return warn(f"{path}: {error.strerror}", "is it being restarted?")
    fact = f"{path} answers: {_access(path)}"
    if open_to_all and above:
        return warn(fact, f"every account may connect: chmod o-rwx {path}")
    return ok(fact)


def _closed_place(diagnosis: Diagnosis) -> str:
    """Return why the daemon would refuse its socket directory in /tmp; empty if it accepts or needs none."""
    place = fallback_runtime_dir()
    try:
        chosen = os.path.dirname(diagnosis.config.socket())
    except ShmmapError:
        return ""
    why = why_not_used(place) if chosen == place and os.path.lexists(place) else ""
    return f"the daemon would refuse its runtime directory {place}: {why}" if why else ""


def _access(path: str) -> str:
    try:
        status = os.stat(path)
    except OSError:
        return "its directory is closed to this user"
    return f"{stat.filemode(status.st_mode)} {account_name(status.st_uid)}:{group_name(status.st_gid)}"


def check_map_access(diagnosis: Diagnosis) -> Finding:
    """Check that the daemon can read the map, whether a directory or a URL."""
    path = diagnosis.map_path
    if not path and (diagnosis.config.live or diagnosis.live_names):
        return ok("none is served: the daemon keeps live maps alone")
    if not path:
        return warn("no map is named", "set map_path, or give `shmmap serve MAP`")
    if diagnosis.alive:
        if diagnosis.counters.get("origin_out", 0):
            since = outage_so_far(diagnosis.counters)
            return warn(
                f"{path} is being served from memory: where it comes from has not answered for {since}",
                "`shmmap tail` says why loads fail",
            )
        if problems := diagnosis.counters.get("map_problems", 0):
            return warn(
                f"{path} is being served, but reading it found {counted(problems, 'problem')}",
                "the daemon's log names them, and so does `shmmap reload`",
            )
        if outside := diagnosis.counters.get("cells_outside_box", 0):
            return warn(
                f"{path} is being served, but points of {counted(outside, 'cell')} lie outside its box",
                "moved without the metadata? the daemon's log names them, and so does `shmmap inspect`",
            )
        return ok(f"{path} is being served")
    if is_url(path):
        return ok(f"{path} is looked for when the daemon starts")
    if not os.path.exists(path):
        try:
            os.stat(path)
        except PermissionError:
            return warn(f"{path}: this user may not look there", "run it with sudo")
        except OSError:
            return fail(f"there is no map at {path}", "set map_path")
    uid = diagnosis.runs_as
    if uid != diagnosis.uid and _hidden_from_service(diagnosis, path):
        return fail(
            f"{path} lies where the service sees nothing (ProtectHome=, PrivateTmp=)",
            f"sudo shmmap unit install --map {path}, or see `shmmap unit print drop-ins/maps-in-home.conf`",
        )
    shown = uid != diagnosis.uid and _shown_to_service(diagnosis, path)
    closed = _closed_to(uid, path, parents=not shown)
    if closed:
        return fail(
            f"{account_name(uid)} may not read {closed}",
            f"chmod -R a+rX {path}, and a+x on what is above it",
        )
    return ok(f"{path} can be read by {account_name(uid)}")


def paths_of_service(diagnosis: Diagnosis, *settings: str) -> list[str]:
    """Return the paths that drop-ins of the service's unit name in any of these settings."""
    directory = diagnosis.machine.path(f"{_UNITS}/shmmapd.service.d")
    try:
        text = "\n".join(one.read_text(errors="replace") for one in sorted(directory.glob("*.conf")))
    except OSError:
        return []
    named = re.findall(rf"^(?:{'|'.join(settings)})=(.*)$", text, re.MULTILINE)
    return [word.strip('"-+').split(":")[0] for word in " ".join(named).split()]


def is_in(path: str, directory: str) -> bool:
    """Return whether a path lies in a directory, or is that directory."""
    return f"{path}/".startswith(f"{directory.rstrip('/')}/")


def _shown_to_service(diagnosis: Diagnosis, path: str) -> bool:
    shown = paths_of_service(diagnosis, "BindReadOnlyPaths", "BindPaths")
    return any(is_in(path, place) for place in shown)


def _hidden_from_service(diagnosis: Diagnosis, path: str) -> bool:
    from shmmap.service.program import is_hidden

    if not diagnosis.machine.path(f"{_UNITS}/shmmapd.service").exists():
        return False
    return is_hidden(os.path.realpath(path)) and not _shown_to_service(diagnosis, path)


def _closed_to(uid: int, path: str, *, parents: bool) -> str:
    """Return the first directory or file up to ``path`` that an account cannot access; empty if none."""
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


_BRIDGE_ADVICE: Final = (
    "with ROS use the node (shmmap-ros-node), which serves every implementation;"
    " or start these nodes with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp"
)
_MAX_BYTES: Final = 1 << 16
_NAMED: Final = 3
_LOCKED: Final = 0
"""Offset at which the file is locked; the bridge locks the whole file."""


def check_ros_bridge(diagnosis: Diagnosis) -> Finding:
    """Check that bridges to ROS 2 run, and that every node that asks a bridge can get a reply.

    A bridge writes its status to a file beside the daemon's socket, ``INSTANCE.ros-bridge-DOMAIN.json``, and
    holds a lock on that file while it runs.
    """
    bridges = [one for path in _files(diagnosis) if (one := _read_status(diagnosis, path)) is not None]
    if not bridges:
        return skip("none runs")
    places = ", ".join(
        sorted(f"domain {one['domain']}: {counted(one['clients'], 'client')}" for one in bridges)
    )
    unanswered = Counter(
        (str(one.get("service")), str(one.get("vendor", "")))
        for each in bridges
        for one in each["incompatible"]
    )
    if not unanswered:
        return ok(places)
    named = "; ".join(
        f"{counted(count, 'client')} of {service}{f', of {vendor}' if vendor else ''}"
        for (service, vendor), count in unanswered.most_common(_NAMED)
    )
    more = "; …" if len(unanswered) > _NAMED else ""
    return warn(
        f"{places}; not nodes of rmw_cyclonedds_cpp, so that they never get an answer: {named}{more}",
        _BRIDGE_ADVICE,
    )


def _files(diagnosis: Diagnosis) -> list[str]:
    """Return the status files of this instance's bridges, from the directories that bridges use."""
    places = dict.fromkeys((os.path.dirname(diagnosis.socket), *runtime_dirs()))
    pattern = f"{glob.escape(diagnosis.config.instance)}.ros-bridge-*.json"
    root = len(str(diagnosis.machine.path("/")).rstrip("/"))
    return [
        found[root:]
        for place in places
        for found in sorted(glob.glob(f"{glob.escape(str(diagnosis.machine.path(place)))}/{pattern}"))
    ]


def _read_status(diagnosis: Diagnosis, path: str) -> dict[str, Any] | None:
    """Read a bridge's status; None if the bridge does not run, or the file is not a bridge's."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        fd = os.open(diagnosis.machine.path(path), flags)
        try:
            if not stat.S_ISREG(os.fstat(fd).st_mode) or not has_slot(fd, _LOCKED):
                return None
            status = json.loads(os.pread(fd, _MAX_BYTES, 0))
        finally:
            os.close(fd)
        incompatible = [one for one in status["incompatible"] if isinstance(one, dict)]
        return {
            "domain": int(status["domain"]),
            "clients": int(status["clients"]),
            "incompatible": incompatible,
        }
    return None
