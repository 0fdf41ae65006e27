# SPDX-License-Identifier: Apache-2.0
"""Identify the daemon that writes the statistics, and check whether that process still runs.

A process id may be reused; together with the process's start time it is unique.
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass, fields
from typing import Final, Literal, TypeAlias

from shmmap.errors import SegmentCorrupt

DaemonState: TypeAlias = Literal["healthy", "starting", "stopped", "hung", "dead"]

HUNG_AFTER_S: Final = 5.0
"""Time without a beat after which a running daemon counts as hung."""


def _stat_fields(stat: bytes) -> list[str]:
    text = stat.decode("utf-8", "replace")
    return text[text.rindex(")") + 2 :].split()  # the command in front may contain spaces and brackets


def start_time_ticks(pid: int) -> int:
    """Return when a process started, in clock ticks since boot (field 22 of ``/proc/PID/stat``)."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        return int(_stat_fields(file.read())[19])


def pid_namespace() -> int:
    """Return the inode of this process's pid namespace; 0 if /proc does not show it."""
    try:
        return os.stat("/proc/self/ns/pid").st_ino
    except OSError:
        return 0


@dataclass(frozen=True, slots=True)
class DaemonIdentity:
    """A run of the daemon, and the map that it serves.

    Attributes
    ----------
    pid, start_time_ticks, pid_namespace
        The process: id, start in clock ticks since boot, inode of the namespace the id is valid in.
    epoch
        64-bit number of this run.
    instance, endpoint, shm_dir
        Name of the instance, path of its socket, directory of its segments.
    map_path, map_version, frame_id
        The map as configured, 64-bit hash of its catalogue, frame of its coordinates.
    id_prefix
        Prefix that ids of cells lack in the daemon's replies.
    library_version
        Version of shmmap the daemon runs.
    started_unix_ns
        Wall-clock start of this run.
    prepare
        Layers that it prepares for every cell, separated by blanks.
    live
        Names of the live maps that it keeps, separated by blanks.
    """

    pid: int
    start_time_ticks: int
    pid_namespace: int
    epoch: int
    instance: str
    endpoint: str
    map_path: str
    map_version: int
    shm_dir: str
    id_prefix: str
    library_version: str
    started_unix_ns: int
    frame_id: str = "map"
    prepare: str = ""
    live: str = ""

    def to_bytes(self) -> bytes:
        """Return name and value of every attribute, each ended by a NUL."""
        parts = []
        for field in fields(self):
            parts += [field.name.encode(), os.fsencode(str(getattr(self, field.name)))]
        return b"".join(part + b"\0" for part in parts)

    @classmethod
    def from_bytes(cls, data: bytes) -> DaemonIdentity:
        """Return the identity; names that this version does not know are ignored.

        Raises
        ------
        SegmentCorrupt
            A name is missing or a number is invalid.
        """
        parts = data.split(b"\0")
        found = {
            name.decode("utf-8", "replace"): os.fsdecode(value)
            for name, value in zip(parts[::2], parts[1::2], strict=False)
        }
        try:
            return cls(
                pid=int(found["pid"]),
                start_time_ticks=int(found["start_time_ticks"]),
                pid_namespace=int(found["pid_namespace"]),
                epoch=int(found["epoch"]),
                instance=found["instance"],
                endpoint=found["endpoint"],
                map_path=found["map_path"],
                map_version=int(found["map_version"]),
                shm_dir=found["shm_dir"],
                id_prefix=found["id_prefix"],
                library_version=found["library_version"],
                started_unix_ns=int(found["started_unix_ns"]),
                frame_id=found.get("frame_id", "map"),
                prepare=found.get("prepare", ""),
                live=found.get("live", ""),
            )
        except (KeyError, ValueError) as error:
            raise SegmentCorrupt(f"the statistics' identity is damaged: {error}") from error


class WriterProcess:
    """The process that writes the statistics, watched through one descriptor of ``/proc/PID/stat``.

    The descriptor refers to that process even when its id is reused, and reading takes a third of the time of
    opening.
    """

    def __init__(self, identity: DaemonIdentity) -> None:
        self._identity = identity
        self._fd = -1
        # in another namespace the pid is not valid: only the beat counts
        self._is_visible = identity.pid_namespace in (0, pid_namespace())
        if self._is_visible:
            with contextlib.suppress(OSError):
                self._fd = os.open(f"/proc/{identity.pid}/stat", os.O_RDONLY | os.O_CLOEXEC)

    def state(self, beat_age_s: float) -> DaemonState:
        """Return the daemon's state, given the age of its last beat in seconds."""
        letter = self._letter() if self._is_visible else ""
        if letter and letter in "ZXx":
            return "dead"
        if letter and letter in "Tt":
            return "stopped"
        return "healthy" if beat_age_s <= HUNG_AFTER_S else "hung"

    def _letter(self) -> str:
        """Return the state of the process as in ``/proc/PID/stat``, X if it is gone; empty if hidden."""
        if self._fd < 0:  # there was no such process, or /proc hides other users' processes
            try:
                os.kill(self._identity.pid, 0)
            except ProcessLookupError:
                return "X"
            except PermissionError:
                pass
            return ""
        try:
            found = _stat_fields(os.pread(self._fd, 1024, 0))
        except ProcessLookupError:
            return "X"
        return found[0] if int(found[19]) == self._identity.start_time_ticks else "X"

    def close(self) -> None:
        """Close the descriptor."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
