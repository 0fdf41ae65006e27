# SPDX-License-Identifier: Apache-2.0
"""Check the daemon: whether it runs, has read the map, leaves memory behind, and has the kernel's support."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import resource
import time
from typing import Final

from shmmap.daemon.pins.probe import probe_pins
from shmmap.daemon.prerequisites import account_name
from shmmap.doctor.diagnosis import Diagnosis, Machine, answering_at
from shmmap.doctor.verdicts import Finding, fail, ok, state_problem, warn
from shmmap.errors import CannotStart, ShmmapError
from shmmap.quantities import counted, format_bytes
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import usual_directory
from shmmap.statistics.reader import read_statistics
from shmmap.version import build_version

SYSTEM_UIDS: Final = 999
"""logind spares accounts up to this id (SYS_UID_MAX of Debian, Ubuntu, Fedora and systemd)."""

_SEGMENT: Final = re.compile(r"shmmap\.([A-Za-z0-9_-]{1,64})\.[0-9a-f]{16}(?:\.zombie)?")
_CHUNK: Final = re.compile(r"shmmap-live\.([A-Za-z0-9_-]{1,64})\.[A-Za-z0-9_-]{1,64}\.-?\d+_-?\d+_-?\d+\.\d+")


def check_daemon(diagnosis: Diagnosis) -> Finding:
    """Check that the daemon runs, answers and matches the installed version."""
    if diagnosis.seen is None:
        return warn(*diagnosis.unreadable)
    identity = diagnosis.seen.identity
    instance = diagnosis.config.instance
    if diagnosis.awaits_first_client:
        return ok(f"instance {instance} does not run; its first client starts it")
    if identity is None and diagnosis.answering:
        return warn(
            f"instance {instance}, pid {diagnosis.answering}, answers, but its statistics were removed",
            "it makes them again within seconds, or its log says why not",
        )
    if identity is None:
        return warn(f"instance {instance} does not run", "`systemctl start shmmapd` or `shmmap serve MAP`")
    it_is = f"instance {instance}, pid {identity.pid}, is"
    if problem := state_problem(diagnosis.seen):
        return dataclasses.replace(problem, fact=f"{it_is} {problem.fact}")
    fact = f"{it_is} {diagnosis.seen.state}"
    if defects := diagnosis.seen.counters.get("defects", 0):
        return warn(
            f"{fact}; it survived {counted(defects, 'exception')}",
            "please report the tracebacks in its log: journalctl -u shmmapd -g defect",
        )
    if identity.library_version != build_version():
        return warn(
            f"{fact}; it is version {identity.library_version}, installed is {build_version()}",
            "restart it (cells stay in memory): systemctl restart shmmapd",
        )
    return ok(fact)


def check_leftovers(diagnosis: Diagnosis) -> Finding:
    """Check for memory in segments that belong to no running daemon."""
    found: dict[str, tuple[int, int]] = {}
    with_chunks: set[str] = set()
    try:
        with os.scandir(diagnosis.machine.path(diagnosis.shm_dir)) as entries:
            for entry in entries:
                chunk = _CHUNK.fullmatch(entry.name)
                match = chunk or _SEGMENT.fullmatch(entry.name)
                with contextlib.suppress(FileNotFoundError):  # a running daemon frees some meanwhile
                    if match:
                        held = entry.stat(follow_symlinks=False).st_blocks * 512
                        count, nbytes = found.get(match[1], (0, 0))
                        found[match[1]] = (count + 1, nbytes + held)
                        with_chunks |= {match[1]} if chunk else set()
    except OSError as error:
        return warn(f"{diagnosis.shm_dir}: {error.strerror}", "run it with sudo")
    orphans = {name: held for name, held in found.items() if not _has_daemon(diagnosis, name)}
    listening = diagnosis.listening if orphans else set()
    silent = ""
    for path in sorted(listening):
        if path.removesuffix(".sock") + ".events.sock" in listening:  # any daemon, even without statistics
            answer = answering_at(path)
            silent = silent if answer else path
            for instance in answer:
                orphans.pop(instance, None)
    if not orphans:
        return ok("every segment belongs to a running daemon" if found else "none")
    listed = ", ".join(
        f"{one}: {counted(count, 'segment')}, {format_bytes(n)}"
        for one, (count, n) in sorted(orphans.items())
    )
    if with_chunks & set(orphans):
        return warn(
            f"segments and chunks of live maps of daemons that do not run: {listed}",
            "start that instance with its live maps: chunks may be in memory alone, and are saved then",
        )
    if silent:
        return warn(
            f"segments of daemons without statistics: {listed}",
            f"a daemon at {silent} does not answer this user, and they may be its: see `shmmap health`",
        )
    return warn(
        f"segments of daemons that do not run: {listed}",
        "start that instance: it serves or frees them; or `rm " + diagnosis.shm_dir + "/shmmap.INSTANCE.*`",
    )


def _has_daemon(diagnosis: Diagnosis, instance: str) -> bool:
    if instance == diagnosis.config.instance:
        return diagnosis.alive or diagnosis.seen is None or diagnosis.answering > 0
    places = {diagnosis.shm_dir, usual_directory(instance)}  # live maps may be apart from cells
    try:
        states = [read_statistics(instance, place).state for place in places]
        return any(state not in ("dead", "absent") for state in states)
    except (ShmmapError, OSError):
        return True  # files of another account are not judged


def _logind_setting(machine: Machine, key: str) -> str:
    """Return a value of logind.conf(5); drop-ins override the file, in the order of their names."""
    drop_ins: dict[str, str] = {}
    for place in ("/usr/lib", "/usr/local/lib", "/run", "/etc"):  # a later directory hides equal names
        directory = f"{place}/systemd/logind.conf.d"
        drop_ins |= {path.name: f"{directory}/{path.name}" for path in machine.path(directory).glob("*.conf")}
    texts = [machine.text("/etc/systemd/logind.conf")]
    texts += [machine.text(drop_ins[name]) for name in sorted(drop_ins)]
    value = ""
    for text in texts:
        for match in re.finditer(rf"^\s*{key}\s*=\s*(\S*)", text, re.MULTILINE):
            value = match[1]
    return value


def check_logind(diagnosis: Diagnosis) -> Finding:
    """Check whether the session manager will delete the segments at logout."""
    machine, uid = diagnosis.machine, diagnosis.runs_as
    if uid <= SYSTEM_UIDS:
        return ok("the daemon runs as a system account: logind does not delete its segments")
    if not machine.path("/run/systemd/system").exists():
        return ok("no systemd here: nothing is deleted at logout")
    if _logind_setting(machine, "RemoveIPC").lower() in ("no", "0", "false", "off"):
        return ok("logind has RemoveIPC=no: segments outlive sessions")
    account = account_name(uid)
    if machine.path(f"/var/lib/systemd/linger/{account}").exists():
        return ok(f"{account} lingers: segments outlive sessions")
    return warn(
        f"logind deletes the segments of {account} a few seconds after the last logout",
        f"loginctl enable-linger {account}, or install the system service",
    )


def check_reload(diagnosis: Diagnosis) -> Finding:
    """Check that the last attempt to read the map succeeded."""
    count = diagnosis.counters
    at_ns = count.get("last_reload_unix_ns", 0)
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at_ns * 1e-9)) if at_ns else ""
    if again := count.get("reloads", 0):
        fact = f"the map was read at the start and {counted(again, 'time')} again" + (
            at and f", last at {at}"
        )
    else:
        fact = "the map was read once, at the start" + (at and f" ({at})")
    if count.get("last_reload_failed", 0):
        return fail(
            f"{fact}; the last attempt failed, the map read before is served",
            "`shmmap reload` says why",
        )
    return ok(fact)


FEW_DESCRIPTORS: Final = 4096
_LIMIT: Final = re.compile(r"^Max open files\s+(\S+)\s+(\S+)", re.MULTILINE)


def check_pins(diagnosis: Diagnosis) -> Finding:
    """Check that the kernel can report whether any process maps a segment."""
    try:
        directory = ShmDirectory(diagnosis.shm_dir)
    except CannotStart as error:
        if diagnosis.alive:
            return ok("tried by the daemon when it started: see `shmmap status`")
        return fail(error.message, error.hint)
    try:
        found = probe_pins(directory)
    finally:
        directory.close()
    if not found.leases:
        return warn(
            f"{diagnosis.shm_dir} grants none: memory in use is known from {found.source.value} only",
            "name a directory on a tmpfs with shm_dir",
        )
    parts = {"locks": found.locks, "inotify": found.close_events}
    if lacking := ", ".join(f"no {part}" for part, works in parts.items() if not works):
        return warn(
            f"they work, but not all of what goes with them: {lacking}",
            "clients may stay unnamed, or memory be freed late: use a newer kernel",
        )
    return ok("leases and locks work: the kernel reports which processes map a segment")


def check_descriptors(diagnosis: Diagnosis) -> Finding:
    """Check how many clients the limit on open files allows."""
    limits = _LIMIT.search(diagnosis.machine.text(f"/proc/{diagnosis.pid}/limits")) if diagnosis.pid else None
    hard = limits[2] if limits else str(resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    whose = f"of the daemon (pid {diagnosis.pid})" if limits else "here"
    if not hard.isdigit() or int(hard) < 0:
        return ok(f"no limit {whose}")
    fact = f"limit {whose}: {hard}, enough for {int(hard) // 2} clients"
    if int(hard) < FEW_DESCRIPTORS:
        return warn(fact, "raise it: LimitNOFILE=65536 in the unit, or `ulimit -Hn`")
    return ok(fact)
